"""One substep forward of the total-Lagrangian form: points, then nodes.

Points find F and their stress from the nodes, tile by tile, and each tile sums what its points hand to its nodes; then
nodes add up these sums, move, and meet the planes. ``loaded`` says at compile time whether there are forces, springs or
viscosity, ``stiffens`` whether solids stiffen with stretch.
"""

import taichi as ti

from torchsoro.simulation.kernels.forward import (
    CPU_UNIT,
    Integers,
    Reals,
)
from torchsoro.simulation.kernels.lattice import nodes_per_axis, particle_place, points_per_axis, product
from torchsoro.simulation.kernels.layout import (
    ABSENT,
    ANCHOR,
    BATCH,
    BLOCKS,
    BULK,
    CHAMBER,
    CHAMBER_NUMBERS,
    CHAMBER_STIFFNESS,
    CHAMBER_VOLUME,
    CHAMBERS,
    COEFFICIENT,
    COEFFICIENTS,
    COLLAPSED,
    ELEMENT,
    ELEMENTS,
    FORCE,
    GRAVITY,
    GROUPS,
    HEAD,
    KEPT_RING,
    KIND,
    NEAR_NODES,
    NODAL,
    NODAL_DRAG_FACTOR,
    NODAL_MASS,
    NODES,
    PAD,
    PADS,
    PARTIALS,
    PLANES,
    PRESSURE,
    PRONY,
    PRONY_DECAY,
    PRONY_GAIN,
    PRONY_MODULUS,
    PUSHED,
    RING,
    SHARE,
    SHARED,
    SHEAR,
    SLOT,
    SLOT_CHAMBER,
    SLOTS,
    SOURCES,
    SPRING,
    SPRINGS,
    STEP_SIZE,
    STIFFENING,
    SWEPT,
    TILE,
    VISCOSITY,
    VISCOUS,
    VOID_FRACTION,
    VOLUME,
    VOLUME_VISCOSITY,
    VOLUMES,
)
from torchsoro.simulation.kernels.stress import (
    least_ratio,
    piola,
    pull_back,
    stiffening,
    viscous_piola,
    void_piola,
)
from torchsoro.simulation.kernels.surface import (
    surface_response,
)
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
    TOTALS,
    chamber_slots,
    hand_over,
    hand_over_vector,
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
    tile_value,
)


@ti.func
def state_length(head: ti.template()):
    """Numbers in the state of a simulation."""
    return 6 * product(nodes_per_axis(head)) + 6 * head[ELEMENTS] * product(points_per_axis(head))


@ti.func
def chamber_pressure(head: ti.template(), fixed: ti.template(), supply, volume, one):
    """p_act - k (V/V0 - 1) in chamber number ``one`` of all simulations."""
    at = head[CHAMBER_NUMBERS] + one * CHAMBER
    return supply - fixed[at + CHAMBER_STIFFNESS] * (volume / fixed[at + CHAMBER_VOLUME] - 1)


@ti.func
def spring_stretch(head: ti.template(), fixed: ti.template(), d, b, p):
    """From point p, displaced by d, to its anchor."""
    points = product(points_per_axis(head))
    anchor = head[COEFFICIENT] + (b * COEFFICIENTS + ANCHOR) * points + p
    return load_vector(fixed, anchor, points) - particle_place(head, fixed, p) - d


@ti.func
def external_force(
    head: ti.template(), fixed: ti.template(), supply: ti.template(), pad: ti.template(), base, q, t, b, p
):
    """Shares of the group forces, and spring to an anchor [N] at point p; drag is with the nodes."""
    points = product(points_per_axis(head))
    push = ti.Vector([fixed[STEP_SIZE] * 0, fixed[STEP_SIZE] * 0, fixed[STEP_SIZE] * 0])
    for g in range(head[GROUPS]):
        force = head[FORCE] + ((t * head[BATCH] + b) * head[GROUPS] + g) * 3
        push += fixed[head[SHARE] + g * points + p] * load_vector(supply, force, 1)
    if head[SPRINGS] == 1:
        spring = fixed[head[COEFFICIENT] + (b * COEFFICIENTS + SPRING) * points + p]
        push += spring * spring_stretch(head, fixed, tile_value(pad, base, 0, q), b, p)
    return push


@ti.func
def chamber_share(head: ti.template(), fixed: ti.template(), pad: ti.template(), base, q, b, p, mine):
    """Hand over the share of point p in its chamber's area, volume times cof F; nothing if it is in none (``mine``).

    Returns:
        The reference volume, the volume ratio, and cof F.
    """
    points = product(points_per_axis(head))
    zero = fixed[STEP_SIZE] * 0
    cof = ti.Matrix([[zero, zero, zero], [zero, zero, zero], [zero, zero, zero]])
    volume = zero
    ratio = zero
    if mine == 1:
        F = plus_identity(tile_gradient(pad, base, 0, q), 1)
        volume = fixed[head[COEFFICIENT] + (b * COEFFICIENTS + VOLUME) * points + p]
        cof = cofactor(F)
        ratio = contract(cof, F) / 3
    hand_over(pad, base, q, volume * cof)
    return volume, ratio, cof


