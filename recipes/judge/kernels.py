"""Compiled loops: forces of the material, of a pressure on walls, of planes; float64, one thread."""

from __future__ import annotations

import math

import numba
import numpy as np

_D = np.array([[-1.5, 2.0, -0.5], [-0.5, 0.0, 0.5], [0.5, -2.0, 1.5]])
LANES = 28  # of an element's 27 points, filled up so that they fit the vector registers
_J, _LOG, _TWO, _TRACE, _WEIGHT, _MU, _K = 36, 37, 38, 39, 40, 41, 42
_jit = numba.njit(cache=True, fastmath=True, error_model="numpy")


@_jit
def gradients(local, scale, out):
    """Reference gradient, row 3 a + b of out: d u_a / d X_b, from nodal values local[27 a + q], q = i + 3 j + 9 k.

    Along a line of three nodes at -1, 0, 1 the derivative of a quadratic is (-3, 4, -1)/2, (-1, 0, 1)/2, (1, -4, 3)/2.
    """
    for a in range(3):
        for b in range(3):
            stride = 3**b
            first, second = (3, 9) if b == 0 else ((1, 9) if b == 1 else (1, 3))
            row, half = (3 * a + b) * LANES, 0.5 * scale[b]
            for m in range(3):
                for n in range(3):
                    at = first * m + second * n
                    u, v, w = (
                        local[27 * a + at],
                        local[27 * a + at + stride],
                        local[27 * a + at + 2 * stride],
                    )
                    out[row + at] = half * (4 * v - 3 * u - w)
                    out[row + at + stride] = half * (w - u)
                    out[row + at + 2 * stride] = half * (u - 4 * v + 3 * w)


@_jit
def gathered(p, scale, local):
    """Nodal sums local[27 a + l] = sum over points and b of (d N_l / d X_b) p[3 a + b]: the transpose of gradients."""
    local[:] = 0.0
    for a in range(3):
        for b in range(3):
            stride = 3**b
            first, second = (3, 9) if b == 0 else ((1, 9) if b == 1 else (1, 3))
            row, half = (3 * a + b) * LANES, 0.5 * scale[b]
            for m in range(3):
                for n in range(3):
                    at = first * m + second * n
                    u, v, w = (
                        p[row + at],
                        p[row + at + stride],
                        p[row + at + 2 * stride],
                    )
                    local[27 * a + at] += half * (w - 3 * u - v)
                    local[27 * a + at + stride] += half * 4 * (u - w)
                    local[27 * a + at + 2 * stride] += half * (v - u + 3 * w)


@_jit
def material(x, rest, cells, size, weight, shear, bulk, discrete, old, history, law, peak, force):
    """Add the forces of the stress to ``force`` [N, 3]; returns the smallest J.

    Args:
        x: Positions [N, 3] m.
        rest: Reference positions [N, 3] m.
        cells: [M, 27].
        size: [M, 3] m.
        weight: [M, 27] m3.
        shear: mu [M, 27] Pa.
        bulk: K [M, 27] Pa.
        discrete: a, b and g of each Maxwell element [E, 3].
        old: S of the step before [M, 6, LANES].
        history: H [M, E, 6, LANES].
        law: 1/J_m of a Gent solid, then 1/r and m [Pa] of Ogden and Roxburgh; zeros for neo-Hookean.
        peak: Largest deviatoric energy so far [M, 27] Pa.
        force: [N, 3] N.
    """
    elements = discrete.shape[0]
    local = np.empty(81)
    w = np.zeros(43 * LANES)  # rows: F 0-8, cofactors 9-17, Cb 18-23, S 24-29, T 30-35, then single ones; P in 0-8
    scale = np.empty(3)
    least = 1e9
    plain = law[0] == 0 and law[1] == 0
    for e in range(cells.shape[0]):
        for q in range(27):
            n = cells[e, q]
            for a in range(3):
                local[27 * a + q] = x[n, a] - rest[n, a]
            w[_WEIGHT * LANES + q] = weight[e, q]
            w[_MU * LANES + q] = shear[e, q]
            w[_K * LANES + q] = bulk[e, q]
        for a in range(3):
            scale[a] = 2 / size[e, a]
        gradients(local, scale, w)
        for c in range(9):
            w[c * LANES + 27] = 0.0
        for q in range(LANES):
            w[0 * LANES + q] += 1
            w[4 * LANES + q] += 1
            w[8 * LANES + q] += 1
        _strain(w)
        for q in range(27):
            least = min(least, w[_J * LANES + q])
        if plain:
            for c in range(6):
                for q in range(LANES):
                    w[(30 + c) * LANES + q] = w[(24 + c) * LANES + q]
        else:
            _soften(w, law, peak[e])
        for m in range(elements):
            a, b, g = discrete[m, 0], discrete[m, 1], discrete[m, 2]
            for c in range(6):
                row, before = history[e, m, c], old[e, c]
                for q in range(LANES):
                    h = a * row[q] + b * (w[(24 + c) * LANES + q] - before[q])
                    row[q] = h
                    w[(30 + c) * LANES + q] += g * h
        if elements > 0:
            for c in range(6):
                for q in range(LANES):
                    old[e, c, q] = w[(24 + c) * LANES + q]
        _stress(w)
        gathered(w, scale, local)
        for q in range(27):
            for a in range(3):
                force[cells[e, q], a] -= local[27 * a + q]
    return least


