"""Many variations of a twin at once: what they have in common, threads, and a GPU."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from test_experiment import experiment

from torchsoro.sim2real.data.experiment import read_experiment
from torchsoro.sim2real.data.schema import ForceTable
from torchsoro.sim2real.hypotheses.library import library
from torchsoro.sim2real.inference.fit import FitProblem
from torchsoro.sim2real.twin.batch import _at_once, _countable, _Group, safety, simulate, waves
from torchsoro.sim2real.twin.twin import Twin, _steps
from torchsoro.simulation.kernels.layout import LARGEST

EDGE = 0.008
EFFECTS = {type(e).__name__: e for e in library()}


@pytest.fixture
def trial(tmp_path):
    return read_experiment(experiment(tmp_path)).trials[0]


def varied(twin, trial):
    """Variations without and with two Maxwell elements, springs, added mass, drag and forces; all differ."""
    still = twin.scenario(trial)
    values = {
        "Modulus": [[0.0], [0.3], [-0.2]],
        "Viscoelastic": [[0.3, 0.0], [0.1, -1.0]],
        "AttachedMass": [[1e-3, 0.02, 0.01, 0.02]],
        "Tether": [[3.0, 0.1, 1e-4, 0.03, 0.01, 0.02], [10.0, 0.0, 1e-3, 0.02, 0.01, 0.02]],
        "TautTether": [[0.0, 0.02, 0.0, 0.03, 0.01, 0.02], [0.0, 0.02, 0.0, 0.02, 0.01, 0.02]],
    }
    return [EFFECTS[name](still, torch.tensor(v, dtype=torch.float64), twin) for name, v in values.items()]


def assert_same(found, wanted, atol):
    for one, other in zip(found, wanted, strict=True):
        assert (one.sound == other.sound).all() and one.sound.all()
        np.testing.assert_allclose(one.position, other.position, rtol=0, atol=atol)


@pytest.mark.parametrize("threads", [1, 2, 3, 16])
def test_every_group_is_simulated_once_whatever_the_number_of_threads(threads):
    for groups in range(70):
        assert sum(waves(groups, threads)) == groups
        assert max(waves(groups, threads), default=0) <= threads


def test_threads_that_have_no_group_of_their_own_help_with_others():
    assert sorted(waves(9, 8)) == [1, 8]
    assert waves(1, 16) == (1,)


def test_motions_are_the_same_bits_for_any_number_of_threads(trial):
    twin = Twin(trial.setup, edge=EDGE)
    asked = varied(twin, trial) * 3
    one, *others = (simulate(twin, asked, threads=n) for n in (1, 2, 5))
    for other in others:
        assert_same(one, other, 0.0)


def test_variations_with_elements_and_springs_move_together_as_they_do_alone(trial):
    twin = Twin(trial.setup, edge=EDGE)
    asked = varied(twin, trial)
    together = simulate(twin, asked, even=True)
    for one, s in zip(together, asked, strict=True):
        (alone,) = simulate(twin, [s])
        assert np.ptp(alone.position) > 1e-3
        assert_same([one], [alone], 2e-5)  # whose step is another


def test_forces_at_a_place_are_one_for_all_trials(trial):
    twin = Twin(trial.setup, edge=EDGE)
    asked = varied(twin, trial) * 3
    lanes = [(i, b) for i, s in enumerate(asked) for b in range(s.batch)]
    forces = _Group(twin, asked, lanes).forces()
    assert len(forces) == 2  # the two places of the taut tether
    for place, force in enumerate(forces):
        pulled = [k for k, (i, b) in enumerate(lanes) if i % 5 == 4 and b == place]
        assert len(pulled) == 3 and force.value.any(1).nonzero().squeeze(1).tolist() == pulled


def test_batches_of_a_gpu_hold_no_more_than_it_can_index(trial):
    twin = Twin(trial.setup, edge=EDGE)
    lanes = [(0, b) for b in range(6)]
    assert _at_once(lanes, [1.0, 1.0, 2.0, 1.1, 1.2, 1.0], 3) == [[(0, 0), (0, 1), (0, 5)], [(0, 3), (0, 4)], [(0, 2)]]
    short, long = (_countable(twin, samples, 2) for samples in (2, 10**6))
    nodes = 27 * len(trial.setup.markers)
    assert long == LARGEST // (10**6 * 6 * nodes) < short < LARGEST // (2 * 6 * twin.nodes)


def test_residuals_of_a_batch_are_those_of_each_motion(tmp_path):
    found = read_experiment(experiment(tmp_path))
    problem = FitProblem(found, Twin(found.setup, edge=EDGE))
    (motions,) = problem.simulate([((), np.array([[0.0], [0.5], [-0.5]]))])
    errors = 0.3 * problem.observation.deviations
    together = problem.residual(motions, errors)
    for k in range(3):
        alone = problem.residual([m.alone(k) for m in motions], errors)
        np.testing.assert_allclose(together[:, k], alone, rtol=1e-9, atol=1e-9)


def test_a_gpu_moves_markers_as_lanes_do(trial, cuda):
    twin = Twin(trial.setup, edge=EDGE)
    asked = varied(twin, trial)
    on_gpu = dataclasses.replace(twin, device=str(cuda))
    assert_same(simulate(on_gpu, asked, even=True), simulate(twin, asked, even=True), 2e-6)
    still = twin.scenario(trial)
    far = torch.tensor([1e5, 0.0], dtype=torch.float64)[:, None, None] * torch.ones(twin.nodes, 3)
    found = simulate(on_gpu, [still.replace(velocity=still.velocity + far)])[0]
    assert found.sound.tolist() == [False, True]
    np.testing.assert_allclose(found.position[1], simulate(twin, [still])[0].position[0], rtol=0, atol=2e-6)


def test_a_solid_that_softens_steeply_has_a_step_that_is_short_enough(trial):
    """Held near its largest stretch, where what softens little is steep: with steps as near rest, it diverges."""
    twin = Twin(trial.setup, edge=EDGE)
    pulled = ForceTable(box=((0.036, -1, -1), (0.041, 1, 1)), force=(0, 0, 0.7), ramp=0.05)
    still = twin.scenario(trial).replace(loads=tuple(_steps(pulled, twin.grid.within(pulled.box))))
    still = still.replace(poisson_ratio=torch.tensor(0.3, dtype=torch.float64))
    asked = torch.tensor([[0.3, -6.0], [0.1, -7.0], [0.6, -6.0]], dtype=torch.float64)
    deep = EFFECTS["Softening"](still, asked, twin)
    (bare,), (found,) = simulate(twin, [still]), simulate(twin, [deep])
    (wanted,) = simulate(twin, [deep], safe=safety(twin) / 8)
    assert_same([found], [wanted], 3e-5)  # of a step that is up to eight times as long
    assert found.sound.all() and (np.abs(wanted.position - bare.position).max((1, 2, 3)) > 5e-4).all()
