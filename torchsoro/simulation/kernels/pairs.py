"""Which points are near each other though they were not in the undeformed body, by a cell list; compiled by Numba."""

from __future__ import annotations

import numpy as np

from torchsoro.simulation.kernels.lanes import fast, law

FAR = 2.0**40  # cells from the origin; what is farther has diverged


@law
def bucket(x, y, z, size):
    """Of so many buckets, a power of two, the one of a cell."""
    return (x * 73856093 ^ y * 19349663 ^ z * 83492791) & (size - 1)


@law
def cell_of(places, at, width):
    """Cell in which a place is."""
    x, y, z = places[at] / width, places[at + 1] / width, places[at + 2] / width
    return int(np.floor(x)), int(np.floor(y)), int(np.floor(z))


@fast
def sort_points(places, counts, width, begin, order, of, here):
    """Sort points into buckets by their cell, those that have diverged into none.

    Args:
        places: Of the points, three numbers each.
        counts: Which of them count.
        width: Edge of the cells [m].
        begin: Becomes where each bucket begins in ``order``, and the end of the last; a power of two, and one.
        order: Becomes the points, bucket by bucket in their order.
        of: Room for the bucket of each point.
        here: Becomes the places in this order.
    """
    size = len(begin) - 1
    begin[:] = 0
    for p in range(len(counts)):
        there = counts[p]
        for c in range(3):
            there = there and abs(places[3 * p + c]) < FAR * width
        of[p] = -1
        if there:
            x, y, z = cell_of(places, 3 * p, width)
            of[p] = bucket(x, y, z, size)
            begin[of[p]] += 1
    for h in range(size):
        begin[h + 1] += begin[h]
    for back in range(len(counts)):
        p = len(counts) - 1 - back
        if of[p] >= 0:
            begin[of[p]] -= 1
            order[begin[of[p]]] = p
    for s in range(begin[size]):
        for c in range(3):
            here[3 * s + c] = places[3 * order[s] + c]


@law
def pairs_in(reference, s, first, last, square, apart, order, here, keys, n):
    """Write down which of some sorted points are near one; how many are written down then, or would be."""
    i, count = order[s], len(order)
    for q in range(first, last):
        a, b, c = here[3 * s] - here[3 * q], here[3 * s + 1] - here[3 * q + 1], here[3 * s + 2] - here[3 * q + 2]
        if a * a + b * b + c * c < square:
            j, rest = order[q], 0.0
            for k in range(3):
                gap = reference[3 * i + k] - reference[3 * j + k]
                rest += gap * gap
            if rest > apart:
                if n < len(keys):
                    keys[n] = min(i, j) * count + max(i, j)
                n += 1
    return n


@fast
def find_pairs(reference, width, apart, begin, order, here, keys):
    """Find the pairs of sorted points that are nearer than the width of the cells.

    Args:
        reference: Places of the points in the undeformed body, three numbers each.
        width: Of the cells [m].
        apart: Squared distance there above which two points are a pair [m2].
        begin: As of :func:`sort_points`.
        order: Likewise.
        here: Likewise.
        keys: Becomes the pairs, first point times count plus second point; some may be there twice.

    Returns:
        The number of pairs, which are not all there if it is more than the length of ``keys``.
    """
    n, square, size = 0, width * width, len(begin) - 1
    for s in range(begin[size]):
        x, y, z = cell_of(here, 3 * s, width)
        own = bucket(x, y, z, size)
        n = pairs_in(reference, s, s + 1, begin[own + 1], square, apart, order, here, keys, n)
        for k in range(14, 27):  # those neighbours of the cell that do not have this one among theirs
            h = bucket(x + k // 9 - 1, y + k // 3 % 3 - 1, z + k % 3 - 1, size)
            if h != own:
                n = pairs_in(reference, s, begin[h], begin[h + 1], square, apart, order, here, keys, n)
    return n
