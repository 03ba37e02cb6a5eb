"""How much better recordings are predicted, and where and when they are the furthest from what was believed."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from torchsoro.sim2real.data.experiment import Trial


@dataclass(frozen=True, kw_only=True)
class Improvement:
    """Distances between recording and simulation, root mean squares over markers and time.

    Attributes:
        trials: By name, as believed and as explained [m].
        heldout: Whether the trials were left out of the fit.
        floor: That noise and the simulation's remaining error make by themselves [m].
    """

    trials: dict[str, tuple[float, float]]
    heldout: bool
    floor: float

    @property
    def believed(self) -> float:
        """Root mean square over the trials [m]."""
        return math.sqrt(float(np.mean([b**2 for b, _ in self.trials.values()])))

    @property
    def explained(self) -> float:
        """The same as explained [m]."""
        return math.sqrt(float(np.mean([a**2 for _, a in self.trials.values()])))


@dataclass(frozen=True, kw_only=True)
class Worst:
    """Where and when a trial's recording is the furthest from what was believed.

    Attributes:
        trial: Number of the trial.
        marker: Number of the marker.
        sample: Number of the sample.
        time: Of the sample by the recording's clock [s].
        believed: Distance there as believed [m].
        explained: Distance there as explained [m].
    """

    trial: int
    marker: int
    sample: int
    time: float
    believed: float
    explained: float


def distances(trial: Trial, simulated: np.ndarray) -> np.ndarray:
    """Of each marker from the recording [T, M] m; not a number where a sample was lost.

    Args:
        trial: With a recording.
        simulated: What would have been recorded [T, M, A] m.
    """
    assert trial.recording is not None
    return np.linalg.norm(trial.recording.position - simulated, axis=-1)


def worst_of(number: int, trial: Trial, believed: np.ndarray, explained: np.ndarray) -> Worst:
    """The largest distance of a trial as believed.

    Args:
        number: Of the trial.
        trial: With a recording.
        believed: What would have been recorded [T, M, A] m.
        explained: The same as explained.
    """
    assert trial.recording is not None
    apart = distances(trial, believed)
    sample, marker = np.unravel_index(int(np.nanargmax(apart)), apart.shape)
    return Worst(
        trial=number,
        marker=int(marker),
        sample=int(sample),
        time=float(trial.recording.time[sample]),
        believed=float(apart[sample, marker]),
        explained=float(distances(trial, explained)[sample, marker]),
    )
