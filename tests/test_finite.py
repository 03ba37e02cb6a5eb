"""Finite-strain experiments: validation, deformation history from rest, and file reader."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchsoro.rheology.finite import Experiment, read

PULL = {"name": "pull", "mode": "uniaxial", "time": [1.0, 2.0], "deformation": [1.5, 2.0], "stress": [3.0, 4.0]}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mode": "bending"}, r"pull: mode = 'bending', wanted one of uniaxial, equibiaxial, shear"),
        ({"stress": [3.0]}, r"pull: stress of shape \(1,\), wanted \[n\] with n >= 2"),
        ({"stress": [3.0, math.nan]}, r"pull: stress\[1\] is not finite"),
        ({"time": [1.0, 1.0]}, r"pull: time\[1\] = 1 s, wanted times from 0 on that increase"),
        ({"time": [-1.0, 1.0]}, r"pull: time\[0\] = -1 s"),
        ({"deformation": [1.5, 0.0]}, r"pull: deformation\[1\] = 0, wanted a positive stretch"),
    ],
)
def test_experiment_refuses_invalid_arrays_naming_sample(change, message):
    with pytest.raises(ValueError, match="^" + message):
        Experiment(**{**PULL, **change})


def test_experiment_copies_and_freezes_its_arrays():
    stress = np.array([3.0, 4.0])
    test = Experiment(**{**PULL, "stress": stress})
    stress[0] = 99.0
    assert test.stress.tolist() == [3.0, 4.0]
    assert test.rms() == pytest.approx(math.sqrt(12.5))
    with pytest.raises(ValueError, match="read-only"):
        test.stress[0] = 1.0
    shorter = Experiment(**{**PULL, "time": [1, 2, 3], "deformation": [1, 2, 3], "stress": [1, 2, 3]})
    assert shorter.part(np.array([True, False, True])).stress.tolist() == [1.0, 3.0]


@pytest.mark.parametrize(("mode", "value"), [("shear", 9.0), ("uniaxial", 9 + 2 / 3 - 3), ("equibiaxial", 15 + 1 / 81)])
def test_first_invariant_of_incompressible_solid_matches_closed_form(mode, value):
    test = Experiment(**{**PULL, "mode": mode, "deformation": [1.0, 3.0]})
    assert test.invariant.tolist() == pytest.approx([1.0 if mode == "shear" else 0.0, value])


@given(
    ways=st.lists(st.floats(-2, 2), min_size=2, max_size=6),
    first=st.sampled_from([0.0, 0.7]),
    largest=st.floats(0.05, 3),
)
def test_path_starts_at_rest_meets_samples_and_bounds_step_of_deformation(ways, first, largest):
    time = first + np.arange(len(ways))
    test = Experiment(name="", mode="shear", time=time, deformation=ways, stress=np.ones(len(ways)))
    way, steps, at = test.path(largest)
    assert way[at] == pytest.approx(np.array(ways))
    assert (steps > 0).all() and len(steps) == len(way)
    moments = np.cumsum(steps) if first else np.cumsum(steps) - steps[0]
    assert moments[at] == pytest.approx(time)
    before = np.append(0.0, way)[:-1] if first else np.append(way[0], way)[:-1]
    assert np.abs(way - before).max() <= largest * (1 + 1e-6)


# -------------------------------------------------------------------------------------------------------- the reader


def write(folder, text, name="data.csv"):
    path = folder / name
    path.write_text(text, encoding="utf-8-sig")
    return path


def test_tensile_export_with_preamble_and_engineering_strain_is_read_in_si(tmp_path):
    head = "Speed (mm/min);450;;\n;;;\nTime (s);True Strain;Engineering Strain;Engineering Stress (MPa)\n"
    test = read(write(tmp_path, head + "0.5;9;0.25;0.5\n1;9;1;2\n;;;\n\n"), name="silicone")
    assert (test.name, test.mode) == ("silicone", "uniaxial")
    assert test.time.tolist() == [0.5, 1.0]
    assert test.deformation.tolist() == [1.25, 2.0]
    assert test.stress.tolist() == [0.5e6, 2e6]


def test_columns_are_identified_by_name_in_any_order(tmp_path):
    table = "shear_strain,force_N,shear_stress_kPa,time_s\n0.5,7,3,1\n2,7,4,2\n"
    test = read(write(tmp_path, table, "ramp.csv"))
    assert (test.name, test.mode) == ("ramp", "shear")
    assert test.time.tolist() == [1.0, 2.0]
    assert test.deformation.tolist() == [0.5, 2.0]
    assert test.stress.tolist() == [3e3, 4e3]


def test_time_at_given_rate_is_path_length_over_rate_on_loading_and_unloading(tmp_path):
    table = write(tmp_path, "time_s,stretch,nominal_stress_kPa\n0,1,0\n9,1.5,1\n8,1.2,1\n")
    assert read(table, rate=0.1).time == pytest.approx([0.0, 5.0, 8.0])
    sheared = write(tmp_path, "time_s,shear_strain,shear_stress_kPa\n0,0.5,0\n9,-0.5,1\n")
    assert read(sheared, rate=0.5).time == pytest.approx([1.0, 3.0])
    with pytest.raises(ValueError, match=r"^rate = 0: wanted finite and positive, in 1/s"):
        read(sheared, rate=0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time_s,stretch\n0,1\n", "no line names columns of time, deformation and stress, wanted time_s or time"),
        ("", "no line names columns"),
        (
            "time_s,stretch,shear_stress_kPa\n0,1,0\n",
            "line 1: stretch and shear_stress_kpa, wanted both of one kind of test",
        ),
        (
            "time_s,stretch,nominal_stress_kPa\n0,1,0\n1,x,1\n",
            "line 3: '1,x,1', wanted numbers as the header says",
        ),
        ("time_s,stretch,nominal_stress_kPa\n0,1\n", "line 2: '0,1', wanted numbers"),
    ],
)
def test_invalid_file_is_refused_naming_line(tmp_path, text, message):
    with pytest.raises(ValueError, match=r"data\.csv: " + message):
        read(write(tmp_path, text))


def test_empty_table_and_decreasing_times_are_refused(tmp_path):
    head = "time_s,stretch,nominal_stress_kPa\n"
    with pytest.raises(ValueError, match=r"data: time of shape \(0,\)"):
        read(write(tmp_path, head))
    with pytest.raises(ValueError, match=r"data: time\[2\] = 40\.1 s, wanted times from 0 on that increase"):
        read(write(tmp_path, head + "40.8,1.1,1\n40.9,1.2,2\n40.10,1.3,3\n"))
