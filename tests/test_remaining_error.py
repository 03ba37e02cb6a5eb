"""The error that a twin has left: by larger cells, and by the spread of twins that are equally good."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from swings import draws, recorded

from torchsoro.sim2real.inference.evidence import infer
from torchsoro.sim2real.inference.observed import size_of
from torchsoro.sim2real.inference.remaining_error import ORDER, by_richardson, by_spread, cleared

SHIFTS = np.linspace(-1.0, 1.0, 7)


def test_richardson_finds_an_error_that_falls_with_a_power_of_the_edge():
    data, nothing, _ = recorded(0.0, 1)
    time = data.trials[0].time
    error = 0.03 * np.sin(40 * time)[:, None, None] * np.ones((1, 3, 2))
    finer = tuple(r + error for r in nothing.residuals)
    coarser = tuple(r + 1.5**ORDER * error for r in nothing.residuals)
    priced = by_richardson(data, dataclasses.replace(nothing, residuals=finer), coarser, 1.5)
    assert priced.numerics.amplitude == pytest.approx(float(np.sqrt((error**2).mean())), rel=1e-6)
    assert np.abs(priced.numerics.draws[0][0]) == pytest.approx(np.abs(error), abs=1e-12)


def test_richardson_refuses_a_twin_that_is_no_coarser():
    data, nothing, _ = recorded(0.0, 1)
    with pytest.raises(ValueError, match=r"ratio = 1, wanted one above 1"):
        by_richardson(data, nothing, nothing.residuals, 1.0)


def test_spread_of_equally_good_twins_is_priced_within_a_third_of_the_error_of_their_mean():
    data, nothing, _ = recorded(0.0, 2)
    off = draws(data, 7, 0.05, 3)
    variants = [tuple(r + d for r, d in zip(nothing.residuals, one, strict=True)) for one in off]
    priced = by_spread(data, nothing, variants, SHIFTS)
    mean = tuple(np.mean(same, 0) for same in zip(*off, strict=True))
    for r, m, n in zip(priced.residuals, mean, nothing.residuals, strict=True):
        assert r - m == pytest.approx(n, abs=1e-12, nan_ok=True)
    truth = draws(data, 40, 0.05, 4)
    real = np.sqrt(np.mean([(t - m) ** 2 for one in truth for t, m in zip(one, mean, strict=True)]))
    assert float(np.sqrt((priced.numerics.amplitude**2).mean())) == pytest.approx(real, rel=0.33)
    assert 0.03 < priced.numerics.time < 0.3


def test_what_grows_with_the_shift_of_planes_is_no_error():
    data, nothing, _ = recorded(0.0, 2)
    (way,) = draws(data, 1, 0.05, 3)
    variants = [tuple(r + s * d for r, d in zip(nothing.residuals, way, strict=True)) for s in SHIFTS]
    priced = by_spread(data, nothing, variants, SHIFTS)
    assert priced.numerics.amplitude.max() < 1e-12
    for r, n in zip(priced.residuals, nothing.residuals, strict=True):
        assert r == pytest.approx(n, abs=1e-12, nan_ok=True)


def test_errors_of_other_twins_add_up():
    data, nothing, _ = recorded(0.0, 2)
    one, other = draws(data, 2, 0.05, 3)
    priced = by_spread(data, nothing, [nothing.residuals] * 7, SHIFTS, others=(one, other))
    assert priced.numerics.kinds == (0,) * 7 + (1, 2)  # each of its own kind, beside seven of chance
    left = [size_of(cleared(data, nothing, o)) for o in (one, other)]
    assert priced.numerics.size == pytest.approx(float(np.hypot(*left)), rel=1e-6)
    assert priced.numerics.modes[0].shape[-1] == 7 + 2


def test_what_smaller_cells_would_change_may_look_like_a_belief():
    data, _, drag = recorded(0.0, 3)
    believed = dataclasses.replace(drag, model=dataclasses.replace(drag.model, own=()))
    difference = tuple(0.2 * J[..., 0] for J in drag.slopes)
    priced = by_spread(data, believed, [drag.residuals] * 7, SHIFTS, beyond=(difference,))
    for mode, whole in zip(priced.numerics.modes, difference, strict=True):
        assert mode[..., -1] == pytest.approx(whole, nan_ok=True)
    assert priced.numerics.size < 0.05 * size_of(difference)  # what a belief does not take up
    without = by_spread(data, believed, [drag.residuals] * 7, SHIFTS)
    sure, unsure = (float(infer(data, m).mode.covariance[0, 0]) for m in (without, priced))
    assert unsure > 4 * sure


def test_two_twins_have_no_spread_and_shifts_are_theirs():
    data, nothing, _ = recorded(0.0, 2)
    with pytest.raises(ValueError, match="variants: 2, wanted three or more"):
        by_spread(data, nothing, [nothing.residuals] * 2, SHIFTS[:2])
    with pytest.raises(ValueError, match="wanted 3 that sum to zero"):
        by_spread(data, nothing, [nothing.residuals] * 3, SHIFTS[:3])


def test_a_difference_that_a_measurement_error_makes_is_no_error_of_the_twin():
    data, _, drag = recorded(0.0, 3)
    difference = tuple(0.2 * J[..., 0] for J in drag.slopes)
    clock = dataclasses.replace(drag, model=dataclasses.replace(drag.model, own=()))
    assert max(np.abs(c).max() for c in cleared(data, clock, difference)) < 1e-3
    for kept, whole in zip(cleared(data, drag, difference), difference, strict=True):
        assert kept == pytest.approx(whole)


def test_a_modulus_takes_up_the_same_error_of_the_twin_as_a_belief_and_as_an_effect():
    data, _, drag = recorded(0.0, 3)
    difference = tuple(0.2 * J[..., 0] for J in drag.slopes)
    belief, effect = (
        dataclasses.replace(drag, model=dataclasses.replace(drag.model, own=own, released=own)) for own in ((), (0,))
    )
    for one, other in zip(cleared(data, belief, difference), cleared(data, effect, difference), strict=True):
        assert one == pytest.approx(other)
