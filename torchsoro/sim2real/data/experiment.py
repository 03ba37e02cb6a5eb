"""An experiment on disk: what its experimenter believes (``setup.toml``) and what was recorded (``trials/``).

    my-experiment/
      setup.toml
      trials/<name>/markers.csv      time_s, <marker>_x_m, <marker>_y_m, <marker>_z_m, ...; an empty cell is lost
      trials/<name>/pressure.csv     time_s, <chamber>_pa; gauge pressure at the supply, where there is a chamber
      trials/<name>/trial.toml       tables of setup.toml that differ in this trial
      trials/<name>/simulated.csv    as markers.csv, x, y and z: where a simulation of one's own has the markers
      heldout/<name>/                trials that are only predicted

SI units; z is up.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from torchsoro.design.mesh import Surface, read_surface
from torchsoro.sim2real.data.misreading import Reading, misreadings
from torchsoro.sim2real.data.recording import Recording, brief, read_table
from torchsoro.sim2real.data.schema import (
    LENGTH,
    Box,
    ChamberTable,
    ForceTable,
    Marker,
    PlaneTable,
    SetupFile,
    Vector,
    read_tables,
    validated,
)
from torchsoro.simulation.actuation import Waveform

SHORTEST = 0.03  # s, three times the standard deviation of a clock's offset
COVERED = 0.03  # of a trial's duration, that a recording must last; minutes in place of seconds last 1/60
FEW = 10  # samples within a trial, below which a recording that goes on for ten times as long has another unit of time
FAR = 2.0  # edge lengths of the body, that a marker may be from its stated place at the beginning
LOST = 100.0  # the same at any time: no thrown body flies further
HELD = 5.0  # the same of a body that is clamped: none is stretched further
PRESSURE = 10.0  # Young's moduli, that a pressure may be
# Standard deviations of what is never exact, and decides nothing.
PLACE = 0.0007  # m, of a marker's stated place
CLOCK = 0.01  # s, of the moment of release
TURN = 0.01  # of the frame [rad], or of its scale
SCALE = 0.02  # of the scale of a video
NOISE = 0.1  # of the body's longest edge, that the noise may be
WHOLE = ("title", "body", "clamp", "marker", "recording")  # tables that are the same in all trials


@dataclasses.dataclass(frozen=True, kw_only=True)
class Setup:
    """What is believed about an experiment.

    Attributes:
        title: For people.
        gravity: [m/s2].
        duration: From release [s].
        velocity: Of the whole body at the start [m/s].
        angular_velocity: About the body's centre at the start [rad/s].
        size: Edge lengths of the body's box [m].
        origin: Its lower corner [m].
        surface: The body where it is no box.
        density: [kg/m3].
        youngs_modulus: At equilibrium [Pa].
        poisson_ratio: Below 0.5.
        prony: Maxwell elements: modulus relative to equilibrium, relaxation time [s].
        clamps: Boxes whose body points are held still.
        chambers: Chambers.
        planes: Ground and walls.
        forces: Dead forces.
        markers: What is tracked.
        kind: "mocap" (metres) or "video" (two axes, scale not exact).
        axes: Recorded axes.
        noise: Standard deviation of a marker's coordinate [m] where it is known.
    """

    title: str
    gravity: Vector
    duration: float
    velocity: Vector
    angular_velocity: Vector
    size: Vector
    origin: Vector
    surface: Surface | None
    density: float
    youngs_modulus: float
    poisson_ratio: float
    prony: tuple[tuple[float, float], ...]
    clamps: tuple[Box, ...]
    chambers: tuple[ChamberTable, ...]
    planes: tuple[PlaneTable, ...]
    forces: tuple[ForceTable, ...]
    markers: tuple[Marker, ...]
    kind: Literal["mocap", "video"]
    axes: tuple[int, ...]
    noise: float | None

    @property
    def center(self) -> Vector:
        """Of the body's box [m]."""
        x, y, z = (o + s / 2 for o, s in zip(self.origin, self.size, strict=True))
        return x, y, z


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Trial:
    """One recording and the setup it was taken under.

    Attributes:
        name: Of its folder.
        setup: With what differs in this trial.
        recording: Marker places; None for a trial that is to be predicted.
        pressure: Supply pressure [chambers, S] Pa; None without a chamber.
        simulated: Where a simulation of one's own has the markers of what is believed, along x, y and z; None if there
            is none.
    """

    name: str
    setup: Setup
    recording: Recording | None
    pressure: Waveform | None
    simulated: Recording | None = None


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Experiment:
    """A setup and its trials, of which the ones held out are not used for any fit.

    Attributes:
        folder: Where it was read from.
        setup: As in setup.toml.
        trials: By name.
        heldout: Trials of the folder ``heldout``, which are only predicted.
    """

    folder: Path
    setup: Setup
    trials: tuple[Trial, ...]
    heldout: tuple[Trial, ...] = ()


