"""Stress laws of the points and their adjoints, in sixteen lanes: the laws of ``stress``, as formulas without branches.

A tensor is a tuple of its nine components, row by row; a symmetric one of six: xx, yy, zz, xy, yz, xz. Of the adjoint
of a symmetric tensor, an off-diagonal component counts once.
"""

from torchsoro.simulation.kernels.lanes import larger, law, rough_cube_root, select, split

# Least volume ratio that the solid's share of a partly void point feels: a grey point under pressure may be crushed.
CRUSHED = 0.20000000298023224  # 0.2 as float32, which Taichi takes


@law
def logarithm(x):
    """Of a positive number: x = m 2^e, ln m = 2 artanh z with z = (m - 1) / (m + 1), |z| < 0.172."""
    m, e = split(x)
    z = (m - 1) / (m + 1)
    q = z * z
    s = 1 / 15 + q * (1 / 17 + q * (1 / 19 + q * (1 / 21)))
    s = q * (1 / 3 + q * (1 / 5 + q * (1 / 7 + q * (1 / 9 + q * (1 / 11 + q * (1 / 13 + q * s))))))
    return 2 * z * (1 + s) + e * 0.6931471805599453


@law
def inverse_cube_root(x):
    """x^(-1/3) of a positive number, by Newton's method."""
    r = rough_cube_root(x)
    third = x * (1 / 3)
    r = r * (4 / 3 - third * r * r * r)
    r = r * (4 / 3 - third * r * r * r)
    r = r * (4 / 3 - third * r * r * r)
    return r * (4 / 3 - third * r * r * r)


@law
def cofactor(F):
    """Det F F^-T."""
    return (
        F[4] * F[8] - F[5] * F[7],
        F[5] * F[6] - F[3] * F[8],
        F[3] * F[7] - F[4] * F[6],
        F[2] * F[7] - F[1] * F[8],
        F[0] * F[8] - F[2] * F[6],
        F[1] * F[6] - F[0] * F[7],
        F[1] * F[5] - F[2] * F[4],
        F[2] * F[3] - F[0] * F[5],
        F[0] * F[4] - F[1] * F[3],
    )


@law
def cross(F, H):
    """Derivative of the cofactor of F along H."""
    return (
        F[4] * H[8] + H[4] * F[8] - F[5] * H[7] - H[5] * F[7],
        F[5] * H[6] + H[5] * F[6] - F[3] * H[8] - H[3] * F[8],
        F[3] * H[7] + H[3] * F[7] - F[4] * H[6] - H[4] * F[6],
        F[2] * H[7] + H[2] * F[7] - F[1] * H[8] - H[1] * F[8],
        F[0] * H[8] + H[0] * F[8] - F[2] * H[6] - H[2] * F[6],
        F[1] * H[6] + H[1] * F[6] - F[0] * H[7] - H[0] * F[7],
        F[1] * H[5] + H[1] * F[5] - F[2] * H[4] - H[2] * F[4],
        F[2] * H[3] + H[2] * F[3] - F[0] * H[5] - H[0] * F[5],
        F[0] * H[4] + H[0] * F[4] - F[1] * H[3] - H[1] * F[3],
    )


@law
def contract(A, B):
    """A : B."""
    return (
        A[0] * B[0] + A[1] * B[1] + A[2] * B[2] + A[3] * B[3] + A[4] * B[4] + A[5] * B[5]
        + A[6] * B[6] + A[7] * B[7] + A[8] * B[8]
    )  # fmt: skip


@law
def plus(a, A, b, B):
    """A A + b B."""
    return (
        a * A[0] + b * B[0], a * A[1] + b * B[1], a * A[2] + b * B[2],
        a * A[3] + b * B[3], a * A[4] + b * B[4], a * A[5] + b * B[5],
        a * A[6] + b * B[6], a * A[7] + b * B[7], a * A[8] + b * B[8],
    )  # fmt: skip


@law
def times(F, Q):
    """F Q of a symmetric Q."""
    return (
        F[0] * Q[0] + F[1] * Q[3] + F[2] * Q[5], F[0] * Q[3] + F[1] * Q[1] + F[2] * Q[4],
        F[0] * Q[5] + F[1] * Q[4] + F[2] * Q[2],
        F[3] * Q[0] + F[4] * Q[3] + F[5] * Q[5], F[3] * Q[3] + F[4] * Q[1] + F[5] * Q[4],
        F[3] * Q[5] + F[4] * Q[4] + F[5] * Q[2],
        F[6] * Q[0] + F[7] * Q[3] + F[8] * Q[5], F[6] * Q[3] + F[7] * Q[1] + F[8] * Q[4],
        F[6] * Q[5] + F[7] * Q[4] + F[8] * Q[2],
    )  # fmt: skip


