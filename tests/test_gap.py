"""The recipe that hides physics in an archived robot."""

from __future__ import annotations

import dataclasses
import importlib
import json

import numpy as np
import pytest

from torchsoro.sim2real.data.experiment import read_experiment
from torchsoro.sim2real.hypotheses.library import library
from torchsoro.sim2real.twin.batch import simulate
from torchsoro.sim2real.twin.twin import Twin


@pytest.fixture(scope="module")
def hide(recipes, straight, tmp_path_factory):
    """Make an experiment of a tiny walker that lacks something, and say what."""
    gap = importlib.import_module("gap")

    def make(what: str, **options):
        out = tmp_path_factory.mktemp(what) / "gap"
        settings = {"duration": 0.02, "settle": 0.01, "noise": 1e-9, **options}
        truth = gap.main(gap.Options(robot=str(straight[0]), out=out, hide=what, **settings))
        assert json.loads((out.parent / "gap-truth.json").read_text()) == truth
        return read_experiment(out), truth

    return make


def track(found):
    return np.stack([t.recording.position for t in found.trials])


def simulated(found):
    """At the times of the recordings."""
    return np.stack([t.simulated.position[:: round(0.005 / 0.001)] for t in found.trials])


@pytest.mark.slow
def test_hidden_effects_are_in_the_recording_and_not_in_the_setup(hide):
    plain, truth = hide("nothing")
    assert truth == {} and [t.name for t in plain.heldout] == ["kept"]
    assert np.ptp(track(plain), axis=1).max() > 1e-5
    np.testing.assert_allclose(simulated(plain), track(plain), atol=1e-7)
    names = {e.name for e in library()}
    for what in ("tube", "asymmetry"):
        found, truth = hide(what)
        assert truth["name"] in names
        assert np.abs(track(found) - track(plain)).max() > 1e-7
        np.testing.assert_allclose(simulated(found), track(plain), atol=1e-7)
        # All is believed that is true without it.
        assert found.setup == dataclasses.replace(plain.setup, surface=found.setup.surface)
    found, truth = hide("air")
    twice, once = (e.setup.chambers[0].air_stiffness for e in (found, plain))
    assert truth == {"name": "air_stiffness", "parameters": {"air_stiffness_pa": -once}}
    assert twice == 2 * once > 0
    np.testing.assert_allclose(track(found), track(plain), atol=1e-7)
    assert np.abs(simulated(found) - track(plain)).max() > 1e-7
    relaxed, truth = hide("relaxation")
    assert truth["name"] in names and len(truth["prony"]) == 2
    assert not relaxed.setup.prony and len(plain.setup.prony) == 2
    np.testing.assert_allclose(track(relaxed), track(plain), atol=1e-7)
    assert np.abs(simulated(relaxed) - track(plain)).max() > 1e-7
    assert all(t.simulated is None for t in hide("nothing", simulated=False)[0].trials)


@pytest.mark.slow
def test_twin_of_a_walker_stays_within_5_mm_of_its_plane(hide):
    found, _ = hide("nothing")
    twin = Twin(found.setup, edge=0.01, walls=1)
    assert twin.grid.cut
    moved = simulate(twin, [twin.scenario(found.trials[0])])[0]
    assert moved.sound.all()
    # Neither falls through the ground, nor jumps off it.
    assert np.abs(moved.position[..., 2] - moved.position[..., :1, :, 2]).max() < 5e-3


@pytest.mark.slow
def test_twins_leave_less_of_a_walker_with_the_true_tube(hide):
    found, _ = hide("tube", strength=10.0)
    gap_error = importlib.import_module("gap_error")
    tables = gap_error.main(gap_error.Options(experiment=found.folder, threads=1))
    assert len(tables) == 2
    for table in tables.values():
        without, true = (np.array(table[f"{name}, corrected"]) for name in ("described", "with the true tether"))
        assert without.shape == (len(found.trials),) and (true < without).all()


def test_gap_error_refuses_what_it_has_no_form_for(tmp_path):
    gap_error = importlib.import_module("gap_error")
    for wrong in ({}, {"name": "viscoelastic"}):
        with pytest.raises(ValueError, match=r"hidden = (nothing|viscoelastic): wanted one of tether"):
            gap_error.true_point(None, wrong)
    with pytest.raises(ValueError, match=r"no none-truth\.json beside it, wanted a folder of gap\.py"):
        gap_error.main(gap_error.Options(experiment=tmp_path / "none"))
