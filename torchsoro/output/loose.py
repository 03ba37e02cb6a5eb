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


def loose(robot: Robot, gamma: torch.Tensor) -> float:
    """Share of a design's solid particles that no others connect with a chamber.

    Args:
        robot: The robot.
        gamma: Density of the design [N].
    """
    domain = robot.rounded_domain
    solid = gamma >= HALF
    count = int((solid & (connected(gamma, domain.wall, domain.shape) < HALF)).sum())
    return count / max(1, int(solid.sum()))


def travel_without(
    robot: Robot, gamma: torch.Tensor, void: bool, progress: Callable[[int, int], None] | None = None
) -> float:
    """Travel [m] of a design without its loose pieces; NaN if its simulation breaks down.

    Args:
        robot: The robot.
        gamma: Density of the design [N].
        void: Simulate void, too.
        progress: Called as that of :class:`torchsoro.Simulator`.
    """
    domain = robot.rounded_domain
    try:
        return float(robot(connected(gamma, domain.wall, domain.shape), void=void, progress=progress).travel)
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
