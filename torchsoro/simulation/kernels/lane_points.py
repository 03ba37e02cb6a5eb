"""What a block of sixteen lanes does: gradients of a nodal field at the points, stress, forces on the nodes.

A block is one cell in sixteen variations, or sixteen cells whose lowest nodes follow each other in a plane of nodes.
In both cases what lane l reads of node (i, j, k) of its cell lies at ``i plane + j row + k unit`` from the block's own
place, l numbers further, so that one text serves both: ``unit`` is 16 between two nodes along z, or 1. A cell has
2 x 2 x 2 points, x slowest, and 3 x 3 x 3 nodes; sums are taken axis by axis.

Weights of an axis are 6 numbers, of nodes 0, 1, 2 at the first and at the second point, and 6 slopes: scalars along x,
lanes along y and z.
"""

from __future__ import annotations

from torchsoro.simulation.kernels.lane_laws import (
    contract,
    excess,
    least_ratio,
    piola,
    plus,
    pull_back,
    viscous_piola,
)
from torchsoro.simulation.kernels.lanes import any_lane, larger, law, load, select, store
from torchsoro.simulation.kernels.laws_lanes import laws

softening = laws.softening

# Numbers of a point.
VOLUME, BULK, SHEAR, VOID_FRACTION, STIFFENING, VISCOSITY, VOLUME_VISCOSITY = 0, 1, 2, 3, 4, 6, 7
NUMBERS = 8
# Numbers of a Maxwell element: g, b, a, and b (1 - a), which float32 would not find from the others.
MODULUS, GAIN, DECAY, FADE = 0, 1, 2, 3
MAXWELL = 4


@law
def gather(mesh, b, x, field, at, room, G):
    """Gradient of a nodal vector field: G [8, 9, 16], derivatives of each component by x, y, z.

    Args:
        mesh: Cells and nodes.
        b: Number of the block.
        x: Where the weights along x begin.
        field: Nodal field, whose plane of the block's lowest nodes begins at ``at``.
        at: See ``field``.
        room: For the function's own use.
        G: Filled.
    """
    X, Y, Z, y, z, unit = mesh.X, mesh.Y, mesh.Z, mesh.block_y[b], mesh.block_z[b], mesh.unit
    at += mesh.block_at[b]
    y00, y01, y02 = load(Y, y), load(Y, y + 16), load(Y, y + 32)
    y10, y11, y12 = load(Y, y + 48), load(Y, y + 64), load(Y, y + 80)
    s00, s01, s02 = load(Y, y + 96), load(Y, y + 112), load(Y, y + 128)
    s10, s11, s12 = load(Y, y + 144), load(Y, y + 160), load(Y, y + 176)
    for c in range(3):
        for i in range(3):
            b0 = at + c * mesh.component + i * mesh.plane
            b1, b2 = b0 + mesh.row, b0 + 2 * mesh.row
            a00, a01, a02 = load(field, b0), load(field, b0 + unit), load(field, b0 + 2 * unit)
            a10, a11, a12 = load(field, b1), load(field, b1 + unit), load(field, b1 + 2 * unit)
            a20, a21, a22 = load(field, b2), load(field, b2 + unit), load(field, b2 + 2 * unit)
            for o in range(2):
                w0, w1, w2 = load(Z, z + 48 * o), load(Z, z + 48 * o + 16), load(Z, z + 48 * o + 32)
                t0, t1, t2 = load(Z, z + 48 * o + 96), load(Z, z + 48 * o + 112), load(Z, z + 48 * o + 128)
                v0, v1, v2 = (
                    w0 * a00 + w1 * a01 + w2 * a02,
                    w0 * a10 + w1 * a11 + w2 * a12,
                    w0 * a20 + w1 * a21 + w2 * a22,
                )
                d0, d1, d2 = (
                    t0 * a00 + t1 * a01 + t2 * a02,
                    t0 * a10 + t1 * a11 + t2 * a12,
                    t0 * a20 + t1 * a21 + t2 * a22,
                )
                r = 16 * (12 * i + 3 * o)
                store(room, r, y00 * v0 + y01 * v1 + y02 * v2)
                store(room, r + 16, s00 * v0 + s01 * v1 + s02 * v2)
                store(room, r + 32, y00 * d0 + y01 * d1 + y02 * d2)
                store(room, r + 96, y10 * v0 + y11 * v1 + y12 * v2)
                store(room, r + 112, s10 * v0 + s11 * v1 + s12 * v2)
                store(room, r + 128, y10 * d0 + y11 * d1 + y12 * d2)
        for yz in range(4):
            r = 48 * yz
            a0, a1, a2 = load(room, r), load(room, r + 192), load(room, r + 384)
            b0, b1, b2 = load(room, r + 16), load(room, r + 208), load(room, r + 400)
            c0, c1, c2 = load(room, r + 32), load(room, r + 224), load(room, r + 416)
            for o in range(2):
                w0, w1, w2 = X[x + 3 * o], X[x + 3 * o + 1], X[x + 3 * o + 2]
                g = 16 * (9 * (4 * o + yz) + 3 * c)
                store(G, g, X[x + 6 + 3 * o] * a0 + X[x + 7 + 3 * o] * a1 + X[x + 8 + 3 * o] * a2)
                store(G, g + 16, w0 * b0 + w1 * b1 + w2 * b2)
                store(G, g + 32, w0 * c0 + w1 * c1 + w2 * c2)


