"""Turn published recordings into experiments that recipes/explain.py can explain.

    python recipes/validate/recordings.py FOLDER/silicone-cantilever-beam --out runs/beam
    python recipes/explain.py runs/beam --out runs/beam-explained

The name of the folder selects the experiment. Bar and arm are those of Dubied, Michelis, Spielberg, Katzschmann (2022),
of Dragon Skin 10, recorded by motion capture. The model has the modulus of their repository, fitted to a static
deflection, and no damping. So is the fish tail.

silicone-cantilever-beam: 100 x 30 x 30 mm, clamped at one end, held straight and released under its weight, without and
with an additional 1.0006 N at the upper free edge, modelled as a dead load. One recording of each kind is to be
explained, the other is held out; ``--fit weight`` holds out both recordings with the load instead.

pneumatic-arm-segment: hangs; one of four chambers is inflated to 75, 100 and 150 mbar; 125 and 175 mbar are held out.
The pressure is modelled as a step. The cross-section is not published: round walls of 2 mm are modelled as straight.

bellows-actuator: the actuator of Caasenbrood, Pogromsky, Nijmeijer (2022), bent by 17 degrees and released. The
cross-section is not published: the model is a solid bar of the same length and mass with the published linear
stiffness, held by a force at its end. The recorded quantity is an angle; the position of the end is that of a circular
arc. Gravity, whose direction is not reported, is omitted.

pneumatic-fish-tail: clamped at its base, one of two chambers inflated once. Neither the pressure nor the shape of the
chambers is published: the model has boxes on each side of the middle wall, with walls of 3 mm, and a step to 10 kPa.
Gravity, whose direction is not reported, is omitted. Its recording is explained; none is left to be held out.
"""

from __future__ import annotations

import dataclasses
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from experiment_files import Files, fresh, setup, write

from torchsoro.command_line import plain_errors
from torchsoro.sim2real.data.recording import read_table

MATERIAL = """[material]
density = 1070.0
youngs_modulus = 263824.0
# Of it 0.499 is believed, with which a simulation takes ten times as long; bending does not feel the difference.
poisson_ratio = 0.45
prony = []
"""
RATE = 100.0  # Hz

BAR_MARKERS = {"tip1": (0.0, 0.015, 0.036), "tip2": (0.0, -0.006, 0.024), "tip3": (0.0, 0.036, 0.006)}
# Frame of the file in which the bar has moved by 0.3 mm, some 8 ms after its release.
BAR_TRIALS = {
    "weight_a": ("beam_gravity_V2_a", 72),
    "weight_b": ("beam_gravity_V2_b", 66),
    "load_a": ("beam_load101_V2_a", 52),
    "load_b": ("beam_load101_V2_b", 57),
}
BAR_LASTS = 2.0  # s
BAR = f"""title = "silicone bar, let go"
gravity = [0.0, 0.0, -9.807]
duration = {BAR_LASTS}
start = "rest"

[body]
shape = "box"
size = [0.100, 0.030, 0.030]
origin = [-0.100, 0.0, 0.0]

{MATERIAL}
[[clamp]]
box = [[-0.101, -0.001, -0.001], [-0.0999, 0.031, 0.031]]
"""
BAR_LOAD = """[[load]]
box = [[-0.004, 0.0, 0.026], [0.0, 0.030, 0.030]]
force = [0.0, 0.0, -1.0006]
"""

ARM_MARKERS = {"tip1": (-0.009645, -0.0265, 0.0), "tip2": (-0.009645, 0.0265, 0.0), "tip3": (-0.0282, 0.0, 0.0)}
ARM_TRIALS, ARM_KEPT = (75, 100, 150), (125, 175)  # mbar; straight walls do not bear much more
ARM_BEGINS, ARM_LASTS = 6, 0.5  # frame, the tip moves from the next one on; s
ARM = f"""title = "arm segment, one chamber inflated"
gravity = [0.0, 0.0, -9.81]
duration = {ARM_LASTS}
start = "rest"

[body]
shape = "box"
size = [0.0389, 0.0389, 0.100]
origin = [-0.01945, -0.01945, 0.0]

{MATERIAL}
[[clamp]]
box = [[-0.02, -0.02, 0.0999], [0.02, 0.02, 0.101]]
"""
# Of a chamber: from the inner tube to the outer wall, as wide as the tube.
ARM_CHAMBER = ((0.00714, -0.00714, 0.00693), (0.0174, 0.00714, 0.0970))

