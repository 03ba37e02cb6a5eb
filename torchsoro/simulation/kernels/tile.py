"""Sums over the fixed stencil of the total-Lagrangian lattice: from nodes to points, and from points to nodes.

A cell has 2 x 2 x 2 points and touches 3 x 3 x 3 nodes, its own lowest and two more along each axis, with the weights
of a quadratic B-spline that is a polynomial within the cell. The cells are dealt out in tiles of 256 points. A block of
threads on a GPU, or a loop on a CPU, takes a tile at a time: it copies the tile's nodes to a ``pad`` of its own, finds
what each point hands to the nodes, and sums that within the pad, axis by axis: over lines along z, over the sheets of
such lines along y, and along x to the nodes. Each node then adds up the shares of the tiles that it belongs to. Every
sum is taken in a fixed order, and nothing is added by two threads at once.

On a GPU the pad is the block's shared memory and begins at 0, on a CPU a part of a buffer. What the threads
of a block do is written as a loop over those from ``q0`` to ``q1``: one on a GPU, all on a CPU.
"""

from typing import Any, NamedTuple

import taichi as ti

from torchsoro.simulation.kernels.lattice import nodes_per_axis, product
from torchsoro.simulation.kernels.layout import (
    ARRIVED,
    AXES,
    AXIS,
    CHAMBER_START,
    CHAMBERS,
    HEAD,
    LOADED,
    NY,
    NZ,
    PAD_AXIS,
    PAD_LINES,
    SHAPES,
    SHARED,
    SLOT_START,
    STEP_SIZE,
    TILE,
    TILE_AXES,
    TILES,
    TX,
    TY,
    TZ,
    Shape,
)

ALONE = 9 * TILE  # where parts of a chamber's sum lie in the pad: after the bundles that go with slopes
# Integers that a block keeps at hand: the head, a zero, and those of a tile.
KEPT = HEAD + 14
# A power of two above all places in a pad.
ROOM = 2 ** max(shape.pad for shape in SHAPES).bit_length()


class Block(NamedTuple):
    """What a block of threads works with, for functions that are told at compile time; see ``layout`` for the buffers.

    Functions name what they use of it by ``ti.static`` of a tuple: outside of one it refuses shared memory.

    Attributes:
        gpu: Whether threads are those of a GPU, from ``q0`` to before ``q1``: one each; else a loop runs over all.
        features: What the kernel is compiled for.
        tile: Shape of a tile.
        head: Beginning of ``ints``, at hand.
        pad: Where the block works, from ``base`` on.
    """

    gpu: bool
    features: int
    tile: Shape
    head: Any
    pad: Any
    base: Any
    q0: Any
    q1: Any
    ints: Any
    fixed: Any
    supply: Any
    state: Any
    kept: Any
    scratch: Any
    bar: Any = None
    back: Any = None
    sums: Any = None


def on_cpu(features, shape, base, ints, *buffers):
    """The block of an iteration of a parallel loop on a CPU, whose pad begins at ``base`` of ``scratch``."""
    return Block(False, features, SHAPES[shape], ints, buffers[4], base, 0, TILE, ints, *buffers)


def on_gpu(features, shape, head, pad, q, *buffers):
    """The block of a thread on a GPU."""
    return Block(True, features, SHAPES[shape], head, pad, 0, q, q + 1, *buffers)


@ti.func
def sync(gpu: ti.template()):
    """Wait for the other threads of the block."""
    if ti.static(gpu):
        ti.simt.block.sync()


