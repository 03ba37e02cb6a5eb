"""What may have been left out: modules of at most three parameters that change a scenario, exactly nothing at zero.

A hypothesis of one's own is a subclass of :class:`Hypothesis`:

    class Magnet(Hypothesis):
        name, affected_quantity = "magnet", "a force along z on the tip"
        quantities = (Quantity("force", "N", 0.1),)

        def forward(self, scenario, values, twin):
            ...
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from torch import Tensor, nn

from torchsoro.sim2real.twin.scenario import Scenario
from torchsoro.sim2real.twin.twin import Twin

LAW = 0.35  # see Hypothesis.form; of cases whose truth is known, what covers 90 %


@dataclass(frozen=True)
class Quantity:
    """A parameter of a hypothesis.

    Attributes:
        name: For reports.
        unit: SI.
        scale: A strength that one would notice: the fit counts in these.
        least: Lower bound, in scales.
        most: Upper bound, in scales.
    """

    name: str
    unit: str
    scale: float
    least: float = -math.inf
    most: float = math.inf


class Hypothesis(nn.Module):
    """One effect.

    Attributes:
        name: Of the effect.
        affected_quantity: What of the simulation it changes, for people.
        quantities: Its parameters.
        local: Whether it acts at a place, which is then inferred along with them.
        starts: Strengths to look at first, in scales: alternatives, or, if ``joint``, one of each parameter.
        joint: Whether the parameters add up, as components of a vector do.
        mass: Number of the parameter, if any, that is a mass: off the middle of a body, its weight bends that.
        form: Share of a parameter that stays unknown, as nature's form of the effect is not the hypothesis': small for
            a number that a body has, larger for one that stands for a law.
    """

    name: ClassVar[str]
    affected_quantity: ClassVar[str]
    quantities: tuple[Quantity, ...]
    local: ClassVar[bool] = False
    starts: tuple[tuple[float, ...], ...] = ()
    joint: ClassVar[bool] = False
    mass: ClassVar[int | None] = None
    ratios: ClassVar[frozenset[str]] = frozenset()
    nonnegative: ClassVar[frozenset[str]] = frozenset()
    model_form_deviation: ClassVar[float] = 0.1

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """The scenario with the effect.

        Args:
            scenario: Without it; its tensors may have a leading batch [B].
            values: In the units of ``quantities`` [B, K]; of a local effect, its place [m] follows in three more.
            twin: The body.
        """
        raise NotImplementedError

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """Whether the experiment has what the effect changes."""
        return True

    def reported(self, values: np.ndarray, scenario: Scenario) -> dict[str, tuple[float, str]]:
        """Values [K] as people say them: numbers and units by name.

        Args:
            values: In the units of ``quantities``, without a place.
            scenario: That the effect is missing from.
        """
        return {q.name: (float(v), q.unit) for q, v in zip(self.quantities, values, strict=True)}

    def place(self, values: np.ndarray, twin: Twin) -> np.ndarray | None:
        """Where it acts [3] m, if anywhere; values [K] with the place of a local effect.

        Args:
            values: In the units of ``quantities``, then the place.
            twin: The body.
        """
        return values[len(self.quantities) :] if self.local else None

    def varies(self, values: np.ndarray) -> float:
        """By how much ln of the modulus is higher on the stiff side than on average: it may be what is believed."""
        return 0.0

    def simpler(self, values: np.ndarray) -> tuple[str, np.ndarray] | None:
        """The effect that it comes to at values [K], by name, and that one's values."""
        return None

    def probe_points(self, twin: Twin) -> list[np.ndarray]:
        """What to look at first: alternatives, each with directions [D, K] in scales, which add up.

        Strengths of what adds up need not be tried; others may change the motion so much that nothing is linear.
        A place is in tenths of the body's size, and stays when a direction is scaled.
        """
        starts = np.array(self.starts)
        alternatives = [starts] if self.joint else [start[None] for start in starts]
        if not self.local:
            return alternatives
        return [np.concatenate([a, np.tile(p, (len(a), 1))], 1) for p in _places(twin) for a in alternatives]

    def weak_probe_points(self, twin: Twin, strength: float) -> list[np.ndarray]:
        """Looks that are so weak that the motion changes in proportion; of those that differ in strength only, one.

        Args:
            twin: The body.
            strength: Of the looks, in their own.
        """
        kinds = len(self.quantities)
        # What has no end at zero, as the logarithm of a time, is a form and no strength.
        form = np.array([q.least < 0 for q in self.quantities]) & (np.arange(kinds) > 0)
        shrink = np.concatenate([np.where(form & ~self.joint, 1.0, strength), np.ones(3 * self.local)])
        if self.joint:
            return [d * shrink for d in self.probe_points(twin)]
        found: dict[bytes, np.ndarray] = {}
        for d in sorted(self.probe_points(twin), key=lambda d: abs(d[0, 0])):
            found.setdefault(np.where(shrink == 1, d[0], 0.0).tobytes(), d * shrink)
        return list(found.values())

    def with_masses_aside(self, probe: np.ndarray, twin: Twin) -> np.ndarray:
        """A look of a local effect [D, K], with its mass on the sides of the body as well [D + 4, K]."""
        if self.mass is None:
            return probe
        s, kinds = twin.setup, len(self.quantities)
        longest = int(np.argmax(s.size))
        row = probe[np.flatnonzero(probe[:, self.mass])[0]]
        rows = [probe]
        for axis in (a for a in range(3) if a != longest):
            for side in (s.origin[axis], s.origin[axis] + s.size[axis]):
                aside = row.copy()
                aside[kinds + axis] = 10 * side / s.size[axis]
                rows.append(aside[None])
        return np.concatenate(rows)


def _places(twin: Twin) -> list[np.ndarray]:
    """Along the middle of the body's longest edge, beginning well off a clamp; in tenths of its size."""
    s = twin.setup
    longest = int(np.argmax(s.size))
    held = {side for axis, side in twin.faces if axis == longest}
    found = []
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        if (share < 0.3 and -1 in held) or (share > 0.7 and 1 in held):
            continue
        place = np.array(s.origin) + np.array(s.size) / 2
        place[longest] = s.origin[longest] + share * s.size[longest]
        found.append(10 * place / np.array(s.size))
    return found
