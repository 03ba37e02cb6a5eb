"""What the nodes of a plane do in lanes: sum forces, move, meet planes."""

from __future__ import annotations

from torchsoro.simulation.kernels.lane_contact import meets, store_vector, vector
from torchsoro.simulation.kernels.lane_selfcontact import repelled, strayed
from torchsoro.simulation.kernels.lanes import law, load, part, select, store, total
from torchsoro.simulation.kernels.laws_lanes import laws

quadratic_drag = laws.quadratic_drag

STIFFNESS, REFERENCE = 0, 1  # numbers of a chamber: mean air stiffness, reference volume


@law
def chamber_pressure(supply, stiffness, volume, reference):
    """p_act - k (V/V0 - 1)."""
    return supply - stiffness * (volume / reference - 1)


@law
def pressure_of(case, work, chamber, step):
    """Pressure of a chamber in a substep whose volume is kept, by the places of its numbers and of the substep's."""
    stiffness, reference = load(case.air, 2 * chamber), load(case.air, 2 * chamber + 16)
    return chamber_pressure(load(case.pressure, step), stiffness, load(work.volumes, step), reference)


@law
def sum_items(values, mesh, first, p, at):
    """The vector at a place of plane p, summed over the items that hand anything to it."""
    zero = load(values, first + at) * 0
    f0, f1, f2 = zero, zero, zero
    place = (p * mesh.plane + at) // 16
    for e in range(mesh.near_begin[place], mesh.near_begin[place + 1]):
        o = first + (9 * mesh.near_item[e] + 3 * mesh.near_slot[e]) * mesh.patch + at
        f0, f1, f2 = f0 + load(values, o), f1 + load(values, o + mesh.patch), f2 + load(values, o + 2 * mesh.patch)
    return f0, f1, f2


@law
def sum_chamber(values, mesh, g, c):
    """A sum over the items of a chamber; over the lanes, too, where these are cells."""
    items = len(mesh.item_plane)
    found = load(values, 0) * 0
    for item in range(items):
        if mesh.item_gas[item, c]:
            found = found + load(values, 16 * ((g * items + item) * mesh.chambers + c))
    if mesh.unit == 1:
        found = found * 0 + total(found)
    return found


