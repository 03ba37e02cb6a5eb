"""Mistakes in recordings, each made in sound data: a refusal or a finding names it; sound data give none."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from setups import CLAMP, marker, material

from torchsoro.sim2real.data.experiment import Experiment, Trial, read_experiment
from torchsoro.sim2real.data.plausibility import plausible
from torchsoro.sim2real.data.recording import Recording, write_table

CASES = sorted((Path(__file__).parent / "judged" / "cases").iterdir())
PLACES = [(0.08, 0.01, 0.024), (0.08, 0.003, 0.004), (0.052, 0.02, 0.008), (0.03, 0.0, 0.014)]
NAMES = ["tip", "low", "side", "middle"]
SETUP = f"""
title = "bar"
duration = 0.5

[body]
size = [0.08, 0.02, 0.024]

{material()}
{CLAMP.replace("0.021, 0.021", "0.021, 0.025")}
{"".join(marker(n, *at) for n, at in zip(NAMES, PLACES, strict=True))}
[recording]
noise = 1e-4
"""


def swing(seed: int = 0, rate: float = 200.0, axes: tuple[int, ...] = (0, 1, 2)) -> Recording:
    """A bar that is let go: markers sag and swing, the further from the clamp the more."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 0.5, 1 / rate)
    sag = 0.012 * (1 - np.exp(-time / 0.2) * np.cos(2 * np.pi * 8 * time))
    places = np.array(PLACES)
    moved = np.stack([-0.1 * sag, 0.05 * sag, -sag], -1)[:, None] * (places[:, :1] / 0.08) ** 2
    wrong = 4e-4 * rng.normal(size=places.shape)  # of marker places
    place = places + wrong + moved + 1e-4 * rng.normal(size=moved.shape[:1] + places.shape)
    return Recording(time=time, position=place[..., list(axes)], axes=axes)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("plausibility")
    (place / "setup.toml").write_text(SETUP)
    return place


def write(folder: Path, **recordings: Recording) -> Experiment:
    """An experiment with these trials only."""
    shutil.rmtree(folder / "trials", ignore_errors=True)
    for name, recording in recordings.items():
        write_table(folder / "trials" / name / "markers.csv", recording.columns(NAMES))
    return read_experiment(folder)


def findings(folder: Path, recording: Recording) -> list[str]:
    return [str(f) for f in plausible(write(folder, a=recording))[1]]


def changed(recording: Recording, change) -> Recording:
    return dataclasses.replace(recording, position=change(recording.position.copy()))


def refusal(folder: Path, recording: Recording) -> str:
    with pytest.raises(ValueError, match=r"trials/a/markers\.csv: markers begin .* wanted places in metres") as told:
        write(folder, a=recording)
    return str(told.value)


# Sound data ---------------------------------------------------------------------------------------------------------


@hypothesis.given(
    seed=st.integers(0, 10**6), rate=st.sampled_from([30.0, 100.0, 1000.0]), digits=st.sampled_from([3, 4, 6])
)
def test_sound_recordings_of_any_rate_and_resolution_give_no_finding(folder, seed, rate, digits):
    assert not findings(folder, changed(swing(seed, rate), lambda x: np.round(x, digits)))


@pytest.mark.parametrize("case", CASES, ids=lambda path: path.name)
def test_recordings_of_the_judge_give_no_finding(case):
    experiment = read_experiment(case)
    same, found = plausible(experiment)
    assert not found
    for before, after in zip(experiment.trials, same.trials, strict=True):
        assert before.recording is not None and after.recording is not None
        np.testing.assert_array_equal(before.recording.position, after.recording.position)


def test_a_body_that_bounces_at_a_coarse_rate_gives_no_finding(folder):
    time = np.arange(0.0, 0.5, 0.01)
    height = np.abs(np.sin(9 * time)) * 0.05

    def drop(x):
        x = np.repeat(x[:1], len(time), 0)
        x[..., 2] += height[:, None]
        return x

    assert not findings(folder, Recording(time=time, position=drop(swing().position)))


