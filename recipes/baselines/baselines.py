"""What explain.py is compared with, on the same experiments and in the same words: what others do, and parts of it.

    python recipes/baselines/baselines.py my-experiment --out runs/baseline --method all-parameters
    python recipes/baselines/baselines.py --predict runs/baseline/model.toml --trial trial.toml --out markers.csv

Writes explanation.json and, where there is one, model.toml.
"""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
import tyro
from scipy.interpolate import CubicSpline
from scipy.signal import savgol_filter
from torch import nn

from torchsoro.command_line import plain_errors
from torchsoro.output.archive import atomic_write
from torchsoro.sim2real.data.experiment import Trial
from torchsoro.sim2real.hypotheses.library import library
from torchsoro.sim2real.inference.fit import Fit, FitProblem
from torchsoro.sim2real.inference.force_map import StepForce, force_map, patches
from torchsoro.sim2real.inference.heldout import predict
from torchsoro.sim2real.inference.histories import Lines, simulate
from torchsoro.sim2real.inference.likelihood import BREAKS, Effects
from torchsoro.sim2real.inference.model import write_model
from torchsoro.sim2real.inference.starts import correlation
from torchsoro.sim2real.inference.verdict import judge
from torchsoro.sim2real.inputs import read_inputs
from torchsoro.sim2real.options import Options as ExplainOptions
from torchsoro.sim2real.pipeline import correct, predict_markers
from torchsoro.sim2real.report.explanation import effect_rows

Baseline = Literal["modulus-and-damping", "all-parameters", "white-noise", "force-network", "sparse-regression"]
Ablation = Literal["without-numerics", "one-trial", "force-map"]

