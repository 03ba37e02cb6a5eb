"""Where, when and how strong a force would be needed, and the phases that a mismatch is in."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch
from ringing import SETUP, two_trials
from test_experiment import experiment

from torchsoro.sim2real.data.experiment import read_experiment
from torchsoro.sim2real.data.recording import Recording
from torchsoro.sim2real.hypotheses.outer_effects import GravityTilt
from torchsoro.sim2real.inference import histories
from torchsoro.sim2real.inference.fit import FitProblem
from torchsoro.sim2real.inference.force_map import force_map, patches
from torchsoro.sim2real.inference.heldout import predict
from torchsoro.sim2real.inference.observation import ObservationModel
from torchsoro.sim2real.inference.phases import mismatches, phases
from torchsoro.sim2real.twin.batch import simulate
from torchsoro.sim2real.twin.twin import MarkerTrajectory, Twin
from torchsoro.simulation.loads import Force

COUNT = 3  # patches


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A bar, and what its twin would record in two trials, with a force on a patch from 60 to 120 ms in the second."""
    found, thrown = two_trials(tmp_path_factory.mktemp("bar"))
    twin = Twin(found.setup, edge=0.01, across=2)

    def record(patch: int = 0, force=(0.0, 0.0, 0.0), rows: int = 40) -> FitProblem:
        time = 0.005 * np.linspace(0, 39, rows)
        rng, trials = np.random.default_rng(1), []
        share = patches(twin, COUNT)[1][patch]
        pushed = torch.tensor(force, dtype=torch.float64)
        for trial in (found.trials[0], thrown):
            still = Recording(time=time, position=np.zeros((rows, 2, 3)))
            trial = dataclasses.replace(trial, recording=still)
            s = twin.scenario(trial)
            if trial.name == thrown.name:
                forces = tuple(Force(share=share, value=f, start=t) for f, t in ((pushed, 0.06), (-pushed, 0.12)))
                s = s.replace(loads=forces)
            observation = ObservationModel(found.setup, [trial])
            errors = np.zeros(len(observation.deviations))
            errors[0], errors[6:] = 0.002, 2e-4
            seen = observation.observe(simulate(twin, [s])[0].alone(), 0, errors)
            place = seen + 5e-5 * rng.normal(size=seen.shape)
            trials.append(dataclasses.replace(trial, recording=Recording(time=time, position=place)))
        return FitProblem(dataclasses.replace(found, trials=tuple(trials)), twin)

    return record


def fitted(problem):
    (null_model,) = problem.fit([((), None)], rounds=4)
    return null_model


@pytest.mark.parametrize(
    ("patch", "force"),
    [
        (2, (0.0, 0.0, 0.05)),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in ((1, (0.0, -0.1, 0.0)), (2, (0.5, 0.0, 0.0)))),
    ],
)
def test_a_planted_force_is_found(made, patch, force):
    problem = made(patch, force)
    found = force_map(problem, fitted(problem), count=COUNT)
    needed = found.needed[0]
    axis, size = int(np.abs(force).argmax()), float(np.abs(force).max())
    width = found.windows[1, 1]
    assert needed.trial == "b" and int(np.abs(needed.force).argmax()) == axis
    assert abs(needed.place[0] - found.places[patch][0]) < 0.021
    assert abs(needed.start - 0.06) < 1.01 * width and abs(needed.end - 0.12) < 1.01 * width
    assert needed.force[axis] == pytest.approx(force[axis], rel=0.2)
    assert np.linalg.norm(needed.force - np.array(force)) < 0.25 * size
    assert found.share > 0.8 and found.simulated > 0.8


@pytest.mark.slow
def test_a_force_is_found_by_some_of_many_rows(made, monkeypatch):
    problem = made(2, (0.0, 0.0, 0.05), rows=1300)
    seen = []

    def solved(problem, *given):
        seen.extend(len(t.recording.time) for t in problem.trials)
        return histories.solve(problem, *given)

    monkeypatch.setattr("torchsoro.sim2real.inference.force_map.solve", solved)
    found = force_map(problem, fitted(problem), count=COUNT)
    assert seen and max(seen) == 434 and found.needed[0].trial == "b"
    assert found.needed[0].force[2] == pytest.approx(0.05, rel=0.2)


def test_no_force_is_needed_where_the_recording_agrees(made):
    problem = made()
    null_model = fitted(problem)
    found = force_map(problem, null_model, count=COUNT)
    assert found.share < 0.02 and not found.needed and str(found).startswith("No force")
    after = predict(problem, null_model, problem.trials)
    assert all(m.start is None for m in mismatches(problem, null_model, problem.trials, after))


# Phases -----------------------------------------------------------------------------------------------------------


def trial_of(tmp_path, tables="", pressure=""):
    """A bar of one second with what else is told."""
    chamber = '[[chamber]]\nname = "air"\nbox = [[0.01, 0.005, 0.005], [0.05, 0.015, 0.015]]\n' if pressure else ""
    setup = SETUP.replace("duration = 0.2", "duration = 1.0") + chamber + tables
    header = "time_s," + ",".join(f"{m}_{a}_m" for m in ("tip", "side") for a in "xyz")
    experiment(tmp_path, setup, header + "\n" + "\n".join(f"{0.02 * k},0.06,0.01,0.02,0.04,0,0.01" for k in range(50)))
    if pressure:
        (tmp_path / "trials" / "a" / "pressure.csv").write_text(f"time_s,air_pa\n{pressure}\n")
    return read_experiment(tmp_path).trials[0]


