"""The two formulations on a walking cycle of one design as the cell shrinks; ``simulator.py`` prints the tables."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from scipy.interpolate import RegularGridInterpolator
from structures import EXACT, arguments
from tables import Row
from torch import Tensor

from torchsoro.design.domain import Domain, Region
from torchsoro.design.presets import WALKER
from torchsoro.design.robot import Robot, walker
from torchsoro.design.settings import Settings
from torchsoro.simulation.ops.lattice import Lattice
from torchsoro.simulation.selfcontact import overlapping

EDGE = 35.0  # of the cube [mm]
CAVITY = EDGE / 3  # of the air, which lies on planes of every lattice of 6, 12, 18, ... particles [mm]
WALL = EDGE / 12  # [mm]
RAMP = 1.5  # over which density rises from void to solid [mm]

# Boxes of the walker besides its chamber: limits [mm] in x, |y| and z, and density. A rear leg from the rear wall of
# the chamber to a sole, which also carries the chamber; two front feet; a load on top in front; and intermediate
# density on the chest, as in an unconverged design.
PARTS = (
    ((-18, -8), (-1, 6), (12.5, 17), 1.0),
    ((-18, -14), (-1, 6), (-1, 17), 1.0),
    ((-18, -2), (-1, 6), (-1, 3), 1.0),
    ((-6, -2), (-1, 6), (-1, 10), 1.0),
    ((6, 11), (5, 11), (-1, 10), 1.0),
    ((8, 18), (-1, 8), (23, 36), 1.0),
    ((9, 15), (-1, 8), (12, 20), 0.4),
)
# Tracked material points [mm].
POINTS = {"heel": (-15.0, 4.0, 2.0), "knee": (-15.0, 4.0, 14.5), "chest": (7.3, 0.0, 17.5), "brow": (13.0, 4.0, 29.0)}


def density(place: np.ndarray) -> np.ndarray:
    """Density of the walker at places [..., 3] mm, 0 to 1."""
    x, y, z = place[..., 0], np.abs(place[..., 1]), place[..., 2]

    def inside(*limits: tuple[float, float]) -> np.ndarray:
        """Smooth step through the surface of a box, by the distance from it."""
        sides = zip((x, y, z), limits, strict=True)
        out = np.stack([np.abs(c - (low + high) / 2) - (high - low) / 2 for c, (low, high) in sides], -1)
        distance = np.linalg.norm(np.maximum(out, 0), axis=-1) + np.minimum(out.max(-1), 0)
        t = np.clip(0.5 - distance / RAMP, 0, 1)
        return t * t * (3 - 2 * t)

    half = CAVITY / 2 + WALL
    found = inside((-half, half), (-half, half), (EDGE / 2 - half, EDGE / 2 + half))
    for *limits, value in PARTS:
        found = np.maximum(found, value * inside(*limits))
    return found


def design(domain: Domain, parts: int = 4) -> Tensor:
    """Density of every particle [N]: the mean over its volume; and 1 in the chamber's wall."""
    line = ((np.arange(parts) + 0.5) / parts - 0.5) * domain.spacing
    offsets = np.stack(np.meshgrid(line, line, line, indexing="ij"), -1).reshape(-1, 3)
    mean = np.mean([density(1e3 * (domain.positions.numpy() + offset)) for offset in offsets], 0)
    return torch.where(domain.wall, torch.ones(domain.count, dtype=EXACT), torch.from_numpy(mean))


def setting(particles: int, form: str, *, shift: float = 0.0, **changes: Any) -> Settings:
    """The desk walker with another number of particles along its edge, a multiple of 6.

    The volume of air in the chamber and its density, whose default depends on the formulation, are the same for all
    lattices. ``shift`` offsets the grid of the updated formulation along x and y, in cells.
    """
    spacing = 1e-3 * EDGE / particles
    how = {"formulation": "updated", **arguments(form)}
    return dataclasses.replace(
        WALKER["desk"],
        particles=(particles,) * 3,
        chamber=(1e-3 * CAVITY + 2 * spacing,) * 3,
        wall=spacing,
        room=0.02 + 2 * shift * spacing,
        dt="auto",
        air_density=100.0,
        counted="body",
        **{"device": "cpu", **how, **changes},
    )


def volume_ratios(domain: Domain, position: Tensor) -> Tensor:
    """Volume ratio J [S, N] in the total formulation, from the positions of the particles [S, N, 3]."""
    lattice = Lattice.around(domain.positions, domain.cell)
    moved = (position.to("cpu", EXACT) - domain.positions).transpose(-1, -2)
    gradient = lattice.gradient(lattice.to_nodes(moved, "back")).permute(0, 3, 1, 2)
    return torch.linalg.det(gradient + torch.eye(3, dtype=EXACT))


def follow(domain: Domain, position: Tensor) -> np.ndarray:
    """Positions of the material points over time [S, points, 3] m, interpolated linearly between particles."""
    axes = [o + (np.arange(n) + 0.5) * domain.spacing for o, n in zip(domain.origin, domain.shape, strict=True)]
    points = 1e-3 * np.array(list(POINTS.values()))
    moved = (position.to("cpu", EXACT) - domain.positions).numpy().reshape(-1, *domain.shape, 3)
    between = RegularGridInterpolator(axes, np.moveaxis(moved, 0, -2), bounds_error=True)
    return points + np.moveaxis(between(points), 1, 0)


