"""What is said of effects that were fitted: their order, those that lean on others, which are told apart."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
from ringing import effect

from torchsoro.sim2real.hypotheses.library import library
from torchsoro.sim2real.inference.fit import FitProblem
from torchsoro.sim2real.inference.ranking import Candidate, rank
from torchsoro.sim2real.inference.search import _unconstrained
from torchsoro.sim2real.inference.verdict import Thresholds, decide


@pytest.fixture(scope="module")
def still(made):
    """Recordings that lack nothing, and their fit without an effect."""
    twin, record = made
    problem = FitProblem(record(None), twin)
    return problem, problem.fit([((), None)], rounds=3)[0]


def fitted(null_model, name, score, explained, heldout_ratio=math.nan):
    """An effect of which only these numbers count."""
    fit = dataclasses.replace(null_model, effects=(effect(name),), values=(np.ones(6),))
    return Candidate(fit=fit, score=score, gain=400.0, explained=explained, heldout_ratio=heldout_ratio)


def on(planes):
    """What a verdict asks of a problem."""
    return SimpleNamespace(experiment=SimpleNamespace(setup=SimpleNamespace(planes=planes)))


def test_scores_are_in_units_of_the_residual_variance_of_the_best_effect(still):
    problem, null_model = still
    worse = dataclasses.replace(null_model, chi2=3 * null_model.samples, effects=(effect("drag"),), unknowns=1)
    better = dataclasses.replace(worse, chi2=1.5 * null_model.samples, effects=(effect("tether"),), unknowns=6)
    start = dataclasses.replace(null_model, chi2=10.0 * null_model.samples)
    trust = problem.observation.deviations
    first, second = rank([worse, better], start, start.chi2, trust)
    assert first.fit is better and second.fit is worse
    # What no form of an effect is known well enough for does not count, and then the simpler is the better.
    near = dataclasses.replace(worse, chi2=better.chi2 + 0.5 * null_model.samples)
    simple, other = rank([near, better], start, 1e3 * start.chi2, trust)
    assert simple.fit is near and simple.gain < other.gain
    # A clock that would have to be off by five standard deviations tells against an effect, thirty do not forbid it.
    for off, lost in ((2.0, 0.0), (5.0, 2.0), (30.0, 12.0)):
        bent = dataclasses.replace(near, errors=off * trust * (np.arange(len(trust)) == 0))
        told = {c.fit.name: c.score for c in rank([bent, better], start, 1e3 * start.chi2, trust)}
        assert told["drag"] == pytest.approx(simple.score - lost)


@pytest.mark.parametrize(
    ("start", "excess", "explained", "gain", "kept", "kind"),
    [
        (1.2, 1.1, 0.3, 400.0, 0.8, "explained"),  # of so little no share is known
        (1.6, 1.3, 0.6, 400.0, 0.8, "explained"),
        (1.6, 1.4, 0.4, 400.0, 0.8, "nothing_missing"),
        (2.5, 1.9, 0.4, 400.0, 0.8, "unknown_physics"),
        (9.0, 5.0, 0.7, 400.0, 0.8, "unknown_physics"),
        (1.1, 1.0, 1.0, 300.0, 0.9, "explained"),  # noise hides how much better it predicts
        (1.1, 1.0, 1.0, 100.0, 0.9, "nothing_missing"),
        (5.0, 1.1, 1.0, 300.0, 0.9, "unknown_physics"),  # it fits, but does not predict
    ],
)
def test_verdict_on_one_effect_by_chi2_share_and_heldout_ratio(still, start, excess, explained, gain, kept, kind):
    problem, null_model = still
    fit = dataclasses.replace(null_model, effects=(effect("drag"),), values=(np.ones(1),))
    found = [Candidate(fit=fit, score=400.0, gain=gain, explained=explained, heldout_ratio=kept)]
    assert decide(problem, null_model, found, excess, Thresholds(), start=start).kind == kind


def test_heldout_ratio_of_0_9_suffices_where_the_heldout_error_is_below_twice_the_noise(still):
    problem, null_model = still
    found = [fitted(null_model, "density", 400.0, 0.96, heldout_ratio=0.9)]
    for faint, chosen in ((1.5, 1), (3.0, 0)):
        assert len(decide(problem, null_model, found, 1.5, Thresholds(), start=9.0, faint=faint).chosen) == chosen


def test_modulus_beyond_its_tolerance_is_fitted_without_its_prior(still):
    problem, null_model = still
    assert not _unconstrained(problem, library(), null_model)
    ((chosen, begin),) = _unconstrained(problem, library(), dataclasses.replace(null_model, point=np.array([3.5])))
    assert [e.name for e in chosen] == ["modulus"]
    assert begin.tolist() == pytest.approx([0.0, 3.5])  # tolerance and scale are the same


def test_effect_with_far_larger_heldout_error_than_another_is_not_chosen(still):
    problem, null_model = still
    tether, drag = (
        dataclasses.replace(null_model, effects=(effect(name),), values=(np.ones(6),)) for name in ("tether", "drag")
    )
    common = {"gain": 400.0, "explained": 0.96}
    for kept, chosen in ((0.3, "tether"), (0.38, "tether"), (0.6, "drag"), (0.9, "drag")):
        found = [
            Candidate(fit=tether, score=480.0, heldout_ratio=kept, **common),
            Candidate(fit=drag, score=460.0, heldout_ratio=0.3, **common),
        ]
        told = decide(problem, null_model, found, 1.5, Thresholds(), start=9.0)
        assert [c.fit.name for c in told.chosen] == [chosen]
    # Of two that predict nearly all, neither does far worse.
    found = [dataclasses.replace(c, heldout_ratio=kept) for c, kept in zip(found, (0.05, 0.035), strict=True)]
    assert decide(problem, null_model, found, 1.5, Thresholds(), start=9.0).chosen[0].fit.name == "tether"


def test_effects_with_nearly_equal_heldout_ratios_on_both_sides_of_the_limit_are_both_kept(still):
    problem, null_model = still
    found = [
        fitted(null_model, name, 400.0, 0.96, heldout_ratio=kept)
        for name, kept in (("density", 0.853), ("drag", 0.849))
    ]
    assert len(decide(problem, null_model, found, 1.5, Thresholds(), start=9.0).chosen) == 2
    # If none is believed, what comes near it is not either.
    assert not decide(problem, null_model, found[:1], 1.5, Thresholds(), start=9.0).chosen


@pytest.mark.parametrize("planes, kind", [((), "explained"), (("a plane",), "cannot_distinguish")])
def test_margin_between_effects_is_larger_where_the_body_meets_planes(still, planes, kind):
    _, null_model = still
    found = [
        fitted(null_model, name, score, 0.96)
        for name, score in (("density", 180.0), ("modulus", 120.0), ("drag", 90.0))
    ]
    told = decide(on(planes), null_model, found, 1.5, Thresholds(), start=9.0)
    assert told.kind == kind
    assert [c.fit.name for c in told.chosen] == ["density", "modulus"][: 1 + len(planes)]


@pytest.mark.parametrize("kept, told", [(0.8, ["friction"]), (0.9, ["friction", "adhesion"])])
def test_bad_heldout_prediction_does_not_exclude_an_effect_where_the_body_meets_planes(still, kept, told):
    _, null_model = still
    found = [
        fitted(null_model, name, score, 0.96, heldout_ratio=ratio)
        for name, score, ratio in (("adhesion", 420.0, kept), ("friction", 400.0, 0.4), ("drag", 200.0, kept))
    ]
    assert [
        c.fit.name for c in decide(on(("a plane",)), null_model, found, 1.5, Thresholds(), start=9.0).chosen
    ] == told


def test_nothing_is_missing_where_chi2_of_the_stated_setup_is_below_0_8_per_sample(still):
    problem, null_model = still
    found = [fitted(null_model, "drag", 400.0, 0.96, heldout_ratio=0.5)]
    for plainly, kind in ((0.75, "nothing_missing"), (0.85, "explained")):
        assert decide(problem, null_model, found, 0.5, Thresholds(), start=0.75, plainly=plainly).kind == kind


def test_one_effect_is_chosen_on_planes_where_noise_limits_the_heldout_error(still):
    _, null_model = still
    found = [fitted(null_model, "friction", 400.0, 0.96, heldout_ratio=0.9)]
    assert decide(on(("a plane",)), null_model, found, 1.0, Thresholds(), start=1.1).kind == "explained"


@pytest.mark.parametrize("best, other, told", [(0.8, 0.61, 2), (0.8, 0.59, 1), (0.97, 0.965, 1), (0.8, 0.85, 2)])
def test_effect_that_leaves_less_than_twice_the_rest_of_the_best_is_not_told_apart(still, best, other, told):
    problem, null_model = still
    found = [
        fitted(null_model, name, score, share)
        for name, score, share in (("density", 480.0, best), ("drag", 440.0, other))
    ]
    assert len(decide(problem, null_model, found, 1.5, Thresholds(), start=9.0).chosen) == told


@pytest.mark.parametrize("slope, ranked", [(0.6, ["soft_side", "modulus"]), (0.1, ["modulus"])])
def test_soft_side_is_ranked_where_the_stated_modulus_is_that_of_its_stiff_side(still, slope, ranked):
    problem, null_model = still
    unconstrained = dataclasses.replace(
        null_model, effects=(effect("modulus"),), values=(np.array([-0.25]),), chi2=6600.0
    )
    off = np.array([-2.5, slope / 0.2, 0.0, 0.0])
    soft = dataclasses.replace(
        null_model, effects=(effect("soft_side"),), values=(np.array([slope, 0.0, 0.0]),), ln_factors=np.array([-0.25]),
        point=off, chi2=4400.0, unknowns=3,
    )  # fmt: skip
    without = dataclasses.replace(null_model, chi2=7000.0)
    found = rank([unconstrained, soft], without, 115000.0, problem.observation.deviations)
    assert [c.fit.name for c in found] == ranked


def test_effect_that_needs_an_incredible_modulus_yields_to_the_modulus_by_itself(still):
    """Less density is more modulus and more pressure: neither of these does without the other."""
    problem, null_model = still
    without = dataclasses.replace(null_model, chi2=8000.0, ln_factors=np.zeros(2), point=np.zeros(2))

    def leaning(name, chi2, by):
        return dataclasses.replace(
            without, effects=(effect(name),), values=(np.array([0.2]),), chi2=chi2, point=np.array([0.0, by, 1.0])
        )

    fits = [leaning("density", 7170.0, 1.7), leaning("pressure_loss", 7210.0, 2.2), leaning("modulus", 7900.0, 5.0)]
    drag = leaning("drag", 7890.0, 5.0)
    found = rank([*fits, drag], without, 30000.0, problem.observation.deviations)
    assert [c.fit.name for c in found] == ["density", "pressure_loss"]
    # What stands by itself sends away what leans, unless that does far better.
    found = rank([*fits, leaning("modulus", 7200.0, 0.5)], without, 30000.0, problem.observation.deviations)
    assert [c.fit.name for c in found] == ["modulus"]
    found = rank(
        [leaning("density", 1000.0, 1.7), leaning("modulus", 7200.0, 0.5)],
        without,
        30000.0,
        problem.observation.deviations,
    )
    assert [c.fit.name for c in found] == ["density", "modulus"]