@law
def scatter(mesh, b, x, out, at, room, P):
    """Add what the points hand to the nodes, sum P grad N, with P as G of :func:`gather`.

    Blocks of cells share nodes with themselves: what goes to a node from three lanes is added one after the other.
    ``out`` is a patch of three planes from ``at`` on.
    """
    X, Y, Z, y, z, unit = mesh.X, mesh.Y, mesh.Z, mesh.block_y[b], mesh.block_z[b], mesh.unit
    at += mesh.block_at[b]
    for c in range(3):
        for i in range(3):
            w0, w1, s0, s1 = X[x + i], X[x + 3 + i], X[x + 6 + i], X[x + 9 + i]
            p = 48 * c
            a00, a01 = s0 * load(P, p) + s1 * load(P, p + 576), s0 * load(P, p + 144) + s1 * load(P, p + 720)
            a10, a11 = s0 * load(P, p + 288) + s1 * load(P, p + 864), s0 * load(P, p + 432) + s1 * load(P, p + 1008)
            p += 16
            b00, b01 = w0 * load(P, p) + w1 * load(P, p + 576), w0 * load(P, p + 144) + w1 * load(P, p + 720)
            b10, b11 = w0 * load(P, p + 288) + w1 * load(P, p + 864), w0 * load(P, p + 432) + w1 * load(P, p + 1008)
            p += 16
            c00, c01 = w0 * load(P, p) + w1 * load(P, p + 576), w0 * load(P, p + 144) + w1 * load(P, p + 720)
            c10, c11 = w0 * load(P, p + 288) + w1 * load(P, p + 864), w0 * load(P, p + 432) + w1 * load(P, p + 1008)
            for j in range(3):
                y0, y1 = load(Y, y + 16 * j), load(Y, y + 48 + 16 * j)
                t0, t1 = load(Y, y + 96 + 16 * j), load(Y, y + 144 + 16 * j)
                a0, a1 = y0 * a00 + y1 * a10 + t0 * b00 + t1 * b10, y0 * a01 + y1 * a11 + t0 * b01 + t1 * b11
                b0, b1 = y0 * c00 + y1 * c10, y0 * c01 + y1 * c11
                r = 16 * (27 * c + 9 * i + 3 * j)
                for k in range(3):
                    z0, z1 = load(Z, z + 16 * k), load(Z, z + 48 + 16 * k)
                    d0, d1 = load(Z, z + 96 + 16 * k), load(Z, z + 144 + 16 * k)
                    store(room, r + 16 * k, z0 * a0 + z1 * a1 + d0 * b0 + d1 * b1)
    # Neighbours overlap: what is written is not read again before it has arrived.
    for k in range(3):
        for j in range(3):
            for i in range(3):
                for c in range(3):
                    o = at + (3 * i + c) * mesh.patch + j * mesh.row + k * unit
                    store(out, o, load(out, o) + load(room, 16 * (27 * c + 9 * i + 3 * j + k)))


ROOM = 16 * 84  # numbers that gather and scatter need for themselves


@law
def deformed(G, at):
    """F = I + displacement gradient of a point."""
    return (
        load(G, at) + 1, load(G, at + 16), load(G, at + 32),
        load(G, at + 48), load(G, at + 64) + 1, load(G, at + 80),
        load(G, at + 96), load(G, at + 112), load(G, at + 128) + 1,
    )  # fmt: skip