@hypothesis.given(seed=st.integers(0, 10**6), turn=st.tuples(*[st.floats(-0.35, 0.35)] * 3))
def test_a_body_that_begins_tilted_gives_no_finding(folder, seed, turn):
    middle = np.array([0.04, 0.01, 0.012])
    tilt = Rotation.from_rotvec(turn)

    def turned(x):
        return tilt.apply((x - middle).reshape(-1, 3)).reshape(x.shape) + middle

    assert not findings(folder, changed(swing(seed), turned))


# The frame ----------------------------------------------------------------------------------------------------------


@hypothesis.given(seed=st.integers(0, 10**6), axis=st.integers(0, 2), shift=st.sampled_from([0.0, 0.3, -0.7]))
def test_a_mirrored_axis_is_refused_by_name_whatever_the_origin(folder, seed, axis, shift):
    def mirror(x):
        x[..., axis] = shift - x[..., axis]
        return x

    assert f"{'xyz'[axis]} mirrored" in refusal(folder, changed(swing(seed), mirror))


@hypothesis.given(seed=st.integers(0, 10**6), pair=st.sampled_from([(0, 1), (0, 2), (1, 2)]))
def test_swapped_axes_are_refused_by_name(folder, seed, pair):
    order = [0, 1, 2]
    order[pair[0]], order[pair[1]] = order[pair[1]], order[pair[0]]
    told = refusal(folder, changed(swing(seed), lambda x: x[..., order]))
    assert f"{'xyz'[pair[0]]} and {'xyz'[pair[1]]} swapped" in told


def test_axes_turned_in_a_circle_with_one_mirrored_are_refused_with_what_columns_hold(folder):
    told = refusal(folder, changed(swing(), lambda x: np.stack([x[..., 1], x[..., 2], -x[..., 0]], -1)))
    assert "columns x, y, z hold y, z, -x" in told


@pytest.mark.parametrize(
    ("factor", "unit"),
    [
        (1e3, "lengths in millimetres"),
        (1e2, "lengths in centimetres"),
        (1 / 0.0254, "lengths in inches"),
        (1e-3, "lengths in metres, and those of setup.toml in millimetres"),
    ],
)
def test_another_unit_of_length_is_refused_by_name(folder, factor, unit):
    assert unit in refusal(folder, changed(swing(), lambda x: factor * x))


def test_displacements_in_place_of_places_are_refused(folder):
    assert "hold displacements, not places" in refusal(folder, changed(swing(), lambda x: x - PLACES))


def test_displacements_in_millimetres_added_to_places_in_metres_are_refused(folder):
    with pytest.raises(ValueError, match=r"marker tip is at .*\(is it in millimetres\?\), wanted within 0\.4 m"):
        write(folder, a=changed(swing(), lambda x: x[:1] + 1e3 * (x - x[:1])))


@hypothesis.given(seed=st.integers(0, 10**6), pair=st.sampled_from([(0, 1), (0, 2), (1, 3), (2, 3)]))
def test_columns_of_two_exchanged_markers_are_put_right_and_named(folder, seed, pair):
    right = write(folder, a=swing(seed))
    order = np.arange(4)
    order[list(pair)] = order[list(pair[::-1])]
    mended, (found,) = plausible(write(folder, a=changed(swing(seed), lambda x: x[:, order])))
    assert f"columns of {NAMES[pair[0]]} and {NAMES[pair[1]]} exchanged" in str(found) and "put right" in str(found)
    np.testing.assert_array_equal(places(mended.trials[0]), places(right.trials[0]))


def test_three_markers_named_in_a_circle_are_put_right(folder):
    mended, (found,) = plausible(write(folder, a=changed(swing(), lambda x: x[:, [1, 2, 0, 3]])))
    assert "columns of tip, low and side exchanged" in found.what
    np.testing.assert_allclose(places(mended.trials[0]), swing().position, atol=1e-8)


