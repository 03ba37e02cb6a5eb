"""The wheel: it holds what the commands need, and works where only its dependencies are installed."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PARTS = ("torchsoro", "recipes", "pyproject.toml", "README.md", "LICENSE")
TINY = (
    *("--particles", "8", "8", "8", "--wall", "0.004375", "--filter-radius", "0.00875", "--elements", "1"),
    *("--iterations", "1", "--settle", "0.005", "--duration", "0.02", "--frequency", "50", "--frames", "2"),
)


def test_every_package_is_listed_for_the_wheel():
    listed = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    folders = {path.parent.relative_to(ROOT) for path in (ROOT / "torchsoro").rglob("*.py")}
    assert listed == {".".join(folder.parts) for folder in folders} | {"torchsoro.recipes"}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """The wheel, built from a copy of what it is made of."""
    folder = tmp_path_factory.mktemp("wheel")
    for name in PARTS:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / "source" / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, folder / "source" / name)
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(folder / "source")]
    built = subprocess.run(command, capture_output=True, text=True)
    assert built.returncode == 0, built.stdout + built.stderr
    return next(folder.glob("*.whl"))


@pytest.fixture(scope="module")
def python(wheel, tmp_path_factory) -> Path:
    """The interpreter of an environment with the wheel, and this one's other packages beside it."""
    folder = tmp_path_factory.mktemp("environment") / "venv"
    venv.EnvBuilder(symlinks=os.name != "nt").create(folder)
    bin_ = folder / ("Scripts" if os.name == "nt" else "bin")
    packages = next(folder.rglob("site-packages"))
    # A path in a .pth file brings the packages, but not the editable torchsoro among them.
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    command = [sys.executable, "-m", "pip", "--python", str(bin_ / "python"), "install", "--no-deps", "--no-index"]
    done = subprocess.run([*command, str(wheel)], capture_output=True, text=True, env=bare())
    assert done.returncode == 0, done.stdout + done.stderr
    return bin_ / "python"


def bare() -> dict[str, str]:
    """The environment without a path to this checkout."""
    return {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}


def torchsoro(python: Path, folder: Path, *arguments: str) -> str:
    """What the console script prints."""
    command = [str(python.parent / "torchsoro"), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, env=bare(), timeout=500)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_the_wheel_holds_all_that_is_read_or_run(wheel):
    held = set(zipfile.ZipFile(wheel).namelist())
    package = [path for path in (ROOT / "torchsoro").rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    wanted = {str(path.relative_to(ROOT)) for path in package}
    wanted |= {f"torchsoro/{path.relative_to(ROOT)}" for path in (ROOT / "recipes").glob("*.py")}
    assert not wanted - held
    assert any(name.endswith("licenses/LICENSE") for name in held)
    assert not [name for name in held if name.split("/")[0] not in ("torchsoro", wheel_info(held))]


def wheel_info(names: set[str]) -> str:
    """The folder of the wheel's own data."""
    return next(name.split("/")[0] for name in names if ".dist-info/" in name)


@pytest.mark.slow
def test_the_installed_commands_run_without_the_checkout(python, tmp_path):
    where = [str(python), "-c", "import torchsoro; print(torchsoro.__file__)"]
    done = subprocess.run(where, capture_output=True, text=True, cwd=tmp_path, env=bare())
    assert str(python.parents[1]) in done.stdout
    assert "walker" in torchsoro(python, tmp_path, "--help")
    assert {"walker", "climber", "slope30", "slope58"} <= set(torchsoro(python, tmp_path, "replay").split())
    torchsoro(python, tmp_path, "walker", "--preset", "desk", "--device", "cpu", *TINY)
    written = {path.name for path in (tmp_path / "runs" / "walker").iterdir()}
    assert {"settings.json", "result.json", "design.npz", "shape.stl", "walker.mp4", "summary.png"} <= written