@law
def plain(G, at):
    """The tensor of a point as it is."""
    return (
        load(G, at), load(G, at + 16), load(G, at + 32), load(G, at + 48), load(G, at + 64), load(G, at + 80),
        load(G, at + 96), load(G, at + 112), load(G, at + 128),
    )  # fmt: skip


@law
def keep(P, at, T, scale):
    """Store a tensor times a number."""
    store(P, at, scale * T[0])
    store(P, at + 16, scale * T[1])
    store(P, at + 32, scale * T[2])
    store(P, at + 48, scale * T[3])
    store(P, at + 64, scale * T[4])
    store(P, at + 80, scale * T[5])
    store(P, at + 96, scale * T[6])
    store(P, at + 112, scale * T[7])
    store(P, at + 128, scale * T[8])


@law
def volume_ratio(F):
    """Det F."""
    return F[0] * (F[4] * F[8] - F[5] * F[7]) + F[1] * (F[5] * F[6] - F[3] * F[8]) + F[2] * (F[3] * F[7] - F[4] * F[6])


@law
def stiffening(F, ratio, least, numbers, n):
    """Factor 1 + a x + b x^2 of the shear modulus at x = I1b - 3."""
    x, _ = excess(F, larger(ratio, least))
    return 1 + x * (load(numbers, n + 16 * STIFFENING) + load(numbers, n + 16 * STIFFENING + 16) * x)


@law
def added(S, past, before, future, after, elements, maxwell, m):
    """Q = sum g (Z + b S) over the Maxwell elements, and their states: Z becomes a Z - b (1 - a) S."""
    Q0, Q1, Q2, Q3, Q4, Q5 = 0 * S[0], 0 * S[0], 0 * S[0], 0 * S[0], 0 * S[0], 0 * S[0]
    for e in range(elements):
        g, b = load(maxwell, m + 64 * e), load(maxwell, m + 64 * e + 16)
        a, fade, gb = load(maxwell, m + 64 * e + 32), load(maxwell, m + 64 * e + 48), g * b
        i, o = before + 96 * e, after + 96 * e
        z0, z1, z2 = load(past, i), load(past, i + 16), load(past, i + 32)
        z3, z4, z5 = load(past, i + 48), load(past, i + 64), load(past, i + 80)
        Q0, Q1, Q2 = Q0 + g * z0 + gb * S[0], Q1 + g * z1 + gb * S[1], Q2 + g * z2 + gb * S[2]
        Q3, Q4, Q5 = Q3 + g * z3 + gb * S[3], Q4 + g * z4 + gb * S[4], Q5 + g * z5 + gb * S[5]
        store(future, o, a * z0 - fade * S[0])
        store(future, o + 16, a * z1 - fade * S[1])
        store(future, o + 32, a * z2 - fade * S[2])
        store(future, o + 48, a * z3 - fade * S[3])
        store(future, o + 64, a * z4 - fade * S[4])
        store(future, o + 80, a * z5 - fade * S[5])
    return Q0, Q1, Q2, Q3, Q4, Q5


@law
def point(G, rates, at, numbers, n, past, before, future, after, elements, maxwell, m, flags, softens):
    """First Piola stress times volume of a point, stored in place of its gradient; whether solid matter collapsed.

    Args:
        G: Displacement gradients, then stresses.
        rates: Velocity gradients, read where there is viscosity.
        at: Of the point in both.
        numbers: Of the points.
        n: Where the point's begin.
        past: History: Z of each Maxwell element, then the largest x.
        before: Where the point's begins.
        future: The same after the substep.
        after: Where the point's begins.
        elements: Number of Maxwell elements.
        maxwell: Their numbers.
        m: Where those of the simulation begin.
        flags: Whether anything stiffens, softens or is viscous.
        softens: Depth and range of softening, lanes.
    """
    F = deformed(G, at)
    volume, void_fraction = load(numbers, n), load(numbers, n + 16 * VOID_FRACTION)
    bulk, shear = load(numbers, n + 16 * BULK), load(numbers, n + 16 * SHEAR)
    factor = select(void_fraction < 1, 0 * volume + 1, 0 * volume)
    least = least_ratio(void_fraction)
    left = 0 * volume + 1
    if flags[0] or flags[1]:
        ratio = volume_ratio(F)
        if flags[0]:
            factor = factor * stiffening(F, ratio, least, numbers, n)
        if flags[1]:
            end = 96 * elements
            x, _ = excess(F, larger(ratio, least))
            left, largest = softening(x, load(past, before + end), load(softens, 0), load(softens, 16))
            store(future, after + end, select(void_fraction < 1, largest, 0 * largest))
    S = (factor, factor, factor, factor, factor, factor)
    if elements > 0:
        T = pull_back(F, least)
        S = (factor * T[0], factor * T[1], factor * T[2], factor * T[3], factor * T[4], factor * T[5])
    Q = added(S, past, before, future, after, elements, maxwell, m)
    P, _, J = piola(F, Q, bulk, shear, factor * left, void_fraction)
    if flags[2]:
        eta, zeta = load(numbers, n + 16 * VISCOSITY), load(numbers, n + 16 * VOLUME_VISCOSITY)
        P = plus(1.0, P, 1.0, viscous_piola(F, plain(rates, at), eta, zeta))
    keep(G, at, P, volume)
    return any_lane(~(J > 0) & (void_fraction == 0) & (volume > 0))


