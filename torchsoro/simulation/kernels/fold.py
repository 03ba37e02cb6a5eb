"""Sums over the threads of a block, and of what tiles hand over for each chamber."""

import taichi as ti

from torchsoro.simulation.kernels.layout import AXES, CHAMBER_START, CHAMBERS, SWEPT, TILE
from torchsoro.simulation.kernels.tile import sync, thread

# Where sums over a block's threads lie in the pad: after the parts that each is taken in.
PARTS = 16
TOTALS = TILE + PARTS


@ti.func
def fold(block: ti.template(), k, count):
    """Sum so many numbers at the beginning of the pad to number k of TOTALS; PARTS of them at most lie at TILE, too."""
    sync(block.gpu)
    if count > PARTS:
        for each in range(block.q0, block.q1):
            q = thread(block, each)
            if q < PARTS:
                total = block.pad[block.base + q]
                for m in ti.static(range(1, TILE // PARTS)):
                    total += block.pad[block.base + m * PARTS + q]
                block.pad[block.base + TILE + q] = total
        sync(block.gpu)
    for each in range(block.q0, block.q1):
        if thread(block, each) == 0:
            total = block.pad[block.base + TILE]
            for m in ti.static(range(1, PARTS)):
                total += block.pad[block.base + TILE + m]
            block.pad[block.base + TOTALS + k] = total
    sync(block.gpu)


@ti.func
def sum_chambers(block: ti.template(), b):
    """Sum what the tiles of each chamber of simulation b hand over alone: at TOTALS of the pad, number by number."""
    chambers, start = block.head[CHAMBERS], block.head[CHAMBER_START]
    for k in range(chambers):
        first, last = block.ints[start + k], block.ints[start + k + 1]
        swept = block.head[SWEPT] + b * block.ints[start + chambers]
        for each in range(block.q0, block.q1):
            q = thread(block, each)
            total = block.fixed[AXES] * 0
            one = first + q
            while one < last:
                total += block.scratch[swept + one]
                one += TILE
            block.pad[block.base + q] = total
            if q < PARTS:
                block.pad[block.base + TILE + q] = total
        fold(block, k, last - first)
