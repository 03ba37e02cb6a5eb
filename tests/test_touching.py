"""Differences of motions that hang on which node touches when."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from ringing import bar, effect, onto_a_floor

from torchsoro.sim2real.inference.discretization import measure
from torchsoro.sim2real.inference.fit import FitProblem
from torchsoro.sim2real.inference.likelihood import CALM, FEW_LOOKS, LOOKS, SECANT, STEP
from torchsoro.sim2real.inference.remaining_error import ORDER
from torchsoro.sim2real.inference.resolution import FINEST, finest
from torchsoro.sim2real.inference.touching import GAPS, averaged, shifted
from torchsoro.sim2real.inference.twin_error import DiscretizationError
from torchsoro.sim2real.twin.twin import Twin


@pytest.fixture(scope="module")
def on_a_floor(tmp_path_factory):
    """A bar, clamped, that swings onto a floor."""
    twin, record = bar(tmp_path_factory.mktemp("bar"))
    return FitProblem(
        onto_a_floor(record(None)), twin, fine=Twin(twin.setup, edge=0.6 * twin.edge, across=5), noise=1e-4
    )


def known(problem, chance):
    return problem.only(problem.trials, discretization=DiscretizationError(chance=0.0, chance_in_use=chance))


def test_a_mean_over_shifts_of_the_planes_is_that_of_their_motions(on_a_floor):
    problem, density = on_a_floor, effect("density")
    points = np.array([[0.0, 0.0], [0.5, 1.0]])
    requests = [((), points[:1, :1]), ((density,), points)]
    looks = 3
    gaps = np.linspace(GAPS[0], GAPS[-1], looks)
    still, (first, *_) = averaged(problem, requests, looks)
    assert [m.position.shape[0] for m in still] == [1] * len(problem.trials)
    assert first.position.shape[0] == len(points)
    by_hand = shifted(problem, [((density,), point[None]) for point in points], gaps)
    for k, motions in enumerate(by_hand):
        np.testing.assert_allclose(first.position[k], motions[0].position.mean(0), rtol=0, atol=1e-12)
        assert np.ptp(motions[0].position, axis=0).max() > 1e-6  # the planes are where they matter
    (alone,), (simulated,) = averaged(problem, requests[:1], 1), problem.simulate(requests[:1])
    assert all(np.array_equal(a.position, b.position) for a, b in zip(alone, simulated, strict=True))


@pytest.mark.parametrize("share", [0.0, 0.02, 0.2, 0.99, 1.5, 50.0])
def test_steps_and_shifts_keep_the_error_of_a_difference_calm_if_they_can(on_a_floor, share):
    chance = share * CALM * on_a_floor.noise / math.sqrt(2)
    problem = known(on_a_floor, chance)
    assert STEP <= problem.step <= SECANT
    assert 1 <= problem.looks <= LOOKS
    error = math.sqrt(2 / problem.looks) * chance / problem.step
    least = math.sqrt(2 / LOOKS) * chance / SECANT
    assert error <= max(CALM * on_a_floor.noise, least) * (1 + 1e-9)
    # No longer and no more than that takes.
    assert problem.step == pytest.approx(min(max(share, STEP), SECANT))
    assert problem.looks == min(max(math.ceil(share**2), 1), LOOKS)
    assert np.abs(problem.steps((), np.zeros(1))) == pytest.approx(problem.step)


def test_a_body_that_meets_no_plane_is_differentiated_closely(on_a_floor):
    free = [dataclasses.replace(t, setup=dataclasses.replace(t.setup, planes=())) for t in on_a_floor.trials]
    problem = known(on_a_floor.only(free), 1.0)
    assert (problem.step, problem.looks) == (STEP, 1)
    # What moves the body by many times the noise has a step that is shorter by as much.
    for rms, share in ((0.3, 1.0), (20.0, 1 / 20)):
        assert np.abs(problem.steps((), np.zeros(1), rms * np.ones((7, 1)))) == pytest.approx(share * STEP)
    loud = known(on_a_floor, 10 * CALM * on_a_floor.noise)
    assert np.abs(loud.steps((), np.zeros(1), 20.0 * np.ones((7, 1)))) == pytest.approx(loud.step)


def test_changes_by_larger_cells_are_differentiated_as_these_touch(on_a_floor):
    loud = known(on_a_floor, on_a_floor.noise)
    assert loud.finely().step == loud.step == SECANT
    assert loud.finely().looks == loud.looks > 1
    assert loud.by(loud.fine).step == STEP  # by itself it touches calmly


def test_responses_that_tell_where_to_begin_are_means_over_few_shifts(on_a_floor):
    finely = known(on_a_floor, on_a_floor.noise).finely()
    base, request = finely.base(), [((effect("density"),), np.array([[0.0, 1.0]]))]
    found = []
    for roughly, shifts in (True, FEW_LOOKS), (False, LOOKS):
        before = finely.tally.simulations
        found.append(finely.responses(request, base, roughly=roughly)[0][0].position - base.motions[0].position)
        assert finely.tally.simulations - before == 2 * shifts * len(finely.trials)  # with the density, and without
    few, many = found
    assert 0 < np.abs(few - many).max() < 0.5 * np.abs(many).max()


@pytest.mark.slow
def test_the_chance_of_both_twins_is_measured(on_a_floor):
    found = measure(on_a_floor.experiment, on_a_floor.twin, on_a_floor.fine)
    for twin, chance in ((on_a_floor.twin, found.chance_in_use), (on_a_floor.fine, found.chance)):
        problem = on_a_floor.only(on_a_floor.trials, twin=twin)
        (motions,) = shifted(problem, [((), np.zeros((1, 1)))], GAPS)
        moved = np.concatenate([np.ptp(m.position, axis=0).ravel() for m in motions])
        assert 0 < chance < moved.max()


@pytest.mark.slow
def test_a_third_twin_corrects_the_finer_one(on_a_floor):
    third = finest(on_a_floor.fine, 1, math.inf)
    assert third is not None
    known = measure(on_a_floor.experiment, on_a_floor.twin, on_a_floor.fine, finest=third)
    assert set(known.smaller) == {t.name for t in on_a_floor.trials}
    problem = on_a_floor.only(on_a_floor.trials, discretization=known)
    stated = [((), np.zeros((1, 1)))]
    plain = on_a_floor.only(on_a_floor.trials, twin=on_a_floor.fine, discretization=DiscretizationError())
    for corrected, fine, t in zip(
        *(p.simulate(stated)[0] for p in (problem.by(on_a_floor.fine), plain)), problem.trials, strict=True
    ):
        change = corrected.position[0] - fine.position[0]
        assert change == pytest.approx(known.smaller[t.name].position, abs=1e-12)
        assert 0 < np.abs(change).max() < 0.2 * np.ptp(fine.position)


@pytest.mark.slow
def test_a_calm_motion_is_extrapolated_to_cells_without_size(on_a_floor):
    third = finest(on_a_floor.fine, 1, math.inf)

    def known(noise):
        setup = dataclasses.replace(on_a_floor.experiment.setup, noise=noise)
        experiment = dataclasses.replace(on_a_floor.experiment, setup=setup)
        return measure(experiment, on_a_floor.twin, on_a_floor.fine, finest=third)

    rough, calm = known(1e-9), known(1e-2)
    assert calm.chance == rough.chance > CALM * 1e-9
    more = 1 + 1 / (FINEST**ORDER - 1)
    for name, change in rough.smaller.items():
        np.testing.assert_allclose(calm.smaller[name].position, more * change.position, atol=1e-12)
    # At first order, three times what a third twin with cells smaller by a third changes.
    assert rough.unsure == pytest.approx(2)
    assert calm.unsure == pytest.approx((more - 1) / more)


def test_a_third_twin_that_takes_too_long_is_none(on_a_floor):
    assert finest(on_a_floor.fine, 1, 1e-3) is None
