"""Hyperelastic fits to finite-strain tests: recovered constants, coverage of intervals, specimen factors, refusals."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from torchsoro import Prony, Solid
from torchsoro.rheology.finite import Experiment
from torchsoro.rheology.hyperelastic import LEVEL, Fit, fit, ladder
from torchsoro.rheology.pointwise import Law, equibiaxial, simple_shear, uniaxial

TRUE = Solid(youngs_modulus=3e5, poisson_ratio=0.495, linear_stiffening=0.02, quadratic_stiffening=0.003)
PRONY = Prony(moduli=torch.tensor([0.8, 0.5]).double(), times=torch.tensor([20.0, 1.0]).double())


def experiment(mode, rate, top=2.5, *, prony=None, solid=TRUE, noise=0.0, seed=0, factor=1.0, back=True, count=50):
    """Load to ``top`` and half of the way back; the law's stress at every sample."""
    rest = 0.0 if mode == "shear" else 1.0
    up = np.linspace(rest, top, count + 1)[1:]
    way = np.concatenate([up, np.linspace(top, (rest + top) / 2, count // 2 + 1)[1:]]) if back else up
    time = np.cumsum(np.abs(np.diff(way, prepend=rest))) / rate
    blank = Experiment(name=mode, mode=mode, time=time, deformation=way, stress=np.ones(len(way)))
    fine, steps, at = blank.path(0.02)
    run = {"shear": simple_shear, "uniaxial": uniaxial, "equibiaxial": equibiaxial}[mode]
    found = run(torch.from_numpy(fine), torch.from_numpy(steps), Law.of(solid, prony))
    exact = (found if mode == "shear" else found[0]).numpy()[at]
    random = np.random.default_rng(seed).standard_normal(len(way))
    return replace(blank, stress=factor * (exact + noise * math.sqrt((exact**2).mean()) * random))


def held(found: Fit, **wanted: float) -> list[bool]:
    """Whether each interval holds what is wanted."""
    intervals = [(found.intervals[name], value) for name, value in wanted.items()]
    assert all(i.low <= i.value <= i.high for i, _ in intervals)
    return [i.low <= value <= i.high for i, value in intervals]


@pytest.mark.parametrize("mode", ["uniaxial", "equibiaxial", "shear"])
def test_yeoh_constants_recovered_from_one_stress_stretch_curve(mode):
    exact = experiment(mode, 1.0, back=False)
    found = fit([exact])
    assert found.error < 1e-5
    assert found.shear == pytest.approx(TRUE.shear, rel=1e-4)
    assert found.stiffening == pytest.approx((0.02, 0.003), rel=1e-2)
    assert exact.rms() > 0 and found.inflation >= 1.0
    assert found.largest == pytest.approx(float(exact.invariant.max()))


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["uniaxial", "equibiaxial", "shear"])
def test_coverage_of_yeoh_intervals_matches_confidence_level(mode):
    mu, count, exact = TRUE.shear, 40, experiment(mode, 1.0, back=False)
    wanted = {"shear": mu, "a": 0.02, "b": 0.003, "C20": 0.02 * mu / 4, "C30": 0.003 * mu / 6}
    rows = []
    for seed in range(count):
        random = np.random.default_rng(seed).standard_normal(len(exact.time))
        noisy = replace(exact, stress=exact.stress + 0.005 * exact.rms() * random)
        found = fit([noisy])
        rows.append(held(found, **wanted))
        assert found.error == pytest.approx(0.005, rel=0.4)
        assert found.error == pytest.approx(found.error_of([noisy]))
    share = np.mean(rows, axis=0)
    assert (share > LEVEL - 3 * math.sqrt(LEVEL * (1 - LEVEL) / count)).all(), share


@pytest.mark.slow
def test_coverage_of_maxwell_element_intervals_matches_confidence_level():
    exact = [experiment("shear", rate, prony=PRONY) for rate in (0.02, 0.1, 1.0)]
    wanted = {"shear": TRUE.shear, "a": 0.02, "b": 0.003, "g1": 0.8, "tau1": 20.0, "g2": 0.5, "tau2": 1.0}
    rows = []
    for seed in range(10):
        random = np.random.default_rng(seed)
        noisy = [replace(e, stress=e.stress + 0.01 * e.rms() * random.standard_normal(len(e.time))) for e in exact]
        rows.append(held(ladder(noisy, most=2)[-1], **wanted))
    assert np.mean(rows) > 0.75, rows  # 90 %, but those of one fit go together


def test_interval_widens_with_serially_correlated_residuals():
    smooth = experiment("uniaxial", 1.0, back=False)
    wave = replace(smooth, stress=smooth.stress * (1 + 0.02 * np.sin(np.linspace(0, 12, len(smooth.time)))))
    found = fit([wave], order=1)
    assert found.inflation > 5
    assert held(found, shear=TRUE.shear) == [True]


@pytest.mark.slow
def test_two_maxwell_elements_recovered_within_10_percent_and_predict_another_rate():
    known = [experiment("shear", rate, prony=PRONY, noise=0.01, seed=k) for k, rate in enumerate((0.02, 1.0))]
    known.append(experiment("uniaxial", 0.1, top=2.0, prony=PRONY, noise=0.01, seed=7))
    fits = ladder(known, most=2)
    assert [len(f.moduli) for f in fits] == [0, 1, 2]
    best = min(fits, key=lambda f: f.bic)
    assert best is fits[2]
    assert best.shear == pytest.approx(TRUE.shear, rel=0.03)
    assert best.moduli == pytest.approx((0.8, 0.5), rel=0.1)
    assert best.times == pytest.approx((20.0, 1.0), rel=0.1)
    other = [experiment("equibiaxial", 0.2, prony=PRONY)]
    assert best.error_of(other) < 0.02 < 0.15 < fits[0].error_of(other)
    # To the simulator and back: the same law.
    torch.testing.assert_close(best.prony().times, torch.tensor(best.times).double())
    law = Law.of(best.solid(1000.0), best.prony())
    for name in ("shear", "bulk", "stiffening", "moduli", "times"):
        torch.testing.assert_close(getattr(law, name), getattr(best.law, name).squeeze(), rtol=1e-12, atol=0)


def test_stress_factors_of_specimens_recovered_within_1_percent():
    factors = (0.8, 1.25)
    known = [
        experiment("shear", rate, prony=PRONY, factor=factor) for rate, factor in zip((0.02, 1.0), factors, strict=True)
    ]
    found = ladder(known, most=2, specimens=True)[-1]
    assert found.factors == pytest.approx(factors, rel=1e-2)
    assert found.shear == pytest.approx(TRUE.shear, rel=2e-2)
    other = [experiment("shear", 0.2, prony=PRONY, factor=1.7)]
    assert found.error_of(other, specimens=True) < 0.01 < 0.3 < found.error_of(other)


def test_interval_of_relaxation_time_far_below_sampling_spans_a_decade():
    # An element a thousand times as fast as the test lies below what it sees.
    fast = Prony(moduli=torch.tensor([0.5]).double(), times=torch.tensor([1e-4]).double())
    found = fit([experiment("shear", 1.0, prony=fast, noise=0.01)], elements=1)
    interval = found.intervals["tau1"]
    assert interval.high > 10 * interval.low


def test_stable_fit_to_softening_data_is_accepted_by_solid():
    softer = experiment("shear", 1.0, top=3.0, back=False)
    softer = replace(softer, stress=2e4 * np.tanh(softer.deformation))
    for order in (0, 1, 2):
        found = fit([softer], order=order)
        found.solid(1000.0)
        strains = torch.linspace(0, 50, 2001).double()
        stress = simple_shear(strains, torch.ones(2001).double(), found.law)
        assert bool((stress.diff() > 0).all())
    free = fit([softer], order=1, stable=False)
    assert free.error < fit([softer], order=1).error
    with pytest.raises(ValueError, match="linear_stiffening"):
        free.solid(1000.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"order": 3}, r"order, elements, poisson_ratio = 3, 0, 0\.495: wanted 0 to 2, 0 to 5, and 0 to below 0\.5"),
        ({"elements": 6}, r"order, elements, poisson_ratio = 2, 6, "),
        ({"poisson_ratio": 0.5}, r"order, elements, poisson_ratio = 2, 0, 0\.5"),
    ],
)
def test_fit_refuses_arguments_outside_their_range(change, message):
    test = experiment("shear", 1.0)
    with pytest.raises(ValueError, match="^" + message):
        fit([test], **change)


def test_fit_refuses_empty_list_and_zero_stress():
    test = experiment("shear", 1.0)
    with pytest.raises(ValueError, match="experiments: 0, wanted at least one"):
        fit([])
    with pytest.raises(ValueError, match="experiments: 2, wanted at least one, all with some stress"):
        fit([test, replace(test, stress=0 * test.stress)])
