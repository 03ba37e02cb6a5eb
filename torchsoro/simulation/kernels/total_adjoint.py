"""One substep backward of the total-Lagrangian form: nodes, then points, from the kept states.

The adjoint state lies in one buffer, laid out as the state, that each pass overwrites in place. A pass finishes the
sums over substep t + 1 and begins substep t, so that a caller may add its own gradients by the state after t + 1
substeps between two passes.
"""

import taichi as ti

from torchsoro.simulation.kernels.forward import (
    CPU_UNIT,
    Integers,
    Reals,
)
from torchsoro.simulation.kernels.lattice import gather_value, nodes_per_axis, points_per_axis, product
from torchsoro.simulation.kernels.layout import (
    BATCH,
    BLOCKS,
    CHAMBER,
    CHAMBER_BAR,
    CHAMBER_NUMBERS,
    CHAMBER_STIFFNESS,
    CHAMBER_VOLUME,
    CHAMBERS,
    FORCE_BAR,
    FORCES,
    GRAVITY,
    GRAVITY_BAR,
    GROUPS,
    HEAD,
    KIND,
    NEAR_NODES,
    NODAL,
    NODAL_DRAG_FACTOR,
    NODAL_MASS,
    NODES,
    NODES_BAR,
    PAD,
    PADS,
    PARTIALS,
    PLANES,
    PRESSURE_BAR,
    PUSHED,
    SHARE,
    SHARED,
    SLOT,
    SLOT_CHAMBER,
    SLOTS,
    SOURCES,
    STEP_SIZE,
    STEPS,
    SURFACES,
    SWEPT,
    TALLIES,
    TILE,
    VISCOUS,
    VOLUME_BAR,
    VOLUMES,
)
from torchsoro.simulation.kernels.surface import (
    surface_response_adjoint,
    surface_spread,
)
from torchsoro.simulation.kernels.tensor import (
    add,
    contract,
    load_vector,
    store_vector,
)
from torchsoro.simulation.kernels.tile import (
    ALONE,
    KEPT,
    TOTALS,
    chamber_slots,
    meet,
    node_chunks,
    point_of,
    stage,
    stage_axes,
    sum_chambers,
    sum_tile,
    sum_tiles,
    sync,
    thread,
    tile_box,
    tile_count,
    tile_gradient,
)
from torchsoro.simulation.kernels.total import (
    chamber_share,
    state_length,
)
from torchsoro.simulation.kernels.total_points_adjoint import rate_point_adjoint, stress_point_adjoint


