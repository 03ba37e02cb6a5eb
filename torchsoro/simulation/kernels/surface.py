"""Planes against the nodes of the total-Lagrangian lattice, and the adjoint.

A node outside of a face lies half a cell in front of it, and of a design the outer layers may be void. So a node
responds to a plane not where it is itself but where the surface of the matter is that it carries: some way
(``NODAL_REACH``, as share of that to the next node, known from the masses) towards its neighbours, wherever these
have moved.

Where a plane keeps energy the way has the length that it had in the undeformed body, towards the neighbours: a node
then meets the plane with its own motion, so that the plane's force on it does the work that the plane's spring takes.
"""

import taichi as ti

from torchsoro.simulation.kernels.contact import plane_contact, plane_contact_adjoint
from torchsoro.simulation.kernels.lattice import node_place, nodes_per_axis, product
from torchsoro.simulation.kernels.laws_taichi import laws
from torchsoro.simulation.kernels.layout import (
    AREA,
    BATCH,
    EDGE,
    FACED,
    NODAL,
    NODAL_REACH,
    NODES,
    NODES_BAR,
    PLANE,
    PLANE_ADHESION,
    PLANE_AT_REST,
    PLANE_BAR,
    PLANE_ELASTIC,
    PLANE_FRICTION,
    PLANE_INTEGERS,
    PLANE_KIND,
    PLANE_NORMAL,
    PLANE_NUMBERS,
    PLANE_OFFSET,
    PLANE_REACH,
    PLANE_SIGN,
    PLANE_SLOW,
    PLANE_STICK,
    PLANES,
    STEP_SIZE,
    SURFACES,
)
from torchsoro.simulation.kernels.tensor import add, load_vector


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
def step_inward(ints: ti.template(), fixed: ti.template(), state: ti.template(), at, i, m, c: ti.template(), reach):
    """The way from node i to its neighbour towards ``reach`` along axis c, and its length in the undeformed body."""
    nodes = product(m)
    here = index_of(i, m)[c]
    length = node_place(ints, fixed, c, here + ti.select(reach > 0, 1, -1)) - node_place(ints, fixed, c, here)
    step = load_vector(state, at + neighbour(i, m, c, reach), nodes) - load_vector(state, at + i, nodes)
    step[c] += length
    return step, ti.abs(length)


