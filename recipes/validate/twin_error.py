"""Print along which effects a twin errs, trial by trial, in cases of a judge's batch that lack nothing.

    python recipes/validate/twin_error.py runs/judge/batch-18 --cases case-070 case-092 case-147

Each case is simulated by the finer twin with the modulus and the pressure that the judge's body has. What the recording
then leaves is the error of the twin, beside noise. Along the response to each effect its amplitude is fitted in each
trial by itself, beside measurement errors. An error that lasts from trial to trial has one sign in all of them; by
chance, three trials agree in one of four.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import tyro

from torchsoro.command_line import options, program
from torchsoro.sim2real.hypotheses.body_effects import Density, Modulus, Stiffening, Viscoelastic
from torchsoro.sim2real.hypotheses.hypothesis import Hypothesis
from torchsoro.sim2real.hypotheses.outer_effects import FluidDrag, GravityTilt
from torchsoro.sim2real.hypotheses.supply_effects import AirStiffness, OrificeLeak, PressureGain, PressureLag
from torchsoro.sim2real.inference.fit import FitProblem
from torchsoro.sim2real.inference.likelihood import Request
from torchsoro.sim2real.inputs import read_inputs
from torchsoro.sim2real.options import Options as Explaining

EFFECTS = (
    *(Modulus, Viscoelastic, Stiffening, Density, FluidDrag, GravityTilt),
    *(PressureLag, PressureGain, OrificeLeak, AirStiffness),
)
CORRELATED = 10.0  # samples that count as one: noise in part lasts


@options
class Options:
    """Which cases."""

    batch: tyro.conf.Positional[Path]
    """Folder of a batch with its truth, as seal.py makes it."""
    cases: tuple[str, ...] = ()
    """Names of cases that lack nothing; all of the batch if none is given."""
    threads: int = 0
    """0 for as many as there are processors."""


def true_point(problem: FitProblem, nuisance: dict[str, float]) -> np.ndarray:
    """What is stated, at the numbers that the judge's body has [K], in scales."""
    known = {
        Modulus: math.log(nuisance["youngs_modulus"] / problem.experiment.setup.youngs_modulus),
        PressureGain: math.log(nuisance.get("pressure_gain", 1.0)),
    }
    return np.array([known.get(type(belief), 0.0) / tolerance for belief, tolerance in problem.common])


def amplitudes(problem: FitProblem, at: np.ndarray, effects: list[Hypothesis]) -> np.ndarray:
    """Amplitude of the twin's error along the response to each effect, in each trial [effects, trials] m."""
    points = [e.probe_points(problem.twin)[0][0] for e in effects]
    asked: list[Request] = [((e,), np.concatenate([at, p])[None]) for e, p in zip(effects, points, strict=True)]
    bare, *moved = problem.simulate([((), at[None]), *asked])
    deviations = problem.observation.deviations
    none = np.zeros(len(deviations))
    weight = 1 / (CORRELATED * problem.noise**2)
    found = np.zeros((len(effects), len(problem.trials)))
    for i, trial in enumerate(problem.trials):
        assert trial.recording is not None
        seen, errors = problem.observation.linearise(bare[i].alone(), i, none)
        left = (trial.recording.position - seen).ravel()
        held = np.isfinite(left)
        for k, motions in enumerate(moved):
            response = problem.observation.observe(motions[i].alone(), i, none) - seen
            size = math.sqrt(float(np.nanmean(response**2)))
            X = np.concatenate([response[..., None] / size, errors], -1).reshape(len(left), -1)[held]
            prior = np.diag(np.concatenate([[0.0], 1 / deviations**2]))
            found[k, i] = np.linalg.solve(weight * X.T @ X + prior, weight * X.T @ left[held])[0]
    return found


def main(asked: Options) -> None:
    """Print a table of each case, and in how many directions all trials agree."""
    sealed = asked.batch / "sealed"
    truths = {p.stem: json.loads(p.read_text()) for p in sorted(sealed.glob("case-*.json"))}
    if not truths:
        raise ValueError(f"batch = {asked.batch}: no sealed/case-*.json, wanted a batch with its truth")
    names = asked.cases or [n for n, t in truths.items() if t["kind"] == "null"]
    if unknown := [n for n in names if n not in truths or truths[n]["effects"]]:
        raise ValueError(f"cases = {', '.join(unknown)}: wanted cases of {sealed} that lack nothing")
    agreed = count = 0
    for name in names:
        inputs = read_inputs(
            Explaining(experiment=asked.batch / "cases" / name, out=asked.batch, threads=asked.threads)
        )
        problem = FitProblem(inputs.experiment, inputs.fine, trials=inputs.trials, threads=inputs.threads)
        effects = problem.thought_of([kind() for kind in EFFECTS])
        found = amplitudes(problem, true_point(problem, truths[name]["nuisance"]), effects)
        print(f"{name}, {truths[name]['specimen']}: mm along the response to an effect, by trial")
        for effect, own in zip(effects, found, strict=True):
            print(f"  {effect.name:<14}" + "".join(f"{1e3 * a:+9.3f}" for a in own), flush=True)
            agreed, count = agreed + (abs(np.sign(own).sum()) == len(own)), count + 1
    print(f"one sign in all trials: {agreed} of {count} directions")


cli = program(main, Options, __doc__)

if __name__ == "__main__":
    cli()
