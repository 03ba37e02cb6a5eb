"""The recipe that makes experiments of published recordings."""

import importlib
from pathlib import Path

import numpy as np
import pytest
from published import RECORDINGS, recordings

from torchsoro.sim2real.data.experiment import read_experiment
from torchsoro.sim2real.twin.twin import Twin


@pytest.fixture(scope="module")
def recipe():
    return importlib.import_module("recordings")


def places(trial):
    assert trial.recording is not None
    return trial.recording.position


def made(recipe, name, out, **options):
    recipe.main(recipe.Options(recordings=Path(RECORDINGS or "") / name, out=out, **options))
    return read_experiment(out)


@recordings
def test_sag_of_the_published_bar_with_and_without_its_load(recipe, tmp_path):
    found = made(recipe, "silicone-cantilever-beam", tmp_path)
    assert [t.name for t in found.trials] == ["load_a", "weight_a"]
    assert [t.name for t in found.heldout] == ["load_b", "weight_b"]
    fell = {}
    for trial in (*found.trials, *found.heldout):
        assert len(trial.setup.forces) == trial.name.startswith("load")
        place = places(trial)
        assert np.nanmax(np.abs(place[0] - np.array([m.at for m in found.setup.markers]))) < 5e-4
        fell[trial.name] = -float(np.nanmin(place[:, :, 2] - place[0, :, 2]))
    # The load is about as heavy as the bar, and hangs at its end.
    assert 0.009 < fell["weight_a"] < 0.5 * fell["load_a"] and fell["load_a"] == pytest.approx(fell["load_b"], rel=0.1)
    kept = made(recipe, "silicone-cantilever-beam", tmp_path / "weight", fit="weight")
    assert [t.name for t in kept.heldout] == ["load_a", "load_b"]


@recordings
def test_the_arm_bends_away_from_the_chamber_that_is_inflated(recipe, tmp_path):
    found = made(recipe, "pneumatic-arm-segment", tmp_path)
    twin = Twin(found.setup, edge=0.02, walls=1)
    assert len(found.setup.chambers) == 4 and twin.held.any()
    reach = {}
    for trial in (*found.trials, *found.heldout):
        assert trial.pressure is not None
        supply = trial.pressure.pressure.reshape(4, -1)
        assert supply[0].max() > 0 and not supply[1:].any()
        reach[float(supply.max())] = float(np.nanmin(places(trial)[:, 0, 0] - places(trial)[0, 0, 0]))
    inflated, bent = zip(*sorted(reach.items()), strict=True)
    assert inflated == (7500.0, 10000.0, 12500.0, 15000.0, 17500.0)
    assert all(np.diff(bent) < 0)
    # What repeats the frame before was lost.
    place = places(found.trials[0])
    assert np.isnan(place).all((1, 2)).any()
    assert not (np.diff(place, axis=0) == 0).all((1, 2)).any()


@pytest.mark.parametrize(
    "name, message", [("other", "wanted a folder named"), ("silicone-cantilever-beam", "no beam_")]
)
def test_a_folder_without_recordings_is_refused(recipe, tmp_path, name, message):
    with pytest.raises(ValueError, match=message):
        recipe.main(recipe.Options(recordings=tmp_path / name, out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()


@recordings
def test_bellows_begin_on_an_arc_of_16_9_degrees_held_by_a_force_that_ends(recipe, tmp_path):
    found = made(recipe, "bellows-actuator", tmp_path)
    (trial,) = found.trials
    (load,) = trial.setup.forces
    assert trial.recording is not None and trial.recording.time[0] == load.end
    place = places(trial)[:, 0]
    # An arc of 16.9 degrees whose length is the body's.
    angle = np.radians(16.9)
    chord = 2 * 0.064 / angle * np.sin(angle / 2)
    start = place[0] - [0.0, found.setup.size[2] / 2]
    assert np.hypot(*start) == pytest.approx(chord, rel=1e-3) and start[1] / start[0] == pytest.approx(
        -np.tan(angle / 2), rel=1e-2
    )
    assert np.abs(place[-1] - [0.064, found.setup.size[2] / 2]).max() < 1e-3


def test_a_folder_that_holds_an_experiment_is_refused(recipe, tmp_path):
    (tmp_path / "trials").mkdir()
    with pytest.raises(ValueError, match="holds an experiment already, wanted a new folder"):
        recipe.fresh(tmp_path)
