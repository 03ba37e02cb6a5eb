"""One substep backward of the total-Lagrangian form: nodes, then points, from the kept states.

The adjoint state lies in one buffer, laid out as the state, that each pass overwrites in place. A pass finishes the
sums over substep t + 1 and begins substep t, so that a caller may add its own gradients by the state after t + 1
substeps between two passes.
"""

import taichi as ti

from torchsoro.simulation.kernels.fold import TOTALS, sum_chambers
from torchsoro.simulation.kernels.forward import CPU_UNIT, Integers, Reals
from torchsoro.simulation.kernels.lattice import gather_value, nodes_per_axis, points_per_axis, product, state_length
from torchsoro.simulation.kernels.laws_taichi import laws
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
    HOLLOW,
    IMMERSED,
    LOADED,
    NEAR_NODES,
    NODAL,
    NODAL_DRAG_FACTOR,
    NODAL_MASS,
    NODE_SHARE,
    NODES,
    NODES_BAR,
    PADS,
    PARTIALS,
    PLANES,
    PRESSURE_BAR,
    PUSHED,
    PUSHED_NODES,
    PUSHES,
    QUADRATIC,
    QUADRATIC_BAR,
    REPELLED,
    REPULSION,
    SHAPES,
    SHARE,
    SHARED,
    SLOT_CHAMBER,
    SLOTS,
    SOURCES,
    STEP_SIZE,
    STEPS,
    SURFACES,
    SWEPT,
    TALLIES,
    TIED,
    TIES,
    TILE,
    VISCOUS,
    VOLUME_BAR,
    VOLUMES,
    WALL_CHUNKS,
)
from torchsoro.simulation.kernels.surface import surface_response_adjoint, surface_spread
from torchsoro.simulation.kernels.tensor import add, contract, load_vector, store_vector
from torchsoro.simulation.kernels.tile import (
    ALONE,
    KEPT,
    chamber_slots,
    meet,
    node_chunks,
    on_cpu,
    on_gpu,
    point_of,
    stage,
    stage_axes,
    sum_tile,
    sum_tiles,
    sync,
    thread,
    tile_box,
    tile_count,
    tile_gradient,
)
from torchsoro.simulation.kernels.total import air_of, chamber_share, slow
from torchsoro.simulation.kernels.total_points_adjoint import rate_point_adjoint, stress_point_adjoint
from torchsoro.simulation.kernels.total_walls import (
    chamber_volume_bar,
    tie_pass_adjoint,
    tied,
    wall_pass_adjoint,
    wall_spread,
)


