"""Finite-strain tests of soft solids: tension, equibiaxial tension and simple shear, and how their files are read."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np

Mode = Literal["uniaxial", "equibiaxial", "shear"]

# What columns are called, in lower case, and the unit of each in SI. The first name that a file has is taken.
_COLUMNS: dict[str, tuple[tuple[str, float, Mode | None], ...]] = {
    "time": (("time_s", 1.0, None), ("time (s)", 1.0, None)),
    "deformation": (
        ("shear_strain", 1.0, "shear"),
        ("stretch", 1.0, "uniaxial"),
        ("engineering strain", 1.0, "uniaxial"),
    ),
    "stress": (
        ("shear_stress_kpa", 1e3, "shear"),
        ("nominal_stress_kpa", 1e3, "uniaxial"),
        ("engineering stress (mpa)", 1e6, "uniaxial"),
    ),
}
_STRAINS = {"engineering strain"}  # a stretch less one


@dataclass(frozen=True, kw_only=True, eq=False)
class Experiment:
    """What was done to a specimen at rest, and the stress that it took.

    Attributes:
        name: For people.
        mode: "uniaxial" or "equibiaxial" tension or compression with free sides, or simple "shear".
        time: [n] s, from 0 on, increasing; the specimen is at rest at time 0 and moves evenly to the first sample.
        deformation: Stretch, or amount of shear [n].
        stress: Nominal stress [n] Pa: force over the area at rest.

    Raises:
        ValueError: for fewer than two samples, lengths that differ, numbers that are not finite, times that do not
            increase, or a stretch that is not positive; names the experiment and the sample.
    """

    name: str
    mode: Mode
    time: np.ndarray
    deformation: np.ndarray
    stress: np.ndarray

    def __post_init__(self) -> None:
        """Check and freeze the arrays."""
        if self.mode not in get_args(Mode):
            raise ValueError(f"{self.name}: mode = {self.mode!r}, wanted one of {', '.join(get_args(Mode))}")
        for name in ("time", "deformation", "stress"):
            values = np.array(getattr(self, name), dtype=float)
            if values.ndim != 1 or len(values) < 2 or len(values) != len(self.time):
                raise ValueError(
                    f"{self.name}: {name} of shape {values.shape}, wanted [n] with n >= 2, for all the same"
                )
            if not np.isfinite(values).all():
                raise ValueError(f"{self.name}: {name}[{np.flatnonzero(~np.isfinite(values))[0]}] is not finite")
            values.setflags(write=False)
            object.__setattr__(self, name, values)
        late = np.flatnonzero(np.diff(self.time) <= 0)
        if self.time[0] < 0 or len(late):
            i = int(late[0]) + 1 if len(late) else 0
            raise ValueError(f"{self.name}: time[{i}] = {self.time[i]:g} s, wanted times from 0 on that increase")
        if self.mode != "shear" and not (self.deformation > 0).all():
            i = int(np.flatnonzero(self.deformation <= 0)[0])
            raise ValueError(f"{self.name}: deformation[{i}] = {self.deformation[i]:g}, wanted a positive stretch")

    @property
    def rest(self) -> float:
        """The deformation at rest."""
        return 0.0 if self.mode == "shear" else 1.0

    @property
    def invariant(self) -> np.ndarray:
        """I1 - 3 of an incompressible solid at each sample [n]."""
        s = self.deformation
        if self.mode == "shear":
            return s**2
        return s**2 + 2 / s - 3 if self.mode == "uniaxial" else 2 * s**2 + s**-4 - 3

    def rms(self) -> float:
        """Root mean square of the stress [Pa]."""
        return math.sqrt(float((self.stress**2).mean()))

    def part(self, keep: np.ndarray) -> Experiment:
        """Some of its samples, bool or indices [n]; the path between them is taken as even."""
        arrays = {name: getattr(self, name)[keep] for name in ("time", "deformation", "stress")}
        return Experiment(name=self.name, mode=self.mode, **arrays)

    def path(self, largest: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The way from rest through all samples in even steps, of which none changes the deformation by more.

        Args:
            largest: Change of the deformation in a step, at most.

        Returns:
            Deformation at the end of each step [S], length of each step [S] s, and the steps that end at samples [n].
        """
        time, deformation = self.time, self.deformation
        if time[0] > 0:
            time, deformation = np.append(0.0, time), np.append(self.rest, deformation)
        counts = np.maximum(1, np.ceil(np.abs(np.diff(deformation)) / largest - 1e-9)).astype(int)
        ends = np.cumsum(counts)
        at = np.interp(np.arange(ends[-1] + 1), np.append(0, ends), np.arange(len(time)))
        moments = np.interp(at, np.arange(len(time)), time)
        steps = np.diff(moments)
        way = np.interp(at, np.arange(len(time)), deformation)
        if self.time[0] > 0:
            return way[1:], steps, ends - 1
        return way, np.append(steps[0], steps), np.append(0, ends)