def thrown(seed: int, late: float) -> Recording:
    """A bar that flies and turns, by a clock that is late."""
    time = np.arange(0.0, 0.5, 0.005)
    true, middle = time + late, np.array([0.04, 0.01, 0.012])
    turned = Rotation.from_rotvec(np.outer(true, (0.0, 0.0, 10.0))).as_matrix() @ (np.array(PLACES) - middle).T
    fallen = np.outer(true, (1.5, -0.5, 0.0)) - 0.5 * np.outer(true**2, (0.0, 0.0, 9.81))
    wrong = 4e-4 * np.random.default_rng(seed).normal(size=(4, 3))
    return Recording(time=time, position=turned.transpose(0, 2, 1) + middle + fallen[:, None] + wrong)


@hypothesis.settings(max_examples=10, deadline=None)
@hypothesis.given(
    seed=st.integers(0, 10**6),
    late=st.floats(-0.015, 0.015),
    pair=st.sampled_from([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]),
)
@pytest.mark.slow
def test_exchanged_markers_of_a_body_that_is_thrown_are_put_right(tmp_path_factory, seed, late, pair):
    place, order = tmp_path_factory.mktemp("thrown"), np.arange(4)
    start = "[start]\nvelocity = [1.5, -0.5, 0.0]\nangular_velocity = [0.0, 0.0, 10.0]\n"
    (place / "setup.toml").write_text(SETUP.replace(CLAMP.replace("0.021, 0.021", "0.021, 0.025"), start))
    right = write(place, a=thrown(seed, late))
    assert not plausible(right)[1]
    order[list(pair)] = order[list(pair[::-1])]
    mended, (found,) = plausible(write(place, a=changed(thrown(seed, late), lambda x: x[:, order])))
    assert f"columns of {NAMES[pair[0]]} and {NAMES[pair[1]]} exchanged" in str(found) and "put right" in str(found)
    np.testing.assert_array_equal(places(mended.trials[0]), places(right.trials[0]))


def test_a_shifted_origin_is_told_with_its_shift(folder):
    (told,) = findings(folder, changed(swing(), lambda x: x + np.array([0.02, 0.0, -0.01])))
    assert "origin shifted by (2" in told and "frame of setup.toml" in told


def test_a_mirrored_axis_of_a_video_is_refused(folder, tmp_path):
    (tmp_path / "setup.toml").write_text(SETUP.replace("[recording]", '[recording]\nkind = "video"\naxes = ["x", "z"]'))

    def down(x):
        x[..., 1] = 0.24 - x[..., 1]
        return x

    assert "z mirrored" in refusal(tmp_path, changed(swing(axes=(0, 2)), down))


def places(trial: Trial) -> np.ndarray:
    assert trial.recording is not None
    return trial.recording.position


# Samples ------------------------------------------------------------------------------------------------------------


@hypothesis.given(
    seed=st.integers(0, 10**6), row=st.integers(2, 97), number=st.integers(0, 3), far=st.floats(0.03, 0.2)
)
def test_a_jump_of_one_sample_counts_as_lost_and_is_named(folder, seed, row, number, far):
    def jump(x):
        x[row, number, 1] += far
        return x

    mended, (found,) = plausible(write(folder, a=changed(swing(seed), jump)))
    assert f"{NAMES[number]} at {row / 200:g} s" in found.evidence and "lost" in found.remedy
    lost = np.isnan(places(mended.trials[0])).all(-1)
    assert np.argwhere(lost).tolist() == [[row, number]]


@hypothesis.given(seed=st.integers(0, 10**6), first=st.integers(8, 40), lasts=st.integers(12, 60))
def test_markers_that_change_places_for_a_while_are_put_back(folder, seed, first, lasts):
    def exchange(x):
        x[first : first + lasts, [0, 2]] = x[first : first + lasts, [2, 0]]
        return x

    mended, (found,) = plausible(write(folder, a=changed(swing(seed), exchange)))
    assert found.what == "side, tip change places" and f"{first / 200:g}" in found.evidence
    np.testing.assert_allclose(places(mended.trials[0]), swing(seed).position, atol=1e-8)


