"""How a finished robot does in scenarios that it was not designed in: a table and a picture of travel by scenario."""

from __future__ import annotations

import csv
import dataclasses
import io
import math
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from PIL import Image

from torchsoro.command_line import progress_bar
from torchsoro.design.ensemble import Evaluation, evaluate
from torchsoro.design.reading import lasting, read_settings
from torchsoro.design.robot import build
from torchsoro.design.scenarios import LIMITS, NOMINAL
from torchsoro.output.archive import find, load_resampled, load_supply
from torchsoro.output.canvas import canvas_of, pixels
from torchsoro.output.delivery import spread_line
from torchsoro.output.page import heading, plain, scenario_panel
from torchsoro.output.scene import INK, REST
from torchsoro.storage import atomic_write, check_folder, write_json

# Of the scenarios beyond the design run's: each of its iterations, of 10^6 at most, may have drawn with the next seed.
UNSEEN = 2 * 10**6
TABLE, PICTURE, NUMBERS = "scenarios.csv", "scenarios.png", "scenarios.json"
_MM = {"lag": (1e3, "ms"), "tube_mass": (1e3, "g"), "drop": (1e3, "mm")}  # quantities in the units that people use
_NAMES = {
    "friction": "friction angle [degrees]",
    "tilt_x": "uphill tilt [degrees]",
    "tilt_y": "tilt across [degrees]",
    "pressure_gain": "pressure, factor",
    "lag": "lag [ms]",
    "modulus_factor": "Young's modulus, factor",
    "density_factor": "density, factor",
    "tube_mass": "tube [g]",
    "pitch": "pitch [degrees]",
    "roll": "roll [degrees]",
    "drop": "drop [mm]",
}


def compare_scenarios(
    robot: str,
    out: Path,
    *,
    count: int,
    seed: int | None = None,
    void: bool = True,
    particles: tuple[int, int, int] | None = None,
    wall: float | None = None,
    settle: float | None = None,
    duration: float | None = None,
    device: Literal["auto", "cpu", "cuda"] = "auto",
) -> dict[str, Any]:
    """Simulate a finished robot in scenarios drawn from the ranges of its settings, and write what it does.

    Args:
        robot: Name of an archived robot, or a run's folder.
        out: Folder for the results.
        count: Number of scenarios.
        seed: Of the scenarios; one that no iteration of the design run had if None.
        void: Simulate void, too.
        particles: Along the edges, instead of the design's.
        wall: Thickness of the chamber wall [m], instead of the design's; a whole number of spacings.
        settle: Time before the actuation starts [s], instead of the design's.
        duration: Time of actuation [s], in which the travel is measured, instead of the design's.
        device: Where to compute.

    Returns:
        Spread of the travel [m], numbers of falls and of breakdowns, seed and times; also in ``scenarios.json``.

    Raises:
        ValueError: for a robot that does not exist, a wall that does not fit the particles, or a folder that cannot be
            written.
    """
    folder = find(robot)
    # Not the number of the design run's scenarios, on which the memory of that run depends.
    s = dataclasses.replace(read_settings(folder / "settings.json", device=device, resume=False), scenarios=0)
    check_folder("out", out, (TABLE, PICTURE, NUMBERS))
    changes: dict[str, Any] = {"dt": "auto"} if s.dt != "auto" else {}  # what is stiffer needs a smaller step
    other = {"particles": particles, "wall": wall, "settle": settle}
    s = s if duration is None else lasting(s, duration)
    built = build(dataclasses.replace(s, **changes, **{name: one for name, one in other.items() if one is not None}))
    gamma = load_resampled(folder, built.domain).to(s.target)
    load_supply(folder / "design.npz", built.supply)
    if s.target.type == "cpu":
        torch.set_num_threads(1)  # the threads of the kernels do the work
    chosen = s.scenario_seed + UNSEEN if seed is None else seed
    batch = s.distribution.sample(count, chosen)
    with progress_bar(f"{count} scenarios of {folder.name}") as progress:
        found = evaluate(built, gamma, batch, void=void, progress=progress)
    times = {"settle": built.settings.settle, "duration": built.settings.duration}
    result = {"robot": folder.name, "count": count, "seed": chosen, **times, **found.numbers()}
    result |= {} if particles is None else {"particles": list(particles)}
    result |= {} if wall is None else {"wall": wall}
    out.mkdir(parents=True, exist_ok=True)
    with atomic_write(out / TABLE) as file:
        file.write(table(found).encode())
    write_json(out / NUMBERS, result)
    line = f"{spread_line(result, count)}; in {built.settings.duration:g} s"
    image = Image.fromarray(picture(found, f"{folder.name}: {line}"))
    with atomic_write(out / PICTURE) as file:
        image.save(file, format="PNG")
    print(printed(found))
    for index, error in found.errors.items():
        print(f"scenario {index} broke down: {error}")
    print(f"{folder.name}, seed {chosen}: {line}\ntable and picture are in {out}")
    return result


