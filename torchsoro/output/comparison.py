"""The paper's checks on a finished robot: slopes, modulus, pressure, frequency, early designs, cell, formulation."""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from torchsoro.command_line import progress_bar
from torchsoro.design.objective import mean_stride
from torchsoro.design.outcome import Outcome
from torchsoro.design.reading import CHAMBERS, lasting, read_settings
from torchsoro.design.robot import Robot, build
from torchsoro.design.settings import Settings
from torchsoro.errors import SimulationDiverged
from torchsoro.output.archive import find, kept_iterations, load_design, load_shape, load_supply
from torchsoro.output.delivery import mean_pressure
from torchsoro.storage import atomic_write, check_folder, read_json

LONG = 2.0  # s of actuation, where a robot is watched for an extended time
EARLY = (0, 5, 10, 20, 50, 100)
PHASES = 8  # of a cycle, kept for pictures


@dataclasses.dataclass(frozen=True, kw_only=True)
class Check:
    """One simulation.

    Attributes:
        title: For the table.
        changes: Settings that differ from the design run's.
        long: Actuate for ``LONG`` instead of the run's duration.
        finer: Particles along an edge, as a multiple of the design's.
        iteration: Design of this iteration instead of the final one.
        motion: Keep the motion for pictures.
        void: Simulate void, too.
    """

    title: str
    changes: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    long: bool = False
    finer: int = 1
    iteration: int | None = None
    motion: bool = False
    void: bool = True


def checks(s: Settings, iterations: Sequence[int]) -> dict[str, Check]:
    """The checks of a robot, by name; without those of numbers that a file gives instead of the settings.

    Args:
        s: Its settings.
        iterations: Early designs to look at.
    """
    updated = {"formulation": "updated", "transfer": "apic", "air_density": "auto"}
    found = {"design": Check(title="as designed", long=True, motion=True)}
    if s.robot == "walker":
        slopes = {"level": 0.0, **{f"uphill_{p}": p / 100 for p in (10, 20, 30)}}
        found |= {
            name: Check(
                title=name.replace("_", " ") + " %" * (slope > 0), changes={"slope": slope}, long=True, motion=True
            )
            for name, slope in slopes.items()
            if slope != s.slope
        }
    found |= {
        "double_modulus": Check(title="double modulus", changes={"youngs_modulus": 2 * s.youngs_modulus}),
        "double_modulus_and_pressure": Check(
            title="double modulus, double pressure",
            changes={"youngs_modulus": 2 * s.youngs_modulus, "pressure": 2 * s.pressure},
        ),
        "50_kPa": Check(title="50 kPa", changes={"pressure": 50e3}, long=True),
        "3_Hz": Check(title="3 Hz", changes={"frequency": 3.0}, long=True),
        "five_elements": Check(title="five Maxwell elements", changes={"elements": 5}),
        "half_cell": Check(title="half the cell size", finer=2),
        "half_cell_without_void": Check(title="half the cell size, void left out", finer=2, void=False),
        "updated": Check(title="updated formulation (MLS-MPM), void left out", changes=updated, void=False),
        "updated_half_cell": Check(title="updated formulation, half the cell size", changes=updated, finer=2),
    }
    if s.material is not None:  # which gives modulus and Maxwell elements
        found = {k: check for k, check in found.items() if not {"youngs_modulus", "elements"} & check.changes.keys()}
    if s.pressure_file is not None:  # which gives pressure and cycle, and ends
        found = {
            k: dataclasses.replace(check, long=False)
            for k, check in found.items()
            if not {"pressure", "frequency"} & check.changes.keys()
        }
    return found | {f"iteration_{k}": Check(title=f"iteration {k}", iteration=k, motion=True) for k in iterations}


def finer(gamma: torch.Tensor, shape: tuple[int, int, int], times: int) -> torch.Tensor:
    """A density on a lattice with so many times the particles along each edge, by trilinear interpolation [N]."""
    if times == 1:
        return gamma
    volume = gamma.view(1, 1, *shape)
    return torch.nn.functional.interpolate(volume, scale_factor=times, mode="trilinear").flatten()