@ti.func
def node_adjoint(block: ti.template(), t, b, i):
    """Finish the gradient by the place of node i after t + 1 substeps, and go back to the force on it in substep t."""
    head, ints, fixed, state, bar, sums = ti.static(
        (block.head, block.ints, block.fixed, block.state, block.bar, block.sums)
    )
    nodes, chambers = product(nodes_per_axis(head)), head[CHAMBERS]
    here = b * state_length(head) + i
    mass = fixed[head[NODES] + (b * NODAL + NODAL_MASS) * nodes + i]
    d_bar = load_vector(bar, here, nodes)
    v_bar = load_vector(bar, here + 3 * nodes, nodes)
    if t + 1 < head[STEPS]:
        partials = head[PARTIALS] + b * head[SLOTS] * ti.static(block.tile.slot)
        d_bar += sum_tiles(block, partials, head[SOURCES], i, nodes)
        for k in range(chambers):
            if ints[head[NEAR_NODES] + k * nodes + i] == 1:
                by_volume = chamber_volume_bar(block, block.pad[block.base + TOTALS + k], b * chambers + k)
                table = head[SOURCES] + (k + 1) * SHARED * nodes
                d_bar += by_volume * sum_tiles(block, partials, table, i, nodes)
        if ti.static(block.features & HOLLOW):
            d_bar += wall_spread(block, b, i)
        if ti.static(block.features & TIED):
            d_bar += tied(block, b, i, nodes)
        if ti.static(block.features & REPELLED):
            d_bar += load_vector(block.scratch, head[REPULSION] + 3 * b * nodes + i, nodes)
        if head[PLANES] > 0:
            after = ((t + 1) * head[BATCH] + b) * state_length(head)
            d_bar += surface_spread(ints, fixed, state, after, block.back, (t + 1) % 2, b, i)
        if ti.static(block.features & LOADED):
            if head[VISCOUS] == 1:
                rates_at = partials + (tile_count(head) + chamber_slots(head, ints)) * ti.static(block.tile.slot)
                v_bar += sum_tiles(block, rates_at, head[SOURCES], i, nodes)
        store_vector(bar, here, nodes, d_bar)
    # Nodes that are held have no mass here, but the forces on others depend on where they are.
    if t >= 0 and mass > 0:
        dt = fixed[STEP_SIZE]
        slot = t * head[BATCH] + b
        at = slot * state_length(head)
        v = load_vector(state, at + 3 * nodes + i, nodes)
        # Velocity before drag, and after the quadratic one.
        u = load_vector(block.kept, head[PUSHED] + slot * 3 * nodes + i, nodes)
        s = slow(block, b, i, nodes, mass, u)
        drag_factor = fixed[head[NODES] + (b * NODAL + NODAL_DRAG_FACTOR) * nodes + i]
        v_bar += dt * d_bar
        mass_bar = mass * 0
        if head[PLANES] > 0:
            u_bar, by_surface, by_mass = surface_response_adjoint(
                ints, fixed, state, at, sums, b, i, mass, drag_factor * s, v_bar, dt * d_bar
            )
            v_bar, mass_bar = u_bar, by_mass
            surfaces = head[SURFACES] + ((t % 2) * head[BATCH] + b) * 3 * nodes
            store_vector(block.back, surfaces + i, nodes, by_surface)
        add(False, sums, head[NODES_BAR] + (b * NODAL + NODAL_DRAG_FACTOR) * nodes + i, s.dot(v_bar))
        v_bar *= drag_factor
        if ti.static(block.features & IMMERSED):
            for c in ti.static(range(3)):
                area = fixed[head[QUADRATIC] + (3 * b + c) * nodes + i]
                by_u, by_sink = laws.quadratic_drag_adjoint(u[c], dt / mass * area, v_bar[c])
                v_bar[c] = by_u
                add(False, sums, head[QUADRATIC_BAR] + (3 * b + c) * nodes + i, dt / mass * by_sink)
                mass_bar -= dt / mass * area * by_sink / mass
        pull = dt * load_vector(block.supply, head[GRAVITY] + slot * 3, 1)
        mass_bar -= (u - v - pull).dot(v_bar) / mass
        add(False, sums, head[NODES_BAR] + (b * NODAL + NODAL_MASS) * nodes + i, mass_bar)
        store_vector(block.back, head[FORCES] + b * 3 * nodes + i, nodes, (dt / mass) * v_bar)
    store_vector(bar, here + 3 * nodes, nodes, v_bar)


@ti.func
def chamber_adjoint(block: ti.template(), t, one, p_bar):
    """Gradients by the pressure, stiffness and volumes of a chamber in substep t."""
    head, sums = ti.static((block.head, block.sums))
    volume_bar = chamber_volume_bar(block, p_bar, one)
    step = t * head[BATCH] * head[CHAMBERS] + one
    ratio = block.kept[head[VOLUMES] + step] / block.fixed[head[CHAMBER_NUMBERS] + one * CHAMBER + CHAMBER_VOLUME]
    mine = head[CHAMBER_BAR] + one * CHAMBER
    add(False, sums, mine + CHAMBER_STIFFNESS, -p_bar * (ratio - 1))
    add(False, sums, mine + CHAMBER_VOLUME, -volume_bar * ratio)
    add(False, sums, head[PRESSURE_BAR] + step, p_bar)
    block.back[head[VOLUME_BAR] + one] = volume_bar


