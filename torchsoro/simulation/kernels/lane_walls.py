"""Hollow chambers and springs to the mean place of some nodes, in lanes.

A hollow chamber is known by points of its walls. Pressure follows them, p dA = p t1 x t2 with the two tangents, and
the volume is one third of the sum of x . dA. Where lanes are cells, a wall point is dealt with by the first lane only.
"""

from __future__ import annotations

from torchsoro.simulation.kernels.lane_chains import chain_forward
from torchsoro.simulation.kernels.lane_contact import dot, store_vector
from torchsoro.simulation.kernels.lane_nodes import pressure_of
from torchsoro.simulation.kernels.lanes import law, load, part, store, total


@law
def wall_point(mesh, w, field, at):
    """Place of a wall point, and its two tangents, from a nodal field of displacements."""
    axis, zero = mesh.wall_axis[w], 0 * load(mesh.own, 0)
    x0, x1, x2 = zero + mesh.wall_place[3 * w], zero + mesh.wall_place[3 * w + 1], zero + mesh.wall_place[3 * w + 2]
    a0, a1, a2 = zero + 1.0 * (axis == 2), zero + 1.0 * (axis == 0), zero + 1.0 * (axis == 1)
    b0, b1, b2 = zero + 1.0 * (axis == 1), zero + 1.0 * (axis == 2), zero + 1.0 * (axis == 0)
    for i in range(3):
        for j in range(3):
            for k in range(3):
                v = 81 * w + 27 * i + 9 * j + 3 * k
                o = at + mesh.wall_at[w] + i * mesh.plane + j * mesh.row + k * mesh.unit
                d0, d1, d2 = load(field, o), load(field, o + mesh.component), load(field, o + 2 * mesh.component)
                n, s, r = mesh.wall_value[v], mesh.wall_value[v + 1], mesh.wall_value[v + 2]
                x0, x1, x2 = x0 + n * d0, x1 + n * d1, x2 + n * d2
                a0, a1, a2 = a0 + s * d0, a1 + s * d1, a2 + s * d2
                b0, b1, b2 = b0 + r * d0, b1 + r * d1, b2 + r * d2
    return x0, x1, x2, a0, a1, a2, b0, b1, b2


@law
def hand_to_nodes(mesh, w, out, at, n, a, b):
    """Add to the nodes of a wall point what goes with its weights, and with the slopes along its two tangents.

    ``out`` is a patch of three planes from ``at`` on.
    """
    for i in range(3):
        for j in range(3):
            for k in range(3):
                v = 81 * w + 27 * i + 9 * j + 3 * k
                share, s, r = mesh.wall_value[v], mesh.wall_value[v + 1], mesh.wall_value[v + 2]
                o = at + 3 * i * mesh.patch + mesh.wall_at[w] + j * mesh.row + k * mesh.unit
                store(out, o, load(out, o) + (share * n[0] + (s * a[0] + r * b[0])))
                o += mesh.patch
                store(out, o, load(out, o) + (share * n[1] + (s * a[1] + r * b[1])))
                o += mesh.patch
                store(out, o, load(out, o) + (share * n[2] + (s * a[2] + r * b[2])))


@law
def crossed(scale, a, b):
    """A product of vectors times a number."""
    return scale * (a[1] * b[2] - a[2] * b[1]), scale * (a[2] * b[0] - a[0] * b[2]), scale * (a[0] * b[1] - a[1] * b[0])


@part
def walls_forward(mesh, case, work, g, item, corner):
    """Area vectors and volumes that the wall points of an item add to their chambers."""
    items, size, zero = len(mesh.item_plane), 9 * mesh.patch, 0 * load(mesh.own, 0)
    none = zero, zero, zero
    for w in range(mesh.wall_begin[item], mesh.wall_begin[item + 1]):
        x0, x1, x2, a0, a1, a2, b0, b1, b2 = wall_point(mesh, w, work.states, corner)
        n = crossed(mesh.wall_area[w] * load(mesh.own, 0), (a0, a1, a2), (b0, b1, b2))
        one = (g * items + item) * mesh.chambers + mesh.wall_chamber[w]
        store(work.swept, 16 * one, load(work.swept, 16 * one) + dot((x0, x1, x2), n) * (1 / 3))
        hand_to_nodes(mesh, w, work.areas, one * size, n, none, none)


