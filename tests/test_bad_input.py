"""Command lines of a robot's recipes: a message and exit code 2 for what is wrong, and nothing half-written."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import re
import shutil
import typing
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import hypothesis
import pytest
import torch
from hypothesis import strategies as st
from tiny import TINY

from torchsoro.design import loop
from torchsoro.design.robot import walker
from torchsoro.design.settings import Settings
from torchsoro.errors import SimulationDiverged
from torchsoro.output.archive import save_design
from torchsoro.storage import plain_settings

STARTED = "the simulation started"
FOUND = {"L": 0.01, "stride": 0.01, "C": 0.01, "C_limit": 0.0125, "C_within_limit": True, "mass": 0.02}


@dataclasses.dataclass(frozen=True)
class Ended:
    """How a command line ended: exit code, and what it said on both streams."""

    code: int
    said: str


@contextlib.contextmanager
def without_simulation(recipes: dict[str, ModuleType]) -> Iterator[None]:
    """Everything but the simulations; those of a design loop and of a check diverge at once."""

    def diverge(*_: Any, **__: Any) -> Any:
        raise SimulationDiverged(step=1, time=0.1, particle=None, quantity=STARTED, remedy="nothing")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "simulate", diverge)
        patch.setattr("torchsoro.output.comparison.perform", diverge)
        patch.setattr("torchsoro.output.delivery.show", lambda *_, **__: (FOUND, SimpleNamespace(report=STARTED)))
        yield


def run(recipes: dict[str, ModuleType], recipe: str, *arguments: str) -> Ended:
    """Run a recipe in this process; any other exception than the end of the process goes through."""
    streams, code = io.StringIO(), 0
    with without_simulation(recipes), contextlib.redirect_stdout(streams), contextlib.redirect_stderr(streams):
        try:
            recipes[recipe].cli(list(arguments))
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
    return Ended(code, " ".join(streams.getvalue().replace("\u2502", " ").split()))


def table(path: Path, *rows: str) -> Path:
    """A file of measured pressures."""
    path.write_text("time_s,pressure_pa\n" + "\n".join(rows) + "\n")
    return path


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """The folder of a finished run, without having run it."""
    folder = tmp_path_factory.mktemp("finished") / "robot"
    robot = walker(TINY)
    gamma = robot.field().detach()
    save_design(folder / "design.npz", robot.domain, gamma)
    save_design(folder / "shapes" / "00000.npz", robot.domain, gamma)
    (folder / "settings.json").write_text(json.dumps(plain_settings(dataclasses.asdict(TINY))))
    (folder / "metrics.csv").write_text("iteration,objective/L,constraint/C\n0,0.01,0.2\n")
    (folder / "result.json").write_text(json.dumps(FOUND))
    return folder


# Each line: recipe, arguments, what the message names. In arguments "{in}" is a folder of inputs.
WRONG = [
    ("walker", ["--youngs-modulus", "0.44"], "youngs_modulus = 0.44 Pa: wanted at least 1000 Pa; 0.44 MPa is 440000"),
    ("walker", ["--pressure", "80"], "pressure = 80 Pa: wanted from 440 to"),
    ("walker", ["--slope", "30"], "slope = 30: wanted rise over run, at most 2; 30 % is 0.3, 30 degrees are 0.577"),
    ("walker", ["--robot", "climber"], "robot = 'climber': wanted 'walker'; recipes/climber.py"),
    ("climber", ["--robot", "walker"], "robot = 'walker': wanted 'climber'"),
    ("walker", ["--iterations", "9" * 20], f"iterations = {'9' * 20}: wanted at most 1000000"),
    ("walker", ["--frequency", "1e9"], "frequency = 1e+09 Hz: wanted at most 200 Hz"),
    ("walker", ["--port", "1"], "port = 1 m: wanted 0, or"),
    ("walker", ["--port", "1e-9"], "port = 1e-09 m: wanted 0, or"),
    ("walker", ["--chamber-until", "5"], "chamber_until = 5: without chamber_design, wanted place or size there"),
    (
        "walker",
        ["--chambers", "2", "--chamber-axis", "y", *"--chamber-centers -0.00875 0 0.0175 0.00875 0 0.0175".split()],
        r"the port of 'chamber 2' runs into chamber 'chamber 1'",
    ),
    ("walker", ["--offset", "1"], "offset = 1 m: wanted at most a quarter"),
    ("walker", ["--air-density", "-3"], "air_density = -3.0: wanted finite and positive or 'auto'"),
    ("walker", ["--particles", "6000", "6000", "6000"], "GiB"),
    ("walker", ["--duration", "9e4"], "GiB"),
    ("walker", ["--resume", "--overwrite"], "resume and overwrite: wanted one of them"),
    ("walker", ["--resume"], "holds no run"),
    ("walker", ["--material", "{in}/none.toml"], "none.toml"),
    ("walker", ["--pressure-file", "{in}/none.csv"], "none.csv"),
    ("walker", ["--pressure-file", "{in}/binary.csv"], "binary.csv"),
    ("walker", ["--pressure-file", "{in}/nan.csv"], "nan.csv, line 3: got pressure_pa = 'nan'"),
    ("walker", ["--pressure-file", "{in}/kilo.csv"], "kilo.csv, largest = 80 Pa: wanted from 440"),
    ("walker", ["--pressure-file", "{in}/late.csv"], "late.csv: from 5 to 6 s, wanted times that begin"),
    ("walker", ["--pressure-file", "{in}/short.csv"], "short.csv: from 0 to 0.01 s, wanted times that begin"),
    ("walker", ["--pressure-file", "{in}"], "wanted an existing CSV file|want an existing CSV file"),
    ("replay", ["nobody"], "robot = 'nobody': wanted"),
    ("replay", ["{in}/robot", "--cycles", "0"], "cycles = 0.0: wanted finite and positive"),
    ("replay", ["{in}/robot", "--cycles", "1e300"], "cycles = 1e+300: wanted at most 1000"),
    ("replay", ["{in}/robot", "--settle", "-1"], "settle = -1.0: wanted at least 0"),
    ("replay", ["{in}/robot", "--frames", "0"], "frames = 0: wanted at least 1"),
    ("replay", ["{in}/list"], "settings.json holds a list"),
    ("replay", ["--archive", "{in}/robot", "--name", "a/b"], "name = 'a/b': wanted a plain name"),
    ("compare", ["{in}/robot", "--only", "none"], "only = none: wanted some of design"),
    ("compare", ["{in}/robot", "--iterations", "7"], "iterations = \\[7\\]: wanted some of those that .* kept: 0"),
    ("compare", ["{in}/list"], "settings.json holds a list"),
    ("compare", ["{in}/bare"], "bare has no metrics.csv, wanted a finished run"),
]


@pytest.fixture(scope="module")
def inputs(finished, tmp_path_factory) -> Path:
    """Files and folders that are wrong in one way each."""
    folder = tmp_path_factory.mktemp("inputs")
    (folder / "binary.csv").write_bytes(bytes(range(256)) * 4)
    table(folder / "nan.csv", "0,0", "1,nan")
    table(folder / "kilo.csv", "0,0", "1,80")
    table(folder / "late.csv", "5,0", "6,80e3")
    table(folder / "short.csv", "0,0", "0.01,80e3")
    for name in ("robot", "list", "bare"):
        shutil.copytree(finished, folder / name)
    (folder / "list" / "settings.json").write_text("[1, 2]")
    (folder / "bare" / "metrics.csv").unlink()
    return folder


@pytest.mark.parametrize(
    ("recipe", "arguments", "message"), WRONG, ids=lambda value: " ".join(value) if isinstance(value, list) else ""
)
def test_wrong_input_is_named_before_any_work_and_leaves_no_file(recipe, arguments, message, recipes, inputs, tmp_path):
    given = [word.replace("{in}", str(inputs)) for word in arguments]
    ended = run(recipes, recipe, *given, "--out", str(tmp_path / "out"))
    assert ended.code == 2, ended
    assert re.search(message, ended.said) or message in ended.said, ended
    assert "weights_only" not in ended.said and STARTED not in ended.said
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("recipe", ["walker", "climber", "replay", "compare"])
@pytest.mark.parametrize("below", ["", "a/b"])
def test_a_folder_for_results_that_is_a_file_or_lies_under_one_is_refused(recipe, below, recipes, finished, tmp_path):
    (tmp_path / "out").write_text("mine")
    robot = [] if recipe in ("walker", "climber") else [str(finished)]
    ended = run(recipes, recipe, *robot, "--out", str(tmp_path / "out" / below))
    assert ended.code == 2 and "out = " in ended.said and "is a file, wanted a folder" in ended.said
    assert (tmp_path / "out").read_text() == "mine"


def test_a_run_that_diverges_at_once_can_be_started_again_with_other_settings(recipes, tmp_path):
    for pressure in ("90e3", "80e3"):
        ended = run(recipes, "walker", "--out", str(tmp_path / "out"), "--pressure", pressure)
        assert ended.code == 1 and STARTED in ended.said
        assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("damage", ["shape", "optimizer"])
def test_a_checkpoint_that_does_not_fit_the_run_is_refused_and_stays_whole(damage, recipes, straight, tmp_path):
    shutil.copytree(straight[0], tmp_path / "run")
    file = tmp_path / "run" / "checkpoint.pt"
    payload = torch.load(file, weights_only=True)
    if damage == "shape":
        payload["items"]["field"]["phi"] = torch.zeros(3, 3, 3)
    else:
        del payload["items"]["adam"]
    torch.save(payload, file)
    held = file.read_bytes()
    words = {"shape": r"does not fit the run \(a design of shape \(3, 3, 3\)", "optimizer": "lacks adam"}
    with pytest.raises(ValueError, match=rf"checkpoint\.pt {words[damage]}"):
        recipes["walker"].main(dataclasses.replace(TINY, out=tmp_path / "run", resume=True))
    assert file.read_bytes() == held


# Drawn command lines --------------------------------------------------------------------------------------------------

NUMBERS = ["0", "-1", "1", "3", "0.5", "nan", "inf", "-inf", "1e-300", "1e300", "1e9", "9" * 20, "abc", "", "80e3"]
KINDS = typing.get_type_hints(Settings)


@st.composite
def flags(draw: st.DrawFn, names: Sequence[str], counts: dict[str, int]) -> list[str]:
    """Up to three flags, each with values of any kind, one too few or too many now and then."""
    words = []
    for name in draw(st.lists(st.sampled_from(names), min_size=1, max_size=3, unique=True)):
        count = max(0, counts.get(name, 1) + draw(st.sampled_from([0] * 8 + [-1, 1])))
        words += [
            "--" + name.replace("_", "-"),
            *draw(st.lists(st.sampled_from(NUMBERS), min_size=count, max_size=count)),
        ]
    return words


WIDTHS = {name: len(typing.get_args(kind)) for name, kind in KINDS.items() if typing.get_origin(kind) is tuple}
DESIGN = [name for name in KINDS if name not in ("out", "preset", "resume", "amend", "overwrite")]


def check_outcome(ended: Ended, folder: Path, written: set[str]) -> None:
    """A message with exit code 2 and no file, or a start of the simulation; no file that is cut off."""
    assert ended.code in (0, 1, 2), ended
    assert ended.said and "Traceback" not in ended.said
    there = {file.name for file in folder.rglob("*") if file.is_file()}
    if ended.code == 2:
        assert STARTED not in ended.said and not there, ended
    else:
        assert STARTED in ended.said and there <= written, ended


@pytest.mark.slow
@hypothesis.settings(max_examples=40)
@hypothesis.given(recipe=st.sampled_from(["walker", "climber"]), words=flags(DESIGN, WIDTHS))
def test_drawn_settings_start_a_run_or_are_refused_without_a_file(recipe, words, recipes, tmp_path_factory):
    folder = tmp_path_factory.mktemp("drawn")
    ended = run(recipes, recipe, "--preset", "desk", "--out", str(folder / "run"), *words)
    check_outcome(ended, folder, set())


@hypothesis.given(words=flags(["cycles", "settle", "frames", "device", "void"], {"void": 0}))
def test_drawn_options_replay_a_robot_or_are_refused_without_a_file(words, recipes, finished, tmp_path_factory):
    folder = tmp_path_factory.mktemp("drawn")
    ended = run(recipes, "replay", str(finished), "--out", str(folder / "out"), *words)
    check_outcome(ended, folder, set())


@hypothesis.given(words=flags(["only", "iterations", "device"], {"only": 2, "iterations": 2}))
def test_drawn_options_compare_a_robot_or_are_refused_without_a_file(words, recipes, finished, tmp_path_factory):
    folder = tmp_path_factory.mktemp("drawn")
    ended = run(recipes, "compare", str(finished), "--out", str(folder / "out"), *words)
    check_outcome(ended, folder, {"compare.json", "settings.json", "metrics.csv", "design.npz"})
    if ended.code == 0:
        assert json.loads((folder / "out" / "compare.json").read_text())["rows"]