@ti.func
def stress_point(
    loaded: ti.template(),
    stiffens: ti.template(),
    head: ti.template(),
    ints: ti.template(),
    fixed: ti.template(),
    supply: ti.template(),
    state: ti.template(),
    pad: ti.template(),
    base,
    q,
    t,
    b,
    p,
):
    """Stress of point p in substep t, its elements a substep on; hands over volume times stress, and external force."""
    zero = fixed[STEP_SIZE] * 0
    P = ti.Matrix([[zero, zero, zero], [zero, zero, zero], [zero, zero, zero]])
    push = ti.Vector([zero, zero, zero])
    kind = ti.cast(ABSENT, ti.i32)
    if p >= 0:
        kind = ints[head[KIND] + p]
    if kind != ABSENT:
        points, elements = product(points_per_axis(head)), head[ELEMENTS]
        nodes, length = product(nodes_per_axis(head)), state_length(head)
        at = ((t % head[RING]) * head[BATCH] + b) * length + 6 * nodes + p
        out = (((t + 1) % head[RING]) * head[BATCH] + b) * length + 6 * nodes + p
        mat = head[COEFFICIENT] + b * COEFFICIENTS * points + p
        # Read together, before they are needed.
        volume, shear = fixed[mat + VOLUME * points], fixed[mat + SHEAR * points]
        bulk, void_fraction = fixed[mat + BULK * points], fixed[mat + VOID_FRACTION * points]
        F = plus_identity(tile_gradient(pad, base, 0, q), 1)
        if kind < 0:
            Q = F * 0
            factor = void_fraction * 0 + 1
            if void_fraction < 1:
                least = least_ratio(void_fraction)
                if ti.static(stiffens):
                    linear, square = fixed[mat + STIFFENING * points], fixed[mat + (STIFFENING + 1) * points]
                    factor = stiffening(F, least, linear, square)
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
                    ti.atomic_min(ints[COLLAPSED], t)
            else:
                for c in range(6 * elements):
                    state[out + c * points] = 0
            P = volume * piola(F, Q, bulk, shear, factor, void_fraction)
        else:
            for c in range(6 * elements):
                state[out + c * points] = 0
            if not F.determinant() > 0:
                ti.atomic_min(ints[COLLAPSED], t)
            P = volume * void_piola(F, shear)
        if ti.static(loaded):
            if kind < 0 and head[VISCOUS] == 1:
                eta, zeta = fixed[mat + VISCOSITY * points], fixed[mat + VOLUME_VISCOSITY * points]
                rate = tile_gradient(pad, base, 1, q)
                P += volume * viscous_piola(F, rate, eta, zeta)
            push = external_force(head, fixed, supply, pad, base, q, t, b, p)
    hand_over(pad, base, q, P)
    if ti.static(loaded):
        hand_over_vector(pad, base, q, -push)


@ti.func
def point_pass(
    gpu: ti.template(),
    loaded: ti.template(),
    stiffens: ti.template(),
    head: ti.template(),
    ints: ti.template(),
    fixed: ti.template(),
    supply: ti.template(),
    state: ti.template(),
    scratch: ti.template(),
    pad: ti.template(),
    base,
    item,
    fresh,
    t,
    q0,
    q1,
):
    """Of all simulations' tiles, do number ``item`` in substep t: what its points hand to its nodes."""
    cell, cells, node, first, last, b, tile = tile_box(gpu, fresh, head, ints, item, q0)
    at = ((t % head[RING]) * head[BATCH] + b) * state_length(head)
    if fresh == 1:
        stage_axes(gpu, head, fixed, pad, base, cell, cells, q0, q1)
    stage(gpu, head, state, at, pad, base, 0, node, q0, q1)
    if ti.static(loaded):
        if head[VISCOUS] == 1:
            stage(gpu, head, state, at + 3 * product(nodes_per_axis(head)), pad, base, 1, node, q0, q1)
    sync(gpu)
    partials = head[PARTIALS] + b * head[SLOTS] * SLOT
    for slot in range(first - 1, last):
        # The tile's own slot, then those of the chambers that it has points of.
        out = partials + tile * SLOT
        alone = ti.cast(-1, ti.i32)
        if slot < first:
            for each in range(q0, q1):
                q = thread(gpu, head, each)
                p = point_of(head, cell, cells, q)
                stress_point(loaded, stiffens, head, ints, fixed, supply, state, pad, base, q, t, b, p)
        else:
            out = partials + (tile_count(head) + slot) * SLOT
            alone = head[SWEPT] + b * chamber_slots(head, ints) + ints[head[SLOT_CHAMBER] + 2 * slot + 1]
            for each in range(q0, q1):
                q = thread(gpu, head, each)
                p = point_of(head, cell, cells, q)
                mine = ti.cast(0, ti.i32)
                if p >= 0:
                    mine = ti.cast(ints[head[KIND] + p] == ints[head[SLOT_CHAMBER] + 2 * slot], ti.i32)
                volume, ratio, _ = chamber_share(head, fixed, pad, base, q, b, p, mine)
                pad[base + ALONE + q] = volume * ratio
        sync(gpu)
        own = ti.cast(slot < first, ti.i32)
        sum_tile(gpu, loaded, head, pad, base, own, scratch, out, scratch, alone, q0, q1)


