"""Velocity gradient of particles by local least squares: what the affine part of the updated form starts with."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

_SINGULAR = 1e-8  # share of the largest eigenvalue below which neighbours are taken to lie in a plane or on a line


def velocity_gradient(x: Tensor, v: Tensor, *, origin: Tensor, cell: float) -> Tensor:
    """Gradient C of a velocity field that is known at the particles, by weighted least squares at each of them.

    C_p minimises sum_q W_pq |v_q - v_p - C_p (x_q - x_p)|^2 with W_pq = sum_i N_i(x_p) N_i(x_q) over the quadratic
    B-splines N_i of the grid, so that the neighbours are those with which a particle exchanges momentum. C is exact for
    an affine field and exactly zero for a uniform one. Across directions in which a particle has no neighbours C is
    zero.

    Args:
        x: Positions [B, N, 3] m.
        v: Velocities [B, N, 3] m/s.
        origin: A grid node [B, 3] m.
        cell: Grid cell [m].

    Returns:
        C [B, N, 3, 3] in 1/s, differentiable by x, v and origin.
    """
    batch, count, _ = x.shape
    place = ((x - origin.unsqueeze(1)) / cell).double()
    # From one particle's velocity, so that equal velocities give exactly zero.
    speed = (v - v[:, :1]).double()
    base = torch.floor(place.detach() - 0.5)
    f = place - base
    weights = torch.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2], -2)
    corner = base.long()
    corner = corner - corner.amin((0, 1))
    nx, ny, nz = (int(n) + 3 for n in corner.amax((0, 1)))
    simulation = torch.arange(batch, device=x.device).unsqueeze(1)
    node0 = ((simulation * nx + corner[..., 0]) * ny + corner[..., 1]) * nz + corner[..., 2]

    def stencil():
        """The 27 nodes of every particle: index, weight, and the way from the node to the particle in cells."""
        for i, j, k in itertools.product(range(3), repeat=3):
            weight = weights[..., i, 0] * weights[..., j, 1] * weights[..., k, 2]
            yield (node0 + (i * ny + j) * nz + k).flatten(), weight.unsqueeze(-1), f - f.new_tensor([i, j, k])

    # Moments about the nodes, then about the particles. The columns: arms (1, d), and the velocity.
    nodes = f.new_zeros(batch * nx * ny * nz, 4 * 7)
    for index, weight, arm in stencil():
        columns = torch.cat([torch.ones_like(weight), arm, speed], -1)
        moment = weight.unsqueeze(-1) * columns[..., :4, None] * columns[..., None, :]
        nodes = nodes.index_add(0, index, moment.flatten(-2).flatten(0, 1))
    square, product = f.new_zeros(batch, count, 3, 3), f.new_zeros(batch, count, 3, 3)
    for index, weight, arm in stencil():
        moment = nodes[index].view(batch, count, 4, 7)
        total, first, speeds = moment[..., :1, :1], moment[..., 0, 1:4] - moment[..., 0, :1] * arm, moment[..., 4:]
        weight = weight.unsqueeze(-1)
        lever = arm.unsqueeze(-1)
        second = moment[..., 1:, 1:4] - lever * moment[..., :1, 1:4] - moment[..., 1:, :1] * lever.mT
        square = square + weight * (second + total * lever * lever.mT)
        along = speeds[..., 1:, :] - lever * speeds[..., :1, :]
        product = product + weight * (along - first.unsqueeze(-1) * speed.unsqueeze(-2))
    inverse = torch.linalg.pinv(square, rtol=_SINGULAR, hermitian=True)
    return ((inverse @ product).mT / cell).to(v.dtype)
