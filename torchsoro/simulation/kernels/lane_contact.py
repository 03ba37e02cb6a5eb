"""Planes against the nodes, in lanes: the rules of ``contact`` and ``surface`` without branches, and their adjoint."""

from __future__ import annotations

from torchsoro.simulation.kernels.lane_laws import law
from torchsoro.simulation.kernels.lanes import any_lane, larger, load, magnitude, select, square_root

GRAZING = 0.2  # slope below which a point that arrives is taken to graze the plane
LOOK = 2.0  # cells in front of a plane at which a node is looked at
CONTACT_DISTANCE = 1e-3  # cells from which adhesion holds
NORMAL, OFFSET, FRICTION, ADHESION, PLANE = 0, 3, 4, 5, 6  # numbers of a plane


@law
def dot(a0, a1, a2, b0, b1, b2):
    """a . b."""
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
        node = (
            dot(
                load(d, state + i) + load(mesh.places, i),
                load(d, state + i + n) + load(mesh.places, i + n),
                load(d, state + i + 2 * n) + load(mesh.places, i + 2 * n),
                load(case.plane_numbers, q),
                load(case.plane_numbers, q + 16),
                load(case.plane_numbers, q + 32),
            )
            - load(case.plane_numbers, q + 16 * OFFSET)
        )
        near = node < LOOK * case.spacing
        if any_lane(near):
            _, gap, n0, n1, n2 = surface_gap(mesh, case, d, state, g, i, q)
            area = load(case.area, k * n + i)
            hold = load(case.plane_numbers, q + 16 * ADHESION) * area * dt * light
            hold = select(gap < CONTACT_DISTANCE * case.spacing, hold, 0 * hold - 1)
            friction = load(case.plane_numbers, q + 16 * FRICTION)
            r0, r1, r2, p0, p1, p2 = lands(
                u0, u1, u2, n0, n1, n2, gap, dt, case.plane_stick[k], friction, hold
            )
            u0, u1, u2 = select(near, r0, u0), select(near, r1, u1), select(near, r2, u2)
            zero = 0 * p0
            o0, o1, o2 = o0 + select(near, p0, zero), o1 + select(near, p1, zero), o2 + select(near, p2, zero)
    return u0, u1, u2, o0, o1, o2
