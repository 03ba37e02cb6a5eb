"""A robot made of settings: where it moves, what it is judged by, and what is refused before any simulation."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import pytest
import torch
from tiny import TINY

import torchsoro.design.robot
from torchsoro import SimulationDiverged, Simulator
from torchsoro.design.outcome import Outcome
from torchsoro.design.robot import Robot, build, climber, walker
from torchsoro.design.scenarios import ScenarioBatch
from torchsoro.design.settings import Settings


def tiny(**changes: Any) -> Settings:
    return dataclasses.replace(TINY, **changes)


@pytest.fixture(scope="module")
def judged() -> tuple[Robot, Outcome]:
    """A walker with a front that differs from its rear, its outcome, and gradients."""
    robot = walker(tiny())
    with torch.no_grad():
        robot.field.phi.copy_(torch.linspace(-0.1, 0.3, 8).reshape(8, 1, 1) + 0.05 * torch.linspace(-1, 1, 8))
    outcome = robot(robot.field())
    (outcome.travel / robot.domain.cell).backward()
    return robot, outcome


def test_a_walker_stands_on_the_ground_and_a_climber_between_two_walls():
    robot = walker(tiny(friction=0.4))
    assert [(p.axis, p.offset, p.side, p.friction) for p in robot.planes] == [(2, 0.0, 1, 0.4)]
    assert (robot.direction, robot.field.symmetry) == ((1, 0, 0), ("y",))
    assert robot.domain.positions[:, 2].min() > 0
    assert robot.domain.positions[:, :2].mean(0).tolist() == pytest.approx([0, 0], abs=1e-12)
    robot = climber(tiny(wall_distance=0.04))
    assert [(p.axis, p.offset, p.side, p.friction) for p in robot.planes] == [
        (0, -0.02, 1, "stick"),
        (0, 0.02, -1, "stick"),
    ]
    assert (robot.direction, robot.field.symmetry) == ((0, 0, 1), ("x", "y"))


def test_a_slope_leans_gravity_back_and_keeps_its_size():
    assert walker(tiny()).gravity == (0, 0, -9.8)
    x, y, z = walker(tiny(slope=0.3)).gravity
    assert x / z == pytest.approx(0.3)
    assert x < 0
    assert y == 0
    assert math.hypot(x, z) == pytest.approx(9.8)


def test_an_outcome_agrees_with_its_trajectory_and_its_design(judged):
    robot, outcome = judged
    s, gamma, seen = robot.settings, robot.field().detach(), outcome.trajectory
    settled = int((seen.time - s.settle).abs().argmin())
    assert float(seen.time[-1]) == pytest.approx(s.settle + s.duration)
    torch.testing.assert_close(outcome.travel, (seen.center_of_gravity[-1] - seen.center_of_gravity[settled])[0])
    height = seen.center_of_gravity[:, 2]
    assert outcome.fall >= 0
    assert outcome.fall <= height[0] - height.min()
    density = gamma[robot.design]
    assert outcome.intermediate.item() == pytest.approx(float((density * (1 - density)).mean()), rel=1e-6)
    scale = (1 - s.epsilon) * density.double() ** s.power + s.epsilon
    solid = s.density * robot.domain.volume * (float(scale.sum()) + int(robot.wall.sum()))
    assert outcome.mass.item() == pytest.approx(solid, rel=1e-5)
    place = (scale.unsqueeze(-1) * robot.domain.positions[robot.design]).sum(0) / scale.sum()
    assert outcome.center.tolist() == pytest.approx(place.tolist(), abs=1e-7)
    assert place[0] > 1e-3  # denser in front
    assert outcome.center.tolist() == pytest.approx(seen.center_of_gravity[0].tolist(), abs=1e-7)
    assert torch.equal(seen.probes, robot.soles) and seen.position.shape[1:] == (len(robot.soles), 3)


def test_feet_count_that_touch_the_ground_at_the_end_and_lean_nowhere_by_the_cube_of_their_density(judged):
    robot, outcome = judged
    seen, gamma = outcome.trajectory, robot.field().detach()
    place = robot.domain.positions[robot.soles].float()
    still = place.expand(len(seen.time), -1, -1).clone()
    assert float(robot.feet(dataclasses.replace(seen, position=still), gamma)) == 0
    moved = still.clone()
    front = place[:, 0] > 0
    moved[-1, front, 0] += 0.003
    share = gamma[robot.soles] ** 3
    half = float(share[front].sum() / share.sum())
    assert float(robot.feet(dataclasses.replace(seen, position=moved), gamma)) == pytest.approx(0.003 * half, rel=1e-5)
    moved[-1, ~front, 2] += 0.5 * robot.domain.spacing  # lifted
    assert float(robot.feet(dataclasses.replace(seen, position=moved), gamma)) == pytest.approx(0.003, rel=1e-5)
    rear = math.exp(-1) * float(share[~front].sum())
    part = float(share[front].sum()) / (float(share[front].sum()) + rear)
    near = robot.feet(dataclasses.replace(seen, position=moved.requires_grad_()), gamma, near=True)
    assert float(near.detach()) == pytest.approx(0.003 * part, rel=1e-5)
    (gradient,) = torch.autograd.grad(near, moved)
    assert (gradient[-1, ~front, 2] > 0).all()  # the rear ones, which did not move, count less farther up


def test_the_gradient_reaches_phi_and_is_mirror_symmetric_to_the_bit(judged):
    robot, _ = judged
    gradient = robot.field.phi.grad
    assert torch.isfinite(gradient).all()
    assert torch.equal(gradient, gradient.flip(1))
    design = robot.domain.lattice(robot.design)
    assert (gradient[design] != 0).all()
    assert (gradient[~design] == 0).all()
    assert not torch.allclose(gradient, gradient.flip(0))


def test_everything_records_all_particles_and_the_same_motion(judged):
    robot, outcome = judged
    with torch.no_grad():
        full = robot(robot.field(), everything=True)
    assert full.trajectory.position.shape == (len(full.trajectory.time), robot.domain.count, 3)
    assert torch.equal(full.trajectory.center_of_gravity, outcome.trajectory.center_of_gravity)
    assert torch.equal(full.travel, outcome.travel)


@torch.no_grad()
def test_a_robot_without_its_void_goes_the_same_way():
    robot = walker(tiny(epsilon=1e-5))
    x, _, z = robot.domain.positions.T
    # Void under the belly and behind an edge at the front, 128 of 512 particles.
    gamma = 1 - ((x.abs() < 0.013) & (x > -0.008) & (z < 0.009) | (x > 0.009) & (z > 0.02)).float()
    whole, part = (robot(gamma, everything=True, void=void) for void in (True, False))
    # Measured: 4e-3 of the travel, as nodal masses have the moments of inertia of all matter, 7e-8 m in the path, 2e-6
    # m and 1e-3 m/s at single particles; with the 100 times heavier void of the other tests 11 %, 6e-6 m, 3e-5 m and
    # 1.5e-2 m/s, which these tolerances exclude.
    assert abs(float(whole.travel)) > 5e-5
    assert float(part.travel) == pytest.approx(float(whole.travel), rel=5e-3)
    here, there = part.trajectory, whole.trajectory
    assert torch.equal(here.time, there.time)
    torch.testing.assert_close(here.center_of_gravity, there.center_of_gravity, rtol=0, atol=1e-6)
    assert here.position.shape == here.velocity.shape == (len(here.time), robot.domain.count, 3)
    assert here.probes.tolist() == list(range(robot.domain.count))
    void = (gamma == 0) & robot.design
    assert int(void.sum()) == 128
    torch.testing.assert_close(here.position[:, ~void], there.position[:, ~void], rtol=0, atol=1e-5)
    torch.testing.assert_close(here.velocity[:, ~void], there.velocity[:, ~void], rtol=0, atol=5e-3)
    moved = here.center_of_gravity - here.center_of_gravity[0]
    assert float(moved.abs().max()) > 5e-5
    carried = (robot.domain.positions[void] + moved[:, None]).float()
    torch.testing.assert_close(here.position[:, void], carried, rtol=0, atol=1e-8)
    for name in ("intermediate", "mass", "center", "dt"):
        assert getattr(part, name) == pytest.approx(getattr(whole, name)), name
    lean = robot(gamma, void=False)
    assert torch.equal(lean.travel, part.travel)
    there = robot.soles[~void[robot.soles]]
    assert torch.equal(lean.trajectory.probes, there) and lean.trajectory.position.shape[1] == len(there)
    torch.testing.assert_close(lean.feet, part.feet)


def test_the_settings_name_the_robot():
    assert build(tiny()).direction == (1, 0, 0)
    assert build(tiny(robot="climber")).direction == (0, 0, 1)


@torch.no_grad()
def test_what_is_free_below_a_body_is_no_fall():
    robot = walker(TINY)
    whole = torch.ones(robot.domain.count)
    h = robot.domain.spacing
    worn = torch.where(robot.domain.positions[:, 2] < h, 0.0, whole)  # as an eroded design, without its lowest layer
    assert robot.clearance(torch.stack([whole, worn])).tolist() == pytest.approx([0.0, h])
    assert float(robot.clearance(0.1 * whole)) == 0.0 == float(climber(tiny(wall_distance=0.04)).clearance(worn))
    dropped = ScenarioBatch(count=2, drop=torch.tensor([0.0, 0.002], dtype=torch.float64))
    with torch.no_grad():
        falls = walker(tiny(settle=0.04, sink=0.0, duration=0.02))(whole, scenarios=dropped).fall
        leaning = ScenarioBatch(count=2, pitch=torch.tensor([0.0, 8.0], dtype=torch.float64))
        resting = walker(tiny(settle=0.2, sink=0.0, duration=0.02, friction=0.5))(whole, scenarios=leaning)
        height = resting.trajectory.center_of_gravity[..., 2]
        assert float(height[1, 0] - height[1].amin()) > 0.001  # comes down from where it leaned
        assert float(resting.fall[1]) < float(resting.fall[0]) + 0.0005
    # Both sink by their weight alone; what drops, and has its speed to lose, a little more.
    assert float(falls[0]) <= float(falls[1]) < float(falls[0]) + 0.0005


def test_a_share_of_gravity_is_a_smaller_gravity():
    robot = walker(tiny(gravity=8.0))
    half = robot(robot.field(), gravity_scale=0.5)
    other = walker(tiny(gravity=4.0))
    assert torch.equal(half.travel, other(other.field()).travel)
    assert not torch.equal(half.travel, robot(robot.field()).travel)


def test_the_actuation_starts_after_settling(tmp_path):
    modelled = walker(tiny()).pressure
    assert modelled.at(torch.tensor([0.0, 0.0099, 0.012], dtype=torch.float64)).tolist()[:2] == [0, 0]
    assert 0.5 < float(modelled.at(torch.tensor([0.012], dtype=torch.float64))) / TINY.pressure < 0.7  # 1 - 1/e
    file = tmp_path / "measured.csv"
    file.write_text("time_s,pressure_pa\n0,0\n0.01,50e3\n0.02,10e3\n")
    measured = walker(tiny(pressure_file=file)).pressure
    assert measured.time.tolist() == pytest.approx([0.01, 0.02, 0.03])
    assert measured.pressure.tolist() == [0, 50e3, 10e3]


class Fragile:
    """Stands in for a simulator: diverges in the first tries, and takes note of the steps."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, failures: int) -> None:
        self.steps: list[float] = []
        self.failures = failures
        monkeypatch.setattr(torchsoro.design.robot, "Simulator", self.make)

    def make(self, **settings: Any) -> Any:
        simulator = Simulator(**settings)
        real = simulator.forward

        def forward(*args: Any, **keywords: Any) -> Any:
            self.steps.append(simulator.dt)
            if len(self.steps) <= self.failures:
                raise SimulationDiverged(step=1, time=0.1, particle=2, quantity="J <= 0", remedy="a smaller step")
            return real(*args, **keywords)

        simulator.forward = forward
        return simulator


