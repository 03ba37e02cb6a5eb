"""What a finished run leaves: the mean stride, the planes in pictures, the part with its port, the shape on screen."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tiny import TINY

from torchsoro.objective import stride
from torchsoro.results import _mean_stride, drawn_planes, print_part, show_shape
from torchsoro.robot import climber, walker
from torchsoro.training import RunFolder


def moving(*, frequency: float, duration: float) -> Any:
    """A robot and a motion that speeds up: 2 t + 30 t^2 metres after settling, sampled each 1 ms."""
    robot = SimpleNamespace(
        settings=dataclasses.replace(TINY, frequency=frequency, duration=duration), direction=(0.0, 0.0, 1.0)
    )
    time = torch.arange(round((TINY.settle + duration) / 1e-3) + 1, dtype=torch.float64) * 1e-3
    after = (time - TINY.settle).clamp(min=0)
    way = torch.stack([torch.zeros_like(time), 9 * time, 2 * after + 30 * after**2], -1)
    return robot, SimpleNamespace(time=time, center_of_gravity=way)


def test_the_mean_stride_is_that_of_the_whole_cycles():
    robot, motion = moving(frequency=50.0, duration=0.05)  # two cycles and a half
    each = stride(motion.center_of_gravity, motion.time, start=TINY.settle, period=0.02, direction=(0, 0, 1))
    assert len(each) == 2
    assert _mean_stride(robot, motion) == pytest.approx(float(each.mean()))


def test_a_cycle_may_end_between_two_samples():
    robot, motion = moving(frequency=30.0, duration=0.1)  # three cycles of 33.3 ms
    assert _mean_stride(robot, motion) == pytest.approx((2 * 0.1 + 30 * 0.01) / 3)
    robot, motion = moving(frequency=30.0, duration=0.05)
    assert _mean_stride(robot, motion) == pytest.approx(2 / 30 + 30 / 30**2, rel=1e-3)


def test_without_a_whole_cycle_there_is_no_stride():
    assert math.isnan(_mean_stride(*moving(frequency=5.0, duration=0.1)))


def test_pictures_get_the_planes_of_the_robot():
    assert drawn_planes(walker(TINY)) == ((2, 0.0, 1),)
    assert drawn_planes(climber(TINY)) == ((0, -0.0175, 1), (0, 0.0175, -1))


@pytest.mark.parametrize(("make", "axis"), [(walker, 0), (climber, 2)])
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
