"""Hypotheses: effects that a setup may lack, as modules of a few parameters that change a scenario.

At zero strength a hypothesis leaves the scenario as it is, exactly.

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

# Model-form standard deviation of an effect that stands for a law; set so that 90 % intervals hold the truth in 90 % of
# cases whose truth is known: in 84 of 90 of two batches.
LAW = 0.15


@dataclass(frozen=True)
class Quantity:
    """A parameter of a hypothesis.

    Attributes:
        name: For reports.
        unit: SI.
        scale: Size of a noticeable change; unknowns of a fit are in these.
        least: Lower bound, in scales.
        most: Upper bound, in scales.
    """

    name: str
    unit: str
    scale: float
    least: float = -math.inf
    most: float = math.inf


@dataclass(frozen=True)
class Simpler:
    """An effect that another one extends, where it comes nearest to that.

    Attributes:
        name: Of the effect, of which the first form in the library is meant.
        values: Of its quantities in their units, and its place if it is local [K].
        ln_pressure: By what ln of the stated pressure differs then, which stands for the numbers that are left out.
    """

    name: str
    values: np.ndarray
    ln_pressure: float = 0.0


class Hypothesis(nn.Module):
    """One effect.

    Attributes:
        name: Of the effect.
        affected_quantity: Quantity of the simulation that it changes, in words.
        quantities: Its parameters.
        local: Whether it acts at one place, which is then fitted as well.
        starts: Values of the quantities at the probe points, in scales: alternatives, or, if ``joint``, one along each.
        joint: Whether the quantities are components that add up, as those of a vector.
        rugged: Whether chi-squared has so many valleys that searches begin at many points, see :meth:`spread`; they do
            only where no other effect explains what is seen.
        mass: Number of the quantity, if any, that is a mass, whose weight bends a body off its middle.
        ratios: Reported quantities that are exponentials of an unknown, so that their interval is a ratio.
        nonnegative: Reported quantities that cannot be negative.
        model_form_deviation: Relative standard deviation of a quantity that remains with any amount of data, since the
            effect in the body follows another law than the hypothesis: small for a constant of the body, larger for a
            parameter that stands for a law.
    """

    name: ClassVar[str]
    affected_quantity: ClassVar[str]
    quantities: tuple[Quantity, ...]
    local: ClassVar[bool] = False
    starts: tuple[tuple[float, ...], ...] = ()
    joint: ClassVar[bool] = False
    rugged: ClassVar[bool] = False
    mass: ClassVar[int | None] = None
    ratios: ClassVar[frozenset[str]] = frozenset()
    nonnegative: ClassVar[frozenset[str]] = frozenset()
    model_form_deviation: ClassVar[float] = 0.05

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

    def reported(self, values: np.ndarray, scenario: Scenario, twin: Twin) -> dict[str, tuple[float, str]]:
        """Values [K] as they are reported: numbers and units by name.

        Args:
            values: In the units of ``quantities``, without a place.
            scenario: That the effect is missing from.
            twin: The body.
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
        """Excess of ln of the modulus on the stiffest side over its mean: the stated one may be that of this side."""
        return 0.0

    def simpler(self, values: np.ndarray) -> list[Simpler]:
        """What is left of the effect at values [K] without one or more of its numbers; nothing that has no name."""
        return []

    def probe_points(self, twin: Twin) -> list[np.ndarray]:
        """Points at which the response is simulated: alternatives, each with directions [D, K] in scales.

        The response to directions of one alternative is taken as additive. A place is in tenths of the body's size and
        is not scaled with the direction.
        """
        starts = np.array(self.starts)
        alternatives = [starts] if self.joint else [start[None] for start in starts]
        if not self.local:
            return alternatives
        return [np.concatenate([a, np.tile(p, (len(a), 1))], 1) for p in _places(twin) for a in alternatives]

    def spread(self, twin: Twin, u: np.ndarray) -> np.ndarray:
        """Where searches of a rugged effect begin [N, K] in scales, with the place of a local one.

        Args:
            twin: The body.
            u: Points of the unit cube [N, K].
        """
        raise NotImplementedError

    def weak_probe_points(self, twin: Twin, strength: float) -> list[np.ndarray]:
        """Probe points at a small strength, where responses are nearly linear; one of those that differ in strength.

        Args:
            twin: The body.
            strength: Over that of :meth:`probe_points`.
        """
        kinds = len(self.quantities)
        # A second quantity that may be negative, as the logarithm of a time, is a shape and no strength.
        shape = np.array([q.least < 0 for q in self.quantities]) & (np.arange(kinds) > 0)
        shrink = np.concatenate([np.where(shape & ~self.joint, 1.0, strength), np.ones(3 * self.local)])
        if self.joint:
            return [d * shrink for d in self.probe_points(twin)]
        found: dict[bytes, np.ndarray] = {}
        for d in sorted(self.probe_points(twin), key=lambda d: abs(d[0, 0])):
            found.setdefault(np.where(shrink == 1, d[0], 0.0).tobytes(), d * shrink)
        return list(found.values())

    def with_masses_aside(self, directions: np.ndarray, twin: Twin) -> np.ndarray:
        """Directions of a probe point [D, K], and those with a local mass on the sides of the body [D + 4, K]."""
        if self.mass is None:
            return directions
        s, kinds = twin.setup, len(self.quantities)
        longest = int(np.argmax(s.size))
        row = directions[np.flatnonzero(directions[:, self.mass])[0]]
        rows = [directions]
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
