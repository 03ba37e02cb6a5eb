"""The highest frequency of a grid, and the step that it allows."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from test_experiment import experiment

from torchsoro.sim2real.data.experiment import read_experiment
from torchsoro.sim2real.data.schema import ChamberTable
from torchsoro.sim2real.twin.batch import simulate
from torchsoro.sim2real.twin.twin import Twin

CHAMBER = ChamberTable(name="c", box=((0.01, 0.006, 0.007), (0.03, 0.014, 0.012)))


@pytest.fixture
def trial(tmp_path):
    return read_experiment(experiment(tmp_path)).trials[0]


def dense(grid, shear):
    """All eigenvalues, by a matrix that is put together point by point, of a bulk modulus of 1 Pa."""
    lattice, cells = grid.lattice, np.repeat(grid.cells, 8, axis=0)
    nodes, _, slopes = lattice.splines(grid.points, cells)
    n = lattice.nodes
    K = np.zeros((3 * n, 3 * n))
    law = np.zeros((6, 6))
    law[:3, :3], law[range(6), range(6)] = 1 - 2 * shear / 3, shear * np.array([1, 1, 1, 0.5, 0.5, 0.5]) * 2
    law[:3, :3] += np.diag([1 - 2 * shear / 3] * 3)
    for at, slope, volume in zip(nodes, slopes, grid.volumes, strict=True):
        B = np.zeros((6, 3, 27))
        for row, (i, j) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))):
            B[row, i] += slope[j]
            if i != j:
                B[row, j] += slope[i]
        B = B.reshape(6, 81)
        place = (np.arange(3)[:, None] * n + at).reshape(-1)
        K[np.ix_(place, place)] += volume * B.T @ law @ B
    whole = lattice.spread(torch.from_numpy(grid.volumes))[None]
    mass = lattice.nodal(whole, 0 * whole, 1.0)[0, 0].numpy()
    there = np.tile(mass > 0, 3)
    root = np.tile(mass, 3)[there] ** -0.5
    return np.linalg.eigvalsh(root[:, None] * K[np.ix_(there, there)] * root)


def test_highest_frequency_matches_a_dense_matrix(trial):
    """Between powers of two, chords lie above it by little."""
    setup = dataclasses.replace(trial.setup, chambers=(CHAMBER,))
    twin = Twin(setup, edge=0.03, walls=1, across=1)
    for shear in (0.125, 0.18, 0.4, 1.5):
        wanted = dense(twin.grid, shear)[-1]
        assert 0.99 < float(twin.frequency.square(np.array(shear))) / wanted < 1.05


@pytest.mark.parametrize("share, stable", [(0.95, True), (1.15, False)])
def test_a_bar_is_stable_just_below_the_step_that_its_highest_frequency_allows(trial, share, stable):
    """While it moves little."""
    weak = dataclasses.replace(trial, setup=dataclasses.replace(trial.setup, gravity=(0.0, 0.0, -1e-3)))
    twin = Twin(weak.setup, edge=0.01)
    assert simulate(twin, [twin.scenario(weak)], safe=share)[0].sound.all() == stable
