"""What is attached to groups of particles or nodes: forces, point masses, springs, chains, drag, clamps.

A group shares its load equally, or by ``share`` [..., n], whose sum is 1. Without ``particles`` a share is one of each
node of the lattice, which ``Total(lattice=...)`` is told: so a load can be anywhere in the body.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsoro.simulation.actuation import Waveform
from torchsoro.simulation.material import Body


@dataclass(frozen=True, kw_only=True, eq=False)
class Force:
    """A dead force on a group.

    Attributes:
        particles: int64 indices [n]; None for nodes.
        value: [..., 3] N, constant; or [..., S, 3] with ``time``.
        time: [S] s, increasing; interpolated linearly.
        share: Of each particle or node [n]; equal if None. No gradient flows to it.
        start: Since when a constant force acts [s].

    Raises:
        ValueError: for neither particles nor a share, or a start that is not finite or stands beside ``time``.
    """

    particles: Tensor | None = None
    value: Tensor
    time: Tensor | None = None
    share: Tensor | None = None
    start: float = 0.0

    def __post_init__(self) -> None:
        """Check the group and the start."""
        _check_group(self)
        if not math.isfinite(self.start) or (self.time is not None and self.start != 0):
            raise ValueError(f"start = {self.start}: wanted a finite time of a force that is constant since then")

    def first(self, dt: float) -> int:
        """The first of the steps of ``dt`` [s] in which a constant force acts, however its start is rounded."""
        return max(0, math.ceil(self.start / dt - 1e-3))

    def at(self, t: Tensor, dt: float | None = None) -> Tensor:
        """Force at times t [T], where steps of ``dt`` [s] may begin: [..., T, 3] N, in the type of ``value``."""
        if self.time is None:
            found = self.value.unsqueeze(-2).expand(*self.value.shape[:-1], len(t), 3)
            begin = self.start if dt is None else (self.first(dt) - 0.5) * dt
            return found * (t >= begin).to(found)[:, None]
        return vectors_at("Force", self.time, self.value, t)


@dataclass(frozen=True, kw_only=True, eq=False)
class PointMass:
    """A mass carried by a group, with inertia and weight.

    Attributes:
        particles: int64 indices [n]; None for nodes.
        mass: [...] kg.
        share: Of each particle or node [..., n]; equal if None.

    Raises:
        ValueError: for neither particles nor a share.
    """

    particles: Tensor | None = None
    mass: Tensor | float
    share: Tensor | None = None

    def __post_init__(self) -> None:
        """Check the group."""
        _check_group(self)


@dataclass(frozen=True, kw_only=True, eq=False)
class Spring:
    """A spring from each particle of a group to its place plus ``shift``; together of the given stiffness.

    Attributes:
        particles: int64 indices [n]; None for nodes, with ``mean``.
        stiffness: [...] N/m of the whole group.
        shift: [..., 3] m from the reference place to the rest point; not with ``mean``.
        share: Of each particle or node [..., n]; equal if None. Without a gradient with ``mean``.
        mean: Whether there is one spring, from the group's mean place to where that is in the undeformed body: the
            group is free to turn and to deform about it. Total formulation only. Its stiffness sets no limit to the
            step that the simulator knows of: on nodes of little mass a stiff one needs a smaller step.

    Raises:
        ValueError: for neither particles nor a share, nodes without ``mean``, or a shift with it.
    """

    particles: Tensor | None = None
    stiffness: Tensor | float
    shift: Tensor | None = None
    share: Tensor | None = None
    mean: bool = False

    def __post_init__(self) -> None:
        """Check the group."""
        _check_group(self)
        if self.particles is None and not self.mean:
            raise ValueError("mean = False: a spring on nodes, wanted mean = True, or particles")
        if self.mean and self.shift is not None:
            raise ValueError("shift: beside mean = True, wanted a spring to the mean place in the undeformed body")


@dataclass(frozen=True, kw_only=True, eq=False)
class Chain:
    """A tube that hangs between a group's mean place and a fixed end: beads in a row, joined by links that only pull.

    It begins at rest, with the body where it is undeformed. Total formulation only, without a gradient, and not in a
    simulation that goes on from another.

    Attributes:
        share: Of each node [..., nodes].
        support: The fixed end, as seen from the group's mean place in the undeformed body [..., 3] m.
        length: Unstretched [...] m.
        mass: [...] kg; one of none does not pull.
        stiffness: Of the whole chain when taut [...] N/m.
        damping: Of each link, over that which is critical for a bead on it [...].
    """

    share: Tensor
    support: Tensor
    length: Tensor | float
    mass: Tensor | float
    stiffness: Tensor | float
    damping: Tensor | float


@dataclass(frozen=True, kw_only=True, eq=False)
class Drag:
    """Linear drag on a group.

    Attributes:
        particles: int64 indices [n]; None for nodes.
        coefficient: [...] N s/m of the whole group.
        share: Of each particle or node [..., n]; equal if None.

    Raises:
        ValueError: for neither particles nor a share.
    """

    particles: Tensor | None = None
    coefficient: Tensor | float
    share: Tensor | None = None

    def __post_init__(self) -> None:
        """Check the group."""
        _check_group(self)


@dataclass(frozen=True, eq=False)
class QuadraticDrag:
    """What surrounds the body resists by c/2 A v |v| along each axis, on the area A of its undeformed faces across it.

    Of a lattice with ``faces`` only. Several add up.

    Attributes:
        coefficient: c = density times drag coefficient [...] kg/m3.
    """

    coefficient: Tensor | float


@dataclass(frozen=True)
class Clamp:
    """Holds the nodes of the lattice in a box of the undeformed body; total formulation only.

    The outermost nodes lie on the body's faces if the lattice is one with open knots (``Axis``), and half a cell in
    front of them if it is uniform.

    Attributes:
        low: Lower corner [m].
        high: Upper corner [m].
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]


