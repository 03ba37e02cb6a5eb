"""Sixteen variations of a body at a time: the total-Lagrangian substep with a lane for each variation.

A variation's number is the last, contiguous axis of every array, so that one instruction serves all sixteen. Nothing is
shared by two groups of lanes, so that groups run in threads that never wait for each other. Compiled by Numba, since
Taichi has no lanes on a CPU; it finds no gradients, which would not serve friction or adhesion either.

The body is a box of cells between planes at any distance, with quadratic B-splines that end with the body: faces are
where they are, and the outermost nodes lie on them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchsoro.simulation.kernels.simd_cells import clear, f32, fast, gather, remember, scatter, solid

LANES = 16
TOUCH = 1e-6  # m in front of a plane within which a node lies on it
SURFACE = 0.5  # stiffness of planes for a node, in its mass over the square of the step: what the step still bears
MARKED = 5 * 3 * LANES  # numbers of a marker: place, velocity, derivatives by the reference place


class Mesh(NamedTuple):
    """The body's shape; lengths in m.

    Attributes:
        corners: Lowest node of each cell [C].
        cells: Number of each cell along x, y, z [C, 3].
        weights: Of an axis' three nodes at a cell's two points [3, cells, 2, 3].
        slopes: The same, of the derivatives of the weights.
        stride_x: Between nodes along x.
        stride_y: Between nodes along y.
        held: Nodes that stay where they are, bool [n].
        places: Of nodes in the undeformed body [n, 3].
        surface: Nodes of the surface, which may meet planes [F].
        front: Area of the body that moves along x, y, z, as shares of nodes [n, 3].
        wall_begin: First entry of each point of the chambers' walls, and the end [W + 1].
        wall_node: Node of each entry [E].
        wall_value: Its weight and two slopes along the wall [E, 3].
        wall_place: Of wall points in the undeformed body [W, 3].
        wall_axis: Axis normal to the wall [W].
        wall_area: Area of the point, positive if the chamber is on the lower side [W].
        wall_chamber: Number of the chamber [W].
        mark_begin: First entry of each marker, and the end [M + 1].
        mark_node: Node of each entry [K].
        mark_value: Its weight and slopes by x, y, z [K, 4].
    """

    corners: np.ndarray
    cells: np.ndarray
    weights: np.ndarray
    slopes: np.ndarray
    stride_x: int
    stride_y: int
    held: np.ndarray
    places: np.ndarray
    surface: np.ndarray
    front: np.ndarray
    wall_begin: np.ndarray
    wall_node: np.ndarray
    wall_value: np.ndarray
    wall_place: np.ndarray
    wall_axis: np.ndarray
    wall_area: np.ndarray
    wall_chamber: np.ndarray
    mark_begin: np.ndarray
    mark_node: np.ndarray
    mark_value: np.ndarray


class Case(NamedTuple):
    """What differs between lanes, and what acts on them; SI units.

    Attributes:
        dt: Substep.
        steps: Of them.
        every: Substeps between two samples.
        own: Of each point, eight to a cell with z fastest, shear and bulk modulus times volume, and 0 [P * 48].
        series: Of Maxwell elements g, g b, a and b (1 - a) [E * 64], with a and b as in ``Prony.discrete``.
        law: Coefficients a and b of ``stress.stiffening``, depth and range of softening [64].
        stiffens: Whether any of the former is not zero.
        softens: Whether any depth is not zero.
        weight: One over the mass of nodes [n, 16]; 0 for those without.
        left: What drag leaves of a node's velocity in a substep [n, 16].
        gravity: [3, 16].
        fluid: Half the density of the fluid around times its drag coefficient [16].
        place: Displacement of nodes at the start [n, 3, 16].
        velocity: Of nodes at the start [n, 3, 16].
        supply: Pressure of chambers at each substep [steps, chambers, 16].
        air: Stiffness of the air in chambers [chambers, 16].
        volume: Of the undeformed chambers [chambers].
        push_begin: First entry of each force, and the end [G + 1].
        push_node: Node of each entry.
        push_share: Its share of the force.
        push: Forces [G, 3, 16].
        push_start: Substep at which they begin [G].
        spring_node: Nodes of springs [R].
        spring_share: Of each, for each lane [R, 16].
        spring_number: Number of the spring [R].
        springs: Stiffness of springs [Q, 16].
        normals: Of planes [A, 3].
        stick: Whether planes hold what is pressed on them [A].
        offset: Of planes along their normals [A, 16].
        friction: Coulomb coefficients [A, 16].
        adhesion: Tractions that pull towards planes [A, 16].
        reach: So far [A, 16].
        area: Of nodes that face planes [A, n].
    """

    dt: float
    steps: int
    every: int
    own: np.ndarray
    series: np.ndarray
    law: np.ndarray
    stiffens: bool
    softens: bool
    weight: np.ndarray
    left: np.ndarray
    gravity: np.ndarray
    fluid: np.ndarray
    place: np.ndarray
    velocity: np.ndarray
    supply: np.ndarray
    air: np.ndarray
    volume: np.ndarray
    push_begin: np.ndarray
    push_node: np.ndarray
    push_share: np.ndarray
    push: np.ndarray
    push_start: np.ndarray
    spring_node: np.ndarray
    spring_share: np.ndarray
    spring_number: np.ndarray
    springs: np.ndarray
    normals: np.ndarray
    stick: np.ndarray
    offset: np.ndarray
    friction: np.ndarray
    adhesion: np.ndarray
    reach: np.ndarray
    area: np.ndarray


@fast
def _walls(mesh, case, t, d, f, swept, normals, pressure, room):
    """Pressure on the walls of the chambers, following their motion: p dA = p t1 x t2."""
    chambers = swept.shape[0] // LANES
    clear(swept)
    place, one, two = room[:48], room[48:96], room[96:144]
    for w in range(len(mesh.wall_axis)):
        axis = mesh.wall_axis[w]
        for c in range(3):
            for lane in range(16):
                place[16 * c + lane] = mesh.wall_place[w, c]
                one[16 * c + lane] = f32(c == (axis + 1) % 3)
                two[16 * c + lane] = f32(c == (axis + 2) % 3)
        for k in range(mesh.wall_begin[w], mesh.wall_begin[w + 1]):
            at = 48 * mesh.wall_node[k]
            x, n, s, r = d[at : at + 48], mesh.wall_value[k, 0], mesh.wall_value[k, 1], mesh.wall_value[k, 2]
            for q in range(48):
                place[q] += n * x[q]
                one[q] += s * x[q]
                two[q] += r * x[q]
        area = mesh.wall_area[w]
        out = normals[48 * w : 48 * w + 48]
        volume = swept[16 * mesh.wall_chamber[w] : 16 * mesh.wall_chamber[w] + 16]
        for lane in range(16):
            n0 = area * (one[16 + lane] * two[32 + lane] - one[32 + lane] * two[16 + lane])
            n1 = area * (one[32 + lane] * two[lane] - one[lane] * two[32 + lane])
            n2 = area * (one[lane] * two[16 + lane] - one[16 + lane] * two[lane])
            out[lane], out[16 + lane], out[32 + lane] = n0, n1, n2
            volume[lane] += (place[lane] * n0 + place[16 + lane] * n1 + place[32 + lane] * n2) / f32(3)
    for c in range(chambers):
        for lane in range(16):
            grown = swept[16 * c + lane] / case.volume[c] - f32(1)
            pressure[16 * c + lane] = case.supply[t, c, lane] - case.air[c, lane] * grown
    for w in range(len(mesh.wall_axis)):
        n = normals[48 * w : 48 * w + 48]
        p = pressure[16 * mesh.wall_chamber[w] : 16 * mesh.wall_chamber[w] + 16]
        for k in range(mesh.wall_begin[w], mesh.wall_begin[w + 1]):
            at, share = 48 * mesh.wall_node[k], mesh.wall_value[k, 0]
            o = f[at : at + 48]
            for c in range(3):
                for lane in range(16):
                    o[16 * c + lane] -= share * p[lane] * n[16 * c + lane]


@fast
def _attached(case, t, d, f, push, stretch):
    """Dead forces and springs."""
    for g in range(len(case.push_begin) - 1):
        if t < case.push_start[g]:
            continue
        for c in range(3):
            for lane in range(16):
                push[16 * c + lane] = case.push[g, c, lane]
        for k in range(case.push_begin[g], case.push_begin[g + 1]):
            at, share = 48 * case.push_node[k], case.push_share[k]
            o = f[at : at + 48]
            for q in range(48):
                o[q] -= share * push[q]
    if len(case.springs) > 0:
        clear(stretch)
        for k in range(len(case.spring_node)):
            x = d[48 * case.spring_node[k] : 48 * case.spring_node[k] + 48]
            number = case.spring_number[k]
            for c in range(3):
                for lane in range(16):
                    stretch[48 * number + 16 * c + lane] += case.spring_share[k, lane] * x[16 * c + lane]
        for k in range(len(case.spring_node)):
            o = f[48 * case.spring_node[k] : 48 * case.spring_node[k] + 48]
            number = case.spring_number[k]
            for c in range(3):
                for lane in range(16):
                    pull = case.springs[number, lane] * stretch[48 * number + 16 * c + lane]
                    o[16 * c + lane] += case.spring_share[k, lane] * pull


@fast
def _meet(mesh, case, d, v):
    """Nodes of the surface against the planes: what is behind a plane is pushed out, as by a stiff spring.

    A node that came to rest at once would take its share of a blow's energy away, the more the larger the cells.
    """
    dt = f32(case.dt)
    push = f32(SURFACE) / dt
    for a in range(len(case.stick)):
        n0, n1, n2 = case.normals[a, 0], case.normals[a, 1], case.normals[a, 2]
        for node in mesh.surface:
            X = mesh.places[node, 0] * n0 + mesh.places[node, 1] * n1 + mesh.places[node, 2] * n2
            x, u = d[48 * node : 48 * node + 48], v[48 * node : 48 * node + 48]
            for lane in range(16):
                gap = X + x[lane] * n0 + x[16 + lane] * n1 + x[32 + lane] * n2 - case.offset[a, lane]
                hold = case.adhesion[a, lane] * case.area[a, node] * dt * case.weight[node, lane]
                if gap < f32(TOUCH):
                    u0, u1, u2 = u[lane], u[16 + lane], u[32 + lane]
                    normal = u0 * n0 + u1 * n1 + u2 * n2
                    # What the plane gives, and what adhesion takes.
                    pressed = max(-gap, f32(0)) * push
                    held = max(min(normal + pressed, hold), f32(0))
                    t0, t1, t2 = u0 - normal * n0, u1 - normal * n1, u2 - normal * n2
                    rest = f32(0)
                    if not case.stick[a]:
                        speed = np.sqrt(t0 * t0 + t1 * t1 + t2 * t2)
                        lost = case.friction[a, lane] * (pressed + hold)
                        if speed > lost:
                            rest = f32(1) - lost / speed
                    elif pressed + held <= 0:
                        rest = f32(1)
                    normal += pressed - held
                    u[lane] = t0 * rest + normal * n0
                    u[16 + lane] = t1 * rest + normal * n1
                    u[32 + lane] = t2 * rest + normal * n2
                elif gap < case.reach[a, lane]:
                    u[lane] -= hold * n0
                    u[16 + lane] -= hold * n1
                    u[32 + lane] -= hold * n2


@fast
def _look(mesh, d, v, out):
    """Markers [M * 240]: place, velocity, derivatives of the displacement by x, y, z."""
    clear(out)
    for m in range(len(mesh.mark_begin) - 1):
        o = out[MARKED * m : MARKED * m + MARKED]
        for k in range(mesh.mark_begin[m], mesh.mark_begin[m + 1]):
            at = 48 * mesh.mark_node[k]
            x, u = d[at : at + 48], v[at : at + 48]
            n, s0, s1, s2 = mesh.mark_value[k, 0], mesh.mark_value[k, 1], mesh.mark_value[k, 2], mesh.mark_value[k, 3]
            for q in range(48):
                o[q] += n * x[q]
                o[48 + q] += n * u[q]
                o[96 + q] += s0 * x[q]
                o[144 + q] += s1 * x[q]
                o[192 + q] += s2 * x[q]


def march(mesh, case, out):
    """Simulate sixteen variations.

    Args:
        mesh: The body.
        case: The variations.
        out: Filled with samples [samples, markers * 240], the first of the undeformed body.
    """
    chambers, walls = case.supply.shape[1], len(mesh.wall_axis)
    moves = ~np.asarray(mesh.held)[:, None, None]
    d, v = (np.ascontiguousarray(a * moves).reshape(-1) for a in (case.place, case.velocity))
    history = np.zeros(2 * (len(case.series) // 64) * len(case.own), f32)
    sizes = (
        len(d), 1728, 1728, 1152, 1152, 96, 96,
        16 * chambers, 48 * walls, 16 * chambers, 144, 48, 48 * len(case.springs),
    )  # fmt: skip
    _march(mesh, case, out, d, v, case.own.copy(), history, *(np.zeros(n, f32) for n in sizes))


@fast
def _march(mesh, case, out, d, v, own, Z, f, X, Y, G, P, T, Q, swept, normals, pressure, room, push, stretch):
    """The steps; what follows ``out`` changes, and what follows ``Z`` is for their own use."""
    count, elements, chambers = len(mesh.held), len(case.series) // 64, case.supply.shape[1]
    dt = f32(case.dt)
    _look(mesh, d, v, out[0])
    for t in range(case.steps):
        clear(f)
        for cell in range(len(mesh.corners)):
            corner = mesh.corners[cell]
            Wx, Sx = mesh.weights[0, mesh.cells[cell, 0]], mesh.slopes[0, mesh.cells[cell, 0]]
            Wy, Sy = mesh.weights[1, mesh.cells[cell, 1]], mesh.slopes[1, mesh.cells[cell, 1]]
            Wz, Sz = mesh.weights[2, mesh.cells[cell, 2]], mesh.slopes[2, mesh.cells[cell, 2]]
            gather(d, corner, mesh.stride_x, mesh.stride_y, Wx, Wy, Wz, Sx, Sy, Sz, X, Y, G)
            for k in range(8):
                p = 8 * cell + k
                if elements > 0:
                    history = Z[96 * elements * p : 96 * elements * (p + 1)]
                    remember(144 * k, G, T, Q, history, case.series, case.law, case.stiffens, elements)
                solid(144 * k, G, P, Q, own[48 * p : 48 * p + 48], case.law, case.stiffens, case.softens)
            scatter(f, corner, mesh.stride_x, mesh.stride_y, Wx, Wy, Wz, Sx, Sy, Sz, X, P)
        if chambers > 0:
            _walls(mesh, case, t, d, f, swept, normals, pressure, room)
        _attached(case, t, d, f, push, stretch)
        for i in range(count):
            if not mesh.held[i]:
                u, force = v[48 * i : 48 * i + 48], f[48 * i : 48 * i + 48]
                weight, left = case.weight[i], case.left[i]
                for c in range(3):
                    g, front = case.gravity[c], dt * mesh.front[i, c]
                    for lane in range(16):
                        moved = u[16 * c + lane] + dt * (g[lane] - weight[lane] * force[16 * c + lane])
                        slowed = f32(1) + front * case.fluid[lane] * weight[lane] * abs(moved)
                        u[16 * c + lane] = left[lane] * moved / slowed
        if len(case.stick) > 0:
            _meet(mesh, case, d, v)
        for q in range(48 * count):
            d[q] += dt * v[q]
        if (t + 1) % case.every == 0:
            _look(mesh, d, v, out[(t + 1) // case.every])
