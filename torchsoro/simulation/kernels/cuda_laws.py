"""Stress at a point of a variation of a body on a GPU: ln J and J^(-2/3) as series, which suffice near J = 1."""

from __future__ import annotations

from typing import Any

import numba.cuda
import numpy as np

CRUSHED = 0.05  # least volume ratio that the stress laws feel
f32 = np.float32
cuda: Any = numba.cuda  # its types are those of the host
device = cuda.jit(device=True, fastmath=True)


@device
def at_least(x, least):
    """The larger of two numbers, without a branch."""
    return f32(0.5) * (x + least + abs(x - least))


@device
def logarithm(J):
    """Of J: 2 artanh z, z = (J - 1) / (J + 1), by its series."""
    z = (J - f32(1)) / (J + f32(1))
    q = z * z
    tail = f32(1 / 7) + q * (f32(1 / 9) + q * (f32(1 / 11) + q * f32(1 / 13)))
    return f32(2) * z * (f32(1) + q * (f32(1 / 3) + q * (f32(1 / 5) + q * tail)))


@device
def shrinkage(log):
    """J^(-2/3) from ln J, by its series."""
    y = f32(-2 / 3) * log
    tail = f32(1 / 24) + y * (f32(1 / 120) + y * (f32(1 / 720) + y * f32(1 / 5040)))
    return f32(1) + y * (f32(1) + y * (f32(1 / 2) + y * (f32(1 / 6) + y * tail)))


@device
def pull_back(F, law, stiffens):
    """Pull-back of the deviatoric stress over mu at a point: xx, yy, zz, xy, yz, xz; ``law`` as of :func:`piola`."""
    F00, F01, F02, F10, F11, F12, F20, F21, F22 = F
    C00, C11, C22 = (
        F00 * F00 + F10 * F10 + F20 * F20,
        F01 * F01 + F11 * F11 + F21 * F21,
        F02 * F02 + F12 * F12 + F22 * F22,
    )
    C01, C12, C02 = (
        F00 * F01 + F10 * F11 + F20 * F21,
        F01 * F02 + F11 * F12 + F21 * F22,
        F00 * F02 + F10 * F12 + F20 * F22,
    )
    J = F00 * (F11 * F22 - F12 * F21) + F01 * (F12 * F20 - F10 * F22) + F02 * (F10 * F21 - F11 * F20)
    J = at_least(J, f32(CRUSHED))
    trace, factor = C00 + C11 + C22, f32(1)
    if stiffens:
        x = at_least(shrinkage(logarithm(J)) * trace - f32(3), f32(0))
        factor += x * (law[0] + law[1] * x)
    scale, iso = -factor * trace / (f32(3) * J * J * J), factor / J
    return (
        scale * (C11 * C22 - C12 * C12) + iso,
        scale * (C00 * C22 - C02 * C02) + iso,
        scale * (C00 * C11 - C01 * C01) + iso,
        scale * (C02 * C12 - C01 * C22),
        scale * (C01 * C02 - C00 * C12),
        scale * (C01 * C12 - C02 * C11),
    )


@device
def piola(F, Q, own, law, stiffens, softens):
    """First Piola stress at a point, column by column, and the largest x so far.

    Args:
        F: Deformation gradient, row by row.
        Q: What the Maxwell elements add, as of :func:`pull_back`.
        own: Shear and bulk modulus times volume, and the largest x = I1b - 3 so far.
        law: Two coefficients of stiffening, then depth d and range r of softening: below the largest x the deviatoric
            stress is 1 - d u / (1 + u) of what it was, u = (largest - x) / r.
        stiffens: Whether the former count.
        softens: Whether the latter do.
    """
    F00, F01, F02, F10, F11, F12, F20, F21, F22 = F
    Q00, Q11, Q22, Q01, Q12, Q02 = Q
    shear, bulk, largest = own
    one = f32(1)
    c00, c01, c02 = F11 * F22 - F12 * F21, F12 * F20 - F10 * F22, F10 * F21 - F11 * F20
    c10, c11, c12 = F02 * F21 - F01 * F22, F00 * F22 - F02 * F20, F01 * F20 - F00 * F21
    c20, c21, c22 = F01 * F12 - F02 * F11, F02 * F10 - F00 * F12, F00 * F11 - F01 * F10
    J = at_least(F00 * c00 + F01 * c01 + F02 * c02, f32(CRUSHED))
    log = logarithm(J)
    shrink = shrinkage(log)
    square = F00 * F00 + F01 * F01 + F02 * F02 + F10 * F10 + F11 * F11 + F12 * F12 + F20 * F20 + F21 * F21 + F22 * F22
    factor, whole = one, one
    x = at_least(shrink * square - f32(3), f32(0))
    if stiffens:
        factor += x * (law[0] + law[1] * x)
    if softens:
        below = at_least(largest - x, f32(0))
        largest = x + below
        whole -= law[2] * below / (below + law[3])
    q00, q11, q22, q01, q12, q02 = J * Q00 + factor, J * Q11 + factor, J * Q22 + factor, J * Q01, J * Q12, J * Q02
    A00, A01, A02 = (
        F00 * q00 + F01 * q01 + F02 * q02,
        F00 * q01 + F01 * q11 + F02 * q12,
        F00 * q02 + F01 * q12 + F02 * q22,
    )
    A10, A11, A12 = (
        F10 * q00 + F11 * q01 + F12 * q02,
        F10 * q01 + F11 * q11 + F12 * q12,
        F10 * q02 + F11 * q12 + F12 * q22,
    )
    A20, A21, A22 = (
        F20 * q00 + F21 * q01 + F22 * q02,
        F20 * q01 + F21 * q11 + F22 * q12,
        F20 * q02 + F21 * q12 + F22 * q22,
    )
    along = F00 * A00 + F01 * A01 + F02 * A02 + F10 * A10 + F11 * A11 + F12 * A12 + F20 * A20 + F21 * A21 + F22 * A22
    m = shear * shrink * whole
    beta = (bulk * f32(0.5) * (J * (J - one) + log) - m * along * f32(1 / 3)) / J
    return (
        m * A00 + beta * c00,
        m * A10 + beta * c10,
        m * A20 + beta * c20,
        m * A01 + beta * c01,
        m * A11 + beta * c11,
        m * A21 + beta * c21,
        m * A02 + beta * c02,
        m * A12 + beta * c12,
        m * A22 + beta * c22,
        largest,
    )
