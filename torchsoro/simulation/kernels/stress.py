"""Stress laws of the particles and their adjoints: Yeoh's solid with Maxwell elements, void, gas, viscosity.

Solids give their first Piola stress P by the deformation gradient F; the Kirchhoff stress is ``tau = P F^T = J sigma``.
Equation numbers are those of Kobayashi et al., "Computational synthesis of locomotive soft robots by topology
optimization". Their solid is neo-Hookean; here its modulus may grow with the stretch, as in Yeoh's law (1993) with the
isochoric invariant I1b = tr(Cb), Cb = J^(-2/3) F^T F:

    W = mu/2 (I1b - 3) + C20 (I1b - 3)^2 + C30 (I1b - 3)^3, so that mu becomes mu (1 + a (I1b - 3) + b (I1b - 3)^2)

in the deviatoric stress, with a = 4 C20 / mu and b = 6 C30 / mu. The Maxwell elements follow this whole deviatoric
stress, stiffening included, as in Simo's finite linear viscoelasticity (1987).
"""

import taichi as ti

from torchsoro.simulation.kernels.tensor import cofactor, contract, cross, plus_identity

# Least volume ratio that the solid's share of a partly void point feels: a grey point under pressure may be crushed.
CRUSHED = 0.2


@ti.func
def least_ratio(void_fraction):
    """Volume ratio below which partly void matter counts as no further crushed; 0 for solid matter."""
    least = void_fraction * 0
    if void_fraction > 0:
        least = void_fraction * 0 + CRUSHED
    return least


@ti.func
def fade(ratio, least):
    """Smooth step from 0 where a solid is turned inside out to 1 at the least volume ratio, and its slope."""
    share, slope = ratio * 0 + 1, ratio * 0
    if ratio < least:
        t = ti.max(ratio, 0) / least
        share, slope = t * t * (3 - 2 * t), 6 * t * (1 - t) / least
    return share, slope


@ti.func
def excess(F, least):
    """Stretch x = I1b - 3 of a solid.

    J counts as at least ``least``, here and in the other laws of the solid, and x as at least 0: only a crushed point
    has less.
    """
    J = ti.max(F.determinant(), least)
    return ti.max(ti.exp(-2 * ti.log(J) / 3) * contract(F, F) - 3, 0)


@ti.func
def excess_adjoint(F, least, x_bar):
    """Adjoint of :func:`excess`: the gradient by F."""
    cof = cofactor(F)
    ratio = contract(cof, F) / 3
    J = ti.max(ratio, least)
    shrink = ti.exp(-2 * ti.log(J) / 3)
    x = ti.max(shrink * contract(F, F) - 3, 0)
    used = x_bar
    if x == 0:  # cut off
        used = 0 * J
    J_bar = -2 * (x + 3) * used / (3 * J)
    if ratio < least:
        J_bar = 0 * J
    return (2 * shrink * used) * F + J_bar * cof


@ti.func
def stiffening(F, least, a, b):
    """Factor 1 + a x + b x^2 of the shear modulus at x = I1b - 3 (:func:`excess`).

    Kernels without stiffening leave this out and take 1, which the compiler then leaves out, too.
    """
    x = excess(F, least)
    return 1 + x * (a + b * x)


@ti.func
def stiffening_adjoint(F, least, a, b, factor_bar):
    """Adjoint of :func:`stiffening`: gradients by F, a and b."""
    x = excess(F, least)
    return excess_adjoint(F, least, factor_bar * (a + 2 * b * x)), factor_bar * x, factor_bar * x * x


@ti.func
def pull_back(F, least):
    """Pull-back S of the deviatoric neo-Hookean stress over mu: (I - tr(C)/3 C^-1) / J with C = F^T F (in Eq. 8).

    J counts as at least ``least``, here and in the other laws of the solid. Below that S fades out, since turned inside
    out it would push the wrong way. What the Maxwell elements follow is this times :func:`stiffening`.
    """
    ratio = F.determinant()
    J = ti.max(ratio, least)
    C = F.transpose() @ F
    share, _ = fade(ratio, least)
    return share * plus_identity(cofactor(C) * (-C.trace() / (3 * J * J * J)), 1 / J)


