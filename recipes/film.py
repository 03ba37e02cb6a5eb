"""Prepare the experiment of a robot that was designed: what is believed of it, at which pressures, and its markers.

    python recipes/film.py walker --out my-experiment        # an archived robot, or a run's folder
    python recipes/convert.py walkDLC.csv --out my-experiment/trials/a/markers.csv --fps 240 --scale 0.0005
    python recipes/explain.py my-experiment --out runs/explained

Writes setup.toml with the body (body.stl), its material, chambers and ground as designed, a folder with a pressure.csv
for each trial, and markers.png, which shows where the markers of setup.toml are to be. Print the robot, stick or draw
markers there, film it at these pressures, and put a markers.csv into each trial's folder. Correct in setup.toml what
you know better, and put what your gauge measured into pressure.csv.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro
from pydantic import Field

from torchsoro.command_line import AtLeastZero, Positive, options, program

SAMPLING = 1e-3  # s, of pressure.csv
REACHED = 0.25  # of the body's width: how deep between its limbs a marker can be put


@options
class Options:
    """What is to be filmed."""

    robot: tyro.conf.Positional[str]
    """Name of an archived robot, or a run's folder."""
    out: Path
    """Folder of the experiment."""
    camera: Literal["-x", "+x", "-y", "+y"] = "-y"
    """Side of the body on which the camera stands, level."""
    kind: Literal["video", "mocap"] = "video"
    """Of the recording: one camera, which sees two axes, or motion capture."""
    markers: Annotated[int, Field(strict=True, ge=1, le=64)] = 8
    """How many, far from each other on the side that the camera sees."""
    pressures: tuple[Positive, ...] = (1.0, 0.8, 0.6)
    """Pressure of each trial, over that of the design; trials that differ tell more."""
    heldout: AtLeastZero = 0.9
    """The same of a trial that is only predicted, as a check; 0 for none."""
    settle: AtLeastZero = 0.05
    """Time at rest before the actuation [s]."""
    duration: Positive = 0.2
    """Of the actuation [s]."""


def main(chosen: Options) -> Path:
    """Write the experiment.

    Returns:
        Its folder.

    Raises:
        ValueError: for a robot that does not exist, or whose chamber is a mesh; for a folder that holds an experiment
            already, or cannot be written.
    """
    # Imported when it runs, so that --help is there at once.
    import numpy as np
    import torch
    import trimesh
    from PIL import Image

    from torchsoro.design.reading import read_settings
    from torchsoro.design.robot import build
    from torchsoro.output.archive import find, load_design, load_supply
    from torchsoro.output.fabricate import surface
    from torchsoro.output.loose import loose_share, without_loose
    from torchsoro.output.marker_map import marker_map
    from torchsoro.sim2real.data.from_design import believed, elements, far_apart, marker_tables, seen_from
    from torchsoro.sim2real.data.recording import write_table
    from torchsoro.storage import check_folder

    if (chosen.out / "setup.toml").exists() or (chosen.out / "trials").exists():
        raise ValueError(f"out = {chosen.out}: holds an experiment already, wanted a new folder")
    check_folder("out", chosen.out, ("setup.toml", "body.stl", "markers.png"))
    folder = find(chosen.robot)
    timed = {"settle": chosen.settle, "duration": chosen.duration}
    base = dataclasses.replace(read_settings(folder / "settings.json", device="cpu", scenarios=0), **timed)
    robot = build(base)
    load_supply(folder / "design.npz", robot.supply)
    design = load_design(folder / "design.npz", robot.domain)
    gamma = without_loose(robot, design)
    if share := loose_share(design, gamma):
        print(f"{100 * share:.2g} % of the solid is loose and not printed: body.stl is without it")
    length = chosen.settle + chosen.duration
    text = believed(
        robot,
        title=folder.name,
        duration=length,
        prony=elements(robot),
        air_stiffness=base.air_stiffness,
    )
    axis, side = "xyz".index(chosen.camera[1]), 1 if chosen.camera[0] == "+" else -1
    solid = robot.domain.positions[(gamma >= 0.5) & ~robot.domain.gas].numpy()
    seen = solid[seen_from(solid, axis, side, robot.domain.spacing)]
    away = -side * seen[:, axis]
    near = seen[away <= away.min() + REACHED * robot.domain.size[axis]]
    places = {f"m{k + 1}": near[i] for k, i in enumerate(far_apart(near, chosen.markers))}
    text += f"\n{marker_tables({name: place.tolist() for name, place in places.items()})}"
    axes = ["x", "y", "z"] if chosen.kind == "mocap" else [a for a in "xyz" if a != chosen.camera[1]]
    text += f'\n[recording]\nkind = "{chosen.kind}"\naxes = {axes}\n'.replace("'", '"')
    chosen.out.mkdir(parents=True, exist_ok=True)
    time = torch.arange(0, length + SAMPLING / 2, SAMPLING, dtype=torch.float64)
    shares = {f"trials/{chr(ord('a') + k)}": share for k, share in enumerate(chosen.pressures)}
    for trial, share in (shares | ({"heldout/kept": chosen.heldout} if chosen.heldout else {})).items():
        found = share * robot.pressure.at(time).detach().double().reshape(-1, len(time)).numpy()
        table = {f"{c.name}_pa": p for c, p in zip(robot.domain.chambers, found, strict=True)}
        write_table(chosen.out / trial / "pressure.csv", {"time_s": time.numpy(), **table})
        print(f"{trial}: up to {1e-3 * np.max(found):.3g} kPa")
    trimesh.Trimesh(*surface(robot.domain, gamma.numpy())).export(chosen.out / "body.stl")
    picture = marker_map(seen, places, axis, side, robot.domain.spacing)
    Image.fromarray(picture).save(chosen.out / "markers.png")
    (chosen.out / "setup.toml").write_text(text, encoding="utf-8")
    print(f"{chosen.out}: {len(places)} markers, see markers.png; wanted now: a markers.csv in each trial")
    return chosen.out


cli = program(main, Options, __doc__)

if __name__ == "__main__":
    cli()