@law
def right_cauchy_green(F):
    """C = F^T F."""
    return (
        F[0] * F[0] + F[3] * F[3] + F[6] * F[6],
        F[1] * F[1] + F[4] * F[4] + F[7] * F[7],
        F[2] * F[2] + F[5] * F[5] + F[8] * F[8],
        F[0] * F[1] + F[3] * F[4] + F[6] * F[7],
        F[1] * F[2] + F[4] * F[5] + F[7] * F[8],
        F[0] * F[2] + F[3] * F[5] + F[6] * F[8],
    )


@law
def symmetric_cofactor(C):
    """Det C C^-1."""
    return (
        C[1] * C[2] - C[4] * C[4],
        C[0] * C[2] - C[5] * C[5],
        C[0] * C[1] - C[3] * C[3],
        C[4] * C[5] - C[3] * C[2],
        C[3] * C[5] - C[0] * C[4],
        C[3] * C[4] - C[1] * C[5],
    )


@law
def least_ratio(void_fraction):
    """Volume ratio below which partly void matter counts as no further crushed; 0 for solid matter."""
    return select(void_fraction > 0, 0 * void_fraction + CRUSHED, 0 * void_fraction)


@law
def fade(ratio, least):
    """Smooth step from 0 where a solid is turned inside out to 1 at the least volume ratio, and its slope."""
    below = ratio < least  # never of solid matter, whose least is 0, unless it is turned inside out
    back = select(least > 0, 0 * least + 1 / CRUSHED, 0 * least + 1e30)
    t = larger(ratio, 0.0) * back
    return select(below, t * t * (3 - 2 * t), 0 * t + 1), select(below, 6 * t * (1 - t) * back, 0 * t)


@law
def excess(F, J):
    """X = I1b - 3, at least 0, and J^(-2/3)."""
    root = inverse_cube_root(J)
    return larger(root * root * contract(F, F) - 3, 0.0), root * root


@law
def pull_back(F, least):
    """Pull-back S of the deviatoric neo-Hookean stress over mu: (I - tr(C)/3 C^-1) / J, faded below ``least``."""
    C = right_cauchy_green(F)
    G = symmetric_cofactor(C)
    ratio = F[0] * (F[4] * F[8] - F[5] * F[7]) + F[1] * (F[5] * F[6] - F[3] * F[8]) + F[2] * (F[3] * F[7] - F[4] * F[6])
    back = 1 / larger(ratio, least)
    share, _ = fade(ratio, least)
    one = share * back
    scale = -(C[0] + C[1] + C[2]) * (1 / 3) * one * back * back
    return (
        scale * G[0] + one, scale * G[1] + one, scale * G[2] + one,
        scale * G[3], scale * G[4], scale * G[5],
    )  # fmt: skip


@law
def pull_back_adjoint(F, cof, ratio, least, B):
    """Gradient by F of :func:`pull_back` for the gradient B by S."""
    J = larger(ratio, least)
    share, slope = fade(ratio, least)
    C = right_cauchy_green(F)
    G = symmetric_cofactor(C)
    trace = C[0] + C[1] + C[2]
    back = 1 / J
    scale = (1 / 3) * back * back * back
    along = scale * (B[0] * G[0] + B[1] * G[1] + B[2] * G[2] + B[3] * G[3] + B[4] * G[4] + B[5] * G[5])
    # d cof(C) : B with each off-diagonal component counted once; its gradient as the full symmetric tensor.
    t = -trace * scale
    h3, h4, h5 = 0.5 * B[3], 0.5 * B[4], 0.5 * B[5]
    D = (
        t * (C[1] * B[2] + B[1] * C[2] - C[4] * B[4]) - along,
        t * (C[0] * B[2] + B[0] * C[2] - C[5] * B[5]) - along,
        t * (C[0] * B[1] + B[0] * C[1] - C[3] * B[3]) - along,
        t * (C[4] * h5 + h4 * C[5] - C[3] * B[2] - h3 * C[2]),
        t * (C[3] * h5 + h3 * C[5] - C[0] * h4 - B[0] * C[4]),
        t * (C[3] * h4 + h3 * C[4] - C[1] * h5 - B[1] * C[5]),
    )
    spread = B[0] + B[1] + B[2]
    J_bar = select(
        ratio < least,
        slope * (spread * back - trace * along),
        share * (3 * trace * along * back - spread * back * back),
    )
    return plus(2 * share, times(F, D), J_bar, cof)


