"""The stages of an explanation, from an experiment's folder to its report."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Literal

import torch
import tyro

from torchsoro.sim2real.data.experiment import Experiment, Trial, read_experiment
from torchsoro.sim2real.data.recording import write_table
from torchsoro.sim2real.hypotheses.hypothesis import Hypothesis
from torchsoro.sim2real.hypotheses.library import library
from torchsoro.sim2real.inference.discretization import DiscretizationError, measure
from torchsoro.sim2real.inference.fit import Fit, FitProblem
from torchsoro.sim2real.inference.force_map import force_map
from torchsoro.sim2real.inference.heldout import Prediction, at_clocks_of, predict
from torchsoro.sim2real.inference.isolability import isolability
from torchsoro.sim2real.inference.model import predict_trial, read_model, write_model
from torchsoro.sim2real.inference.next_experiment import next_experiment
from torchsoro.sim2real.inference.phases import mismatches
from torchsoro.sim2real.inference.recording_faults import reordered
from torchsoro.sim2real.inference.resolution import WALLS, choose_twin, finer
from torchsoro.sim2real.inference.verdict import judge
from torchsoro.sim2real.report.explanation import Explanation
from torchsoro.sim2real.report.report import write
from torchsoro.sim2real.report.sentences import lead
from torchsoro.sim2real.twin.ensemble import THREADS, Ensemble
from torchsoro.sim2real.twin.twin import Twin


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
    """Time that the explanation may take on two cores, about [minutes]; sets how fine the twin is, on any machine."""
    edge: float = 0.0
    """Edge of the twin's cells [m] instead."""
    walls: int = WALLS
    """Cells through each wall around a chamber, at least."""
    effects: tuple[str, ...] = ()
    """Names of the effects to think of; all of the library if none is given."""
    threads: int = 0
    """That simulate side by side; 0 for as many as there are processors."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """What simulates; "auto" is a GPU where there is one and the package numba-cuda."""


def predicted(options: Options) -> None:
    """Predict a trial with a model.

    Raises:
        ValueError: for a model or a trial that cannot be read.
    """
    assert options.predict is not None
    if options.trial is None:
        raise ValueError("trial: wanted the trial.toml to predict")
    model, threads = read_model(options.predict), options.threads or THREADS
    write_table(options.out, predict_trial(model, options.trial, options.predict, threads, options.device))


def named(names: tuple[str, ...]) -> list[Hypothesis] | None:
    """Effects of the library by name; None for all.

    Raises:
        ValueError: for a name that is not known.
    """
    known = dict.fromkeys(effect.name for effect in library())
    if unknown := set(names) - set(known):
        raise ValueError(f"effects = {', '.join(sorted(unknown))}: wanted names out of {', '.join(known)}")
    # More than one may have a name, as friction of planes that are thought to stick and of others.
    return [effect for effect in library() if effect.name in names] or None


def begun(options: Options) -> tuple[Experiment, list[Trial], Twin]:
    """The experiment, its trials with a recording, and a twin that the budget can pay.

    Raises:
        ValueError: for an experiment that cannot be read or simulated.
    """
    if options.experiment is None:
        raise ValueError("experiment: wanted a folder, or --predict")
    torch.set_num_threads(1)
    experiment, confused = reordered(read_experiment(options.experiment))
    if confused:
        print(confused)
    trials = list(experiment.trials)
    if empty := [f"trials/{t.name}" for t in trials if t.recording is None]:
        raise ValueError(f"{options.experiment}: {', '.join(empty)}: no markers.csv, wanted one in each trial")
    if options.edge > 0:
        return experiment, trials, Twin(experiment.setup, edge=options.edge, walls=options.walls)
    return experiment, trials, choose_twin(experiment.setup, len(trials), 60 * options.budget, walls=options.walls)


def prepared(options: Options) -> tuple[FitProblem, DiscretizationError]:
    """What effects are fitted to: recordings, a twin, and that twin's own error.

    Raises:
        ValueError: for an experiment that cannot be read or simulated.
    """
    experiment, trials, twin = begun(options)
    chosen = named(options.effects)
    if chosen and not any(e.applies(twin.scenario(t), twin) for e in chosen for t in trials):
        raise ValueError(f"effects = {', '.join(options.effects)}: wanted one that can act in these trials")
    print(f"twin: {twin.count} points, cells of {1e3 * twin.edge:.2f} mm")
    ensemble = Ensemble(twin, options.threads or THREADS, options.device)
    fine = Ensemble(finer(twin, len(trials), 2 * options.budget), ensemble.threads, options.device)
    print(f"corrected by one of {fine.twin.count} points")
    discretization = measure(experiment, ensemble, fine)
    problem = FitProblem(
        experiment,
        twin,
        trials=trials,
        discretization=discretization.deviation,
        shift=discretization.shift,
        correction=discretization.correction,
        ensemble=ensemble,
        fine=fine,
    )
    print(
        f"noise {1e3 * problem.noise:.3f} mm, numerics "
        + ", ".join(f"{1e3 * n.mean():.3f}" for n in discretization.deviation)
    )
    return problem, discretization


def shown(
    problem: FitProblem, best: Fit, trials: list[Trial], kept: list[Trial]
) -> tuple[list[Trial], tuple[Prediction, ...], tuple[Prediction, ...]]:
    """The trials that do not break down, as believed and as explained."""
    for asked in ([*trials, *kept], trials):
        before, after = (tuple(predict(problem, best, asked, believed=b)) for b in (True, False))
        if before and after:
            break
        print("a trial that was left out breaks down, and is not shown")
    return asked, before, after


def explain(options: Options) -> Explanation | None:
    """Explain an experiment, or predict a trial.

    Raises:
        ValueError: for an experiment that cannot be read or simulated.
    """
    if options.predict is not None:
        return predicted(options)
    if options.out.exists() and not options.out.is_dir():
        raise ValueError(f"out = {options.out}: a file, wanted a folder")
    begin = time.perf_counter()
    problem, discretization = prepared(options)
    trials = list(problem.trials)
    kept = [t for t in problem.experiment.heldout if t.recording is not None]
    tells = isolability(problem)
    verdict = judge(problem, named(options.effects), heldout=kept, budget=60 * options.budget)
    problem = verdict.problem
    best = verdict.chosen[0].fit if verdict.chosen else verdict.null_model
    following = []
    if verdict.kind == "cannot_distinguish":
        one, other = ((c.fit.effects, c.fit.point) for c in verdict.chosen[:2])
        following = next_experiment(problem, one, other)
    everything, before, after = shown(problem, best, trials, kept)
    # Without what the best effect leaves, which was priced for the verdict.
    known = problem.only(problem.trials, discretization=discretization.deviation)
    forces = None
    if verdict.kind == "unknown_physics":
        try:
            forces = force_map(known, best)
        except ValueError as error:  # the verdict is worth its report without it
            print(f"no force map: {error}")
    found = Explanation(
        problem=problem,
        discretization=discretization,
        verdict=verdict,
        before=before,
        after=after,
        drawn=tuple(at_clocks_of(problem, best, everything, before, after)),
        heldout=tuple(t.name for t in kept),
        mismatches=tuple(mismatches(known, verdict.null_model, everything, after)),
        forces=forces,
        seconds=time.perf_counter() - begin,
        isolability=tells,
        following=tuple(following),
    )
    settings = {
        "experiment": str(options.experiment),
        "budget_minutes": options.budget,
        "edge_m": problem.twin.edge,
        "walls": problem.twin.walls,
    }
    options.out.mkdir(parents=True, exist_ok=True)
    write(found, everything, options.out, settings)
    assert problem.fine is not None
    write_model(options.out / "model.toml", problem.experiment.folder / "setup.toml", best, problem.fine.twin)
    print(f"{verdict.kind}: {lead(found)}\n{found.seconds:.0f} s; {options.out / 'report.html'}")
    return found