def walk(particles: int, form: str, *, shift: float = 0.0, **changes: Any) -> tuple[Row, Row]:
    """Row and trajectories (SI units) of one simulation."""
    begin = time.perf_counter()
    settings = setting(particles, form, shift=shift, **changes)
    robot: Robot = walker(settings)
    domain, device = robot.domain, settings.target
    gamma = design(domain)
    with torch.no_grad():
        precision = EXACT if device.type == "cpu" else torch.float32
        outcome = robot(gamma.to(device, precision), everything=True)
    seen = outcome.trajectory
    volume = (seen.chamber_volume[:, 0] / seen.chamber_volume[0, 0]).cpu().numpy()
    points = follow(domain, seen.position)
    center = seen.center_of_gravity.cpu().numpy()
    free = domain.region != Region.GAS
    solid, void = free & (gamma > 0.5), free & (gamma < 0.1)
    met = overlapping(seen.position.cpu(), domain.positions.to(precision), solid, spacing=domain.spacing)
    row: Row = {
        "form": form,
        "particles": particles,
        "cell [mm]": domain.cell * 1e3,
        "shift": shift,
        "L [mm]": float(outcome.travel) * 1e3,
        "height [mm]": center[-1, 2] * 1e3,
    }
    for name, place in zip(POINTS, points[-1] * 1e3, strict=True):
        row[f"{name} x, z [mm]"] = f"{place[0]:.2f} {place[2]:.2f}"
    row |= {"most V/V0": float(volume.max()), "last V/V0": float(volume[-1])}
    row |= {"J solid": math.nan, "J void": math.nan, "void inverted": "-"}
    if form == "total":
        J = volume_ratios(domain, seen.position)
        row |= {"J solid": float(J[:, solid].min()), "J void": float(J[:, void].min())}
        row["void inverted"] = f"{int((J[:, void] <= 0).any(0).sum())} of {int(void.sum())}"
    row |= {"self-contact": int(met.any(0).sum()), "dt [us]": outcome.dt * 1e6, "seconds": time.perf_counter() - begin}
    course = {"travel": float(outcome.travel), "center": center, "points": points, "volume": volume}
    return row, course | {"time": seen.time.cpu().numpy(), "settle": settings.settle}


def difference(particles: int, what: str, one: Row, other: Row) -> Row:
    """Differences of two trajectories of a design, in mm and in percent of the longest path of a tracked point."""
    way = np.linalg.norm(one["points"] - one["points"][0], axis=-1).max()
    center = np.linalg.norm(one["center"] - other["center"], axis=-1).max()
    points = np.linalg.norm(one["points"] - other["points"], axis=-1).max()
    travel = abs(one["travel"] - other["travel"])
    row: Row = {"what": what, "particles": particles, "cell [mm]": 2 * EDGE / particles, "way [mm]": way * 1e3}
    for name, size in (("L", travel), ("c.o.g.", center), ("points", points)):
        row |= {f"{name} [mm]": size * 1e3, f"{name} [%]": 100 * size / way}
    return row | {"V/V0 [%]": 100 * float(np.abs(one["volume"] - other["volume"]).max())}


def walking(
    counts: Sequence[int] = (12, 18, 24), forms: Sequence[str] = ("total", "apic", "flip"), **changes: Any
) -> tuple[list[Row], list[Row], dict[tuple[int, str], Row]]:
    """Convergence of one cycle (rest, filling, venting) of a design with lattice refinement in both formulations.

    The updated formulation is also run with its first transfer on a grid shifted by half a cell; the difference
    measures its own discretization error. The total formulation has no background grid.

    Args:
        counts: Numbers of particles along the edge, multiples of 6.
        forms: "total", and the forms to compare with it.
        changes: Changes of the settings.

    Returns:
        Rows of the simulations; rows of the differences, largest over time; the courses.
    """
    rows, apart, courses = [], [], {}
    others = [form for form in forms if form != "total"]
    for n in counts:
        for form in forms:
            row, courses[n, form] = walk(n, form, **changes)
            rows.append(row)
        if others:
            row, courses[n, "shifted"] = walk(n, others[0], shift=0.5, **changes)
            rows.append(row)
        one = courses[n, "total"]
        apart += [difference(n, f"total, {form}", one, courses[n, form]) for form in others]
        if others:
            pair = courses[n, others[0]], courses[n, "shifted"]
            apart.append(difference(n, f"{others[0]}, shifted", *pair))
    return rows, sorted(apart, key=lambda row: row["what"]), courses


def orders(rows: Sequence[Row]) -> Row:
    """Order in the cell of each difference of the centres of gravity, by least squares; 0 if it does not shrink."""
    found = {}
    for what in dict.fromkeys(row["what"] for row in rows):
        cells, sizes = zip(*((r["cell [mm]"], r["c.o.g. [mm]"]) for r in rows if r["what"] == what), strict=True)
        if len(cells) > 1:
            found[what] = float(np.polyfit(np.log(cells), np.log(sizes), 1)[0])
    return found
