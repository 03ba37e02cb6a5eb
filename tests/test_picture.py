"""Pictures: the deformation is exact where it must be, the files are whole, and what should be seen is on the page."""

from __future__ import annotations

import subprocess
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from moving import DOMAIN, table
from PIL import Image

from torchsoro.design.domain import Domain
from torchsoro.output.fabricate import surface
from torchsoro.output.page import history_panel, last_cycle, motion_of
from torchsoro.output.picture import deform, movie, shape_image, summary
from torchsoro.output.scene import Camera

WALLS = ((0, 0.1, 1), (0, 0.136, -1))


def walk(count: int = 5, travel: float = 0.01, axis: int = 0) -> torch.Tensor:
    """Frames that move along an axis."""
    frames = DOMAIN.positions.repeat(count, 1, 1)
    frames[:, :, axis] += torch.linspace(0, travel, count, dtype=torch.float64)[:, None]
    return frames


def arguments(count: int = 5) -> dict:
    time = torch.linspace(0.25, 0.75, count)
    pressure = 40e3 * (1 - torch.cos(2 * torch.pi * 5 * time))
    return {"domain": DOMAIN, "gamma": table(), "frames": walk(count), "time": time, "pressure": pressure}


@pytest.mark.parametrize("weighted", [False, True])
def test_deform_is_exact_for_affine_motion(weighted: bool) -> None:
    gamma = table()
    vertices, _ = surface(DOMAIN, gamma)
    matrix, shift = np.array([[0.9, -0.4, 0.1], [0.3, 1.2, 0.2], [0.0, -0.1, 0.8]]), np.array([0.01, 0.02, 0.03])
    frame = DOMAIN.positions.numpy() @ matrix.T + shift
    moved = deform(DOMAIN, vertices, frame, gamma=gamma if weighted else None)
    # With densities a little regularisation takes up to 1 % of a spacing.
    np.testing.assert_allclose(moved, vertices @ matrix.T + shift, atol=0.01 * DOMAIN.spacing if weighted else 1e-9)


def test_deform_follows_the_material_and_not_the_void() -> None:
    gamma = table()
    vertices, _ = surface(DOMAIN, gamma)
    frame = DOMAIN.positions.numpy().copy()
    void = ((gamma < 0.01) & DOMAIN.design).numpy()
    frame[void] += np.random.default_rng(0).normal(0, 2e-3, (int(void.sum()), 3))
    astray = np.abs(deform(DOMAIN, vertices, frame) - vertices).max()
    assert np.abs(deform(DOMAIN, vertices, frame, gamma=gamma) - vertices).max() < min(1e-4, 0.1 * astray)


