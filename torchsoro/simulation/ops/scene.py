"""The arguments of the operator: a scene, which is constant and known by a number, and differentiable tensors."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any
from weakref import WeakValueDictionary

import torch
from torch import Tensor

from torchsoro.simulation.kernels import layout
from torchsoro.simulation.ops.lattice import Lattice
from torchsoro.simulation.ops.markers import Markers

# Arguments of an operator of torch.library are tensors and numbers, so that a scene is passed by its handle.
_handles = itertools.count()
_scenes: WeakValueDictionary[int, Scene] = WeakValueDictionary()

Observe = Callable[[int, Tensor], None]
"""Called with a sampled substep, counted within the segment, and the state or its gradient there."""

ObserveMany = Callable[[int | list[int], Tensor], None]
"""Called with a sampled substep and the state there, or with several and their states [S, ...]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """Constant, non-differentiable data of a segment.

    Attributes:
        dt: Substep [s].
        cell: Grid cell [m].
        blend: 0 for APIC, 1 for affine FLIP, between them a mixture.
        low: Lower corner of the analysis box [m].
        high: Upper corner of the analysis box [m].
        kind: int32 [N], -1 for solid, else the number of the gas chamber; ENCLOSES - c for a solid of which a share is
            air of chamber c.
        share: [groups, N], each particle's share of its group's force.
        plane_kind: int32 [planes, PLANE_INTEGERS]: axis (-1 if oblique), side (+1 or -1), 1 for stick or 0 for Coulomb,
            1 for elastic landing or 0.
        springs: Whether any particle has a spring, be it of zero.
        drags: Whether any particle has drag, be it of zero.
        viscous: Whether any solid particle has a viscosity, or one of zero with a gradient; of the total form only.
        stiffens: Whether any solid particle stiffens with stretch, or by zero with a gradient; a kernel of its own.
        softens: Whether solids soften below their largest stretch; a number more of every point in the state.
        immersed: Whether what surrounds the body resists it by the square of its velocity; wants ``Lattice.faces``.
        held: bool [nodes], nodes of the lattice that keep their state; None if there are none.
        node_share: [more, nodes], each node's share of the forces that follow those of ``share`` in ``Inputs.force``.
        force_start: First substep of the run at which each force acts, if ``Inputs.force`` has one row for all
            substeps; None if it has one for each. In lanes without gradient only.
        tie_share: [B, Q, nodes], each node's share of the groups whose mean displacement a spring resists; None if
            there are none.
        chain_steps: Steps that chains take within a substep; 0 if there are none. Without gradient, in one segment.
        probes: int64 [P], particles whose motion is recorded.
        markers: Places whose motion is recorded instead, with its gradient; of the total-Lagrangian form.
        lattice: Of the total-Lagrangian form; None for the updated form.
        lanes: Whether the total-Lagrangian form runs in lanes on a CPU, else by Taichi, as it does on a GPU.
        apart: Whether simulations that diverge go on with what is not finite, and the others are not disturbed.
        only_markers: Whether nothing is recorded but the motion of the markers; where simulations go on apart only.
        device: Where to simulate a scene whose tensors are on a CPU; with them if None. Of the total-Lagrangian form,
            where only markers are recorded.
        self_contact: Whether the surface of a body repels itself; of the total-Lagrangian form, on a uniform lattice.
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
    drags: bool
    viscous: bool
    stiffens: bool
    probes: Tensor
    softens: bool = False
    immersed: bool = False
    held: Tensor | None = None
    node_share: Tensor | None = None
    force_start: tuple[int, ...] | None = None
    tie_share: Tensor | None = None
    chain_steps: int = 0
    lattice: Lattice | None = None
    markers: Markers | None = None
    lanes: bool = True
    apart: bool = False
    only_markers: bool = False
    device: torch.device | None = None
    self_contact: bool = False
    steady: bool = False
    handle: int = field(init=False, default_factory=_handles.__next__)

    def __post_init__(self) -> None:
        """Register the scene under its handle."""
        _scenes[self.handle] = self

    @cached_property
    def gas_chambers(self) -> int:
        """Number of chambers of gas particles; hollow ones follow them."""
        return max(int(self.air.max()) + 1, 0) if len(self.air) else 0

    @cached_property
    def air(self) -> Tensor:
        """The chamber whose air each particle is, or has a share of, int32 [N]; negative for none."""
        return torch.where(self.kind <= layout.ENCLOSES, layout.ENCLOSES - self.kind, self.kind)

    @cached_property
    def shared(self) -> bool:
        """Whether solids have shares of the chambers' air, rather than that gas particles are all of it."""
        return bool((self.kind <= layout.ENCLOSES).any())

    @property
    def chambers(self) -> int:
        """Number of chambers."""
        walls = None if self.lattice is None else self.lattice.walls
        return self.gas_chambers + (0 if walls is None else walls.count)

    @property
    def forces(self) -> int:
        """Number of forces."""
        return len(self.share) + (0 if self.node_share is None else len(self.node_share))

    @cached_property
    def absent(self) -> Tensor | None:
        """Places of the lattice without a particle, bool [N]; None if there are none."""
        absent = self.kind == layout.ABSENT
        return absent if bool(absent.any()) else None

    @cached_property
    def _gas(self) -> dict[int, Tensor]:
        return {}

    def gas(self, chamber: int) -> Tensor:
        """The particles that are air of a chamber, or have a share of it, int64."""
        if chamber not in self._gas:
            self._gas[chamber] = (self.air == chamber).nonzero().squeeze(1)
        return self._gas[chamber]


