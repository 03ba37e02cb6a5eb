"""One substep forward of the total-Lagrangian form: points, then nodes.

Points find F and their stress from the nodes, tile by tile, and each tile sums what its points hand to its nodes; then
nodes add up these sums, move, and meet the planes. What a body has besides (``features``) is known at compile time.
"""

import taichi as ti

from torchsoro.simulation.kernels.fold import TOTALS, sum_chambers
from torchsoro.simulation.kernels.forward import CPU_UNIT, Integers, Reals
from torchsoro.simulation.kernels.lattice import nodes_per_axis, particle_place, points_per_axis, product, state_length
from torchsoro.simulation.kernels.laws_taichi import laws
from torchsoro.simulation.kernels.layout import (
    ABSENT,
    AIR_SHARE,
    ANCHOR,
    BATCH,
    BLOCKS,
    BULK,
    CHAMBERS,
    COEFFICIENT,
    COEFFICIENTS,
    COLLAPSED,
    ELEMENT,
    ELEMENTS,
    ENCLOSES,
    FLUID,
    FORCE,
    GRAVITY,
    GROUPS,
    HEAD,
    HISTORIES,
    HOLLOW,
    IMMERSED,
    KEPT_RING,
    KIND,
    LOADED,
    NEAR_NODES,
    NEAR_NUMBER,
    NODAL,
    NODAL_DRAG_FACTOR,
    NODAL_MASS,
    NODE_SHARE,
    NODES,
    PADS,
    PARTIALS,
    PLANES,
    PRONY,
    PRONY_DECAY,
    PRONY_GAIN,
    PRONY_MODULUS,
    PUSHED,
    PUSHED_NODES,
    PUSHES,
    QUADRATIC,
    RECORDED,
    REPELLED,
    REPULSION,
    RING,
    ROW_AT,
    SAMPLE_AT,
    SEEN,
    SHAPES,
    SHARE,
    SHARED,
    SHARED_AIR,
    SHEAR,
    SLOT_CHAMBER,
    SLOTS,
    SOFTENING,
    SOFTENS,
    SOURCES,
    SPRING,
    SPRINGS,
    STEP_SIZE,
    STIFFENING,
    STIFFENS,
    SWEPT,
    TIED,
    TIES,
    TILE,
    VISCOSITY,
    VISCOUS,
    VOID_FRACTION,
    VOLUME,
    VOLUME_VISCOSITY,
    VOLUMES,
    WALL_CHUNKS,
    WATCHED,
)
from torchsoro.simulation.kernels.stress import (
    excess,
    least_ratio,
    piola,
    pull_back,
    stiffening,
    viscous_piola,
    void_piola,
)
from torchsoro.simulation.kernels.surface import surface_response
from torchsoro.simulation.kernels.tensor import (
    cofactor,
    contract,
    load_symmetric,
    load_vector,
    plus_identity,
    store_symmetric,
    store_vector,
)
from torchsoro.simulation.kernels.tile import (
    ALONE,
    KEPT,
    chamber_slots,
    hand_over,
    hand_over_vector,
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
    tile_value,
)
from torchsoro.simulation.kernels.total_walls import (
    chamber_pressure,
    stage_walls,
    tie_pass,
    tied,
    wall_force,
    wall_pass,
)


@ti.func
def spring_stretch(block: ti.template(), d, b, p):
    """From point p, displaced by d, to its anchor."""
    points = product(points_per_axis(block.head))
    anchor = block.head[COEFFICIENT] + (b * COEFFICIENTS + ANCHOR) * points + p
    return load_vector(block.fixed, anchor, points) - particle_place(block.head, block.fixed, p) - d


@ti.func
def external_force(block: ti.template(), q, t, b, p):
    """Shares of the group forces, and spring to an anchor [N] at point p; drag is with the nodes."""
    (head,) = ti.static((block.head,))
    points = product(points_per_axis(head))
    push = load_vector(block.fixed, STEP_SIZE, 0) * 0
    for g in range(head[GROUPS]):
        force = force_at(block, t, b, g)
        push += block.fixed[head[SHARE] + g * points + p] * load_vector(block.supply, force, 1)
    if head[SPRINGS] == 1:
        spring = block.fixed[head[COEFFICIENT] + (b * COEFFICIENTS + SPRING) * points + p]
        push += spring * spring_stretch(block, tile_value(block, 0, q), b, p)
    return push


