"""What a cell of the lattice does in sixteen variations at once: gradients, stress, forces.

A cell's eight points share its 27 nodes, and weights are products by axis: gradients are found, and forces summed, axis
by axis. A node has 48 numbers: x of all lanes, y, z. Arrays are flat and taken apart by slices, within which the
compiler sees that nothing overlaps; what it does not see through it does not do for all lanes at once. The stress laws
are those of ``stress``, with ln J and J^(-2/3) as series.
"""

from __future__ import annotations

import numpy as np
from numba import njit

CRUSHED = 0.05  # least volume ratio that the stress laws feel

# Without counts of references to arrays: every slice would be counted, which takes longer than what is done with some.
OPTIONS = {"fastmath": True, "boundscheck": False, "error_model": "numpy", "nogil": True, "cache": True, "_nrt": False}
fast = njit(**OPTIONS)
inlined = njit(**OPTIONS, forceinline=True)  # what a lane's loop calls, which then is still done for all lanes at once
f32 = np.float32


@fast
def clear(a):
    """Fill an array with zeros."""
    for n in range(len(a)):
        a[n] = f32(0)


@inlined
def at_least(x, least):
    """The larger of two numbers, without a branch."""
    return f32(0.5) * (x + least + abs(x - least))


@inlined
def logarithm(J):
    """Of J: 2 artanh z, z = (J - 1) / (J + 1), by its series."""
    z = (J - f32(1)) / (J + f32(1))
    q = z * z
    tail = f32(1 / 7) + q * (f32(1 / 9) + q * (f32(1 / 11) + q * f32(1 / 13)))
    return f32(2) * z * (f32(1) + q * (f32(1 / 3) + q * (f32(1 / 5) + q * tail)))


@inlined
def shrinkage(log):
    """J^(-2/3) from ln J, by its series."""
    y = f32(-2 / 3) * log
    tail = f32(1 / 24) + y * (f32(1 / 120) + y * (f32(1 / 720) + y * f32(1 / 5040)))
    return f32(1) + y * (f32(1) + y * (f32(1 / 2) + y * (f32(1 / 6) + y * tail)))


@fast
def gather(d, corner, sx, sy, Wx, Wy, Wz, Sx, Sy, Sz, Z, Y, G):
    """Gradient of a nodal field at the eight points of a cell: G [8, derivative, 48]; Z and Y are for its own use."""
    w00, w01, w02, w10, w11, w12 = Wz[0, 0], Wz[0, 1], Wz[0, 2], Wz[1, 0], Wz[1, 1], Wz[1, 2]
    s00, s01, s02, s10, s11, s12 = Sz[0, 0], Sz[0, 1], Sz[0, 2], Sz[1, 0], Sz[1, 1], Sz[1, 2]
    for i in range(3):
        for j in range(3):
            at = 48 * (corner + i * sx + j * sy)
            a, o = d[at : at + 144], Z[192 * (3 * i + j) : 192 * (3 * i + j) + 192]
            for q in range(48):
                a0, a1, a2 = a[q], a[48 + q], a[96 + q]
                o[q] = w00 * a0 + w01 * a1 + w02 * a2
                o[48 + q] = w10 * a0 + w11 * a1 + w12 * a2
                o[96 + q] = s00 * a0 + s01 * a1 + s02 * a2
                o[144 + q] = s10 * a0 + s11 * a1 + s12 * a2
    w00, w01, w02, w10, w11, w12 = Wy[0, 0], Wy[0, 1], Wy[0, 2], Wy[1, 0], Wy[1, 1], Wy[1, 2]
    s00, s01, s02, s10, s11, s12 = Sy[0, 0], Sy[0, 1], Sy[0, 2], Sy[1, 0], Sy[1, 1], Sy[1, 2]
    for i in range(3):
        for z in range(2):
            a = Z[576 * i + 48 * z : 576 * i + 48 * z + 528]
            o = Y[576 * i + 144 * z : 576 * i + 144 * z + 432]
            for q in range(48):
                a0, a1, a2, b0, b1, b2 = a[q], a[192 + q], a[384 + q], a[96 + q], a[288 + q], a[480 + q]
                o[q] = w00 * a0 + w01 * a1 + w02 * a2
                o[48 + q] = s00 * a0 + s01 * a1 + s02 * a2
                o[96 + q] = w00 * b0 + w01 * b1 + w02 * b2
                o[288 + q] = w10 * a0 + w11 * a1 + w12 * a2
                o[336 + q] = s10 * a0 + s11 * a1 + s12 * a2
                o[384 + q] = w10 * b0 + w11 * b1 + w12 * b2
    w00, w01, w02, w10, w11, w12 = Wx[0, 0], Wx[0, 1], Wx[0, 2], Wx[1, 0], Wx[1, 1], Wx[1, 2]
    s00, s01, s02, s10, s11, s12 = Sx[0, 0], Sx[0, 1], Sx[0, 2], Sx[1, 0], Sx[1, 1], Sx[1, 2]
    for r in range(4):
        a, o = Y[144 * r : 144 * r + 1296], G[144 * r : 144 * r + 720]
        for q in range(48):
            a0, a1, a2 = a[q], a[576 + q], a[1152 + q]
            o[q] = s00 * a0 + s01 * a1 + s02 * a2
            o[576 + q] = s10 * a0 + s11 * a1 + s12 * a2
            a0, a1, a2 = a[48 + q], a[624 + q], a[1200 + q]
            o[48 + q] = w00 * a0 + w01 * a1 + w02 * a2
            o[624 + q] = w10 * a0 + w11 * a1 + w12 * a2
            a0, a1, a2 = a[96 + q], a[672 + q], a[1248 + q]
            o[96 + q] = w00 * a0 + w01 * a1 + w02 * a2
            o[672 + q] = w10 * a0 + w11 * a1 + w12 * a2


