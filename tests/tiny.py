"""Settings of a robot that simulates in a fraction of a second, shared by the tests of robots, results and recipes."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from torchsoro.design.settings import Settings

TINY = Settings(
    preset="desk",
    out=Path("runs/tiny"),
    device="cpu",
    iterations=3,
    particles=(8, 8, 8),
    wall=0.035 / 8,
    elements=2,
    epsilon=1e-3,
    dt=1.25e-4,
    settle=0.01,
    duration=0.02,
    sample_every=0.001,
    frequency=50.0,
    rise=0.002,
    fall=0.002,
    filter_radius=0.0088,
    learning_rate=0.05,
    picture_every=2,
    frames=6,
)


def tiny(out: Path, **changes: Any) -> Settings:
    """The same in a folder of its own, with changes."""
    return dataclasses.replace(TINY, out=out, **changes)
