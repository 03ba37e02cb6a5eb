"""What is said of recordings of a small bar, and what has no say in it."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
from ringing import effect

from torchsoro.sim2real.hypotheses.body_effects import Modulus
from torchsoro.sim2real.hypotheses.library import library
from torchsoro.sim2real.hypotheses.supply_effects import PressureGain, ThrottledLoss
from torchsoro.sim2real.inference import verdict
from torchsoro.sim2real.inference.candidates import weigh
from torchsoro.sim2real.inference.decision import WRONG
from torchsoro.sim2real.inference.fit import FitProblem
from torchsoro.sim2real.inference.heldout import Predictions, predict, predictions
from torchsoro.sim2real.inference.search import AHEAD, ENDS, FARTHER, distinct, running
from torchsoro.sim2real.inference.starts import likely, unconstrained
from torchsoro.sim2real.inference.twin_error import DiscretizationError
from torchsoro.sim2real.inference.verdict import _as_pairs, _as_simpler, _halfway, weighed
from torchsoro.sim2real.report import sentences
from torchsoro.sim2real.report.explanation import Explanation, as_json
from torchsoro.sim2real.report.sentences import evidence, verdict_sentence
from torchsoro.sim2real.report.words import probability


def quiet(line: str) -> None:
    """Report nothing."""


@pytest.fixture(scope="module")
def still(made):
    """Recordings that lack nothing, and their fit without an effect."""
    twin, record = made
    problem = FitProblem(record(None), twin)
    return problem, problem.fit([((), None)], rounds=3)[0]


@pytest.fixture(scope="module")
def judged(still):
    """What is said of recordings that lack nothing."""
    problem, null_model = still
    return weighed(problem, [effect("drag"), effect("density")], null_model, [], report=quiet)


@pytest.fixture(scope="module")
def dragged(made):
    """Ends of searches in recordings of a bar in a fluid."""
    twin, record = made
    problem = FitProblem(record("drag", (600.0,)), twin)
    drag, tilt = effect("drag"), effect("gravity_tilt")
    null_model, *ends = problem.fit([((), None), ((drag,), np.array([0.0, 20.0])), ((tilt,), None)], rounds=8)
    return problem, [drag, tilt], null_model, ends


def explanation(verdict):
    return Explanation(
        problem=verdict.problem,
        discretization=DiscretizationError(edges=(0.01,), walls=(2,)),
        verdict=verdict,
        before=(),
        after=(),
        heldout=(),
        seconds=1.0,
    )


def test_modulus_beyond_its_tolerance_is_fitted_without_its_prior(still):
    problem, null_model = still
    assert not unconstrained(problem, library(), null_model)
    ((chosen, begin),) = unconstrained(problem, library(), dataclasses.replace(null_model, point=np.array([3.5])))
    assert [e.name for e in chosen] == ["modulus"]
    assert begin.tolist() == pytest.approx([0.0, 3.5])  # tolerance and scale are the same


def test_what_a_leak_extends_is_weighed_where_it_supplies_the_same_pressure(still):
    _, null_model = still
    common = (Modulus(), 0.1), (PressureGain(), 0.05)
    problem = SimpleNamespace(
        common=common, scales=lambda effects: np.array([0.1, 0.05, *(q.scale for e in effects for q in e.quantities)])
    )
    leak = effect("leak")
    # Eight hundredths less of a supply that is seven hundredths higher, late by 30 ms.
    fit = dataclasses.replace(
        null_model, effects=(leak,), values=(np.array([0.08, 0.03]),), point=np.array([0.4, 1.4, 1.6, 3.0])
    )
    effects = [effect("pressure_loss"), effect("pressure_lag")]
    lag, loss = _as_simpler(problem, effects, [fit, null_model])
    total = 0.07 + math.log(0.92)
    assert lag.name == "pressure_lag" and lag.point == pytest.approx([0.4, total / 0.05, 3.0])
    # The stated pressure is the same number as the loss, which moves in its place.
    assert loss.name == "pressure_loss" and loss.point == pytest.approx([0.4, 0.0, total / 0.05])
    assert _as_simpler(problem, [leak], [fit]) == []
    at_once = dataclasses.replace(fit, values=(np.array([0.08, 0.0]),))
    assert [f.name for f in _as_simpler(problem, effects, [at_once])] == ["pressure_loss"]


def test_the_mass_of_a_tether_is_weighed_at_its_place(still):
    problem, null_model = still
    tether, mass = effect("tether"), effect("attached_mass")
    values = np.array([4.0, 0.1, 0.006, 0.05, 0.01, 0.01])
    point = np.concatenate([[0.2], values / problem.scales((tether,))[1:]])
    fit = dataclasses.replace(null_model, effects=(tether,), values=(values,), point=point)
    (found,) = _as_simpler(problem, [tether, mass], [fit])
    assert found.name == "attached_mass" and found.point == pytest.approx(point[[0, 3, 4, 5, 6]])


def test_an_effect_of_a_pair_whose_other_one_is_hardly_there_is_weighed_alone(still):
    problem, null_model = still
    drag, visco, mass = (effect(name) for name in ("drag", "viscoelastic", "attached_mass"))
    there, hardly = np.array([0.2, 3.0]), np.array([0.1, -6.0])  # whose time counts for nothing
    pair = dataclasses.replace(null_model, effects=(visco, drag), point=np.concatenate([there[:1], hardly, there[1:]]))
    (found,) = _as_simpler(problem, [drag, visco, mass], [null_model, pair])
    assert found.effects == (drag,) and found.point == pytest.approx(there)
    both = dataclasses.replace(pair, point=np.array([0.2, 1.0, -6.0, 3.0]))
    assert _as_simpler(problem, [drag, visco], [both]) == []


def test_a_stated_number_that_is_not_credible_beside_an_effect_is_weighed_as_an_effect_of_its_own(still):
    problem, null_model = still
    modulus, drag, mass = (effect(name) for name in ("modulus", "drag", "attached_mass"))
    strained = dataclasses.replace(null_model, effects=(drag,), point=np.array([3.5, 20.0]))
    alone = dataclasses.replace(null_model, effects=(modulus,), point=np.array([3.5, 1.0]))
    credible = dataclasses.replace(strained, point=np.array([1.2, 20.0]))
    (found,) = _as_pairs(problem, [modulus, mass, drag], [null_model, strained, alone, credible])
    assert found.effects == (modulus, drag)
    assert found.point == pytest.approx([0.0, 3.5, 20.0])  # tolerance and scale are the same
    assert _as_pairs(problem, [drag], [strained]) == []


@pytest.mark.slow
def test_drag_on_a_body_that_is_described_half_as_stiff_is_named_with_its_modulus(made):
    twin, record = made
    recorded, drag = record("drag", (600.0,)), effect("drag")
    soft = [
        dataclasses.replace(t, setup=dataclasses.replace(t.setup, youngs_modulus=t.setup.youngs_modulus / 2))
        for t in recorded.trials
    ]
    problem = FitProblem(dataclasses.replace(recorded, trials=tuple(soft)), twin)
    null_model, end = problem.fit([((), None), ((drag,), np.array([3.5, 20.0]))], rounds=8)
    verdict = weighed(problem, [effect("modulus"), drag], null_model, [end], report=quiet)
    assert verdict.kind == "explained"
    (chosen,) = verdict.chosen
    assert chosen.name == "drag + modulus"
    numbers = {e.name: v[0] for e, v in zip(chosen.fit.effects, chosen.fit.values, strict=True)}
    assert numbers == pytest.approx({"modulus": math.log(2), "drag": 600.0}, rel=0.02)


def test_ends_of_one_name_count_once_where_they_are_the_same_place(still):
    _, null_model = still
    drag = dataclasses.replace(null_model, effects=(effect("drag"),), point=np.array([0.1, 20.0]))
    near, far = (dataclasses.replace(drag, point=np.array([0.1, x])) for x in (22.0, 40.0))
    other = dataclasses.replace(drag, effects=(effect("density"),))
    assert distinct([drag, near, null_model, far, other], ENDS) == [drag, far, other]
    many = [dataclasses.replace(drag, point=np.array([0.1, 2.0**k])) for k in range(2 * ENDS)]
    assert distinct(many, ENDS) == many[:ENDS]


@pytest.mark.parametrize(("chance", "share"), [(0.0, 1.0), (1.0, 2.0), (3.0, 10.0)])
def test_what_leaves_no_more_than_noise_and_chance_in_touching_is_in_the_running(still, chance, share):
    _, null_model = still
    where = SimpleNamespace(chance=chance)
    drag = dataclasses.replace(null_model, effects=(effect("drag"),), chi2=0.1 * null_model.samples)
    ahead = [drag] * AHEAD
    least = FARTHER * share * null_model.samples
    near, far = (dataclasses.replace(drag, chi2=by * least) for by in (0.99, 1.01))
    assert running(where, [far, near, null_model, *ahead]) == [*ahead, near]
    assert (near in running(SimpleNamespace(chance=0.0), [near, *ahead])) == (chance == 0.0)


def test_drag_is_named_with_its_number_and_its_probability(dragged):
    problem, effects, null_model, ends = dragged
    found = weighed(problem, effects, null_model, ends, report=quiet)
    assert (found.kind, found.best.name) == ("explained", "drag")
    deviation = math.sqrt(found.best.covariances[0][0, 0])
    assert found.best.values[0][0] == pytest.approx(600.0, abs=4 * deviation)
    assert deviation < 60.0
    assert found.conclusion.probabilities["drag"] > 0.95
    assert found.chosen[0].probability == pytest.approx(1 / (1 + WRONG), rel=0.01)  # as former batches have it
    assert sum(found.conclusion.probabilities.values()) == pytest.approx(1.0)
    answer = as_json(explanation(found), {})
    assert answer["verdict"] == "explained"
    assert answer["probabilities"]["drag"] == answer["effects"][0]["confidence"] == found.chosen[0].probability


@pytest.mark.slow
def test_what_breaks_down_where_it_is_most_probable_explains_nothing(dragged, monkeypatch):
    problem, effects, null_model, ends = dragged

    def broken_with_drag(problem, fit, *args):
        found = predictions(problem, fit, *args)
        return Predictions(before=(), after=(), left_out={}) if "drag" in fit.name else found

    monkeypatch.setattr(verdict, "predictions", broken_with_drag)
    said = []
    found = weighed(problem, effects, null_model, ends, report=said.append)
    assert "drag" not in {c.name for c in found.ranking}
    assert len(found.before) == len(problem.trials)
    assert "drag: breaks down where it is most probable" in said


def test_a_mode_that_breaks_down_is_approached_halfway(dragged):
    problem, _, null_model, (drag, tilt, *_) = dragged
    known = weigh(problem, [null_model, drag, tilt])
    far = [p for _, p in known[1:]]
    ends = [dataclasses.replace(fit, point=fit.point + 2.0, errors=fit.errors + 0.2) for fit, _ in known[1:]]
    (found,) = _halfway(known, far, ends, [known[2]])  # the second was simulated
    assert found.name == "drag"
    assert found.point == pytest.approx(drag.point + 1.0)
    assert found.errors == pytest.approx(drag.errors + 0.1)


@pytest.mark.slow
def test_trials_that_are_only_predicted_change_no_verdict(made, dragged):
    problem, effects, null_model, ends = dragged
    _, record = made
    verdicts = []
    for recorded in (record("drag", (600.0,)), record("gravity_tilt", (0.0, 0.2))):
        kept = [dataclasses.replace(recorded.trials[1], name="kept")]
        there = problem.only(problem.trials, experiment=dataclasses.replace(problem.experiment, heldout=tuple(kept)))
        verdicts.append(weighed(there, effects, null_model, ends, heldout=kept, report=quiet))
    one, other = verdicts
    assert one.conclusion.probabilities == other.conclusion.probabilities
    assert (one.kind, [c.fit.name for c in one.chosen]) == (other.kind, [c.fit.name for c in other.chosen])
    assert one.heldout["kept"][1] < 0.2 * one.heldout["kept"][0]
    assert other.heldout["kept"][1] > 2 * one.heldout["kept"][1]


def test_trials_left_out_are_predicted_together_as_one_by_one(dragged):
    problem, _, _, (fit, *_) = dragged
    count = len(problem.trials)
    fits = [dataclasses.replace(fit, errors=np.delete(fit.errors, i)) for i in range(count)]
    found = predictions(problem, fit, [], fits)
    assert list(found.left_out) == [t.name for t in problem.trials]
    for i, trial in enumerate(problem.trials):
        others = problem.only([t for t in problem.trials if t is not trial])
        (one,), (other,) = (predict(others, fits[i], [trial], believed=b) for b in (True, False))
        before, after = found.left_out[trial.name]
        assert before == pytest.approx(one.total, rel=1e-3)
        assert after == pytest.approx(other.total, rel=1e-3)
        assert after < 0.5 * before
        (own,) = predict(problem, fit, [trial])
        assert found.after[i].total == pytest.approx(own.total, rel=1e-3)


def test_a_trial_that_breaks_down_is_left_out_and_the_others_are_predicted(dragged):
    problem, _, _, (fit, *_) = dragged
    trial = problem.trials[0]
    crushed = dataclasses.replace(trial.setup, gravity=(0.0, 0.0, -1e6))
    broken, kept = (
        dataclasses.replace(trial, name=name, setup=setup)
        for name, setup in (("broken", crushed), ("kept", trial.setup))
    )
    found = predictions(problem, fit, [broken, kept])
    names = [*(t.name for t in problem.trials), "kept"]
    assert [p.trial for p in found.before] == [p.trial for p in found.after] == names
    assert found.left_out == {}
    assert list(predictions(problem, fit, [kept]).left_out) == ["kept"]


def test_it_is_told_what_would_make_an_effect_that_matters_visible(judged):
    assert judged.kind in ("nothing_missing", "cannot_tell")
    blind = dataclasses.replace(
        judged.conclusion, limit=3e-3, matters=1e-3, remedies={"noise": 4.0, "motion": 8.0}, kind="cannot_tell"
    )
    told = explanation(dataclasses.replace(judged, kind="cannot_tell", conclusion=blind))
    assert verdict_sentence(told).startswith("It cannot be told")
    (seen,) = (s for s in evidence(told) if "would have been seen" in s)
    assert "only if it changed the motion by 3 mm, while 1 mm matter" in seen
    assert "markers with 4 times less noise or a motion 8 times as large" in seen
    assert as_json(told, {})["visible"] == {"limit_m": 3e-3, "matters_m": 1e-3, "remedies": blind.remedies}


def test_probabilities_are_told_in_percent_and_never_as_certain():
    assert [probability(p) for p in (1.0, 0.9991, 0.42, 0.0005)] == [
        "above 99.9 %",
        "above 99.9 %",
        "42.0 %",
        "below 0.1 %",
    ]


def test_a_set_of_one_name_and_what_is_unknown_says_so(monkeypatch):
    monkeypatch.setattr(sentences, "candidate_words", lambda candidate, problem: candidate)

    def said(*chosen, kind="cannot_distinguish", credible=()):
        conclusion = SimpleNamespace(partly=False, credible=credible)
        verdict = SimpleNamespace(kind=kind, chosen=chosen, conclusion=conclusion)
        return sentences.verdict_sentence(SimpleNamespace(verdict=verdict, problem=None))

    assert said("a lag", "a leak").endswith("by which: a lag; a leak.")
    assert "none of the known effects" in said("a lag")
    assert "a leak; or none of the known effects" in said("a lag", "a leak", credible=("a lag", "unknown", "a leak"))
    assert said(kind="unknown_physics", credible=("unknown",)).endswith("none of the known effects.")
    both = said(kind="unknown_physics", credible=("unknown", "drag"))
    assert "Most probably" in both and both.endswith("drag of the surrounding fluid is not excluded.")
    assert "that nothing is missing is not" in said(kind="unknown_physics", credible=("unknown", "nothing"))


def test_why_an_effect_that_fits_is_not_told(judged):
    for credible, reason in (
        (("drag", "nothing"), "nothing is missing is not excluded"),
        (("drag",), "no better with it"),
    ):
        seen = dataclasses.replace(judged.conclusion, kind="cannot_tell", chosen=("drag",), credible=credible)
        told = evidence(explanation(dataclasses.replace(judged, kind="cannot_tell", conclusion=seen)))
        assert any("It may be drag of the surrounding fluid" in s and reason in s for s in told)
    blind = dataclasses.replace(judged.conclusion, kind="cannot_tell", chosen=(), limit=math.inf, matters=1e-3)
    told = evidence(explanation(dataclasses.replace(judged, kind="cannot_tell", conclusion=blind)))
    assert "No effect would have been seen, however large." in told


def test_each_form_of_an_effect_is_searched_however_well_another_one_looks():
    null = SimpleNamespace(chi2=1e5, samples=100, point=np.zeros(1), whitened=[np.array([1.0, -1.0, 1.0])])
    throttled, gain, modulus = ThrottledLoss(), PressureGain(), Modulus()
    looks = [(10.0 + k, throttled, np.array([0.0, 2.0**k])) for k in range(5)]
    looks.append((11.5, throttled, np.array([0.1, 2.1])))
    looks += [(50.0, gain, np.array([0.0, 2.0])), (60.0, modulus, np.array([0.0, 1.0]))]
    found = [(type(effects[0]), start[-1]) for effects, start in likely(looks, null, most=9)]  # type: ignore[arg-type]
    first, more = [(ThrottledLoss, 1.0), (Modulus, 1.0)], [(ThrottledLoss, 2.0), (ThrottledLoss, 4.0)]
    assert found == [*first, *more, (PressureGain, 2.0)]
