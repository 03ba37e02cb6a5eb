"""All input of one simulation; hypotheses change it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property

from torch import Tensor

from torchsoro.simulation.actuation import Waveform
from torchsoro.simulation.contact import Plane
from torchsoro.simulation.loads import Load
from torchsoro.simulation.material import Prony


@dataclass(frozen=True, kw_only=True, eq=False)
class Scenario:
    """All input of a simulation; leading axes [...] are a batch of variations; float64.

    Attributes:
        youngs_modulus: Young's modulus at each point of the body [..., P] Pa.
        poisson_ratio: [...].
        density: At each point [..., P] kg/m3.
        prony: Maxwell elements.
        stiffening: Coefficients a, b of x and x^2 in mu (1 + a x + b x^2), x = I1b - 3 [..., 2].
        softening: Depth and range of softening below the largest x so far [..., 2].
        air_stiffness: Pressure that a chamber loses as its volume doubles [..., chambers] Pa.
        pressure: Supply [..., chambers, S] Pa; None without a chamber.
        gravity: [..., 3] m/s2.
        displacement: Of the nodes at the start [..., n, 3] m.
        velocity: The same [..., n, 3] m/s.
        planes: Planes, with a normal each.
        loads: Forces, point masses, springs to mean places and drag on nodes, and drag of what surrounds the body.
        duration: Of the trial [s].
        until: End of the simulation [s]; after that of the trial where the clock of a recording may be late.
    """

    youngs_modulus: Tensor
    poisson_ratio: Tensor
    density: Tensor
    prony: Prony | None
    stiffening: Tensor
    softening: Tensor
    air_stiffness: Tensor
    pressure: Waveform | None
    gravity: Tensor
    displacement: Tensor
    velocity: Tensor
    planes: tuple[Plane, ...]
    loads: tuple[Load, ...]
    duration: float
    until: float

    def replace(self, **changes) -> Scenario:
        """A scenario with other values."""
        return dataclasses.replace(self, **changes)

    def plus(self, *loads: Load) -> Scenario:
        """A scenario with more loads."""
        return self.replace(loads=(*self.loads, *loads))

    @cached_property
    def batch(self) -> int:
        """Number of variations."""
        ranks = [(self.youngs_modulus, 1), (self.poisson_ratio, 0), (self.density, 1), (self.stiffening, 1)]
        ranks += [(self.air_stiffness, 1), (self.gravity, 1)]
        ranks += [(self.softening, 1), (self.displacement, 2), (self.velocity, 2)]
        ranks += [
            (t, 0) for g in self.planes for t in (g.offset, g.adhesion, g.reach, g.friction) if isinstance(t, Tensor)
        ]
        for load in self.loads:
            named = {"value": 1, "mass": 0, "stiffness": 0, "coefficient": 0, "share": 1, "support": 1, "length": 0}
            given = [(getattr(load, name, None), rank) for name, rank in named.items()]
            ranks += [(t, rank) for t, rank in given if isinstance(t, Tensor)]
        if self.prony is not None:
            ranks.append((self.prony.moduli, 1))
        if self.pressure is not None:
            ranks.append((self.pressure.pressure, 2))
        return max(t.shape[0] if t.ndim > rank else 1 for t, rank in ranks)
