"""Fits of a small bar weighed by evidence."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from ringing import bar, effect, onto_a_floor

from torchsoro.sim2real.data.schema import PlaneTable
from torchsoro.sim2real.hypotheses.body_effects import TautTether
from torchsoro.sim2real.hypotheses.library import library
from torchsoro.sim2real.hypotheses.outer_effects import Friction, WallOffset
from torchsoro.sim2real.inference import likelihood
from torchsoro.sim2real.inference.candidates import (
    GAPS,
    at_mode,
    data_of,
    model_of,
    near,
    planes_moved,
    weigh,
    weighing_of,
    with_chance_of,
)
from torchsoro.sim2real.inference.conclusion import conclude
from torchsoro.sim2real.inference.discretization import measure
from torchsoro.sim2real.inference.fit import FitProblem
from torchsoro.sim2real.inference.gauss_newton import Asked
from torchsoro.sim2real.inference.isolability import isolability
from torchsoro.sim2real.inference.likelihood import CALM
from torchsoro.sim2real.inference.resolution import between
from torchsoro.sim2real.inference.touching import shifted
from torchsoro.sim2real.inference.twin_error import DiscretizationError
from torchsoro.sim2real.inference.visible import limit
from torchsoro.sim2real.twin.twin import Twin

NAMES = ("density",)


@pytest.fixture(scope="module")
def weighed(tmp_path_factory):
    """A bar that is a half heavier than believed, and one that is as believed."""
    twin, record = bar(tmp_path_factory.mktemp("bar"))
    fine = Twin(twin.setup, edge=0.006, across=4)
    found = {}
    for name, values in (("density", (math.log(1.5),)), (None, ())):
        problem = FitProblem(record(name, values, by=fine), twin, fine=fine)
        tasks = [((), None), *(((effect(n),), None) for n in NAMES)]
        fits = [f for f in problem.fit(tasks, rounds=5) if f is not None]
        found[name] = problem, fits, weighing_of(problem, [p for _, p in weigh(problem, fits)], names=20)
    return found


def test_a_heavier_bar_is_explained_by_its_density(weighed):
    _, _, weighing = weighed["density"]
    found = conclude(weighing, limit=0.0)
    assert (found.kind, found.chosen) == ("explained", ("density",))
    own = found.candidates[0].best
    # A bar that swings by itself tells the ratio of density and modulus only.
    ln_modulus, ln_density = 0.1 * own.mode.at[:2]
    assert ln_density - ln_modulus == pytest.approx(math.log(1.5), abs=0.02)
    assert ln_modulus == pytest.approx(0.0, abs=0.15)


def test_nothing_is_named_in_a_bar_that_is_as_believed(weighed):
    problem, _, weighing = weighed[None]
    changes = isolability(problem, [effect(n) for n in NAMES]).changes
    seen = limit(weighing.data, weighing.null, changes, 1.0, 20)
    assert 0.0 < seen < 0.1 * weighing.data.size
    found = conclude(weighing, limit=0.0)
    assert (found.kind, found.chosen) == ("nothing_missing", ())
    # The rest is shared by effects too small to matter, of which few cannot be excluded.
    assert max(found.probabilities, key=lambda name: found.probabilities[name]) == "nothing"
    assert found.probabilities["nothing"] + found.probabilities["unseen"] > 0.95 and found.credible == ("nothing",)


def test_a_fit_that_is_made_over_for_another_effect_is_linearised_as_one_of_that(weighed):
    problem, (_, fit), _ = weighed["density"]
    assert fit.columns is fit.end.columns
    point = np.concatenate([fit.point[:1], np.ones(1), 5 * np.ones(3)])
    mass = dataclasses.replace(fit, effects=(effect("attached_mass"),), point=point)
    assert mass.columns is None
    (model,) = near(problem, [mass])
    assert model is not None and model.slopes[0].shape[-1] == len(model.at) == 5 + len(fit.errors)


def test_trials_that_are_only_predicted_change_no_evidence(weighed):
    problem, _, weighing = weighed["density"]
    trial = dataclasses.replace(problem.trials[0], name="other")
    other = FitProblem(dataclasses.replace(problem.experiment, heldout=(trial,)), problem.twin)
    assert [t.name for t in data_of(other).trials] == [t.name for t in weighing.data.trials]


def test_priors_are_those_of_quantities(weighed):
    problem = weighed[None][0]
    mass = model_of(problem, (effect("attached_mass"),))
    assert [p.low for p in mass.priors[1:5]] == [0.0, 0.0, 0.0, 0.0]
    assert [p.high for p in mass.priors[2:5]] == [10.0, 10.0, 10.0]
    assert mass.own == (1, 2, 3, 4)
    assert model_of(problem, (effect("tether"),)).simpler == ("attached_mass",)
    assert model_of(problem, (TautTether(),)).simpler == ("gravity_tilt",)
    assert model_of(problem, (effect("modulus"),)).own == (0,)  # the belief is held
    assert model_of(problem, (effect("modulus"),)).released == (0,)
    assert model_of(problem, (effect("density"), effect("modulus"))).released == (1,)
    assert model_of(problem, (effect("density"),)).released == ()
    shape = model_of(problem, (effect("viscoelastic"),)).priors[2]
    assert math.isinf(shape.scale)
    assert (shape.low, shape.high) == (-9.0, 1.5)


def test_a_model_without_a_finer_twin_has_the_error_that_its_problem_states(weighed):
    problem, fits, _ = weighed[None]
    alone = problem.only(problem.trials, fine=None)
    (model,) = near(alone, fits[:1])
    stated = np.mean([alone.discretization.of(t) ** 2 for t in alone.trials], 0).T
    assert model.numerics.amplitude == pytest.approx(np.sqrt(stated))
    assert not model.numerics.draws


@pytest.fixture(scope="module")
def on_a_plane(made):
    twin, record = made
    return FitProblem(onto_a_floor(record(None)), twin, fine=Twin(twin.setup, edge=0.6 * twin.edge, across=5))


@pytest.fixture(scope="module")
def lying(on_a_plane):
    """Its fit without an effect, at the setup as stated."""
    (fit,) = on_a_plane.fit([((), None)], rounds=0)
    assert fit is not None
    return fit


def test_a_body_that_meets_a_plane_is_searched_by_the_finer_twin_however_noisy_its_recording(on_a_plane):
    problem, known = on_a_plane, DiscretizationError(chance=1e-5)
    quiet, loud = (problem.only(problem.trials, discretization=known, noise=n) for n in (1e-6, 1e-3))
    assert quiet.rough and not loud.rough and quiet.searched_finely and loud.searched_finely
    assert not problem.only(problem.trials, fine=None).searched_finely
    free = [dataclasses.replace(t, setup=dataclasses.replace(t.setup, planes=())) for t in problem.trials]
    assert not problem.only(free).searched_finely


def with_planes_moved(problem, fit):
    """Motions of each trial by the finer twin, at a fit without an effect."""
    wall = WallOffset()
    points = np.concatenate([np.tile(fit.point, (len(GAPS), 1)), GAPS[:, None] / wall.quantities[0].scale], 1)
    by_fine = problem.only(problem.trials, twin=problem.fine, discretization=DiscretizationError())
    (motions,) = by_fine.simulate([((wall,), points)])
    return motions


def test_what_leads_of_a_body_on_a_plane_is_told_by_finer_twins_whose_planes_are_moved(on_a_plane, lying):
    problem, fit = on_a_plane, lying
    assert problem.rough  # as long as nobody has moved its planes
    (model,) = near(problem, [fit], closely=True)
    assert model is not None
    motions = with_planes_moved(problem, fit)
    for i, (trial, motion) in enumerate(zip(problem.trials, motions, strict=True)):
        seen = [problem.observation.observe(motion.alone(k), i, fit.errors) for k in range(len(GAPS))]
        left = trial.recording.position - np.mean(seen, 0)
        np.testing.assert_allclose(model.residuals[i], left, rtol=0, atol=1e-9)
    assert len(model.numerics.draws) == len(GAPS) + 1  # and that of the cells


@pytest.mark.slow
def test_where_chance_is_small_planes_are_moved_at_the_setup_as_stated_alone(on_a_plane, monkeypatch):
    monkeypatch.setattr(likelihood, "SECANT", likelihood.STEP)  # the same difference quotients for both
    problem = on_a_plane
    known = measure(problem.experiment, problem.twin, problem.fine)
    assert len(known.touching) == len(GAPS)
    assert math.isfinite(known.chance)
    quiet = DiscretizationError(touching=known.touching, chance=0.99 * CALM * problem.noise)
    loud = quiet.replace(chance=1.01 * CALM * problem.noise)
    calm, rough = (problem.only(problem.trials, discretization=d) for d in (quiet, loud))
    assert rough.rough
    assert not calm.rough
    (fit,) = problem.fit([((), None)], rounds=0)
    assert fit is not None
    ((one,), (other,)) = near(calm, [fit]), near(rough, [fit], closely=True)
    assert one is not None
    assert other is not None
    for mine, theirs in zip(one.residuals, other.residuals, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-7)  # steps in time differ by what goes together
    assert one.numerics.amplitude == pytest.approx(other.numerics.amplitude, rel=1e-3)


@pytest.mark.slow
def test_what_was_simulated_for_chance_is_not_simulated_again_to_look_closely(on_a_plane):
    error = on_a_plane.discretization.replace(chance=2 * CALM * on_a_plane.noise)
    problem = on_a_plane.only(on_a_plane.trials, discretization=error)
    (fit,) = problem.fit([((), None)], rounds=0)
    assert fit is not None
    assert problem.rough
    moved, before = planes_moved(problem, fit), problem.tally.simulations
    (again,) = near(problem, [fit], closely=True, moved=moved)
    spared = problem.tally.simulations - before
    (anew,) = near(problem, [fit], closely=True)
    assert again is not None
    assert anew is not None
    assert problem.tally.simulations - before - spared == spared + len(GAPS) * len(problem.trials)
    assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(again.residuals, anew.residuals, strict=True))
    assert np.array_equal(again.numerics.amplitude, anew.numerics.amplitude)


@pytest.mark.slow
def test_chance_is_that_at_what_leads_where_it_is_more_than_as_stated(on_a_plane):
    problem = on_a_plane
    (fit,) = problem.fit([((), None)], rounds=0)
    assert fit is not None
    motions = with_planes_moved(problem, fit)
    seen = [
        np.stack([problem.observation.observe(m.alone(k), i, fit.errors) for k in range(len(GAPS))])
        for i, m in enumerate(motions)
    ]
    flat = np.concatenate([s[:, np.isfinite(s).all(0)] for s in seen], 1)
    line = np.stack([np.polyval(c, GAPS) for c in np.polyfit(GAPS, flat, 1).T], 1)
    chance = float(np.sqrt(((flat - line) ** 2).sum(0).mean() / (len(GAPS) - 2)))

    def after(known):
        error = problem.discretization.replace(chance=known)
        return with_chance_of(problem.only(problem.trials, discretization=error), planes_moved(problem, fit))

    assert after(0.0).discretization.chance == pytest.approx(chance, rel=0.02)  # recordings have lost samples
    assert after(2 * chance).discretization.chance == 2 * chance
    assert after(0.0).rough == (chance > CALM * problem.noise)


def test_a_fit_at_a_mode_has_its_numbers_and_deviations_in_si_units(weighed):
    problem, fits, weighing = weighed["density"]
    fit, found = next(f for f in fits if f.effects), weighing.groups["density"][0]
    moved = at_mode(problem, fit, found.mode)
    scales = problem.scales(fit.effects)
    assert moved.values[0] == pytest.approx(found.mode.at[1:2] * scales[1])
    assert moved.ln_factors == pytest.approx({"ln_modulus": found.mode.at[0] * scales[0]})
    assert moved.covariances[0][0, 0] == pytest.approx(found.mode.covariance[1, 1] * scales[1] ** 2)
    assert moved.errors == pytest.approx(found.mode.at[2:])


def test_a_twin_between_two_has_cells_between_theirs(weighed):
    problem = weighed[None][0]
    middle = between(problem.twin, problem.fine)
    assert problem.fine.edge < middle.edge < problem.twin.edge
    assert problem.twin.count < middle.count < problem.fine.count


@pytest.fixture(scope="module")
def sliding(made):
    """A bar that slides on a floor whose coefficient of friction is 5 % above what is stated."""
    twin, record = made
    floor = PlaneTable(point=(0.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0), friction=0.5)
    free = {"clamps": (), "gravity": (0.0, 0.0, -9.81), "velocity": (0.6, 0.0, 0.0), "planes": (floor,)}
    there = dataclasses.replace(twin, setup=dataclasses.replace(twin.setup, **free))
    slippery = floor.model_copy(update={"friction": 0.525})
    experiment = record(None, by=there, **free | {"planes": (slippery,)})
    trials = [dataclasses.replace(t, setup=dataclasses.replace(t.setup, planes=(floor,))) for t in experiment.trials]
    fine = dataclasses.replace(there, edge=0.6 * there.edge, across=4)
    return FitProblem(dataclasses.replace(experiment, trials=tuple(trials)), there, fine=fine)


def test_a_coefficient_of_friction_within_its_tolerance_is_a_belief(sliding):
    (fit,) = sliding.fit([((), None)], rounds=8)
    assert fit is not None
    assert list(fit.ln_factors) == ["ln_modulus", "ln_friction"]
    assert fit.ln_factors["ln_friction"] == pytest.approx(math.log(1.05), abs=0.01)
    friction = next(e for e in library() if isinstance(e, Friction))
    assert model_of(sliding, (friction,)).released == (1,)  # beside the modulus; the belief is held


@pytest.mark.parametrize("named", [pytest.param(False, marks=pytest.mark.slow), True])
def test_friction_that_differs_from_trial_to_trial_is_an_error_of_the_twin(sliding, named):
    """Whether friction is a belief or an effect, beside which the belief is held."""
    effects = tuple(e for e in library() if named and isinstance(e, Friction))
    (fit,) = sliding.fit([(effects, None)], rounds=4)
    assert fit is not None
    (model,) = near(sliding, [fit], closely=True)
    assert model is not None
    own = model.numerics.draws[-2:]  # of two trials
    assert len(model.numerics.draws) == len(GAPS) + 1 + 2
    for k, draw in enumerate(own):
        sizes = [np.sqrt(np.nanmean(d**2)) for d in draw]
        assert sizes[k] > 2 * sliding.noise  # what friction in all trials and measurement errors do not take up of it
        assert sizes[k] > 0.5 * sizes[1 - k]


def test_larger_cells_tell_what_changes_in_the_finer_twin(sliding):
    problem = sliding.only(sliding.trials, discretization=DiscretizationError(shift=(0.02, -0.01)))
    finely = problem.finely()
    density = effect("density")
    points = np.array([[0.1, 0.0, 0.0], [0.1, 1.0, 0.0], [0.1, -2.0, 1.0]])
    ((coarse,), (fine,)) = (p.simulate([((density,), points)]) for p in (problem, problem.by(problem.fine)))
    (mixed,) = finely.beside([Asked((density,), points)])
    base = finely.base()
    assert len(finely.probe([density], base)[0]) > 0
    # Without the effect, what is added to the motions of the base is nothing.
    (responses,) = finely.responses([((density,), np.append(base.at, 0.0)[None])], base)
    for found, at in zip(responses, base.motions, strict=True):
        np.testing.assert_allclose(found.position[0], at.position, atol=1e-7)
    for a, b, found in zip(coarse, fine, mixed, strict=True):
        np.testing.assert_allclose(found.position[0], b.position[0], atol=1e-7)
        np.testing.assert_allclose(found.position[1:] - found.position[:1], a.position[1:] - a.position[:1], atol=1e-7)
        # What they change is a measure of what the finer twin does.
        for one, other in zip(found.position[1:], b.position[1:], strict=True):
            assert np.abs(one - other).max() < 0.25 * np.abs(other - b.position[0]).max()
    with pytest.raises(ValueError, match="wanted a twin with smaller cells"):
        sliding.only(sliding.trials, fine=None).finely()


def test_what_is_known_is_not_simulated_again(sliding):
    asked = Asked((effect("density"),), np.array([[0.1, 0.0, 0.0], [0.1, 1.0, 0.0], [0.1, -2.0, 1.0]]))
    for problem, simulated in (sliding, 2), (sliding.finely(), 3):  # of the latter, all of them with larger cells
        (whole,) = problem.beside([asked])
        before = problem.tally.simulations
        (again,) = problem.beside([dataclasses.replace(asked, known=[m.alone(0) for m in whole])])
        assert problem.tally.simulations - before == simulated * len(problem.trials)
        for one, other in zip(again, whole, strict=True):
            np.testing.assert_allclose(one.position, other.position, atol=1e-12)
            assert one.sound.shape == other.sound.shape


@pytest.mark.slow
def test_a_fit_whose_derivatives_are_those_of_larger_cells_ends_where_one_by_the_finer_twin_does(sliding):
    fits = [p.fit([((), None)], rounds=8)[0] for p in (sliding.finely(), sliding.by(sliding.fine))]
    mixed, fine = (f for f in fits if f is not None)
    np.testing.assert_allclose(mixed.point, fine.point, atol=0.1)
    # Planes elsewhere by less than a cell, which are as good, change chi-squared by more than the two differ.
    there = sliding.by(sliding.fine)
    (motions,) = shifted(there, [((), fine.point[None])], GAPS)
    alike = [there.measure([m.alone(k) for m in motions], fine.errors)[0] for k in range(len(GAPS))]
    assert mixed.chi2 < np.median(alike)


@pytest.mark.slow
def test_cells_that_are_as_good_count_where_bodies_touch(on_a_plane):
    known = measure(on_a_plane.experiment, on_a_plane.twin, on_a_plane.fine)
    assert set(known.between) == {t.name for t in on_a_plane.trials}
    (fit,) = on_a_plane.fit([((), None)], rounds=0)
    assert fit is not None
    (one,), (other,) = (
        near(on_a_plane.only(on_a_plane.trials, discretization=known.replace(between=b)), [fit])
        for b in ({}, known.between)
    )
    assert one is not None
    assert other is not None
    assert len(other.numerics.draws) == len(one.numerics.draws) + 1
    assert other.numerics.size > one.numerics.size


def test_the_difference_to_larger_cells_counts_where_walls_are_two_of_these_wide(on_a_plane, lying):
    known = measure(on_a_plane.experiment, on_a_plane.twin, on_a_plane.fine)
    (one,), (other,) = (
        near(on_a_plane.only(on_a_plane.trials, discretization=known.replace(walls=w)), [lying])
        for w in ((1, 2), (2, 4))
    )
    assert one is not None
    assert other is not None
    deviation = np.mean([d**2 for d in known.deviation.values()], 0).T
    assert other.numerics.amplitude**2 == pytest.approx(one.numerics.amplitude**2 + deviation, rel=1e-9)
    assert other.numerics.size > 1.05 * one.numerics.size
