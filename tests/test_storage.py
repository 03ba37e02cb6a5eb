"""Folders for results, judged before anything is computed."""

from __future__ import annotations

import pytest

from torchsoro.storage import check_folder


def test_a_folder_that_can_be_written_passes_and_is_not_made(tmp_path):
    check_folder("out", tmp_path / "a" / "b", ("report.html",))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("file", r"out = .*file: is a file, wanted a folder"),
        ("file/run/a", r"out = .*file/run/a: lies under .*file, which is a file, wanted a folder"),
        ("x" * 300, r"out = .*: not writable \(.*\), wanted a folder that is"),
        ("/proc/run", r"out = /proc/run: not writable \(.*\), wanted a folder that is"),
        ("taken", r"out = .*taken: holds a folder report\.html, wanted no folder"),
    ],
)
def test_a_folder_that_cannot_be_written_is_refused(tmp_path, path, message):
    (tmp_path / "file").write_text("x")
    (tmp_path / "taken" / "report.html").mkdir(parents=True)
    with pytest.raises(ValueError, match=message):
        check_folder("out", tmp_path / path, ("report.html",))