SIGNIFICANT = 3.0  # standard deviations from what is believed, beyond which a fitted parameter is named
PATCHES, WINDOWS = 4, 10  # that the force network acts on, in each trial
QUIET = 1.7  # chi-squared per sample without an effect, below which nothing is missing
SLICES = 8  # of the body, on which the force map puts its forces
HIDDEN, EPOCHS, DECAY = 16, 1500, 1e-3  # of the force network
IMPROVEMENT = 0.85  # error on trials left out, over that without it, at which a network has found something
FILTER_SAMPLES = 9  # samples of the parabola that is differentiated twice for sparse regression
SPARSITY = 0.1  # of the largest normalised coefficient, below which a term is dropped
PREDICTED_SHARE = 0.1  # share of the residual accelerations of trials left out, at which terms are believed
DIVERGED_ERROR = 1.0  # m, the error where a prediction breaks down


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """What to explain, and how."""

    experiment: tyro.conf.Positional[Path | None] = None
    """Folder of the experiment."""
    out: Path
    """Folder for explanation.json and model.toml; with --predict, the file of the markers."""
    method: Baseline | Ablation = "modulus-and-damping"
    """modulus-and-damping: both fitted. all-parameters: all of the library that need no place, fitted together.
    white-noise: as explain.py, but with independent noise and without the simulation's own error. force-network: a
    network of state and pressure, whose forces on the body explain the residual. sparse-regression: residual
    accelerations of the markers from a list of terms. without-numerics: explain.py with a twin that is corrected, but
    is taken to be exact; one-trial: that sees the first trial only. force-map: where free forces on the body would
    explain what is left, without any effect whose form is known."""
    predict: Path | None = None
    """A model.toml, to predict a trial with instead."""
    trial: Path | None = None
    """The trial.toml to predict."""
    budget: float = 20.0
    """As of explain.py [minutes], for a twin as fine."""
    threads: int = 1
    """That simulate side by side."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Answer:
    """In the words of explanation.json.

    Attributes:
        verdict: Of the five.
        effects: Rows.
        names: Effects that cannot be distinguished.
        heldout: Of trials that were left out, the error as believed and after [m].
        fit: For model.toml, if there is one.
    """

    verdict: str
    effects: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    names: list[str] = dataclasses.field(default_factory=list)
    heldout: dict[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    fit: Fit | None = None


def fit_or_raise(problem: FitProblem, effects: Effects = (), start: np.ndarray | None = None, rounds: int = 6) -> Fit:
    """A fit.

    Raises:
        ValueError: if the simulation breaks down.
    """
    (found,) = problem.fit([(effects, start)], rounds=rounds)
    if found is None:
        raise ValueError(BREAKS)
    return found


def leave_one_out_errors(
    problem: FitProblem, null_model: Fit, other: Callable[[int, FitProblem, Trial], float]
) -> dict[str, tuple[float, float]]:
    """The error of each trial as believed, and what a function of its number, the other trials and it gives."""
    found = {}
    for i, trial in enumerate(problem.trials):
        where = problem.only([t for t in problem.trials if t is not trial])
        (before,) = predict(where, problem.without(null_model, i), [trial], believed=True)
        found[trial.name] = before.total, other(i, where, trial)
    return found


def fit_parameters(problem: FitProblem, names: Sequence[str]) -> Answer:
    """Least squares in some parameters at once; those far from what is believed are named."""
    effects = tuple(problem.thought_of([e for e in library() if e.name in names]))
    start = [np.zeros(len(problem.common))]
    for effect in effects:
        # The strength begins at nothing, what does not matter without it where a search would begin.
        begin = np.zeros(len(effect.quantities)) if effect.joint else np.array(effect.starts[0], float)
        begin[0] = 0.0
        start.append(begin)
    fit = fit_or_raise(problem, effects, np.concatenate(start), rounds=20)
    spread = math.sqrt(max(1.0, fit.chi2 / fit.samples))
    wide = spread**2 * correlation(fit)
    widened = dataclasses.replace(fit, covariances=tuple(wide * c for c in fit.covariances))
    rows = {r["name"]: r for r in effect_rows(widened, 1.0, problem)}
    sure = []
    for effect, values, covariance in zip(fit.effects, fit.values, fit.covariances, strict=True):
        strengths = len(effect.quantities) if effect.joint else 1
        v, c = values[:strengths], covariance[:strengths, :strengths]
        if v.any() and float(v @ np.linalg.pinv(c) @ v) > strengths * (SIGNIFICANT * spread) ** 2:
            sure.append(effect.name)

    def after(i: int, where: FitProblem, trial: Trial) -> float:
        predicted = predict(where, problem.without(fit, i), [trial])
        return predicted[0].total if predicted else DIVERGED_ERROR

    kind = {0: "nothing_missing", 1: "explained"}.get(len(sure), "cannot_distinguish")
    held = leave_one_out_errors(problem, fit_or_raise(problem), after)
    return Answer(verdict=kind, effects=[rows[n] for n in sure], names=sure, heldout=held, fit=fit)


def full_search(problem: FitProblem, budget: float) -> Answer:
    """The verdict of explain.py."""
    verdict = judge(problem, budget=budget, report=lambda line: None)
    rows = effect_rows(verdict.best, 1.0, verdict.problem)
    return Answer(
        verdict=verdict.kind,
        effects=rows,
        names=[c.fit.name for c in verdict.chosen],
        heldout=verdict.heldout,
        fit=verdict.best,
    )


def without_discretization_error(problem: FitProblem) -> FitProblem:
    """The same, as if the corrected twin made no error."""
    known = problem.discretization
    none = {name: np.zeros_like(n) for name, n in known.deviation.items()}
    return problem.only(problem.trials, discretization=known.replace(deviation=none), fine=None)


# A network of forces -----------------------------------------------------------------------------------------------


def features(problem: FitProblem, fit: Fit) -> torch.Tensor:
    """Of each patch and window [T, P, W, F], about one: place, motion of the marker next to it, pressures."""
    places, _ = patches(problem.twin, PATCHES)
    setup = problem.experiment.setup
    longest = int(np.argmax(setup.size))
    along = (places[:, longest] - setup.origin[longest]) / setup.size[longest]
    nearest = np.linalg.norm(places[:, None] - np.array([m.at for m in setup.markers]), axis=-1).argmin(1)
    moved, speeds, pressures = [], [], []
    for motion, scenario in zip(fit.end.motions, problem.scenarios, strict=True):
        middle = (np.arange(WINDOWS) + 0.5) / WINDOWS * scenario.duration
        at = np.minimum(np.searchsorted(motion.time, middle), len(motion.time) - 1)
        moved.append((motion.position - motion.position[:1])[at][:, nearest])
        speeds.append(motion.velocity[at][:, nearest])
        if scenario.pressure is not None:
            p = scenario.pressure.at(torch.from_numpy(middle)).reshape(-1, WINDOWS).T.numpy()
            pressures.append(np.broadcast_to(p[:, None], (WINDOWS, PATCHES, p.shape[1])))
    parts = [np.broadcast_to(along[:, None], (len(moved), WINDOWS, PATCHES, 1))]
    parts += [np.stack(part) / (np.abs(part).max() + 1e-12) for part in (moved, speeds, pressures) if part]
    return torch.from_numpy(np.concatenate(parts, -1).swapaxes(1, 2))


class ForceNetwork(nn.Module):
    """Forces on patches from what happens there; none before it is trained.

    Args:
        inputs: Number of features.
        unit: Size of a force.
    """

    def __init__(self, inputs: int, unit: float) -> None:
        super().__init__()
        self.unit, self.hidden, self.out = unit, nn.Linear(inputs, HIDDEN), nn.Linear(HIDDEN, 3)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)
        self.double()

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Forces [..., 3] of features [..., F]."""
        return self.unit * self.out(torch.tanh(self.hidden(x)))


