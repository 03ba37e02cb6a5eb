"""All input of one simulation; hypotheses change it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchsoro.simulation.actuation import Waveform
from torchsoro.simulation.material import Prony


@dataclass(frozen=True, kw_only=True, eq=False)
class ObliquePlane:
    """A plane that the body does not penetrate.

    Attributes:
        normal: Unit normal to the body's side [3].
        offset: Of the plane along it [...] m.
        friction: Coulomb coefficient [...]; "stick" for no slip under compression.
        adhesion: Traction towards the plane, which also counts as normal traction for friction [...] Pa.
        reach: Distance up to which adhesion acts [...] m.
    """

    normal: Tensor
    offset: Tensor
    friction: Tensor | str
    adhesion: Tensor
    reach: Tensor

    @property
    def sticks(self) -> bool:
        """Whether the plane holds what is pressed on it."""
        return isinstance(self.friction, str)


@dataclass(frozen=True, kw_only=True, eq=False)
class NodalForce:
    """A dead force on nodes, from a time on.

    Attributes:
        share: Of each node [n], sum 1.
        value: [..., 3] N.
        start: When it begins [s].
    """

    share: Tensor
    value: Tensor
    start: float


@dataclass(frozen=True, kw_only=True, eq=False)
class NodalSpring:
    """A spring from the mean place of some nodes to where that was in the undeformed body.

    Attributes:
        share: Of each node [..., n], sum 1.
        stiffness: [...] N/m.
    """

    share: Tensor
    stiffness: Tensor


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
        point_mass: Attached to nodes [..., n] kg.
        drag: Of nodes [..., n] N s/m.
        quadratic_drag: Density of what surrounds the body times its drag coefficient [...] kg/m3.
        planes: Planes.
        forces: Dead forces.
        springs: Springs to the ground.
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
    point_mass: Tensor
    drag: Tensor
    quadratic_drag: Tensor
    planes: tuple[ObliquePlane, ...]
    forces: tuple[NodalForce, ...]
    springs: tuple[NodalSpring, ...]
    duration: float
    until: float

    def replace(self, **changes) -> Scenario:
        """A scenario with other values."""
        return dataclasses.replace(self, **changes)

    @cached_property
    def batch(self) -> int:
        """Number of variations."""
        ranks = [(self.youngs_modulus, 1), (self.poisson_ratio, 0), (self.density, 1), (self.stiffening, 1)]
        ranks += [(self.air_stiffness, 1), (self.gravity, 1), (self.point_mass, 1), (self.drag, 1)]
        ranks += [(self.softening, 1), (self.quadratic_drag, 0), (self.displacement, 2), (self.velocity, 2)]
        ranks += [
            (t, 0) for g in self.planes for t in (g.offset, g.adhesion, g.reach, g.friction) if isinstance(t, Tensor)
        ]
        ranks += [(p.value, 1) for p in self.forces] + [(s.stiffness, 0) for s in self.springs]
        if self.prony is not None:
            ranks.append((self.prony.moduli, 1))
        if self.pressure is not None:
            ranks.append((self.pressure.pressure, 2))
        lead = torch.broadcast_shapes(*(t.shape[: t.ndim - rank] for t, rank in ranks))
        return lead[0] if lead else 1
