"""Design runs whose chambers move: parameters, checkpoints, rounding at the end, and what reads a finished run."""

from __future__ import annotations

import csv
import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tiny import tiny

from torchsoro.design import loop
from torchsoro.design.loop import optimize
from torchsoro.design.placement import DESIGNED
from torchsoro.design.reading import CHAMBERS, read_settings
from torchsoro.design.robot import Robot, build, walker
from torchsoro.design.rounding import changes, rounded, rounding_line
from torchsoro.design.settings import Settings
from torchsoro.design.starts import optimize_starts
from torchsoro.errors import SimulationDiverged
from torchsoro.output.archive import find, load_design, load_resampled
from torchsoro.output.comparison import compare
from torchsoro.output.delivery import design

MOVING: dict[str, Any] = {"chamber_design": DESIGNED, "chamber_rate": 0.1, "duration": 0.04}


def table(folder: Path) -> list[dict[str, str]]:
    with (folder / "metrics.csv").open() as file:
        return list(csv.DictReader(file))


def moving(out: Path, **changes: Any) -> Settings:
    return tiny(out, **{**MOVING, **changes})


def test_place_and_size_move_with_the_body_and_the_loss_falls(tmp_path):
    # The body stays nearly as it is, so that the travel is the chambers' doing.
    how: dict[str, Any] = {"iterations": 8, "learning_rate": 1e-6, "clip": 0.0, "friction": 0.5, "chamber_rate": 0.05}
    settings = moving(tmp_path / "run", **how)
    robot = walker(settings)
    assert robot.placement is not None
    with torch.no_grad():
        # Denser in front than behind, or the body would have no direction.
        front = robot.domain.lattice(robot.domain.positions[:, 0] > 0)
        robot.field.phi.copy_(torch.where(front, 0.3, 0.15))
        robot.placement.size += 0.3 * robot.domain.spacing
    optimize(robot)
    rows = table(settings.out)
    travels = [float(row["objective/L"]) for row in rows]
    assert travels[-1] > travels[0] + 2e-5 and travels[-1] == max(travels)
    for name in ("center_x_1", "center_z_1", "size_x_1", "size_y_1", "size_z_1"):
        assert float(rows[-1][f"chamber/{name}"]) != float(rows[0][f"chamber/{name}"]), name
    assert {float(row["chamber/center_y_1"]) for row in rows} == {0.0}
    assert all(float(row["grad_norm/chamber"]) > 0 for row in rows)


def test_a_fixed_volume_stays_and_edges_keep_their_bounds(tmp_path):
    settings = moving(tmp_path / "run", iterations=4, chamber_volume="fixed", chamber_edges=(0.015, 0.019))
    optimize(walker(settings))
    rows = table(settings.out)
    volumes = [float(row["chamber/volume"]) for row in rows]
    assert volumes == pytest.approx([volumes[0]] * len(rows), rel=1e-9)
    edges = [float(row[f"chamber/size_{axis}_1"]) for row in rows for axis in "xyz"]
    assert min(edges) >= 0.015 and max(edges) <= 0.019 and len(set(edges)) > 3


def test_a_narrow_port_leaves_a_designed_chamber_its_layer_of_air(tmp_path):
    robot = walker(moving(tmp_path, port=1e-3))
    assert robot.placement is not None and robot.domain.spacing > 1e-3
    least = robot.settings.wall * 2 + robot.domain.spacing
    assert robot.placement.least == pytest.approx(torch.full((1, 3), least, dtype=torch.float64))


