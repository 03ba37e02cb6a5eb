"""Adjoint of what a point of the total-Lagrangian form does in a substep: stress, Maxwell elements, forces on it."""

import taichi as ti

from torchsoro.simulation.kernels.lattice import nodes_per_axis, points_per_axis, product
from torchsoro.simulation.kernels.layout import (
    ABSENT,
    ANCHOR,
    BATCH,
    BULK,
    CHAMBERS,
    COEFFICIENT,
    COEFFICIENT_BAR,
    COEFFICIENTS,
    ELEMENT,
    ELEMENT_BAR,
    ELEMENTS,
    JACOBIANS,
    KIND,
    PRESSURE,
    PRONY,
    PRONY_DECAY,
    PRONY_GAIN,
    PRONY_MODULUS,
    SHEAR,
    SPRING,
    SPRINGS,
    STEP_SIZE,
    STEPS,
    STIFFENING,
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
from torchsoro.simulation.kernels.tensor import (
    add,
    cofactor,
    contract,
    cross,
    load_symmetric,
    load_symmetric_adjoint,
    plus_identity,
    store_symmetric_adjoint,
)
from torchsoro.simulation.kernels.tile import hand_over, hand_over_vector, tile_gradient, tile_value
from torchsoro.simulation.kernels.total import (
    chamber_pressure,
    spring_stretch,
    state_length,
)


@ti.func
def maxwell_adjoint(
    head: ti.template(),
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
    elements = head[ELEMENTS]
    S_bar = S * 0
    for e in range(elements):
        place = here + 6 * e * points
        number = head[ELEMENT] + (b * elements + e) * PRONY
        a, gain, g = fixed[number + PRONY_DECAY], fixed[number + PRONY_GAIN], fixed[number + PRONY_MODULUS]
        Z_bar = load_symmetric_adjoint(bar, place, points)
        S_bar += gain * (g * Q_bar - (1 - a) * Z_bar)
        if head[WANT_PRONY] == 1:
            Z = load_symmetric(state, at + 6 * e * points, points)
            mine = head[ELEMENT_BAR] + (b * elements + e) * PRONY * points + p
            by_stress, by_history = contract(Q_bar, S), contract(Z_bar, S)
            add(False, sums, mine + PRONY_MODULUS * points, contract(Q_bar, Z) + gain * by_stress)
            add(False, sums, mine + PRONY_GAIN * points, g * by_stress - (1 - a) * by_history)
            add(False, sums, mine + PRONY_DECAY * points, contract(Z_bar, Z) + gain * by_history)
        store_symmetric_adjoint(bar, place, points, a * Z_bar + g * Q_bar)
    return S_bar


@ti.func
def external_adjoint(
    head: ti.template(),
    fixed: ti.template(),
    pad: ti.template(),
    base,
    q,
    sums: ti.template(),
    b,
    p,
):
    """Adjoint of ``total.external_force``, group forces excepted: by springs, anchors, and (returned) the place."""
    points = product(points_per_axis(head))
    mine = b * COEFFICIENTS * points + p
    mat, mat_bar = head[COEFFICIENT] + mine, head[COEFFICIENT_BAR] + mine
    push_bar = tile_value(pad, base, 1, q)
    spring = fixed[mat + SPRING * points]
    stretch = spring_stretch(head, fixed, tile_value(pad, base, 0, q), b, p)
    add(False, sums, mat_bar + SPRING * points, push_bar.dot(stretch))
    for c in ti.static(range(3)):
        add(False, sums, mat_bar + (ANCHOR + c) * points, spring * push_bar[c])
    return -spring * push_bar


@ti.func
def stress_point_adjoint(
    loaded: ti.template(),
    stiffens: ti.template(),
    head: ti.template(),
    ints: ti.template(),
    fixed: ti.template(),
    supply: ti.template(),
    state: ti.template(),
    kept: ti.template(),
    bar: ti.template(),
    back: ti.template(),
    sums: ti.template(),
    pad: ti.template(),
    base,
    q,
    t,
    b,
    p,
):
    """Adjoint of ``total.stress_point``: sums of its own; hands over the gradients by F and by the place of point p."""
    zero = fixed[STEP_SIZE] * 0
    F_bar = ti.Matrix([[zero, zero, zero], [zero, zero, zero], [zero, zero, zero]])
    place_bar = ti.Vector([zero, zero, zero])
    kind = ti.cast(ABSENT, ti.i32)
    if p >= 0:
        kind = ints[head[KIND] + p]
    points, elements, nodes = product(points_per_axis(head)), head[ELEMENTS], product(nodes_per_axis(head))
    mine = b * COEFFICIENTS * points + p
    mat, mat_bar = head[COEFFICIENT] + mine, head[COEFFICIENT_BAR] + mine
    if kind >= 0 and t + 1 < head[STEPS]:
        # The gradient by a chamber's volume is known one pass after the points that fill it.
        by_volume = back[head[VOLUME_BAR] + b * head[CHAMBERS] + kind]
        add(False, sums, mat_bar + VOLUME * points, by_volume * back[head[JACOBIANS] + b * points + p])
    if t >= 0 and kind != ABSENT:
        history = b * state_length(head) + 6 * nodes + p
        maxwell = (t * head[BATCH] + b) * state_length(head) + 6 * nodes + p
        F = plus_identity(tile_gradient(pad, base, 0, q), 1)
        volume, shear = fixed[mat + VOLUME * points], fixed[mat + SHEAR * points]
        P_bar = -volume * tile_gradient(pad, base, 1, q)
        work = volume * 0  # P : P_bar, by which the gradient by the volume is known
        if kind < 0:
            bulk, void_fraction = fixed[mat + BULK * points], fixed[mat + VOID_FRACTION * points]
            least = least_ratio(void_fraction)
            Q = F * 0
            S = F * 0
            factor, linear, square = void_fraction * 0 + 1, void_fraction * 0, void_fraction * 0
            if ti.static(stiffens):
                linear, square = fixed[mat + STIFFENING * points], fixed[mat + (STIFFENING + 1) * points]
                factor = stiffening(F, least, linear, square)
            if elements > 0 and void_fraction < 1:
                S = factor * pull_back(F, least)
                for e in range(elements):
                    number = head[ELEMENT] + (b * elements + e) * PRONY
                    Z = load_symmetric(state, maxwell + 6 * e * points, points)
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
                S_bar = maxwell_adjoint(head, fixed, state, maxwell, bar, history, sums, b, p, points, S, Q_bar)
                F_bar += pull_back_adjoint(F, least, factor * S_bar)
                if ti.static(stiffens):
                    factor_bar += contract(S_bar, pull_back(F, least))
            else:
                for c in range(6 * elements):
                    bar[history + c * points] = 0
            if ti.static(stiffens):
                by_F, linear_bar, square_bar = stiffening_adjoint(F, least, linear, square, factor_bar)
                F_bar += by_F
                add(False, sums, mat_bar + STIFFENING * points, linear_bar)
                add(False, sums, mat_bar + (STIFFENING + 1) * points, square_bar)
        else:
            for c in range(6 * elements):
                bar[history + c * points] = 0
            cof = cofactor(F)
            one = b * head[CHAMBERS] + kind
            step = t * head[BATCH] * head[CHAMBERS] + one
            p_act, swelled = supply[head[PRESSURE] + step], kept[head[VOLUMES] + step]
            pressure = chamber_pressure(head, fixed, p_act, swelled, one)
            shear_bar = void_work(F, P_bar)
            F_bar = void_piola_adjoint(F, shear, P_bar) - pressure * cross(F, P_bar)
            work = shear * shear_bar - pressure * contract(P_bar, cof)
            add(False, sums, mat_bar + SHEAR * points, shear_bar)
            back[head[JACOBIANS] + b * points + p] = contract(cof, F) / 3
        if ti.static(loaded):
            if kind < 0 and head[VISCOUS] == 1:
                eta, zeta = fixed[mat + VISCOSITY * points], fixed[mat + VOLUME_VISCOSITY * points]
                rate = tile_gradient(pad, base, 2, q)
                by_F, _, eta_bar, zeta_bar = viscous_piola_adjoint(F, rate, eta, zeta, P_bar)
                F_bar += by_F
                work += eta * eta_bar + zeta * zeta_bar
                add(False, sums, mat_bar + VISCOSITY * points, eta_bar)
                add(False, sums, mat_bar + VOLUME_VISCOSITY * points, zeta_bar)
            if head[SPRINGS] == 1:
                place_bar = external_adjoint(head, fixed, pad, base, q, sums, b, p)
        add(False, sums, mat_bar + VOLUME * points, work / volume)
    hand_over(pad, base, q, F_bar)
    if ti.static(loaded):
        hand_over_vector(pad, base, q, place_bar)


@ti.func
def rate_point_adjoint(
    head: ti.template(), ints: ti.template(), fixed: ti.template(), pad: ti.template(), base, q, b, p
):
    """Hand over the gradient by the rate of F at point p, through viscosity."""
    zero = fixed[STEP_SIZE] * 0
    rate_bar = ti.Matrix([[zero, zero, zero], [zero, zero, zero], [zero, zero, zero]])
    if p >= 0:
        if ints[head[KIND] + p] == -1:
            points = product(points_per_axis(head))
            mat = head[COEFFICIENT] + b * COEFFICIENTS * points + p
            F = plus_identity(tile_gradient(pad, base, 0, q), 1)
            P_bar = -fixed[mat + VOLUME * points] * tile_gradient(pad, base, 1, q)
            rate = tile_gradient(pad, base, 2, q)
            eta, zeta = fixed[mat + VISCOSITY * points], fixed[mat + VOLUME_VISCOSITY * points]
            _, by_rate, _, _ = viscous_piola_adjoint(F, rate, eta, zeta, P_bar)
            rate_bar = by_rate
    hand_over(pad, base, q, rate_bar)
