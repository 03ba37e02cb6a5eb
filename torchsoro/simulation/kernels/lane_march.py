"""Substeps of the total-Lagrangian form in lanes: points, nodes, and the threads that share them.

Cells are dealt with in items, each a part of a layer of cells across x, which sums forces in a buffer of its own over
the three planes of nodes that the layer touches; nodes then sum over the items of their plane in a fixed order. So
nothing is added by two threads at once, and results do not depend on the number of threads.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchsoro.simulation.kernels.lane_nodes import advance
from torchsoro.simulation.kernels.lane_points import (
    ATTACHED,
    MAXWELL,
    NUMBERS,
    ROOM,
    enclosed,
    gather,
    hand_on,
    keep,
    point,
    scatter,
    stretch,
    value,
)
from torchsoro.simulation.kernels.lane_selfcontact import SelfContact, contact_forward
from torchsoro.simulation.kernels.lane_threads import look, meet
from torchsoro.simulation.kernels.lane_walls import ties_forward, walls_forward
from torchsoro.simulation.kernels.lanes import fast, law, load, part, store

NEVER = 2**62
SCRATCH = ROOM + 5 * 1152  # numbers of a thread: for sums, and tensors of eight points of five kinds


class Mesh(NamedTuple):
    """Cells and nodes, the same for all simulations.

    A plane of nodes takes ``plane`` numbers of a component, a component ``component`` numbers, a simulation (or sixteen
    variations) three components for displacements and three for velocities; nodes begin at ``front``. Of its planes an
    item touches the numbers ``item_from`` to ``item_to``; each sixteen of a plane has a list of those that touch it.
    """

    unit: int
    row: int
    plane: int
    front: int
    component: int
    planes: int
    patch: int
    chambers: int
    item_plane: np.ndarray
    item_x: np.ndarray
    item_begin: np.ndarray
    item_from: np.ndarray
    item_to: np.ndarray
    block_at: np.ndarray
    block_y: np.ndarray
    block_z: np.ndarray
    gas_begin: np.ndarray
    gas_chamber: np.ndarray
    item_gas: np.ndarray
    X: np.ndarray
    Y: np.ndarray
    Z: np.ndarray
    near_begin: np.ndarray
    near_item: np.ndarray
    near_slot: np.ndarray
    places: np.ndarray
    own: np.ndarray
    wall_begin: np.ndarray
    wall_at: np.ndarray
    wall_value: np.ndarray
    wall_place: np.ndarray
    wall_axis: np.ndarray
    wall_area: np.ndarray
    wall_chamber: np.ndarray


class Case(NamedTuple):
    """What differs between simulations, and what acts over time; the last axis has sixteen lanes, or nodes."""

    dt: float
    groups: int
    elements: int
    history: int
    flags: tuple[bool, bool, bool, bool, bool]
    numbers: np.ndarray
    attached: np.ndarray
    gas: np.ndarray
    maxwell: np.ndarray
    softening: np.ndarray
    inverse_mass: np.ndarray
    moves: np.ndarray
    drag_factor: np.ndarray
    reach: np.ndarray
    air: np.ndarray
    pressure: np.ndarray
    gravity: np.ndarray
    share: np.ndarray
    share_there: np.ndarray
    force: np.ndarray
    force_start: np.ndarray
    tie_share: np.ndarray
    tie_stiffness: np.ndarray
    chains: np.ndarray
    chain_steps: int
    quadratic: np.ndarray
    plane_numbers: np.ndarray
    plane_stick: np.ndarray
    plane_elastic: np.ndarray
    keeps: bool
    area: np.ndarray
    far: np.ndarray
    touches: np.ndarray
    spacing: float


class Work(NamedTuple):
    """States, and what threads hand each other.

    Of a sample, ``seen`` holds those sixteens of numbers of a component that ``seen_place`` has a place for.
    """

    states: np.ndarray
    histories: np.ndarray
    pushed: np.ndarray
    volumes: np.ndarray
    seen: np.ndarray
    seen_at: np.ndarray
    seen_place: np.ndarray
    seen_width: int
    forces: np.ndarray
    areas: np.ndarray
    swept: np.ndarray
    by_plane: np.ndarray
    tension: np.ndarray
    beads: np.ndarray
    collapsed: np.ndarray
    sync: np.ndarray
    scratch: np.ndarray
    contact: SelfContact


@law
def clear(mesh, item, a, at):
    """Fill with zeros what an item touches of its three planes, the three components of each."""
    zero = 0 * load(mesh.own, 0)
    for column in range(at, at + 9 * mesh.patch, mesh.patch):
        for n in range(column + mesh.item_from[item], column + mesh.item_to[item], 16):
            store(a, n, zero)


@law
def clear_sums(mesh, work, g, item):
    """Empty the sums of an item."""
    one = g * len(mesh.item_plane) + item
    clear(mesh, item, work.forces, 9 * one * mesh.patch)
    for c in range(mesh.chambers):
        if mesh.item_gas[item, c]:
            clear(mesh, item, work.areas, 9 * (one * mesh.chambers + c) * mesh.patch)
            store(work.swept, 16 * (one * mesh.chambers + c), 0 * load(mesh.own, 0))


# What follows is rare, and not part of the loop over blocks: with it inlined that takes half as long again.
@part
def gas_forward(mesh, case, work, g, item, b, G, rates, room):
    """Area vectors and volume that a block adds to its chambers; whether any gas collapsed."""
    size, collapsed = 9 * mesh.patch, False
    for pair in range(mesh.gas_begin[b], mesh.gas_begin[b + 1]):
        one = (g * len(mesh.item_plane) + item) * mesh.chambers + mesh.gas_chamber[pair]
        base = (g * len(mesh.gas_chamber) + pair) * 128
        swept = load(work.swept, 16 * one)
        for k in range(8):
            cof, ratio, gone = enclosed(G, 144 * k, case.gas, base + 16 * k)
            keep(rates, 1152 + 144 * k, cof, load(case.gas, base + 16 * k))
            swept = swept + ratio
            collapsed = collapsed or gone
        store(work.swept, 16 * one, swept)
        scatter(mesh, b, mesh.item_x[item], work.areas, one * size, room, rates[1152:])
    return collapsed


@part
def springs_forward(mesh, case, work, g, item, b, corner, rates):
    """Forces of the springs of a block."""
    x, out = mesh.item_x[item], (g * len(mesh.item_plane) + item) * 9 * mesh.patch
    for k in range(8):
        u = value(mesh, b, x, work.states, corner, k)
        at = (g * len(mesh.block_at) + b) * 128 * ATTACHED + 16 * ATTACHED * k
        w0, w1, w2 = stretch(u, case.attached, at)
        spring = load(case.attached, at)
        store(rates, 1152 + 48 * k, -spring * w0)
        store(rates, 1152 + 48 * k + 16, -spring * w1)
        store(rates, 1152 + 48 * k + 32, -spring * w2)
    hand_on(mesh, b, x, work.forces, out, rates[1152:])


@part
def points_forward(mesh, case, work, g, item, past, future, state, room, G, rates):
    """Forces of an item on the nodes of its planes; whether any solid or gas collapsed."""
    items = len(mesh.item_plane)
    size = 9 * mesh.patch
    out = (g * items + item) * size
    forces = work.forces
    clear_sums(mesh, work, g, item)
    corner = state + mesh.front + mesh.item_plane[item] * mesh.plane
    x, collapsed = mesh.item_x[item], False
    blocks, each = len(mesh.block_at), 16 * case.history
    d = work.states
    for b in range(mesh.item_begin[item], mesh.item_begin[item + 1]):
        gather(mesh, b, x, d, corner, room, G)
        if case.flags[2]:
            gather(mesh, b, x, d, corner + 3 * mesh.component, room, rates)
        if mesh.gas_begin[b] < mesh.gas_begin[b + 1]:
            collapsed = gas_forward(mesh, case, work, g, item, b, G, rates, room) or collapsed
        n = (g * blocks + b) * 128 * NUMBERS
        h = (g * blocks + b) * 8 * each
        m, s = g * 16 * MAXWELL * case.elements, case.softening[32 * g :]
        for k in range(8):
            gone = point(
                G, rates, 144 * k, case.numbers, n + 16 * NUMBERS * k, work.histories, past + h + each * k,
                work.histories, future + h + each * k, case.elements, case.maxwell, m, case.flags, s,
            )  # fmt: skip
            collapsed = collapsed or gone
        if case.flags[4]:
            springs_forward(mesh, case, work, g, item, b, corner, rates)
        scatter(mesh, b, x, forces, out, room, G)
    if mesh.wall_begin[item] < mesh.wall_begin[item + 1]:
        walls_forward(mesh, case, work, g, item, corner)
    return collapsed


@fast
def march(mesh, case, work, rank, threads, begin, steps, ring, history_ring, stop_where_collapsed):
    """A thread's share of the substeps from ``begin`` on, up to where pairs are to be listed; how many were done."""
    items = len(mesh.item_plane)
    blocks = len(mesh.block_at)
    tasks, planes = case.groups * items, case.groups * mesh.planes
    own = work.scratch[rank * SCRATCH : (rank + 1) * SCRATCH]
    room, G, rates = own[:ROOM], own[ROOM : ROOM + 1152], own[ROOM + 1152 :]
    state_size = case.groups * 6 * mesh.component
    history_size = case.groups * blocks * 128 * case.history
    for t in range(begin, steps):
        now, then = (t % ring) * state_size, ((t + 1) % ring) * state_size
        past, future = (t % history_ring) * history_size, ((t + 1) % history_ring) * history_size
        for task in range(tasks * rank // threads, tasks * (rank + 1) // threads):
            g, item = task // items, task % items
            if points_forward(mesh, case, work, g, item, past, future, now + g * 6 * mesh.component, room, G, rates):
                work.collapsed[8 * rank] = min(work.collapsed[8 * rank], t)
        if rank == 0 and case.tie_stiffness.size:
            for g in range(case.groups):
                ties_forward(mesh, case, work, g, now + g * 6 * mesh.component, t)
        for g in range(rank, case.groups, threads):
            if work.contact.actives[g] > 0:
                contact_forward(mesh, work.contact, work.states, g, now + g * 6 * mesh.component)
        meet(work.sync, threads)
        if stop_where_collapsed:
            for other in range(threads):
                if look(work.collapsed, 8 * other) <= t:
                    return t
        for task in range(planes * rank // threads, planes * (rank + 1) // threads):
            if advance(mesh, case, work, task // mesh.planes, task % mesh.planes, t, ring, now, then):
                work.contact.moved[8 * rank] = 1
        meet(work.sync, threads)
        if work.contact.count > 0:
            for other in range(threads):
                if look(work.contact.moved, 8 * other) > 0:
                    return t + 1
    return steps
