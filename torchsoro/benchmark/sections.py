"""The sections of ``recipes/benchmark.py``: what each measures, and the table that it prints."""

from __future__ import annotations

import dataclasses
import json
import os
import tempfile
import time
from typing import Any

import torch
from torch import Tensor

from torchsoro.benchmark.naive import Naive
from torchsoro.benchmark.options import Options
from torchsoro.benchmark.timing import (
    EDGE,
    Case,
    Row,
    Watch,
    best_of,
    child,
    copy_bandwidth,
    least_bytes,
    named,
    peak,
    say,
    skipping,
    table,
)

PAPER_STEPS = 75_000
SIZES = {"cpu": (2000, 4096, 8000, 16_384), "cuda": (16_384, 64_000, 216_000, 512_000, 2_000_376)}
# Quantity, required, aim; on one H200.
WANTED = (
    ("forward [us/step]", "30", "20"),
    ("forward and backward of 75,000 steps [s]", "8", "6"),
    ("device memory [GB]", "20", "10"),
    ("same bits in two runs", "yes", "yes"),
    ("512,000 particles, forward [M/s]", "1,500", "2,500"),
    ("five Maxwell elements over three", "1.4", ""),
)


def naive_step(options: Options) -> list[Row]:
    """The naive step, and how many times faster the formulations are."""
    case = options.case("updated")
    cells = [n // 2 for n in case.domain.particles]
    naive = Naive(
        case.body(case.gamma),
        case.prony,
        cell=case.domain.cell,
        dt=case.substep,
        low=(-2 * EDGE,) * 3,
        nodes=(5 * cells[0],) * 3,
    )

    def march() -> None:
        for _ in range(case.steps):
            naive.step()

    seconds = {"naive": best_of(options.repeats, march, case.device)[0]}
    for formulation in options.formulations:
        with skipping(f"naive, {formulation}"):
            seconds[formulation] = best_of(options.repeats, options.case(formulation).forward, case.device)[0]
    return [
        {
            "step": name,
            "particles": case.domain.count,
            "forward [us]": 1e6 * value / case.steps,
            "naive over this": seconds["naive"] / value,
        }
        for name, value in seconds.items()
    ]


def measure(case: Case, *, repeats: int, bandwidth: float) -> Row:
    """Time one size: a row of the table."""
    count, kept, floor = case.domain.count, case.kept(), least_bytes(case) / bandwidth
    say(f"{case.formulation}, {count:,} particles: forward")
    forward, _ = best_of(repeats, case.forward, case.device)
    row: Row = {"particles": count, "formulation": case.formulation, "steps": case.steps}
    row |= {"floor [us]": 1e6 * floor, "forward [us]": 1e6 * forward / case.steps}
    row |= {"forward [M/s]": count * case.steps / forward / 1e6, "kept: steps": kept.steps}
    for name, each in (("kept", kept), ("recomputed", case.recomputed())):
        say(f"{case.formulation}, {count:,} particles: forward and backward, {name}")
        seconds, memory = best_of(repeats, each.gradient, case.device)
        row[f"{name} [us]"] = 1e6 * seconds / each.steps
        row[f"{name} [M/s]"] = count * each.steps / seconds / 1e6
        row[f"{name} [GB]"] = memory
    return row


def sizes(options: Options, bandwidth: float) -> list[Row]:
    """The table over sizes and formulations."""
    rows = []
    for count in options.particles or SIZES[options.target.type]:
        for formulation in options.formulations:
            case = options.case(formulation, count=count)
            with skipping(f"{count:,} particles, {formulation}"):
                rows.append(measure(case, repeats=options.repeats, bandwidth=bandwidth))
    return rows


def engines(options: Options) -> list[Row]:
    """The total-Lagrangian form on a CPU: sixteen lanes of its vector registers against the kernels of a GPU."""
    rows: list[Row] = []
    for count, bodies in ((4096, 1), (64_000, 1), (1000, 16)):
        # So many steps that what a call sets up (10 ms at 4,096 points, 55 ms at 64,000, 30 ms for 16 bodies) hardly
        # counts: 1,000, 300 and 3,000 by default.
        steps = max(300, 2 * options.table_steps * 4096 // (count * bodies)) if bodies == 1 else 6 * options.table_steps
        case = options.case("total", count=count, bodies=bodies, steps=steps)
        seconds: dict[str, tuple[float, float]] = {}
        for name, lanes in (("lanes", True), ("GPU's kernels", False)):
            say(f"{count:,} points, {bodies} bodies, {name}")
            one = dataclasses.replace(case, lanes=lanes)
            kept = one.kept()
            forward, _ = best_of(options.repeats, one.forward, case.device)
            both, _ = best_of(options.repeats, kept.gradient, case.device)
            seconds[name] = forward / one.steps, both / kept.steps
        points = case.domain.count * bodies
        (fast, fast_both), (slow, slow_both) = seconds["lanes"], seconds["GPU's kernels"]
        rows.append(
            {"points": case.domain.count, "bodies": bodies, "forward [M/s]": points / fast / 1e6}
            | {"GPU's kernels [M/s]": points / slow / 1e6, "ratio": slow / fast}
            | {"both [M/s]": points / fast_both / 1e6, "GPU's, both [M/s]": points / slow_both / 1e6}
            | {"ratio of both": slow_both / fast_both}
        )
    return rows


def traced(case: Case) -> list[dict[str, tuple[str, float]]]:
    """Milliseconds of each Taichi task, with its kernel: in a forward run, and in its gradient with recomputation."""
    say(f"{case.formulation}: Taichi's profiler, in a process of its own")
    arguments = (case.count, case.formulation, case.device.type, case.steps, case.elements, case.bodies)
    printed = child(f"timing.trace(*{arguments!r})", TI_KERNEL_PROFILER="1")
    return [named(each, case.device.type == "cuda") for each in json.loads(printed.strip().splitlines()[-1])]


def host(options: Options) -> list[Row]:
    """A step by the clock over what its kernels take: far more than 1 says that the device waits for the host.

    Of one body, and of 64 bodies of 1,000 particles at once.
    """
    rows = []
    for formulation in options.formulations:
        for changes in ({}, {"bodies": 64, "count": 1000}):
            # So many steps that what a call sets up, 55 ms, hardly counts.
            case = options.case(formulation, steps=10 * options.table_steps, **changes)
            with skipping(f"host, {formulation}, {case.bodies} bodies"):
                phases = [sum(spent for _, spent in phase.values()) for phase in traced(case)]
                row: Row = {"formulation": formulation, "bodies": case.bodies, "particles": case.domain.count}
                works = (Case.forward, lambda c: c.recomputed().gradient())
                for name, work, spent in zip(("forward", "both"), works, (phases[0], sum(phases)), strict=True):
                    seconds, _ = best_of(options.repeats, lambda c=case, w=work: w(c), case.device)
                    clock, kernels = 1e6 * seconds / case.steps, 1e3 * spent / case.steps
                    row |= {f"{name} [us]": clock, f"{name}, kernels [us]": kernels, f"{name}, ratio": clock / kernels}
                rows.append(row)
    return rows


def tasks(options: Options, formulation: str) -> list[Row]:
    """Share of each Taichi task in a step forward and back with recomputation."""
    case = options.case(formulation)
    phases = traced(case)
    forward = {kernel for kernel, _ in phases[0].values()}
    total = sum(spent for phase in phases for _, spent in phase.values())
    rows = [
        {
            "formulation": formulation,
            "part": "forward" if i == 0 else "recompute" if kernel in forward else "adjoint",
            "task": task,
            "[us/step]": 1e3 * spent / case.steps,
            "share [%]": 100 * spent / total,
        }
        for i, phase in enumerate(phases)
        for task, (kernel, spent) in phase.items()
    ]
    return sorted(rows, key=lambda row: ("forward", "recompute", "adjoint").index(row["part"]))


def split(options: Options, formulation: str) -> Row:
    """Forward, recompute and backward by the clock; the recompute is what backward takes longer without the states."""
    case = options.case(formulation).kept()
    laps: dict[str, list[float]] = {}
    for name, each in (("kept", case), ("recomputed", case.recomputed())):
        say(f"{formulation}: forward and backward by the clock, {name}")
        each.gradient()
        watches = [Watch(case.device) for _ in range(options.repeats)]
        for watch in watches:
            each.gradient(watch)
        laps[name] = [1e6 / case.steps * min(lap) for lap in zip(*(w.laps() for w in watches), strict=True)]
    (kept, adjoint), (forward, backward) = laps["kept"], laps["recomputed"]
    row: Row = {"formulation": formulation, "forward [us]": forward, "forward, kept [us]": kept}
    return row | {"recompute [us]": backward - adjoint, "adjoint [us]": adjoint}


def where(options: Options) -> dict[str, list[Row]]:
    """Where the time goes: by Taichi's tasks and by the clock."""
    tables: dict[str, list[Row]] = {"tasks": [], "split": []}
    for formulation in options.formulations:
        with skipping(f"where the time goes, {formulation}"):
            tables["split"].append(split(options, formulation))
            tables["tasks"] += tasks(options, formulation)
    return tables


def rollout(case: Case) -> tuple[Row, Tensor, Tensor]:
    """The whole rollout once, after a short one that compiles: its row, L and gradient."""
    dataclasses.replace(case, steps=min(case.steps, 300)).recomputed().gradient()
    say(f"{case.formulation}: forward and backward of {case.steps:,} steps of {case.domain.count:,} particles")
    peak(case.device, reset=True)
    watch = Watch(case.device)
    L, gradient = case.gradient(watch)
    forward, backward = watch.laps()
    row: Row = {"formulation": case.formulation, "particles": case.domain.count, "steps": case.steps}
    row |= {"forward [s]": forward, "forward [us/step]": 1e6 * forward / case.steps, "both [s]": forward + backward}
    row |= {
        "memory [GB]": peak(case.device),
        "L [mm]": 1e3 * float(L),
        "|dL/dgamma| [mm]": 1e3 * float(gradient.norm()),
    }
    return row, L, gradient


def rollouts(options: Options) -> dict[str, list[Row]]:
    """Whole rollouts: one, one more for the bits, one with the largest step."""
    steps = options.steps or (PAPER_STEPS if options.preset == "paper" else 3000)
    tables: dict[str, list[Row]] = {"rollout": [], "bits": [], "auto": []}
    for formulation in options.formulations:
        case = options.case(formulation, steps=steps)
        with skipping(f"rollout, {formulation}"):
            row, L, gradient = rollout(case)
            tables["rollout"].append(row)
            if "bits" in options.sections:
                _, again, other = rollout(case)
                same: Row = {name: row[name] for name in ("formulation", "particles", "steps")}
                same |= {"L": torch.equal(L, again), "gradient": torch.equal(gradient, other)}
                tables["bits"].append(same | {"equal": same["L"] and same["gradient"]})
            if "auto-dt" in options.sections:
                auto = dataclasses.replace(case, auto=True)
                faster, again, other = rollout(auto)
                row = {"formulation": formulation, "dt [us]": 1e6 * case.substep}
                row |= {"auto [us]": 1e6 * auto.taken, "auto: both [s]": faster["both [s]"]}
                row |= {"L, auto [mm]": faster["L [mm]"], "L: difference": abs(float(again / L) - 1)}
                row["gradient: difference"] = float((other - gradient).norm() / gradient.norm())
                row["cosine"] = float(torch.nn.functional.cosine_similarity(other, gradient, dim=0))
                tables["auto"].append(row)
    return tables


def five_elements(options: Options) -> list[Row]:
    """Cost of five Maxwell elements over that of three, at the same step."""
    rows = []
    for formulation in options.formulations:
        with skipping(f"five elements, {formulation}"):
            say(f"{formulation}: five Maxwell elements and three")
            five = options.case(formulation, elements=5)
            three = dataclasses.replace(five, elements=3, dt=five.substep)
            row: Row = {"formulation": formulation, "particles": five.domain.count}
            for name, work in (("forward", Case.forward), ("both", lambda case: case.recomputed().gradient())):
                times = [best_of(options.repeats, lambda c=c, w=work: w(c), c.device)[0] for c in (three, five)]
                row |= {f"{name}, {n} [us]": 1e6 * t / five.steps for n, t in zip((3, 5), times, strict=True)}
                row[f"{name}, ratio"] = times[1] / times[0]
            rows.append(row)
    return rows


def compile_seconds(options: Options) -> list[Row]:
    """Seconds of a process that takes one small gradient: with an empty cache of kernels, and again."""
    rows = []
    for formulation in options.formulations:
        with skipping(f"compilation, {formulation}"), tempfile.TemporaryDirectory() as cache:
            row: Row = {"formulation": formulation}
            for name in ("empty cache [s]", "after that [s]"):
                say(f"{formulation}: a process until its first gradient, {name}")
                begin = time.perf_counter()
                arguments = f"count=512, formulation={formulation!r}, steps=4, elements={options.elements}"
                device = f"device=timing.torch.device({options.target.type!r})"
                child(f"timing.Case({arguments}, {device}).gradient()", TI_OFFLINE_CACHE_FILE_PATH=cache)
                row[name] = time.perf_counter() - begin
            rows.append(row)
    return rows


def beside_the_required(results: dict[str, Any], formulations: tuple[str, ...]) -> list[Row]:
    """What was measured beside what was required of it on one H200; nothing from another size or a shorter run."""

    def find(section: str, column: str, **where: Any) -> Any:
        rows = (row for row in results.get(section, []) if all(row[k] == v for k, v in where.items()))
        return next((row[column] for row in rows), None)

    rows: list[Row] = [{"quantity": q, "required": required, "aim": aim} for q, required, aim in WANTED]
    for f in formulations:
        paper: Row = {"formulation": f, "particles": 64_000}
        whole = paper | {"steps": PAPER_STEPS}
        ratios = [find("five", f"{name}, ratio", **paper) for name in ("forward", "both")]
        values = (
            find("rollout", "forward [us/step]", **whole),
            find("rollout", "both [s]", **whole),
            find("rollout", "memory [GB]", **whole),
            find("bits", "equal", **whole),
            find("table", "forward [M/s]", formulation=f, particles=512_000),
            None if None in ratios else max(ratios),
        )
        for row, value in zip(rows, values, strict=True):
            row[f] = value
    return rows


TITLES = {
    "naive": "Naive step: four plain Taichi kernels over the full grid, forward only",
    "table": "Sizes",
    "tasks": "Where the time goes: Taichi's tasks in a step forward and back with recomputation",
    "split": "Where the time goes, by the clock, per step",
    "engines": "Engines on a CPU, total-Lagrangian form: million point-steps per second",
    "host": "A step by the clock over its kernels' own time",
    "rollout": "Whole rollout",
    "bits": "Equal bits in two whole rollouts",
    "auto": "The step that the simulator chooses, and relative differences from the small one",
    "five": "Five Maxwell elements over three",
    "compile": "A process until its first gradient",
    "required": "Beside the required (one H200, 64,000 particles, 75,000 steps)",
}


def run(options: Options) -> dict[str, Any]:
    """Measure, print and write; returns all numbers."""
    on = torch.cuda.get_device_name() if options.target.type == "cuda" else f"{os.cpu_count()} CPU threads"
    bandwidth = copy_bandwidth(options.target)
    torch.set_num_threads(1)  # Taichi's threads do the work; torch's would spin beside them
    results: dict[str, Any] = {"device": on, "torch": torch.__version__, "copy [GB/s]": bandwidth / 1e9}
    print(f"{on}, float32, {options.elements} Maxwell elements; a large copy moves {bandwidth / 1e9:,.0f} GB/s")

    def show(**sections: list[Row]) -> None:
        for name, rows in sections.items():
            if rows:
                results[name] = rows
                table(TITLES[name], rows)

    try:
        if "naive" in options.sections:
            show(naive=naive_step(options))
        if "table" in options.sections:
            show(table=sizes(options, bandwidth))
        if "engines" in options.sections:
            if options.target.type == "cuda":
                raise ValueError("only = engines: compares two engines of a CPU, wanted --device cpu")
            show(engines=engines(options))
        if "where" in options.sections:
            show(**where(options))
        if "host" in options.sections:
            show(host=host(options))
        if {"rollout", "bits", "auto-dt"} & set(options.sections):
            show(**rollouts(options))
        if "five" in options.sections:
            show(five=five_elements(options))
        if "compile" in options.sections:
            show(compile=compile_seconds(options))
        if options.preset == "paper":
            show(required=beside_the_required(results, options.formulations))
    finally:
        if options.json is not None:
            options.json.write_text(json.dumps(results, indent=1) + "\n")
    return results