def perform(folder: Path, base: Settings, check: Check, stage: str) -> tuple[Robot, torch.Tensor, Outcome]:
    """Simulate one check.

    Args:
        folder: The robot's folder.
        base: Its settings.
        check: The check.
        stage: Name of the check, for the progress bar.

    Raises:
        ValueError: if the folder lacks the design of the check's iteration.
        SimulationDiverged: if the simulation breaks down.
    """
    particles = tuple(check.finer * n for n in base.particles)
    # What is stiffer or finer needs a smaller step.
    step = {"dt": "auto"} if check.changes or check.finer > 1 else {}
    timed = lasting(base, LONG) if check.long else base
    s = dataclasses.replace(timed, **{"particles": particles, **step, **check.changes})
    robot, coarse = build(s), build(dataclasses.replace(base, device="cpu")).domain
    at = check.iteration
    gamma = load_design(folder / "design.npz", coarse) if at is None else load_shape(folder, coarse, at)
    load_supply(folder / "design.npz", robot.supply)  # of early designs, too, whose own was not kept
    gamma = finer(gamma, base.particles, check.finer).to(s.target)
    with torch.no_grad(), progress_bar(stage) as progress:
        return robot, gamma, robot(gamma, everything=check.motion, void=check.void, progress=progress)


def row(robot: Robot, outcome: Outcome, base: Settings, check: Check, seconds: float) -> dict[str, Any]:
    """What a check says, in SI units; L is over the design run's duration, stride and speed over all whole cycles."""
    s, trajectory = robot.settings, outcome.trajectory
    instants = trajectory.time.cpu().double().numpy()
    course = trajectory.center_of_gravity.cpu().double().numpy()
    way = course @ np.array(robot.direction)
    begin, end = np.interp([s.settle, s.settle + base.duration], instants, way)
    stride = mean_stride(way, instants, start=s.settle, period=1 / s.frequency)
    return {
        "title": check.title,
        "L": float(end - begin),
        "stride": number(stride),
        "speed": number(stride * s.frequency),
        "fall": float(outcome.fall),
        **({"turn": float(outcome.turn)} if s.robot == "turner" else {}),
        "dt": outcome.dt,
        "seconds": seconds,
        "time": [round(t, 7) for t in instants.tolist()],
        "cog": np.round(course, 7).tolist(),
    }


def number(value: float) -> float | None:
    """A number that JSON has: not NaN, which a stride is without a whole cycle."""
    return None if math.isnan(value) else value


def keep_motion(path: Path, robot: Robot, gamma: torch.Tensor, outcome: Outcome, base: Settings, check: Check) -> None:
    """Write what pictures need: start, phases of the last whole cycle of the design's duration, ends of all cycles."""
    s, trajectory = robot.settings, outcome.trajectory
    instants = trajectory.time.cpu().double().numpy()
    period = 1 / s.frequency
    wanted = [s.settle + base.duration]
    if check.iteration is None:
        cycles = math.floor(base.duration / period + 1e-9)
        first = s.settle + max(cycles - 1, 0) * period
        wanted += [first + k * period / PHASES for k in range(PHASES + 1)]
        wanted += list(np.arange(s.settle, instants[-1] + 1e-9, period))
    chosen = sorted({int(np.abs(instants - t).argmin()) for t in wanted})
    rest = robot.domain.positions.to(trajectory.position)
    moved = 1e3 * (trajectory.position[chosen] - rest)
    supply = mean_pressure(robot, trajectory.time[chosen])
    with atomic_write(path) as file:
        np.savez_compressed(
            file,
            time=instants[chosen],
            pressure=supply,
            displacement=moved.half().cpu().numpy(),
            gamma=gamma.half().cpu().numpy(),
        )


