"""Planes against the nodes of the total-Lagrangian lattice, and the adjoint.

A node outside of a face lies half a cell in front of it, and of a design the outer layers may be void. So a node
responds to a plane not where it is itself but where the surface of the matter is that it carries: some way
(``NODAL_REACH``, as share of that to the next node, known from the masses) towards its neighbours, wherever these
have moved.
"""

import taichi as ti

from torchsoro.simulation.kernels.contact import axis_normal, gap_response, gap_response_adjoint
from torchsoro.simulation.kernels.lattice import node_place, nodes_per_axis, product
from torchsoro.simulation.kernels.layout import (
    BATCH,
    EDGE,
    NODAL,
    NODAL_REACH,
    NODES,
    NODES_BAR,
    PLANE,
    PLANE_ADHESION,
    PLANE_AXIS,
    PLANE_BAR,
    PLANE_FRICTION,
    PLANE_KIND,
    PLANE_NUMBERS,
    PLANE_OFFSET,
    PLANE_SIGN,
    PLANE_STICK,
    PLANES,
    STEP_SIZE,
    SURFACES,
)
from torchsoro.simulation.kernels.tensor import add, load_vector

# How far in front of a plane a node is looked at, and how near it is held by adhesion, in cells.
LOOK = 2.0
CONTACT_DISTANCE = 1e-3


@ti.func
def neighbour(i, m, c: ti.template(), side):
    """The node next to node i along axis c, on the given side."""
    stride = 1
    if ti.static(c == 0):
        stride = m[1] * m[2]
    elif ti.static(c == 1):
        stride = m[2]
    return i + ti.select(side > 0, stride, -stride)


