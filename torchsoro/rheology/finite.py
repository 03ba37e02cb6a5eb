"""Finite-strain tests of soft solids: uniaxial and equibiaxial tension, simple shear, and their file reader."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np

Mode = Literal["uniaxial", "equibiaxial", "shear"]

# Column names in lower case, factor to SI units, and mode of the test. The first name found in a file is used.
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
_STRAINS = {"engineering strain"}  # stretch minus one


@dataclass(frozen=True, kw_only=True, eq=False)
class Experiment:
    """Deformation history of a specimen and its nominal stress.

    Attributes:
        name: Label in tables and messages.
        mode: "uniaxial" or "equibiaxial" tension or compression with stress-free sides, or simple "shear".
        time: Times [n] s, non-negative, increasing; the specimen is undeformed and relaxed at time 0 and deforms at a
            constant rate up to the first sample.
        deformation: Stretch, or amount of shear [n].
        stress: Nominal stress [n] Pa: force over undeformed area.

    Raises:
        ValueError: for fewer than two samples, different lengths, numbers that are not finite, times that do not
            increase, or a stretch that is not positive; the message names experiment and sample.
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
        """Deformation of the undeformed specimen: 0 in shear, stretch 1 otherwise."""
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
        """Experiment with a subset of the samples, given as bool [n] or indices; linear in between."""
        arrays = {name: getattr(self, name)[keep] for name in ("time", "deformation", "stress")}
        return Experiment(name=self.name, mode=self.mode, **arrays)

    def path(self, largest: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Piecewise linear deformation history from rest through all samples, in steps of bounded increment.

        Args:
            largest: Largest increment of the deformation in a step.

        Returns:
            Deformation at the end of each step [S], duration of each step [S] s, and indices of the steps that end at
            the samples [n].
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
    """Read a tensile or shear test from a table separated by commas or semicolons.

    Columns are identified by name in the first line that names time, deformation and stress; lines above it are
    skipped. Names are ``time_s`` or ``Time (s)``; ``stretch``, ``shear_strain`` or ``Engineering Strain``;
    ``nominal_stress_kPa``, ``shear_stress_kPa`` or ``Engineering Stress (MPa)``.

    Args:
        path: File.
        name: Label of the experiment; the name of the file if None.
        rate: Constant rate of deformation [1/s]. If given, times are the accumulated deformation over the rate, and the
            times of the file are ignored.

    Raises:
        ValueError: for a missing column or a cell that is not a number, naming file and line; for a rate that is not
            positive; or as for `Experiment`.
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
    """Number of the header line (from 1), separator, all column names, and the three columns to be read."""
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
    """Time, deformation and stress [n, 3] in SI units, from the lines below line ``header``."""
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
