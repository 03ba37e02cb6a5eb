"""A design from several starts: initial fields that differ by a millionth, of which the best design is taken.

Travel is so rough a function of the design that starts which differ by rounding alone end with different robots. Every
start is a run of its own, in a folder ``start-1``, ``start-2``, ... of the run's folder, which ends with the settings
and the metrics of the best.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import math
import shutil
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch

from torchsoro.design.field import DesignField
from torchsoro.design.loop import Observe, Optimized, optimize
from torchsoro.design.processes import Processes
from torchsoro.design.robot import Robot
from torchsoro.design.training import RunFolder
from torchsoro.errors import SimulationDiverged
from torchsoro.simulation.threads import thread_count, threads_here
from torchsoro.storage import check_folder, plain_settings, read_json, write_json

CHANGE = 1e-6  # of the initial field, standard deviation: some ten times the rounding of float32


@torch.no_grad()
def disturb(field: DesignField, seed: int) -> None:
    """Change the design variable by normal random numbers of standard deviation :data:`CHANGE`, in place."""
    change = CHANGE * torch.randn(field.phi.shape, generator=torch.Generator().manual_seed(seed))
    field.phi.add_(change.to(field.phi))
    field.clamp_()


def optimize_starts(robot: Robot, observe: Observe | None = None, processes: Processes | None = None) -> Optimized:
    """Run the design loop from ``robot.settings.starts`` initial fields, the first the robot's own, and take the best.

    That is the one that goes farthest of those within the limit on C; if none is, the one nearest to it. A start whose
    simulation breaks down is left out as long as another one ends.

    Args:
        robot: What to design; its field, supply and chambers are what the first start begins with, and what the best
            ends with.
        observe: See :func:`torchsoro.design.loop.optimize`; called by several threads on a CPU.
        processes: That share the scenarios of a single start.

    Returns:
        The best; with one start what :func:`torchsoro.design.loop.optimize` returns.

    Raises:
        ValueError: see :func:`torchsoro.design.loop.optimize`.
        SimulationDiverged: if the simulation of every start breaks down.
    """
    s = robot.settings
    held = _starts_of(s.out)
    if s.resume and held and (held == 1) != (s.starts == 1):
        raise ValueError(f"starts = {s.starts}: {s.out} holds a run of {held}, wanted that to resume it")
    former = held if s.overwrite and held > 1 else 0
    if s.starts == 1:
        found = optimize(robot, observe, processes)
        _forget(s.out, 1, former)
        return found
    check_folder("out", s.out)
    if (s.out / "settings.json").exists() and not (s.resume or s.overwrite):
        raise ValueError(f"out = {s.out}: already holds a run; wanted another folder, or --resume or --overwrite")
    if s.resume and not any(s.out.glob("start-*/settings.json")) and not (s.out / "settings.json").exists():
        raise ValueError(f"out = {s.out}: holds no run of several starts; start without --resume")
    robots = [_start(robot, k) for k in range(s.starts)]
    _forget(s.out, s.starts + 1, former)
    s.out.mkdir(parents=True, exist_ok=True)
    write_json(s.out / "settings.json", plain_settings(dataclasses.asdict(s)))  # what --resume goes on with
    # Taichi, that is a GPU and the updated form, takes one simulation at a time.
    beside = min(s.starts, thread_count()) if s.target.type == "cpu" and s.formulation == "total" else 1
    threads, over = max(1, thread_count() // beside), threading.Event()

    def watched(run: RunFolder, one: Robot, gamma: torch.Tensor, iteration: int) -> None:
        if over.is_set():
            raise KeyboardInterrupt
        if observe is not None:
            observe(run, one, gamma, iteration)

    def designed(one: Robot) -> Optimized | SimulationDiverged:
        try:
            with threads_here(threads):
                return optimize(one, watched)
        except SimulationDiverged as error:
            print(f"{one.settings.out}: {error}", file=sys.stderr)
            return error

    with ThreadPoolExecutor(beside) as pool:
        running = [pool.submit(designed, one) for one in robots]
        try:
            ended = [one.result() for one in running]
        except BaseException:
            over.set()  # every other start ends with its iteration
            for one in running:
                one.cancel()
            raise
    found = {k: one for k, one in enumerate(ended) if isinstance(one, Optimized)}
    if not found:
        if not any(s.out.glob("start-*/checkpoint.pt")):  # nothing that a resumed run could go on from
            (s.out / "settings.json").unlink()
            with contextlib.suppress(OSError):  # where it holds something else
                s.out.rmdir()
        raise next(one for one in ended if isinstance(one, SimulationDiverged))
    best = max(found, key=lambda k: (-max(found[k].violation, 0.0), found[k].worth))
    robot.field.load_state_dict(robots[best].field.state_dict())
    robot.field.beta = robots[best].field.beta
    robot.supply.load_state_dict(robots[best].supply.state_dict())
    if (placement := robots[best].placement) is not None and robot.placement is not None:
        robot.placement.load_state_dict(placement.state_dict())
    with RunFolder(s.out, dataclasses.asdict(s), overwrite=True) as run:
        for row in _rows(found[best].metrics):
            run.log(int(row.pop("iteration")), row)
    return found[best]


def _starts_of(folder: Path) -> int:
    """Of how many starts a folder's run is; 0 without a run."""
    path = folder / "settings.json"
    starts = read_json(path, dict).get("starts", 1) if path.is_file() else 0
    return starts if isinstance(starts, int) else 1


def _forget(folder: Path, first: int, last: int) -> None:
    """Delete the runs of an earlier run's starts from one number to another."""
    for start in (folder / f"start-{k}" for k in range(first, last + 1)):
        if (start / "settings.json").is_file() and not start.is_symlink():
            shutil.rmtree(start)


def _start(robot: Robot, index: int) -> Robot:
    """The robot of a start, in a folder of its own; a start that was killed before it began starts anew."""
    s = robot.settings
    folder = s.out / f"start-{index + 1}"
    held = (folder / "settings.json").exists()
    own = dataclasses.replace(s, out=folder, starts=1, resume=s.resume and held)
    one = copy.deepcopy(robot)
    one.settings = own
    if index:
        disturb(one.field, index)
    return one


def _rows(metrics: dict[str, list[float]]) -> list[dict[str, float]]:
    """The columns of a run's metrics as rows, without what is missing."""
    rows = [dict(zip(metrics, values, strict=True)) for values in zip(*metrics.values(), strict=True)]
    return [{name: value for name, value in row.items() if not math.isnan(value)} for row in rows]