@fast
def scatter(f, corner, sx, sy, Wx, Wy, Wz, Sx, Sy, Sz, X, P):
    """Add what the eight points of a cell hand to its nodes; P as G of :func:`gather`."""
    u00, u01, u02, u10, u11, u12 = Wz[0, 0], Wz[0, 1], Wz[0, 2], Wz[1, 0], Wz[1, 1], Wz[1, 2]
    t00, t01, t02, t10, t11, t12 = Sz[0, 0], Sz[0, 1], Sz[0, 2], Sz[1, 0], Sz[1, 1], Sz[1, 2]
    for i in range(3):
        w0, w1, s0, s1 = Wx[0, i], Wx[1, i], Sx[0, i], Sx[1, i]
        for r in range(4):
            p, o = P[144 * r : 144 * r + 720], X[144 * r : 144 * r + 144]
            for q in range(48):
                o[q] = s0 * p[q] + s1 * p[576 + q]
                o[48 + q] = w0 * p[48 + q] + w1 * p[624 + q]
                o[96 + q] = w0 * p[96 + q] + w1 * p[672 + q]
        for j in range(3):
            w0, w1, s0, s1 = Wy[0, j], Wy[1, j], Sy[0, j], Sy[1, j]
            at = 48 * (corner + i * sx + j * sy)
            o = f[at : at + 144]
            for q in range(48):
                a0 = w0 * X[q] + w1 * X[288 + q] + s0 * X[48 + q] + s1 * X[336 + q]
                a1 = w0 * X[144 + q] + w1 * X[432 + q] + s0 * X[192 + q] + s1 * X[480 + q]
                b0 = w0 * X[96 + q] + w1 * X[384 + q]
                b1 = w0 * X[240 + q] + w1 * X[528 + q]
                o[q] += u00 * a0 + u10 * a1 + t00 * b0 + t10 * b1
                o[48 + q] += u01 * a0 + u11 * a1 + t01 * b0 + t11 * b1
                o[96 + q] += u02 * a0 + u12 * a1 + t02 * b0 + t12 * b1


@inlined
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


@inlined
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


@inlined
def _deformed(g, lane):
    """Deformation gradient of a lane, row by row, from displacement gradients [3, 48]."""
    one = f32(1)
    return (
        *(one + g[lane], g[48 + lane], g[96 + lane]),
        *(g[16 + lane], one + g[64 + lane], g[112 + lane]),
        *(g[32 + lane], g[80 + lane], one + g[128 + lane]),
    )


@fast
def solid(at, G, P, Q, own, law, stiffens, softens):
    """First Piola stress P from displacement gradients G [3, 48]; Q is [6, 16], ``law`` [4, 16] of :func:`piola`."""
    g, p = G[at : at + 144], P[at : at + 144]
    for lane in range(16):
        added = Q[lane], Q[16 + lane], Q[32 + lane], Q[48 + lane], Q[64 + lane], Q[80 + lane]
        mine = own[lane], own[16 + lane], own[32 + lane]
        laws = law[lane], law[16 + lane], law[32 + lane], law[48 + lane]
        P00, P10, P20, P01, P11, P21, P02, P12, P22, largest = piola(
            _deformed(g, lane), added, mine, laws, stiffens, softens
        )
        p[lane], p[16 + lane], p[32 + lane] = P00, P10, P20
        p[48 + lane], p[64 + lane], p[80 + lane] = P01, P11, P21
        p[96 + lane], p[112 + lane], p[128 + lane] = P02, P12, P22
        if softens:
            own[32 + lane] = largest


@fast
def remember(at, G, T, Q, Z, series, law, stiffens, elements):
    """What the Maxwell elements add, and their state of the next substep, as in ``total``.

    S is the pull-back of the deviatoric stress over mu. Q = sum g (Z + b S), Z becomes a Z - b (1 - a) S; ``series``
    has g, g b, a and b (1 - a) of each element [E * 64].
    """
    g = G[at : at + 144]
    for lane in range(16):
        T00, T11, T22, T01, T12, T02 = pull_back(_deformed(g, lane), (law[lane], law[16 + lane]), stiffens)
        T[lane], T[16 + lane], T[32 + lane] = T00, T11, T22
        T[48 + lane], T[64 + lane], T[80 + lane] = T01, T12, T02
    clear(Q)
    for e in range(elements):
        z, maxwell = Z[96 * e : 96 * e + 96], series[64 * e : 64 * e + 64]
        for lane in range(16):
            now, later = maxwell[lane], maxwell[16 + lane]
            fades, grows = maxwell[32 + lane], maxwell[48 + lane]
            for c in range(6):
                old, new = z[16 * c + lane], T[16 * c + lane]
                Q[16 * c + lane] += now * old + later * new
                z[16 * c + lane] = fades * old - grows * new
