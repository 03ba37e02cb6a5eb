"""What an explanation is asked for, and whether it can be done: all input is checked here, before any simulation."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from torchsoro.sim2real.data.experiment import Experiment, Trial, read_experiment
from torchsoro.sim2real.data.plausibility import plausible
from torchsoro.sim2real.data.recording import Recording
from torchsoro.sim2real.hypotheses.hypothesis import Hypothesis
from torchsoro.sim2real.hypotheses.library import library
from torchsoro.sim2real.inference.noise import estimate_noise
from torchsoro.sim2real.inference.resolution import choose_twin, cost, finer, finest
from torchsoro.sim2real.inference.thinning import thinned
from torchsoro.sim2real.options import Options
from torchsoro.sim2real.twin.batch import THREADS
from torchsoro.sim2real.twin.twin import Twin
from torchsoro.storage import check_folder

RESULTS = ("report.html", "explanation.json", "model.toml")
RECORDINGS = Path(__file__).resolve().parents[1] / "recordings"  # experiments that come with the package
WORTH = 30.0  # s on two cores, of an explanation that is worth a GPU: those of bars wait for each step of a small body
DEAR = 100.0  # budgets, that a twin with a given edge may take


@dataclass(frozen=True, kw_only=True, eq=False)
class Inputs:
    """An experiment that can be explained.

    Attributes:
        experiment: As read, recordings thinned where they have too many rows, what is certain put right.
        trials: To be explained, each with a recording.
        kept: With a recording, only to be predicted.
        twin: The body that is fitted.
        fine: Simulates one with smaller cells, which tells the other's error.
        finest: The same of that one, where bodies meet planes and the budget allows it.
        effects: Considered; None for the whole library.
        notes: Recordings that were thinned, a line each.
        hints: What is likely to be a mistake in the data, a line each, and what was put right of it.
    """

    experiment: Experiment
    trials: tuple[Trial, ...]
    kept: tuple[Trial, ...]
    twin: Twin
    fine: Twin
    finest: Twin | None
    threads: int
    effects: list[Hypothesis] | None
    notes: tuple[str, ...]
    hints: tuple[str, ...]


def read_inputs(options: Options) -> Inputs:
    """Read an experiment and check all that an explanation needs; nothing is simulated or written.

    Args:
        options: What is asked for.

    Raises:
        ValueError: for options out of range, a folder that cannot be written, or an experiment that cannot be read or
            simulated; names the option or the file, what was seen and what is wanted.
    """
    if options.experiment is None:
        raise ValueError("experiment: not given, wanted a folder, or --predict with a model.toml")
    check_numbers(options)
    check_device(options.device)
    effects = named(options.effects)
    check_folder("out", Path(options.out), RESULTS)
    experiment = read_experiment(_found(Path(options.experiment)))
    if empty := [f"trials/{t.name}" for t in experiment.trials if t.recording is None]:
        raise ValueError(f"{options.experiment}: {', '.join(empty)}: no markers.csv, wanted one in each trial")
    experiment, notes = thinned(experiment)
    experiment, findings = plausible(experiment)
    hints = [str(f) for f in findings]
    trials = experiment.trials
    recordings = [t.recording for t in trials if t.recording is not None]
    _check_noise(experiment, recordings)
    with named_in(experiment.folder, hints):
        twin = _twin(options, experiment)
        supplies = [t.pressure.pressure for t in trials if t.pressure is not None]
        highest = max((float(p.abs().max()) for p in supplies), default=0.0)
        twin = dataclasses.replace(twin, device=chosen(options.device, cost(twin, len(trials))), highest=highest)
    scenarios = {}
    for room, group in (("trials", trials), ("heldout", experiment.heldout)):
        for trial in group:
            with named_in(experiment.folder / room / trial.name):
                scenarios[trial.name] = twin.scenario(trial)
    if effects and not any(e.applies(scenarios[t.name], twin) for e in effects for t in trials):
        raise ValueError(f"effects = {', '.join(options.effects)}: wanted one that can act in these trials")
    with named_in(experiment.folder):
        fine = finer(twin, len(trials), 4 * options.budget)
        planes = [plane for s in scenarios.values() for plane in s.planes]
        # Of a body that slides, which node sticks when decides how far it goes, in smaller cells as much as in larger.
        sticks = bool(planes) and all(isinstance(plane.friction, str) for plane in planes)
        third = finest(fine, len(trials), 15 * options.budget) if sticks else None
    return Inputs(
        experiment=experiment,
        trials=trials,
        kept=tuple(t for t in experiment.heldout if t.recording is not None),
        twin=twin,
        fine=fine,
        finest=third,
        threads=options.threads or THREADS,
        effects=effects,
        notes=tuple(notes),
        hints=tuple(hints),
    )


def _found(experiment: Path) -> Path:
    """The folder of an experiment: one's own, or else one that comes with the package."""
    shipped = RECORDINGS / experiment
    return shipped if not experiment.exists() and len(experiment.parts) == 1 and shipped.is_dir() else experiment


