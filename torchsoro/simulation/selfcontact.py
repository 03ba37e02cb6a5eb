"""Where a body has moved into itself: the total-Lagrangian form has no contact between its own parts."""

from __future__ import annotations

import math

import torch
from scipy.spatial import KDTree
from torch import Tensor

# Two parts that just touch have their outermost particles one spacing apart; two lattices that lie in one another
# leave at most 0.87 spacings between a particle and the nearest one of the other part.
NEAR = 0.8


@torch.no_grad()
def overlapping(position: Tensor, reference: Tensor, solid: Tensor, *, spacing: float, apart: float = 3.0) -> Tensor:
    """Mark solid particles that lie in another part of the body.

    A particle is marked if a solid particle is nearer than 0.8 spacings now that was more than ``apart`` spacings
    away at first. So compression alone marks nothing before it brings the material to 0.8 / ``apart`` of its length.

    Candidates come from a k-d tree on the CPU: the time grows with the number of particles, and with the square of how
    many lie within 0.8 spacings of each other. No gradient passes.

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
    chosen = solid.cpu().nonzero().flatten()
    x, first = position.reshape(math.prod(batch), count, 3).cpu()[:, chosen], reference.cpu()[chosen]
    if not bool(torch.isfinite(x).all()):
        raise ValueError("position: got a solid particle at a place that is not finite, want finite coordinates in m")
    near, far = (NEAR * spacing) ** 2, (apart * spacing) ** 2
    found = torch.zeros(len(x), count, dtype=torch.bool)
    for here, marked in zip(x, found, strict=True):
        # A little farther, as the tree and the comparison below round differently.
        pairs = KDTree(here.double().numpy()).query_pairs(1.001 * NEAR * spacing, output_type="ndarray")
        i, j = torch.from_numpy(pairs).unbind(-1)
        meets = ((here[i] - here[j]).square().sum(-1) < near) & ((first[i] - first[j]).square().sum(-1) > far)
        marked[chosen[torch.cat([i[meets], j[meets]])]] = True
    return found.reshape(*batch, count).to(position.device)


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
