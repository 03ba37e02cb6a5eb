"""Chains that hang on the mean place of some nodes, in lanes; forward only.

Beads advance by a semi-implicit Euler step, several within a substep of the body if a link asks for it, while their end
on the body goes straight from where it was to where it is.
"""

from __future__ import annotations

from torchsoro.simulation.kernels.lane_contact import store_vector, vector
from torchsoro.simulation.kernels.lane_nodes import gravity_row
from torchsoro.simulation.kernels.lanes import law, load, part, store
from torchsoro.simulation.kernels.laws_lanes import laws
from torchsoro.simulation.kernels.layout import (
    CHAIN,
    CHAIN_BEADS,
    CHAIN_DAMPING,
    CHAIN_LIGHTNESS,
    CHAIN_REST,
    CHAIN_START,
    CHAIN_STATE,
    CHAIN_STIFFNESS,
)

link = laws.link
PLACES, SPEEDS, END = 0, 48 * CHAIN_BEADS, 96 * CHAIN_BEADS  # of a chain's state, where each begins


@law
def pull_of(case, one, p, q, u, v):
    """Force of a link from place p, which moves by u, to place q, which moves by v."""
    rest, stiffness = load(case.chains, one + 16 * CHAIN_REST), load(case.chains, one + 16 * CHAIN_STIFFNESS)
    damping = load(case.chains, one + 16 * CHAIN_DAMPING)
    d0, d1, d2 = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    return link(d0, d1, d2, v[0] - u[0], v[1] - u[1], v[2] - u[2], rest, stiffness, damping)


@law
def stepped(v, pull, back, light, weight, dt):
    """Velocity of a bead after a step, between two links."""
    return (
        v[0] + dt * (weight[0] + light * (pull[0] - back[0])),
        v[1] + dt * (weight[1] + light * (pull[1] - back[1])),
        v[2] + dt * (weight[2] + light * (pull[2] - back[2])),
    )


@part
def chain_forward(mesh, case, work, g, tie, end, t):
    """Add to the tension of a tie what its chain pulls, over substep t; its mean displacement is ``end``."""
    weight, dt = vector(case.gravity, gravity_row(case, g, t), 16), case.dt / case.chain_steps
    one, at, zero = 16 * CHAIN * tie, 16 * CHAIN_STATE * tie, 0 * load(mesh.own, 0)
    before = vector(work.beads, at + END, 16)
    if t == 0:
        before = end
        for k in range(3 * CHAIN_BEADS):
            store(work.beads, at + PLACES + 16 * k, load(case.chains, one + 16 * (CHAIN_START + k)))
    rate = (end[0] - before[0]) / case.dt, (end[1] - before[1]) / case.dt, (end[2] - before[2]) / case.dt
    fixed, still = vector(case.chains, one, 16), (zero, zero, zero)
    light = load(case.chains, one + 16 * CHAIN_LIGHTNESS)
    p0, p1, p2 = zero, zero, zero
    for step in range(1, case.chain_steps + 1):
        ago = case.dt - step * dt
        place = end[0] - ago * rate[0], end[1] - ago * rate[1], end[2] - ago * rate[2]
        x, v = vector(work.beads, at + PLACES, 16), vector(work.beads, at + SPEEDS, 16)
        f = pull_of(case, one, place, x, rate, v)
        p0, p1, p2 = p0 + f[0], p1 + f[1], p2 + f[2]
        for bead in range(CHAIN_BEADS):
            y, w = fixed, still
            if bead + 1 < CHAIN_BEADS:
                y = vector(work.beads, at + PLACES + 48 * (bead + 1), 16)
                w = vector(work.beads, at + SPEEDS + 48 * (bead + 1), 16)
            h = pull_of(case, one, x, y, v, w)
            s = stepped(v, h, f, light, weight, dt)
            store_vector(work.beads, at + SPEEDS + 48 * bead, 16, s)
            store_vector(
                work.beads, at + PLACES + 48 * bead, 16, (x[0] + dt * s[0], x[1] + dt * s[1], x[2] + dt * s[2])
            )
            f, x, v = h, y, w
    store_vector(work.beads, at + END, 16, end)
    store(work.tension, 48 * tie, load(work.tension, 48 * tie) - p0 / case.chain_steps)
    store(work.tension, 48 * tie + 16, load(work.tension, 48 * tie + 16) - p1 / case.chain_steps)
    store(work.tension, 48 * tie + 32, load(work.tension, 48 * tie + 32) - p2 / case.chain_steps)