@_jit
def _strain(w):
    for q in range(LANES):
        f0, f1, f2 = w[q], w[LANES + q], w[2 * LANES + q]
        f3, f4, f5 = w[3 * LANES + q], w[4 * LANES + q], w[5 * LANES + q]
        f6, f7, f8 = w[6 * LANES + q], w[7 * LANES + q], w[8 * LANES + q]
        k0, k1, k2 = f4 * f8 - f5 * f7, f5 * f6 - f3 * f8, f3 * f7 - f4 * f6
        w[9 * LANES + q], w[10 * LANES + q], w[11 * LANES + q] = k0, k1, k2
        w[12 * LANES + q], w[13 * LANES + q], w[14 * LANES + q] = (
            f2 * f7 - f1 * f8,
            f0 * f8 - f2 * f6,
            f1 * f6 - f0 * f7,
        )
        w[15 * LANES + q], w[16 * LANES + q], w[17 * LANES + q] = (
            f1 * f5 - f2 * f4,
            f2 * f3 - f0 * f5,
            f0 * f4 - f1 * f3,
        )
        j = f0 * k0 + f1 * k1 + f2 * k2
        # ln J = 2 artanh z and J^(-2/3) by their series, which the compiler vectorises: 1e-9 for J from 1/2 to 2.
        z = (j - 1) / (j + 1)
        zz = z * z
        log = 1 / 13 + zz * (1 / 15 + zz * (1 / 17 + zz * (1 / 19 + zz / 21)))
        log = 2 * z * (1 + zz * (1 / 3 + zz * (1 / 5 + zz * (1 / 7 + zz * (1 / 9 + zz * (1 / 11 + zz * log))))))
        y = -log / 3
        third = 1 / 120 + y * (1 / 720 + y * (1 / 5040 + y * (1 / 40320 + y * (1 / 362880 + y / 3628800))))
        third = 1 + y * (1 + y * (1 / 2 + y * (1 / 6 + y * (1 / 24 + y * third))))
        two = third * third
        c0 = two * (f0 * f0 + f3 * f3 + f6 * f6)
        c1 = two * (f1 * f1 + f4 * f4 + f7 * f7)
        c2 = two * (f2 * f2 + f5 * f5 + f8 * f8)
        c3 = two * (f0 * f1 + f3 * f4 + f6 * f7)
        c4 = two * (f1 * f2 + f4 * f5 + f7 * f8)
        c5 = two * (f0 * f2 + f3 * f5 + f6 * f8)
        t, inv = (c0 + c1 + c2) / 3, 1 / j
        (
            w[18 * LANES + q],
            w[19 * LANES + q],
            w[20 * LANES + q],
            w[21 * LANES + q],
            w[22 * LANES + q],
            w[23 * LANES + q],
        ) = c0, c1, c2, c3, c4, c5
        # S = (I - t Cb^-1) / J; det Cb = 1, so that its inverse is its adjugate. Order xx, yy, zz, xy, yz, xz.
        w[24 * LANES + q] = inv * (1 - t * (c1 * c2 - c4 * c4))
        w[25 * LANES + q] = inv * (1 - t * (c0 * c2 - c5 * c5))
        w[26 * LANES + q] = inv * (1 - t * (c0 * c1 - c3 * c3))
        w[27 * LANES + q] = -inv * t * (c4 * c5 - c3 * c2)
        w[28 * LANES + q] = -inv * t * (c3 * c5 - c4 * c0)
        w[29 * LANES + q] = -inv * t * (c3 * c4 - c5 * c1)
        (
            w[_J * LANES + q],
            w[_LOG * LANES + q],
            w[_TWO * LANES + q],
            w[_TRACE * LANES + q],
        ) = j, log, two, 3 * t


