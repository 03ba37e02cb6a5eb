"""Adjoint of what points do in lanes: from the gradient by forces on the nodes to that by their places."""

from __future__ import annotations

from torchsoro.simulation.kernels.lane_laws import (
    cofactor,
    contract,
    cross,
    excess,
    least_ratio,
    piola_adjoint,
    plus,
    pull_back,
    pull_back_adjoint,
    viscous_piola_adjoint,
)
from torchsoro.simulation.kernels.lane_march import clear, clear_sums
from torchsoro.simulation.kernels.lane_nodes import pressure_of
from torchsoro.simulation.kernels.lane_points import (
    ATTACHED,
    BULK,
    MAXWELL,
    NUMBERS,
    SHEAR,
    STIFFENING,
    VISCOSITY,
    VOID_FRACTION,
    VOLUME,
    VOLUME_VISCOSITY,
    deformed,
    gather,
    hand_on,
    keep,
    plain,
    scatter,
    stretch,
    value,
)
from torchsoro.simulation.kernels.lane_walls import walls_backward
from torchsoro.simulation.kernels.lanes import larger, law, load, part, select, store
from torchsoro.simulation.kernels.laws_lanes import laws

softening, softening_adjoint = laws.softening, laws.softening_adjoint


@law
def add(a, at, value):
    """Add to sixteen numbers."""
    store(a, at, load(a, at) + value)


