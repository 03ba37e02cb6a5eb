"""Sums over the fixed stencil of the total-Lagrangian lattice: from nodes to points, and from points to nodes.

A cell has 2 x 2 x 2 points and touches 3 x 3 x 3 nodes, its own lowest and two more along each axis, with the weights
of a quadratic B-spline that is a polynomial within the cell. The cells are dealt out in tiles of 256 points. A block of
threads on a GPU, or a loop on a CPU, takes a tile at a time: it copies the tile's nodes to a ``pad`` of its own, finds
what each point hands to the nodes, and sums that within the pad, axis by axis: over lines along z, over the sheets of
such lines along y, and along x to the nodes. Each node then adds up the shares of the tiles that it belongs to. Every
sum is taken in a fixed order, and nothing is added by two threads at once.

``head`` is the beginning of ``ints``, which a block keeps at hand; ``ints`` and ``fixed`` are the buffers of
``layout``. On a GPU the pad is the block's shared memory and begins at 0, on a CPU a part of a buffer. What the threads
of a block do is written as a loop over those from ``q0`` to ``q1``: one on a GPU, all on a CPU.
"""

import taichi as ti

from torchsoro.simulation.kernels.layout import (
    ARRIVED,
    AXES,
    AXIS,
    CHAMBER_START,
    CHAMBERS,
    FIRSTS,
    HEAD,
    MX,
    MY,
    MZ,
    NX,
    NY,
    NZ,
    PAD_AXES,
    PAD_LINES,
    PAD_NODES,
    SHARED,
    SLOT,
    STEP_SIZE,
    SWEPT,
    TILE,
    TILE_CELLS,
    TILE_LINES,
    TILE_NODES,
    TILE_SHEETS,
    TILE_Y,
    TILE_Z,
    TILES,
    TX,
    TY,
    TZ,
)

# Points of a tile along x, y, z.
WIDE, DEEP, HIGH = (2 * n for n in TILE_CELLS)
# Where parts of a chamber's sum lie in the pad: after the bundles that go with slopes; likewise of one over tiles.
ALONE = 9 * TILE
PARTS = 16
TOTALS = TILE + PARTS


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


# ----------------------------------------------------------------------------------------------------- blocks and tiles


@ti.func
def sync(gpu: ti.template()):
    """Wait for the other threads of the block."""
    if ti.static(gpu):
        ti.simt.block.sync()


@ti.func
def thread(gpu: ti.template(), head: ti.template(), each):
    """Number of a thread, read anew: else what follows from it would be kept, in slow memory, from the start."""
    q = each
    if ti.static(gpu):
        q += head[HEAD]  # 0
    return q


@ti.func
def meet(ints: ti.template(), arrivals, q):
    """Wait for the other blocks, all of which must run at the same time, until so many have arrived in all."""
    ti.simt.block.sync()
    if q == 0:
        ti.simt.grid.memfence()
        ti.atomic_add(ints[ARRIVED], 1)
        while ti.atomic_max(ints[ARRIVED], 0) < arrivals:  # a plain load may come from a cache
            pass
        ti.simt.grid.memfence()
    ti.simt.block.sync()


@ti.func
def tile_count(head: ti.template()):
    """Tiles of a simulation."""
    return head[TX] * head[TY] * head[TZ]


@ti.func
def node_chunks(head: ti.template()):
    """Blocks of threads that the nodes of a simulation take."""
    return (product(nodes_per_axis(head)) + TILE - 1) // TILE


@ti.func
def chamber_slots(head: ti.template(), ints: ti.template()):
    """Pairs of a tile and a chamber that has points in it, of a simulation."""
    return ints[head[CHAMBER_START] + head[CHAMBERS]]


@ti.func
def tile_box(head: ti.template(), ints: ti.template(), tile):
    """The lowest cell of a tile, its cells along x, y, z, and its lowest node."""
    x, y, z = tile // (head[TY] * head[TZ]), (tile // head[TZ]) % head[TY], tile % head[TZ]
    ax, ay, az = (
        head[TILES] + 3 * x,
        head[TILES] + 3 * (head[TX] + y),
        head[TILES] + 3 * (head[TX] + head[TY] + z),
    )
    cell = ti.Vector([ints[ax], ints[ay], ints[az]])
    cells = ti.Vector([ints[ax + 1], ints[ay + 1], ints[az + 1]])
    return cell, cells, ti.Vector([ints[ax + 2], ints[ay + 2], ints[az + 2]])


