"""What a finished run leaves for people: the design, a printable part, a movie of the gait, a page that sums it up."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from torchsoro.fabricate import AirPort, Part, fabricate, surface
from torchsoro.picture import movie, shape_image, summary
from torchsoro.robot import Robot
from torchsoro.simulator import Trajectory
from torchsoro.storage import atomic_write
from torchsoro.training import RunFolder


def show_shape(run: RunFolder, robot: Robot, gamma: torch.Tensor, iteration: int) -> None:
    """Put the present shape into TensorBoard, as a picture and as a mesh."""
    density = gamma.detach().cpu().numpy()
    vertices, faces = surface(robot.domain, density)
    run.log_mesh("shape/mesh", vertices, faces, None, iteration)
    title = f"iteration {iteration}"
    picture = shape_image(domain=robot.domain, gamma=density, planes=drawn_planes(robot), title=title)
    run.log_image("shape/picture", picture, iteration)


def drawn_planes(robot: Robot) -> tuple[tuple[int, float, int], ...]:
    """The robot's planes as pictures take them: axis, place, free side."""
    return tuple((plane.axis, float(plane.offset), plane.side) for plane in robot.planes)


@torch.no_grad()
def deliver(
    path: Path, robot: Robot, gamma: torch.Tensor, history: Mapping[str, Sequence[float]], *, name: str
) -> dict[str, float]:
    """Simulate the final gait once more with every particle recorded, and write everything into the run's folder.

    Files: ``design.npz``, ``shape.stl`` with ``shape.json`` (what the part weighs and how thin it gets), ``<name>.mp4``
    and ``summary.png``.

    Args:
        path: The folder.
        robot: The robot.
        gamma: Its density [N].
        history: Metrics of the run, for the summary.
        name: Of the robot: names the movie and the page.

    Returns:
        Travel L [m], mean stride over whole cycles [m] (NaN if there is none), C, mass [kg].

    Raises:
        ValueError: if the design has no connected body to print; the design and the movie are written before.
    """
    s = robot.settings
    outcome = robot(gamma, everything=True)
    density = gamma.detach().cpu().numpy()
    trajectory = outcome.trajectory
    with atomic_write(path / "design.npz") as file:
        np.savez_compressed(
            file,
            gamma=density.astype(np.float32),
            shape=np.array(robot.domain.shape),
            spacing=robot.domain.spacing,
            origin=np.array(robot.domain.origin),
        )
    frames = trajectory.position.cpu().numpy()
    time = trajectory.time.cpu().numpy()
    chosen = np.unique(np.linspace(0, len(time) - 1, min(s.frames, len(time))).round().astype(int))
    supply = robot.pressure.at(trajectory.time.cpu().to(robot.pressure.time)).numpy().reshape(-1)
    shown = {
        "domain": robot.domain,
        "gamma": density,
        "planes": drawn_planes(robot),
        "direction": robot.direction,
    }
    movie(
        path / f"{name}.mp4",
        **shown,
        frames=frames[chosen],
        time=time[chosen],
        pressure=supply[chosen],
        fps=20,
        title=f"{name}, {1e3 * float(outcome.travel):.2f} mm in {s.duration:g} s",
    )
    summary(
        path / "summary.png",
        **shown,
        frames=frames,
        time=time,
        pressure=supply,
        history=history,
        limit=s.c_max,
        period=1 / s.frequency,
        title=f"{name} ({s.preset}): L = {1e3 * float(outcome.travel):.2f} mm in {s.duration:g} s",
    )
    part = print_part(robot, density)
    part.save(path / "shape.stl")
    with atomic_write(path / "shape.json") as file:
        file.write((json.dumps(part.report.as_dict(), indent=2) + "\n").encode())
    return {
        "L": float(outcome.travel),
        "stride": _mean_stride(robot, trajectory),
        "C": float(outcome.intermediate),
        "mass": float(outcome.mass),
    }


def _mean_stride(robot: Robot, trajectory: Trajectory) -> float:
    """Advance per whole cycle [m], interpolated where a cycle does not end on a sample; NaN without a whole cycle."""
    s = robot.settings
    cycles = math.floor(s.duration * s.frequency + 1e-9)
    if cycles == 0:
        return math.nan
    way = trajectory.center_of_gravity.double().cpu() @ torch.tensor(robot.direction, dtype=torch.float64)
    start, end = np.interp([s.settle, s.settle + cycles / s.frequency], trajectory.time.cpu().numpy(), way.numpy())
    return float(end - start) / cycles


def print_part(robot: Robot, density: np.ndarray) -> Part:
    """The printable part, with an air port at the rear: against the travel, or downward for a climber."""
    s = robot.settings
    rear = tuple(-d for d in robot.direction)
    cavity = min(c - 2 * s.wall for c in s.chamber)
    port = AirPort(direction=(rear[0], rear[1], rear[2]), diameter=s.port or 0.4 * cavity)
    return fabricate(robot.domain, density, density=s.density, offset=s.offset, port=port)