@torch.no_grad()
def test_a_simulation_that_diverges_is_tried_again_with_half_the_step(monkeypatch):
    robot = walker(tiny(halvings=2))
    plain = robot(robot.field())
    fragile = Fragile(monkeypatch, failures=1)
    again = robot(robot.field())
    assert fragile.steps == [TINY.dt, TINY.dt / 2]
    assert torch.equal(again.trajectory.time, plain.trajectory.time)
    torch.testing.assert_close(
        again.trajectory.center_of_gravity, plain.trajectory.center_of_gravity, rtol=0, atol=1e-4
    )
    fragile = Fragile(monkeypatch, failures=9)
    with pytest.raises(SimulationDiverged, match="J <= 0"):
        robot(robot.field())
    assert fragile.steps == [TINY.dt, TINY.dt / 2, TINY.dt / 4]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"youngs_modulus": -1.0}, "youngs_modulus = -1.0"),
        ({"density": math.nan}, "density = nan"),
        ({"poisson_ratio": 0.5}, "poisson_ratio = 0.5"),
        ({"elements": 6}, "elements = 6"),
        ({"air_stiffness": -1.0}, "stiffness = -1.0"),
        ({"epsilon": 0.0}, "epsilon = 0.0"),
        ({"power": -3.0}, "power = -3.0"),
        ({"friction": -0.1}, "friction = -0.1"),
        ({"dt": 1e-3}, r"dt = 0.001 s: above the limit of about 0.000\d+ s, set by \w+"),
        ({"wall": 0.0}, "wall = 0.0"),
        ({"wall": 0.003}, "wall face"),
        ({"chamber": (0.04375,) * 3}, "leaves the body"),
        ({"particles": (8, 8, 9)}, "particles"),
        ({"room": 0.0, "size": (0.0175,) * 3, "chamber": (0.00875,) * 3, "wall": 0.0175 / 8}, "low, high"),
        ({"filter_radius": 0.0}, "radius"),
        ({"beta": -1.0}, "beta"),
        ({"duty": 1.0}, "duty"),
        ({"rise": 0.0}, "rise"),
    ],
)
def test_settings_that_do_not_fit_are_refused_before_any_simulation(changes, message):
    with pytest.raises(ValueError, match=message):
        walker(tiny(**changes))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "existing CSV file"),
        ("time_s,bar\n0,0\n1,1\n", "pressure_pa"),
        ("time_s,pressure_pa\n0,0\n1,1\n0.5,2\n", "line 4.*increasing"),
        ("time_s,pressure_pa\n0,0\n0.01,5e4\n", r"measured.csv: from 0 to 0.01 s, wanted .* duration of 0.02 s"),
        ("time_s,pressure_pa\n3,0\n3.03,5e4\n", r"measured.csv: from 3 to 3.03 s, wanted .* at 0"),
        ("time_s,pressure_pa\n0,0\n0.03,50\n", r"measured.csv, largest = 50 Pa: wanted from 440 to .* 80 kPa is 80000"),
    ],
)
def test_a_bad_pressure_file_is_refused_before_any_simulation(text, message, tmp_path):
    file = tmp_path / "measured.csv"
    if text is not None:
        file.write_text(text)
    with pytest.raises(ValueError, match=message):
        walker(tiny(pressure_file=file))


def test_walls_closer_than_the_body_is_wide_are_refused():
    with pytest.raises(ValueError, match=r"wall_distance = 0.03 m: wanted at least the body's 0.035 m"):
        climber(tiny(wall_distance=0.03))
