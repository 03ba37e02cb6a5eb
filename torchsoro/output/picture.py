"""Movies, a one-page summary and single views of a design in motion.

No display and no GPU: triangles are culled, shaded and sorted by depth in orthographic projection, and Matplotlib
paints them as one flat collection, in some tens of milliseconds a frame. The up axis z is always vertical on the page.
Camera angles follow Matplotlib: azimuth -90 degrees looks along +y, so +x points to the right; elevation 90 degrees
looks down. Everything passed in is in SI units; everything drawn is in mm from the lower corner of the body at rest.
"""

from __future__ import annotations

import contextlib
import math
import os
import subprocess
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from torchsoro.output.canvas import canvas_of, pixels
from torchsoro.output.levelset import as_array
from torchsoro.output.page import (
    DrawnMotion,
    check_frames,
    check_planes,
    gait_panels,
    heading,
    history_panel,
    last_cycle,
    motion_of,
    path_panels,
    pressure_trace,
)
from torchsoro.output.scene import FAINT, INK, REST, Camera, PlaneTuple, Scene, Shape, Skin, bounds_of, camera_path
from torchsoro.storage import atomic_write

if TYPE_CHECKING:
    from torchsoro.design.domain import Domain


MOVIES = (".mp4", ".gif", ".webp")


# ---------------------------------------------------------------------------------------------------------- deformation
def deform(domain: Domain, vertices: np.ndarray, frame: Any, *, gamma: Any | None = None) -> np.ndarray:
    """Carry points of the body at rest along with the particles.

    Args:
        domain: the lattice.
        vertices: points at rest [V, 3] in m.
        frame: positions of the particles [N, 3] in m.
        gamma: densities [N]; with them, points follow the material and not the void, whose particles may be anywhere.

    Returns:
        The moved points [V, 3] in m: a moving-least-squares fit to the particles around, exact for every affine
        motion and beyond the outermost particles (with densities, to 0.01 spacings).

    Raises:
        ValueError: for a frame of the wrong shape or not finite.
    """
    moved = check_frames(domain, as_array(frame)[None])[0]
    return Skin(domain, np.asarray(vertices, dtype=float), gamma)(moved)


# ------------------------------------------------------------------------------------------------------------- drawing
def shape_image(
    *,
    domain: Domain,
    gamma: Any,
    frame: Any | None = None,
    pressure: float | None = None,
    planes: Sequence[PlaneTuple] = ((2, 0.0, 1),),
    azimuth: float = -60.0,
    elevation: float = 20.0,
    width: int = 640,
    height: int = 480,
    level: float = 0.5,
    title: str | None = None,
) -> np.ndarray:
    """One shaded view of the design.

    Args:
        domain: the lattice.
        gamma: density per particle [N].
        frame: positions of the particles [N, 3] in m; None is the body at rest.
        pressure: 0 (rest) to 1 (largest): colours the cavity, seen through the body.
        planes: ground and walls to draw, each (axis, position [m], side of the robot).
        azimuth: of the camera [degrees].
        elevation: of the camera [degrees].
        width: in pixels.
        height: in pixels.
        level: density at the surface.
        title: written above.

    Returns:
        An image, uint8 [height, width, 3].

    Raises:
        ValueError: for arrays of the wrong shape and for planes that are none.
    """
    check_planes(planes)
    frames = check_frames(domain, as_array(domain.positions if frame is None else frame)[None])
    shape = Shape(domain, gamma, level)
    vertices, cavity = shape.place(frames[0])
    figure, canvas = canvas_of(width, height)
    axes = figure.add_axes((0.0, 0.0, 1.0, 0.93 if title else 1.0))
    Scene(axes, shape, Camera(azimuth, elevation), planes, bounds_of([vertices])).show(vertices, cavity, pressure)
    if title:
        figure.text(0.5, 0.975, title, ha="center", va="top", fontsize=12, color=INK)
    return pixels(canvas)


