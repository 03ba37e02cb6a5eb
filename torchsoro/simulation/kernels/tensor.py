"""Small matrix helpers for kernels: loads and stores of vectors and tensors, symmetric storage, invariants."""

import taichi as ti


@ti.func
def add(atomic: ti.template(), a: ti.template(), at, value):
    """Add to a buffer: atomically where threads share it, plainly where a lane owns it."""
    if ti.static(atomic):
        ti.atomic_add(a[at], value)
    else:
        a[at] = a[at] + value


@ti.func
def load_vector(a: ti.template(), at, stride):
    """Three components, ``stride`` apart."""
    return ti.Vector([a[at], a[at + stride], a[at + 2 * stride]])


@ti.func
def store_vector(a: ti.template(), at, stride, v):
    """Write three components, ``stride`` apart."""
    for i in ti.static(range(3)):
        a[at + i * stride] = v[i]


@ti.func
def load_matrix(a: ti.template(), at, stride):
    """Nine components in row order, ``stride`` apart."""
    return ti.Matrix([[a[at + (3 * i + j) * stride] for j in ti.static(range(3))] for i in ti.static(range(3))])


@ti.func
def store_matrix(a: ti.template(), at, stride, m):
    """Write nine components in row order, ``stride`` apart."""
    for i, j in ti.static(ti.ndrange(3, 3)):
        a[at + (3 * i + j) * stride] = m[i, j]


@ti.func
def load_symmetric(a: ti.template(), at, stride):
    """A symmetric matrix from (xx, yy, zz, xy, yz, xz)."""
    xx, yy, zz = a[at], a[at + stride], a[at + 2 * stride]
    xy, yz, xz = a[at + 3 * stride], a[at + 4 * stride], a[at + 5 * stride]
    return ti.Matrix([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


@ti.func
def store_symmetric(a: ti.template(), at, stride, m):
    """Write (xx, yy, zz, xy, yz, xz) of a symmetric matrix."""
    for i in ti.static(range(3)):
        a[at + i * stride] = m[i, i]
        a[at + (3 + i) * stride] = m[min(i, (i + 1) % 3), max(i, (i + 1) % 3)]


@ti.func
def load_symmetric_adjoint(a: ti.template(), at, stride):
    """The symmetric matrix G with G : dH equal to the stored component gradient times the component changes."""
    m = load_symmetric(a, at, stride)
    for i, j in ti.static(ti.ndrange(3, 3)):
        if ti.static(i != j):
            m[i, j] *= 0.5
    return m


@ti.func
def store_symmetric_adjoint(a: ti.template(), at, stride, m):
    """Gradient by stored component: an off-diagonal component stands in two places of the matrix."""
    for i in ti.static(range(3)):
        a[at + i * stride] = m[i, i]
        j = ti.static((i + 1) % 3)
        a[at + (3 + i) * stride] = m[i, j] + m[j, i]


@ti.func
def cofactor(m):
    """The cofactor matrix, det(m) m^-T."""
    c = m
    for i, j in ti.static(ti.ndrange(3, 3)):
        a, b = ti.static((i + 1) % 3, (i + 2) % 3)
        k, n = ti.static((j + 1) % 3, (j + 2) % 3)
        c[i, j] = m[a, k] * m[b, n] - m[a, n] * m[b, k]
    return c


@ti.func
def cross(m, n):
    """The part of the cofactor of m + n that is linear in both; contracted with a third, symmetric in all three."""
    c = m
    for i, j in ti.static(ti.ndrange(3, 3)):
        a, b = ti.static((i + 1) % 3, (i + 2) % 3)
        k, o = ti.static((j + 1) % 3, (j + 2) % 3)
        c[i, j] = m[a, k] * n[b, o] + n[a, k] * m[b, o] - m[a, o] * n[b, k] - n[a, o] * m[b, k]
    return c


@ti.func
def contract(a, b):
    """The inner product a : b."""
    s = a[0, 0] * b[0, 0]
    for i, j in ti.static(ti.ndrange(3, 3)):
        if ti.static(i + j > 0):
            s += a[i, j] * b[i, j]
    return s


@ti.func
def plus_identity(m, s):
    """The matrix m + s I."""
    r = m
    for i in ti.static(range(3)):
        r[i, i] += s
    return r
