"""Simulate the archived robots by both engines of a CPU, and print how far each goes.

    python recipes/validate/engines.py                     # all, without void: half a minute and several minutes each
    python recipes/validate/engines.py walker climber --cycles 0.5

The total form runs in lanes of vector registers or by the kernels of a GPU. Both solve the same equations in single
precision, with sums in another order.
"""

from __future__ import annotations

import dataclasses
import time
from typing import Annotated

import torch
import tyro
from pydantic import Field

from torchsoro.command_line import options, program, progress_bar
from torchsoro.design.reading import read_settings
from torchsoro.design.robot import build
from torchsoro.output import archive
from torchsoro.simulation.formulation import Total


@options
class Options:
    """Which robots, and how long."""

    robots: tyro.conf.Positional[tuple[str, ...]] = ()
    """Names of archived robots; all if left out."""
    cycles: Annotated[float, Field(strict=True, gt=0, le=1000)] = 1.0
    """Cycles of the pressure."""


@torch.no_grad()
def travel(name: str, cycles: float, lanes: bool) -> tuple[float, float]:
    """Travel of an archived robot [m], simulated without void on this CPU, and the seconds that it took."""
    folder = archive.find(name)
    base = read_settings(folder / "settings.json", device="cpu")
    duration = max(1, round(cycles / base.frequency / base.sample_every)) * base.sample_every
    robot = build(dataclasses.replace(base, duration=duration, settle=min(base.settle, 0.05)))
    robot.formulation = Total(lanes=lanes)
    gamma = archive.load_design(folder / "design.npz", robot.domain)
    begin = time.perf_counter()
    with progress_bar(f"{name}, {'lanes' if lanes else 'kernels of a GPU'}") as progress:
        outcome = robot(gamma, void=False, progress=progress)
    return float(outcome.travel), time.perf_counter() - begin


def main(chosen: Options) -> dict[str, tuple[float, float]]:
    """Print a line for each robot; returns its travel by lanes and by the kernels of a GPU [m].

    Raises:
        ValueError: for a robot that is not there.
    """
    found = {}
    for name in chosen.robots or archive.names():
        (one, here), (other, there) = (travel(name, chosen.cycles, lanes) for lanes in (True, False))
        found[name] = (one, other)
        print(
            f"{name}, {chosen.cycles:g} cycles: {1e3 * one:.3f} mm in lanes ({here:.0f} s), {1e3 * other:.3f} mm by "
            f"the kernels of a GPU ({there:.0f} s), {100 * (other / one - 1):+.2f} %",
            flush=True,
        )
    return found


cli = program(main, Options, __doc__)

if __name__ == "__main__":
    cli()
