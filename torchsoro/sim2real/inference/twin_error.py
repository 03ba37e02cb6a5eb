"""What is known of the twin's own error: its size, and what corrects it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from torchsoro.sim2real.data.experiment import Trial
from torchsoro.sim2real.hypotheses.hypothesis import Hypothesis
from torchsoro.sim2real.twin.twin import MarkerTrajectory


@dataclass(frozen=True, kw_only=True, eq=False)
class DiscretizationError:
    """Error of the twin by its discretization; without any argument, none.

    Attributes:
        deviation: By trial, standard deviation [M, A] m once it is corrected, and modulus, pressure and measurement
            errors are fitted.
        shift: Of ln of the modulus, and of the pressure, with which the twin moves as a finer one does; zero if empty.
        correction: By trial, what the finer twin then adds to the motion that is believed [S, M, ...].
        own: By effects, the same with them, where it is known.
        touching: What the finer twin adds where planes are a little elsewhere, by trial, for each of some shifts; none
            without planes, or if they were not moved.
        between: What a twin with cells between those of the two adds to the finer one, by trial; none without planes.
        smaller: What a third twin with still smaller cells adds to the finer one, by trial; none without one. Where
            touching is calm, also what cells without size would add to that.
        unsure: Share of this by which it may be off: what cells without size would add to it at first order, or what
            was added for them.
        chance: Root mean square of what of that is not in proportion to the shift, so that which node touches when
            decides it [m]; not finite if it was not measured.
        chance_in_use: The same of the twin in use, by which derivatives are taken.
        edges: Of the cells of the twins that were compared [m], the one in use first.
        walls: Cells through the thinnest wall, or edge, of each.
    """

    deviation: Mapping[str, np.ndarray] = field(default_factory=dict)
    shift: tuple[float, ...] = ()
    correction: Mapping[str, MarkerTrajectory] = field(default_factory=dict)
    own: Mapping[tuple[Hypothesis, ...], Mapping[str, MarkerTrajectory]] = field(default_factory=dict)
    touching: tuple[Mapping[str, MarkerTrajectory], ...] = ()
    between: Mapping[str, MarkerTrajectory] = field(default_factory=dict)
    smaller: Mapping[str, MarkerTrajectory] = field(default_factory=dict)
    unsure: float = 0.0
    chance: float = math.inf
    chance_in_use: float = math.inf
    edges: tuple[float, ...] = ()
    walls: tuple[int, ...] = ()

    @property
    def mean(self) -> np.ndarray:
        """Deviation over the trials [M, A] m."""
        return np.asarray(np.mean(list(self.deviation.values()), axis=0))

    def of(self, trial: Trial) -> np.ndarray:
        """Deviation for a trial with a recording [M, A] m: its own, else the mean of those that are known, else 0."""
        if trial.name in self.deviation:
            return self.deviation[trial.name]
        assert trial.recording is not None
        return self.mean if self.deviation else np.zeros(trial.recording.position.shape[1:])

    def among(self, trials: Sequence[Trial]) -> DiscretizationError:
        """The same with deviations for just these trials."""
        return self.replace(deviation={t.name: self.of(t) for t in trials})

    def replace(self, **changes: Any) -> DiscretizationError:
        """The same with other values."""
        return dataclasses.replace(self, **changes)
