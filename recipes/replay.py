"""Show a finished robot: simulate it again, on a CPU too, and write its movie and its printable STL.

    python recipes/replay.py                              # the robots there are
    python recipes/replay.py walker                       # one cycle of the archived walker, half a minute
    python recipes/replay.py climber --cycles 5 --settle 0
    python recipes/replay.py runs/walker                  # one of your own
    python recipes/replay.py --archive runs/walker --name mine    # keep a finished run among the designs

Void is left out, which halves the time (``--void`` keeps it). The archived robots go as far without it to 3 %.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro
from pydantic import Field

from torchsoro.command_line import AtLeastZero, Count, options, program

KEPT = (0, 5, 10, 20, 50, 100, 150, 200, 250, 300)  # iterations whose designs are archived


@options
class Options:
    """What to show."""

    robot: tyro.conf.Positional[str] = ""
    """Name of an archived robot, or a run's folder; the names there are if it is left out."""
    out: Path | None = None
    """Folder for movie and STL; runs/replay/<robot> if left out."""
    cycles: Annotated[float, Field(strict=True, gt=0, le=1000)] = 1.0
    """Cycles of the pressure."""
    settle: AtLeastZero = 0.05
    """Time before the actuation starts, to come to rest [s]; the climber has none."""
    void: bool = False
    """Simulate void, too."""
    frames: Count = 60
    """Pictures in the movie."""
    resolution: str = "960x640"
    """Of the movie: width x height in pixels."""
    fps: Annotated[int, Field(strict=True, ge=1, le=120)] = 20
    """Pictures of the movie per second."""
    follow: bool = False
    """Let the movie's camera follow the robot."""
    self_contact: bool | None = None
    """Let parts of the body that fold onto each other repel each other; as in the robot's settings if left out."""
    min_wall: AtLeastZero | None = None
    """Thickness up to which thin walls are mended [m]; as in the robot's settings if left out."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to compute."""
    archive: Path | None = None
    """Keep this finished run among the designs instead, under ``--name``."""
    name: str = ""
    """Name of the robot to keep."""


def main(chosen: Options) -> dict[str, float]:
    """Show a robot, or archive one.

    Returns:
        What was measured (see :func:`torchsoro.output.delivery.show`); empty where nothing was simulated.

    Raises:
        ValueError: for a robot that does not exist, or a folder that cannot be written.
    """
    # Imported when it runs, so that --help is there at once.
    import torch

    from torchsoro.design.reading import lasting, read_settings
    from torchsoro.design.robot import build
    from torchsoro.output import archive
    from torchsoro.output.delivery import numbers, show
    from torchsoro.output.folding import folding_line
    from torchsoro.output.printable import mending_line
    from torchsoro.storage import check_folder

    if chosen.archive is not None:
        if chosen.name in ("", "..") or Path(chosen.name).name != chosen.name:
            raise ValueError(f"name = {chosen.name!r}: wanted a plain name to keep {chosen.archive} under")
        domain = build(read_settings(chosen.archive / "settings.json", device="cpu")).domain
        archive.archive(chosen.archive, archive.DESIGNS / chosen.name, domain, KEPT)
        print(f"kept as {archive.DESIGNS / chosen.name}")
        return {}
    if not chosen.robot:
        print("\n".join(archive.names()))
        return {}
    folder = archive.find(chosen.robot)
    designed = archive.read_result(folder)
    movie = {name: getattr(chosen, name) for name in ("frames", "resolution", "fps", "follow")}
    base = read_settings(folder / "settings.json", device=chosen.device, scenarios=0, **movie)
    # At least one sample, so that even a small part of a cycle can be simulated.
    duration = max(1, round(chosen.cycles / base.frequency / base.sample_every)) * base.sample_every
    settle = chosen.settle if base.settle > 0 else 0.0
    min_wall = base.mended_to if chosen.min_wall is None else chosen.min_wall
    touches = base.self_contact if chosen.self_contact is None else chosen.self_contact
    changes = {"settle": settle, "min_wall": min_wall, "self_contact": touches}
    robot = build(dataclasses.replace(lasting(base, duration), **changes))
    out = chosen.out or Path("runs/replay") / folder.name
    written = ("motion.npz", "motion.html", "shape.stl", "shape.3mf", "shape.json")
    check_folder("out", out, (f"{folder.name}.mp4", *written))
    # Mended anew, for a part and a motion of the same walls.
    gamma = archive.load_design(folder / "design.npz", robot.domain, mended=False).to(robot.settings.target)
    archive.load_supply(folder / "design.npz", robot.supply)
    out.mkdir(parents=True, exist_ok=True)
    if robot.settings.target.type == "cpu":
        torch.set_num_threads(1)  # Taichi's threads do the work
    found, part = show(out, robot, gamma, name=folder.name, void=chosen.void)
    print(f"{folder.name}, {chosen.cycles:g} cycles: travel {1e3 * found['L']:.2f} mm; {numbers(found)}")
    if (then := designed.get("stride")) is not None:
        print(f"in the design run, over all of its cycles and with void: stride {1e3 * then:.2f} mm")
    print(mending_line(found) + folding_line(found, robot.settings), end="")
    print(f"printable part: {part.report}\nmovie and STL are in {out}")
    return found


cli = program(main, Options, __doc__)

if __name__ == "__main__":
    cli()
