"""The motion that an experimenter expects: a specimen as stated, simulated."""

from __future__ import annotations

import functools
import hashlib
import os
from pathlib import Path

import numpy as np
from lobatto import Floats, Ints
from march import March, case_of
from scipy.interpolate import CubicSpline
from specimens import SPECIMENS, mesh_for
from world import World

Begun = tuple[March, Floats, tuple[Ints, Floats]]
"""A march, its instants [T] s, and nodes and shape functions [P, 27] of what is recorded of it."""


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
    path = None if kept is None else expected_path(name, number, world, finer, kept)
    if path is not None and path.exists():
        return CubicSpline(_times(name), np.load(path, allow_pickle=False))
    march, t, points = expected(name, number, world, finer)
    moved = march.run(t, *points)
    if path is not None:
        keep(path, moved)
    return CubicSpline(t, moved)


def expected(name: str, number: int, world: World, finer: float) -> Begun:
    """The march of such a motion, its instants [T] s, and what :meth:`March.run` takes of the stated markers."""
    march, points = begun(name, number, world, finer)
    return march, _times(name), points


def begun(
    name: str, number: int, world: World, finer: float, off: Floats | None = None
) -> tuple[March, tuple[Ints, Floats]]:
    """The march of a trial in a world, and nodes and shape functions [P, 27] of its markers.

    Args:
        name: Of the specimen.
        number: Of its trial.
        world: What is not as stated.
        finer: Divides the elements' edge.
        off: How far the markers are from where they are stated [markers, 3] m; they come first then, before the stated
            places.
    """
    specimen, mesh = SPECIMENS[name](), mesh_for(name, finer)
    trial, duration = specimen.trials[number], specimen.setup["duration"]
    times = {"started": number * duration, "lasting": len(specimen.trials) * duration}
    case = case_of({**specimen.setup, **trial.tables}, mesh, trial.pressure, **times)
    stated = np.array([m["at"] for m in specimen.setup["marker"]], float)
    points = stated if off is None else np.concatenate([stated + off, stated])
    return March(case, world), mesh.interpolation(points)


def expected_path(name: str, number: int, world: World, finer: float, kept: Path) -> Path:
    """Where such a motion is kept."""
    return kept / f"{name}-{number}-{finer:g}-{hashlib.sha256(repr(world).encode()).hexdigest()[:16]}.npy"


def _times(name: str) -> Floats:
    return np.arange(0, 1.02 * SPECIMENS[name]().setup["duration"] + 0.01, 1e-3)


def keep(path: Path, motion: Floats) -> None:
    """Write a motion that other processes may look for: whole, or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(f".{os.getpid()}")
    with part.open("wb") as file:
        np.save(file, motion)
    part.rename(path)
