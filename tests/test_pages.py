"""The pages of the paper's figures, drawn from made-up folders of finished robots: no simulation."""

from __future__ import annotations

import csv
import dataclasses
import importlib
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from PIL import Image
from tiny import TINY

from torchsoro.design.robot import Robot, build
from torchsoro.output.archive import save_design
from torchsoro.storage import plain_settings

RECIPES = Path(__file__).parents[1] / "recipes"
PAGES = ("fig2", "fig3", "fig4", "figS3", "figS5", "figS7")
CHECKS = ("design", "uphill_10", "uphill_30", "double_modulus", "double_modulus_and_pressure")
STEPS = (0, 1, 2)


@pytest.fixture(scope="module")
def pages() -> ModuleType:
    return importlib.import_module("pages")


def finished(folder: Path) -> Robot:
    """A robot's folder as a run and its measurements leave it, with a made-up walk at 0.4 m/s."""
    name = folder.name
    slope = {"slope30": 0.3, "slope58": 0.577}.get(name, 0.0)
    kind = "climber" if name == "climber" else "walker"
    settings = dataclasses.replace(TINY, robot=kind, out=folder, slope=slope, gravity_every=1)
    settings = dataclasses.replace(settings, gravity_steps=2 if kind == "climber" else 0)
    robot = build(settings)
    folder.mkdir(parents=True)
    (folder / "settings.json").write_text(json.dumps(plain_settings(dataclasses.asdict(settings))))
    with (folder / "metrics.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["iteration", "objective/L", "constraint/C", "mass", "cog/x", "cog/y", "cog/z"])
        table.writerows([[k, 1e-3 * k, 0.25 - 0.1 * k, 0.01, 1e-3 * k, 0.0, 0.018] for k in STEPS])
    positions = robot.domain.positions
    gamma = (positions[:, 2] > 0.01).float()
    save_design(folder / "design.npz", robot.domain, gamma)
    along, start, period = (2 if name == "climber" else 0), settings.settle, 1 / settings.frequency
    rows = []
    for check in CHECKS:
        time = np.linspace(0, start + 4 * period, 40)
        cog = np.zeros((40, 3))
        cog[:, along] = 0.4 * np.clip(time - start, 0, None)
        rows.append({"check": check, "L": 2e-3, "stride": 2e-3, "speed": 0.4, "time": list(time), "cog": cog.tolist()})
    rows.append({"check": "uphill_20", "error": "it broke down"})
    (folder / "compare.json").write_text(json.dumps({"robot": name, "rows": rows}))
    eighths = np.append(np.arange(9) / 8, (2, 4)) * period + start
    for check, moments in {"design": eighths, **{f"iteration_{k}": eighths[8:9] for k in STEPS}}.items():
        moved = np.zeros((len(moments), robot.domain.count, 3))
        moved[..., along] = 1e3 * 0.4 * (moments - start)[:, None]
        moved[:, 0] = np.inf  # void that has left the range of its numbers
        np.savez(
            folder / f"motion_{check}.npz",
            time=moments,
            pressure=np.linspace(0, 80e3, len(moments)),
            displacement=moved.astype(np.float16),
            gamma=gamma.numpy().astype(np.float16),
        )
    return robot


def texts(page) -> str:
    """All that is written on a page."""
    axes = page.figure.axes
    return "\n".join(
        [text.get_text() for text in page.figure.texts]
        + [text.get_text() for panel in axes for text in (panel.title, panel.xaxis.label, panel.yaxis.label)]
        + [text.get_text() for panel in axes for text in panel.texts]
        + [text.get_text() for panel in axes if panel.get_legend() for text in panel.get_legend().get_texts()]
    )


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("robots")
    for name in ("walker", "slope30", "slope58", "climber"):
        finished(path / name)
    return path


@pytest.mark.slow
def test_a_page_for_each_figure(pages, data, tmp_path, capsys):
    written = pages.main(data, tmp_path / "out")
    assert sorted(path.name for path in written) == sorted(f"{name}.png" for name in PAGES)
    for path in written:
        with Image.open(path) as image:
            assert image.width == 1760
            assert len(image.convert("RGB").getcolors(maxcolors=2**24)) > 100
    assert "skipped" not in capsys.readouterr().out


def test_pages_say_what_was_measured(pages, data):
    walks = texts(pages.locomotion(pages.Found(data / "walker")))
    for text in ("iteration 1\nL = 1.0 mm", "finished\nL = 2.0 mm", "t/T = 0.125\n8 kPa, 1.0 mm", "L [mm]"):
        assert text in walks
    assert "10 %, 400.0 mm/s" not in walks  # it has a path, but no frames
    assert "10 %: 400.0 mm/s" in walks
    assert "10 %: there are no frames." in walks
    assert "20 %: there are no frames." in walks
    assert "20 %: " not in walks.replace("20 %: there", "")  # it broke down
    climbs = texts(pages.locomotion(pages.Found(data / "climber")))
    assert "gravity rises at each line" in climbs
    assert "iteration 1\nL = 1.0 mm at 50 % g" in climbs
    slopes = texts(pages.slopes({"slope58": pages.Found(data / "slope58")}))
    assert "slope30: there is no finished robot" in slopes
    assert "Shape for a slope of 57.7 %" in slopes
    assert slopes.count("t/T") == 5
    assert "g\n" in slopes
    moduli = texts(pages.stiffness(pages.Found(data / "walker")))
    assert "double modulus and pressure: L = 2.0 mm, stride 2.0 mm" in moduli


def test_path_of_the_centre_of_gravity_is_from_the_chambers_centre(pages, data):
    page = pages.centers(pages.Found(data / "walker"))
    along, up = page.figure.axes[2].lines
    np.testing.assert_allclose(along.get_ydata(), [0, 1, 2])
    np.testing.assert_allclose(up.get_ydata(), [0.5, 0.5, 0.5])


def test_robots_that_are_missing_are_skipped_and_missing_files_named(pages, tmp_path, capsys):
    robot = finished(tmp_path / "walker")
    for path in (tmp_path / "walker").glob("motion_*"):
        path.unlink()
    for name in ("metrics.csv", "compare.json"):
        (tmp_path / "walker" / name).unlink()
    written = pages.main(tmp_path, tmp_path / "out")
    assert [path.name for path in written] == ["fig2.png", "figS3.png", "figS5.png"]
    out = capsys.readouterr().out
    assert f"fig4.png: skipped, there is no {tmp_path / 'climber' / 'settings.json'}" in out
    assert "fig3.png: skipped" in out
    found = pages.Found(tmp_path / "walker")
    for text in ("no frames of any design", "no metrics.csv", "no frames of a whole", "30 %: there", "no compare.json"):
        assert text in texts(pages.locomotion(found))
    assert "no metrics.csv" in texts(pages.centers(found))
    assert "double modulus: no path in compare.json" in texts(pages.stiffness(found))
    assert torch.equal(torch.from_numpy(found.gamma), (robot.domain.positions[:, 2] > 0.01).float())


def test_damaged_files_are_refused(pages, data, tmp_path):
    finished(tmp_path / "walker")
    compare, motion = tmp_path / "walker" / "compare.json", tmp_path / "walker" / "motion_design.npz"
    whole = compare.read_text()
    for text in ("{", '{"rows": [{"check": "design"}]}', whole.replace("]]", "], [1]]", 1)):
        compare.write_text(text)
        with pytest.raises(ValueError, match=r"data: .*compare\.json holds no comparison .*wanted rows"):
            pages.Found(tmp_path / "walker")
    compare.write_text(whole)
    content = motion.read_bytes()
    motion.write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match=r"data: .*motion_design\.npz holds no motion .*wanted time"):
        pages.Found(tmp_path / "walker").motion("design")
    with np.load(data / "walker" / "motion_design.npz") as file:
        stored = dict(file)
    for change in ({"gamma": stored["gamma"][1:]}, {"displacement": stored["displacement"][:, :, :2]}):
        np.savez(motion, **{**stored, **change})
        with pytest.raises(ValueError, match="holds no motion"):
            pages.Found(tmp_path / "walker").motion("design")


@pytest.mark.slow
def test_command_line_ends_with_a_line(tmp_path):
    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, str(RECIPES / "validate" / "pages.py"), *arguments]
        return subprocess.run(command, capture_output=True, text=True, timeout=300)

    ended = run(str(tmp_path / "nothing"), "--out", str(tmp_path / "out"))
    assert ended.returncode == 2
    assert "error: data: there is no" in ended.stderr
    assert "Traceback" not in ended.stderr
    assert not (tmp_path / "out").exists()
    help_text = run("--help")
    assert help_text.returncode == 0
    for text in ("--out", "slope58", "compare.json", "figS7.png"):
        assert text in help_text.stdout
