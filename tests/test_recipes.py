"""The recipes on tiny settings: the files they promise, exact resume, and what their command lines refuse."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import imageio.v3 as iio
import imageio_ffmpeg
import numpy as np
import pytest
import torch
import trimesh
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tiny import TINY, tiny

from torchsoro.design import loop
from torchsoro.design.lagrangian import AugmentedLagrangian
from torchsoro.design.presets import CLIMBER, WALKER
from torchsoro.design.reading import from_command_line
from torchsoro.design.robot import climber, walker
from torchsoro.design.settings import Settings
from torchsoro.errors import SimulationDiverged
from torchsoro.output import delivery
from torchsoro.output.archive import load_design, load_shape

RECIPES = Path(__file__).parents[1] / "recipes"
HISTORY = {"iteration": [0.0], "objective/L": [0.0], "constraint/C": [0.2]}
TAGS = (
    "objective/L",
    "constraint/C",
    "mass",
    "cog/x",
    "cog/y",
    "cog/z",
    "multiplier/C",
    "penalty/C",
    "grad_norm/phi",
    "time/iteration",
)


def metrics(path: Path) -> list[dict[str, str]]:
    """Rows of the metrics without the seconds, which no two runs share."""
    with (path / "metrics.csv").open(newline="") as file:
        return [{k: v for k, v in row.items() if not k.startswith("time/")} for row in csv.DictReader(file)]


def items(path: Path) -> dict[str, Any]:
    return torch.load(path / "checkpoint.pt", weights_only=True)["items"]


def assert_same_run(one: Path, other: Path) -> None:
    """Equal to the bit: metrics, state and design."""
    assert metrics(one) == metrics(other)
    assert torch.equal(items(one)["field"]["phi"], items(other)["field"]["phi"])
    for name, value in items(one)["adam"]["state"][0].items():
        assert torch.equal(value, items(other)["adam"]["state"][0][name])
    designs = [np.load(path / "design.npz")["gamma"] for path in (one, other)]
    assert np.array_equal(*designs)


def test_the_settings_and_the_metrics_are_all_there(straight):
    path, result = straight
    held = json.loads((path / "settings.json").read_text())
    assert set(held) == {field.name for field in dataclasses.fields(Settings)}
    assert held["particles"] == [8, 8, 8]
    rows = metrics(path)
    assert [row["iteration"] for row in rows] == ["0", "1", "2"]
    for row in rows:
        assert all(math.isfinite(float(value)) for value in row.values())
    assert float(rows[0]["constraint/C"]) == pytest.approx(0.25)
    assert float(rows[2]["constraint/C"]) < 0.25
    assert float(rows[0]["grad_norm/phi"]) > 0
    assert result["iterations"] == 3
    # What is delivered is what was optimized.
    assert result["C"] == float(rows[2]["constraint/C"])
    assert result["L"] == pytest.approx(float(rows[2]["objective/L"]), rel=1e-6)
    assert result["stride"] == pytest.approx(result["L"])  # a single cycle
    assert 0.004 < result["mass"] < 0.05
    assert json.loads((path / "result.json").read_text()) == result
    assert result["iteration"] == 2 and result["C_limit"] == TINY.c_max and not result["C_within_limit"]
    with (path / "metrics.csv").open(newline="") as file:
        assert result["seconds"] == pytest.approx(sum(float(row["time/iteration"]) for row in csv.DictReader(file)))


def test_the_first_design_is_kept_and_is_grey_around_the_chamber(straight):
    path, _ = straight
    assert [file.name for file in (path / "shapes").iterdir()] == ["00000.npz"]
    robot = walker(TINY)
    gamma = load_shape(path, robot.domain, 0)
    assert torch.equal(gamma[robot.design], torch.full_like(gamma[robot.design], 0.5))


def test_tensorboard_shows_every_scalar_and_the_shape_every_few_iterations(straight):
    events = EventAccumulator(str(straight[0])).Reload()
    for tag in TAGS:
        assert [event.step for event in events.Scalars(tag)] == [0, 1, 2], tag
    assert [event.step for event in events.Images("shape/picture")][-1:] == [2]
    assert any("mesh" in tag for tag in events.Tags()["tensors"])


def test_the_design_and_the_part_can_be_used(straight):
    path, result = straight
    design = np.load(path / "design.npz")
    assert design["gamma"].shape == (512,)
    assert (design["shape"] == 8).all()
    assert float(design["spacing"]) == pytest.approx(0.035 / 8)
    assert design["gamma"].min() >= 0
    assert design["gamma"].max() <= 1
    lattice = design["gamma"].reshape(design["shape"])
    assert np.array_equal(lattice, lattice[:, ::-1])
    part = trimesh.load_mesh(path / "shape.stl")
    assert part.is_watertight
    assert part.is_winding_consistent
    assert 15 < part.extents.max() < 40  # mm
    report = json.loads((path / "shape.json").read_text())
    assert report["watertight"]
    # What is printed is what is denser than one half, whatever the grey around it weighs.
    dense = (design["gamma"] > 0.5).sum() * float(design["spacing"]) ** 3
    assert report["mass_g"] == pytest.approx(1070e3 * dense, rel=0.5)
    assert result["mass"] > 0


def test_the_movie_plays_and_the_summary_is_a_page(straight):
    path, _ = straight
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(path / "walker.mp4"))
    assert frames == TINY.frames
    assert seconds > 0
    page = iio.imread(path / "summary.png")
    assert min(page.shape[:2]) > 500
    assert page[..., :3].std() > 5


def test_a_resumed_run_equals_an_uninterrupted_one_to_the_bit(recipes, straight, tmp_path):
    loop.optimize(walker(tiny(tmp_path / "run", iterations=1)))
    again = recipes["walker"].main(tiny(tmp_path / "run", resume=True, picture_every=1, frames=2))
    assert_same_run(tmp_path / "run", straight[0])
    seconds = ("forward", "backward", "seconds")
    assert {k: v for k, v in again.items() if k not in seconds} == {
        k: v for k, v in straight[1].items() if k not in seconds
    }
    steps = [event.step for event in EventAccumulator(str(tmp_path / "run")).Reload().Scalars("objective/L")]
    assert steps == [0, 1, 2]


def command(settings: Settings) -> list[str]:
    """The flags that make these settings."""
    flags: list[str] = []
    for field in dataclasses.fields(settings):
        name, value = field.name.replace("_", "-"), getattr(settings, field.name)
        if isinstance(value, bool):
            flags.append(f"--{name}" if value else f"--no-{name}")
        elif value is not None:
            flags += [f"--{name}", *map(str, value if isinstance(value, tuple) else (value,))]
    return [sys.executable, str(RECIPES / "walker.py"), *flags]


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs SIGKILL")
def test_a_run_killed_within_an_iteration_resumes_to_the_same_numbers(recipes, straight, tmp_path):
    path = tmp_path / "run"
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(
        command(tiny(path)), env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as process:
        deadline = time.monotonic() + 300  # the kernels may have to be compiled
        while not (path / "checkpoint.pt").exists() and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.002)
        process.kill()
    assert process.returncode == -signal.SIGKILL
    saved = torch.load(path / "checkpoint.pt", weights_only=True)["iteration"]
    assert saved < 2  # at least one iteration is lost, and done again
    assert not (path / "summary.png").exists()
    recipes["walker"].main(tiny(path, resume=True))
    assert_same_run(path, straight[0])


def test_a_checkpoint_of_other_settings_is_refused_and_stays_whole(recipes, straight):
    path, _ = straight
    held = {file: file.read_bytes() for file in path.rglob("*.*")}
    with pytest.raises(ValueError, match=r"slope is 0\.3, the run has 0\.0"):
        recipes["walker"].main(tiny(path, resume=True, slope=0.3))
    with pytest.raises(ValueError, match="already holds a run; resume it"):
        recipes["walker"].main(tiny(path))
    assert {file: file.read_bytes() for file in path.rglob("*.*")} == held


@pytest.mark.slow
def test_a_design_with_no_body_to_print_leaves_its_numbers(recipes, tmp_path):
    # Grey everywhere but in the wall, which no design particle touches at one half.
    settings = tiny(tmp_path / "run", iterations=1, min_wall=1e-3)
    robot = walker(settings)
    gamma = 0.1 * torch.ones(robot.domain.count)
    settings.out.mkdir()
    with pytest.raises(ValueError, match="no connected body"):
        delivery.deliver(settings.out, robot, gamma, HISTORY, name="walker", more={})
    assert json.loads((settings.out / "result.json").read_text())["mass"] > 0
    assert (settings.out / "motion.html").exists() and not (settings.out / "shape.stl").exists()


def test_a_run_is_resumed_with_its_own_settings_but_for_the_flags_given(straight, tmp_path):
    path, _ = straight
    given = json.loads((path / "settings.json").read_text())
    assert given["particles"] != list(WALKER["desk"].particles)
    flags = ["--resume", "--out", str(path), "--iterations", "7", "--device", "cpu"]
    read = from_command_line(WALKER, description="walks", arguments=flags)
    told = {**given, "iterations": 7, "resume": True, "device": "cpu"}
    assert json.loads(json.dumps(dataclasses.asdict(read), default=str)) == told
    # One that was designed on a GPU goes on without, too.
    (tmp_path / "settings.json").write_text(json.dumps({**given, "device": "cuda"}))
    elsewhere = ["--resume", "--out", str(tmp_path), "--device", "cpu"]
    assert from_command_line(WALKER, description="walks", arguments=elsewhere).device == "cpu"
    preset = from_command_line(WALKER, description="walks", arguments=[*flags, "--preset", "desk"])
    assert preset.particles == WALKER["desk"].particles


def test_a_bad_schedule_is_refused_before_the_folder_is_made(recipes, tmp_path):
    for name, bad in (("penalty", 0.0), ("growth", 1.0), ("tolerance", -1.0)):
        with pytest.raises(ValueError, match=name):
            recipes["walker"].main(tiny(tmp_path / "run", **{name: bad}))
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_the_climber_raises_gravity_in_steps_and_writes_its_files(recipes, tmp_path):
    settings = tiny(
        tmp_path / "run", iterations=2, settle=0.0, gravity_steps=1, gravity_every=1, frames=2, robot="climber"
    )
    result = recipes["climber"].main(settings)
    assert result["iterations"] == 2
    names = {file.name for file in settings.out.iterdir() if not file.name.startswith("events")}
    assert names == {
        "settings.json",
        "metrics.csv",
        "checkpoint.pt",
        "design.npz",
        "shapes",
        "shape.stl",
        "shape.3mf",
        "shape.json",
        "result.json",
        "climber.mp4",
        "motion.npz",
        "motion.html",
        "summary.png",
    }
    gamma = np.load(settings.out / "design.npz")["gamma"].reshape(8, 8, 8)
    assert np.array_equal(gamma, gamma[::-1])
    assert np.array_equal(gamma, gamma[:, ::-1])


def test_every_preset_fits_together(recipes):
    for name, make in (("walker", walker), ("climber", climber)):
        for preset in ("desk", "paper"):
            settings = {"walker": WALKER, "climber": CLIMBER}[name][preset]
            assert settings.preset == preset
            assert settings.out == Path("runs") / name
            robot = make(dataclasses.replace(settings, device="cpu"))
            assert robot.domain.count == math.prod(settings.particles)


def test_a_program_that_refuses_its_input_ends_with_code_two_without_a_traceback_or_a_folder(tmp_path):
    ended = subprocess.run(
        [sys.executable, str(RECIPES / "walker.py"), "--out", str(tmp_path / "run"), "--poisson-ratio", "0.5"],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert ended.returncode == 2
    assert "error: poisson_ratio = 0.5: wanted less than 0.5\n" in ended.stderr
    assert "Traceback" not in ended.stderr
    assert not (tmp_path / "run").exists()


class Shaky(torch.nn.Module):
    """A robot that falls over where its design goes beyond one limit, and whose simulation breaks down beyond another.

    Designs come nearer to 0 by halves, 1, 0.5, 0.25, and go back to 0 at last.
    """

    def __init__(self, *, falls: float = math.inf, breaks: float = math.inf, upright: float = 1.0) -> None:
        super().__init__()
        self.settings = SimpleNamespace(upright=upright, size=(1.0, 1.0, 2.0))
        self.field: Any = torch.nn.Module()
        self.field.phi = torch.nn.Parameter(torch.ones(3))
        self.field.forward = lambda: self.field.phi + 0
        self.field.beta = 9.0
        self.falls, self.breaks = falls, breaks
        self.tried: list[float] = []

    def density(self) -> torch.Tensor:
        return self.field()

    def forward(self, gamma: torch.Tensor, *, gravity_scale: float) -> SimpleNamespace:
        assert gravity_scale == 0.5
        self.tried.append(gamma.max().item())
        if self.tried[-1] > self.breaks:
            raise SimulationDiverged(step=1, time=0.1, particle=2, quantity="J", batch=0, remedy="none")
        return SimpleNamespace(fall=torch.tensor(0.3 if self.tried[-1] > self.falls else 0.1), tried=self.tried[-1])


@pytest.mark.parametrize(
    ("limits", "tried"),
    [
        ({}, [1]),
        ({"breaks": 0.3}, [1, 0.5, 0.25]),
        ({"falls": 0.3}, [1, 0.5, 0.25]),
        ({"breaks": 0.6, "falls": 0.2}, [1, 0.5, 0.25, 0]),
        ({"falls": 0.0}, [1, 0.5, 0.25, 0]),  # then the good one itself
        ({"falls": 0.0, "upright": 0.0}, [1]),  # where falling is not punished it is no failure
    ],
)
def test_a_design_that_falls_over_or_breaks_down_goes_back_towards_the_last_good_one(recipes, limits, tried):
    robot, good = Shaky(**limits), {"phi": torch.zeros(3), "beta": 8.0}
    gamma, outcome, back = loop.simulate(robot, good, 0.5)
    assert back == (tried[-1] == 0)
    assert robot.tried == tried
    assert outcome.tried == tried[-1]
    assert gamma.requires_grad
    assert gamma.tolist() == robot.field.phi.tolist() == [tried[-1]] * 3
    assert not good["phi"].any()
    assert robot.field.beta == (8.0 if tried[-1] == 0 else 9.0)  # the good design as it was


@pytest.mark.parametrize("falls", [math.inf, 0.3])
def test_a_simulation_that_breaks_down_on_the_last_try_as_well_ends_the_run(recipes, falls):
    robot = Shaky(breaks=-1.0, falls=falls)
    with pytest.raises(SimulationDiverged):
        loop.simulate(robot, {"phi": torch.zeros(3), "beta": 8.0}, 0.5)
    assert robot.tried == [1, 0.5, 0.25, 0]


def test_a_robot_has_fallen_when_it_sank_by_more_than_a_tenth_of_its_height(recipes):
    for upright, fall, fell in ((1.0, 0.21, True), (1.0, 0.19, False), (0.01, 0.21, True), (0.0, 1.0, False)):
        outcome = SimpleNamespace(fall=torch.tensor(fall))
        assert loop.fell(Shaky(upright=upright), outcome) == fell


def test_a_fallen_design_is_not_what_later_ones_step_back_to(recipes, tmp_path, monkeypatch):
    recipe = recipes["walker"]
    monkeypatch.setattr(loop, "fell", lambda robot, outcome: True)
    monkeypatch.setattr(loop, "simulate", lambda robot, good, scale: (robot.field(), robot(robot.field()), False))
    monkeypatch.setattr(delivery, "report", lambda result, settings: "")
    monkeypatch.setattr(delivery, "deliver", lambda *_, **__: {})
    recipe.main(tiny(tmp_path / "run", iterations=2))
    start = walker(TINY).field.phi
    assert torch.equal(items(tmp_path / "run")["good"][-1]["phi"], start)
    assert not torch.equal(items(tmp_path / "run")["field"]["phi"], start)


class Overflowing(torch.autograd.Function):
    """The same number, whose gradient is not finite."""

    @staticmethod
    def forward(ctx: Any, value: torch.Tensor) -> torch.Tensor:
        return value.clone()

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor) -> torch.Tensor:
        return math.inf * grads[0]


@pytest.mark.parametrize("often, begin", [(1, 0.0), (99, 0.0), pytest.param(99, 0.5, marks=pytest.mark.slow)])
def test_a_gradient_that_overflows_changes_no_design_and_ends_the_run_only_if_it_does_so_again_and_again(
    recipes, tmp_path, monkeypatch, often, begin
):
    aim, seen = loop.aim, []

    def overflowing(*given):
        seen.append(given[0].field.phi.detach().clone())
        return Overflowing.apply(aim(*given)) if len(seen) <= often else aim(*given)

    monkeypatch.setattr(loop, "aim", overflowing)
    # A window as long as the run: without the motion's gradient, the loss levels off within a few iterations.
    robot = walker(tiny(tmp_path / "run", iterations=12, c_max=0.2499, window=12))
    with torch.no_grad():
        robot.field.phi.fill_(begin)
    if often > loop.MOST_LOST and begin:  # the first design is within the limit: the run ends with it
        assert len(loop.optimize(robot).metrics["iteration"]) == loop.MOST_LOST + 1
        assert items(robot.settings.out)["stopped"]
        return
    if often > loop.MOST_LOST:
        with pytest.raises(SimulationDiverged, match="gradient of norm"):
            loop.optimize(robot)
        assert len(seen) == loop.MOST_LOST + 1
        return
    assert len(loop.optimize(robot).metrics["iteration"]) == 12
    assert torch.equal(seen[0], seen[1]) and not torch.equal(seen[1], seen[2])
    assert all(bool(phi.isfinite().all()) for phi in seen)


def test_no_design_counts_as_the_best_before_gravity_is_whole(recipes, tmp_path, monkeypatch):
    recipe = recipes["walker"]
    delivered = []
    monkeypatch.setattr(delivery, "report", lambda result, settings: "")
    monkeypatch.setattr(delivery, "deliver", lambda path, robot, gamma, *_, **__: delivered.append(gamma) or {})
    # Every design but the first is within the limit on C.
    settings = tiny(tmp_path / "run", c_max=0.249, gravity_steps=1, gravity_every=2, iterations=2)
    recipe.main(settings)
    assert items(settings.out)["best"] is None
    robot = walker(settings)
    robot.field.load_state_dict(items(settings.out)["field"])
    assert not torch.equal(delivered[0], robot.field())  # a step beyond what was simulated
    loop.take_(robot, items(settings.out)["good"][-1])
    assert torch.equal(delivered[0], robot.field())  # without a best one the last that was simulated is delivered
    recipe.main(dataclasses.replace(settings, iterations=3, resume=True))
    last = float(metrics(settings.out)[2]["objective/L"])
    assert items(settings.out)["best"]["worth"] == pytest.approx(last / robot.domain.cell, rel=1e-6)


def test_a_design_is_better_within_the_limit_then_if_it_goes_farther_and_before_that_by_the_loss(recipes):
    better = loop.better
    soft, hard = (AugmentedLagrangian(previous=0.24, penalty=price) for price in (1.0, 1e4))
    assert better(-1.0, 0.5, None, soft)
    within, beyond = {"worth": 1.0, "violation": -0.01}, {"worth": 1.0, "violation": 0.02}
    assert better(1.1, -0.001, within, soft) and not better(0.9, -0.02, within, soft)
    assert better(-1.0, 0.0, beyond, soft) and not better(9.0, 0.001, within, soft)
    # A tenth more travel for a hundredth more of violation, at different prices.
    assert better(1.1, 0.03, beyond, soft) and not better(1.1, 0.03, beyond, hard)
    assert not better(0.9, 0.01, beyond, soft) and better(0.9, 0.01, beyond, hard)


@pytest.mark.slow
def test_without_a_design_within_the_limit_the_one_with_the_least_loss_is_delivered(recipes, tmp_path):
    settings = tiny(tmp_path / "run", c_max=1e-6, iterations=7, upright=20.0)  # the last sinks a little
    result = recipes["walker"].main(settings)
    with (tmp_path / "run" / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    loss, cell = AugmentedLagrangian(previous=0.24, penalty=settings.penalty), walker(settings).domain.cell
    violations = [float(row["constraint/C"]) - settings.c_max for row in rows]
    worths = [(float(row["objective/L"]) - settings.upright * float(row["objective/fall"])) / cell for row in rows]
    lost = [float(loss(torch.tensor(w), torch.tensor(v))) for w, v in zip(worths, violations, strict=True)]
    least = int(np.argmin(lost))
    assert least < len(rows) - 1  # not the last
    assert items(settings.out)["best"]["iteration"] == least
    assert items(settings.out)["best"]["violation"] == pytest.approx(violations[least], abs=1e-7)
    assert items(settings.out)["best"]["worth"] == pytest.approx(worths[least], rel=1e-5)
    assert result["C"] == pytest.approx(violations[least] + settings.c_max, rel=1e-2)


@pytest.mark.slow
def test_the_best_design_within_the_limit_is_delivered(recipes, tmp_path):
    settings = tiny(tmp_path / "run", c_max=0.249, iterations=2, frames=2)  # which every design but the first keeps
    result = recipes["walker"].main(settings)
    with (tmp_path / "run" / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    kept = [float(row["objective/L"]) for row in rows if float(row["constraint/C"]) <= settings.c_max]
    assert 0 < len(kept) < len(rows)
    robot = walker(settings)
    with torch.no_grad():
        robot.field.phi.copy_(items(settings.out)["best"]["phi"])
        best = robot.field()
        assert torch.equal(load_design(settings.out / "design.npz", robot.domain), best)
        assert items(settings.out)["best"]["worth"] == pytest.approx(max(kept) / robot.domain.cell, rel=1e-6)
        assert result["L"] == pytest.approx(robot(best).travel.item(), rel=1e-6)
