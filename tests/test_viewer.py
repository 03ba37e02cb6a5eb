"""Recorded motions: the file keeps them, and viewer and page show them in a real browser."""

from __future__ import annotations

import importlib
import json
import shutil
import socket
import time
from pathlib import Path

import moving
import numpy as np
import pytest
from browser import Browser, browser

from torchsoro.output.archive import DESIGNS
from torchsoro.output.motion import TOLERANCE, decompose, read_motion
from torchsoro.output.scene import Skin
from torchsoro.output.section import Cut, surfaces
from torchsoro.output.viewer import Viewer, check_address
from torchsoro.output.web_page import write_page


@pytest.fixture(scope="module")
def view():
    return importlib.import_module("view")


@pytest.fixture(scope="module")
def motion():
    return moving.motion()


@pytest.fixture
def window(tmp_path):
    with browser(tmp_path / "profile") as opened:
        yield opened


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        return probe.getsockname()[1]


# The file -------------------------------------------------------------------------------------------------------------


def test_stored_motion_of_two_modes_has_two_and_is_exact_to_the_tolerance(motion, tmp_path):
    motion.save(tmp_path / "motion.npz")
    found = read_motion(tmp_path)
    assert len(found.modes) == 2  # what bends and what grows; travel is apart
    error = (found.positions() - moving.bending(found.time))[:, found.material]
    assert np.sqrt((error**2).mean()) < 1.5 * TOLERANCE
    assert found.travel[-1] == pytest.approx(moving.TRAVEL, abs=1e-6)
    assert found.pressure.max() == pytest.approx(moving.PRESSURE)
    assert (found.name, found.planes, found.domain, found.period) == ("table", ((2, 0.0, 1),), moving.DOMAIN, 0.2)


def test_points_carried_by_modes_are_where_interpolation_of_the_particles_puts_them(motion):
    points = surfaces(motion.domain, motion.gamma)["body"][0]
    skin, modes = Skin(motion.domain, points, motion.gamma), motion.carry(points)
    for sample in (0, 13):
        moved = points + motion.shift[sample] + np.tensordot(motion.amplitude[sample], modes, axes=1)
        assert np.abs(moved - skin(motion.positions([sample])[0])).max() < 1e-6


def test_motion_longer_than_the_limit_is_thinned_evenly_and_keeps_its_ends():
    found = moving.motion(samples=301)
    assert len(found.time) == 240 and found.time[[0, -1]] == pytest.approx([0.0, 0.4])
    assert np.ptp(np.diff(found.time)) < 0.0014


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"frames": np.zeros((3, 5, 3))}, "frames: got shape"),
        ({"gamma": np.zeros(3)}, r"gamma: got shape \(3,\)"),
        ({"time": np.zeros(41)}, "time: got times that do not increase"),
        ({"pressure": np.full(41, np.nan)}, "pressure: got shape"),
    ],
)
def test_motion_of_wrong_arrays_is_refused_by_name(change, words):
    time_ = np.linspace(0, 0.4, 41)
    given = {"frames": moving.bending(time_), "gamma": moving.table(), "time": time_, "pressure": 0 * time_}
    with pytest.raises(ValueError, match=words):
        decompose(name="x", domain=moving.DOMAIN, **{**given, **change})


def test_missing_damaged_and_pickled_files_are_refused_without_advice_to_trust_them(tmp_path):
    with pytest.raises(ValueError, match=r"there is no .*motion\.npz, wanted the motion of a finished run"):
        read_motion(tmp_path)
    np.save(tmp_path / "objects.npy", np.array([{}], dtype=object), allow_pickle=True)
    (tmp_path / "text.npz").write_text("no archive")
    for name in ("objects.npy", "text.npz"):
        with pytest.raises(ValueError, match="holds no motion, or is damaged") as error:
            read_motion(tmp_path / name)
        assert "pickle" not in str(error.value)


