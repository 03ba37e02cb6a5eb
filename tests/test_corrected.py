"""What a finer twin, or a simulation of one's own, adds to the twin in use."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from ringing import effect

from torchsoro.sim2real.data.recording import Recording
from torchsoro.sim2real.inference.discretization import measure
from torchsoro.sim2real.inference.fit import FitProblem
from torchsoro.sim2real.inference.search import search
from torchsoro.sim2real.inference.twin_error import DiscretizationError
from torchsoro.sim2real.twin.twin import Twin


def test_a_finer_twin_corrects_where_one_is(made):
    twin, record = made
    setup = record(None).setup
    fine = Twin(setup, edge=0.6 * twin.edge, across=5)
    problem = FitProblem(record(None), twin, fine=fine)
    at = np.array([0.8])
    there = FitProblem(record(None), fine)
    wanted = there.simulate([((), at[None])])[0]
    for motion, right in zip(problem.corrected(at).simulate([((), at[None])])[0], wanted, strict=True):
        assert np.abs(motion.position - right.position).max() < 1e-7
    assert np.abs(problem.simulate([((), at[None])])[0][0].position - wanted[0].position).max() > 1e-5


def test_each_effect_is_corrected_where_it_is(made):
    twin, record = made
    fine = Twin(record(None).setup, edge=0.6 * twin.edge, across=5)
    problem = FitProblem(record(None), twin, fine=fine)
    drag, tilt = (effect(name) for name in ("drag", "gravity_tilt"))
    points = [((), np.array([[0.3]])), ((drag,), np.array([[0.5, 20.0]]))]
    told = problem.corrected_each(points)
    wanted = FitProblem(record(None), fine).simulate(points)
    for motions, right in zip(told.simulate(points), wanted, strict=True):
        for one, other in zip(motions, right, strict=True):
            assert np.abs(one.position - other.position).max() < 1e-7
    others = [((tilt,), np.array([[0.5, 1.0, 1.0]]))]
    (found,), (bare,) = told.simulate(others), problem.simulate(others)
    assert all(np.array_equal(a.position, b.position) for a, b in zip(found, bare, strict=True))


@pytest.mark.slow
def test_correction_at_the_effect_recovers_drag_of_a_finer_twin_within_3_percent(made):
    """Recordings by a finer twin, of a body that is so different that the twin's error is another than believed."""
    twin, record = made
    fine = Twin(record(None).setup, edge=0.6 * twin.edge, across=5)
    recorded, left = record("drag", (2000.0,), by=fine), []
    for other in (None, fine):
        problem = FitProblem(recorded, twin, fine=other)
        _, null_model, best = search(problem, [effect("drag"), effect("gravity_tilt")], 600.0, lambda line: None)
        assert null_model.chi2 > 3 * null_model.samples and best[0].name == "drag"
        assert best[0].values[0][0] == pytest.approx(2000.0, rel=0.03)
        left.append(best[0].chi2 / best[0].samples)
    assert left[1] < 1.1 and left[0] > 1.5


def test_a_simulation_of_ones_own_is_what_is_believed(made):
    twin, record = made
    experiment = record(None)
    still = [((), np.zeros((1, 1)))]
    problem = FitProblem(experiment, twin)
    time, trials = np.arange(0.0, 0.2001, 0.0025), []
    for trial, motion in zip(experiment.trials, problem.simulate(still)[0], strict=True):
        place = motion.alone().position[: len(time)] + 2e-3 * np.sin(40 * time)[:, None, None]
        trials.append(dataclasses.replace(trial, simulated=Recording(time=time, position=place)))
    fine = Twin(experiment.setup, edge=0.6 * twin.edge, across=5)
    assert not problem.stated
    experiment = dataclasses.replace(experiment, trials=(trials[0],), heldout=(trials[1],))
    known = measure(experiment, twin, fine)
    told = DiscretizationError(shift=known.shift, correction=known.correction)
    problem = FitProblem(experiment, twin, trials=tuple(trials), fine=fine, discretization=told)
    assert problem.stated.keys() == {t.name for t in trials}
    for motion, trial in zip(problem.simulate(still)[0], trials, strict=True):
        place = motion.alone().position
        np.testing.assert_allclose(place[: len(time)], trial.simulated.position, atol=1e-9)
        # What a clock that is behind has seen after its end goes on.
        steps = np.abs(np.diff(place[len(time) - 2 :], axis=0)).max((1, 2))
        assert len(steps) > 8 and (steps > 5e-5).all() and (steps < 1e-3).all()
    # Also where modulus and pressure are not what is believed.
    moved = problem.corrected(np.array([0.8])).discretization.correction
    assert all(moved[t.name] is known.correction[t.name] for t in trials)
