"""Contact of a body with itself in the total-Lagrangian form: the counterpart of ``lane_selfcontact``, by the same law.

Every point sums over the points near it, and every node over the points that it moves, each in a fixed order.
"""

import taichi as ti

from torchsoro.simulation.kernels.forward import Integers, Reals
from torchsoro.simulation.kernels.laws_taichi import laws
from torchsoro.simulation.kernels.tensor import load_vector, store_vector

# Of ``bounds``: squared distance from which on nothing acts; squared way that nodes may go before pairs are listed.
REACH, SLACK = 0, 1
# No number of a point. A sum that might end at it is taken one after the other: LLVM would else regroup it by lanes of
# a processor, and its last bits would depend on pairs that are listed and do not act.
NO_PAIR = -1


@ti.func
def of_point(node: ti.template(), weight: ti.template(), field: ti.template(), at, nodes, p):
    """A nodal vector field at point p."""
    found = load_vector(field, at, nodes) * 0
    for k in range(27 * p, 27 * p + 27):
        found += weight[k] * load_vector(field, at + node[k], nodes)
    return found


@ti.func
def gather(entry: ti.template(), begin: ti.template(), weight: ti.template(), pushes: ti.template(), points, b, i):
    """Sum at node i of what points hand to it."""
    found = load_vector(pushes, 0, 1) * 0
    for e in range(begin[i], begin[i + 1]):
        k = entry[e]
        found += weight[k] * load_vector(pushes, 3 * (b * points + k // 27), 1)
    return found


@ti.kernel
def contact_forces(
    slot: ti.i32,
    offset: ti.i32,
    batch: ti.i32,
    nodes: ti.i32,
    length: ti.i32,
    points: ti.i32,
    node: Integers,
    begin: Integers,
    entry: Integers,
    first: Integers,
    other: Integers,
    weight: Reals,
    reference: Reals,
    bounds: Reals,
    stiffness: Reals,
    state: Reals,
    places: Reals,
    pushes: Reals,
    scratch: Reals,
):
    """Forces of the bodies on themselves, by node, with the state in a slot of its ring; from ``offset`` in scratch.

    Args:
        slot: Of the state.
        offset: Where the vectors of the nodes begin.
        batch: Number of bodies.
        nodes: Number of nodes.
        length: Of a body's state.
        points: Number of points of the surface.
        node: The 27 nodes of each point.
        begin: Where the entries of each node begin, and the end of the last.
        entry: Of each node the places in ``node`` that have its number.
        first: Where the pairs of each point of each body begin, and the end of the last.
        other: Their other points.
        weight: As ``node``.
        reference: Places of the points in the undeformed body.
        bounds: See above.
        stiffness: Of each point of each body.
        state: Of all bodies.
        places: Room for a vector for each point of each body.
        pushes: Likewise.
        scratch: See ``layout.BUFFERS``.
    """
    for w in range(batch * points):
        b, p = w // points, w % points
        if first[w] < first[w + 1]:
            at = (slot * batch + b) * length
            x = load_vector(reference, 3 * p, 1) + of_point(node, weight, state, at, nodes, p)
            store_vector(places, 3 * w, 1, x)
    for w in range(batch * points):
        b = w // points
        force = load_vector(places, 3 * w, 1) * 0
        for e in range(first[w], first[w + 1]):
            if other[e] == NO_PAIR:
                break
            j = b * points + other[e]
            r = load_vector(places, 3 * w, 1) - load_vector(places, 3 * j, 1)
            force += laws.repulsion(r.dot(r), bounds[REACH], stiffness[w], stiffness[j]) * r
        store_vector(pushes, 3 * w, 1, force)
    for w in range(batch * nodes):
        b, i = w // nodes, w % nodes
        store_vector(scratch, offset + 3 * b * nodes + i, nodes, gather(entry, begin, weight, pushes, points, b, i))


@ti.kernel
def contact_adjoint(
    slot: ti.i32,
    offset: ti.i32,
    batch: ti.i32,
    nodes: ti.i32,
    length: ti.i32,
    points: ti.i32,
    node: Integers,
    begin: Integers,
    entry: Integers,
    first: Integers,
    other: Integers,
    weight: Reals,
    reference: Reals,
    bounds: Reals,
    stiffness: Reals,
    state: Reals,
    places: Reals,
    pushes: Reals,
    scratch: Reals,
    pulled: Reals,
    stiffness_bar: Reals,
    back: Reals,
):
    """Adjoint of :func:`contact_forces`, with what it takes: gradient by the places of the nodes, from ``offset`` on.

    Args:
        slot: As there, and so on.
        offset: Likewise.
        batch: Likewise.
        nodes: Likewise.
        length: Likewise.
        points: Likewise.
        node: Likewise.
        begin: Likewise.
        entry: Likewise.
        first: Likewise.
        other: Likewise.
        weight: Likewise.
        reference: Likewise.
        bounds: Likewise.
        stiffness: Likewise.
        state: Likewise.
        places: Likewise.
        pushes: Room for the gradient by the place of each point.
        scratch: As there.
        pulled: Room for the gradient by the force on each point.
        stiffness_bar: Gradient by ``stiffness``, to which is added.
        back: Begins with the gradient by the forces on the nodes.
    """
    for w in range(batch * points):
        b, p = w // points, w % points
        if first[w] < first[w + 1]:
            at = (slot * batch + b) * length
            x = load_vector(reference, 3 * p, 1) + of_point(node, weight, state, at, nodes, p)
            store_vector(places, 3 * w, 1, x)
            store_vector(pulled, 3 * w, 1, of_point(node, weight, back, 3 * b * nodes, nodes, p))
    for w in range(batch * points):
        b = w // points
        found = load_vector(places, 3 * w, 1) * 0
        by_stiffness = stiffness[w] * 0
        for n in range(first[w], first[w + 1]):
            if other[n] == NO_PAIR:
                break
            j = b * points + other[n]
            r = load_vector(places, 3 * w, 1) - load_vector(places, 3 * j, 1)
            e = load_vector(pulled, 3 * w, 1) - load_vector(pulled, 3 * j, 1)
            square = r.dot(r)
            push = laws.repulsion(square, bounds[REACH], stiffness[w], stiffness[j])
            by_square, mine, _ = laws.repulsion_adjoint(square, bounds[REACH], stiffness[w], stiffness[j], r.dot(e))
            found += push * e + 2 * by_square * r
            by_stiffness += mine
        store_vector(pushes, 3 * w, 1, found)
        stiffness_bar[w] += by_stiffness
    for w in range(batch * nodes):
        b, i = w // nodes, w % nodes
        store_vector(scratch, offset + 3 * b * nodes + i, nodes, gather(entry, begin, weight, pushes, points, b, i))


@ti.kernel
def stray(
    slot: ti.i32,
    batch: ti.i32,
    nodes: ti.i32,
    length: ti.i32,
    strayed: Integers,
    bounds: Reals,
    watched: Reals,
    listed: Reals,
    state: Reals,
):
    """Flag whether any node has gone so far since pairs were listed that they are to be listed again.

    Args:
        slot: Of the state.
        batch: Number of bodies.
        nodes: Number of nodes.
        length: Of a body's state.
        strayed: The flag.
        bounds: See above.
        watched: By what share the way of each node counts.
        listed: Displacements of the nodes when pairs were listed.
        state: Of all bodies.
    """
    for w in range(batch * nodes):
        b, i = w // nodes, w % nodes
        d = load_vector(state, (slot * batch + b) * length + i, nodes)
        way = watched[i] * (d - load_vector(listed, 3 * b * nodes + i, nodes))
        if way.dot(way) > bounds[SLACK]:
            strayed[0] = 1
