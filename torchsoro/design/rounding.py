"""What becomes of chambers whose place or size was designed: faces on lattice planes, as of chambers that are given."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch

from torchsoro.design.chambers import chamber_settings, with_chambers
from torchsoro.design.loop import worth_of
from torchsoro.design.placement import numbered
from torchsoro.design.reading import CHAMBERS
from torchsoro.design.robot import Robot, build
from torchsoro.errors import SimulationDiverged
from torchsoro.storage import write_json


@torch.no_grad()
def rounded(robot: Robot) -> Robot:
    """The robot whose chambers are those of a design rounded to lattice planes, and given.

    Args:
        robot: Whose chambers are designed.

    Returns:
        Another robot, with the same design variable and supply.

    Raises:
        ValueError: if its chambers are given already.
    """
    if robot.placement is None:
        raise ValueError("robot: got one whose chambers are given, want chambers whose place or size is designed")
    sharp = build(with_chambers(robot.settings, robot.placement.rounded()))
    sharp.field.phi.copy_(robot.field.phi)
    sharp.field.beta = robot.field.beta
    sharp.supply.load_state_dict(robot.supply.state_dict())
    return sharp


def save_chambers(folder: Path, robot: Robot) -> None:
    """Write the settings of a robot's chambers beside those of its run, as ``read_settings`` takes them up."""
    write_json(folder / CHAMBERS, {"chamber_design": [], **chamber_settings(robot.domain.chambers)})


@torch.no_grad()
def changes(robot: Robot, sharp: Robot, history: Mapping[str, Sequence[float]]) -> dict[str, float]:
    """Where the chambers of a design have ended, and what rounding them has changed.

    Args:
        robot: With the chambers as they were designed.
        sharp: See :func:`rounded`.
        history: Metrics of the run, in which chambers may have been rounded on the way.

    Returns:
        Centre and outer edges of each chamber [m] as ``center_x_1``, ``size_x_1``, ..., and volume of all cavities
        [m3]; travel [m] and what was maximised, in cells (see :func:`torchsoro.design.loop.worth_of`), before and after
        they were rounded, in the settings' own scenario; without travel if one of these simulations breaks down.
    """
    assert robot.placement is not None
    chambers = sharp.domain.chambers
    found = {
        **numbered([one.center for one in chambers], [one.size for one in chambers]),
        "volume": sharp.domain.volume * float(sharp.domain.gas.sum()),
    }
    names = [f"{name}_{when}" for name in ("L", "objective") for when in ("unrounded", "rounded")]
    if f"chamber/{names[0]}" in history:
        return found | {name: [v for v in history[f"chamber/{name}"] if not math.isnan(v)][-1] for name in names}
    try:
        before, after = robot(robot.density()), sharp(sharp.density())
    except SimulationDiverged:  # in a scenario that the run may not have met
        return found
    values = float(before.travel), float(after.travel), worth_of(robot, before), worth_of(sharp, after)
    return found | dict(zip(names, values, strict=True))


def rounding_line(found: Mapping[str, float]) -> str:
    """What :func:`changes` says, in a line; empty for chambers that are given."""
    if "L_unrounded" not in found:
        return ""
    count = sum(name.startswith("center_x_") for name in found)
    places = (
        f"at {_millimetres(found, 'center', k)} mm of {_millimetres(found, 'size', k)} mm" for k in range(1, count + 1)
    )
    return (
        f"chamber {', '.join(places)}, rounded to lattice planes: travel {1e3 * found['L_unrounded']:.2f} mm before, "
        f"{1e3 * found['L_rounded']:.2f} mm after, objective {found['objective_unrounded']:.3f} cells before, "
        f"{found['objective_rounded']:.3f} after\n"
    )


def _millimetres(found: Mapping[str, float], name: str, number: int) -> str:
    return " x ".join(f"{1e3 * found[f'{name}_{axis}_{number}']:.2f}" for axis in "xyz")