@ti.func
def pull_back_adjoint(F, least, S_bar):
    """Adjoint of :func:`pull_back`: the gradient by F for the symmetric gradient S_bar by S."""
    cof = cofactor(F)
    ratio = contract(cof, F) / 3
    J = ti.max(ratio, least)
    share, slope = fade(ratio, least)
    C = F.transpose() @ F
    trace, G = C.trace(), cofactor(C)
    scale = 1 / (3 * J * J * J)
    along = contract(S_bar, G) * scale
    C_bar = plus_identity(cross(C, S_bar) * (-trace * scale), -along)
    J_bar = -S_bar.trace() / (J * J) + 3 * trace * along / J
    if ratio < least:
        J_bar = slope * (S_bar.trace() / J - trace * along)
    return share * (2 * F @ C_bar) + J_bar * cof


@ti.func
def solid_piola(F, Q, bulk, shear, factor, least):
    """Eqs. 3-8 as first Piola stress, with Q = sum_i g_i H_i and a factor from :func:`stiffening`.

    The Kirchhoff stress K/2 [(J-1) + ln J / J] J I + mu dev(Fb A Fb^T) times F^-T, with A = factor I + J Q and
    Fb = J^(-1/3) F.
    """
    J = ti.max(F.determinant(), least)
    shrink = ti.exp(-2 * ti.log(J) / 3)
    FA = factor * F + J * (F @ Q)
    pressure = bulk / 2 * (J * (J - 1) + ti.log(J)) - shear * shrink * contract(F, FA) / 3
    return shear * shrink * FA + pressure / J * cofactor(F)


@ti.func
def solid_piola_adjoint(F, Q, bulk, shear, factor, least, P_bar):
    """Adjoint of :func:`solid_piola`: gradients by F, Q, bulk and shear modulus, and factor."""
    cof = cofactor(F)
    ratio = contract(cof, F) / 3
    J = ti.max(ratio, least)
    log = ti.log(J)
    shrink = ti.exp(-2 * log / 3)
    FQ = F @ Q
    FA = factor * F + J * FQ
    spread = contract(F, FA) / 3
    volumetric = (J * (J - 1) + log) / 2
    beta = (bulk * volumetric - shear * shrink * spread) / J
    beta_bar = contract(P_bar, cof)
    pressure_bar = beta_bar / J
    alpha_bar = contract(P_bar, FA) - pressure_bar * spread  # by shear * shrink
    alpha = shear * shrink
    # contract(F, FA) is quadratic in F and linear in A.
    FA_bar = alpha * P_bar - (alpha * pressure_bar / 3) * F
    J_bar = pressure_bar * (bulk * (J - 0.5 + 0.5 / J) - beta) - 2 * alpha * alpha_bar / (3 * J)
    J_bar += contract(FA_bar, FQ)
    if ratio < least:
        J_bar = 0 * J
    F_bar = factor * FA_bar + J * (FA_bar @ Q) - (alpha * pressure_bar / 3) * FA + beta * cross(F, P_bar) + J_bar * cof
    half = (J / 2) * (F.transpose() @ FA_bar)
    return F_bar, half + half.transpose(), pressure_bar * volumetric, alpha_bar * shrink, contract(FA_bar, F)


@ti.func
def void_piola(F, shear):
    """Stress of void: mu (F - l'(J) cof F) with l = ln J above J = 1 and its second-order expansion below.

    Defined and bounded for every F, also collapsed and turned inside out, and objective; J = 1 is at rest.
    """
    J = F.determinant()
    slope = 2 - J
    if J > 1:
        slope = 1 / J
    return shear * (F - slope * cofactor(F))


@ti.func
def void_piola_adjoint(F, shear, P_bar):
    """Adjoint of :func:`void_piola`: the gradient by F."""
    cof = cofactor(F)
    J = contract(cof, F) / 3
    slope = 2 - J
    curvature = J * 0 - 1
    if J > 1:
        slope = 1 / J
        curvature = -slope * slope
    along = contract(P_bar, cof)
    return shear * (P_bar - slope * cross(F, P_bar) - (curvature * along) * cof)


@ti.func
def void_work(F, P_bar):
    """P : P_bar for the stress P of void of unit shear modulus: the gradient of :func:`void_piola` by that modulus."""
    cof = cofactor(F)
    J = contract(cof, F) / 3
    slope = 2 - J
    if J > 1:
        slope = 1 / J
    return contract(P_bar, F) - slope * contract(P_bar, cof)


