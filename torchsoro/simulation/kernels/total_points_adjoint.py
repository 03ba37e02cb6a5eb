"""Adjoint of what a point of the total-Lagrangian form does in a substep: stress, Maxwell elements, forces on it."""

import taichi as ti

from torchsoro.simulation.kernels.lattice import nodes_per_axis, points_per_axis, product, state_length
from torchsoro.simulation.kernels.laws_taichi import laws
from torchsoro.simulation.kernels.layout import (
    ABSENT,
    AIR_SHARE,
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
    ENCLOSES,
    HISTORIES,
    JACOBIANS,
    KIND,
    LOADED,
    PRONY,
    PRONY_DECAY,
    PRONY_GAIN,
    PRONY_MODULUS,
    SHARED_AIR,
    SHEAR,
    SOFTENING,
    SOFTENING_BAR,
    SOFTENS,
    SPRING,
    SPRINGS,
    STEP_SIZE,
    STEPS,
    STIFFENING,
    STIFFENS,
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
    excess,
    excess_adjoint,
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
from torchsoro.simulation.kernels.total import softened, spring_stretch
from torchsoro.simulation.kernels.total_walls import chamber_pressure


@ti.func
def maxwell_adjoint(block: ti.template(), at, here, b, p, points, S, Q_bar):
    """Through the Maxwell elements of a point, whose places in state and adjoint are given: the gradient by S."""
    head, fixed, bar, sums = ti.static((block.head, block.fixed, block.bar, block.sums))
    elements = head[ELEMENTS]
    S_bar = S * 0
    for e in range(elements):
        place = here + 6 * e * points
        number = head[ELEMENT] + (b * elements + e) * PRONY
        a, gain, g = fixed[number + PRONY_DECAY], fixed[number + PRONY_GAIN], fixed[number + PRONY_MODULUS]
        Z_bar = load_symmetric_adjoint(bar, place, points)
        S_bar += gain * (g * Q_bar - (1 - a) * Z_bar)
        if head[WANT_PRONY] == 1:
            Z = load_symmetric(block.state, at + 6 * e * points, points)
            mine = head[ELEMENT_BAR] + (b * elements + e) * PRONY * points + p
            by_stress, by_history = contract(Q_bar, S), contract(Z_bar, S)
            add(False, sums, mine + PRONY_MODULUS * points, contract(Q_bar, Z) + gain * by_stress)
            add(False, sums, mine + PRONY_GAIN * points, g * by_stress - (1 - a) * by_history)
            add(False, sums, mine + PRONY_DECAY * points, contract(Z_bar, Z) + gain * by_history)
        store_symmetric_adjoint(bar, place, points, a * Z_bar + g * Q_bar)
    return S_bar


@ti.func
def external_adjoint(block: ti.template(), q, b, p):
    """Adjoint of ``total.external_force``, group forces excepted: by springs, anchors, and (returned) the place."""
    head, sums = ti.static((block.head, block.sums))
    points = product(points_per_axis(head))
    mine = b * COEFFICIENTS * points + p
    mat, mat_bar = head[COEFFICIENT] + mine, head[COEFFICIENT_BAR] + mine
    push_bar = tile_value(block, 1, q)
    spring = block.fixed[mat + SPRING * points]
    stretch = spring_stretch(block, tile_value(block, 0, q), b, p)
    add(False, sums, mat_bar + SPRING * points, push_bar.dot(stretch))
    for c in ti.static(range(3)):
        add(False, sums, mat_bar + (ANCHOR + c) * points, spring * push_bar[c])
    return -spring * push_bar


@ti.func
def softened_adjoint(block: ti.template(), x, at, here, b, p, points, left_bar):
    """Adjoint of ``total.softened``: gradients by its numbers and, in place, by the largest x; returns that by x."""
    head, fixed = ti.static((block.head, block.fixed))
    depth, reach = fixed[head[SOFTENING] + 2 * b], fixed[head[SOFTENING] + 2 * b + 1]
    x_bar, largest_bar, depth_bar, reach_bar = laws.softening_adjoint(
        x, block.state[at], depth, reach, left_bar, block.bar[here]
    )
    block.bar[here] = largest_bar
    mine = head[SOFTENING_BAR] + 2 * b * points + p
    add(False, block.sums, mine, depth_bar)
    add(False, block.sums, mine + points, reach_bar)
    return x_bar


@ti.func
def chamber_pressure_at(block: ti.template(), t, b, chamber):
    """Pressure of a chamber in substep t, by the volume that was kept."""
    one = b * block.head[CHAMBERS] + chamber
    volume = block.kept[block.head[VOLUMES] + t * block.head[BATCH] * block.head[CHAMBERS] + one]
    return chamber_pressure(block, t, volume, one)


@ti.func
def owed_by_volume(block: ti.template(), b, p, chamber, mat, mat_bar, points):
    """Gradient by a point's volume of air from that by its chamber's, which is known one pass after the points."""
    head, sums = ti.static((block.head, block.sums))
    by_volume = (
        block.back[head[VOLUME_BAR] + b * head[CHAMBERS] + chamber] * block.back[head[JACOBIANS] + b * points + p]
    )
    if ti.static(block.features & SHARED_AIR):
        add(False, sums, mat_bar + AIR_SHARE * points, by_volume * block.fixed[mat + VOLUME * points])
        by_volume *= block.fixed[mat + AIR_SHARE * points]
    add(False, sums, mat_bar + VOLUME * points, by_volume)


@ti.func
def stress_point_adjoint(block: ti.template(), q, t, b, p):
    """Adjoint of ``total.stress_point``: hands over the gradients by F and by the place of point p."""
    head, fixed, state, bar, sums = ti.static((block.head, block.fixed, block.state, block.bar, block.sums))
    zero = fixed[STEP_SIZE] * 0
    F_bar = ti.Matrix([[zero, zero, zero], [zero, zero, zero], [zero, zero, zero]])
    place_bar = ti.Vector([zero, zero, zero])
    kind = ti.cast(ABSENT, ti.i32)
    if p >= 0:
        kind = block.ints[head[KIND] + p]
    points, elements, nodes = product(points_per_axis(head)), head[ELEMENTS], product(nodes_per_axis(head))
    mine = b * COEFFICIENTS * points + p
    mat, mat_bar = head[COEFFICIENT] + mine, head[COEFFICIENT_BAR] + mine
    air = kind
    if ti.static(block.features & SHARED_AIR):
        air = ti.select(kind <= ENCLOSES, ENCLOSES - kind, kind)
    if air >= 0 and t + 1 < head[STEPS]:
        owed_by_volume(block, b, p, air, mat, mat_bar, points)
    if t >= 0 and kind != ABSENT:
        history = b * state_length(head) + 6 * nodes + p
        maxwell = (t * head[BATCH] + b) * state_length(head) + 6 * nodes + p
        F = plus_identity(tile_gradient(block, 0, q), 1)
        volume, shear = fixed[mat + VOLUME * points], fixed[mat + SHEAR * points]
        P_bar = -volume * tile_gradient(block, 1, q)
        work = volume * 0  # P : P_bar, by which the gradient by the volume is known
        if kind < 0:
            bulk, void_fraction = fixed[mat + BULK * points], fixed[mat + VOID_FRACTION * points]
            least = least_ratio(void_fraction)
            Q = F * 0
            S = F * 0
            factor, linear, square = void_fraction * 0 + 1, void_fraction * 0, void_fraction * 0
            if ti.static(block.features & STIFFENS):
                linear, square = fixed[mat + STIFFENING * points], fixed[mat + (STIFFENING + 1) * points]
                factor = stiffening(F, least, linear, square)
            left, x, x_bar = void_fraction * 0 + 1, void_fraction * 0, void_fraction * 0
            if void_fraction < 1:
                if ti.static(block.features & SOFTENS):
                    x = excess(F, least)
                    left, _ = softened(block, x, maxwell + 6 * elements * points, b)
                if elements > 0:
                    S = factor * pull_back(F, least)
                    for e in range(elements):
                        number = head[ELEMENT] + (b * elements + e) * PRONY
                        Z = load_symmetric(state, maxwell + 6 * e * points, points)
                        Q += fixed[number + PRONY_MODULUS] * (Z + fixed[number + PRONY_GAIN] * S)
            by_F, Q_bar, bulk_bar, shear_bar, whole_bar, void_bar = piola_adjoint(
                F, Q, bulk, shear, factor * left, void_fraction, P_bar
            )
            F_bar, factor_bar = by_F, left * whole_bar
            work = bulk * bulk_bar + shear * shear_bar
            add(False, sums, mat_bar + BULK * points, bulk_bar)
            add(False, sums, mat_bar + VOID_FRACTION * points, void_bar)
            if void_fraction < 1:
                if elements > 0:
                    S_bar = maxwell_adjoint(block, maxwell, history, b, p, points, S, Q_bar)
                    F_bar += pull_back_adjoint(F, least, factor * S_bar)
                    if ti.static(block.features & STIFFENS):
                        factor_bar += contract(S_bar, pull_back(F, least))
                if ti.static(block.features & SOFTENS):
                    last = 6 * elements * points
                    x_bar = softened_adjoint(block, x, maxwell + last, history + last, b, p, points, factor * whole_bar)
                    F_bar += excess_adjoint(F, least, x_bar)
            else:
                for c in range(head[HISTORIES]):
                    bar[history + c * points] = 0
            add(False, sums, mat_bar + SHEAR * points, shear_bar)
            if ti.static(block.features & STIFFENS):
                by_F, linear_bar, square_bar = stiffening_adjoint(F, least, linear, square, factor_bar)
                F_bar += by_F
                add(False, sums, mat_bar + STIFFENING * points, linear_bar)
                add(False, sums, mat_bar + (STIFFENING + 1) * points, square_bar)
            if ti.static(block.features & SHARED_AIR):
                if air >= 0:
                    cof, share = cofactor(F), fixed[mat + AIR_SHARE * points]
                    pressure = chamber_pressure_at(block, t, b, air)
                    pressed = pressure * contract(P_bar, cof)
                    F_bar -= share * pressure * cross(F, P_bar)
                    work -= share * pressed
                    add(False, sums, mat_bar + AIR_SHARE * points, -pressed)
                    block.back[head[JACOBIANS] + b * points + p] = contract(cof, F) / 3
        else:
            for c in range(head[HISTORIES]):
                bar[history + c * points] = 0
            cof = cofactor(F)
            pressure = chamber_pressure_at(block, t, b, kind)
            shear_bar = void_work(F, P_bar)
            F_bar = void_piola_adjoint(F, shear, P_bar) - pressure * cross(F, P_bar)
            work = shear * shear_bar - pressure * contract(P_bar, cof)
            add(False, sums, mat_bar + SHEAR * points, shear_bar)
            block.back[head[JACOBIANS] + b * points + p] = contract(cof, F) / 3
        if ti.static(block.features & LOADED):
            if kind < 0 and head[VISCOUS] == 1:
                eta, zeta = fixed[mat + VISCOSITY * points], fixed[mat + VOLUME_VISCOSITY * points]
                rate = tile_gradient(block, 2, q)
                by_F, _, eta_bar, zeta_bar = viscous_piola_adjoint(F, rate, eta, zeta, P_bar)
                F_bar += by_F
                work += eta * eta_bar + zeta * zeta_bar
                add(False, sums, mat_bar + VISCOSITY * points, eta_bar)
                add(False, sums, mat_bar + VOLUME_VISCOSITY * points, zeta_bar)
            if head[SPRINGS] == 1:
                place_bar = external_adjoint(block, q, b, p)
        add(False, sums, mat_bar + VOLUME * points, work / volume)
    hand_over(block, q, F_bar)
    if ti.static(block.features & LOADED):
        hand_over_vector(block, q, place_bar)


@ti.func
def rate_point_adjoint(block: ti.template(), q, b, p):
    """Hand over the gradient by the rate of F at point p, through viscosity."""
    head, fixed = ti.static((block.head, block.fixed))
    zero = fixed[STEP_SIZE] * 0
    rate_bar = ti.Matrix([[zero, zero, zero], [zero, zero, zero], [zero, zero, zero]])
    if p >= 0:
        kind = block.ints[head[KIND] + p]
        if kind < 0 and kind != ABSENT:
            points = product(points_per_axis(head))
            mat = head[COEFFICIENT] + b * COEFFICIENTS * points + p
            F = plus_identity(tile_gradient(block, 0, q), 1)
            P_bar = -fixed[mat + VOLUME * points] * tile_gradient(block, 1, q)
            rate = tile_gradient(block, 2, q)
            eta, zeta = fixed[mat + VISCOSITY * points], fixed[mat + VOLUME_VISCOSITY * points]
            _, by_rate, _, _ = viscous_piola_adjoint(F, rate, eta, zeta, P_bar)
            rate_bar = by_rate
    hand_over(block, q, rate_bar)
