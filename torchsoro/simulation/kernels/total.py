"""One substep forward of the total-Lagrangian form: points, lines, sheets, nodes.

Points find F and their stress from the nodes; lines, sheets and nodes sum the forces; nodes move and meet the planes.
These are four loops of one kernel, into which ``repeats`` substeps are unrolled, since a launch costs more than a loop.
The clock advances in the pass over lines, which does not read it. ``loaded`` says at compile time whether there are
forces, springs, drag or viscosity, ``stiffens`` whether solids stiffen with stretch.
"""

import taichi as ti

from torchsoro.simulation.kernels.forward import Integers, Reals
from torchsoro.simulation.kernels.lattice import (
    gather_gradient,
    gather_value,
    line_tasks,
    nodes_per_axis,
    points_per_axis,
    product,
    sheet_count,
    sheet_tasks,
    sum_chamber,
    sum_lines,
    sum_node,
    sum_sheets,
)
from torchsoro.simulation.kernels.layout import (
    ABSENT,
    ACTIVE,
    ANCHOR,
    AREA,
    AREA_SHEETS,
    BATCH,
    BULK,
    BUNDLE,
    CHAMBER,
    CHAMBER_NUMBERS,
    CHAMBER_STIFFNESS,
    CHAMBER_VOLUME,
    CHAMBERS,
    COEFFICIENT,
    COEFFICIENTS,
    COLLAPSED,
    CORNER,
    EDGE,
    ELEMENT,
    ELEMENTS,
    FILLED,
    FORCE,
    GRAVITY,
    GROUPS,
    KEPT_RING,
    KIND,
    NEAR_NODES,
    NODAL,
    NODAL_DRAG_FACTOR,
    NODAL_MASS,
    NODES,
    NOW,
    PLANES,
    POINT_SUM,
    PRESSURE,
    PRONY,
    PRONY_DECAY,
    PRONY_GAIN,
    PRONY_MODULUS,
    PUSHED,
    RANK,
    RING,
    SHARE,
    SHEAR,
    SHEET,
    SHEET_SUM,
    SPRING,
    SPRINGS,
    STEP_SIZE,
    STIFFENING,
    STOP,
    SWEPT,
    VISCOSITY,
    VISCOUS,
    VOID_FRACTION,
    VOLUME,
    VOLUME_VISCOSITY,
    VOLUMES,
)
from torchsoro.simulation.kernels.stress import least_ratio, piola, pull_back, stiffening, viscous_piola, void_piola
from torchsoro.simulation.kernels.surface import surface_response
from torchsoro.simulation.kernels.tensor import (
    cofactor,
    contract,
    load_symmetric,
    load_vector,
    plus_identity,
    store_matrix,
    store_symmetric,
    store_vector,
)


@ti.func
def state_length(ints: ti.template(), n):
    """Numbers in the state of a simulation."""
    return 6 * product(nodes_per_axis(n)) + 6 * ints[ELEMENTS] * product(n)


@ti.func
def chamber_pressure(ints: ti.template(), fixed: ti.template(), supply, volume, one):
    """p_act - k (V/V0 - 1) in chamber number ``one`` of all simulations."""
    at = ints[CHAMBER_NUMBERS] + one * CHAMBER
    return supply - fixed[at + CHAMBER_STIFFNESS] * (volume / fixed[at + CHAMBER_VOLUME] - 1)


