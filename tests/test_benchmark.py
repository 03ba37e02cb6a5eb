"""The recipe ``benchmark.py`` on small settings, and the naive step that it compares with."""

from __future__ import annotations

import dataclasses
import json
from types import ModuleType

import pytest
import torch
import tyro

from torchsoro import Prony, Simulator, Solid, Waveform, fill, ground
from torchsoro.benchmark import naive, sections, timing
from torchsoro.simulation.ops.affine import velocity_gradient

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    return sections


def small(benchmark, **changes):
    fixed = {"formulation": "updated", "device": "cpu", "size": 512, "particles": (512,), "table_steps": 4}
    return benchmark.Options(**(fixed | {"repeats": 1} | changes))


# The body ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [512, 2000, 4096, 8000, 16_384, 64_000, 216_000, 512_000, 2_000_376])
def test_body_has_about_the_particles_asked_for_and_a_chamber(count):
    domain = timing.walker(count)
    assert domain.count == pytest.approx(count, rel=0.05)
    assert domain.gas.any() and domain.wall.any() and domain.design.any()


def test_paper_size_is_the_papers_walker():
    case = timing.Case(count=64_000, formulation="updated", device=CPU, steps=75_000)
    assert case.domain.cell == pytest.approx(1.75e-3)
    assert (int(case.domain.gas.sum()), int(case.domain.wall.sum())) == (4096, 3904)
    assert case.substep == 1e-5


def test_states_are_kept_for_as_many_steps_as_taichi_can_index():
    case = timing.Case(count=216_000, formulation="updated", device=CPU, steps=500)
    kept = case.kept()
    assert kept.steps * 42 * 216_000 < 2**31 and kept.steps * 4 * 42 * 216_000 < kept.budget
    assert case.recomputed().segment == min(250, kept.steps)


def test_floor_of_the_papers_walker_is_its_state_there_and_back():
    updated, total = (
        timing.least_bytes(timing.Case(count=64_000, formulation=f, device=CPU, steps=1)) for f in ("updated", "total")
    )
    assert updated == 4 * (64_000 * (84 + 7) + 23**3 * 14)
    assert total == 4 * (64_000 * (36 + 4) + 22**3 * 19)


# The naive step ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_naive_step_falls_freely_and_keeps_its_momentum():
    domain = timing.walker(512)
    body = fill(domain, torch.full((domain.count,), 0.9), solid=Solid())
    dt, steps, cell = 2e-5, 20, domain.cell
    stepper = naive.Naive(body, Prony.paper(3), cell=cell, dt=dt, low=(-2 * cell,) * 3, nodes=(8,) * 3, ground=False)
    for _ in range(steps):
        stepper.step()
    speed = -9.81 * dt * steps
    torch.testing.assert_close(
        stepper.velocity, torch.tensor([0.0, 0.0, speed]).expand(domain.count, 3), rtol=1e-4, atol=1e-8
    )
    fallen = -9.81 * dt**2 * steps * (steps + 1) / 2
    assert float((stepper.position - body.position)[:, 2].mean()) == pytest.approx(fallen, rel=1e-3)

    generator = torch.Generator().manual_seed(0)
    noise = 0.1 * torch.randn(domain.count, 3, generator=generator)
    stepper.v.from_numpy(noise.numpy())
    before = (body.mass.double()[:, None] * noise.double()).sum(0)
    for _ in range(steps):
        stepper.step(20e3)
    after = (body.mass.double()[:, None] * stepper.velocity.double()).sum(0)
    gained = torch.tensor([0.0, 0.0, speed]).double() * body.mass.double().sum()
    scale = float((body.mass[:, None] * noise.abs()).sum())
    torch.testing.assert_close(after - before, gained, rtol=0, atol=1e-6 * scale)
    assert not torch.allclose(stepper.velocity, noise, atol=0.01)


@pytest.mark.slow
def test_naive_step_is_the_simulators():
    domain = timing.walker(512)
    body = fill(domain, torch.full((domain.count,), 0.9), solid=Solid())
    generator = torch.Generator().manual_seed(0)
    body = dataclasses.replace(body, velocity=0.1 * torch.randn(domain.count, 3, generator=generator))
    dt, steps, cell, pressure = 2e-5, 40, domain.cell, 20e3
    stepper = naive.Naive(body, Prony.paper(3), cell=cell, dt=dt, low=(-4 * cell,) * 3, nodes=(16,) * 3)
    # The simulator begins with the gradient of the velocities.
    origin, x, v = torch.tensor([[-4 * cell, -4 * cell, 0.0]]), body.position[None], body.velocity[None]
    stepper.C.from_numpy(velocity_gradient(x, v, origin=origin, cell=cell)[0].numpy())
    for _ in range(steps):
        stepper.step(pressure)
    seen = Simulator(cell=cell, dt=dt, low=(-4 * cell,) * 3, high=(12 * cell,) * 3)(
        body,
        duration=steps * dt,
        prony=Prony.paper(3),
        pressure=Waveform(time=torch.tensor([0.0, 1.0]), pressure=torch.full((2,), pressure)),
        planes=[ground()],
        probes=torch.arange(domain.count),
        sample_every=steps * dt,
    )
    assert float((seen.position[-1] - seen.position[0]).abs().max()) > 1e-5
    # The two add up a stress in another order; 4e-8 is ten units in the last place of a place of 35 mm.
    torch.testing.assert_close(stepper.position, seen.position[-1], rtol=0, atol=4e-8)
    # Random velocities of 0.1 m/s: a thousandth, as rounding decides whether a node that hardly moves is held.
    torch.testing.assert_close(stepper.velocity, seen.velocity[-1], rtol=0, atol=1e-4)


