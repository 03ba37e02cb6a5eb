"""Planes against the nodes, in lanes: the rules of ``contact`` and ``surface`` without branches, and their adjoint."""

from __future__ import annotations

from torchsoro.simulation.kernels.lanes import any_lane, larger, law, load, magnitude, select, square_root, store

GRAZING = 0.2  # slope below which a point that arrives is taken to graze the plane
LOOK = 2.0  # cells in front of a plane at which a node is looked at
CONTACT_DISTANCE = 1e-3  # cells from which adhesion holds
NORMAL, OFFSET, FRICTION, ADHESION, PLANE = 0, 3, 4, 5, 6  # numbers of a plane


@law
def dot(a0, a1, a2, b0, b1, b2):
    """A . b."""
    return a0 * b0 + a1 * b1 + a2 * b2


@law
def response(u0, u1, u2, n0, n1, n2, normal, sticks, friction, hold):
    """Velocity after a plane, as ``contact.response``."""
    t0, t1, t2 = u0 - normal * n0, u1 - normal * n1, u2 - normal * n2
    speed = square_root(larger(dot(t0, t1, t2, t0, t1, t2), 1e-30))
    loss = friction * (hold - normal)
    rest = select(speed > loss, 1 - loss / speed, 0 * speed)
    if sticks:
        rest = 0 * rest
    tears = normal > hold
    held = ((normal < 0) | (hold > 0)) & ~tears
    r0, r1, r2 = select(held, rest * t0, u0), select(held, rest * t1, u1), select(held, rest * t2, u2)
    return select(tears, u0 - hold * n0, r0), select(tears, u1 - hold * n1, r1), select(tears, u2 - hold * n2, r2)


@law
def lands(u0, u1, u2, n0, n1, n2, gap, dt, sticks, friction, hold):
    """Velocity after a plane that is ``gap`` away, and what carries a point that arrives onto it."""
    normal = dot(u0, u1, u2, n0, n1, n2)
    way = larger(gap, 0.0)
    arrives = normal * dt + way < 0
    leaves = (normal > 0) & (hold >= 0) & ~arrives
    pull = larger(hold, 0.0)
    r0, r1, r2 = response(u0, u1, u2, n0, n1, n2, normal, sticks, friction, pull)
    l0, l1, l2 = u0 - r0 - normal * n0, u1 - r1 - normal * n1, u2 - r2 - normal * n2
    speed = larger(-normal, GRAZING * square_root(larger(dot(l0, l1, l2, l0, l1, l2), 1e-30)))
    rate, back = way / dt, 1 / larger(speed, 1e-30)
    o0, o1, o2 = rate * (l0 * back - n0), rate * (l1 * back - n1), rate * (l2 * back - n2)
    felt, zero = arrives | leaves, 0 * normal
    return (
        select(felt, r0, u0), select(felt, r1, u1), select(felt, r2, u2),
        select(arrives, o0, zero), select(arrives, o1, zero), select(arrives, o2, zero),
    )  # fmt: skip


@law
def inward(mesh, d, state, i, stride, component, reach):
    """From nodes to their neighbours towards ``reach``: how far along an axis, deformation included."""
    c = component * mesh.component
    here = load(d, state + c + i) + load(mesh.places, c + i)
    up = load(d, state + c + i + stride) + load(mesh.places, c + i + stride)
    down = load(d, state + c + i - stride) + load(mesh.places, c + i - stride)
    return select(reach > 0, up, down) - here


@law
def stride_of(mesh, c):
    """Between two nodes along axis c."""
    if c == 0:
        return mesh.plane
    return mesh.row if c == 1 else mesh.unit


@law
def surface_gap(mesh, case, d, state, g, i, q):
    """Distance in front of a plane of nodes, and of the surface of the matter that they carry."""
    n0, n1, n2 = load(case.plane_numbers, q), load(case.plane_numbers, q + 16), load(case.plane_numbers, q + 32)
    n = mesh.component
    x0 = load(d, state + i) + load(mesh.places, i)
    x1 = load(d, state + i + n) + load(mesh.places, i + n)
    x2 = load(d, state + i + 2 * n) + load(mesh.places, i + 2 * n)
    node = dot(x0, x1, x2, n0, n1, n2) - load(case.plane_numbers, q + 16 * OFFSET)
    gap = node
    for c in range(3):
        reach = load(case.reach, (3 * g + c) * n + i)
        way = magnitude(reach)
        if any_lane(way > 0):
            stride = stride_of(mesh, c)
            a0, a1, a2 = (
                inward(mesh, d, state, i, stride, 0, reach),
                inward(mesh, d, state, i, stride, 1, reach),
                inward(mesh, d, state, i, stride, 2, reach),
            )
            gap = gap + select(way > 0, way * dot(a0, a1, a2, n0, n1, n2), 0 * way)
    return node, gap, n0, n1, n2