@pytest.mark.parametrize("name", ["walker", "climber"])
def test_archived_motion_is_below_1_5_mb_and_travels_as_far_per_cycle_as_the_archive_says_to_15_percent(name):
    folder = DESIGNS / name
    assert (folder / "motion.npz").stat().st_size < 1.5e6
    found = read_motion(folder)
    stride = json.loads((folder / "result.json").read_text())["stride"]
    cycles = (found.time[-1] - found.time[0]) / found.period
    assert cycles == pytest.approx(round(cycles), abs=0.02) and cycles > 1.9
    # Another number of cycles, from another time of coming to rest, without void.
    assert found.travel[-1] / cycles == pytest.approx(stride, rel=0.15)


# Sections -------------------------------------------------------------------------------------------------------------


def area(mesh: tuple[np.ndarray, np.ndarray]) -> float:
    vertices, faces = mesh
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


@pytest.mark.parametrize("side", [1, -1])
def test_section_through_the_middle_has_the_areas_of_wall_and_material(side):
    meshes = surfaces(moving.DOMAIN, moving.table().numpy(), cut=Cut(1, 0.068 + 1e-7, side))
    assert area(meshes["wall section"]) == pytest.approx(0.018**2 - 0.012**2, rel=0.01)
    # Legs are at the corners: the middle has the upper part only, whose lower edge is 12 mm up.
    assert area(meshes["body section"]) == pytest.approx(0.036 * 0.024 - 0.018 * 0.015, rel=0.02)
    assert area(meshes["cavity"]) == pytest.approx(3 * 0.012**2, rel=1e-3)
    along = side * (np.concatenate([v for v, _ in meshes.values()])[:, 1] - 0.068)
    assert along.max() < 1e-6


# In a browser ---------------------------------------------------------------------------------------------------------


def shown_at(window: Browser, page: Path, fragment: str) -> np.ndarray:
    window.open("about:blank")
    window.open(f"{page.as_uri()}#{fragment}")
    window.wait("document.body.dataset.ready && document.getElementById('state').textContent")
    time.sleep(0.3)
    return window.picture()


def changed(one: np.ndarray, other: np.ndarray) -> float:
    """Share of the pixels that differ visibly."""
    return float((np.abs(one.astype(int) - other).max(axis=2) > 24).mean())


def test_page_from_disk_shows_motion_and_cut_without_errors_or_network(motion, window, tmp_path):
    page = write_page(motion, tmp_path / "motion.html")
    assert page.stat().st_size < 2e6
    text = page.read_text()
    assert "http://" not in text and "https://" not in text and 'src="' not in text
    rest, full = (shown_at(window, page, f"time={t}") for t in (0.0, 0.1))
    assert changed(rest, full) > 0.01
    assert "80.0 kPa" in window.run("return document.getElementById('state').textContent")
    cut = shown_at(window, page, "time=0.1&axis=1")
    assert changed(full, cut) > 0.01
    red = (cut[..., 0].astype(int) - cut[..., 1] > 80) & (cut[..., 2] > 30)
    assert red.mean() > 0.002  # the chamber under pressure, behind the cut
    assert window.errors() == []


def test_page_plays_and_stops(motion, window, tmp_path):
    page = write_page(motion, tmp_path / "motion.html")
    window.open(page.as_uri())
    window.wait("document.getElementById('state').textContent")
    first = window.run("return state.time")
    window.wait(f"state.time !== {first}")
    window.run("document.getElementById('play').click()")
    held = window.run("return state.time")
    time.sleep(0.3)
    assert window.run("return state.time") == held
    assert window.errors() == []


