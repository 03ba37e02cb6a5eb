"""A body between planes: cells that end where the body and its chambers do, and quadratic B-splines on them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from torchsoro.simulation.axis import Axis
from torchsoro.simulation.ops.lattice import Faces, Lattice, Walls
from torchsoro.simulation.ops.markers import nearest

BODY, OUTSIDE = -1, -2  # kinds of cells that belong to no chamber
PARTS = 4  # subdivisions of a cell along each axis, by which its filled share is sampled
LEAST = 0.05  # filled share of a cell, below which the cell is left out
OUTER = 1.3  # width of outermost cells over that of their neighbours: the end splines are steeper


def divide(breaks: Sequence[float], least: Sequence[int], edge: float) -> np.ndarray:
    """Planes of cells along an axis.

    Args:
        breaks: Where cells must end [m], increasing.
        least: Cells in each interval between them, at least.
        edge: Of a cell, about [m].

    Returns:
        Planes [cells + 1] m.
    """
    planes = [breaks[0]]
    last = len(breaks) - 2
    for i, (low, high) in enumerate(itertools.pairwise(breaks)):
        count = max(least[i], round((high - low) / edge), 1)
        width = np.ones(count)
        width[0] *= OUTER if i == 0 else 1.0
        width[-1] *= OUTER if i == last else 1.0
        planes += list(low + (high - low) * np.cumsum(width) / width.sum())
    return np.array(planes)


class Grid:
    """Three axes, and which of their cells are body.

    Args:
        axes: Along x, y and z.
        holes: Boxes [low, high] m that are no body, whose faces lie on planes.
        filled: Which points of a lattice, given by its coordinates, the body fills, bool [X, Y, Z]; all if None.
    """

    def __init__(
        self,
        axes: tuple[Axis, Axis, Axis],
        holes: Sequence[tuple[Sequence[float], Sequence[float]]],
        filled: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray] | None = None,
    ) -> None:
        self.axes = axes
        middles = np.meshgrid(*((a.planes[1:] + a.planes[:-1]) / 2 for a in axes), indexing="ij")
        self.hole = np.full(middles[0].shape, BODY)
        share = np.ones((*self.hole.shape, 8))
        if filled is not None:
            share = _shares(axes, filled)
            self.hole[share.mean(-1) < LEAST] = OUTSIDE
        for number, (low, high) in enumerate(holes):
            inside = [(m > a) & (m < b) for m, a, b in zip(middles, low, high, strict=True)]
            self.hole[inside[0] & inside[1] & inside[2]] = number
        self.cells = np.argwhere(self.hole == BODY)
        parts = [a.points[self.cells[:, i]] for i, a in enumerate(axes)]
        x, y, z = (
            p[:, shape] for p, shape in zip(parts, ([0] * 4 + [1] * 4, [0, 0, 1, 1] * 2, [0, 1] * 4), strict=True)
        )
        self.points = np.stack([x, y, z], -1).reshape(-1, 3)
        """Of the body [P, 3] m, cell by cell."""
        size = np.prod([np.diff(a.planes)[self.cells[:, i]] for i, a in enumerate(axes)], axis=0)
        mine = share[tuple(self.cells.T)]
        self.volumes = (size[:, None] / 8 * mine).reshape(-1)
        """Of the points [P] m3."""
        self.cut = bool((mine < 1).any())
        """Whether a cell is filled in part only."""

    @cached_property
    def lattice(self) -> Lattice:
        """For the simulator; particles are the points with any volume, in their order."""
        one, two, three = (2 * self.cells[:, [i]] for i in range(3))
        x, y, z = (c + np.array(n) for c, n in ((one, [0] * 4 + [1] * 4), (two, [0, 0, 1, 1] * 2), (three, [0, 1] * 4)))
        _, ny, nz = (2 * a.cells for a in self.axes)
        index = torch.from_numpy(((x * ny + y) * nz + z).reshape(-1)[self.solid])
        plain = Lattice(axes=self.axes, index=index)
        return Lattice(axes=self.axes, index=index, walls=self._walls(plain), faces=self._faces(plain))

    @property
    def solid(self) -> np.ndarray:
        """Which points have a volume, bool [P]."""
        return self.volumes > 0

    def nearest(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The places of the body [N, 3] m nearest to points [N, 3] m, and the cells that they lie in."""
        return nearest(self.lattice, self.cells, x)

    def collect(self, amounts: Tensor) -> Tensor:
        """Amounts [..., P] at the body's points, over the nodes [..., n]."""
        flat = amounts[..., self.solid].reshape(-1, int(self.solid.sum()))
        return self.lattice.to_nodes(self.lattice.spread(flat)).reshape(*amounts.shape[:-1], -1)

    def within(self, box: tuple[Sequence[float], Sequence[float]]) -> Tensor:
        """Shares [n] of what is spread evenly over a box.

        Raises:
            ValueError: if the body has no part there.
        """
        low, high = (np.array(corner, float) for corner in box)
        begin = np.array([a.planes[0] for a in self.axes])
        end = np.array([a.planes[-1] for a in self.axes])
        low, high = np.maximum(low, begin), np.minimum(high, end)
        if not (low < high).all():
            raise ValueError(f"box = {box}: no part of the body, wanted a box that meets it")
        share = (np.arange(6) + 0.5) / 6
        x = np.stack(np.meshgrid(*(a + share * (b - a) for a, b in zip(low, high, strict=True)), indexing="ij"), -1)
        x = x.reshape(-1, 3)
        inside = self.hole[tuple(a.cell(x[:, i]) for i, a in enumerate(self.axes))] == BODY
        if not inside.any():
            raise ValueError(f"box = {box}: no part of the body, wanted a box that meets it")
        nodes, weights, _ = self.lattice.splines(x[inside])
        found = np.bincount(nodes.ravel(), weights.ravel() / int(inside.sum()), self.lattice.nodes)
        return torch.from_numpy(found)

    def _walls(self, lattice: Lattice) -> Walls | None:
        """Four points on each face of a cell beside a chamber."""
        rows = [
            (cell, place, axis, -side * area, self.hole[beside])
            for cell, beside, place, axis, side, area in self._sides()
            if beside is not None and self.hole[beside] >= 0
        ]
        if not rows:
            return None
        cells, places, axes, areas, chambers = (np.array(column) for column in zip(*rows, strict=True))
        nodes, weights, slopes = lattice.splines(places, cells)
        number = np.arange(len(rows))
        values = np.stack([weights, slopes[number, (axes + 1) % 3], slopes[number, (axes + 2) % 3]], -1)
        nodes, values, places, axes, areas, chambers = map(
            torch.from_numpy, (nodes, values, places, axes, areas, chambers)
        )
        return Walls(nodes=nodes, values=values, places=places, axes=axes, areas=areas, chambers=chambers)

    def _sides(self) -> Iterator[tuple[np.ndarray, tuple[int, ...] | None, np.ndarray, int, int, float]]:
        """Four points on each face of a cell behind which there is no body.

        Yields:
            The cell, what is beside it (None outside of the box), the place [3] m, axis and side, and the area [m2].
        """
        for cell in self.cells:
            for axis, side in itertools.product(range(3), (-1, 1)):
                beside = cell.copy()
                beside[axis] += side
                within = 0 <= beside[axis] < self.axes[axis].cells
                if within and self.hole[tuple(beside)] == BODY:
                    continue
                one, two = (axis + 1) % 3, (axis + 2) % 3
                area = float(np.diff(self.axes[one].planes)[cell[one]] * np.diff(self.axes[two].planes)[cell[two]])
                for a, b in itertools.product(range(2), range(2)):
                    place = np.zeros(3)
                    place[axis] = self.axes[axis].planes[cell[axis] + (side > 0)]
                    place[one], place[two] = self.axes[one].points[cell[one], a], self.axes[two].points[cell[two], b]
                    yield cell, tuple(beside) if within else None, place, axis, side, area / 4

    def _faces(self, lattice: Lattice) -> Faces:
        """Nodes on the faces of the box may meet planes; cut surfaces inside of it do not."""
        index = np.stack(np.unravel_index(np.arange(lattice.nodes), lattice.shape), -1)
        touches = ((index == 0) | (index == np.array(lattice.shape) - 1)).any(-1)
        sides = [s for s in self._sides() if s[1] is None or self.hole[s[1]] == OUTSIDE]
        cells, places = np.array([s[0] for s in sides]), np.array([s[2] for s in sides])
        axes, upper, areas = (np.array([s[i] for s in sides]) for i in (3, 4, 5))
        nodes, weights, _ = lattice.splines(places, cells)
        front, ends = np.zeros((lattice.nodes, 3)), np.zeros((3, 2, lattice.nodes))
        np.add.at(front, (nodes, axes[:, None]), weights * areas[:, None] / 2)
        on = np.array([s[1] is None for s in sides])
        which = axes[on, None], (upper[on, None] > 0).astype(int), nodes[on]
        np.add.at(ends, which, weights[on] * areas[on, None])
        return Faces(touches=torch.from_numpy(touches), ends=torch.from_numpy(ends), front=torch.from_numpy(front))

    @property
    def open(self) -> bool:
        """Whether a chamber has no wall somewhere."""
        for axis in range(3):
            one, other = (np.moveaxis(self.hole, axis, 0)[part] for part in (slice(None, -1), slice(1, None)))
            if (((one >= 0) & (other == OUTSIDE)) | ((one == OUTSIDE) & (other >= 0))).any():
                return True
        return False


def _shares(axes: Sequence[Axis], filled: Callable[..., np.ndarray]) -> np.ndarray:
    """Of each cell's eight parts, z fastest, what the body fills [X, Y, Z, 8]."""
    part = (np.arange(PARTS) + 0.5) / PARTS
    lattice = [(a.planes[:-1, None] + np.diff(a.planes)[:, None] * part).reshape(-1) for a in axes]
    half = PARTS // 2
    shape = [n for a in axes for n in (a.cells, 2, half)]
    parts = filled(*lattice).reshape(shape).mean((2, 5, 8))
    return parts.transpose(0, 2, 4, 1, 3, 5).reshape(*(a.cells for a in axes), 8)
