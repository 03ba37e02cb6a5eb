"""Compiled loops: forces of the material, of a pressure on walls, of planes; float64, one thread."""

from __future__ import annotations

import math

import numba
import numpy as np

_D = np.array([[-1.5, 2.0, -0.5], [-0.5, 0.0, 0.5], [0.5, -2.0, 1.5]])
_jit = numba.njit(cache=True, fastmath=True, error_model="numpy")


@_jit
def gradients(local, scale, out):
    """Reference gradient out[3 a + b, q] = d u_a / d X_b from nodal values local[a, q], q = i + 3 j + 9 k."""
    for a in range(3):
        for k in range(3):
            for j in range(3):
                for i in range(3):
                    q = i + 3 * j + 9 * k
                    gx, gy, gz = 0.0, 0.0, 0.0
                    for m in range(3):
                        gx += _D[i, m] * local[a, m + 3 * j + 9 * k]
                        gy += _D[j, m] * local[a, i + 3 * m + 9 * k]
                        gz += _D[k, m] * local[a, i + 3 * j + 9 * m]
                    out[3 * a, q] = gx * scale[0]
                    out[3 * a + 1, q] = gy * scale[1]
                    out[3 * a + 2, q] = gz * scale[2]


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
        old: S of the step before [M, 6, 27].
        history: H [M, E, 6, 27].
        law: 1/J_m of a Gent solid, then 1/r and m [Pa] of Ogden and Roxburgh; zeros for neo-Hookean.
        peak: Largest deviatoric energy so far [M, 27] Pa.
        force: [N, 3] N.
    """
    elements = discrete.shape[0]
    local = np.empty((3, 27))
    f = np.empty((9, 27))
    p = np.empty((9, 27))
    s = np.empty((6, 27))
    scale = np.empty(3)
    least = 1e9
    for e in range(cells.shape[0]):
        for q in range(27):
            n = cells[e, q]
            for a in range(3):
                local[a, q] = x[n, a] - rest[n, a]
        for a in range(3):
            scale[a] = 2 / size[e, a]
        gradients(local, scale, f)
        for q in range(27):
            f[0, q] += 1
            f[4, q] += 1
            f[8, q] += 1
        for q in range(27):
            f0, f1, f2, f3, f4, f5, f6, f7, f8 = (
                f[0, q], f[1, q], f[2, q], f[3, q], f[4, q], f[5, q], f[6, q], f[7, q], f[8, q]
            )  # fmt: skip
            # Cofactors: dJ/dF.
            k0, k1, k2 = f4 * f8 - f5 * f7, f5 * f6 - f3 * f8, f3 * f7 - f4 * f6
            k3, k4, k5 = f2 * f7 - f1 * f8, f0 * f8 - f2 * f6, f1 * f6 - f0 * f7
            k6, k7, k8 = f1 * f5 - f2 * f4, f2 * f3 - f0 * f5, f0 * f4 - f1 * f3
            j = f0 * k0 + f1 * k1 + f2 * k2
            least = min(least, j)
            log = math.log(max(j, 1e-3))
            third = math.exp(-log / 3)
            two = third * third
            # Cb and its inverse (det Cb = 1: the adjugate); order xx, yy, zz, xy, yz, xz.
            c0 = two * (f0 * f0 + f3 * f3 + f6 * f6)
            c1 = two * (f1 * f1 + f4 * f4 + f7 * f7)
            c2 = two * (f2 * f2 + f5 * f5 + f8 * f8)
            c3 = two * (f0 * f1 + f3 * f4 + f6 * f7)
            c4 = two * (f1 * f2 + f4 * f5 + f7 * f8)
            c5 = two * (f0 * f2 + f3 * f5 + f6 * f8)
            trace = c0 + c1 + c2
            t, inv = trace / 3, 1 / j
            s0 = inv * (1 - t * (c1 * c2 - c4 * c4))
            s1 = inv * (1 - t * (c0 * c2 - c5 * c5))
            s2 = inv * (1 - t * (c0 * c1 - c3 * c3))
            s3 = -inv * t * (c4 * c5 - c3 * c2)
            s4 = -inv * t * (c3 * c5 - c4 * c0)
            s5 = -inv * t * (c3 * c4 - c5 * c1)
            s[0, q], s[1, q], s[2, q], s[3, q], s[4, q], s[5, q] = s0, s1, s2, s3, s4, s5
            factor = 1 / (1 - min(law[0] * (trace - 3), 0.9))
            if law[1] > 0:
                energy = shear[e, q] / 2 * (trace - 3)
                if energy > peak[e, q]:
                    peak[e, q] = energy
                else:
                    factor *= 1 - law[1] * math.erf((peak[e, q] - energy) / law[2])
            t0, t1, t2, t3, t4, t5 = factor * s0, factor * s1, factor * s2, factor * s3, factor * s4, factor * s5
            for m in range(elements):
                a, b, g = discrete[m, 0], discrete[m, 1], discrete[m, 2]
                h0 = a * history[e, m, 0, q] + b * (s0 - old[e, 0, q])
                h1 = a * history[e, m, 1, q] + b * (s1 - old[e, 1, q])
                h2 = a * history[e, m, 2, q] + b * (s2 - old[e, 2, q])
                h3 = a * history[e, m, 3, q] + b * (s3 - old[e, 3, q])
                h4 = a * history[e, m, 4, q] + b * (s4 - old[e, 4, q])
                h5 = a * history[e, m, 5, q] + b * (s5 - old[e, 5, q])
                history[e, m, 0, q], history[e, m, 1, q], history[e, m, 2, q] = h0, h1, h2
                history[e, m, 3, q], history[e, m, 4, q], history[e, m, 5, q] = h3, h4, h5
                t0, t1, t2 = t0 + g * h0, t1 + g * h1, t2 + g * h2
                t3, t4, t5 = t3 + g * h3, t4 + g * h4, t5 + g * h5
            # P = tau F^-T with tau = mu J dev(Fb T Fb^T) + ... ; F T first, then the deviator's trace is T : Cb.
            third_trace = (t0 * c0 + t1 * c1 + t2 * c2 + 2 * (t3 * c3 + t4 * c4 + t5 * c5)) / 3
            w = weight[e, q]
            own = w * shear[e, q] * j * two
            iso = w * (bulk[e, q] / 2 * (j * (j - 1) + log) * inv - shear[e, q] * third_trace)
            p[0, q] = own * (f0 * t0 + f1 * t3 + f2 * t5) + iso * k0
            p[1, q] = own * (f0 * t3 + f1 * t1 + f2 * t4) + iso * k1
            p[2, q] = own * (f0 * t5 + f1 * t4 + f2 * t2) + iso * k2
            p[3, q] = own * (f3 * t0 + f4 * t3 + f5 * t5) + iso * k3
            p[4, q] = own * (f3 * t3 + f4 * t1 + f5 * t4) + iso * k4
            p[5, q] = own * (f3 * t5 + f4 * t4 + f5 * t2) + iso * k5
            p[6, q] = own * (f6 * t0 + f7 * t3 + f8 * t5) + iso * k6
            p[7, q] = own * (f6 * t3 + f7 * t1 + f8 * t4) + iso * k7
            p[8, q] = own * (f6 * t5 + f7 * t4 + f8 * t2) + iso * k8
        if elements > 0:
            for c in range(6):
                for q in range(27):
                    old[e, c, q] = s[c, q]
        for a in range(3):
            for k in range(3):
                for j2 in range(3):
                    for i in range(3):
                        total = 0.0
                        for m in range(3):
                            total += _D[m, i] * scale[0] * p[3 * a, m + 3 * j2 + 9 * k]
                            total += _D[m, j2] * scale[1] * p[3 * a + 1, i + 3 * m + 9 * k]
                            total += _D[m, k] * scale[2] * p[3 * a + 2, i + 3 * j2 + 9 * m]
                        force[cells[e, i + 3 * j2 + 9 * k], a] -= total
    return least


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
                press = max(-ground[0] * gap - ground[1] * normal, 0.0) * area[n]
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