@ti.func
def node_adjoint(
    head: ti.template(),
    ints: ti.template(),
    fixed: ti.template(),
    supply: ti.template(),
    state: ti.template(),
    kept: ti.template(),
    scratch: ti.template(),
    bar: ti.template(),
    back: ti.template(),
    sums: ti.template(),
    pad: ti.template(),
    base,
    t,
    b,
    i,
    rates: ti.template(),
):
    """Finish the gradient by the place of node i after t + 1 substeps, and go back to the force on it in substep t."""
    nodes, chambers = product(nodes_per_axis(head)), head[CHAMBERS]
    here = b * state_length(head) + i
    mass = fixed[head[NODES] + (b * NODAL + NODAL_MASS) * nodes + i]
    if mass > 0:
        d_bar = load_vector(bar, here, nodes)
        v_bar = load_vector(bar, here + 3 * nodes, nodes)
        if t + 1 < head[STEPS]:
            partials = head[PARTIALS] + b * head[SLOTS] * SLOT
            d_bar += sum_tiles(fixed, ints, scratch, partials, head[SOURCES], i, nodes)
            for k in range(chambers):
                if ints[head[NEAR_NODES] + k * nodes + i] == 1:
                    one = b * chambers + k
                    by_volume = chamber_volume_bar(head, fixed, pad[base + TOTALS + k], one)
                    table = head[SOURCES] + (k + 1) * SHARED * nodes
                    d_bar += by_volume * sum_tiles(fixed, ints, scratch, partials, table, i, nodes)
            if head[PLANES] > 0:
                after = ((t + 1) * head[BATCH] + b) * state_length(head)
                d_bar += surface_spread(ints, fixed, state, after, back, (t + 1) % 2, b, i)
            if ti.static(rates):
                if head[VISCOUS] == 1:
                    rates_at = partials + (tile_count(head) + chamber_slots(head, ints)) * SLOT
                    v_bar += sum_tiles(fixed, ints, scratch, rates_at, head[SOURCES], i, nodes)
            store_vector(bar, here, nodes, d_bar)
        if t >= 0:
            dt = fixed[STEP_SIZE]
            slot = t * head[BATCH] + b
            at = slot * state_length(head)
            v = load_vector(state, at + 3 * nodes + i, nodes)
            u = load_vector(kept, head[PUSHED] + slot * 3 * nodes + i, nodes)
            v_bar += dt * d_bar
            mass_bar = mass * 0
            if head[PLANES] > 0:
                u_bar, by_surface, by_mass = surface_response_adjoint(
                    ints, fixed, state, at, sums, b, i, mass, u, v_bar, dt * d_bar
                )
                v_bar, mass_bar = u_bar, by_mass
                surfaces = head[SURFACES] + ((t % 2) * head[BATCH] + b) * 3 * nodes
                store_vector(back, surfaces + i, nodes, by_surface)
            drag_factor = fixed[head[NODES] + (b * NODAL + NODAL_DRAG_FACTOR) * nodes + i]
            add(False, sums, head[NODES_BAR] + (b * NODAL + NODAL_DRAG_FACTOR) * nodes + i, u.dot(v_bar) / drag_factor)
            v_bar *= drag_factor
            pull = dt * load_vector(supply, head[GRAVITY] + slot * 3, 1)
            mass_bar -= (u / drag_factor - v - pull).dot(v_bar) / mass
            add(False, sums, head[NODES_BAR] + (b * NODAL + NODAL_MASS) * nodes + i, mass_bar)
            store_vector(back, head[FORCES] + b * 3 * nodes + i, nodes, (dt / mass) * v_bar)
        store_vector(bar, here + 3 * nodes, nodes, v_bar)


@ti.func
def chamber_volume_bar(head: ti.template(), fixed: ti.template(), p_bar, one):
    """Gradient by a chamber's volume, from that by its pressure."""
    at = head[CHAMBER_NUMBERS] + one * CHAMBER
    return -p_bar * fixed[at + CHAMBER_STIFFNESS] / fixed[at + CHAMBER_VOLUME]


@ti.func
def chamber_adjoint(
    head: ti.template(),
    fixed: ti.template(),
    kept: ti.template(),
    back: ti.template(),
    sums: ti.template(),
    t,
    one,
    p_bar,
):
    """Gradients by the pressure, stiffness and volumes of a chamber in substep t."""
    volume_bar = chamber_volume_bar(head, fixed, p_bar, one)
    step = t * head[BATCH] * head[CHAMBERS] + one
    ratio = kept[head[VOLUMES] + step] / fixed[head[CHAMBER_NUMBERS] + one * CHAMBER + CHAMBER_VOLUME]
    mine = head[CHAMBER_BAR] + one * CHAMBER
    add(False, sums, mine + CHAMBER_STIFFNESS, -p_bar * (ratio - 1))
    add(False, sums, mine + CHAMBER_VOLUME, -volume_bar * ratio)
    add(False, sums, head[PRESSURE_BAR] + step, p_bar)
    back[head[VOLUME_BAR] + one] = volume_bar


