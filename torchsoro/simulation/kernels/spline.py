"""Quadratic B-splines on the grid: the three weights per axis and their slopes."""

import taichi as ti


@ti.func
def base_node(x, inverse_cell):
    """Lowest of the three nodes per axis that a particle at grid position x touches."""
    return ti.cast(ti.floor(x * inverse_cell - 0.5), ti.i32)


@ti.func
def weights(f):
    """Weights of the three nodes per axis; f in [1/2, 3/2) is the distance from the lowest node in cells."""
    a, b, c = 1.5 - f, f - 1.0, f - 0.5
    w0, w1, w2 = 0.5 * a * a, 0.75 - b * b, 0.5 * c * c
    return ti.Matrix([[w0[0], w0[1], w0[2]], [w1[0], w1[1], w1[2]], [w2[0], w2[1], w2[2]]])


@ti.func
def slopes(f):
    """Derivatives of :func:`weights` by the particle's position in cells."""
    a, b, c = f - 1.5, -2.0 * (f - 1.0), f - 0.5
    return ti.Matrix([[a[0], a[1], a[2]], [b[0], b[1], b[2]], [c[0], c[1], c[2]]])
