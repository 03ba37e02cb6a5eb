"""The density of a design as far as it is connected with its chambers."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.morphology import reconstruction
from tiny import TINY

from torchsoro.design.connected import connected
from torchsoro.design.robot import walker
from torchsoro.output.levelset import pieces
from torchsoro.output.loose import loose_line, loose_share, travel_of, without_loose

FACES = np.zeros((3, 3, 3), dtype=bool)
FACES[1, 1] = FACES[1, :, 1] = FACES[:, 1, 1] = True


def body(shape: tuple[int, int, int], seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Random densities with a wall, and which are wall."""
    random = np.random.default_rng(seed)
    gamma, wall = random.random(shape), np.zeros(shape, dtype=bool)
    wall[tuple(random.integers(n) for n in shape)] = True
    gamma[wall] = 1.0
    return gamma, wall


@given(shape=st.tuples(*(st.integers(1, 7),) * 3), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_it_is_a_reconstruction_by_dilation_from_the_walls(shape, seed):
    gamma, wall = body(shape, seed)
    found = connected(torch.from_numpy(gamma.ravel()), torch.from_numpy(wall.ravel()), shape)
    expected = reconstruction(np.where(wall, gamma, 0.0), gamma, method="dilation", footprint=FACES)
    np.testing.assert_array_equal(found.numpy(), expected.ravel())


def test_a_piece_behind_a_gap_counts_as_the_gap_which_has_all_its_gradient():
    gamma = torch.tensor([1.0, 0.8, 0.3, 0.9, 0.6], dtype=torch.float64, requires_grad=True)
    wall = torch.tensor([True, False, False, False, False])
    found = connected(gamma, wall, (5, 1, 1))
    assert found.tolist() == [1.0, 0.8, 0.3, 0.3, 0.3]
    (by,) = torch.autograd.grad((found * torch.arange(1.0, 6.0)).sum(), gamma)
    assert by.tolist() == [1.0, 2.0, 3.0 + 4.0 + 5.0, 0.0, 0.0]


def test_its_gradient_is_that_of_differences():
    gamma, wall = (torch.from_numpy(one.ravel()) for one in body((4, 5, 3), 1))
    gamma.requires_grad_()
    assert torch.autograd.gradcheck(lambda g: connected(g, wall, (4, 5, 3)), gamma)


def test_it_counts_as_far_as_the_projection_has_sharpened():
    s = dataclasses.replace(TINY, beta=8.0, final_beta=24.0, sharpen=(10, 30))
    assert [s.sharp(s.sharpness(k)) for k in (0, 10, 20, 30, 40)] == pytest.approx([0.0, 0.0, 0.5, 1.0, 1.0])
    assert dataclasses.replace(s, sharpen=(0, 0)).sharp(8.0) == 1.0


def test_a_robot_that_is_sharp_has_no_loose_feet():
    robot = walker(dataclasses.replace(TINY, beta=40.0, connected=True))
    shape = robot.domain.shape
    with torch.no_grad():
        robot.field.phi.fill_(-1.0)
        robot.field.phi[:, :, 0] = 1.0  # a sole below the chamber, which nothing connects with it
        plain, found = ((gamma >= 0.5).reshape(shape).numpy() for gamma in (robot.field(), robot.density()))
    gas = robot.domain.gas.reshape(shape).numpy()
    assert pieces(plain | gas)[1] == 2 and pieces(found | gas)[1] == 1


def test_a_run_says_what_is_loose_and_how_far_the_rest_travels():
    robot = walker(dataclasses.replace(TINY, beta=40.0))
    with torch.no_grad():
        robot.field.phi.fill_(-1.0)
        robot.field.phi[:, :, 0] = 1.0
        gamma = robot.field()
    layer, shell = robot.domain.shape[0] * robot.domain.shape[1], int(robot.domain.wall.sum())
    whole, walls = without_loose(robot, gamma), robot.domain.wall.float()
    assert loose_share(gamma, whole) == pytest.approx(layer / (layer + shell), rel=0.2)
    assert loose_share(walls, without_loose(robot, walls)) == 0.0
    travel = travel_of(robot, whole, void=True)
    expected = robot(connected(gamma, robot.domain.wall, robot.domain.shape)).travel
    assert travel == float(expected) != float(robot(gamma).travel)
    assert loose_line({"loose": 0.0}) == ""
    said = loose_line({"loose": 0.123, "L_connected": -4.37e-3})
    assert "12 % of the solid is loose and not printed: without it the travel is -4.37 mm" in said
    assert "the simulation breaks down" in loose_line({"loose": 0.5, "L_connected": None})
