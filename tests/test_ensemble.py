"""Design runs in scenarios: what is judged and summed, resume, files, several processes, and runs without scenarios."""

from __future__ import annotations

import csv
import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tiny import TINY, tiny

import torchsoro.design.ensemble
import torchsoro.design.robot
from torchsoro.design import loop
from torchsoro.design.ensemble import Ensemble, Evaluation, evaluate, fallen, overall
from torchsoro.design.outcome import Outcome
from torchsoro.design.processes import Processes
from torchsoro.design.robot import Robot, walker
from torchsoro.design.scenarios import ScenarioBatch
from torchsoro.errors import SimulationDiverged
from torchsoro.output.archive import load_design
from torchsoro.output.robustness import UNSEEN, compare_scenarios
from torchsoro.simulation.ops.lanes import fewest, lay_out
from torchsoro.simulation.ops.lattice import Lattice

RECIPES = Path(__file__).parents[1] / "recipes"
MEMORY = 0.04  # GiB, in which twice as many lanes keep states more often
MANY = {"scenarios": 5, "risk": "cvar:0.5", "fresh": True, "dt": "auto"}


def robot_of(**changes: Any) -> Robot:
    made = walker(dataclasses.replace(TINY, **{**MANY, **changes}))
    with torch.no_grad():
        made.field.phi.copy_(torch.linspace(-0.1, 0.3, 8).reshape(8, 1, 1) + 0.05 * torch.linspace(-1, 1, 8))
    return made


def alone(made: Robot, batch: ScenarioBatch, k: int) -> ScenarioBatch:
    """One scenario of a batch, as often as it takes for the same bits: a lane does not see what is beside."""
    return batch.part([k] * made.carried(1, batch.count))


def metrics(path: Path) -> list[dict[str, str]]:
    """Rows of the metrics without the seconds, which no two runs share."""
    with (path / "metrics.csv").open(newline="") as file:
        return [{k: v for k, v in row.items() if not k.startswith("time/")} for row in csv.DictReader(file)]


def assert_same_run(one: Path, other: Path) -> None:
    assert metrics(one) == metrics(other)
    found = [torch.load(path / "checkpoint.pt", weights_only=True)["items"] for path in (one, other)]
    assert torch.equal(found[0]["field"]["phi"], found[1]["field"]["phi"])
    assert found[0].keys() == found[1].keys()
    for part in found[0].keys() & {"supply", "placement"}:
        for name, value in found[0][part].items():
            assert torch.equal(value, found[1][part][name])
    assert found[0]["best"]["iteration"] == found[1]["best"]["iteration"]


@pytest.fixture(scope="module")
def designed(recipes, tmp_path_factory) -> tuple[Path, dict[str, float]]:
    """A run in fresh scenarios."""
    path = tmp_path_factory.mktemp("scenarios") / "run"
    return path, recipes["walker"].main(tiny(path, **MANY))


def test_scenarios_are_fresh_in_each_iteration_and_the_same_ones_when_asked_again():
    made = robot_of()
    one, two = Ensemble(made).sample(0), Ensemble(made).sample(1)
    assert not torch.equal(one.friction, two.friction)
    assert torch.equal(two.friction, Ensemble(made).sample(1).friction)
    fixed = Ensemble(robot_of(fresh=False, scenario_seed=1))
    assert torch.equal(fixed.sample(0).friction, two.friction)
    assert torch.equal(fixed.sample(7).friction, two.friction)