@ti.func
def particle_place(fixed: ti.template(), p, n):
    """Reference place of the particle of point p."""
    half = fixed[EDGE] / 2
    x = load_vector(fixed, CORNER, 1)
    x[0] += (p // (n[1] * n[2]) + 0.5) * half
    x[1] += ((p // n[2]) % n[1] + 0.5) * half
    x[2] += (p % n[2] + 0.5) * half
    return x


@ti.func
def spring_stretch(ints: ti.template(), fixed: ti.template(), state: ti.template(), at, b, p, n):
    """From point p to its anchor."""
    points = product(n)
    anchor = ints[COEFFICIENT] + (b * COEFFICIENTS + ANCHOR) * points + p
    d = gather_value(ints, fixed, state, at, p, n)
    return load_vector(fixed, anchor, points) - particle_place(fixed, p, n) - d


@ti.func
def external_force(
    ints: ti.template(), fixed: ti.template(), supply: ti.template(), state: ti.template(), at, t, b, p, n
):
    """Shares of the group forces, and spring to an anchor [N] at point p; drag is with the nodes."""
    points = product(n)
    push = load_vector(fixed, CORNER, 1) * 0
    for g in range(ints[GROUPS]):
        force = ints[FORCE] + ((t * ints[BATCH] + b) * ints[GROUPS] + g) * 3
        push += fixed[ints[SHARE] + g * points + p] * load_vector(supply, force, 1)
    if ints[SPRINGS] == 1:
        spring = fixed[ints[COEFFICIENT] + (b * COEFFICIENTS + SPRING) * points + p]
        push += spring * spring_stretch(ints, fixed, state, at, b, p, n)
    return push


@ti.kernel
def total_substep(
    repeats: ti.template(),
    loaded: ti.template(),
    stiffens: ti.template(),
    ints: Integers,
    fixed: Reals,
    supply: Reals,
    state: Reals,
    kept: Reals,
    scratch: Reals,
):
    """Advance by ``repeats`` substeps, but not beyond ints[STOP]; the buffers are those of ``layout.BUFFERS``."""
    # Lengths of loops are found once: each that is not known costs a launch.
    n = points_per_axis(ints)
    point_threads, line_threads = ints[BATCH] * product(n), line_tasks(ints, n)
    sheet_threads = sheet_tasks(ints, n)
    node_threads = ints[BATCH] * (product(nodes_per_axis(n)) + ints[CHAMBERS])
    for _ in ti.static(range(repeats)):
        for w in range(point_threads):
            t = ints[NOW]
            n = points_per_axis(ints)
            points = product(n)
            b, p = w // points, w % points
            kind = ints[ints[KIND] + p]
            if t < ints[STOP] and kind != ABSENT:
                length, elements = state_length(ints, n), ints[ELEMENTS]
                nodes = product(nodes_per_axis(n))
                at = ((t % ints[RING]) * ints[BATCH] + b) * length
                out = (((t + 1) % ints[RING]) * ints[BATCH] + b) * length
                mat = ints[COEFFICIENT] + b * COEFFICIENTS * points + p
                F = plus_identity(gather_gradient(ints, fixed, state, at, p, n), 1)
                volume, shear = fixed[mat + VOLUME * points], fixed[mat + SHEAR * points]
                P = F * 0
                history = 6 * nodes + p
                if kind < 0:
                    void_fraction = fixed[mat + VOID_FRACTION * points]
                    Q = F * 0
                    factor = void_fraction * 0 + 1
                    if void_fraction < 1:
                        least = least_ratio(void_fraction)
                        if ti.static(stiffens):
                            linear, square = fixed[mat + STIFFENING * points], fixed[mat + (STIFFENING + 1) * points]
                            factor = stiffening(F, least, linear, square)
                        if elements > 0:
                            S = factor * pull_back(F, least)
                            for e in range(elements):
                                place = history + 6 * e * points
                                number = ints[ELEMENT] + (b * elements + e) * PRONY
                                decay, gain = fixed[number + PRONY_DECAY], fixed[number + PRONY_GAIN]
                                Z = load_symmetric(state, at + place, points)
                                Q += fixed[number + PRONY_MODULUS] * (Z + gain * S)
                                store_symmetric(state, out + place, points, decay * Z - gain * (1 - decay) * S)
                        if void_fraction == 0 and not F.determinant() > 0:
                            ti.atomic_min(ints[COLLAPSED], t)
                    else:
                        for c in range(6 * elements):
                            state[out + history + c * points] = 0
                    P = piola(F, Q, fixed[mat + BULK * points], shear, factor, void_fraction)
                else:
                    for c in range(6 * elements):
                        state[out + history + c * points] = 0
                    cof = cofactor(F)
                    if not contract(cof, F) > 0:
                        ti.atomic_min(ints[COLLAPSED], t)
                    P = void_piola(F, shear)
                    area = ints[AREA] + (b * ints[CHAMBERS] + kind) * BUNDLE * points + p
                    store_matrix(scratch, area, points, volume * cof)
                    swept = ints[SWEPT] + b * ints[ints[FILLED] + ints[CHAMBERS]] + ints[ints[RANK] + p]
                    scratch[swept] = volume * contract(cof, F) / 3
                if ti.static(loaded):
                    eta, zeta = fixed[mat + VISCOSITY * points], fixed[mat + VOLUME_VISCOSITY * points]
                    if kind < 0 and ints[VISCOUS] == 1:
                        P += viscous_piola(F, gather_gradient(ints, fixed, state, at + 3 * nodes, p, n), eta, zeta)
                    push = external_force(ints, fixed, supply, state, at, t, b, p, n)
                    store_vector(scratch, ints[POINT_SUM] + (b * BUNDLE + 9) * points + p, points, -push)
                store_matrix(scratch, ints[POINT_SUM] + b * BUNDLE * points + p, points, volume * P)
        for w in range(line_threads):
            if w == 0:
                ints[ACTIVE] = 0
                if ints[NOW] < ints[STOP]:
                    ints[NOW] = ints[NOW] + 1
                    ints[ACTIVE] = 1
            sum_lines(ints, fixed, scratch, w, points_per_axis(ints), loaded)
        for w in range(sheet_threads):
            sum_sheets(ints, fixed, scratch, w, points_per_axis(ints))
        for w in range(node_threads):
            if ints[ACTIVE] == 1:
                t = ints[NOW] - 1
                n = points_per_axis(ints)
                nodes, chambers = product(nodes_per_axis(n)), ints[CHAMBERS]
                b, i = w // (nodes + chambers), w % (nodes + chambers)
                slot = (t % ints[KEPT_RING]) * ints[BATCH]
                if i >= nodes:
                    one = b * chambers + i - nodes
                    kept[ints[VOLUMES] + slot * chambers + one] = sum_chamber(ints, scratch, one)
                else:
                    length = state_length(ints, n)
                    at = ((t % ints[RING]) * ints[BATCH] + b) * length + i
                    out = (((t + 1) % ints[RING]) * ints[BATCH] + b) * length + i
                    dt = fixed[STEP_SIZE]
                    mass = fixed[ints[NODES] + (b * NODAL + NODAL_MASS) * nodes + i]
                    d = load_vector(state, at, nodes)
                    v = load_vector(state, at + 3 * nodes, nodes)
                    # Divide wherever there is mass, with no floor: a void node weighs 1e-12 kg.
                    if mass > 0:
                        count = SHEET * sheet_count(n)
                        f = sum_node(fixed, scratch, ints[SHEET_SUM] + b * count, i, n)
                        for k in range(chambers):
                            if ints[ints[NEAR_NODES] + k * nodes + i] == 1:
                                one = b * chambers + k
                                p_act = supply[ints[PRESSURE] + t * ints[BATCH] * chambers + one]
                                p = chamber_pressure(ints, fixed, p_act, sum_chamber(ints, scratch, one), one)
                                f -= p * sum_node(fixed, scratch, ints[AREA_SHEETS] + one * count, i, n)
                        pull = load_vector(supply, ints[GRAVITY] + (t * ints[BATCH] + b) * 3, 1)
                        drag_factor = fixed[ints[NODES] + (b * NODAL + NODAL_DRAG_FACTOR) * nodes + i]
                        v = drag_factor * (v + dt * (pull - f / mass))
                        store_vector(kept, ints[PUSHED] + (slot + b) * 3 * nodes + i, nodes, v)
                        after, onto = surface_response(ints, fixed, state, at - i, b, i, n, ints[PLANES], mass, v)
                        v = after
                        d += dt * (onto + v)
                    store_vector(state, out, nodes, d)
                    store_vector(state, out + 3 * nodes, nodes, v)
