"""The paper's checks on a tiny robot: rows and motions as documented, what is not repeated, and finer lattices."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from tiny import TINY

from torchsoro.design.objective import center_of_gravity
from torchsoro.design.robot import walker
from torchsoro.errors import SimulationDiverged
from torchsoro.output import comparison
from torchsoro.output.archive import load_design, load_shape

CHOSEN = ("design", "double_modulus", "half_cell", "iteration_0")
NUMBERS = {"L", "stride", "speed", "fall", "dt", "seconds"}
PERIOD = 1 / TINY.frequency
LONG = 2.5 * PERIOD


@pytest.fixture(scope="module")
def compare() -> ModuleType:
    return comparison


def check(compare: ModuleType, robot: Path, out: Path, *only: str, **changes: Any) -> dict[str, dict[str, Any]]:
    return compare.compare(str(robot), out, only=only, device="cpu", **changes)


@pytest.fixture(scope="module")
def compared(compare, straight, tmp_path_factory) -> tuple[Path, dict[str, dict[str, Any]]]:
    """The folder of the results on the tiny run, and the rows."""
    out = tmp_path_factory.mktemp("compare") / "straight"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compare, "LONG", LONG)
        return out, check(compare, straight[0], out, *CHOSEN)


def test_the_rows_are_written_as_they_are_returned(compared, straight):
    out, rows = compared
    held = json.loads((out / "compare.json").read_text())
    assert held == {"robot": "walker", "rows": [{"check": name, **rows[name]} for name in CHOSEN]}
    motions = {f"motion_{name}.npz" for name in ("design", "iteration_0")}
    copies = {"settings.json", "metrics.csv", "design.npz"}
    assert {file.name for file in out.iterdir()} == {"compare.json", *motions, *copies}
    for name in copies:
        assert (out / name).read_bytes() == (straight[0] / name).read_bytes()
    for name, row in rows.items():
        assert set(row) == {"title", "time", "cog", *NUMBERS}, name
        assert np.isfinite([row[number] for number in NUMBERS]).all()
        duration = LONG if name == "design" else TINY.duration
        assert len(row["time"]) == round((TINY.settle + duration) / TINY.sample_every) + 1
        assert row["time"][-1] == pytest.approx(TINY.settle + duration)
        assert np.array(row["cog"]).shape == (len(row["time"]), 3)


def test_the_numbers_are_those_of_the_path(compared, straight):
    rows, result = compared[1], straight[1]
    # In the total form the larger box changes nothing, nor does what comes after.
    assert rows["design"]["L"] == pytest.approx(result["L"], rel=1e-5)
    for name, row in rows.items():
        time, x = np.array(row["time"]), np.array(row["cog"])[:, 0]
        begin, end, two = np.interp(TINY.settle + PERIOD * np.array([0, 1, 2]), time, x)
        assert row["L"] == pytest.approx(end - begin, abs=2e-7)
        mean = (two - begin) / 2 if name == "design" else end - begin
        assert row["stride"] == pytest.approx(mean, abs=2e-7)
        assert row["speed"] == pytest.approx(row["stride"] / PERIOD)
    assert len({round(row["L"], 6) for row in rows.values()}) == len(rows)


def test_what_is_stiffer_or_finer_gets_a_step_of_its_own(compared):
    steps = {name: row["dt"] for name, row in compared[1].items()}
    assert steps["design"] == steps["iteration_0"] == TINY.dt
    assert steps["half_cell"] == pytest.approx(steps["double_modulus"] / 2**0.5, rel=0.2)
    assert steps["double_modulus"] < walker(dataclasses.replace(TINY, dt="auto"))(torch.ones(512), void=False).dt


def test_a_motion_holds_the_frames_that_pages_draw(compared, straight):
    out, rows = compared
    domain = walker(TINY).domain
    end = TINY.settle + TINY.duration
    eighths = TINY.settle + PERIOD * np.append(np.arange(9) / 8, 2)
    designs = load_design(straight[0] / "design.npz", domain), load_shape(straight[0], domain, 0)
    for name, times, design in (("design", eighths, designs[0]), ("iteration_0", np.array([end]), designs[1])):
        motion = np.load(out / f"motion_{name}.npz")
        assert motion["displacement"].dtype == motion["gamma"].dtype == np.float16
        assert np.abs(motion["time"] - times).max() <= TINY.sample_every / 2 + 1e-6
        assert motion["displacement"].shape == (len(times), domain.count, 3)
        assert np.array_equal(motion["gamma"], design.half().numpy())
        # Of the same motion as the row: the centre of gravity of the frames is that of the path, to half precision.
        place = domain.positions + 1e-3 * torch.from_numpy(motion["displacement"]).double()
        weight = torch.where(domain.design, design.double() ** 3 + TINY.epsilon, 0.0)
        course = np.array([np.interp(motion["time"], rows[name]["time"], c) for c in np.array(rows[name]["cog"]).T]).T
        torch.testing.assert_close(center_of_gravity(place, weight), torch.from_numpy(course), rtol=0, atol=1e-5)
    pressure = np.load(out / "motion_design.npz")["pressure"]
    assert pressure[0] == 0 and 0.7 * TINY.pressure < pressure.max() < TINY.pressure


def test_what_is_there_is_not_repeated_and_one_that_breaks_down_is_a_row(
    compared, compare, straight, tmp_path, monkeypatch
):
    out, rows = compared
    shutil.copytree(out, tmp_path / "again")
    error = SimulationDiverged(step=3, time=1e-3, particle=5, quantity="J <= 0", remedy="a smaller step")

    def perform(folder: Path, base: Any, wanted: Any, stage: str) -> Any:
        assert wanted.title == "five Maxwell elements"
        raise error

    monkeypatch.setattr(compare, "perform", perform)
    again = check(compare, straight[0], tmp_path / "again", *CHOSEN, "five_elements")
    assert again == {**rows, "five_elements": {"title": "five Maxwell elements", "error": str(error)}}
    assert check(compare, straight[0], tmp_path / "again", "five_elements") == again


def test_checks_and_robots_that_do_not_exist_are_refused_before_any_work(compare, straight, tmp_path):
    with pytest.raises(ValueError, match=r"only = iteration_5, slower: wanted some of design, .*, iteration_0, iter"):
        check(compare, straight[0], tmp_path / "out", "design", "slower", "iteration_5", iterations=(0, 10))
    with pytest.raises(ValueError, match=r"wanted .* a finished run's folder"):
        check(compare, tmp_path, tmp_path / "out")
    with pytest.raises(ValueError, match=r"iterations = \[10\]: wanted some of those that .* has kept: 0$"):
        check(compare, straight[0], tmp_path / "out", iterations=(0, 10))
    assert not (tmp_path / "out").exists()
    with pytest.raises(ValueError, match=r"only = iteration_10: wanted some of .*, iteration_0$"):
        check(compare, straight[0], tmp_path / "out", "iteration_10")


def test_a_walker_is_sent_up_other_slopes_than_its_own(compare):
    def slopes(**changes: Any) -> list[float]:
        known = compare.checks(dataclasses.replace(TINY, **changes), (0, 3))
        assert {"iteration_0", "iteration_3"} < set(known)
        return [c.changes["slope"] for c in known.values() if "slope" in c.changes]

    assert slopes() == [0.1, 0.2, 0.3]
    assert slopes(slope=0.3) == [0.0, 0.1, 0.2]
    assert slopes(robot="climber") == []


def test_what_a_file_gives_is_not_checked_by_a_setting(compare, tmp_path):
    for name in ("pressure.csv", "material.toml"):
        (tmp_path / name).touch()
    plain = compare.checks(TINY, ())
    measured = compare.checks(dataclasses.replace(TINY, pressure_file=tmp_path / "pressure.csv"), ())
    assert plain.keys() - measured.keys() == {"double_modulus_and_pressure", "50_kPa", "3_Hz"}
    assert any(check.long for check in plain.values()) and not any(check.long for check in measured.values())
    fitted = compare.checks(dataclasses.replace(TINY, material=tmp_path / "material.toml"), ())
    assert plain.keys() - fitted.keys() == {"double_modulus", "double_modulus_and_pressure", "five_elements"}


@pytest.mark.parametrize("times", [1, 2, 3])
def test_a_finer_density_keeps_constant_and_linear_fields(times, compare):
    shape = (4, 5, 6)
    places = torch.meshgrid(*((torch.arange(n) + 0.5) / n for n in shape), indexing="ij")
    finer = torch.meshgrid(*((torch.arange(times * n) + 0.5) / (times * n) for n in shape), indexing="ij")
    field, wanted = (0.1 + 0.2 * x + 0.3 * y + 0.4 * z for x, y, z in (places, finer))
    found = compare.finer(field.flatten(), shape, times).view(wanted.shape)
    inner = (slice(times // 2, -(times // 2) or None),) * 3
    torch.testing.assert_close(found[inner], wanted[inner], rtol=0, atol=1e-6)
    constant = compare.finer(torch.full((120,), 0.37), shape, times)
    torch.testing.assert_close(constant, torch.full((120 * times**3,), 0.37), rtol=1e-6, atol=0)
