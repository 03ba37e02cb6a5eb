"""One substep backward of the total-Lagrangian form: nodes, points, lines, sheets, from the kept states.

The adjoint state lies in one buffer, laid out as the state, that each pass overwrites in place. A pass finishes the
sums over substep t + 1 and begins substep t, so that a caller may add its own gradients by the state after t + 1
substeps between two passes. The clock goes down in the pass over lines, which does not read it.
"""

import taichi as ti

from torchsoro.simulation.kernels.forward import Integers, Reals
from torchsoro.simulation.kernels.lattice import (
    gather_gradient,
    gather_value,
    line_count,
    line_tasks,
    nodes_per_axis,
    points_per_axis,
    product,
    sheet_count,
    sheet_tasks,
    sum_chamber,
    sum_line,
    sum_lines,
    sum_node,
    sum_sheet,
    sum_sheets,
)
from torchsoro.simulation.kernels.layout import (
    ABSENT,
    ANCHOR,
    AREA,
    AREA_SHEETS,
    BATCH,
    BULK,
    BUNDLE,
    CHAMBER,
    CHAMBER_BAR,
    CHAMBER_NUMBERS,
    CHAMBER_STIFFNESS,
    CHAMBER_VOLUME,
    CHAMBERS,
    COEFFICIENT,
    COEFFICIENT_BAR,
    COEFFICIENTS,
    CORNER,
    ELEMENT,
    ELEMENT_BAR,
    ELEMENTS,
    FILLED,
    FORCE_BAR,
    FORCES,
    GRAVITY,
    GRAVITY_BAR,
    GROUPS,
    JACOBIANS,
    KIND,
    LINE,
    NEAR_NODES,
    NODAL,
    NODAL_DRAG_FACTOR,
    NODAL_MASS,
    NODES,
    NODES_BAR,
    NOW,
    PLANES,
    POINT_SUM,
    PRESSURE,
    PRESSURE_BAR,
    PRONY,
    PRONY_DECAY,
    PRONY_GAIN,
    PRONY_MODULUS,
    PUSHED,
    RANK,
    RATE_LINES,
    RATE_SHEETS,
    RATES,
    SHARE,
    SHEAR,
    SHEET,
    SHEET_SUM,
    SPRING,
    SPRINGS,
    STEP_SIZE,
    STEPS,
    STIFFENING,
    STOP,
    SURFACES,
    SWEPT,
    TALLIES,
    VISCOSITY,
    VISCOUS,
    VOID_FRACTION,
    VOLUME,
    VOLUME_BAR,
    VOLUME_VISCOSITY,
    VOLUMES,
    WANT_PRONY,
)
from torchsoro.simulation.kernels.stress import (
    least_ratio,
    piola_adjoint,
    pull_back,
    pull_back_adjoint,
    stiffening,
    stiffening_adjoint,
    viscous_piola_adjoint,
    void_piola_adjoint,
    void_work,
)
from torchsoro.simulation.kernels.surface import surface_response_adjoint, surface_spread
from torchsoro.simulation.kernels.tensor import (
    add,
    cofactor,
    contract,
    cross,
    load_symmetric,
    load_symmetric_adjoint,
    load_vector,
    plus_identity,
    store_matrix,
    store_symmetric_adjoint,
    store_vector,
)
from torchsoro.simulation.kernels.total import chamber_pressure, spring_stretch, state_length


