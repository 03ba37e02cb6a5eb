"""From recordings to a verdict, on recordings that the twin itself made: that this works says nothing of real ones."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from test_experiment import experiment

from torchsoro.sim2real.experiment import Experiment, read_experiment
from torchsoro.sim2real.fit import Problem
from torchsoro.sim2real.heldout import predict
from torchsoro.sim2real.library import library
from torchsoro.sim2real.model import predict_trial, read_model
from torchsoro.sim2real.recording import Recording, read_table
from torchsoro.sim2real.residual import Band, Camera, estimate_noise
from torchsoro.sim2real.twin import Motion, Twin
from torchsoro.sim2real.verdict import judge

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "recipes"))
SPACING = 0.005
SETUP = """
title = "bar"
duration = 0.2

[body]
size = [0.06, 0.02, 0.02]

[material]
density = 1000.0
youngs_modulus = 1e5
poisson_ratio = 0.3
prony = [[0.3, 0.01]]

[[clamp]]
box = [[-0.001, -0.001, -0.001], [0.0001, 0.021, 0.021]]

[[marker]]
name = "tip"
at = [0.06, 0.01, 0.02]

[[marker]]
name = "side"
at = [0.04, 0.0, 0.01]

[recording]
noise = 5e-5
"""


def effect(name):
    return next(e for e in library() if e.name == name)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A bar, and what its twin would record with an effect, two trials."""
    folder = tmp_path_factory.mktemp("bar")
    header = "time_s," + ",".join(f"{m}_{a}_m" for m in ("tip", "side") for a in "xyz")
    blank = "\n".join(",".join([f"{0.005 * k}"] + ["0"] * 6) for k in range(40))
    experiment(folder, SETUP, f"{header}\n{blank}\n")
    found = read_experiment(folder)
    twin = Twin(found.setup, spacing=SPACING)
    loud = dataclasses.replace(
        found.trials[0], name="b", setup=dataclasses.replace(found.setup, velocity=(0.0, 0.1, 0.3))
    )

    def record(name: str | None, values=()) -> Experiment:
        rng, trials = np.random.default_rng(1), []
        for k, trial in enumerate((found.trials[0], loud)):
            scenario = twin.scenario(trial)
            if name is not None:
                scenario = effect(name)(scenario, torch.tensor([values], dtype=torch.float64), twin)
            camera = Camera(found.setup, [trial])
            errors = np.zeros(len(camera.deviations))
            errors[0], errors[6:] = 0.002 * (k + 1), 2e-4
            seen = camera.see(twin.simulate(scenario).alone(), 0, errors)[0]
            place = seen + 5e-5 * rng.normal(size=seen.shape)
            place[7, 0] = np.nan
            trials.append(dataclasses.replace(trial, recording=Recording(time=trial.recording.time, place=place)))
        return dataclasses.replace(found, trials=tuple(trials))

    return twin, record


def test_derivatives_by_measurement_errors_are_those_of_differences():
    rng = np.random.default_rng(0)
    steps, markers = 30, 2
    time = torch.linspace(0, 0.3, steps, dtype=torch.float64)
    place = torch.stack([torch.sin(7 * time + i) for i in range(3 * markers)], -1).view(steps, markers, 3)
    velocity = torch.stack([7 * torch.cos(7 * time + i) for i in range(3 * markers)], -1).view(steps, markers, 3)
    gradient = torch.eye(3, dtype=torch.float64) + 0.1 * torch.from_numpy(rng.normal(size=(1, markers, 3, 3)))
    motion = Motion(time=time, place=place, velocity=velocity, gradient=gradient.expand(steps, -1, -1, -1), dt=1e-3)
    recording = Recording(time=np.linspace(0.05, 0.25, 9), place=np.zeros((9, markers, 2)), axes=(0, 2))

    class Two:
        markers = (dataclasses.make_dataclass("M", ["name"])("a"), dataclasses.make_dataclass("M", ["name"])("b"))
        axes, kind = (0, 2), "video"

    trial = dataclasses.make_dataclass("T", ["name", "recording"])("t", recording)
    camera = Camera(Two(), [trial])  # type: ignore[arg-type]
    at = 0.5 * camera.deviations * rng.normal(size=len(camera.deviations))
    _, by = camera.see(motion, 0, at)
    for k, scale in enumerate(camera.deviations):
        step = np.zeros_like(at)
        step[k] = 1e-3 * scale
        difference = (camera.see(motion, 0, at + step)[0] - camera.see(motion, 0, at - step)[0]) / (2e-3 * scale)
        # Rotations add up only where they are small, and a spline's second derivative jumps.
        np.testing.assert_allclose(by[..., k], difference, rtol=0.02, atol=0.02 * np.abs(difference).max() + 1e-9)


