"""One substep forward: nodes, then every particle gathers, updates its state, and scatters for the next substep.

Fusing the gather of one substep with the scatter of the next leaves one pass over the particles per substep. On a CPU
the particles are cut into lanes, each with a grid of its own that the node pass adds up in a fixed order, so that a
run has the same bits whatever the number of threads; on a GPU every particle is a lane, in the order of the cells,
and the grid is shared.
"""

import taichi as ti

from torchsoro.simulation.kernels.constitutive import deform, stress
from torchsoro.simulation.kernels.layout import (
    ACTIVE,
    AFFINE,
    ANCHOR,
    BEFORE,
    COEFFICIENTS,
    DRAG,
    FLAG_LEFT_BOX,
    MASS,
    NODE,
    NODE_NEW,
    NOW,
    PLANE,
    POSITION,
    PRONY,
    SPRING,
    VELOCITY,
    VOLUME,
)
from torchsoro.simulation.kernels.nodes import collect, move, node_position
from torchsoro.simulation.kernels.spline import base_node
from torchsoro.simulation.kernels.tensor import (
    load_matrix,
    load_vector,
    store_matrix,
    store_vector,
)
from torchsoro.simulation.kernels.transfer import grid_to_particle, particle_to_grid
from torchsoro.simulation.kernels.warp import shared

Reals = ti.types.ndarray(ndim=1)
Integers = ti.types.ndarray(dtype=ti.i32, ndim=1)

# Numbers handed over in the working precision.
DT, CELL, INVERSE_CELL, BLEND = 0, 1, 2, 3

# Taichi hands a CPU thread no fewer than 512 iterations of a loop: a lane is that many, of which one works.
CPU_UNIT = 512

# Threads of a block on a GPU. So many make the compiler keep to 128 registers, and 16 warps run at a time.
BLOCK = 256


@ti.func
def lowest_node(x, inverse_cell, box_low: ti.template(), b, size, flags: ti.template()):
    """Lowest node of a particle in the active box; a particle outside is flagged and kept inside memory."""
    base = base_node(x, inverse_cell)
    for c in ti.static(range(3)):
        local = base[c] - box_low[3 * b + c]
        if local < 0 or local > size[c] - 3:
            flags[FLAG_LEFT_BOX] = 1
            base[c] = ti.max(0, ti.min(local, size[c] - 3)) + box_low[3 * b + c]
    return base


@ti.func
def place(x, low, inverse_cell, box_low: ti.template(), b, size, flags: ti.template()):
    """A particle's place above its lowest node, in cells, and the number of that node in the active box."""
    base = lowest_node(x - low, inverse_cell, box_low, b, size, flags)
    f = (x - low) * inverse_cell - base
    node0 = (base[0] - box_low[3 * b]) * (size[1] * size[2]) + (base[1] - box_low[3 * b + 1]) * size[2]
    node0 += base[2] - box_low[3 * b + 2]
    return f, node0


@ti.func
def external_force(
    coefficients: ti.template(),
    mat,
    particles,
    p,
    springs,
    force: ti.template(),
    force_at,
    share: ti.template(),
    groups,
    x,
    v,
):
    """Shares of the group forces, spring to an anchor, linear drag [N]."""
    f = x * 0
    for g in range(groups):
        f += share[g * particles + p] * load_vector(force, force_at + 3 * g, 1)
    if springs == 1:
        spring = coefficients[mat + SPRING * particles]
        drag = coefficients[mat + DRAG * particles]
        f += spring * (load_vector(coefficients, mat + ANCHOR * particles, particles) - x) - drag * v
    return f


