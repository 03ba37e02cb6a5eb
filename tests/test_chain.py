"""A tube that hangs on a body: where it rests, how it swings with a rigid body, and that all engines agree."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from problems import vector
from test_nodes import STEP, bar, rigid, run, whole

from torchsoro import Spring
from torchsoro.simulation.formulation import Total
from torchsoro.simulation.hanging import at_rest
from torchsoro.simulation.kernels import layout
from torchsoro.simulation.loads import Chain
from torchsoro.simulation.simulator import Simulator

G = 9.81
DOWN = (0.0, 0.0, -G)
N = layout.CHAIN_BEADS
ENGINES = [{}, {"lanes": False}]
# The kernels of a GPU are compared with the lanes below, which takes ten seconds to compile.
one_at_once = pytest.mark.parametrize("engine", [{}, pytest.param({"lanes": False}, marks=pytest.mark.slow)])


def hung(lattice, body, **changes) -> Chain:
    """A light chain that hangs straight down from its support to the body."""
    settings = {"support": vector(0.0, 0.0, 0.05), "length": 0.05, "mass": 1e-7, "stiffness": 20.0, "damping": 0.0}
    return Chain(share=rigid(lattice, body), **(settings | changes))


@pytest.mark.parametrize("length", [0.09, 0.1001, 0.13])
def test_beads_at_rest_are_in_equilibrium(length):
    support, weight = torch.tensor([[0.08, 0.0, 0.06]]).double(), torch.tensor([[0.0, 0.0, -0.01]]).double()
    rest, stiffness = torch.tensor([length / (N + 1)]).double(), torch.tensor([40.0]).double()
    x = at_rest(support, rest, stiffness, weight)[0]
    links = torch.diff(torch.cat([torch.zeros(1, 3), x, support]), dim=0)
    span = links.norm(dim=1, keepdim=True)
    pull = stiffness * (span - rest) * links / span
    assert bool((span > rest).all())
    torch.testing.assert_close(pull[:-1] - pull[1:], weight.expand(N, 3), rtol=1e-4, atol=1e-7)


def test_a_long_chain_hangs_in_a_catenary():
    # Level ends 0.08 m apart, and 0.1 m of chain that hardly stretches: 2 a sinh(d / 2a) is its length, and its
    # horizontal tension is a times its weight by length, of which a bead has that of a link.
    support, weight = torch.tensor([[0.08, 0.0, 0.0]]).double(), torch.tensor([[0.0, 0.0, -0.01]]).double()
    rest, stiffness = torch.tensor([0.1 / (N + 1)]).double(), torch.tensor([1e4]).double()
    x = at_rest(support, rest, stiffness, weight)[0]
    span = x[0].norm()
    along = stiffness * (span - rest) * x[0] / span
    a = 0.04
    for _ in range(60):
        a -= (2 * a * math.sinh(0.04 / a) - 0.1) / (2 * math.sinh(0.04 / a) - 0.08 / a * math.cosh(0.04 / a))
    assert float(along[0]) == pytest.approx(a * 0.01 * (N + 1) / 0.1, rel=0.02)
    assert float(-along[2]) == pytest.approx(0.01 * N / 2, rel=1e-4)


@one_at_once
def test_a_rigid_body_bobs_on_a_light_chain(engine):
    lattice, body = bar()
    mass = float(body.mass.sum())
    found = run(lattice, body, 400, engine, gravity=DOWN, loads=[hung(lattice, body)])
    t = found.time
    sunk = mass * G / 20.0 * (1 - torch.cos(math.sqrt(20.0 / mass) * t))
    fallen = found.center_of_gravity[0, 2] - found.center_of_gravity[:, 2]
    torch.testing.assert_close(fallen, sunk, rtol=0, atol=5e-3 * float(sunk.max()))


def test_a_slack_chain_does_not_push_and_catches():
    lattice, body = bar()
    mass, slack = float(body.mass.sum()), 2e-3
    chain = hung(lattice, body, length=0.05 + slack)
    found = run(lattice, body, 1100, gravity=DOWN, loads=[chain])
    fallen = found.center_of_gravity[0, 2] - found.center_of_gravity[:, 2]
    free = fallen < 0.9 * slack
    torch.testing.assert_close(fallen[free], 0.5 * G * found.time[free] ** 2, rtol=0.02, atol=2e-6)
    # Energy: the deepest point of a fall into a spring.
    deepest = mass * G / 20.0
    assert float(fallen.max()) == pytest.approx(slack + deepest + math.sqrt(deepest**2 + 2 * deepest * slack), rel=0.02)


@one_at_once
def test_heavy_beads_swing_with_the_body(engine):
    # A taut row of beads under the support, with the body as its last mass: linear, so that its modes are known.
    lattice, body = bar()
    mass, own, stiffness = float(body.mass.sum()), 0.008, 30.0
    chain = hung(lattice, body, mass=own, stiffness=stiffness, length=0.045)
    found = run(lattice, body, 800, engine, gravity=DOWN, loads=[chain])
    link, bead = stiffness * (N + 1), own / N
    K = 2 * link * np.eye(N + 1) - link * np.eye(N + 1, k=1) - link * np.eye(N + 1, k=-1)
    K[0, 0] = link
    M = np.array([mass, *[bead] * N])
    # At first the body is held, and then bobs about where it hangs.
    taut = stiffness * 0.005
    hanging = np.linalg.solve(K, np.array([mass * G - taut, *[bead * G] * N]))
    before = np.zeros(N + 1)
    before[1:] = np.linalg.solve(K[1:, 1:], np.full(N, bead * G))
    values, modes = np.linalg.eigh(K / np.sqrt(np.outer(M, M)))
    start = modes.T @ (np.sqrt(M) * (before - hanging))
    moved = modes @ (start[:, None] * np.cos(np.sqrt(values)[:, None] * found.time.numpy()))
    sunk = hanging[0] + moved[0] / math.sqrt(mass)
    fallen = (found.center_of_gravity[0, 2] - found.center_of_gravity[:, 2]).numpy()
    np.testing.assert_allclose(fallen, sunk, rtol=0, atol=5e-3 * sunk.max())


@pytest.mark.slow
def test_engines_agree_on_a_chain_that_swings_aside():
    lattice, body = bar()
    chains = [
        Chain(
            share=rigid(lattice, body),
            support=vector(0.05, 0.03, 0.02).expand(3, 3),
            length=vector(0.062, 0.0625, 0.07),
            mass=vector(0.003, 0.002, 0.0),
            stiffness=vector(40.0, 15.0, 10.0),
            damping=vector(0.02, 0.1, 0.0),
        ),
        Spring(share=rigid(lattice, body), stiffness=vector(30.0, 40.0, 50.0), mean=True),
    ]
    start = whole(lattice, velocity=(0.1, -0.2, 0.05))
    both = [run(lattice, body, 600, e, gravity=DOWN, loads=chains, start=start).center_of_gravity for e in ENGINES]
    torch.testing.assert_close(*both, rtol=0, atol=1e-9)
    alone = run(
        lattice,
        body,
        600,
        gravity=DOWN,
        start=start,
        loads=[Spring(share=rigid(lattice, body), stiffness=50.0, mean=True)],
    )
    torch.testing.assert_close(both[0][2], alone.center_of_gravity, rtol=0, atol=1e-12)  # of no mass


def test_what_a_chain_cannot_be_is_refused():
    lattice, body = bar()
    for changes, wrong in (
        ({"mass": -1.0}, "mass of a Chain"),
        ({"support": vector(0.0, 0.0, 0.0)}, "support of a Chain"),
        ({"stiffness": 0.0}, "stiffness of a Chain"),
    ):
        with pytest.raises(ValueError, match=wrong):
            run(lattice, body, 2, loads=[hung(lattice, body, **changes)])
    mass = torch.tensor(1e-3, dtype=torch.float64, requires_grad=True)
    with pytest.raises(ValueError, match="a Chain: no gradient"):
        run(lattice, body, 2, loads=[hung(lattice, body, mass=mass)])
    before = run(lattice, body, 2, loads=[hung(lattice, body)])
    with pytest.raises(ValueError, match="beside a Chain"):
        run(lattice, body, 2, loads=[hung(lattice, body)], start=before)
    updated = Simulator(cell=0.01, dt=STEP, low=(-1.0,) * 3, high=(1.0,) * 3)
    assert not isinstance(updated.formulation, Total)
    with pytest.raises(ValueError, match="Chain"):
        updated(body, duration=STEP, loads=[hung(lattice, body)])


def test_a_tube_swings_on_cuda_as_on_a_cpu(cuda: torch.device):
    lattice, body = bar()
    body = replace(
        body, **{name: getattr(body, name).float() for name in ("position", "mass", "volume", "bulk", "shear")}
    )
    start = whole(lattice, velocity=(0.1, -0.2, 0.05))
    start = replace(start, displacement=start.displacement.float(), velocity=start.velocity.float())
    chain = hung(lattice, body, support=vector(0.05, 0.03, 0.02), length=0.062, mass=0.003, stiffness=40.0, damping=0.3)
    settings = {"gravity": DOWN, "loads": [chain], "start": start, "divergence": "mark", "record": "probes"}
    places = lattice.particles[[0, -1]]
    here, there = (
        run(lattice, body, 600, engine, probes=places, **settings).position for engine in ({}, {"device": str(cuda)})
    )
    assert float((here[-1] - here[0]).norm(dim=-1).min()) > 5e-3
    torch.testing.assert_close(there, here, rtol=0, atol=1e-5)