@law
def void_slope(J, back):
    """l'(J) of the law of void, l = ln J above J = 1 and its second-order expansion below, and l''; back is 1 / J."""
    return select(J > 1, back, 2 - J), select(J > 1, -back * back, 0 * J - 1)


@law
def piola(F, Q, bulk, shear, factor, void_fraction):
    """First Piola stress of a solid of which a share is void, and the volume ratio.

    Args:
        F: Deformation gradient.
        Q: Sum of g H over the Maxwell elements.
        bulk: Bulk modulus.
        shear: Shear modulus.
        factor: By which the solid stiffens with stretch.
        void_fraction: 0 to 1.
    """
    cof = cofactor(F)
    ratio = F[0] * cof[0] + F[1] * cof[1] + F[2] * cof[2]
    J = larger(ratio, least_ratio(void_fraction))
    back = 1 / J
    log = logarithm(J)
    root = inverse_cube_root(J)
    A = times(F, (J * Q[0] + factor, J * Q[1] + factor, J * Q[2] + factor, J * Q[3], J * Q[4], J * Q[5]))
    solid = 1 - void_fraction
    m = solid * shear * root * root
    beta = (solid * bulk * 0.5 * (J * (J - 1) + log) - m * contract(F, A) * (1 / 3)) * back
    void = void_fraction * shear
    slope, _ = void_slope(ratio, back)
    beta = beta - void * slope
    P = plus(m, A, beta, cof)
    return plus(1.0, P, void, F), cof, ratio


@law
def piola_adjoint(F, cof, ratio, Q, bulk, shear, factor, void_fraction, P_bar):
    """Adjoint of :func:`piola`: gradients by F, Q, both moduli, factor and void fraction."""
    least = least_ratio(void_fraction)
    J = larger(ratio, least)
    back = 1 / J
    log = logarithm(J)
    root = inverse_cube_root(J)
    shrink = root * root
    FQ = times(F, Q)
    FA = plus(factor, F, J, FQ)
    spread = contract(F, FA) * (1 / 3)
    volumetric = 0.5 * (J * (J - 1) + log)
    alpha = shear * shrink
    beta = (bulk * volumetric - alpha * spread) * back
    along = contract(P_bar, cof)
    stretch = contract(P_bar, F)
    pressure_bar = along * back
    alpha_bar = contract(P_bar, FA) - pressure_bar * spread
    third = alpha * pressure_bar * (1 / 3)
    B = plus(alpha, P_bar, -third, F)
    J_bar = pressure_bar * (bulk * (J - 0.5 + 0.5 * back) - beta) - (2 / 3) * alpha * alpha_bar * back
    J_bar = select(ratio < least, 0 * J, J_bar + contract(B, FQ))
    solid = 1 - void_fraction
    slope, curvature = void_slope(ratio, back)
    void = void_fraction * shear
    BQ = times(B, Q)
    turned = cross(F, P_bar)
    F_bar = plus(factor * solid, B, J * solid, BQ)
    F_bar = plus(1.0, F_bar, -third * solid, FA)
    F_bar = plus(1.0, F_bar, solid * beta - void * slope, turned)
    F_bar = plus(1.0, F_bar, solid * J_bar - void * curvature * along, cof)
    F_bar = plus(1.0, F_bar, void, P_bar)
    scale = J * solid
    Q_bar = (
        scale * (F[0] * B[0] + F[3] * B[3] + F[6] * B[6]),
        scale * (F[1] * B[1] + F[4] * B[4] + F[7] * B[7]),
        scale * (F[2] * B[2] + F[5] * B[5] + F[8] * B[8]),
        scale * (F[0] * B[1] + F[1] * B[0] + F[3] * B[4] + F[4] * B[3] + F[6] * B[7] + F[7] * B[6]),
        scale * (F[1] * B[2] + F[2] * B[1] + F[4] * B[5] + F[5] * B[4] + F[7] * B[8] + F[8] * B[7]),
        scale * (F[0] * B[2] + F[2] * B[0] + F[3] * B[5] + F[5] * B[3] + F[6] * B[8] + F[8] * B[6]),
    )
    by_bulk, by_shear = pressure_bar * volumetric, alpha_bar * shrink
    void_work = stretch - slope * along
    void_bar = select(void_fraction < 1, shear * void_work - (bulk * by_bulk + shear * by_shear), 0 * void_work)
    return (
        F_bar,
        Q_bar,
        solid * by_bulk,
        solid * by_shear + void_fraction * void_work,
        solid * contract(B, F),
        void_bar,
    )