# --------------------------------------------------------------------------------------------------------------- movie
def movie(
    path: str | os.PathLike[str],
    *,
    domain: Domain,
    gamma: Any,
    frames: Any,
    time: Any,
    pressure: Any | None = None,
    planes: Sequence[PlaneTuple] = ((2, 0.0, 1),),
    direction: Sequence[float] = (1.0, 0.0, 0.0),
    displacement: Any | None = None,
    fps: int = 30,
    title: str | None = None,
    azimuth: float = -65.0,
    elevation: float = 16.0,
    tilt: float = 0.0,
    width: int = 960,
    height: int = 640,
    follow: bool = False,
    level: float = 0.5,
) -> Path:
    """Write a movie, one picture per frame, with the time, the travel and the pressure.

    Args:
        path: an .mp4, .gif or .webp file; it is there whole or not at all.
        domain: the lattice.
        gamma: density per particle [N].
        frames: positions of the particles [S, N, 3] in m.
        time: of the frames [S] in s.
        pressure: gauge pressure at the frames [S] in Pa.
        planes: ground and walls to draw, each (axis, position [m], side of the robot).
        direction: unit vector of the travel that is written out.
        displacement: of the centre of gravity since the start of the actuation [S, 3] in m, whose travel is written
            out; None takes that of the densities since the first frame.
        fps: pictures per second.
        title: written above.
        azimuth: of the camera [degrees].
        elevation: of the camera [degrees].
        tilt: by which all is turned, so that a slope whose ground was kept level rises along +x [degrees].
        width: in pixels; even for .mp4.
        height: in pixels; even for .mp4.
        follow: let the camera follow the robot, which is then larger; otherwise all of its way is seen.
        level: density at the surface.

    Returns:
        The path.

    Raises:
        ValueError: for another suffix, arrays of the wrong shape, times that do not increase, planes that are none.
    """
    target = _target(path, MOVIES)
    if not (isinstance(fps, int) and 1 <= fps <= 120):
        raise ValueError(f"fps: got {fps}, want a whole number from 1 to 120")
    if min(width, height) < 160 or (target.suffix.lower() == ".mp4" and (width % 2 or height % 2)):
        raise ValueError(f"width, height: got {width} x {height}, want at least 160, and even numbers for .mp4")
    motion = motion_of(domain, gamma, frames, time, pressure, planes, direction, level, displacement)
    looks = camera_path(motion.cog, direction) if follow else None
    pictures = _pictures(motion, planes, Camera(azimuth, elevation, tilt), title, fps, (width, height), looks)
    # ffmpeg writes to a path of its own, so a movie moves to its place when it is complete.
    with tempfile.TemporaryDirectory() as folder:
        temporary = Path(folder) / target.name
        if target.suffix.lower() == ".mp4":
            _write_mp4(temporary, pictures, (width, height), fps)
        else:
            _write_animation(temporary, pictures, fps)
        with atomic_write(target) as file:
            file.write(temporary.read_bytes())
    return target