Load = Force | PointMass | Spring | Chain | Drag | QuadraticDrag | Clamp


@dataclass(frozen=True, kw_only=True, eq=False)
class Attached:
    """Loads as the particles feel them.

    Attributes:
        body: The body, with the point masses added.
        spring: [..., N] N/m, or None without springs.
        anchor: [..., N, 3] m, or None.
        drag: [..., N] N s/m, or None.
        forces: The forces, one group each; those on particles come first.
        share: [groups, N] of those on particles.
        more: What is attached to nodes or acts on means, as it was given: springs, point masses, drag, clamps.
    """

    body: Body
    spring: Tensor | None
    anchor: Tensor | None
    drag: Tensor | None
    forces: tuple[Force, ...]
    share: Tensor
    more: tuple[Load, ...] = ()


def attach(body: Body, loads: Sequence[Load]) -> Attached:
    """Distribute loads over the particles of a body.

    Args:
        body: The body.
        loads: Any number of loads; groups may overlap, but no two springs may share a particle.

    Raises:
        ValueError: for an empty group, an index out of range, a negative mass, stiffness or coefficient, springs that
            share a particle, forces or shifts of the wrong shape or not finite, or a force's share that requires a
            gradient.
    """
    x = body.position.detach()
    count = x.shape[-2]
    mass, spring = body.mass, x.new_zeros(count)
    drag = x.new_zeros(count) if body.drag is None else body.drag
    anchor = body.position
    forces = [load for load in loads if isinstance(load, Force)]
    forces.sort(key=lambda force: force.particles is None)
    shares = [x.new_zeros(0, count)]
    held = torch.zeros(count, dtype=torch.bool, device=x.device)
    more = tuple(load for load in loads if _elsewhere(load))
    loads = [load for load in loads if not _elsewhere(load)]
    for force in forces:
        _check_vector("force", force.value)
    for load in loads:
        assert not isinstance(load, QuadraticDrag | Clamp | Chain)
        assert load.particles is not None
        group = group_shares(load.particles, load.share, count, x)
        if isinstance(load, Force):
            if group.ndim > 1:
                raise ValueError(f"share of a force: shape {tuple(group.shape[:-1])} of a batch, wanted [n]")
            if group.requires_grad:
                raise ValueError(
                    "share of a force: requires a gradient, which is not computed, wanted one without; forces on parts "
                    "of the group have gradients by their values"
                )
            shares.append(group.unsqueeze(0))
        elif isinstance(load, PointMass):
            mass = mass + load_amount("mass", load.mass, x).unsqueeze(-1) * group
        elif isinstance(load, Drag):
            drag = drag + load_amount("drag coefficient", load.coefficient, x).unsqueeze(-1) * group
        else:
            there = (group > 0).reshape(-1, count).any(0)
            if bool((held & there).any()):
                raise ValueError("springs: two groups share a particle, wanted groups apart from each other")
            held |= there
            spring = spring + load_amount("stiffness", load.stiffness, x).unsqueeze(-1) * group
            if load.shift is not None:
                _check_vector("spring shift", load.shift)
                place = there.to(x).unsqueeze(-1)
                anchor = anchor + place * load.shift.to(x).unsqueeze(-2)
    tied = any(isinstance(load, Spring) for load in loads)
    dragged = body.drag is not None or any(isinstance(load, Drag) for load in loads)
    return Attached(
        body=replace(body, mass=mass),
        spring=spring if tied else None,
        anchor=anchor if tied else None,
        drag=drag if dragged else None,
        forces=tuple(forces),
        share=torch.cat(shares),
        more=more,
    )


