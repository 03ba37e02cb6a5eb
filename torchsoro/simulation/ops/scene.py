"""The arguments of the operator: a scene, which is constant and known by a number, and differentiable tensors."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from weakref import WeakValueDictionary

from torch import Tensor

from torchsoro.simulation.kernels import layout
from torchsoro.simulation.ops.lattice import Lattice

# Arguments of an operator of torch.library are tensors and numbers, so that a scene is passed by its handle.
_handles = itertools.count()
_scenes: WeakValueDictionary[int, Scene] = WeakValueDictionary()

Observe = Callable[[int, Tensor], None]
"""Called with a sampled substep, counted within the segment, and the state or its gradient there."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """Constant, non-differentiable data of a segment.

    Attributes:
        dt: Substep [s].
        cell: Grid cell [m].
        blend: 0 for APIC, 1 for affine FLIP, between them a mixture.
        low: Lower corner of the analysis box [m].
        high: Upper corner of the analysis box [m].
        kind: int32 [N], -1 for solid, else the number of the gas chamber.
        share: [groups, N], each particle's share of its group's force.
        plane_kind: int32 [planes, PLANE_INTEGERS]: axis (-1 if oblique), side (+1 or -1), 1 for stick or 0 for Coulomb,
            1 for elastic landing or 0.
        springs: Whether any particle has a spring or drag, be it of zero.
        viscous: Whether any solid particle has a viscosity, or one of zero with a gradient; of the total form only.
        stiffens: Whether any solid particle stiffens with stretch, or by zero with a gradient; a kernel of its own.
        probes: int64 [P], particles whose motion is recorded.
        lattice: Of the total-Lagrangian form; None for the updated form.
        lanes: Whether the total-Lagrangian form runs in lanes on a CPU, else by Taichi, as it does on a GPU.
        steady: Whether the scene is of one run, whose segments have the same coefficients, Maxwell elements and planes.
        handle: Number of this scene in the process, valid as long as the scene exists.
    """

    dt: float
    cell: float
    blend: float
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    kind: Tensor
    share: Tensor
    plane_kind: Tensor
    springs: bool
    viscous: bool
    stiffens: bool
    probes: Tensor
    lattice: Lattice | None = None
    lanes: bool = True
    steady: bool = False
    handle: int = field(init=False, default_factory=_handles.__next__)

    def __post_init__(self) -> None:
        """Register the scene under its handle."""
        _scenes[self.handle] = self

    @cached_property
    def last_chamber(self) -> int:
        """Highest number of a chamber, below 0 if there is none."""
        return int(self.kind.max())

    @cached_property
    def absent(self) -> Tensor | None:
        """Places of the lattice without a particle, bool [N]; None if there are none."""
        absent = self.kind == layout.ABSENT
        return absent if bool(absent.any()) else None

    @cached_property
    def _gas(self) -> dict[int, Tensor]:
        return {}

    def gas(self, chamber: int) -> Tensor:
        """The particles of a chamber, int64."""
        if chamber not in self._gas:
            self._gas[chamber] = (self.kind == chamber).nonzero().squeeze(1)
        return self._gas[chamber]


def scene_of(handle: int) -> Scene:
    """The scene with a handle."""
    return _scenes[handle]


@dataclass(frozen=True, kw_only=True, eq=False)
class Inputs:
    """The differentiable tensors of a segment of T substeps, one row per simulation.

    Attributes:
        coefficients: [B, COEFFICIENTS, N], see ``kernels.layout``.
        prony: [B, elements, 3]: decay, gain, modulus of each Maxwell element.
        pressure: [T + 1, B, chambers] supply pressure at each substep and after the last [Pa].
        gravity: [T, B, 3] [m/s2].
        force: [T, B, groups, 3] [N].
        planes: [B, planes, PLANE]: offset [m], Coulomb coefficient, adhesive traction [Pa], its reach [m], normal.
        origin: [B, 3] a grid node [m].
    """

    coefficients: Tensor
    prony: Tensor
    pressure: Tensor
    gravity: Tensor
    force: Tensor
    planes: Tensor
    origin: Tensor