def _pictures(
    motion: DrawnMotion,
    planes: Sequence[PlaneTuple],
    camera: Camera,
    title: str | None,
    fps: int,
    size: tuple[int, int],
    looks: np.ndarray | None,
) -> Iterator[np.ndarray]:
    figure, canvas = canvas_of(*size)
    # Below some 600 pixels text of the usual size would run into itself.
    scale = min(1.0, size[0] / 720)
    below = max(0.075, 36 / size[1])  # for the numbers and the name of the time axis
    strip = 0.0 if motion.pressure is None else below + 0.095
    axes = figure.add_axes((0.01, strip + 0.01, 0.98, 0.90 - strip))
    start = float(motion.cog[0, motion.along])
    scene = Scene(axes, motion.shape, camera, planes, motion.bounds, along=motion.along, start=start)
    if looks is not None:
        scene.frame(vertices - look for (vertices, _), look in zip(motion.placed, looks, strict=True))
    if title:
        figure.text(0.02, 0.975, title, va="top", fontsize=14 * scale, color=INK, weight="bold")
    steps = np.diff(motion.time)
    slow = 1 / (fps * steps.mean()) if len(steps) else 1.0
    speed = "real time" if abs(slow - 1) < 0.05 else (f"slowed {slow:.3g}x" if slow > 1 else f"{1 / slow:.3g}x faster")
    figure.text(0.98, 0.975, speed if len(steps) else "", va="top", ha="right", fontsize=10 * scale, color=FAINT)
    label = figure.text(
        0.02, 0.925 if title else 0.975, "", va="top", fontsize=12 * scale, color=INK, family="DejaVu Sans Mono"
    )
    dot = None
    if motion.pressure is not None:
        left = max(0.075, 54 / size[0])  # for the numbers beside it
        trace = figure.add_axes((left, below, 1 - left - max(0.02, 18 / size[0]), strip - below))
        dot = pressure_trace(trace, motion.time, motion.pressure)
        trace.set_xlabel("time [s]", color=INK, fontsize=9, labelpad=1)
    for i, (vertices, cavity) in enumerate(motion.placed):
        scene.show(vertices, cavity, motion.fill(i))
        if looks is not None:
            scene.look_at(looks[i])
        label.set_text(f"t = {motion.time[i]:.3f} s   travel {motion.travel[i]:+6.2f} mm")
        if dot is not None and motion.pressure is not None:
            dot.set_data([motion.time[i]], [motion.pressure[i]])
        yield pixels(canvas)


def _write_mp4(path: Path, pictures: Iterator[np.ndarray], size: tuple[int, int], fps: int) -> None:
    import imageio_ffmpeg  # here, so that robots are designed and STLs written without it

    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error"]
    command += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[0]}x{size[1]}", "-r", str(fps), "-i", "-"]
    command += ["-an", "-c:v", "libx264", "-crf", "20", "-pix_fmt", "yuv420p", "-movflags", "+faststart", str(path)]
    with tempfile.TemporaryFile() as messages:
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=messages) as ffmpeg:
            assert ffmpeg.stdin is not None
            with contextlib.suppress(BrokenPipeError):  # ffmpeg has stopped, and says why below
                for picture in pictures:
                    ffmpeg.stdin.write(picture.data)
                ffmpeg.stdin.close()
        if ffmpeg.returncode:
            messages.seek(0)
            raise RuntimeError(f"ffmpeg could not write the movie: {messages.read().decode(errors='replace').strip()}")


def _write_animation(path: Path, pictures: Iterator[np.ndarray], fps: int) -> None:
    images: Iterator[Image.Image] = (Image.fromarray(picture) for picture in pictures)
    options: dict[str, Any] = {"quality": 75, "method": 4}
    if path.suffix.lower() == ".gif":
        images = (i.quantize(256, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE) for i in images)
        options = {"optimize": False}
    first = next(images)
    first.save(path, save_all=True, append_images=images, duration=round(1000 / fps), loop=0, **options)


def _target(path: str | os.PathLike[str], suffixes: tuple[str, ...]) -> Path:
    target = Path(path)
    if target.suffix.lower() not in suffixes:
        raise ValueError(f"path: got {str(target)!r}, want a suffix among {', '.join(suffixes)}")
    if not target.parent.is_dir():
        raise ValueError(f"path: got {str(target)!r}, want a folder that exists")
    return target


