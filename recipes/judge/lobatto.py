"""Boxes with voids and cuts as 27-node hexahedra whose nodes are quadrature points (Gauss-Lobatto, three to an edge).

The mass matrix of such elements is diagonal without lumping, and quadratic displacements neither lock in shear, in
volume (at a Poisson ratio of 0.4), nor have zero-energy modes. Local node l = i + 3 j + 9 k.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Box = tuple[Sequence[float], Sequence[float]]

SIMPSON = np.array([1.0, 4.0, 1.0]) / 6
_NEAR = 1e-7
_SOLID, _CUT = -1, -2  # kinds of elements; others are numbers of chambers


@dataclass(frozen=True, kw_only=True, eq=False)
class Faces:
    """Sides of elements that face the outside, or a chamber.

    Attributes:
        nodes: Nodes of each side [B, 9], the first tangent running fastest.
        sign: [B], +1 where the cross product of the tangents points out of the solid, else -1.
        area: Reference area of each node's share [B, 9] m2.
    """

    nodes: Ints
    sign: Floats
    area: Floats

    def share(self, count: int) -> Floats:
        """Reference area of every node [N] m2, zero inside the body."""
        return np.bincount(self.nodes.ravel(), self.area.ravel(), count).astype(np.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class Mesh:
    """A box of hexahedra, less its chambers and what is cut off.

    Attributes:
        nodes: Reference positions [N, 3] m.
        cells: Nodes of each element [M, 27].
        size: Edges of each element [M, 3] m.
        weight: Volume of each quadrature point [M, 27] m3.
        outside: The outer surface.
        chambers: The walls of each chamber.
        lines: Planes of nodes along each axis, m.
        number: Node at each crossing of the planes [., ., .], -1 inside a chamber or a cut.
    """

    nodes: Floats
    cells: Ints
    size: Floats
    weight: Floats
    outside: Faces
    chambers: tuple[Faces, ...]
    lines: tuple[Floats, Floats, Floats]
    number: Ints

    def spread(self, points: Floats) -> tuple[Ints, Floats]:
        """Share a unit between nodes: every weight positive, the centre of gravity that of points [P, 3].

        Points outside the solid are left out; ValueError if none is inside.
        """
        total = np.zeros(len(self.nodes))
        inside = np.ones(len(points), bool)
        at, part = [], []
        for axis, line in enumerate(self.lines):
            x = points[:, axis]
            inside &= (x > line[0] - _NEAR) & (x < line[-1] + _NEAR)
            i = np.clip(np.searchsorted(line, x) - 1, 0, len(line) - 2)
            at.append(i)
            part.append(np.clip((x - line[i]) / (line[i + 1] - line[i]), 0, 1))
        corners = list(itertools.product((0, 1), repeat=3))
        numbers = np.stack([self.number[at[0] + a, at[1] + b, at[2] + c] for a, b, c in corners])
        inside &= (numbers >= 0).all(0)
        if not inside.any():
            raise ValueError(f"points = {points[:2].tolist()}...: wanted at least one inside the solid")
        for (a, b, c), number in zip(corners, numbers, strict=True):
            w = np.prod([p if bit else 1 - p for p, bit in zip(part, (a, b, c), strict=True)], axis=0)
            np.add.at(total, number[inside], w[inside])
        total /= total.sum()
        nodes = np.flatnonzero(total)
        return nodes, total[nodes]

    def interpolation(self, points: Floats) -> tuple[Ints, Floats]:
        """Nodes [P, 27] and quadratic shape functions [P, 27] at points [P, 3]; slightly outside is extrapolated."""
        centre = self.nodes[self.cells[:, 13]]
        nodes, values = [], []
        for point in points:
            reach = np.abs(point - centre) - self.size / 2
            cell = int(np.argmin(np.maximum(reach, 0).sum(1)))
            s = 2 * (point - centre[cell]) / self.size[cell]
            shape = np.stack([s * (s - 1) / 2, 1 - s * s, s * (s + 1) / 2])
            values.append(np.einsum("k,j,i->kji", shape[:, 2], shape[:, 1], shape[:, 0]).ravel())
            nodes.append(self.cells[cell])
        return np.array(nodes), np.array(values)


def planes(low: float, high: float, features: Sequence[float], target: float) -> Floats:
    """Element boundaries from low to high [m] through all features between, at most about ``target`` apart."""
    stops = np.unique(np.round([low, high, *(f for f in features if low < f < high)], 9))
    parts = [np.linspace(a, b, max(1, round((b - a) / target)) + 1)[:-1] for a, b in itertools.pairwise(stops)]
    return np.append(np.concatenate(parts), stops[-1])


def box_mesh(
    origin: Sequence[float], size: Sequence[float], chambers: Sequence[Box], target: float, missing: Sequence[Box] = ()
) -> Mesh:
    """Mesh of a box, or of what is left of one.

    Args:
        origin: Lower corner [3] m.
        size: Edges [3] m.
        chambers: Boxes that are void, each inside the body; their walls become planes of the mesh.
        target: Edge that elements shall have about [m]; nodes are half as far apart.
        missing: Boxes that are cut off, as between legs; what they uncover is outside.
    """
    features = [*chambers, *missing]
    edges = [
        planes(origin[d], origin[d] + size[d], [c[s][d] for c in features for s in (0, 1)], target) for d in range(3)
    ]
    lines = [np.sort(np.concatenate([e, (e[1:] + e[:-1]) / 2])) for e in edges]
    shape = tuple(len(e) - 1 for e in edges)
    middle = np.stack(np.meshgrid(*[(e[1:] + e[:-1]) / 2 for e in edges], indexing="ij"), -1)
    kind = np.full(shape, _SOLID)
    for number, (low, high) in [*((_CUT, box) for box in missing), *enumerate(chambers)]:
        kind[((middle > np.asarray(low)) & (middle < np.asarray(high))).all(-1)] = number
    step = np.stack(np.meshgrid(*[np.diff(e) for e in edges], indexing="ij"), -1)

    solid = np.argwhere(kind == _SOLID)
    local = np.array([(i, j, k) for k in range(3) for j in range(3) for i in range(3)])
    counts = tuple(len(line) for line in lines)
    flat = np.ravel_multi_index(tuple((2 * solid[:, None, :] + local).transpose(2, 0, 1)), counts)
    used, cells = np.unique(flat, return_inverse=True)
    cells = cells.reshape(flat.shape)
    number = np.full(int(np.prod(counts)), -1)
    number[used] = np.arange(len(used))
    nodes = np.stack(np.meshgrid(*lines, indexing="ij"), -1).reshape(-1, 3)[used]
    edge = step[tuple(solid.T)]
    simpson = np.einsum("k,j,i->kji", SIMPSON, SIMPSON, SIMPSON).ravel()

    sides: dict[int, list[tuple[Ints, float, Floats]]] = {n: [] for n in range(-1, len(chambers))}
    for cell, place in enumerate(solid):
        for axis, way in itertools.product(range(3), (0, 1)):
            beside = place.copy()
            beside[axis] += 2 * way - 1
            out = bool(beside[axis] < 0 or beside[axis] >= shape[axis]) or kind[tuple(beside)] == _CUT
            if not out and kind[tuple(beside)] == _SOLID:
                continue
            first, second = (axis + 1) % 3, (axis + 2) % 3
            chosen = np.flatnonzero(local[:, axis] == 2 * way)
            chosen = chosen[np.lexsort((local[chosen, first], local[chosen, second]))]
            area = np.outer(SIMPSON, SIMPSON).ravel() * edge[cell, first] * edge[cell, second]
            target_list = sides[-1 if out else int(kind[tuple(beside)])]
            target_list.append((cells[cell, chosen], 2.0 * way - 1, area))
    faces = [
        Faces(
            nodes=np.array([s[0] for s in found], np.int64).reshape(-1, 9),
            sign=np.array([s[1] for s in found], np.float64),
            area=np.array([s[2] for s in found], np.float64).reshape(-1, 9),
        )
        for found in sides.values()
    ]
    return Mesh(
        nodes=nodes,
        cells=cells.astype(np.int64),
        size=edge,
        weight=edge.prod(1)[:, None] * simpson,
        outside=faces[0],
        chambers=tuple(faces[1:]),
        lines=(lines[0], lines[1], lines[2]),
        number=number.reshape(counts),
    )