BELLOWS_LENGTH, BELLOWS_WIDTH = 0.064, 0.013 * math.pi**0.5  # m; a square of the same area
BELLOWS_STIFFNESS, BELLOWS_MASS, BELLOWS_POISSON = 8.25e-4, 0.017, 0.45  # N m2, kg
BELLOWS_GROWS, BELLOWS_ENDS, BELLOWS_LASTS = 0.26, 0.30, 0.85  # s; two periods, so that what holds leaves no swing
BELLOWS_RATE = 200.0  # Hz; the file has 10 kHz, interpolated

TAIL_MARKERS = {"tail1": (0.0, -0.01419, 0.05221)}
TAIL_LASTS = 1.8  # s
TAIL_PRESSURE, TAIL_FILLS = 10e3, 0.02  # Pa, s
TAIL_SEEN, TAIL_EVERY = 0.3e-3, 2  # m that the tail has moved when it begins; of the 100 Hz every second frame
# Within walls of 3 mm; the middle wall is published.
TAIL_CHAMBERS = {
    "left": [[-0.012, -0.012, 0.003], [-0.007, 0.012, 0.057]],
    "right": [[0.005, -0.012, 0.003], [0.012, 0.012, 0.057]],
}
TAIL = f"""title = "fish tail, one chamber inflated"
gravity = [0.0, 0.0, 0.0]
duration = {TAIL_LASTS}
start = "rest"

[body]
shape = "mesh"
file = "tail.stl"
scale = 0.001

{MATERIAL}
[[clamp]]
box = [[-0.016, -0.026, -0.001], [0.016, 0.026, 0.0001]]
"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Experiment for explain.py from published recordings."""

    recordings: tyro.conf.Positional[Path]
    """Folder with the recordings, under its published name."""
    out: Path
    """Folder of the experiment."""
    fit: Literal["both", "weight"] = "both"
    """For the bar: explain one recording of each kind, or only those without the load."""


def table_of(path: Path) -> dict[str, np.ndarray]:
    """Columns of a CSV file.

    Raises:
        ValueError: if the file does not exist.
    """
    if not path.is_file():
        raise ValueError(f"recordings = {path.parent}: no {path.name}, wanted the folder that holds it")
    return read_table(path)


def moved(table: dict[str, np.ndarray], markers: dict[str, tuple[float, ...]], still: slice, used: np.ndarray):
    """Columns of markers: nominal position plus displacement since rest.

    Markers were placed to within a millimetre; only their displacement is used.
    """
    columns = {}
    for key, at in markers.items():
        for axis, place in zip("xyz", at, strict=True):
            x = table[f"{key}_{axis}_m"]
            columns[f"{key}_{axis}_m"] = place + x[used] - x[still].mean()
    return columns


def bar(options: Options) -> tuple[str, dict[str, Files]]:
    """Bar released from the straight state."""
    kept = ("weight_b", "load_b") if options.fit == "both" else ("load_a", "load_b")
    trials = {}
    for name, (file, first) in BAR_TRIALS.items():
        table = table_of(options.recordings / f"{file}_beamframe.csv")
        time = (np.arange(len(table["time_s"])) - (first - 1)) / RATE
        used = (time >= 0) & (time <= BAR_LASTS)
        columns = {"time_s": time[used], **moved(table, BAR_MARKERS, slice(first - 30, first - 2), used)}
        trials[name] = Files(kept=name in kept, markers=columns, trial=BAR_LOAD if name.startswith("load") else "")
    return setup(BAR, BAR_MARKERS), trials


def arm(options: Options) -> tuple[str, dict[str, Files]]:
    """Arm segment with one chamber inflated and the others vented."""
    chambers, trials = "", {}
    for side, (c, d) in enumerate(((1, 0), (0, 1), (-1, 0), (0, -1))):
        corners = np.array([[c * x - d * y, d * x + c * y, z] for x, y, z in ARM_CHAMBER])
        box = [corners.min(0).tolist(), corners.max(0).tolist()]
        chambers += f'\n[[chamber]]\nname = "side{side}"\nbox = {box}\n'
    for mbar in (*ARM_TRIALS, *ARM_KEPT):
        table = table_of(options.recordings / "blackframe_25mbar" / f"{mbar:03d}mbar_armframe.csv")
        time = (np.arange(len(table["time_s"])) - ARM_BEGINS) / RATE
        used = (time >= 0) & (time <= ARM_LASTS)
        places = moved(table, ARM_MARKERS, slice(0, ARM_BEGINS - 1), used)
        # Lost frames repeat the previous one.
        lost = np.all([np.diff(x, prepend=np.nan) == 0 for x in places.values()], axis=0)
        columns = {"time_s": time[used]} | {key: np.where(lost, np.nan, x) for key, x in places.items()}
        full = 100.0 * mbar
        supply = {f"side{side}_pa": np.array([0.0, full, full]) * (side == 0) for side in range(4)}
        pressure = {"time_s": np.array([0.0, 0.002, 2 * ARM_LASTS]), **supply}
        trials[f"{mbar}mbar"] = Files(kept=mbar in ARM_KEPT, markers=columns, pressure=pressure)
    return setup(ARM + chambers, ARM_MARKERS), trials