def train(lines: Lines, x: torch.Tensor) -> ForceNetwork:
    """The network whose forces leave least of a residual, by the linear response."""
    torch.manual_seed(0)
    G, d = torch.from_numpy(lines.histories.G.reshape(len(lines.histories.d), -1)), torch.from_numpy(lines.histories.d)
    network = ForceNetwork(x.shape[-1], float(d.norm() * math.sqrt(G.shape[1]) / G.norm()))
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-2, weight_decay=DECAY)
    for _ in range(EPOCHS):
        optimizer.zero_grad()
        left = d - G @ network(x).reshape(-1)
        loss = (left @ left) / (d @ d)
        loss.backward()
        optimizer.step()
    return network


def force_network(problem: FitProblem) -> Answer:
    """Forces by a network, learned from all trials but one."""
    null_model = fit_or_raise(problem)
    s = problem.experiment.setup
    small = 1e-3 * s.youngs_modulus * min(s.size) ** 3 / max(s.size)
    _, shares = patches(problem.twin, PATCHES)
    steps = tuple(StepForce(share, k / WINDOWS, small) for share in shares for k in range(WINDOWS))
    none = np.zeros((len(problem.trials), PATCHES, WINDOWS, 3))
    motions = simulate(problem, steps, null_model.point[None], none[None], slopes=True)
    x = features(problem, null_model)

    def after(i: int, where: FitProblem, trial: Trial) -> float:
        others = [k for k in range(len(problem.trials)) if k != i]
        still = problem.without(null_model, i)
        lines = Lines(where, still.errors, null_model.point, [motions[k] for k in others], none[others])
        forces = train(lines, x[others])(x[i]).detach().numpy()
        jumps = np.diff(forces, axis=1, prepend=0.0).reshape(-1)
        fit = dataclasses.replace(still, effects=steps, point=np.concatenate([still.point, jumps]))
        # Without forces where the body does not bear them.
        found = predict(where, fit, [trial]) or predict(where, still, [trial])
        return found[0].total

    held = leave_one_out_errors(problem, null_model, after)
    (one, other) = (math.sqrt(sum(v[k] ** 2 for v in held.values())) for k in (0, 1))
    return Answer(verdict="unknown_physics" if other < IMPROVEMENT * one else "nothing_missing", heldout=held)