@ti.func
def force_at(block: ti.template(), t, b, g):
    """Where force number g of a substep lies: those on points, then those on nodes."""
    forces, row = block.head[GROUPS] + block.head[PUSHES], block.ints[block.head[ROW_AT] + t]
    return block.head[FORCE] + ((row * block.head[BATCH] + b) * forces + g) * 3


@ti.func
def air_of(block: ti.template(), p):
    """The chamber whose air point p is, or has a share of; negative for none."""
    kind = block.ints[block.head[KIND] + p]
    if ti.static(block.features & SHARED_AIR):
        kind = ti.select(kind <= ENCLOSES, ENCLOSES - kind, kind)
    return kind


@ti.func
def chamber_share(block: ti.template(), q, b, p, mine):
    """Hand over the share of point p in its chamber's area, volume times cof F; nothing if it is in none (``mine``).

    Returns:
        The reference volume of its air, the volume ratio, and cof F.
    """
    points = product(points_per_axis(block.head))
    zero = block.fixed[STEP_SIZE] * 0
    cof = ti.Matrix([[zero, zero, zero], [zero, zero, zero], [zero, zero, zero]])
    volume = zero
    ratio = zero
    if mine == 1:
        F = plus_identity(tile_gradient(block, 0, q), 1)
        volume = block.fixed[block.head[COEFFICIENT] + (b * COEFFICIENTS + VOLUME) * points + p]
        if ti.static(block.features & SHARED_AIR):
            volume *= block.fixed[block.head[COEFFICIENT] + (b * COEFFICIENTS + AIR_SHARE) * points + p]
        cof = cofactor(F)
        ratio = contract(cof, F) / 3
    hand_over(block, q, volume * cof)
    return volume, ratio, cof


@ti.func
def softened(block: ti.template(), x, at, b):
    """``laws.softening`` of a point whose largest x is at a place in the state."""
    numbers = block.head[SOFTENING] + 2 * b
    return laws.softening(x, block.state[at], block.fixed[numbers], block.fixed[numbers + 1])


