"""Show a finished robot: simulate it again, on a CPU too, and write its movie and its printable STL.

    python recipes/replay.py                              # the robots there are
    python recipes/replay.py walker                       # two cycles of the archived walker, minutes on two cores
    python recipes/replay.py climber --cycles 5 --settle 0
    python recipes/replay.py runs/walker                  # one of your own
    python recipes/replay.py --archive runs/walker --name mine    # keep a finished run among the designs

Void is left out, which halves the time (``--void`` keeps it). The archived robots go as far without it to 3 %.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import torch
import tyro

from torchsoro.command_line import plain_errors
from torchsoro.design.reading import read_settings
from torchsoro.design.robot import build
from torchsoro.output import archive
from torchsoro.output.delivery import show

KEPT = (0, 5, 10, 20, 50, 100, 150, 200, 250, 300)  # iterations whose designs are archived


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """What to show."""

    robot: tyro.conf.Positional[str] = ""
    """Name of an archived robot, or a run's folder; the names there are if it is left out."""
    out: Path | None = None
    """Folder for movie and STL; runs/replay/<robot> if left out."""
    cycles: float = 2.0
    """Cycles of the pressure."""
    settle: float = 0.05
    """Time before the actuation starts, to come to rest [s]; the climber has none."""
    void: bool = False
    """Simulate void, too."""
    frames: int = 60
    """Pictures in the movie."""
    resolution: str = "960x640"
    """Of the movie: width x height in pixels."""
    fps: int = 20
    """Pictures of the movie per second."""
    follow: bool = False
    """Let the movie's camera follow the robot."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to compute."""
    archive: Path | None = None
    """Keep this finished run among the designs instead, under ``--name``."""
    name: str = ""
    """Name of the robot to keep."""


def main(options: Options) -> dict[str, float]:
    """Show a robot, or archive one.

    Returns:
        What was measured (see ``results.show``); empty where nothing was simulated.

    Raises:
        ValueError: for a robot that does not exist.
    """
    if options.archive is not None:
        if options.name in ("", "..") or Path(options.name).name != options.name:
            raise ValueError(f"name = {options.name!r}: wanted a plain name to keep {options.archive} under")
        domain = build(read_settings(options.archive / "settings.json", device="cpu")).domain
        archive.archive(options.archive, archive.DESIGNS / options.name, domain, KEPT)
        print(f"kept as {archive.DESIGNS / options.name}")
        return {}
    if not options.robot:
        print("\n".join(archive.names()))
        return {}
    begin = time.perf_counter()
    folder = archive.find(options.robot)
    designed = archive.read_result(folder)
    movie = {name: getattr(options, name) for name in ("frames", "resolution", "fps", "follow")}
    base = read_settings(folder / "settings.json", device=options.device, **movie)
    duration = round(options.cycles / base.frequency / base.sample_every) * base.sample_every
    settle = options.settle if base.settle > 0 else 0.0
    robot = build(dataclasses.replace(base, duration=duration, settle=settle))
    out = options.out or Path("runs/replay") / folder.name
    out.mkdir(parents=True, exist_ok=True)
    if robot.settings.target.type == "cpu":
        torch.set_num_threads(1)
    gamma = archive.load_design(folder / "design.npz", robot.domain).to(robot.settings.target)
    found, part = show(out, robot, gamma, name=folder.name, void=options.void)
    then = designed.get("stride")
    there = "" if then is None else f" (in the design run, over all its cycles and with void, {1e3 * then:.2f} mm)"
    print(
        f"{folder.name}: {1e3 * found['stride']:.2f} mm per cycle{there}, C = {found['C']:.4f}, "
        f"mass = {1e3 * found['mass']:.2f} g; {time.perf_counter() - begin:.0f} s; movie and STL are in {out}\n"
        f"{part.report}"
    )
    return found


def cli(arguments: Sequence[str] | None = None) -> None:
    """Show or keep a robot as the command line says.

    Args:
        arguments: Instead of the process's own.
    """
    with plain_errors():
        main(tyro.cli(Options, description=__doc__, args=arguments))


if __name__ == "__main__":
    cli()
