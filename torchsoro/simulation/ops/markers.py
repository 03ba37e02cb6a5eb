"""Markers anywhere on a body of the total-Lagrangian form, in terms of the nodes around them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from torchsoro.simulation.kernels import layout
from torchsoro.simulation.ops.lattice import Lattice


@dataclass(frozen=True, kw_only=True, eq=False)
class Markers:
    """Points that move with the nearest place of a body.

    Attributes:
        places: [M, 3] m in the undeformed body, float64.
        nodes: int64 [M, 27].
        weights: [M, 27], float64.
        slopes: [M, 3, 27] 1/m, float64.
    """

    places: Tensor
    nodes: Tensor
    weights: Tensor
    slopes: Tensor

    @cached_property
    def near(self) -> Tensor:
        """The nodes of all markers, int64 [U]."""
        return torch.unique(self.nodes)

    @cached_property
    def matrix(self) -> Tensor:
        """From values at these nodes to those at the markers, and to their three derivatives [U, 4 M]."""
        parts = torch.cat([self.weights.unsqueeze(0), self.slopes.transpose(0, 1)])
        at = torch.searchsorted(self.near, self.nodes).expand_as(parts)
        whole = parts.new_zeros(4, len(self.nodes), len(self.near)).scatter_add(2, at, parts)
        return whole.flatten(0, 1).T.contiguous()

    def observe(self, motion: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Displacements and velocities [..., M, 3], and derivatives of the former [..., M, 3, 3].

        Args:
            motion: Displacements and velocities of the nodes that are near [..., 6, U].
        """
        found = (motion @ self.matrix.to(motion)).unflatten(-1, (4, len(self.nodes)))
        d, v = found[..., :3, :, :], found[..., 3:, 0, :]
        return d[..., 0, :].transpose(-1, -2), v.transpose(-1, -2), d[..., 1:, :].movedim(-1, -3)

    @classmethod
    def at(cls, lattice: Lattice, kind: Tensor, places: Tensor) -> Markers:
        """Markers at places [M, 3] m; those outside of the body move with the nearest place of it, and its gradient.

        Args:
            lattice: Of the body.
            kind: Of each point [points], as in ``Scene``.
            places: [M, 3] m.
        """
        x = places.detach().cpu().double().numpy()
        cells = body_cells(lattice, kind)
        on, own = nearest(lattice, cells, x)
        nodes, weights, slopes = lattice.splines(on, own)
        weights = weights + np.einsum("mak,ma->mk", slopes, x - on)
        at, weights, slopes = (torch.from_numpy(a).to(kind.device) for a in (nodes, weights, slopes))
        return cls(places=torch.from_numpy(x).to(kind.device), nodes=at, weights=weights, slopes=slopes)


def body_cells(lattice: Lattice, kind: Tensor) -> np.ndarray:
    """Cells with a particle in them [C, 3]."""
    x, y, z = (a.cells for a in lattice.axes)
    there = (kind.cpu().numpy() != layout.ABSENT).reshape(x, 2, y, 2, z, 2)
    return np.argwhere(there.any((1, 3, 5)))


def nearest(lattice: Lattice, cells: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The places of some cells [C, 3] nearest to points [M, 3] m, and the cells that they lie in."""
    low = np.stack([a.planes[cells[:, i]] for i, a in enumerate(lattice.axes)], -1)
    high = np.stack([a.planes[cells[:, i] + 1] for i, a in enumerate(lattice.axes)], -1)
    at = [int(((np.clip(p, low, high) - p) ** 2).sum(-1).argmin()) for p in x]
    return np.clip(x, low[at], high[at]), cells[at]