def check_numbers(options: Options) -> None:
    """Ranges of the options that are numbers.

    Raises:
        ValueError: for one out of range.
    """
    ranges = {
        "budget": (options.budget, lambda v: 0 < v <= 1e5, "a positive number of minutes, at most 100000"),
        "edge": (options.edge, lambda v: 0 <= v <= 10, "a positive length in metres, or 0 to choose one"),
        "walls": (options.walls, lambda v: 1 <= v <= 32, "1 to 32 cells"),
        "threads": (options.threads, lambda v: 0 <= v <= 1024, "1 to 1024, or 0 for the number of processors"),
    }
    for name, (value, good, wanted) in ranges.items():
        whole = name in ("walls", "threads")
        if isinstance(value, bool) or not isinstance(value, int if whole else int | float) or not good(value):
            raise ValueError(f"{name} = {value!r}, wanted {wanted}")


def check_device(name: str) -> None:
    """Where to simulate.

    Raises:
        ValueError: for CUDA where there is none.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise ValueError("device = 'cuda': this machine has no CUDA device that torch can use; wanted 'cpu'")


def chosen(name: str, seconds: float) -> str:
    """Where to simulate, of an explanation that takes so long on two cores [s]."""
    if name != "auto":
        return name
    return "cuda" if seconds > WORTH and torch.cuda.is_available() else "cpu"


def named(names: tuple[str, ...]) -> list[Hypothesis] | None:
    """Effects of the library by name; None for all.

    Raises:
        ValueError: for a name that is not known.
    """
    known = dict.fromkeys(effect.name for effect in library())
    if unknown := set(names) - set(known):
        raise ValueError(f"effects = {', '.join(sorted(unknown))}: wanted names out of {', '.join(known)}")
    # Two effects may share a name, as friction of planes that are thought to stick and of others.
    return [effect for effect in library() if effect.name in names] or None


def _check_noise(experiment: Experiment, recordings: list[Recording]) -> None:
    if experiment.setup.noise is not None:
        return
    wanted = "wanted noise = ..., its standard deviation in metres, under [recording] in setup.toml"
    third = [np.diff(r.position, 3, axis=0) for r in recordings]
    if not any(np.isfinite(t).any() for t in third):
        raise ValueError(f"{experiment.folder}: no marker has four samples in a row to estimate noise from, {wanted}")
    if not estimate_noise(recordings) > 0:
        raise ValueError(f"{experiment.folder}: recorded samples repeat each other and show no noise, {wanted}")


def _twin(options: Options, experiment: Experiment) -> Twin:
    setup, trials = experiment.setup, len(experiment.trials)
    if not options.edge:
        return choose_twin(setup, trials, 60 * options.budget, walls=options.walls)
    if options.edge > max(setup.size):
        raise ValueError(f"edge = {options.edge:g} m, wanted at most {max(setup.size):g} m, the body's longest edge")
    twin = Twin(setup, edge=options.edge, walls=options.walls)
    needed = cost(twin, trials) / 60
    if needed > DEAR * options.budget:
        raise ValueError(
            f"edge = {options.edge:g} m, walls = {options.walls}: about {needed:.3g} minutes, wanted at most "
            f"{DEAR:g} times budget = {options.budget:g} minutes"
        )
    return twin


@contextlib.contextmanager
def named_in(file: Path, hints: Sequence[str] = ()) -> Iterator[None]:
    """Complaints begin with the file or folder that they are about, and end with hints, a line each."""
    try:
        yield
    except ValueError as error:
        raise ValueError("\n".join([f"{file}: {error}", *(f"Hint: {hint}" for hint in hints)])) from error
