"""A small bar that is let go, and recordings that its own twin makes of it."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import numpy as np
import torch
from setups import CLAMP, marker, material
from test_experiment import experiment

from torchsoro.sim2real.data.experiment import Experiment, Trial, read_experiment
from torchsoro.sim2real.data.recording import Recording
from torchsoro.sim2real.data.schema import PlaneTable
from torchsoro.sim2real.hypotheses.library import library
from torchsoro.sim2real.inference.observation import ObservationModel
from torchsoro.sim2real.twin.batch import simulate
from torchsoro.sim2real.twin.twin import Twin

EDGE = 0.01
SETUP = f"""
title = "bar"
duration = 0.2

[body]
size = [0.06, 0.02, 0.02]

{material(poisson_ratio=0.3, prony="[[0.3, 0.01]]")}
{CLAMP}
{marker("tip", 0.06, 0.01, 0.02)}
{marker("side", 0.04, 0.0, 0.01)}
[recording]
noise = 5e-5
"""


def effect(name):
    return next(e for e in library() if e.name == name)


def two_trials(folder: Path) -> tuple[Experiment, Trial]:
    """A bar with a trial in which nothing was seen yet, and another in which it is thrown."""
    header = "time_s," + ",".join(f"{m}_{a}_m" for m in ("tip", "side") for a in "xyz")
    blank = "\n".join(f"{0.005 * k},0.06,0.01,0.02,0.04,0,0.01" for k in range(40))
    experiment(folder, SETUP, f"{header}\n{blank}\n")
    found = read_experiment(folder)
    thrown = dataclasses.replace(found.setup, velocity=(0.0, 0.1, 0.3))
    return found, dataclasses.replace(found.trials[0], name="b", setup=thrown)


def bar(folder: Path):
    """The twin of a bar, and a function that makes what it, or another, would record in two trials."""
    found, loud = two_trials(folder)
    twin = Twin(found.setup, edge=EDGE, across=2)

    def simulated(name: str | None, values=(), by: Twin = twin, **change) -> Experiment:
        rng, trials = np.random.default_rng(1), []
        for k, trial in enumerate((found.trials[0], loud)):
            trial = dataclasses.replace(trial, setup=dataclasses.replace(trial.setup, **change))
            scenario = by.scenario(trial)
            if name is not None:
                scenario = effect(name)(scenario, torch.tensor([values], dtype=torch.float64), by)
            observation = ObservationModel(found.setup, [trial])
            errors = np.zeros(len(observation.deviations))
            errors[0], errors[6:] = 0.002 * (k + 1), 2e-4
            seen = observation.observe(simulate(by, [scenario])[0].alone(), 0, errors)
            place = seen + 5e-5 * rng.normal(size=seen.shape)
            place[7, 0] = np.nan
            trials.append(dataclasses.replace(trial, recording=Recording(time=trial.recording.time, position=place)))
        return dataclasses.replace(found, trials=tuple(trials))

    own = functools.cache(simulated)

    def record(name: str | None, values=(), **how) -> Experiment:
        return simulated(name, values, **how) if how else own(name, values)

    return twin, record


def onto_a_floor(experiment: Experiment) -> Experiment:
    """The same, in which the bar swings onto a floor."""
    ground = PlaneTable(point=(0.0, 0.0, -0.005), normal=(0.0, 0.0, 1.0), friction="stick")
    trials = [dataclasses.replace(t, setup=dataclasses.replace(t.setup, planes=(ground,))) for t in experiment.trials]
    return dataclasses.replace(experiment, trials=tuple(trials))
