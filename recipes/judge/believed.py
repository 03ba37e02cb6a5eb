"""The motion that an experimenter expects: a specimen as stated, simulated."""

from __future__ import annotations

import functools

import numpy as np
from march import March, case_of
from scipy.interpolate import CubicSpline
from specimens import SPECIMENS, mesh_for
from world import World


@functools.cache
def believed_motion(name: str, number: int, world: World, finer: float) -> CubicSpline:
    """Stated markers over time in one trial, had the experimenter been right in all but ``world``."""
    specimen = SPECIMENS[name]()
    trial = specimen.trials[number]
    mesh = mesh_for(name, finer)
    case = case_of({**specimen.setup, **trial.tables}, mesh, trial.pressure)
    t = np.arange(0, 1.02 * specimen.setup["duration"] + 0.01, 1e-3)
    points = np.array([m["at"] for m in specimen.setup["marker"]], float)
    return CubicSpline(t, March(case, world).run(t, *mesh.interpolation(points)))
