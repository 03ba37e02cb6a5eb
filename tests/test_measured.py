"""Validation of measured curves, and the reader of text tables and workbooks."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from published import RECORDINGS, recordings

from torchsoro.rheology.measured import Creep, Relaxation, Sweep, read

SWEEP = {"omega": [1.0, 2.0], "storage": [3.0, 4.0], "loss": [0.0, 1.0], "temperature": 20.0, "deformation": "shear"}


def write(folder, text, name="data.csv", encoding="utf-8"):
    path = folder / name
    path.write_bytes(text.encode(encoding))
    return path


# ------------------------------------------------------------------------------------------------------- the curves


def test_curve_copies_and_freezes_its_arrays():
    omega = np.array([1.0, 2.0])
    sweep = Sweep(**{**SWEEP, "omega": omega, "temperature": math.nan})
    omega[0] = 99.0
    assert sweep.omega.tolist() == [1.0, 2.0]
    with pytest.raises(ValueError, match="read-only"):
        sweep.storage[0] = 1.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"omega": [2.0, 1.0]}, r"omega\[1\] = 1 after 2: wanted increasing, without duplicates"),
        ({"omega": [1.0, 1.0]}, r"omega\[1\] = 1 after 1"),
        ({"omega": [0.0, 1.0]}, r"omega\[0\] = 0: wanted finite and more than 0"),
        ({"storage": [3.0, math.nan]}, r"storage\[1\] = nan: wanted finite and more than 0"),
        ({"storage": [0.0, 1.0]}, r"storage\[0\] = 0: wanted finite and more than 0"),
        ({"loss": [1.0, -1.0]}, r"loss\[1\] = -1: wanted finite and 0 or more"),
        ({"loss": [1.0]}, "loss: 1 values, wanted 2, one for each of omega"),
        ({"storage": [[3.0, 4.0]]}, r"storage: shape \(1, 2\), wanted \[n\]"),
        ({"omega": []}, r"omega: shape \(0,\)"),
        ({"deformation": "bending"}, 'deformation = \'bending\': wanted "tension" or "shear"'),
        ({"temperature": -300.0}, "temperature = -300.0: wanted deg C above -273.15"),
    ],
)
def test_curve_refuses_invalid_arrays_naming_attribute_and_index(change, message):
    with pytest.raises(ValueError, match=message):
        Sweep(**{**SWEEP, **change})


# --------------------------------------------------------------------------------------------------------- the table

MODULI = {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9}
HEADERS = [("E'", "E''"), ("E_stor", "E_loss"), ("E storage", "E loss"), ("E'", 'E"'), ("E_storage", "E_loss")]


@given(
    delimiter=st.sampled_from([",", ";", "\t"]),
    header=st.sampled_from(HEADERS),
    modulus=st.sampled_from(sorted(MODULI)),
    frequency=st.sampled_from([("f", "Hz"), ("omega", "rad/s"), ("Freq.", None), ("freq", "kHz")]),
    kelvin=st.booleans(),
    units=st.sampled_from(["row", "brackets", "suffix"]),
    seed=st.integers(0, 2**32 - 1),
)
def test_table_read_in_si_units_for_any_delimiter_header_and_unit(
    tmp_path_factory, delimiter, header, modulus, frequency, kelvin, units, seed
):
    rng = np.random.default_rng(seed)
    name, spelled = frequency
    if spelled is None:
        name, spelled = "Frequency", "Hz"
    factor = {"Hz": 2 * math.pi, "kHz": 2e3 * math.pi, "rad/s": 1.0}[spelled]
    names, marks = [name, *header, "T"], [spelled, modulus, modulus, "K" if kelvin else "°C"]
    if units == "row":
        head = [delimiter.join(names), delimiter.join(marks)]
    elif units == "brackets":
        head = [delimiter.join(f"{n} [{m}]" for n, m in zip(names, marks, strict=True))]
    else:
        plain = [m.replace("/", "_per_").replace("°", "") for m in marks]
        head = [delimiter.join(f"{n}_{m}" for n, m in zip(names, plain, strict=True))]
    x, temperatures = np.geomspace(0.1, 10, 5), [-20.0, 0.0, 35.0]
    wanted = {t: (rng.uniform(1, 9, 5), rng.uniform(0, 1, 5)) for t in temperatures}
    rows = [
        (x[i], wanted[t][0][i], wanted[t][1][i], t + 273.15 * kelvin + rng.uniform(-0.2, 0.2))
        for t in temperatures
        for i in range(5)
    ]
    rng.shuffle(rows)
    lines = ["made by hand", *head, *(delimiter.join(f"{v:.12g}" for v in row) for row in rows), ""]
    curves = read(write(tmp_path_factory.mktemp("t"), "\n".join(lines)))
    assert [type(c) for c in curves] == [Sweep] * 3
    for t, curve in zip(temperatures, curves, strict=True):
        assert curve.deformation == "tension"
        assert curve.temperature == pytest.approx(t, abs=0.2)
        np.testing.assert_allclose(curve.omega, x * factor, rtol=1e-9)
        np.testing.assert_allclose(curve.storage, wanted[t][0] * MODULI[modulus], rtol=1e-9)
        np.testing.assert_allclose(curve.loss, wanted[t][1] * MODULI[modulus], rtol=1e-9)


def test_time_columns_give_relaxation_and_creep_in_si_units(tmp_path):
    (relaxation,) = read(write(tmp_path, "t,E_relax\nms,MPa\n1,3\n10,2\n"))
    assert isinstance(relaxation, Relaxation)
    assert relaxation.time.tolist() == [1e-3, 1e-2]
    assert relaxation.modulus.tolist() == [3e6, 2e6]
    assert math.isnan(relaxation.temperature)
    (creep,) = read(write(tmp_path, "time_min,J_cm2_per_dyn\n1,3\n10,4\n"), deformation="shear", temperature=25.0)
    assert isinstance(creep, Creep)
    assert creep.time.tolist() == [60.0, 600.0]
    assert creep.compliance == pytest.approx([30.0, 40.0])  # 1 cm2/dyn = 1e-4 m2 / 1e-5 N
    assert (creep.temperature, creep.deformation) == (25.0, "shear")


def test_rheometer_export_with_metadata_tabs_and_latin_1_is_read(tmp_path):
    # Metadata first, tabs in the header only, a degree sign in one byte, a column twice, a comment, blank lines.
    text = "T=-10;chem=PI;\nFreq\tG'\tG\"\tTemp\tPhase\tTemp\nrad/s\tPa\tPa\t\xb0C\t\xb0\t\xb0C\n"
    path = write(
        tmp_path,
        text + "  31.6   3.9E5   42907  -10.006  6.2\n\n# note\n  21.5   3.8E5   40225  -9.99  6\n",
        encoding="latin-1",
    )
    (sweep,) = read(path)
    assert sweep.deformation == "shear"
    assert sweep.omega.tolist() == [21.5, 31.6]
    assert sweep.loss.tolist() == [40225.0, 42907.0]
    assert sweep.temperature == pytest.approx(-9.998)


def test_decimal_comma_is_read_in_semicolon_table(tmp_path):
    (sweep,) = read(write(tmp_path, "f / Hz;E' / MPa;E'' / MPa\n0,5;1,25;0,5\n1,5;2;1\n", encoding="utf-16"))
    assert sweep.omega == pytest.approx([math.pi, 3 * math.pi])
    assert sweep.storage.tolist() == [1.25e6, 2e6]


def test_table_without_header_is_read_by_column_numbers(tmp_path):
    path = write(tmp_path, "nothing to see\n1 10 2\n2 11 3\n", name="data.txt")
    units = {"frequency": "rad/s", "storage": "Pa", "loss": "Pa"}
    columns = {"frequency": 0, "storage": 1, "loss": 2}
    (sweep,) = read(path, columns=columns, units=units, deformation="tension")
    assert (sweep.omega.tolist(), sweep.loss.tolist()) == ([1.0, 2.0], [2.0, 3.0])


def test_label_and_nominal_temperature_split_rows_into_curves(tmp_path):
    # A label splits two runs of one temperature, the nominal temperature splits what the measured one blurs.
    head = "run,T_nominal_C,T_measured_C,f_Hz,E'_Pa,E''_Pa\n"
    rows = ["a,0,0.7,1,5,1", "a,0,-0.6,2,6,1", "b,0,0.1,1,7,1", "b,0,0.1,2,8,1", "a,1,1.1,1,9,1", "a,1,0.8,2,9,1"]
    curves = read(write(tmp_path, head + "\n".join(rows)))
    assert [round(c.temperature, 6) for c in curves] == [0.05, 0.1, 0.95]
    assert [c.storage.tolist() for c in curves] == [[5.0, 6.0], [7.0, 8.0], [9.0, 9.0]]
    # One label over all temperatures splits nothing; then the temperature does.
    rows = [f"x,{t},{f},{t + f},1" for f in (1, 2) for t in (10, 20, 30)]
    curves = read(write(tmp_path, "set,T_C,f_Hz,E'_Pa,E''_Pa\n" + "\n".join(rows)))
    assert [c.temperature for c in curves] == [10.0, 20.0, 30.0]


GOOD = "f,E',E'',T\nHz,MPa,MPa,C\n1,5,1,20\n2,6,1,20\n"


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        (("Hz,MPa,MPa,C\n", ""), {}, r"data.csv, line 1, column 'f' \(frequency\): no unit, wanted one of 'Hz'"),
        (("Hz", "rpm"), {}, r"unit 'rpm', wanted one of 'Hz', 'kHz', 'rad/s'. Declare it, for example units=\{"),
        (("2,6", "2,six"), {}, r"data.csv, line 4, column \"E'\" \(storage\): 'six', wanted a finite number"),
        (("2,6", "2,-6"), {}, "line 4, .*'-6', wanted a finite number more than 0"),
        (("2,6", "2,nan"), {}, "line 4, .*'nan', wanted a finite number more than 0"),
        (("2,6", "1,6"), {}, "lines 3 and 4: omega 6.28319 twice in one curve.*columns="),
        (("2,6,1,20", "2,6,1"), {}, "line 4: 3 columns, wanted at least 4, for 'T'"),
        (("2,6,1,20", "2,6,1,23"), {"scatter": 4.0}, "3 K between the rows of one curve.*wanted at most 2 K"),
        (("E''", "tan"), {}, r"line 1: recognised frequency \('f'\), .* wanted frequency, storage and loss, or"),
        (("T\nHz,MPa,MPa,C", "w\nHz,MPa,MPa,Hz"), {}, "or 'w'. Choose one, for example columns="),
        (
            ("f,E',E'',T", "a,b,c,T"),
            {},
            r"data.csv: no header row names quantities; the first rows are: a,b,c,T; Hz",
        ),
        (("f,E',E'',T", "Strain,Stress,c,T"), {}, "data.csv: stress and strain .* stress over strain"),
        (("E',E''", "Stress,t"), {"columns": {"time": "f", "modulus": "Stress"}}, "a stress, wanted a modulus: divide"),
        (("E',E''", "stor_mod,loss_mod"), {}, 'tension or shear. Declare it, for example deformation="shear"'),
        (("1,5,1,20\n2,6,1,20\n", ""), {}, "data.csv, line 3: no rows of data"),
        (("", ""), {"temperature": 20.0}, r"column 'T' \(temperature\) holds temperatures already"),
        (("", ""), {"columns": {"storage": "E_1"}}, "no header row names quantities with the columns"),
        (("", ""), {"columns": {"stiffness": "E'"}}, "columns: 'stiffness', wanted some of 'frequency'"),
        (("", ""), {"columns": {"storage": 4}}, "columns: 'storage' in column 4, but .* has 4, counted from 0"),
        (("", ""), {"units": {"storage": "bar"}}, "units: 'bar' for 'storage', wanted one of Pa, kPa"),
        (("", ""), {"deformation": "bending"}, "deformation = 'bending'"),
        (("", ""), {"sheet": "one"}, "sheet = 'one': .* is text"),
    ],
)
def test_invalid_table_is_refused_naming_line_and_column(tmp_path, change, options, message):
    with pytest.raises(ValueError, match=message):
        read(write(tmp_path, GOOD.replace(*change)), **options)


def test_declared_units_and_columns_override_header(tmp_path):
    path = write(
        tmp_path, GOOD.replace("f,", "f,Gp,").replace("Hz,", "Hz,-,").replace("1,5", "1,7,5").replace("2,6", "2,8,6")
    )
    (sweep,) = read(
        path, columns={"storage": "Gp"}, units={"storage": "kPa", "frequency": "rad/s"}, deformation="shear"
    )
    assert (sweep.omega.tolist(), sweep.storage.tolist()) == ([1.0, 2.0], [7e3, 8e3])


def test_workbook_without_calamine_and_missing_file_raise(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "python_calamine", None)
    with pytest.raises(ModuleNotFoundError, match=r"torchsoro\[excel\]"):
        read(write(tmp_path, "x", name="data.xls"))
    with pytest.raises(FileNotFoundError, match="no such file"):
        read(tmp_path / "none.xls")


# -------------------------------------------------------------------------------------------------------- recordings


@recordings
@pytest.mark.parametrize(
    ("file", "options", "kind", "points", "ends"),
    [
        ("dma-nrel-polymer/freq_user_raw.csv", {}, Sweep, [10] * 21, (-49.91, 99.99)),
        ("dma-nrel-polymer/freq_user_master.csv", {"temperature": -5.0}, Sweep, [206], (-5, -5)),
        ("dma-nrel-polymer/time_user_master.csv", {"temperature": 0.0}, Relaxation, [481], (0, 0)),
        (
            "rheology-polyisoprene-tts/PI_226k_sweeps.csv",
            {},
            Sweep,
            [15, 22, 22, 17, 22, 22, 22, 16, 19, 21, 20, 18],
            (-45, 50),
        ),
        ("rheology-polyisoprene-tts/PI_635k_sweeps.csv", {}, Sweep, [19, 16, 16, 16, 16, 17, 22, 16, 21], (-40, 100)),
        ("rheology-polyisoprene-tts/original_osc/PI223k-14_10C_FS_PP10.osc", {}, Sweep, [22], (10, 10)),
        ("dma-shaker-rubber/material_a/dma/tf_015p.csv", {}, Sweep, [14, 14, *[15] * 4, 22, 22, 22], (-9.99, 45.97)),
        (
            "creep-polystyrene-plazek/plazek_long.csv",
            {"deformation": "shear"},
            Creep,
            [41, 50, 48, 46, 50, 41, 31, 30, 45, 22],
            (97, 144.9),
        ),
    ],
)
def test_published_recordings_give_expected_curves_points_and_range(file, options, kind, points, ends):
    curves = read(Path(RECORDINGS) / file, **options)
    assert {type(c) for c in curves} == {kind}
    assert [len(getattr(c, kind.axis)) for c in curves] == points
    assert (curves[0].temperature, curves[-1].temperature) == pytest.approx(ends, abs=0.01)


@recordings
def test_instrument_workbook_equals_published_csv():
    pytest.importorskip("python_calamine", reason="reads workbooks")
    folder = Path(RECORDINGS) / "dma-nrel-polymer"
    for a, b in zip(read(folder / "freq_Eplexor_raw.xls"), read(folder / "freq_user_raw.csv"), strict=True):
        np.testing.assert_allclose(a.storage, b.storage, rtol=1e-6)
        np.testing.assert_allclose(a.omega, b.omega, rtol=1e-6)


@recordings
def test_single_sweep_files_equal_combined_table():
    folder = Path(RECORDINGS) / "rheology-polyisoprene-tts"
    units = {"frequency": "rad/s", "storage": "Pa", "loss": "Pa", "temperature": "C"}  # some files do not say
    single = [read(path, units=units)[0] for path in sorted((folder / "original_osc").glob("PI600k*"))]
    together = read(folder / "PI_635k_sweeps.csv")
    for a, b in zip(sorted(single, key=lambda c: c.temperature), together, strict=True):
        np.testing.assert_allclose(a.storage, b.storage, rtol=1e-9)
        assert a.temperature == pytest.approx(b.temperature, abs=1e-6)