def scene_of(handle: int) -> Scene:
    """The scene with a handle."""
    return _scenes[handle]


_NONE: Any = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Inputs:
    """The differentiable tensors of a segment of T substeps, one row per simulation.

    Those from ``softening`` on are of the total-Lagrangian form; none of them acts if they are left out.

    Attributes:
        coefficients: [B, COEFFICIENTS, N], see ``kernels.layout``.
        prony: [B, elements, 3]: decay, gain, modulus of each Maxwell element.
        pressure: [T + 1, B, chambers] supply pressure at each substep and after the last [Pa].
        gravity: [T, B, 3] [m/s2].
        force: [T, B, forces, 3] [N], those on particles, then those on nodes; see also ``Scene.force_start``.
        planes: [B, planes, PLANE]: offset [m], Coulomb coefficient, adhesive traction [Pa], its reach [m], normal, what
            is added to the coefficient at rest, speed that halves it [m/s].
        origin: [B, 3] a grid node [m].
        softening: [B, 2] depth d and range r of the shear modulus' factor 1 - d erf(u / r), where u is by how much
            x = I1b - 3 is less than its largest so far.
        fluid: [B] density of what surrounds the body times its drag coefficient [kg/m3]: along each axis a force of
            half of it times the area (``Faces.front``) times v |v|, taken implicitly.
        ties: [B, Q] stiffness of springs to the mean displacement of some nodes (``Scene.tie_share``) [N/m].
        chains: [B, Q, CHAIN] chains on the mean place of the same nodes (``kernels.layout``); [B, 0, CHAIN] for none.
        air: [B, hollow chambers] pressure that the air in each loses as its volume doubles [Pa].
        attached: [B, 2, nodes] mass [kg] and drag coefficient [N s/m] attached to nodes; [B, 2, 0] for none.
    """

    coefficients: Tensor
    prony: Tensor
    pressure: Tensor
    gravity: Tensor
    force: Tensor
    planes: Tensor
    origin: Tensor
    softening: Tensor = _NONE
    fluid: Tensor = _NONE
    ties: Tensor = _NONE
    chains: Tensor = _NONE
    air: Tensor = _NONE
    attached: Tensor = _NONE

    def __post_init__(self) -> None:
        """Fill in what is left out."""
        like = self.coefficients
        none = {"fluid": (len(like),), "ties": (len(like), 0), "chains": (len(like), 0, layout.CHAIN)}
        none |= {"air": (len(like), 0), "attached": (len(like), 2, 0)}
        for name, shape in none.items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, like.new_zeros(shape))
        if self.softening is None:
            object.__setattr__(self, "softening", like.new_tensor([0.0, 1.0]).expand(len(like), 2))