@ti.func
def stress_point(block: ti.template(), q, t, b, p):
    """Stress of point p in substep t, its history a substep on; hands over volume times stress, and external force."""
    head, fixed, state = ti.static((block.head, block.fixed, block.state))
    zero = fixed[STEP_SIZE] * 0
    P = ti.Matrix([[zero, zero, zero], [zero, zero, zero], [zero, zero, zero]])
    push = ti.Vector([zero, zero, zero])
    kind = ti.cast(ABSENT, ti.i32)
    if p >= 0:
        kind = block.ints[head[KIND] + p]
    if kind != ABSENT:
        points, elements = product(points_per_axis(head)), head[ELEMENTS]
        nodes, length = product(nodes_per_axis(head)), state_length(head)
        at = ((t % head[RING]) * head[BATCH] + b) * length + 6 * nodes + p
        out = (((t + 1) % head[RING]) * head[BATCH] + b) * length + 6 * nodes + p
        mat = head[COEFFICIENT] + b * COEFFICIENTS * points + p
        # Read together, before they are needed.
        volume, shear = fixed[mat + VOLUME * points], fixed[mat + SHEAR * points]
        bulk, void_fraction = fixed[mat + BULK * points], fixed[mat + VOID_FRACTION * points]
        F = plus_identity(tile_gradient(block, 0, q), 1)
        if kind < 0:
            Q = F * 0
            factor, left = void_fraction * 0 + 1, void_fraction * 0 + 1
            if void_fraction < 1:
                least = least_ratio(void_fraction)
                if ti.static(block.features & STIFFENS):
                    linear, square = fixed[mat + STIFFENING * points], fixed[mat + (STIFFENING + 1) * points]
                    factor = stiffening(F, least, linear, square)
                if ti.static(block.features & SOFTENS):
                    if head[HISTORIES] > 6 * elements:
                        left, largest = softened(block, excess(F, least), at + 6 * elements * points, b)
                        state[out + 6 * elements * points] = largest
                if elements > 0:
                    S = factor * pull_back(F, least)
                    Z = load_symmetric(state, at, points)
                    for e in range(elements):
                        number = head[ELEMENT] + (b * elements + e) * PRONY
                        decay, gain = fixed[number + PRONY_DECAY], fixed[number + PRONY_GAIN]
                        # The next element is read before this one is written, as no load goes ahead of a store.
                        following = load_symmetric(state, at + 6 * ti.min(e + 1, elements - 1) * points, points)
                        Q += fixed[number + PRONY_MODULUS] * (Z + gain * S)
                        store_symmetric(state, out + 6 * e * points, points, decay * Z - gain * (1 - decay) * S)
                        Z = following
                if void_fraction == 0 and not F.determinant() > 0:
                    ti.atomic_min(block.ints[COLLAPSED], t)
            else:
                for c in range(head[HISTORIES]):
                    state[out + c * points] = 0
            if ti.static(block.features & SHARED_AIR):
                if kind <= ENCLOSES and fixed[mat + AIR_SHARE * points] > 0 and not F.determinant() > 0:
                    ti.atomic_min(block.ints[COLLAPSED], t)
            P = volume * piola(F, Q, bulk, shear, factor * left, void_fraction)
        else:
            for c in range(head[HISTORIES]):
                state[out + c * points] = 0
            if not F.determinant() > 0:
                ti.atomic_min(block.ints[COLLAPSED], t)
            P = volume * void_piola(F, shear)
        if ti.static(block.features & LOADED):
            if kind < 0 and head[VISCOUS] == 1:
                eta, zeta = fixed[mat + VISCOSITY * points], fixed[mat + VOLUME_VISCOSITY * points]
                rate = tile_gradient(block, 1, q)
                P += volume * viscous_piola(F, rate, eta, zeta)
            push = external_force(block, q, t, b, p)
    hand_over(block, q, P)
    if ti.static(block.features & LOADED):
        hand_over_vector(block, q, -push)


@ti.func
def point_pass(block: ti.template(), item, fresh, t):
    """Of all simulations' tiles, do number ``item`` in substep t: what its points hand to its nodes."""
    gpu, head, ints = ti.static((block.gpu, block.head, block.ints))
    cell, counts, node, first, last, b, tile = tile_box(block, fresh, item)
    at = ((t % head[RING]) * head[BATCH] + b) * state_length(head)
    if fresh == 1:
        stage_axes(block, tile)
    stage(block, block.state, at, 0, node)
    if ti.static(block.features & LOADED):
        if head[VISCOUS] == 1:
            stage(block, block.state, at + 3 * product(nodes_per_axis(head)), 1, node)
    sync(gpu)
    partials = head[PARTIALS] + b * head[SLOTS] * ti.static(block.tile.slot)
    for slot in range(first - 1, last):
        # The tile's own slot, then those of the chambers that it has points of.
        out = partials + tile * ti.static(block.tile.slot)
        alone = ti.cast(-1, ti.i32)
        if slot < first:
            for each in range(block.q0, block.q1):
                q = thread(block, each)
                stress_point(block, q, t, b, point_of(block, cell, counts, q))
        else:
            out = partials + (tile_count(head) + slot) * ti.static(block.tile.slot)
            alone = head[SWEPT] + b * chamber_slots(head, ints) + ints[head[SLOT_CHAMBER] + 2 * slot + 1]
            for each in range(block.q0, block.q1):
                q = thread(block, each)
                p = point_of(block, cell, counts, q)
                mine = ti.cast(0, ti.i32)
                if p >= 0:
                    mine = ti.cast(air_of(block, p) == ints[head[SLOT_CHAMBER] + 2 * slot], ti.i32)
                volume, ratio, _ = chamber_share(block, q, b, p, mine)
                block.pad[block.base + ALONE + q] = volume * ratio
        sync(gpu)
        sum_tile(block, ti.cast(slot < first, ti.i32), out, alone)


