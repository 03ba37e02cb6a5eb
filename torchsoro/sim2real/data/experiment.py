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
import math
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from torchsoro.sim2real.data.recording import Recording, read_table
from torchsoro.sim2real.data.surface import Surface, read_surface
from torchsoro.simulation.actuation import Waveform

SHORTEST = 0.03  # s, three times what a clock may be late
FAR = 2.0  # times a body's size, that a marker may be from where it is stated, when all begins
WHOLE = ("title", "body", "clamp", "marker", "recording")  # tables that are the same in all trials
Vector = tuple[float, float, float]
Box = tuple[Vector, Vector]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Boundary:
    """Ground or wall; the body stays on the side that ``normal`` points to."""

    point: Vector
    normal: Vector
    friction: str | float = "stick"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Load:
    """Dead force [N] on the body points in a box, from ``start`` to ``end`` [s]; at first it grows for ``ramp`` [s]."""

    box: Box
    force: Vector
    start: float = 0.0
    ramp: float = 0.0
    end: float = math.inf


@dataclasses.dataclass(frozen=True, kw_only=True)
class Cavity:
    """A void inside the body, pressed on all its walls; ``air_stiffness`` [Pa] is 0 for a regulated supply."""

    name: str
    box: Box
    air_stiffness: float = 0.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Marker:
    """A tracked point, by its place in the undeformed body [m]; it moves with the nearest surface point."""

    name: str
    at: Vector


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
        cavities: Chambers.
        planes: Ground and walls.
        loads: Dead forces.
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
    cavities: tuple[Cavity, ...]
    planes: tuple[Boundary, ...]
    loads: tuple[Load, ...]
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
    markers, supply = folder / "markers.csv", folder / "pressure.csv"
    recording = None
    if markers.is_file():
        recording = Recording.read(markers, [m.name for m in setup.markers], setup.axes)
        if recording.time[0] > setup.duration or recording.time[-1] < SHORTEST:
            raise ValueError(
                f"{markers}: times from {recording.time[0]:g} to {recording.time[-1]:g} s, wanted some of the "
                f"{SHORTEST:g} to {setup.duration:g} s from release, in seconds"
            )
        recording = recording.until(setup.duration)
        _check_places(recording, setup, markers)
    pressure = None
    if setup.cavities:
        if not supply.is_file():
            raise ValueError(f"{folder}: no pressure.csv, wanted one, as the body has a chamber")
        pressure = _pressure(supply, [c.name for c in setup.cavities])
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
    _check_places(found, dataclasses.replace(setup, axes=(0, 1, 2)), path)
    return found


def _check_places(recording: Recording, setup: Setup, path: Path) -> None:
    reach = max(setup.size)
    for m, marker in enumerate(setup.markers):
        there = recording.seen[:, m].all(-1)
        if not there.any():
            raise ValueError(
                f"{path}: marker {marker.name} has no sample, wanted some, or no such marker in setup.toml"
            )
        stated, first = np.array(marker.at)[list(setup.axes)], int(there.argmax())
        seen = recording.place[first, m]
        if np.abs(seen - stated).max() > (FAR if recording.time[first] < SHORTEST else 100) * reach:
            raise ValueError(
                f"{path}: marker {marker.name} begins at {seen.tolist()}, wanted about {stated.tolist()} m: "
                "is it in metres, and in the frame of setup.toml?"
            )


def _folders(parent: Path) -> list[Path]:
    return sorted(p for p in parent.iterdir() if p.is_dir()) if parent.is_dir() else []


def _pressure(path: Path, names: Sequence[str]) -> Waveform:
    columns = read_table(path)
    wanted = ["time_s", *(f"{name}_pa" for name in names)]
    if missing := [name for name in wanted if name not in columns]:
        raise ValueError(f"{path}: columns {', '.join(columns)}, wanted also {', '.join(missing)}")
    time = torch.tensor(columns["time_s"], dtype=torch.float64)
    values = torch.tensor([columns[f"{name}_pa"] for name in names], dtype=torch.float64)
    try:
        return Waveform(time=time, pressure=values)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def read_tables(file: Path) -> dict[str, Any]:
    """Tables of a TOML file.

    Raises:
        ValueError: if it cannot be read.
    """
    try:
        return tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{file}: {error}; wanted a setup in TOML") from error