def read_experiment(folder: Path) -> Experiment:
    """Read an experiment's folder.

    Raises:
        ValueError: if a file or a table is missing, unknown or out of range; names file and table.
    """
    file = folder / "setup.toml"
    if not folder.is_dir():
        raise ValueError(f"experiment = {folder}: {'a file' if folder.exists() else 'not there'}, wanted a folder")
    if not file.is_file():
        raise ValueError(f"experiment = {folder}: no setup.toml, wanted one that says what is believed")
    tables = read_tables(file)
    setup = setup_of(tables, file)
    trials = [read_trial(path, tables, file) for path in _folders(folder / "trials")]
    if not trials:
        raise ValueError(f"{folder}: no trial, wanted folders trials/<name> with a markers.csv each")
    heldout = [read_trial(path, tables, file) for path in _folders(folder / "heldout")]
    if twice := {t.name for t in trials} & {t.name for t in heldout}:
        raise ValueError(f"{folder}: {', '.join(sorted(twice))} in both trials and heldout, wanted another name")
    return Experiment(folder=folder, setup=setup, trials=tuple(trials), heldout=tuple(heldout))


def read_trial(folder: Path, tables: Mapping[str, Any], file: Path) -> Trial:
    """Read a trial's folder: markers.csv, simulated.csv, pressure.csv and trial.toml where they are.

    Args:
        folder: Of the trial.
        tables: Of setup.toml, which trial.toml's replace.
        file: Where those come from, for messages.

    Raises:
        ValueError: as :func:`read_experiment`.
    """
    own = folder / "trial.toml"
    changed = read_tables(own) if own.is_file() else {}
    if other := [name for name in WHOLE if name in changed]:
        raise ValueError(f"{own}: table {', '.join(other)}, wanted the same in all trials, in setup.toml only")
    setup = setup_of({**tables, **changed}, own if changed else file, file.parent)
    if "chamber" in changed:
        stated = validated(SetupFile, tables, str(file)).chamber
        if [(c.name, c.box) for c in setup.chambers] != [(c.name, c.box) for c in stated]:
            raise ValueError(f"{own}: other names or boxes in [[chamber]], wanted those of {file}, in its order")
    markers, supply = folder / "markers.csv", folder / "pressure.csv"
    recording = None
    if markers.is_file():
        recording = Recording.read(markers, [m.name for m in setup.markers], setup.axes)
        _check_times(recording.time, setup.duration, markers)
        recording = recording.until(setup.duration)
        _check_places(recording, setup, markers)
    pressure = None
    if setup.chambers:
        if not supply.is_file():
            raise ValueError(f"{folder}: no pressure.csv, wanted one, as the body has a chamber")
        pressure = _pressure(supply, setup)
    elif supply.is_file():
        raise ValueError(f"{supply}: a pressure, wanted none, as the body has no [[chamber]]")
    own = folder / "simulated.csv"
    simulated = _simulated(own, setup) if own.is_file() else None
    return Trial(name=folder.name, setup=setup, recording=recording, pressure=pressure, simulated=simulated)


def _simulated(path: Path, setup: Setup) -> Recording:
    found = Recording.read(path, [m.name for m in setup.markers])
    if not found.seen.all():
        raise ValueError(f"{path}: an empty cell, wanted all places of a simulation")
    if found.time[0] > 0 or found.time[-1] < setup.duration - SHORTEST:
        raise ValueError(
            f"{path}: times from {found.time[0]:g} to {found.time[-1]:g} s, wanted 0 to {setup.duration:g} s"
        )
    _check_places(found, dataclasses.replace(setup, axes=(0, 1, 2)), path, names=True)
    return found


def _check_times(time: np.ndarray, duration: float, path: Path) -> None:
    """Times of a recording by the clock of the trial, in seconds; most other units show by how long it lasts."""
    begin, end = float(time[0]), float(time[-1])
    seen = f"{path}: times from {begin:g} to {end:g}"
    wanted = (
        f"wanted seconds from release, some of {SHORTEST:g} to {duration:g} s as duration = {duration:g} in setup.toml"
    )
    inside = int(np.count_nonzero(time <= duration))
    if end > 10 * duration and 0 < inside < min(FEW, len(time)):
        unit = "milliseconds" if end < 2000 * duration else "microseconds, or numbers of frames"
        raise ValueError(f"{seen} with {inside} samples within the trial: are they {unit}? {wanted}")
    if begin > duration or end < SHORTEST:
        raise ValueError(f"{seen}, {wanted}")
    if end < COVERED * duration:
        raise ValueError(f"{seen}: are they minutes, or does the trial end earlier? {wanted}")


