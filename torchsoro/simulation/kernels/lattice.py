"""The lattice of the total-Lagrangian form in kernels: its sizes, places of nodes and particles, a field at a point.

``head`` is the beginning of ``ints``, which a block of threads on a GPU keeps at hand; ``ints`` and ``fixed`` are the
buffers of ``layout``.
"""

import taichi as ti

from torchsoro.simulation.kernels.layout import (
    AXES,
    AXIS,
    FIRSTS,
    HISTORIES,
    MX,
    MY,
    MZ,
    NX,
    NY,
    NZ,
)


@ti.func
def points_per_axis(head: ti.template()):
    """(nx, ny, nz)."""
    return ti.Vector([head[NX], head[NY], head[NZ]])


@ti.func
def nodes_per_axis(head: ti.template()):
    """Nodes along x, y, z."""
    return ti.Vector([head[MX], head[MY], head[MZ]])


@ti.func
def product(v):
    """Of the three components."""
    return v[0] * v[1] * v[2]


@ti.func
def axis_starts(head: ti.template()):
    """Where the numbers of the axes begin."""
    y = AXES + (AXIS + 1) * head[NX] + head[MX]
    return ti.Vector([AXES, y, y + (AXIS + 1) * head[NY] + head[MY]])


@ti.func
def node_place(head: ti.template(), fixed: ti.template(), axis, index):
    """Reference coordinate of the nodes with an index along an axis."""
    starts = axis_starts(head)
    at, n = starts[0], head[NX]
    if axis == 1:
        at, n = starts[1], head[NY]
    elif axis == 2:
        at, n = starts[2], head[NZ]
    return fixed[at + (AXIS + 1) * n + index]


@ti.func
def particle_place(head: ti.template(), fixed: ti.template(), p):
    """Reference place of the particle of point p."""
    starts, n = axis_starts(head), points_per_axis(head)
    x = fixed[starts[0] + AXIS * n[0] + p // (n[1] * n[2])]
    y = fixed[starts[1] + AXIS * n[1] + (p // n[2]) % n[1]]
    z = fixed[starts[2] + AXIS * n[2] + p % n[2]]
    return ti.Vector([x, y, z])


@ti.func
def gather_value(head: ti.template(), ints: ti.template(), fixed: ti.template(), a: ti.template(), at, p):
    """A nodal vector field, component c of node i at ``at + c I + i``, at point p."""
    n, m, starts = points_per_axis(head), nodes_per_axis(head), axis_starts(head)
    nodes = product(m)
    x, y, z = p // (n[1] * n[2]), (p // n[2]) % n[1], p % n[2]
    firsts = head[FIRSTS]
    i0, j0 = ints[firsts + x // 2], ints[firsts + (n[0] + y) // 2]
    k0 = ints[firsts + (n[0] + n[1] + z) // 2]
    zero = fixed[AXES] * 0
    u = ti.Vector([zero, zero, zero])
    for i in range(3):
        for j in range(3):
            line = at + ((i0 + i) * m[1] + j0 + j) * m[2] + k0
            flat = fixed[starts[0] + AXIS * x + i] * fixed[starts[1] + AXIS * y + j]
            for k in range(3):
                weight = flat * fixed[starts[2] + AXIS * z + k]
                for c in ti.static(range(3)):
                    u[c] += weight * a[line + c * nodes + k]
    return u


@ti.func
def state_length(head: ti.template()):
    """Numbers in the state of a simulation of the total-Lagrangian form."""
    return 6 * product(nodes_per_axis(head)) + head[HISTORIES] * product(points_per_axis(head))
