"""Print how far chance in touching drowns the derivatives that searches follow.

    python recipes/validate/slopes.py runs/judge/batch-20/cases --cases case-186 case-222 case-137

For each case, and for each number that is stated with a tolerance, the motion of the first trial is simulated at the
setup as stated and a step beside it, by the twin in use, with planes moved by less than a cell. A difference quotient
with planes in one place is off by chance. Printed are the response to one tolerance [um], by the mean over all shifts
at the longest step, and the error of one quotient with a step of a twentieth, as bodies without planes have it, and
with the step and the number of shifts that are chosen.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import tyro
from chosen_cases import names_of

from torchsoro.command_line import options, program
from torchsoro.sim2real.inference.discretization import measure
from torchsoro.sim2real.inference.fit import FitProblem
from torchsoro.sim2real.inference.likelihood import SECANT, STEP
from torchsoro.sim2real.inference.touching import GAPS, shifted
from torchsoro.sim2real.inputs import read_inputs
from torchsoro.sim2real.options import Options as Explaining


@options
class Options:
    """Which cases."""

    folder: tyro.conf.Positional[Path]
    """Folder of experiments."""
    cases: tuple[str, ...] = ()
    """Their names; all if none is given."""
    threads: int = 0
    """0 for as many as there are processors."""


def quotients(problem: FitProblem, step: float) -> np.ndarray:
    """Difference quotients of what is recorded of the first trial, by stated number and shift [K, R, ...] m."""
    count, none = len(problem.common), np.zeros(len(problem.observation.deviations))
    points = np.concatenate([np.zeros((1, count)), step * np.eye(count)])
    found = shifted(problem, [((), point[None]) for point in points], GAPS)
    seen = np.array([[problem.observation.observe(m.alone(k), 0, none) for k in range(len(GAPS))] for (m,) in found])
    return np.asarray((seen[1:] - seen[0]) / step)


def rms(values: np.ndarray) -> float:
    """Root mean square of what is not lost [um]."""
    return 1e6 * math.sqrt(float(np.nanmean(values**2)))


def main(options: Options) -> None:
    """Print a row for each case and number.

    Raises:
        ValueError: for a folder without the cases.
    """
    names = names_of(options.folder, options.cases)
    print("case      number          noise  response  error: step 0.05   step (shifts)  as chosen  [um]")
    for name in names:
        inputs = read_inputs(
            Explaining(experiment=options.folder / name, out=Path("runs/slopes"), threads=options.threads)
        )
        error = measure(inputs.experiment, inputs.twin, inputs.fine, threads=inputs.threads)
        problem = FitProblem(
            inputs.experiment, inputs.twin, trials=inputs.trials[:1], discretization=error, threads=inputs.threads
        )
        near, far, chosen = (quotients(problem, step) for step in (STEP, SECANT, problem.step))
        for k, (belief, _) in enumerate(problem.common):
            print(
                f"{name:9s} {type(belief).__name__:14s} {1e6 * problem.noise:6.0f}  {rms(far[k].mean(0)):8.0f}"
                f"  {rms(near[k] - near[k].mean(0)):16.0f}   {problem.step:.2f} ({problem.looks})"
                f"  {rms(chosen[k] - chosen[k].mean(0)) / math.sqrt(problem.looks):15.0f}",
                flush=True,
            )


cli = program(main, Options, __doc__)

if __name__ == "__main__":
    cli()