def test_rows_that_repeat_the_row_before_are_told_with_their_number(folder):
    def hold(x):
        x[1::2] = x[::2]
        return x

    (told,) = findings(folder, changed(swing(), hold))
    assert "rows repeat the row before" in told and "49 of 98 rows" in told


def test_a_marker_that_is_not_followed_any_more_is_told_with_its_times(folder):
    def freeze(x):
        x[60:, 2] = x[60, 2]
        return x

    (told,) = findings(folder, changed(swing(), freeze))
    assert "marker side keeps one value" in told and "0.3 to 0.495 s" in told


def test_two_markers_with_the_same_columns_are_told(folder, tmp_path):
    (tmp_path / "setup.toml").write_text(SETUP.replace(str(list(PLACES[1])), "[0.08, 0.0095, 0.0235]"))

    def copy(x):
        x[:, 1] = x[:, 0]
        return x

    assert "markers tip and low have the same columns" in findings(tmp_path, changed(swing(), copy))[0]


def test_the_same_recording_in_two_trials_is_told(folder):
    _, (found,) = plausible(write(folder, a=swing(), b=swing(), c=swing(1)))
    assert found.where == ("a", "b") and found.what == "the same recording"


# Time and setup -----------------------------------------------------------------------------------------------------


def test_times_and_duration_in_milliseconds_are_told_by_the_period_of_the_body(tmp_path):
    (tmp_path / "setup.toml").write_text(SETUP.replace("duration = 0.5", "duration = 500.0"))
    recording = swing()
    (told,) = findings(tmp_path, dataclasses.replace(recording, time=1e3 * recording.time))
    assert "too far apart" in told and "5 s between two of them" in told and "in seconds" in told


def test_a_modulus_in_kilopascals_is_told_by_the_weight(tmp_path):
    (tmp_path / "setup.toml").write_text(SETUP.replace("youngs_modulus = 1e5", "youngs_modulus = 100.0"))
    assert any("cannot bear its own weight" in told for told in findings(tmp_path, swing()))


def test_markers_that_are_all_on_clamped_parts_are_told(tmp_path):
    held = SETUP.replace("[0.0001, 0.021, 0.025]", "[0.0799, 0.021, 0.025]").replace("at = [0.08,", "at = [0.0795,")
    (tmp_path / "setup.toml").write_text(held)
    assert any("all markers are on clamped parts" in told for told in findings(tmp_path, swing()))


def test_an_absolute_pressure_is_told(tmp_path):
    (tmp_path / "setup.toml").write_text(
        SETUP + '[[chamber]]\nname = "air"\nbox = [[0.01, 0.005, 0.005], [0.07, 0.015, 0.015]]\n'
    )
    write_table(tmp_path / "trials/a/markers.csv", swing().columns(NAMES))
    for base, count in ((0.0, 0), (101e3, 1)):
        (tmp_path / "trials/a/pressure.csv").write_text(f"time_s,air_pa\n0,{base}\n0.1,{base + 8e3}\n0.5,{base}\n")
        found = plausible(read_experiment(tmp_path))[1]
        assert [f.what for f in found] == ["the pressure is never below that of the atmosphere"] * count


def test_a_finding_in_several_trials_is_told_once(folder):
    swapped = changed(swing(), lambda x: x[:, [1, 0, 2, 3]]), changed(swing(1), lambda x: x[:, [1, 0, 2, 3]])
    _, (found,) = plausible(write(folder, a=swapped[0], b=swapped[1], c=swing(2)))
    assert found.where == ("a", "b") and str(found).startswith("trials a, b: columns of tip and low exchanged")
