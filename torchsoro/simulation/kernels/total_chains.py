"""Chains that hang on the mean place of some nodes, in the total-Lagrangian form; forward only. See ``lane_chains``."""

import taichi as ti

from torchsoro.simulation.kernels.fold import TOTALS
from torchsoro.simulation.kernels.laws_taichi import laws
from torchsoro.simulation.kernels.layout import (
    BATCH,
    BEADS,
    CHAIN,
    CHAIN_BEADS,
    CHAIN_DAMPING,
    CHAIN_LIGHTNESS,
    CHAIN_REST,
    CHAIN_START,
    CHAIN_STATE,
    CHAIN_STEPS,
    CHAIN_STIFFNESS,
    CHAINS,
    GRAVITY,
    STEP_SIZE,
    TENSION,
    TIES,
)
from torchsoro.simulation.kernels.tensor import load_vector, store_vector

PLACES, SPEEDS, END = 0, 3 * CHAIN_BEADS, 6 * CHAIN_BEADS  # of a chain's state, where each begins


@ti.func
def pull_of(block: ti.template(), one, p, q, u, v):
    """Force of a link from place p, which moves by u, to place q, which moves by v."""
    d, r = q - p, v - u
    rest, stiffness = block.fixed[one + CHAIN_REST], block.fixed[one + CHAIN_STIFFNESS]
    f0, f1, f2 = laws.link(d[0], d[1], d[2], r[0], r[1], r[2], rest, stiffness, block.fixed[one + CHAIN_DAMPING])
    return ti.Vector([f0, f1, f2])


@ti.func
def chain_pass(block: ti.template(), tie, t):
    """Add to the tension of a tie what its chain pulls, over substep t; its mean displacement is known."""
    head, fixed, beads = ti.static((block.head, block.fixed, block.scratch))
    one, at = head[CHAINS] + CHAIN * tie, head[BEADS] + CHAIN_STATE * tie
    whole = fixed[STEP_SIZE]
    dt = whole / head[CHAIN_STEPS]
    end = load_vector(block.pad, block.base + TOTALS, 1)
    before = load_vector(beads, at + END, 1)
    if t == 0:
        before = end
        for k in range(3 * CHAIN_BEADS):
            beads[at + PLACES + k] = fixed[one + CHAIN_START + k]
    rate, pull = (end - before) / whole, end * 0
    weight = load_vector(block.supply, head[GRAVITY] + (t * head[BATCH] + tie // head[TIES]) * 3, 1)
    for step in range(head[CHAIN_STEPS]):
        place = end - (whole - (step + 1) * dt) * rate
        x, v = load_vector(beads, at + PLACES, 1), load_vector(beads, at + SPEEDS, 1)
        f = pull_of(block, one, place, x, rate, v)
        pull += f
        for bead in range(CHAIN_BEADS):
            y, w = load_vector(fixed, one, 1), end * 0
            if bead + 1 < CHAIN_BEADS:
                y = load_vector(beads, at + PLACES + 3 * (bead + 1), 1)
                w = load_vector(beads, at + SPEEDS + 3 * (bead + 1), 1)
            h = pull_of(block, one, x, y, v, w)
            s = v + dt * (weight + fixed[one + CHAIN_LIGHTNESS] * (h - f))
            store_vector(beads, at + SPEEDS + 3 * bead, 1, s)
            store_vector(beads, at + PLACES + 3 * bead, 1, x + dt * s)
            f, x, v = h, y, w
    store_vector(beads, at + END, 1, end)
    tension = load_vector(beads, head[TENSION] + 3 * tie, 1) - pull / head[CHAIN_STEPS]
    store_vector(beads, head[TENSION] + 3 * tie, 1, tension)