def read(path: str | Path, *, name: str | None = None, rate: float | None = None) -> Experiment:
    """Read a tensile or shear test from a table of numbers, separated by commas or semicolons.

    The columns are found by their names, in the first line that has one for the time, the deformation and the stress;
    lines above it are skipped. Known names are ``time_s`` or ``Time (s)``; ``stretch``, ``shear_strain`` or
    ``Engineering Strain``; ``nominal_stress_kPa``, ``shear_stress_kPa`` or ``Engineering Stress (MPa)``.

    Args:
        path: The file.
        name: For people; the file's name if None.
        rate: Of the deformation [1/s], if the file's own times are not to be used: in a test at one speed they then
            follow from the way.

    Raises:
        ValueError: if a column is missing or a cell is no number, with the file and line; for a rate that is not
            positive; or as of `Experiment`.
        OSError: if the file cannot be read.
    """
    path = Path(path)
    lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    number, separator, header, columns = _header(path, lines)
    mode = columns[1][2]
    if mode is None or mode != columns[2][2]:
        raise ValueError(f"{path}: line {number}: {columns[1][0]} and {columns[2][0]}, wanted both of one kind of test")
    table = _numbers(path, lines, number, separator, [(header.index(c[0]), c[1]) for c in columns])
    time, deformation, stress = table.T
    if columns[1][0] in _STRAINS:
        deformation = deformation + 1
    if rate is not None:
        if not 0 < rate < math.inf:
            raise ValueError(f"rate = {rate}: wanted finite and positive, in 1/s")
        way = np.abs(np.diff(deformation, prepend=0.0 if mode == "shear" else 1.0))
        time = np.cumsum(way) / rate
    return Experiment(name=name or path.stem, mode=mode, time=time, deformation=deformation, stress=stress)


def _header(path: Path, lines: Sequence[str]) -> tuple[int, str, list[str], list[tuple[str, float, Mode | None]]]:
    """The line that names the columns (from 1), what separates them, their names, and those to be read."""
    for number, line in enumerate(lines, start=1):
        separator = ";" if ";" in line else ","
        header = [cell.strip().lower() for cell in line.split(separator)]
        found = [next((c for c in known if c[0] in header), None) for known in _COLUMNS.values()]
        columns = [c for c in found if c is not None]
        if len(columns) == len(found):
            return number, separator, header, columns
    wanted = "; ".join(" or ".join(c[0] for c in known) for known in _COLUMNS.values())
    raise ValueError(f"{path}: no line names columns of time, deformation and stress, wanted {wanted}")


def _numbers(
    path: Path, lines: Sequence[str], header: int, separator: str, columns: Sequence[tuple[int, float]]
) -> np.ndarray:
    """The columns [n, 3] in SI below line number ``header``."""
    rows = []
    for number, line in enumerate(lines[header:], start=header + 1):
        cells = line.split(separator)
        if not line.strip(separator + " \t"):
            continue
        try:
            rows.append([float(cells[at]) * unit for at, unit in columns])
        except (ValueError, IndexError):
            raise ValueError(f"{path}: line {number}: {line.strip()!r}, wanted numbers as the header says") from None
    return np.array(rows, dtype=float).reshape(-1, len(columns))