@ti.func
def tally(block: ti.template(), t, b, row):
    """One share of the sums over all nodes and points that gravity and forces of substep t need."""
    head, fixed, sums = ti.static((block.head, block.fixed, block.sums))
    nodes, points, tallies = product(nodes_per_axis(head)), product(points_per_axis(head)), head[TALLIES]
    mine = (t * tallies + row) * head[BATCH] + b
    velocity, forces = b * state_length(head) + 3 * nodes, head[FORCES] + b * 3 * nodes
    total = load_vector(fixed, 0, 1) * 0
    for m in range((nodes + tallies - 1) // tallies):
        i = row + m * tallies
        if i < nodes and fixed[head[NODES] + (b * NODAL + NODAL_MASS) * nodes + i] > 0:
            total += load_vector(block.bar, velocity + i, nodes)
    store_vector(sums, head[GRAVITY_BAR] + 3 * mine, 1, fixed[STEP_SIZE] * total)
    out = head[FORCE_BAR] + 3 * mine * (head[GROUPS] + head[PUSHES])
    for g in range(head[GROUPS]):
        total *= 0
        for m in range((points + tallies - 1) // tallies):
            i = row + m * tallies
            if i < points and fixed[head[SHARE] + g * points + i] != 0:
                by_push = gather_value(head, block.ints, fixed, block.back, forces, i)
                total += fixed[head[SHARE] + g * points + i] * by_push
        store_vector(sums, out + 3 * g, 1, total)
    if ti.static(block.features & PUSHED_NODES):
        for g in range(head[PUSHES]):
            total *= 0
            for m in range((nodes + tallies - 1) // tallies):
                i = row + m * tallies
                if i < nodes:
                    total += fixed[head[NODE_SHARE] + g * nodes + i] * load_vector(block.back, forces + i, nodes)
            store_vector(sums, out + 3 * (head[GROUPS] + g), 1, total)


@ti.func
def point_pass_adjoint(block: ti.template(), item, fresh, t):
    """Adjoint of ``total.point_pass``."""
    gpu, head, ints = ti.static((block.gpu, block.head, block.ints))
    cell, counts, node, first, last, b, tile = tile_box(block, fresh, item)
    nodes = product(nodes_per_axis(head))
    at = (ti.max(t, 0) * head[BATCH] + b) * state_length(head)
    viscous = ti.cast(0, ti.i32)
    if fresh == 1:
        stage_axes(block, tile)
    stage(block, block.state, at, 0, node)
    stage(block, block.back, head[FORCES] + b * 3 * nodes, 1, node)
    if ti.static(block.features & LOADED):
        viscous = head[VISCOUS]
        if viscous == 1:
            stage(block, block.state, at + 3 * nodes, 2, node)
    sync(gpu)
    partials = head[PARTIALS] + b * head[SLOTS] * ti.static(block.tile.slot)
    for slot in range(first - 1, last + viscous):
        # The tile's own slot, then those of the chambers that it has points of, then that of the rates of F.
        out = partials + tile * ti.static(block.tile.slot)
        alone = ti.cast(-1, ti.i32)
        if slot < first:
            for each in range(block.q0, block.q1):
                q = thread(block, each)
                stress_point_adjoint(block, q, t, b, point_of(block, cell, counts, q))
        elif slot < last:
            out = partials + (tile_count(head) + slot) * ti.static(block.tile.slot)
            alone = head[SWEPT] + b * chamber_slots(head, ints) + ints[head[SLOT_CHAMBER] + 2 * slot + 1]
            for each in range(block.q0, block.q1):
                q = thread(block, each)
                p = point_of(block, cell, counts, q)
                mine = ti.cast(0, ti.i32)
                if p >= 0:
                    mine = ti.cast(air_of(block, p) == ints[head[SLOT_CHAMBER] + 2 * slot], ti.i32)
                volume, _, cof = chamber_share(block, q, b, p, mine)
                P_bar = tile_gradient(block, 1, ti.select(mine == 1, q, 0))
                block.pad[block.base + ALONE + q] = volume * contract(P_bar, cof)
        else:
            out = partials + (tile_count(head) + chamber_slots(head, ints) + tile) * ti.static(block.tile.slot)
            if ti.static(block.features & LOADED):
                stage(block, block.state, at + 3 * nodes, 2, node)  # lines have been there
                sync(gpu)
                for each in range(block.q0, block.q1):
                    q = thread(block, each)
                    rate_point_adjoint(block, q, b, point_of(block, cell, counts, q))
        sync(gpu)
        sum_tile(block, ti.cast(slot < first, ti.i32), out, alone)


@ti.func
def node_pass_adjoint(block: ti.template(), item, t):
    """Adjoint of ``total.node_pass``."""
    (head,) = ti.static((block.head,))
    nodes, chambers = product(nodes_per_axis(head)), head[CHAMBERS]
    b, chunk = item // node_chunks(head), item % node_chunks(head)
    sum_chambers(block, b)
    for each in range(block.q0, block.q1):
        q = thread(block, each)
        i = chunk * TILE + q
        if i < chambers and t + 1 < head[STEPS]:
            chamber_adjoint(block, t + 1, b * chambers + i, block.pad[block.base + TOTALS + i])
        if i < nodes:
            node_adjoint(block, t, b, i)
    sync(block.gpu)


@ti.kernel
def total_substep_adjoint(
    features: ti.template(),
    shape: ti.template(),
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
            base = ints[PADS] + w // CPU_UNIT * ti.static(SHAPES[shape].pad)
            block = ti.static(on_cpu(features, shape, base, ints, fixed, supply, state, kept, scratch, bar, back, sums))
            node_pass_adjoint(block, w // CPU_UNIT, t)
    for w in range(ints[BATCH] * tile_count(ints) * CPU_UNIT):
        if w % CPU_UNIT == 0:
            base = ints[PADS] + w // CPU_UNIT * ti.static(SHAPES[shape].pad)
            block = ti.static(on_cpu(features, shape, base, ints, fixed, supply, state, kept, scratch, bar, back, sums))
            point_pass_adjoint(block, w // CPU_UNIT, 1, t)
    if ti.static(features & HOLLOW):
        for w in range(ints[BATCH] * ints[WALL_CHUNKS] * CPU_UNIT):
            if w % CPU_UNIT == 0 and t >= 0:
                base = ints[PADS] + w // CPU_UNIT * ti.static(SHAPES[shape].pad)
                block = ti.static(
                    on_cpu(features, shape, base, ints, fixed, supply, state, kept, scratch, bar, back, sums)
                )
                wall_pass_adjoint(block, w // CPU_UNIT, t)
    if ti.static(features & TIED):
        for w in range(ints[BATCH] * ints[TIES] * CPU_UNIT):
            if w % CPU_UNIT == 0 and t >= 0:
                base = ints[PADS] + w // CPU_UNIT * ti.static(SHAPES[shape].pad)
                block = ti.static(
                    on_cpu(features, shape, base, ints, fixed, supply, state, kept, scratch, bar, back, sums)
                )
                tie_pass_adjoint(block, w // CPU_UNIT, t)
    for w in range(ints[BATCH] * ints[TALLIES]):
        if t >= 0:
            base = ints[PADS] + w // CPU_UNIT * ti.static(SHAPES[shape].pad)
            block = ti.static(on_cpu(features, shape, base, ints, fixed, supply, state, kept, scratch, bar, back, sums))
            tally(block, t, w // ints[TALLIES], w % ints[TALLIES])


@ti.kernel
def total_march_adjoint(
    real: ti.template(),
    most: ti.template(),
    features: ti.template(),
    shape: ti.template(),
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
        q, number = w % TILE, w // TILE
        head = ti.simt.block.SharedArray((KEPT,), ti.i32)
        pad = ti.simt.block.SharedArray((SHAPES[shape].pad,), real)
        if q < HEAD:
            head[q] = ints[q]
        head[HEAD] = 0
        sync(True)
        blocks = head[BLOCKS]
        arrivals = before
        block = ti.static(
            on_gpu(features, shape, head, pad, q, ints, fixed, supply, state, kept, scratch, bar, back, sums)
        )
        if number < blocks:
            for passed in range(last - first):
                t = last - 1 - passed
                item = number
                while item < head[BATCH] * node_chunks(head):
                    node_pass_adjoint(block, item, t)
                    item += blocks
                arrivals += blocks
                meet(ints, arrivals, q)
                item = number
                while item < head[BATCH] * tile_count(head):
                    fresh = ti.cast(passed == 0 or head[BATCH] * tile_count(head) > blocks, ti.i32)
                    point_pass_adjoint(block, item, fresh, t)
                    item += blocks
                if ti.static(features & HOLLOW):
                    item = blocks - 1 - number
                    while item < head[BATCH] * head[WALL_CHUNKS] and t >= 0:
                        wall_pass_adjoint(block, item, t)
                        item += blocks
                if ti.static(features & TIED):
                    item = blocks - 1 - number
                    while item < head[BATCH] * head[TIES] and t >= 0:
                        tie_pass_adjoint(block, item, t)
                        item += blocks
                if t >= 0:
                    row = w
                    while row < head[BATCH] * head[TALLIES]:
                        tally(block, t, row // head[TALLIES], row % head[TALLIES])
                        row += blocks * TILE
                arrivals += blocks
                meet(ints, arrivals, q)