@law
def point_adjoint(
    G,
    B,
    rates,
    at,
    numbers,
    n,
    past,
    before,
    bars,
    after,
    elements,
    maxwell,
    m,
    flags,
    softens,
    sums,
    number_sums,
    e_sums,
    s_sums,
):
    """Gradient by F of a point, stored in place of its gradient, from that by the stress, which is in B."""
    F = deformed(G, at)
    W = plain(B, at)
    volume, void_fraction = load(numbers, n), load(numbers, n + 16 * VOID_FRACTION)
    bulk, shear = load(numbers, n + 16 * BULK), load(numbers, n + 16 * SHEAR)
    cof = cofactor(F)
    ratio = F[0] * cof[0] + F[1] * cof[1] + F[2] * cof[2]
    least = least_ratio(void_fraction)
    there = select(void_fraction < 1, 0 * volume + 1, 0 * volume)
    factor, left = there, 0 * volume + 1
    x, shrink, linear, square = 0 * volume, 0 * volume, 0 * volume, 0 * volume
    depth, reach = 0 * volume, 0 * volume + 1
    end = 96 * elements
    if flags[0] or flags[1]:
        x, shrink = excess(F, larger(ratio, least))
        if flags[0]:
            linear, square = load(numbers, n + 16 * STIFFENING), load(numbers, n + 16 * STIFFENING + 16)
            factor = there * (1 + x * (linear + square * x))
        if flags[1]:
            depth, reach = load(softens, 0), load(softens, 16)
            left, _ = softening(x, load(past, before + end), depth, reach)
    T = (0 * factor, 0 * factor, 0 * factor, 0 * factor, 0 * factor, 0 * factor)
    Q0, Q1, Q2, Q3, Q4, Q5 = 0 * volume, 0 * volume, 0 * volume, 0 * volume, 0 * volume, 0 * volume
    if elements > 0:
        T = pull_back(F, least)
    S = (factor * T[0], factor * T[1], factor * T[2], factor * T[3], factor * T[4], factor * T[5])
    for e in range(elements):
        g, b = load(maxwell, m + 64 * e), load(maxwell, m + 64 * e + 16)
        gb, i = g * b, before + 96 * e
        Q0, Q1 = Q0 + g * load(past, i) + gb * S[0], Q1 + g * load(past, i + 16) + gb * S[1]
        Q2, Q3 = Q2 + g * load(past, i + 32) + gb * S[2], Q3 + g * load(past, i + 48) + gb * S[3]
        Q4, Q5 = Q4 + g * load(past, i + 64) + gb * S[4], Q5 + g * load(past, i + 80) + gb * S[5]
    W = plus(-1.0, W, 0.0, W)
    F_bar, R, bulk_bar, shear_bar, whole_bar, fraction_bar = piola_adjoint(
        F, cof, ratio, (Q0, Q1, Q2, Q3, Q4, Q5), bulk, shear, factor * left, void_fraction, W
    )
    work = bulk * bulk_bar + shear * shear_bar
    F_bar = plus(volume, F_bar, 0.0, F_bar)
    factor_bar = there * volume * left * whole_bar
    # S_bar gathers from all elements.
    Z0, Z1, Z2, Z3, Z4, Z5 = 0 * volume, 0 * volume, 0 * volume, 0 * volume, 0 * volume, 0 * volume
    for e in range(elements):
        g, b, a = load(maxwell, m + 64 * e), load(maxwell, m + 64 * e + 16), load(maxwell, m + 64 * e + 32)
        fade = load(maxwell, m + 64 * e + 48)
        q0, q1, q2 = volume * R[0], volume * R[1], volume * R[2]
        q3, q4, q5 = volume * R[3], volume * R[4], volume * R[5]
        o, i = after + 96 * e, before + 96 * e
        h0, h1, h2 = load(bars, o), load(bars, o + 16), load(bars, o + 32)
        h3, h4, h5 = load(bars, o + 48), load(bars, o + 64), load(bars, o + 80)
        lost = 1 - a
        Z0, Z1, Z2 = (
            Z0 + b * g * q0 - fade * h0, Z1 + b * g * q1 - fade * h1, Z2 + b * g * q2 - fade * h2
        )  # fmt: skip
        Z3, Z4, Z5 = (
            Z3 + b * g * q3 - fade * h3, Z4 + b * g * q4 - fade * h4, Z5 + b * g * q5 - fade * h5
        )  # fmt: skip
        if flags[3]:
            z0, z1, z2 = load(past, i), load(past, i + 16), load(past, i + 32)
            z3, z4, z5 = load(past, i + 48), load(past, i + 64), load(past, i + 80)
            by_stress = q0 * S[0] + q1 * S[1] + q2 * S[2] + q3 * S[3] + q4 * S[4] + q5 * S[5]
            by_history = h0 * S[0] + h1 * S[1] + h2 * S[2] + h3 * S[3] + h4 * S[4] + h5 * S[5]
            direct = q0 * z0 + q1 * z1 + q2 * z2 + q3 * z3 + q4 * z4 + q5 * z5
            fading = h0 * z0 + h1 * z1 + h2 * z2 + h3 * z3 + h4 * z4 + h5 * z5
            add(sums.maxwell, e_sums + 48 * e, direct + b * by_stress)
            add(sums.maxwell, e_sums + 48 * e + 16, g * by_stress - lost * by_history)
            add(sums.maxwell, e_sums + 48 * e + 32, fading + b * by_history)
        store(bars, o, a * h0 + g * q0)
        store(bars, o + 16, a * h1 + g * q1)
        store(bars, o + 32, a * h2 + g * q2)
        store(bars, o + 48, a * h3 + g * q3)
        store(bars, o + 64, a * h4 + g * q4)
        store(bars, o + 80, a * h5 + g * q5)
    if elements > 0:
        B6 = (factor * Z0, factor * Z1, factor * Z2, factor * Z3, factor * Z4, factor * Z5)
        F_bar = plus(1.0, F_bar, 1.0, pull_back_adjoint(F, cof, ratio, least, B6))
        factor_bar = factor_bar + there * (Z0 * T[0] + Z1 * T[1] + Z2 * T[2] + Z3 * T[3] + Z4 * T[4] + Z5 * T[5])
    if flags[0] or flags[1]:
        x_bar = factor_bar * (linear + 2 * square * x)
        if flags[0]:
            add(sums.numbers, number_sums + 16 * STIFFENING, factor_bar * x)
            add(sums.numbers, number_sums + 16 * STIFFENING + 16, factor_bar * x * x)
        if flags[1]:
            later = select(void_fraction < 1, load(bars, after + end), 0 * x)
            by_x, largest_bar, depth_bar, reach_bar = softening_adjoint(
                x, load(past, before + end), depth, reach, volume * factor * whole_bar, later
            )
            add(sums.softening, s_sums, depth_bar)
            add(sums.softening, s_sums + 16, reach_bar)
            store(bars, after + end, largest_bar)
            x_bar = x_bar + by_x
        x_bar = select(x > 0, x_bar, 0 * x)
        J = larger(ratio, least)
        J_bar = select(ratio < least, 0 * x, -2 * (x + 3) * x_bar / (3 * J))
        F_bar = plus(1.0, F_bar, 2 * shrink * x_bar, F)
        F_bar = plus(1.0, F_bar, J_bar, cof)
    if flags[2]:
        eta, zeta = load(numbers, n + 16 * VISCOSITY), load(numbers, n + 16 * VOLUME_VISCOSITY)
        by_F, by_rate, eta_bar, zeta_bar = viscous_piola_adjoint(F, plain(rates, at), eta, zeta, W)
        F_bar = plus(1.0, F_bar, volume, by_F)
        keep(rates, at, by_rate, volume)
        work = work + eta * eta_bar + zeta * zeta_bar
        add(sums.numbers, number_sums + 16 * VISCOSITY, volume * eta_bar)
        add(sums.numbers, number_sums + 16 * VOLUME_VISCOSITY, volume * zeta_bar)
    add(sums.numbers, number_sums + 16 * VOLUME, work)
    add(sums.numbers, number_sums + 16 * BULK, volume * bulk_bar)
    add(sums.numbers, number_sums + 16 * SHEAR, volume * shear_bar)
    add(sums.numbers, number_sums + 16 * VOID_FRACTION, volume * fraction_bar)
    keep(G, at, F_bar, 0 * volume + 1)