def _check_places(recording: Recording, setup: Setup, path: Path, *, names: bool = False) -> None:
    """Places in the frame of the setup; with ``names``, also those of markers that were exchanged are refused."""
    reach = max(setup.size)
    for m, marker in enumerate(setup.markers):
        if not recording.seen[:, m].all(-1).any():
            raise ValueError(
                f"{path}: marker {marker.name} has no sample, wanted some, or no such marker in setup.toml"
            )
    away, readings = read_otherwise(recording, setup)
    if readings and (names or not readings[0].names_only) and not readings[0].origin_only:
        told = list(dict.fromkeys(r.says([m.name for m in setup.markers]) for r in readings))
        raise ValueError(
            f"{path}: markers begin {1e3 * away:.3g} mm (root mean square along an axis) from where setup.toml has "
            f"them, and {1e3 * readings[0].away:.2g} mm if read as: {'; or '.join(told[:3])}; wanted places in metres "
            "in the frame of setup.toml"
        )
    most = (HELD if setup.clamps else LOST) * reach
    for m, marker in enumerate(setup.markers):
        there = recording.seen[:, m].all(-1)
        stated, first = np.array(marker.at)[list(setup.axes)], int(there.argmax())
        seen = recording.position[first, m]
        if recording.time[first] < SHORTEST and np.abs(seen - stated).max() > FAR * reach:
            raise ValueError(
                f"{path}: marker {marker.name} begins at {seen.tolist()}, wanted about {stated.tolist()} m: "
                "is it in metres, and in the frame of setup.toml?"
            )
        distance = np.nan_to_num(np.abs(recording.position[:, m] - stated).max(-1))
        if distance.max() > most:
            at = int(distance.argmax())
            unit = " (is it in millimetres?)" if np.median(distance[there]) > reach / 10 else ""
            raise ValueError(
                f"{path}: marker {marker.name} is at {recording.position[at, m].tolist()} m at "
                f"{recording.time[at]:g} s{unit}, wanted within {most:g} m, or an empty cell where it was lost"
            )


def read_otherwise(recording: Recording, setup: Setup) -> tuple[float, list[Reading]]:
    """Ways to read a recording under which its markers are at release where the setup has them.

    Returns:
        How far they are from there as it stands [m], and the ways, best first; none if they are there, or under none.
    """
    near = np.flatnonzero(np.abs(recording.time) <= SHORTEST)
    near = near[np.argsort(np.abs(recording.time[near]), kind="stable")]
    if not len(near):
        return 0.0, []
    seen = recording.seen[near].all(-1)
    earliest = near[seen.argmax(0)]  # of each marker
    first = recording.position[earliest, np.arange(len(setup.markers))]
    first[~seen.any(0)] = np.nan
    low, size = np.array(setup.origin), np.array(setup.size)
    when = recording.time[earliest]
    late = float(np.abs(when).max()) + CLOCK
    stated = np.array([m.at for m in setup.markers])
    scale = (SCALE if setup.kind == "video" else TURN) * float(np.abs(stated).max())
    tolerance = math.hypot(PLACE, scale, math.hypot(*setup.gravity) * late**2 / 2, setup.noise or 0.0)
    velocity = np.array(setup.velocity) + np.cross(setup.angular_velocity, stated - (low + size / 2))
    return misreadings(
        first,
        stated + velocity * when[:, None],
        velocity=velocity,
        clock=CLOCK,
        axes=setup.axes,
        box=(low, low + size),
        tolerance=tolerance,
    )


def _folders(parent: Path) -> list[Path]:
    try:
        return sorted(p for p in parent.iterdir() if p.is_dir()) if parent.is_dir() else []
    except OSError as error:
        raise ValueError(f"{parent}: {error}; wanted a folder that can be read") from error


