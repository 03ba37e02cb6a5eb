"""How many independent values residuals, and errors of the twin, amount to."""

from __future__ import annotations

import numpy as np
import pytest

from torchsoro.sim2real.inference.evidence import TwinError
from torchsoro.sim2real.inference.observed import independent


def test_residuals_that_last_and_move_together_are_worth_few_values():
    rng = np.random.default_rng(19)
    count, time = 2000, 40.0  # samples, and their correlation time in samples
    keep = np.exp(-1 / time)
    x = np.zeros((count, 4))
    for k in range(1, count):
        x[k] = keep * x[k - 1] + np.sqrt(1 - keep**2) * rng.normal(size=4)
    apart_, together = x.reshape(count, 2, 2), np.repeat(x[:, :1], 4, 1).reshape(count, 2, 2)
    assert independent((rng.normal(size=(count, 2, 2)),)) == pytest.approx(4 * count, rel=0.1)
    assert independent((apart_,)) == pytest.approx(4 * count / time, rel=0.3)
    assert independent((together,)) == pytest.approx(count / time, rel=0.3)
    assert independent((together, together)) == pytest.approx(2 * independent((together,)))


def test_an_error_of_the_twin_amounts_to_as_few_numbers_in_many_trials_as_in_one():
    slow = np.sin(np.pi * np.linspace(0, 1, 60))[:, None, None] * np.array([[1.0, 0.3]])
    fast = np.random.default_rng(3).normal(size=slow.shape)

    def count(*draws):
        return TwinError(amplitude=np.ones((2, 1)), draws=draws).count

    assert count((slow, slow, slow)) == pytest.approx(count((slow,)))
    # The most lasting of the draws counts, and none for less than a number.
    assert count((fast,)) > 2 * count((slow,)) and count((fast,), (slow,)) == count((slow,)) >= 1
    assert count() == 1.0
