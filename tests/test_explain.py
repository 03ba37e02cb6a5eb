"""From recordings to a verdict, on recordings that the twin itself made: that this works says nothing of real ones."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from ringing import EDGE, effect

from torchsoro.sim2real import inputs, pipeline
from torchsoro.sim2real.data.recording import Recording, read_table
from torchsoro.sim2real.data.schema import PlaneTable
from torchsoro.sim2real.hypotheses.library import library
from torchsoro.sim2real.inference.discretization import measure
from torchsoro.sim2real.inference.fit import FitProblem
from torchsoro.sim2real.inference.heldout import predict
from torchsoro.sim2real.inference.model import predict_trial, read_model
from torchsoro.sim2real.inference.noise import LASTING, NoiseModel, estimate_noise
from torchsoro.sim2real.inference.observation import MarkerSlip, ObservationModel
from torchsoro.sim2real.inference.recording_faults import find_slips
from torchsoro.sim2real.inference.resolution import WALLS, choose_twin, cost, finer
from torchsoro.sim2real.inference.search import _by_finer
from torchsoro.sim2real.inference.starts import FIRST, null_starts, spread
from torchsoro.sim2real.inference.verdict import judge
from torchsoro.sim2real.report.explanation import as_json, effect_rows
from torchsoro.sim2real.report.words import digits
from torchsoro.sim2real.twin.batch import simulate
from torchsoro.sim2real.twin.twin import MarkerTrajectory, Twin

# Measurement ------------------------------------------------------------------------------------------------------


def test_derivatives_by_measurement_errors_are_those_of_differences():
    rng = np.random.default_rng(0)
    steps, markers = 30, 2
    time = np.linspace(0, 0.3, steps)
    place = np.stack([np.sin(7 * time + i) for i in range(3 * markers)], -1).reshape(steps, markers, 3)
    velocity = np.stack([7 * np.cos(7 * time + i) for i in range(3 * markers)], -1).reshape(steps, markers, 3)
    gradient = np.broadcast_to(np.eye(3) + 0.1 * rng.normal(size=(1, markers, 3, 3)), (steps, markers, 3, 3))
    motion = MarkerTrajectory(
        time=time, position=place, velocity=velocity, deformation=gradient, sound=np.array(True), dt=1e-3
    )
    recording = Recording(time=np.linspace(0.05, 0.25, 9), position=np.zeros((9, markers, 2)), axes=(0, 2))

    class Two:
        markers = (dataclasses.make_dataclass("M", ["name"])("a"), dataclasses.make_dataclass("M", ["name"])("b"))
        axes, kind = (0, 2), "video"

    trial = dataclasses.make_dataclass("T", ["name", "recording"])("t", recording)
    slip = MarkerSlip(trial="t", marker=1, start=0.1)
    observation = ObservationModel(Two(), [trial], slips=[slip])  # type: ignore[arg-type]
    assert len(observation.names) == len(observation.deviations) == 1 + 5 + 6 + 3
    at = 0.5 * observation.deviations * rng.normal(size=len(observation.deviations))
    _, by = observation.linearise(motion, 0, at)
    for k, scale in enumerate(observation.deviations):
        step = np.zeros_like(at)
        step[k] = 1e-3 * scale
        difference = (observation.observe(motion, 0, at + step) - observation.observe(motion, 0, at - step)) / (
            2e-3 * scale
        )
        # Rotations add up only where they are small, and a spline's second derivative jumps.
        np.testing.assert_allclose(by[..., k], difference, rtol=0.02, atol=0.02 * np.abs(difference).max() + 1e-9)


def test_noise_model_whitens_noise_of_its_own_covariance():
    rng = np.random.default_rng(2)
    time = np.arange(60) * 0.01
    discretization = np.array([[2e-4, 0.0]])
    alike = np.exp(-np.abs(time[:, None] - time[None]) / 0.03)
    noise_model = NoiseModel(Recording(time=time, position=np.zeros((60, 1, 2)), axes=(0, 2)), 1e-4, discretization)
    noise = 1e-8 * ((1 - LASTING) * np.eye(60) + LASTING * alike)
    root = [np.linalg.cholesky(noise + n**2 * alike) for n in discretization[0]]
    draws = rng.normal(size=(2, 60, 400))
    values = np.stack([root[a] @ draws[a] for a in range(2)], 1)[:, None]
    np.testing.assert_allclose(noise_model.whiten(values), draws.reshape(120, 400), atol=1e-9)


@pytest.mark.parametrize("noise", [3e-5, 2e-4])
def test_noise_is_found_beside_motion(noise):
    rng = np.random.default_rng(3)
    time = np.arange(300) * 0.01
    motion = 0.01 * np.exp(-time)[:, None, None] * np.sin(2 * np.pi * 5 * time)[:, None, None] * np.ones((1, 4, 3))
    place = motion + noise * rng.normal(size=motion.shape)
    assert estimate_noise([Recording(time=time, position=place)]) == pytest.approx(noise, rel=0.3)


def test_a_marker_that_slips_is_found_and_a_motion_of_all_is_not(made):
    _, record = made
    trials = record(None).trials
    rng = np.random.default_rng(4)
    still = [5e-5 * rng.normal(size=t.recording.position.shape) for t in trials]
    noise_models = [NoiseModel(t.recording, 5e-5, np.zeros((2, 3))) for t in trials]
    assert not find_slips(trials, noise_models, still)
    slipped = [r.copy() for r in still]
    slipped[1][trials[1].recording.time > 0.1, 1] += [1e-3, 0.0, -1e-3]
    (slip,) = find_slips(trials, noise_models, slipped)
    assert (slip.trial, slip.marker) == ("b", 1) and slip.start == pytest.approx(0.1, abs=0.01)
    swinging = [r + 1e-3 * np.sin(60 * t.recording.time)[:, None, None] for r, t in zip(still, trials, strict=True)]
    assert not find_slips(trials, noise_models, swinging)


# Fits -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "values", "wrong"),
    [("drag", (600.0,), 0.15), ("attached_mass", (0.004, 0.055, 0.01, 0.015), 0.35)],
)
def test_finds_what_its_own_twin_was_given(made, name, values, wrong):
    twin, record = made
    recorded = record(name, values)
    problem = FitProblem(recorded, twin, trials=recorded.trials[:1])
    (ranked,) = problem.probe([effect(name)], problem.base())
    fits = problem.fit([((effect(name),), start) for _, start in ranked[:3]])
    fit = min((f for f in fits if f is not None), key=lambda fit: fit.chi2)
    assert fit.chi2 / fit.samples == pytest.approx(1.0, abs=0.35)
    # A mass near the tip is a lighter one at the tip of a bar that is softer within what is believed.
    assert fit.values[0][0] == pytest.approx(values[0], rel=wrong)
    deviation = np.sqrt(np.diag(fit.covariances[0]))
    if len(values) == 1:
        assert abs(fit.values[0][0] - values[0]) < 4 * deviation[0]
    if len(values) > 1:
        assert np.abs(fit.values[0][1:] - values[1:]).max() < 0.006
    (one,) = predict(problem, fit, recorded.trials[1:])
    (other,) = predict(problem, fit, recorded.trials[1:], believed=True)
    assert one.total < 0.3 * other.total


def test_the_beginning_of_a_trial_is_that_of_its_recording(made):
    twin, record = made
    recorded = record(None)
    late = []
    for trial in recorded.trials:
        held = trial.recording.time > 0.5 * trial.setup.duration
        recording = dataclasses.replace(
            trial.recording, time=trial.recording.time[held], position=trial.recording.position[held]
        )
        late.append(dataclasses.replace(trial, recording=recording))
    early = FitProblem(recorded, twin, trials=tuple(late)).early(0.4)
    for whole, part in zip(late, early.trials, strict=True):
        share = len(part.recording.time) / len(whole.recording.time)
        assert share == pytest.approx(0.4, abs=0.05)


def test_a_clock_that_is_behind_has_seen_what_comes_after_the_end(made):
    """What it shows at the end happened later; the body has not stopped by then."""
    twin, record = made
    experiment, behind, trials = record(None), 0.012, []
    for trial in experiment.trials:
        (motion,) = simulate(twin, [twin.scenario(trial).replace(until=0.3)])
        observation = ObservationModel(experiment.setup, [trial])
        place = observation.observe(
            motion.alone(), 0, np.where(np.arange(len(observation.deviations)) == 0, -behind, 0.0)
        )
        recording = dataclasses.replace(trial.recording, position=place)
        trials.append(dataclasses.replace(trial, recording=recording))
    problem = FitProblem(experiment, twin, trials=tuple(trials))
    for part, end in ((problem, 0.2), (problem.early(0.5), 0.1)):
        motions = [m.alone() for m in part.simulate([((), np.zeros((1, 1)))])[0]]
        chi2, errors, _, _ = part.measure(motions, np.zeros(len(part.observation.deviations)))
        # Nothing is left but what so late a clock costs by its prior.
        assert errors[:2] == pytest.approx(-behind, abs=2e-4)
        assert chi2 < 2 * (behind / part.observation.deviations[0]) ** 2
        assert all(s.duration == pytest.approx(end) for s in part.scenarios)


def test_a_leak_is_a_lag_at_a_lower_pressure_and_at_once_a_loss():
    lag, loss = effect("leak").simpler(np.array([0.1, 0.02]))
    assert lag.name == "pressure_lag" and lag.values == pytest.approx([0.02])
    assert np.exp(lag.ln_pressure) == pytest.approx(0.9)
    told = effect("pressure_loss").reported(loss.values, None, None)
    assert loss.name == "pressure_loss" and told["fraction"][0] == pytest.approx(0.1)
    assert not loss.ln_pressure


def test_a_mass_on_the_side_of_a_hanging_bar_is_looked_for_there(made):
    twin, record = made
    recorded = record("attached_mass", (0.002, 0.05, 0.01, 0.02), gravity=(9.81, 0.0, 0.0))
    problem = FitProblem(recorded, twin, trials=recorded.trials)
    (ranked,) = problem.probe([effect("attached_mass")], problem.base())
    _, start = ranked[0]
    assert start[-3:] / 10 * twin.setup.size == pytest.approx((0.05, 0.01, 0.02), abs=0.006)
    (fit,) = problem.fit([((effect("attached_mass"),), start)])
    assert fit is not None and fit.chi2 / fit.samples == pytest.approx(1.0, abs=0.35)
    assert fit.values[0] == pytest.approx((0.002, 0.05, 0.01, 0.02), rel=0.3, abs=0.003)
    (row,) = effect_rows(fit, 1.0, problem)
    off = np.abs(np.array(row["location_m"]) - (0.05, 0.01, 0.02))
    assert (off < 2 * np.array(row["location_within_m"])).all() and max(row["location_within_m"]) < 0.02
    # What is not known is still within the body.
    (row,) = effect_rows(dataclasses.replace(fit, covariances=(np.eye(4),)), 1.0, problem)
    place, size = np.array(row["location_m"]), np.array(twin.setup.size)
    assert row["location_within_m"] == pytest.approx(np.maximum(place, size - place))


def test_a_fit_without_a_trial_is_near_what_the_other_trials_give(made):
    """The trial that is left out disagrees, so that the fits differ."""
    twin, record = made
    told = record("drag", (600.0,))
    off = dataclasses.replace(told.trials[1], recording=record("drag", (500.0,)).trials[1].recording)
    problem = FitProblem(dataclasses.replace(told, trials=(told.trials[0], off)), twin)
    tasks = [((effect("drag"),), np.array([0.0, 1.0]))]
    (both,) = problem.fit(tasks)
    there = problem.only(problem.trials[:1])
    (one,) = there.fit(tasks)
    found = problem.without(both, 1)
    assert found.errors.shape == one.errors.shape
    away = abs(both.point - one.point)
    assert away[1] > 0.1 * one.point[1]
    assert (abs(found.point - one.point) < 0.2 * away + 0.01).all()


def test_prior_residual_is_small_within_the_tolerance_and_large_beyond(made):
    twin, record = made
    problem = FitProblem(record(None), twin)
    held = np.array([False])
    costs = [float((problem.prior_residual(np.array([a]), held)[0] ** 2).sum()) for a in (0.0, 1.0, 2.0)]
    assert costs[0] == 0 and costs[1] < 0.1 and costs[2] > 20
    for a in (0.5, 1.5):
        r, slope = (x[0] for x in problem.prior_residual(np.array([a]), held))
        ahead = problem.prior_residual(np.array([a + 1e-6]), held)[0][0]
        assert (ahead - r) / 1e-6 == pytest.approx(slope, rel=0.1)
    assert not problem.prior_residual(np.array([3.0]), np.array([True]))[0].any()


@pytest.mark.slow
def test_a_verdict_names_the_effect_or_nothing(made):
    twin, record = made
    effects = [effect(name) for name in ("modulus", "drag", "gravity_tilt")]
    quiet = {"report": lambda line: None}
    told = judge(FitProblem(record("drag", (600.0,)), twin), effects, **quiet)
    assert told.kind == "explained" and told.chosen[0].fit.name == "drag"
    deviation = float(np.sqrt(told.chosen[0].fit.covariances[0][0, 0]))
    assert abs(told.chosen[0].fit.values[0][0] - 600.0) < 5 * deviation
    assert judge(FitProblem(record(None), twin), effects, **quiet).kind == "nothing_missing"


@pytest.mark.slow
def test_a_wrong_frequency_is_found_over_many_swings(made):
    """A modulus so wrong that simulation and recording are out of phase long before the end."""
    twin, record = made
    recorded = record("modulus", (0.9,))
    told = judge(FitProblem(recorded, twin), [effect("modulus"), effect("drag")], report=lambda line: None)
    assert told.chosen and told.chosen[0].fit.name == "modulus"
    assert told.chosen[0].fit.values[0][0] == pytest.approx(0.9, abs=0.01)


# The whole --------------------------------------------------------------------------------------------------------


def test_a_twin_that_a_budget_cannot_pay_is_refused(made):
    _, record = made
    setup = record(None).setup
    assert choose_twin(setup, 2, 600.0).count <= choose_twin(setup, 2, 6000.0).count
    # Where a body slides, a finer one is worth more of the time.
    fine, coarse = (Twin(setup, edge=0.02 / n, across=n) for n in (3, 2))
    enough = 30 * cost(fine, 2)
    ground = PlaneTable(point=(0.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0), friction="stick")
    chosen = [choose_twin(s, 2, enough).count for s in (setup, dataclasses.replace(setup, planes=(ground,)))]
    assert chosen == [coarse.count, fine.count]
    with pytest.raises(ValueError, match=r"budget: .* minutes, wanted"):
        choose_twin(setup, 2, 0.01)


def test_effects_that_cannot_act_and_trials_without_a_recording_are_refused(made, tmp_path, monkeypatch):
    _, record = made
    recorded = record("drag", (800.0,))
    monkeypatch.setattr(inputs, "read_experiment", lambda folder: recorded)
    asked = pipeline.Options(experiment=recorded.folder, out=tmp_path / "out", edge=EDGE)
    with pytest.raises(ValueError, match="effects = friction: wanted one that can act"):
        inputs.read_inputs(dataclasses.replace(asked, effects=("friction",)))
    blank = (*recorded.trials, dataclasses.replace(recorded.trials[0], name="c", recording=None))
    monkeypatch.setattr(inputs, "read_experiment", lambda folder: dataclasses.replace(recorded, trials=blank))
    with pytest.raises(ValueError, match=r"trials/c: no markers\.csv, wanted one in each trial"):
        inputs.read_inputs(asked)


def test_a_beginning_without_samples_is_none(made):
    twin, record = made
    experiment = record(None)
    early = FitProblem(experiment, twin).early(0.35)
    assert early is not None and all(t.setup.duration == pytest.approx(0.07) for t in early.trials)
    assert FitProblem(experiment, twin).early(0.12) is None
    recording = experiment.trials[0].recording
    before = dataclasses.replace(recording, time=recording.time - 0.06)
    experiment = dataclasses.replace(experiment, trials=(dataclasses.replace(experiment.trials[0], recording=before),))
    early = FitProblem(experiment, twin).early(0.12)
    assert early is not None and early.trials[0].setup.duration == pytest.approx(0.024)


def test_planes_of_one_trial_alone_are_touched(made):
    twin, record = made
    experiment = record(None)
    ground = PlaneTable(point=(0.0, 0.0, -0.005), normal=(0.0, 0.0, 1.0), friction="stick")
    one, other = experiment.trials
    other = dataclasses.replace(other, setup=dataclasses.replace(other.setup, planes=(ground,)))
    experiment = dataclasses.replace(experiment, trials=(one, other))
    fine = Twin(experiment.setup, edge=0.6 * twin.edge, across=5)
    assert [np.isfinite(d).all() for d in measure(experiment, twin, fine).deviation.values()] == [True, True]


def test_the_null_model_of_a_body_on_a_plane_begins_where_what_is_stated_leaves_least(made):
    twin, record = made
    experiment = record("modulus", (-0.06,))
    starts = null_starts(FitProblem(experiment, twin, noise=5e-5))
    assert len(starts) == FIRST and all(not effects and np.abs(at).max() <= 1 for effects, at in starts)
    # Tolerance of ln of the modulus: 0.1. Of sixteen even places the two nearest are within an eighth of it.
    assert [float(at[0]) for _, at in starts] == pytest.approx([-0.6, -0.6], abs=0.13)


@pytest.mark.slow
def test_the_finer_twin_finds_from_evenly_spread_points_what_its_own_recordings_hide(made):
    twin, record = made
    fine = finer(twin, 2, 40.0)
    problem = FitProblem(record("drag", (800.0,), by=fine), twin, fine=fine, noise=5e-5)
    (null_model,) = problem.fit([((), None)])
    assert null_model is not None
    nothing, found = _by_finer(problem, [effect("drag")], null_model, [], lambda line: None)
    assert found[0].name == "drag" and found[0].chi2 < 0.1 * min(f.chi2 for f in nothing)
    assert found[0].values[0] == pytest.approx([800.0], rel=0.1)


@pytest.mark.slow
def test_components_that_add_up_are_told_by_the_finer_twin_from_afar(made):
    twin, record = made
    fine = finer(twin, 1, 5.0)
    tilt = (0.0, 12 * 0.03)  # twelve times what is noticeable, six times the farthest point that is screened
    problem = FitProblem(record("gravity_tilt", tilt, by=fine), twin, fine=fine, noise=5e-5)
    (null_model,) = problem.fit([((), None)])
    assert null_model is not None
    _, found = _by_finer(problem, [effect("gravity_tilt")], null_model, [], lambda line: None)
    assert found[0].values[0] == pytest.approx(tilt, abs=0.03)


@pytest.mark.parametrize("one", library(), ids=lambda e: type(e).__name__)
def test_screened_points_are_within_bounds_and_places_within_the_body(made, one):
    twin, record = made
    points = spread(twin, one)
    low, high = FitProblem(record(None), twin).bounds((one,))
    assert (points >= low[1:]).all() and (points <= high[1:]).all()
    assert len(np.unique(points, axis=0)) == len(points) and np.abs(points[:, : len(one.quantities)]).max(1).all()
    if one.local:  # even in the body: each half of each edge has half of them
        middle = 10 * np.array(twin.setup.center) / np.array(twin.setup.size)
        assert (points[:, -3:] < middle).mean(0) == pytest.approx(0.5, abs=0.1)


@pytest.mark.slow
def test_the_recording_that_comes_along_lacks_the_fluid_around_its_bar(tmp_path):
    found = pipeline.explain(pipeline.Options(experiment=Path("bar"), out=tmp_path)).verdict
    assert found.kind == "explained" and [c.name for c in found.chosen] == ["drag"]
    ((before, after),) = found.heldout.values()
    assert after < 0.35 * before  # with noise and the markers' unknown places, of which both errors consist in part


def test_the_recipe_writes_its_answer(made, tmp_path, monkeypatch):
    _, record = made
    setup = record(None).setup
    recorded = record("drag", (800.0,), by=finer(Twin(setup, edge=EDGE, walls=WALLS), 2, 40.0))
    monkeypatch.setattr(inputs, "read_experiment", lambda folder: recorded)
    monkeypatch.setattr("torchsoro.sim2real.inference.verdict.library", lambda: (effect("drag"),))
    told = pipeline.explain(pipeline.Options(experiment=recorded.folder, out=tmp_path / "out", edge=EDGE))
    assert told is not None
    blind = dataclasses.replace(told.verdict.conclusion, limit=np.inf)  # JSON knows no infinity
    verdict = dataclasses.replace(told.verdict, conclusion=blind)
    json.dumps(as_json(dataclasses.replace(told, verdict=verdict), {}), allow_nan=False)
    answer = json.loads((tmp_path / "out" / "explanation.json").read_text())
    assert answer["verdict"] == "explained" and answer["set"] == ["drag"]
    found = answer["effects"][0]["parameters"]["density_drag_kg_m3"]
    assert found["low"] < found["value"] < found["high"] and found["value"] == pytest.approx(800.0, rel=0.15)
    assert set(answer) >= {"ranking", "noise", "nuisance", "error_before", "error_after", "heldout", "cost", "version"}
    assert set(answer["isolability"]) >= {"effects", "detectable", "alike"}
    assert answer["force_map"] is None and answer["mismatch"]["b"]["phase"].endswith("swing")
    assert answer["error_after"]["a"]["all"] < 0.5 * answer["error_before"]["a"]["all"]
    page = (tmp_path / "out" / "report.html").read_text()
    assert re.search(
        r'<p class="lead">The difference is explained by drag [^:]*: [^:]* \d+ kg/m³ \(90 %: \d+ to \d+ kg/m³', page
    )
    assert page.count("data:image/png") == 6
    # The first screen has the numbers of the JSON.
    better, worst = answer["improvement"], answer["worst"]
    large = [f"{digits(1e3 * better[key])} mm" for key in ("believed_m", "explained_m", "floor_m")]
    assert re.findall(r"<b>([^<]*)</b>", page) == large and not better["heldout"]
    assert better["explained_m"] < 0.5 * better["believed_m"]
    noise = answer["noise"]
    floor = np.sqrt(3) * np.hypot(noise["standard_deviation_m"], noise["simulation_m"])
    assert better["floor_m"] == pytest.approx(floor)
    for key in ("believed_m", "explained_m"):
        squares = [error["all"] ** 2 for error in answer[f"error_{'after' if key[0] == 'e' else 'before'}"].values()]
        assert better[key] == pytest.approx(np.sqrt(np.mean(squares)))
    shown = next(t.recording for t in recorded.trials if t.name == worst["trial"])
    assert worst["time_s"] in shown.time and worst["believed_m"] > max(answer["error_before"][worst["trial"]].values())
    folder = tmp_path / "new"
    folder.mkdir()
    (folder / "trial.toml").write_text("duration = 0.05\n[start]\nvelocity = [0.0, 0.0, 0.2]\n")
    model, markers = tmp_path / "out" / "model.toml", tmp_path / "markers.csv"
    pipeline.run(pipeline.Options(predict=model, trial=folder / "trial.toml", out=markers))
    columns = read_table(markers)
    assert columns["time_s"][-1] == pytest.approx(0.05) and len(columns) == 7
    believed = dataclasses.replace(read_model(model), effects=(), ln_modulus=0.0)
    plain = predict_trial(believed, folder / "trial.toml", model)["tip_z_m"]
    # Drag holds back what is thrown.
    assert max(columns["tip_z_m"]) < plain.max() - 1e-5
    model.write_text(model.read_text().replace('name = "drag"', 'name = "wind"'))
    with pytest.raises(ValueError, match=r"name = 'wind', wanted one of"):
        read_model(model)
    # Some effects share a name.
    before = re.sub(r"(?s)\[\[effect\]\]\n.*?(?=\n\[|$)", "", model.read_text()).rstrip() + "\n"
    for e in library():
        numbers = "".join(f"{q.name} = 0.1\n" for q in e.quantities) + "at = [0.0, 0.0, 0.0]\n" * e.local
        model.write_text(f'{before}[[effect]]\nname = "{e.name}"\n{numbers}')
        ((told, _),) = read_model(model).effects
        assert type(told) is type(e)
    model.write_text(f'{before}[[effect]]\nname = "friction"\nmu = 0.3\n')
    with pytest.raises(ValueError, match="friction has mu, wanted inverse_coefficient or ln_factor"):
        read_model(model)


@pytest.mark.slow
def test_measurement_errors_stay_within_10_deviations_where_no_effect_explains(made):
    """A wind that is none of the effects at hand: what is left is priced, and measurement errors stay believable."""
    twin, record = made
    recorded = record("attached_mass", (0.01, 0.06, 0.01, 0.01))
    told = judge(
        FitProblem(recorded, twin),
        [effect("gravity_tilt"), effect("drag")],
        report=lambda line: None,
    )
    assert told.kind != "explained" and told.posterior.matters
    errors = np.abs(told.null_model.errors / told.problem.observation.deviations)
    assert errors.max() < 10.001
    # What no effect explains is no error of the simulation.
    assert not told.problem.discretization.mean.any()


@pytest.mark.slow
def test_two_effects_are_found_where_one_does_not_do(made):
    """A bar that is drawn by a fluid and let go with a velocity: neither alone explains it."""
    twin, record = made
    one = record("drag", (600.0,))
    thrown = effect("initial_motion")
    values = torch.tensor([[0.0, 0.0, 0.25]], dtype=torch.float64)
    trials = []
    for trial in one.trials:
        s = thrown(twin.scenario(trial), values, twin)
        s = effect("drag")(s, torch.tensor([[600.0]], dtype=torch.float64), twin)
        seen = ObservationModel(one.setup, [trial]).observe(simulate(twin, [s])[0].alone(), 0, np.zeros(12))
        noise = 5e-5 * np.random.default_rng(5).normal(size=seen.shape)
        trials.append(dataclasses.replace(trial, recording=Recording(time=trial.recording.time, position=seen + noise)))
    both = dataclasses.replace(one, trials=tuple(trials))
    effects = [effect(name) for name in ("drag", "initial_motion", "gravity_tilt")]
    told = judge(FitProblem(both, twin), effects, report=lambda line: None)
    assert told.chosen and {e.name for e in told.chosen[0].fit.effects} == {"drag", "initial_motion"}
    # Which of the numbers is which effect's does not depend on their order.
    found = dict(zip((e.name for e in told.chosen[0].fit.effects), told.chosen[0].fit.values, strict=True))
    assert found["drag"][0] == pytest.approx(600.0, rel=0.1)
    assert found["initial_motion"][2] == pytest.approx(0.25, rel=0.05)
