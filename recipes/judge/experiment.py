"""An experiment on disk as the judge reads and writes it: what is believed, per trial, and what was recorded."""

from __future__ import annotations

import csv
import json
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """Markers over time.

    Attributes:
        time: [T] s.
        names: Of the markers.
        axes: Recorded coordinates of each marker, such as "xyz".
        value: [T, markers, axes] m, not a number where a sample is lost.
    """

    time: Floats
    names: tuple[str, ...]
    axes: str
    value: Floats

    def write(self, path: Path) -> None:
        """Write as markers.csv."""
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("w", newline="") as file:
            rows = csv.writer(file)
            rows.writerow(["time_s", *(f"{name}_{axis}_m" for name in self.names for axis in self.axes)])
            for t, row in zip(self.time, self.value.reshape(len(self.time), -1), strict=True):
                rows.writerow([f"{t:.6g}", *("" if np.isnan(v) else f"{v:.6g}" for v in row)])

    @classmethod
    def read(cls, path: Path) -> Recording:
        """Read a markers.csv."""
        header, data = _read_csv(path)
        names, axes = [], ""
        for column in header[1:]:
            name, axis, _ = column.rsplit("_", 2)
            if name not in names:
                names.append(name)
            axes += axis if axis not in axes else ""
        return cls(
            time=data[:, 0],
            names=tuple(names),
            axes=axes,
            value=data[:, 1:].reshape(len(data), len(names), len(axes)),
        )


def _read_csv(path: Path) -> tuple[list[str], Floats]:
    with path.open(newline="") as file:
        header, *rows = list(csv.reader(file))
    return header, np.array([[float(cell) if cell else np.nan for cell in row] for row in rows])


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One run of the apparatus.

    Attributes:
        name: Of its folder.
        held_out: Whether the tool does not get its markers.
        tables: What differs from setup.toml, as in trial.toml.
        pressure: Rows of (time [s], pressure [Pa]); empty without a chamber.
    """

    name: str
    held_out: bool = False
    tables: dict[str, Any] = field(default_factory=dict)
    pressure: tuple[tuple[float, float], ...] = ()

    def write(self, folder: Path) -> None:
        """Write trial.toml and pressure.csv, where there is something to write."""
        folder.mkdir(parents=True, exist_ok=True)
        if self.tables:
            (folder / "trial.toml").write_text(toml(self.tables))
        if self.pressure:
            lines = ["time_s,c1_pa", *(f"{t:.6g},{p:.6g}" for t, p in self.pressure)]
            (folder / "pressure.csv").write_text("\n".join(lines) + "\n")

    @classmethod
    def read(cls, folder: Path, *, held_out: bool = False) -> Trial:
        """Read a trial's folder."""
        tables, pressure = {}, ()
        if (folder / "trial.toml").exists():
            tables = tomllib.loads((folder / "trial.toml").read_text())
        if (folder / "pressure.csv").exists():
            pressure = tuple((float(t), float(p)) for t, p in _read_csv(folder / "pressure.csv")[1])
        return cls(name=folder.name, held_out=held_out, tables=tables, pressure=pressure)


def read_setup(folder: Path) -> dict[str, Any]:
    """The tables of setup.toml."""
    return tomllib.loads((folder / "setup.toml").read_text())


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value)
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k} = {_value(v)}" for k, v in value.items()) + "}"
    if isinstance(value, Sequence | np.ndarray):
        return "[" + ", ".join(_value(v) for v in value) + "]"
    return repr(float(value))


def toml(tables: dict[str, Any]) -> str:
    """Tables as TOML text: plain values, tables, and arrays of tables."""
    plain = {k: v for k, v in tables.items() if not isinstance(v, dict) and not _is_tables(v)}
    lines = [f"{k} = {_value(v)}" for k, v in plain.items()]
    for key, value in tables.items():
        for table in [value] if isinstance(value, dict) else value if _is_tables(value) else []:
            lines += ["", f"[{key}]" if isinstance(value, dict) else f"[[{key}]]"]
            lines += [f"{k} = {_value(v)}" for k, v in table.items()]
    return "\n".join(lines).strip() + "\n"


def _is_tables(value: Any) -> bool:
    return isinstance(value, list | tuple) and bool(value) and all(isinstance(v, dict) for v in value)