class _Table:
    """A table of a file, of which every entry is asked for once, and checked."""

    def __init__(self, values: object, where: str) -> None:
        if not isinstance(values, Mapping):
            raise ValueError(f"{where} = {values!r}: wanted a table")
        self.values, self.where = dict(values), where

    def number(self, name: str, default: float | None = None, *, least: float = -math.inf) -> float:
        value = self.values.pop(name, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or value < least:
            bound = f" of at least {least:g}" if least > -math.inf else ""
            raise ValueError(f"{self.where}: {name} = {value!r}, wanted a finite number{bound}")
        return float(value)

    def vector(self, name: str, default: Vector | None = None) -> Vector:
        return _vector(self.values.pop(name, default), f"{self.where}: {name}")

    def box(self, name: str = "box") -> Box:
        found = self.values.pop(name, None)
        if not isinstance(found, list | tuple) or len(found) != 2:
            raise ValueError(f"{self.where}: {name} = {found!r}, wanted two corners [[x, y, z], [x, y, z]]")
        low, high = (_vector(corner, f"{self.where}: {name}") for corner in found)
        if not all(a < b for a, b in zip(low, high, strict=True)):
            raise ValueError(f"{self.where}: {name} = {found!r}, wanted the lower corner first")
        return low, high

    def text(self, name: str, default: str | None = None, *, among: Sequence[str] = ()) -> str:
        value = self.values.pop(name, default)
        if not isinstance(value, str) or (among and value not in among):
            wanted = f"one of {', '.join(map(repr, among))}" if among else "a text"
            raise ValueError(f"{self.where}: {name} = {value!r}, wanted {wanted}")
        return value

    def tables(self, name: str) -> list[_Table]:
        found = self.values.pop(name, [])
        if not isinstance(found, list):
            raise ValueError(f"{self.where}: {name} = {found!r}, wanted [[{name}]] tables")
        return [_Table(t, f"{self.where}: [[{name}]] number {i}") for i, t in enumerate(found, start=1)]

    def done(self) -> None:
        if self.values:
            raise ValueError(f"{self.where}: unknown {', '.join(self.values)}")


def _vector(found: object, where: str) -> Vector:
    good = isinstance(found, list | tuple) and len(found) == 3
    if not good or not all(isinstance(v, int | float) and math.isfinite(v) for v in found):  # type: ignore[union-attr]
        raise ValueError(f"{where} = {found!r}, wanted three finite numbers")
    x, y, z = (float(v) for v in found)  # type: ignore[union-attr]
    return x, y, z


def setup_of(tables: Mapping[str, Any], file: Path, folder: Path | None = None) -> Setup:
    """What tables of a setup say.

    Args:
        tables: As in setup.toml.
        file: Where they come from, for messages.
        folder: Where the body's mesh lies; that of the file if None.

    Raises:
        ValueError: as :func:`read_experiment`.
    """
    top = _Table(tables, str(file))
    start = top.values.pop("start", "rest")
    moving = _Table({} if start == "rest" else start, f"{file}: start")
    body = _Table(top.values.pop("body", None), f"{file}: [body]")
    shape = body.text("shape", "box", among=("box", "mesh"))
    surface = None
    if shape == "mesh":
        at = body.vector("origin") if "origin" in body.values else None
        mesh = Path(body.text("file"))
        if ".." in mesh.parts:
            raise ValueError(f"{file}: [body]: file = '{mesh}', wanted one beside it or below, or an absolute path")
        surface = read_surface((folder or file.parent) / mesh, body.number("scale", 1.0, least=1e-9), at)
    material = _Table(top.values.pop("material", None), f"{file}: [material]")
    recording = _Table(top.values.pop("recording", {}), f"{file}: [recording]")
    kind: Any = recording.text("kind", "mocap", among=("mocap", "video"))
    axes = recording.values.pop("axes", ["x", "y", "z"])
    if not axes or any(axis not in ("x", "y", "z") for axis in axes) or len(set(axes)) != len(axes):
        raise ValueError(f'{recording.where}: axes = {axes!r}, wanted some of "x", "y", "z"')
    zero = (0.0, 0.0, 0.0)
    setup = Setup(
        title=top.text("title", ""),
        gravity=top.vector("gravity", (0.0, 0.0, -9.81)),
        duration=top.number("duration", least=1e-6),
        velocity=moving.vector("velocity", zero),
        angular_velocity=moving.vector("angular_velocity", zero),
        size=body.vector("size") if surface is None else surface.size,
        origin=body.vector("origin", zero) if surface is None else surface.origin,
        surface=surface,
        density=material.number("density", least=1e-9),
        youngs_modulus=material.number("youngs_modulus", least=1e-9),
        poisson_ratio=material.number("poisson_ratio", least=0.0),
        prony=_prony(material),
        clamps=tuple(table.box() for table in top.tables("clamp")),
        cavities=tuple(
            Cavity(name=t.text("name"), box=t.box(), air_stiffness=t.number("air_stiffness", 0.0, least=0.0))
            for t in top.tables("chamber")
        ),
        planes=tuple(
            Boundary(point=t.vector("point"), normal=t.vector("normal"), friction=_friction(t))
            for t in top.tables("plane")
        ),
        loads=tuple(_load(t) for t in top.tables("load")),
        markers=tuple(Marker(name=t.text("name"), at=t.vector("at")) for t in top.tables("marker")),
        kind=kind,
        axes=tuple("xyz".index(axis) for axis in axes),
        noise=recording.number("noise", least=1e-12) if "noise" in recording.values else None,
    )
    for table in (top, moving, body, material, recording):
        table.done()
    _check(setup, file)
    return setup


def _load(table: _Table) -> Load:
    start, ramp = table.number("start", 0.0, least=0.0), table.number("ramp", 0.0, least=0.0)
    end = table.number("end") if "end" in table.values else math.inf
    if not end > start + ramp:
        raise ValueError(f"{table.where}: end = {end:g}, wanted one after it has grown, at {start + ramp:g} s")
    return Load(box=table.box(), force=table.vector("force"), start=start, ramp=ramp, end=end)


def _prony(material: _Table) -> tuple[tuple[float, float], ...]:
    pairs = material.values.pop("prony", [])
    good = isinstance(pairs, list) and all(isinstance(p, list) and len(p) == 2 for p in pairs)
    if not good or not all(isinstance(v, int | float) and v > 0 for p in pairs for v in p) or len(pairs) > 5:
        raise ValueError(f"{material.where}: prony = {pairs!r}, wanted at most five pairs of positive numbers")
    return tuple((float(g), float(tau)) for g, tau in pairs)


def _friction(table: _Table) -> str | float:
    value = table.values.pop("friction", "stick")
    if value != "stick" and (isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < 1e9):
        raise ValueError(f'{table.where}: friction = {value!r}, wanted "stick" or a coefficient of at least 0')
    return "stick" if value == "stick" else float(value)


# What bodies are like whose numbers are in SI units.
_LENGTH, _MODULUS, _DENSITY, _PULL = (1e-4, 10.0), (1e2, 1e10), (10.0, 3e4), 1e3


def _check(setup: Setup, file: Path) -> None:
    if not all(edge > 0 for edge in setup.size):
        raise ValueError(f"{file}: [body]: size = {setup.size}, wanted positive lengths")
    sized = {
        "[body]: size": (min(setup.size), max(setup.size), _LENGTH, "m"),
        "[material]: youngs_modulus": (setup.youngs_modulus, setup.youngs_modulus, _MODULUS, "Pa"),
        "[material]: density": (setup.density, setup.density, _DENSITY, "kg/m3"),
    }
    for name, (least, most, (low, high), unit) in sized.items():
        if least < low or most > high:
            seen = f"{least:g}" if least == most else f"{least:g} to {most:g}"
            raise ValueError(f"{file}: {name} = {seen}, wanted {low:g} to {high:g} {unit}: is the unit right?")
    if max(map(abs, setup.gravity)) > _PULL:
        raise ValueError(f"{file}: gravity = {setup.gravity}, wanted at most {_PULL:g} m/s2: is the unit right?")
    reach = max(setup.size)
    for marker in setup.markers:
        away = [max(o - x, x - o - s, 0.0) for x, o, s in zip(marker.at, setup.origin, setup.size, strict=True)]
        if max(away) > reach / 2:
            raise ValueError(
                f"{file}: [[marker]] {marker.name} at {marker.at} m is {1e3 * max(away):.0f} mm outside of the body, "
                f"wanted one on it or within {1e3 * reach / 2:.0f} mm"
            )
    if setup.poisson_ratio >= 0.5:
        raise ValueError(f"{file}: [material]: poisson_ratio = {setup.poisson_ratio}, wanted less than 0.5")
    if not setup.markers:
        raise ValueError(f"{file}: no [[marker]], wanted at least one")
    for what, names in (("marker", [m.name for m in setup.markers]), ("chamber", [c.name for c in setup.cavities])):
        if len(set(names)) != len(names):
            raise ValueError(f"{file}: [[{what}]] names {', '.join(names)}, wanted each once")
