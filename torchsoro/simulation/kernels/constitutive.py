"""A particle's material: its stress from its state, its new state from a velocity gradient, and the adjoints.

Here the stress laws of ``stress`` meet the state buffers; transfers and nodes know nothing of them.
"""

import taichi as ti

from torchsoro.simulation.kernels.layout import (
    AFFINE,
    BULK,
    DEFORMATION,
    FLAG_COLLAPSED,
    HISTORY,
    PRONY,
    PRONY_DECAY,
    PRONY_GAIN,
    PRONY_MODULUS,
    SHEAR,
    STIFFENING,
    VISCOSITY,
    VOID_FRACTION,
    VOLUME_VISCOSITY,
)
from torchsoro.simulation.kernels.stress import (
    gas_pressure,
    least_ratio,
    piola,
    piola_adjoint,
    pull_back,
    pull_back_adjoint,
    stiffening,
    stiffening_adjoint,
    viscous_stress,
    viscous_stress_adjoint,
)
from torchsoro.simulation.kernels.tensor import (
    add,
    cofactor,
    contract,
    load_matrix,
    load_symmetric,
    load_symmetric_adjoint,
    plus_identity,
    store_matrix,
    store_symmetric,
    store_symmetric_adjoint,
)


@ti.func
def history_sum(state: ti.template(), at, stride, prony: ti.template(), prony_at, elements):
    """Q = sum_i g_i H_i over the Maxwell elements."""
    Q = load_symmetric(state, at, stride) * prony[prony_at + PRONY_MODULUS]
    for e in range(1, elements):
        H = load_symmetric(state, at + 6 * e * stride, stride)
        Q += H * prony[prony_at + PRONY * e + PRONY_MODULUS]
    return Q


@ti.func
def stiffness(stiffens: ti.template(), F, least, coefficients: ti.template(), mat, particles):
    """The factor of ``stress.stiffening`` of a particle; 1 in kernels without."""
    factor = F[0, 0] * 0 + 1
    if ti.static(stiffens):
        a, b = coefficients[mat + STIFFENING * particles], coefficients[mat + (STIFFENING + 1) * particles]
        factor = stiffening(F, least, a, b)
    return factor


@ti.func
def stiffness_adjoint(
    F, least, coefficients: ti.template(), coefficients_bar: ti.template(), mat, particles, factor_bar
):
    """Adjoint of :func:`stiffness`, in kernels with it: adds to the coefficients' gradient, returns the one by F."""
    a, b = coefficients[mat + STIFFENING * particles], coefficients[mat + (STIFFENING + 1) * particles]
    F_bar, a_bar, b_bar = stiffening_adjoint(F, least, a, b, factor_bar)
    add(False, coefficients_bar, mat + STIFFENING * particles, a_bar)
    add(False, coefficients_bar, mat + (STIFFENING + 1) * particles, b_bar)
    return F_bar


@ti.func
def stress(
    stiffens: ti.template(),
    state: ti.template(),
    at,
    coefficients: ti.template(),
    mat,
    particles,
    prony: ti.template(),
    prony_at,
    elements,
    kind,
    pressure: ti.template(),
    pressure_at,
):
    """Kirchhoff stress of a particle from its state: solid with Maxwell elements, or gas; both with viscosity."""
    F = load_matrix(state, at + DEFORMATION * particles, particles)
    C = load_matrix(state, at + AFFINE * particles, particles)
    bulk = coefficients[mat + BULK * particles]
    J = F[0, 0]
    tau = F * 0
    if kind < 0:
        J = F.determinant()
        Q = F * 0
        if elements > 0:
            Q = history_sum(state, at + HISTORY * particles, particles, prony, prony_at, elements)
        shear, void_fraction = coefficients[mat + SHEAR * particles], coefficients[mat + VOID_FRACTION * particles]
        factor = stiffness(stiffens, F, least_ratio(void_fraction), coefficients, mat, particles)
        tau = piola(F, Q, bulk, shear, factor, void_fraction) @ F.transpose()
    else:
        tau = plus_identity(tau, -J * gas_pressure(J, bulk, pressure[pressure_at + kind]))
    eta = coefficients[mat + VISCOSITY * particles]
    zeta = coefficients[mat + VOLUME_VISCOSITY * particles]
    if eta != 0 or zeta != 0:
        tau += viscous_stress(J, C, eta, zeta)
    return tau


