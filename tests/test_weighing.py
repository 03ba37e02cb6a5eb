"""How evidence is weighed: modes, looks at them, and the adjustment for errors along an effect."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from swings import EXACT, draws, recorded, weighed

from torchsoro.sim2real.inference.conclusion import conclude
from torchsoro.sim2real.inference.decision import TOLERANCE
from torchsoro.sim2real.inference.evidence import (
    Discrepancy,
    Linearised,
    Model,
    TwinError,
    infer,
)
from torchsoro.sim2real.inference.least_squares import ln_evidence_within, told
from torchsoro.sim2real.inference.priors import Prior
from torchsoro.sim2real.inference.remaining_error import by_spread
from torchsoro.sim2real.inference.weighing import adjustment


def shifted(found, by):
    """The same mode, whose evidence was found higher by so much."""
    some, none = (dataclasses.replace(b, ln_occam=b.ln_occam + by) for b in (found.some, found.none))
    return dataclasses.replace(found, some=some, none=none)


def test_evidence_that_scatters_where_a_mode_is_looked_at_again_decides_by_no_more_than_that():
    data, nothing, drag = recorded(0.0, 1, effect=0.02)
    sure = weighed(data, nothing, drag)
    off = (40.0, 0.0, -40.0)
    again = dataclasses.replace(sure, effects=tuple(shifted(p, d) for p in sure.effects for d in off))
    assert sure.scatter == 0.0
    assert again.scatter == pytest.approx(40.0)  # sample deviation of the three; the model without an effect adds none
    assert again.kappa == pytest.approx(40.0)
    # Neither the best nor the last of them counts, but the middle.
    assert [p.ln_evidence for p in again.groups["drag"]] == [sure.groups["drag"][0].ln_evidence]
    odds = [w.candidates()[0] for w in (sure, again)]
    assert odds[0]["drag"] > 0.99 > odds[1]["drag"]
    # It is followed from its last look.
    assert again.latest(again.groups["drag"][0]) is again.effects[-1]


def test_where_touching_is_no_matter_of_chance_the_most_probable_look_at_a_mode_counts():
    data, nothing, drag = recorded(0.0, 1, effect=0.02)
    sure = weighed(data, nothing, drag)
    looks = tuple(shifted(p, d) for p in sure.effects for d in (0.0, 40.0, -400.0))
    calm = dataclasses.replace(sure, effects=looks, rough=False)
    assert (calm.scatter, calm.kappa) == (0.0, 1.0)
    assert calm.groups["drag"] == (looks[1],)


def test_the_best_look_at_nothing_is_known_beside_the_one_in_the_middle():
    data, nothing, drag = recorded(0.0, 1, effect=0.02)
    sure = weighed(data, nothing, drag)
    looks = tuple(shifted(sure.null, d) for d in (-40.0, 40.0, 0.0))
    again = dataclasses.replace(sure, nothing=looks)
    assert again.null is looks[2]
    assert again.valleys == (looks[1],)
    assert again.latest(again.null) is looks[2]


def test_forms_of_a_name_are_modes_of_their_own_whatever_their_numbers():
    data, nothing, drag = recorded(0.0, 8, effect=0.3)
    linear = dataclasses.replace(drag, model=dataclasses.replace(drag.model, forms=("Linear",)))
    quadratic = dataclasses.replace(drag, model=dataclasses.replace(drag.model, forms=("Quadratic",)))
    wide = Model(effects=("drag",), priors=(Prior(1.0), Prior(1.0)), own=(0, 1), forms=("General",))
    slopes = tuple(np.concatenate([J, J**2], -1) for J in drag.slopes)
    general = Linearised(model=wide, at=np.zeros(2), residuals=drag.residuals, slopes=slopes, numerics=EXACT)
    weighing = weighed(data, nothing, linear, linear, quadratic, general)
    assert sorted(p.near.model.forms for p in weighing.groups["drag"]) == [("General",), ("Linear",), ("Quadratic",)]
    for mode in weighing.groups["drag"]:
        assert weighing.latest(mode).near.model.forms == mode.near.model.forms


def test_evidence_counts_less_where_the_twin_errs_along_an_effect():
    data, nothing, drag = recorded(0.0, 9, effect=0.05)
    size = np.full_like(data.amplitudes[0], 0.02)
    along = tuple(tuple(sign * 0.1 * J[..., 0] for J in drag.slopes) for sign in (-1, 1))
    aside = draws(data, 2, 0.02, 10)
    kappas = [
        weighed(
            data, *(dataclasses.replace(m, numerics=TwinError(amplitude=size, draws=tuple(d))) for m in (nothing, drag))
        ).kappa
        for d in ((), aside, along)
    ]
    assert kappas[0] == 1.0
    assert kappas[2] > 2 * kappas[1] > 2.0


def test_an_effect_that_moves_the_body_as_the_twin_errs_is_not_told():
    data, nothing, drag = recorded(0.0, 20)
    # The recording is off by a change like that of the effect, and so are twins that are equally good.
    off = tuple(0.1 * J[..., 0] for J in drag.slopes)
    off_models = [
        dataclasses.replace(m, residuals=tuple(r + o for r, o in zip(m.residuals, off, strict=True)))
        for m in (nothing, drag)
    ]
    scales = (-1.2, 0.9, -0.4, 1.3, 0.2, -0.8)
    variants = [[tuple(r + a * o for r, o in zip(m.residuals, off, strict=True)) for a in scales] for m in off_models]
    exact = conclude(weighed(data, *off_models), limit=0.0)
    assert exact.chosen == ("drag",)
    shifts = np.array([-5.0, 3.0, 1.0, -1.0, -3.0, 5.0])  # in no order with the scales
    priced = [by_spread(data, m, v, shifts) for m, v in zip(off_models, variants, strict=True)]
    assert conclude(weighed(data, *priced), limit=0.0).kind == "nothing_missing"


def test_the_adjustment_of_a_twin_that_errs_along_a_response_grows_with_the_square_of_its_error():
    data, nothing, drag = recorded(0.0, 21)
    size = np.full_like(data.amplitudes[0], 0.02)

    def kappa(error, share=1.0):
        twin = TwinError(amplitude=size, draws=(tuple(error * J[..., 0] for J in drag.slopes),))
        found = infer(data, dataclasses.replace(nothing, numerics=twin))
        fixed = dataclasses.replace(found.none, discrepancy=Discrepancy(share=0.01, twin=share))
        return adjustment(data, dataclasses.replace(found, some=fixed, none=fixed), drag.slopes)

    assert kappa(0.0) == 1.0
    assert kappa(0.2) - 1 == pytest.approx(4 * (kappa(0.1) - 1), rel=1e-9)
    # An error along a response is taken up by the effect, so that what is left of it says nothing of its size.
    assert kappa(0.1, share=0.1) > kappa(0.1)


def test_errors_of_several_kinds_add_up_as_one_kind_of_their_variance_does():
    data, nothing, drag = recorded(0.0, 21)
    size = np.full_like(data.amplitudes[0], 0.02)
    along = [tuple(error * J[..., 0] for J in drag.slopes) for error in (0.1, -0.1, 0.2)]

    def kappa(draws, kinds):
        twin = TwinError(amplitude=size, draws=tuple(draws), kinds=kinds)
        return adjustment(data, infer(data, dataclasses.replace(nothing, numerics=twin)), drag.slopes)

    one = kappa(along[:1], ())
    assert kappa(along[:2], (0, 0)) == pytest.approx(one, rel=1e-9)
    assert kappa(along[:2], (0, 1)) - 1 == pytest.approx(2 * (one - 1), rel=1e-9)
    assert kappa(along, (0, 0, 1)) - 1 == pytest.approx((1 + 4) * (one - 1), rel=1e-9)
    assert kappa(along, ()) - 1 == pytest.approx((1 + 1 + 4) / 3 * (one - 1), rel=1e-9)


def test_a_mode_that_was_found_twice_counts_once():
    data, nothing, drag = recorded(0.0, 11, effect=0.3)
    once, twice = weighed(data, nothing, drag), weighed(data, nothing, drag, drag)
    assert len(twice.groups["drag"]) == 1
    assert twice.candidates()[0] == once.candidates()[0]


@pytest.mark.parametrize("samples", [30, 400])
def test_an_error_tells_as_much_as_its_independent_numbers_whatever_the_rate_of_the_camera(samples):
    data, nothing, _ = recorded(0.0, 1, count=samples)
    exact = dataclasses.replace(data, noise=1e-9)
    slow = tuple(0.1 * np.sqrt(2) * np.sin(2 * np.pi * t.time)[:, None, None] * np.ones((1, 3, 2)) for t in data.trials)
    some, none = (dataclasses.replace(nothing, residuals=r) for r in (slow, tuple(0 * r for r in slow)))
    odds = ln_evidence_within(exact, some, 0.1, 8.0) - ln_evidence_within(exact, none, 0.1, 8.0)
    assert odds == pytest.approx(-4.0, rel=0.05)


def test_nothing_has_the_evidence_of_all_its_modes_as_names_have():
    data, nothing, drag = recorded(0.0, 4)
    once = weighed(data, nothing, drag)
    model = Model(effects=(), priors=(Prior(1e3),), stated=("modulus",))
    still = tuple(np.zeros_like(J) for J in drag.slopes)
    modes = [dataclasses.replace(nothing, model=model, at=np.array([x]), slopes=still) for x in (0.0, 900.0)]
    found = [infer(data, m) for m in modes]
    found = [
        dataclasses.replace(p, **{
            name: dataclasses.replace(b, mode=dataclasses.replace(b.mode, at=m.at, covariance=np.eye(1)))
            for name, b in (("some", p.some), ("none", p.none))
        })
        for p, m in zip(found, modes, strict=True)
    ]  # fmt: skip
    one, both = (dataclasses.replace(once, nothing=tuple(n)).candidates()[0] for n in (found[:1], found))
    odds = [p["nothing"] / p["drag"] for p in (one, both)]
    gained = found[1].none.ln_evidence - found[0].none.ln_evidence
    assert odds[1] / odds[0] == pytest.approx(1 + np.exp(gained), rel=1e-6)


@pytest.mark.parametrize(("off", "another"), [(1.2, None), (2.0, "drag")])
def test_nothing_with_a_stated_number_that_is_not_credible_counts_as_that_number(off, another):
    data, nothing, drag = recorded(0.0, 1, effect=0.2)
    model = Model(effects=(), priors=(Prior(TOLERANCE),), stated=("drag",))
    # A tolerance in which the effect is so many of them; the recording tells it to a hundredth.
    slopes = tuple(J * 0.2 / off for J in drag.slopes)
    found = weighed(data, dataclasses.replace(nothing, model=model, at=np.zeros(1), slopes=slopes), drag)
    assert float(told(data, found.null).at[0]) == pytest.approx(off, rel=0.05)
    assert found.another == another
    probabilities, (candidate,) = found.candidates()
    assert candidate.probability == probabilities["drag"]
    assert sum(probabilities.values()) == pytest.approx(1)
    assert (probabilities["nothing"] == 0) == (another is not None)
