"""What the threads of a block do for a variation of a body on a GPU: stress at points, forces of cells, walls, planes.

The substep is that of ``lane_march``, for one variation.
"""

from __future__ import annotations

import math

from torchsoro.simulation.kernels.cuda_laws import cuda, device, f32, piola


@device
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


@device
def stress(F, Q, own, p, law, stiffens, softens, P):
    """First Piola stress times volume into P [9, P], derivative by derivative."""
    P00, P10, P20, P01, P11, P21, P02, P12, P22, largest = piola(
        F, Q, (own[0, p], own[1, p], own[2, p]), law, stiffens, softens
    )
    P[0, p], P[1, p], P[2, p] = P00, P10, P20
    P[3, p], P[4, p], P[5, p] = P01, P11, P21
    P[6, p], P[7, p], P[8, p] = P02, P12, P22
    if softens:
        own[2, p] = largest


@device
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


@device
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


@device
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


@device
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
