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
import json
import time
from pathlib import Path
from typing import Literal

import torch
import tyro

from torchsoro.archive import archive, load_design, read_settings
from torchsoro.results import show
from torchsoro.robot import build
from torchsoro.settings import plain_errors

DESIGNS = Path(__file__).resolve().parent / "designs"
KEPT = (0, 5, 10, 20, 50, 100, 150, 200, 250, 300)  # iterations whose designs are archived


def find(robot: str) -> Path:
    """The folder of an archived robot or of a run.

    Raises:
        ValueError: if there is none.
    """
    for folder in (DESIGNS / robot, Path(robot)):
        if (folder / "design.npz").is_file():
            return folder
    raise ValueError(
        f"robot = {robot!r}: wanted {', '.join(names()) or 'an archived robot'}, or a finished run's folder"
    )


def read_result(folder: Path) -> dict[str, float | None]:
    """What the design run measured; nothing if it was not written."""
    path = folder / "result.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def names() -> list[str]:
    """The archived robots."""
    return sorted(path.parent.name for path in DESIGNS.glob("*/design.npz"))


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
        archive(options.archive, DESIGNS / options.name, domain, KEPT)
        print(f"kept as {DESIGNS / options.name}")
        return {}
    if not options.robot:
        print("\n".join(names()))
        return {}
    begin = time.perf_counter()
    folder = find(options.robot)
    designed = read_result(folder)
    base = read_settings(folder / "settings.json", device=options.device, frames=options.frames)
    duration = round(options.cycles / base.frequency / base.sample_every) * base.sample_every
    settle = options.settle if base.settle > 0 else 0.0
    robot = build(dataclasses.replace(base, duration=duration, settle=settle))
    out = options.out or Path("runs/replay") / folder.name
    out.mkdir(parents=True, exist_ok=True)
    if robot.settings.target.type == "cpu":
        torch.set_num_threads(1)
    gamma = load_design(folder / "design.npz", robot.domain).to(robot.settings.target)
    found, part = show(out, robot, gamma, name=folder.name, void=options.void)
    then = designed.get("stride")
    there = "" if then is None else f" (in the design run, over all its cycles and with void, {1e3 * then:.2f} mm)"
    print(
        f"{folder.name}: {1e3 * found['stride']:.2f} mm per cycle{there}, C = {found['C']:.4f}, "
        f"mass = {1e3 * found['mass']:.2f} g; {time.perf_counter() - begin:.0f} s; movie and STL are in {out}\n"
        f"{part.report}"
    )
    return found


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Options, description=__doc__))
