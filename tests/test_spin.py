"""Bodies that rotate from the first substep on: initial velocity gradients, and what transfers keep of a rotation."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from problems import WAYS, H, block, momenta, simulator, vector, ways
from torch import Tensor

from torchsoro.simulation.ops.affine import velocity_gradient

FREE = (0.0, 0.0, 0.0)
OMEGA = 60.0  # rad/s
STEP = 1e-4  # s, stable without Maxwell elements
TURN = round(2 * math.pi / OMEGA / STEP)


def randn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def scattered(count: int, *, batch: int = 2) -> Tensor:
    """Places in a cube of three metres [batch, count, 3]."""
    return 3 * torch.rand(batch, count, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)


def test_gradient_of_an_affine_velocity_field_is_exact():
    x, gradient = scattered(60), randn(2, 3, 3)
    found = velocity_gradient(x, x @ gradient.mT + randn(2, 1, 3), origin=randn(2, 3, seed=1), cell=1.2)
    torch.testing.assert_close(found, gradient.unsqueeze(1).expand_as(found), rtol=0, atol=1e-12)


def test_gradient_of_a_uniform_velocity_is_exactly_zero():
    v = randn(2, 1, 3).expand(2, 60, 3)
    assert not velocity_gradient(scattered(60), v, origin=randn(2, 3, seed=1), cell=1.2).any()


def test_gradient_is_zero_across_a_flat_body():
    x, gradient = scattered(60), randn(2, 3, 3)
    x[..., 2] = 0.3
    found = velocity_gradient(x, x @ gradient.mT, origin=torch.zeros(2, 3).double(), cell=1.2)
    gradient[..., 2] = 0
    torch.testing.assert_close(found, gradient.unsqueeze(1).expand_as(found), rtol=0, atol=1e-12)


@pytest.mark.slow
def test_velocity_gradient_is_differentiable_by_place_velocity_and_grid():
    given = [t.requires_grad_() for t in (scattered(12, batch=1) / 2, randn(1, 12, 3), randn(1, 3, seed=1))]
    assert torch.autograd.gradcheck(lambda x, v, o: velocity_gradient(x, v, origin=o, cell=1.2), given)


def spun(cells: int, way: dict[str, str], *, steps: int):
    """A cube of so many cells that turns about z: the body, and its trajectory."""
    _, body = block((2 * cells,) * 3)
    arm = body.position - body.position.mean(0)
    body = replace(body, velocity=torch.linalg.cross(vector(0.0, 0.0, OMEGA).expand_as(arm), arm))
    every = torch.arange(len(arm))
    return body, simulator(dt=STEP, **way)(body, duration=steps * STEP, gravity=FREE, sample_every=STEP, probes=every)


def rate(body, x: Tensor, v: Tensor) -> float:
    """Angular velocity about z over the initial one, from the particles' angular momentum and moment of inertia."""
    arm = x - x.mean(0)
    m = body.mass.unsqueeze(-1)
    inertia = (m * arm[:, :2].square()).sum()
    return float((m * torch.linalg.cross(arm, v)).sum(0)[2] / inertia) / OMEGA


@ways("apic", "flip", "total")
@pytest.mark.parametrize("cells", [2, 4])
def test_a_body_with_spin_turns_at_its_speed_from_the_first_substep(cells, way):
    body, run = spun(cells, way, steps=2)
    assert rate(body, run.position[1], run.velocity[1]) == pytest.approx(1.0, abs=1e-4)
    assert rate(body, run.position[0], (run.position[1] - run.position[0]) / STEP) == pytest.approx(1.0, abs=1e-4)


@ways("apic", "total")
def test_a_free_body_keeps_angular_momentum_and_speed_over_a_turn(way):
    body, run = spun(2, way, steps=TURN)
    arms = [run.position[k] - run.position[k].mean(0) for k in (0, -1)]
    assert float((arms[1] - arms[0]).norm() / arms[0].norm()) < 0.01  # it is where it was
    assert rate(body, run.position[-1], run.velocity[-1]) == pytest.approx(1.0, abs=5e-4)
    energy = [float((body.mass * run.velocity[k].square().sum(-1)).sum()) for k in (0, -1)]
    assert energy[1] == pytest.approx(energy[0], rel=1e-3)
    _, spin = momenta(body, run.final, 2 * H)
    first = spun(2, way, steps=1)[1]
    torch.testing.assert_close(spin, momenta(body, first.final, 2 * H)[1], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("cells", "share"), [(2, 0.07), pytest.param(4, 0.02, marks=pytest.mark.slow)])
def test_flip_loses_a_stated_share_of_angular_velocity_in_a_turn(cells, share):
    body, run = spun(cells, WAYS["flip"], steps=TURN)
    assert 1 - share < rate(body, run.position[-1], run.velocity[-1]) < 1
