"""What is believed of a robot that was designed, as the setup of its experiment, and where a camera sees markers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from torchsoro.design.robot import Robot


def elements(robot: Robot) -> list[list[float]]:
    """Relative modulus and relaxation time [s] of each Maxwell element."""
    return torch.stack([robot.prony.moduli, robot.prony.times], -1).tolist()


def believed(
    robot: Robot, *, title: str, duration: float, prony: list[list[float]], air_stiffness: float, body: str = "body.stl"
) -> str:
    """Tables of setup.toml, without markers and recording.

    Args:
        robot: With its chambers, material and planes.
        title: For people.
        duration: Of a trial [s].
        prony: Relative modulus and relaxation time [s] of each Maxwell element.
        air_stiffness: Of the air in each chamber [Pa].
        body: File of the body's mesh [m], beside setup.toml.

    Raises:
        ValueError: for a chamber that is no box.
    """
    if any(chamber.shape is not None for chamber in robot.domain.chambers):
        raise ValueError("robot: its chamber is a mesh, wanted chambers that are boxes, as explanations know no others")
    tables = [
        f'title = "{title}"\ngravity = {list(robot.gravity)}\nduration = {duration}\n',
        f'[body]\nshape = "mesh"\nfile = "{body}"\n',
        f"[material]\ndensity = {robot.solid.density}\nyoungs_modulus = {robot.solid.youngs_modulus}\n"
        f"poisson_ratio = {robot.solid.poisson_ratio}\nprony = {prony}\n",
    ]
    for chamber in robot.domain.chambers:
        half = np.array(chamber.size) / 2 - chamber.wall
        box = [(np.array(chamber.center) + side * half).tolist() for side in (-1, 1)]
        tables.append(f'[[chamber]]\nname = "{chamber.name}"\nbox = {box}\nair_stiffness = {air_stiffness}\n')
    for plane in robot.planes:
        normal = [float(plane.side) * (a == plane.axis) for a in range(3)]
        point = [float(plane.offset) * (a == plane.axis) for a in range(3)]
        friction = '"stick"' if plane.sticks else plane.friction
        tables.append(f"[[plane]]\npoint = {point}\nnormal = {normal}\nfriction = {friction}\n")
    return "\n".join(tables)


def marker_tables(markers: Mapping[str, Sequence[float]]) -> str:
    """Tables of setup.toml of markers at places of the undeformed body [m], by name."""
    tables = (f'[[marker]]\nname = "{name}"\nat = {[float(f"{x:.6g}") for x in at]}\n' for name, at in markers.items())
    return "\n".join(tables)


def seen_from(places: np.ndarray, axis: int, side: int, spacing: float) -> np.ndarray:
    """Numbers of the material points that a camera sees.

    Args:
        places: Of material points on a lattice [N, 3] m.
        axis: Along which the camera looks.
        side: +1 if it stands on the positive side of the body, -1 if on the other.
        spacing: Of the lattice [m].
    """
    across = np.delete(places, axis, 1)
    columns = np.round((across - across.min(0)) / spacing).astype(int)
    nearest_first = np.argsort(-side * places[:, axis], kind="stable")
    _, first = np.unique(columns[nearest_first], axis=0, return_index=True)
    return nearest_first[first]


def far_apart(places: np.ndarray, count: int) -> list[int]:
    """Numbers of so many places [N, 3] m that are far from each other, beginning with the first."""
    chosen = [0]
    while len(chosen) < min(count, len(places)):
        near = np.linalg.norm(places[:, None] - places[chosen], axis=-1).min(1)
        chosen.append(int(near.argmax()))
    return chosen