# ------------------------------------------------------------------------------------------------------------- summary
def summary(
    path: str | os.PathLike[str],
    *,
    domain: Domain,
    gamma: Any,
    frames: Any,
    time: Any,
    history: Mapping[str, Sequence[float]],
    pressure: Any | None = None,
    planes: Sequence[PlaneTuple] = ((2, 0.0, 1),),
    direction: Sequence[float] = (1.0, 0.0, 0.0),
    displacement: Any | None = None,
    start: float | None = None,
    limit: float | None = None,
    period: float | None = None,
    title: str | None = None,
    note: str | None = None,
    azimuth: float = -65.0,
    elevation: float = 16.0,
    tilt: float = 0.0,
    level: float = 0.5,
    chosen: int | None = None,
    scenarios: np.ndarray | None = None,
) -> Path:
    """Write the page of a run: shape, histories of L and C, one cycle of the gait, path of the centre of gravity.

    Args:
        path: a .png file; it is there whole or not at all.
        domain: the lattice.
        gamma: density per particle [N].
        frames: positions of the particles [S, N, 3] in m.
        time: of the frames [S] in s.
        history: per iteration, "L" [m] and "C" [-] (or "objective/L" and "constraint/C"); of a turner its angle,
            "objective/turn" [rad], which is drawn instead of L.
        pressure: gauge pressure at the frames [S] in Pa.
        planes: ground and walls to draw, each (axis, position [m], side of the robot).
        direction: unit vector of the travel.
        displacement: as for a movie.
        start: of the first cycle [s]; None takes cycles from the rises of the pressure.
        limit: C_max, drawn as a line.
        period: of the actuation [s]; None takes it from the pressure, or else the whole time.
        title: written above.
        note: written at the right of the title, as small as it takes.
        azimuth: of the camera [degrees].
        elevation: of the camera [degrees].
        tilt: as for a movie [degrees].
        level: density at the surface.
        chosen: iteration that the design is of, counted from 0; the last if None.
        scenarios: travel in each scenario [S] m, drawn in place of the path; NaN where the simulation broke down.

    Returns:
        The path.

    Raises:
        ValueError: for another suffix, arrays of the wrong shape, a history without L or C, times that do not increase.
    """
    target = _target(path, (".png",))
    constraint = _history(history, "C", "constraint/C")
    if "objective/turn" in history:
        objective, unit, said = np.degrees(_history(history, "objective/turn")), "turn [degrees]", "objective, angle"
    else:
        objective, unit, said = 1e3 * _history(history, "L", "objective/L"), "L [mm]", "objective L"
    if period is not None and not (math.isfinite(period) and period > 0):
        raise ValueError(f"period: got {period} s, want a positive number")
    motion = motion_of(domain, gamma, frames, time, pressure, planes, direction, level, displacement)
    figure, canvas = canvas_of(1760, 1120, 110)
    _headline(figure, title or "", note or "")
    camera = Camera(azimuth, elevation, tilt)
    view = figure.add_axes((0.02, 0.46, 0.34, 0.46))
    vertices, cavity = motion.shape.place(as_array(domain.positions))
    Scene(view, motion.shape, camera, planes, bounds_of([vertices]), along=motion.along).show(vertices, cavity, None)
    heading(view, "design (orange: chamber wall; inside: cavity)")

    upper = figure.add_axes((0.425, 0.74, 0.24, 0.175))
    history_panel(upper, objective, REST, unit, f"{said} (dot: this design)", chosen=chosen)
    lower = figure.add_axes((0.425, 0.48, 0.24, 0.175), sharex=upper)
    history_panel(lower, constraint, "#b5651d", "C [-]", "intermediate density C (dot: this design)", limit, chosen)
    lower.set_xlabel("iteration", color=INK)
    cycle = last_cycle(motion, period, start)
    path_panels(figure, motion, cycle, scenarios)
    gait_panels(figure, motion, planes, camera, cycle)
    image = Image.fromarray(pixels(canvas))
    with atomic_write(target) as file:
        image.save(file, format="PNG", dpi=(110, 110))
    return target


def _headline(figure: Figure, title: str, note: str) -> None:
    """A title, and at its right a note in letters as small as it takes."""
    left = figure.text(0.03, 0.975, title, va="top", fontsize=17, weight="bold", color=INK).get_window_extent()
    right = figure.text(0.975, 0.97, note, va="top", ha="right", fontsize=11, color=INK)
    room, wanted = 0.965 * figure.bbox.width - left.x1, right.get_window_extent().width
    right.set_fontsize(11 * min(1.0, room / max(wanted, 1.0)))


def _history(history: Mapping[str, Sequence[float]], *names: str) -> np.ndarray:
    for name in names:
        if name in history and np.isfinite(np.asarray(history[name], dtype=float)).any():
            return np.asarray(history[name], dtype=float)
    raise ValueError(f"history: got the keys {sorted(history)}, want numbers under {names[0]!r} or {names[-1]!r}")
