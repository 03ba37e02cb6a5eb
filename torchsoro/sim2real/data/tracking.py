"""Marker places as tracking programs write them: Tracker (physlets.org), DeepLabCut, C3D of motion capture.

Samples are read as they are: nothing is smoothed, filled or resampled. Time begins at 0, places are in metres.
"""

from __future__ import annotations

import csv
import importlib
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from torchsoro.sim2real.data.recording import AXES, Recording, brief

LIKELIHOOD = 0.6  # below which a sample is lost, as in DeepLabCut's own plots
METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
SAME = 1e-5  # s, within which two times are of one frame, as files round them


@dataclass(frozen=True, kw_only=True, eq=False)
class Tracked:
    """Named markers and where they were.

    Attributes:
        names: Of the markers [M].
        recording: Places [T, M, A] m over time from 0 [T] s; its axes increase.
    """

    names: tuple[str, ...]
    recording: Recording

    def columns(self) -> dict[str, np.ndarray]:
        """Columns [T] of a markers.csv by name; NaN where a sample was lost."""
        return self.recording.columns(self.names)


@dataclass(frozen=True, kw_only=True)
class Frame:
    """How a file's coordinates lie in ours.

    Attributes:
        axes: Which of ours the file's are, in their order, "-x" for the opposite of x. An image has two, to the right
            and up. None for x and z of an image; x, y and z of a space.
        scale: Metres in the file's unit of length; None where the file says what that is.
        origin: Where ours is, in the file's coordinates and unit; None for the file's own.
        start: Time by the file's clock that becomes 0 [s]; what is before is left out. None for the first sample.

    Raises:
        ValueError: for axes that are none, a scale beyond 1e-9 to 1000, or numbers that are not finite.
    """

    axes: Sequence[str] | None = None
    scale: float | None = None
    origin: Sequence[float] | None = None
    start: float | None = None

    def __post_init__(self) -> None:
        letters = [axis.removeprefix("-") for axis in self.axes or ()]
        if not {*letters} <= {*AXES} or len({*letters}) != len(letters):
            raise ValueError(f"axes = {', '.join(self.axes or ())}, wanted different ones of x, y, z, -x, -y, -z")
        if self.scale is not None and not 1e-9 <= self.scale <= 1e3:
            raise ValueError(f"scale = {self.scale}, wanted metres in the file's unit of length, 1e-9 to 1000")
        if not (np.abs([*(self.origin or ()), self.start or 0.0]) <= 1e9).all():
            raise ValueError(f"origin = {self.origin}, start = {self.start}, wanted finite numbers up to 1e9")


def read(
    paths: Sequence[Path], frame: Frame | None = None, *, fps: float | None = None, likelihood: float = LIKELIHOOD
) -> Tracked:
    """Read what a file's ending and first line say it is.

    Args:
        paths: One file; of Tracker several, of one clock.
        frame: How its coordinates lie in ours.
        fps: Frames per second, which DeepLabCut does not write.
        likelihood: Below which a sample of DeepLabCut is lost.

    Raises:
        ValueError: for a file that cannot be read; names it, what was seen and what is wanted.
    """
    kinds = ["c3d" if p.suffix.lower() == ".c3d" else _cells(_lines(p)[0])[0] for p in paths]
    if len(paths) != 1 and (not paths or {"c3d", "scorer"} & set(kinds)):
        raise ValueError(f"{', '.join(map(str, paths)) or 'no file'}: wanted one file, or some that Tracker exported")
    if kinds[0] == "c3d":
        return read_c3d(paths[0], frame)
    if kinds[0] == "scorer":
        return read_deeplabcut(paths[0], frame, fps=fps, likelihood=likelihood)
    return read_tracker(paths, frame)


def _finished(path: Path, names: Sequence[str], time: np.ndarray, place: np.ndarray, frame: Frame) -> Tracked:
    """In metres, along our axes, from 0; places [T, M, A] in the file's unit, time [T] s by its clock."""
    count = place.shape[-1]
    axes = frame.axes or ("xz" if count == 2 else AXES)
    origin = np.array(frame.origin or [0.0] * count)
    if len(axes) != count or len(origin) != count:
        raise ValueError(f"{path}: axes = {', '.join(axes)}, origin = {frame.origin}, wanted {count} of each")
    begin = float(time[0]) if frame.start is None else frame.start
    if (used := time > begin - SAME).sum() < 3:
        raise ValueError(f"{path}: {used.sum()} samples from {begin:g} s on, wanted at least 3")
    metres = (place[used] - origin) * (frame.scale or 1.0) * [-1.0 if a.startswith("-") else 1.0 for a in axes]
    if (lost := np.isnan(metres).any(-1)).all():
        raise ValueError(f"{path}: no sample of {', '.join(names)} from {begin:g} s on, wanted some")
    metres[lost] = np.nan  # as a whole, where only one coordinate is missing
    ours = np.array([AXES.index(axis[-1]) for axis in axes])
    order = np.argsort(ours)
    if not all(names) or len(set(names)) != len(names):
        raise ValueError(f"{path}: markers {', '.join(map(repr, names))}, wanted names that differ")
    try:
        recording = Recording(time=time[used] - begin, position=metres[..., order], axes=tuple(ours[order].tolist()))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return Tracked(names=tuple(names), recording=recording)


