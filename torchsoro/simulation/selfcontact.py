"""Where a body has moved into itself: the total-Lagrangian form has no contact between its own parts."""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor

# Two parts that just touch have their outermost particles one spacing apart; two lattices that lie in one another
# leave at most 0.87 spacings between a particle and the nearest one of the other part.
NEAR = 0.8

_WRAP = 1 << 16  # hash cells along an axis; the cells beyond share the keys of these
_HALF = [offset for offset in itertools.product((-1, 0, 1), repeat=3) if offset >= (0, 0, 0)]
_PAIRS = 1 << 22  # candidate pairs that are looked at together: bounds the memory


@torch.no_grad()
def overlapping(position: Tensor, reference: Tensor, solid: Tensor, *, spacing: float, apart: float = 3.0) -> Tensor:
    """Mark solid particles that lie in another part of the body.

    A particle is marked if a solid particle is nearer than 0.8 spacings now that was more than ``apart`` spacings
    away at first. So compression alone marks nothing before it brings the material to 0.8 / ``apart`` of its length.

    Candidates come from a hash of cells of 0.8 spacings: the time grows with the number of particles, and with the
    square of how many share a cell. No gradient passes.

    Args:
        position: Current places [..., N, 3] m.
        reference: Places at first [N, 3] m.
        solid: Which particles count, bool [N]; leave out void and air, which may be crushed.
        spacing: Distance of neighbouring particles at first, m.
        apart: Distance at first, in spacings, above which two particles belong to different parts.

    Returns:
        Bool [..., N] on the device of ``position``.

    Raises:
        ValueError: A shape or type is wrong, a solid particle's place is not finite, or a number is out of range.
    """
    _check(position, reference, solid, spacing, apart)
    batch, count = position.shape[:-2], position.shape[-2]
    found = torch.zeros(math.prod(batch) * count, dtype=torch.bool, device=position.device)
    chosen = solid.to(position.device).nonzero().flatten()
    x = position.reshape(math.prod(batch), count, 3)[:, chosen]
    if not bool(torch.isfinite(x).all()):
        raise ValueError("position: got a solid particle at a place that is not finite, want finite coordinates in m")
    if x.numel() == 0:
        return found.reshape(*batch, count)
    where = torch.arange(len(x), device=x.device)[:, None] * count + chosen
    first = reference.to(x.device)[chosen].expand(x.shape).reshape(-1, 3)
    near, far = (NEAR * spacing) ** 2, (apart * spacing) ** 2

    # Cells are a little larger than the distance, so that rounding puts no near pair two cells apart.
    cell = torch.remainder(torch.floor(x.double() / (1.001 * NEAR * spacing)), _WRAP).long()
    simulation = torch.arange(len(x), device=x.device)[:, None].expand(x.shape[:-1]).reshape(-1)
    key, order = torch.sort(_key(simulation, cell.reshape(-1, 3)))
    x, first, where = x.reshape(-1, 3)[order], first[order], where.reshape(-1)[order]
    cells, size = torch.unique_consecutive(key, return_counts=True)
    start = torch.cumsum(size, 0) - size
    simulation, cell = simulation[order][start], cell.reshape(-1, 3)[order][start]

    for offset in _HALF:
        wanted = _key(simulation, (cell + torch.tensor(offset, device=x.device)) % _WRAP)
        other = torch.searchsorted(cells, wanted).clamp(max=len(cells) - 1)
        here = (cells[other] == wanted).nonzero().flatten()
        other = other[here]
        ends = torch.cumsum(size[here] * size[other], 0)
        total = int(ends[-1]) if len(ends) else 0
        for low in range(0, total, _PAIRS):
            pair = torch.arange(low, min(low + _PAIRS, total), device=x.device)
            which = torch.searchsorted(ends, pair, right=True)
            one, two = here[which], other[which]
            pair = pair - (ends[which] - size[one] * size[two])
            i, j = start[one] + pair // size[two], start[two] + pair % size[two]
            meets = ((x[i] - x[j]).square().sum(-1) < near) & ((first[i] - first[j]).square().sum(-1) > far)
            found[where[i[meets]]] = True
            found[where[j[meets]]] = True
    return found.reshape(*batch, count)


def _key(simulation: Tensor, cell: Tensor) -> Tensor:
    """One integer for a simulation and a hash cell in it [..., 3]."""
    return ((simulation * _WRAP + cell[..., 0]) * _WRAP + cell[..., 1]) * _WRAP + cell[..., 2]


def _check(position: Tensor, reference: Tensor, solid: Tensor, spacing: float, apart: float) -> None:
    if position.ndim < 2 or position.shape[-1] != 3 or not position.is_floating_point():
        raise ValueError(f"position: got {_describe(position)}, want a floating-point tensor [..., N, 3]")
    count = position.shape[-2]
    if reference.shape != (count, 3) or not reference.is_floating_point():
        raise ValueError(f"reference: got {_describe(reference)}, want a floating-point tensor [{count}, 3]")
    if solid.shape != (count,) or solid.dtype != torch.bool:
        raise ValueError(f"solid: got {_describe(solid)}, want a bool tensor [{count}]")
    if not (math.isfinite(spacing) and spacing > 0):
        raise ValueError(f"spacing: got {spacing!r} m, want a finite length > 0")
    if not (math.isfinite(apart) and apart >= 1):
        raise ValueError(f"apart: got {apart!r} spacings, want a finite number >= 1")


def _describe(value: Tensor) -> str:
    return f"{value.dtype} {tuple(value.shape)}"
