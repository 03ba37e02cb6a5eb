"""The motion that an experimenter expects: a specimen as stated, simulated."""

from __future__ import annotations

import functools
import hashlib
import os
from pathlib import Path

import numpy as np
from lobatto import Floats
from march import March, case_of
from scipy.interpolate import CubicSpline
from specimens import SPECIMENS, mesh_for
from world import World


@functools.cache
def believed_motion(name: str, number: int, world: World, finer: float, kept: Path | None = None) -> CubicSpline:
    """Stated markers over time in one trial, had the experimenter been right in all but ``world``.

    Args:
        name: Of the specimen.
        number: Of its trial.
        world: What is not as stated.
        finer: Divides the elements' edge.
        kept: Folder of motions that processes share; each is simulated once.
    """
    specimen = SPECIMENS[name]()
    trial = specimen.trials[number]
    t = np.arange(0, 1.02 * specimen.setup["duration"] + 0.01, 1e-3)
    path = None
    if kept is not None:
        path = kept / f"{name}-{number}-{finer:g}-{hashlib.sha256(repr(world).encode()).hexdigest()[:16]}.npy"
        if path.exists():
            return CubicSpline(t, np.load(path, allow_pickle=False))
    mesh = mesh_for(name, finer)
    case = case_of({**specimen.setup, **trial.tables}, mesh, trial.pressure)
    points = np.array([m["at"] for m in specimen.setup["marker"]], float)
    moved = March(case, world).run(t, *mesh.interpolation(points))
    if path is not None:
        keep(path, moved)
    return CubicSpline(t, moved)


def keep(path: Path, motion: Floats) -> None:
    """Write a motion that other processes may look for: whole, or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(f".{os.getpid()}")
    with part.open("wb") as file:
        np.save(file, motion)
    part.rename(path)
