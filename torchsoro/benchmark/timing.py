"""What ``benchmark.py`` measures with: the walker-like body and its runs, clocks, memory, and plain-text tables."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchsoro.design.density import fill
from torchsoro.design.domain import Chamber, Domain
from torchsoro.errors import SimulationDiverged
from torchsoro.simulation.actuation import square_wave
from torchsoro.simulation.contact import ground
from torchsoro.simulation.formulation import FormulationName, Total, formulation_of
from torchsoro.simulation.material import Body, Gas, Prony, Solid
from torchsoro.simulation.simulator import Simulator
from torchsoro.simulation.stability import stable_step

EDGE = 0.035  # of the body [m]
PAPER_CELL, PAPER_STEP = 1.75e-3, 1e-5  # [m], [s]
LARGEST = 2**31 - 1  # Taichi indexes a buffer with 32 bits
Row = dict[str, Any]
# What the loops of a kernel do, in order; another kernel's are numbered.
LOOPS = {
    "substep": ("nodes", "particles (g2p, p2g)"),
    "substep_adjoint": ("nodes", "particles (p2g, g2p)"),
    "total_substep": ("points (gather, stress, sums)", "nodes"),
    "total_substep_adjoint": ("nodes", "points (gather, stress, sums)", "sums over all nodes and points"),
    "total_march": ("all",),
    "total_march_adjoint": ("all",),
}


# What a forward step moves of a particle beside its history and of a node, and how many nodes lie beyond the cells.
NUMBERS = {"updated": (2 * 24 + 7, 14, 3), "total": (4, 19, 2)}
VOID_RANGE = (0.1, 0.3)  # as in the design recipes


def walker(count: int) -> Domain:
    """A box of about ``count`` particles, 35 mm wide, with a chamber of half its width in the middle."""
    n = 2 * round(count ** (1 / 3) / 2)
    height = 2 * round(count / n**2 / 2)
    h, air = EDGE / n, 2 * round(n / 4)
    center = (EDGE / 2, EDGE / 2, height * h / 2)
    chamber = Chamber(name="air", center=center, size=(air * h,) * 3, wall=max(1, n // 20) * h)
    return Domain(size=(EDGE, EDGE, height * h), particles=(n, n, height), chambers=(chamber,))


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    """A run: about ``count`` particles over ``steps`` substeps.

    It rests for a third of the time and is then driven at 80 kPa and 5 Hz, as the paper's walker is. Its density falls
    from front to back, so that it travels. ``dt`` [s] is by default the paper's for its cell; with ``auto`` the
    simulator chooses its own for the same duration. ``segment`` and ``budget`` [bytes] are the simulator's. ``bodies``
    of this size are simulated at once, each a little denser than the one before. Without ``lanes`` a CPU runs the
    kernels of a GPU.
    """

    count: int
    formulation: FormulationName
    device: torch.device
    steps: int
    elements: int = 3
    dt: float | None = None
    auto: bool = False
    segment: int | None = None
    budget: int | None = None
    bodies: int = 1
    lanes: bool = True

    @cached_property
    def domain(self) -> Domain:
        """The body's lattice."""
        return walker(self.count)

    @cached_property
    def gamma(self) -> Tensor:
        """Density [N], or [bodies, N] if there are several."""
        falling = 0.65 + 0.25 * torch.cos(math.pi / EDGE * self.domain.positions[:, 0])
        if self.bodies > 1:
            falling = falling + torch.linspace(0.0, 0.05, self.bodies).to(falling).unsqueeze(1)
        return torch.where(self.domain.wall, torch.ones_like(falling), falling).to(self.device, torch.float32)

    @cached_property
    def prony(self) -> Prony:
        """Maxwell elements."""
        return Prony.paper(self.elements)

    def body(self, gamma: Tensor) -> Body:
        """The lattice filled with material."""
        gas = Gas(density=formulation_of(self.formulation).air_density)
        return fill(self.domain, gamma, solid=Solid(), gas=gas, void_range=VOID_RANGE)

    @cached_property
    def substep(self) -> float:
        """The substep [s] unless the simulator chooses it."""
        usual = round(PAPER_STEP * self.domain.cell / PAPER_CELL, 12)
        return self.dt or min(usual, 0.9 * self.limit)

    @cached_property
    def limit(self) -> float:
        """Largest stable substep [s]."""
        body = self.body(self.gamma)
        return stable_step(body, self.prony, cell=self.domain.cell, formulation=self.formulation)

    @cached_property
    def simulator(self) -> Simulator:
        """The simulator."""
        room = EDGE + 4 * self.domain.cell
        options: Row = {"dt": "auto" if self.auto else self.substep, "cell": self.domain.cell}
        form = Total(lanes=self.lanes) if self.formulation == "total" else self.formulation
        options |= {"formulation": form, "segment": self.segment, "memory_budget": self.budget}
        return Simulator(low=(-room,) * 3, high=(2 * room,) * 3, **options)

    @property
    def times(self) -> tuple[float, float]:
        """At rest, and in all [s]."""
        rest = self.steps // 3 * self.substep
        return rest, 3 * rest if self.auto else self.steps * self.substep

    @property
    def taken(self) -> float:
        """The substep [s] that the simulator takes."""
        rest, duration = self.times
        body = self.body(self.gamma)
        return self.simulator.step(body, self.prony, duration=duration, sample_every=rest or duration)

    def run(self, gamma: Tensor) -> Tensor:
        """L: how far the centre of gravity travels along x after the rest [m]; the mean of several bodies."""
        rest, duration = self.times
        trajectory = self.simulator(
            self.body(gamma),
            duration=duration,
            prony=self.prony,
            pressure=square_wave(
                amplitude=80e3, frequency=5.0, rise=0.015, fall=0.025, start=rest, end=duration + self.substep
            ),
            planes=[ground()],
            sample_every=rest or duration,
        )
        x = trajectory.center_of_gravity[..., 0]
        return (x[..., -1] - x[..., 1 if rest else 0]).mean()

    def forward(self) -> None:
        """A run without gradient."""
        with torch.no_grad():
            self.run(self.gamma)

    def gradient(self, watch: Watch | None = None) -> tuple[Tensor, Tensor]:
        """L and its gradient by the density [N]; the watch is read before, between and after forward and backward."""
        watch = watch or Watch(self.device)
        gamma = self.gamma.clone().requires_grad_()
        watch.mark()
        L = self.run(gamma)
        watch.mark()
        L.backward()
        watch.mark()
        assert gamma.grad is not None
        return L.detach(), gamma.grad

    def kept(self) -> Case:
        """The same with all states kept, over no more steps than fit into the memory and into Taichi's indices."""
        numbers = self.bodies * self.domain.count * (24 + 6 * self.elements)
        room = torch.cuda.mem_get_info()[1] * 2 // 3 if self.device.type == "cuda" else 4 * 2**30
        fit = min(LARGEST // numbers, int(room / (1.2 * 4 * numbers))) - 1
        return dataclasses.replace(self, steps=min(self.steps, fit), budget=room)

    def recomputed(self) -> Case:
        """The same in two segments or more, whose states backward computes again, as in long runs."""
        kept = self.kept()
        return dataclasses.replace(self, segment=max(1, min(self.steps // 2, kept.steps)), budget=kept.budget)


class Watch:
    """A stopwatch: CUDA's events on a GPU, for Taichi and torch launch on the same stream; else the wall clock."""

    def __init__(self, device: torch.device) -> None:
        self.gpu, self.marks = device.type == "cuda", []

    def mark(self) -> None:
        """Read the watch."""
        if self.gpu:
            self.marks.append(torch.cuda.Event(enable_timing=True))
            self.marks[-1].record()
        else:
            self.marks.append(time.perf_counter())

    def laps(self) -> list[float]:
        """Seconds between the marks."""
        pairs = zip(self.marks, self.marks[1:], strict=False)
        if self.gpu:
            torch.cuda.synchronize()
            return [a.elapsed_time(b) / 1e3 for a, b in pairs]
        return [b - a for a, b in pairs]


def peak(device: torch.device, *, reset: bool = False) -> float | None:
    """Peak memory since the last reset [GB]; none on a CPU."""
    if device.type != "cuda":
        return None
    if reset:
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
    return torch.cuda.max_memory_allocated() / 1e9


def best_of(repeats: int, work: Callable[[], object], device: torch.device) -> tuple[float, float | None]:
    """Least seconds that ``work`` takes after a first time, and its peak memory [GB]."""
    work()
    peak(device, reset=True)
    seconds = math.inf
    for _ in range(repeats):
        watch = Watch(device)
        watch.mark()
        work()
        watch.mark()
        seconds = min(seconds, *watch.laps())
    return seconds, peak(device)


def copy_bandwidth(device: torch.device) -> float:
    """Bytes read and written per second by a copy that is larger than any cache."""
    source = torch.ones(2**30 // 4 if device.type == "cuda" else 2**28 // 4, device=device)
    target = torch.empty_like(source)
    return 2 * source.nbytes / best_of(5, lambda: target.copy_(source), device)[0]


def least_bytes(case: Case) -> int:
    """What a forward step must at least move.

    Updated: 24 numbers and the history of a particle both ways, its seven coefficients; of a node mass and momentum
    written and read, then the velocity. Total: the history both ways and four coefficients of a point; of a node
    displacement and velocity both ways, force written and read, the mass.
    """
    history = 6 * case.elements
    of_particle, of_node, beyond = NUMBERS[case.formulation]
    nodes = math.prod(n // 2 + beyond for n in case.domain.particles)
    return 4 * (case.domain.count * (of_particle + 2 * history) + nodes * of_node)


def child(code: str, **environment: str) -> str:
    """Standard output of a process that runs ``code`` with this module imported."""
    path = str(Path(__file__).resolve().parent)
    command = [sys.executable, "-c", f"import sys; sys.path.insert(0, {path!r}); import timing; {code}"]
    done = subprocess.run(command, env=os.environ | environment, check=True, capture_output=True, text=True)
    return done.stdout


def trace(count: int, formulation: FormulationName, device: str, steps: int, elements: int, bodies: int = 1) -> None:
    """Print the milliseconds of each Taichi task in a forward run and in its gradient; for a process of its own."""
    from taichi.profiler.kernel_profiler import get_default_kernel_profiler

    fixed: Row = {"count": count, "formulation": formulation, "device": torch.device(device)}
    case = Case(**fixed, steps=steps, elements=elements, bodies=bodies).recomputed()
    case.gradient()
    profiler, phases = get_default_kernel_profiler(), []
    gamma = case.gamma.clone().requires_grad_()
    profiler.clear_info()
    L = case.run(gamma)
    for work in (lambda: None, L.backward):
        work()
        profiler.get_total_time()  # brings the records here
        # Taichi lists them by name nowhere else.
        phases.append({name: found.total_time for name, found in profiler._statistical_results.items()})
        profiler.clear_info()
    print(json.dumps(phases))


def named(tasks: dict[str, float], gpu: bool) -> dict[str, tuple[str, float]]:
    """Milliseconds of what a kernel's loops do, as (kernel, milliseconds), from those of Taichi's tasks.

    Serial tasks find the bounds of a loop and count the clock; on a CPU a loop over few nodes is one, too.
    """
    kernels: dict[str, list[tuple[int, str, float]]] = {}
    for task, spent in tasks.items():
        found = re.fullmatch(r"(.+)_c\d+_\d+_kernel_(\d+)_(\w+)", task)
        kernel, number, kind = found.groups() if found else (task, "0", "range_for")
        kernels.setdefault(kernel, []).append((int(number), kind, spent))
    out: dict[str, tuple[str, float]] = {}
    for kernel, parts in kernels.items():
        most = 0.02 * sum(spent for *_, spent in parts)
        loops = [spent for _, kind, spent in sorted(parts) if kind != "serial" or (not gpu and spent > most)]
        names = LOOPS.get(kernel, ())
        if not names or len(loops) % len(names):
            names = [f"loop {i + 1}" for i in range(len(loops))]
        # Several substeps may be unrolled into a kernel.
        out |= {f"{kernel}: {name}": (kernel, sum(loops[i :: len(names)])) for i, name in enumerate(names)}
        rest = sum(spent for *_, spent in parts) - sum(loops)
        if rest > 0:
            out[f"{kernel}: bounds, clock"] = (kernel, rest)
    return out


def say(text: str, begin: float = time.perf_counter()) -> None:
    """Progress, on stderr."""
    print(f"[{time.perf_counter() - begin:6.1f} s] {text}", file=sys.stderr, flush=True)


def shown(value: Any) -> str:
    """A number for people."""
    if isinstance(value, float):
        return f"{value:,.0f}" if 1000 <= abs(value) < 1e9 else f"{value:.4g}"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "-" if value is None else f"{value:,}" if isinstance(value, int) else str(value)


def table(title: str, rows: list[Row]) -> None:
    """Print rows with the same names as an aligned table."""
    cells = [list(rows[0]), *([shown(v) for v in row.values()] for row in rows)] if rows else []
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    text = [isinstance(v, str) for v in rows[0].values()] if rows else []
    print(f"\n{title}")
    for line in cells:
        aligned = (c.ljust(w) if t else c.rjust(w) for c, w, t in zip(line, widths, text, strict=True))
        print("  " + "  ".join(aligned).rstrip(), flush=True)


@contextlib.contextmanager
def skipping(what: str) -> Iterator[None]:
    """Say what cannot be measured here (it does not fit, does not exist, or breaks down), and go on."""
    try:
        yield
    except (ValueError, torch.OutOfMemoryError, subprocess.CalledProcessError, SimulationDiverged) as error:
        lines = str(getattr(error, "stderr", None) or error).strip().splitlines()
        print(f"\n{what}: not measured: {lines[-1] if lines else type(error).__name__}", flush=True)
