"""Validation recipe of finite-strain fits, with and without the published recordings."""

import importlib
from pathlib import Path

import numpy as np
import pytest
from published import RECORDINGS, recordings

from torchsoro.rheology.finite import Experiment


@pytest.fixture(scope="module")
def checks():
    return importlib.import_module("finite_checks")


def folder(checks, name):
    path = Path(RECORDINGS or "") / name
    if not path.is_dir():
        pytest.skip(f"there is no folder {path}")
    return path


def test_absent_recording_folders_are_skipped(checks, tmp_path, capsys):
    checks.main(tmp_path)
    said = capsys.readouterr().out
    assert said.count("skipped") == 3
    assert str(tmp_path / "silicone-tensile-tests") in said


def test_strain_rate_from_file_head_and_refusal_without_gauge_length(checks, tmp_path):
    path = tmp_path / "pull.csv"
    path.write_text("Speed (mm/min);450;;\nLength (mm);33;;\n")
    assert checks.pull_rate(path) == pytest.approx(450 / 33 / 60)
    path.write_text("Speed (mm/min);450;;\n")
    with pytest.raises(ValueError, match=r"pull\.csv: no line Length \(mm\), wanted the number after it"):
        checks.pull_rate(path)


def test_test_is_truncated_at_first_sample_above_strain_limit(checks):
    numbers = np.array([1.0, 2.0, 3.0, 1.0])
    test = Experiment(name="", mode="shear", time=np.arange(4.0), deformation=numbers, stress=numbers)
    assert checks.until(test, 3.0).stress.tolist() == [1.0, 2.0, 3.0, 1.0]
    assert checks.until(test, 2.5).stress.tolist() == [1.0, 2.0]


@recordings
def test_recorded_times_and_strain_rates_match_file_names(checks):
    base = folder(checks, "viscoelastic-shear-and-tension")
    for rate, tests in checks.tension(base).items():
        for test in tests:  # the way over the rate
            way = np.cumsum(np.abs(np.diff(test.deformation, prepend=1.0)))
            assert test.time * rate == pytest.approx(way, abs=0.02 * way[-1]), test.name
    for rate, (test,) in checks.stepped(base).items():
        speed = 60 * np.abs(np.diff(test.deformation) / np.diff(test.time))
        assert np.median(speed[speed > rate / 2]) == pytest.approx(rate, rel=0.01)
    for rate, (test,) in checks.monotonic(base, clock=True).items():
        even = test.deformation / np.sqrt(1 + test.deformation**2 / 4)
        assert even[-1] / test.time[-1] == pytest.approx(rate, rel=0.03)
        assert checks._speed(test)[1] > 20 * rate  # not an even rate of shear


@pytest.mark.slow
@recordings
def test_viscous_law_halves_prediction_error_at_held_out_rates(checks):
    base = folder(checks, "viscoelastic-shear-and-tension")
    row = checks.split(checks.tension(base), [0.03], elements=1)
    assert row["tests"] == "8, 2"
    assert row["elements"] == 1
    assert row["prediction, elastic [%]"] > 2 * row["prediction, viscous [%]"]
    tests = checks._until(checks.stepped(base), checks.MODERATE + 0.02)
    row = checks.split(tests, [2, 6], specimens=True)
    assert row["prediction, elastic [%]"] > 3 * row["prediction, viscous [%]"]


@pytest.mark.slow
@recordings
def test_yeoh_error_below_5_percent_for_all_17_silicones(checks):
    rows = checks.silicones(folder(checks, "silicone-tensile-tests"))
    assert len(rows) == 3 * 17
    assert len({row["material"] for row in rows}) == 17
    assert {row["left out"] for row in rows} == {0, 1, 3}
    for neo, _, yeoh in zip(*(rows[k::3] for k in range(3)), strict=True):
        assert yeoh["error [%]"] < 5 < neo["error [%]"]
        assert yeoh["fitted to 2 [%]"] < 7
