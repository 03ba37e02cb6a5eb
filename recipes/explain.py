"""Why does a recording differ from its simulation? Names the missing physics, with its strength, or says it cannot.

    python recipes/explain.py my-experiment --out runs/explained
    python recipes/explain.py my-experiment --out runs/explained --budget 5      # minutes, on a coarser twin
    python recipes/explain.py --predict runs/explained/model.toml --trial trial.toml --out markers.csv

The experiment is a folder: setup.toml says what is believed, trials/<name>/markers.csv what was recorded. Trials in a
folder heldout/ are only predicted; without one, the last of three or more. Writes report.html, explanation.json and
model.toml, the setup with what was missing, which predicts a trial that nobody has recorded yet.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

import torch
import tyro

from torchsoro.settings import plain_errors
from torchsoro.sim2real.experiment import read_experiment
from torchsoro.sim2real.fit import Problem
from torchsoro.sim2real.heldout import predict
from torchsoro.sim2real.model import predict_trial, read_model, write_model
from torchsoro.sim2real.numerics import choose_spacing, measure
from torchsoro.sim2real.report import Explanation, lead, write
from torchsoro.sim2real.twin import Twin
from torchsoro.sim2real.verdict import judge
from torchsoro.storage import atomic_write


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """What to explain."""

    experiment: tyro.conf.Positional[Path | None] = None
    """Folder of the experiment."""
    out: Path
    """Folder for report.html, explanation.json and model.toml; with --predict, the file of the markers."""
    predict: Path | None = None
    """A model.toml, to predict a trial with instead."""
    trial: Path | None = None
    """The trial.toml to predict; with a pressure.csv beside it where the body has a chamber."""
    budget: float = 20.0
    """Time that the explanation may take, about [minutes]; sets how fine the twin is."""
    spacing: float = 0.0
    """Distance of the twin's particles [m] instead."""
    device: str = "cpu"
    """"cpu" or "cuda"."""


def predicted(options: Options) -> None:
    """Predict a trial with a model.

    Raises:
        ValueError: for a model or a trial that cannot be read.
    """
    assert options.predict is not None
    if options.trial is None:
        raise ValueError("trial: wanted the trial.toml to predict")
    columns = predict_trial(read_model(options.predict), options.trial, options.predict)
    lines = [",".join(columns), *(",".join(f"{x:.9g}" for x in row) for row in zip(*columns.values(), strict=True))]
    options.out.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(options.out) as file:
        file.write(("\n".join(lines) + "\n").encode())


def main(options: Options) -> Explanation | None:
    """Explain an experiment, or predict a trial.

    Raises:
        ValueError: for an experiment that cannot be read or simulated.
    """
    if options.predict is not None:
        return predicted(options)
    if options.experiment is None:
        raise ValueError("experiment: wanted a folder, or --predict")
    begin = time.perf_counter()
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    experiment = read_experiment(options.experiment)
    trials = [t for t in experiment.trials if t.recording is not None]
    kept = [t for t in experiment.heldout if t.recording is not None]
    if not kept and len(trials) > 2:
        trials, kept = trials[:-1], trials[-1:]
    spacing = options.spacing or choose_spacing(experiment.setup, len(trials), 60 * options.budget)
    twin = Twin(experiment.setup, spacing=spacing, device=options.device)
    print(f"twin: {twin.count} particles, {1e3 * spacing:.2f} mm apart")
    numerics = measure(experiment, twin, trials)
    problem = Problem(experiment, twin, trials=trials, numerics=numerics.deviation)
    print(
        f"noise {1e3 * problem.noise:.3f} mm, numerics "
        + ", ".join(f"{1e3 * n.mean():.3f}" for n in numerics.deviation)
    )
    verdict = judge(problem)
    best = verdict.chosen[0].fit if verdict.chosen else verdict.nothing
    everything = [*trials, *kept]
    found = Explanation(
        problem=problem,
        numerics=numerics,
        verdict=verdict,
        before=tuple(predict(problem, best, everything, believed=True)),
        after=tuple(predict(problem, best, everything)),
        heldout=tuple(t.name for t in kept),
        seconds=time.perf_counter() - begin,
    )
    settings = {"experiment": str(options.experiment), "budget_minutes": options.budget, "spacing_m": spacing}
    write(found, everything, options.out, settings)
    write_model(options.out / "model.toml", options.experiment / "setup.toml", best, spacing)
    print(f"{verdict.kind}: {lead(found)}\n{found.seconds:.0f} s; {options.out / 'report.html'}")
    return found


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Options, description=__doc__))