@ti.func
def index_of(i, m):
    """Numbers of node i along the axes."""
    return ti.Vector([i // (m[1] * m[2]), (i // m[2]) % m[1], i % m[2]])


@ti.func
def current_place(ints: ti.template(), fixed: ti.template(), state: ti.template(), at, i, m):
    """Where node i is."""
    index = index_of(i, m)
    x = load_vector(state, at + i, product(m))
    for c in ti.static(range(3)):
        x[c] += node_place(ints, fixed, c, index[c])
    return x


@ti.func
def reaches_of(ints: ti.template(), fixed: ti.template(), b, i, nodes):
    """The way from node i to the surface of the matter that it carries, as shares of those to the next nodes."""
    return load_vector(fixed, ints[NODES] + (b * NODAL + NODAL_REACH) * nodes + i, nodes)


@ti.func
def resized(step, length):
    """A vector of another length."""
    return step * (length / step.norm())


@ti.func
def resized_adjoint(step, length, bar):
    """Adjoint of :func:`resized`: gradient by the vector."""
    along = step / step.norm()
    return (bar - bar.dot(along) * along) * (length / step.norm())


@ti.func
def inward(ints: ti.template(), fixed: ti.template(), state: ti.template(), at, i, m, c: ti.template(), reach, keeps):
    """:func:`step_inward`, of its undeformed length if planes keep energy."""
    step, length = step_inward(ints, fixed, state, at, i, m, c, reach)
    if keeps:
        step = resized(step, length)
    return step


@ti.func
def inward_adjoint(
    ints: ti.template(), fixed: ti.template(), state: ti.template(), at, i, m, c: ti.template(), reach, keeps, bar
):
    """Adjoint of :func:`inward` times the reach: gradient by the way to the neighbour."""
    found = bar * ti.abs(reach)
    if keeps:
        step, length = step_inward(ints, fixed, state, at, i, m, c, reach)
        found = resized_adjoint(step, length, found)
    return found


@ti.func
def elastic(ints: ti.template()):
    """Whether any plane keeps energy."""
    found = False
    for k in range(ints[PLANES]):
        if ints[ints[PLANE_KIND] + k * PLANE_INTEGERS + PLANE_ELASTIC] == 1:
            found = True
    return found


@ti.func
def surface_place(ints: ti.template(), fixed: ti.template(), state: ti.template(), at, i, m, node, reaches, keeps):
    """Where the surface of the matter is that a node carries, which is at ``node``."""
    x = node
    for c in ti.static(range(3)):
        if reaches[c] != 0:
            x += inward(ints, fixed, state, at, i, m, c, reaches[c], keeps) * ti.abs(reaches[c])
    return x


@ti.func
def plane_of(ints: ti.template(), fixed: ti.template(), b, k, reaches):
    """Of plane k: unit normal to the free side, distance from the origin along it, and what ``plane_contact`` takes.

    These are: stick, friction (three numbers), reach of adhesion, push. Adhesion reaches to the nodes whose matter
    faces the plane.
    """
    plane = ints[PLANE_NUMBERS] + (b * ints[PLANES] + k) * PLANE
    kind = ints[PLANE_KIND] + k * PLANE_INTEGERS
    edge, sign = fixed[EDGE], ints[kind + PLANE_SIGN]
    n, level = sign * load_vector(fixed, plane + PLANE_NORMAL, 1), sign * fixed[plane + PLANE_OFFSET]
    stick, friction = ints[kind + PLANE_STICK], fixed[plane + PLANE_FRICTION]
    more, slow = fixed[plane + PLANE_AT_REST], fixed[plane + PLANE_SLOW]
    reach = fixed[plane + PLANE_REACH]
    if ints[FACED] == 0 and not reaches.dot(n) > 0:
        reach = reach * 0
    push = edge * 0 + laws.PUSH * ints[kind + PLANE_ELASTIC]
    return n, level, stick, friction, more, slow, reach, push


@ti.func
def adhesion_speed(ints: ti.template(), fixed: ti.template(), b, k, i, mass):
    """Pull-off speed of node i that adhesion to plane k cancels in a step, and that for an adhesion of one.

    A node that meets no planes has a negative area.
    """
    one = b * ints[PLANES] + k
    area = fixed[ints[AREA] + one * product(nodes_per_axis(ints)) + i]
    per_adhesion = area * fixed[STEP_SIZE] / mass
    return fixed[ints[PLANE_NUMBERS] + one * PLANE + PLANE_ADHESION] * per_adhesion, per_adhesion


@ti.func
def surface_response(ints: ti.template(), fixed: ti.template(), state: ti.template(), at, b, i, count, mass, u):
    """Velocity of node i after the first ``count`` planes, one after the other, and what carries it onto them."""
    r = u
    onto = u * 0
    m = nodes_per_axis(ints)
    edge, dt, keeps = fixed[EDGE], fixed[STEP_SIZE], elastic(ints)
    node = current_place(ints, fixed, state, at, i, m)
    reaches = reaches_of(ints, fixed, b, i, product(m))
    for k in range(count):
        normal, level, stick, friction, more, slow, reach, push = plane_of(ints, fixed, b, k, reaches)
        hold, per_adhesion = adhesion_speed(ints, fixed, b, k, i, mass)
        if per_adhesion >= 0 and node.dot(normal) - level < laws.LOOK * edge + reach:
            gap = surface_place(ints, fixed, state, at, i, m, node, reaches, keeps).dot(normal) - level
            after, way = plane_contact(
                r, normal, gap, dt, stick, friction, more, slow, hold, reach, laws.TOUCH * edge, push
            )
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
    edge, dt, keeps = fixed[EDGE], fixed[STEP_SIZE], elastic(ints)
    node = current_place(ints, fixed, state, at, i, m)
    reaches = reaches_of(ints, fixed, b, i, nodes)
    for back in range(ints[PLANES]):
        k = ints[PLANES] - 1 - back
        normal, level, stick, friction, more, slow, reach, push = plane_of(ints, fixed, b, k, reaches)
        hold, per_adhesion = adhesion_speed(ints, fixed, b, k, i, mass)
        if per_adhesion >= 0 and node.dot(normal) - level < laws.LOOK * edge + reach:
            surface = surface_place(ints, fixed, state, at, i, m, node, reaches, keeps)
            gap = surface.dot(normal) - level
            arriving, _ = surface_response(ints, fixed, state, at, b, i, k, mass, u)
            by_u, by_normal, gap_bar, by_friction, hold_bar = plane_contact_adjoint(
                *(arriving, normal, gap, dt, stick, friction, more, slow, hold, reach, laws.TOUCH * edge, push),
                *(u_bar, onto_bar),
            )
            u_bar = by_u
            by_normal += gap_bar * surface
            sign = ints[ints[PLANE_KIND] + k * PLANE_INTEGERS + PLANE_SIGN]
            bar = ints[PLANE_BAR] + (b * ints[PLANES] + k) * PLANE * nodes + i
            add(False, sums, bar + PLANE_OFFSET * nodes, -sign * gap_bar)
            add(False, sums, bar + PLANE_FRICTION * nodes, by_friction[0])
            add(False, sums, bar + PLANE_AT_REST * nodes, by_friction[1])
            add(False, sums, bar + PLANE_SLOW * nodes, by_friction[2])
            add(False, sums, bar + PLANE_ADHESION * nodes, hold_bar * per_adhesion)
            mass_bar -= hold_bar * hold / mass
            for c in ti.static(range(3)):
                add(False, sums, bar + (PLANE_NORMAL + c) * nodes, sign * by_normal[c])
            if gap_bar != 0:
                surface_bar += gap_bar * normal
                for c in ti.static(range(3)):
                    if reaches[c] != 0:
                        step = inward(ints, fixed, state, at, i, m, c, reaches[c], keeps)
                        gain = gap_bar * normal.dot(step)
                        mine = ints[NODES_BAR] + (b * NODAL + NODAL_REACH + c) * nodes + i
                        add(False, sums, mine, ti.select(reaches[c] > 0, gain, -gain))
    return u_bar, surface_bar, mass_bar


@ti.func
def surface_spread(
    ints: ti.template(), fixed: ti.template(), state: ti.template(), at, back: ti.template(), parity, b, i
):
    """What the surfaces of node i and of the neighbours that reach to it add to the gradient by its place."""
    m = nodes_per_axis(ints)
    nodes = product(m)
    surfaces = ints[SURFACES] + (parity * ints[BATCH] + b) * 3 * nodes
    reaches = ints[NODES] + (b * NODAL + NODAL_REACH) * nodes
    own = load_vector(back, surfaces + i, nodes)
    total = own
    place, keeps = index_of(i, m), elastic(ints)
    for c in ti.static(range(3)):
        reach = fixed[reaches + c * nodes + i]
        if reach != 0:
            total -= inward_adjoint(ints, fixed, state, at, i, m, c, reach, keeps, own)
        for side in ti.static((-1, 1)):
            if place[c] + side >= 0 and place[c] + side < m[c]:
                other = neighbour(i, m, c, side)
                towards = fixed[reaches + c * nodes + other]
                if towards * side < 0:
                    bar = load_vector(back, surfaces + other, nodes)
                    total += inward_adjoint(ints, fixed, state, at, other, m, c, towards, keeps, bar)
    return total
