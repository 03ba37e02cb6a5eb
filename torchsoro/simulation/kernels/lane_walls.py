"""Hollow chambers and springs to the mean place of some nodes, in lanes.

A hollow chamber is known by points of its walls. Pressure follows them, p dA = p t1 x t2 with the two tangents, and
the volume is one third of the sum of x . dA. Where lanes are cells, a wall point is dealt with by the first lane only.
"""

from __future__ import annotations

from torchsoro.simulation.kernels.lanes import fast, law, load, select, store, total


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


@fast
def walls_forward(mesh, case, work, g, item, corner):
    """Area vectors and volumes that the wall points of an item add to their chambers."""
    items, size, zero = len(mesh.item_plane), 9 * mesh.patch, 0 * load(mesh.own, 0)
    mine = load(mesh.own, 0) > 0
    for w in range(mesh.wall_begin[item], mesh.wall_begin[item + 1]):
        x0, x1, x2, a0, a1, a2, b0, b1, b2 = wall_point(mesh, w, work.states, corner)
        area = mesh.wall_area[w]
        n0, n1, n2 = area * (a1 * b2 - a2 * b1), area * (a2 * b0 - a0 * b2), area * (a0 * b1 - a1 * b0)
        one = (g * items + item) * mesh.chambers + mesh.wall_chamber[w]
        volume = select(mine, (x0 * n0 + x1 * n1 + x2 * n2) * (1 / 3), zero)
        store(work.swept, 16 * one, load(work.swept, 16 * one) + volume)
        n0, n1, n2 = select(mine, n0, zero), select(mine, n1, zero), select(mine, n2, zero)
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    share = mesh.wall_value[81 * w + 27 * i + 9 * j + 3 * k]
                    o = one * size + 3 * i * mesh.patch + mesh.wall_at[w] + j * mesh.row + k * mesh.unit
                    store(work.areas, o, load(work.areas, o) + share * n0)
                    o += mesh.patch
                    store(work.areas, o, load(work.areas, o) + share * n1)
                    o += mesh.patch
                    store(work.areas, o, load(work.areas, o) + share * n2)


@fast
def ties_forward(mesh, case, work, g, state):
    """Mean displacement of the nodes of each spring."""
    ties = case.tie_stiffness.size // (16 * case.groups)
    for tie in range(ties):
        for c in range(3):
            found = 0 * load(mesh.own, 0)
            shares = (g * ties + tie) * mesh.component
            for i in range(mesh.front, mesh.front + mesh.planes * mesh.plane, 16):
                found = found + load(case.tie_share, shares + i) * load(work.states, state + c * mesh.component + i)
            if mesh.unit == 1:
                found = found * 0 + total(found)
            store(work.stretch, 16 * ((g * ties + tie) * 3 + c), found)
