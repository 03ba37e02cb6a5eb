"""The run folder: what it refuses, what it writes, and that a resumed run equals an uninterrupted one."""

from __future__ import annotations

import dataclasses
import enum
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from torchsoro.design.training import RunFolder

SETTINGS = {"seed": 1, "chamber": {"wall": 0.00175, "size": (0.1, 0.2)}, "iterations": 6}


def events(path: Path) -> EventAccumulator:
    return EventAccumulator(str(path)).Reload()


def optimize(path: Path, iterations: int, *, resume: bool = False, lose: bool = False) -> torch.Tensor:
    """A noisy optimization that saves each iteration, or dies between the log and the save of the last one."""
    torch.manual_seed(3)
    model = torch.nn.Linear(4, 1)
    adam = torch.optim.Adam(model.parameters(), lr=0.05)
    settings = {**SETTINGS, "iterations": iterations}
    with RunFolder(path, settings, resume=resume, free=("iterations",)) as run:
        if state := run.load():
            model.load_state_dict(state["model"])
            adam.load_state_dict(state["adam"])
        for iteration in run.progress(iterations):
            adam.zero_grad()
            loss = model(torch.randn(8, 4)).square().mean()
            loss.backward()
            adam.step()
            values = {"objective/L": loss, "constraint/C": 0.1 * iteration}
            run.log(iteration, values if iteration % 2 else {**values, "grad_norm/phi": np.float64(loss.item() / 3)})
            if not (lose and iteration == iterations - 1):
                run.save(iteration, model=model, adam=adam)
    return torch.cat([parameter.detach().reshape(-1) for parameter in model.parameters()])


def test_a_resumed_run_equals_an_uninterrupted_one(tmp_path):
    straight = optimize(tmp_path / "straight", 8)
    optimize(tmp_path / "resumed", 5, lose=True)
    assert len((tmp_path / "resumed" / "metrics.csv").read_text().splitlines()) == 1 + 5
    resumed = optimize(tmp_path / "resumed", 8, resume=True)
    assert torch.equal(straight, resumed)
    straight_csv, resumed_csv = ((tmp_path / name / "metrics.csv").read_bytes() for name in ("straight", "resumed"))
    assert straight_csv == resumed_csv
    one, two = events(tmp_path / "straight"), events(tmp_path / "resumed")
    for tag in ("objective/L", "constraint/C", "grad_norm/phi"):
        rows = [(event.step, event.value) for event in two.Scalars(tag)]
        assert rows == [(event.step, event.value) for event in one.Scalars(tag)]
        assert len({step for step, _ in rows}) == len(rows)


def test_a_finished_run_resumes_to_nothing(tmp_path):
    before = optimize(tmp_path / "run", 3)
    table = (tmp_path / "run" / "metrics.csv").read_bytes()
    assert torch.equal(before, optimize(tmp_path / "run", 3, resume=True))
    assert (tmp_path / "run" / "metrics.csv").read_bytes() == table


def test_a_run_killed_before_its_first_checkpoint_starts_again(tmp_path):
    optimize(tmp_path / "run", 1, lose=True)
    resumed = optimize(tmp_path / "run", 4, resume=True)
    assert torch.equal(resumed, optimize(tmp_path / "other", 4))
    assert [event.step for event in events(tmp_path / "run").Scalars("objective/L")] == [0, 1, 2, 3]