def _pressure(path: Path, setup: Setup) -> Waveform:
    names: Sequence[str] = [c.name for c in setup.chambers]
    columns = read_table(path)
    wanted = ["time_s", *(f"{name}_pa" for name in names)]
    if missing := [name for name in wanted if name not in columns]:
        raise ValueError(f"{path}: columns {brief(', '.join(columns), 300)}, wanted also {', '.join(missing)}")
    time = torch.from_numpy(columns["time_s"].copy())
    values = torch.from_numpy(np.stack([columns[f"{name}_pa"] for name in names]))
    try:
        wave = Waveform(time=time, pressure=values)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    begin, end, most = float(time[0]), float(time[-1]), float(values.abs().max())
    inside = int((time <= setup.duration).sum())
    if begin >= setup.duration or end <= 0 or (end > 10 * setup.duration and inside < 3 <= len(time) / 3):
        raise ValueError(
            f"{path}: times from {begin:g} to {end:g}, wanted the pressure from 0 to {setup.duration:g}, in seconds"
        )
    if most > PRESSURE * setup.youngs_modulus:
        raise ValueError(
            f"{path}: a pressure of {most:g}, wanted at most {PRESSURE * setup.youngs_modulus:g} Pa, ten times "
            "youngs_modulus: is it gauge pressure in Pa?"
        )
    return wave


def setup_of(tables: Mapping[str, Any], file: Path, folder: Path | None = None) -> Setup:
    """What tables of a setup say.

    Args:
        tables: As in setup.toml.
        file: Where they come from, for messages.
        folder: Where the body's mesh lies; that of the file if None.

    Raises:
        ValueError: as :func:`read_experiment`.
    """
    parsed = validated(SetupFile, tables, str(file))
    body, material, recording = parsed.body, parsed.material, parsed.recording
    surface = None
    if body.file is not None:
        mesh = Path(body.file)
        if ".." in mesh.parts:
            raise ValueError(f"{file}: [body]: file = '{mesh}', wanted one beside it or below, or an absolute path")
        surface = read_surface((folder or file.parent) / mesh, body.scale or 1.0, body.origin)
    setup = Setup(
        title=parsed.title,
        gravity=parsed.gravity,
        duration=parsed.duration,
        velocity=parsed.start.velocity,
        angular_velocity=parsed.start.angular_velocity,
        size=surface.size if surface is not None else body.size or (0.0, 0.0, 0.0),
        origin=surface.origin if surface is not None else body.origin or (0.0, 0.0, 0.0),
        surface=surface,
        density=material.density,
        youngs_modulus=material.youngs_modulus,
        poisson_ratio=material.poisson_ratio,
        prony=material.prony,
        clamps=tuple(clamp.box for clamp in parsed.clamp),
        chambers=parsed.chamber,
        planes=parsed.plane,
        forces=parsed.load,
        markers=parsed.marker,
        kind=recording.kind,
        axes=tuple("xyz".index(axis) for axis in recording.axes),
        noise=recording.noise,
    )
    _check(setup, file)
    return setup


def _check(setup: Setup, file: Path) -> None:
    """What tables say together."""
    least, most = min(setup.size), max(setup.size)
    if not (least >= LENGTH[0] and most <= LENGTH[1]):  # of a mesh; also where it is not a number
        raise ValueError(
            f"{file}: [body]: the mesh is {least:g} to {most:g} m long, wanted {LENGTH[0]:g} to {LENGTH[1]:g} m: "
            "is the unit right? scale = metres in a unit of the mesh"
        )
    for marker in setup.markers:
        away = [max(o - x, x - o - s, 0.0) for x, o, s in zip(marker.at, setup.origin, setup.size, strict=True)]
        if max(away) > most / 2:
            raise ValueError(
                f"{file}: [[marker]] {marker.name} at {marker.at} m is {1e3 * max(away):.0f} mm outside of the body, "
                f"wanted one on it or within {1e3 * most / 2:.0f} mm"
            )
    for what, names in (("marker", [m.name for m in setup.markers]), ("chamber", [c.name for c in setup.chambers])):
        if len(set(names)) != len(names):
            raise ValueError(f"{file}: [[{what}]] names {', '.join(names)}, wanted each once")
    if setup.noise is not None and setup.noise > NOISE * most:
        raise ValueError(
            f"{file}: [recording]: noise = {setup.noise:g} m, wanted at most {NOISE * most:g} m, a tenth of the body: "
            "is it in metres?"
        )
    for low, high in setup.clamps:
        if all(low[a] <= setup.origin[a] and high[a] >= setup.origin[a] + setup.size[a] for a in range(3)):
            raise ValueError(f"{file}: [[clamp]] box {low}, {high} holds the whole body, wanted a part that can move")
    for one, other in itertools.combinations(setup.chambers, 2):
        if all(max(one.box[0][a], other.box[0][a]) < min(one.box[1][a], other.box[1][a]) for a in range(3)):
            raise ValueError(
                f"{file}: [[chamber]] {one.name} and {other.name} overlap, wanted chambers with a wall between them"
            )