def largest_force(problem: FitProblem) -> Answer:
    """The place of the largest force that a force map needs, where something is missing."""
    null_model = fit_or_raise(problem)
    if null_model.chi2 < QUIET * null_model.samples:
        return Answer(verdict="nothing_missing", fit=null_model)
    needed = force_map(problem, null_model, count=SLICES, windows=WINDOWS).needed
    rows = [{"name": "force", "parameters": {}, "location_m": n.place.tolist()} for n in needed[:1]]
    return Answer(verdict="unknown_physics", effects=rows, fit=null_model)


# Sparse regression -------------------------------------------------------------------------------------------------


def even_times(time: np.ndarray) -> np.ndarray:
    """Times as far apart as most samples are."""
    return np.arange(time[0], time[-1], float(np.median(np.diff(time))))


def smooth_derivative(time: np.ndarray, track: np.ndarray, order: int) -> np.ndarray:
    """A derivative of a track, some of whose samples were lost, at even times."""
    even, good = even_times(time), np.isfinite(track)
    whole = CubicSpline(time[good], track[good])(even)
    return np.asarray(savgol_filter(whole, FILTER_SAMPLES, 3, deriv=order, delta=float(even[1] - even[0])))


def candidate_terms(problem: FitProblem, fit: Fit) -> tuple[list[str], list[np.ndarray], list[np.ndarray]]:
    """Names of terms, and for each trial their values [N, K] and the residual accelerations [N], by the recordings."""
    names = ["modulus", "stiffening", "viscoelastic", "drag", "friction", "density"]
    names += ["gravity_tilt"] * len(problem.experiment.setup.axes)
    pressed = problem.scenarios[0].pressure is not None
    names += ["pressure_loss", "pressure_lag"] if pressed else []
    values, targets = [], []
    for trial, seen, scenario in zip(problem.trials, fit.seen, problem.scenarios, strict=True):
        assert trial.recording is not None
        t = trial.recording.time
        even = even_times(t)
        p = np.zeros(len(even))
        if scenario.pressure is not None:
            p = scenario.pressure.at(torch.from_numpy(even)).reshape(-1, len(even))[0].numpy()
        rate = np.gradient(p, even)
        rows, accelerations = [], []
        for m, a in np.ndindex(*seen.shape[1:]):
            left = trial.recording.position[:, m, a] - seen[:, m, a]
            if np.isfinite(left).sum() < FILTER_SAMPLES:
                continue
            u = smooth_derivative(t, seen[:, m, a] - seen[0, m, a], 0)
            v, b = (smooth_derivative(t, seen[:, m, a], k) for k in (1, 2))
            speed = float(np.abs(v).max()) or 1.0
            constant = np.zeros((len(even), seen.shape[2]))
            constant[:, a] = 1.0
            columns = [u, u**3, v, v * np.abs(v), np.tanh(20 * v / speed), b, *constant.T]
            if pressed:
                way = float(u[int(np.abs(p).argmax())])
                columns += [p * way, rate * way]
            rows.append(np.stack(columns, -1))
            accelerations.append(smooth_derivative(t, left, 2))
        values.append(np.concatenate(rows))
        targets.append(np.concatenate(accelerations))
    return names, values, targets


