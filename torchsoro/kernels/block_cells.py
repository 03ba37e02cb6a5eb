"""What the threads of a block do for a variation of a body on a GPU: stress at points, forces of cells, walls, planes.

As :mod:`lane_cells`, whose laws these are, and :mod:`lanes`, for one variation.
"""

from __future__ import annotations

import math
from typing import Any

import numba.cuda

from torchsoro.kernels import lane_cells
from torchsoro.kernels.lane_cells import CRUSHED, f32

cuda: Any = numba.cuda  # its types are those of the host
_device = cuda.jit(device=True, fastmath=True)
_at_least, _logarithm, _shrinkage = (
    _device(f.py_func) for f in (lane_cells.at_least, lane_cells.logarithm, lane_cells.shrinkage)
)


@_device
def gradient(mesh, d, cell, k):
    """Deformation gradient at point k of a cell, F[a][b] = d x_a / d X_b, row by row."""
    weights, slopes, cells, corners, stride_x, stride_y = mesh
    corner = corners[cell]
    cx, cy, cz = cells[cell, 0], cells[cell, 1], cells[cell, 2]
    x, y, z = k >> 2, (k >> 1) & 1, k & 1
    w0, w1, w2 = weights[2, cz, z, 0], weights[2, cz, z, 1], weights[2, cz, z, 2]
    s0, s1, s2 = slopes[2, cz, z, 0], slopes[2, cz, z, 1], slopes[2, cz, z, 2]
    g00, g10, g20 = f32(1), f32(0), f32(0)
    g01, g11, g21 = f32(0), f32(1), f32(0)
    g02, g12, g22 = f32(0), f32(0), f32(1)
    for i in range(3):
        wx, sx = weights[0, cx, x, i], slopes[0, cx, x, i]
        for j in range(3):
            at = corner + i * stride_x + j * stride_y
            wy, sy = weights[1, cy, y, j], slopes[1, cy, y, j]
            along, across, up = sx * wy, wx * sy, wx * wy
            a0 = w0 * d[0, at] + w1 * d[0, at + 1] + w2 * d[0, at + 2]
            a1 = w0 * d[1, at] + w1 * d[1, at + 1] + w2 * d[1, at + 2]
            a2 = w0 * d[2, at] + w1 * d[2, at + 1] + w2 * d[2, at + 2]
            g00 += along * a0
            g10 += along * a1
            g20 += along * a2
            g01 += across * a0
            g11 += across * a1
            g21 += across * a2
            g02 += up * (s0 * d[0, at] + s1 * d[0, at + 1] + s2 * d[0, at + 2])
            g12 += up * (s0 * d[1, at] + s1 * d[1, at + 1] + s2 * d[1, at + 2])
            g22 += up * (s0 * d[2, at] + s1 * d[2, at + 1] + s2 * d[2, at + 2])
    return g00, g01, g02, g10, g11, g12, g20, g21, g22


@_device
def pulled(F, law, stiffens):
    """Pull-back of the deviatoric stress over mu: xx, yy, zz, xy, yz, xz; see :func:`lane_cells.remember`."""
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
    J = _at_least(J, f32(CRUSHED))
    trace, factor = C00 + C11 + C22, f32(1)
    if stiffens:
        x = _at_least(_shrinkage(_logarithm(J)) * trace - f32(3), f32(0))
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


@_device
def stress(F, Q, own, p, law, stiffens, softens, P):
    """First Piola stress times volume into P [9, P], derivative by derivative; see :func:`lane_cells.solid`."""
    F00, F01, F02, F10, F11, F12, F20, F21, F22 = F
    Q00, Q11, Q22, Q01, Q12, Q02 = Q
    one = f32(1)
    c00, c01, c02 = F11 * F22 - F12 * F21, F12 * F20 - F10 * F22, F10 * F21 - F11 * F20
    c10, c11, c12 = F02 * F21 - F01 * F22, F00 * F22 - F02 * F20, F01 * F20 - F00 * F21
    c20, c21, c22 = F01 * F12 - F02 * F11, F02 * F10 - F00 * F12, F00 * F11 - F01 * F10
    J = _at_least(F00 * c00 + F01 * c01 + F02 * c02, f32(CRUSHED))
    log = _logarithm(J)
    shrink = _shrinkage(log)
    square = F00 * F00 + F01 * F01 + F02 * F02 + F10 * F10 + F11 * F11 + F12 * F12 + F20 * F20 + F21 * F21 + F22 * F22
    factor, whole = one, one
    x = _at_least(shrink * square - f32(3), f32(0))
    if stiffens:
        factor += x * (law[0] + law[1] * x)
    if softens:
        below = _at_least(own[2, p] - x, f32(0))
        own[2, p] = x + below
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
    m = own[0, p] * shrink * whole
    beta = (own[1, p] * f32(0.5) * (J * (J - one) + log) - m * along * f32(1 / 3)) / J
    P[0, p], P[1, p], P[2, p] = m * A00 + beta * c00, m * A10 + beta * c10, m * A20 + beta * c20
    P[3, p], P[4, p], P[5, p] = m * A01 + beta * c01, m * A11 + beta * c11, m * A21 + beta * c21
    P[6, p], P[7, p], P[8, p] = m * A02 + beta * c02, m * A12 + beta * c12, m * A22 + beta * c22


