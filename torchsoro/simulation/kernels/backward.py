"""One substep backward: the adjoint of ``forward.substep``, from the kept states and node velocities.

The adjoint state lies in one buffer that each pass overwrites in place. A pass finishes the scatter of substep t + 1
and begins the gather of substep t, so that a caller may add its own gradients by the state after t + 1 substeps
between two passes. Sums over particles or nodes (pressure, gravity, ...) go to rows, one for each lane, added up later.
"""

import taichi as ti

from torchsoro.simulation.kernels.constitutive import deform_adjoint, stress, stress_adjoint
from torchsoro.simulation.kernels.forward import (
    BLEND,
    CELL,
    CPU_UNIT,
    DT,
    INVERSE_CELL,
    Integers,
    Reals,
    external_force,
    place,
)
from torchsoro.simulation.kernels.layout import (
    ACTIVE,
    ADJOINT_NEW,
    AFFINE,
    ANCHOR,
    BEFORE,
    COEFFICIENTS,
    DRAG,
    MASS,
    NODE,
    NODE_NEW,
    NODE_VELOCITY,
    NOW,
    PLANE,
    POSITION,
    PRONY,
    SPRING,
    VELOCITY,
    VOLUME,
)
from torchsoro.simulation.kernels.nodes import move, node_adjoint, node_position
from torchsoro.simulation.kernels.tensor import (
    add,
    contract,
    load_matrix,
    load_vector,
    store_matrix,
    store_vector,
)
from torchsoro.simulation.kernels.transfer import grid_to_particle_adjoint, particle_to_grid_adjoint
from torchsoro.simulation.kernels.warp import shared

BLOCK = 256  # as in ``forward``; here some registers go to memory for it