@ti.func
def thread(block: ti.template(), each):
    """Number of a thread, read anew: else what follows from it would be kept, in slow memory, from the start."""
    q = each
    if ti.static(block.gpu):
        q += block.head[HEAD]  # 0
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
def tile_number(head: ti.template(), ints: ti.template(), item, k):
    """One of the numbers of :func:`tile_box`, in its order."""
    b, tile = item // tile_count(head), item % tile_count(head)
    along = tile // (head[TY] * head[TZ])
    if k % 3 == 1:
        along = head[TX] + (tile // head[TZ]) % head[TY]
    elif k % 3 == 2:
        along = head[TX] + head[TY] + tile % head[TZ]
    at = head[TILES] + 3 * along + k // 3
    if k >= 9:
        at = head[SLOT_START] + tile + ti.min(k - 9, 1)
    number = ints[at]
    if k == 11:
        number = b
    elif k == 12:
        number = tile
    return number


@ti.func
def tile_box(block: ti.template(), fresh, item):
    """What is to be known of a tile, number ``item`` of all simulations; a GPU keeps it at hand until ``fresh``.

    Returns:
        Lowest cell and number of cells along x, y, z; lowest node; where its pairs with chambers begin and end; the
        simulation, and the tile's number in it.
    """
    box = ti.Vector([0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0])
    if ti.static(block.gpu):
        if fresh == 1 and block.q0 < 13:
            block.head[HEAD + 1 + block.q0] = tile_number(block.head, block.ints, item, block.q0)
        sync(block.gpu)
        for k in ti.static(range(13)):
            box[k] = block.head[HEAD + 1 + k]
    else:
        for k in ti.static(range(13)):
            box[k] = tile_number(block.head, block.ints, item, k)
    cell, counts = ti.Vector([box[0], box[1], box[2]]), ti.Vector([box[3], box[4], box[5]])
    return cell, counts, ti.Vector([box[6], box[7], box[8]]), box[9], box[10], box[11], box[12]


@ti.func
def number_along(cell, count, at):
    """Along an axis, the number of a tile's point ``at`` among those of the lattice; -1 if the tile has none there."""
    return ti.select(at < 2 * count, 2 * cell + at, -1)


@ti.func
def point_of(block: ti.template(), cell, counts, q):
    """The point that thread q works on; -1 if the tile has none there."""
    deep, high = ti.static((block.tile.deep, block.tile.high))
    x = number_along(cell[0], counts[0], q // ti.static(deep * high))
    y = number_along(cell[1], counts[1], (q // high) % deep)
    z = number_along(cell[2], counts[2], q % high)
    p = ti.cast(-1, ti.i32)
    if x >= 0 and y >= 0 and z >= 0:
        p = (x * block.head[NY] + y) * block.head[NZ] + z
    return p


@ti.func
def field_start(block: ti.template(), number: ti.template()):
    """Where a staged field begins in the pad."""
    return ti.static(PAD_LINES if number == 2 else block.tile.pad_nodes + number * block.tile.slot)


@ti.func
def near(place):
    """A place in the pad, of which the compiler then knows that constants added to it do not overflow."""
    return place & (ROOM - 1)


@ti.func
def stage(block: ti.template(), a: ti.template(), at, number: ti.template(), node):
    """Copy a vector field at the nodes of a tile to the pad, as its field of that number."""
    m = nodes_per_axis(block.head)
    nodes = product(m)
    slot, count, layer, row = ti.static((block.tile.slot, block.tile.count, block.tile.layer, block.tile.nodes[2]))
    for each in range(block.q0, block.q1):
        q = thread(block, each)
        for part in ti.static(range((slot + TILE - 1) // TILE)):
            one = q + part * TILE
            if one < slot:
                c, i = one // count, one % count
                # A tile with fewer cells than usual reads some nodes in vain.
                x = ti.min(node[0] + i // layer, m[0] - 1)
                y = ti.min(node[1] + i // row % ti.static(block.tile.nodes[1]), m[1] - 1)
                z = ti.min(node[2] + i % row, m[2] - 1)
                start = block.base + field_start(block, number)
                block.pad[start + one] = a[at + c * nodes + (x * m[1] + y) * m[2] + z]


@ti.func
def stage_axes(block: ti.template(), tile):
    """Copy what is to be known of a tile's points and nodes along the axes to the pad."""
    (head,) = ti.static((block.head,))
    x, y, z = tile // (head[TY] * head[TZ]), (tile // head[TZ]) % head[TY], tile % head[TZ]
    of_x, of_y, of_z = ti.static((block.tile.along(0), block.tile.along(1), block.tile.along(2)))
    for each in range(block.q0, block.q1):
        q = thread(block, each)
        at = x * of_x
        if q >= of_x:
            at = head[TX] * of_x + y * of_y - of_x
        if q >= ti.static(of_x + of_y):
            at = head[TX] * of_x + head[TY] * of_y + z * of_z - ti.static(of_x + of_y)
        if q < ti.static(of_x + of_y + of_z):
            block.pad[block.base + ti.static(block.tile.axis_at(0)) + q] = block.fixed[head[TILE_AXES] + at + q]


@ti.func
def lowest_node(block: ti.template(), axis: ti.template(), at, along):
    """Along an axis, the number of the lowest node of the cell that a tile's point lies in.

    ``at`` is where what is known of the point begins, ``along`` its number.
    """
    number = along // 2
    if ti.static(block.tile.nodes[axis] > block.tile.cells[axis] + 2):
        number = ti.cast(block.pad[block.base + at + AXIS], ti.i32)
    return number


@ti.func
def point_axes(block: ti.template(), q):
    """Where the weights of the tile's point q along the axes begin, and that of its cell's lowest node in a field."""
    deep, high = ti.static((block.tile.deep, block.tile.high))
    x, y, z = q // ti.static(deep * high), (q // high) % deep, q % high
    fx = near(ti.static(block.tile.axis_at(0)) + PAD_AXIS * x)
    fy = near(ti.static(block.tile.axis_at(1)) + PAD_AXIS * y)
    fz = near(ti.static(block.tile.axis_at(2)) + PAD_AXIS * z)
    i, j, k = lowest_node(block, 0, fx, x), lowest_node(block, 1, fy, y), lowest_node(block, 2, fz, z)
    return fx, fy, fz, (i * ti.static(block.tile.nodes[1]) + j) * ti.static(block.tile.nodes[2]) + k


@ti.func
def tile_gradient(block: ti.template(), number: ti.template(), q):
    """Gradient of a staged field by the reference place at the tile's point q."""
    fx, fy, fz, first = point_axes(block, q)
    corner = near(field_start(block, number) + first)
    count, layer, row = ti.static((block.tile.count, block.tile.layer, block.tile.nodes[2]))
    w = ti.Vector([block.pad[block.base + fz + k] for k in ti.static(range(3))])
    s = ti.Vector([block.pad[block.base + fz + 3 + k] for k in ti.static(range(3))])
    zero = w[0] * 0
    G = ti.Matrix([[zero, zero, zero], [zero, zero, zero], [zero, zero, zero]])
    for i in ti.static(range(3)):
        wx, sx = block.pad[block.base + fx + i], block.pad[block.base + fx + 3 + i]
        for j in ti.static(range(3)):
            wy, sy = block.pad[block.base + fy + j], block.pad[block.base + fy + 3 + j]
            for c in ti.static(range(3)):
                place = block.base + corner + ti.static(c * count + i * layer + j * row)
                a0, a1, a2 = block.pad[place], block.pad[place + 1], block.pad[place + 2]
                value = w[0] * a0 + w[1] * a1 + w[2] * a2
                G[c, 0] += sx * wy * value
                G[c, 1] += wx * sy * value
                G[c, 2] += wx * wy * (s[0] * a0 + s[1] * a1 + s[2] * a2)
    return G


@ti.func
def tile_value(block: ti.template(), number: ti.template(), q):
    """A staged field at the tile's point q."""
    fx, fy, fz, first = point_axes(block, q)
    corner = near(field_start(block, number) + first)
    count, layer, row = ti.static((block.tile.count, block.tile.layer, block.tile.nodes[2]))
    zero = block.pad[block.base + fx] * 0
    u = ti.Vector([zero, zero, zero])
    for i in range(3):
        for j in range(3):
            for k in range(3):
                weight = (
                    block.pad[block.base + fx + i] * block.pad[block.base + fy + j] * block.pad[block.base + fz + k]
                )
                for c in ti.static(range(3)):
                    u[c] += weight * block.pad[block.base + corner + c * count + i * layer + j * row + k]
    return u


@ti.func
def hand_over(block: ti.template(), q, m):
    """Write the tensor that the tile's point q hands to the nodes."""
    for i, j in ti.static(ti.ndrange(3, 3)):
        block.pad[block.base + near(q) + (3 * i + j) * TILE] = m[i, j]


@ti.func
def hand_over_vector(block: ti.template(), q, v):
    """Write the vector that goes with it."""
    for i in ti.static(range(3)):
        block.pad[block.base + near(q) + (9 + i) * TILE] = v[i]


@ti.func
def neighbour_point(block: ti.template(), axis: ti.template(), node, k, odd):
    """Of the cell whose k-th node along an axis a tile's node is, point ``odd``: its number; weight and slope."""
    cells, nodes = ti.static((block.tile.cells[axis], block.tile.nodes[axis]))
    cell = node - k
    if ti.static(nodes > cells + 2):
        found = ti.cast(block.pad[block.base + ti.static(block.tile.cells_at(axis)) + ti.max(cell, 0)], ti.i32)
        cell = ti.select(cell >= 0, found, -1)
    inside = cell >= 0 and cell < cells
    # Elsewhere, a point that is there is read for nothing, so that loads need not wait for branches.
    p = ti.select(inside, 2 * cell + odd, 0)
    at = near(ti.static(block.tile.axis_at(axis)) + PAD_AXIS * p)
    w, s = block.pad[block.base + at + k], block.pad[block.base + at + 3 + k]
    return p, ti.select(inside, w, w * 0), ti.select(inside, s, s * 0)


@ti.func
def sum_tile(block: ti.template(), with_vector, out, alone):
    """Sum what the points of a tile hand to its nodes: tensors, and vectors too if ``with_vector``.

    Without vectors, each point hands over a number alone in their place, and these are summed, too, unless ``alone``
    is negative.
    """
    deep, high, row, across = ti.static((block.tile.deep, block.tile.high, block.tile.nodes[2], block.tile.nodes[1]))
    lines, sheets, count, layer = ti.static((block.tile.lines, block.tile.sheets, block.tile.count, block.tile.layer))
    # Threads from the last on, as a tile seldom fills them, sum what is handed over alone.
    for each in range(block.q0, block.q1):
        q = thread(block, each)
        if q < lines:
            node, column = q % row, q // row * high
            zero = block.fixed[STEP_SIZE] * 0
            along_x = ti.Vector([zero, zero, zero])
            along_y = ti.Vector([zero, zero, zero])
            along_z = ti.Vector([zero, zero, zero])
            for k in ti.static(range(3)):
                for odd in ti.static(range(2)):
                    p, w, s = neighbour_point(block, 2, node, k, odd)
                    at = block.base + near(column + p)
                    for c in ti.static(range(3)):
                        along_x[c] += w * block.pad[at + (3 * c) * TILE]
                        along_y[c] += w * block.pad[at + (3 * c + 1) * TILE]
                        along_z[c] += s * block.pad[at + (3 * c + 2) * TILE]
                    if ti.static(block.features & LOADED):
                        if with_vector == 1:
                            for c in ti.static(range(3)):
                                along_z[c] += w * block.pad[at + (9 + c) * TILE]
            for c in ti.static(range(3)):
                block.pad[block.base + near(q) + ti.static(PAD_LINES + c * lines)] = along_x[c]
                block.pad[block.base + near(q) + ti.static(PAD_LINES + (3 + c) * lines)] = along_y[c]
                block.pad[block.base + near(q) + ti.static(PAD_LINES + (6 + c) * lines)] = along_z[c]
        if with_vector == 0 and alone >= 0 and q >= TILE - TILE // 4:
            one = TILE - 1 - q
            total = block.pad[block.base + ALONE + 4 * one]
            for m in ti.static(range(1, 4)):
                total += block.pad[block.base + ALONE + 4 * one + m]
            block.pad[block.base + ALONE + TILE + one] = total
    sync(block.gpu)
    for each in range(block.q0, block.q1):
        q = thread(block, each)
        if q < sheets:
            iz, iy, px = q % row, q // row % across, q // layer
            zero = block.fixed[STEP_SIZE] * 0
            slope = ti.Vector([zero, zero, zero])
            flat = ti.Vector([zero, zero, zero])
            for k in ti.static(range(3)):
                for odd in ti.static(range(2)):
                    p, w, s = neighbour_point(block, 1, iy, k, odd)
                    at = block.base + near(PAD_LINES + (px * deep + p) * row + iz)
                    for c in ti.static(range(3)):
                        slope[c] += w * block.pad[at + c * lines]
                        flat[c] += s * block.pad[at + (3 + c) * lines] + w * block.pad[at + (6 + c) * lines]
            for c in ti.static(range(3)):
                block.pad[block.base + near(q) + c * sheets] = slope[c]
                block.pad[block.base + near(q) + (3 + c) * sheets] = flat[c]
        if with_vector == 0 and alone >= 0 and q >= TILE - 8:
            one = TILE - 1 - q
            total = block.pad[block.base + ALONE + TILE + 8 * one]
            for m in ti.static(range(1, 8)):
                total += block.pad[block.base + ALONE + TILE + 8 * one + m]
            block.pad[block.base + ALONE + 2 * TILE + one] = total
    sync(block.gpu)
    for each in range(block.q0, block.q1):
        q = thread(block, each)
        if q < count:
            rest, ix = q % layer, q // layer
            zero = block.fixed[STEP_SIZE] * 0
            total = ti.Vector([zero, zero, zero])
            for k in ti.static(range(3)):
                for odd in ti.static(range(2)):
                    p, w, s = neighbour_point(block, 0, ix, k, odd)
                    at = block.base + near(p * layer + rest)
                    for c in ti.static(range(3)):
                        total[c] += s * block.pad[at + c * sheets] + w * block.pad[at + (3 + c) * sheets]
            for c in ti.static(range(3)):
                block.scratch[out + c * count + q] = total[c]
        if with_vector == 0 and alone >= 0 and q == TILE - 1:
            total = block.pad[block.base + ALONE + 2 * TILE]
            for m in ti.static(range(1, 8)):
                total += block.pad[block.base + ALONE + 2 * TILE + m]
            block.scratch[alone] = total
    sync(block.gpu)


@ti.func
def sum_tiles(block: ti.template(), at, sources, i, nodes):
    """Sum at node i the shares of tiles; ``sources`` is where the table begins that says where these lie."""
    zero = block.fixed[AXES] * 0
    total = ti.Vector([zero, zero, zero])
    for n in ti.static(range(SHARED)):
        source = block.ints[sources + n * nodes + i]
        place = at + ti.max(source, 0)
        for c in ti.static(range(3)):
            share = block.scratch[place + c * ti.static(block.tile.count)]
            total[c] += ti.select(source >= 0, share, zero)
    return total