def sequential_thresholding(A: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Coefficients by least squares, small ones dropped until none is."""
    scale = np.sqrt((A**2).mean(0)) + 1e-300
    kept = np.ones(A.shape[1], bool)
    x = np.zeros(A.shape[1])
    while kept.any():
        x[:] = 0.0
        x[kept] = np.linalg.lstsq(A[:, kept] / scale[kept], y, rcond=1e-8)[0]
        small = kept & (np.abs(x) < SPARSITY * np.abs(x).max())
        if not small.any():
            break
        kept &= ~small
    return x / scale


def sparse_regression(problem: FitProblem) -> Answer:
    """Terms that the residual accelerations are made of."""
    null_model = fit_or_raise(problem)
    names, values, targets = candidate_terms(problem, null_model)
    left = whole = 0.0
    for i, (A, y) in enumerate(zip(values, targets, strict=True)):
        others = [k for k in range(len(values)) if k != i]
        known, wanted = (np.concatenate([rows[k] for k in others]) for rows in (values, targets))
        x = sequential_thresholding(known, wanted)
        left, whole = left + float(((y - A @ x) ** 2).sum()), whole + float((y**2).sum())
    if left > (1 - PREDICTED_SHARE) * whole:
        return Answer(verdict="nothing_missing")
    A, y = np.concatenate(values), np.concatenate(targets)
    x = sequential_thresholding(A, y)
    sizes: dict[str, float] = {}
    for name, size in zip(names, np.abs(x) * np.sqrt((A**2).mean(0)), strict=True):
        sizes[name] = max(sizes.get(name, 0.0), float(size))
    chosen = [n for n in sorted(sizes, key=lambda n: -sizes[n]) if sizes[n] > 0]
    rows = [{"name": n, "parameters": {}, "confidence": 1.0, "location_m": None} for n in chosen]
    return Answer(verdict="explained" if len(rows) == 1 else "cannot_distinguish", effects=rows, names=chosen)


def main(options: Options) -> Answer | None:
    """Explain an experiment as others would, or predict a trial.

    Raises:
        ValueError: for an experiment that cannot be read or simulated.
    """
    if options.predict is not None:
        predict_markers(ExplainOptions(predict=options.predict, trial=options.trial, out=options.out))
        return None
    begin, seconds = time.perf_counter(), 60 * options.budget
    whole = ExplainOptions(
        experiment=options.experiment, out=options.out, budget=options.budget, threads=options.threads
    )
    torch.set_num_threads(1)  # threads belong to groups of simulations
    inputs = read_inputs(whole)
    if options.method in get_args(Ablation):
        problem = correct(inputs)
    else:
        problem = FitProblem(inputs.experiment, inputs.twin, threads=inputs.threads, trials=inputs.trials, lasting=0.0)
    everything = [e.name for e in library() if not e.local]
    answer = {
        "modulus-and-damping": lambda: fit_parameters(problem, ["modulus", "viscoelastic"]),
        "all-parameters": lambda: fit_parameters(problem, everything),
        "white-noise": lambda: full_search(problem, seconds),
        "force-network": lambda: force_network(problem),
        "sparse-regression": lambda: sparse_regression(problem),
        "without-numerics": lambda: full_search(without_discretization_error(problem), seconds),
        "one-trial": lambda: full_search(problem.only(problem.trials[:1]), seconds),
        "force-map": lambda: largest_force(problem),
    }[options.method]()
    report = {
        "verdict": answer.verdict,
        "effects": [] if answer.verdict == "cannot_distinguish" else answer.effects,
        "set": answer.names,
        "heldout": [{"trial": name, "before": b, "after": a} for name, (b, a) in answer.heldout.items()],
        "cost": {
            "simulations": problem.tally.simulations,
            "seconds": time.perf_counter() - begin,
        },
    }
    options.out.mkdir(parents=True, exist_ok=True)
    with atomic_write(options.out / "explanation.json") as file:
        file.write((json.dumps(report, indent=2) + "\n").encode())
    if answer.fit is not None:
        write_model(options.out / "model.toml", problem.experiment.folder / "setup.toml", answer.fit, problem.twin)
    print(f"{options.method}: {answer.verdict} {', '.join(answer.names)}; {report['cost']['seconds']:.0f} s")
    return answer


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Options, description=__doc__))
