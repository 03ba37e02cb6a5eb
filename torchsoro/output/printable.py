"""The part that is printed of a design, with its thin walls mended where the settings ask for a least wall."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from torchsoro.design.density import thickened
from torchsoro.design.loop import Optimized, design_of, take_, worth_of
from torchsoro.design.objective import intermediate_density
from torchsoro.design.outcome import Outcome
from torchsoro.design.robot import Robot
from torchsoro.errors import SimulationDiverged
from torchsoro.output.fabricate import fabricate
from torchsoro.output.part import Part

LATELY = 3  # of the last designs, at most, that are mended beside the best one: each takes up to a minute


@torch.no_grad()
def farthest(robot: Robot, optimized: Optimized) -> tuple[torch.Tensor, int | None, Part | None]:
    """Of the best design and some of the last ones, the one whose mended part goes farthest.

    A wall that is mended changes the gait, so that the design that goes farthest may not be the part that does.

    Args:
        robot: The robot; ends with that design.
        optimized: What its run has ended with.

    Returns:
        Density of the design [N], its iteration, and the part; those of the best where no other is better. The part is
        None where none can be printed, and where there is no other design, which is not mended here then.
    """
    first = {"iteration": optimized.iteration, **design_of(robot)}
    others = [one for one in optimized.lately if one.get("iteration") not in (None, optimized.iteration)]
    if optimized.iteration is None or not others:
        return optimized.gamma, optimized.iteration, None
    found: list[tuple[bool, float, dict[str, Any], torch.Tensor, Part | None]] = []
    for design in [first, *others[:: math.ceil(len(others) / LATELY)]]:
        take_(robot, design)
        gamma = robot.density().detach()
        if design is not first and float(intermediate_density(gamma, robot.design)) > robot.settings.c_max:
            continue
        part, delivered = mended(robot, gamma)
        done = None if part is None else part.report.mended
        try:
            worth = _worth(robot, delivered)
        except SimulationDiverged:
            worth = -math.inf
        found.append((done is not None and done.met, worth, design, gamma, part))
    _, _, design, gamma, part = max(found, key=lambda one: one[:2])
    take_(robot, design)
    return gamma, design["iteration"], part


def _worth(robot: Robot, gamma: torch.Tensor) -> float:
    """What a density is worth, in cells, in the run's scenarios if it has any."""
    s = robot.settings
    batch = s.distribution.sample(s.scenarios, s.scenario_seed) if s.scenarios else None
    return worth_of(robot, robot(gamma, scenarios=batch))


def print_part(robot: Robot, density: np.ndarray) -> Part:
    """The printable part, with the robot's air ports."""
    s = robot.settings
    how: dict[str, Any] = {"density": float(robot.solid.density), "offset": s.offset, "min_wall": s.mended_to}
    return fabricate(robot.domain, density, port=robot.port, **how)


def mended(robot: Robot, gamma: torch.Tensor, part: Part | None = None) -> tuple[Part | None, torch.Tensor]:
    """The printable part of a design whose settings ask for a least wall, and the density of that part.

    Args:
        robot: The robot.
        gamma: Density of the design [N].
        part: The part, if it has been made already.

    Returns:
        None and the design's density, where no least wall is asked for, or there is no part.
    """
    if not robot.settings.mended_to:
        return None, gamma
    try:
        part = part or print_part(robot, gamma.cpu().numpy())
    except (ValueError, RuntimeError):  # no body to print, which is told at the end
        return None, gamma
    return part, thickened(gamma, torch.from_numpy(part.added).to(gamma), robot.settings.power)


def told_of(part: Part, plain: Outcome) -> dict[str, float]:
    """What is told of a part with mended walls, and of its design without.

    Args:
        part: The part.
        plain: What the design does without.

    Returns:
        Wanted wall [m], whether it is met, the wall before [m], volume added [m3] and as a share, travel before [m].
    """
    done = part.report.mended
    assert done is not None
    return {
        "min_wall": 1e-3 * done.min_wall_mm,
        "min_wall_met": done.met,
        "thinnest_wall_before": 1e-3 * done.thinnest_wall_before_mm,
        "mended_volume": 1e-9 * done.volume_mm3,
        "mended_share": done.share,
        "L_before": float(plain.travel),
    }


def mending_line(found: Mapping[str, Any]) -> str:
    """What mending the walls has changed, in a line; empty where none was asked for."""
    if "min_wall" not in found:
        return ""
    walls = [1e3 * found[name] for name in ("min_wall", "thinnest_wall_before", "thinnest_wall")]
    missed = "" if found["min_wall_met"] else " NOT MET"
    return (
        f"walls mended to {walls[0]:.2f} mm{missed}: thinnest {walls[1]:.2f} mm before, {walls[2]:.2f} mm now, by "
        f"{1e9 * found['mended_volume']:.1f} mm3 ({100 * found['mended_share']:.2f} %); "
        f"travel {1e3 * found['L_before']:.2f} mm before, {1e3 * found['L']:.2f} mm now\n"
    )
