"""Variations of a body on a GPU: the substep of ``lane_march``, a block of threads for each variation.

A block marches through all its substeps by itself, so that nothing waits for another block or for the host. Points,
nodes of cells, and nodes are handed to its threads in turn; sums are gathered and never added to by two threads at
once, so that a run gives the same bits each time. Compiled by Numba for CUDA (package ``numba-cuda``).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import config, float32

from torchsoro.simulation.kernels.cuda_cells import gradient, hand_out, look, met, stress, wall_area
from torchsoro.simulation.kernels.cuda_laws import cuda, f32, pull_back
from torchsoro.simulation.kernels.variations import Case, Mesh

TOUCH = 1e-6  # m in front of a plane within which a node lies on it
SURFACE = 0.5  # stiffness of planes for a node, in its mass over the square of the step: what the step still bears
ROOM = 264  # variations that run side by side on a GPU of some hundred multiprocessors
SIMULATED = bool(getattr(config, "ENABLE_CUDASIM", False))  # by Numba, on the processor, for tests
WARP = 32  # threads that add up what a block has in common
SHARED = 8  # such sums at most: chambers, and three for each spring
# So many registers that a block fits; Numba's simulator of a GPU knows no such options.
OPTIONS: dict[str, Any] = {"fastmath": True} | ({} if SIMULATED else {"max_registers": 128, "cache": True})


@cuda.jit(**OPTIONS)
def _march(mesh, wall, mark, node, plane, case, room, stiffens, softens, out):
    b, thread = cuda.blockIdx.x, cuda.threadIdx.x
    held, surface, places, front, spread, slots, filled, wall_entries, wall_at, wall_share = node
    normals, stick, facing = plane
    dts, steps, everys, owns, series, laws, weights, lefts, gravities, fluids, supplies, airs, volumes = case[:13]
    pushed, pushes, starts, ties, springs, offsets, frictions, adhesions, reaches = case[13:]
    d, v, Z, P, shares, areas = room[0][b], room[1][b], room[2][b], room[3][b], room[4][b], room[5][b]
    own, law, weight, left, gravity, fluid = owns[b], laws[b], weights[b], lefts[b], gravities[b], fluids[b]
    sums = cuda.shared.array((SHARED, WARP), float32)
    common = cuda.shared.array(SHARED, float32)
    points, nodes, walls = own.shape[1], held.shape[0], areas.shape[1]
    elements, chambers, tied = series.shape[1], supplies.shape[2], ties.shape[1]
    dt, every = dts[b], everys[b]
    push = f32(SURFACE) / dt
    look(mark, d, v, out[b, 0], thread)
    for t in range(steps[b]):
        for p in range(thread, points, cuda.blockDim.x):
            F = gradient(mesh, d, p >> 3, p & 7)
            q0, q1, q2, q3, q4, q5 = f32(0), f32(0), f32(0), f32(0), f32(0), f32(0)
            if elements > 0:
                T = pull_back(F, law, stiffens)
                for e in range(elements):
                    now, later, fades, grows = series[b, e, 0], series[b, e, 1], series[b, e, 2], series[b, e, 3]
                    q0 += now * Z[e, 0, p] + later * T[0]
                    q1 += now * Z[e, 1, p] + later * T[1]
                    q2 += now * Z[e, 2, p] + later * T[2]
                    q3 += now * Z[e, 3, p] + later * T[3]
                    q4 += now * Z[e, 4, p] + later * T[4]
                    q5 += now * Z[e, 5, p] + later * T[5]
                    Z[e, 0, p] = fades * Z[e, 0, p] - grows * T[0]
                    Z[e, 1, p] = fades * Z[e, 1, p] - grows * T[1]
                    Z[e, 2, p] = fades * Z[e, 2, p] - grows * T[2]
                    Z[e, 3, p] = fades * Z[e, 3, p] - grows * T[3]
                    Z[e, 4, p] = fades * Z[e, 4, p] - grows * T[4]
                    Z[e, 5, p] = fades * Z[e, 5, p] - grows * T[5]
            stress(F, (q0, q1, q2, q3, q4, q5), own, p, law, stiffens, softens, P)
        for w in range(thread, walls, cuda.blockDim.x):
            wall_area(wall, d, w, areas)
        cuda.syncthreads()
        hand_out(mesh, spread, slots, P, shares, thread)
        # What a block has in common: volumes of chambers, stretches of springs.
        if thread < WARP:
            for c in range(chambers):
                total = f32(0)
                for w in range(thread, walls, WARP):
                    if wall[6][w] == c:
                        total += areas[3, w]
                sums[c, thread] = total
        elif thread < 2 * WARP:
            for s in range(3 * tied):
                total = f32(0)
                for n in range(thread - WARP, nodes, WARP):
                    total += ties[b, s // 3, n] * d[s % 3, n]
                sums[chambers + s, thread - WARP] = total
        cuda.syncthreads()
        if thread < chambers + 3 * tied:
            total = f32(0)
            for k in range(WARP):
                total += sums[thread, k]
            if thread < chambers:
                common[thread] = supplies[b, t, thread] - airs[b, thread] * (total / volumes[thread] - f32(1))
            else:
                common[thread] = springs[b, (thread - chambers) // 3] * total
        cuda.syncthreads()
        for n in range(thread, nodes, cuda.blockDim.x):
            u0, u1, u2 = v[0, n], v[1, n], v[2, n]
            if not held[n]:
                f0, f1, f2 = f32(0), f32(0), f32(0)
                for k in range(n, filled[n], nodes):
                    f0 += shares[0, k]
                    f1 += shares[1, k]
                    f2 += shares[2, k]
                for k in range(wall_entries[n], wall_entries[n + 1]):
                    w = wall_at[k]
                    pressure = wall_share[k] * common[wall[6][w]]
                    f0 -= pressure * areas[0, w]
                    f1 -= pressure * areas[1, w]
                    f2 -= pressure * areas[2, w]
                for k in range(pushes.shape[1]):
                    if t >= starts[b, k]:
                        share = pushed[b, k, n]
                        f0 -= share * pushes[b, k, 0]
                        f1 -= share * pushes[b, k, 1]
                        f2 -= share * pushes[b, k, 2]
                for k in range(tied):
                    share = ties[b, k, n]
                    f0 += share * common[chambers + 3 * k]
                    f1 += share * common[chambers + 3 * k + 1]
                    f2 += share * common[chambers + 3 * k + 2]
                w, drag = weight[n], dt * fluid * weight[n]
                u0 += dt * (gravity[0] - w * f0)
                u1 += dt * (gravity[1] - w * f1)
                u2 += dt * (gravity[2] - w * f2)
                u0 = left[n] * u0 / (f32(1) + drag * front[n, 0] * abs(u0))
                u1 = left[n] * u1 / (f32(1) + drag * front[n, 1] * abs(u1))
                u2 = left[n] * u2 / (f32(1) + drag * front[n, 2] * abs(u2))
            if surface[n]:
                for a in range(stick.shape[0]):
                    gap = (places[n, 0] + d[0, n]) * normals[a, 0] + (places[n, 1] + d[1, n]) * normals[a, 1]
                    gap += (places[n, 2] + d[2, n]) * normals[a, 2] - offsets[b, a]
                    hold = adhesions[b, a] * facing[a, n] * dt * weight[n]
                    if gap < f32(TOUCH):
                        u0, u1, u2 = met(u0, u1, u2, gap, normals[a], stick[a], push, hold, frictions[b, a])
                    elif gap < reaches[b, a]:
                        u0 -= hold * normals[a, 0]
                        u1 -= hold * normals[a, 1]
                        u2 -= hold * normals[a, 2]
            v[0, n], v[1, n], v[2, n] = u0, u1, u2
            d[0, n] += dt * u0
            d[1, n] += dt * u1
            d[2, n] += dt * u2
        cuda.syncthreads()
        if (t + 1) % every == 0:
            look(mark, d, v, out[b, (t + 1) // every], thread)


def available() -> bool:
    """Whether there is a GPU that this can run on."""
    try:
        return bool(cuda.is_available())
    except Exception:  # a driver or toolkit that does not fit: what it raises is its own
        return False


@dataclass(frozen=True)
class GpuMesh:
    """A mesh on the GPU.

    Attributes:
        mesh: Weights, slopes, cells, corners and strides.
        wall: Points of the chambers' walls.
        mark: Markers.
        node: Of nodes: held, on the surface, places, front; what cells, and walls, hand to them.
        held: Nodes that stay, here.
        count: Of points, nodes, walls, markers.
        most: Cells of a node.
    """

    mesh: tuple[Any, ...]
    wall: tuple[Any, ...]
    mark: tuple[Any, ...]
    node: tuple[Any, ...]
    held: np.ndarray
    count: tuple[int, int, int, int]
    most: int


def body_of(mesh: Mesh) -> GpuMesh:
    """Bring a mesh to the GPU."""
    i32 = np.int32
    nodes, cells, walls = len(mesh.held), len(mesh.corners), len(mesh.wall_axis)
    i, j, k = (a.reshape(-1) for a in np.meshgrid(*[np.arange(3)] * 3, indexing="ij"))
    whose = (mesh.corners[:, None] + i * mesh.stride_x + j * mesh.stride_y + k).reshape(-1)
    begin, entry = _by_node(whose, nodes)
    slots = np.zeros(27 * cells, i32)
    slots[entry] = (np.arange(27 * cells) - begin[whose[entry]]) * nodes + whose[entry]
    spread = ((np.arange(cells)[:, None] << 6) + (i << 4) + (j << 2) + k).reshape(-1)
    wall_begin, wall_entry = _by_node(mesh.wall_node, nodes)
    wall_of = np.repeat(np.arange(walls), np.diff(mesh.wall_begin))
    surface = np.zeros(nodes, bool)
    surface[mesh.surface] = True
    filled = (np.diff(begin) * nodes + np.arange(nodes)).astype(i32)
    node = (mesh.held, surface, mesh.places, mesh.front, spread.astype(i32), slots, filled)
    on_walls = (wall_begin, wall_of[wall_entry].astype(i32), mesh.wall_value[wall_entry, 0].astype(f32))
    wall = (mesh.wall_begin, mesh.wall_node, mesh.wall_value, mesh.wall_place, mesh.wall_axis, mesh.wall_area)
    wall = tuple(a.astype(i32 if a.dtype.kind == "i" else f32) for a in (*wall, mesh.wall_chamber))
    mark = (mesh.mark_begin.astype(i32), mesh.mark_node.astype(i32), mesh.mark_value)
    shape = (mesh.weights, mesh.slopes, mesh.cells.astype(i32), mesh.corners.astype(i32))
    return GpuMesh(
        mesh=(*_there(shape), i32(mesh.stride_x), i32(mesh.stride_y)),
        wall=_there(wall),
        mark=_there(mark),
        node=_there((*node, *on_walls)),
        held=mesh.held,
        count=(8 * cells, nodes, walls, len(mesh.mark_begin) - 1),
        most=int(np.diff(begin).max()),
    )


def march_all(body: GpuMesh, cases: Sequence[Case], used: Sequence[int], samples: int) -> np.ndarray:
    """Simulate variations that have planes, springs and Maxwell elements in common.

    Args:
        body: Of all.
        cases: Each with sixteen variations.
        used: How many of each, the first ones.
        samples: Of all.

    Returns:
        Samples [B, samples, markers, 5, 3] as in :func:`lanes.march`.
    """
    points, nodes, _, markers = body.count
    count, first = sum(used), cases[0]
    every_case = list(zip(cases, used, strict=True))

    def each(get) -> np.ndarray:
        """One array of all variations [B, ...], from arrays whose last axis they are."""
        return np.concatenate([np.moveaxis(np.asarray(get(c)), -1, 0)[:n] for c, n in every_case]).astype(f32)

    def single(get, kind: type) -> np.ndarray:
        return np.repeat(np.array([get(c) for c in cases], kind), used)

    elements, chambers, tied = len(first.series) // 64, first.supply.shape[1], len(first.springs)
    assert chambers + 3 * tied <= SHARED
    longest = max(len(c.supply) for c in cases)
    most = max(len(c.push_begin) - 1 for c in cases)
    supply = np.zeros((count, longest, chambers), f32)
    pushed, pushes = np.zeros((count, most, nodes), f32), np.zeros((count, most, 3), f32)
    starts, ties = np.zeros((count, most), np.int32), np.zeros((count, tied, nodes), f32)
    at = 0
    for c, n in every_case:
        mine = slice(at, at + n)
        at += n
        supply[mine, : len(c.supply)] = np.moveaxis(c.supply, -1, 0)[:n]
        for k in range(len(c.push_begin) - 1):
            span = slice(c.push_begin[k], c.push_begin[k + 1])
            np.add.at(pushed[mine, k].T, c.push_node[span], c.push_share[span, None])
            pushes[mine, k], starts[mine, k] = c.push[k].T[:n], c.push_start[k]
        for node, number, share in zip(c.spring_node, c.spring_number, c.spring_share, strict=True):
            ties[mine, number, node] += share[:n]
    d, v = (each(lambda c, a=a: np.swapaxes(getattr(c, a), 0, 1)) * ~body.held for a in ("place", "velocity"))
    case = (
        single(lambda c: c.dt, f32),
        single(lambda c: c.steps, np.int32),
        single(lambda c: c.every, np.int32),
        each(lambda c: np.swapaxes(c.own.reshape(points, 3, 16), 0, 1)),
        each(lambda c: c.series.reshape(elements, 4, 16)),
        each(lambda c: c.law.reshape(4, 16)),
        each(lambda c: c.weight),
        each(lambda c: c.left),
        each(lambda c: c.gravity),
        each(lambda c: c.fluid),
        supply,
        each(lambda c: c.air),
        first.volume,
        pushed,
        pushes,
        starts,
        ties,
        each(lambda c: c.springs),
        each(lambda c: c.offset),
        each(lambda c: c.friction),
        each(lambda c: c.adhesion),
        each(lambda c: c.reach),
    )
    planes = (first.normals.astype(f32), first.stick, first.area)
    flags = (any(c.stiffens for c in cases), any(c.softens for c in cases))
    return _run(body, planes, case, (d, v), elements, flags, (count, samples, markers, 5, 3))


def _run(
    body: GpuMesh, planes, case, start, elements: int, flags: tuple[bool, bool], shape: tuple[int, ...]
) -> np.ndarray:
    """Launch: what is on the host goes to the GPU, samples come back."""
    points, nodes, walls, _ = body.count
    history = np.zeros((shape[0], elements, 6, points), f32)
    rooms = ((9, points), (3, nodes * body.most), (4, walls))
    free = [*_there((*start, history)), *(cuda.device_array((shape[0], *room), f32) for room in rooms)]
    out = cuda.to_device(np.zeros(shape, f32))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that there are few blocks
        _march[shape[0], _threads(points)](
            body.mesh, body.wall, body.mark, body.node, _there(planes), _there(case), tuple(free), *flags, out
        )
    return out.copy_to_host()


def _threads(points: int) -> int:
    """Of a block: few, so that several blocks share a multiprocessor, but not so few that a large body takes long."""
    if SIMULATED:
        return 2 * WARP  # which are taken one after the other
    return 128 if points <= 512 else 256 if points <= 2048 else 512


def _there(arrays: Sequence[np.ndarray]) -> tuple[Any, ...]:
    return tuple(cuda.to_device(np.ascontiguousarray(a)) for a in arrays)


def _by_node(node: np.ndarray, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Entries of each node: where they begin [n + 1], and their numbers."""
    begin = np.concatenate([[0], np.cumsum(np.bincount(node, minlength=nodes))])
    return begin.astype(np.int32), np.argsort(node, kind="stable").astype(np.int32)
