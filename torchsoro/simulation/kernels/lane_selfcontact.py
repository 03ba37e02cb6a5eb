"""Contact of a body with itself, in lanes: repulsion between points of its surface, its adjoint, and the list of pairs.

Points move with the nodes around them, x = X + sum w d, and hand forces to them by the same weights, so that forces and
moments of a pair cancel. All that concerns a body is done by one thread, pair after pair in the order of the list,
which holds every pair within reach, and some beyond that add nothing: results do not depend on when it was made.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchsoro.simulation.kernels.lane_contact import add_vector, dot, store_vector, vector
from torchsoro.simulation.kernels.lanes import any_lane, fast, law, load, part, select, store
from torchsoro.simulation.kernels.laws_lanes import laws

repulsion, repulsion_adjoint = laws.repulsion, laws.repulsion_adjoint


class SelfContact(NamedTuple):
    """Points of the surface, and which of them are near each other; without any where contact is off.

    Attributes:
        count: Points.
        node: Place in a component, of the first lane, of the 27 nodes of each point.
        weight: Of these nodes.
        reference: Places of the points in the undeformed body, component by component for each.
        stiffness: Of each body, point and lane [N/m].
        watched: By what share the way of the node at each place of a component counts, 0 where it moves no point.
        reach: Squared distance from which on nothing acts [m2].
        slack: Squared way [m2] that nodes may go before pairs are listed again.
        listed: Displacements of the nodes when they were listed.
        first: For each body where the pairs of each point begin, and the end of the last one.
        other: The second points of the pairs, ``capacity`` for each body.
        capacity: Places in ``other``.
        active: Points of each body that have a pair.
        actives: Their number.
        places: Of each point, three components in lanes; likewise ``pushes``, its force or the gradient by its place,
            and ``pulled``, the gradient by its force.
        nodal: What the points hand to the nodes.
        stiffness_bar: Gradient by ``stiffness``.
        moved: Of each thread, in a cache line of its own, whether a node has gone farther than ``slack``.
    """

    count: int
    node: np.ndarray
    weight: np.ndarray
    reference: np.ndarray
    stiffness: np.ndarray
    watched: np.ndarray
    reach: float
    slack: float
    listed: np.ndarray
    first: np.ndarray
    other: np.ndarray
    capacity: int
    active: np.ndarray
    actives: np.ndarray
    places: np.ndarray
    pushes: np.ndarray
    pulled: np.ndarray
    nodal: np.ndarray
    stiffness_bar: np.ndarray
    moved: np.ndarray


@law
def of_point(mesh, contact, p, field, at):
    """A nodal vector field at point p."""
    u0, u1, u2 = 0 * load(mesh.own, 0), 0 * load(mesh.own, 0), 0 * load(mesh.own, 0)
    for k in range(27 * p, 27 * p + 27):
        w, o = contact.weight[k], at + contact.node[k]
        u0, u1 = u0 + w * load(field, o), u1 + w * load(field, o + mesh.component)
        u2 = u2 + w * load(field, o + 2 * mesh.component)
    return u0, u1, u2


@law
def put_place(mesh, contact, g, p, states, state):
    """Find where point p is."""
    u0, u1, u2 = of_point(mesh, contact, p, states, state)
    x = u0 + contact.reference[3 * p], u1 + contact.reference[3 * p + 1], u2 + contact.reference[3 * p + 2]
    store_vector(contact.places, 48 * (g * contact.count + p), 16, x)


@law
def prepare(mesh, contact, g, states, state):
    """Find where the points that have pairs are, and clear what they add to."""
    zero = 0 * load(mesh.own, 0)
    for a in range(g * contact.count, g * contact.count + contact.actives[g]):
        p = contact.active[a]
        put_place(mesh, contact, g, p, states, state)
        store_vector(contact.pushes, 48 * (g * contact.count + p), 16, (zero, zero, zero))
        for k in range(27 * p, 27 * p + 27):
            o = 3 * g * mesh.component + contact.node[k]
            store_vector(contact.nodal, o, mesh.component, (zero, zero, zero))


@law
def hand_to_nodes(mesh, contact, g):
    """Add to the nodes what the points have."""
    for a in range(g * contact.count, g * contact.count + contact.actives[g]):
        p = contact.active[a]
        f0, f1, f2 = vector(contact.pushes, 48 * (g * contact.count + p), 16)
        for k in range(27 * p, 27 * p + 27):
            w, o = contact.weight[k], 3 * g * mesh.component + contact.node[k]
            add_vector(contact.nodal, o, mesh.component, (w * f0, w * f1, w * f2))


@law
def between(contact, i, j):
    """The vector from point j to point i, by the places of both in the buffers."""
    x, y = vector(contact.places, 48 * i, 16), vector(contact.places, 48 * j, 16)
    return x[0] - y[0], x[1] - y[1], x[2] - y[2]


@part
def contact_forward(mesh, contact, states, g, state):
    """Forces of a body on itself, left in ``nodal``; ``state`` is where the body's displacements begin."""
    prepare(mesh, contact, g, states, state)
    own, base = load(mesh.own, 0) > 0, g * contact.count
    zero = 0 * load(mesh.own, 0)
    for a in range(base, base + contact.actives[g]):
        p = contact.active[a]
        i, row = base + p, g * (contact.count + 1) + p
        f0, f1, f2 = vector(contact.pushes, 48 * i, 16)
        for e in range(contact.first[row], contact.first[row + 1]):
            j = base + contact.other[g * contact.capacity + e]
            r = between(contact, i, j)
            square = dot(r, r)
            near = own & (square < contact.reach)
            if any_lane(near):
                push = repulsion(
                    square, zero + contact.reach, load(contact.stiffness, 16 * i), load(contact.stiffness, 16 * j)
                )
                b0, b1, b2 = (
                    select(near, push * r[0], zero),
                    select(near, push * r[1], zero),
                    select(near, push * r[2], zero),
                )
                f0, f1, f2 = f0 + b0, f1 + b1, f2 + b2
                add_vector(contact.pushes, 48 * j, 16, (-b0, -b1, -b2))
        store_vector(contact.pushes, 48 * i, 16, (f0, f1, f2))
    hand_to_nodes(mesh, contact, g)