@ti.kernel
def substep(
    gpu: ti.template(),
    serial_nodes: ti.template(),
    stiffens: ti.template(),
    clock: Integers,
    numbers: Reals,
    state: Reals,
    coefficients: Reals,
    kind: Integers,
    order: Integers,
    prony: Reals,
    pressure: Reals,
    gravity: Reals,
    force: Reals,
    share: Reals,
    planes: Reals,
    plane_kind: Integers,
    origin: Reals,
    box_low: Integers,
    grid: Reals,
    node: Reals,
    grid_before: Reals,
    before: Reals,
    new: Reals,
    flags: Integers,
    batch: ti.i32,
    particles: ti.i32,
    lanes: ti.i32,
    components: ti.i32,
    elements: ti.i32,
    chambers: ti.i32,
    groups: ti.i32,
    springs: ti.i32,
    plane_count: ti.i32,
    nx: ti.i32,
    ny: ti.i32,
    nz: ti.i32,
    first: ti.i32,
    steps: ti.i32,
    ring: ti.i32,
    node_ring: ti.i32,
):
    """Advance by one substep; clock[NOW] counts from -1 (scatter only) to ``steps`` - 1 within a chunk.

    The pass over the nodes reads clock[NOW] and the one over the particles clock[ACTIVE]; each sets the other's.
    """
    unit = ti.static(1 if gpu else CPU_UNIT)
    # Bounds of both loops before the first: else a GPU has a task of its own for each.
    all_nodes = batch * nx * ny * nz
    all_lanes = batch * lanes * unit
    if ti.static(serial_nodes):
        ti.loop_config(serialize=True)
    for w in range(all_nodes):
        s = clock[NOW]
        if w == 0:
            clock[ACTIVE] = s
        if s >= 0:
            nodes = nx * ny * nz
            b = w // nodes
            i = w % nodes
            cell = numbers[CELL]
            parts = lanes
            if ti.static(gpu):
                parts = 1
            node_at = (((s % node_ring) * batch + b) * nodes + i) * NODE
            before_at = (((s % node_ring) * batch + b) * nodes + i) * BEFORE
            both = numbers[BLEND] > 0
            collect(grid, node, node_at, grid_before, before, before_at, both, b, i, batch, nodes, parts)
            move(
                *(node, node_at, before, before_at, new, (b * nodes + i) * NODE_NEW),
                *(gravity, ((first + s) * batch + b) * 3),
                *(planes, plane_kind, b * plane_count * PLANE, plane_count),
                node_position(box_low, origin, b, i, ti.Vector([nx, ny, nz]), cell),
                *(cell, numbers[DT], numbers[BLEND]),
            )
    if ti.static(gpu):
        ti.loop_config(block_dim=BLOCK)
    for w in range(all_lanes):
        s = clock[ACTIVE]
        if w == 0:
            clock[NOW] = s + 1
        if w % unit == 0:
            pool, marks = ti.static(shared(gpu, BLOCK, grid))
            nodes = nx * ny * nz
            b = w // unit // lanes
            lane = w // unit % lanes
            dt = numbers[DT]
            cell = numbers[CELL]
            inverse_cell = numbers[INVERSE_CELL]
            blend = numbers[BLEND]
            size = ti.Vector([nx, ny, nz])
            plane = ny * nz
            low = load_vector(origin, 3 * b, 1)
            prony_at = b * elements * PRONY
            mat = b * COEFFICIENTS * particles
            each = (particles + lanes - 1) // lanes
            begin, end, part = lane * each, ti.min(particles, (lane + 1) * each), lane
            if ti.static(gpu):
                begin, end, part = lane, lane + 1, 0
            step = first + s + 1
            for n in range(begin, end):
                p = n
                live = True
                if ti.static(gpu):
                    live = order[b * lanes + n] >= 0
                    p = ti.max(order[b * lanes + n], 0)
                phase = kind[p]
                out = ((step % ring) * batch + b) * components * particles + p
                if s >= 0 and live:
                    at = (((first + s) % ring) * batch + b) * components * particles + p
                    x = load_vector(state, at + POSITION * particles, particles)
                    v = load_vector(state, at + VELOCITY * particles, particles)
                    f, node0 = place(x, low, inverse_cell, box_low, b, size, flags)
                    u, moment, r = grid_to_particle(new, b * nodes * NODE_NEW, node0, nz, plane, f, blend > 0)
                    L = moment * (4 * inverse_cell)
                    store_vector(state, out + POSITION * particles, particles, x + dt * u)
                    store_vector(state, out + VELOCITY * particles, particles, blend * v + r)
                    store_matrix(state, out + AFFINE * particles, particles, L)
                    deform(
                        *(stiffens, state, at, out, coefficients, mat + p, particles),
                        *(prony, prony_at, elements, phase, dt * L, flags),
                    )
                if s + 1 < steps:
                    # A thread without a particle adds nothing, but takes part in its warp's sums.
                    mass = dt * 0
                    f, node0 = low * 0, -1
                    q, q_before = low * 0, low * 0
                    A = low.outer_product(low) * 0
                    A_before = A
                    if live:
                        x = load_vector(state, out + POSITION * particles, particles)
                        v = load_vector(state, out + VELOCITY * particles, particles)
                        C = load_matrix(state, out + AFFINE * particles, particles)
                        mass = coefficients[mat + MASS * particles + p]
                        volume = coefficients[mat + VOLUME * particles + p]
                        tau = stress(
                            *(stiffens, state, out, coefficients, mat + p, particles),
                            *(prony, prony_at, elements, phase, pressure, (step * batch + b) * chambers),
                        )
                        push = external_force(
                            *(coefficients, mat + p, particles, p, springs),
                            *(force, (step * batch + b) * groups * 3, share, groups, x, v),
                        )
                        A_before = (mass * cell) * C
                        A = A_before - (dt * volume * 4 * inverse_cell) * tau
                        q_before = mass * v
                        q = q_before + dt * push
                        f, node0 = place(x, low, inverse_cell, box_low, b, size, flags)
                    particle_to_grid(
                        *(gpu, pool, marks, w % BLOCK),
                        *(grid, (part * batch + b) * nodes * NODE),
                        *(grid_before, (part * batch + b) * nodes * BEFORE, blend > 0),
                        *(node0, nz, plane, f, mass, q, A, q_before, A_before),
                    )
