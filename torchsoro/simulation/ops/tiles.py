"""How the cells of a total-Lagrangian lattice are dealt out in tiles, and the index tables of its kernels."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from torch import Tensor

from torchsoro.simulation.axis import Axis
from torchsoro.simulation.kernels import layout
from torchsoro.simulation.kernels.tile import KEPT
from torchsoro.simulation.ops.lattice import Lattice

LIMIT = 48 * 1024  # bytes that a block of threads may share on any GPU


@dataclass(frozen=True, kw_only=True, eq=False)
class Tiles:
    """How the cells of a lattice are dealt out.

    Attributes:
        shape: Number of a tile's shape, among ``layout.SHAPES``.
        along: The tiles along x, y and z, see :func:`tiles_along`.
    """

    shape: int
    along: tuple[np.ndarray, ...]

    @property
    def counts(self) -> tuple[int, ...]:
        """Tiles along x, y, z."""
        return tuple(map(len, self.along))

    @property
    def count(self) -> int:
        """Number of tiles."""
        return math.prod(self.counts)

    @property
    def of(self) -> layout.Shape:
        """A tile's shape."""
        return layout.SHAPES[self.shape]


def tiles_along(axis: Axis, cells: int, nodes: int) -> np.ndarray:
    """Along an axis, tiles of at most so many cells and nodes: first cell, number of cells, first node [T, 3].

    A cell beyond a crease has its lowest node two further on than the cell before it. A tile with just two nodes beyond
    its cells ends there, as its kernels count on it. No node belongs to more than two tiles.
    """
    rows, cell = [], 0
    while cell < axis.cells:
        first = axis.first[cell : cell + cells] - axis.first[cell]
        room = np.arange(len(first)) if nodes == cells + 2 else nodes - 3
        rows.append((cell, (first <= room).sum(), axis.first[cell]))
        cell += rows[-1][1]
    return np.array(rows)


def tiles_of(lattice: Lattice, like: Tensor) -> Tiles:
    """The tiles of a lattice, as few as can be; a block of a GPU has room for numbers like these."""
    return _tiles_of(tuple(lattice.axes), like.element_size() if like.is_cuda else 0)


@lru_cache(maxsize=256)
def _tiles_of(axes: tuple[Axis, ...], itemsize: int) -> Tiles:
    found = [
        Tiles(shape=k, along=tuple(map(tiles_along, axes, s.cells, s.nodes)))
        for k, s in enumerate(layout.SHAPES)
        if 4 * KEPT + itemsize * s.pad <= LIMIT
    ]
    return min(found, key=lambda tiles: tiles.count)


def tables(lattice: Lattice, tiles: Tiles, air: Tensor, chambers: int) -> list[np.ndarray]:
    """Index tables of a lattice whose points are air of these chambers, or have a share of it [points].

    Returns:
        In the order of ``layout.BUFFERS``: the lowest node of the cells along x, y and z; the tiles along them; where
        each chamber's pairs of it and a tile begin; likewise each tile's; the chamber of each tile's pair, and its
        number among those of the chambers; for all tiles, and for each chamber's, where what they hand to a node lies,
        -1 for none; whether a node has any of a chamber's; then those of :func:`wall_tables`. A chamber's pairs are
        followed by the chunks of its wall points.
    """
    counts, shape = tiles.counts, tiles.of
    kinds = air.cpu().numpy().reshape(lattice.points)
    points = np.meshgrid(*map(_tile_of_points, tiles.along), indexing="ij")
    tile_of = np.ravel_multi_index(points, counts)
    has = np.zeros((tiles.count, chambers), bool)
    has[tile_of[kinds >= 0], kinds[kinds >= 0]] = True
    pairs = np.argwhere(has)  # tile and chamber, tile by tile
    order = np.argsort(pairs[:, 1], kind="stable")
    place = np.empty(len(pairs), int)
    place[order] = np.arange(len(pairs))
    slot = np.full(has.shape, -1)
    slot[has] = tiles.count + np.arange(len(pairs))
    # The two tiles of a node along each axis, and its number there.
    both, local = zip(*map(_tiles_of_nodes, lattice.axes, tiles.along), strict=True)
    rows = []
    for parts in itertools.product(range(2), repeat=3):
        x, y, z = np.meshgrid(*(t[:, i] for t, i in zip(both, parts, strict=True)), indexing="ij")
        there = (x >= 0) & (y >= 0) & (z >= 0)
        tile = np.where(there, (x * counts[1] + y) * counts[2] + z, 0)
        i, j, k = np.meshgrid(*(n[:, i] for n, i in zip(local, parts, strict=True)), indexing="ij")
        node = (i * shape.nodes[1] + j) * shape.nodes[2] + k
        slots = np.concatenate([tile[..., None], slot[tile]], -1)
        rows.append(np.where(there[..., None] & (slots >= 0), slots * shape.slot + node[..., None], -1))
    sources = np.stack(rows).reshape(layout.SHARED, lattice.nodes, 1 + chambers).transpose(2, 0, 1)
    gas = int(kinds.max()) + 1 if (kinds >= 0).any() else 0
    walls, chunk_chamber = wall_tables(lattice, gas, len(pairs))
    return [
        np.concatenate([a.first for a in lattice.axes]),
        np.concatenate(tiles.along),
        _starts(np.concatenate([pairs[:, 1], chunk_chamber]), chambers),
        _starts(pairs[:, 0], tiles.count),
        np.stack([pairs[:, 1], place], 1),
        sources,
        np.asarray((sources[1:] >= 0).any(1)),
        *walls,
    ]