@part
def gas_backward(mesh, case, work, sums, g, item, b, t, last, room, G, B, rates):
    """Through the area vectors of a block's gas, at a pressure that is known."""
    x, items, size, pairs = mesh.item_x[item], len(mesh.item_plane), 9 * mesh.patch, len(mesh.gas_chamber)
    for pair in range(mesh.gas_begin[b], mesh.gas_begin[b + 1]):
        chamber = mesh.gas_chamber[pair]
        one = (g * items + item) * mesh.chambers + chamber
        base = (g * pairs + pair) * 128
        swept = load(work.swept, 16 * one)
        step = 16 * ((t * case.groups + g) * mesh.chambers + chamber)
        mine = 16 * (g * mesh.chambers + chamber)
        pressure = pressure_of(case, work, mine, step)
        by_volume = load(sums.volume_bar, mine)
        for k in range(8):
            F, W, V = deformed(G, 144 * k), plain(B, 144 * k), load(case.gas, base + 16 * k)
            cof = cofactor(F)
            keep(rates, 1152 + 144 * k, cof, V)
            pressed = contract(W, cof)
            swept = swept + V * pressed
            V_bar = pressure * pressed
            if not last:
                V_bar = V_bar + by_volume * load(sums.ratios, base + 16 * k)
            add(sums.gas, base + 16 * k, V_bar)
            store(sums.ratios, base + 16 * k, contract(cof, F) * (1 / 3))
            keep(rates, 2304 + 144 * k, cross(F, W), pressure * V)
        store(work.swept, 16 * one, swept)
        scatter(mesh, b, x, work.areas, one * size, room, rates[1152:])
        scatter(mesh, b, x, work.forces, (g * items + item) * size, room, rates[2304:])


