"""The substep in lanes, backwards: points, nodes, and the threads that share them.

The adjoint state lies in one buffer that each pass overwrites in place. A pass over nodes finishes the sums over
substep t + 1 and begins substep t. What ``Sums`` collects is by point or by node, so that no two threads meet.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchsoro.simulation.kernels.lane_contact import add_vector, meets_adjoint, spread, store_vector, vector
from torchsoro.simulation.kernels.lane_march import SCRATCH
from torchsoro.simulation.kernels.lane_nodes import gravity_row, pressed, slow, sum_chamber, sum_items, tied
from torchsoro.simulation.kernels.lane_points import ROOM
from torchsoro.simulation.kernels.lane_points_adjoint import add, gas_end, points_backward
from torchsoro.simulation.kernels.lane_selfcontact import contact_backward, repelled, strayed
from torchsoro.simulation.kernels.lane_threads import look, meet
from torchsoro.simulation.kernels.lane_walls import ties_backward
from torchsoro.simulation.kernels.lanes import fast, load, part, select, store
from torchsoro.simulation.kernels.laws_lanes import laws

quadratic_drag_adjoint = laws.quadratic_drag_adjoint


class Sums(NamedTuple):
    """Adjoint states and sums of gradients."""

    bar: np.ndarray
    history_bar: np.ndarray
    seen_bar: np.ndarray
    pulls: np.ndarray
    surfaces: np.ndarray
    rates: np.ndarray
    ratios: np.ndarray
    volume_bar: np.ndarray
    numbers: np.ndarray
    attached: np.ndarray
    gas: np.ndarray
    maxwell: np.ndarray
    softening: np.ndarray
    mass: np.ndarray
    drag_factor: np.ndarray
    quadratic: np.ndarray
    ties: np.ndarray
    reach: np.ndarray
    planes: np.ndarray
    air: np.ndarray
    pressure: np.ndarray


@part
def retreat(mesh, case, work, sums, g, p, t, steps):
    """Finish the gradients by the nodes of plane p after t + 1 substeps, and go back to the forces in substep t.

    Returns whether any node is too far away for the list of pairs in contact.
    """
    contact, far = work.contact, False
    n, own, dt = mesh.component, g * 6 * mesh.component, case.dt
    first = g * len(mesh.item_plane) * 9 * mesh.patch
    finishes, planes = t + 1 < steps, len(case.plane_stick)
    if finishes:
        for k in range(mesh.chambers):
            one = 16 * (g * mesh.chambers + k)
            step = 16 * ((t + 1) * case.groups + g) * mesh.chambers + 16 * k
            p_bar = sum_chamber(work.swept, mesh, g, k)
            stiffness, reference = load(case.air, 2 * one), load(case.air, 2 * one + 16)
            volume_bar = -p_bar * stiffness / reference
            store(work.by_plane, 16 * ((g * mesh.planes + p) * mesh.chambers + k), volume_bar)
            if p == 0:
                growth = load(work.volumes, step) / reference
                store(sums.volume_bar, one, volume_bar)
                store(sums.pressure, step, p_bar)
                add(sums.air, 2 * one, -p_bar * (growth - 1))
                add(sums.air, 2 * one + 16, -volume_bar * growth)
    sample = work.seen_at[t + 1]
    for at in range(0, mesh.plane, 16):
        i = mesh.front + p * mesh.plane + at
        node, a = g * n + i, own + i
        d0, d1, d2 = load(sums.bar, a), load(sums.bar, a + n), load(sums.bar, a + 2 * n)
        v0, v1, v2 = load(sums.bar, a + 3 * n), load(sums.bar, a + 4 * n), load(sums.bar, a + 5 * n)
        if finishes:
            f0, f1, f2 = pressed(mesh, work, g, p, at, sum_items(work.forces, mesh, first, p, at))
            d0, d1, d2 = d0 + f0, d1 + f1, d2 + f2
            if contact.actives[g] > 0:
                f0, f1, f2 = repelled(mesh, contact, g, i)
                d0, d1, d2 = d0 + f0, d1 + f1, d2 + f2
            if case.tie_stiffness.size:
                d0, d1, d2 = (
                    d0 + tied(mesh, case, work, g, 0, i),
                    d1 + tied(mesh, case, work, g, 1, i),
                    d2 + tied(mesh, case, work, g, 2, i),
                )
            if planes > 0:
                after = ((t + 1) * case.groups + g) * 6 * n
                s0, s1, s2 = spread(mesh, case, work.states, after, sums.surfaces, (t + 1) % 2, g, i)
                d0, d1, d2 = d0 + s0, d1 + s1, d2 + s2
            if case.flags[2]:
                f0, f1, f2 = sum_items(sums.rates, mesh, first, p, at)
                v0, v1, v2 = v0 + f0, v1 + f1, v2 + f2
        if sample >= 0:
            o = (sample * case.groups + g) * 6 * n + i
            d0, d1, d2 = (
                d0 + load(sums.seen_bar, o),
                d1 + load(sums.seen_bar, o + n),
                d2 + load(sums.seen_bar, o + 2 * n),
            )
            o += 3 * n
            v0, v1, v2 = (
                v0 + load(sums.seen_bar, o),
                v1 + load(sums.seen_bar, o + n),
                v2 + load(sums.seen_bar, o + 2 * n),
            )
        store_vector(sums.bar, a, n, (d0, d1, d2))
        if t >= 0:
            moves, light = load(case.moves, node) > 0, load(case.inverse_mass, node)
            left, zero = load(case.drag_factor, node), 0 * d0
            state = (t * case.groups + g) * 6 * n
            if contact.count > 0:
                far = strayed(mesh, contact, g, i, vector(work.states, state + i, n)) or far
            b0, b1, b2 = v0 + dt * d0, v1 + dt * d1, v2 + dt * d2
            w = vector(work.states, state + 3 * n + i, n)
            # Velocity before drag, after the quadratic one, and before planes.
            if work.pushed.size:
                p0, p1, p2 = vector(work.pushed, (t * case.groups + g) * 3 * n + i, n)
            else:
                after, whole = vector(work.states, ((t + 1) * case.groups + g) * 6 * n + 3 * n + i, n), 1 / left
                p0, p1, p2 = whole * after[0], whole * after[1], whole * after[2]
            s0, s1, s2 = p0, p1, p2
            if case.quadratic.size:
                s0, s1, s2 = slow(mesh, case, g, i, light, p0, p1, p2)
            mass_bar = zero
            if planes > 0:
                u, by_way = (left * s0, left * s1, left * s2), (dt * d0, dt * d1, dt * d2)
                b0, b1, b2, c0, c1, c2, mass_bar = meets_adjoint(
                    mesh, case, work.states, state, sums, g, i, light, moves, u, (b0, b1, b2), by_way
                )
                s = (((t % 2) * case.groups + g) * 3) * n + i
                store_vector(
                    sums.surfaces, s, n, (select(moves, c0, zero), select(moves, c1, zero), select(moves, c2, zero))
                )
            pull = gravity_row(case, g, t)
            g0, g1, g2 = load(case.gravity, pull), load(case.gravity, pull + 16), load(case.gravity, pull + 32)
            add(sums.drag_factor, node, select(moves, s0 * b0 + s1 * b1 + s2 * b2, zero))
            b0, b1, b2 = left * b0, left * b1, left * b2
            if case.quadratic.size:
                q, sink = 3 * g * n + i, select(moves, dt * light, zero)
                q0, q1, q2 = vector(case.quadratic, q, n)
                b0, k0 = quadratic_drag_adjoint(p0, sink * q0, b0)
                b1, k1 = quadratic_drag_adjoint(p1, sink * q1, b1)
                b2, k2 = quadratic_drag_adjoint(p2, sink * q2, b2)
                add_vector(sums.quadratic, q, n, (sink * k0, sink * k1, sink * k2))
                mass_bar = mass_bar - sink * (q0 * k0 + q1 * k1 + q2 * k2) * light
            pushed = (p0 - w[0] - dt * g0) * b0 + (p1 - w[1] - dt * g1) * b1 + (p2 - w[2] - dt * g2) * b2
            add(sums.mass, node, select(moves, mass_bar - light * pushed, zero))
            f, way = g * 3 * n + i, select(moves, dt * light, zero)
            f0, f1, f2 = way * b0, way * b1, way * b2
            store_vector(sums.pulls, f, n, (f0, f1, f2))
            v0, v1, v2 = select(moves, b0, v0), select(moves, b1, v1), select(moves, b2, v2)
            if sums.pulls.size > case.groups * 3 * n:
                store_vector(sums.pulls, f + (t + 1) * case.groups * 3 * n, n, (f0, f1, f2))
        store_vector(sums.bar, a + 3 * n, n, (v0, v1, v2))
    return far


@fast
def march_back(mesh, case, work, rank, threads, sums, begin, listed, steps):
    """A thread's share of all substeps, the last first, from substep ``begin`` on.

    Returns -2 at the end, or the substep that wants pairs to be listed and to begin with again, ``listed``.
    """
    items, blocks = len(mesh.item_plane), len(mesh.block_at)
    tasks, planes = case.groups * items, case.groups * mesh.planes
    own = work.scratch[rank * SCRATCH : (rank + 1) * SCRATCH]
    room, G, B = own[:ROOM], own[ROOM : ROOM + 1152], own[ROOM + 1152 : ROOM + 2304]
    rates = own[ROOM + 2304 :]
    state_size = case.groups * 6 * mesh.component
    history_size = case.groups * blocks * 128 * case.history
    for back in range(begin + 2):
        t = begin - back
        if not (listed and back == 0):
            for task in range(planes * rank // threads, planes * (rank + 1) // threads):
                if retreat(mesh, case, work, sums, task // mesh.planes, task % mesh.planes, t, steps):
                    work.contact.moved[8 * rank] = 1
            meet(work.sync, threads)
            if work.contact.count > 0:
                for other in range(threads):
                    if look(work.contact.moved, 8 * other) > 0:
                        return t
        for task in range(tasks * rank // threads, tasks * (rank + 1) // threads):
            g, item = task // items, task % items
            if t >= 0:
                state = t * state_size + g * 6 * mesh.component
                points_backward(
                    mesh, case, work, sums, g, item, t, t + 1 == steps, state, t * history_size, room, G, B, rates
                )
            else:
                gas_end(mesh, sums, g, item)
        if rank == 0 and case.tie_stiffness.size and t >= 0:
            for g in range(case.groups):
                ties_backward(mesh, case, work, sums, g, t * state_size + g * 6 * mesh.component)
        for g in range(rank, case.groups, threads):
            if work.contact.actives[g] > 0 and t >= 0:
                state = t * state_size + g * 6 * mesh.component
                contact_backward(mesh, work.contact, work.states, g, state, sums.pulls)
        meet(work.sync, threads)
    return -2