@_jit
def _soften(w, law, peak):
    for q in range(27):
        factor = 1 / (1 - min(law[0] * (w[_TRACE * LANES + q] - 3), 0.9))
        if law[1] > 0:
            energy = w[_MU * LANES + q] / 2 * (w[_TRACE * LANES + q] - 3)
            if energy > peak[q]:
                peak[q] = energy
            else:
                factor *= 1 - law[1] * math.erf((peak[q] - energy) / law[2])
        for c in range(6):
            w[(30 + c) * LANES + q] = factor * w[(24 + c) * LANES + q]


@_jit
def _stress(w):
    # P = tau F^-T, tau = mu J dev(Fb T Fb^T) + K/2 (J (J - 1) + ln J) I: with F T first the trace is T : Cb.
    for q in range(LANES):
        t0, t1, t2, t3, t4, t5 = (
            w[30 * LANES + q],
            w[31 * LANES + q],
            w[32 * LANES + q],
            w[33 * LANES + q],
            w[34 * LANES + q],
            w[35 * LANES + q],
        )
        mean = t0 * w[18 * LANES + q] + t1 * w[19 * LANES + q] + t2 * w[20 * LANES + q]
        mean = (mean + 2 * (t3 * w[21 * LANES + q] + t4 * w[22 * LANES + q] + t5 * w[23 * LANES + q])) / 3
        j, weight, mu = w[_J * LANES + q], w[_WEIGHT * LANES + q], w[_MU * LANES + q]
        own = weight * mu * j * w[_TWO * LANES + q]
        iso = weight * (w[_K * LANES + q] / 2 * (j * (j - 1) + w[_LOG * LANES + q]) / j - mu * mean)
        for r in (0, 3, 6):
            a, b, c = w[r * LANES + q], w[(r + 1) * LANES + q], w[(r + 2) * LANES + q]
            w[r * LANES + q] = own * (a * t0 + b * t3 + c * t5) + iso * w[(9 + r) * LANES + q]
            w[(r + 1) * LANES + q] = own * (a * t3 + b * t1 + c * t4) + iso * w[(10 + r) * LANES + q]
            w[(r + 2) * LANES + q] = own * (a * t5 + b * t4 + c * t2) + iso * w[(11 + r) * LANES + q]


@_jit
def area_vectors(x, nodes, sign, out):
    """Area vector of each node's share of each side in the current state, out of the solid: out[B, 9, 3] m2.

    Returns the volume that the sides enclose with the origin, (1/3) sum x . a [m3].
    """
    first = np.empty((9, 3))
    second = np.empty((9, 3))
    volume = 0.0
    for b in range(nodes.shape[0]):
        for a in range(3):
            for j in range(3):
                for i in range(3):
                    g, h = 0.0, 0.0
                    for m in range(3):
                        g += _D[i, m] * x[nodes[b, m + 3 * j], a]
                        h += _D[j, m] * x[nodes[b, i + 3 * m], a]
                    first[i + 3 * j, a] = g
                    second[i + 3 * j, a] = h
        for q in range(9):
            w = sign[b] / 9.0
            if q % 3 == 1:
                w *= 4
            if q // 3 == 1:
                w *= 4
            u, v = first[q], second[q]
            out[b, q, 0] = w * (u[1] * v[2] - u[2] * v[1])
            out[b, q, 1] = w * (u[2] * v[0] - u[0] * v[2])
            out[b, q, 2] = w * (u[0] * v[1] - u[1] * v[0])
            n = nodes[b, q]
            volume += (x[n, 0] * out[b, q, 0] + x[n, 1] * out[b, q, 1] + x[n, 2] * out[b, q, 2]) / 3
    return volume


