"""Folders of runs that are damaged, held by another run, or not writable: what is refused, kept and deleted."""

from __future__ import annotations

import os
import tempfile
from typing import Any

import pytest
import torch

from torchsoro.design.training import RunFolder

SETTINGS = {"seed": 1, "chamber": {"wall": 0.00175, "size": (0.1, 0.2)}, "iterations": 6}


@pytest.fixture
def at_once(monkeypatch) -> None:
    """No waiting between two event files, for tests that look at none."""
    monkeypatch.setattr(RunFolder, "_wait_for_next_second", lambda self: None)


@pytest.mark.parametrize("below", ["", "a/b"])
def test_a_folder_that_is_a_file_or_lies_under_one_is_refused(tmp_path, below):
    (tmp_path / "run").write_text("")
    with pytest.raises(ValueError, match=r"out = .*run.* is a file, wanted a folder"):
        RunFolder(tmp_path / "run" / below, SETTINGS)


def test_a_folder_that_cannot_be_written_is_refused(tmp_path, monkeypatch):
    def refuse(**_: Any) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(tempfile, "TemporaryFile", refuse)
    with pytest.raises(ValueError, match=r"out = .*: not writable \(Permission denied\)"):
        RunFolder(tmp_path / "run", SETTINGS)
    assert not list(tmp_path.iterdir())


def test_a_checkpoint_of_other_settings_is_refused(tmp_path):
    for name, seed in (("one", 1), ("two", 2)):
        with RunFolder(tmp_path / name, {"seed": seed}) as run:
            run.save(0)
    os.replace(tmp_path / "one" / "checkpoint.pt", tmp_path / "two" / "checkpoint.pt")
    with pytest.raises(ValueError, match=r"from checkpoint\.pt .* seed is 2, the run has 1"):
        RunFolder(tmp_path / "two", {"seed": 2}, resume=True)


@pytest.mark.parametrize(
    ("file", "content"),
    [
        *[("settings.json", bad) for bad in (b"{", b"[1]", b"\xff")],
        *[("checkpoint.pt", bad) for bad in (b"broken", b"")],
        *[("metrics.csv", bad) for bad in (b"iteration\nx\n", b"\xff\xfe\n")],
    ],
)
def test_damaged_files_are_named(tmp_path, file, content):
    with RunFolder(tmp_path, SETTINGS) as run:
        run.save(0)
    (tmp_path / file).write_bytes(content)
    with pytest.raises(ValueError, match=f"{file} is damaged"):
        RunFolder(tmp_path, SETTINGS, resume=True)


class Foreign:
    """Something that torch would unpickle only without its safeguard."""


@pytest.mark.parametrize(
    ("payload", "seen"),
    [
        ({"weights": torch.zeros(2)}, "it lacks iteration, settings, rng_cpu"),
        ([1, 2], "it holds a list"),
        ({"iteration": 1, "items": Foreign()}, "more than tensors, numbers, text"),
    ],
)
def test_a_checkpoint_of_something_else_is_refused_without_advice_to_load_it_unsafely(tmp_path, payload, seen):
    with RunFolder(tmp_path, SETTINGS) as run:
        run.save(0)
    torch.save(payload, tmp_path / "checkpoint.pt")
    with pytest.raises(ValueError, match=rf"checkpoint\.pt is not a checkpoint of a run: .*{seen}") as error:
        RunFolder(tmp_path, SETTINGS, resume=True)
    assert "weights_only" not in str(error.value)


def test_a_flipped_bit_of_a_checkpoint_is_refused_or_changes_nothing(tmp_path):
    field = torch.rand(400)
    with RunFolder(tmp_path, SETTINGS) as run:
        run.log(0, {"mass": 1.0})
        run.save(0, field=field)
        path = tmp_path / "checkpoint.pt"
        whole, refused = path.read_bytes(), 0
        at = whole.index(field.numpy().tobytes()) + 40
        for place in (at, *range(0, len(whole), 101)):
            path.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
            try:
                assert torch.equal(run.load()["field"], field), place
            except ValueError as error:
                refused += 1
                assert "checkpoint.pt is" in str(error)
    assert refused > 5


def test_a_run_that_fails_before_its_first_checkpoint_leaves_the_folder_as_it_was(tmp_path, at_once):
    (tmp_path / "held").mkdir()
    (tmp_path / "held" / "note.txt").write_text("mine")
    for name in ("new", "held"):
        for error in (RuntimeError, KeyboardInterrupt):
            with pytest.raises(error), RunFolder(tmp_path / name, SETTINGS) as run:
                run.log(0, {"mass": 1.0})
                raise error
    assert not (tmp_path / "new").exists()
    assert [file.name for file in (tmp_path / "held").iterdir()] == ["note.txt"]
    RunFolder(tmp_path / "held", {**SETTINGS, "seed": 2}).close()


def test_a_run_that_fails_after_a_checkpoint_keeps_it(tmp_path):
    with pytest.raises(RuntimeError), RunFolder(tmp_path, SETTINGS) as run:
        run.log(0, {"mass": 1.0})
        run.save(0)
        raise RuntimeError
    assert RunFolder(tmp_path, SETTINGS, resume=True).start == 1


def test_overwrite_deletes_the_files_of_the_run_and_no_others(tmp_path, at_once):
    with RunFolder(tmp_path, SETTINGS) as run:
        run.log(0, {"mass": 1.0})
        run.save(0)
    (tmp_path / "shapes").mkdir()
    for name in ("design.npz", "walker.mp4", "other.mp4", "shapes/00000.npz", "note.txt"):
        (tmp_path / name).write_text("held")
    with RunFolder(tmp_path, {**SETTINGS, "seed": 2}, overwrite=True) as run:
        assert run.start == 0 and run.metrics == {"iteration": []}
        run.save(0)
    left = {file.name for file in tmp_path.iterdir() if "tfevents" not in file.name}
    assert left == {"settings.json", "metrics.csv", "checkpoint.pt", "shapes", "other.mp4", "note.txt"}
    assert len(list(tmp_path.glob("*tfevents*"))) == 1 and not list((tmp_path / "shapes").iterdir())


@pytest.mark.parametrize(("left", "seen"), [(None, "is missing"), (1, "ends with iteration 0")])
def test_metrics_that_lack_iterations_of_the_checkpoint_are_refused_on_resume(tmp_path, left, seen):
    with RunFolder(tmp_path, SETTINGS) as run:
        for iteration in range(3):
            run.log(iteration, {"mass": 1.0})
            run.save(iteration)
    table = tmp_path / "metrics.csv"
    lines = table.read_text().splitlines(keepends=True)
    table.unlink() if left is None else table.write_text("".join(lines[: 1 + left]))
    with pytest.raises(ValueError, match=rf"metrics\.csv {seen}, wanted all up to 2"):
        RunFolder(tmp_path, SETTINGS, resume=True)
