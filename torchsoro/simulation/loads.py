"""What is attached to groups of particles: forces, point masses, springs, drag; together a tube or a tip load.

A group shares its load equally, or by ``share`` [..., n], whose sum is 1.
"""

from __future__ import annotations

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
        particles: int64 indices [n].
        value: [..., 3] N, constant; or [..., S, 3] with ``time``.
        time: [S] s, increasing; interpolated linearly.
        share: Of each particle [n]; equal if None. No gradient flows to it.
    """

    particles: Tensor
    value: Tensor
    time: Tensor | None = None
    share: Tensor | None = None

    def at(self, t: Tensor) -> Tensor:
        """Force at times t [T]: [..., T, 3] N, in the type and on the device of ``value``."""
        if self.time is None:
            return self.value.unsqueeze(-2).expand(*self.value.shape[:-1], len(t), 3)
        return Waveform(time=self.time, pressure=self.value.transpose(-1, -2)).at(t.to(self.time)).transpose(-1, -2)


@dataclass(frozen=True, kw_only=True, eq=False)
class PointMass:
    """A mass carried by a group, with inertia and weight.

    Attributes:
        particles: int64 indices [n].
        mass: [...] kg.
        share: Of each particle [..., n]; equal if None.
    """

    particles: Tensor
    mass: Tensor | float
    share: Tensor | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Spring:
    """A spring from each particle of a group to its place plus ``shift``; together of the given stiffness.

    Attributes:
        particles: int64 indices [n].
        stiffness: [...] N/m of the whole group.
        shift: [..., 3] m from the reference place to the rest point.
        share: Of each particle [..., n]; equal if None.
    """

    particles: Tensor
    stiffness: Tensor | float
    shift: Tensor | None = None
    share: Tensor | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Drag:
    """Linear drag on a group.

    Attributes:
        particles: int64 indices [n].
        coefficient: [...] N s/m of the whole group.
        share: Of each particle [..., n]; equal if None.
    """

    particles: Tensor
    coefficient: Tensor | float
    share: Tensor | None = None


Load = Force | PointMass | Spring | Drag


@dataclass(frozen=True, kw_only=True, eq=False)
class Attached:
    """Loads as the particles feel them.

    Attributes:
        body: The body, with the point masses added.
        spring: [..., N] N/m, or None without springs and drag.
        anchor: [..., N, 3] m, or None.
        drag: [..., N] N s/m, or None.
        forces: The forces, one group each.
        share: [groups, N].
    """

    body: Body
    spring: Tensor | None
    anchor: Tensor | None
    drag: Tensor | None
    forces: tuple[Force, ...]
    share: Tensor


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
    forces = tuple(load for load in loads if isinstance(load, Force))
    shares = [x.new_zeros(0, count)]
    held = torch.zeros(count, dtype=torch.bool, device=x.device)
    for load in loads:
        group = _shares(load.particles, load.share, count, x)
        if isinstance(load, Force):
            if group.ndim > 1:
                raise ValueError(f"share of a force: shape {tuple(group.shape[:-1])} of a batch, wanted [n]")
            if group.requires_grad:
                raise ValueError(
                    "share of a force: requires a gradient, which is not computed, wanted one without; forces on parts "
                    "of the group have gradients by their values"
                )
            shares.append(group.unsqueeze(0))
            _check_vector("force", load.value)
        elif isinstance(load, PointMass):
            mass = mass + _amount("mass", load.mass, x).unsqueeze(-1) * group
        elif isinstance(load, Drag):
            drag = drag + _amount("drag coefficient", load.coefficient, x).unsqueeze(-1) * group
        else:
            there = (group > 0).reshape(-1, count).any(0)
            if bool((held & there).any()):
                raise ValueError("springs: two groups share a particle, wanted groups apart from each other")
            held |= there
            spring = spring + _amount("stiffness", load.stiffness, x).unsqueeze(-1) * group
            if load.shift is not None:
                _check_vector("spring shift", load.shift)
                place = there.to(x).unsqueeze(-1)
                anchor = anchor + place * load.shift.to(x).unsqueeze(-2)
    loose = body.drag is None and not any(isinstance(load, Spring | Drag) for load in loads)
    return Attached(
        body=replace(body, mass=mass),
        spring=None if loose else spring,
        anchor=None if loose else anchor,
        drag=None if loose else drag,
        forces=forces,
        share=torch.cat(shares),
    )


def _shares(particles: Tensor, share: Tensor | None, count: int, like: Tensor) -> Tensor:
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


def _amount(name: str, value: Tensor | float, like: Tensor) -> Tensor:
    number = torch.as_tensor(value, dtype=like.dtype, device=like.device)
    if not bool((torch.isfinite(number.detach()) & (number.detach() >= 0)).all()):
        raise ValueError(f"{name} = {value}: wanted finite and at least 0")
    return number
