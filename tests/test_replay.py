"""Finished robots: simulated again from their folder, kept among the designs, and those that come with the package."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import imageio_ffmpeg
import pytest
import torch
import trimesh
from tiny import TINY

from torchsoro.design.objective import intermediate_density
from torchsoro.design.reading import read_settings
from torchsoro.design.robot import Robot, build
from torchsoro.output import archive
from torchsoro.output.archive import DESIGNS, load_design, load_shape
from torchsoro.output.printable import print_part


@pytest.fixture
def replay(recipes, tmp_path, monkeypatch) -> ModuleType:
    """The recipe, with a folder of designs of its own, which is empty."""
    monkeypatch.setattr(archive, "DESIGNS", tmp_path / "designs")
    return recipes["replay"]


def play(replay: ModuleType, robot: Path | str, out: Path, **changes: Any) -> dict[str, float]:
    options = {"cycles": 1.0, "settle": TINY.settle, "frames": 3, "device": "cpu", **changes}
    return replay.main(replay.Options(robot=str(robot), out=out, **options))


@pytest.mark.slow
def test_with_void_and_for_as_long_a_robot_does_what_it_did_in_its_run(replay, straight, tmp_path, capsys):
    path, result = straight
    found = play(replay, path, tmp_path / "out", void=True)
    names = ("L", "feet", "stride", "C", "C_limit", "C_within_limit", "mass", "folded", "thinnest_wall", "thinnest_gap")
    assert found == {name: pytest.approx(result[name], rel=1e-6) for name in names}
    assert {file.name for file in (tmp_path / "out").iterdir()} == {
        "straight.mp4",
        "motion.npz",
        "motion.html",
        "shape.stl",
        "shape.3mf",
        "shape.json",
    }
    assert imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "out" / "straight.mp4"))[0] == 3
    assert trimesh.load_mesh(tmp_path / "out" / "shape.stl").is_watertight
    for name in ("shape.stl", "shape.json"):
        assert (tmp_path / "out" / name).read_bytes() == (path / name).read_bytes()
    said = capsys.readouterr()
    assert (
        f"travel {1e3 * result['L']:.2f} mm; feet {1e3 * result['feet']:.2f} mm, stride {1e3 * result['stride']:.2f} mm"
        in said.out
    )
    assert "limit 0.0125 NOT MET" in said.out
    assert "simulating straight: 100 %" in said.err


def test_a_kept_run_is_found_by_its_name_and_walks_as_long_as_is_wanted(
    replay, straight, tmp_path, monkeypatch, capsys
):
    path, result = straight
    assert replay.main(replay.Options(archive=path, name="mine")) == {}
    folder = tmp_path / "designs" / "mine"
    assert archive.find("mine") == folder
    capsys.readouterr()
    assert replay.main(replay.Options()) == {}
    assert capsys.readouterr().out == "mine\n"
    shown: list[tuple[Robot, torch.Tensor, dict[str, Any]]] = []

    def show(out: Path, robot: Robot, gamma: torch.Tensor, **options: Any) -> tuple[dict[str, float], Any]:
        assert out == tmp_path / "out"
        shown.append((robot, gamma, options))
        return result, SimpleNamespace(report="")

    monkeypatch.setattr("torchsoro.output.delivery.show", show)
    assert play(replay, "mine", tmp_path / "out", cycles=2.5, settle=0.002) == result
    robot, gamma, options = shown[0]
    assert options == {"name": "mine", "void": False}
    assert (robot.settings.duration, robot.settings.settle) == (pytest.approx(0.05), 0.002)
    assert torch.equal(gamma, load_design(path / "design.npz", robot.domain))
    # One that was designed without coming to rest does without it now.
    held = json.loads((folder / "settings.json").read_text())
    (folder / "settings.json").write_text(json.dumps({**held, "settle": 0.0}))
    play(replay, "mine", tmp_path / "out", settle=0.002, void=True)
    assert shown[1][0].settings.settle == 0
    assert shown[1][2]["void"]


def test_a_robot_that_does_not_exist_is_refused_with_those_that_do(replay, straight, tmp_path):
    with pytest.raises(ValueError, match=r"robot = 'walker': wanted an archived robot, or a finished run's folder"):
        play(replay, "walker", tmp_path / "out")
    for name in ("two", "one"):
        replay.main(replay.Options(archive=straight[0], name=name))
    with pytest.raises(ValueError, match=r"robot = '.*': wanted one, two, or a finished run's folder"):
        play(replay, tmp_path, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["", ".", "..", "a/b", "/tmp/a"])
def test_a_run_is_kept_under_a_plain_name_only(name, replay, straight, tmp_path):
    with pytest.raises(ValueError, match=r"name = .*: wanted a plain name"):
        replay.main(replay.Options(archive=straight[0], name=name))
    assert not list(tmp_path.iterdir())


def test_an_unfinished_run_is_not_kept(replay, tmp_path):
    with pytest.raises(ValueError, match=r"settings\.json holds no settings"):
        replay.main(replay.Options(archive=tmp_path, name="mine"))
    (tmp_path / "settings.json").write_text('{"device": "cpu", "particles": [8, 8, 8], "wall": 0.004375}')
    with pytest.raises(ValueError, match=r"has no design\.npz, .*, wanted a finished run"):
        replay.main(replay.Options(archive=tmp_path, name="mine"))
    assert not (tmp_path / "designs").exists()


# The robots that come with the package --------------------------------------------------------------------------------

COMMITTED = sorted(path.parent for path in DESIGNS.glob("*/design.npz")) or [
    pytest.param(None, marks=pytest.mark.skip(reason="there are no designs in torchsoro/designs"))
]


def named(folder: Any) -> str:
    return folder.name if isinstance(folder, Path) else "none"


@pytest.mark.parametrize("folder", COMMITTED, ids=named)
def test_an_archived_robot_is_small_and_within_its_limit(folder):
    assert sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) <= 2e6
    robot = build(read_settings(folder / "settings.json", device="cpu"))
    s, gamma = robot.settings, load_design(folder / "design.npz", robot.domain, mended=False)  # whose C is told
    limit = intermediate_density(gamma, robot.design).item()
    assert limit <= 1.001 * s.c_max
    result = json.loads((folder / "result.json").read_text())
    assert result["C"] == pytest.approx(limit, rel=1e-4)
    assert math.isfinite(result["stride"]) and result["stride"] > 0
    lattice = robot.domain.lattice(gamma)
    assert torch.equal(lattice, lattice.flip(1))
    if not s.start_from:
        first = load_shape(folder, robot.domain, 0)
        assert intermediate_density(first, robot.design).item() == pytest.approx(0.25, abs=1e-3)  # grey all over


@pytest.mark.parametrize(
    "folder",
    [f if named(f) in ("walker", "none") else pytest.param(f, marks=pytest.mark.slow) for f in COMMITTED],
    ids=named,
)
def test_an_archived_robot_can_be_printed(folder):
    robot = build(read_settings(folder / "settings.json", device="cpu"))
    report = print_part(robot, load_design(folder / "design.npz", robot.domain).numpy()).report
    assert report.watertight and report.manifold
    assert report.bodies == 1
    assert report.port_open
