"""States of undeformed bodies, which simulations start from, in the layouts of both formulations."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsoro.simulation.ops.lattice import Lattice


def updated_state(x: Tensor, v: Tensor, elements: int, affine: Tensor | None = None) -> Tensor:
    """State of undeformed particles without history (a gas keeps J = 1 where a solid keeps F[0, 0] = 1).

    Args:
        x: Positions [B, N, 3] in m.
        v: Velocities [B, N, 3] in m/s.
        elements: Number of Maxwell elements.
        affine: Velocity gradient [B, N, 3, 3] in 1/s; zero if None.

    Returns:
        State [B, S, N], differentiable by x, v and affine.
    """
    batch, count, _ = x.shape
    F = torch.eye(3, dtype=x.dtype, device=x.device).reshape(1, 9, 1).expand(batch, 9, count)
    C = x.new_zeros(batch, 9, count) if affine is None else affine.flatten(-2).transpose(1, 2)
    H = x.new_zeros(batch, 6 * elements, count)
    return torch.cat([x.transpose(1, 2), v.transpose(1, 2), C, F, H], dim=1)


def total_state(
    lattice: Lattice, x: Tensor, v: Tensor, present: Tensor, elements: int, softens: bool = False
) -> Tensor:
    """State of an undeformed body without history.

    Args:
        lattice: Where its particles lie.
        x: Positions of the points [B, points, 3] in m: the lattice's, moved as a whole.
        v: Velocities [B, points, 3] in m/s.
        present: bool [points], where there is a particle.
        elements: Number of Maxwell elements.
        softens: Whether solids soften.

    Returns:
        State [B, L], differentiable by x (as a shift of the whole) and v.
    """
    shift = (x - lattice.places.to(x))[:, present].mean(1)
    d = shift.unsqueeze(-1).expand(-1, -1, lattice.nodes)
    rest = x.new_zeros(x.shape[0], (6 * elements + softens) * lattice.count)
    return torch.cat([d.flatten(1), lattice.project(v, present).flatten(1), rest], 1)
