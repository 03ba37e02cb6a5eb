"""Print how well a body with larger cells responds, and up to which step it is stable.

    python recipes/validate/cells.py runs/judge/batch-20/cases --cases case-011 case-007 case-000

For each case, the first trial is simulated as stated, by the twin in use, by the one that corrects it, and by one with
cells smaller than these by another third, without planes and weight where the body meets planes, as chance in touching
would hide the rest. Printed are how far the first two move the markers from the third [um], and by how much their
response to a modulus and a pressure that are 5 % off, the worse of the two, differs from its response, as a share; the
step in use over the largest stable one near rest, and for how many of the trials as stated the motion is sound with
steps that are given as such shares.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
import tyro
from chosen_cases import names_of

from torchsoro.command_line import options, program
from torchsoro.sim2real.inference.fit import FitProblem
from torchsoro.sim2real.inference.resolution import finest
from torchsoro.sim2real.inference.twin_error import DiscretizationError
from torchsoro.sim2real.inputs import Inputs, read_inputs
from torchsoro.sim2real.options import Options as Explaining
from torchsoro.sim2real.twin.batch import THREADS, safety, simulate
from torchsoro.sim2real.twin.twin import Twin

OFF = 0.05  # of modulus and pressure, for a response


@options
class Options:
    """Which cases."""

    folder: tyro.conf.Positional[Path]
    """Folder of experiments."""
    cases: tuple[str, ...] = ()
    """Their names; all if none is given."""
    shares: tuple[float, ...] = (0.55, 0.75, 0.85, 0.95)
    """Steps over the largest stable one near rest."""
    until: float = 0.25
    """Of a motion that is compared [s]."""
    threads: int = 0
    """0 for as many as there are processors."""


def moved(inputs: Inputs, twin: Twin, until: float, threads: int) -> np.ndarray:
    """Ways of the markers of the first trial, as stated and beside it [B, ...] m."""
    problem = FitProblem(inputs.experiment, twin, trials=inputs.trials[:1], discretization=DiscretizationError())
    scales = [tolerance for _, tolerance in problem.common[: 1 + bool(twin.setup.chambers)]]
    beside = np.diag([OFF / scale for scale in scales])
    points = np.pad(
        np.concatenate([np.zeros((1, len(scales))), beside]), ((0, 0), (0, len(problem.common) - len(scales)))
    )
    scenario = problem.vary(problem.scenarios[0], (), points)
    scenario = scenario.replace(until=min(until, scenario.until))
    if scenario.planes:
        scenario = scenario.replace(planes=(), gravity=torch.zeros_like(scenario.gravity))
    position = simulate(twin, [scenario], threads=threads, even=True)[0].position
    return np.asarray(position - position[:, :1])


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return math.sqrt(float(np.mean(values**2)))


def main(options: Options) -> None:
    """Print two rows for each case, one for each of its twins.

    Raises:
        ValueError: for a folder without the cases.
    """
    threads = options.threads or THREADS
    names = names_of(options.folder, options.cases)
    print("case      cells [mm]  moves [um]  error [um]  of responses  step in use  sound with steps of")
    for name in names:
        inputs = read_inputs(Explaining(experiment=options.folder / name, out=Path("runs/cells"), threads=threads))
        fine = inputs.fine
        smaller = finest(fine, len(inputs.trials), math.inf)
        assert smaller is not None  # whatever it takes
        reference = moved(inputs, smaller, options.until, threads)
        wanted = reference[1:] - reference[0]
        for twin in (inputs.twin, fine):
            ways = moved(inputs, twin, options.until, threads)
            off = max(rms(a - ways[0] - b) / rms(b) for a, b in zip(ways[1:], wanted, strict=True))
            scenarios = [twin.scenario(trial) for trial in inputs.trials]
            sound = {
                share: sum(int(m.sound.all()) for m in simulate(twin, scenarios, threads=threads, safe=share))
                for share in options.shares
            }
            print(
                f"{name:9s} {1e3 * twin.edge:10.2f} {1e6 * rms(reference[0]):11.0f}"
                f" {1e6 * rms(ways[0] - reference[0]):11.1f} {off:13.3f} {safety(twin):12.2f}  "
                + ", ".join(f"{share:g}: {count} of {len(scenarios)}" for share, count in sound.items()),
                flush=True,
            )


cli = program(main, Options, __doc__)

if __name__ == "__main__":
    cli()
