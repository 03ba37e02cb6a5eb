"""Noise that lasts: its share and size, by third differences and by what a model leaves."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from swings import recorded

from torchsoro.sim2real.data.recording import Recording
from torchsoro.sim2real.inference.evidence import infer
from torchsoro.sim2real.inference.lasting import with_lasting_noise
from torchsoro.sim2real.inference.noise import CORRELATION, LASTING, estimate_noise, lasting_noise

NOISE = 0.01  # of the recordings of ``swings``


def drifting(lasting, interval, count=40_000):
    """Noise of unit variance along three axes, a share of which is an Ornstein-Uhlenbeck process."""
    rng = np.random.default_rng(7)
    keep = math.exp(-interval / CORRELATION)
    slow = rng.normal(size=(count, 1, 3))
    for i in range(1, count):
        slow[i] = keep * slow[i - 1] + math.sqrt(1 - keep**2) * slow[i]
    return math.sqrt(lasting) * slow + math.sqrt(1 - lasting) * rng.normal(size=slow.shape)


@pytest.mark.parametrize("interval", [0.002, 0.01, 0.03])
@pytest.mark.parametrize("lasting", [0.0, 0.3, 0.6])
def test_third_differences_tell_the_size_of_noise_of_which_a_share_lasts(lasting, interval):
    place = drifting(lasting, interval)
    white = estimate_noise([Recording(time=interval * np.arange(len(place)), position=place)])
    assert lasting_noise(white, lasting, interval) == pytest.approx(1.0, rel=0.03)
    assert lasting == 0 or white < 0.97


@pytest.mark.parametrize(
    ("lasting", "level"),
    [(0.25, 1.2), (0.05, 1.0), (0.25, 1.0), (0.5, 1.0)],
)
@pytest.mark.slow
def test_what_a_model_leaves_tells_how_much_of_the_noise_lasts(lasting, level):
    shares, sizes = [], []
    for seed in range(4):
        data, _, drag = recorded(0.02, seed, trials=3, count=120, effect=0.3, lasting=lasting)
        white = level * NOISE / lasting_noise(1.0, lasting, 1 / 119)  # as third differences tell it, or more
        unknown = dataclasses.replace(data, noise=white, lasting=LASTING)
        found = with_lasting_noise(unknown, infer(unknown, drag), stated=False)
        shares.append(found.lasting)
        sizes.append(found.noise)
        stated = dataclasses.replace(data, lasting=LASTING)
        assert with_lasting_noise(stated, infer(stated, drag), stated=True).noise == NOISE
    assert np.mean(shares) == pytest.approx(lasting, abs=0.1)
    assert np.mean(sizes) == pytest.approx(NOISE, rel=0.06)


def test_a_discrepancy_that_markers_share_is_not_taken_for_noise_that_lasts():
    found = []
    for seed in range(4):
        data, nothing, _ = recorded(0.2, seed, trials=3, count=120, lasting=0.25)
        found.append(with_lasting_noise(data, infer(data, nothing), stated=True).lasting)
    assert np.mean(found) == pytest.approx(0.25, abs=0.1)