def rows(found: Evaluation) -> list[dict[str, Any]]:
    """A row for each scenario, in SI units and degrees; travel and fall are None where the simulation broke down."""
    listed = []
    for k in range(found.batch.count):
        broke = k in found.errors
        numbers = {"L_m": None, "fall_m": None} if broke else {"L_m": found.travel[k], "fall_m": found.fall[k]}
        units = {name: f"{name}_{LIMITS[name][2]}" for name in LIMITS if " " not in LIMITS[name][2]}
        own = {units.get(name, name): value for name, value in found.batch.row(k).items()}
        listed.append({"scenario": k, **own, **numbers, "fell": int(found.fell[k]), "broke_down": int(broke)})
    return listed


def table(found: Evaluation) -> str:
    """The rows as CSV, with nothing in cells without a number."""
    listed, text = rows(found), io.StringIO()
    writer = csv.DictWriter(text, list(listed[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows({k: f"{v:.7g}" if isinstance(v, float) else v for k, v in row.items()} for row in listed)
    return text.getvalue()


def printed(found: Evaluation) -> str:
    """The scenarios in columns, from the least travel to the largest."""
    names = list(found.batch.given)
    lines = ["scenario " + " ".join(f"{name:>14s}" for name in names) + f" {'L [mm]':>9s}"]
    for k in np.argsort(found.travel):
        own = found.batch.row(int(k))
        way = "broke down" if int(k) in found.errors else f"{1e3 * found.travel[k]:9.2f}"
        numbers = " ".join(f"{own[name]:14.4g}" for name in names)
        lines.append(f"{k:8d} {numbers} {way}{' fell' if found.fell[k] else ''}")
    return "\n".join(lines)


def picture(found: Evaluation, title: str) -> np.ndarray:
    """Travel in each scenario, and over every quantity that varies: uint8 [height, width, 3]."""
    named = {name: value.detach().double().numpy() for name, value in found.batch.given.items()}
    named = {name: values for name, values in named.items() if np.ptp(values) > 0 and name in NOMINAL}
    columns = 3
    lines = 1 + math.ceil(len(named) / columns)
    height = 260 * lines + 80
    figure, canvas = canvas_of(1200, height)
    figure.text(0.03, 1 - 25 / height, title, va="top", fontsize=12, weight="bold", color=INK)

    def place(row: int, column: int, width: float) -> tuple[float, float, float, float]:
        bottom = 1 - (80 + 260 * (row + 1) - 65) / height
        return 0.06 + column / columns * 0.94, bottom, width, 165 / height

    scenario_panel(figure.add_axes(place(0, 0, 0.9)), 1e3 * found.travel)
    for k, (name, values) in enumerate(named.items()):
        axes = figure.add_axes(place(1 + k // columns, k % columns, 0.25))
        factor = _MM.get(name, (1.0, ""))[0]
        shown = np.degrees(np.arctan(values)) if name == "friction" else factor * values
        for chosen, color, label in ((~found.fell, REST, "stands"), (found.fell, "#a33b3b", "fell")):
            axes.plot(shown[chosen], 1e3 * found.travel[chosen], "o", ms=4, color=color, label=label)
        axes.set_xlabel(_NAMES[name], color=INK)
        axes.set_ylabel("L [mm]", color=INK)
        plain(axes)
        if k == 0:
            heading(axes, "by each quantity (red: fell)")
    return pixels(canvas)
