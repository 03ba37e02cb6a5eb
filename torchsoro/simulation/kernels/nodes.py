"""What happens on the grid nodes: momentum to velocity, gravity, contact; and the adjoint."""

import taichi as ti

from torchsoro.simulation.kernels.contact import (
    adhesive_speed,
    contact,
    in_contact,
    normal_of,
    plane_distance,
    response_adjoint,
)
from torchsoro.simulation.kernels.layout import (
    ADJOINT_FLIP,
    ADJOINT_MOVED,
    ADJOINT_NEW,
    BEFORE,
    NODE,
    NODE_MASS,
    NODE_MOVED,
    NODE_TRANSFER,
    NODE_VELOCITY,
    PLANE,
    PLANE_ADHESION,
    PLANE_FRICTION,
    PLANE_INTEGERS,
    PLANE_STICK,
)
from torchsoro.simulation.kernels.tensor import add, load_vector, store_vector


@ti.func
def node_position(box_low: ti.template(), origin: ti.template(), b, i, size, cell):
    """Position of node i of the active box of simulation b."""
    x = load_vector(origin, 3 * b, 1)
    x[0] += cell * (box_low[3 * b] + i // (size[1] * size[2]))
    x[1] += cell * (box_low[3 * b + 1] + (i // size[2]) % size[1])
    x[2] += cell * (box_low[3 * b + 2] + i % size[2])
    return x


@ti.func
def collect(
    partial: ti.template(),
    node: ti.template(),
    node_at,
    partial_before: ti.template(),
    before: ti.template(),
    before_at,
    both,
    b,
    i,
    batch,
    nodes,
    parts,
):
    """Sum the lanes' mass and momentum of a node, empty them, and keep mass and velocity."""
    # The zero takes the buffer's precision.
    mass = partial[0] * 0
    momentum = ti.Vector([mass, mass, mass])
    for w in range(parts):
        at = ((w * batch + b) * nodes + i) * NODE
        mass += partial[at + NODE_MASS]
        momentum += load_vector(partial, at + NODE_VELOCITY, 1)
        for c in ti.static(range(NODE)):
            partial[at + c] = 0
    # Divide wherever there is mass, with no floor: a void particle weighs 1e-12 kg and a floor would pin it.
    velocity = momentum
    if mass > 0:
        velocity = momentum / mass
    node[node_at + NODE_MASS] = mass
    store_vector(node, node_at + NODE_VELOCITY, 1, velocity)
    if both:
        momentum *= 0
        for w in range(parts):
            at = ((w * batch + b) * nodes + i) * BEFORE
            momentum += load_vector(partial_before, at, 1)
            for c in ti.static(range(BEFORE)):
                partial_before[at + c] = 0
        if mass > 0:
            momentum /= mass
        store_vector(before, before_at, 1, momentum)


@ti.func
def move(
    node: ti.template(),
    node_at,
    before: ti.template(),
    before_at,
    new: ti.template(),
    new_at,
    gravity: ti.template(),
    gravity_at,
    planes: ti.template(),
    plane_kind: ti.template(),
    planes_at,
    plane_count,
    x,
    cell,
    dt,
    blend,
):
    """Gravity and contact; the transferred velocity is (1 - blend) u' + blend (u' - u_before)."""
    mass = node[node_at + NODE_MASS]
    u = load_vector(node, node_at + NODE_VELOCITY, 1)
    moved = u
    if mass > 0:
        moved = contact(
            planes,
            plane_kind,
            planes_at,
            plane_count,
            x,
            mass,
            u + dt * load_vector(gravity, gravity_at, 1),
            cell,
            dt,
        )
    store_vector(new, new_at + NODE_MOVED, 1, moved)
    if blend > 0:
        store_vector(new, new_at + NODE_TRANSFER, 1, moved - blend * load_vector(before, before_at, 1))


@ti.func
def node_adjoint(
    atomic: ti.template(),
    partial: ti.template(),
    node: ti.template(),
    node_at,
    bar: ti.template(),
    bar_at,
    before: ti.template(),
    before_at,
    before_bar: ti.template(),
    before_bar_at,
    both,
    gravity: ti.template(),
    gravity_at,
    gravity_bar: ti.template(),
    gravity_bar_at,
    planes: ti.template(),
    plane_kind: ti.template(),
    planes_at,
    planes_bar: ti.template(),
    planes_bar_at,
    plane_count,
    x,
    cell,
    dt,
    b,
    i,
    batch,
    nodes,
    parts,
):
    """Adjoint of :func:`collect` and :func:`move`: gradients by a node's momentum and mass, gravity and planes."""
    mass = node[node_at + NODE_MASS]
    zero = mass * 0
    moved_bar = ti.Vector([zero, zero, zero])
    flip_bar = ti.Vector([zero, zero, zero])
    for w in range(parts):
        at = ((w * batch + b) * nodes + i) * ADJOINT_NEW
        moved_bar += load_vector(partial, at + ADJOINT_MOVED, 1)
        flip_bar += load_vector(partial, at + ADJOINT_FLIP, 1)
        for c in ti.static(range(ADJOINT_NEW)):
            partial[at + c] = 0
    momentum_bar = moved_bar * 0
    mass_bar = zero
    if mass > 0:
        u = load_vector(node, node_at + NODE_VELOCITY, 1)
        pushed = u + dt * load_vector(gravity, gravity_at, 1)
        impulse = cell * cell * dt
        for back in range(plane_count):
            k = plane_count - 1 - back
            distance = plane_distance(planes, plane_kind, planes_at, k, x, cell)
            hold = adhesive_speed(planes, planes_at, k, distance, mass, impulse)
            n = normal_of(plane_kind, k, u)
            arriving = contact(planes, plane_kind, planes_at, k, x, mass, pushed, cell, dt)
            if in_contact(distance):
                stick = plane_kind[PLANE_INTEGERS * k + PLANE_STICK]
                friction = planes[planes_at + PLANE * k + PLANE_FRICTION]
                u_bar, friction_bar, hold_bar = response_adjoint(arriving, n, stick, friction, hold, moved_bar)
                moved_bar = u_bar
                add(atomic, planes_bar, planes_bar_at + PLANE * k + PLANE_FRICTION, friction_bar)
                if distance > -0.5:
                    add(atomic, planes_bar, planes_bar_at + PLANE * k + PLANE_ADHESION, hold_bar * impulse / mass)
                    mass_bar -= hold_bar * hold / mass
        for c in ti.static(range(3)):
            add(atomic, gravity_bar, gravity_bar_at + c, dt * moved_bar[c])
        momentum_bar = moved_bar / mass
        mass_bar -= momentum_bar.dot(u)
        flip_bar = -flip_bar / mass
        if both:
            mass_bar -= flip_bar.dot(load_vector(before, before_at, 1))
    bar[bar_at + NODE_MASS] = mass_bar
    store_vector(bar, bar_at + NODE_VELOCITY, 1, momentum_bar)
    if both:
        store_vector(before_bar, before_bar_at, 1, flip_bar)