def _lines(path: Path) -> list[str]:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: {error}; wanted a text file of Tracker or DeepLabCut, or one called .c3d") from error
    if not any(line.strip() for line in lines):
        raise ValueError(f"{path}: empty, wanted a table of marker places")
    return lines


def _cells(line: str, delimiter: str = ",") -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter), [])] or [""]
    except csv.Error as error:
        raise ValueError(f"{brief(line)}: {error}; wanted a row of a table") from error


def _number(cell: str, where: str) -> float:
    try:
        return float(cell or "nan")
    except ValueError:
        raise ValueError(f"{where} = {cell!r}, wanted a number or nothing") from None


def read_tracker(paths: Sequence[Path], frame: Frame | None = None) -> Tracked:
    """Read data files that Tracker exported: columns t, x, y, with y up, between tabs, semicolons or commas.

    A file has one mass, its name in the line above the columns (otherwise the file's name is taken); several below
    each other; or several side by side ("#multi:"). Masses seen in different frames are put on all frames.

    Args:
        paths: Files of one clock.
        frame: How the coordinates lie in ours. Without a scale they are in metres, to which Tracker was calibrated.

    Raises:
        ValueError: for a file that is none of these, cells that are no numbers, or times that do not increase.
    """
    found: dict[str, np.ndarray] = {}
    for path in paths:
        for name, rows in _masses(path).items():
            table = np.array(rows).reshape(-1, 3)
            if name in found or not len(table):
                raise ValueError(f"{path}: mass {name!r} is there twice or has no row, wanted each once, with rows")
            if late := np.flatnonzero(~(np.diff(table[:, 0]) > SAME)).tolist():
                before, after = table[late[0] : late[0] + 2, 0]
                raise ValueError(f"{path}: {name}: t = {after:g} after {before:g}, wanted times that increase")
            found[name] = table
    times = np.unique(np.concatenate([table[:, 0] for table in found.values()]))
    first = np.diff(times, prepend=-np.inf) > SAME
    frames = np.cumsum(first) - 1  # that each time is of
    place = np.full((frames[-1] + 1, len(found), 2), np.nan)
    for m, table in enumerate(found.values()):
        place[frames[np.searchsorted(times, table[:, 0])], m] = table[:, 1:]
    return _finished(paths[0], list(found), times[first], place, frame or Frame())


def _masses(path: Path) -> dict[str, list[tuple[float, float, float]]]:
    """Rows t, x, y of each mass of a file, in the file's units."""
    masses: dict[str, list[tuple[float, float, float]]] = {}
    pairs: list[tuple[str, int, int]] = []
    delimiter, above = "", ""  # the line above the columns names masses
    for number, line in enumerate(_lines(path), start=1):
        where = f"{path}: line {number}"
        if split := next((d for d in "\t;," if _cells(line, d)[0] == "t"), ""):
            delimiter = split
            pairs = _pairs(_cells(line, delimiter), _cells(above, delimiter), path.stem, where)
            above = ""
            masses |= {name: masses.get(name, []) for name, *_ in pairs}
        elif pairs and not above and re.match(r"[-+.]?\d", line):
            # A comma within a cell is the decimal sign of many languages.
            cells = [cell.replace(",", ".") for cell in _cells(line, delimiter)]
            cells += [""] * (1 + max(max(i, j) for _, i, j in pairs) - len(cells))
            for name, *at in pairs:
                t, x, y = (_number(cells[k], f"{where}: {what}") for k, what in zip((0, *at), "txy", strict=True))
                masses[name].append((t, x, y))
        elif line.strip(" \t,;"):
            if above and not above.startswith("#"):
                break
            above = line
    if above or not masses:
        raise ValueError(
            f"{path}: {above.strip()[:60]!r}, wanted columns t, x, y as of Tracker, and numbers below, "
            "the CSV of DeepLabCut, or a C3D file"
        )
    return masses


def _pairs(columns: list[str], above: list[str], stem: str, where: str) -> list[tuple[str, int, int]]:
    """Name of each mass, and numbers of its columns x and y; side by side, names stand above their first column."""
    xs, ys = ([k for k, column in enumerate(columns) if column == letter] for letter in "xy")
    if not xs or len(xs) != len(ys):
        raise ValueError(f"{where}: columns {', '.join(columns)}, wanted t, and x and y of each mass")
    starts = [k for k, name in enumerate(above) if name]
    names = [above[max((s for s in starts if s <= x), default=0)] for x in xs]
    if len(xs) == 1:
        names = [names[0] or stem]
    if not all(names) or len(set(names)) != len(names):
        raise ValueError(f"{where}: masses {', '.join(map(repr, names))}, wanted a name above each x")
    return list(zip(names, xs, ys, strict=True))


