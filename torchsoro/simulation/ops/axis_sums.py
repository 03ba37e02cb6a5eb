"""Sums over the points or nodes of a lattice, along one axis after the other."""

from __future__ import annotations

import functools
import operator
from collections.abc import Sequence
from functools import lru_cache
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from torchsoro.simulation.axis import GAUSS, MARK, Axis

# Places of a cell's two points per axis: the two of Gauss, for which the pressure of a uniformly deformed chamber does
# no work inside it; and those of the particles, where motion is recorded.
QUADRATURE, PARTICLES = GAUSS, MARK

To = Literal["points", "nodes"]


def summed(values: Tensor, axes: Sequence[Axis], kinds: Sequence[str], to: To) -> Tensor:
    """Sums with a kind of weight for each axis, term by term, so that their order is that of the lattice alone.

    Args:
        values: By node [..., nodes], or by point [..., points] where the sums are to be by node.
        axes: Of the lattice.
        kinds: For each axis "weight", "slope" (1/m), "moment" (m), "mark" (weight at the particles) or "back", which
            finds nodal values from those at the particles.
        to: What the sums are by.

    Returns:
        [rows, x, y, z], with all leading axes in one.
    """
    found = values.reshape(-1, *((2 * a.cells if to == "nodes" else a.nodes) for a in axes))
    for n, (axis, kind) in enumerate(zip(axes, kinds, strict=True)):
        terms = _terms(kind, axis, to, values.dtype, values.device)
        wide = (-1, *(1,) * (2 - n))
        parts = (found.index_select(n + 1, at) * weight.view(wide) for at, weight in terms)
        found = functools.reduce(operator.add, parts)
    return found


def _matrix(kind: str, axis: Axis) -> np.ndarray:
    """What each point [points, nodes] of an axis takes of each node."""
    weight, slope = axis.tabulate(PARTICLES if kind in ("mark", "back") else QUADRATURE)
    values = slope if kind == "slope" else weight
    if kind == "moment":
        values = weight * (axis.points[..., None] - axis.places[axis.first[:, None, None] + np.arange(3)])
    wide = np.zeros((axis.cells, 2, axis.nodes))
    np.put_along_axis(wide, axis.first[:, None, None] + np.arange(3) + np.zeros((1, 2, 1), int), values, 2)
    found = wide.reshape(-1, axis.nodes)
    return torch.linalg.pinv(torch.from_numpy(found)).T.numpy() if kind == "back" else found


@lru_cache(maxsize=2048)
def _terms(kind: str, axis: Axis, to: To, dtype: torch.dtype, device: torch.device) -> list[tuple[Tensor, Tensor]]:
    """Products with a matrix as terms: where each comes from, and its weight, which is zero where there is none."""
    matrix = _matrix(kind, axis)
    rows = matrix if to == "points" else matrix.T
    most = int((rows != 0).sum(1).max())
    at = np.sort(np.argsort(rows == 0, axis=1, kind="stable")[:, :most], axis=1)
    weights = np.take_along_axis(rows, at, 1)
    columns = zip(at.T.copy(), weights.T.copy(), strict=True)
    return [(torch.from_numpy(a).to(device), torch.from_numpy(w).to(device, dtype)) for a, w in columns]
