"""Experiments and recordings on disk."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from setups import CLAMP, marker, material

from torchsoro.sim2real.data.experiment import read_experiment
from torchsoro.sim2real.data.recording import Recording, read_table

SETUP = f"""
title = "bar"
duration = 0.1

[body]
size = [0.04, 0.02, 0.02]

{material()}
{CLAMP}
{marker("tip", 0.04, 0.01, 0.02)}
[recording]
kind = "video"
axes = ["x", "z"]
noise = 1e-4
"""


def experiment(folder: Path, setup: str = SETUP, markers: str | None = None) -> Path:
    rows = "\n".join(f"{0.01 * k},{0.04 + 1e-3 * k},{0.02 - 1e-3 * k}" for k in range(5))
    (folder / "trials" / "a").mkdir(parents=True, exist_ok=True)
    (folder / "setup.toml").write_text(setup, encoding="utf-8")
    (folder / "trials" / "a" / "markers.csv").write_text(
        markers or f"time_s,tip_x_m,tip_z_m\n{rows}\n", encoding="utf-8"
    )
    return folder


def test_setup_values_defaults_and_marker_places_are_read(tmp_path):
    found = read_experiment(experiment(tmp_path))
    setup, (trial,) = found.setup, found.trials
    assert setup.size == (0.04, 0.02, 0.02) and setup.axes == (0, 2) and setup.prony == ((0.5, 0.01),)
    assert setup.gravity == (0.0, 0.0, -9.81) and setup.velocity == (0.0, 0.0, 0.0)
    np.testing.assert_allclose(trial.recording.position[:, 0], [[0.04 + 1e-3 * k, 0.02 - 1e-3 * k] for k in range(5)])


def test_tables_of_trial_toml_replace_those_of_setup_toml(tmp_path):
    folder = experiment(tmp_path)
    (folder / "trials" / "a" / "trial.toml").write_text(
        "[start]\nvelocity = [1.0, 0.0, 0.0]\n[[load]]\nbox = [[0,0,0],[0.01,0.01,0.01]]\nforce = [0.0, 0.0, -1.0]\n"
    )
    found = read_experiment(folder)
    assert found.setup.forces == () and found.trials[0].setup.velocity == (1.0, 0.0, 0.0)
    assert found.trials[0].setup.forces[0].force == (0.0, 0.0, -1.0)


def test_two_samples_are_refused(tmp_path):
    table = "time_s,tip_x_m,tip_z_m\n0,0.04,0.02\n0.05,0.04,0.02\n"
    with pytest.raises(ValueError, match=r"markers\.csv: 2 samples, wanted three or more"):
        read_experiment(experiment(tmp_path, markers=table))


def test_an_empty_cell_is_a_lost_sample(tmp_path):
    table = "time_s,tip_x_m,tip_z_m\n0,0.04,0.02\n0.05,,0.02\n0.1,0.04,0.02\n"
    recording = read_experiment(experiment(tmp_path, markers=table)).trials[0].recording
    assert recording.seen[:, 0].tolist() == [[True, True], [False, True], [True, True]]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("duration = 0.1", "", r"setup\.toml: no duration, wanted a finite number of seconds"),
        ("duration = 0.1", "duration = 0.1\nspeed = 3", r"unknown speed"),
        (
            "poisson_ratio = 0.4",
            "poisson_ratio = 0.5",
            r"\[material\]: poisson_ratio = 0\.5, wanted a finite number from 0 to 0\.4999",
        ),
        ("[[0.5, 0.01]]", "[[0.5, -1]]", r"prony = .*, wanted at most five pairs of positive numbers"),
        ("size = [0.04, 0.02, 0.02]", "size = [0.04, 0.02]", r"size = \[0\.04, 0\.02\], wanted three finite numbers"),
        (
            "size = [0.04, 0.02, 0.02]",
            'shape = "mesh"\nfile = "../a.stl"',
            r"file = '\.\./a\.stl', wanted one beside it",
        ),
        ('kind = "video"', 'kind = "film"', r"\[recording\]: kind = 'film', wanted \"mocap\" or \"video\""),
        ('name = "tip"', 'name = "end"', r"columns 'time_s, tip_x_m, tip_z_m', wanted also end_x_m, end_z_m"),
        (
            "box = [[-0.001, -0.001, -0.001],",
            "box = [[0.1, 0.1, 0.1],",
            r"\[\[clamp\]\] number 1: box = .*, wanted .*the lower corner first",
        ),
        (
            "size = [0.04, 0.02, 0.02]",
            "size = [100, 30, 30]",
            r"size = .*, wanted .* from 0\.0001 to 10 m: is the unit",
        ),
        ("youngs_modulus = 1e5", "youngs_modulus = 0.1", r"youngs_modulus = 0\.1, wanted 100 to 1e\+10 Pa"),
        ("density = 1000.0", "density = 1.0", r"density = 1\.0, wanted 10 to 30000 kg/m3"),
        ("at = [0.04, 0.01, 0.02]", "at = [0.14, 0.01, 0.02]", r"tip at .* is 100 mm outside of the body"),
        (
            "duration = 0.1",
            "duration = 0.1\ngravity = [0, 0, -9810]",
            r"gravity = \[0, 0, -9810\], wanted .* at most 1000 m/s2",
        ),
        (
            "[recording]",
            "[[load]]\nbox = [[0,0,0],[1,1,1]]\nforce = [0, 0, 1]\nramp = 0.2\nend = 0.1\n[recording]",
            r"end = 0\.1, wanted one after it has grown, at 0\.2 s",
        ),
    ],
)
def test_setup_values_out_of_range_are_refused_by_table_and_key(tmp_path, old, new, message):
    assert old in SETUP
    with pytest.raises(ValueError, match=message):
        read_experiment(experiment(tmp_path, SETUP.replace(old, new)))


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("time_s,tip_x_m,tip_z_m\n0,1,2\n0.1,x,2\n0.2,1,2\n", r"line 3: 'tip_x_m' = 'x', wanted a number or nothing"),
        ("time_s,tip_x_m,tip_z_m\n0,1\n", r"line 2 has 2 cells, wanted 3"),
        (
            "time_s,tip_x_m,tip_z_m\n0,1,2\n0,1,2\n0.2,1,2\n",
            r"time: 0 s in sample 2 after 0 s, wanted times that increase",
        ),
        ("time_s,tip_x_m,tip_z_m\n0,,\n0.02,,\n0.04,,\n", r"marker tip has no sample"),
        (
            "time_s,tip_x_m,tip_z_m\n0,40,20\n0.02,40,20\n0.04,40,20\n",
            r"markers begin 3\.16e\+04 mm .* if read as: lengths in millimetres; wanted places in metres",
        ),
        (
            "time_s,tip_x_m,tip_z_m\n0,1,2\n0.004,1,2\n0.008,1,2\n",
            r"times from 0 to 0\.008, wanted seconds from release, some of 0\.03",
        ),
        ("time_s\n", r"1 lines, wanted names of columns and numbers below"),
    ],
)
def test_marker_tables_that_do_not_fit_are_refused_by_line_or_marker(tmp_path, table, message):
    with pytest.raises(ValueError, match=message):
        read_experiment(experiment(tmp_path, markers=table))


def test_simulated_csv_is_read_along_three_axes(tmp_path):
    table = tmp_path / "trials" / "a" / "simulated.csv"
    folder = experiment(tmp_path)
    assert read_experiment(folder).trials[0].simulated is None
    table.write_text("time_s,tip_x_m,tip_y_m,tip_z_m\n0,0.04,0.01,0.02\n0.05,0.05,0.01,0.02\n0.1,0.06,0.01,0.02\n")
    simulated = read_experiment(folder).trials[0].simulated
    assert simulated.position[:, 0, 0].tolist() == [0.04, 0.05, 0.06]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("0,0.04,0.01,0.02\n0.05,,0.01,0.02\n0.1,0.06,0.01,0.02", "an empty cell, wanted all places"),
        ("0,0.04,0.01,0.02\n0.03,0.04,0.01,0.02\n0.06,0.06,0.01,0.02", r"0 to 0\.06 s, wanted 0 to 0\.1 s"),
        ("0.02,0.04,0.01,0.02\n0.03,0.04,0.01,0.02\n0.1,0.06,0.01,0.02", r"0\.02 to 0\.1 s, wanted 0 to 0\.1 s"),
        ("0,40,10,20\n0.05,40,10,20\n0.1,40,10,20", "lengths in millimetres"),
    ],
)
def test_simulated_csv_with_gaps_or_too_short_is_refused(tmp_path, rows, message):
    folder = experiment(tmp_path)
    (folder / "trials" / "a" / "simulated.csv").write_text(f"time_s,tip_x_m,tip_y_m,tip_z_m\n{rows}\n")
    with pytest.raises(ValueError, match=rf"simulated\.csv.*{message}"):
        read_experiment(folder)


def test_samples_after_the_duration_are_left_out(tmp_path):
    rows = "\n".join(f"{0.01 * k},{0.04 + 1e-3 * k},0.02" for k in range(-2, 30))
    recording = read_experiment(experiment(tmp_path, markers=f"time_s,tip_x_m,tip_z_m\n{rows}\n")).trials[0].recording
    assert recording.time[[0, -1]] == pytest.approx([-0.02, 0.1])


def test_a_marker_far_from_its_stated_place_is_refused(tmp_path):
    table = "time_s,tip_x_m,tip_z_m\n0,0.14,0.02\n0.02,0.14,0.02\n0.04,0.14,0.02\n"
    with pytest.raises(ValueError, match=r"tip begins at \[0\.14, 0\.02\], .* in the frame of setup\.toml"):
        read_experiment(experiment(tmp_path, markers=table))
    # Who is seen only later may have come far.
    read_experiment(
        experiment(tmp_path, markers=table.replace("\n0,0.14,0.02", "\n0,,").replace("0.02,0.14", "0.03,0.14"))
    )


def test_a_trial_with_another_body_is_refused(tmp_path):
    folder = experiment(tmp_path)
    (folder / "trials" / "a" / "trial.toml").write_text("[body]\nsize = [0.05, 0.02, 0.02]\n")
    with pytest.raises(ValueError, match=r"trial\.toml: table body, wanted the same in all trials"):
        read_experiment(folder)


def test_a_trial_with_other_chambers_is_refused(tmp_path):
    chamber = '[[chamber]]\nname = "air"\nbox = [[0.01, 0.005, 0.005], [{}, 0.015, 0.015]]\nair_stiffness = {}\n'
    folder = experiment(tmp_path, SETUP + chamber.format(0.03, 0.0))
    (folder / "trials" / "a" / "pressure.csv").write_text("time_s,air_pa\n0,0\n0.1,1000\n")
    own = folder / "trials" / "a" / "trial.toml"
    own.write_text(chamber.format(0.03, 5e3))
    assert read_experiment(folder).trials[0].setup.chambers[0].air_stiffness == 5e3
    own.write_text(chamber.format(0.025, 0.0))
    with pytest.raises(ValueError, match=r"trial\.toml: other names or boxes in \[\[chamber\]\], wanted those of"):
        read_experiment(folder)


def test_a_pressure_without_a_chamber_is_refused(tmp_path):
    folder = experiment(tmp_path)
    (folder / "trials" / "a" / "pressure.csv").write_text("time_s,c_pa\n0,0\n0.1,0\n")
    with pytest.raises(ValueError, match=r"pressure\.csv: a pressure, wanted none"):
        read_experiment(folder)


def test_a_trial_name_in_trials_and_heldout_is_refused(tmp_path):
    folder = experiment(tmp_path)
    shutil.copytree(folder / "trials", folder / "heldout")
    with pytest.raises(ValueError, match="a in both trials and heldout"):
        read_experiment(folder)


def test_no_trial_is_refused(tmp_path):
    folder = experiment(tmp_path)
    (folder / "trials" / "a" / "markers.csv").unlink()
    (folder / "trials" / "a").rmdir()
    with pytest.raises(ValueError, match="no trial"):
        read_experiment(folder)


def test_a_chamber_without_pressure_csv_is_refused(tmp_path):
    chamber = '[[chamber]]\nname = "c"\nbox = [[0.01, 0.005, 0.005], [0.03, 0.015, 0.015]]\n'
    with pytest.raises(ValueError, match=r"no pressure\.csv"):
        read_experiment(experiment(tmp_path, SETUP + chamber))
    (tmp_path / "trials" / "a" / "pressure.csv").write_text("time_s,c_pa\n0,0\n0.1,1000\n")
    assert read_experiment(tmp_path).trials[0].pressure.pressure.tolist() == [[0.0, 1000.0]]


def test_recordings_of_wrong_shape_or_infinite_places_are_refused():
    time = np.array([0.0, 0.1, 0.2])
    with pytest.raises(ValueError, match="wanted \\[T, M, 3\\]"):
        Recording(time=time, position=np.zeros((3, 1, 2)))
    with pytest.raises(ValueError, match="infinite"):
        Recording(time=time, position=np.full((3, 1, 3), math.inf))


def test_columns_keep_their_order_and_empty_cells_are_nan(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("a, b\n1,2\n3,\n")
    found = read_table(path)
    assert list(found) == ["a", "b"] and found["a"].tolist() == [1.0, 3.0] and math.isnan(found["b"][1])