def test_a_band_makes_its_own_noise_white():
    rng = np.random.default_rng(2)
    time = np.arange(60) * 0.01
    numerics = np.array([[2e-4, 0.0]])
    alike = np.exp(-np.abs(time[:, None] - time[None]) / 0.03)
    band = Band(Recording(time=time, place=np.zeros((60, 1, 2)), axes=(0, 2)), 1e-4, numerics)
    root = [np.linalg.cholesky(1e-8 * np.eye(60) + n**2 * alike) for n in numerics[0]]
    draws = rng.normal(size=(2, 60, 400))
    values = np.stack([root[a] @ draws[a] for a in range(2)], 1)[:, None]
    white = band.whiten(values)
    np.testing.assert_allclose(white, draws.reshape(120, 400), atol=1e-9)
    assert band.logarithm == pytest.approx(sum(np.linalg.slogdet(r @ r.T)[1] for r in root))


@pytest.mark.parametrize("noise", [3e-5, 2e-4])
def test_noise_is_found_beside_motion(noise):
    rng = np.random.default_rng(3)
    time = np.arange(300) * 0.01
    motion = 0.01 * np.exp(-time)[:, None, None] * np.sin(2 * np.pi * 5 * time)[:, None, None] * np.ones((1, 4, 3))
    place = motion + noise * rng.normal(size=motion.shape)
    assert estimate_noise([Recording(time=time, place=place)]) == pytest.approx(noise, rel=0.3)


@pytest.mark.parametrize(
    ("name", "values", "wrong"),
    [("drag", (6.0,), 0.05), ("attached_mass", (0.004, 0.055, 0.01, 0.015), 0.35)],
)
def test_finds_what_its_own_twin_was_given(made, name, values, wrong):
    twin, record = made
    problem = Problem(record(name, values), twin, trials=record(name, values).trials[:1])
    starts = [start for _, start in problem.look(effect(name), problem.base())[:2]]
    fit = min((problem.fit([effect(name)], start) for start in starts), key=lambda fit: fit.misfit)
    assert fit.misfit / fit.samples == pytest.approx(1.0, abs=0.35)
    # A mass near the tip is a lighter one at the tip of a bar that is softer within what is believed.
    assert fit.values[0][0] == pytest.approx(values[0], rel=wrong)
    if len(values) == 1:
        assert abs(fit.values[0][0] - values[0]) < 4 * fit.deviations[0][0]
    if len(values) > 1:
        assert np.abs(fit.values[0][1:] - values[1:]).max() < 0.006
    (one,) = predict(problem, fit, record(name, values).trials[1:])
    (other,) = predict(problem, fit, record(name, values).trials[1:], believed=True)
    assert one.total < 0.3 * other.total


def test_a_verdict_names_the_effect_or_nothing(made):
    twin, record = made
    effects = [effect(name) for name in ("modulus", "drag", "gravity_tilt")]
    told = judge(Problem(record("drag", (6.0,)), twin), effects, report=lambda line: None)
    assert told.kind == "explained" and told.chosen[0].fit.name == "drag"
    low = told.chosen[0].fit.values[0][0] - 5 * told.chosen[0].fit.deviations[0][0]
    assert low < 6.0 < told.chosen[0].fit.values[0][0] + 5 * told.chosen[0].fit.deviations[0][0]
    quiet = judge(Problem(record(None), twin), effects, report=lambda line: None)
    assert quiet.kind == "nothing_missing" and quiet.excess == pytest.approx(1.0, abs=0.3)


def test_the_recipe_writes_its_answer(made, tmp_path, monkeypatch):
    import explain

    _, record = made
    recorded = record("drag", (8.0,))
    monkeypatch.setattr(explain, "read_experiment", lambda folder: recorded)
    monkeypatch.setattr("torchsoro.sim2real.verdict.library", lambda: (effect("drag"),))
    explain.main(explain.Options(experiment=recorded.folder, out=tmp_path / "out", spacing=SPACING))
    answer = json.loads((tmp_path / "out" / "explanation.json").read_text())
    assert answer["verdict"] == "explained" and answer["set"] == ["drag"]
    found = answer["effects"][0]["parameters"]["rate"]
    assert found["low"] < found["value"] < found["high"] and found["value"] == pytest.approx(8.0, abs=1.0)
    assert set(answer) >= {"ranking", "noise", "nuisance", "error_before", "error_after", "heldout", "cost", "version"}
    assert answer["error_after"]["a"]["all"] < 0.5 * answer["error_before"]["a"]["all"]
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Missing is drag" in page and page.count("data:image/png") == 3
    folder = tmp_path / "new"
    folder.mkdir()
    (folder / "trial.toml").write_text("duration = 0.05\n[start]\nvelocity = [0.0, 0.0, 0.2]\n")
    model, markers = tmp_path / "out" / "model.toml", tmp_path / "markers.csv"
    explain.main(explain.Options(predict=model, trial=folder / "trial.toml", out=markers))
    columns = read_table(markers)
    assert columns["time_s"][-1] == pytest.approx(0.05) and len(columns) == 7
    believed = dataclasses.replace(read_model(model), effects=(), ln_modulus=0.0)
    plain = predict_trial(believed, folder / "trial.toml", model)["tip_z_m"]
    # Drag holds back what is thrown.
    assert max(columns["tip_z_m"]) < plain.max() - 1e-4
    model.write_text(model.read_text().replace('name = "drag"', 'name = "wind"'))
    with pytest.raises(ValueError, match=r"name = 'wind', wanted one of"):
        read_model(model)
