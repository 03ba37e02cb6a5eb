"""Several chambers: where they lie, the valve of each, gradients by its timing, and designs of timing and turn."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
from typing import Any

import numpy as np
import pytest
import torch
from problems import rotations, vector
from tiny import TINY, tiny

from torchsoro import Chamber, DesignField, Domain, Gas, Prony, Simulator, Solid, Waveform, fill, ground, square_wave
from torchsoro.design import loop
from torchsoro.design.loop import optimize
from torchsoro.design.objective import yaw
from torchsoro.design.robot import build, turner, walker
from torchsoro.design.supply import DUTY, Supply
from torchsoro.output.archive import load_supply, save_design
from torchsoro.simulation.actuation import side_by_side

VALVE: dict[str, Any] = {"pressure": 2e4, "frequency": 100.0, "rise": 5e-4, "fall": 5e-4, "start": 1e-4, "end": 2e-2}
NAMES = ("amplitude", "phase", "duty")
TWO: dict[str, Any] = {"amplitude": (0.9, 0.6), "phase": (0.0031, 0.0127), "duty": (0.4, 0.55)}
BOTH = (
    Chamber(name="right", center=(0.01, 0.006, 0.011), size=(0.012, 0.008, 0.012), wall=0.002),
    Chamber(name="left", center=(0.01, 0.014, 0.011), size=(0.012, 0.008, 0.012), wall=0.002),
)
DOMAIN = Domain(size=(0.02,) * 3, particles=(10,) * 3, origin=(0.0, 0.0, 1e-3), chambers=BOTH)


def simulated(pressure: Waveform, *, symmetry: tuple[str, ...] = (), duration: float = 4e-4) -> torch.Tensor:
    """Displacement of every particle [N, 3] m of a random body with two chambers, in float64."""
    field = DesignField(DOMAIN, radius=0.006, symmetry=symmetry, dtype=torch.float64)
    with torch.no_grad():
        random = torch.rand(DOMAIN.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        field.phi.copy_(0.8 * random - 0.2)
    body = fill(DOMAIN, field().detach(), solid=Solid(), gas=Gas(density=3.0), void_range=(0.1, 0.3))
    simulator = Simulator(cell=DOMAIN.cell, dt=8e-6, low=(-0.1,) * 3, high=(0.1,) * 3, formulation="total")
    everywhere = torch.arange(DOMAIN.count)
    how = {"prony": Prony.paper(1), "planes": [ground()], "probes": everywhere}
    seen = simulator(body, duration=duration, pressure=pressure, sample_every=duration, **how).position
    return seen[-1] - DOMAIN.positions


# The valves -----------------------------------------------------------------------------------------------------------


def test_a_single_chamber_has_the_square_wave_bit_for_bit():
    seen = Supply(**VALVE)()
    wave = square_wave(amplitude=2e4, **{name: VALVE[name] for name in ("frequency", "rise", "fall", "start", "end")})
    assert torch.equal(seen.time, wave.time) and torch.equal(seen.pressure, wave.pressure)


def test_each_of_several_chambers_has_its_own_valve_in_closed_form():
    seen = Supply(**VALVE, **TWO)()
    t = torch.linspace(0, 2e-2, 777, dtype=torch.float64)
    for chamber, (a, phase, duty) in enumerate(zip(*TWO.values(), strict=True)):
        begin = VALVE["start"] + phase / 100
        level, cycle = 0.0, 0
        expected = torch.zeros_like(t)
        while begin + cycle / 100 < 2e-2:  # half cycles one after the other
            opens, shuts, ends = (begin + (cycle + part) / 100 for part in (0, duty, 1))
            rising = 2e4 * a + (level - 2e4 * a) * torch.exp(-(t - opens) / 5e-4)
            top = 2e4 * a + (level - 2e4 * a) * math.exp(-(shuts - opens) / 5e-4)
            expected = torch.where((t > opens) & (t <= shuts), rising, expected)
            expected = torch.where((t > shuts) & (t <= ends), top * torch.exp(-(t - shuts) / 5e-4), expected)
            level, cycle = top * math.exp(-(ends - shuts) / 5e-4), cycle + 1
        # Linear between samples of 1/400 of a cycle: h^2 / 8 of the largest second derivative.
        torch.testing.assert_close(seen.at(t)[chamber], expected, rtol=0, atol=2e4 * (2.5e-5 / 5e-4) ** 2 / 8)


def test_pressures_have_gradients_by_amplitude_phase_and_duty():
    supply = Supply(**VALVE, **TWO)
    t = torch.linspace(1e-3, 1.9e-2, 13, dtype=torch.float64)

    def pressures(*values: torch.Tensor) -> torch.Tensor:
        named = dict(zip(NAMES, values, strict=True))
        return 1e-4 * torch.func.functional_call(supply, named, ()).at(t)

    values = [torch.tensor(TWO[name], dtype=torch.float64, requires_grad=True) for name in NAMES]
    assert torch.autograd.gradcheck(pressures, values, atol=1e-7, rtol=1e-6)
    for value in torch.autograd.grad(pressures(*values).square().sum(), values):
        assert bool((value.abs() > 1e-3).all())


def test_pressures_of_own_times_are_those_of_each_alone_and_a_batch_of_gains_scales_them():
    one = Waveform(time=vector(0.0, 1.0, 2.0), pressure=vector(0.0, 3.0, 1.0))
    other = Waveform(time=vector(0.5, 1.5), pressure=vector(-2.0, 4.0))
    both, t = side_by_side([one, other]), vector(-1.0, 0.0, 0.7, 1.0, 1.7, 2.0, 3.5, 99.0)
    assert torch.equal(both.at(t), torch.stack([one.at(t), other.at(t)]))
    gains = vector(1.0, 0.5, 2.0).reshape(3, 1, 1)
    scaled = dataclasses.replace(both, pressure=gains * both.pressure)
    assert torch.equal(scaled.at(t), gains * both.at(t))
    with pytest.raises(ValueError, match=r"waveforms: got pressures of shapes \[\(2, 3\)\]"):
        side_by_side([both])
    with pytest.raises(ValueError, match=r"time: got shape \(2, 3\), want"):
        Waveform(time=both.time, pressure=vector(0.0, 1.0, 2.0))
    with pytest.raises(ValueError, match=r"time: got 0\.5 s in sample 2 after 0.5 s"):
        Waveform(time=torch.stack([vector(0.0, 1.0, 2.0), vector(0.0, 0.5, 0.5)]), pressure=both.pressure)


# Motion ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_gradient_of_a_motion_by_the_timing_is_the_central_difference(name):
    supply = Supply(**VALVE, **TWO, designed=NAMES)
    # Short cycles, so that the valves switch within the motion; no sample of theirs lies on a substep.
    supply.frequency = 4000.0
    with torch.no_grad():
        supply.phase.copy_(vector(0.13117, 0.43671))
    values, way = getattr(supply, name), vector(0.7, -0.4)
    weight = torch.rand(DOMAIN.count, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def moved(step: float) -> torch.Tensor:
        with torch.no_grad():
            values.add_(step * way)
        seen = 1e3 * (weight * simulated(supply())).sum()
        with torch.no_grad():
            values.sub_(step * way)
        return seen

    (gradient,) = torch.autograd.grad(moved(0.0), values)
    with torch.no_grad():
        difference = float(moved(1e-7) - moved(-1e-7)) / 2e-7
    assert float(gradient @ way) == pytest.approx(difference, rel=1e-6)
    assert bool((gradient.abs() > 1e-6).all())


def test_equal_valves_move_a_body_as_one_pressure_in_both_chambers():
    with torch.no_grad():
        equal = simulated(Supply(**VALVE, amplitude=(1.0, 1.0))())
        alone = Supply(**VALVE)()
        one = simulated(Waveform(time=alone.time, pressure=alone.pressure.expand(2, -1)))
        other = simulated(Supply(**VALVE, **TWO)())
    assert torch.equal(equal, one) and not torch.equal(equal, other)


def test_mirrored_valves_move_a_symmetric_body_as_its_mirror_image():
    supply = Supply(**VALVE, **TWO)
    with torch.no_grad():
        one, other = (DOMAIN.lattice(simulated(supply(mirrored=flag), symmetry=("y",)).T) for flag in (False, True))
    image = one.flip(2) * vector(1.0, -1.0, 1.0).reshape(3, 1, 1, 1)  # over y
    torch.testing.assert_close(other, image, rtol=0, atol=1e-12)
    assert float((other - one).abs().max()) > 1e-6  # m


# Turning --------------------------------------------------------------------------------------------------------------


def test_yaw_of_a_rigid_motion_is_its_angle_about_z_whatever_the_shift_and_the_weights():
    generator = torch.Generator().manual_seed(2)
    place = torch.rand(20, 3, generator=generator, dtype=torch.float64)
    weight = torch.rand(20, generator=generator, dtype=torch.float64)
    for angle in (-3.0, -0.2, 0.0, 1e-3, 0.5, 2.0):
        c, s = math.cos(angle), math.sin(angle)
        turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
        later = place @ turn.T + vector(0.3, -0.1, 5.0)
        assert float(yaw(place, later, weight)) == pytest.approx(angle, abs=1e-12)
        batch = yaw(place.expand(2, -1, -1), torch.stack([later, place]), weight)
        assert batch.tolist() == pytest.approx([angle, 0.0], abs=1e-12)
    # No angle fits better than that of the closed form.
    later = place @ rotations(1)[0].T
    best = float(yaw(place, later, weight))

    def error(angle: float) -> float:
        share = (weight / weight.sum()).unsqueeze(-1)
        (x, y), (u, v) = ((p - (share * p).sum(0)).T[:2] for p in (place, later))
        c, s = math.cos(angle), math.sin(angle)
        return float((weight * ((c * x - s * y - u) ** 2 + (s * x + c * y - v) ** 2)).sum())

    assert error(best) < min(error(best + d) for d in (-1e-3, 1e-3, 1.0))


def test_yaw_has_a_gradient_and_refuses_shapes_that_do_not_fit():
    place, later = (torch.rand(2, 6, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)).unbind()
    weight = torch.rand(6, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    inputs = [t.requires_grad_() for t in (place, later, weight)]
    assert torch.autograd.gradcheck(yaw, inputs)
    with pytest.raises(ValueError, match=r"rest, place, weight: got shapes \(6, 3\), \(6, 3\), \(5,\)"):
        yaw(place, later, weight[:5])


def test_what_a_turner_maximises_is_the_arc_of_half_its_width_in_cells(tmp_path):
    robot = turner(tiny(tmp_path, robot="turner", chambers=2, chamber_axis="y", phases=(0.0, 0.25), upright=2.0))
    with torch.no_grad():
        outcome = robot(robot.field())
        outcome = dataclasses.replace(outcome, turn=torch.tensor(0.2), fall=torch.tensor(1e-3))
    worth = (0.2 * 0.0175 - 2e-3) / robot.domain.cell
    assert loop.worth_of(robot, outcome) == pytest.approx(worth)
    assert float(loop.aim(robot, outcome, 0)) == pytest.approx(worth)


# Designs --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_several_chambers_hold_the_air_of_the_one_apart_from_each_other(axis, tmp_path):
    one, two = (walker(tiny(tmp_path, chambers=n, chamber_axis=axis)).domain for n in (1, 2))
    assert int(one.gas.sum()) == int(two.gas.sum()) > 0
    counts = torch.bincount(two.chamber[two.gas].long())
    assert counts.tolist() == [int(two.gas.sum()) // 2] * 2
    at = "xyz".index(axis)
    first, last = (two.positions[two.chamber == k][:, at] for k in (0, 1))
    # Two walls lie between, one of each.
    assert float(last.min() - first.max()) == pytest.approx(2 * TINY.wall + two.spacing)
    middle = two.positions[two.gas].mean(0)
    torch.testing.assert_close(middle, one.positions[one.gas].mean(0), rtol=0, atol=1e-12)


def test_a_designed_timing_is_kept_within_its_bounds_and_moves(tmp_path):
    settings = tiny(tmp_path / "run", chambers=2, timing=NAMES, timing_rate=0.3, iterations=4)
    robot = walker(settings)
    optimize(robot)
    with (settings.out / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    for name, low, high in (("amplitude", 0.0, settings.pressure), ("phase", 0.0, 1.0), ("duty", *DUTY)):
        for chamber in (1, 2):
            seen = [float(row[f"supply/{name}_{chamber}"]) for row in rows]
            assert all(low <= value <= high for value in seen)
            assert name != "duty" or len(set(seen)) > 1
    assert all(float(row["grad_norm/supply"]) > 0 for row in rows)


def test_a_resumed_run_keeps_the_timing_to_the_bit_and_a_design_holds_it(tmp_path):
    settings = tiny(tmp_path / "whole", chambers=2, timing=NAMES, phases=(0.0, 0.2), iterations=4)
    whole = walker(settings)
    one = optimize(whole)
    cut = dataclasses.replace(settings, out=tmp_path / "cut", iterations=2)
    optimize(walker(cut))
    resumed = walker(dataclasses.replace(cut, iterations=4, resume=True))
    other = optimize(resumed)
    assert torch.equal(one.gamma, other.gamma)
    for name, value in whole.supply.named_parameters():
        assert torch.equal(value, getattr(resumed.supply, name)), name
    tables = [(tmp_path / name / "metrics.csv").read_text().splitlines() for name in ("whole", "cut")]
    columns = tables[0][0].split(",")
    for row in zip(*(csv.DictReader(lines) for lines in tables), strict=True):
        assert all(row[0][c] == row[1][c] for c in columns if not c.startswith("time/"))
    # From a file into a robot of the same settings.
    save_design(tmp_path / "design.npz", whole.domain, one.gamma, whole.supply)
    again = walker(settings)
    assert not torch.equal(again.supply.duty, whole.supply.duty)
    load_supply(tmp_path / "design.npz", again.supply)
    assert torch.equal(again.pressure.pressure, whole.pressure.pressure)
    save_design(tmp_path / "bare.npz", whole.domain, one.gamma)
    with pytest.raises(ValueError, match=r"bare.npz has no timing .* of 2 chambers"):
        load_supply(tmp_path / "bare.npz", again.supply)
    checkpoint = torch.load(tmp_path / "cut" / "checkpoint.pt", weights_only=True)
    checkpoint["items"]["supply"]["phase"] = torch.zeros(3, dtype=torch.float64)
    torch.save(checkpoint, tmp_path / "cut" / "checkpoint.pt")
    with pytest.raises(ValueError, match=r"checkpoint.pt does not fit the run \(a design of shape \(3,\), wanted \(2,"):
        optimize(walker(dataclasses.replace(cut, iterations=6, resume=True)))


def test_a_design_that_breaks_down_takes_its_timing_back_with_it(tmp_path):
    robot = walker(tiny(tmp_path, chambers=2, timing=("phase",), phases=(0.0, 0.8)))
    good = loop.design_of(robot)
    good["supply"] = {**good["supply"], "phase": vector(0.0, 0.4)}
    broken = robot.forward
    tried: list[float] = []

    def breaks(gamma: torch.Tensor, **how: Any) -> Any:
        tried.append(robot.supply.phase.tolist()[1])
        if len(tried) < 3:
            raise loop.SimulationDiverged(step=1, time=0.1, particle=2, quantity="J", remedy="none")
        return broken(gamma, **how)

    robot.forward = breaks
    loop.simulate(robot, good, 1.0)
    assert tried == pytest.approx([0.8, 0.6, 0.5])


@pytest.mark.slow
def test_the_turner_recipe_turns_to_either_side_and_says_by_how_much(recipes, tmp_path):
    settings = tiny(
        tmp_path / "run", robot="turner", chambers=2, chamber_axis="y", timing=("phase",), phases=(0.0, 0.25)
    )
    result = recipes["turner"].main(settings)
    assert result["turn_left"] == pytest.approx(result["turn_right"], rel=1e-2)
    assert result["turn_left"] != 0
    stored = json.loads((settings.out / "result.json").read_text())
    assert stored["phase_2"] != 0.25 and stored["amplitude_1"] == settings.pressure
    with np.load(settings.out / "design.npz") as design:
        assert design["phase"].tolist() == [stored["phase_1"], stored["phase_2"]]
    replayed = recipes["replay"].main(
        recipes["replay"].Options(robot=str(settings.out), out=tmp_path / "again", void=True, frames=6, settle=0.01)
    )
    assert replayed["turn_left"] == pytest.approx(result["turn_left"], rel=1e-5)
    assert (settings.out / "turner.mp4").exists() and (settings.out / "shape.stl").exists()


@torch.no_grad()
def test_a_symmetric_body_turns_as_far_to_the_right_with_the_valves_mirrored(tmp_path):
    robot = turner(tiny(tmp_path, robot="turner", chambers=2, chamber_axis="y", phases=(0.0, 0.25)))
    robot.field.phi.copy_(torch.linspace(-0.2, 0.3, 8).reshape(8, 1, 1) + 0.05 * torch.linspace(-1, 1, 8))
    gamma = robot.field()
    left, right = robot(gamma), robot(gamma, pressure=robot.supply(mirrored=True))
    assert abs(float(left.turn)) > 1e-4
    assert float(right.turn) == pytest.approx(-float(left.turn), rel=1e-2)
    assert float(right.travel) == pytest.approx(float(left.travel), rel=1e-2)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"phases": (0.0, 0.5)}, r"phases = \(0.0, 0.5\): wanted none for a single chamber"),
        ({"duties": (0.5,)}, "duties = .*: wanted none for a single chamber"),
        ({"timing": ("phase",)}, "timing = .*: wanted no phase for a single chamber"),
        ({"chambers": 2, "phases": (0.5,)}, "phases = .*: wanted one for each of the 2 chambers"),
        ({"chambers": 2, "phases": (0.0, 1.5)}, r"phases\[1\] = 1.5: wanted at most 1"),
        ({"chambers": 2, "amplitudes": (0.0, -1.0)}, r"amplitudes\[1\] = -1.0: wanted at least 0"),
        ({"chambers": 2, "duties": (0.5, 0.05), "timing": ("duty",)}, r"duty = \(0.5, 0.05\): .* from 0.1 to 0.9"),
        ({"chambers": 2, "timing": ("lag",)}, "timing.* = 'lag': wanted 'amplitude', 'phase' or 'duty'"),
        ({"chambers": 0}, "chambers = 0: wanted at least 1"),
        ({"chambers": 2, "chamber": (0.035, 0.0175, 0.0175)}, r"'chamber 1' .* leaves the body"),
        ({"chambers": 3}, r"'chamber 1' has an? .* spacings from the lower face"),
        ({"robot": "turner", "chambers": 2}, "chambers = 2, chamber_axis = 'x': wanted at least 2 along 'y' to turn"),
        ({"robot": "turner", "chambers": 2, "chamber_axis": "y"}, "wanted some that differ from left to right"),
    ],
)
def test_chambers_and_timings_that_do_not_fit_are_refused_before_any_simulation(changes, message):
    with pytest.raises(ValueError, match=message):
        build(dataclasses.replace(TINY, **changes))


def test_chambers_that_overlap_are_refused():
    other = dataclasses.replace(BOTH[1], center=(0.01, 0.012, 0.011))
    with pytest.raises(ValueError, match="'right' overlapping 'left'"):
        Domain(size=(0.02,) * 3, particles=(10,) * 3, origin=(0.0, 0.0, 1e-3), chambers=(BOTH[0], other))


def test_a_measured_pressure_is_that_of_every_chamber_and_has_no_timing(tmp_path):
    file = tmp_path / "measured.csv"
    file.write_text("time_s,pressure_pa\n0,0\n0.01,50e3\n0.02,10e3\n")
    both = walker(tiny(tmp_path, chambers=2, pressure_file=file)).pressure
    assert both.at(vector(0.02)).tolist() == [[50e3], [50e3]]
    with pytest.raises(ValueError, match=r"designed = .*: wanted none with a pressure that is measured"):
        walker(tiny(tmp_path, chambers=2, pressure_file=file, timing=("phase",)))
    with pytest.raises(ValueError, match="pressure_file: beside phases, wanted valves or"):
        walker(tiny(tmp_path, chambers=2, pressure_file=file, phases=(0.0, 0.5)))
