"""Print what the twins of an explanation leave of an experiment by gap.py, with the hidden effect and without it.

    python recipes/validate/gap.py walker --hide tube --out runs/gap
    python recipes/validate/gap_error.py runs/gap
    python recipes/validate/gap_error.py runs/gap --edges 0.0029 0.00175

The twins simulate the described model, and the same with the effect in its true form and with its true numbers. What
is left of each trial, once measurement errors are fitted, is the error of the twin, beside noise. Where it is not far
less with the effect than without, the effect cannot be named by that twin. Motions corrected by ``simulated.csv`` have
what that adds to the twin's motion of the described model.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from torchsoro.command_line import options, program
from torchsoro.sim2real.hypotheses.body_effects import Modulus, SoftPart, Tether
from torchsoro.sim2real.hypotheses.hypothesis import Hypothesis
from torchsoro.sim2real.hypotheses.supply_effects import AirStiffness
from torchsoro.sim2real.inference.discretization import as_simulated
from torchsoro.sim2real.inference.fit import FitProblem
from torchsoro.sim2real.inference.likelihood import added
from torchsoro.sim2real.inference.observed import size_of
from torchsoro.sim2real.inputs import read_inputs
from torchsoro.sim2real.options import Options as Explaining
from torchsoro.sim2real.twin.twin import MarkerTrajectory

Values = Callable[[dict[str, Any]], tuple[Hypothesis, list[float], float]]
"""Of what was hidden: the effect, its values in SI units without its place, and ln of the modulus beside it."""


@options
class Options:
    """Which experiment."""

    experiment: tyro.conf.Positional[Path]
    """Folder that gap.py wrote, with its truth beside it."""
    edges: tuple[float, ...] = ()
    """Edges of the cells of the twins [m]; those of an explanation if none."""
    threads: int = 0
    """0 for as many as there are processors."""


def _tether(truth: dict[str, Any]) -> tuple[Hypothesis, list[float], float]:
    effect = Tether()
    return effect, [truth["parameters"][q.name] for q in effect.quantities], 0.0


def _soft_side(truth: dict[str, Any]) -> tuple[Hypothesis, list[float], float]:
    """A softer half for y > 0: ln E by a step, and half of it everywhere."""
    lost = math.log(1 - truth["parameters"]["fraction"])
    return SoftPart(), [0.0, lost, 0.0, 0.0], lost / 2


def _air(truth: dict[str, Any]) -> tuple[Hypothesis, list[float], float]:
    return AirStiffness(), [truth["parameters"]["air_stiffness_pa"]], 0.0


KNOWN: dict[str, Values] = {"tether": _tether, "soft_side": _soft_side, "air_stiffness": _air}


def true_point(problem: FitProblem, truth: dict[str, Any]) -> tuple[Hypothesis, np.ndarray]:
    """The hidden effect, and all that is simulated with its true numbers [K], in scales.

    Raises:
        ValueError: for an effect that has another form in the library.
    """
    name = truth.get("name", "nothing")
    if name not in KNOWN:
        raise ValueError(f"hidden = {name}: wanted one of {', '.join(KNOWN)}, whose forms are those of the library")
    effect, values, ln_modulus = KNOWN[name](truth)
    stated = [ln_modulus if isinstance(belief, Modulus) else 0.0 for belief, _ in problem.common]
    place = truth["location_m"] if effect.local else []
    return effect, np.array([*stated, *values, *place]) / problem.scales((effect,))


def left(problem: FitProblem, motions: Sequence[MarkerTrajectory]) -> list[float]:
    """Root mean square of what motions leave of each trial, with measurement errors fitted [m]."""
    errors = problem.measure(motions, np.zeros(len(problem.observation.deviations)))[1]
    return [
        size_of((t.recording.position - problem.observation.observe(m, i, errors),))
        for i, (t, m) in enumerate(zip(problem.trials, motions, strict=True))
        if t.recording is not None
    ]


def remainders(problem: FitProblem, truth: dict[str, Any]) -> dict[str, list[float]]:
    """What is left of each trial [m], by what is simulated.

    Raises:
        ValueError: as :func:`true_point`, or for a simulation that breaks down.
    """
    effect, at = true_point(problem, truth)
    asked = [problem.as_stated, ((effect,), at[None])]
    found = [[m.alone() for m in motions] for motions in problem.simulate(asked)]
    if not all(m.sound.all() for motions in found for m in motions):
        raise ValueError(f"{problem.experiment.folder}: a simulation breaks down, wanted a twin that bears what acts")
    described = found[0]
    own = [as_simulated(m, t) for m, t in zip(described, problem.trials, strict=True)]
    by = added(problem.trials, described, own)
    lines = {}
    for name, motions in zip(("described", f"with the true {effect.name}"), found, strict=True):
        lines[name] = left(problem, motions)
        if any(t.simulated for t in problem.trials):
            corrected = [m.plus(by[t.name]) for m, t in zip(motions, problem.trials, strict=True)]
            lines[f"{name}, corrected"] = left(problem, corrected)
    return lines


def main(asked: Options) -> dict[str, dict[str, list[float]]]:
    """Print a table for each twin.

    Returns:
        The same [m], by the edge of the twin's cells in mm.
    """
    path = asked.experiment.parent / f"{asked.experiment.name}-truth.json"
    if not path.is_file():
        raise ValueError(f"experiment = {asked.experiment}: no {path.name} beside it, wanted a folder of gap.py")
    truth = json.loads(path.read_text(encoding="utf-8"))
    inputs = read_inputs(Explaining(experiment=asked.experiment, out=asked.experiment, threads=asked.threads))
    tables = {}
    others = [dataclasses.replace(inputs.twin, edge=edge) for edge in asked.edges]
    for twin in others or (inputs.twin, inputs.fine):
        problem = FitProblem(inputs.experiment, twin, trials=inputs.trials, threads=inputs.threads)
        tables[f"{1e3 * twin.edge:.1f}"] = table = remainders(problem, truth)
        print(f"cells of {1e3 * twin.edge:.1f} mm: mm left of {', '.join(t.name for t in problem.trials)}")
        for name, sizes in table.items():
            print(f"  {name:<32}" + "".join(f"{1e3 * size:8.3f}" for size in sizes), flush=True)
    return tables


cli = program(main, Options, __doc__)

if __name__ == "__main__":
    cli()