@law
def meets(mesh, case, d, state, g, i, count, light, u0, u1, u2):
    """Velocity after the first ``count`` planes, one after the other, and what carries the nodes onto them."""
    dt = case.dt
    o0, o1, o2 = 0 * u0, 0 * u0, 0 * u0
    planes = len(case.plane_stick)
    for k in range(count):
        q = 16 * PLANE * (g * planes + k)
        n = mesh.component
        node = dot(
            load(d, state + i) + load(mesh.places, i),
            load(d, state + i + n) + load(mesh.places, i + n),
            load(d, state + i + 2 * n) + load(mesh.places, i + 2 * n),
            load(case.plane_numbers, q),
            load(case.plane_numbers, q + 16),
            load(case.plane_numbers, q + 32),
        ) - load(case.plane_numbers, q + 16 * OFFSET)
        near = node < LOOK * case.spacing
        if any_lane(near):
            _, gap, n0, n1, n2 = surface_gap(mesh, case, d, state, g, i, q)
            area = load(case.area, k * n + i)
            hold = load(case.plane_numbers, q + 16 * ADHESION) * area * dt * light
            hold = select(gap < CONTACT_DISTANCE * case.spacing, hold, 0 * hold - 1)
            friction = load(case.plane_numbers, q + 16 * FRICTION)
            r0, r1, r2, p0, p1, p2 = lands(u0, u1, u2, n0, n1, n2, gap, dt, case.plane_stick[k], friction, hold)
            u0, u1, u2 = select(near, r0, u0), select(near, r1, u1), select(near, r2, u2)
            zero = 0 * p0
            o0, o1, o2 = o0 + select(near, p0, zero), o1 + select(near, p1, zero), o2 + select(near, p2, zero)
    return u0, u1, u2, o0, o1, o2


@law
def response_adjoint(u0, u1, u2, n0, n1, n2, normal, sticks, friction, hold, b0, b1, b2):
    """Adjoint of :func:`response`: gradients by the velocity, friction and hold."""
    t0, t1, t2 = u0 - normal * n0, u1 - normal * n1, u2 - normal * n2
    speed = square_root(larger(dot(t0, t1, t2, t0, t1, t2), 1e-30))
    loss = friction * (hold - normal)
    slides, zero = speed > loss, 0 * speed
    e0, e1, e2 = t0 / speed, t1 / speed, t2 / speed
    loss_bar = -dot(e0, e1, e2, b0, b1, b2)
    along = dot(b0, b1, b2, n0, n1, n2)
    f0, f1, f2 = b0 - along * n0, b1 - along * n1, b2 - along * n2
    share, ahead = loss / speed, dot(e0, e1, e2, f0, f1, f2)
    pressed = loss_bar * friction
    h0 = f0 - share * (f0 - ahead * e0) - pressed * n0
    h1 = f1 - share * (f1 - ahead * e1) - pressed * n1
    h2 = f2 - share * (f2 - ahead * e2) - pressed * n2
    friction_bar, hold_bar = loss_bar * (hold - normal), pressed
    h0, h1, h2 = select(slides, h0, zero), select(slides, h1, zero), select(slides, h2, zero)
    friction_bar, hold_bar = select(slides, friction_bar, zero), select(slides, hold_bar, zero)
    if sticks:
        h0, h1, h2, friction_bar, hold_bar = zero, zero, zero, zero, zero
    tears = normal > hold
    held = ((normal < 0) | (hold > 0)) & ~tears
    return (
        select(held, h0, b0), select(held, h1, b1), select(held, h2, b2),
        select(held, friction_bar, zero), select(held, hold_bar, select(tears, -along, zero)),
    )  # fmt: skip


@law
def lands_adjoint(u0, u1, u2, n0, n1, n2, gap, dt, sticks, friction, hold, b0, b1, b2, o0, o1, o2):
    """Adjoint of :func:`lands`: gradients by the velocity, gap, friction and hold."""
    normal, zero = dot(u0, u1, u2, n0, n1, n2), 0 * gap
    way = larger(gap, 0.0)
    arrives = normal * dt + way < 0
    leaves = (normal > 0) & (hold >= 0) & ~arrives
    pull = larger(hold, 0.0)
    r0, r1, r2 = response(u0, u1, u2, n0, n1, n2, normal, sticks, friction, pull)
    # What carries it onto the plane.
    l0, l1, l2 = u0 - r0 - normal * n0, u1 - r1 - normal * n1, u2 - r2 - normal * n2
    size = square_root(larger(dot(l0, l1, l2, l0, l1, l2), 1e-30))
    grazes = -normal < GRAZING * size
    speed = larger(larger(-normal, GRAZING * size), 1e-30)
    back, on = 1 / speed, dot(o0, o1, o2, n0, n1, n2)
    gap_bar = dot(l0 * back - n0, l1 * back - n1, l2 * back - n2, o0, o1, o2) / dt
    rate = way * back / dt
    m0, m1, m2 = rate * (o0 - on * n0), rate * (o1 - on * n1), rate * (o2 - on * n2)
    speed_bar = -dot(m0, m1, m2, l0, l1, l2) * back
    turned = select(grazes, speed_bar * GRAZING / size, zero)
    m0, m1, m2 = m0 + turned * l0, m1 + turned * l1, m2 + turned * l2
    straight = select(grazes, zero, speed_bar)
    carried = arrives & (gap > 0)
    m0, m1, m2 = select(carried, m0, zero), select(carried, m1, zero), select(carried, m2, zero)
    straight, gap_bar = select(carried, straight, zero), select(carried, gap_bar, zero)
    h0, h1, h2, friction_bar, hold_bar = response_adjoint(
        u0, u1, u2, n0, n1, n2, normal, sticks, friction, pull, b0 - m0, b1 - m1, b2 - m2
    )
    h0, h1, h2 = h0 + m0 - straight * n0, h1 + m1 - straight * n1, h2 + m2 - straight * n2
    felt = arrives | leaves
    return (
        select(felt, h0, b0), select(felt, h1, b1), select(felt, h2, b2),
        gap_bar, select(felt, friction_bar, zero), select(felt, hold_bar, zero),
    )  # fmt: skip


