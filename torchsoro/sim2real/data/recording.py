"""Recorded marker places: a table over time, with lost samples."""

from __future__ import annotations

import csv
import dataclasses
import io
import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from torchsoro.storage import atomic_write

AXES = "xyz"
PART = 10_000  # rows of a file, that are read at a time
SHOWN = 60  # characters of a value in a message


def brief(value: object, most: int = SHOWN) -> str:
    """A value for a message, cut where it is longer than so many characters."""
    text = repr(value)
    return text if len(text) <= most else f"{text[:most]}..."


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """Marker places over time.

    Attributes:
        time: [T] s, increasing, by the recording's own clock.
        position: [T, M, A] m; NaN where a sample was lost. A is the number of recorded axes.
        axes: Which axes those are, 0 to 2.

    Raises:
        ValueError: for shapes that do not fit, times that do not increase, or a place that is infinite.
    """

    time: np.ndarray
    position: np.ndarray
    axes: tuple[int, ...] = (0, 1, 2)

    def __post_init__(self) -> None:
        """Check the table."""
        if self.time.ndim != 1 or self.position.shape[:1] != self.time.shape:
            raise ValueError(
                f"time, position: shapes {self.time.shape} and {self.position.shape}, wanted [T], [T, M, A]"
            )
        if len(self.time) < 3:
            raise ValueError(f"{len(self.time)} samples, wanted three or more")
        if self.position.ndim != 3 or self.position.shape[2] != len(self.axes):
            raise ValueError(
                f"position: shape {self.position.shape}, wanted [T, M, {len(self.axes)}] as axes = {self.axes}"
            )
        late = np.flatnonzero(~(np.diff(self.time) > 0))
        if len(late):
            before, after = self.time[late[0] : late[0] + 2]
            raise ValueError(
                f"time: {after:g} s in sample {late[0] + 2} after {before:g} s, wanted times that increase"
            )
        if not np.isfinite(self.time).all():
            raise ValueError("time: an infinite number, wanted finite times")
        if np.isinf(self.position).any():
            raise ValueError("position: an infinite number, wanted finite ones, or NaN for a lost sample")

    @property
    def seen(self) -> np.ndarray:
        """Where a sample was not lost, bool [T, M, A]."""
        return np.isfinite(self.position)

    def until(self, end: float) -> Recording:
        """What was recorded up to a time [s], the first three samples in any case."""
        count = max(int(np.searchsorted(self.time, end, side="right")), 3)
        return dataclasses.replace(self, time=self.time[:count], position=self.position[:count])

    def every(self, step: int) -> Recording:
        """Every ``step``-th sample, from the first on."""
        return dataclasses.replace(self, time=self.time[::step], position=self.position[::step])

    def columns(self, markers: Sequence[str]) -> dict[str, np.ndarray]:
        """Columns [T] of a markers.csv by name; NaN where a sample was lost.

        Args:
            markers: Names.
        """
        columns = {"time_s": self.time}
        for m, name in enumerate(markers):
            for a, axis in enumerate(self.axes):
                columns[f"{name}_{AXES[axis]}_m"] = self.position[:, m, a]
        return columns

    @classmethod
    def read(cls, path: Path, markers: Sequence[str], axes: Sequence[int] = (0, 1, 2)) -> Recording:
        """Read ``time_s, <marker>_x_m, <marker>_y_m, ...``; an empty cell is a lost sample.

        Args:
            path: CSV file.
            markers: Names of the markers wanted, in this order; others are left out.
            axes: Recorded axes.

        Raises:
            ValueError: if a column is missing or a cell is no number, with the file.
        """
        columns = read_table(path)
        wanted = [[f"{name}_{AXES[a]}_m" for a in axes] for name in markers]
        if missing := [n for n in ("time_s", *itertools.chain(*wanted)) if n not in columns]:
            raise ValueError(f"{path}: columns {brief(', '.join(columns), 300)}, wanted also {', '.join(missing)}")
        place = np.stack([columns[name] for row in wanted for name in row], -1).reshape(-1, len(markers), len(axes))
        try:
            return cls(time=columns["time_s"].copy(), position=place, axes=tuple(axes))
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error


def write_table(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Write columns [T] by name as a CSV file, whose folder is made; NaN is an empty cell."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(columns)
    for row in zip(*columns.values(), strict=True):
        table.writerow("" if math.isnan(value) else f"{value:z.9g}" for value in row)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as file:
        file.write(text.getvalue().encode())


def read_table(path: Path) -> dict[str, np.ndarray]:
    """Columns [T] of a CSV file by name; an empty cell is NaN.

    The file is read a part at a time: a million rows take about three times the memory of their numbers.

    Raises:
        ValueError: if the file cannot be read, has no rows, a column twice, or a cell that is no number; with file and
            line.
    """
    parts: list[np.ndarray] = []
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = enumerate(csv.reader(file), start=1)
            _, head = next(rows, (0, []))
            names = [name.strip() for name in head]
            if twice := [name for name in dict.fromkeys(names) if names.count(name) > 1]:
                count = names.count(twice[0])
                raise ValueError(f"column {brief(twice[0])} is there {count} times, wanted each once")
            last = 0
            while part := list(itertools.islice(rows, PART)):
                last = part[-1][0]
                parts.append(_numbers([(number, row) for number, row in part if row], names))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: {error}; wanted a table of numbers between commas") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    if not last:
        raise ValueError(f"{path}: {int(bool(head))} lines, wanted names of columns and numbers below")
    return dict(zip(names, np.concatenate(parts).T, strict=True))


def _numbers(rows: Sequence[tuple[int, list[str]]], names: Sequence[str]) -> np.ndarray:
    """Numbers [T, columns] of rows with their numbers in the file."""
    for number, row in rows:
        if len(row) != len(names):
            raise ValueError(f"line {number} has {len(row)} cells, wanted {len(names)} as in the first")
    try:
        return np.array([[float(cell) if cell else math.nan for cell in row] for _, row in rows]).reshape(
            len(rows), len(names)
        )
    except ValueError:
        return np.array([[_number(c, number, n) for c, n in zip(row, names, strict=True)] for number, row in rows])


def _number(cell: str, number: int, name: str) -> float:
    if not cell or cell.isspace():
        return math.nan
    try:
        return float(cell)
    except ValueError:
        raise ValueError(f"line {number}: {brief(name)} = {brief(cell)}, wanted a number or nothing") from None
