"""Planes against the nodes, in lanes: the counterpart of ``surface``, with the same law, and the adjoint."""

from __future__ import annotations

from torchsoro.simulation.kernels.lanes import any_lane, law, load, magnitude, select, square_root, store
from torchsoro.simulation.kernels.laws_lanes import laws

NORMAL, OFFSET, FRICTION, ADHESION, REACH, AT_REST, SLOW, PLANE = 0, 3, 4, 5, 6, 7, 8, 9  # numbers of a plane
LOOK, TOUCH, PUSH = laws.LOOK, laws.TOUCH, laws.PUSH
plane_contact, plane_contact_adjoint = laws.plane_contact, laws.plane_contact_adjoint


@law
def dot(a, b):
    """A . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@law
def vector(a, at, stride):
    """Three components."""
    return load(a, at), load(a, at + stride), load(a, at + 2 * stride)


@law
def store_vector(a, at, stride, v):
    """Write three components."""
    store(a, at, v[0])
    store(a, at + stride, v[1])
    store(a, at + 2 * stride, v[2])


@law
def add_vector(a, at, stride, v):
    """Add to three components."""
    store(a, at, load(a, at) + v[0])
    store(a, at + stride, load(a, at + stride) + v[1])
    store(a, at + 2 * stride, load(a, at + 2 * stride) + v[2])


@law
def stride_of(mesh, c):
    """Between two nodes along axis c."""
    if c == 0:
        return mesh.plane
    return mesh.row if c == 1 else mesh.unit


@law
def place(mesh, d, state, i):
    """Where nodes are."""
    x, u = vector(mesh.places, i, mesh.component), vector(d, state + i, mesh.component)
    return x[0] + u[0], x[1] + u[1], x[2] + u[2]


@law
def step_inward(mesh, d, state, i, c, reach):
    """The way from nodes to their neighbours towards ``reach`` along axis c, and its length in the undeformed body."""
    stride, n = stride_of(mesh, c), mesh.component
    here, up, down = place(mesh, d, state, i), place(mesh, d, state, i + stride), place(mesh, d, state, i - stride)
    on = reach > 0
    step = (
        select(on, up[0], down[0]) - here[0],
        select(on, up[1], down[1]) - here[1],
        select(on, up[2], down[2]) - here[2],
    )
    at = c * n + i
    other = select(on, load(mesh.places, at + stride), load(mesh.places, at - stride))
    return step, magnitude(other - load(mesh.places, at))


@law
def inward(mesh, case, d, state, i, c, reach):
    """:func:`step_inward`, of its undeformed length if planes keep energy."""
    step, length = step_inward(mesh, d, state, i, c, reach)
    if case.keeps:
        scale = length / square_root(dot(step, step))
        step = step[0] * scale, step[1] * scale, step[2] * scale
    return step


@law
def inward_adjoint(mesh, case, d, state, i, c, reach, bar):
    """Adjoint of :func:`inward` times the reach: gradient by the way to the neighbour, where there is a reach."""
    way, zero = magnitude(reach), 0 * reach
    found = bar[0] * way, bar[1] * way, bar[2] * way
    if case.keeps:
        step, length = step_inward(mesh, d, state, i, c, reach)
        one = 1 / square_root(dot(step, step))
        e = step[0] * one, step[1] * one, step[2] * one
        along, scale = dot(found, e), length * one
        found = scale * (found[0] - along * e[0]), scale * (found[1] - along * e[1]), scale * (found[2] - along * e[2])
    there = way > 0
    return select(there, found[0], zero), select(there, found[1], zero), select(there, found[2], zero)


@law
def surface(mesh, case, d, state, g, i):
    """Where the surface of the matter is that nodes carry."""
    x0, x1, x2 = place(mesh, d, state, i)
    for c in range(3):
        reach = load(case.reach, (3 * g + c) * mesh.component + i)
        way = magnitude(reach)
        there, zero = way > 0, 0 * way
        if any_lane(there):
            a = inward(mesh, case, d, state, i, c, reach)
            x0, x1, x2 = (
                x0 + select(there, way * a[0], zero),
                x1 + select(there, way * a[1], zero),
                x2 + select(there, way * a[2], zero),
            )
    return x0, x1, x2


@law
def contact_numbers(mesh, case, g, k, i, light):
    """What ``plane_contact`` takes of plane k, from stick to push, and the hold per unit of adhesion."""
    planes = len(case.plane_stick)
    q, s = 16 * PLANE * (g * planes + k), (g * planes + k) * mesh.component + i
    zero = 0 * light
    per_adhesion = load(case.area, s) * case.dt * light
    hold = load(case.plane_numbers, q + 16 * ADHESION) * per_adhesion
    reach = select(load(case.far, s) > 0, load(case.plane_numbers, q + 16 * REACH), zero)
    stick, push = zero + 1.0 * case.plane_stick[k], zero + PUSH * case.plane_elastic[k]
    return (
        stick,
        load(case.plane_numbers, q + 16 * FRICTION),
        load(case.plane_numbers, q + 16 * AT_REST),
        load(case.plane_numbers, q + 16 * SLOW),
        hold,
        reach,
        zero + TOUCH * case.spacing,
        push,
        per_adhesion,
    )


@law
def meets(mesh, case, d, state, g, i, count, light, u):
    """Velocity after the first ``count`` planes, one after the other, and what carries the nodes onto them."""
    u0, u1, u2 = u
    zero = 0 * u0
    o0, o1, o2 = zero, zero, zero
    x = place(mesh, d, state, i)
    touching = load(case.touches, i) > 0
    for k in range(count):
        q = 16 * PLANE * (g * len(case.plane_stick) + k)
        n, level = vector(case.plane_numbers, q, 16), load(case.plane_numbers, q + 16 * OFFSET)
        near = touching & (dot(x, n) - level < LOOK * case.spacing + load(case.plane_numbers, q + 16 * REACH))
        if any_lane(near):
            gap = dot(surface(mesh, case, d, state, g, i), n) - level
            stick, friction, more, slow, hold, reach, touch, push, _ = contact_numbers(mesh, case, g, k, i, light)
            r0, r1, r2, p0, p1, p2 = plane_contact(
                u0, u1, u2, n[0], n[1], n[2], gap, case.dt, stick, friction, more, slow, hold, reach, touch, push
            )
            u0, u1, u2 = select(near, r0, u0), select(near, r1, u1), select(near, r2, u2)
            o0, o1, o2 = o0 + select(near, p0, zero), o1 + select(near, p1, zero), o2 + select(near, p2, zero)
    return u0, u1, u2, o0, o1, o2


@law
def meets_adjoint(mesh, case, d, state, sums, g, i, light, moves, u, b, o):
    """Adjoint of :func:`meets`: gradients by the velocity, by the places of the surfaces, and by the mass."""
    n, zero = mesh.component, 0 * light
    b0, b1, b2 = b
    c0, c1, c2, mass_bar = zero, zero, zero, zero
    planes = len(case.plane_stick)
    x = place(mesh, d, state, i)
    touching = moves & (load(case.touches, i) > 0)
    for behind in range(planes):
        k = planes - 1 - behind
        q = 16 * PLANE * (g * planes + k)
        m, level = vector(case.plane_numbers, q, 16), load(case.plane_numbers, q + 16 * OFFSET)
        near = touching & (dot(x, m) - level < LOOK * case.spacing + load(case.plane_numbers, q + 16 * REACH))
        if any_lane(near):
            s0, s1, s2 = surface(mesh, case, d, state, g, i)
            gap = dot((s0, s1, s2), m) - level
            stick, friction, more, slow, hold, reach, touch, push, per_adhesion = contact_numbers(
                mesh, case, g, k, i, light
            )
            r0, r1, r2, _, _, _ = meets(mesh, case, d, state, g, i, k, light, u)
            h0, h1, h2, m0, m1, m2, gap_bar, friction_bar, more_bar, slow_bar, hold_bar = plane_contact_adjoint(
                r0, r1, r2, m[0], m[1], m[2], gap, case.dt, stick, friction, more, slow, hold, reach, touch, push,
                b0, b1, b2, o[0], o[1], o[2],
            )  # fmt: skip
            b0, b1, b2 = select(near, h0, b0), select(near, h1, b1), select(near, h2, b2)
            gap_bar, friction_bar = select(near, gap_bar, zero), select(near, friction_bar, zero)
            hold_bar = select(near, hold_bar, zero)
            by_normal = (
                select(near, m0 + gap_bar * s0, zero), select(near, m1 + gap_bar * s1, zero),
                select(near, m2 + gap_bar * s2, zero),
            )  # fmt: skip
            s = (g * planes + k) * PLANE * n + i
            add_vector(sums.planes, s, n, by_normal)
            add_vector(sums.planes, s + OFFSET * n, n, (-gap_bar, friction_bar, hold_bar * per_adhesion))
            more_at, slow_at = s + AT_REST * n, s + SLOW * n
            store(sums.planes, more_at, load(sums.planes, more_at) + select(near, more_bar, zero))
            store(sums.planes, slow_at, load(sums.planes, slow_at) + select(near, slow_bar, zero))
            mass_bar = mass_bar - hold_bar * hold * light
            c0, c1, c2 = c0 + gap_bar * m[0], c1 + gap_bar * m[1], c2 + gap_bar * m[2]
            for c in range(3):
                r = (3 * g + c) * n + i
                reach = load(case.reach, r)
                if any_lane(magnitude(reach) > 0):
                    gain = gap_bar * dot(inward(mesh, case, d, state, i, c, reach), m)
                    gain = select(reach > 0, gain, select(reach < 0, -gain, zero))
                    store(sums.reach, r, load(sums.reach, r) + gain)
    return b0, b1, b2, c0, c1, c2, mass_bar


@law
def spread(mesh, case, d, state, surfaces, parity, g, i):
    """What the surfaces of nodes and of the neighbours that reach to them add to the gradient by their places."""
    n = mesh.component
    s = (parity * case.groups + g) * 3 * n + i
    own = vector(surfaces, s, n)
    t0, t1, t2 = own
    zero = 0 * t0
    for c in range(3):
        r, stride = (3 * g + c) * n + i, stride_of(mesh, c)
        reach, up, down = load(case.reach, r), load(case.reach, r + stride), load(case.reach, r - stride)
        if any_lane(magnitude(reach) > 0):
            a = inward_adjoint(mesh, case, d, state, i, c, reach, own)
            t0, t1, t2 = t0 - a[0], t1 - a[1], t2 - a[2]
        if any_lane(up < 0):
            bar = vector(surfaces, s + stride, n)
            a = inward_adjoint(mesh, case, d, state, i + stride, c, select(up < 0, up, zero), bar)
            t0, t1, t2 = t0 + a[0], t1 + a[1], t2 + a[2]
        if any_lane(down > 0):
            bar = vector(surfaces, s - stride, n)
            a = inward_adjoint(mesh, case, d, state, i - stride, c, select(down > 0, down, zero), bar)
            t0, t1, t2 = t0 + a[0], t1 + a[1], t2 + a[2]
    return t0, t1, t2