@pytest.mark.parametrize(("count", "carried"), [(5, 5), pytest.param(9, 16, marks=pytest.mark.slow)])
def test_a_gradient_is_the_sum_over_scenarios_of_the_gradients_of_single_runs(count, carried):
    made = robot_of(scenarios=count, clip=0.0, lightness=0.1, dt=1e-4)
    assert made.carried(count) == carried
    ensemble = Ensemble(made)
    gamma = made.field()
    outcome = ensemble.judge(gamma, 3, 1.0)
    aims = loop.aim(made, outcome, 3)
    (found,) = ensemble.gradient(gamma, aims)
    batch = ensemble.sample(3)
    singles = [made(made.field(), scenarios=alone(made, batch, k)) for k in range(count)]
    values = torch.cat([loop.aim(made, one, 3)[:1] for one in singles])
    assert torch.equal(aims, values)
    (wanted,) = torch.autograd.grad(-overall(made, values), made.field.phi)
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-5 * float(wanted.abs().max()))
    assert torch.equal(found, found.flip(1))


def test_two_chambers_with_a_designed_timing_in_three_scenarios_have_the_gradients_of_single_runs():
    timing = {"chambers": 2, "timing": ("amplitude", "phase", "duty"), "phases": (0.0, 0.2), "amplitudes": (0.9, 0.8)}
    made = robot_of(**timing, scenarios=3, clip=0.0, dt=1e-4, lag_range=(0.0, 0.003))
    ensemble, designed = Ensemble(made), made.supply.designed()
    gamma = made.field()
    aims = loop.aim(made, ensemble.judge(gamma, 1, 1.0), 1)
    found = ensemble.gradient(gamma, aims)
    batch = ensemble.sample(1)
    singles = [made(made.field(), scenarios=alone(made, batch, k)) for k in range(3)]
    values = torch.cat([loop.aim(made, one, 1)[:1] for one in singles])
    assert torch.equal(aims, values)
    wanted = torch.autograd.grad(-overall(made, values), (made.field.phi, *designed))
    assert [one.shape for one in found] == [one.shape for one in wanted]
    for one, other in zip(found, wanted, strict=True):
        assert float(other.abs().min()) > 0 or other is wanted[0]
        torch.testing.assert_close(one, other, rtol=0, atol=1e-5 * float(other.abs().max()))


def test_designed_chambers_in_three_scenarios_have_the_gradients_of_single_runs():
    placed = {"chamber_design": ("place", "size"), "modulus_range": (0.8, 1.2), "density_range": (0.9, 1.1)}
    made = robot_of(**placed, scenarios=3, clip=0.0, lightness=0.1, dt=1e-4)
    assert made.placement is not None
    with torch.no_grad():
        made.placement.size += 0.3 * made.domain.spacing
        made.placement.center[:, 0] += 0.2 * made.domain.spacing
    ensemble, designed = Ensemble(made), made.placement.designed()
    gamma = made.density()
    outcome = ensemble.judge(gamma, 1, 1.0)
    aims = loop.aim(made, outcome, 1)
    found = ensemble.gradient(gamma, aims)
    batch = ensemble.sample(1)
    singles = [made(made.density(), scenarios=alone(made, batch, k)) for k in range(3)]
    assert torch.equal(outcome.intermediate, singles[0].intermediate)
    values = torch.cat([loop.aim(made, one, 1)[:1] for one in singles])
    assert torch.equal(aims, values)
    wanted = torch.autograd.grad(-overall(made, values), (made.field.phi, *designed))
    assert len(found) == 3
    for one, other in zip(found, wanted, strict=True):
        assert float(other.abs().max()) > 0
        torch.testing.assert_close(one, other, rtol=0, atol=2e-5 * float(other.abs().max()))


def test_each_scenario_counts_with_its_part_of_the_clip_and_what_overflows_is_counted(monkeypatch):
    made = robot_of(risk="mean", clip=0.01)
    ensemble = Ensemble(made)
    gamma = made.field()
    aims = loop.aim(made, ensemble.judge(gamma, 0, 1.0), 0)
    real = Ensemble._pulled
    (pulled,) = real(ensemble, torch.autograd.grad(-aims.mean(), ensemble._all, retain_graph=True)[0])
    for factor, lost in (
        ([1.0, 1e6, 1.0, 1.0, 1.0], 0),
        ([1.0, np.inf, 1.0, 1.0, 1.0], 1),
        ([np.nan] * 3 + [1.0] * 2, 3),
    ):
        rows = pulled * torch.tensor(factor)[:, None]
        monkeypatch.setattr(Ensemble, "_pulled", lambda self, bars, rows=rows: [rows])
        (found,) = ensemble.gradient(gamma, aims)
        assert ensemble.lost == lost
        assert bool(found.isfinite().all()) == (lost < 3)
        if lost < 3:
            assert float(found.norm()) <= 0.01