def tile_axes(lattice: Lattice, tiles: Tiles) -> np.ndarray:
    """What kernels are to know of each tile along each axis, one after the other.

    Of its points three weights, three slopes [1/m] and the lowest node of their cell, zeros for those that it lacks; of
    its nodes the cell of which each is the lowest, -1 for none.
    """
    rows = []
    for axis, along, cells, nodes in zip(lattice.axes, tiles.along, tiles.of.cells, tiles.of.nodes, strict=True):
        table = np.concatenate([t.reshape(-1, 3) for t in axis.table], 1)
        for cell, count, first in along.tolist():
            lowest = axis.first[cell : cell + count] - first
            points, starts = np.zeros((2 * cells, layout.PAD_AXIS)), np.full(nodes, -1)
            points[: 2 * count, : layout.AXIS] = table[2 * cell : 2 * (cell + count)]
            points[: 2 * count, layout.AXIS] = np.repeat(lowest, 2)
            starts[lowest] = np.arange(count)
            rows += [points.reshape(-1), starts]
    return np.concatenate(rows)


def wall_slots(lattice: Lattice) -> tuple[np.ndarray, np.ndarray]:
    """How wall points of hollow chambers go into chunks of 256 of one chamber each.

    Returns:
        Of each place in the chunks its wall point, -1 for none [256 chunks]; of each chunk the hollow chamber [chunks].
    """
    if lattice.walls is None:
        return np.zeros(0, int), np.zeros(0, int)
    points, of = [], []
    for chamber in range(lattice.walls.count):
        mine = np.flatnonzero(lattice.walls.chambers.numpy() == chamber)
        chunks = -(-len(mine) // layout.TILE)
        points.append(np.pad(mine, (0, chunks * layout.TILE - len(mine)), constant_values=-1))
        of += [chamber] * chunks
    return np.concatenate(points), np.array(of, int)


def wall_tables(lattice: Lattice, gas: int, pairs: int) -> tuple[list[np.ndarray], np.ndarray]:
    """Index tables of wall points.

    Args:
        lattice: Of the body.
        gas: Number of chambers of gas particles.
        pairs: Of a tile and a chamber, which chunks follow.

    Returns:
        In the order of ``layout.BUFFERS``: the number of each chunk among what chambers sum; lowest node, chamber and
        axis of each wall point [WALL_INTEGERS, places]; of each node its row, -1 for none; of each row, how many wall
        points it adds up, and for each of them [most, rows] 27 times the wall point and which of its nodes it is. And
        the chamber of each chunk.
    """
    points, of = wall_slots(lattice)
    kind = np.zeros((layout.WALL_INTEGERS, len(points)), int)
    there, walls = np.flatnonzero(points >= 0), lattice.walls
    node = np.zeros((0, 27), int)
    if walls is not None:
        p = points[there]
        node = walls.nodes.numpy()[p]
        kind[:, there] = np.stack([node[:, 0], gas + walls.chambers.numpy()[p], walls.axes.numpy()[p]])
    entry = (27 * there[:, None] + np.arange(27)).reshape(-1)
    order = np.argsort(node.reshape(-1), kind="stable")
    count = np.bincount(node.reshape(-1), minlength=lattice.nodes)
    near = np.flatnonzero(count)
    row = np.full(lattice.nodes, -1)
    row[near] = np.arange(len(near))
    entries = np.zeros((count.max(initial=0), len(near)), int)
    within = np.arange(len(order)) - np.repeat(np.cumsum(count) - count, count)
    entries[within, np.repeat(row[near], count[near])] = entry[order]
    return [pairs + np.arange(len(of)), kind, row, count[near], entries], gas + of


def wall_numbers(lattice: Lattice) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of wall points, in the order of :func:`wall_slots`: place, area, values [WALL, places].

    Beside them the weight of each of the entries of :func:`wall_tables` [most, rows].
    """
    points, _ = wall_slots(lattice)
    found, there = np.zeros((layout.WALL, len(points))), points >= 0
    if lattice.walls is not None:
        w = lattice.walls
        places, areas, values = (t.numpy()[points[there]] for t in (w.places, w.areas, w.values))
        found[:, there] = np.concatenate([places, areas[:, None], values.reshape(len(values), -1)], 1).T
    *_, count, entry = wall_tables(lattice, 0, 0)[0]
    weights = found[4 + 3 * (entry % 27), entry // 27]
    return found, np.where(np.arange(len(entry))[:, None] < count, weights, 0.0)


def _starts(sorted_or_not: np.ndarray, count: int) -> np.ndarray:
    """Where the rows of each number begin, and where the last end [count + 1]."""
    return np.concatenate([[0], np.cumsum(np.bincount(sorted_or_not, minlength=count))])


def _tile_of_points(along: np.ndarray) -> np.ndarray:
    """Tile of each point along an axis [2 cells]."""
    return np.repeat(np.arange(len(along)), 2 * along[:, 1])


def _tiles_of_nodes(axis: Axis, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tiles that a node along an axis belongs to, and its number among their nodes; each [nodes, 2], -1 for none."""
    tiles, local = np.full((2, axis.nodes, 2), -1)
    for number, (cell, count, first) in enumerate(along.tolist()):
        nodes = np.arange(first, int(axis.first[cell + count - 1]) + 3)
        free = (tiles[nodes, 0] >= 0).astype(int)
        tiles[nodes, free], local[nodes, free] = number, np.arange(len(nodes))
    return tiles, local