def test_a_resumed_run_keeps_the_chambers_to_the_bit(tmp_path):
    settings = moving(tmp_path / "whole", iterations=4)
    whole = walker(settings)
    one = optimize(whole)
    cut = dataclasses.replace(settings, out=tmp_path / "cut", iterations=2)
    optimize(walker(cut))
    resumed = walker(dataclasses.replace(cut, iterations=4, resume=True))
    other = optimize(resumed)
    assert torch.equal(one.gamma, other.gamma)
    assert whole.placement is not None and resumed.placement is not None
    for name, value in whole.placement.named_parameters():
        assert torch.equal(value, getattr(resumed.placement, name)), name
    for row, again in zip(table(tmp_path / "whole"), table(tmp_path / "cut"), strict=True):
        assert all(row[c] == again[c] for c in row if not c.startswith("time/"))
    checkpoint = torch.load(tmp_path / "cut" / "checkpoint.pt", weights_only=True)
    checkpoint["items"]["placement"]["size"] = torch.zeros(2, 3, dtype=torch.float64)
    torch.save(checkpoint, tmp_path / "cut" / "checkpoint.pt")
    with pytest.raises(ValueError, match=r"does not fit the run \(a design of shape \(2, 3\), wanted \(1, 3\)"):
        optimize(walker(dataclasses.replace(cut, iterations=6, resume=True)))
    del checkpoint["items"]["placement"]
    torch.save(checkpoint, tmp_path / "cut" / "checkpoint.pt")
    with pytest.raises(ValueError, match=r"checkpoint.pt lacks placement, wanted the state of a design run"):
        optimize(walker(dataclasses.replace(cut, iterations=6, resume=True)))


@pytest.mark.slow
@pytest.mark.parametrize("among", [{}, {"scenarios": 3, "fresh": True, "dt": "auto"}])
def test_chambers_may_settle_on_the_way_and_the_body_goes_on(tmp_path, among):
    how: dict[str, Any] = {"iterations": 6, "chamber_until": 3, "chamber_rate": 0.3, "chamber_volume": "fixed", **among}
    settings = moving(tmp_path / "whole", **how)
    whole = walker(settings)
    one = optimize(whole)
    assert whole.placement is not None and not whole.placement.designed()
    assert one.iteration is not None and one.iteration >= 3
    rows = table(settings.out)
    h = whole.domain.spacing
    for row in rows[3:]:
        faces = [float(row[f"chamber/{n}_{a}_1"]) / h / (1 + (n == "size")) for a in "xyz" for n in ("center", "size")]
        assert all(abs(2 * face - round(2 * face)) < 1e-9 for face in faces)
        assert float(row["grad_norm/chamber"]) == 0
    assert float(rows[0]["chamber/center_x_1"]) != float(rows[2]["chamber/center_x_1"])
    assert rows[2]["chamber/L_rounded"] == "" != rows[3]["chamber/L_rounded"]
    assert rows[3]["chamber/L_unrounded"] != rows[3]["chamber/L_rounded"]
    # The rounded robot is the same.
    sharp = rounded(whole)
    assert torch.equal(sharp.density(), whole.density()) and torch.equal(sharp.density().detach(), one.gamma)
    # Resumed after the chambers have settled, to the bit.
    cut = dataclasses.replace(settings, out=tmp_path / "cut", iterations=4)
    optimize(walker(cut))
    resumed = walker(dataclasses.replace(cut, iterations=6, resume=True))
    assert torch.equal(optimize(resumed).gamma, one.gamma)
    for row, again in zip(rows, table(tmp_path / "cut"), strict=True):
        assert all(row[c] == again[c] for c in row if not c.startswith("time/"))


def test_amended_rates_and_a_late_settling_take_effect(tmp_path):
    settings = moving(tmp_path / "run", iterations=2)
    optimize(walker(settings))
    amended = dataclasses.replace(
        settings, resume=True, amend=True, iterations=4, chamber_rate=0.0001, learning_rate=0.5, chamber_until=1
    )
    robot = walker(amended)
    optimize(robot)
    assert robot.placement is not None and bool(robot.placement.settled)
    groups = torch.load(settings.out / "checkpoint.pt", weights_only=True)["items"]["adam"]["param_groups"]
    assert [group["lr"] for group in groups] == [0.5, 0.0001 * robot.domain.spacing]


def test_an_unrounded_gait_that_breaks_down_costs_only_its_numbers(monkeypatch):
    robot = walker(moving(Path("unused")))

    def broken(self: Robot, gamma: torch.Tensor, **_: Any) -> None:
        raise SimulationDiverged(step=1, time=0.1, particle=2, quantity="J <= 0", remedy="a smaller step")

    monkeypatch.setattr(Robot, "forward", broken)
    found = changes(robot, rounded(robot), {})
    assert "center_x_1" in found and "L_rounded" not in found and rounding_line(found) == ""