def outcome_of(fall: list[float], travel: list[float]) -> Outcome:
    values = {name: torch.tensor(travel) for name in ("travel", "feet", "soles", "inflated")}
    rest: Any = dict.fromkeys(("turn", "turn_inflated", "intermediate", "mass", "center", "trajectory", "dt"))
    return Outcome(**values, fall=torch.tensor(fall), **rest)


def test_the_lowest_tenth_of_a_run_is_that_of_an_evaluation():
    travel = np.linspace(0.03, 0.01, 20)
    judged = loop.spread(robot_of(scenarios=20), outcome_of([0.0] * 20, travel.tolist()), 0)
    whole = Evaluation(batch=ScenarioBatch(count=20), travel=travel, fall=travel, fell=travel > 1, errors={}).numbers()
    assert judged["scenarios/L_tenth"] == pytest.approx(np.sort(travel)[:2].mean()) == whole["L_lowest_tenth"]


def test_a_design_fell_where_those_that_fell_are_more_than_half_of_the_risk():
    height = TINY.size[2]
    one = outcome_of([0.0, 0.2 * height, 0.0, 0.0, 0.0], [0.01, 0.02, 0.03, 0.04, 0.05])
    assert fallen(robot_of(), one).tolist() == [False, True, False, False, False]
    for risk, fell in (("mean", False), ("worst", True), ("cvar:0.2", True), ("cvar:0.6", False)):
        assert loop.fell(robot_of(risk=risk, upright=10.0), one) == fell, risk
    assert not loop.fell(robot_of(risk="worst", upright=0.0), one)


def test_a_scenario_that_breaks_down_is_named_and_halves_the_step_of_all(monkeypatch):
    made = robot_of(halvings=1, scenarios=9)
    ensemble, steps = Ensemble(made), []
    real = Robot.forward
    failures = 1

    def fragile(self: Robot, *args: Any, **how: Any) -> Outcome:
        steps.append(how["dt"])
        if len(steps) <= failures:
            raise SimulationDiverged(step=1, time=0.1, particle=2, quantity="J <= 0", batch=12, remedy="a smaller step")
        return real(self, *args, **how)

    monkeypatch.setattr(Robot, "forward", fragile)
    assert ensemble.judge(made.field(), 0, 1.0).dt == steps[0] / 2 == steps[1]
    steps.clear()
    failures = 2
    with pytest.raises(SimulationDiverged, match="of simulation 8: J <= 0"):  # lane 12 repeats scenario 8, the last
        ensemble.judge(made.field(), 0, 1.0)


def test_an_evaluation_tells_which_scenarios_broke_down(monkeypatch):
    made = robot_of()
    batch = made.settings.distribution.sample(20, 1)
    real = Robot.forward

    def fragile(self: Robot, gamma: torch.Tensor, **how: Any) -> Outcome:
        if bool((how["scenarios"].friction == batch.friction[3]).any()):
            raise SimulationDiverged(step=1, time=0.1, particle=2, quantity="J <= 0", remedy="a smaller step")
        return real(self, gamma, **how)

    plain = evaluate(made, made.field(), batch)
    monkeypatch.setattr(Robot, "forward", fragile)
    found = evaluate(made, made.field(), batch)
    assert list(found.errors) == [3] and "J <= 0" in found.errors[3]
    assert np.isnan(found.travel[3]) and np.isfinite(np.delete(found.travel, 3)).all()
    np.testing.assert_allclose(np.delete(found.travel, 3), np.delete(plain.travel, 3), rtol=0, atol=5e-7)
    assert found.numbers()["diverged"] == 1 and found.numbers()["L_min"] <= 0


