"""What of a design nothing connects with its chambers, and what a run says of it: it is not printed."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch

from torchsoro.design.connected import connected
from torchsoro.design.robot import Robot
from torchsoro.errors import SimulationDiverged
from torchsoro.output.folding import HALF


def without_loose(robot: Robot, gamma: torch.Tensor) -> torch.Tensor:
    """A design as far as it is connected with the robot's chambers [N].

    Args:
        robot: The robot.
        gamma: Density of the design [N].
    """
    domain = robot.rounded_domain
    return connected(gamma, domain.wall, domain.shape)


def loose_share(gamma: torch.Tensor, whole: torch.Tensor) -> float:
    """Share of a design's solid particles that no others connect with a chamber.

    Args:
        gamma: Density of the design [N].
        whole: The same of :func:`without_loose`.
    """
    solid = gamma >= HALF
    return int((solid & (whole < HALF)).sum()) / max(1, int(solid.sum()))


def travel_of(
    robot: Robot, gamma: torch.Tensor, void: bool, progress: Callable[[int, int], None] | None = None
) -> float:
    """Travel [m] of a density, NaN if its simulation breaks down.

    Args:
        robot: The robot.
        gamma: The density [N].
        void: Simulate void, too.
        progress: Called as that of :class:`torchsoro.Simulator`.
    """
    try:
        return float(robot(gamma, void=void, progress=progress).travel)
    except SimulationDiverged:
        return math.nan


def loose_line(found: Mapping[str, Any]) -> str:
    """That pieces are loose, in a line; empty where none is."""
    if not found.get("loose"):
        return ""
    travel = math.nan if found["L_connected"] is None else float(found["L_connected"])
    without = "the simulation breaks down" if math.isnan(travel) else f"the travel is {1e3 * travel:.2f} mm"
    return (
        f"{100 * found['loose']:.2g} % of the solid is loose and not printed: without it {without} (--connected "
        "designs a body in one piece)\n"
    )