def bellows(options: Options) -> tuple[str, dict[str, Files]]:
    """Bellows actuator released from a bend."""
    table = table_of(options.recordings / "oscill_data_b17.csv")
    time = np.arange(0.0, BELLOWS_LASTS - BELLOWS_ENDS, 1 / BELLOWS_RATE)
    bend = np.radians(np.interp(time, table["time_s"], table["bending_angle_deg"]))
    length, width = BELLOWS_LENGTH, BELLOWS_WIDTH
    along, aside = length * np.sinc(bend / np.pi), -length * bend / 2 * np.sinc(bend / (2 * np.pi)) ** 2
    modulus = BELLOWS_STIFFNESS / (width**4 / 12)
    # Of a cantilever with a force at its end, shear included.
    give = length**3 / (3 * BELLOWS_STIFFNESS) + 1.2 * length * 2 * (1 + BELLOWS_POISSON) / (modulus * width**2)
    middle, end = width / 2, [[length - 0.004, 0.0, 0.0], [length, width, width]]
    text = f"""title = "bellows actuator, let go from a bend"
gravity = [0.0, 0.0, 0.0]
duration = {BELLOWS_LASTS}
start = "rest"

[body]
shape = "box"
size = [{length}, {width:.6f}, {width:.6f}]
origin = [0.0, 0.0, 0.0]

[material]
density = {BELLOWS_MASS / (length * width**2):.1f}
youngs_modulus = {modulus:.0f}
poisson_ratio = {BELLOWS_POISSON}
prony = []

[[clamp]]
box = [[-0.001, -0.001, -0.001], [0.0001, {width + 0.001:.6f}, {width + 0.001:.6f}]]

[[load]]
box = {end}
force = [0.0, 0.0, {aside[0] / give:.5f}]
ramp = {BELLOWS_GROWS}
end = {BELLOWS_ENDS}

[[marker]]
name = "end"
at = [{length}, {middle:.6f}, {middle:.6f}]

[recording]
kind = "video"
axes = ["x", "z"]
noise = 1e-4
"""
    columns = {"time_s": BELLOWS_ENDS + time, "end_x_m": along, "end_z_m": middle + aside}
    return text, {"released": Files(kept=False, markers=columns)}


def tail(options: Options) -> tuple[str, dict[str, Files]]:
    """Fish tail with one chamber inflated and the other vented."""
    table = table_of(options.recordings / "fish_tail_tailframe.csv")
    aside = table["tail1_x_m"]
    begins = int(np.argmax(np.abs(aside - aside[:2].mean()) > TAIL_SEEN)) - 1
    time = table["time_s"] - table["time_s"][begins]
    used = np.flatnonzero((time >= 0) & (time <= TAIL_LASTS))[::TAIL_EVERY]
    columns = {"time_s": time[used], **moved(table, TAIL_MARKERS, slice(0, begins + 1), used)}
    supply = {"left_pa": np.array([0.0, TAIL_PRESSURE, TAIL_PRESSURE]), "right_pa": np.zeros(3)}
    pressure = {"time_s": np.array([0.0, TAIL_FILLS, 2 * TAIL_LASTS]), **supply}
    chambers = "".join(f'\n[[chamber]]\nname = "{name}"\nbox = {box}\n' for name, box in TAIL_CHAMBERS.items())
    options.out.mkdir(parents=True, exist_ok=True)
    shutil.copy(options.recordings / "soft_fish_mm.stl", options.out / "tail.stl")
    return setup(TAIL + chambers, TAIL_MARKERS), {"inflated": Files(kept=False, markers=columns, pressure=pressure)}


MAKERS: dict[str, Callable[[Options], tuple[str, dict[str, Files]]]] = {
    "silicone-cantilever-beam": bar,
    "pneumatic-arm-segment": arm,
    "bellows-actuator": bellows,
    "pneumatic-fish-tail": tail,
}


def main(options: Options) -> None:
    """Write the experiment.

    Raises:
        ValueError: if the folder is none of those, a recording is not there, or an experiment is in its place; before
            anything is written.
    """
    name = options.recordings.resolve().name
    if name not in MAKERS:
        raise ValueError(f"recordings = {options.recordings}, wanted a folder named {' or '.join(MAKERS)}")
    out = fresh(options.out)
    text, trials = MAKERS[name](options)
    write(out, text, trials)
    print(options.out)


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Options, description=__doc__))