@ti.kernel
def substep_adjoint(
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
    bar: Reals,
    node_bar: Reals,
    before_bar: Reals,
    coefficients_bar: Reals,
    prony_bar: Reals,
    pressure_bar: Reals,
    gravity_bar: Reals,
    force_bar: Reals,
    planes_bar: Reals,
    origin_bar: Reals,
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
    node_lanes: ti.i32,
    rows: ti.i32,
    want_prony: ti.i32,
):
    """Go back by one substep; clock[NOW] counts from ``steps`` - 1 down to -1 (scatter of the first substep only)."""
    unit = ti.static(1 if gpu else CPU_UNIT)
    all_nodes = batch * node_lanes * unit
    all_lanes = batch * lanes * unit
    if ti.static(serial_nodes):
        ti.loop_config(serialize=True)
    for w in range(all_nodes):
        t = clock[NOW]
        if w == 0:
            clock[ACTIVE] = t
        if w % unit == 0:
            nodes = nx * ny * nz
            b = w // unit // node_lanes
            lane = w // unit % node_lanes
            row = lane % rows
            cell = numbers[CELL]
            dt = numbers[DT]
            parts = lanes
            if ti.static(gpu):
                parts = 1
            each = (nodes + node_lanes - 1) // node_lanes
            for i in range(lane * each, ti.min(nodes, (lane + 1) * each)):
                x = node_position(box_low, origin, b, i, ti.Vector([nx, ny, nz]), cell)
                if t + 1 < steps:
                    time = first + t + 1
                    node_adjoint(
                        *(gpu, grid, node, (((t + 1) * batch + b) * nodes + i) * NODE),
                        *(node_bar, (b * nodes + i) * NODE),
                        *(before, (((t + 1) * batch + b) * nodes + i) * BEFORE),
                        *(before_bar, (b * nodes + i) * BEFORE, numbers[BLEND] > 0),
                        *(gravity, (time * batch + b) * 3, gravity_bar, ((time * rows + row) * batch + b) * 3),
                        *(planes, plane_kind, b * plane_count * PLANE),
                        *(planes_bar, (row * batch + b) * plane_count * PLANE, plane_count),
                        *(x, cell, dt, b, i, batch, nodes, parts),
                    )
                if t >= 0:
                    move(
                        *(node, ((t * batch + b) * nodes + i) * NODE),
                        *(before, ((t * batch + b) * nodes + i) * BEFORE),
                        *(new, (b * nodes + i) * NODE_NEW),
                        *(gravity, ((first + t) * batch + b) * 3),
                        *(planes, plane_kind, b * plane_count * PLANE, plane_count),
                        *(x, cell, dt, numbers[BLEND]),
                    )
    if ti.static(gpu):
        ti.loop_config(block_dim=BLOCK)
    for w in range(all_lanes):
        t = clock[ACTIVE]
        if w == 0:
            clock[NOW] = t - 1
        if w % unit == 0:
            pool, marks = ti.static(shared(gpu, BLOCK, grid))
            nodes = nx * ny * nz
            b = w // unit // lanes
            lane = w // unit % lanes
            row = lane % rows
            dt = numbers[DT]
            cell = numbers[CELL]
            inverse_cell = numbers[INVERSE_CELL]
            blend = numbers[BLEND]
            size = ti.Vector([nx, ny, nz])
            plane = ny * nz
            low = load_vector(origin, 3 * b, 1)
            prony_at = b * elements * PRONY
            prony_row = (row * batch + b) * elements * PRONY
            mat0 = b * COEFFICIENTS * particles
            each = (particles + lanes - 1) // lanes
            begin, end, part = lane * each, ti.min(particles, (lane + 1) * each), lane
            if ti.static(gpu):
                begin, end, part = lane, lane + 1, 0
            for n in range(begin, end):
                p = n
                live = True
                if ti.static(gpu):
                    live = order[b * lanes + n] >= 0
                    p = ti.max(order[b * lanes + n], 0)
                phase = kind[p]
                mat = mat0 + p
                here = b * components * particles + p
                slot = ((first + t + 1) * batch + b) * components * particles + p
                f_bar = low * 0
                if t + 1 < steps and live:
                    time = first + t + 1
                    pressure_at = (time * batch + b) * chambers
                    force_at = (time * batch + b) * groups * 3
                    x = load_vector(state, slot + POSITION * particles, particles)
                    v = load_vector(state, slot + VELOCITY * particles, particles)
                    C = load_matrix(state, slot + AFFINE * particles, particles)
                    mass = coefficients[mat + MASS * particles]
                    volume = coefficients[mat + VOLUME * particles]
                    tau = stress(
                        *(stiffens, state, slot, coefficients, mat, particles),
                        *(prony, prony_at, elements, phase, pressure, pressure_at),
                    )
                    push = external_force(
                        coefficients, mat, particles, p, springs, force, force_at, share, groups, x, v
                    )
                    per_volume = dt * 4 * inverse_cell
                    A = (mass * cell) * C - (per_volume * volume) * tau
                    f, node0 = place(x, low, inverse_cell, box_low, b, size, flags)
                    mass_bar, q_bar, A_bar, by_f = particle_to_grid_adjoint(
                        *(node_bar, b * nodes * NODE, NODE, NODE_VELOCITY),
                        *(node0, nz, plane, f, mass, mass * v + dt * push, A),
                    )
                    add(False, coefficients_bar, mat + VOLUME * particles, -(per_volume * contract(tau, A_bar)))
                    push_bar = dt * q_bar
                    tau_bar = (-per_volume * volume) * A_bar
                    if blend > 0:
                        _mass, q_more, A_more, f_more = particle_to_grid_adjoint(
                            *(before_bar, b * nodes * BEFORE, BEFORE, 0),
                            *(node0, nz, plane, f, mass, mass * v, (mass * cell) * C),
                        )
                        q_bar += q_more
                        A_bar += A_more
                        by_f += f_more
                    f_bar += by_f
                    mass_bar += v.dot(q_bar) + cell * contract(C, A_bar)
                    add(False, coefficients_bar, mat + MASS * particles, mass_bar)
                    x_bar = load_vector(bar, here + POSITION * particles, particles)
                    v_bar = load_vector(bar, here + VELOCITY * particles, particles) + mass * q_bar
                    C_bar = load_matrix(bar, here + AFFINE * particles, particles) + (mass * cell) * A_bar
                    if springs == 1:
                        spring = coefficients[mat + SPRING * particles]
                        drag = coefficients[mat + DRAG * particles]
                        anchor = load_vector(coefficients, mat + ANCHOR * particles, particles)
                        x_bar -= spring * push_bar
                        v_bar -= drag * push_bar
                        add(False, coefficients_bar, mat + SPRING * particles, push_bar.dot(anchor - x))
                        add(False, coefficients_bar, mat + DRAG * particles, -(push_bar.dot(v)))
                        for c in ti.static(range(3)):
                            add(False, coefficients_bar, mat + (ANCHOR + c) * particles, spring * push_bar[c])
                    for g in range(groups):
                        force_bar_at = ((time * rows + row) * batch + b) * groups * 3 + 3 * g
                        for c in ti.static(range(3)):
                            add(gpu, force_bar, force_bar_at + c, share[g * particles + p] * push_bar[c])
                    C_bar += stress_adjoint(
                        *(stiffens, gpu, state, slot, bar, here, coefficients, coefficients_bar, mat, particles),
                        *(prony, prony_at, prony_bar, prony_row, want_prony, elements, phase),
                        *(pressure, pressure_at, pressure_bar, ((time * rows + row) * batch + b) * chambers),
                        tau_bar,
                    )
                    store_vector(bar, here + POSITION * particles, particles, x_bar + inverse_cell * by_f)
                    store_vector(bar, here + VELOCITY * particles, particles, v_bar)
                    store_matrix(bar, here + AFFINE * particles, particles, C_bar)
                if t >= 0:
                    # A thread without a particle adds nothing, but takes part in its warp's sums.
                    f, node0 = low * 0, -1
                    x_bar, v_bar = low * 0, low * 0
                    none = low.outer_product(low) * 0
                    L_bar = none
                    if live:
                        at = ((first + t) * batch + b) * components * particles + p
                        x = load_vector(state, at + POSITION * particles, particles)
                        L = load_matrix(state, slot + AFFINE * particles, particles)
                        x_bar = load_vector(bar, here + POSITION * particles, particles)
                        v_bar = load_vector(bar, here + VELOCITY * particles, particles)
                        L_bar = load_matrix(bar, here + AFFINE * particles, particles)
                        L_bar += dt * deform_adjoint(
                            *(
                                stiffens,
                                gpu,
                                state,
                                at,
                                slot,
                                bar,
                                here,
                                coefficients,
                                coefficients_bar,
                                mat,
                                particles,
                            ),
                            *(prony, prony_at, prony_bar, prony_row, want_prony, elements, phase, dt * L),
                        )
                        f, node0 = place(x, low, inverse_cell, box_low, b, size, flags)
                    by_f = grid_to_particle_adjoint(
                        *(gpu, pool, marks, w % BLOCK, new, b * nodes * NODE_NEW),
                        *(grid, (part * batch + b) * nodes * ADJOINT_NEW),
                        *(node0, nz, plane, f, blend, dt * x_bar, (4 * inverse_cell) * L_bar, v_bar),
                    )
                    f_bar += by_f
                    if live:
                        store_vector(bar, here + POSITION * particles, particles, x_bar + inverse_cell * by_f)
                        store_vector(bar, here + VELOCITY * particles, particles, blend * v_bar)
                        store_matrix(bar, here + AFFINE * particles, particles, none)
                if live:
                    for c in ti.static(range(3)):
                        add(gpu, origin_bar, (row * batch + b) * 3 + c, -inverse_cell * f_bar[c])