@law
def meets_adjoint(mesh, case, d, state, sums, g, i, light, moves, u0, u1, u2, b0, b1, b2, o0, o1, o2):
    """Adjoint of :func:`meets`: gradients by the velocity, by the places of the surfaces, and by the mass."""
    dt, n, zero = case.dt, mesh.component, 0 * u0
    c0, c1, c2, mass_bar = zero, zero, zero, zero
    planes = len(case.plane_stick)
    for behind in range(planes):
        k = planes - 1 - behind
        q = 16 * PLANE * (g * planes + k)
        node, gap, n0, n1, n2 = surface_gap(mesh, case, d, state, g, i, q)
        near = (node < LOOK * case.spacing) & moves
        if any_lane(near):
            area = load(case.area, k * n + i)
            reaches = gap < CONTACT_DISTANCE * case.spacing
            hold = load(case.plane_numbers, q + 16 * ADHESION) * area * dt * light
            hold = select(reaches, hold, zero - 1)
            friction = load(case.plane_numbers, q + 16 * FRICTION)
            r0, r1, r2, _, _, _ = meets(mesh, case, d, state, g, i, k, light, u0, u1, u2)
            h0, h1, h2, gap_bar, friction_bar, hold_bar = lands_adjoint(
                r0, r1, r2, n0, n1, n2, gap, dt, case.plane_stick[k], friction, hold, b0, b1, b2, o0, o1, o2
            )
            b0, b1, b2 = select(near, h0, b0), select(near, h1, b1), select(near, h2, b2)
            gap_bar, friction_bar = select(near, gap_bar, zero), select(near, friction_bar, zero)
            hold_bar = select(near & reaches, hold_bar, zero)
            s = (g * planes + k) * PLANE * n + i
            store(sums.planes, s + OFFSET * n, load(sums.planes, s + OFFSET * n) - gap_bar)
            store(sums.planes, s + FRICTION * n, load(sums.planes, s + FRICTION * n) + friction_bar)
            store(sums.planes, s + ADHESION * n, load(sums.planes, s + ADHESION * n) + hold_bar * area * dt * light)
            mass_bar = mass_bar - hold_bar * hold * light
            c0, c1, c2 = c0 + gap_bar * n0, c1 + gap_bar * n1, c2 + gap_bar * n2
            for c in range(3):
                r = (3 * g + c) * n + i
                reach = load(case.reach, r)
                way = magnitude(reach)
                if any_lane(way > 0):
                    stride = stride_of(mesh, c)
                    gain = gap_bar * dot(
                        inward(mesh, d, state, i, stride, 0, reach),
                        inward(mesh, d, state, i, stride, 1, reach),
                        inward(mesh, d, state, i, stride, 2, reach),
                        n0, n1, n2,
                    )  # fmt: skip
                    gain = select(reach > 0, gain, select(reach < 0, -gain, zero))
                    store(sums.reach, r, load(sums.reach, r) + gain)
    return b0, b1, b2, c0, c1, c2, mass_bar


@law
def spread(mesh, case, surfaces, parity, g, i):
    """What the surfaces of nodes and of the neighbours that reach to them add to the gradient by their places."""
    n = mesh.component
    s = (parity * case.groups + g) * 3 * n + i
    a0, a1, a2 = load(surfaces, s), load(surfaces, s + n), load(surfaces, s + 2 * n)
    own, zero = 0 * a0 + 1, 0 * a0
    t0, t1, t2 = zero, zero, zero
    for c in range(3):
        r = (3 * g + c) * n + i
        own = own - magnitude(load(case.reach, r))
        stride = stride_of(mesh, c)
        up, down = load(case.reach, r + stride), load(case.reach, r - stride)
        from_up, from_down = select(up < 0, -up, zero), select(down > 0, down, zero)
        t0 = t0 + from_up * load(surfaces, s + stride) + from_down * load(surfaces, s - stride)
        t1 = t1 + from_up * load(surfaces, s + n + stride) + from_down * load(surfaces, s + n - stride)
        t2 = t2 + from_up * load(surfaces, s + 2 * n + stride) + from_down * load(surfaces, s + 2 * n - stride)
    return own * a0 + t0, own * a1 + t1, own * a2 + t2
