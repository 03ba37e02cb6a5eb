"""Design a robot from several initial fields that differ by 1e-6, and print what becomes of each.

    python recipes/validate/seeds.py                       # ten desk walkers, about a minute each on two cores
    python recipes/validate/seeds.py climber --seeds 3
    python recipes/validate/seeds.py --out runs/seeds      # again: what is finished there is only printed

Walking is judged over one cycle, back at the pressure that it began with: travel of the centre of gravity, and that of
the feet, which is as long for a robot that does not just lean.
"""

from __future__ import annotations

import dataclasses
import json
import statistics
import time
from pathlib import Path
from typing import Literal

import torch
import tyro

from torchsoro.command_line import Count, options, program
from torchsoro.design.loop import optimize
from torchsoro.design.presets import CLIMBER, WALKER
from torchsoro.design.robot import build
from torchsoro.design.settings import Settings
from torchsoro.storage import atomic_write

CHANGE = 1e-6  # of the initial field, standard deviation


@options
class Options:
    """Which robot, and how often."""

    robot: tyro.conf.Positional[Literal["walker", "climber"]] = "walker"
    """What to design, by its desk preset."""
    seeds: Count = 10
    """Number of initial fields."""
    out: Path = Path("runs/seeds")
    """Folder of the runs; one that is cut off goes on."""


def designed(settings: Settings, seed: int) -> dict[str, float]:
    """Result of the design from the initial field of a seed."""
    robot = build(settings)
    change = CHANGE * torch.randn(robot.field.phi.shape, generator=torch.Generator().manual_seed(seed))
    with torch.no_grad():
        robot.field.phi.add_(change.to(robot.field.phi)).clamp_(-1, 1)
    begin = time.perf_counter()
    found = optimize(robot)
    with torch.no_grad():
        outcome = robot(found.gamma)
    return {
        "L": float(outcome.travel),
        "feet": float(outcome.feet),
        "C": float(outcome.intermediate),
        "seconds": time.perf_counter() - begin,
    }


def main(chosen: Options) -> list[dict[str, float]]:
    """Design each, and print a line for each and one for all."""
    preset = (WALKER if chosen.robot == "walker" else CLIMBER)["desk"]
    rows = []
    for seed in range(chosen.seeds):
        folder = chosen.out / f"{chosen.robot}{seed}"
        path = folder / "result.json"
        if not path.is_file():
            resume = (folder / "settings.json").is_file()
            row = designed(dataclasses.replace(preset, out=folder, resume=resume), seed)
            with atomic_write(path) as file:
                file.write(json.dumps(row).encode())
        row = json.loads(path.read_text(encoding="utf-8"))
        rows.append(row)
        print(
            f"seed {seed}: L = {1e3 * row['L']:.2f} mm, feet {1e3 * row['feet']:.2f} mm, C = {row['C']:.4f} "
            f"(limit {preset.c_max:g}), {row['seconds']:.0f} s",
            flush=True,
        )
    travels, shares = [1e3 * row["L"] for row in rows], [row["feet"] / row["L"] for row in rows]
    print(
        f"{chosen.robot}, {len(rows)} initial fields: L median {statistics.median(travels):.2f} mm, "
        f"{min(travels):.2f} to {max(travels):.2f} mm; feet over centre at least {min(shares):.2f}; "
        f"largest C {max(row['C'] for row in rows):.4f}"
    )
    return rows


cli = program(main, Options, __doc__)

if __name__ == "__main__":
    cli()
