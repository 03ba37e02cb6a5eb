"""A body on four legs that bends and moves on, as a recorded motion: made by formula, nothing simulated."""

from __future__ import annotations

import numpy as np
import torch

from torchsoro.design.domain import Chamber, Domain
from torchsoro.output.motion import Motion, decompose

CHAMBER = Chamber(name="air", center=(0.118, 0.068, 0.018), size=(0.018, 0.018, 0.018), wall=0.003)
DOMAIN = Domain(size=(0.036,) * 3, particles=(12,) * 3, origin=(0.1, 0.05, 0.0), chambers=(CHAMBER,))
TRAVEL, PRESSURE = 0.02, 80e3


def table() -> torch.Tensor:
    """Density of a body on four legs."""
    gamma = torch.zeros(12, 12, 12)
    gamma[:, :, 4:] = 1.0
    for i in (slice(0, 3), slice(9, 12)):
        for j in (slice(0, 3), slice(9, 12)):
            gamma[i, j] = 1.0
    gamma = gamma.flatten()
    gamma[DOMAIN.gas] = 0.0
    return gamma


def bending(time: np.ndarray) -> np.ndarray:
    """Positions [S, N, 3] m: it travels along x at constant speed, bows sideways and grows upward in turns."""
    rest = DOMAIN.positions.numpy()
    x, z = rest[:, 0] - 0.118, rest[:, 2]
    phase = 2 * np.pi * time / 0.2
    frames = np.repeat(rest[None], len(time), axis=0)
    frames[..., 0] += TRAVEL * (time / time[-1])[:, None]
    frames[..., 1] += np.sin(phase)[:, None] * 0.004 * (x / 0.018) ** 2
    frames[..., 2] += (1 - np.cos(phase))[:, None] * 0.1 * z
    return frames


def motion(samples: int = 41) -> Motion:
    """Two cycles of it."""
    time = np.linspace(0.0, 0.4, samples)
    pressure = 0.5 * PRESSURE * (1 - np.cos(2 * np.pi * time / 0.2))
    return decompose(
        name="table", domain=DOMAIN, gamma=table(), frames=bending(time), time=time, pressure=pressure, period=0.2
    )
