"""Sums over the fixed stencil of the total-Lagrangian lattice: from nodes to points, and from points to nodes.

A cell has 2 x 2 x 2 points and touches 3 x 3 x 3 nodes, its own lowest and two more along each axis, with the weights
of a quadratic B-spline that is a polynomial within the cell. Every sum is taken by whoever needs it, in a fixed order,
so that nothing is added by two threads at once. Points to nodes goes axis by axis: over lines along z, over the sheets
of such lines along y, and along x to the node.

``ints`` and ``fixed`` are the buffers of ``layout``; ``n`` is (nx, ny, nz), points per axis.
"""

import taichi as ti

from torchsoro.simulation.kernels.layout import (
    AREA,
    AREA_LINES,
    AREA_SHEETS,
    BATCH,
    BUNDLE,
    CHAMBER_GROUPS,
    CHAMBER_PARTS,
    CHAMBERS,
    FILLED,
    GROUP_SUM,
    LINE,
    LINE_SUM,
    NEAR_LINES,
    NEAR_SHEETS,
    NX,
    NY,
    NZ,
    PART_SUM,
    POINT_CORNER,
    POINT_SUM,
    SHEET,
    SHEET_SUM,
    SLOPE,
    SWEPT,
    WEIGHT,
)


@ti.func
def points_per_axis(ints: ti.template()):
    """(nx, ny, nz)."""
    return ti.Vector([ints[NX], ints[NY], ints[NZ]])