def motion_of(z):
    """Markers that all move up and down [S], a second long."""
    at = np.array([[0.06, 0.01, 0.02], [0.04, 0.0, 0.01]])
    place = at + z[:, None, None] * np.array([0, 0, 1.0])
    F = np.broadcast_to(np.eye(3), (len(z), 2, 3, 3))
    return MarkerTrajectory(
        time=np.linspace(0, 1, len(z)), position=place, velocity=0 * place, deformation=F, sound=np.array(True), dt=1e-3
    )


STILL = np.zeros(401)


def test_phases_of_a_pressure_are_those_that_were_written(tmp_path):
    rng = np.random.default_rng(3)
    time = np.linspace(0, 1, 501)
    p = np.interp(time, (0.2, 0.4, 0.7, 0.8), (0, 2e4, 2e4, 0)) + 50 * rng.normal(size=501)
    lines = "\n".join(f"{t},{v}" for t, v in zip(time, p, strict=True))
    found = phases(trial_of(tmp_path, pressure=lines), motion_of(STILL))
    assert [x.name for x in found] == ["first pause", "inflation", "hold", "deflation", "second pause"]
    np.testing.assert_allclose([x.start for x in found], (0, 0.2, 0.4, 0.7, 0.8), atol=0.02)
    assert found[-1].end == 1.0


def test_phases_of_a_walk_are_inflations_and_deflations(tmp_path):
    time = np.linspace(0, 1, 501)
    lines = "\n".join(f"{t},{1e4 * (1 - np.cos(4 * np.pi * t))}" for t in time)
    names = [x.name for x in phases(trial_of(tmp_path, pressure=lines), motion_of(STILL))]
    kinds = [name.split()[-1] for name in names if name.split()[-1] in ("inflation", "deflation")]
    assert kinds == ["inflation", "deflation"] * 2


def test_contact_and_flight_are_told_by_the_lowest_corner(tmp_path):
    plane = "[[plane]]\npoint = [0.0, 0.0, -0.05]\nnormal = [0.0, 0.0, 1.0]\n"
    fall = np.interp(np.linspace(0, 1, 401), (0, 0.4, 0.6, 1.0), (0.0, -0.05, -0.05, 0.0))
    trial = trial_of(tmp_path, plane)
    trial = dataclasses.replace(trial, setup=dataclasses.replace(trial.setup, clamps=()))
    found = phases(trial, motion_of(fall))
    assert [x.name for x in found] == ["first flight", "contact", "second flight"]
    assert found[1].start == pytest.approx(0.4, abs=0.03) and found[1].end == pytest.approx(0.6, abs=0.03)


def test_a_load_and_swings_are_phases(tmp_path):
    load = "[[load]]\nbox = [[0.05, 0, 0], [0.06, 0.02, 0.02]]\nforce = [0.0, 0.0, -0.1]\nstart = 0.3\n"
    found = phases(trial_of(tmp_path / "loaded", load), motion_of(STILL))
    assert [x.name for x in found] == ["time before the load", "time under the load"]
    assert found[0].end == pytest.approx(0.3, abs=0.002)
    found = phases(trial_of(tmp_path / "held", load.replace("start", "end")), motion_of(STILL))
    assert [x.name for x in found] == ["time under the load", "time after the load"]
    swing = 0.01 * np.cos(6 * np.pi * np.linspace(0, 1, 401))
    found = phases(trial_of(tmp_path / "swinging"), motion_of(swing))
    assert [x.name for x in found][:2] == ["first swing", "second swing"]
    np.testing.assert_allclose([x.start for x in found], np.arange(6) / 6, atol=0.01)


# The whole --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_report_says_which_force_no_effect_stands_for(made, tmp_path, monkeypatch):
    from torchsoro.sim2real import pipeline as explain

    problem = made(2, (0.0, 0.0, 0.05))
    monkeypatch.setattr("torchsoro.sim2real.inputs.read_experiment", lambda folder: problem.experiment)
    monkeypatch.setattr("torchsoro.sim2real.inference.verdict.library", lambda: (GravityTilt(),))
    explain.explain(explain.Options(experiment=problem.experiment.folder, out=tmp_path / "out", edge=0.01))
    answer = json.loads((tmp_path / "out" / "explanation.json").read_text())
    assert answer["verdict"] == "unknown_physics"
    needed = answer["force_map"]["needed"][0]
    assert needed["trial"] == "b" and needed["force_n"][2] == pytest.approx(0.05, rel=0.3)
    assert answer["force_map"]["words"] in (tmp_path / "out" / "report.html").read_text()
    parted = answer["mismatch"]["b"]
    assert 0.06 < parted["starts_s"] < 0.1 and "swing" in parted["phase"] and parted["worst_marker"] == "tip"
    assert {"name", "start_s", "end_s", "before", "after"} == set(parted["phases"][0])
