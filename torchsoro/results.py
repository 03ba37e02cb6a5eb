"""What a finished run leaves for people: the design, a printable part, a movie of the gait, a page that sums it up."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from torchsoro.archive import save_design
from torchsoro.fabricate import AirPort, Part, fabricate, surface
from torchsoro.objective import mean_stride
from torchsoro.picture import movie, shape_image, summary
from torchsoro.robot import Robot
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


def deliver(
    path: Path,
    robot: Robot,
    gamma: torch.Tensor,
    history: Mapping[str, Sequence[float]],
    *,
    name: str,
    chosen: int | None = None,
) -> dict[str, float]:
    """Write the design of a finished run into its folder, as ``design.npz``, and show it there: see :func:`show`.

    Args:
        path: The folder.
        robot: The robot.
        gamma: Its density [N]; judged as it is stored, with three decimals.
        history: Metrics of the run, for the summary.
        name: Of the robot: names the movie and the page.
        chosen: Iteration that the design is of; the last if None.

    Returns:
        What :func:`show` measured.

    Raises:
        ValueError: if the design has no connected body to print; the design and the movie are written before.
    """
    gamma = save_design(path / "design.npz", robot.domain, gamma)
    return show(path, robot, gamma, history=history, chosen=chosen, name=name)[0]


@torch.no_grad()
def show(
    path: Path,
    robot: Robot,
    gamma: torch.Tensor,
    *,
    name: str,
    history: Mapping[str, Sequence[float]] | None = None,
    chosen: int | None = None,
    void: bool = True,
) -> tuple[dict[str, float], Part]:
    """Simulate a gait with every particle recorded, and write what people look at and print.

    Files: ``<name>.mp4``, with a history ``summary.png``, and ``shape.stl`` with ``shape.json`` (what the part weighs
    and how thin it gets).

    Args:
        path: Folder to write to.
        robot: The robot.
        gamma: Its density [N].
        name: Of the robot: names the movie and the page.
        history: Metrics of its run.
        chosen: Iteration of that run that the design is of; the last if None.
        void: Simulate void, too.

    Returns:
        Travel L [m], mean stride over whole cycles [m] (NaN if there is none), C, mass [kg]; and the printable part.

    Raises:
        ValueError: if the design has no connected body to print; the movie is written before.
    """
    s = robot.settings
    outcome = robot(gamma, everything=True, void=void)
    density = gamma.cpu().numpy()
    trajectory = outcome.trajectory
    frames = trajectory.position.cpu().numpy()
    time = trajectory.time.cpu().double().numpy()
    way = trajectory.center_of_gravity.cpu().double().numpy() @ np.array(robot.direction)
    drawn = np.unique(np.linspace(0, len(time) - 1, min(s.frames, len(time))).round().astype(int))
    supply = robot.pressure.at(trajectory.time.cpu().to(robot.pressure.time)).numpy().reshape(-1)
    shown = {
        "domain": robot.domain,
        "gamma": density,
        "planes": drawn_planes(robot),
        "direction": robot.direction,
        "tilt": math.degrees(math.atan(s.slope)),
    }
    movie(
        path / f"{name}.mp4",
        **shown,
        frames=frames[drawn],
        time=time[drawn],
        pressure=supply[drawn],
        fps=20,
        title=f"{name}, {1e3 * float(outcome.travel):.2f} mm in {s.duration:g} s",
    )
    if history is not None:
        summary(
            path / "summary.png",
            **shown,
            frames=frames,
            time=time,
            pressure=supply,
            history=history,
            chosen=chosen,
            limit=s.c_max,
            period=1 / s.frequency,
            title=f"{name} ({s.preset}): L = {1e3 * float(outcome.travel):.2f} mm in {s.duration:g} s",
        )
    part = print_part(robot, density)
    part.save(path / "shape.stl")
    with atomic_write(path / "shape.json") as file:
        file.write((json.dumps(part.report.as_dict(), indent=2) + "\n").encode())
    found = {
        "L": float(outcome.travel),
        "stride": mean_stride(way, time, start=s.settle, period=1 / s.frequency),
        "C": float(outcome.intermediate),
        "mass": float(outcome.mass),
    }
    return found, part


def print_part(robot: Robot, density: np.ndarray) -> Part:
    """The printable part, with an air port at the rear: against the travel, or downward for a climber."""
    s = robot.settings
    rear = tuple(-d for d in robot.direction)
    cavity = min(c - 2 * s.wall for c in s.chamber)
    port = AirPort(direction=(rear[0], rear[1], rear[2]), diameter=s.port or 0.4 * cavity)
    return fabricate(robot.domain, density, density=s.density, offset=s.offset, port=port)
