"""Scenarios: samples, what each quantity does to a robot, batches against single runs, gradients, bad input."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import pytest
import torch
from tiny import TINY

from torchsoro import Chamber, Domain
from torchsoro.design.chambers import sockets
from torchsoro.design.outcome import Outcome
from torchsoro.design.reading import from_command_line
from torchsoro.design.risk import CVaR
from torchsoro.design.robot import Robot, build, climber, walker
from torchsoro.design.scenarios import (
    NOMINAL,
    STICK,
    ScenarioBatch,
    Scenarios,
    leaning_gravity,
    posed,
    supplied,
    varied,
)
from torchsoro.design.supply import Supply
from torchsoro.simulation.actuation import Waveform, square_wave

WIDE = Scenarios(
    friction=(0.3, "stick"),
    tilt_x=(-5.0, 5.0),
    tilt_y=(-5.0, 5.0),
    pressure_gain=(0.85, 1.15),
    lag=(0.0, 0.004),
    modulus_factor=(0.8, 1.2),
    density_factor=(0.9, 1.1),
    tube_mass=(0.0, 0.002),
    pitch=(-3.0, 3.0),
    roll=(-3.0, 3.0),
    drop=(0.0, 1e-3),
)
NUMBERS = ("travel", "feet", "soles", "inflated", "fall")


def batch(**values: list[float]) -> ScenarioBatch:
    tensors = {name: torch.tensor(v, dtype=torch.float64) for name, v in values.items()}
    return ScenarioBatch(count=len(next(iter(values.values()))), **tensors)


def robot_of(**changes: Any) -> Robot:
    """A walker with a front that differs from its rear."""
    made = walker(dataclasses.replace(TINY, **changes))
    with torch.no_grad():
        made.field.phi.copy_(torch.linspace(-0.1, 0.3, 8).reshape(8, 1, 1) + 0.05 * torch.linspace(-1, 1, 8))
    return made


@pytest.fixture(scope="module")
def robot() -> Robot:
    return robot_of()


@torch.no_grad()
def run(robot: Robot, scenarios: ScenarioBatch | None = None, **how: Any) -> Outcome:
    return robot(robot.field(), scenarios=scenarios, **how)


def test_a_sample_is_the_same_for_a_seed_within_its_ranges_and_spread_evenly():
    found, again, other = WIDE.sample(64, 3), WIDE.sample(64, 3), WIDE.sample(64, 4)
    assert list(found.given) == list(NOMINAL)
    for name, values in found.given.items():
        assert values.dtype == torch.float64
        assert torch.equal(values, again.given[name])
        assert not torch.equal(values, other.given[name])
        if name != "friction":
            low, high = getattr(WIDE, name)
            share = (values - low) / (high - low)
            # A scrambled Sobol sequence of 2^k numbers has one in each of 2^k even parts.
            assert torch.equal((64 * share).floor().sort().values, torch.arange(64.0, dtype=torch.float64))
    angle = found.friction.atan()
    low = math.atan(0.3)
    part = (64 * (angle - low) / (math.pi / 2 - low)).floor().sort().values
    assert torch.equal(part, torch.arange(64.0, dtype=torch.float64))


def test_what_does_not_vary_is_left_to_the_robot_and_does_not_change_the_rest():
    assert Scenarios().sample(4, 0).given == {}
    one = Scenarios(modulus_factor=(0.8, 1.2)).sample(8, 0)
    assert list(one.given) == ["modulus_factor"]
    assert torch.equal(one.modulus_factor, WIDE.sample(8, 0).modulus_factor)
    constant = Scenarios(tube_mass=(0.002, 0.002), friction=("stick", "stick")).sample(3, 0)
    assert constant.tube_mass.tolist() == [0.002] * 3 and constant.friction.tolist() == [STICK] * 3


def test_every_slope_has_as_many_scenarios_and_meets_all_of_the_other_ranges():
    plain, sloping = WIDE.sample(16, 5), dataclasses.replace(WIDE, slopes=(0.0, 0.3)).sample(16, 5)
    added = torch.deg2rad(sloping.tilt_x - plain.tilt_x).tan()
    assert added.tolist() == pytest.approx([0.0] * 8 + [0.3] * 8, abs=1e-12)
    for name in set(NOMINAL) - {"tilt_x", "friction"}:
        assert torch.equal(sloping.given[name], plain.given[name])
        low, high = getattr(WIDE, name)
        for half in (sloping.given[name][:8], sloping.given[name][8:]):
            eighths = (8 * (half - low) / (high - low)).floor().sort().values
            assert torch.equal(eighths, torch.arange(8.0, dtype=torch.float64)), name
    exact = Scenarios(slopes=(0.0, 0.1, 0.2, 0.3)).sample(4, 0)
    assert list(exact.given) == ["tilt_x"]
    assert torch.deg2rad(exact.tilt_x).tan().tolist() == pytest.approx([0.0, 0.1, 0.2, 0.3])
    with pytest.raises(ValueError, match=r"count = 3: wanted at least one scenario for each of 4 slopes"):
        Scenarios(slopes=(0.0, 0.1, 0.2, 0.3)).sample(3, 0)
    with pytest.raises(ValueError, match=r"slopes = .*: wanted rise over run"):
        dataclasses.replace(TINY, slopes=(0.0, 30.0))


def test_a_nominal_scenario_is_the_plain_robot_bit_for_bit(robot):
    plain = run(robot)
    nominal = {name: [value] for name, value in NOMINAL.items() if value is not None}
    for one in (ScenarioBatch(count=1), batch(**nominal, friction=[STICK])):
        found = run(robot, one)
        for name in NUMBERS:
            assert getattr(found, name).tolist() == [float(getattr(plain, name))], name
        assert torch.equal(found.trajectory.center_of_gravity[0], plain.trajectory.center_of_gravity)
    lean = run(robot, ScenarioBatch(count=1), void=False)
    assert lean.travel.tolist() == [float(run(robot, void=False).travel)]


def test_a_scenario_moves_beside_others_as_it_does_alone(robot):
    some = WIDE.sample(16, 0)
    together = run(robot, some)
    assert float(together.travel.std()) > 1e-4
    for k in (0, 5, 15):
        # Sixteen times the same: the same lanes, so the same bits whatever is beside it.
        same, alone = run(robot, some.part([k] * 16)), run(robot, some.part([k]))
        for name in NUMBERS:
            value = float(getattr(together, name)[k])
            assert set(getattr(same, name).tolist()) == {value}, name
            assert float(getattr(alone, name)) == pytest.approx(value, abs=2e-8), name


def test_factors_and_friction_are_those_of_other_settings(robot):
    changes = {"youngs_modulus": 1.1 * 0.44e6, "density": 0.9 * 1070.0, "pressure": 0.9 * 80e3, "friction": 0.4}
    other = run(robot_of(**changes, slope=math.tan(math.radians(4))))
    one = batch(modulus_factor=[1.1], density_factor=[0.9], pressure_gain=[0.9], friction=[0.4], tilt_x=[4.0])
    found = run(robot, one)
    for name in ("travel", "soles", "inflated"):
        assert float(getattr(found, name)) == pytest.approx(float(getattr(other, name)), abs=2e-8), name
    assert abs(float(other.travel - run(robot).travel)) > 1e-5


def test_gravity_leans_as_the_floor_tilts_and_keeps_its_size():
    found = leaning_gravity(9.8, 0.1, batch(tilt_x=[0.0, 3.0], tilt_y=[0.0, -2.0]))
    assert found.norm(dim=1).tolist() == pytest.approx([9.8, 9.8], rel=1e-14)
    assert float(found[0, 0] / found[0, 2]) == pytest.approx(0.1)
    assert float(found[1, 0]) == pytest.approx(-9.8 * math.sin(math.atan(0.1) + math.radians(3)))
    assert float(found[1, 1] / found[1, 2]) == pytest.approx(math.tan(math.radians(-2)))


def test_a_lagging_supply_is_the_closed_form_and_a_lag_of_zero_none():
    time, pressure = torch.tensor([[0.0, 0.1, 0.2], [0.0, 1e4, 1e4]], dtype=torch.float64)
    ramp = Waveform(time=time, pressure=pressure)
    tau = torch.tensor([0.0, 1e-6, 0.02, 0.3], dtype=torch.float64)
    found = supplied(ramp, ScenarioBatch(count=4, lag=tau, pressure_gain=2 * torch.ones_like(tau)))
    t = found.time
    assert float(t.diff().max()) <= 1.0001e-3
    torch.testing.assert_close(found.pressure[0, 0], 2 * ramp.at(t), rtol=1e-12, atol=1e-9)
    for k in (1, 2, 3):
        T = float(tau[k])
        rising = 2e5 * (t - T * (1 - torch.exp(-t / T)))
        top = 2e5 * (0.1 - T * (1 - math.exp(-0.1 / T)))
        wanted = torch.where(t <= 0.1, rising, 2e4 + (top - 2e4) * torch.exp(-(t - 0.1) / T))
        torch.testing.assert_close(found.pressure[k, 0], wanted, rtol=0, atol=1e-8 * 2e4)


def test_every_chamber_has_the_gain_and_the_lag():
    wave = square_wave(amplitude=torch.tensor([1e4, -2e4]), frequency=20, rise=0.003, fall=0.004, end=0.1)
    found = supplied(wave, batch(lag=[0.0, 0.002, 0.01], pressure_gain=[1.0, 0.9, 1.1]))
    assert found.pressure.shape == (3, 2, len(found.time))
    torch.testing.assert_close(found.pressure[:, 1], -2 * found.pressure[:, 0])
    assert supplied(wave, batch(tilt_x=[1.0])) is wave


@pytest.mark.slow
def test_lagging_valves_of_several_chambers_have_gradients_by_the_timing_of_each_scenario():
    valves = {"pressure": 2e4, "frequency": 100.0, "rise": 5e-4, "fall": 5e-4, "start": 5e-3, "end": 2e-2}
    names = ("amplitude", "phase", "duty")
    supply = Supply(**valves, amplitude=(0.9, 0.6), designed=names)
    t = torch.linspace(4e-3, 1.9e-2, 7, dtype=torch.float64)
    lag = torch.tensor([0.0, 0.002, 0.001], dtype=torch.float64)

    def pressures(*values: torch.Tensor) -> torch.Tensor:
        each = supply.each(dict(zip(names, values, strict=True)))
        return 1e-4 * supplied(each, ScenarioBatch(count=3, lag=lag)).at(t)

    rows = ([0.9, 0.6], [0.0031, 0.2127], [0.4, 0.55])
    values = [torch.tensor([row] * 3, dtype=torch.float64, requires_grad=True) for row in rows]
    assert pressures(*values).shape == (3, 2, 7)
    assert torch.autograd.gradcheck(pressures, values, atol=1e-7, rtol=1e-5)
    with torch.no_grad():
        for name, row in zip(names, rows, strict=True):
            getattr(supply, name).copy_(torch.tensor(row, dtype=torch.float64))
        behind = supplied(supply(), ScenarioBatch(count=3, lag=lag)).at(t)
    torch.testing.assert_close(1e4 * pressures(*values).detach(), behind, rtol=1e-12, atol=1e-9)
    assert float((behind[1] - behind[0]).abs().max()) > 100.0  # Pa


def test_gradients_of_a_lagging_supply_are_central_differences():
    wave = square_wave(amplitude=1.0, frequency=20, rise=0.003, fall=0.004, end=0.06, samples_per_period=40)
    inputs = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in ([0.002, 0.01], [1.1, 0.9])]

    def pressure(lag: torch.Tensor, gain: torch.Tensor) -> torch.Tensor:
        return supplied(wave, ScenarioBatch(count=2, lag=lag, pressure_gain=gain)).pressure

    assert torch.autograd.gradcheck(pressure, inputs, eps=1e-7, atol=1e-5)


def test_only_the_solid_is_stiffer_and_heavier(robot):
    body = robot.filled(robot.field().detach())
    found = varied(body, batch(modulus_factor=[0.5, 2.0], density_factor=[1.0, 3.0]))
    solid = body.chamber < 0
    for name, factor in (("bulk", 2.0), ("shear", 2.0), ("mass", 3.0), ("drag", 3.0)):
        own, plain = getattr(found, name), getattr(body, name)
        torch.testing.assert_close(own[1, solid], factor * plain[solid])
        assert torch.equal(own[1, ~solid], plain[~solid])


def test_a_pose_is_a_rigid_motion_that_leaves_no_corner_below_the_floor():
    corners = [[x, y, z] for x in (-0.01, 0.01) for y in (-0.02, 0.02) for z in (0.0, 0.03)]
    places = torch.tensor(corners, dtype=torch.float64)
    found = places + posed(places, (0.02, 0.04, 0.03), batch(pitch=[5.0, 0.0], roll=[-3.0, 4.0], drop=[0.0, 1e-3]))
    for one, drop in zip(found, (0.0, 1e-3), strict=True):
        torch.testing.assert_close(torch.cdist(one, one), torch.cdist(places, places))
        assert float(one[:, 2].min()) == pytest.approx(drop, abs=1e-12)
    assert float(found[0, 1::2, 0].mean() - found[0, ::2, 0].mean()) == pytest.approx(0.03 * math.sin(math.radians(5)))


def test_a_tube_pulls_down_at_the_rear_and_a_dropped_robot_falls(robot):
    plain = run(robot, everything=True).trajectory
    found = run(robot, batch(tube_mass=[0.0, 0.02], drop=[0.0, 0.001]), everything=True).trajectory
    assert robot.domain.positions[robot.socket[0], 0].unique().tolist() == [
        robot.domain.positions[robot.domain.wall, 0].min()
    ]
    start = found.position[:, 0] - plain.position[0]
    torch.testing.assert_close(start[1], torch.tensor([0.0, 0.0, 1e-3]).expand_as(start[1]), rtol=0, atol=1e-8)
    hung = run(robot, batch(tube_mass=[0.02]), everything=True).trajectory
    lower = (hung.position[0, 10] - plain.position[10])[robot.socket[0], 2]
    assert (lower < -1e-5).all()


def test_tubes_hang_in_equal_parts_on_chambers_of_different_size():
    sizes = ((0.012, 0.012, 0.012), (0.012, 0.018, 0.018))
    chambers = tuple(
        Chamber(name=name, center=(x, 0.009, 0.009), size=size, wall=0.003)
        for name, x, size in zip(("small", "large"), (0.006, 0.018), sizes, strict=True)
    )
    domain = Domain(size=(0.024, 0.018, 0.018), particles=(16, 12, 12), chambers=chambers)
    particles, share = sockets(domain, (0.0, 0.0, 1.0))
    parts = [share[domain.shell(k)[particles]] for k in range(2)]
    assert len(parts[1]) > len(parts[0]) > 0
    assert [float(part.sum()) for part in parts] == pytest.approx([0.5, 0.5])


def test_gradients_by_every_quantity_and_through_the_risk_are_central_differences():
    changes = {"settle": 0.002, "duration": 0.012, "sample_every": 0.0005, "friction": 0.05, "frequency": 80.0}
    made = robot_of(**changes)
    gamma = made.field().detach().double()
    # Feet slide throughout: where they stick, the motion knows jumps.
    start = {
        "friction": [0.05, 0.1, 0.07],
        "tilt_x": [1.0, -4.0, 3.0],
        "tilt_y": [5.0, 2.0, -3.0],
        "pressure_gain": [0.9, 1.1, 1.0],
        "lag": [0.002, 0.001, 0.004],
        "modulus_factor": [0.9, 1.1, 1.0],
        "density_factor": [0.95, 1.05, 1.0],
        "tube_mass": [0.002, 0.001, 0.003],
        "pitch": [1.0, -1.0, 0.5],
        "roll": [0.5, 1.0, -1.0],
        "drop": [1e-4, 2e-4, 3e-4],
    }
    way = torch.tensor([1.0, -0.7, 0.4], dtype=torch.float64)
    leaves = {name: torch.tensor(v, dtype=torch.float64, requires_grad=True) for name, v in start.items()}

    def objective(tensors: dict[str, torch.Tensor]) -> torch.Tensor:
        return CVaR(0.5)(1e3 * made(gamma, scenarios=ScenarioBatch(count=3, **tensors)).travel)

    gradients = torch.autograd.grad(objective(leaves), list(leaves.values()))
    with torch.no_grad():
        for (name, value), gradient in zip(leaves.items(), gradients, strict=True):
            step = 1e-5 * float(value.abs().max()) * way
            up, down = (objective({**leaves, name: value + sign * step}) for sign in (1, -1))
            slope = float((gradient * step).sum())
            assert slope == pytest.approx(float(up - down) / 2, rel=1e-6), name
            assert slope != 0, name


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"friction": (0.5, 0.3)}, r"friction = 0.5 0.3: wanted two increasing coefficients"),
        ({"friction": ("stick", 0.3)}, r"friction = stick 0.3: wanted"),
        ({"tilt_x": (-90.0, 5.0)}, r"tilt_x = -90 5: wanted two increasing numbers from -60 to 60 degrees"),
        ({"pressure_gain": (1.1, 0.9)}, r"pressure_gain = 1.1 0.9: wanted two increasing"),
        ({"lag": (-0.1, 0.0)}, r"lag = -0.1 0: wanted .* from 0 to 10 s"),
        ({"modulus_factor": (0.0, 1.0)}, r"modulus_factor = 0 1: wanted .* from 0.01 to 100"),
        ({"tube_mass": (0.0, 2.0)}, r"tube_mass = 0 2: wanted .* from 0 to 1 kg"),
        ({"drop": (0.0, math.nan)}, r"drop = 0 nan: wanted"),
    ],
)
def test_ranges_that_make_no_sense_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        Scenarios(**changes)


def test_bad_samples_and_batches_are_refused():
    with pytest.raises(ValueError, match="count = 0: wanted at least one"):
        WIDE.sample(0, 0)
    with pytest.raises(ValueError, match="seed = -1: wanted at least 0"):
        WIDE.sample(4, -1)
    with pytest.raises(ValueError, match=r"lag: torch.float32 \(3,\), wanted a floating-point tensor \(2,\)"):
        ScenarioBatch(count=2, lag=torch.zeros(3))


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--risk", "cvar:1.5"), r"risk = 'cvar:1.5': wanted a level of more than 0 and at most 1"),
        (("--risk", "median"), r"risk = 'median': wanted 'mean', 'worst' or 'cvar:'"),
        (("--tilt-range", "5", "-5"), r"tilt_range = 5 -5: wanted two increasing"),
        (("--tube-range", "0", "2"), r"tube_range = 0 2: wanted .* kg"),
        (("--friction-range", "stick", "0.3"), r"friction_range = stick 0.3: wanted"),
        (("--scenarios", "-1"), r"scenarios = -1: wanted at least 0"),
    ],
)
def test_bad_flags_are_refused_by_name(flags, message):
    with pytest.raises(ValueError, match=message):
        from_command_line({"desk": TINY}, description="", arguments=("--preset", "desk", "--device", "cpu", *flags))


@pytest.mark.parametrize("changes", [{"formulation": "updated"}, {"robot": "climber"}])
def test_a_pose_at_the_start_is_refused_where_there_is_none(changes):
    with pytest.raises(ValueError, match=r"drop_range = \(0.0, 0.001\): wanted 0 0, but of a walker"):
        build(dataclasses.replace(TINY, drop_range=(0.0, 1e-3), **changes))


def test_a_step_too_long_for_the_stiffest_scenario_is_refused_before_any_simulation():
    with pytest.raises(ValueError, match=r"dt = 0.000125 s: above the limit"):
        walker(dataclasses.replace(TINY, scenarios=4, modulus_range=(0.5, 3.0)))


@torch.no_grad()
def test_a_climber_has_scenarios_too():
    made = climber(dataclasses.replace(TINY, settle=0.0))
    found = made(made.field(), scenarios=Scenarios(friction=(0.3, "stick"), tube_mass=(0.002, 0.002)).sample(2, 0))
    assert found.travel.shape == (2,)
    assert float(found.travel.diff().abs()) > 0


def test_without_void_scenarios_in_lanes_go_as_each_alone(robot):
    batch = WIDE.sample(16, 3)
    together = run(robot, batch, void=False)
    for k in (0, 15):
        alone = run(robot, batch.part([k]), void=False, dt=together.dt)
        torch.testing.assert_close(alone.travel[0], together.travel[k], rtol=1e-4, atol=1e-8)