def test_a_run_logs_the_spread_and_delivers_it(designed):
    path, result = designed
    rows = metrics(path)
    for row in rows:
        low, tenth, mean, high = (float(row[f"scenarios/L_{name}"]) for name in ("min", "tenth", "mean", "max"))
        assert low == tenth < mean < high  # a tenth of five is the lowest one
        assert low <= float(row["objective/L"]) <= mean
        assert float(row["scenarios/falls"]) == float(row["scenarios/gradients_lost"]) == 0
    events = EventAccumulator(str(path), size_guidance={"histograms": 0}).Reload()
    histograms = events.Histograms("scenarios/L")
    assert [event.step for event in histograms] == [0, 1, 2]
    assert histograms[1].histogram_value.min == pytest.approx(float(rows[1]["scenarios/L_min"]))
    assert result["L_min"] <= result["L_lowest_tenth"] <= result["L_mean"] <= result["L_max"]
    assert json.loads((path / "result.json").read_text())["L_mean"] == result["L_mean"]
    assert (path / "summary.png").exists()


def test_a_run_in_fresh_scenarios_that_is_resumed_has_the_same_bits(designed, tmp_path):
    for resume in (False, True):
        loop.optimize(walker(tiny(tmp_path / "run", **MANY, iterations=1 + 2 * resume, resume=resume)))
    assert_same_run(tmp_path / "run", designed[0])


def test_other_scenarios_are_refused_on_resume(recipes, designed):
    with pytest.raises(ValueError, match="scenario_seed is 1, the run has 0"):
        recipes["walker"].main(tiny(designed[0], **MANY, scenario_seed=1, resume=True))