@ti.func
def tally(
    head: ti.template(),
    ints: ti.template(),
    fixed: ti.template(),
    bar: ti.template(),
    back: ti.template(),
    sums: ti.template(),
    t,
    b,
    row,
):
    """One share of the sums over all nodes and points that gravity and group forces of substep t need."""
    nodes, points, tallies = product(nodes_per_axis(head)), product(points_per_axis(head)), head[TALLIES]
    mine = (t * tallies + row) * head[BATCH] + b
    velocity = b * state_length(head) + 3 * nodes
    total = load_vector(fixed, 0, 1) * 0
    for m in range((nodes + tallies - 1) // tallies):
        i = row + m * tallies
        if i < nodes and fixed[head[NODES] + (b * NODAL + NODAL_MASS) * nodes + i] > 0:
            total += load_vector(bar, velocity + i, nodes)
    store_vector(sums, head[GRAVITY_BAR] + 3 * mine, 1, fixed[STEP_SIZE] * total)
    for g in range(head[GROUPS]):
        total *= 0
        for m in range((points + tallies - 1) // tallies):
            i = row + m * tallies
            if i < points and fixed[head[SHARE] + g * points + i] != 0:
                by_push = gather_value(head, ints, fixed, back, head[FORCES] + b * 3 * nodes, i)
                total += fixed[head[SHARE] + g * points + i] * by_push
        store_vector(sums, head[FORCE_BAR] + 3 * (mine * head[GROUPS] + g), 1, total)


@ti.func
def point_pass_adjoint(
    gpu: ti.template(),
    loaded: ti.template(),
    stiffens: ti.template(),
    head: ti.template(),
    ints: ti.template(),
    fixed: ti.template(),
    supply: ti.template(),
    state: ti.template(),
    kept: ti.template(),
    scratch: ti.template(),
    bar: ti.template(),
    back: ti.template(),
    sums: ti.template(),
    pad: ti.template(),
    base,
    item,
    fresh,
    t,
    q0,
    q1,
):
    """Adjoint of ``total.point_pass``."""
    cell, cells, node, first, last, b, tile = tile_box(gpu, fresh, head, ints, item, q0)
    nodes = product(nodes_per_axis(head))
    at = (ti.max(t, 0) * head[BATCH] + b) * state_length(head)
    viscous = ti.cast(0, ti.i32)
    if fresh == 1:
        stage_axes(gpu, head, fixed, pad, base, cell, cells, q0, q1)
    stage(gpu, head, state, at, pad, base, 0, node, q0, q1)
    stage(gpu, head, back, head[FORCES] + b * 3 * nodes, pad, base, 1, node, q0, q1)
    if ti.static(loaded):
        viscous = head[VISCOUS]
        if viscous == 1:
            stage(gpu, head, state, at + 3 * nodes, pad, base, 2, node, q0, q1)
    sync(gpu)
    partials = head[PARTIALS] + b * head[SLOTS] * SLOT
    for slot in range(first - 1, last + viscous):
        # The tile's own slot, then those of the chambers that it has points of, then that of the rates of F.
        out = partials + tile * SLOT
        alone = ti.cast(-1, ti.i32)
        if slot < first:
            for each in range(q0, q1):
                q = thread(gpu, head, each)
                p = point_of(head, cell, cells, q)
                stress_point_adjoint(
                    *(loaded, stiffens, head, ints, fixed, supply, state, kept, bar, back, sums),
                    *(pad, base, q, t, b, p),
                )
        elif slot < last:
            out = partials + (tile_count(head) + slot) * SLOT
            alone = head[SWEPT] + b * chamber_slots(head, ints) + ints[head[SLOT_CHAMBER] + 2 * slot + 1]
            for each in range(q0, q1):
                q = thread(gpu, head, each)
                p = point_of(head, cell, cells, q)
                mine = ti.cast(0, ti.i32)
                if p >= 0:
                    mine = ti.cast(ints[head[KIND] + p] == ints[head[SLOT_CHAMBER] + 2 * slot], ti.i32)
                volume, _, cof = chamber_share(head, fixed, pad, base, q, b, p, mine)
                P_bar = tile_gradient(pad, base, 1, ti.select(mine == 1, q, 0))
                pad[base + ALONE + q] = volume * contract(P_bar, cof)
        else:
            out = partials + (tile_count(head) + chamber_slots(head, ints) + tile) * SLOT
            if ti.static(loaded):
                stage(gpu, head, state, at + 3 * nodes, pad, base, 2, node, q0, q1)  # lines have been there
                sync(gpu)
                for each in range(q0, q1):
                    q = thread(gpu, head, each)
                    p = point_of(head, cell, cells, q)
                    rate_point_adjoint(head, ints, fixed, pad, base, q, b, p)
        sync(gpu)
        own = ti.cast(slot < first, ti.i32)
        sum_tile(gpu, loaded, head, pad, base, own, scratch, out, scratch, alone, q0, q1)


@ti.func
def node_pass_adjoint(
    gpu: ti.template(),
    loaded: ti.template(),
    head: ti.template(),
    ints: ti.template(),
    fixed: ti.template(),
    supply: ti.template(),
    state: ti.template(),
    kept: ti.template(),
    scratch: ti.template(),
    bar: ti.template(),
    back: ti.template(),
    sums: ti.template(),
    pad: ti.template(),
    base,
    item,
    t,
    q0,
    q1,
):
    """Adjoint of ``total.node_pass``."""
    nodes, chambers = product(nodes_per_axis(head)), head[CHAMBERS]
    b, chunk = item // node_chunks(head), item % node_chunks(head)
    sum_chambers(gpu, head, ints, fixed, scratch, pad, base, b, q0, q1)
    for each in range(q0, q1):
        q = thread(gpu, head, each)
        i = chunk * TILE + q
        if i < chambers and t + 1 < head[STEPS]:
            chamber_adjoint(head, fixed, kept, back, sums, t + 1, b * chambers + i, pad[base + TOTALS + i])
        if i < nodes:
            node_adjoint(head, ints, fixed, supply, state, kept, scratch, bar, back, sums, pad, base, t, b, i, loaded)
    sync(gpu)


@ti.kernel
def total_substep_adjoint(
    loaded: ti.template(),
    stiffens: ti.template(),
    t: ti.i32,
    ints: Integers,
    fixed: Reals,
    supply: Reals,
    state: Reals,
    kept: Reals,
    scratch: Reals,
    bar: Reals,
    back: Reals,
    sums: Reals,
):
    """Back by substep t on a CPU; substep -1 only finishes the sums of the first."""
    for w in range(ints[BATCH] * node_chunks(ints) * CPU_UNIT):
        if w % CPU_UNIT == 0:
            item = w // CPU_UNIT
            pad = ints[PADS] + item * PAD
            node_pass_adjoint(
                *(False, loaded, ints, ints, fixed, supply, state, kept, scratch, bar, back, sums),
                *(scratch, pad, item, t, 0, TILE),
            )
    for w in range(ints[BATCH] * tile_count(ints) * CPU_UNIT):
        if w % CPU_UNIT == 0:
            item = w // CPU_UNIT
            pad = ints[PADS] + item * PAD
            point_pass_adjoint(
                *(False, loaded, stiffens, ints, ints, fixed, supply, state, kept, scratch, bar, back, sums),
                *(scratch, pad, item, 1, t, 0, TILE),
            )
    for w in range(ints[BATCH] * ints[TALLIES]):
        if t >= 0:
            tally(ints, ints, fixed, bar, back, sums, t, w // ints[TALLIES], w % ints[TALLIES])


@ti.kernel
def total_march_adjoint(
    real: ti.template(),
    most: ti.template(),
    loaded: ti.template(),
    stiffens: ti.template(),
    first: ti.i32,
    last: ti.i32,
    before: ti.i32,
    ints: Integers,
    fixed: Reals,
    supply: Reals,
    state: Reals,
    kept: Reals,
    scratch: Reals,
    bar: Reals,
    back: Reals,
    sums: Reals,
):
    """Back from substep ``last - 1`` to ``first`` on a GPU, as ``total.total_march``."""
    ti.loop_config(block_dim=TILE)
    for w in range(most * TILE):
        q, block = w % TILE, w // TILE
        head = ti.simt.block.SharedArray((KEPT,), ti.i32)
        pad = ti.simt.block.SharedArray((PAD,), real)
        if q < HEAD:
            head[q] = ints[q]
        head[HEAD] = 0
        sync(True)
        blocks = head[BLOCKS]
        arrivals = before
        if block < blocks:
            for passed in range(last - first):
                t = last - 1 - passed
                item = block
                while item < head[BATCH] * node_chunks(head):
                    node_pass_adjoint(
                        *(True, loaded, head, ints, fixed, supply, state, kept, scratch, bar, back, sums),
                        *(pad, 0, item, t, q, q + 1),
                    )
                    item += blocks
                arrivals += blocks
                meet(ints, arrivals, q)
                item = block
                while item < head[BATCH] * tile_count(head):
                    fresh = ti.cast(passed == 0 or head[BATCH] * tile_count(head) > blocks, ti.i32)
                    point_pass_adjoint(
                        *(True, loaded, stiffens, head, ints, fixed, supply, state, kept, scratch, bar, back, sums),
                        *(pad, 0, item, fresh, t, q, q + 1),
                    )
                    item += blocks
                if t >= 0:
                    row = w
                    while row < head[BATCH] * head[TALLIES]:
                        tally(head, ints, fixed, bar, back, sums, t, row // head[TALLIES], row % head[TALLIES])
                        row += blocks * TILE
                arrivals += blocks
                meet(ints, arrivals, q)
