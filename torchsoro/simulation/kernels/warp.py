"""On a GPU: threads of a warp that add to the same nodes sum up among themselves first.

An atomic addition waits for the memory, so that what counts is how many a thread makes one after the other. Threads
take the particles in the order of their cells: the 32 threads of a warp then hold a few runs of particles with the
same lowest node. They lay their numbers side by side in shared memory, and share out the sums of the runs.

All threads of a warp have to come here together, also those without a particle; those name node -1.
"""

import taichi as ti

WARP = 32
EVERY = 0xFFFFFFFF  # mask of all threads of a warp
PITCH = 13  # numbers that a thread may lay down, odd so that threads meet different memory banks


def shared(gpu: bool, block: int, like):
    """Arrays in the memory that a block of threads shares: the pool for numbers, of the kind of ``like``, and marks.

    To be called from a kernel within ``ti.static``; on a CPU something to hand on instead.
    """
    if not gpu:
        return like, like
    kind = like.get_type().element_type
    return ti.simt.block.SharedArray((block * PITCH,), kind), ti.simt.block.SharedArray((block * 2,), ti.i32)


@ti.func
def find_runs(marks: ti.template(), slot, node):
    """Cut a warp into runs of threads with the same node, and mark down each run's first thread and node.

    ``slot`` is the thread's number in the block. Returns the number of runs.
    """
    lane = slot % WARP
    mask = ti.u32(EVERY)
    # No branch here: a compiler may copy a call into both of its arms, where the threads no longer meet.
    head = ti.select((ti.simt.warp.shfl_up_i32(mask, node, 1) != node) | (lane == 0), 1, 0)
    rank = head
    for power in ti.static(range(5)):
        rank += ti.select(lane >= 2**power, ti.simt.warp.shfl_up_i32(mask, rank, 2**power), 0)
    # A warp may still read the marks of what it added before.
    ti.simt.warp.sync(mask)
    if head == 1:
        at = 2 * (slot - lane + rank - 1)
        marks[at] = slot
        marks[at + 1] = node
    ti.simt.warp.sync(mask)
    return ti.simt.warp.shfl_sync_i32(mask, rank, WARP - 1)


@ti.func
def add_runs(
    pool: ti.template(),
    marks: ti.template(),
    slot,
    runs,
    width: ti.template(),
    size: ti.template(),
    grid: ti.template(),
    grid_at,
):
    """Sum over each run what its threads laid down for three nodes in a row, and add that to the grid.

    ``width`` numbers for each node, which holds ``size`` of them; the run's first node counts from ``grid_at``.
    """
    lane = slot % WARP
    columns = ti.static(3 * width)
    mask = ti.u32(EVERY)
    ti.simt.warp.sync(mask)
    for turn in range((runs * columns + WARP - 1) // WARP):
        job = turn * WARP + lane
        run = job // columns
        if run < runs:
            column = job - run * columns
            mark = 2 * (slot - lane + run)
            stop = slot - lane + WARP
            if run + 1 < runs:
                stop = marks[mark + 2]
            node = marks[mark + 1]
            if node >= 0:
                start = marks[mark]
                total = pool[start * PITCH + column]
                for other in range(start + 1, stop):
                    total += pool[other * PITCH + column]
                knot = column // width
                ti.atomic_add(grid[grid_at + (node + knot) * size + column - knot * width], total)
    ti.simt.warp.sync(mask)


@ti.func
def lay(gpu: ti.template(), pool: ti.template(), slot, column, grid: ti.template(), at, value):
    """Lay a number down for :func:`add_runs`; on a CPU, where a lane owns its grid, add it at once."""
    if ti.static(gpu):
        pool[slot * PITCH + column] = value
    else:
        grid[at] = grid[at] + value