def test_a_finished_robot_is_compared_in_scenarios_it_has_not_seen(designed, tmp_path, capsys):
    path, _ = designed
    found = compare_scenarios(str(path), tmp_path / "out", count=20, device="cpu")
    assert {file.name for file in (tmp_path / "out").iterdir()} == {"scenarios.csv", "scenarios.json", "scenarios.png"}
    assert json.loads((tmp_path / "out" / "scenarios.json").read_text()) == found
    assert found["seed"] == UNSEEN and found["count"] == 20
    with (tmp_path / "out" / "scenarios.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    travel = np.array([float(row["L_m"]) for row in rows])
    assert len(rows) == 20 and found["L_mean"] == pytest.approx(travel.mean(), rel=1e-6)
    assert found["L_lowest_tenth"] == pytest.approx(np.sort(travel)[:2].mean(), rel=1e-6)
    robot = walker(tiny(path, **{**MANY, "scenarios": 0}))
    batch = robot.settings.distribution.sample(20, UNSEEN)
    gamma = load_design(path / "design.npz", robot.domain)
    with torch.no_grad():
        alone = robot(gamma, scenarios=batch.part([13]))
    assert float(alone.travel) == pytest.approx(travel[13], abs=2e-8)
    assert float(rows[13]["tilt_x_degrees"]) == pytest.approx(float(batch.tilt_x[13]), rel=1e-6)
    printed = capsys.readouterr().out
    assert "lowest tenth" in printed and "0 falls" in printed


def test_robots_are_compared_in_times_that_are_not_those_of_their_design(designed, tmp_path, capsys):
    path, _ = designed
    times = {"settle": 0.015, "duration": 0.04}
    found = compare_scenarios(str(path), tmp_path / "out", count=2, device="cpu", **times)
    assert {name: found[name] for name in times} == times
    assert "; in 0.04 s" in capsys.readouterr().out
    robot = walker(tiny(path, **{**MANY, **times, "scenarios": 0}))
    gamma = load_design(path / "design.npz", robot.domain)
    with torch.no_grad():
        alone = robot(gamma, scenarios=robot.settings.distribution.sample(2, UNSEEN))
    assert [found["L_min"], found["L_max"]] == pytest.approx(alone.travel.sort().values.tolist(), abs=2e-8)


def test_parts_of_processes_are_all_scenarios_in_order():
    for world in (1, 2, 3, 5):
        parts = Processes(world=world).deal(5)
        assert [k for part in parts for k in part] == list(range(5))
        assert max(map(len, parts)) - min(map(len, parts)) <= 1
    with pytest.raises(ValueError, match="nproc-per-node = 6 processes in all: wanted at most scenarios = 5"):
        Processes(world=6).deal(5)


def test_processes_agree_on_a_text_by_its_digest(monkeypatch):
    assert Processes().agree("a")
    for other, same in ((0, True), (1, False)):
        monkeypatch.setattr(Processes, "gather", lambda self, mine, parts, other=other: torch.cat([mine, mine ^ other]))
        assert Processes(world=2).agree("settings") is same


def flags(path: Path, **changes: Any) -> list[str]:
    """The flags that make a tiny run in scenarios."""
    listed = []
    settings = tiny(path, **{**MANY, **changes})
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        name = field.name.replace("_", "-")
        if isinstance(value, bool):
            listed.append(f"--{name}" if value else f"--no-{name}")
        elif value is not None:
            listed += [f"--{name}", *map(str, value if isinstance(value, tuple) else (value,))]
    return listed


def torchrun(processes: int, path: Path, **changes: Any) -> list[str]:
    start = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(processes)]
    return [*start, str(RECIPES / "walker.py"), *flags(path, **changes)]


ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(RECIPES.parent)}


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs SIGKILL")
@pytest.mark.parametrize(
    "more",
    [
        {},
        *(
            pytest.param(more, marks=pytest.mark.slow)
            for more in (
                {"scenarios": 9},
                {"chambers": 2, "timing": ("phase", "duty"), "phases": (0.0, 0.2)},
                {"feature": 0.004},
                {"chamber_design": ("place", "size")},
            )
        ),
    ],
)
def test_two_processes_have_the_bits_of_one_and_a_killed_run_goes_on_in_one(recipes, tmp_path, more):
    path, one = tmp_path / "two", tmp_path / "one"
    # First in this process, so that those of the other run find its kernels compiled.
    recipes["walker"].main(tiny(one, **{**MANY, **more}, iterations=1))
    begin = time.monotonic()
    with (
        (tmp_path / "log").open("w") as log,
        subprocess.Popen(torchrun(2, path, **more, iterations=40), env=ENVIRONMENT, stdout=log, stderr=log) as run,
    ):
        while not (path / "checkpoint.pt").exists() and run.poll() is None and time.monotonic() < begin + 300:
            time.sleep(0.01)
        os.kill(rank_of(path, 1), signal.SIGKILL)
        killed = time.monotonic()
        assert run.wait(60) != 0
        assert time.monotonic() < killed + 60
    said = (tmp_path / "log").read_text()
    assert "are saved in" in said
    saved = torch.load(path / "checkpoint.pt", weights_only=True)["iteration"]
    assert saved < 39 and not list(path.glob("*.tmp")) and not (path / "result.json").exists()
    last = saved + 3
    if more:  # the plain run goes on in one at once, as each start of two takes seconds
        again = torchrun(2, path, **more, iterations=last - 1, resume=True)
        done = subprocess.run(again, env=ENVIRONMENT, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    recipes["walker"].main(tiny(path, **{**MANY, **more}, iterations=last, resume=True))
    recipes["walker"].main(tiny(one, **{**MANY, **more}, iterations=last, resume=True))
    assert_same_run(path, one)


def rank_of(path: Path, rank: int) -> int:
    """Number of the process that has this rank in the torchrun of a run's folder."""
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            words, given = (entry / "cmdline").read_bytes(), (entry / "environ").read_bytes().split(b"\0")
        except OSError:
            continue
        if str(path).encode() in words and f"RANK={rank}".encode() in given:
            return int(entry.name)
    raise AssertionError(f"no process of rank {rank}")


def test_more_processes_than_scenarios_and_several_starts_are_refused(recipes, monkeypatch, tmp_path):
    monkeypatch.setenv("WORLD_SIZE", "3")
    with pytest.raises(ValueError, match="nproc-per-node = 3 processes in all: wanted at most scenarios = 2"):
        recipes["walker"].main(tiny(tmp_path / "run", **{**MANY, "scenarios": 2}))
    with pytest.raises(ValueError, match="starts = 2: wanted 1 in several processes"):
        recipes["walker"].main(tiny(tmp_path / "run", **MANY, starts=2))
    assert not (tmp_path / "run").exists()


def test_lanes_are_as_many_as_a_cpu_carries():
    from torchsoro.simulation.kernels.lanes import LANES

    assert torchsoro.design.robot.LANES == LANES


@pytest.mark.parametrize("lattice", [(4, 4, 4), (8, 8, 8), (10, 12, 6)])
def test_lanes_are_simulations_from_as_many_on_as_the_layout_says(lattice):
    grid = Lattice.uniform(lattice, (0.0, 0.0, 0.0), 2e-3)
    kind = torch.zeros(lattice).flatten()
    laid = [lay_out(grid, kind, torch.full_like(kind, -1).long(), n, torch.float32).variations for n in range(1, 17)]
    assert laid.index(True) + 1 == fewest(grid)
    assert laid == sorted(laid)


def test_a_part_of_few_scenarios_has_their_gradient_bit_by_bit_without_more_lanes():
    made = robot_of(scenarios=3)
    batch, gamma = Ensemble(made).sample(0), made.field().detach()
    assert [made.carried(n, 3) for n in (1, 2, 3)] == [1, 2, 3] and made.carried(1, 20) == 16
    dt = made.step(gamma, batch)
    found = [gradients(made, gamma, batch.part(part), dt) for part in ([0, 1, 2], [0, 1], [2])]
    assert torch.equal(torch.cat(found[1:]), found[0]) and float(found[0].abs().max()) > 0


def gradients(made: Robot, gamma: torch.Tensor, batch: ScenarioBatch, dt: float) -> torch.Tensor:
    """Of each scenario's travel by its own density [S, N]."""
    rows = gamma.expand(batch.count, -1).clone().requires_grad_()
    return torch.autograd.grad(made(rows, scenarios=batch, dt=dt).travel.sum(), rows)[0]


def test_a_part_of_the_scenarios_keeps_states_as_often_as_all_and_has_their_gradient_bit_by_bit():
    made = robot_of(scenarios=20, memory=MEMORY)
    batch, gamma = Ensemble(made).sample(0), made.field().detach()
    dt = made.step(gamma, batch)
    whole = gradients(made, gamma, batch.part([*range(20), *[19] * 12]), dt)
    assert torch.equal(gradients(made, gamma, batch.part([*range(16)]), dt), whole[:16])


@pytest.mark.gpu
def test_a_scenario_on_a_gpu_has_the_same_bits_and_gradient_in_any_share(cuda):
    made = robot_of(device="cuda")
    batch, gamma = Ensemble(made).sample(0), made.field().detach()
    dt = made.step(gamma, batch)

    def of(part: list[int]) -> tuple[torch.Tensor, torch.Tensor]:
        rows = gamma.expand(len(part), -1).clone().requires_grad_()
        travel = made(rows, scenarios=batch.part(part), dt=dt).travel
        return travel.detach(), torch.autograd.grad(travel.sum(), rows)[0]

    whole = of([0, 1, 2, 3, 4])
    for part in ([0, 1, 2], [3, 4], [2]):
        for found, wanted in zip(of(part), whole, strict=True):
            assert torch.equal(found, wanted[part])