@ti.func
def node_adjoint(
    ints: ti.template(),
    fixed: ti.template(),
    supply: ti.template(),
    state: ti.template(),
    kept: ti.template(),
    scratch: ti.template(),
    bar: ti.template(),
    back: ti.template(),
    sums: ti.template(),
    t,
    b,
    i,
    n,
    rates: ti.template(),
):
    """Finish the gradient by the place of node i after t + 1 substeps, and go back to the force on it in substep t."""
    nodes, chambers = product(nodes_per_axis(n)), ints[CHAMBERS]
    here = b * state_length(ints, n) + i
    mass = fixed[ints[NODES] + (b * NODAL + NODAL_MASS) * nodes + i]
    if mass > 0:
        d_bar = load_vector(bar, here, nodes)
        v_bar = load_vector(bar, here + 3 * nodes, nodes)
        if t + 1 < ints[STEPS]:
            count = SHEET * sheet_count(n)
            d_bar += sum_node(fixed, scratch, ints[SHEET_SUM] + b * count, i, n)
            for k in range(chambers):
                if ints[ints[NEAR_NODES] + k * nodes + i] == 1:
                    one = b * chambers + k
                    by_volume = chamber_volume_bar(ints, fixed, scratch, one)
                    d_bar += by_volume * sum_node(fixed, scratch, ints[AREA_SHEETS] + one * count, i, n)
            if ints[PLANES] > 0:
                d_bar += surface_spread(ints, fixed, back, (t + 1) % 2, b, i, n)
            if ti.static(rates):
                v_bar += sum_node(fixed, back, ints[RATE_SHEETS] + b * count, i, n)
            store_vector(bar, here, nodes, d_bar)
        if t >= 0:
            dt = fixed[STEP_SIZE]
            slot = t * ints[BATCH] + b
            at = slot * state_length(ints, n)
            v = load_vector(state, at + 3 * nodes + i, nodes)
            u = load_vector(kept, ints[PUSHED] + slot * 3 * nodes + i, nodes)
            v_bar += dt * d_bar
            mass_bar = mass * 0
            if ints[PLANES] > 0:
                u_bar, by_surface, by_mass = surface_response_adjoint(
                    ints, fixed, state, at, sums, b, i, n, mass, u, v_bar, dt * d_bar
                )
                v_bar, mass_bar = u_bar, by_mass
                surfaces = ints[SURFACES] + ((t % 2) * ints[BATCH] + b) * 3 * nodes
                store_vector(back, surfaces + i, nodes, by_surface)
            drag_factor = fixed[ints[NODES] + (b * NODAL + NODAL_DRAG_FACTOR) * nodes + i]
            add(False, sums, ints[NODES_BAR] + (b * NODAL + NODAL_DRAG_FACTOR) * nodes + i, u.dot(v_bar) / drag_factor)
            v_bar *= drag_factor
            pull = dt * load_vector(supply, ints[GRAVITY] + slot * 3, 1)
            mass_bar -= (u / drag_factor - v - pull).dot(v_bar) / mass
            add(False, sums, ints[NODES_BAR] + (b * NODAL + NODAL_MASS) * nodes + i, mass_bar)
            store_vector(back, ints[FORCES] + b * 3 * nodes + i, nodes, (dt / mass) * v_bar)
        store_vector(bar, here + 3 * nodes, nodes, v_bar)


@ti.func
def chamber_volume_bar(ints: ti.template(), fixed: ti.template(), scratch: ti.template(), one):
    """Gradient by a chamber's volume, from the summed gradient by its pressure."""
    at = ints[CHAMBER_NUMBERS] + one * CHAMBER
    return -sum_chamber(ints, scratch, one) * fixed[at + CHAMBER_STIFFNESS] / fixed[at + CHAMBER_VOLUME]


@ti.func
def chamber_adjoint(
    ints: ti.template(),
    fixed: ti.template(),
    kept: ti.template(),
    scratch: ti.template(),
    back: ti.template(),
    sums: ti.template(),
    t,
    one,
):
    """Gradients by the pressure, stiffness and volumes of a chamber in substep t."""
    p_bar = sum_chamber(ints, scratch, one)
    volume_bar = chamber_volume_bar(ints, fixed, scratch, one)
    step = t * ints[BATCH] * ints[CHAMBERS] + one
    ratio = kept[ints[VOLUMES] + step] / fixed[ints[CHAMBER_NUMBERS] + one * CHAMBER + CHAMBER_VOLUME]
    mine = ints[CHAMBER_BAR] + one * CHAMBER
    add(False, sums, mine + CHAMBER_STIFFNESS, -p_bar * (ratio - 1))
    add(False, sums, mine + CHAMBER_VOLUME, -volume_bar * ratio)
    add(False, sums, ints[PRESSURE_BAR] + step, p_bar)
    back[ints[VOLUME_BAR] + one] = volume_bar