@ti.func
def index_along(i, m, axis):
    """Number of node i along an axis."""
    index = i // (m[1] * m[2])
    if axis == 1:
        index = (i // m[2]) % m[1]
    elif axis == 2:
        index = i % m[2]
    return index


@ti.func
def step_inward(
    ints: ti.template(), fixed: ti.template(), state: ti.template(), at, i, m, axis, c: ti.template(), reach
):
    """From node i to its neighbour towards ``reach`` along axis c: the coordinate along ``axis`` gained."""
    along = at + axis * product(m)
    gain = state[along + neighbour(i, m, c, reach)] - state[along + i]
    if axis == c:
        here = index_along(i, m, c)
        gain += node_place(ints, fixed, c, here + ti.select(reach > 0, 1, -1)) - node_place(ints, fixed, c, here)
    return gain


@ti.func
def places(ints: ti.template(), fixed: ti.template(), state: ti.template(), at, b, i, m, axis):
    """Coordinate along ``axis`` of node i, and of the surface of the matter that it carries."""
    nodes = product(m)
    node = node_place(ints, fixed, axis, index_along(i, m, axis)) + state[at + axis * nodes + i]
    surface = node
    for c in ti.static(range(3)):
        reach = fixed[ints[NODES] + (b * NODAL + NODAL_REACH + c) * nodes + i]
        if reach != 0:
            surface += step_inward(ints, fixed, state, at, i, m, axis, c, reach) * ti.abs(reach)
    return node, surface


@ti.func
def adhesive_hold(ints: ti.template(), fixed: ti.template(), plane, gap, mass):
    """Pull-off speed that adhesion cancels in a step; negative where it does not reach."""
    edge = fixed[EDGE]
    hold = mass * 0 - 1
    if gap < CONTACT_DISTANCE * edge:
        hold = fixed[plane + PLANE_ADHESION] * edge * edge * fixed[STEP_SIZE] / mass
    return hold


@ti.func
def surface_response(ints: ti.template(), fixed: ti.template(), state: ti.template(), at, b, i, count, mass, u):
    """Velocity of node i after the first ``count`` planes, one after the other, and what carries it onto them."""
    r = u
    onto = u * 0
    m = nodes_per_axis(ints)
    for k in range(count):
        plane = ints[PLANE_NUMBERS] + (b * ints[PLANES] + k) * PLANE
        kind = ints[PLANE_KIND] + 3 * k
        offset, sign = fixed[plane + PLANE_OFFSET], ints[kind + PLANE_SIGN]
        node, surface = places(ints, fixed, state, at, b, i, m, ints[kind + PLANE_AXIS])
        if sign * (node - offset) < LOOK * fixed[EDGE]:
            gap = sign * (surface - offset)
            hold = adhesive_hold(ints, fixed, plane, gap, mass)
            normal = axis_normal(ints[kind + PLANE_AXIS], sign, u)
            stick, friction = ints[kind + PLANE_STICK], fixed[plane + PLANE_FRICTION]
            after, way = gap_response(r, normal, gap, fixed[STEP_SIZE], stick, friction, hold)
            r = after
            onto += way
    return r, onto


@ti.func
def surface_response_adjoint(
    ints: ti.template(),
    fixed: ti.template(),
    state: ti.template(),
    at,
    sums: ti.template(),
    b,
    i,
    mass,
    u,
    r_bar,
    onto_bar,
):
    """Adjoint of :func:`surface_response`: gradients by the velocity, by the place of the surface, and by the mass.

    The gradients by planes and reaches go to sums of their own for each node, so that no two threads meet.
    """
    u_bar = r_bar
    surface_bar = r_bar * 0
    mass_bar = mass * 0
    m = nodes_per_axis(ints)
    nodes = product(m)
    dt = fixed[STEP_SIZE]
    for back in range(ints[PLANES]):
        k = ints[PLANES] - 1 - back
        plane = ints[PLANE_NUMBERS] + (b * ints[PLANES] + k) * PLANE
        kind = ints[PLANE_KIND] + 3 * k
        axis, sign = ints[kind + PLANE_AXIS], ints[kind + PLANE_SIGN]
        node, surface = places(ints, fixed, state, at, b, i, m, axis)
        if sign * (node - fixed[plane + PLANE_OFFSET]) < LOOK * fixed[EDGE]:
            gap = sign * (surface - fixed[plane + PLANE_OFFSET])
            hold = adhesive_hold(ints, fixed, plane, gap, mass)
            arriving, _ = surface_response(ints, fixed, state, at, b, i, k, mass, u)
            normal = axis_normal(axis, sign, u)
            friction, stick = fixed[plane + PLANE_FRICTION], ints[kind + PLANE_STICK]
            by_u, gap_bar, by_friction, hold_bar = gap_response_adjoint(
                arriving, normal, gap, dt, stick, friction, hold, u_bar, onto_bar
            )
            u_bar = by_u
            bar = ints[PLANE_BAR] + (b * ints[PLANES] + k) * PLANE * nodes + i
            add(False, sums, bar + PLANE_OFFSET * nodes, -sign * gap_bar)
            add(False, sums, bar + PLANE_FRICTION * nodes, by_friction)
            if hold >= 0:
                add(False, sums, bar + PLANE_ADHESION * nodes, hold_bar * fixed[EDGE] * fixed[EDGE] * dt / mass)
                mass_bar -= hold_bar * hold / mass
            if gap_bar != 0:
                for c in ti.static(range(3)):
                    if axis == c:
                        surface_bar[c] += sign * gap_bar
                    mine = (b * NODAL + NODAL_REACH + c) * nodes + i
                    reach = fixed[ints[NODES] + mine]
                    if reach != 0:
                        gain = sign * gap_bar * step_inward(ints, fixed, state, at, i, m, axis, c, reach)
                        add(False, sums, ints[NODES_BAR] + mine, ti.select(reach > 0, gain, -gain))
    return u_bar, surface_bar, mass_bar


@ti.func
def surface_spread(ints: ti.template(), fixed: ti.template(), back: ti.template(), parity, b, i):
    """What the surfaces of node i and of the neighbours that reach to it add to the gradient by its place."""
    m = nodes_per_axis(ints)
    nodes = product(m)
    surfaces = ints[SURFACES] + (parity * ints[BATCH] + b) * 3 * nodes
    reaches = ints[NODES] + (b * NODAL + NODAL_REACH) * nodes
    own = load_vector(back, surfaces + i, nodes)
    total = own
    place = ti.Vector([i // (m[1] * m[2]), (i // m[2]) % m[1], i % m[2]])
    for c in ti.static(range(3)):
        total -= ti.abs(fixed[reaches + c * nodes + i]) * own
        for side in ti.static((-1, 1)):
            if place[c] + side >= 0 and place[c] + side < m[c]:
                other = neighbour(i, m, c, side)
                reach = fixed[reaches + c * nodes + other]
                if reach * side < 0:
                    total += ti.abs(reach) * load_vector(back, surfaces + other, nodes)
    return total