def test_viewer_serves_motion_and_cut_to_a_browser_without_errors(motion, window):
    viewer = Viewer(motion, port=free_port())
    try:
        viewer.playing.value = False
        viewer.show(0.0)
        window.open(viewer.address)
        window.wait("document.querySelector('canvas') && document.body.textContent.includes('travel')", 90)
        time.sleep(4)
        rest = window.picture()
        viewer.show(0.1)
        time.sleep(2)
        full = window.picture()
        assert changed(rest, full) > 0.01
        viewer.cut("y", 18.0)
        time.sleep(2)
        assert changed(full, window.picture()) > 0.01
        assert window.errors() == []
    finally:
        viewer.stop()


def test_viewer_advances_at_the_chosen_speed_and_starts_over_at_the_end(motion):
    viewer = Viewer(motion, port=free_port())
    try:
        viewer.speed.value = "1/10"
        viewer.advance(1.0)
        assert viewer.time.value == pytest.approx(100.0)
        viewer.advance(3.5)
        assert viewer.time.value == pytest.approx(50.0)
        viewer.playing.value = False
        viewer.advance(1.0)
        assert viewer.time.value == pytest.approx(50.0)
        viewer.cut("z", 0.0)  # all is beyond it
        viewer.cut("none", 0.0)
    finally:
        viewer.stop()


# The recipe -----------------------------------------------------------------------------------------------------------


def refused(view, capsys, *arguments: str) -> str:
    with pytest.raises(SystemExit) as error:
        view.cli(arguments)
    assert error.value.code == 2
    return capsys.readouterr().err


def test_view_names_what_is_missing_taken_or_out_of_range(view, motion, tmp_path, capsys):
    motion.save(tmp_path / "motion.npz")
    run = str(tmp_path)
    assert "robot = 'nowhere'" in refused(view, capsys, "nowhere")
    (tmp_path / "bare").mkdir()
    shutil.copy(DESIGNS / "walker" / "design.npz", tmp_path / "bare")
    assert "wanted the motion of a finished run" in refused(view, capsys, str(tmp_path / "bare"))
    for port in ("0", "-1", "65536"):
        assert f"port = {port}: wanted a number from 1 to 65535" in refused(view, capsys, run, "--port", port)
    with socket.socket() as taken:
        taken.bind(("localhost", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        assert f"port = {port}: another program" in refused(view, capsys, run, "--port", port)
    assert "host = '192.0.2.1'" in refused(view, capsys, run, "--host", "192.0.2.1")
    assert "resolution = '12'" in refused(view, capsys, run, "--animation", "x.gif", "--resolution", "12")
    assert "pictures = 1" in refused(view, capsys, run, "--pictures", "1")
    assert "is a file, wanted a folder" in refused(view, capsys, run, "--page", str(tmp_path / "motion.npz" / "x.html"))
    assert "wanted no folder of a result's name" in refused(view, capsys, run, "--animation", str(tmp_path / "bare"))
    assert "want an .html file" in refused(view, capsys, run, "--page", str(tmp_path / "no" / "x.html"))


def test_view_without_a_robot_lists_those_that_are_archived_and_which_have_no_motion(
    view, tmp_path, monkeypatch, capsys
):
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "design.npz").touch()
    (tmp_path / "one" / "motion.npz").touch()
    monkeypatch.setattr("torchsoro.output.archive.DESIGNS", tmp_path)
    view.cli([])
    assert capsys.readouterr().out == "one\ntwo (without motion)\n"


def test_view_writes_page_export_and_animation(view, motion, tmp_path):
    motion.save(tmp_path / "motion.npz")
    run = str(tmp_path / "motion.npz")
    view.cli([run, "--page", str(tmp_path / "a.html")])
    view.cli([run, "--export", str(tmp_path / "vtu")])
    options = ("--resolution", "320x240", "--pictures", "3", "--fps", "10")
    view.cli([run, "--animation", str(tmp_path / "a.webp"), *options])
    assert (tmp_path / "a.html").is_file() and (tmp_path / "vtu" / "table.pvd").is_file()
    assert (tmp_path / "a.webp").stat().st_size > 1000


def test_address_of_a_free_port_is_accepted():
    check_address("localhost", free_port())
