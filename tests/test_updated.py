"""The recipe that simulates what is believed by the updated formulation."""

from __future__ import annotations

import dataclasses
import importlib

import numpy as np
import pytest
import torch
import trimesh
from test_experiment import SETUP, experiment

from torchsoro.sim2real.data.experiment import read_experiment
from torchsoro.sim2real.data.schema import ForceTable, PlaneTable
from torchsoro.sim2real.twin.batch import simulate
from torchsoro.sim2real.twin.twin import Twin

LOADED = SETUP + "[[load]]\nbox = [[0.03, 0.0, 0.0], [0.04, 0.02, 0.02]]\nforce = [0.0, 0.05, 0.0]\nstart = 0.02\n"
FREE = SETUP.replace("[[clamp]]\nbox = [[-0.001, -0.001, -0.001], [0.0001, 0.021, 0.021]]\n", "").replace(
    'title = "bar"', 'title = "bar"\nstart = { velocity = [0.2, 0.0, 0.1] }'
)


@pytest.fixture
def updated(recipes):
    return importlib.import_module("updated")


def test_force_over_time_follows_start_ramp_and_end_of_a_load(updated):
    x = torch.tensor([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
    box = ((0.45, 0.0, 0.0), (1.0, 0.1, 0.1))
    t = torch.tensor([0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6], dtype=torch.float64)
    for start, ramp, end, share in (
        (0.0, 0.0, float("inf"), [0, 1, 1, 1, 1, 1, 1]),
        (0.1, 0.2, float("inf"), [0, 0, 0.5, 1, 1, 1, 1]),
        (0.25, 0.0, 0.45, [0, 0, 0, 1, 1, 0, 0]),
    ):
        force = updated.force_of(
            ForceTable(box=box, force=(0.0, 2.0, -1.0), start=start, ramp=ramp, end=end), x, 0.01, 0.6
        )
        assert force.particles.tolist() == [1, 2]
        expected = np.array(share)[:, None] * np.array([0.0, 2.0, -1.0])
        np.testing.assert_allclose(force.at(t).numpy(), expected, atol=1e-12)


def test_marker_shares_reproduce_a_linear_motion(updated):
    x = torch.rand(400, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    at = torch.tensor([[1.0, 0.5, 1.0], [0.4, 0.5, 0.6]], dtype=torch.float64)
    near, shares = updated.around(x, at)
    assert near.shape == shares.shape == (2, updated.AROUND)
    A = torch.tensor([[1.1, 0.2, 0.0], [-0.3, 0.9, 0.1], [0.0, 0.0, 1.3]], dtype=torch.float64)
    np.testing.assert_allclose((shares[..., None] * (x @ A)[near]).sum(1), at @ A, atol=1e-10)


def test_path_of_a_free_body_matches_free_fall(updated, tmp_path):
    folder = experiment(tmp_path, FREE)
    updated.main(updated.Options(experiments=(folder,)))
    (trial,) = read_experiment(folder).trials
    t = trial.simulated.time[:, None]
    path = np.array([0.04, 0.01, 0.02]) + t * np.array([0.2, 0.0, 0.1]) - t**2 / 2 * np.array([0.0, 0.0, 9.81])
    # A symplectic step is ahead by half a step of gravity.
    np.testing.assert_allclose(trial.simulated.position[:, 0, :2], path[:, :2], atol=1e-6)
    np.testing.assert_allclose(trial.simulated.position[:, 0, 2], path[:, 2], atol=9.81 * 0.1 * updated.FINE / 2)


def off(folder):
    """How far the particles' motion is from the twin's, over that, along y and z."""
    (trial,) = read_experiment(folder).trials
    twin = Twin(trial.setup, edge=0.004)
    (motion,) = simulate(twin, [twin.scenario(trial)])
    course, own = motion.alone().position[:, 0], trial.simulated
    same = np.stack([np.interp(motion.time, own.time, own.position[:, 0, k]) for k in range(3)], 1)
    moved = np.sqrt(((course - course[:1]) ** 2).mean(0))[1:]
    assert (moved > 1e-4).all()
    return np.sqrt(((course - same) ** 2).mean(0))[1:] / moved


@pytest.mark.slow
def test_loaded_cantilever_matches_the_twin_within_10_percent(updated, tmp_path):
    folder, other = experiment(tmp_path / "one", LOADED), experiment(tmp_path / "other", LOADED)
    assert updated.main(updated.Options(experiments=(folder, other), transfer="flip")) == 1
    tables = [(f / "trials" / "a" / "simulated.csv").read_text() for f in (folder, other)]
    assert tables[0] == tables[1]
    coarse = off(folder)
    assert updated.main(updated.Options(experiments=(folder,), transfer="flip", cells=6)) == 1
    assert (off(folder) < np.minimum(0.1, 0.6 * coarse)).all()


def test_half_clamped_faces_oblique_planes_and_uneven_edges_are_refused(updated, tmp_path):
    (trial,) = read_experiment(experiment(tmp_path)).trials
    options = updated.Options(experiments=())
    half = ((-0.001, -0.001, -0.001), (0.0001, 0.011, 0.021))
    slope = PlaneTable(point=(0.0, 0.0, 0.0), normal=(0.6, 0.0, 0.8))
    for change, message in (
        ({"clamps": (half,)}, "wanted whole faces"),
        ({"planes": (slope,)}, "wanted one along x, y or z"),
        ({"size": (0.04, 0.02, 0.0199)}, "wanted edges that a lattice"),
        ({"forces": (ForceTable(box=((1.0, 0.0, 0.0), (2.0, 1.0, 1.0)), force=(0.0, 0.0, 1.0)),)}, "holds a part"),
    ):
        with pytest.raises(ValueError, match=message):
            updated.simulate(dataclasses.replace(trial.setup, **change), options)


def test_nothing_is_written_where_one_of_them_is_refused(updated, tmp_path):
    whole = experiment(tmp_path / "whole")
    chamber = '[[chamber]]\nname = "c"\nbox = [[0.01, 0.006, 0.007], [0.03, 0.014, 0.012]]\n'
    hollow = experiment(tmp_path / "hollow", SETUP + chamber)
    (hollow / "trials" / "a" / "pressure.csv").write_text("time_s,c_pa\n0,0\n0.1,1000\n")
    mesh = experiment(
        tmp_path / "mesh", SETUP.replace("size = [0.04, 0.02, 0.02]", 'shape = "mesh"\nfile = "body.stl"')
    )
    trimesh.creation.box(bounds=((0.0, 0.0, 0.0), (0.04, 0.02, 0.02))).export(mesh / "body.stl")
    for other in (hollow, mesh):
        with pytest.raises(ValueError, match="wanted a box without chambers"):
            updated.main(updated.Options(experiments=(whole, other)))
    assert not list(tmp_path.rglob("simulated.csv"))
