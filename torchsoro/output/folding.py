"""Whether the body of a robot folds into itself in a motion, and what a run says of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from torchsoro.design.domain import Region
from torchsoro.design.robot import Robot
from torchsoro.design.settings import Settings
from torchsoro.simulation.selfcontact import overlapping
from torchsoro.simulation.trajectory import Trajectory

HALF = 0.5  # density above which a particle counts as solid, as in the printed part
FOLDS = 24  # samples of a motion that are searched for folds, a tenth of a second for each at the paper's size


def folded(robot: Robot, density: np.ndarray, trajectory: Trajectory) -> int:
    """How many solid particles of a motion lie in another part of the body, at the worst of up to 24 samples.

    Args:
        robot: The robot.
        density: Of the design [N].
        trajectory: Its motion, of all particles.
    """
    domain = robot.domain
    solid = torch.from_numpy(density > HALF) & (domain.region != Region.GAS)
    count = len(trajectory.time)
    some = torch.linspace(0, count - 1, min(count, FOLDS)).round().long()
    places = trajectory.position[some.to(trajectory.position.device)].cpu()
    return int(overlapping(places, domain.positions.to(places), solid, spacing=domain.spacing).sum(-1).max())


def folding_line(found: Mapping[str, Any], settings: Settings) -> str:
    """That the body has folded into itself, in a line; empty where it has not."""
    count = int(found.get("folded") or 0)
    if not count:
        return ""
    remedy = "" if settings.self_contact else "; --self-contact keeps them apart"
    return f"the body folds into itself: {count} particles lie in another part of it at the worst{remedy}\n"
