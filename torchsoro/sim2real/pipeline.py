"""From an experiment's folder to its report, and from a model to a trial that nobody has recorded yet.

>>> from torchsoro.sim2real.pipeline import Options, explain
>>> found = explain(Options(experiment=Path("my-experiment"), out=Path("runs/explained")))  # doctest: +SKIP
>>> found.verdict.kind, found.best.name  # doctest: +SKIP
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from torchsoro.sim2real.data.experiment import Trial
from torchsoro.sim2real.data.recording import write_table
from torchsoro.sim2real.inference.believed_motion import against_belief
from torchsoro.sim2real.inference.discretization import measure
from torchsoro.sim2real.inference.fit import FitProblem
from torchsoro.sim2real.inference.force_map import force_map
from torchsoro.sim2real.inference.heldout import at_clocks_of
from torchsoro.sim2real.inference.isolability import isolability
from torchsoro.sim2real.inference.likelihood import silent
from torchsoro.sim2real.inference.model import predict_trial, read_model, write_model
from torchsoro.sim2real.inference.next_experiment import next_experiment
from torchsoro.sim2real.inference.phases import mismatches
from torchsoro.sim2real.inference.verdict import judge
from torchsoro.sim2real.inputs import Inputs, check_device, check_numbers, chosen, read_inputs
from torchsoro.sim2real.options import Options
from torchsoro.sim2real.progress import Progress, span
from torchsoro.sim2real.report.body import body_motion
from torchsoro.sim2real.report.explanation import Explanation
from torchsoro.sim2real.report.improvement import worst_of
from torchsoro.sim2real.report.report import write
from torchsoro.sim2real.report.sentences import lead
from torchsoro.sim2real.twin.batch import THREADS
from torchsoro.storage import check_folder

__all__ = ["Explanation", "Options", "explain", "predict_markers", "run"]


def run(options: Options) -> Explanation | None:
    """Explain an experiment, or predict a trial if a model is given.

    Raises:
        ValueError: as :func:`explain` and :func:`predict_markers`.
    """
    if options.predict is None:
        return explain(options)
    predict_markers(options)
    print(options.out)
    return None


def predict_markers(options: Options) -> dict[str, np.ndarray]:
    """Predict a trial with a model, and write its markers.

    Args:
        options: With ``predict``, ``trial`` and ``out``.

    Returns:
        Columns of the file, by name: time_s [T] s and places [T] m.

    Raises:
        ValueError: for a model or a trial that cannot be read, or a file that cannot be written; before any simulation.
    """
    if options.predict is None or options.trial is None:
        raise ValueError("predict, trial: wanted a model.toml, and the trial.toml to predict")
    check_numbers(options)
    check_device(options.device)
    out = Path(options.out)
    check_folder("out", out.parent, [out.name])
    model = read_model(Path(options.predict))
    threads, device = options.threads or THREADS, chosen(options.device, 0.0)
    columns = predict_trial(model, Path(options.trial), Path(options.predict), threads, device)
    write_table(out, columns)
    return columns


def correct(inputs: Inputs, progress: Progress | None = None) -> FitProblem:
    """What effects are fitted to: recordings, a twin, and the error that its cells make, by a twin with smaller ones.

    Args:
        inputs: That were checked.
        progress: To tell of simulations.

    Raises:
        ValueError: if the body as it is believed does not bear what acts on it.
    """
    report, watch = (silent, silent) if progress is None else (progress.tick, progress.watch)
    return FitProblem(
        inputs.experiment,
        inputs.twin,
        trials=inputs.trials,
        discretization=measure(
            inputs.experiment, inputs.twin, inputs.fine, finest=inputs.finest, threads=inputs.threads, report=report
        ),
        fine=inputs.fine,
        threads=inputs.threads,
        report=report,
        watch=watch,
    )


@threadpool_limits.wrap(limits=1)  # products of small matrices: threads would wait for each other, and round otherwise
def explain(options: Options) -> Explanation:
    """Explain an experiment, and write report.html, explanation.json and model.toml.

    Stage and time left go to standard error, the answer and where the report is to standard output.

    Args:
        options: With ``experiment`` and ``out``.

    Raises:
        ValueError: for options out of range, a folder that cannot be written, or an experiment that cannot be read or
            simulated; nothing is written then.
    """
    torch.set_num_threads(1)  # threads belong to groups of simulations
    begin = time.perf_counter()
    inputs = read_inputs(options)
    progress = Progress()
    try:
        for note in (*inputs.notes, *(f"Hint: {hint}" for hint in inputs.hints)):
            progress.note(note)
        size = f"{inputs.twin.count} points in cells of {1e3 * inputs.twin.edge:.1f} mm"
        progress.note(f"{len(inputs.trials)} trials, each simulated with {size}")
        found, trials = _explained(inputs, options, progress, begin)
    finally:
        progress.close()
    settings = {
        "experiment": str(options.experiment),
        "budget_minutes": options.budget,
        "edge_m": inputs.twin.edge,
        "walls": inputs.twin.walls,
    }
    out = Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    write(found, trials, out, settings)
    write_model(out / "model.toml", inputs.experiment.folder / "setup.toml", found.best, inputs.fine)
    print(f"{lead(found)}\nReport: {out / 'report.html'} (after {span(found.seconds)})")
    return found


def _explained(inputs: Inputs, options: Options, progress: Progress, begin: float) -> tuple[Explanation, list[Trial]]:
    """The explanation, and the trials that it shows."""
    trials, kept = list(inputs.trials), list(inputs.kept)
    told = against_belief(inputs.twin, trials, inputs.threads)
    for finding in told:
        progress.note(f"Hint: {finding}")
    progress.stage("comparing cell sizes")
    problem = correct(inputs, progress)
    discretization = problem.discretization
    progress.stage("simulating what each effect would change")
    tells = isolability(problem, inputs.effects)
    progress.stage("searching among the effects")
    verdict = judge(
        problem, inputs.effects, tells=tells, heldout=kept, budget=60 * options.budget, report=lambda line: None
    )
    progress.stage("predicting trials and writing the report")
    problem = verdict.problem
    best = verdict.best
    following = []
    if len(verdict.chosen) > 1:  # beside one name the set may hold what is unknown
        one, other = ((c.fit.effects, c.fit.point) for c in verdict.chosen[:2])
        following = next_experiment(problem, one, other)
    before, after = verdict.before, verdict.after
    simulated = {p.trial for p in before}
    everything = [t for t in (*trials, *kept) if t.name in simulated]
    if not everything:
        # An effect that breaks down is left out, so that it is the fit without one.
        raise ValueError(
            "experiment: no trial can be simulated with the modulus, pressure and friction that fit best without an "
            "effect, wanted a setup that bears these"
        )
    if len(everything) < len(trials) + len(kept):
        progress.note("Trials that cannot be simulated with what was found are not shown.")
    # With the error that the simulation has as it is corrected, not that of the twin in the search.
    own = verdict.posterior.near.numerics.amplitude.T
    deviation = {t.name: own for t in problem.trials}
    known = problem.only(problem.trials, discretization=problem.discretization.replace(deviation=deviation))
    forces = None
    if verdict.kind == "unknown_physics":
        try:
            forces = force_map(known, best)
        except ValueError as error:  # the verdict is worth its report without it
            progress.note(f"The report shows no map of forces: {error}")
    drawn = at_clocks_of(problem, best, everything, before, after)
    # The report shows the trial that is the furthest off.
    k = int(np.argmax([p.total for p in before]))
    worst = worst_of(k, everything[k], drawn[k], after[k].seen)
    body = None
    try:
        body = body_motion(problem, best, everything[k], after[k].clock, worst)
    except ValueError as error:
        progress.note(f"The report does not draw the body: {error}")
    found = Explanation(
        problem=problem,
        discretization=discretization,
        verdict=verdict,
        before=before,
        after=after,
        drawn=tuple(drawn),
        heldout=tuple(t.name for t in kept),
        mismatches=tuple(mismatches(known, verdict.null_model, everything, after)),
        forces=forces,
        seconds=time.perf_counter() - begin,
        isolability=tells,
        following=tuple(following),
        hints=(*inputs.hints, *map(str, told)),
        worst=worst,
        body=body,
    )
    return found, everything
