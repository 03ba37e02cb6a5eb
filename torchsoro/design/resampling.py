"""A finished design on another lattice, and the design variable whose density it is: what another run begins with."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsoro.design.domain import Domain
from torchsoro.design.field import DesignField

# Adam's steps and learning rate, in units of phi: of the archived walker's density at 24 particles along the edge they
# leave a root mean square of 0.001, from 0.075, in less than a second.
_STEPS, _RATE = 100, 0.1
# Least distance of 2 gamma - 1 from void and solid, where atanh is infinite: some ten times float32's resolution.
_EDGE = 1e-6


@torch.no_grad()
def resampled(gamma: Tensor, source: Domain, target: Domain) -> Tensor:
    """Density on another lattice of the same body, between the particles that are designed.

    Interpolated, trilinear, is atanh(2 gamma - 1), which Eq. 12 makes nearly proportional to the filtered design
    variable: it varies smoothly where the density jumps, so that a new lattice makes no greys of its own. Walls and air
    do not enter where designed particles are near; on the new lattice they have densities 1 and 0.

    Args:
        gamma: Density on the lattice of ``source`` [N].
        source: Lattice of the design.
        target: Lattice that is wanted.

    Returns:
        Density on the lattice of ``target``; on the same lattice ``gamma`` itself.

    Raises:
        ValueError: if the bodies differ in size.
    """
    if not all(math.isclose(a, b, rel_tol=1e-6) for a, b in zip(source.size, target.size, strict=True)):
        raise ValueError(f"source: a design of a body of {source.size} m, wanted one of {target.size} m")
    if source.shape == target.shape and torch.equal(source.region, target.region):
        return gamma
    level, design = _level(source.lattice(gamma).double().cpu()), source.lattice(source.design).double()
    stacked = torch.stack([level, level * design, design]).unsqueeze(0)
    # Both lattices are centred in their cells, as pixels are.
    every, designed, share = torch.nn.functional.interpolate(stacked, size=target.shape, mode="trilinear")[0]
    found = 0.5 * (torch.where(share > 0, designed / share.clamp(min=1e-300), every).tanh() + 1)
    found = torch.where(target.design, found.flatten(), target.wall.to(found))
    return found.to(gamma)


def fit_(field: DesignField, gamma: Tensor) -> float:
    """Set a field's design variable so that its density comes near a given one, by least squares.

    Only densities that the filter allows can be met: what is finer than its radius on the new lattice is rounded off.

    Args:
        field: Its ``phi`` is changed.
        gamma: Wanted density [N].

    Returns:
        Root mean square of what is left, over the particles that are designed.
    """
    design = field.domain.design.to(field.phi.device)
    wanted = gamma.detach().to(field.phi)
    with torch.no_grad():
        start = torch.where(design, _level(wanted) / field.beta, torch.zeros_like(wanted)).clamp(-1, 1)
        field.phi.copy_(field.domain.lattice(start))
    adam = torch.optim.Adam([field.phi], lr=_RATE)
    for _ in range(_STEPS):
        adam.zero_grad()
        (field() - wanted).square().sum().backward()
        adam.step()
        field.clamp_()
    adam.zero_grad()
    with torch.no_grad():
        return float((field() - wanted)[design].square().mean().sqrt())


def _level(gamma: Tensor) -> Tensor:
    """The argument of the projection's tanh at a density, whose surface is at zero."""
    return (2 * gamma - 1).clamp(_EDGE - 1, 1 - _EDGE).atanh()