@part
def contact_backward(mesh, contact, states, g, state, pulls):
    """Adjoint of :func:`contact_forward`, from the gradient by the forces on the nodes to that by their displacements.

    The latter is left in ``nodal``.
    """
    prepare(mesh, contact, g, states, state)
    own, base = load(mesh.own, 0) > 0, g * contact.count
    zero = 0 * load(mesh.own, 0)
    for a in range(base, base + contact.actives[g]):
        p = contact.active[a]
        pull = of_point(mesh, contact, p, pulls, 3 * g * mesh.component)
        store_vector(contact.pulled, 48 * (base + p), 16, pull)
    for a in range(base, base + contact.actives[g]):
        p = contact.active[a]
        i, row = base + p, g * (contact.count + 1) + p
        x0, x1, x2 = vector(contact.pushes, 48 * i, 16)
        q = vector(contact.pulled, 48 * i, 16)
        for e in range(contact.first[row], contact.first[row + 1]):
            j = base + contact.other[g * contact.capacity + e]
            r = between(contact, i, j)
            square = dot(r, r)
            near = own & (square < contact.reach)
            if any_lane(near):
                h, reach = vector(contact.pulled, 48 * j, 16), zero + contact.reach
                stiff, against = load(contact.stiffness, 16 * i), load(contact.stiffness, 16 * j)
                e0, e1, e2 = q[0] - h[0], q[1] - h[1], q[2] - h[2]
                push = repulsion(square, reach, stiff, against)
                square_bar, a_bar, b_bar = repulsion_adjoint(square, reach, stiff, against, dot(r, (e0, e1, e2)))
                twice = 2 * square_bar
                b0, b1, b2 = (
                    select(near, push * e0 + twice * r[0], zero),
                    select(near, push * e1 + twice * r[1], zero),
                    select(near, push * e2 + twice * r[2], zero),
                )
                x0, x1, x2 = x0 + b0, x1 + b1, x2 + b2
                add_vector(contact.pushes, 48 * j, 16, (-b0, -b1, -b2))
                bars = contact.stiffness_bar
                store(bars, 16 * i, load(bars, 16 * i) + select(near, a_bar, zero))
                store(bars, 16 * j, load(bars, 16 * j) + select(near, b_bar, zero))
        store_vector(contact.pushes, 48 * i, 16, (x0, x1, x2))
    hand_to_nodes(mesh, contact, g)


@law
def repelled(mesh, contact, g, i):
    """What surface points hand to the nodes at a place of a component."""
    return vector(contact.nodal, 3 * g * mesh.component + i, mesh.component)


@law
def strayed(mesh, contact, g, i, d):
    """Whether nodes that move surface points have gone so far that pairs are to be listed again."""
    o = vector(contact.listed, 3 * g * mesh.component + i, mesh.component)
    way = d[0] - o[0], d[1] - o[1], d[2] - o[2]
    share = load(contact.watched, i)
    return any_lane(share * share * dot(way, way) > contact.slack)


@fast
def place_points(mesh, contact, states, g, state):
    """Find where all points of a body are."""
    for p in range(contact.count):
        put_place(mesh, contact, g, p, states, state)
