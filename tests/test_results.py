"""What a finished run leaves: the planes in pictures, the part with its port, the shape on screen."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tiny import TINY

from torchsoro.design.robot import climber, walker
from torchsoro.design.training import RunFolder
from torchsoro.output import delivery
from torchsoro.output.delivery import drawn_planes, numbers, show, show_shape
from torchsoro.output.printable import print_part


def test_pictures_get_the_planes_of_the_robot():
    assert drawn_planes(walker(TINY)) == ((2, 0.0, 1),)
    assert drawn_planes(climber(TINY)) == ((0, -0.0175, 1), (0, 0.0175, -1))


@pytest.mark.parametrize(("make", "axis"), [(walker, 0), pytest.param(climber, 2, marks=pytest.mark.slow)])
def test_the_air_port_leaves_at_the_rear(make, axis):
    robot = make(dataclasses.replace(TINY, port=0.005))
    part = print_part(robot, robot.field(torch.ones(8, 8, 8)).detach().numpy())
    assert part.mesh.is_watertight
    low, high = part.mesh.bounds
    place = part.mesh.vertices
    radius = np.linalg.norm(np.delete(place - (low + high) / 2, axis, axis=1), axis=1)
    hole = abs(radius - 2.5) < 0.3  # mm
    for depth, there in ((place[:, axis] - low[axis], True), (high[axis] - place[:, axis], False)):
        assert (hole & (depth > 1) & (depth < 5)).any() == there


@pytest.mark.slow
def test_an_offset_thickens_the_part():
    robot = walker(TINY)
    density = robot.field(torch.ones(8, 8, 8)).detach().numpy()
    plain = print_part(robot, density)
    thick = print_part(walker(dataclasses.replace(TINY, offset=4.375e-4)), density)
    assert thick.mesh.extents[1] - plain.mesh.extents[1] == pytest.approx(2 * 0.4375, rel=0.3)


def test_the_shape_goes_to_tensorboard_as_picture_and_mesh(tmp_path):
    robot = walker(TINY)
    with RunFolder(tmp_path / "run", {}) as run:
        show_shape(run, robot, torch.zeros(robot.domain.count), 0)  # nothing but the chamber's wall
        show_shape(run, robot, robot.field(), 4)
    seen = EventAccumulator(str(tmp_path / "run")).Reload()
    assert [event.step for event in seen.Images("shape/picture")] == [0, 4]
    assert seen.Images("shape/picture")[0].encoded_image_string.startswith(b"\x89PNG")
    assert [event.step for event in seen.Tensors("shape/mesh_VERTEX")] == [0, 4]


@pytest.mark.parametrize("void", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_robot_is_shown_with_or_without_its_void_and_without_a_page_of_its_run(void, tmp_path, monkeypatch):
    robot = walker(dataclasses.replace(TINY, frames=2))
    gamma = (robot.domain.positions[:, 0] < 0.008).float()  # void in front
    asked: list[dict[str, Any]] = []
    forward = robot.forward
    monkeypatch.setattr(robot, "forward", lambda gamma, **how: asked.append(how) or forward(gamma, **how))
    found, part = show(tmp_path, robot, gamma, name="stump", void=void)
    assert [(how["everything"], how["void"]) for how in asked] == [(True, void)]
    assert {file.name for file in tmp_path.iterdir()} == {
        "stump.mp4",
        "motion.npz",
        "motion.html",
        "shape.stl",
        "shape.3mf",
        "shape.json",
    }
    assert json.loads((tmp_path / "shape.json").read_text())["mass_g"] == part.report.mass_g
    assert found["C"] == 0
    # Body and wall, without air; of grey there is none.
    solid = (robot.design & (gamma == 1) | robot.wall).sum() * robot.domain.volume * TINY.density
    assert found["mass"] == pytest.approx(float(solid), rel=1e-3)


@pytest.mark.slow
def test_the_pictures_of_a_run_tell_the_numbers_of_its_result(tmp_path, monkeypatch):
    robot = walker(dataclasses.replace(TINY, frames=2))
    told: dict[str, dict[str, Any]] = {}
    for name in ("movie", "summary"):
        monkeypatch.setattr(delivery, name, lambda path, name=name, **how: told.update({name: how}))
    history = {"objective/L": [0.0], "constraint/C": [0.2]}
    found, _ = show(tmp_path, robot, torch.ones(robot.domain.count), name="block", history=history)
    assert found["C"] == 0 and found["C_within_limit"]
    for how in told.values():
        assert how["title"] == f"block: travel L = {1e3 * found['L']:.2f} mm in 0.02 s"
        assert how["displacement"][-1, 0] == pytest.approx(found["L"], abs=1e-9)
    assert told["summary"]["note"] == numbers(found)
    assert numbers(found).startswith(
        f"feet {1e3 * found['feet']:.2f} mm, stride {1e3 * found['stride']:.2f} mm (mean of whole cycles), "
        "C = 0.0000 (limit 0.0125)"
    )
    assert "limit 0.0125 NOT MET" in numbers({**found, "C_within_limit": False})
    assert "no whole cycle" in numbers({**found, "stride": None})
