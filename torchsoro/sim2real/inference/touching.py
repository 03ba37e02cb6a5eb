"""Motions of bodies that meet planes, with the planes a little nearer and farther.

Which node touches when is decided by distances far below a cell, and motion after that differs by chance. A motion with
planes elsewhere, by less than a cell, is as good. The difference of two motions, of which an unknown is a step h apart,
has the error sqrt(2) times that chance, which divided by h may be far more than the response itself. A mean over R
shifts of the planes has an error that is sqrt(R) times smaller.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from torchsoro.sim2real.hypotheses.outer_effects import WallOffset
from torchsoro.sim2real.inference.likelihood import Likelihood, Request
from torchsoro.sim2real.twin.twin import MarkerTrajectory

GAPS = 1e-5 * np.array([-10.0, -5.0, -2.0, 0.0, 2.0, 5.0, 10.0])  # of planes, far below a cell [m]


def shifted(problem: Likelihood, points: Sequence[Request], gaps: np.ndarray) -> list[list[MarkerTrajectory]]:
    """Motions of all trials with planes a little nearer and farther, for each request at one point.

    Args:
        problem: By whose twin.
        points: Effects, and where [1, K].
        gaps: By which planes are moved, towards the body if positive [R] m.
    """
    wall = WallOffset()
    by = gaps[:, None] / wall.quantities[0].scale
    asked = [((*effects, wall), np.concatenate([np.tile(at, (len(by), 1)), by], 1)) for effects, at in points]
    return problem.simulate(asked)


def averaged(problem: Likelihood, requests: Sequence[Request], looks: int) -> list[list[MarkerTrajectory]]:
    """As :meth:`Likelihood.simulate`, the mean of motions with planes a little nearer and farther.

    Args:
        problem: By whose twin.
        requests: Effects, and where [B, K].
        looks: Number of shifts of the planes, evenly spread over those of ``GAPS``; with one, planes stay where they
            are.
    """
    if looks == 1:
        return problem.simulate(requests)
    gaps = np.linspace(GAPS[0], GAPS[-1], looks)
    apart = [(effects, point[None]) for effects, points in requests for point in points]
    found = iter(shifted(problem, apart, gaps))
    return [[_together(same) for same in zip(*(next(found) for _ in at), strict=True)] for _, at in requests]


def _together(motions: Sequence[MarkerTrajectory]) -> MarkerTrajectory:
    """Means over the batch of each motion [R, ...], as one batch; what breaks down with one shift is not sound."""
    names = "position", "velocity", "deformation"
    means = {name: np.stack([getattr(m, name).mean(0) for m in motions]) for name in names}
    sound = np.array([m.sound.all() for m in motions])
    return dataclasses.replace(motions[0], **means, sound=sound, dt=max(m.dt for m in motions))
