"""Mistakes that only the motion shows, made in what a body's own twin records; none where physics is missing."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from ringing import effect
from setups import CLAMP, marker, material
from test_experiment import experiment

from torchsoro.sim2real.data.experiment import Trial, read_experiment
from torchsoro.sim2real.data.recording import Recording
from torchsoro.sim2real.inference.believed_motion import against_belief, untold
from torchsoro.sim2real.inference.observation import ObservationModel
from torchsoro.sim2real.twin.batch import simulate
from torchsoro.sim2real.twin.twin import Twin
from torchsoro.simulation.actuation import Waveform

NAMES = {"tip": (0.08, 0.01, 0.02), "middle": (0.04, 0.004, 0.02)}  # on the upper face
SETUP = f"""
title = "bar"
duration = 0.5

[body]
size = [0.08, 0.02, 0.02]

{material(poisson_ratio=0.3, prony="")}
{CLAMP}
{"".join(marker(name, *at) for name, at in NAMES.items())}
[recording]
noise = 5e-5
"""
CHAMBER = '[[chamber]]\nname = "air"\nbox = [[0.01, 0.005, 0.01], [0.07, 0.015, 0.016]]\n'


def made(folder: Path, setup: str, *, missing: tuple[str, tuple[float, ...]] | None = None, pressure: float = 0.0):
    """A twin, and the trial that it records, with an effect that the setup does not have."""
    time = np.arange(0.0, 0.5, 0.005)
    head = "time_s," + ",".join(f"{m}_{a}_m" for m in NAMES for a in "xyz")
    still = ",".join(f"{v:g}" for at in NAMES.values() for v in at)
    folder = experiment(folder, setup, "\n".join([head, *(f"{t:g},{still}" for t in time)]) + "\n")
    if pressure:
        (folder / "trials" / "a" / "pressure.csv").write_text(f"time_s,air_pa\n0,0\n0.05,{pressure}\n0.5,{pressure}\n")
    (trial,) = read_experiment(folder).trials
    twin = Twin(trial.setup, edge=0.01, walls=1, across=2)
    scenario = twin.scenario(trial)
    if missing is not None:
        scenario = effect(missing[0])(scenario, torch.tensor([missing[1]], dtype=torch.float64), twin)
    motion = simulate(twin, [scenario], threads=1)[0].alone()
    observation = ObservationModel(trial.setup, [trial])
    place = observation.observe(motion, 0, np.zeros(len(observation.deviations)))
    place = place + 5e-5 * np.random.default_rng(0).normal(size=place.shape)
    return twin, dataclasses.replace(trial, recording=Recording(time=time, position=place))


@pytest.fixture(scope="module")
def swinging(tmp_path_factory) -> tuple[Twin, Trial]:
    return made(tmp_path_factory.mktemp("swinging"), SETUP)


def told(twin: Twin, trial: Trial, **changes) -> list[str]:
    assert trial.recording is not None
    recording = dataclasses.replace(trial.recording, **changes)
    return [str(f) for f in against_belief(twin, [dataclasses.replace(trial, recording=recording)], 1)]


def parts(trial: Trial) -> tuple[np.ndarray, np.ndarray]:
    assert trial.recording is not None
    return trial.recording.time, trial.recording.position


@pytest.mark.parametrize(
    "missing",
    [None, ("modulus", (-0.8,)), ("drag", (2000.0,)), ("attached_mass", (0.02, 0.07, 0.01, 0.01)),
     ("viscoelastic", (1.0, -4.0)), ("gravity_tilt", (0.3, 0.3))],
    ids=lambda m: "nothing" if m is None else m[0],
)  # fmt: skip
def test_a_sound_recording_gives_no_finding_whatever_is_missing(tmp_path, missing):
    assert not told(*made(tmp_path, SETUP, missing=missing))


def test_a_motion_that_is_mirrored_across_the_plane_of_the_markers_is_told(swinging):
    twin, trial = swinging
    _, place = parts(trial)
    place = place.copy()
    place[..., 2] = 0.04 - place[..., 2]
    (found,) = told(twin, trial, position=place)
    assert "the motion is that with z mirrored" in found and "frame of setup.toml" in found


def test_a_body_that_rests_at_first_is_told_with_the_time_of_its_release(swinging):
    twin, trial = swinging
    time, place = parts(trial)
    rows = np.maximum(np.arange(len(time)) - 30, 0)
    (found,) = told(twin, trial, position=place[rows])
    assert "the body rests until 0.15 s" in found and "time_s = 0 has to be the release" in found


@pytest.mark.parametrize(("rate", "words"), [(8.0, "8 times larger"), (0.25, "4 times smaller")])
def test_times_of_a_film_at_another_speed_are_told_with_the_factor(swinging, rate, words):
    twin, trial = swinging
    time, place = parts(trial)
    (found,) = told(twin, trial, time=rate * time, position=place)
    assert f"times are {words} than seconds" in found


@pytest.fixture(scope="module")
def inflated(tmp_path_factory) -> tuple[Twin, Trial]:
    setup = SETUP.replace("duration = 0.5", "duration = 0.5\ngravity = [0, 0, 0]", 1) + CHAMBER
    return made(tmp_path_factory.mktemp("inflated"), setup, pressure=4e3)


@pytest.mark.parametrize(
    ("factor", "unit"),
    [(1, ""), (1e3, "kPa"), *(pytest.param(*u, marks=pytest.mark.slow) for u in ((1e2, "mbar"), (1e5, "bar")))],
)
def test_a_pressure_in_another_unit_is_told_by_name(inflated, factor, unit):
    twin, trial = inflated
    assert trial.pressure is not None
    wrong = Waveform(time=trial.pressure.time, pressure=trial.pressure.pressure / factor)
    if not unit:
        assert not told(twin, trial)
        return
    (found,) = told(twin, dataclasses.replace(trial, pressure=wrong))
    assert f"the pressure is in {unit}" in found and "in Pa in pressure.csv" in found


def test_a_body_on_the_ground_may_walk_the_other_way(tmp_path):
    _, trial = made(tmp_path, SETUP)
    assert untold(trial.setup)
    ground = "[[plane]]\npoint = [0, 0, -0.1]\nnormal = [0, 0, 1]\n"
    _, trial = made(tmp_path, SETUP + ground)
    assert not untold(trial.setup)