@ti.func
def stress_adjoint(
    stiffens: ti.template(),
    atomic: ti.template(),
    state: ti.template(),
    at,
    bar: ti.template(),
    here,
    coefficients: ti.template(),
    coefficients_bar: ti.template(),
    mat,
    particles,
    prony: ti.template(),
    prony_at,
    prony_bar: ti.template(),
    prony_row,
    want_prony,
    elements,
    kind,
    pressure: ti.template(),
    pressure_at,
    pressure_bar: ti.template(),
    pressure_row,
    tau_bar,
):
    """Adjoint of ``forward.stress``: adds to F and H in the adjoint state, returns the gradient by C."""
    F = load_matrix(state, at + DEFORMATION * particles, particles)
    C = load_matrix(state, at + AFFINE * particles, particles)
    bulk = coefficients[mat + BULK * particles]
    F_bar = load_matrix(bar, here + DEFORMATION * particles, particles)
    C_bar = F * 0
    J = F[0, 0]
    J_bar = J * 0
    if kind < 0:
        J = F.determinant()
        Q = F * 0
        if elements > 0:
            Q = history_sum(state, at + HISTORY * particles, particles, prony, prony_at, elements)
        shear = coefficients[mat + SHEAR * particles]
        void_fraction = coefficients[mat + VOID_FRACTION * particles]
        factor = stiffness(stiffens, F, least_ratio(void_fraction), coefficients, mat, particles)
        by_F, Q_bar, bulk_bar, shear_bar, factor_bar, void_bar = piola_adjoint(
            F, Q, bulk, shear, factor, void_fraction, tau_bar @ F
        )
        F_bar += by_F + tau_bar.transpose() @ piola(F, Q, bulk, shear, factor, void_fraction)
        if ti.static(stiffens):
            F_bar += stiffness_adjoint(
                F, least_ratio(void_fraction), coefficients, coefficients_bar, mat, particles, factor_bar
            )
        add(False, coefficients_bar, mat + VOID_FRACTION * particles, void_bar)
        add(False, coefficients_bar, mat + BULK * particles, bulk_bar)
        add(False, coefficients_bar, mat + SHEAR * particles, shear_bar)
        for e in range(elements):
            place = (HISTORY + 6 * e) * particles
            H_bar = load_symmetric_adjoint(bar, here + place, particles)
            H_bar += prony[prony_at + PRONY * e + PRONY_MODULUS] * Q_bar
            store_symmetric_adjoint(bar, here + place, particles, H_bar)
            if want_prony == 1:
                H = load_symmetric(state, at + place, particles)
                add(atomic, prony_bar, prony_row + PRONY * e + PRONY_MODULUS, contract(Q_bar, H))
    else:
        trace_bar = tau_bar.trace()
        J_bar = trace_bar * (J * bulk - gas_pressure(J, bulk, pressure[pressure_at + kind]))
        add(False, coefficients_bar, mat + BULK * particles, -(J * (1 - J) * trace_bar))
        add(atomic, pressure_bar, pressure_row + kind, -J * trace_bar)
    eta = coefficients[mat + VISCOSITY * particles]
    zeta = coefficients[mat + VOLUME_VISCOSITY * particles]
    by_J, by_C, eta_bar, zeta_bar = viscous_stress_adjoint(J, C, eta, zeta, tau_bar)
    C_bar = by_C
    J_bar += by_J
    add(False, coefficients_bar, mat + VISCOSITY * particles, eta_bar)
    add(False, coefficients_bar, mat + VOLUME_VISCOSITY * particles, zeta_bar)
    if kind < 0:
        F_bar += J_bar * cofactor(F)
    else:
        F_bar[0, 0] += J_bar
    store_matrix(bar, here + DEFORMATION * particles, particles, F_bar)
    return C_bar


