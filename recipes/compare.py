"""The paper's checks on a finished robot: slopes, modulus, pressure, frequency, early designs, elements, cell, method.

    python recipes/compare.py walker --out runs/compare            # an archived robot, see torchsoro/designs
    python recipes/compare.py runs/walker --out runs/compare       # one of your own
    python recipes/compare.py walker --out runs/compare --only design half_cell
    python recipes/compare.py walker --out runs/robust --scenarios 64    # friction, tilt, pressure, modulus, tube
    python recipes/compare.py runs/coarse --out runs/fine --scenarios 64 --particles 40 40 40 --wall 0.00175

A row for each check goes to ``compare.json``, and the motion of some to ``motion_<check>.npz``, from which
``recipes/validate/pages.py`` draws. Checks that are there already are not repeated. Meant for a GPU: on two cores a
check of a design at the paper's size takes five to fifteen minutes, one at half the cell size hours.

With ``--scenarios`` it is simulated in so many scenarios instead, drawn from the ranges of its settings by a seed that
its design run did not use: ``scenarios.csv``, a line for each, ``scenarios.json`` and ``scenarios.png``.
Robots that were designed for different times are compared with the same ``--settle`` and ``--duration``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import tyro

from torchsoro.command_line import AtLeastZero, Count, CountOrZero, Positive, options, program


@options
class Options:
    """What to check."""

    robot: tyro.conf.Positional[str]
    """Name of an archived robot, or a run's folder."""
    out: Path
    """Folder for the results; one for each robot."""
    only: tuple[str, ...] = ()
    """Checks to do; all if none are named."""
    iterations: tuple[CountOrZero, ...] = ()
    """Early designs to look at; of 0, 5, 10, 20, 50 and 100 those that were kept if none are named."""
    scenarios: CountOrZero = 0
    """Simulate it in so many scenarios instead of the checks."""
    seed: CountOrZero | None = None
    """Of these scenarios; one that no iteration of the design run had, if left out."""
    void: bool = True
    """Simulate void, too, in the scenarios."""
    particles: tuple[Count, Count, Count] | None = None
    """Simulate it on another lattice in the scenarios: particles along the edges."""
    wall: Positive | None = None
    """Thickness of the chamber wall there [m], a whole number of spacings; as designed if left out."""
    settle: AtLeastZero | None = None
    """Time before the actuation starts in the scenarios [s]; as designed if left out."""
    duration: Positive | None = None
    """Time of actuation in the scenarios, over which the travel is measured [s]; as designed if left out."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to compute; auto takes CUDA if there is one."""


def main(chosen: Options) -> dict[str, dict[str, Any]]:
    """Perform the checks; see :func:`torchsoro.output.comparison.compare`."""
    from torchsoro.output.comparison import compare  # here, so that --help is there at once

    if chosen.scenarios:
        from torchsoro.output.robustness import compare_scenarios

        return {
            "scenarios": compare_scenarios(
                chosen.robot,
                chosen.out,
                count=chosen.scenarios,
                seed=chosen.seed,
                void=chosen.void,
                particles=chosen.particles,
                wall=chosen.wall,
                settle=chosen.settle,
                duration=chosen.duration,
                device=chosen.device,
            )
        }
    alone = [name for name in ("particles", "wall", "settle", "duration") if getattr(chosen, name) is not None]
    if alone:
        raise ValueError(
            f"{', '.join(alone)}: wanted with --scenarios only; the checks have times and lattices of their own"
        )
    how = {"only": chosen.only, "iterations": chosen.iterations, "device": chosen.device}
    return compare(chosen.robot, chosen.out, **how)


cli = program(main, Options, __doc__)

if __name__ == "__main__":
    cli()
