"""A body between planes: cells that end where the body and its chambers do, and quadratic B-splines on them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property

import numpy as np

from torchsoro.simulation.axis import Axis

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
        self.counts = tuple(a.nodes for a in axes)
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

    @property
    def nodes(self) -> int:
        """Number of nodes."""
        return math.prod(self.counts)

    @cached_property
    def places(self) -> np.ndarray:
        """Of the nodes [n, 3] m: values there of a linear field are its coefficients."""
        return np.stack(np.meshgrid(*(a.places for a in self.axes), indexing="ij"), -1).reshape(-1, 3)

    @property
    def strides(self) -> tuple[int, int]:
        """Between nodes along x and y."""
        return self.counts[1] * self.counts[2], self.counts[2]

    def corner(self, cells: np.ndarray) -> np.ndarray:
        """Lowest node of cells [..., 3]."""
        sx, sy = self.strides
        x, y, z = (a.first[cells[..., i]] for i, a in enumerate(self.axes))
        return x * sx + y * sy + z

    def stencil(self, x: np.ndarray, cells: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Nodes [N, 27] of points [N, 3] m, weights, and slopes [N, 27, 3]; in given cells, or where they are."""
        if cells is None:
            cells = np.stack([a.cell(x[:, i]) for i, a in enumerate(self.axes)], -1)
        w, s = zip(*(a.at(x[:, i], cells[:, i]) for i, a in enumerate(self.axes)), strict=True)
        three = np.arange(3)
        sx, sy = self.strides
        offset = (three[:, None, None] * sx + three[None, :, None] * sy + three[None, None, :]).reshape(-1)

        def product(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
            return np.einsum("ni,nj,nk->nijk", a, b, c).reshape(len(x), 27)

        slopes = [product(s[0], w[1], w[2]), product(w[0], s[1], w[2]), product(w[0], w[1], s[2])]
        return self.corner(cells)[:, None] + offset, product(*w), np.stack(slopes, -1)

    def nearest(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The places of the body [N, 3] m nearest to points [N, 3] m, and the cells that they lie in."""
        low = np.stack([a.planes[self.cells[:, i]] for i, a in enumerate(self.axes)], -1)
        high = np.stack([a.planes[self.cells[:, i] + 1] for i, a in enumerate(self.axes)], -1)
        at = [int(((np.clip(p, low, high) - p) ** 2).sum(-1).argmin()) for p in x]
        return np.clip(x, low[at], high[at]), self.cells[at]

    def spread(self, x: np.ndarray, amounts: np.ndarray) -> np.ndarray:
        """Amounts [..., N] at points [N, 3] m, over the nodes [..., n]."""
        nodes, weights, _ = self.stencil(x)
        flat = amounts.reshape(-1, amounts.shape[-1])
        found = np.stack([np.bincount(nodes.ravel(), (weights * row[:, None]).ravel(), self.nodes) for row in flat])
        return found.reshape(*amounts.shape[:-1], self.nodes)

    @cached_property
    def stencil_of_points(self) -> tuple[np.ndarray, np.ndarray]:
        """Nodes and weights of the body's points."""
        nodes, weights, _ = self.stencil(self.points, np.repeat(self.cells, 8, axis=0))
        return nodes, weights

    def collect(self, amounts: np.ndarray) -> np.ndarray:
        """Amounts [..., P] at the body's points, over the nodes [..., n]."""
        nodes, weights = self.stencil_of_points
        flat = amounts.reshape(-1, amounts.shape[-1])
        found = np.stack([np.bincount(nodes.ravel(), (weights * row[:, None]).ravel(), self.nodes) for row in flat])
        return found.reshape(*amounts.shape[:-1], self.nodes)

    def within(self, box: tuple[Sequence[float], Sequence[float]]) -> np.ndarray:
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
        return self.spread(x[inside], np.full(int(inside.sum()), 1 / int(inside.sum())))

    @cached_property
    def walls(self) -> tuple[np.ndarray, ...]:
        """Points of the chambers' walls, four on each face of a cell.

        Returns:
            Nodes [W, 27], weights and two slopes along the wall [W, 27, 3], places [W, 3] m, axes [W], areas [W] m2,
            positive if the chamber is on the lower side, and chambers [W].
        """
        rows = [
            (cell, place, axis, -side * area, self.hole[beside])
            for cell, beside, place, axis, side, area in self._sides()
            if beside is not None and self.hole[beside] >= 0
        ]
        if not rows:
            none = np.zeros(0, int)
            return np.zeros((0, 27), int), np.zeros((0, 27, 3)), np.zeros((0, 3)), none, np.zeros(0), none
        cells, places, axes, areas, chambers = (np.array(column) for column in zip(*rows, strict=True))
        nodes, weights, slopes = self.stencil(places, cells)
        number = np.arange(len(rows))
        values = np.stack([weights, slopes[number, :, (axes + 1) % 3], slopes[number, :, (axes + 2) % 3]], -1)
        return nodes, values, places, axes, areas, chambers

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

    @cached_property
    def front(self) -> np.ndarray:
        """Area across each axis, as shares of nodes [n, 3] m2: the mean of both sides."""
        sides = [s for s in self._sides() if s[1] is None or self.hole[s[1]] == OUTSIDE]
        cells, places = np.array([s[0] for s in sides]), np.array([s[2] for s in sides])
        axes, areas = np.array([s[3] for s in sides]), np.array([s[5] for s in sides])
        nodes, weights, _ = self.stencil(places, cells)
        found = np.zeros((self.nodes, 3))
        np.add.at(found, (nodes, axes[:, None]), weights * areas[:, None] / 2)
        return found

    @property
    def open(self) -> bool:
        """Whether a chamber has no wall somewhere."""
        for axis in range(3):
            one, other = (np.moveaxis(self.hole, axis, 0)[part] for part in (slice(None, -1), slice(1, None)))
            if (((one >= 0) & (other == OUTSIDE)) | ((one == OUTSIDE) & (other >= 0))).any():
                return True
        return False

    @cached_property
    def rim(self) -> np.ndarray:
        """Nodes on the faces of the box [F]."""
        index = np.stack(np.unravel_index(np.arange(self.nodes), self.counts), -1)
        return np.flatnonzero(((index == 0) | (index == np.array(self.counts) - 1)).any(-1))

    @cached_property
    def ends(self) -> np.ndarray:
        """Area of the body on the lower and upper sides of its box, as shares of nodes [3, 2, n] m2."""
        sides = [s for s in self._sides() if s[1] is None]
        places, axes, upper, areas = (np.array([s[i] for s in sides]) for i in (2, 3, 4, 5))
        kinds = 2 * axes + (upper > 0)
        return self.spread(places, areas * (kinds == np.arange(6)[:, None])).reshape(3, 2, self.nodes)

    def facing(self, normal: np.ndarray) -> np.ndarray:
        """Area [n] m2 of the nodes on the face of the box that faces a plane with this normal."""
        axis = int(np.abs(normal).argmax())
        return self.ends[axis, int(normal[axis] < 0)]


def _shares(axes: Sequence[Axis], filled: Callable[..., np.ndarray]) -> np.ndarray:
    """Of each cell's eight parts, z fastest, what the body fills [X, Y, Z, 8]."""
    part = (np.arange(PARTS) + 0.5) / PARTS
    lattice = [(a.planes[:-1, None] + np.diff(a.planes)[:, None] * part).reshape(-1) for a in axes]
    half = PARTS // 2
    shape = [n for a in axes for n in (a.cells, 2, half)]
    parts = filled(*lattice).reshape(shape).mean((2, 5, 8))
    return parts.transpose(0, 2, 4, 1, 3, 5).reshape(*(a.cells for a in axes), 8)