def test_camera_keeps_z_vertical_and_lengths() -> None:
    for azimuth, elevation in ((-60, 20), (30, 45), (-90, 0)):
        view = Camera(azimuth, elevation).axes
        np.testing.assert_allclose(view @ view.T, np.eye(3), atol=1e-12)
        assert view[0, 2] == 0 and view[1, 2] > 0 and np.linalg.det(view) == pytest.approx(1)
    np.testing.assert_allclose(Camera(-90, 0).axes, [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-12)


def share_of(image: np.ndarray, color: str) -> float:
    """Share of the pixels that are bluish (body) or reddish (pressure)."""
    red, green, blue = (image[..., i].astype(int) for i in range(3))
    chosen = {"blue": blue - red > 20, "red": red - green > 25, "ink": image.max(axis=2) < 250}[color]
    return float(chosen.mean())


def test_shape_image_shows_body_ground_and_pressure() -> None:
    still = shape_image(domain=DOMAIN, gamma=table(), title="iteration 3")
    assert still.shape == (480, 640, 3) and still.dtype == np.uint8
    assert 0.1 < share_of(still, "blue") < 0.7
    bare = shape_image(domain=DOMAIN, gamma=table(), planes=())
    assert share_of(bare, "ink") != share_of(still, "ink")
    full = shape_image(domain=DOMAIN, gamma=table(), frame=walk()[2], pressure=1.0, planes=WALLS, width=320, height=256)
    assert full.shape == (256, 320, 3) and share_of(full, "red") > share_of(still, "red")
    empty = Domain(size=(0.036,) * 3, particles=(12,) * 3)
    assert shape_image(domain=empty, gamma=torch.zeros(empty.count)).std() > 0  # an empty stage, not a crash


def test_travel_is_that_of_the_design_material() -> None:
    motion = motion_of(DOMAIN, table(), walk(5, 0.01), np.arange(5.0), None, (), (1, 0, 0), 0.5)
    np.testing.assert_allclose(motion.travel, [0, 2.5, 5, 7.5, 10], atol=1e-9)
    back = motion_of(DOMAIN, table(), walk(5, 0.01), np.arange(5.0), None, (), (-1, 0, 0), 0.5)
    np.testing.assert_allclose(back.travel, -motion.travel, atol=1e-12)


def test_last_cycle_from_pressure_period_or_nothing() -> None:
    time = np.linspace(0.0, 1.0, 201)
    pressure = 80e3 * ((time * 5) % 1 < 0.5)
    frames = walk(1).expand(201, -1, -1)
    motion = motion_of(DOMAIN, table(), frames, time, pressure, (), (1, 0, 0), 0.5)
    assert last_cycle(motion, None) == pytest.approx((0.8, 1.0), abs=0.006)
    calm = motion_of(DOMAIN, table(), frames, time, None, (), (1, 0, 0), 0.5)
    assert last_cycle(calm, None) == (0.0, 1.0)
    assert last_cycle(calm, 0.25) == pytest.approx((0.75, 1.0))


def test_movies_are_whole(tmp_path: Path) -> None:
    film = movie(tmp_path / "gait.mp4", **arguments(), title="walker", width=480, height=320, fps=20)
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(film), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    decoded = subprocess.run(command, capture_output=True, check=True)
    pictures = np.frombuffer(decoded.stdout, np.uint8).reshape(-1, 320, 480, 3)
    assert len(pictures) == 5 and b"20 fps" in decoded.stderr and b"h264" in decoded.stderr
    assert np.abs(pictures[0].astype(int) - pictures[-1]).max() > 50  # it moves
    given = arguments(3) | {"pressure": None, "frames": walk(3, axis=2), "planes": WALLS, "direction": (0, 0, 1)}
    with Image.open(movie(tmp_path / "gait.gif", **given, width=320, height=240)) as picture:
        assert getattr(picture, "n_frames", 1) == 3 and picture.size == (320, 240)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["gait.gif", "gait.mp4"]


def body_column(picture: np.ndarray) -> float:
    """Mean column of the bluish pixels above the pressure trace."""
    upper = picture[: int(0.8 * len(picture))].astype(int)
    return float(np.argwhere(upper[..., 2] - upper[..., 0] > 20)[:, 1].mean())


@pytest.mark.parametrize("follow", [pytest.param(False, marks=pytest.mark.slow), True])
def test_camera_that_follows_keeps_the_body_within_a_tenth_of_the_width_and_shows_it_larger(
    tmp_path: Path, follow: bool
) -> None:
    given = arguments(7) | {"frames": walk(7, 0.06)}
    path = movie(tmp_path / "gait.webp", **given, width=481, height=321, follow=follow)
    with Image.open(path) as film:
        assert film.size == (481, 321)
        pictures = []
        for frame in range(7):
            film.seek(frame)
            pictures.append(np.asarray(film.convert("RGB")))
    columns = [body_column(picture) for picture in pictures]
    # The camera's path is smoothed: a body at constant speed drifts a little at both ends.
    assert np.ptp(columns) < 48 if follow else np.ptp(columns) > 100
    assert (share_of(pictures[3], "blue") > 0.1) == follow


def test_a_failed_movie_leaves_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    old = tmp_path / "gait.gif"
    old.write_bytes(b"old")

    def fail(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("imageio_ffmpeg.get_ffmpeg_exe", lambda: "false")
    with pytest.raises(RuntimeError, match="ffmpeg could not write"):
        movie(tmp_path / "new.mp4", **arguments(2))
    monkeypatch.setattr("torchsoro.output.picture._write_animation", fail)
    with pytest.raises(OSError, match="disk full"):
        movie(old, **arguments(2))
    assert old.read_bytes() == b"old" and list(tmp_path.iterdir()) == [old]


@pytest.mark.parametrize("climb", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_summary(tmp_path: Path, climb: bool) -> None:
    history = {"objective/L": [1e-3, float("nan"), 3e-3], "constraint/C": [0.05, 0.03, 0.012]}
    given = arguments(12)
    if climb:
        given |= {"frames": walk(12, axis=2), "planes": WALLS, "direction": (0, 0, 1), "pressure": None}
    path = summary(tmp_path / "summary.png", **given, history=history, limit=0.0125, period=0.2, title="run")
    with Image.open(path) as picture:
        image = np.asarray(picture)
    assert image.shape == (1120, 1760, 3) and share_of(image, "blue") > 0.02
    assert [p.name for p in tmp_path.iterdir()] == ["summary.png"]


@pytest.mark.parametrize(("chosen", "marked"), [(None, (3, 3.0)), (2, (2, 4.5)), (1, (2, 4.5))])
def test_a_history_marks_the_chosen_iteration_or_the_next_that_is_known(chosen, marked) -> None:
    axes = Figure().add_subplot()
    history_panel(axes, np.array([1.0, float("nan"), 4.5, 3.0]), "k", "L [mm]", "objective", chosen=chosen)
    assert axes.lines[1].get_xydata().tolist() == [list(marked)]


def test_travel_is_along_a_displacement_that_is_given() -> None:
    displacement = np.array([[-1e-3, 0, 0], [0, 0, 1e-3], [2e-3, 0, 0]])
    given = (DOMAIN, table(), walk(3), np.arange(3.0), None, (), (1, 0, 0), 0.5)
    assert motion_of(*given, displacement).travel == pytest.approx([-1, 0, 2])
    with pytest.raises(ValueError, match=r"displacement: got shape \(2, 3\)"):
        motion_of(*given, displacement[:2])


def test_the_last_whole_cycle_counts_from_the_start_of_the_actuation() -> None:
    time = np.linspace(0.0, 0.55, 56)
    motion = motion_of(DOMAIN, table(), walk(1).expand(56, -1, -1), time, None, (), (1, 0, 0), 0.5)
    assert last_cycle(motion, 0.2, 0.05) == pytest.approx((0.25, 0.45))
    assert last_cycle(motion, 0.2, 0.4) == pytest.approx((0.35, 0.55))  # no whole one since then


def test_refusals(tmp_path: Path) -> None:
    nan = walk()
    nan[1, 2, 0] = float("nan")
    for change, words in [
        ({"frames": walk()[:, :-1]}, "frames: got shape"),
        ({"frames": nan}, "frames: got positions that are not finite"),
        ({"time": torch.zeros(4)}, r"time: got shape \(4,\)"),
        ({"time": torch.zeros(5)}, "time: got no increase after frame 0"),
        ({"pressure": torch.full((5,), float("inf"))}, "pressure"),
        ({"planes": ((3, 0.0, 1),)}, "planes: got"),
        ({"direction": (1.0, 1.0, 0.0)}, "direction: got"),
        ({"fps": 0}, "fps: got 0"),
        ({"width": 479}, "width, height: got 479"),
        ({"gamma": torch.ones(3)}, "gamma: got shape"),
    ]:
        with pytest.raises(ValueError, match=words):
            movie(tmp_path / "x.mp4", **(arguments() | change))
    with pytest.raises(ValueError, match=r"path: got .* want a suffix among .mp4, .gif, .webp"):
        movie(tmp_path / "x.avi", **arguments())
    with pytest.raises(ValueError, match="want a folder that exists"):
        movie(tmp_path / "no" / "x.gif", **arguments())
    with pytest.raises(ValueError, match=r"history: got the keys \['L'\], want numbers under 'C'"):
        summary(tmp_path / "x.png", **arguments(), history={"L": [1.0]})
    with pytest.raises(ValueError, match="period: got 0"):
        summary(tmp_path / "x.png", **arguments(), history={"L": [1.0], "C": [0.0]}, period=0)
    assert not list(tmp_path.iterdir())