def compare(
    robot: str,
    out: Path,
    *,
    only: Sequence[str] = (),
    iterations: Sequence[int] = (),
    device: Literal["auto", "cpu", "cuda"] = "auto",
) -> dict[str, dict[str, Any]]:
    """Perform the checks of one robot; those that the folder holds already are not repeated.

    Args:
        robot: Name of an archived robot, or a run's folder.
        out: Folder for the results; one for each robot.
        only: Checks to do; all if none are named.
        iterations: Early designs to look at; of ``EARLY`` those that were kept if none are named.
        device: Where to compute.

    Returns:
        The rows by name, those of earlier calls included.

    Raises:
        ValueError: for a robot, a check or an early design that does not exist, or a folder that cannot be written or
            holds the checks of another robot.
    """
    folder = find(robot)
    base = read_settings(folder / "settings.json", device=device, resume=False, scenarios=0)
    known = checks(base, iterations or [k for k in EARLY if k in kept_iterations(folder)])
    if unknown := sorted(set(only) - set(known)):
        raise ValueError(f"only = {', '.join(unknown)}: wanted some of {', '.join(known)}")
    kept = kept_iterations(folder)
    early = [check.iteration for name, check in known.items() if name in (only or known)]
    if gone := [k for k in early if k is not None and k not in kept]:
        listed = ", ".join(map(str, kept)) or "none"
        raise ValueError(f"iterations = {gone}: wanted some of those that {folder} has kept: {listed}")
    copied = ("settings.json", "metrics.csv", "design.npz")  # for the pages
    copied += (CHAMBERS,) if (folder / CHAMBERS).is_file() else ()
    if missing := [name for name in copied if not (folder / name).is_file()]:
        raise ValueError(f"robot = {robot!r}: {folder} has no {', '.join(missing)}, wanted a finished run")
    load_design(folder / "design.npz", build(dataclasses.replace(base, device="cpu")).domain)
    file = out / "compare.json"
    check_folder("out", out, (*copied, file.name))
    rows = _held(file, base.robot)
    out.mkdir(parents=True, exist_ok=True)
    for name in copied:
        with atomic_write(out / name) as copy:
            copy.write((folder / name).read_bytes())
    wanted = [name for name in only or known if name not in rows]
    for place, name in enumerate(wanted, start=1):
        check, begin = known[name], time.perf_counter()
        try:
            simulated, gamma, outcome = perform(folder, base, check, f"{name} ({place} of {len(wanted)})")
            rows[name] = row(simulated, outcome, base, check, time.perf_counter() - begin)
            if check.motion:
                keep_motion(out / f"motion_{name}.npz", simulated, gamma, outcome, base, check)
        except (SimulationDiverged, ValueError) as error:  # also one that this machine cannot hold
            rows[name] = {"title": check.title, "error": str(error)}
        with atomic_write(file) as target:
            listed = [{"check": key, **value} for key, value in rows.items()]
            target.write(json.dumps({"robot": base.robot, "rows": listed}).encode())
        print(line(name, rows[name]), flush=True)
    return rows


def _held(file: Path, robot: str) -> dict[str, dict[str, Any]]:
    """The rows of earlier calls, by name."""
    if not file.exists():
        return {}
    held = read_json(file, dict)
    try:
        rows = {row.pop("check"): row for row in held["rows"]}
    except (AttributeError, KeyError, TypeError) as error:
        raise ValueError(f"out: {file} is damaged ({error!r}), wanted rows of checks; choose another folder") from error
    if held.get("robot") != robot:
        raise ValueError(f"out: {file} holds the checks of a {held.get('robot')}, wanted those of a {robot}")
    return rows


def line(name: str, found: Mapping[str, Any]) -> str:
    """A row in one line."""
    if "error" in found:
        return f"{name:28s} {found['error']}"
    stride = "no whole cycle"
    if found["stride"] is not None:
        stride = f"stride {1e3 * found['stride']:6.2f} mm, {1e3 * found['speed']:6.1f} mm/s"
    seconds = found["seconds"]
    return f"{name:28s} L = {1e3 * found['L']:6.2f} mm, {stride}, fall {1e3 * found['fall']:.2f} mm, {seconds:.1f} s"
