"""What follows from evidence: the twin's own error, and the credible set."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
from swings import EXACT, draws, recorded, weighed

from torchsoro.sim2real.inference import conclusion
from torchsoro.sim2real.inference.conclusion import conclude
from torchsoro.sim2real.inference.decision import (
    CREDIBLE,
    MATTERS,
    UNEXPLAINED,
    WRONG,
    WRONG_BY_LEFT,
)
from torchsoro.sim2real.inference.evidence import (
    Linearised,
    Model,
    TwinError,
    compared,
    infer,
)
from torchsoro.sim2real.inference.least_squares import ln_evidence_within, told
from torchsoro.sim2real.inference.observed import Data, TrialData, size_of
from torchsoro.sim2real.inference.priors import Prior
from torchsoro.sim2real.inference.verdict import _looked_at_again, _moved
from torchsoro.sim2real.inference.weighing import Weighing, apart, remainder


def test_an_effect_that_is_there_is_explained():
    data, nothing, drag = recorded(0.0, 4, effect=0.3)
    found = conclude(weighed(data, nothing, drag), limit=0.0)
    assert (found.kind, found.chosen) == ("explained", ("drag",))
    assert found.probabilities["drag"] > 0.95
    gain, deviation = found.predictive
    assert gain > deviation > 0


def test_nothing_is_missing_where_an_effect_that_matters_would_have_been_seen():
    data, nothing, drag = recorded(0.0, 5)
    assert conclude(weighed(data, nothing, drag), limit=0.0).kind == "nothing_missing"
    blind = conclude(weighed(data, nothing, drag), limit=1.0, remedies={"twin": 2.0})
    assert (blind.kind, blind.remedies) == ("cannot_tell", {"twin": 2.0})


def test_what_is_too_weak_to_be_seen_is_told_beside_nothing_and_changes_no_verdict():
    weighings = [weighed(*recorded(0.0, 5, effect=e)) for e in (0.0, 0.3)]
    weak, strong = (conclude(weighing, limit=0.0, too_weak=0.3) for weighing in weighings)
    # Something is missing as often as nothing.
    assert weak.kind == "nothing_missing" and strong.kind == "explained"
    assert weak.probabilities["unseen"] == pytest.approx(0.3 * weak.probabilities["nothing"], rel=1e-9)
    assert weak.probabilities["nothing"] + weak.probabilities["unseen"] > CREDIBLE
    assert strong.probabilities["unseen"] < 1e-6


@pytest.mark.parametrize("share", [0.0, 0.02])
def test_what_a_name_leaves_counts_against_it_by_the_record_of_former_ones(share):
    """What former batches say of it, up to a half; without a say in the verdict."""
    data, nothing, drag = recorded(share, 4, effect=0.3)
    weighing = weighed(data, nothing, drag)
    found = conclude(weighing, limit=0.0)
    (c,) = found.candidates
    odds = WRONG * math.exp(WRONG_BY_LEFT * c.left / math.hypot(data.noise, drag.numerics.size, c.size / 10))
    lost = min(odds / (1 + odds), 0.5)
    assert found.calibrated["drag"] == pytest.approx((1 - lost) * found.probabilities["drag"])
    assert sum(found.calibrated.values()) == pytest.approx(1.0)
    assert found.calibrated["nothing"] == found.probabilities["nothing"]
    assert lost > 0.3 if share else lost < 0.3


def test_a_discrepancy_that_no_effect_explains_is_unknown():
    data, nothing, drag = recorded(0.3, 6)
    found = conclude(weighed(data, nothing, drag), limit=0.0)
    assert (found.kind, found.chosen) == ("unknown_physics", ())


def test_a_discrepancy_that_is_no_larger_than_the_noise_is_nothing():
    data, nothing, drag = recorded(0.03, 6)
    weighing = weighed(data, nothing, drag)
    assert MATTERS * data.size < remainder(data, weighing.null) < 1.1 * data.noise
    found = conclude(weighing, limit=0.0)
    assert (found.kind, found.chosen) == ("nothing_missing", ())


@pytest.mark.parametrize("seed", [4, *(pytest.param(k, marks=pytest.mark.slow) for k in (5, 30))])
def test_an_effect_that_does_not_matter_is_told_where_nothing_is_not_credible(seed):
    data, nothing, drag = recorded(0.0, seed, effect=0.03)
    found = conclude(weighed(data, nothing, drag), limit=0.0)
    assert (found.kind, found.chosen, found.credible) == ("explained", ("drag",), ("drag",))
    assert found.candidates[0].size < MATTERS * data.size
    assert found.predictive[0] > 0
    assert sum(found.probabilities.values()) == pytest.approx(1.0, rel=1e-9)


@pytest.mark.parametrize(("effect", "seed", "predicts"), [(0.017, 4, True), (0.02, 5, True), (0.03, 4, False)])
def test_an_effect_that_does_not_matter_counts_as_nothing_where_that_is_credible(effect, seed, predicts, monkeypatch):
    data, nothing, drag = recorded(0.0, seed, effect=effect)
    if not predicts:
        monkeypatch.setattr(conclusion, "compared", lambda *_: (-1.0, 1.0))
    found = conclude(weighed(data, nothing, drag), limit=0.0)
    assert (found.kind, found.chosen, found.credible) == ("nothing_missing", (), ("nothing",))
    assert found.candidates[0].size < MATTERS * data.size
    assert found.probabilities["drag"] > found.probabilities["nothing"]
    assert (found.probabilities["drag"] < CREDIBLE) == predicts


def test_nothing_and_what_moves_less_than_the_twin_may_err_are_told_apart_no_better_than_it_can():
    data, nothing, drag = recorded(0.0, 9, effect=0.08)

    def told_by(error):
        price = TwinError(amplitude=np.full_like(data.amplitudes[0], error), draws=tuple(draws(data, 2, error, 10)))
        weighing = weighed(data, *(dataclasses.replace(m, numerics=price) for m in (nothing, drag)))
        by_evidence.append(weighing.candidates()[0]["drag"])
        found = conclude(weighing, limit=0.0)
        assert sum(found.probabilities.values()) == pytest.approx(1.0, rel=1e-9)
        return found

    by_evidence: list[float] = []
    good, fair, bad = map(told_by, (0.01, 0.02, 0.06))
    # Evidence by itself is sure, until draws of the error that tempers it are as large as what the effect changes.
    assert min(by_evidence[:2]) > 0.999 and by_evidence[2] < 0.5
    assert (good.kind, good.chosen) == ("explained", ("drag",)) and good.candidates[0].size > 0.01
    assert fair.kind == bad.kind == "nothing_missing" and fair.candidates[0].size < 0.02
    assert good.probabilities["drag"] > 0.999 > 0.5 > fair.probabilities["drag"] > bad.probabilities["drag"] > 0


def test_an_effect_that_leaves_less_than_the_noise_is_told_if_it_moves_more():
    for effect, seed, chosen in ((0.03, 14, ("drag",)), (0.04, 15, ())):
        data, nothing, drag = recorded(0.03, seed, effect=effect)
        found = conclude(weighed(data, nothing, drag), limit=0.0)
        (candidate,) = found.candidates
        assert max(UNEXPLAINED * found.left, MATTERS * data.size) < candidate.left < data.noise
        assert (candidate.left < candidate.size) == bool(chosen)
        assert found.chosen == chosen


def test_an_effect_beside_something_else_is_told_as_most_of_the_difference():
    data, nothing, drag = recorded(0.05, 14, effect=1.0)
    found = conclude(weighed(data, nothing, drag), limit=0.0)
    assert (found.kind, found.chosen, found.partly) == ("explained", ("drag",), True)
    (candidate,) = found.candidates
    assert MATTERS * data.size < candidate.left < UNEXPLAINED * found.left
    # The same effect alone leaves nothing that matters.
    data, nothing, drag = recorded(0.0, 14, effect=1.0)
    assert not conclude(weighed(data, nothing, drag), limit=0.0).partly


@pytest.fixture
def wrong():
    """Two ends, none of them right: a smooth one, easily foretold from sample to sample, and a smaller rough one."""
    data, nothing, _ = recorded(0.0, 18)
    time = data.trials[0].time
    everywhere = np.ones((1, 3, 2))
    smooth = tuple(0.2 * np.sin(4 * time)[:, None, None] * everywhere for _ in data.trials)
    rng = np.random.default_rng(18)
    rough = tuple(0.1 * rng.normal(size=(len(time), 3, 2)) for _ in data.trials)
    start = tuple(1.0 * np.sin(9 * time)[:, None, None] * everywhere for _ in data.trials)

    def ending(name, left, at):
        slopes = tuple((a - b)[..., None] / at for a, b in zip(start, left, strict=True))
        model = Model(effects=(name,), priors=(Prior(1.0),), own=(0,))
        return Linearised(model=model, at=np.zeros(1), residuals=start, slopes=slopes, numerics=EXACT)

    nothing = dataclasses.replace(nothing, residuals=start)
    return data, nothing, lambda name, at=1.0: ending(name, smooth, at), lambda name, at=1.0: ending(name, rough, at)


def test_where_no_model_is_right_the_one_that_leaves_less_is_told(wrong):
    data, nothing, smooth, rough = wrong
    weighing = weighed(data, nothing, smooth("drag"), rough("leak"))
    evidence = {p.near.model.name: p.ln_evidence for p in weighing.effects}
    found = conclude(weighing, limit=0.0)
    assert evidence["drag"] > evidence["leak"]
    assert (found.chosen, found.partly) == (("leak",), True)


def test_where_no_model_is_right_an_extension_that_leaves_less_is_told_only_if_evidence_is_for_it(wrong):
    data, nothing, smooth, rough = wrong
    drag, pair = smooth("drag"), rough("drag + leak")
    for simpler, told_first in (((), "drag + leak"), (("drag",), "drag")):
        model = dataclasses.replace(pair.model, simpler=simpler)
        weighing = weighed(data, nothing, drag, dataclasses.replace(pair, model=model))
        evidence = {p.near.model.name: p.ln_evidence for p in weighing.effects}
        assert weighing.best.matters and evidence["drag"] - evidence["drag + leak"] > 40
        assert conclude(weighing, limit=0.0).chosen == (told_first,)


@pytest.mark.parametrize(("priced", "drag"), [(0.1, 0.0), (0.15, 1.0)])
def test_evidence_is_heard_beside_size_for_a_name_that_leaves_no_more_than_the_twin_may_err(wrong, priced, drag):
    """How much more or less probable than the one that leaves less is the one that evidence is for."""
    data, *models = wrong
    models = [models[0], models[1]("drag"), models[2]("leak")]
    twin = TwinError(amplitude=np.full_like(data.amplitudes[0], priced), time=0.01)
    weighing = weighed(data, *(dataclasses.replace(m, numerics=twin) for m in models))
    evidence = {p.near.model.name: p.ln_evidence for p in weighing.effects}
    assert weighing.best.matters and evidence["drag"] - evidence["leak"] > 40
    probabilities, candidates = weighing.candidates()
    left = {c.name: c.left for c in candidates}
    assert left["leak"] < left["drag"] and (left["drag"] < priced) == bool(drag)
    assert probabilities["drag"] == pytest.approx(drag * probabilities["leak"], abs=1e-9)


def test_where_no_model_is_right_a_stated_number_that_is_off_is_held_against_a_name(wrong):
    """A name that leaves a fiftieth less, by a belief within its deviation, or at five of them."""
    data, nothing, _, rough = wrong
    leak = rough("leak")
    slopes = tuple(
        np.concatenate([r[..., None] - 0.98 * (r[..., None] - J), 1e-6 * np.ones_like(J)], -1)
        for r, J in zip(leak.residuals, leak.slopes, strict=True)
    )
    probable = []
    for deviation in (1.0, 1 / 5):
        model = Model(effects=("mass",), priors=(Prior(deviation), Prior(1.0)), own=(1,), stated=("modulus",))
        mass = dataclasses.replace(leak, model=model, at=np.zeros(2), slopes=slopes)
        probable.append(weighed(data, nothing, leak, mass).candidates()[0])
    assert probable[0]["mass"] > 0.95
    assert probable[1]["leak"] > 0.5 > probable[1]["mass"]


def test_where_no_mode_of_a_name_is_right_the_one_that_leaves_less_is_told(wrong):
    data, nothing, smooth, rough = wrong
    weighing = weighed(data, nothing, smooth("drag"), rough("drag", -1.0))
    likely, small = weighing.effects
    assert likely.ln_evidence > small.ln_evidence
    assert weighing.groups["drag"] == (small, likely)
    (candidate,) = conclude(weighing, limit=0.0).candidates
    assert candidate.best.mode.at[0] < 0


def test_a_single_trial_is_concluded_from_by_its_evidence():
    data, nothing, drag = recorded(0.05, 14, trials=1, effect=1.0)
    weighing = weighed(data, nothing, drag)
    one, other = weighing.effects[0], weighing.nothing[0]
    gain, error = compared(data, one, other, 1.0)
    assert gain == pytest.approx(one.mode.ln_evidence - other.mode.ln_evidence, rel=0.05)
    assert error == np.inf
    assert conclude(weighing, limit=0.0).chosen == ("drag",)


def test_what_leads_by_size_is_in_reach_however_far_behind_in_evidence(wrong):
    data, nothing, smooth, rough = wrong
    weighing = weighed(data, nothing, smooth("drag"), rough("leak"))
    likely, small = weighing.effects
    assert likely.ln_evidence - small.ln_evidence > 40
    assert weighing.leading is small
    assert weighing.within_reach([small, likely], 40.0) == [small]
    assert weighing.within_reach([small, likely], np.inf) == [small, likely]
    # What says whether sizes decide is looked at in any case.
    assert _looked_at_again(weighing, 1.0, 0) == [*weighing.nulls[:1], small, likely]


def test_where_no_model_is_right_it_is_linearised_again_where_its_numbers_are_told():
    data, nothing, drag = recorded(0.3, 16, effect=0.6)
    at = told(data, infer(data, drag)).at
    moved = dataclasses.replace(drag, at=at, residuals=drag.left(at))
    found, kappa = infer(data, moved), 0.25
    off, sigma = np.abs(found.mode.at - at), np.sqrt(np.diag(found.mode.covariance))
    assert (off > np.sqrt(kappa) * sigma).all()  # evidence would go on
    assert not _moved(data, found, kappa)
    assert _moved(data, infer(data, drag), kappa)
    # Not there once more, as that would be the same simulation, whose evidence scatters by nothing.
    nothing = infer(data, nothing)
    for one, again in ((found, []), (infer(data, drag), [0])):
        weighing = Weighing(data=data, nothing=(nothing,), effects=(one,), names=10)
        assert _looked_at_again(weighing, np.inf, 1) == [(one,)[k] for k in again]


def test_an_effect_that_leaves_more_than_a_fifth_of_the_difference_is_not_told():
    data, nothing, drag = recorded(0.3, 15, effect=0.6)
    found = conclude(weighed(data, nothing, drag), limit=0.0)
    (candidate,) = found.candidates
    assert candidate.left > UNEXPLAINED * found.left
    assert (found.kind, found.chosen) == ("unknown_physics", ())


@pytest.mark.parametrize("by_chance", [False, True])
def test_what_an_effect_leaves_is_no_discrepancy_where_chance_is_the_more_probable_reason(by_chance):
    data, nothing, drag = recorded(0.05, 4, effect=0.3)
    found = infer(data, drag)
    assert found.matters
    shift = 10.0 if by_chance else -10.0
    mode = dataclasses.replace(found.none.mode, ln_evidence=found.some.ln_evidence - found.none.ln_occam + shift)
    found = dataclasses.replace(found, none=dataclasses.replace(found.none, mode=mode))
    told_of = conclude(Weighing(data=data, nothing=(infer(data, nothing),), effects=(found,), names=10), limit=0.0)
    (candidate,) = told_of.candidates
    assert candidate.left > max(UNEXPLAINED * told_of.left, data.noise)
    assert told_of.kind == ("explained" if by_chance else "unknown_physics")


def test_an_effect_that_leaves_no_more_than_the_twin_may_err_is_told():
    data, nothing, drag = recorded(0.3, 15, effect=0.6)
    (candidate,) = conclude(weighed(data, nothing, drag), limit=0.0).candidates
    # Priced as large as what is left, the error of the twin may be all of it.
    price = TwinError(amplitude=np.full_like(data.amplitudes[0], 1.05 * candidate.left), time=0.1)
    found = conclude(weighed(data, *(dataclasses.replace(m, numerics=price) for m in (nothing, drag))), limit=0.0)
    assert (found.kind, found.chosen) == ("explained", ("drag",))


@pytest.mark.parametrize(("deviation", "kind"), [(57.0, "unknown_physics"), (124.0, "cannot_tell")])
def test_a_name_that_predicts_trials_left_out_surely_worse_than_nothing_is_not_it(deviation, kind, monkeypatch):
    monkeypatch.setattr(conclusion, "compared", lambda *_: (-150.0, deviation))
    data, nothing, drag = recorded(0.0, 4, effect=0.3)
    found = conclude(weighed(data, nothing, drag), limit=0.0)
    assert found.kind == kind
    likely = max(found.probabilities, key=lambda name: found.probabilities[name])
    assert likely == ("unknown" if kind == "unknown_physics" else "drag")
    assert sum(found.probabilities.values()) == pytest.approx(1.0)


def test_numbers_that_are_told_leave_the_least_where_a_discrepancy_matters():
    data, _, drag = recorded(0.3, 16, effect=0.6)
    found = infer(data, drag)
    assert found.matters
    best = found.near.left(told(data, found).at)
    assert size_of(best) < size_of(found.left)
    for step in (-0.02, 0.02):
        assert size_of(best) < size_of(found.near.left(told(data, found).at + step))
    # Without a trial they do not know it.
    one, other = (told(data, found, but=i).at for i in range(2))
    assert one != pytest.approx(other)


def test_numbers_that_are_told_are_the_most_probable_where_no_discrepancy_matters():
    data, _, drag = recorded(0.0, 17, effect=0.3)
    found = infer(data, drag)
    assert told(data, found).at == pytest.approx(found.mode.at)


def test_a_body_that_sags_may_be_off_by_all_that_it_sagged():
    time = np.linspace(0, 1, 50)
    ringing = np.exp(-20 * time) * np.cos(40 * time) - 1
    data = Data(trials=(TrialData(name="a", time=time, position=10 * ringing[:, None, None]),), noise=0.01)
    assert data.shares[1] * data.size == pytest.approx(10.0, rel=0.05)
    assert data.shares[1] > 3


def test_two_effects_that_move_alike_are_not_told_apart():
    data, nothing, drag = recorded(0.0, 7, effect=0.3)
    other = dataclasses.replace(drag, model=dataclasses.replace(drag.model, effects=("leak",)))
    found = conclude(weighed(data, nothing, drag, other), limit=0.0)
    assert (found.kind, set(found.chosen)) == ("cannot_distinguish", {"drag", "leak"})


@pytest.mark.parametrize(("left", "priced", "kind"), [
    (0.1, 1.0, "explained"), (1.0, 1.0, "cannot_distinguish"), (1.0, 0.1, "explained"),
])  # fmt: skip
def test_names_are_told_apart_no_better_than_the_twin_can(left, priced, kind):
    data, nothing, drag = recorded(0.0, 7, effect=0.3)
    time = data.trials[0].time
    bent = tuple(J * (1 + 0.2 * np.sin(9 * time))[:, None, None, None] for J in drag.slopes)
    leak = dataclasses.replace(drag, model=dataclasses.replace(drag.model, effects=("leak",)), slopes=bent)
    far = apart(*(modes[0] for modes in weighed(data, nothing, drag, leak).groups.values()))
    # The twin errs by something that neither takes up.
    error = left * far * np.sqrt(2) * np.sin(60 * time)[:, None, None]
    numerics = TwinError(amplitude=np.full_like(data.amplitudes[0], priced * far))
    models = [
        dataclasses.replace(m, residuals=tuple(r + error for r in m.residuals), numerics=numerics)
        for m in (nothing, drag, leak)
    ]
    weighing = weighed(data, *models)
    found = conclude(weighing, limit=0.0)
    assert (found.kind, found.chosen[0]) == (kind, "drag")
    if kind != "explained":
        size = min(remainder(data, weighing.best, priced=False), priced * far)
        assert size == pytest.approx(far, rel=0.2)
        one, other = (weighing.groups[name][0] for name in ("drag", "leak"))
        odds = found.probabilities["leak"] / found.probabilities["drag"]
        apart_by = 0.5 * (apart(one, other) / size) ** 2
        assert odds == pytest.approx(np.exp(-apart_by), rel=0.3)


def test_samples_that_count_as_few_numbers_tell_no_more_than_all_of_them():
    data, nothing, drag = recorded(0.0, 7, effect=0.05)
    samples = sum(np.isfinite(r).sum() for r in drag.residuals)

    def told_by(error, count):
        return ln_evidence_within(data, drag, error, count) - ln_evidence_within(data, nothing, error, count)

    every = told_by(0.0, samples)
    assert every > 10
    gained = [told_by(0.0, 20), told_by(0.2 * data.noise, 20), told_by(data.noise, 20), told_by(data.noise, 1)]
    assert gained[0] == pytest.approx(every, rel=1e-2)  # of 20 means of all samples none is lost
    assert every > gained[1] > gained[2] > gained[3]


@pytest.mark.parametrize("fits_the_error", [False, True])
def test_a_belief_beyond_its_tolerance_is_held_against_a_name_however_alike_it_moves_the_body(fits_the_error):
    data, nothing, drag = recorded(0.0, 7, effect=0.3)
    moved = size_of(tuple(0.3 * J[..., 0] for J in drag.slopes))
    numerics = TwinError(amplitude=np.full_like(data.amplitudes[0], 0.15 * moved))
    error = 0.15 * moved * np.sqrt(2) * np.sin(60 * data.trials[0].time)[:, None, None]
    # What drag does a belief does as well, at eight deviations of its own; the effect beside it does next to nothing,
    # or what the twin errs by, so that evidence is for it.
    belief = Model(effects=("leak",), priors=(Prior(0.3 / 8), Prior(1.0)), own=(1,), stated=("modulus",))
    own = error[..., None] if fits_the_error else np.array(1e-3)
    other = tuple(np.concatenate([J, own * np.ones_like(J)], -1) for J in drag.slopes)
    leak = Linearised(model=belief, at=np.zeros(2), residuals=drag.residuals, slopes=other, numerics=numerics)
    models = [
        dataclasses.replace(m, residuals=tuple(r + error for r in m.residuals), numerics=numerics)
        for m in (nothing, drag, leak)
    ]
    weighing = weighed(data, *models)
    evidence = {p.near.model.name: p.ln_evidence for p in weighing.effects}
    assert (evidence["leak"] > evidence["drag"] + 30) == fits_the_error
    found = conclude(weighing, limit=0.0)
    assert found.chosen == ("drag",)
    assert found.probabilities.get("leak", 0.0) < 0.02  # what leaves much is not told by name


def test_an_extension_that_moves_as_what_it_extends_goes_by_the_simpler_name():
    data, nothing, drag = recorded(0.0, 8, effect=0.3)
    spring = tuple(np.concatenate([J, 0.01 * J**2], -1) for J in drag.slopes)
    model = Model(effects=("tether",), priors=(Prior(1.0), Prior(1.0)), own=(0, 1), simpler=("drag",))
    tether = Linearised(model=model, at=np.zeros(2), residuals=drag.residuals, slopes=spring, numerics=EXACT)
    weighing = weighed(data, nothing, drag, tether)
    assert apart(*(modes[0] for modes in weighing.groups.values())) < MATTERS * data.size
    found = conclude(weighing, limit=0.0)
    assert (found.kind, found.chosen) == ("explained", ("drag",))
    assert found.probabilities["drag"] == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize(("priced", "name"), [(0.0, "drag + mass"), (0.03, "drag")])
def test_what_a_second_effect_adds_is_told_unless_the_twin_may_err_by_as_much(priced, name):
    """A mass that changes the motion by less than matters, as an effect by itself would be told."""
    data, nothing, drag = recorded(0.0, 8, effect=0.3)
    more = tuple(
        0.05 * J[..., 0] * np.sin(20 * t.time)[:, None, None] for J, t in zip(drag.slopes, data.trials, strict=True)
    )
    residuals = tuple(r + m for r, m in zip(drag.residuals, more, strict=True))
    both = tuple(np.concatenate([J, m[..., None]], -1) for J, m in zip(drag.slopes, more, strict=True))
    model = Model(effects=("drag", "mass"), priors=(Prior(1.0), Prior(1.0)), own=(0, 1), simpler=("drag", "mass"))
    twin = dataclasses.replace(EXACT, amplitude=EXACT.amplitude + priced * data.size)
    pair = Linearised(model=model, at=np.zeros(2), residuals=residuals, slopes=both, numerics=twin)
    drag = dataclasses.replace(drag, residuals=residuals, numerics=twin)
    weighing = weighed(data, dataclasses.replace(nothing, residuals=residuals, numerics=twin), drag, pair)
    assert apart(*(modes[0] for modes in weighing.groups.values())) < MATTERS * data.size
    assert conclude(weighing, limit=0.0).chosen == (name,)


@pytest.mark.parametrize(
    ("share", "priced", "lasting", "name"),
    [(0.05, 0.0, 0.1, "drag"), (0.15, 0.0, 0.1, "tether"), (0.15, 3.0, 0.001, "tether"), (0.15, 3.0, 1.0, "drag")],
)
def test_an_extension_keeps_its_name_where_evidence_is_for_a_difference_that_matters(share, priced, lasting, name):
    data, nothing, drag = recorded(0.0, 8, effect=0.3)
    more = tuple(
        share * J[..., 0] * np.sin(20 * t.time)[:, None, None] for J, t in zip(drag.slopes, data.trials, strict=True)
    )
    residuals = tuple(r + m for r, m in zip(drag.residuals, more, strict=True))
    spring = tuple(np.concatenate([J, m[..., None]], -1) for J, m in zip(drag.slopes, more, strict=True))
    model = Model(effects=("tether",), priors=(Prior(1.0), Prior(1.0)), own=(0, 1), simpler=("drag",))
    error = priced * MATTERS * data.size  # where it passes at once, it cannot be what makes the difference
    of = {"draws": tuple(draws(data, 2, error, 10, lasting))} if priced else {}
    twin = dataclasses.replace(EXACT, amplitude=EXACT.amplitude + error, **of)
    tether = Linearised(model=model, at=np.zeros(2), residuals=residuals, slopes=spring, numerics=twin)
    drag = dataclasses.replace(drag, residuals=residuals, numerics=twin)
    weighing = weighed(data, dataclasses.replace(nothing, residuals=residuals, numerics=twin), drag, tether)
    distance = apart(*(modes[0] for modes in weighing.groups.values()))
    assert (distance < MATTERS * data.size) == (share < 0.1)
    assert not priced or distance < twin.size
    found = conclude(weighing, limit=0.0)
    assert (found.kind, found.chosen) == ("explained", (name,))


@pytest.mark.parametrize(("simple", "called"), [(4e-6, "nothing"), (12e-6, "lag")])
def test_an_extension_of_what_moves_less_than_the_twin_may_err_is_told_as_nothing(simple, called, monkeypatch):
    monkeypatch.setattr(conclusion, "apart", lambda *_: 10e-6)  # less than what matters
    near = SimpleNamespace(
        numerics=SimpleNamespace(size=9e-6), model=SimpleNamespace(simpler=("lag",), effects=("leak",))
    )
    common = {"best": SimpleNamespace(near=near, matters=False), "left": 0.0, "credible": True, "ln_evidence": 0.0}
    leak = SimpleNamespace(name="leak", size=14e-6, probability=0.9, **common)
    lag = SimpleNamespace(name="lag", size=simple, probability=0.01, **common)
    names = {"leak": leak, "lag": lag}
    found = conclusion._meaning(leak, names, 1e-4, 1e-4, 40e-6, 9e-6, lambda *_: True)
    assert found == ("nothing", called)
