"""Speed of the simulator on a walker-like body: solid with Maxwell elements, a gas chamber, ground contact; float32.

    python recipes/benchmark.py                                    # 2,000, 4,096 and 8,000 particles
    python recipes/benchmark.py --particles 4096 --steps 2000      # longer, one size
    python recipes/benchmark.py --preset paper --device cuda       # 64,000 particles, cell 1.75 mm, dt = 10 us
    python recipes/benchmark.py --compile                          # also seconds to compile, without and with the cache

Each line is one size. "kept" holds all states for the gradient, "recomputed" every sqrt(steps)-th, as long runs do;
both count forward and backward together. Times are the best of some repetitions, after one that compiles.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Literal

import torch
import tyro

from torchsoro import Chamber, Domain, Prony, Simulator, Solid, Trajectory, fill, ground, square_wave, stable_step

EDGE = 0.035  # of the body [m]


def walker(count: int) -> Domain:
    """A box of about ``count`` particles, 35 mm wide, with a chamber of half its width in the middle."""
    n = 2 * round(count ** (1 / 3) / 2)
    height = 2 * round(count / n**2 / 2)
    h, air = EDGE / n, 2 * round(n / 4)
    chamber = Chamber(
        name="air",
        center=(EDGE / 2, EDGE / 2, height * h / 2),
        size=(air * h,) * 3,
        wall=max(1, n // 20) * h,
    )
    return Domain(size=(EDGE, EDGE, height * h), particles=(n, n, height), chambers=(chamber,))


def best_of(repeats: int, work: Callable[[], object], device: torch.device) -> float:
    """Least seconds that ``work`` takes; on a GPU by its own clock."""
    seconds = math.inf
    for _ in range(repeats):
        if device.type == "cuda":
            start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
            torch.cuda.synchronize()
            begin = time.perf_counter()
            start.record()
            work()
            end.record()
            torch.cuda.synchronize()
            # Taichi may launch on a stream of its own, which torch's events do not see.
            seconds = min(seconds, max(start.elapsed_time(end) / 1e3, time.perf_counter() - begin))
        else:
            begin = time.perf_counter()
            work()
            seconds = min(seconds, time.perf_counter() - begin)
    return seconds


def measure(
    count: int, *, device: torch.device, steps: int, elements: int = 3, dt: float | None = None, repeats: int = 3
) -> dict[str, float]:
    """Time one size.

    Args:
        count: Number of particles, about.
        device: CPU or CUDA.
        steps: Substeps.
        elements: Maxwell elements.
        dt: Substep [s]; half the stable one if None.
        repeats: Repetitions of which the best counts.

    Returns:
        Particles, steps, seconds of the first call, microseconds per step and million particle-steps per second:
        forward; forward and backward with all states kept; the same with recomputation.
    """
    domain = walker(count)
    prony, solid = Prony.paper(elements), Solid()
    gamma = torch.full((domain.count,), 0.9, device=device, requires_grad=True)
    cell = domain.cell
    dt = dt or 0.5 * stable_step(fill(domain, gamma.detach(), solid=solid), prony, cell=cell)
    wave = square_wave(amplitude=20e3, frequency=5.0, rise=0.01, fall=0.01, end=steps * dt + 0.2)

    def simulate(segment: int | None = None) -> Trajectory:
        room = EDGE + 4 * cell
        simulator = Simulator(
            cell=cell, dt=dt, low=(-room,) * 3, high=(2 * room,) * 3, memory_budget=32 * 2**30, segment=segment
        )
        return simulator(
            fill(domain, gamma, solid=solid),
            duration=steps * dt,
            prony=prony,
            pressure=wave,
            planes=[ground()],
            sample_every=steps * dt,
        )

    def forward() -> None:
        with torch.no_grad():
            simulate()

    def both(segment: int | None = None) -> None:
        gamma.grad = None
        simulate(segment).center_of_gravity[-1, 2].backward()

    begin = time.perf_counter()
    both()
    row: dict[str, float] = {"particles": domain.count, "steps": steps, "first call [s]": time.perf_counter() - begin}
    cases = {"forward": forward, "kept": both, "recomputed": lambda: both(max(1, math.isqrt(steps)))}
    for name, work in cases.items():
        seconds = best_of(repeats, work, device)
        row[f"{name} [us/step]"] = seconds / steps * 1e6
        row[f"{name} [M/s]"] = domain.count * steps / seconds / 1e6
    return row


def compile_seconds(device: str) -> tuple[float, float]:
    """Seconds of a process that takes one small gradient: with an empty cache of kernels, and again."""
    times = []
    with tempfile.TemporaryDirectory() as cache:
        for _ in range(2):
            begin = time.perf_counter()
            command = [sys.executable, __file__, "--particles", "512", "--steps", "4", "--repeats", "1"]
            subprocess.run(
                [*command, "--device", device],
                env=os.environ | {"TI_OFFLINE_CACHE_FILE_PATH": cache},
                check=True,
                capture_output=True,
            )
            times.append(time.perf_counter() - begin)
    return times[0], times[1]


def main(
    preset: Literal["desk", "paper"] = "desk",
    particles: tuple[int, ...] = (2000, 4096, 8000),
    device: Literal["auto", "cpu", "cuda"] = "auto",
    steps: int = 500,
    elements: int = 3,
    repeats: int = 3,
    compile: bool = False,
) -> None:
    """Measure the speed of the simulator.

    Args:
        preset: "paper" measures the paper's walker instead of ``particles``.
        particles: Sizes to measure.
        device: Where; auto takes CUDA if there is one.
        steps: Substeps of a run.
        elements: Maxwell elements.
        repeats: Repetitions of which the best counts.
        compile: Also measure the compilation, in fresh processes.
    """
    where = torch.device(("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device)
    on = torch.cuda.get_device_name() if where.type == "cuda" else f"{os.cpu_count()} CPU threads"
    print(f"{on}, float32, {elements} Maxwell elements; M/s: million particle-steps per second", flush=True)
    sizes, dt = ((64_000,), 1e-5) if preset == "paper" else (particles, None)
    for i, size in enumerate(sizes):
        row = measure(size, device=where, steps=steps, elements=elements, dt=dt, repeats=repeats)
        if i == 0:
            print("  ".join(row))
        print("  ".join(f"{value:{len(name)}.4g}" for name, value in row.items()), flush=True)
    if compile:
        first, cached = compile_seconds(where.type)
        print(
            f"a process until its first gradient: {first:.1f} s with an empty kernel cache, {cached:.1f} s after that"
        )


if __name__ == "__main__":
    tyro.cli(main)