@ti.func
def nodes_per_axis(n):
    """Nodes along x, y, z."""
    return ti.Vector([n[0] // 2 + 2, n[1] // 2 + 2, n[2] // 2 + 2])


@ti.func
def product(v):
    """Of the three components."""
    return v[0] * v[1] * v[2]


@ti.func
def line_count(n):
    """Sums along z."""
    return n[0] * n[1] * (n[2] // 2 + 2)


@ti.func
def sheet_count(n):
    """Sums along z and y."""
    return n[0] * (n[1] // 2 + 2) * (n[2] // 2 + 2)


@ti.func
def corner_of(ints: ti.template(), at, p):
    """Lowest node of the cell of point p in a field at ``at``, and where the weights of this point begin along x, y, z.

    Both are looked up: divisions are slow.
    """
    code = ints[ints[POINT_CORNER] + p]
    return at + code // 8, 3 * (code // 4 % 2), 3 * (code // 2 % 2), 3 * (code % 2)


@ti.func
def gather_gradient(ints: ti.template(), fixed: ti.template(), a: ti.template(), at, p, n):
    """Gradient of a nodal vector field by the reference place at point p; component c of node i is at + c I + i."""
    m = nodes_per_axis(n)
    nodes = product(m)
    corner, ox, oy, oz = corner_of(ints, at, p)
    w = ti.Vector([fixed[WEIGHT + oz + k] for k in ti.static(range(3))])
    s = ti.Vector([fixed[SLOPE + oz + k] for k in ti.static(range(3))])
    zero = w[0] * 0
    G = ti.Matrix([[zero, zero, zero], [zero, zero, zero], [zero, zero, zero]])
    for i in range(3):
        wx, sx = fixed[WEIGHT + ox + i], fixed[SLOPE + ox + i]
        for j in ti.static(range(3)):
            wy, sy = fixed[WEIGHT + oy + j], fixed[SLOPE + oy + j]
            line = corner + (i * m[1] + j) * m[2]
            for c in ti.static(range(3)):
                a0, a1, a2 = a[line + c * nodes], a[line + c * nodes + 1], a[line + c * nodes + 2]
                value = w[0] * a0 + w[1] * a1 + w[2] * a2
                G[c, 0] += sx * wy * value
                G[c, 1] += wx * sy * value
                G[c, 2] += wx * wy * (s[0] * a0 + s[1] * a1 + s[2] * a2)
    return G


@ti.func
def gather_value(ints: ti.template(), fixed: ti.template(), a: ti.template(), at, p, n):
    """A nodal vector field at point p."""
    m = nodes_per_axis(n)
    nodes = product(m)
    corner, ox, oy, oz = corner_of(ints, at, p)
    zero = fixed[WEIGHT] * 0
    u = ti.Vector([zero, zero, zero])
    for i in range(3):
        for j in range(3):
            line = corner + (i * m[1] + j) * m[2]
            for k in range(3):
                weight = fixed[WEIGHT + ox + i] * fixed[WEIGHT + oy + j] * fixed[WEIGHT + oz + k]
                for c in ti.static(range(3)):
                    u[c] += weight * a[line + c * nodes + k]
    return u


@ti.func
def neighbour_cell(fixed: ti.template(), node, k, odd, points):
    """The point, along an axis, ``odd`` of the k-th cell back from a node; its weight and slope, 0 outside the body."""
    cell = node - k
    inside = cell >= 0 and 2 * cell < points
    w, s = fixed[WEIGHT + 3 * odd + k], fixed[SLOPE + 3 * odd + k]
    # Outside, a point that is there is read for nothing, so that loads need not wait for branches.
    p = ti.select(inside, 2 * cell + odd, 0)
    return p, ti.select(inside, w, w * 0), ti.select(inside, s, s * 0)


@ti.func
def sum_line(
    fixed: ti.template(), a: ti.template(), points_at, out: ti.template(), lines_at, line, n, vectors: ti.template()
):
    """Sum what the points with the same x and y hand to one node along z: tensors, and vectors if there are any."""
    nodes_z = n[2] // 2 + 2
    iz = line % nodes_z
    column = points_at + line // nodes_z * n[2]
    points = product(n)
    zero = fixed[WEIGHT] * 0
    along_x = ti.Vector([zero, zero, zero])
    along_y = ti.Vector([zero, zero, zero])
    along_z = ti.Vector([zero, zero, zero])
    for k in range(3):
        for odd in ti.static(range(2)):
            pz, w, s = neighbour_cell(fixed, iz, k, odd, n[2])
            for c in ti.static(range(3)):
                along_x[c] += w * a[column + pz + (3 * c) * points]
                along_y[c] += w * a[column + pz + (3 * c + 1) * points]
                along_z[c] += s * a[column + pz + (3 * c + 2) * points]
                if ti.static(vectors):
                    along_z[c] += w * a[column + pz + (9 + c) * points]
    count = line_count(n)
    for c in ti.static(range(3)):
        out[lines_at + c * count + line] = along_x[c]
        out[lines_at + (3 + c) * count + line] = along_y[c]
        out[lines_at + (6 + c) * count + line] = along_z[c]


@ti.func
def sum_sheet(fixed: ti.template(), a: ti.template(), lines_at, sheets_at, sheet, n):
    """Sum the lines with the same x and z that one node along y needs."""
    m = nodes_per_axis(n)
    iz, iy, px = sheet % m[2], sheet // m[2] % m[1], sheet // (m[1] * m[2])
    count, lines = sheet_count(n), line_count(n)
    zero = fixed[WEIGHT] * 0
    slope = ti.Vector([zero, zero, zero])
    flat = ti.Vector([zero, zero, zero])
    for j in range(3):
        for odd in ti.static(range(2)):
            py, w, s = neighbour_cell(fixed, iy, j, odd, n[1])
            at = lines_at + (px * n[1] + py) * m[2] + iz
            for c in ti.static(range(3)):
                slope[c] += w * a[at + c * lines]
                flat[c] += s * a[at + (3 + c) * lines] + w * a[at + (6 + c) * lines]
    for c in ti.static(range(3)):
        a[sheets_at + c * count + sheet] = slope[c]
        a[sheets_at + (3 + c) * count + sheet] = flat[c]


@ti.func
def sum_node(fixed: ti.template(), a: ti.template(), sheets_at, i, n):
    """Sum the sheets around node i: sum_p bundle_p (grad N_i, N_i)."""
    m = nodes_per_axis(n)
    layer = m[1] * m[2]
    ix, rest = i // layer, i % layer
    count = sheet_count(n)
    zero = fixed[WEIGHT] * 0
    total = ti.Vector([zero, zero, zero])
    for k in ti.static(range(3)):
        for odd in ti.static(range(2)):
            px, w, s = neighbour_cell(fixed, ix, k, odd, n[0])
            at = sheets_at + px * layer + rest
            for c in ti.static(range(3)):
                total[c] += s * a[at + c * count] + w * a[at + (3 + c) * count]
    return total


@ti.func
def line_tasks(ints: ti.template(), n):
    """Threads of :func:`sum_lines`."""
    return ints[BATCH] * ((1 + ints[CHAMBERS]) * line_count(n) + CHAMBER_PARTS * ints[CHAMBERS])


@ti.func
def sum_lines(ints: ti.template(), fixed: ti.template(), scratch: ti.template(), w, n, vectors: ti.template()):
    """What thread w of the pass over lines does: a line, a line of a chamber's area, or a part of a chamber's sum.

    What the points of each chamber hand on is summed apart, since the pressure is not known before their volume is.
    """
    points, count, chambers = product(n), line_count(n), ints[CHAMBERS]
    each = (1 + chambers) * count + CHAMBER_PARTS * chambers
    b, task = w // each, w % each
    if task < count:
        points_at, lines_at = ints[POINT_SUM] + b * BUNDLE * points, ints[LINE_SUM] + b * LINE * count
        sum_line(fixed, scratch, points_at, scratch, lines_at, task, n, vectors)
    elif task < (1 + chambers) * count:
        k, line = task // count - 1, task % count
        if ints[ints[NEAR_LINES] + k * count + line] == 1:
            one = b * chambers + k
            points_at, lines_at = ints[AREA] + one * BUNDLE * points, ints[AREA_LINES] + one * LINE * count
            sum_line(fixed, scratch, points_at, scratch, lines_at, line, n, False)
    else:
        part = task - (1 + chambers) * count
        k = part // CHAMBER_PARTS
        first, last = ints[ints[FILLED] + k], ints[ints[FILLED] + k + 1]
        share = (last - first + CHAMBER_PARTS - 1) // CHAMBER_PARTS
        first += part % CHAMBER_PARTS * share
        swept = ints[SWEPT] + b * ints[ints[FILLED] + chambers]
        total = fixed[WEIGHT] * 0
        for m in range(first, ti.min(last, first + share)):
            total += scratch[swept + m]
        scratch[ints[PART_SUM] + b * chambers * CHAMBER_PARTS + part] = total


@ti.func
def sheet_tasks(ints: ti.template(), n):
    """Threads of :func:`sum_sheets`."""
    return ints[BATCH] * ((1 + ints[CHAMBERS]) * sheet_count(n) + CHAMBER_GROUPS * ints[CHAMBERS])


@ti.func
def sum_sheets(ints: ti.template(), fixed: ti.template(), scratch: ti.template(), w, n):
    """What thread w of the pass over sheets does: a sheet, one of a chamber's area, or a group of parts."""
    count, lines, chambers = sheet_count(n), line_count(n), ints[CHAMBERS]
    each = (1 + chambers) * count + CHAMBER_GROUPS * chambers
    b, task = w // each, w % each
    if task < count:
        lines_at, sheets_at = ints[LINE_SUM] + b * LINE * lines, ints[SHEET_SUM] + b * SHEET * count
        sum_sheet(fixed, scratch, lines_at, sheets_at, task, n)
    elif task < (1 + chambers) * count:
        k, sheet = task // count - 1, task % count
        if ints[ints[NEAR_SHEETS] + k * count + sheet] == 1:
            one = b * chambers + k
            lines_at, sheets_at = ints[AREA_LINES] + one * LINE * lines, ints[AREA_SHEETS] + one * SHEET * count
            sum_sheet(fixed, scratch, lines_at, sheets_at, sheet, n)
    else:
        group = b * chambers * CHAMBER_GROUPS + task - (1 + chambers) * count
        parts = ti.static(CHAMBER_PARTS // CHAMBER_GROUPS)
        scratch[ints[GROUP_SUM] + group] = sum_row(scratch, ints[PART_SUM] + group * parts, parts)


@ti.func
def sum_row(a: ti.template(), at, length: ti.template()):
    """Sum of a few numbers in a row."""
    total = a[at]
    for m in ti.static(range(1, length)):
        total += a[at + m]
    return total


@ti.func
def sum_chamber(ints: ti.template(), scratch: ti.template(), one):
    """A sum over chamber number ``one`` (of all simulations)."""
    return sum_row(scratch, ints[GROUP_SUM] + one * CHAMBER_GROUPS, CHAMBER_GROUPS)