@pytest.mark.parametrize("until", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_of_several_starts_the_best_gives_its_chambers(tmp_path, until):
    how = {"starts": 2, "iterations": 2, "chamber_until": until, "chamber_volume": "fixed"}
    robot = walker(moving(tmp_path / "run", **how))
    found = optimize_starts(robot)
    assert torch.equal(robot.density().detach(), found.gamma)


def test_a_design_that_breaks_down_takes_its_chambers_back_with_it(tmp_path):
    robot = walker(moving(tmp_path))
    assert robot.placement is not None
    good = loop.design_of(robot)
    with torch.no_grad():
        robot.placement.center[0, 0] = 4e-3
    broken, tried = robot.forward, list[float]()

    def breaks(gamma: torch.Tensor, **how: Any) -> Any:
        assert robot.placement is not None
        tried.append(float(robot.placement.center.detach()[0, 0]))
        if len(tried) < 3:
            raise loop.SimulationDiverged(step=1, time=0.1, particle=2, quantity="J", remedy="none")
        return broken(gamma, **how)

    robot.forward = breaks
    loop.simulate(robot, good, 1.0)
    assert tried == pytest.approx([4e-3, 2e-3, 1e-3])


def test_the_rounded_robot_has_the_design_of_the_other_on_lattice_planes(tmp_path):
    robot = walker(moving(tmp_path, chambers=2, timing=("phase",), phases=(0.0, 0.3), chamber_axis="z"))
    assert robot.placement is not None
    with torch.no_grad():
        robot.placement.center[:, 0] += 0.7 * robot.domain.spacing
        robot.field.phi.fill_(0.3)
    sharp = rounded(robot)
    assert sharp.placement is None and sharp.settings.chamber_design == ()
    pairs = zip(sharp.domain.chambers, robot.domain.chambers, strict=True)
    assert [one.center[0] - other.center[0] for one, other in pairs] == pytest.approx([robot.domain.spacing] * 2)
    assert torch.equal(sharp.field.phi, robot.field.phi) and torch.equal(sharp.supply.phase, robot.supply.phase)
    assert torch.equal(robot.rounded_domain.region, sharp.domain.region)
    with pytest.raises(ValueError, match=r"robot: got one whose chambers are given"):
        rounded(sharp)


def test_a_finished_run_holds_the_rounded_chambers_and_what_that_changed(tmp_path, capsys):
    settings = moving(tmp_path / "run", iterations=3, chamber_rate=0.4)
    robot = walker(settings)
    result = design(robot, "walker")
    stored = json.loads((settings.out / "result.json").read_text())
    read = read_settings(settings.out / "settings.json")
    assert read.chamber_design == () and json.loads((settings.out / "settings.json").read_text())["chamber_design"]
    (chamber,) = build(read).domain.chambers
    for k, axis in enumerate("xyz"):
        assert chamber.center[k] == stored[f"center_{axis}_1"] and chamber.size[k] == stored[f"size_{axis}_1"]
    assert chamber.center[0] != 0.0
    assert stored["L"] == pytest.approx(result["L"]) and stored["L_unrounded"] != stored["L_rounded"]
    assert stored["L_rounded"] == pytest.approx(stored["L"], abs=1e-7)
    assert "rounded to lattice planes: travel" in capsys.readouterr().out
    assert rounding_line({"L": 1.0}) == ""
    # The delivered design is on the delivered chamber: what reads runs takes it for any other.
    domain = build(read).domain
    gamma = load_design(settings.out / "design.npz", domain)
    assert torch.equal(gamma[domain.wall], torch.ones(int(domain.wall.sum()))) and not gamma[domain.gas].any()
    assert float(build(read)(gamma).travel) == pytest.approx(stored["L"], abs=1e-7)
    assert torch.equal(load_resampled(find(str(settings.out)), domain), gamma)
    assert (settings.out / "shape.stl").is_file() and json.loads((settings.out / "shape.json").read_text())["port_open"]
    rows = compare(str(settings.out), tmp_path / "checked", only=["double_modulus", "half_cell"], device="cpu")
    assert all("error" not in row and row["L"] != 0 for row in rows.values())
    assert (tmp_path / "checked" / CHAMBERS).is_file()
    with np.load(settings.out / "design.npz") as held:
        assert held["gamma"].shape == (domain.count,)
    (settings.out / CHAMBERS).write_text("[]")
    with pytest.raises(ValueError, match=r"holds a list, wanted the settings.json of a run"):
        read_settings(settings.out / "settings.json")