@ti.func
def tally(
    ints: ti.template(),
    fixed: ti.template(),
    bar: ti.template(),
    back: ti.template(),
    sums: ti.template(),
    t,
    b,
    row,
    n,
):
    """One share of the sums over all nodes and points that gravity and group forces of substep t need."""
    nodes, points, tallies = product(nodes_per_axis(n)), product(n), ints[TALLIES]
    mine = (t * tallies + row) * ints[BATCH] + b
    velocity = b * state_length(ints, n) + 3 * nodes
    total = load_vector(fixed, 0, 1) * 0
    for m in range((nodes + tallies - 1) // tallies):
        i = row + m * tallies
        if i < nodes and fixed[ints[NODES] + (b * NODAL + NODAL_MASS) * nodes + i] > 0:
            total += load_vector(bar, velocity + i, nodes)
    store_vector(sums, ints[GRAVITY_BAR] + 3 * mine, 1, fixed[STEP_SIZE] * total)
    for g in range(ints[GROUPS]):
        total *= 0
        for m in range((points + tallies - 1) // tallies):
            i = row + m * tallies
            if i < points and fixed[ints[SHARE] + g * points + i] != 0:
                by_push = gather_value(ints, fixed, back, ints[FORCES] + b * 3 * nodes, i, n)
                total += fixed[ints[SHARE] + g * points + i] * by_push
        store_vector(sums, ints[FORCE_BAR] + 3 * (mine * ints[GROUPS] + g), 1, total)


@ti.func
def maxwell_adjoint(
    ints: ti.template(),
    fixed: ti.template(),
    state: ti.template(),
    at,
    bar: ti.template(),
    here,
    sums: ti.template(),
    b,
    p,
    points,
    S,
    Q_bar,
):
    """Through the Maxwell elements of a point, whose places in state and adjoint are given: the gradient by S."""
    elements = ints[ELEMENTS]
    S_bar = S * 0
    for e in range(elements):
        place = here + 6 * e * points
        number = ints[ELEMENT] + (b * elements + e) * PRONY
        a, gain, g = fixed[number + PRONY_DECAY], fixed[number + PRONY_GAIN], fixed[number + PRONY_MODULUS]
        Z_bar = load_symmetric_adjoint(bar, place, points)
        S_bar += gain * (g * Q_bar - (1 - a) * Z_bar)
        if ints[WANT_PRONY] == 1:
            Z = load_symmetric(state, at + 6 * e * points, points)
            mine = ints[ELEMENT_BAR] + (b * elements + e) * PRONY * points + p
            by_stress, by_history = contract(Q_bar, S), contract(Z_bar, S)
            add(False, sums, mine + PRONY_MODULUS * points, contract(Q_bar, Z) + gain * by_stress)
            add(False, sums, mine + PRONY_GAIN * points, g * by_stress - (1 - a) * by_history)
            add(False, sums, mine + PRONY_DECAY * points, contract(Z_bar, Z) + gain * by_history)
        store_symmetric_adjoint(bar, place, points, a * Z_bar + g * Q_bar)
    return S_bar


@ti.func
def external_adjoint(
    ints: ti.template(),
    fixed: ti.template(),
    state: ti.template(),
    at,
    back: ti.template(),
    scratch: ti.template(),
    sums: ti.template(),
    b,
    p,
    n,
):
    """Adjoint of ``total.external_force``, but for the group forces: by springs, anchors and place."""
    nodes, points = product(nodes_per_axis(n)), product(n)
    mine = b * COEFFICIENTS * points + p
    mat, mat_bar = ints[COEFFICIENT] + mine, ints[COEFFICIENT_BAR] + mine
    push_bar = gather_value(ints, fixed, back, ints[FORCES] + b * 3 * nodes, p, n)
    spring = fixed[mat + SPRING * points]
    stretch = spring_stretch(ints, fixed, state, at, b, p, n)
    add(False, sums, mat_bar + SPRING * points, push_bar.dot(stretch))
    for c in ti.static(range(3)):
        add(False, sums, mat_bar + (ANCHOR + c) * points, spring * push_bar[c])
    vector = (b * BUNDLE + 9) * points + p
    store_vector(scratch, ints[POINT_SUM] + vector, points, -spring * push_bar)


@ti.kernel
def total_substep_adjoint(
    repeats: ti.template(),
    loaded: ti.template(),
    stiffens: ti.template(),
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
    """Go back by ``repeats`` substeps, but not below ints[STOP]; substep -1 only finishes the sums of the first."""
    n = points_per_axis(ints)
    node_threads = ints[BATCH] * (product(nodes_per_axis(n)) + ints[CHAMBERS])
    point_threads, line_threads = ints[BATCH] * (product(n) + ints[TALLIES]), line_tasks(ints, n)
    sheet_threads = sheet_tasks(ints, n)
    for _ in ti.static(range(repeats)):
        for w in range(node_threads):
            t = ints[NOW]
            if t >= ints[STOP]:
                n = points_per_axis(ints)
                nodes, chambers = product(nodes_per_axis(n)), ints[CHAMBERS]
                b, i = w // (nodes + chambers), w % (nodes + chambers)
                if i < nodes:
                    node_adjoint(ints, fixed, supply, state, kept, scratch, bar, back, sums, t, b, i, n, loaded)
                elif t + 1 < ints[STEPS]:
                    chamber_adjoint(ints, fixed, kept, scratch, back, sums, t + 1, b * chambers + i - nodes)
        for w in range(point_threads):
            t = ints[NOW]
            n = points_per_axis(ints)
            points, nodes, elements = product(n), product(nodes_per_axis(n)), ints[ELEMENTS]
            b, p = w // (points + ints[TALLIES]), w % (points + ints[TALLIES])
            if t >= ints[STOP] and p >= points:
                if t >= 0:
                    tally(ints, fixed, bar, back, sums, t, b, p - points, n)
            elif t >= ints[STOP] and ints[ints[KIND] + p] != ABSENT:
                kind = ints[ints[KIND] + p]
                mine = b * COEFFICIENTS * points + p
                mat, mat_bar = ints[COEFFICIENT] + mine, ints[COEFFICIENT_BAR] + mine
                if kind >= 0 and t + 1 < ints[STEPS]:
                    # The gradient by a chamber's volume is known one pass after the points that fill it.
                    by_volume = back[ints[VOLUME_BAR] + b * ints[CHAMBERS] + kind]
                    gas = b * ints[ints[FILLED] + ints[CHAMBERS]] + ints[ints[RANK] + p]
                    add(False, sums, mat_bar + VOLUME * points, by_volume * back[ints[JACOBIANS] + gas])
                if t >= 0:
                    at = (t * ints[BATCH] + b) * state_length(ints, n)
                    history = b * state_length(ints, n) + 6 * nodes + p
                    F = plus_identity(gather_gradient(ints, fixed, state, at, p, n), 1)
                    volume, shear = fixed[mat + VOLUME * points], fixed[mat + SHEAR * points]
                    P_bar = -volume * gather_gradient(ints, fixed, back, ints[FORCES] + b * 3 * nodes, p, n)
                    F_bar = F * 0
                    work = volume * 0  # P : P_bar, by which the gradient by the volume is known
                    if kind < 0:
                        bulk, void_fraction = fixed[mat + BULK * points], fixed[mat + VOID_FRACTION * points]
                        Q = F * 0
                        S = F * 0
                        factor, linear, square = void_fraction * 0 + 1, void_fraction * 0, void_fraction * 0
                        if ti.static(stiffens):
                            linear, square = fixed[mat + STIFFENING * points], fixed[mat + (STIFFENING + 1) * points]
                            factor = stiffening(F, least_ratio(void_fraction), linear, square)
                        if elements > 0 and void_fraction < 1:
                            S = factor * pull_back(F, least_ratio(void_fraction))
                            for e in range(elements):
                                number = ints[ELEMENT] + (b * elements + e) * PRONY
                                Z = load_symmetric(state, at + 6 * nodes + p + 6 * e * points, points)
                                Q += fixed[number + PRONY_MODULUS] * (Z + fixed[number + PRONY_GAIN] * S)
                        by_F, Q_bar, bulk_bar, shear_bar, factor_bar, void_bar = piola_adjoint(
                            F, Q, bulk, shear, factor, void_fraction, P_bar
                        )
                        F_bar = by_F
                        work = bulk * bulk_bar + shear * shear_bar
                        add(False, sums, mat_bar + BULK * points, bulk_bar)
                        add(False, sums, mat_bar + SHEAR * points, shear_bar)
                        add(False, sums, mat_bar + VOID_FRACTION * points, void_bar)
                        if elements > 0 and void_fraction < 1:
                            maxwell = at + 6 * nodes + p
                            S_bar = maxwell_adjoint(
                                ints, fixed, state, maxwell, bar, history, sums, b, p, points, S, Q_bar
                            )
                            F_bar += pull_back_adjoint(F, least_ratio(void_fraction), factor * S_bar)
                            if ti.static(stiffens):
                                factor_bar += contract(S_bar, pull_back(F, least_ratio(void_fraction)))
                        else:
                            for c in range(6 * elements):
                                bar[history + c * points] = 0
                        if ti.static(stiffens):
                            by_F, linear_bar, square_bar = stiffening_adjoint(
                                F, least_ratio(void_fraction), linear, square, factor_bar
                            )
                            F_bar += by_F
                            add(False, sums, mat_bar + STIFFENING * points, linear_bar)
                            add(False, sums, mat_bar + (STIFFENING + 1) * points, square_bar)
                    else:
                        for c in range(6 * elements):
                            bar[history + c * points] = 0
                        cof = cofactor(F)
                        one = b * ints[CHAMBERS] + kind
                        step = t * ints[BATCH] * ints[CHAMBERS] + one
                        p_act, swelled = supply[ints[PRESSURE] + step], kept[ints[VOLUMES] + step]
                        pressure = chamber_pressure(ints, fixed, p_act, swelled, one)
                        by_F, shear_bar = void_piola_adjoint(F, shear, P_bar), void_work(F, P_bar)
                        p_bar = -contract(P_bar, cof)
                        F_bar = by_F - pressure * cross(F, P_bar)
                        work = shear * shear_bar + pressure * p_bar
                        add(False, sums, mat_bar + SHEAR * points, shear_bar)
                        store_matrix(scratch, ints[AREA] + one * BUNDLE * points + p, points, volume * cof)
                        gas = b * ints[ints[FILLED] + ints[CHAMBERS]] + ints[ints[RANK] + p]
                        scratch[ints[SWEPT] + gas] = p_bar
                        back[ints[JACOBIANS] + gas] = contract(cof, F) / 3
                    if ti.static(loaded):
                        eta, zeta = fixed[mat + VISCOSITY * points], fixed[mat + VOLUME_VISCOSITY * points]
                        rate_bar = F * 0
                        if kind < 0 and ints[VISCOUS] == 1:
                            rate = gather_gradient(ints, fixed, state, at + 3 * nodes, p, n)
                            by_F, by_rate, eta_bar, zeta_bar = viscous_piola_adjoint(F, rate, eta, zeta, P_bar)
                            F_bar += by_F
                            rate_bar = by_rate
                            work += eta * eta_bar + zeta * zeta_bar
                            add(False, sums, mat_bar + VISCOSITY * points, eta_bar)
                            add(False, sums, mat_bar + VOLUME_VISCOSITY * points, zeta_bar)
                        store_matrix(back, ints[RATES] + b * BUNDLE * points + p, points, rate_bar)
                        if ints[SPRINGS] == 1:
                            external_adjoint(ints, fixed, state, at, back, scratch, sums, b, p, n)
                        else:
                            vector = ints[POINT_SUM] + (b * BUNDLE + 9) * points + p
                            store_vector(scratch, vector, points, load_vector(fixed, CORNER, 1) * 0)
                    add(False, sums, mat_bar + VOLUME * points, work / volume)
                    store_matrix(scratch, ints[POINT_SUM] + b * BUNDLE * points + p, points, F_bar)
        for w in range(line_threads):
            if w == 0 and ints[NOW] >= ints[STOP]:
                ints[NOW] = ints[NOW] - 1
            n = points_per_axis(ints)
            sum_lines(ints, fixed, scratch, w, n, loaded)
            if ti.static(loaded):
                count = line_count(n)
                if w < ints[BATCH] * count:
                    b, line = w // count, w % count
                    rates, lines = ints[RATES] + b * BUNDLE * product(n), ints[RATE_LINES] + b * LINE * count
                    sum_line(fixed, back, rates, back, lines, line, n, False)
        for w in range(sheet_threads):
            n = points_per_axis(ints)
            sum_sheets(ints, fixed, scratch, w, n)
            if ti.static(loaded):
                count = sheet_count(n)
                if w < ints[BATCH] * count:
                    b, sheet = w // count, w % count
                    lines, sheets = ints[RATE_LINES] + b * LINE * line_count(n), ints[RATE_SHEETS] + b * SHEET * count
                    sum_sheet(fixed, back, lines, sheets, sheet, n)