@ti.func
def slow(block: ti.template(), b, i, nodes, mass, v):
    """Velocity of node i after quadratic drag."""
    r = v
    if ti.static(block.features & IMMERSED):
        if block.head[FLUID] == 1:
            for c in ti.static(range(3)):
                area = block.fixed[block.head[QUADRATIC] + (3 * b + c) * nodes + i]
                r[c] = laws.quadratic_drag(v[c], block.fixed[STEP_SIZE] / mass * area)
    return r


@ti.func
def record(block: ti.template(), t, b, i, d, v):
    """Write down the motion of node i after substep t, if it is near a marker and that is a sample."""
    (head,) = ti.static((block.head,))
    watched = head[WATCHED]
    sample, number = block.ints[head[SAMPLE_AT] + t], block.ints[head[NEAR_NUMBER] + i]
    if sample >= 0 and number >= 0:
        at = head[SEEN] + (sample * head[BATCH] + b) * 6 * watched + number
        store_vector(block.kept, at, watched, d)
        store_vector(block.kept, at + 3 * watched, watched, v)


@ti.func
def node_pass(block: ti.template(), item, t):
    """Move the 256 nodes of number ``item`` by substep t."""
    head, ints, fixed, state, kept = ti.static((block.head, block.ints, block.fixed, block.state, block.kept))
    nodes, chambers = product(nodes_per_axis(head)), head[CHAMBERS]
    b, chunk = item // node_chunks(head), item % node_chunks(head)
    slot = (t % head[KEPT_RING]) * head[BATCH] + b
    sum_chambers(block, b)
    if ti.static(block.features & HOLLOW):
        stage_walls(block, t, b)
    for each in range(block.q0, block.q1):
        q = thread(block, each)
        i = chunk * TILE + q
        if i < chambers:  # every simulation has more nodes than chambers
            kept[head[VOLUMES] + slot * chambers + i] = block.pad[block.base + TOTALS + i]
        if i < nodes:
            length = state_length(head)
            at = ((t % head[RING]) * head[BATCH] + b) * length + i
            out = (((t + 1) % head[RING]) * head[BATCH] + b) * length + i
            dt = fixed[STEP_SIZE]
            mass = fixed[head[NODES] + (b * NODAL + NODAL_MASS) * nodes + i]
            d = load_vector(state, at, nodes)
            v = load_vector(state, at + 3 * nodes, nodes)
            # Divide wherever there is mass, with no floor: a void node weighs 1e-12 kg.
            if mass > 0:
                partials = head[PARTIALS] + b * head[SLOTS] * ti.static(block.tile.slot)
                f = sum_tiles(block, partials, head[SOURCES], i, nodes)
                for k in range(chambers):
                    if ints[head[NEAR_NODES] + k * nodes + i] == 1:
                        table = head[SOURCES] + (k + 1) * SHARED * nodes
                        p = chamber_pressure(block, t, block.pad[block.base + TOTALS + k], b * chambers + k)
                        f -= p * sum_tiles(block, partials, table, i, nodes)
                if ti.static(block.features & HOLLOW):
                    f += wall_force(block, t, b, i)
                if ti.static(block.features & TIED):
                    f += tied(block, b, i, nodes)
                if ti.static(block.features & REPELLED):
                    f -= load_vector(block.scratch, head[REPULSION] + 3 * b * nodes + i, nodes)
                if ti.static(block.features & PUSHED_NODES):
                    for g in range(head[PUSHES]):
                        share = fixed[head[NODE_SHARE] + g * nodes + i]
                        if share != 0:  # of hundreds of places, few are near a node
                            f -= share * load_vector(block.supply, force_at(block, t, b, head[GROUPS] + g), 1)
                pull = load_vector(block.supply, head[GRAVITY] + (t * head[BATCH] + b) * 3, 1)
                drag_factor = fixed[head[NODES] + (b * NODAL + NODAL_DRAG_FACTOR) * nodes + i]
                v += dt * (pull - f / mass)
                store_vector(kept, head[PUSHED] + slot * 3 * nodes + i, nodes, v)
                v = drag_factor * slow(block, b, i, nodes, mass, v)
                after, onto = surface_response(ints, fixed, state, at - i, b, i, head[PLANES], mass, v)
                v = after
                d += dt * (onto + v)
            store_vector(state, out, nodes, d)
            store_vector(state, out + 3 * nodes, nodes, v)
            if ti.static(block.features & RECORDED):
                record(block, t, b, i, d, v)
    sync(block.gpu)