KILLED = """
import os, random, signal, sys, time
import torch
from torchsoro.design.training import RunFolder

def work(path):
    run = RunFolder(path, {"seed": 1})
    for iteration in range(10**9):
        run.log(iteration, {"objective/L": iteration})
        run.save(iteration, field=torch.full((100_000,), float(iteration)))

torch.set_num_threads(1)  # a child that is forked beside OpenMP threads would wait for them for ever
random.seed(5)
for trial in range(10):
    path = f"{sys.argv[1]}/{trial}"
    child = os.fork()
    if child == 0:
        work(path)
    begin = time.monotonic()
    while not os.path.exists(path + "/checkpoint.pt") and time.monotonic() < begin + 30:
        time.sleep(0.002)  # a busy machine may take its time to the first checkpoint
    time.sleep(random.uniform(0, 0.1))
    os.kill(child, signal.SIGKILL)
    assert os.waitpid(child, 0)[1] == signal.SIGKILL  # it did not fail by itself before
    state = torch.load(path + "/checkpoint.pt", weights_only=True)
    assert (state["items"]["field"] == state["iteration"]).all()
    print(trial, state["iteration"])
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_kill_at_any_moment_leaves_a_whole_checkpoint(tmp_path):
    done = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = [[int(word) for word in line.split()] for line in done.stdout.splitlines()]
    assert len(found) == 10
    for trial, last in found[-3:]:
        path = tmp_path / str(trial)
        with RunFolder(path, {"seed": 1}, resume=True) as run:
            assert run.start == last + 1
            assert run.metrics["iteration"] == list(range(last + 1))
            assert bool((run.load()["field"] == last).all())
        assert not list(path.glob("*.tmp"))
        assert [event.step for event in events(path).Scalars("objective/L")] == list(range(last + 1))


def test_sigterm_ends_the_run_like_ctrl_c(tmp_path, capsys):
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt), RunFolder(tmp_path / "run", SETTINGS) as run:
        for iteration in run.progress(5):
            run.save(iteration)
            if iteration == 2:
                os.kill(os.getpid(), signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) is before
    assert "3 iterations are saved" in capsys.readouterr().err
    assert RunFolder(tmp_path / "run", SETTINGS, resume=True).start == 3


def test_a_run_whose_partner_is_lost_says_where_it_stands_though_torchrun_ends_it(tmp_path, capsys, monkeypatch):
    close = RunFolder.close

    def ended_meanwhile(run: RunFolder) -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        close(run)

    with pytest.raises(ConnectionError), RunFolder(tmp_path / "run", SETTINGS) as run:
        run.save(0)
        monkeypatch.setattr(RunFolder, "close", ended_meanwhile)
        raise ConnectionError("lost")
    assert "1 iterations are saved" in capsys.readouterr().err


class Kind(enum.Enum):
    DESK = "desk"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Body:
    size: tuple[float, float] = (0.1, 0.2)
    folder: Path = Path("runs")


def test_settings_are_written_resolved(tmp_path):
    settings = {"body": Body(), "kind": Kind.DESK, "device": torch.device("cpu"), "gravity": torch.tensor([0.0, -9.5])}
    RunFolder(tmp_path, settings).close()
    written = json.loads((tmp_path / "settings.json").read_text())
    body = {"size": [0.1, 0.2], "folder": "runs"}
    assert written == {"body": body, "kind": "desk", "device": "cpu", "gravity": [0.0, -9.5]}
    RunFolder(tmp_path, settings, resume=True).close()


@pytest.mark.parametrize("value", [float("nan"), float("inf"), object(), {1: 2}])
def test_settings_that_json_cannot_hold_are_refused_by_name(tmp_path, value):
    with pytest.raises(ValueError, match=r"settings: body\.size"):
        RunFolder(tmp_path / "run", {"body": {"size": value}})
    assert not (tmp_path / "run").exists()


def test_settings_must_be_a_mapping(tmp_path):
    with pytest.raises(ValueError, match="settings: got list"):
        RunFolder(tmp_path / "run", [1])  # type: ignore[arg-type]


def test_an_existing_run_is_not_overwritten(tmp_path):
    RunFolder(tmp_path, SETTINGS).close()
    with pytest.raises(ValueError, match=r"already holds a run; resume it .*, start again in it .*, or choose another"):
        RunFolder(tmp_path, SETTINGS)


def test_nothing_to_resume_is_refused(tmp_path):
    with pytest.raises(ValueError, match="holds no run"):
        RunFolder(tmp_path / "run", SETTINGS, resume=True)
    assert not (tmp_path / "run").exists()


def test_other_settings_are_refused_with_both_values(tmp_path):
    RunFolder(tmp_path, SETTINGS).close()
    held = (tmp_path / "settings.json").read_bytes()
    other = {"seed": 2, "chamber": {"wall": 0.002, "size": (0.1, 0.2)}, "extra": True}
    with pytest.raises(ValueError) as caught:
        RunFolder(tmp_path, other, resume=True, free=("iterations",))
    message = str(caught.value)
    assert "seed is 2, the run has 1" in message
    assert "chamber.wall is 0.002, the run has 0.00175" in message
    assert "extra is True, the run has 'absent'" in message
    assert "size" not in message and "iterations is" not in message
    assert (tmp_path / "settings.json").read_bytes() == held


def test_free_settings_may_change_on_resume(tmp_path):
    RunFolder(tmp_path, SETTINGS).close()
    other = {"seed": 1, "chamber": {"wall": 0.1}, "iterations": 9}
    RunFolder(tmp_path, other, resume=True, free=("chamber", "iterations")).close()
    assert json.loads((tmp_path / "settings.json").read_text()) == other


@pytest.fixture
def at_once(monkeypatch) -> None:
    """No waiting between two event files, for tests that look at none."""
    monkeypatch.setattr(RunFolder, "_wait_for_next_second", lambda self: None)


def notes(path: Path) -> list[tuple[int, dict[str, list[Any]]]]:
    """The amendments of a run."""
    return [(one["iteration"], one["changes"]) for one in json.loads((path / "amendments.json").read_text())]


def go_on(path: Path, until: int, **changes: Any) -> None:
    """Resume a run with amended settings, and save an iteration."""
    with RunFolder(path, {**SETTINGS, **changes}, resume=True, free=("iterations",), amend=True) as run:
        run.save(until)


def test_an_amendment_has_to_be_asked_for_and_is_noted_with_its_iteration(tmp_path, at_once):
    with RunFolder(tmp_path, SETTINGS) as run:
        run.save(4)
    with pytest.raises(ValueError, match=r"seed is 2, the run has 1; resume .* or amend it"):
        RunFolder(tmp_path, {**SETTINGS, "seed": 2}, resume=True)
    assert not (tmp_path / "amendments.json").exists()
    go_on(tmp_path, 4, iterations=9)
    assert not (tmp_path / "amendments.json").exists()  # what may change by itself needs no note
    go_on(tmp_path, 7, seed=2, iterations=10)
    first = (5, {"seed": [1, 2]})
    assert notes(tmp_path) == [first]
    go_on(tmp_path, 8, seed=2)
    RunFolder(tmp_path, {**SETTINGS, "seed": 2}, resume=True).close()  # the amended settings are the run's from now on
    assert notes(tmp_path) == [first]
    go_on(tmp_path, 9, seed=2, chamber={"wall": 0.002, "size": (0.1, 0.2)}, extra=True)
    second = {"chamber.wall": [0.00175, 0.002], "extra": ["absent", True]}
    assert notes(tmp_path) == [first, (9, second)]
    assert json.loads((tmp_path / "settings.json").read_text())["chamber"]["wall"] == 0.002


def test_amendments_that_no_iteration_used_are_dropped(tmp_path, at_once):
    with RunFolder(tmp_path, SETTINGS) as run:
        run.save(4)
    early = (tmp_path / "checkpoint.pt").read_bytes()
    RunFolder(tmp_path, {**SETTINGS, "seed": 2}, resume=True, amend=True).close()  # killed in its first iteration
    go_on(tmp_path, 9, seed=3)
    go_on(tmp_path, 12, seed=4)
    assert notes(tmp_path) == [(5, {"seed": [1, 3]}), (10, {"seed": [3, 4]})]
    (tmp_path / "checkpoint.pt").write_bytes(early)
    go_on(tmp_path, 6, seed=7)
    assert notes(tmp_path) == [(5, {"seed": [1, 7]})]
    (tmp_path / "checkpoint.pt").write_bytes(early)
    go_on(tmp_path, 6)  # as it was at first
    assert notes(tmp_path) == []


def test_an_amendment_that_does_not_fit_the_checkpoint_leaves_the_run_as_it_was(tmp_path, at_once):
    with RunFolder(tmp_path, SETTINGS) as run:
        run.save(4)
    go_on(tmp_path, 7, seed=2)
    files = [tmp_path / name for name in ("settings.json", "amendments.json", "checkpoint.pt")]
    before = [path.read_bytes() for path in files]
    with (
        pytest.raises(ValueError, match="does not fit"),
        RunFolder(tmp_path, {**SETTINGS, "seed": 3}, resume=True, amend=True) as run,
    ):
        run.load()
        raise ValueError("the design does not fit")
    assert [path.read_bytes() for path in files] == before


def test_a_half_written_last_row_is_dropped(tmp_path):
    with RunFolder(tmp_path, SETTINGS) as run:
        for iteration in range(12):
            run.log(iteration, {"objective/L": iteration / 3})
        run.save(11)
    table = tmp_path / "metrics.csv"
    whole = table.read_text()
    table.write_text(whole + "1")  # the first digit of row 12
    with RunFolder(tmp_path, SETTINGS, resume=True) as run:
        assert run.metrics["iteration"] == list(range(12))
    assert table.read_text() == whole


def test_a_second_log_of_an_iteration_joins_its_row(tmp_path):
    with RunFolder(tmp_path, SETTINGS) as run:
        run.log(0, {"objective/L": 1})
        run.log(1, {"objective/L": torch.tensor(0.5)})
        run.log(1, {"time/iteration": 2.5})
        with pytest.raises(ValueError, match="iteration: got 0, wanted at least the 1 logged last"):
            run.log(0, {"objective/L": 1})
        history = run.metrics
    assert (tmp_path / "metrics.csv").read_text() == "iteration,objective/L,time/iteration\n0,1.0,\n1,0.5,2.5\n"
    assert np.isnan(history["time/iteration"][0]) and history["objective/L"] == [1.0, 0.5]


@pytest.mark.parametrize("value", [torch.zeros(2), "1", None, [1.0]])
def test_only_single_numbers_are_logged(tmp_path, value):
    with RunFolder(tmp_path, SETTINGS) as run, pytest.raises(ValueError, match=r"values\['mass'\]"):
        run.log(0, {"mass": value})
    assert (tmp_path / "metrics.csv").read_text() == "iteration\n"


@pytest.mark.parametrize("iteration", [-1, 0.5])
def test_iterations_count_from_zero(tmp_path, iteration):
    with RunFolder(tmp_path, SETTINGS) as run, pytest.raises(ValueError, match="iteration: got"):
        run.log(iteration, {"mass": 1.0})


def test_the_tag_iteration_is_taken(tmp_path):
    with RunFolder(tmp_path, SETTINGS) as run, pytest.raises(ValueError, match="tag 'iteration'"):
        run.log(0, {"iteration": 1.0})


@pytest.mark.parametrize("item", [np.zeros(2), np.float64(1), {"a": [{1, 2}]}, lambda: 0])
def test_what_cannot_be_loaded_is_not_saved(tmp_path, item):
    with RunFolder(tmp_path, SETTINGS) as run:
        run.save(0, good=torch.ones(2), nested={"a": [1, 2.0, None, "x", (True,)]})
        with pytest.raises(ValueError, match=r"items\['bad'\].*: got"):
            run.save(1, bad=item)
        state = run.load()
    assert state["nested"] == {"a": [1, 2.0, None, "x", (True,)]}
    assert run.path.joinpath("checkpoint.pt").exists()


def test_a_failed_save_keeps_the_last_checkpoint(tmp_path, monkeypatch):
    with RunFolder(tmp_path, SETTINGS) as run:
        run.save(0, field=torch.ones(3))

        def full(payload, file):
            file.write(b"half")
            raise OSError("no space left")

        monkeypatch.setattr(torch, "save", full)
        with pytest.raises(OSError, match="no space"):
            run.save(1, field=torch.zeros(3))
        assert torch.equal(run.load()["field"], torch.ones(3))
    assert not list(tmp_path.glob("*.tmp"))


def test_the_checkpoint_does_not_go_back(tmp_path):
    with RunFolder(tmp_path, SETTINGS) as run:
        run.save(3)
        with pytest.raises(ValueError, match="iteration: got 2, wanted at least the 3"):
            run.save(2)


def test_loading_restores_the_random_state(tmp_path):
    with RunFolder(tmp_path, SETTINGS) as run:
        torch.manual_seed(0)
        run.save(0)
        expected = torch.rand(3)
        run.load()
        assert torch.equal(torch.rand(3), expected)


def test_the_cuda_random_state_is_kept(tmp_path, cuda):
    with RunFolder(tmp_path, SETTINGS) as run:
        torch.rand(1, device=cuda)
        run.save(0)
        expected = torch.rand(3, device=cuda)
        run.load()
        assert torch.equal(torch.rand(3, device=cuda), expected)


def test_pictures_and_meshes_reach_tensorboard(tmp_path):
    with RunFolder(tmp_path, SETTINGS) as run:
        run.log_image("field/side", np.zeros((8, 6, 3), np.uint8), 0)
        vertices, faces = np.eye(3), torch.tensor([[0, 1, 2]])
        run.log_mesh("field/shape", vertices, faces, np.full((3, 3), 200, np.uint8), 0)
        run.log_mesh("field/plain", vertices, faces, None, 0)
    found = events(tmp_path)
    assert found.Images("field/side")[0].width == 6
    vertex = np.frombuffer(found.Tensors("field/shape_VERTEX")[0].tensor_proto.tensor_content, np.float32)
    if not vertex.size:
        vertex = np.array(found.Tensors("field/shape_VERTEX")[0].tensor_proto.float_val)
    # In mm, and what points up (z) points up on the screen (y).
    np.testing.assert_allclose(vertex.reshape(3, 3), [[1000, 0, 0], [0, 0, -1000], [0, 1000, 0]])
    assert "field/shape_COLOR" in found.Tags()["tensors"] and "field/plain_COLOR" not in found.Tags()["tensors"]


@pytest.mark.parametrize("image", [np.zeros((4, 4)), np.zeros((4, 4, 3)), np.zeros((4, 4, 4), np.uint8)])
def test_a_wrong_image_is_refused(tmp_path, image):
    with RunFolder(tmp_path, SETTINGS) as run, pytest.raises(ValueError, match="image: got"):
        run.log_image("field/side", image, 0)


FACE, POINTS = np.array([[0, 1, 2]]), np.eye(3)


@pytest.mark.parametrize(
    ("vertices", "faces", "colors", "name"),
    [
        (np.zeros((3, 2)), FACE, None, "vertices"),
        (np.full((3, 3), np.nan), FACE, None, "vertices"),
        (POINTS, FACE.astype(float), None, "faces"),
        (POINTS, FACE + 1, None, "faces"),
        (POINTS, FACE, np.zeros((3, 3)), "colors"),
        (POINTS, FACE, np.zeros((2, 3), np.uint8), "colors"),
    ],
)
def test_a_wrong_mesh_is_refused(tmp_path, vertices, faces, colors, name):
    with RunFolder(tmp_path, SETTINGS) as run, pytest.raises(ValueError, match=f"{name}: got"):
        run.log_mesh("field/shape", vertices, faces, colors, 0)


def test_the_bar_shows_objective_and_constraint(tmp_path, capsys):
    with RunFolder(tmp_path, SETTINGS) as run:
        with pytest.raises(ValueError, match="total: got -1"):
            run.progress(-1)
        for iteration in run.progress(2):
            run.log(iteration, {"objective/L": 0.12345, "constraint/C": 0.5})
    shown = capsys.readouterr().err
    assert "2/2" in shown and "L=0.1235" in shown and "C=0.5" in shown