@law
def enclosed(G, at, gas, n):
    """Of a point that may be gas: area vectors V cof F to be handed on, V det F, and whether it collapsed."""
    F = deformed(G, at)
    V = load(gas, n)
    cof = (
        F[4] * F[8] - F[5] * F[7], F[5] * F[6] - F[3] * F[8], F[3] * F[7] - F[4] * F[6],
        F[2] * F[7] - F[1] * F[8], F[0] * F[8] - F[2] * F[6], F[1] * F[6] - F[0] * F[7],
        F[1] * F[5] - F[2] * F[4], F[2] * F[3] - F[0] * F[5], F[0] * F[4] - F[1] * F[3],
    )  # fmt: skip
    J = contract(cof, F) * (1 / 3)
    return cof, V * J, any_lane(~(J > 0) & (V > 0))


STIFFNESS, ANCHOR, ATTACHED = 0, 1, 4  # numbers of a spring: stiffness, way of its anchor from the particle's place


@law
def value(mesh, b, x, field, at, k):
    """A nodal vector field at point k of a block; see :func:`gather`."""
    X, Y, Z, y, z = mesh.X, mesh.Y, mesh.Z, mesh.block_y[b], mesh.block_z[b]
    at += mesh.block_at[b]
    ox, oy, oz = 3 * (k // 4), 48 * (k // 2 % 2), 48 * (k % 2)
    u0, u1, u2 = 0 * load(Y, y), 0 * load(Y, y), 0 * load(Y, y)
    for i in range(3):
        for j in range(3):
            weight = X[x + ox + i] * load(Y, y + oy + 16 * j)
            for n in range(3):
                w = weight * load(Z, z + oz + 16 * n)
                o = at + i * mesh.plane + j * mesh.row + n * mesh.unit
                u0 = u0 + w * load(field, o)
                u1 = u1 + w * load(field, o + mesh.component)
                u2 = u2 + w * load(field, o + 2 * mesh.component)
    return u0, u1, u2


@law
def hand_on(mesh, b, x, out, at, V):
    """Add vectors V [8, 3, 16] of the points to the nodes; see :func:`scatter`."""
    X, Y, Z, y, z = mesh.X, mesh.Y, mesh.Z, mesh.block_y[b], mesh.block_z[b]
    at += mesh.block_at[b]
    for n in range(3):
        for i in range(3):
            for j in range(3):
                o = at + 3 * i * mesh.patch + j * mesh.row + n * mesh.unit
                f0, f1, f2 = 0 * load(V, 0), 0 * load(V, 0), 0 * load(V, 0)
                for k in range(8):
                    w = X[x + 3 * (k // 4) + i] * load(Y, y + 48 * (k // 2 % 2) + 16 * j)
                    w = w * load(Z, z + 48 * (k % 2) + 16 * n)
                    f0, f1, f2 = f0 + w * load(V, 48 * k), f1 + w * load(V, 48 * k + 16), f2 + w * load(V, 48 * k + 32)
                store(out, o, load(out, o) + f0)
                store(out, o + mesh.patch, load(out, o + mesh.patch) + f1)
                store(out, o + 2 * mesh.patch, load(out, o + 2 * mesh.patch) + f2)


@law
def stretch(u, attached, s):
    """From a point that has moved by u to the anchor of its spring."""
    s += 16 * ANCHOR
    return load(attached, s) - u[0], load(attached, s + 16) - u[1], load(attached, s + 32) - u[2]