# The sections -----------------------------------------------------------------------------------------------------


# The updated form's kernels in single precision take half a minute to compile.
forms = pytest.mark.parametrize("form", ["total", pytest.param("updated", marks=pytest.mark.slow)])


@forms
def test_measures_every_case(benchmark, form):
    case = timing.Case(count=512, formulation=form, device=CPU, steps=4)
    row = benchmark.measure(case, repeats=1, bandwidth=1e10)
    assert (row["particles"], row["kept: steps"], row["kept [GB]"]) == (512, 4, None)
    assert row["forward [us]"] * row["forward [M/s]"] == pytest.approx(512)
    for name in ("kept", "recomputed"):
        assert row[f"{name} [us]"] * row[f"{name} [M/s]"] == pytest.approx(512)


@forms
def test_prints_a_line_for_each_size_and_writes_all_numbers(benchmark, capsys, tmp_path, form):
    path = tmp_path / "numbers.json"
    options = small(benchmark, formulation=form, only=("table", "bits", "five"), steps=6, json=path)
    results = benchmark.run(options)
    out, err = capsys.readouterr()
    assert "CPU threads" in out and "512 particles" in err
    lines = out.splitlines()
    assert lines[lines.index("Sizes") + 2].split()[:2] == ["512", form]
    assert all(results["bits"][0][name] is True for name in ("L", "gradient", "equal"))
    assert results["rollout"][0]["steps"] == 6
    assert results["five"][0]["both, ratio"] > 0
    assert json.loads(path.read_text()) == results


def test_says_what_cannot_be_measured_and_goes_on(capsys):
    with timing.skipping("2,000 particles"):
        raise ValueError("memory_budget = 1 MiB: wanted at least 2 MiB")
    assert "2,000 particles: not measured: memory_budget" in capsys.readouterr().out


@pytest.mark.slow
def test_finds_where_the_time_goes(benchmark):
    found = benchmark.where(small(benchmark))
    assert {row["part"] for row in found["tasks"]} == {"forward", "recompute", "adjoint"}
    assert sum(row["share [%]"] for row in found["tasks"]) == pytest.approx(100)
    assert found["split"][0]["adjoint [us]"] > 0


@pytest.mark.slow
def test_sets_the_clock_against_the_kernels_own_time(benchmark):
    one, many = benchmark.host(small(benchmark, formulation="total"))
    assert (one["bodies"], many["bodies"]) == (1, 64)
    for row in (one, many):
        assert row["forward, ratio"] == pytest.approx(row["forward [us]"] / row["forward, kernels [us]"])
        assert row["both, kernels [us]"] > row["forward, kernels [us]"] > 0


def test_names_the_loops_of_the_kernels():
    tasks = {
        "substep_c80_0_kernel_0_serial": 1.0,
        "substep_c80_0_kernel_1_range_for": 10.0,
        "substep_c80_0_kernel_3_range_for": 20.0,
        "other_c1_0_kernel_2_range_for": 3.0,
    }
    node, particle = timing.LOOPS["substep"]
    assert timing.named(tasks, gpu=True) == {
        f"substep: {node}": ("substep", 10.0),
        f"substep: {particle}": ("substep", 20.0),
        "substep: bounds, clock": ("substep", 1.0),
        "other: loop 1": ("other", 3.0),
    }
    del tasks["substep_c80_0_kernel_1_range_for"]
    assert timing.named(tasks, gpu=False)[f"substep: {node}"] == ("substep", 1.0)


def test_paper_adds_what_is_required(benchmark):
    desk, paper = (small(benchmark, preset=preset) for preset in ("desk", "paper"))
    assert desk.sections == ("naive", "table", "where")
    assert paper.sections == ("naive", "table", "where", "host", "rollout", "bits", "five")
    assert benchmark.Options(preset="paper", device="cpu").case("total").domain.count == 64_000
    whole = {"formulation": "total", "particles": 64_000, "steps": 75_000}
    results = {
        "rollout": [whole | {"forward [us/step]": 41.0, "both [s]": 9.0, "memory [GB]": 8.0}],
        "bits": [whole | {"equal": False}, whole | {"formulation": "updated", "steps": 300, "equal": True}],
    }
    rows = benchmark.beside_the_required(results, ("updated", "total"))
    assert [row["total"] for row in rows] == [41.0, 9.0, 8.0, False, None, None]
    assert [row["updated"] for row in rows] == [None] * 6


def test_prints_aligned_columns(capsys):
    rows = [{"step": "naive", "us": 12345.6, "n": None}, {"step": "b", "us": 0.12345, "n": 64_000}]
    timing.table("Title", rows)
    want = ["", "Title", "  step       us       n", "  naive  12,346       -", "  b      0.1235  64,000"]
    assert [line.rstrip() for line in capsys.readouterr().out.splitlines()] == want


def test_command_line_explains_every_option(benchmark, capsys):
    with pytest.raises(SystemExit):
        tyro.cli(benchmark.Options, args=["--help"])
    out = capsys.readouterr().out
    for field in dataclasses.fields(benchmark.Options):
        assert f"--{field.name.replace('_', '-')}" in out


def test_measures_on_cuda(benchmark, cuda):
    case = timing.Case(count=512, formulation="updated", device=cuda, steps=4)
    assert benchmark.measure(case, repeats=1, bandwidth=1e12)["kept [GB]"] > 0
    steps = benchmark.naive_step(small(benchmark, device="cuda"))
    assert [row["step"] for row in steps] == ["naive", "updated"]