@law
def outer_force(mesh, case, work, found, g, p, c, at, t):
    """Component c of the internal force on the nodes at a place of plane p, with group forces taken off."""
    i = mesh.front + p * mesh.plane + at
    for k in range(case.share.shape[0]):
        start = case.force_start[k]
        # Forces that begin at a step have one row; others one for each step.
        if start <= t and case.share_there[k, i // 16]:
            row = t if start < 0 else 0
            force = load(case.force, 16 * (3 * ((row * case.groups + g) * case.share.shape[0] + k) + c))
            found = found - load(case.share[k], i) * force
    return found + tied(mesh, case, work, g, c, i)


@law
def tied(mesh, case, work, g, c, i):
    """Component c of what springs to the mean displacement of some nodes hand to these: shares of ``tension``."""
    ties = case.tie_stiffness.size // (16 * case.groups)
    found = 0 * load(mesh.own, 0)
    for tie in range(g * ties, (g + 1) * ties):
        found = found + load(case.tie_share, tie * mesh.component + i) * load(work.tension, 16 * (3 * tie + c))
    return found


@law
def gravity_row(case, g, t):
    """Where gravity of a substep begins; constant gravity has one row."""
    return 48 * (t * case.groups + g) if case.gravity.size > 48 * case.groups else 48 * g


@law
def pressed(mesh, work, g, p, at, f):
    """A vector at a place of plane p, and on it each chamber's number in ``by_plane`` times its area vector."""
    items = len(mesh.item_plane)
    f0, f1, f2 = f
    place = (p * mesh.plane + at) // 16
    for e in range(mesh.near_begin[place], mesh.near_begin[place + 1]):
        item = mesh.near_item[e]
        for k in range(mesh.chambers):
            if mesh.item_gas[item, k]:
                one = load(work.by_plane, 16 * ((g * mesh.planes + p) * mesh.chambers + k))
                o = (9 * ((g * items + item) * mesh.chambers + k) + 3 * mesh.near_slot[e]) * mesh.patch + at
                f0 = f0 + one * load(work.areas, o)
                f1 = f1 + one * load(work.areas, o + mesh.patch)
                f2 = f2 + one * load(work.areas, o + 2 * mesh.patch)
    return f0, f1, f2


@law
def slow(mesh, case, g, i, light, u0, u1, u2):
    """Velocity after quadratic drag, whose numbers are by node and axis."""
    q, sink = vector(case.quadratic, 3 * g * mesh.component + i, mesh.component), case.dt * light
    return quadratic_drag(u0, sink * q[0]), quadratic_drag(u1, sink * q[1]), quadratic_drag(u2, sink * q[2])


@part
def advance(mesh, case, work, g, p, t, ring, now, then):
    """Move the nodes of plane p over substep t; whether any went too far for the list of pairs in contact."""
    dt, contact, far = case.dt, work.contact, False
    own = g * 6 * mesh.component
    d = work.states
    slot = t % (work.pushed.size // (case.groups * 3 * mesh.component)) if work.pushed.size else 0
    sample = work.seen_at[t + 1]
    for k in range(mesh.chambers):
        one, volume = (g * mesh.chambers + k) * 16, sum_chamber(work.swept, mesh, g, k)
        step = 16 * mesh.chambers * case.groups * t + one
        if p == 0:
            store(work.volumes, step if work.volumes.size > 16 * mesh.chambers * case.groups else one, volume)
        stiffness, reference = load(case.air, 2 * one), load(case.air, 2 * one + 16)
        pressure = chamber_pressure(load(case.pressure, step), stiffness, volume, reference)
        store(work.by_plane, 16 * ((g * mesh.planes + p) * mesh.chambers + k), -pressure)
    forces = g * len(mesh.item_plane) * 9 * mesh.patch
    for at in range(0, mesh.plane, 16):
        i = mesh.front + p * mesh.plane + at
        node = g * mesh.component + i
        free, light = load(case.moves, node), load(case.inverse_mass, node)
        left = load(case.drag_factor, node)
        f0, f1, f2 = sum_items(work.forces, mesh, forces, p, at)
        f0, f1, f2 = (
            outer_force(mesh, case, work, f0, g, p, 0, at, t),
            outer_force(mesh, case, work, f1, g, p, 1, at, t),
            outer_force(mesh, case, work, f2, g, p, 2, at, t),
        )
        f0, f1, f2 = pressed(mesh, work, g, p, at, (f0, f1, f2))
        if contact.actives[g] > 0:
            b0, b1, b2 = repelled(mesh, contact, g, i)
            f0, f1, f2 = f0 - b0, f1 - b1, f2 - b2
        a, b = now + own + i, then + own + i
        n = mesh.component
        d0, d1, d2 = load(d, a), load(d, a + n), load(d, a + 2 * n)
        v0, v1, v2 = load(d, a + 3 * n), load(d, a + 4 * n), load(d, a + 5 * n)
        pull = gravity_row(case, g, t)
        moves = free > 0
        u0 = v0 + dt * (load(case.gravity, pull) - light * f0)
        u1 = v1 + dt * (load(case.gravity, pull + 16) - light * f1)
        u2 = v2 + dt * (load(case.gravity, pull + 32) - light * f2)
        if work.pushed.size:
            store_vector(work.pushed, (slot * case.groups + g) * 3 * n + i, n, (u0, u1, u2))
        if case.quadratic.size:
            u0, u1, u2 = slow(mesh, case, g, i, light, u0, u1, u2)
        u0, u1, u2 = select(moves, left * u0, v0), select(moves, left * u1, v1), select(moves, left * u2, v2)
        planes = len(case.plane_stick)
        o0, o1, o2 = u0 * 0, u1 * 0, u2 * 0
        if planes > 0:
            w0, w1, w2, o0, o1, o2 = meets(mesh, case, d, now + own, g, i, planes, light, (u0, u1, u2))
            u0, u1, u2 = select(moves, w0, u0), select(moves, w1, u1), select(moves, w2, u2)
        d0 = select(moves, d0 + dt * (o0 + u0), d0)
        d1 = select(moves, d1 + dt * (o1 + u1), d1)
        d2 = select(moves, d2 + dt * (o2 + u2), d2)
        if contact.count > 0:
            far = strayed(mesh, contact, g, i, (d0, d1, d2)) or far
        store_vector(d, b, n, (d0, d1, d2))
        store_vector(d, b + 3 * n, n, (u0, u1, u2))
        if sample >= 0 and work.seen_place[i // 16] >= 0:
            width = work.seen_width
            o = (sample * case.groups + g) * 6 * width + 16 * work.seen_place[i // 16]
            store_vector(work.seen, o, width, (d0, d1, d2))
            store_vector(work.seen, o + 3 * width, width, (u0, u1, u2))
    return far