@law
def wall_value(mesh, w, field, at):
    """A nodal vector field at a wall point."""
    u0, u1, u2 = 0 * load(mesh.own, 0), 0 * load(mesh.own, 0), 0 * load(mesh.own, 0)
    for i in range(3):
        for j in range(3):
            for k in range(3):
                share = mesh.wall_value[81 * w + 27 * i + 9 * j + 3 * k]
                o = at + mesh.wall_at[w] + i * mesh.plane + j * mesh.row + k * mesh.unit
                u0, u1 = u0 + share * load(field, o), u1 + share * load(field, o + mesh.component)
                u2 = u2 + share * load(field, o + 2 * mesh.component)
    return u0, u1, u2


@part
def walls_backward(mesh, case, work, sums, g, item, t, corner, force):
    """Through the area vectors of an item's wall points, at a pressure that is known.

    Leaves the gradient by the pressures in ``swept``, that of the volumes by the nodes in ``areas``.
    """
    items, size = len(mesh.item_plane), 9 * mesh.patch
    for w in range(mesh.wall_begin[item], mesh.wall_begin[item + 1]):
        chamber = mesh.wall_chamber[w]
        one = (g * items + item) * mesh.chambers + chamber
        step = 16 * ((t * case.groups + g) * mesh.chambers + chamber)
        pressure = pressure_of(case, work, 16 * (g * mesh.chambers + chamber), step)
        x0, x1, x2, a0, a1, a2, b0, b1, b2 = wall_point(mesh, w, work.states, corner)
        x, a, b = (x0, x1, x2), (a0, a1, a2), (b0, b1, b2)
        scale = mesh.wall_area[w] * load(mesh.own, 0)
        n, pull = crossed(scale, a, b), wall_value(mesh, w, sums.pulls, force)
        store(work.swept, 16 * one, load(work.swept, 16 * one) + dot(pull, n))
        third = scale * (1 / 3)
        by_place = n[0] * (1 / 3), n[1] * (1 / 3), n[2] * (1 / 3)
        hand_to_nodes(mesh, w, work.areas, one * size, by_place, crossed(third, b, x), crossed(third, x, a))
        scale = scale * pressure
        none = 0 * x0, 0 * x0, 0 * x0
        out = (g * items + item) * size
        hand_to_nodes(mesh, w, work.forces, out, none, crossed(scale, b, pull), crossed(scale, pull, a))


@law
def mean_of(mesh, case, shares, field, at):
    """Mean of a component of a nodal field over the nodes of a spring; over lanes, too, where these are cells."""
    found = 0 * load(mesh.own, 0)
    for i in range(mesh.front, mesh.front + mesh.planes * mesh.plane, 16):
        found = found + load(case.tie_share, shares + i) * load(field, at + i)
    if mesh.unit == 1:
        found = found * 0 + total(found)
    return found


@part
def ties_forward(mesh, case, work, g, state, t):
    """Force that each spring to the mean displacement of some nodes takes, and each chain there, in substep t."""
    ties = case.tie_stiffness.size // (16 * case.groups)
    for tie in range(g * ties, (g + 1) * ties):
        stiffness, shares = load(case.tie_stiffness, 16 * tie), tie * mesh.component
        m0 = mean_of(mesh, case, shares, work.states, state)
        m1 = mean_of(mesh, case, shares, work.states, state + mesh.component)
        m2 = mean_of(mesh, case, shares, work.states, state + 2 * mesh.component)
        store_vector(work.tension, 48 * tie, 16, (stiffness * m0, stiffness * m1, stiffness * m2))
        if case.chain_steps:
            chain_forward(mesh, case, work, g, tie, (m0, m1, m2), t)


@part
def ties_backward(mesh, case, work, sums, g, state):
    """Gradient by the mean displacements, left in ``tension``, and by the stiffnesses."""
    ties = case.tie_stiffness.size // (16 * case.groups)
    for tie in range(g * ties, (g + 1) * ties):
        shares = tie * mesh.component
        stiffness, found = load(case.tie_stiffness, 16 * tie), load(sums.ties, 16 * tie)
        for c in range(3):
            pull = mean_of(mesh, case, shares, sums.pulls, (3 * g + c) * mesh.component)
            mean = mean_of(mesh, case, shares, work.states, state + c * mesh.component)
            found = found - pull * mean
            store(work.tension, 16 * (3 * tie + c), -stiffness * pull)
        store(sums.ties, 16 * tie, found)
