"""Bodies as lanes of the CPU's kernels see them: which lane deals with which cell, point, node and simulation."""

from __future__ import annotations

import itertools
import math
from collections import OrderedDict, defaultdict
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchsoro.simulation.kernels import layout
from torchsoro.simulation.kernels.lane_march import Mesh
from torchsoro.simulation.kernels.lanes import LANES
from torchsoro.simulation.ops.lattice import Lattice

PARTS = 16  # items of a body, at least: as many threads have something to do


class _Table(NamedTuple):
    """Of an axis: lowest node of each cell [cells], and weights and slopes of its nodes [cells, 12]."""

    first: np.ndarray
    numbers: np.ndarray


def _tables(lattice: Lattice) -> list[_Table]:
    return [_Table(a.first, np.concatenate([t.reshape(a.cells, 6) for t in a.table], 1)) for a in lattice.axes]


@dataclass(frozen=True, eq=False)
class Lanes:
    """How bodies of one lattice are laid out.

    Attributes:
        mesh: For the kernels.
        batch: Number of simulations.
        groups: Number of bodies that the kernels see: one for each simulation, or for each sixteen.
        points: Of each block, point and lane the point of the lattice, -1 where there is none [blocks, 8, 16].
        nodes: Place of each node in a component, of the first lane [nodes].
        pairs: Block and chamber of each pair that has gas [pairs, 2].
        variations: Whether lanes are simulations, else cells of one.
    """

    mesh: Mesh
    batch: int
    groups: int
    points: Tensor
    nodes: Tensor
    pairs: Tensor
    variations: bool
    absent: bool

    @cached_property
    def _row(self) -> Tensor:
        """Simulation of each group and lane, where lanes are simulations [groups, 16]; the last fills what is left."""
        return torch.arange(self.groups * LANES).clamp(max=self.batch - 1).view(self.groups, LANES)

    @cached_property
    def _flat(self) -> Tensor:
        return self.points.clamp(min=0).reshape(-1)

    @cached_property
    def _there(self) -> Tensor:
        return self.points >= 0

    @cached_property
    def _where(self) -> tuple[Tensor, Tensor]:
        """Points that are there, and their places [block, 8, lane], flat."""
        flat = self.points.reshape(-1)
        places = (flat >= 0).nonzero().squeeze(1)
        return flat[places], places

    def holds(self, air: Tensor) -> Tensor:
        """Which points of each pair of a block and a chamber hold air of that chamber, bool [pairs, 8, 16].

        Args:
            air: The chamber whose air each point is, or has a share of [points].
        """
        block, chamber = self.pairs.unbind(1)
        of = torch.where(self._there, air.cpu()[self.points.clamp(min=0)], -1)
        return of[block] == chamber[:, None, None]

    def from_points(self, values: Tensor, empty: float = 0.0) -> Tensor:
        """Values by point [B, K, points] as [groups, blocks, 8, K, 16]."""
        batch, count, _ = values.shape
        if self.variations:
            wide = values[:, :, self.points[:, :, 0].clamp(min=0).reshape(-1)].view(batch, count, -1, 8)
            wide = torch.where(self._there[:, :, 0], wide, empty).permute(2, 3, 1, 0)
            return wide[..., self._row.reshape(-1)].unflatten(-1, (self.groups, LANES)).movedim(-2, 0).contiguous()
        wide = values[:, :, self._flat].view(batch, count, -1, 8, LANES).permute(0, 2, 3, 1, 4)
        return torch.where(self._there[None, :, :, None, :], wide, empty).contiguous()

    def to_points(self, lanes: Tensor, count: int) -> Tensor:
        """The opposite of :meth:`from_points`, zero where no block has a point; ``count`` is the number of points."""
        inner = lanes.shape[3]
        found = lanes.new_zeros(self.batch, inner, count)
        if self.variations:
            there = self._there[:, :, 0].reshape(-1)
            rows = lanes.permute(0, 4, 3, 1, 2).reshape(self.groups * LANES, inner, -1)[: self.batch]
            return found.index_copy_(2, self.points[:, :, 0].reshape(-1)[there], rows[:, :, there])
        at, places = self._where
        rows = lanes.permute(0, 3, 1, 2, 4).reshape(self.batch, inner, -1)[:, :, places]
        return found.index_copy_(2, at, rows)

    def from_nodes(self, values: Tensor) -> Tensor:
        """Values by node [B, K, nodes] as [groups, K, component]."""
        _batch, count, _ = values.shape
        found = values.new_zeros(self.groups, count, self.mesh.component)
        if self.variations:
            rows = values[self._row.reshape(-1)].unflatten(0, (self.groups, LANES))
            self._without_ends(found).unflatten(-1, (-1, LANES)).copy_(rows.permute(0, 2, 3, 1))
            return found
        return found.index_copy_(2, self.nodes, values)

    def _without_ends(self, lanes: Tensor) -> Tensor:
        """The part [..., nodes * 16] of a component in which the nodes lie one behind the other, of variations."""
        return lanes[..., self.mesh.front : self.mesh.front + LANES * len(self.nodes)]

    def from_common_nodes(self, values: Tensor) -> Tensor:
        """Values by node that all simulations have in common [K, nodes] as [K, component]."""
        found = values.new_zeros(len(values), self.mesh.component)
        if self.variations:
            self._without_ends(found).unflatten(-1, (-1, LANES)).copy_(values.unsqueeze(-1))
            return found
        return found.index_copy_(1, self.nodes, values)

    def to_nodes(self, lanes: Tensor) -> Tensor:
        """The opposite of :meth:`from_nodes`."""
        if self.variations:
            rows = self._without_ends(lanes).unflatten(-1, (-1, LANES)).permute(0, 3, 1, 2)
            return rows.reshape(-1, *rows.shape[2:])[: self.batch].contiguous()
        return lanes[:, :, self.nodes]

    def sixteens(self, some: Tensor | None) -> np.ndarray:
        """Of each sixteen numbers of a component its place among those that have any of some nodes [U]; -1 for none."""
        count = self.mesh.component // LANES
        if some is None:
            return np.arange(count)
        found, chosen = np.full(count, -1), np.unique(self.nodes[some].numpy() // LANES)
        found[chosen] = np.arange(len(chosen))
        return found

    def to_some_nodes(self, lanes: Tensor, some: Tensor) -> Tensor:
        """Samples of some nodes [U] by lane, with their ``sixteens`` only [S, groups, K, ...], as [S, B, K, U]."""
        if self.variations:
            return lanes.unflatten(-1, (-1, LANES)).permute(0, 1, 4, 2, 3).flatten(1, 2)[:, : self.batch]
        at = self.nodes[some]
        return lanes[..., LANES * torch.from_numpy(self.sixteens(some))[at // LANES] + at % LANES]

    def from_batch(self, values: Tensor, axis: int = 0) -> Tensor:
        """Numbers of a simulation, with the batch along an axis, as [..., groups, ..., 16]."""
        if self.variations:
            wide = values.index_select(axis, self._row.reshape(-1)).unflatten(axis, (self.groups, LANES))
            return wide.movedim(axis + 1, -1).contiguous()
        return values.unsqueeze(-1).expand(*values.shape, LANES).contiguous()

    def to_batch(self, lanes: Tensor, axis: int = 0) -> Tensor:
        """Gradients by such numbers: those of a lane, or the sum over lanes."""
        if self.variations:
            return lanes.movedim(-1, axis + 1).flatten(axis, axis + 1).narrow(axis, 0, self.batch)
        return lanes.sum(-1)

    def summed(self, lanes: Tensor, axis: int = 0) -> Tensor:
        """Gradients by such numbers that kernels have summed over the lanes of a simulation."""
        return self.to_batch(lanes, axis) if self.variations else lanes[..., 0]


def _efficiency(cells: np.ndarray, row: int, first: list[np.ndarray]) -> float:
    """Share of lanes that have a cell, where lanes are cells."""
    blocks = sum(len(_blocks(layer, row, first)) for layer in np.split(cells, np.flatnonzero(np.diff(cells[:, 0])) + 1))
    return len(cells) / (LANES * blocks)


def fewest(lattice: Lattice) -> int:
    """Simulations of a body from which on lanes are simulations; of fewer, they are cells of each."""
    there = np.ones(lattice.points, bool) if lattice.index is None else np.zeros(lattice.points, bool)
    if lattice.index is not None:
        there.reshape(-1)[lattice.index.cpu().numpy()] = True
    x, y, z = (n // 2 for n in lattice.points)
    cells = np.argwhere(there.reshape(x, 2, y, 2, z, 2).any((1, 3, 5)))
    return math.ceil(LANES * _efficiency(cells, lattice.shape[2], [axis.first for axis in lattice.axes]))


def _blocks(layer: np.ndarray, row: int, first: list[np.ndarray]) -> list[tuple[int, list[tuple[int, np.ndarray]]]]:
    """Blocks of the cells of a layer: place of the first lane in the plane, and each lane that has a cell with it."""
    corner = first[1][layer[:, 1]] * row + first[2][layer[:, 2]]
    order = np.argsort(corner)
    found: list[tuple[int, list[tuple[int, np.ndarray]]]] = []
    for n in order:
        if not found or corner[n] - found[-1][0] >= LANES:
            found.append((int(corner[n]), []))
        found[-1][1].append((int(corner[n] - found[-1][0]), layer[n]))
    return found


_known: OrderedDict[tuple, Lanes] = OrderedDict()
MOST = 64  # layouts that are remembered


def lay_out(lattice: Lattice, kind: Tensor, air: Tensor, batch: int, dtype: torch.dtype) -> Lanes:
    """:func:`_laid_out`, remembered: every call of a simulator asks again for the same body."""
    axes = ((a.knots.tobytes(), a.first.tobytes()) for a in lattice.axes)
    walls = None if lattice.walls is None else lattice.walls.key
    key = (*axes, walls, kind.cpu().numpy().tobytes(), batch, dtype)  # which the chambers' air follows from
    found = _known.pop(key, None)
    if found is None:
        found = _laid_out(lattice, kind, air, batch, dtype)
    _known[key] = found  # the last one
    while len(_known) > MOST:
        _known.popitem(last=False)
    return found


def _laid_out(lattice: Lattice, kind: Tensor, air: Tensor, batch: int, dtype: torch.dtype) -> Lanes:
    """Deal the cells of a lattice, and the simulations of a batch, to blocks of sixteen lanes.

    Args:
        lattice: Of the bodies.
        kind: Of each point [points], see ``Scene.kind``; or ABSENT.
        air: The chamber whose air each point is, or has a share of [points]; negative for none.
        batch: Number of simulations.
        dtype: Of the kernels' numbers.
    """
    real = {torch.float32: np.float32, torch.float64: np.float64}[dtype]
    px, py, pz = lattice.points
    cx, cy, cz = px // 2, py // 2, pz // 2
    kinds = kind.cpu().numpy().reshape(cx, 2, cy, 2, cz, 2).transpose(0, 2, 4, 1, 3, 5).reshape(cx, cy, cz, 8)
    numbers = np.arange(px * py * pz).reshape(cx, 2, cy, 2, cz, 2).transpose(0, 2, 4, 1, 3, 5).reshape(cx, cy, cz, 8)
    cells = np.argwhere((kinds != layout.ABSENT).any(-1))
    tables = _tables(lattice)
    first = [t.first for t in tables]
    nx, ny, nz = lattice.shape
    full = LANES * math.ceil(batch / LANES)
    variations = batch / full >= _efficiency(cells, nz, first)
    unit = LANES if variations else 1
    row = nz * unit
    plane = LANES * math.ceil(ny * row / LANES)
    front = LANES * math.ceil(plane / LANES)
    component = LANES * math.ceil((front + (nx + 1) * plane + 2 * row + 2 * unit + LANES) / LANES)
    patch = LANES * math.ceil((plane + 2 * row + 2 * unit + LANES) / LANES)

    blocks: list[tuple[int, np.ndarray, bytes, bytes]] = []
    Y: dict[bytes, int] = {}
    Z: dict[bytes, int] = {}
    items: list[tuple[int, int, int]] = []  # layer, first block, last
    layers = np.split(cells, np.flatnonzero(np.diff(cells[:, 0])) + 1)
    parts = math.ceil(PARTS / max(1, len(layers)))
    for layer in layers:
        begin = len(blocks)
        if variations:
            found = [
                (
                    int(first[1][y]) * row + int(first[2][z]) * unit,
                    [(lane, np.array((x, y, z))) for lane in range(LANES)],
                )
                for x, y, z in layer
            ]
        else:
            found = _blocks(layer, row, first)
        for at, lanes in found:
            where = np.full((8, LANES), -1)
            y, z = np.zeros((12, LANES), real), np.zeros((12, LANES), real)
            for lane, cell in lanes:
                there = kinds[tuple(cell)] != layout.ABSENT
                where[:, lane] = np.where(there, numbers[tuple(cell)], -1)
                y[:, lane], z[:, lane] = tables[1].numbers[cell[1]], tables[2].numbers[cell[2]]
            blocks.append((at, where, y.tobytes(), z.tobytes()))
            Y.setdefault(y.tobytes(), len(Y))
            Z.setdefault(z.tobytes(), len(Z))
        count = len(blocks) - begin
        cuts = [begin + count * k // min(parts, count) for k in range(min(parts, count) + 1)]
        items += [(int(layer[0, 0]), a, b) for a, b in itertools.pairwise(cuts)]

    points = np.stack([where for _, where, _, _ in blocks])
    flat = air.cpu().numpy()
    of = np.where(points >= 0, flat[np.maximum(points, 0)], -1)
    gas = int(flat.max()) + 1 if (flat >= 0).any() else 0
    chambers = gas + (0 if lattice.walls is None else lattice.walls.count)
    pairs = [(b, c) for b in range(len(blocks)) for c in range(chambers) if (of[b] == c).any()]
    item_gas = np.zeros((len(items), max(chambers, 1)), bool)
    for i, (_, a, b) in enumerate(items):
        for block, c in pairs:
            item_gas[i, c] |= a <= block < b
    walls = _walls(lattice, row, unit, np.array([first[0][i[0]] for i in items]), gas, real)
    for item, chamber in zip(
        np.repeat(np.arange(len(items)), np.diff(walls["wall_begin"])), walls["wall_chamber"], strict=True
    ):
        item_gas[item, chamber] = True
    touched = _touched(items, [b[0] for b in blocks], walls, 2 * row + 2 * unit + LANES)
    entries = defaultdict(list)
    for i, (layer, _, _) in enumerate(items):
        for slot in range(3):
            for at in range(touched[i, 0], min(touched[i, 1], plane), LANES):
                entries[(int(first[0][layer]) + slot) * plane + at].append((i, slot))
    listed = [entries[at] for at in range(0, nx * plane, LANES)]
    grid = np.stack(np.meshgrid(np.arange(nx) * plane, np.arange(ny) * row, np.arange(nz) * unit, indexing="ij")).sum(0)
    nodes = torch.from_numpy(front + grid.reshape(-1))
    places = torch.zeros(3, component, dtype=dtype)
    where = lattice.node_places.to(dtype).T
    for lane in range(unit):
        places[:, nodes + lane] = where
    whole = np.int64
    mesh = Mesh(
        unit=unit, row=row, plane=plane, front=front, component=component, planes=nx, patch=patch, chambers=chambers,
        item_plane=np.array([first[0][i[0]] for i in items], whole),
        item_x=np.array([12 * i[0] for i in items], whole),
        item_begin=np.array([*(i[1] for i in items), len(blocks)], whole),
        item_from=touched[:, 0].copy(),
        item_to=touched[:, 1].copy(),
        block_at=np.array([b[0] for b in blocks], whole),
        block_y=np.array([192 * Y[b[2]] for b in blocks], whole),
        block_z=np.array([192 * Z[b[3]] for b in blocks], whole),
        gas_begin=np.searchsorted([b for b, _ in pairs], np.arange(len(blocks) + 1)).astype(whole),
        gas_chamber=np.array([c for _, c in pairs], whole),
        item_gas=item_gas,
        X=tables[0].numbers.astype(real).reshape(-1),
        Y=np.frombuffer(b"".join(Y), real).copy(),
        Z=np.frombuffer(b"".join(Z), real).copy(),
        near_begin=np.cumsum([0, *(len(e) for e in listed)]).astype(whole),
        near_item=np.array([i for e in listed for i, _ in e], whole),
        near_slot=np.array([s for e in listed for _, s in e], whole),
        places=places.numpy().reshape(-1),
        own=(np.arange(LANES) < unit).astype(real),
        **walls,
    )  # fmt: skip
    return Lanes(
        mesh=mesh,
        batch=batch,
        groups=full // LANES if variations else batch,
        points=torch.from_numpy(points),
        nodes=nodes,
        pairs=torch.tensor(pairs, dtype=torch.int64).reshape(-1, 2),
        variations=bool(variations),
        absent=bool((points < 0).any()),
    )


def _touched(items: list[tuple[int, int, int]], at: list[int], walls: dict[str, np.ndarray], reach: int) -> np.ndarray:
    """From where to where each item touches its planes, in sixteens; ``reach`` numbers are touched from a place on."""
    found = []
    for i, (_, a, b) in enumerate(items):
        places = [*at[a:b], *walls["wall_at"][walls["wall_begin"][i] : walls["wall_begin"][i + 1]]]
        found.append((min(places) // LANES * LANES, LANES * math.ceil((max(places) + reach) / LANES)))
    return np.array(found, np.int64)


def _walls(lattice: Lattice, row: int, unit: int, planes: np.ndarray, gas: int, real: type) -> dict[str, np.ndarray]:
    """The points of the walls of hollow chambers, by the first item of the layer whose nodes they use.

    Args:
        lattice: Of the bodies.
        row: Numbers between two nodes along y.
        unit: Likewise along z.
        planes: Lowest plane of nodes of each item.
        gas: Number of chambers of gas particles.
        real: Of the kernels' numbers.
    """
    count, w = len(planes), lattice.walls
    whole, begin = np.int64, np.zeros(len(planes) + 1, np.int64)
    at, chamber, axis, area = (np.zeros(0, kind) for kind in (whole, whole, whole, real))
    value, place = np.zeros(0, real), np.zeros(0, real)
    if w is not None:
        x, y, z = np.unravel_index(w.nodes[:, 0].numpy(), lattice.shape)
        item = np.searchsorted(planes, x)
        order = np.argsort(item, kind="stable")
        begin = np.searchsorted(item[order], np.arange(count + 1))
        at, chamber, axis = (y * row + z * unit)[order], gas + w.chambers.numpy()[order], w.axes.numpy()[order]
        value, place, area = (t.numpy()[order].astype(real) for t in (w.values, w.places, w.areas))
    return {
        "wall_begin": begin.astype(whole),
        "wall_at": at.astype(whole),
        "wall_value": value.reshape(-1),
        "wall_place": place.reshape(-1),
        "wall_axis": axis.astype(whole),
        "wall_area": area,
        "wall_chamber": chamber.astype(whole),
    }
