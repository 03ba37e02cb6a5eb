"""View a robot's recorded motion in a browser: design, cut through walls and chamber, gait over time, pressure.

    python recipes/view.py                                 # the robots there are
    python recipes/view.py walker                          # the archived walker; nothing is simulated
    python recipes/view.py runs/walker --port 8090         # a run of your own
    python recipes/view.py walker --page walker.html       # a page that opens from disk
    python recipes/view.py walker --export walker-vtu      # for ParaView: a series of VTU files with a .pvd
    python recipes/view.py walker --animation walker.webp --resolution 600x400 --fps 15

The motion is that of ``motion.npz`` in the robot's folder, which a finished run and recipes/replay.py write.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from torchsoro.command_line import parse_resolution, program

if TYPE_CHECKING:
    from torchsoro.output.motion import Motion

# What a command needs beyond its options is imported by it alone: --help and a wrong option answer at once.


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """What to view, and where."""

    robot: tyro.conf.Positional[str] = ""
    """Name of an archived robot, a run's folder, or a motion.npz; the names there are if it is left out."""
    host: str = "localhost"
    """Name or address to serve on; 0.0.0.0 lets other machines look, too."""
    port: int = 8080
    """Port to serve on."""
    open: bool = True
    """Open a browser."""
    page: Path | None = None
    """Write the motion as one .html file instead, which opens without a network."""
    export: Path | None = None
    """Write the motion as VTU files to this folder instead."""
    animation: Path | None = None
    """Write a movie instead: .mp4, .gif or .webp."""
    resolution: str = "960x640"
    """Of the movie: width x height in pixels."""
    fps: int = 20
    """Pictures of the movie per second."""
    pictures: int = 60
    """Pictures in the movie, evenly over the recorded time."""
    follow: bool = True
    """Let the movie's camera follow the robot."""


def main(options: Options) -> Path | None:
    """View a motion until Ctrl-C, or write it.

    Returns:
        What was written; None where it was shown.

    Raises:
        ValueError: for a robot that does not exist or has no motion, an address that cannot be served on, a path that
            cannot be written to.
    """
    from torchsoro.output import archive
    from torchsoro.output.motion import FILE
    from torchsoro.storage import check_folder

    if not options.robot:
        if options.page or options.export or options.animation:
            wanted = f"a run's folder, a motion.npz or one of {', '.join(archive.names())}"
            raise ValueError(f"robot: none given, wanted {wanted}")
        for name in archive.names():
            print(name if (archive.DESIGNS / name / FILE).is_file() else f"{name} (without motion)")
        return None
    width, height = parse_resolution(options.resolution)
    if options.pictures < 2:
        raise ValueError(f"pictures = {options.pictures}: wanted at least 2")
    for name in ("page", "animation"):
        if (path := getattr(options, name)) is not None:
            check_folder(name, path.parent, [path.name])
    motion = find_motion(options.robot)
    if options.page is not None:
        from torchsoro.output.web_page import write_page

        return _told(write_page(motion, options.page))
    if options.export is not None:
        from torchsoro.output.export import export_vtu

        return _told(export_vtu(motion, options.export))
    if options.animation is not None:
        return _told(animate(motion, options, width, height))
    from torchsoro.output.viewer import Viewer

    viewer = Viewer(motion, host=options.host, port=options.port)
    print(f"{motion.name}: {viewer.address} (Ctrl-C ends)", flush=True)
    try:
        viewer.run(open_browser=options.open)
    except KeyboardInterrupt:
        viewer.stop()
    return None


def find_motion(robot: str) -> Motion:
    """The motion of an archived robot, of a folder, or in a file.

    Raises:
        ValueError: if there is no such robot, or no motion of it.
    """
    from torchsoro.output import archive
    from torchsoro.output.motion import FILE, read_motion

    path = Path(robot)
    if path.is_file() or (path / FILE).is_file():
        return read_motion(path)
    return read_motion(archive.find(robot))


def animate(motion: Motion, options: Options, width: int, height: int) -> Path:
    """Write a movie of the motion."""
    import numpy as np

    from torchsoro.output.picture import movie

    assert options.animation is not None
    drawn = np.unique(np.linspace(0, len(motion.time) - 1, options.pictures).round().astype(int))
    return movie(
        options.animation,
        domain=motion.domain,
        gamma=motion.gamma,
        frames=motion.positions(drawn),
        time=motion.time[drawn] - motion.time[0],
        pressure=motion.pressure[drawn],
        planes=motion.planes,
        direction=motion.direction,
        tilt=motion.tilt,
        title=motion.name,
        fps=options.fps,
        width=width,
        height=height,
        follow=options.follow,
    )


def _told(path: Path) -> Path:
    print(f"written: {path}")
    return path


cli = program(main, Options, __doc__)

if __name__ == "__main__":
    cli()
