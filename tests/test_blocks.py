"""Variations on a GPU move as those on the processor: on a GPU, and on Numba's simulator of one."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch
from test_experiment import experiment
from test_twin import EDGE, hollow

from torchsoro.sim2real.data.experiment import ForceTable, PlaneTable, Trial, read_experiment
from torchsoro.sim2real.hypotheses.library import library
from torchsoro.sim2real.twin.ensemble import SAMPLE, Ensemble
from torchsoro.sim2real.twin.scenario import Scenario
from torchsoro.sim2real.twin.twin import Twin


def varied(trial: Trial, duration: float, edge: float, gap: float = 1e-4) -> list[tuple[Twin, list[Scenario]]]:
    """Bodies that are held, free, hollow, loaded, so far from planes; with every effect, and without any."""
    load = ForceTable(box=((0.03, 0.0, 0.0), (0.04, 0.02, 0.02)), force=(0.0, 0.0, -0.1), start=duration / 3)
    found = []
    for clamped, friction in ((True, "stick"), (False, 0.4)):
        low = trial.setup.origin[2]
        plane = PlaneTable(point=(0.0, 0.0, low - gap), normal=(0.0, 0.0, 1.0), friction=friction)
        slope = PlaneTable(point=(-gap, 0.0, low), normal=(0.8, 0.0, 0.6), friction="stick")
        held = {} if clamped else {"clamps": (), "velocity": (0.1, 0.0, -0.3)}
        t = hollow(trial, forces=(load,), planes=(plane, slope), duration=duration, **held)
        twin = Twin(t.setup, edge=edge, walls=1)
        plain = twin.scenario(t)
        scenarios = [plain]
        for effect in library():
            if effect.applies(plain, twin):
                values = np.concatenate([d[:1] for d in effect.probe_points(twin)])[-2:]
                scales = [q.scale for q in effect.quantities] + [0.1 * s for s in t.setup.size] * effect.local
                scenarios.append(effect(plain, torch.tensor(values * scales), twin))
        found.append((twin, scenarios))
    return found


def check(bodies: list[tuple[Twin, list[Scenario]]], far: float) -> int:
    """Compare velocities, and what differs less; returns how many variations were."""
    count = 0
    for twin, scenarios in bodies:
        known, found = (Ensemble(twin, 1, there)(scenarios) for there in ("cpu", "cuda"))
        for one, other in zip(known, found, strict=True):
            assert one.dt == other.dt
            np.testing.assert_allclose(other.position, one.position, atol=far / 100, rtol=0)
            np.testing.assert_allclose(other.velocity, one.velocity, atol=far, rtol=0)
            np.testing.assert_allclose(other.gradient, one.gradient, atol=far / 10, rtol=0)
            count += len(one.position)
    return count


def stretched(folder: Path) -> Trial:
    """With a relaxation time, and no longer than a sample or two."""
    return read_experiment(experiment(folder)).trials[0]


def test_on_a_gpu(tmp_path, cuda):
    far = varied(stretched(tmp_path), 0.1, EDGE, gap=1.0)
    assert check(far, 1e-3) > 40
    near = varied(stretched(tmp_path), 2 * SAMPLE, EDGE)
    assert check(near, 1e-4) > 40


@pytest.mark.slow
def test_on_a_simulated_gpu():
    # Numba reads this when it is imported.
    done = subprocess.run(
        [sys.executable, __file__],
        env={**os.environ, "NUMBA_ENABLE_CUDASIM": "1", "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        timeout=1200,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert int(done.stdout) == 4


def simulated(folder: Path) -> int:
    """With all effects at once, since a simulated GPU takes seconds for a step."""
    trial = stretched(folder)
    material = dataclasses.replace(trial.setup, youngs_modulus=2e3)  # so that few steps are enough
    bodies = []
    for twin, scenarios in varied(dataclasses.replace(trial, setup=material), SAMPLE, 0.02):
        whole = scenarios[0]
        for effect in library():
            if effect.applies(whole, twin):
                values = effect.probe_points(twin)[-1][-1:]
                scales = [q.scale for q in effect.quantities] + [0.1 * s for s in trial.setup.size] * effect.local
                whole = effect(whole, torch.tensor(0.2 * values * scales), twin)
        bodies.append((twin, [scenarios[0], whole]))
    return check(bodies, 1e-5)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        print(simulated(Path(place)))