@_jit
def push(nodes, areas, pressure, force):
    """Add the forces of a pressure [Pa] on sides with area vectors [B, 9, 3] that point out of the solid."""
    for b in range(nodes.shape[0]):
        for q in range(9):
            for a in range(3):
                force[nodes[b, q], a] -= pressure * areas[b, q, a]


@_jit
def drag(nodes, areas, v, coefficient, force):
    """Add a pressure c |v_n| v_n [c in kg/m3] against the normal motion of every side."""
    for b in range(nodes.shape[0]):
        for q in range(9):
            n = nodes[b, q]
            size = math.sqrt(areas[b, q, 0] ** 2 + areas[b, q, 1] ** 2 + areas[b, q, 2] ** 2)
            if size > 0:
                speed = (v[n, 0] * areas[b, q, 0] + v[n, 1] * areas[b, q, 1] + v[n, 2] * areas[b, q, 2]) / size
                for a in range(3):
                    force[n, a] -= coefficient * abs(speed) * speed * areas[b, q, a]


@_jit
def advance(x, v, mass, force, dt, held, plane, area, ground, coulomb):
    """One central-difference step with at most one plane: penalty along its normal, impulse-limited friction along it.

    Args:
        x: Positions [N, 3] m, advanced in place.
        v: Velocities half a step behind [N, 3] m/s, advanced in place.
        mass: [N] kg.
        force: All other forces [N, 3] N.
        dt: Step [s].
        held: [N], True where clamped.
        plane: Point and unit normal [6]; normal zero: no plane.
        area: Outer area of each node [N] m2.
        ground: Stiffness [Pa/m], loss [Pa s/m], adhesive traction [Pa], its reach [m].
        coulomb: Friction at high speed, at rest, and the Stribeck speed [m/s].
    """
    solid = plane[3] != 0 or plane[4] != 0 or plane[5] != 0
    for n in range(x.shape[0]):
        if held[n]:
            continue
        for a in range(3):
            v[n, a] += dt * force[n, a] / mass[n]
        if solid and area[n] > 0:
            gap = 0.0
            normal = 0.0
            for a in range(3):
                gap += (x[n, a] - plane[a]) * plane[3 + a]
                normal += v[n, a] * plane[3 + a]
            press = 0.0
            if gap < 0:
                # The loss acts on the velocity at the end of the step, so that it cannot grow however large it is.
                rate = dt * area[n] / mass[n]
                after = (normal - rate * ground[0] * gap) / (1 + rate * ground[1])
                press = max((after - normal) * mass[n] / dt, 0.0)
            pull = 0.0
            if ground[2] > 0 and gap > 0:
                pull = ground[2] * area[n] * gap / ground[3] * math.exp(1 - gap / ground[3])
            change = dt * (press - pull) / mass[n]
            for a in range(3):
                v[n, a] += change * plane[3 + a]
            if press > 0:
                normal += change
                speed = 0.0
                for a in range(3):
                    speed += (v[n, a] - normal * plane[3 + a]) ** 2
                speed = math.sqrt(speed)
                if speed > 0:
                    mu = coulomb[0] + (coulomb[1] - coulomb[0]) * math.exp(-speed / coulomb[2])
                    keep = max(1 - mu * dt * press / mass[n] / speed, 0.0)
                    for a in range(3):
                        v[n, a] = normal * plane[3 + a] + keep * (v[n, a] - normal * plane[3 + a])
        for a in range(3):
            x[n, a] += dt * v[n, a]
