"""Simulate archived robots with and without contact of the body with itself, in turns, and print what it costs.

    python recipes/validate/selfcontact.py walker              # one cycle, four times: two minutes
    python recipes/validate/selfcontact.py walker --cycles 0.25 --repeats 3

Void is left out. Seconds are those of the simulation with every particle recorded, the least of all repeats; particles
that lie in another part of the body are counted as ``torchsoro.simulation.selfcontact.overlapping`` finds them.
"""

from __future__ import annotations

import dataclasses
import time
from typing import Annotated

import torch
import tyro
from pydantic import Field

from torchsoro.command_line import Count, options, program, progress_bar
from torchsoro.design.reading import read_settings
from torchsoro.design.robot import build
from torchsoro.output import archive
from torchsoro.output.folding import folded


@options
class Options:
    """Which robots, how long and how often."""

    robots: tyro.conf.Positional[tuple[str, ...]] = ("walker",)
    """Names of archived robots."""
    cycles: Annotated[float, Field(strict=True, gt=0, le=1000)] = 1.0
    """Cycles of the pressure."""
    repeats: Count = 2
    """Simulations of each kind."""


@dataclasses.dataclass(frozen=True)
class Found:
    """Of one simulation: microseconds per substep, travel [m], particles in another part of the body."""

    step: float
    travel: float
    folded: int


@torch.no_grad()
def simulated(name: str, cycles: float, on: bool) -> Found:
    """Simulate an archived robot on this CPU."""
    folder = archive.find(name)
    base = read_settings(folder / "settings.json", device="cpu")
    duration = max(1, round(cycles / base.frequency / base.sample_every)) * base.sample_every
    settle = min(base.settle, 0.05)
    robot = build(dataclasses.replace(base, duration=duration, settle=settle, self_contact=on))
    gamma = archive.load_design(folder / "design.npz", robot.domain)
    with progress_bar(f"{name}, {'with' if on else 'without'} self-contact") as progress:
        begin = time.perf_counter()
        outcome = robot(gamma, void=False, everything=True, progress=progress)
        seconds = time.perf_counter() - begin
    steps = (settle + duration) / outcome.dt
    return Found(1e6 * seconds / steps, float(outcome.travel), folded(robot, gamma.numpy(), outcome.trajectory))


def main(chosen: Options) -> dict[str, tuple[Found, Found]]:
    """Print a line for each robot; returns what was found without and with self-contact.

    Raises:
        ValueError: for a robot that is not there.
    """
    found = {}
    for name in chosen.robots:
        runs = [[simulated(name, chosen.cycles, on) for on in (False, True)] for _ in range(chosen.repeats)]
        without, there = (min(kind, key=lambda run: run.step) for kind in zip(*runs, strict=True))
        found[name] = without, there
        print(
            f"{name}, {chosen.cycles:g} cycles without and with self-contact: {without.step:.0f} and {there.step:.0f} "
            f"us/step ({there.step / without.step:.2f} times), travel {1e3 * without.travel:.3f} and "
            f"{1e3 * there.travel:.3f} mm, {without.folded} and {there.folded} particles in another part of the body",
            flush=True,
        )
    return found


cli = program(main, Options, __doc__)

if __name__ == "__main__":
    cli()
