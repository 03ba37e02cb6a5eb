"""The console script: it lists the recipes before torch is loaded, and hands each its options."""

from __future__ import annotations

import importlib.metadata
import subprocess
import sys
from pathlib import Path

import pytest

from torchsoro import cli

ROOT = Path(__file__).parents[1]


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "torchsoro.cli", *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=300)


def test_help_lists_every_recipe_with_a_sentence():
    ended = run("--help")
    assert ended.returncode == 0
    names = {path.stem for path in (ROOT / "recipes").glob("*.py")}
    lines = dict(line.split(None, 1) for line in ended.stdout.splitlines() if line.startswith("  ") and line.strip())
    assert names <= lines.keys()
    assert all(len(lines[name]) > 20 for name in names)
    assert {*cli.summaries()} == names


def test_help_and_the_package_load_neither_torch_nor_taichi():
    code = (
        "import sys; from torchsoro import cli; cli.main(['--help']); cli.main(['--version'])\n"
        "assert not {'torch', 'taichi', 'numpy', 'scipy'} & set(sys.modules)"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert ended.returncode == 0, ended.stderr
    assert f"torchsoro {importlib.metadata.version('torchsoro')}" in ended.stdout


def test_help_of_a_command_loads_neither_torch_nor_taichi():
    code = (
        "import sys; from torchsoro import cli\n"
        "for name in cli.COMMANDS:\n"
        "    try:\n        cli.main([name, '--help'])\n    except SystemExit:\n        pass\n"
        "    assert not {'torch', 'taichi'} & set(sys.modules), name"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert ended.returncode == 0, ended.stderr
    assert all(f"torchsoro {name} " in ended.stdout for name in cli.COMMANDS)
    assert "python recipes" not in ended.stdout


def test_a_command_that_does_not_exist_is_refused_with_those_that_do():
    ended = run("wlaker")
    assert ended.returncode == 2
    assert "error: command = 'wlaker': wanted one of " in ended.stderr
    assert "walker, climber" in ended.stderr
    assert "Traceback" not in ended.stderr


@pytest.mark.parametrize("name", list(cli.summaries()))
def test_each_command_shows_its_own_help_under_its_own_name(name, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["torchsoro"])
    with pytest.raises(SystemExit) as ended:
        cli.main([name, "--help"])
    assert ended.value.code in (0, None)
    assert f"usage: torchsoro {name} " in capsys.readouterr().out


def test_a_command_gets_its_options(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["torchsoro"])
    cli.main(["replay"])
    assert {"walker", "climber", "slope30", "slope58"} <= set(capsys.readouterr().out.split())
    with pytest.raises(SystemExit) as ended:
        cli.main(["walker", "--slope", "-1"])
    assert ended.value.code == 2
    assert "slope = -1" in capsys.readouterr().err


def test_help_into_a_pipe_that_is_closed_early_ends_without_a_word():
    command = f"{sys.executable} -m torchsoro.cli walker --help | head -n 1"
    ended = subprocess.run(command, shell=True, capture_output=True, text=True, cwd=ROOT, timeout=60)
    assert ended.stdout.startswith("usage: torchsoro walker")
    assert not ended.stderr