def _elsewhere(load: Load) -> bool:
    """Whether a load is not on particles, each by itself."""
    return (
        isinstance(load, QuadraticDrag | Clamp | Chain)
        or load.particles is None
        or (isinstance(load, Spring) and load.mean)
    )


def vectors_at(name: str, time: Tensor, value: Tensor, t: Tensor) -> Tensor:
    """Vectors [..., S, 3] at times [S] s, interpolated linearly at others [T] s: [..., T, 3].

    Raises:
        ValueError: for shapes or times that a :class:`Waveform` does not take; it begins with the name.
    """
    if time.ndim != 1 or value.shape[-2:] != (len(time), 3):
        raise ValueError(
            f"{name}: times of shape {tuple(time.shape)} and values of {tuple(value.shape)}, wanted [S] and [..., S, 3]"
        )
    try:
        wave = Waveform(time=time, pressure=value.transpose(-1, -2))
    except ValueError as error:
        raise ValueError(f"{name}: {error}".replace("pressure: ", "value: ")) from error
    return wave.at(t.to(time)).transpose(-1, -2)


def _check_group(load: Force | PointMass | Spring | Drag) -> None:
    if load.particles is None and load.share is None:
        raise ValueError("particles, share: neither, wanted particles, or a share of each node")


def group_shares(particles: Tensor, share: Tensor | None, count: int, like: Tensor) -> Tensor:
    """Each particle's share of a group [..., N]."""
    if particles.dtype != torch.int64:
        raise ValueError(f"particles: {particles.dtype}, wanted int64 indices")
    indices, which = torch.unique(particles.to(like.device), return_inverse=True)
    if len(indices) == 0:
        raise ValueError("particles: an empty group, wanted at least one particle")
    if int(indices[0]) < 0 or int(indices[-1]) >= count:
        raise ValueError(f"particles: index {int(indices[0])} to {int(indices[-1])}, wanted 0 to {count - 1}")
    group = like.new_zeros(count)
    if share is None:
        group[indices] = 1 / len(indices)
        return group
    share = share.to(like)
    values = share.detach()
    total = values.sum(-1)
    if share.shape[-1:] != particles.shape or not bool((values >= 0).all() & ((total - 1).abs() < 1e-4).all()):
        raise ValueError(
            f"share: shape {tuple(share.shape)}, sums {total.tolist()}, wanted [..., {len(particles)}], numbers of at "
            "least 0 whose sum is 1"
        )
    place = indices[which]
    return like.new_zeros(*share.shape[:-1], count).index_add(-1, place, share)


def _check_vector(name: str, value: Tensor) -> None:
    if value.shape[-1:] != (3,):
        raise ValueError(f"{name}: shape {tuple(value.shape)}, wanted [..., 3]")
    if not bool(torch.isfinite(value.detach()).all()):
        raise ValueError(f"{name} = {value.tolist()}: wanted finite numbers")


def load_amount(name: str, value: Tensor | float, like: Tensor) -> Tensor:
    """A mass, stiffness or coefficient [...] in the type of ``like``; refuses what is negative or not finite."""
    number = torch.as_tensor(value, dtype=like.dtype, device=like.device)
    if not bool((torch.isfinite(number.detach()) & (number.detach() >= 0)).all()):
        raise ValueError(f"{name} = {value}: wanted finite and at least 0")
    return number