def read_deeplabcut(
    path: Path, frame: Frame | None = None, *, fps: float | None, likelihood: float = LIKELIHOOD
) -> Tracked:
    """Read a CSV of DeepLabCut: rows scorer, (individuals,) bodyparts and coords, then one for each video frame.

    A part of one of several individuals is called ``<individual>_<bodypart>``. The image's y goes down; it is turned.

    Args:
        path: File.
        frame: How the image lies in ours; its scale, metres per pixel, is needed, its origin is a pixel.
        fps: Frames per second.
        likelihood: Below which a sample is lost, 0 to 1.

    Raises:
        ValueError: for a file that is no such table, or without ``fps`` or a scale.
    """
    scale = None if frame is None else frame.scale
    wrong = [] if fps is not None and 1e-3 <= fps <= 1e6 else [f"fps = {fps}, wanted frames per second"]
    wrong += [f"scale = {scale}, wanted metres per pixel"] if scale is None else []
    wrong += [] if 0 <= likelihood <= 1 else [f"likelihood = {likelihood}, wanted 0 to 1"]
    if wrong or fps is None or frame is None:
        raise ValueError(f"{path}: {'; '.join(wrong)}")
    lines = [_cells(line) for line in _lines(path) if line.strip(" ,")]
    wanted = ["scorer", "bodyparts", "coords"]
    if lines[1:] and lines[1][0] == "individuals":
        wanted.insert(1, "individuals")
    heads, rows = lines[: len(wanted)], lines[len(wanted) :]
    if (first := [head[0] for head in heads]) != wanted:
        raise ValueError(f"{path}: rows {', '.join(first)}, wanted {', '.join(wanted)} first")
    if odd := [row for row in lines if len(row) != len(heads[0])]:
        raise ValueError(f"{path}: row {odd[0][0]!r} has {len(odd[0])} cells, wanted {len(heads[0])} as in the first")
    markers: dict[str, dict[str, int]] = {}  # the column of each coordinate of each
    for column, (*owner, coordinate) in list(enumerate(zip(*heads[1:], strict=True)))[1:]:
        # "single" stands for parts that belong to no individual.
        name = "_".join(owner[1:] if owner[0] == "single" and len(owner) > 1 else owner)
        markers.setdefault(name, {})[coordinate] = column
    for name, columns in markers.items():
        if set(columns) - {"likelihood"} != {"x", "y"}:
            raise ValueError(f"{path}: {name} has columns {', '.join(columns)}, wanted x, y, likelihood")
    table = np.array([[_number(c, f"{path}: frame {row[0]}: {c!r}") for c in row] for row in rows])
    if len(table) < 3 or not (np.diff(table[:, 0]) > 0).all() or not markers:
        raise ValueError(f"{path}: {len(table)} frames of {len(markers)} parts, wanted 3, with increasing numbers")
    place = np.stack([table[:, [c["x"], c["y"]]] for c in markers.values()], 1)
    for m, columns in enumerate(markers.values()):
        if "likelihood" in columns:
            place[~(table[:, columns["likelihood"]] >= likelihood), m] = np.nan
    if frame.origin:
        frame = replace(frame, origin=(frame.origin[0], *(-y for y in frame.origin[1:])))
    return _finished(path, list(markers), table[:, 0] / fps, place * (1.0, -1.0), frame)


def read_c3d(path: Path, frame: Frame | None = None) -> Tracked:
    """Read the points of a C3D file; those with a negative residual are lost, as the format has it.

    Args:
        path: File.
        frame: How X, Y and Z lie in ours. Without a scale, lengths are in the unit that the file tells.

    Raises:
        ValueError: for a file that is damaged, has no points, rate or known unit, or without the package ezc3d.
    """
    frame = frame or Frame()
    try:
        if (mark := path.read_bytes()[1:2]) != b"P":  # anything may happen in the library then
            raise ValueError(f"second byte {mark!r}, not b'P'")
        file = importlib.import_module("ezc3d").c3d(str(path))
    except ModuleNotFoundError:
        raise ValueError(f"{path}: ezc3d, which reads C3D, is not installed, wanted: pip install ezc3d") from None
    except (OSError, RuntimeError, ValueError, LookupError) as error:
        raise ValueError(f"{path}: {error}; wanted a C3D file") from error
    about, points = file["parameters"]["POINT"], file["data"]["points"]
    parts = sorted((key for key in about if re.fullmatch(r"LABELS\d*", key)), key=len)  # beyond the 255th: LABELS2
    names = [name.strip() for key in parts for name in about[key]["value"]][: points.shape[1]]
    rate = float(file["header"]["points"]["frame_rate"])
    if not points.size or len(names) < points.shape[1] or not rate > 0:
        raise ValueError(f"{path}: {points.shape[1]} points, {len(names)} names, {rate:g} Hz, wanted some of each")
    unit = "".join(about["UNITS"]["value"][:1]).strip() if "UNITS" in about else ""
    scale = METRES.get(unit) if frame.scale is None else frame.scale
    if scale is None:
        raise ValueError(f"{path}: lengths in {unit!r}, wanted {', '.join(METRES)}, or a scale")
    place = np.array(points[:3].T, float)
    place[file["data"]["meta_points"]["residuals"][0].T < 0] = np.nan
    return _finished(path, names, np.arange(len(place)) / rate, place, replace(frame, scale=scale))