@ti.kernel
def total_substep(
    features: ti.template(),
    shape: ti.template(),
    t: ti.i32,
    ints: Integers,
    fixed: Reals,
    supply: Reals,
    state: Reals,
    kept: Reals,
    scratch: Reals,
):
    """Substep t on a CPU; the buffers are those of ``layout.BUFFERS``."""
    for w in range(ints[BATCH] * tile_count(ints) * CPU_UNIT):
        if w % CPU_UNIT == 0:
            base = ints[PADS] + w // CPU_UNIT * ti.static(SHAPES[shape].pad)
            block = ti.static(on_cpu(features, shape, base, ints, fixed, supply, state, kept, scratch))
            point_pass(block, w // CPU_UNIT, 1, t)
    if ti.static(features & HOLLOW):
        for w in range(ints[BATCH] * ints[WALL_CHUNKS] * CPU_UNIT):
            if w % CPU_UNIT == 0:
                base = ints[PADS] + w // CPU_UNIT * ti.static(SHAPES[shape].pad)
                block = ti.static(on_cpu(features, shape, base, ints, fixed, supply, state, kept, scratch))
                wall_pass(block, w // CPU_UNIT, t)
    if ti.static(features & TIED):
        for w in range(ints[BATCH] * ints[TIES] * CPU_UNIT):
            if w % CPU_UNIT == 0:
                base = ints[PADS] + w // CPU_UNIT * ti.static(SHAPES[shape].pad)
                block = ti.static(on_cpu(features, shape, base, ints, fixed, supply, state, kept, scratch))
                tie_pass(block, w // CPU_UNIT, t)
    for w in range(ints[BATCH] * node_chunks(ints) * CPU_UNIT):
        if w % CPU_UNIT == 0:
            base = ints[PADS] + w // CPU_UNIT * ti.static(SHAPES[shape].pad)
            block = ti.static(on_cpu(features, shape, base, ints, fixed, supply, state, kept, scratch))
            node_pass(block, w // CPU_UNIT, t)


@ti.kernel
def total_march(
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
):
    """Substeps from ``first`` to ``last`` on a GPU that runs ``most`` blocks of 256 threads at a time.

    The blocks stay until the last substep and wait for each other between the passes, so that a host need not keep up.
    ``before`` is how often blocks have arrived at a barrier in earlier launches.
    """
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
        block = ti.static(on_gpu(features, shape, head, pad, q, ints, fixed, supply, state, kept, scratch))
        if number < blocks:
            for t in range(first, last):
                item = number
                while item < head[BATCH] * tile_count(head):
                    # A block that has one tile keeps what it knows of it.
                    fresh = ti.cast(t == first or head[BATCH] * tile_count(head) > blocks, ti.i32)
                    point_pass(block, item, fresh, t)
                    item += blocks
                if ti.static(features & HOLLOW):
                    item = blocks - 1 - number
                    while item < head[BATCH] * head[WALL_CHUNKS]:
                        wall_pass(block, item, t)
                        item += blocks
                if ti.static(features & TIED):
                    item = blocks - 1 - number
                    while item < head[BATCH] * head[TIES]:
                        tie_pass(block, item, t)
                        item += blocks
                arrivals += blocks
                meet(ints, arrivals, q)
                item = number
                while item < head[BATCH] * node_chunks(head):
                    node_pass(block, item, t)
                    item += blocks
                arrivals += blocks
                meet(ints, arrivals, q)