@_device
def hand_out(mesh, spread, slots, P, shares, thread):
    """What each cell hands to each of its nodes; ``shares`` [3, slots], a node's lie ``nodes`` apart.

    ``spread`` is the cell of each entry, and its node's number along x, y and z: 64 c + 16 i + 4 j + k.
    """
    weights, slopes, cells = mesh[0], mesh[1], mesh[2]
    for e in range(thread, spread.shape[0], cuda.blockDim.x):
        at = spread[e]
        cell, i, j, k = at >> 6, (at >> 4) & 3, (at >> 2) & 3, at & 3
        cx, cy, cz = cells[cell, 0], cells[cell, 1], cells[cell, 2]
        w0, w1, s0, s1 = weights[2, cz, 0, k], weights[2, cz, 1, k], slopes[2, cz, 0, k], slopes[2, cz, 1, k]
        f0, f1, f2 = f32(0), f32(0), f32(0)
        for x in range(2):
            wx, sx = weights[0, cx, x, i], slopes[0, cx, x, i]
            for y in range(2):
                wy, sy, p = weights[1, cy, y, j], slopes[1, cy, y, j], (cell << 3) + (x << 2) + (y << 1)
                along, across, up = sx * wy, wx * sy, wx * wy
                f0 += along * (w0 * P[0, p] + w1 * P[0, p + 1]) + across * (w0 * P[3, p] + w1 * P[3, p + 1])
                f1 += along * (w0 * P[1, p] + w1 * P[1, p + 1]) + across * (w0 * P[4, p] + w1 * P[4, p + 1])
                f2 += along * (w0 * P[2, p] + w1 * P[2, p + 1]) + across * (w0 * P[5, p] + w1 * P[5, p + 1])
                f0 += up * (s0 * P[6, p] + s1 * P[6, p + 1])
                f1 += up * (s0 * P[7, p] + s1 * P[7, p + 1])
                f2 += up * (s0 * P[8, p] + s1 * P[8, p + 1])
        slot = slots[e]
        shares[0, slot], shares[1, slot], shares[2, slot] = f0, f1, f2


@_device
def wall_area(wall, d, w, normals):
    """Area vector of a point of a chamber's wall, p dA = p t1 x t2, and its share of the volume."""
    begin, node, value, place, axes, area, _ = wall
    axis = axes[w]
    x0, x1, x2 = place[w, 0], place[w, 1], place[w, 2]
    a0, a1, a2 = f32((axis + 1) % 3 == 0), f32((axis + 1) % 3 == 1), f32((axis + 1) % 3 == 2)
    b0, b1, b2 = f32((axis + 2) % 3 == 0), f32((axis + 2) % 3 == 1), f32((axis + 2) % 3 == 2)
    for k in range(begin[w], begin[w + 1]):
        n, s, r, at = value[k, 0], value[k, 1], value[k, 2], node[k]
        u0, u1, u2 = d[0, at], d[1, at], d[2, at]
        x0 += n * u0
        x1 += n * u1
        x2 += n * u2
        a0 += s * u0
        a1 += s * u1
        a2 += s * u2
        b0 += r * u0
        b1 += r * u1
        b2 += r * u2
    n0, n1, n2 = area[w] * (a1 * b2 - a2 * b1), area[w] * (a2 * b0 - a0 * b2), area[w] * (a0 * b1 - a1 * b0)
    normals[0, w], normals[1, w], normals[2, w] = n0, n1, n2
    normals[3, w] = (x0 * n0 + x1 * n1 + x2 * n2) / f32(3)


@_device
def met(u0, u1, u2, gap, normal, stick, push, hold, friction):
    """Velocity of a node that meets a plane; see :func:`lanes._meet`."""
    n0, n1, n2 = normal[0], normal[1], normal[2]
    along = u0 * n0 + u1 * n1 + u2 * n2
    pressed = max(-gap, f32(0)) * push
    held = max(min(along + pressed, hold), f32(0))
    t0, t1, t2 = u0 - along * n0, u1 - along * n1, u2 - along * n2
    rest = f32(0)
    if not stick:
        speed = math.sqrt(t0 * t0 + t1 * t1 + t2 * t2)
        lost = friction * (pressed + hold)
        if speed > lost:
            rest = f32(1) - lost / speed
    elif pressed + held <= f32(0):
        rest = f32(1)
    along += pressed - held
    return t0 * rest + along * n0, t1 * rest + along * n1, t2 * rest + along * n2


@_device
def look(mark, d, v, out, thread):
    """Markers: place, velocity, derivatives of the displacement by x, y, z; out [M, 5, 3]."""
    begin, node, value = mark
    for m in range(thread, 15 * out.shape[0], cuda.blockDim.x):
        kind, c = (m // 3) % 5, m % 3
        total = f32(0)
        for k in range(begin[m // 15], begin[m // 15 + 1]):
            moved = v[c, node[k]] if kind == 1 else d[c, node[k]]
            total += value[k, max(kind - 1, 0)] * moved
        out[m // 15, kind, c] = total