@ti.func
def point_place(cell, q):
    """Number, along each axis, of the tile's point q."""
    x, y, z = q // ti.static(DEEP * HIGH), (q // HIGH) % DEEP, q % HIGH
    return ti.Vector([2 * cell[0] + x, 2 * cell[1] + y, 2 * cell[2] + z])


@ti.func
def point_of(head: ti.template(), cell, cells, q):
    """The point that thread q works on; -1 if the tile has fewer."""
    at = point_place(cell, q) - 2 * cell
    p = ti.cast(-1, ti.i32)
    if at[0] < 2 * cells[0] and at[1] < 2 * cells[1] and at[2] < 2 * cells[2]:
        p = ((2 * cell[0] + at[0]) * head[NY] + 2 * cell[1] + at[1]) * head[NZ] + 2 * cell[2] + at[2]
    return p


@ti.func
def field_start(base, number: ti.template()):
    """Where a staged field begins in the pad."""
    return base + ti.static(PAD_LINES if number == 2 else PAD_NODES + number * SLOT)


@ti.func
def stage(
    gpu: ti.template(),
    head: ti.template(),
    a: ti.template(),
    at,
    pad: ti.template(),
    base,
    number: ti.template(),
    node,
    q0,
    q1,
):
    """Copy a vector field at the nodes of a tile to the pad, as its field of that number."""
    m = nodes_per_axis(head)
    nodes = product(m)
    for each in range(q0, q1):
        q = thread(gpu, head, each)
        for part in ti.static(range((SLOT + TILE - 1) // TILE)):
            one = q + part * TILE
            if one < SLOT:
                c, i = one // TILE_NODES, one % TILE_NODES
                # A tile with fewer cells than usual reads some nodes in vain.
                x = ti.min(node[0] + i // ti.static(TILE_Y * TILE_Z), m[0] - 1)
                y = ti.min(node[1] + i // TILE_Z % TILE_Y, m[1] - 1)
                z = ti.min(node[2] + i % TILE_Z, m[2] - 1)
                pad[field_start(base, number) + one] = a[at + c * nodes + (x * m[1] + y) * m[2] + z]


@ti.func
def stage_axes(
    gpu: ti.template(),
    head: ti.template(),
    fixed: ti.template(),
    pad: ti.template(),
    base,
    cell,
    cells,
    q0,
    q1,
):
    """Copy weights and slopes of a tile's points along the axes to the pad; zeros for cells that it has not."""
    starts = axis_starts(head)
    for each in range(q0, q1):
        q = thread(gpu, head, each)
        if q < ti.static(AXIS * (WIDE + DEEP + HIGH)):
            p, start, first, count = q // AXIS, starts[0], cell[0], cells[0]
            if p >= ti.static(WIDE + DEEP):
                p, start, first, count = p - ti.static(WIDE + DEEP), starts[2], cell[2], cells[2]
            elif p >= WIDE:
                p, start, first, count = p - WIDE, starts[1], cell[1], cells[1]
            number = fixed[STEP_SIZE] * 0
            if p < 2 * count:
                number = fixed[start + AXIS * (2 * first + p) + q % AXIS]
            pad[base + PAD_AXES + q] = number


@ti.func
def point_axes(base, q):
    """Where the weights of the tile's point q along the axes begin, and that of its cell's lowest node in a field."""
    x, y, z = q // ti.static(DEEP * HIGH), (q // HIGH) % DEEP, q % HIGH
    at = base + PAD_AXES
    axes = ti.Vector([at + AXIS * x, at + AXIS * (WIDE + y), at + AXIS * (WIDE + DEEP + z)])
    return axes, ((x // 2) * TILE_Y + y // 2) * TILE_Z + z // 2


@ti.func
def tile_gradient(pad: ti.template(), base, number: ti.template(), q):
    """Gradient of a staged field by the reference place at the tile's point q."""
    axes, corner = point_axes(base, q)
    corner += field_start(base, number)
    wy = ti.Vector([pad[axes[1] + k] for k in ti.static(range(3))])
    sy = ti.Vector([pad[axes[1] + 3 + k] for k in ti.static(range(3))])
    w = ti.Vector([pad[axes[2] + k] for k in ti.static(range(3))])
    s = ti.Vector([pad[axes[2] + 3 + k] for k in ti.static(range(3))])
    zero = w[0] * 0
    G = ti.Matrix([[zero, zero, zero], [zero, zero, zero], [zero, zero, zero]])
    for i in range(3):
        wx, sx = pad[axes[0] + i], pad[axes[0] + 3 + i]
        for j in ti.static(range(3)):
            line = corner + (i * TILE_Y + j) * TILE_Z
            for c in ti.static(range(3)):
                place = line + c * TILE_NODES
                a0, a1, a2 = pad[place], pad[place + 1], pad[place + 2]
                value = w[0] * a0 + w[1] * a1 + w[2] * a2
                G[c, 0] += sx * wy[j] * value
                G[c, 1] += wx * sy[j] * value
                G[c, 2] += wx * wy[j] * (s[0] * a0 + s[1] * a1 + s[2] * a2)
    return G


@ti.func
def tile_value(pad: ti.template(), base, number: ti.template(), q):
    """A staged field at the tile's point q."""
    axes, corner = point_axes(base, q)
    corner += field_start(base, number)
    zero = pad[axes[0]] * 0
    u = ti.Vector([zero, zero, zero])
    for i in range(3):
        for j in range(3):
            for k in range(3):
                weight = pad[axes[0] + i] * pad[axes[1] + j] * pad[axes[2] + k]
                for c in ti.static(range(3)):
                    u[c] += weight * pad[corner + c * TILE_NODES + (i * TILE_Y + j) * TILE_Z + k]
    return u


@ti.func
def hand_over(pad: ti.template(), base, q, m):
    """Write the tensor that the tile's point q hands to the nodes."""
    for i, j in ti.static(ti.ndrange(3, 3)):
        pad[base + (3 * i + j) * TILE + q] = m[i, j]


@ti.func
def hand_over_vector(pad: ti.template(), base, q, v):
    """Write the vector that goes with it."""
    for i in ti.static(range(3)):
        pad[base + (9 + i) * TILE + q] = v[i]


@ti.func
def neighbour_point(pad: ti.template(), axis, most: ti.template(), node, k, odd):
    """Of the k-th cell back from a node of a tile, point ``odd``: its number within the tile; weight and slope.

    ``axis`` is where the tile's weights along an axis begin, ``most`` how many cells a tile has along it.
    """
    cell = node - k
    inside = cell >= 0 and cell < most
    # Elsewhere, a point that is there is read for nothing, so that loads need not wait for branches.
    p = ti.select(inside, 2 * cell + odd, 0)
    w, s = pad[axis + AXIS * p + k], pad[axis + AXIS * p + 3 + k]
    return p, ti.select(inside, w, w * 0), ti.select(inside, s, s * 0)


@ti.func
def sum_tile(
    gpu: ti.template(),
    vectors: ti.template(),
    head: ti.template(),
    pad: ti.template(),
    base,
    with_vector,
    out: ti.template(),
    out_at,
    alone: ti.template(),
    alone_at,
    q0,
    q1,
):
    """Sum what the points of a tile hand to its nodes: tensors, and vectors too if ``with_vector``.

    Without vectors, each point hands over a number alone in their place, and these are summed, too, unless ``alone_at``
    is negative.
    """
    axis_x = base + PAD_AXES
    axis_y, axis_z = axis_x + AXIS * WIDE, axis_x + AXIS * (WIDE + DEEP)
    for each in range(q0, q1):
        q = thread(gpu, head, each)
        if q < TILE_LINES:
            node, column = q % TILE_Z, base + q // TILE_Z * HIGH
            zero = pad[axis_x] * 0
            along_x = ti.Vector([zero, zero, zero])
            along_y = ti.Vector([zero, zero, zero])
            along_z = ti.Vector([zero, zero, zero])
            for k in ti.static(range(3)):
                for odd in ti.static(range(2)):
                    p, w, s = neighbour_point(pad, axis_z, TILE_CELLS[2], node, k, odd)
                    for c in ti.static(range(3)):
                        along_x[c] += w * pad[column + p + (3 * c) * TILE]
                        along_y[c] += w * pad[column + p + (3 * c + 1) * TILE]
                        along_z[c] += s * pad[column + p + (3 * c + 2) * TILE]
                    if ti.static(vectors):
                        if with_vector == 1:
                            for c in ti.static(range(3)):
                                along_z[c] += w * pad[column + p + (9 + c) * TILE]
            for c in ti.static(range(3)):
                pad[base + PAD_LINES + c * TILE_LINES + q] = along_x[c]
                pad[base + PAD_LINES + (3 + c) * TILE_LINES + q] = along_y[c]
                pad[base + PAD_LINES + (6 + c) * TILE_LINES + q] = along_z[c]
        elif with_vector == 0 and alone_at >= 0:
            one = q - TILE_LINES
            total = pad[base + ALONE + 4 * one]
            for m in ti.static(range(1, 4)):
                total += pad[base + ALONE + 4 * one + m]
            pad[base + ALONE + TILE + one] = total
    sync(gpu)
    for each in range(q0, q1):
        q = thread(gpu, head, each)
        if q < TILE_SHEETS:
            iz, iy, px = q % TILE_Z, q // TILE_Z % TILE_Y, q // ti.static(TILE_Y * TILE_Z)
            zero = pad[axis_x] * 0
            slope = ti.Vector([zero, zero, zero])
            flat = ti.Vector([zero, zero, zero])
            for k in ti.static(range(3)):
                for odd in ti.static(range(2)):
                    p, w, s = neighbour_point(pad, axis_y, TILE_CELLS[1], iy, k, odd)
                    at = base + PAD_LINES + (px * DEEP + p) * TILE_Z + iz
                    for c in ti.static(range(3)):
                        slope[c] += w * pad[at + c * TILE_LINES]
                        flat[c] += s * pad[at + (3 + c) * TILE_LINES] + w * pad[at + (6 + c) * TILE_LINES]
            for c in ti.static(range(3)):
                pad[base + c * TILE_SHEETS + q] = slope[c]
                pad[base + (3 + c) * TILE_SHEETS + q] = flat[c]
        elif q < TILE_SHEETS + 8 and with_vector == 0 and alone_at >= 0:
            one = q - TILE_SHEETS
            total = pad[base + ALONE + TILE + 8 * one]
            for m in ti.static(range(1, 8)):
                total += pad[base + ALONE + TILE + 8 * one + m]
            pad[base + ALONE + 2 * TILE + one] = total
    sync(gpu)
    for each in range(q0, q1):
        q = thread(gpu, head, each)
        if q < TILE_NODES:
            rest, ix = q % ti.static(TILE_Y * TILE_Z), q // ti.static(TILE_Y * TILE_Z)
            zero = pad[axis_x] * 0
            total = ti.Vector([zero, zero, zero])
            for k in ti.static(range(3)):
                for odd in ti.static(range(2)):
                    p, w, s = neighbour_point(pad, axis_x, TILE_CELLS[0], ix, k, odd)
                    at = base + p * ti.static(TILE_Y * TILE_Z) + rest
                    for c in ti.static(range(3)):
                        total[c] += s * pad[at + c * TILE_SHEETS] + w * pad[at + (3 + c) * TILE_SHEETS]
            for c in ti.static(range(3)):
                out[out_at + c * TILE_NODES + q] = total[c]
        elif q == TILE_NODES and with_vector == 0 and alone_at >= 0:
            total = pad[base + ALONE + 2 * TILE]
            for m in ti.static(range(1, 8)):
                total += pad[base + ALONE + 2 * TILE + m]
            alone[alone_at] = total
    sync(gpu)


@ti.func
def sum_tiles(fixed: ti.template(), ints: ti.template(), a: ti.template(), at, sources, i, nodes):
    """Sum at node i the shares of tiles; ``sources`` is where the table begins that says where these lie."""
    zero = fixed[AXES] * 0
    total = ti.Vector([zero, zero, zero])
    for n in ti.static(range(SHARED)):
        source = ints[sources + n * nodes + i]
        place = at + ti.max(source, 0)
        for c in ti.static(range(3)):
            share = a[place + c * TILE_NODES]
            total[c] += ti.select(source >= 0, share, zero)
    return total


@ti.func
def sum_chambers(
    gpu: ti.template(),
    head: ti.template(),
    ints: ti.template(),
    fixed: ti.template(),
    scratch: ti.template(),
    pad: ti.template(),
    base,
    b,
    q0,
    q1,
):
    """Sum what the tiles of each chamber of simulation b hand over alone: at TOTALS of the pad, number by number."""
    chambers, start = head[CHAMBERS], head[CHAMBER_START]
    for k in range(chambers):
        first, last = ints[start + k], ints[start + k + 1]
        swept = head[SWEPT] + b * ints[start + chambers]
        for each in range(q0, q1):
            q = thread(gpu, head, each)
            total = fixed[AXES] * 0
            one = first + q
            while one < last:
                total += scratch[swept + one]
                one += TILE
            pad[base + q] = total
        sync(gpu)
        for each in range(q0, q1):
            q = thread(gpu, head, each)
            if q < PARTS:
                total = pad[base + q]
                for m in ti.static(range(1, TILE // PARTS)):
                    total += pad[base + m * PARTS + q]
                pad[base + TILE + q] = total
        sync(gpu)
        for each in range(q0, q1):
            q = thread(gpu, head, each)
            if q == 0:
                total = pad[base + TILE]
                for m in ti.static(range(1, PARTS)):
                    total += pad[base + TILE + m]
                pad[base + TOTALS + k] = total
        sync(gpu)