@ti.func
def deform(
    stiffens: ti.template(),
    state: ti.template(),
    at,
    out,
    coefficients: ti.template(),
    mat,
    particles,
    prony: ti.template(),
    prony_at,
    elements,
    kind,
    step_gradient,
    flags: ti.template(),
):
    """F <- (I + dt L) F (a gas keeps only J), then the exact-exponential history H <- a H + b (S' - S)."""
    F = load_matrix(state, at + DEFORMATION * particles, particles)
    if kind < 0:
        F_new = F + step_gradient @ F
        store_matrix(state, out + DEFORMATION * particles, particles, F_new)
        if F_new.determinant() <= 0:
            flags[FLAG_COLLAPSED] = 1
        if elements > 0:
            before = stiffness(stiffens, F, 0, coefficients, mat, particles)
            after = stiffness(stiffens, F_new, 0, coefficients, mat, particles)
            change = after * pull_back(F_new, 0) - before * pull_back(F, 0)
            for e in range(elements):
                place = (HISTORY + 6 * e) * particles
                decay = prony[prony_at + PRONY * e + PRONY_DECAY]
                gain = prony[prony_at + PRONY * e + PRONY_GAIN]
                H = load_symmetric(state, at + place, particles)
                store_symmetric(state, out + place, particles, decay * H + gain * change)
    else:
        J = F[0, 0] * (1 + step_gradient.trace())
        F[0, 0] = J
        store_matrix(state, out + DEFORMATION * particles, particles, F)
        for c in range(6 * elements):
            state[out + (HISTORY + c) * particles] = 0
        if J <= 0:
            flags[FLAG_COLLAPSED] = 1


@ti.func
def deform_adjoint(
    stiffens: ti.template(),
    atomic: ti.template(),
    state: ti.template(),
    at,
    out,
    bar: ti.template(),
    here,
    coefficients: ti.template(),
    coefficients_bar: ti.template(),
    mat,
    particles,
    prony: ti.template(),
    prony_at,
    prony_bar: ti.template(),
    prony_row,
    want_prony,
    elements,
    kind,
    step_gradient,
):
    """Adjoint of ``forward.deform``: replaces F and H in the adjoint state, returns the gradient by dt L."""
    F = load_matrix(state, at + DEFORMATION * particles, particles)
    F_bar = load_matrix(bar, here + DEFORMATION * particles, particles)
    step_bar = F * 0
    if kind < 0:
        old_bar = F * 0
        if elements > 0:
            F_new = load_matrix(state, out + DEFORMATION * particles, particles)
            before = stiffness(stiffens, F, 0, coefficients, mat, particles)
            after = stiffness(stiffens, F_new, 0, coefficients, mat, particles)
            S_bar = F * 0
            for e in range(elements):
                H_bar = load_symmetric_adjoint(bar, here + (HISTORY + 6 * e) * particles, particles)
                S_bar += prony[prony_at + PRONY * e + PRONY_GAIN] * H_bar
            if want_prony == 1:
                change = after * pull_back(F_new, 0) - before * pull_back(F, 0)
                for e in range(elements):
                    H_bar = load_symmetric_adjoint(bar, here + (HISTORY + 6 * e) * particles, particles)
                    H = load_symmetric(state, at + (HISTORY + 6 * e) * particles, particles)
                    add(atomic, prony_bar, prony_row + PRONY * e + PRONY_DECAY, contract(H_bar, H))
                    add(atomic, prony_bar, prony_row + PRONY * e + PRONY_GAIN, contract(H_bar, change))
            for e in range(elements):
                decay = prony[prony_at + PRONY * e + PRONY_DECAY]
                for c in range(6):
                    place = here + (HISTORY + 6 * e + c) * particles
                    bar[place] = decay * bar[place]
            F_bar += pull_back_adjoint(F_new, 0, after * S_bar)
            old_bar = pull_back_adjoint(F, 0, -before * S_bar)
            if ti.static(stiffens):
                by_after, by_before = contract(S_bar, pull_back(F_new, 0)), -contract(S_bar, pull_back(F, 0))
                F_bar += stiffness_adjoint(F_new, 0, coefficients, coefficients_bar, mat, particles, by_after)
                old_bar += stiffness_adjoint(F, 0, coefficients, coefficients_bar, mat, particles, by_before)
        step_bar = F_bar @ F.transpose()
        F_bar = F_bar + step_gradient.transpose() @ F_bar + old_bar
    else:
        J_bar = F_bar[0, 0]
        step_bar = plus_identity(step_bar, J_bar * F[0, 0])
        F_bar[0, 0] = J_bar * (1 + step_gradient.trace())
        for c in range(6 * elements):
            bar[here + (HISTORY + c) * particles] = 0
    store_matrix(bar, here + DEFORMATION * particles, particles, F_bar)
    return step_bar