@law
def matrix(F, G):
    """F G."""
    return (
        F[0] * G[0] + F[1] * G[3] + F[2] * G[6], F[0] * G[1] + F[1] * G[4] + F[2] * G[7],
        F[0] * G[2] + F[1] * G[5] + F[2] * G[8],
        F[3] * G[0] + F[4] * G[3] + F[5] * G[6], F[3] * G[1] + F[4] * G[4] + F[5] * G[7],
        F[3] * G[2] + F[4] * G[5] + F[5] * G[8],
        F[6] * G[0] + F[7] * G[3] + F[8] * G[6], F[6] * G[1] + F[7] * G[4] + F[8] * G[7],
        F[6] * G[2] + F[7] * G[5] + F[8] * G[8],
    )  # fmt: skip


@law
def transposed(F):
    """F^T."""
    return F[0], F[3], F[6], F[1], F[4], F[7], F[2], F[5], F[8]


@law
def viscous_stress(J, L, viscosity, volume_viscosity):
    """J [mu_v (L + L^T) + (zeta - 2/3 mu_v) tr L I]."""
    spread = J * (volume_viscosity - viscosity * (2 / 3)) * (L[0] + L[4] + L[8])
    m = J * viscosity
    xy, yz, xz = m * (L[1] + L[3]), m * (L[5] + L[7]), m * (L[2] + L[6])
    return 2 * m * L[0] + spread, xy, xz, xy, 2 * m * L[4] + spread, yz, xz, yz, 2 * m * L[8] + spread


@law
def viscous_piola(F, rate, viscosity, volume_viscosity):
    """Viscous stress as first Piola stress, from F and its rate: L = F' F^-1."""
    cof = cofactor(F)
    J = F[0] * cof[0] + F[1] * cof[1] + F[2] * cof[2]
    one = 1 / J
    back = plus(one, cof, 0.0, cof)
    return matrix(viscous_stress(J, matrix(rate, transposed(back)), viscosity, volume_viscosity), back)


@law
def viscous_piola_adjoint(F, rate, viscosity, volume_viscosity, P_bar):
    """Adjoint of :func:`viscous_piola`: gradients by F, its rate, viscosity and volume viscosity."""
    cof = cofactor(F)
    J = F[0] * cof[0] + F[1] * cof[1] + F[2] * cof[2]
    one = 1 / J
    back = plus(one, cof, 0.0, cof)
    L = matrix(rate, transposed(back))
    P = matrix(viscous_stress(J, L, viscosity, volume_viscosity), back)
    tau_bar = matrix(P_bar, transposed(back))
    trace = L[0] + L[4] + L[8]
    trace_bar = tau_bar[0] + tau_bar[4] + tau_bar[8]
    both = plus(1.0, tau_bar, 1.0, transposed(tau_bar))
    sheared = contract(both, L)
    bulk_viscosity = volume_viscosity - viscosity * (2 / 3)
    by_volume = trace_bar * trace
    L_bar = plus(J * viscosity, both, 0.0, both)
    spread = J * bulk_viscosity * trace_bar
    L_bar = (L_bar[0] + spread, *L_bar[1:4], L_bar[4] + spread, *L_bar[5:8], L_bar[8] + spread)
    J_bar = viscosity * sheared + bulk_viscosity * by_volume
    rate_bar = matrix(L_bar, back)
    F_bar = plus(J_bar, cof, -1.0, matrix(matrix(back, transposed(P_bar)), P))
    F_bar = plus(1.0, F_bar, -1.0, matrix(transposed(L), rate_bar))
    return F_bar, rate_bar, J * (sheared - by_volume * (2 / 3)), J * by_volume