@part
def springs_backward(mesh, case, work, sums, g, item, b, corner, force, rates):
    """Through the springs of a block."""
    x, out = mesh.item_x[item], (g * len(mesh.item_plane) + item) * 9 * mesh.patch
    for k in range(8):
        u = value(mesh, b, x, work.states, corner, k)
        p0, p1, p2 = value(mesh, b, x, sums.pulls, force, k)
        at = (g * len(mesh.block_at) + b) * 128 * ATTACHED + 16 * ATTACHED * k
        w0, w1, w2 = stretch(u, case.attached, at)
        spring = load(case.attached, at)
        add(sums.attached, at, p0 * w0 + p1 * w1 + p2 * w2)
        add(sums.attached, at + 16, spring * p0)
        add(sums.attached, at + 32, spring * p1)
        add(sums.attached, at + 48, spring * p2)
        store(rates, 1152 + 48 * k, -spring * p0)
        store(rates, 1152 + 48 * k + 16, -spring * p1)
        store(rates, 1152 + 48 * k + 32, -spring * p2)
    hand_on(mesh, b, x, work.forces, out, rates[1152:])


@part
def points_backward(mesh, case, work, sums, g, item, t, last, state, past, room, G, B, rates):
    """Gradients by the nodes' places of an item, from those by the forces."""
    items, size = len(mesh.item_plane), 9 * mesh.patch
    out = (g * items + item) * size
    clear_sums(mesh, work, g, item)
    if case.flags[2]:
        clear(mesh, item, sums.rates, out)
    place = mesh.front + mesh.item_plane[item] * mesh.plane
    corner, force = state + place, g * 3 * mesh.component + place
    x = mesh.item_x[item]
    blocks, each = len(mesh.block_at), 16 * case.history
    for b in range(mesh.item_begin[item], mesh.item_begin[item + 1]):
        gather(mesh, b, x, work.states, corner, room, G)
        gather(mesh, b, x, sums.pulls, force, room, B)
        if case.flags[2]:
            gather(mesh, b, x, work.states, corner + 3 * mesh.component, room, rates)
        if mesh.gas_begin[b] < mesh.gas_begin[b + 1]:
            gas_backward(mesh, case, work, sums, g, item, b, t, last, room, G, B, rates)
        n = (g * blocks + b) * 128 * NUMBERS
        h = (g * blocks + b) * 8 * each
        e = (g * blocks + b) * 48 * case.elements
        m, s = g * 16 * MAXWELL * case.elements, case.softening[32 * g :]
        for k in range(8):
            point_adjoint(
                G, B, rates, 144 * k, case.numbers, n + 16 * NUMBERS * k, work.histories, past + h + each * k,
                sums.history_bar, h + each * k, case.elements, case.maxwell, m, case.flags, s,
                sums, n + 16 * NUMBERS * k, e, (g * blocks + b) * 32,
            )  # fmt: skip
        scatter(mesh, b, x, work.forces, out, room, G)
        if case.flags[4]:
            springs_backward(mesh, case, work, sums, g, item, b, corner, force, rates)
        if case.flags[2]:
            scatter(mesh, b, x, sums.rates, out, room, rates)
    if mesh.wall_begin[item] < mesh.wall_begin[item + 1]:
        walls_backward(mesh, case, work, sums, g, item, t, corner, force)


@part
def gas_end(mesh, sums, g, item):
    """The gradient by volumes of gas that the first substep still owes."""
    pairs = len(mesh.gas_chamber)
    for b in range(mesh.item_begin[item], mesh.item_begin[item + 1]):
        for pair in range(mesh.gas_begin[b], mesh.gas_begin[b + 1]):
            by_volume = load(sums.volume_bar, 16 * (g * mesh.chambers + mesh.gas_chamber[pair]))
            base = (g * pairs + pair) * 128
            for k in range(8):
                add(sums.gas, base + 16 * k, by_volume * load(sums.ratios, base + 16 * k))