@ti.func
def piola(F, Q, bulk, shear, factor, void_fraction):
    """First Piola stress of a solid of which a share ``void_fraction`` (0 to 1) is void; void does not stiffen."""
    P = F * 0
    if void_fraction < 1:
        P = (1 - void_fraction) * solid_piola(F, Q, bulk, shear, factor, least_ratio(void_fraction))
    if void_fraction > 0:
        P += void_fraction * void_piola(F, shear)
    return P


@ti.func
def piola_adjoint(F, Q, bulk, shear, factor, void_fraction, P_bar):
    """Adjoint of :func:`piola`: gradients by F, Q, both moduli, factor and void_fraction.

    At a void fraction of exactly 0 the last is the derivative from above; at exactly 1 it is 0.
    """
    F_bar = F * 0
    Q_bar = F * 0
    bulk_bar = shear * 0
    shear_bar = shear * 0
    factor_bar = shear * 0
    void_bar = shear * 0
    if void_fraction < 1:
        by_F, by_Q, by_bulk, by_shear, by_factor = solid_piola_adjoint(
            F, Q, bulk, shear, factor, least_ratio(void_fraction), P_bar
        )
        F_bar, Q_bar = (1 - void_fraction) * by_F, (1 - void_fraction) * by_Q
        bulk_bar, shear_bar = (1 - void_fraction) * by_bulk, (1 - void_fraction) * by_shear
        factor_bar = (1 - void_fraction) * by_factor
        # Both laws are linear in their moduli.
        void_bar = shear * void_work(F, P_bar) - (bulk * by_bulk + shear * by_shear)
    if void_fraction > 0:
        F_bar += void_fraction * void_piola_adjoint(F, shear, P_bar)
        shear_bar += void_fraction * void_work(F, P_bar)
    return F_bar, Q_bar, bulk_bar, shear_bar, factor_bar, void_bar


@ti.func
def gas_pressure(J, stiffness, actuation):
    """Eq. 10: p = k (1 - J) + p_act, positive in compression."""
    return stiffness * (1 - J) + actuation


@ti.func
def viscous_stress(J, gradient, viscosity, volume_viscosity):
    """Viscous part of Eq. 9: J [mu_v (L + L^T) + (zeta - 2/3 mu_v) tr L I]."""
    spread = (volume_viscosity - 2 * viscosity / 3) * gradient.trace()
    return J * plus_identity(viscosity * (gradient + gradient.transpose()), spread)


@ti.func
def viscous_stress_adjoint(J, gradient, viscosity, volume_viscosity, tau_bar):
    """Adjoint of :func:`viscous_stress`: gradients by J, L, viscosity and volume viscosity."""
    trace_bar = tau_bar.trace()
    bulk_viscosity = volume_viscosity - 2 * viscosity / 3
    both = tau_bar + tau_bar.transpose()
    gradient_bar = J * plus_identity(viscosity * both, bulk_viscosity * trace_bar)
    volume_bar = trace_bar * gradient.trace()
    viscosity_bar = contract(both, gradient) - 2 * volume_bar / 3
    J_bar = viscosity * contract(both, gradient) + bulk_viscosity * volume_bar
    return J_bar, gradient_bar, J * viscosity_bar, J * volume_bar


@ti.func
def viscous_piola(F, rate, viscosity, volume_viscosity):
    """:func:`viscous_stress` as first Piola stress, from F and its rate: L = F' F^-1."""
    J = F.determinant()
    back = cofactor(F) / J
    return viscous_stress(J, rate @ back.transpose(), viscosity, volume_viscosity) @ back


@ti.func
def viscous_piola_adjoint(F, rate, viscosity, volume_viscosity, P_bar):
    """Adjoint of :func:`viscous_piola`: gradients by F, its rate, viscosity and volume viscosity."""
    J = F.determinant()
    cof = cofactor(F)
    back = cof / J  # F^-T
    L = rate @ back.transpose()
    P = viscous_stress(J, L, viscosity, volume_viscosity) @ back
    tau_bar = P_bar @ back.transpose()
    J_bar, L_bar, by_viscosity, by_volume = viscous_stress_adjoint(J, L, viscosity, volume_viscosity, tau_bar)
    rate_bar = L_bar @ back
    F_bar = J_bar * cof - back @ P_bar.transpose() @ P - L.transpose() @ rate_bar
    return F_bar, rate_bar, by_viscosity, by_volume
