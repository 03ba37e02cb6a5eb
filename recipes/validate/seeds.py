"""Design a robot from several initial fields that differ by a millionth, and print what becomes of each.

    python recipes/validate/seeds.py                       # ten desk walkers, about two minutes each on two cores
    python recipes/validate/seeds.py climber --seeds 3
    python recipes/validate/seeds.py --jobs 8 --out runs/seeds    # eight at a time; finished ones are printed

Walking is judged over one cycle, back at the pressure that it began with: travel of the centre of gravity, and that of
the feet, which is as long for a robot that does not just lean.
"""

from __future__ import annotations

import dataclasses
import json
import os
import platform
import statistics
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Literal

import torch
import tyro

from torchsoro.command_line import Count, options, program
from torchsoro.design.presets import CLIMBER, WALKER
from torchsoro.design.robot import build
from torchsoro.design.settings import Settings
from torchsoro.design.starts import disturb, optimize_starts
from torchsoro.simulation.threads import set_threads, thread_count
from torchsoro.storage import atomic_write


@options
class Options:
    """Which robot, and how often."""

    robot: tyro.conf.Positional[Literal["walker", "climber"]] = "walker"
    """What to design, by its desk preset."""
    seeds: Count = 10
    """Number of initial fields."""
    jobs: Count = 1
    """Designs at a time, among which the threads are shared."""
    out: Path = Path("runs/seeds")
    """Folder of the runs; one that is cut off goes on."""


def designed(settings: Settings, seed: int) -> dict[str, float]:
    """Result of the design from the initial field of a seed."""
    robot = build(settings)
    disturb(robot.field, 100 + seed)  # others than its starts have
    begin, used = time.perf_counter(), time.process_time()
    found = optimize_starts(robot)
    with torch.no_grad():
        outcome = robot(found.gamma)
    return {
        "L": float(outcome.travel),
        "feet": float(outcome.feet),
        "C": float(outcome.intermediate),
        "seconds": time.perf_counter() - begin,
        "cpu_seconds": time.process_time() - used,
    }


def finished(seed: int, robot: str, out: Path, threads: int) -> dict[str, float]:
    """The result of a seed, from its folder if it is there."""
    folder = out / f"{robot}{seed}"
    path = folder / "result.json"
    if not path.is_file():
        set_threads(threads)
        preset = (WALKER if robot == "walker" else CLIMBER)["desk"]
        resume = (folder / "settings.json").is_file()
        row = designed(dataclasses.replace(preset, device="cpu", out=folder, resume=resume), seed)
        with atomic_write(path) as file:
            file.write(json.dumps(row).encode())
    return json.loads(path.read_text(encoding="utf-8"))


def processor() -> str:
    """Name of the processor, and number of its cores that may be used."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{names[0] if names else platform.processor() or platform.machine()}, {os.cpu_count()} cores"


def main(chosen: Options) -> list[dict[str, float]]:
    """Design each, and print a line for each and one for all."""
    limit = (WALKER if chosen.robot == "walker" else CLIMBER)["desk"].c_max
    jobs = min(chosen.jobs, chosen.seeds)
    threads = max(1, thread_count() // jobs)
    task = partial(finished, robot=chosen.robot, out=chosen.out, threads=threads)
    rows = []
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        for seed, row in enumerate(pool.map(task, range(chosen.seeds))):
            rows.append(row)
            print(
                f"seed {seed}: L = {1e3 * row['L']:.2f} mm, feet {1e3 * row['feet']:.2f} mm, C = {row['C']:.4f} "
                f"(limit {limit:g}), {row['seconds']:.0f} s, of processors {row['cpu_seconds']:.0f} s",
                flush=True,
            )
    travels, shares = [1e3 * row["L"] for row in rows], [row["feet"] / row["L"] for row in rows]
    print(
        f"{chosen.robot}, {len(rows)} initial fields: L median {statistics.median(travels):.2f} mm, "
        f"{min(travels):.2f} to {max(travels):.2f} mm; feet over centre at least {min(shares):.2f}; "
        f"largest C {max(row['C'] for row in rows):.4f}; {jobs} at a time with {threads} threads each on {processor()}"
    )
    return rows


cli = program(main, Options, __doc__)

if __name__ == "__main__":
    cli()