@ti.func
def node_pass(
    gpu: ti.template(),
    head: ti.template(),
    ints: ti.template(),
    fixed: ti.template(),
    supply: ti.template(),
    state: ti.template(),
    kept: ti.template(),
    scratch: ti.template(),
    pad: ti.template(),
    base,
    item,
    t,
    q0,
    q1,
):
    """Move the 256 nodes of number ``item`` by substep t."""
    nodes, chambers = product(nodes_per_axis(head)), head[CHAMBERS]
    b, chunk = item // node_chunks(head), item % node_chunks(head)
    slot = (t % head[KEPT_RING]) * head[BATCH] + b
    sum_chambers(gpu, head, ints, fixed, scratch, pad, base, b, q0, q1)
    for each in range(q0, q1):
        q = thread(gpu, head, each)
        i = chunk * TILE + q
        if i < chambers:  # every simulation has more nodes than chambers
            kept[head[VOLUMES] + slot * chambers + i] = pad[base + TOTALS + i]
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
                partials = head[PARTIALS] + b * head[SLOTS] * SLOT
                f = sum_tiles(fixed, ints, scratch, partials, head[SOURCES], i, nodes)
                for k in range(chambers):
                    if ints[head[NEAR_NODES] + k * nodes + i] == 1:
                        one = b * chambers + k
                        p_act = supply[head[PRESSURE] + t * head[BATCH] * chambers + one]
                        p = chamber_pressure(head, fixed, p_act, pad[base + TOTALS + k], one)
                        table = head[SOURCES] + (k + 1) * SHARED * nodes
                        f -= p * sum_tiles(fixed, ints, scratch, partials, table, i, nodes)
                pull = load_vector(supply, head[GRAVITY] + (t * head[BATCH] + b) * 3, 1)
                drag_factor = fixed[head[NODES] + (b * NODAL + NODAL_DRAG_FACTOR) * nodes + i]
                v = drag_factor * (v + dt * (pull - f / mass))
                store_vector(kept, head[PUSHED] + slot * 3 * nodes + i, nodes, v)
                after, onto = surface_response(ints, fixed, state, at - i, b, i, head[PLANES], mass, v)
                v = after
                d += dt * (onto + v)
            store_vector(state, out, nodes, d)
            store_vector(state, out + 3 * nodes, nodes, v)
    sync(gpu)


@ti.kernel
def total_substep(
    loaded: ti.template(),
    stiffens: ti.template(),
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
            item = w // CPU_UNIT
            pad = ints[PADS] + item * PAD
            point_pass(
                *(False, loaded, stiffens, ints, ints, fixed, supply, state, scratch, scratch, pad, item, 1, t, 0, TILE)
            )
    for w in range(ints[BATCH] * node_chunks(ints) * CPU_UNIT):
        if w % CPU_UNIT == 0:
            item = w // CPU_UNIT
            pad = ints[PADS] + item * PAD
            node_pass(False, ints, ints, fixed, supply, state, kept, scratch, scratch, pad, item, t, 0, TILE)


@ti.kernel
def total_march(
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
):
    """Substeps from ``first`` to ``last`` on a GPU that runs ``most`` blocks of 256 threads at a time.

    The blocks stay until the last substep and wait for each other between the passes, so that a host need not keep up.
    ``before`` is how often blocks have arrived at a barrier in earlier launches.
    """
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
            for t in range(first, last):
                item = block
                while item < head[BATCH] * tile_count(head):
                    # A block that has one tile keeps what it knows of it.
                    fresh = ti.cast(t == first or head[BATCH] * tile_count(head) > blocks, ti.i32)
                    point_pass(
                        *(True, loaded, stiffens, head, ints, fixed, supply, state, scratch, pad, 0, item, fresh),
                        *(t, q, q + 1),
                    )
                    item += blocks
                arrivals += blocks
                meet(ints, arrivals, q)
                item = block
                while item < head[BATCH] * node_chunks(head):
                    node_pass(True, head, ints, fixed, supply, state, kept, scratch, pad, 0, item, t, q, q + 1)
                    item += blocks
                arrivals += blocks
                meet(ints, arrivals, q)
