"""Objective and constraint functions against rigid motions and hand-made densities."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchsoro.design.objective import center_of_gravity, intermediate_density, mean_stride, stride, total_mass, travel

torch.set_num_threads(1)

X = (1.0, 0.0, 0.0)


def random(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def history(speed=0.05, samples=16, step=0.05):
    """A centre of gravity that moves at a constant velocity along x, and its times."""
    time = torch.arange(samples, dtype=torch.float64) * step
    return torch.stack([speed * time, 0.0 * time, 0.01 + 0.0 * time], dim=-1), time


# Centre of gravity and mass -------------------------------------------------------------------------------------------


def test_center_of_gravity_by_hand():
    x = torch.tensor([[0.0, 0.0, 0.0], [4.0, 8.0, -4.0]])
    assert center_of_gravity(x, torch.tensor([3.0, 1.0])).tolist() == [1.0, 2.0, -1.0]


@settings(max_examples=25, deadline=None)
@given(n=st.integers(1, 20), seed=st.integers(0, 1000), factor=st.floats(1e-12, 1e6), shift=st.floats(-1.0, 1.0))
def test_center_of_gravity_moves_with_the_body_and_ignores_the_unit_of_mass(n, seed, factor, shift):
    x, mass = random(n, 3, seed=seed), 0.1 + random(n, seed=seed + 1)
    moved = center_of_gravity(x + shift, factor * mass)
    torch.testing.assert_close(moved, center_of_gravity(x, mass) + shift, rtol=1e-12, atol=1e-12)
    assert (center_of_gravity(x, mass) <= x.amax(dim=0) + 1e-12).all()


def test_center_of_gravity_broadcasts_masses_over_frames():
    x, mass = random(2, 5, 7, 3), 0.1 + random(2, 1, 7, seed=1)
    seen = center_of_gravity(x, mass)
    assert seen.shape == (2, 5, 3)
    for b in range(2):
        for s in range(5):
            torch.testing.assert_close(seen[b, s], (mass[b, 0] @ x[b, s]) / mass[b, 0].sum())
    torch.testing.assert_close(center_of_gravity(x[0], mass[0, 0]), seen[0])


def test_gradients():
    x, mass = random(2, 4, 3).requires_grad_(), (0.1 + random(4, seed=1)).requires_grad_()
    assert torch.autograd.gradcheck(center_of_gravity, (x, mass))
    gamma, design = random(2, 4, seed=2).requires_grad_(), torch.tensor([True, False, True, True])
    assert torch.autograd.gradcheck(lambda g: intermediate_density(g, design), gamma)
    cog, time = random(3, 9, 3, seed=3).requires_grad_(), 0.1 * torch.arange(9, dtype=torch.float64)
    direction = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda c: travel(c, time, start=0.1, end=0.7, direction=direction), cog)
    assert torch.autograd.gradcheck(lambda c: stride(c, time, start=0.1, period=0.3, direction=direction), cog)


def test_total_mass():
    assert total_mass(torch.tensor([[1.0, 2.0], [3.0, 4.0]])).tolist() == [3.0, 7.0]
    with pytest.raises(ValueError, match="mass: got shape"):
        total_mass(torch.tensor(1.0))


@pytest.mark.parametrize(
    ("x", "mass", "message"),
    [
        (torch.zeros(3), torch.ones(1), r"x: got shape \(3,\), want \[..., N, 3\]"),
        (torch.zeros(4, 2), torch.ones(4), r"x: got shape \(4, 2\)"),
        (torch.zeros(4, 3), torch.ones(3), r"mass: got shape \(3,\), want \[..., 4\]"),
        (torch.zeros(2, 4, 3), torch.ones(5, 4), "mass: got shape .*broadcast"),
        (torch.zeros(4, 3), torch.zeros(4), "mass: got a total of 0.0 kg"),
        (torch.zeros(4, 3), torch.full((4,), math.nan), "mass: got a total of nan"),
    ],
)
def test_bad_bodies_are_refused(x, mass, message):
    with pytest.raises(ValueError, match=message):
        center_of_gravity(x, mass)


# Travel and stride ----------------------------------------------------------------------------------------------------


def test_travel_and_stride_of_a_constant_velocity():
    cog, time = history()
    assert float(travel(cog, time, start=0.25, end=0.75, direction=X)) == pytest.approx(0.025, rel=1e-12)
    assert float(travel(cog, time, start=0.25, end=0.75, direction=(0, 0, 1))) == 0.0
    slope = (math.cos(0.3), 0.0, math.sin(0.3))
    assert float(travel(cog, time, start=0.25, end=0.75, direction=slope)) == pytest.approx(0.025 * math.cos(0.3))
    # 0.5 s at 5 Hz hold two whole cycles and a half, which is left out.
    cycles = stride(cog, time, start=0.25, period=0.2, direction=X)
    torch.testing.assert_close(cycles, torch.full((2,), 0.01, dtype=torch.float64), rtol=1e-12, atol=0)


def test_strides_add_up_to_the_travel_in_a_batch():
    cog, time = random(2, 3, 13, 3), 0.05 * torch.arange(13, dtype=torch.float64)
    direction = torch.tensor([0.0, 0.6, -0.8])
    cycles = stride(cog, time, start=0.0, period=0.2, direction=direction)
    assert cycles.shape == (2, 3, 3)
    whole = travel(cog, time, start=0.0, end=0.6, direction=direction)
    torch.testing.assert_close(cycles.sum(dim=-1), whole, rtol=1e-12, atol=1e-12)


@settings(max_examples=25, deadline=None)
@given(frequency=st.integers(1, 60), cycles=st.integers(1, 30), start=st.integers(0, 5), single=st.booleans())
def test_rounding_of_the_period_loses_no_cycle(frequency, cycles, start, single):
    period = 1.0 / frequency
    time = torch.arange(start + cycles + 1, dtype=torch.float64) * period
    cog = torch.stack([time, 0 * time, 0 * time], dim=-1)
    if single:
        time = time.float()
    seen = stride(cog, time, start=start * period, period=period, direction=X)
    torch.testing.assert_close(seen, torch.full((cycles,), period, dtype=torch.float64), rtol=1e-6, atol=0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"start": 0.26}, r"start: got 0.26 s, want the time of a sample; the nearest is 0.25 s \(sample 5\)"),
        ({"end": 0.8}, "end: got 0.8 s.*nearest is 0.75 s"),
        ({"start": math.nan}, "start: got nan"),
        ({"end": 0.25}, "end: got 0.25 s, want a time after start"),
        ({"direction": (2.0, 0.0, 0.0)}, "direction: got a length of 2, want a unit vector"),
        ({"direction": (math.nan, 0.0, 0.0)}, "direction: got a length of nan"),
        ({"direction": (1.0, 0.0)}, r"direction: got shape \(2,\)"),
        ({"time": torch.arange(16)}, "time: got torch.int64"),
        ({"time": torch.arange(15.0)}, r"cog: got shape \(16, 3\), want \[..., 15, 3\]"),
    ],
)
def test_bad_intervals_are_refused(changes, message):
    cog, time = history()
    good = {"cog": cog, "time": time, "start": 0.25, "end": 0.75, "direction": X}
    travel(**good)
    with pytest.raises(ValueError, match=message):
        travel(**(good | changes))


@pytest.mark.parametrize(
    ("start", "period", "message"),
    [
        (0.25, 0.0, "period: got 0.0 s"),
        (0.25, 0.6, "period: got 0.6 s from start = 0.25 s, want a whole cycle before 0.75 s"),
        (0.25, 0.12, r"start \+ 1 period: got 0.37 s"),
        (0.26, 0.2, "start: got 0.26 s"),
    ],
)
def test_bad_cycles_are_refused(start, period, message):
    cog, time = history()
    with pytest.raises(ValueError, match=message):
        stride(cog, time, start=start, period=period, direction=X)


START = 0.01


def speeding(duration):
    """A way that speeds up, 2 t + 30 t^2 metres after the start, and its times, 1 ms apart."""
    time = np.arange(round((START + duration) / 1e-3) + 1) * 1e-3
    after = (time - START).clip(min=0)
    return 2 * after + 30 * after**2, time


def test_the_mean_stride_is_that_of_the_whole_cycles():
    way, time = speeding(0.05)  # two cycles and a half
    cog = torch.from_numpy(way)[:, None] * torch.tensor([0.0, 0.0, 1.0])
    each = stride(cog, torch.from_numpy(time), start=START, period=0.02, direction=(0, 0, 1))
    assert len(each) == 2
    assert mean_stride(way, time, start=START, period=0.02) == pytest.approx(float(each.mean()))


def test_a_cycle_may_end_between_two_samples():
    seen = mean_stride(*speeding(0.1), start=START, period=1 / 30)  # three cycles of 33.3 ms
    assert seen == pytest.approx((2 * 0.1 + 30 * 0.01) / 3)
    seen = mean_stride(*speeding(0.05), start=START, period=1 / 30)
    assert seen == pytest.approx(2 / 30 + 30 / 30**2, rel=1e-3)


def test_without_a_whole_cycle_there_is_no_mean_stride():
    assert math.isnan(mean_stride(*speeding(0.1), start=START, period=0.2))
    assert mean_stride(*speeding(0.1), start=START, period=0.1) == pytest.approx(2 * 0.1 + 30 * 0.01)


# Intermediate density -------------------------------------------------------------------------------------------------


def test_intermediate_density_by_hand():
    design = torch.tensor([True, True, False, True])
    assert float(intermediate_density(torch.tensor([0.0, 1.0, 0.5, 1.0]), design)) == 0.0
    assert float(intermediate_density(torch.full((4,), 0.5), design)) == 0.25
    batch = torch.tensor([[0.5, 0.0, 0.3, 1.0], [0.25, 0.25, 0.7, 0.25]])
    torch.testing.assert_close(intermediate_density(batch, design), torch.tensor([0.25 / 3, 0.1875]))


@settings(max_examples=25, deadline=None)
@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=20))
def test_intermediate_density_is_symmetric_and_at_most_a_quarter(values):
    gamma = torch.tensor(values, dtype=torch.float64)
    design = torch.ones(len(values), dtype=torch.bool)
    seen = intermediate_density(gamma, design)
    assert -1e-15 <= float(seen) <= 0.25
    torch.testing.assert_close(intermediate_density(1.0 - gamma, design), seen, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize(
    ("gamma", "design", "message"),
    [
        (torch.zeros(4), torch.ones(4), "design: got torch.float32"),
        (torch.zeros(4), torch.ones(2, 2, dtype=torch.bool), r"design: got torch.bool \(2, 2\)"),
        (torch.zeros(3), torch.ones(4, dtype=torch.bool), r"gamma: got shape \(3,\), want \[..., 4\]"),
        (torch.zeros(4), torch.zeros(4, dtype=torch.bool), "design: got no design particle"),
    ],
)
def test_bad_densities_are_refused(gamma, design, message):
    with pytest.raises(ValueError, match=message):
        intermediate_density(gamma, design)
