"""Measured curves of a viscoelastic material: frequency sweeps, stress relaxation and creep, and their file reader."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal, get_args

import numpy as np
from scipy.ndimage import median_filter

from torchsoro.rheology.readers import Table, load

Deformation = Literal["tension", "shear"]
OUTLIER = 2.5  # largest distance of a value from the running median of five [decades]


class _Curve:
    """Base of the three kinds of curve: validation of values, and read-only arrays."""

    axis: ClassVar[str]
    ordinates: ClassVar[tuple[str, ...]]
    temperature: float
    deformation: Deformation

    def __post_init__(self) -> None:
        """Check and freeze the arrays."""
        x = _vector(self, self.axis, low="more than 0")
        wrong = np.flatnonzero(np.diff(x) <= 0)
        if len(wrong):
            i = int(wrong[0]) + 1
            raise ValueError(f"{self.axis}[{i}] = {x[i]:g} after {x[i - 1]:g}: wanted increasing, without duplicates")
        for name in self.ordinates:
            y = _vector(self, name, low="0 or more" if name == "loss" else "more than 0")
            if len(y) != len(x):
                raise ValueError(f"{name}: {len(y)} values, wanted {len(x)}, one for each of {self.axis}")
        if self.deformation not in get_args(Deformation):
            raise ValueError(f'deformation = {self.deformation!r}: wanted "tension" or "shear"')
        if not (np.isnan(self.temperature) or self.temperature > -273.15) or np.isinf(self.temperature):
            raise ValueError(f"temperature = {self.temperature}: wanted deg C above -273.15, or nan if unknown")


@dataclass(frozen=True, kw_only=True, eq=False)
class Sweep(_Curve):
    """A frequency sweep at one temperature, or a master curve.

    Attributes:
        omega: Angular frequency [n] rad/s, increasing.
        storage: E' or G' [n] Pa, positive.
        loss: E'' or G'' [n] Pa, not negative.
        temperature: Temperature [deg C], nan if unknown; the reference temperature of a master curve.
        deformation: "tension" for E, "shear" for G.

    Raises:
        ValueError: for a value that is not finite or out of its range, frequencies that do not increase, or lengths
            that differ; the message names the attribute and the index.
    """

    axis: ClassVar[str] = "omega"
    ordinates: ClassVar[tuple[str, ...]] = ("storage", "loss")
    omega: np.ndarray
    storage: np.ndarray
    loss: np.ndarray
    temperature: float
    deformation: Deformation


@dataclass(frozen=True, kw_only=True, eq=False)
class Relaxation(_Curve):
    """Stress relaxation: relaxation modulus over the time after a step of strain, at one temperature.

    Attributes:
        time: Time since the step [n] s, increasing.
        modulus: Relaxation modulus E(t) or G(t) [n] Pa, positive.
        temperature: Temperature [deg C], nan if unknown.
        deformation: "tension" for E, "shear" for G.

    Raises:
        ValueError: as of :class:`Sweep`.
    """

    axis: ClassVar[str] = "time"
    ordinates: ClassVar[tuple[str, ...]] = ("modulus",)
    time: np.ndarray
    modulus: np.ndarray
    temperature: float
    deformation: Deformation


@dataclass(frozen=True, kw_only=True, eq=False)
class Creep(_Curve):
    """Creep: compliance over the time after a step of stress, at one temperature.

    Attributes:
        time: Time since the step [n] s, increasing.
        compliance: Creep compliance D(t) or J(t) [n] 1/Pa, positive.
        temperature: Temperature [deg C], nan if unknown.
        deformation: "tension" for D, "shear" for J.

    Raises:
        ValueError: as of :class:`Sweep`.
    """

    axis: ClassVar[str] = "time"
    ordinates: ClassVar[tuple[str, ...]] = ("compliance",)
    time: np.ndarray
    compliance: np.ndarray
    temperature: float
    deformation: Deformation


def read(
    path: str | Path,
    *,
    columns: Mapping[str, str | int] | None = None,
    units: Mapping[str, str] | None = None,
    deformation: Deformation | None = None,
    temperature: float | None = None,
    scatter: float = 0.5,
    sheet: str | None = None,
) -> list[Sweep] | list[Relaxation] | list[Creep]:
    """Read a table of measurements and split it into isothermal curves, ordered by temperature.

    The table is text (columns separated by comma, semicolon, tab or blanks) or a sheet of a workbook (.xls, .xlsx).
    Lines before the header row are skipped; a row of units may follow it. Columns of frequency, storage and loss
    modulus give sweeps; time and modulus give stress relaxation; time and compliance give creep. Columns are identified
    by common names (``f``, ``omega``, ``E'``, ``E_stor``, ``G_loss_Pa``, ``T``, ``Set``, ``E_relax``), units by the
    header (``E' (MPa)``, ``G_storage_pa``) or the row of units. Missing or ambiguous columns and units raise an error
    that names the argument to declare them. If nominal and measured temperatures are present, rows are grouped by the
    nominal one, and the temperature of a curve is the mean of the measured ones.

    Args:
        path: File.
        columns: Column of a quantity, by name or by number from 0, where the header does not identify it. The
            quantities are "frequency", "storage", "loss", "time", "modulus", "compliance", "temperature", "nominal"
            (set temperature) and "set" (label of the curve).
        units: Unit of a quantity, such as ``{"frequency": "rad/s"}``; overrides the file.
        deformation: "tension" or "shear", where the header has neither E nor G; overrides the header.
        temperature: Temperature [deg C], for a file without a temperature column.
        scatter: Largest difference between consecutive sorted temperatures within a curve [K], for a file without label
            or nominal temperature.
        sheet: Sheet of a workbook; the first with such a table if None.

    Returns:
        Curves in SI units, temperatures in deg C.

    Raises:
        ValueError: naming file, line and column, the value seen and the value wanted.
        FileNotFoundError: if there is no such file.
        ModuleNotFoundError: for a workbook, without the package that reads it.
    """
    if temperature is not None and not np.isfinite(temperature):
        raise ValueError(f"temperature = {temperature}: wanted finite, in deg C, or None if the file has it")
    if not scatter > 0:
        raise ValueError(f"scatter = {scatter}: wanted more than 0 K")
    if deformation not in (None, *get_args(Deformation)):
        raise ValueError(f'deformation = {deformation!r}: wanted "tension" or "shear"')
    table = load(Path(path), columns or {}, units or {}, sheet)
    kind = _kind(table)
    if temperature is not None and "temperature" in table.columns:
        raise ValueError(f"temperature = {temperature}: {table.where('temperature')} holds temperatures already")
    if kind is Sweep and "frequency" not in (units or {}):
        _check_unit_of_frequency(table)
    x = table.numbers("frequency" if kind is Sweep else "time", positive=True)
    y = {name: table.numbers(name, positive=name != "loss") for name in kind.ordinates}
    mode = deformation or _deformation(table, kind.ordinates[0])
    measured = table.numbers("temperature") if "temperature" in table.columns else None
    curves = []
    for rows in _isothermal(table, measured, scatter):
        rows = rows[np.argsort(x[rows], kind="stable")]
        twice = np.flatnonzero(np.diff(x[rows]) == 0)
        if len(twice):
            first, second = (table.lines[r] for r in rows[twice[0] : twice[0] + 2])
            raise ValueError(
                f"{table.path}, lines {first} and {second}: {kind.axis} {x[rows[twice[0]]]:g} twice in one curve, "
                'wanted once. If they are of two curves, name the column that tells them apart: columns={"set": ...}'
            )
        for name, values in y.items():
            _check_outliers(table, name, values, rows)
        given = {kind.axis: x[rows], **{name: values[rows] for name, values in y.items()}}
        mean = np.nan if temperature is None else temperature
        if measured is not None:
            mean = float(measured[rows].mean())
        curves.append(kind(**given, temperature=mean, deformation=mode))
    return sorted(curves, key=lambda curve: curve.temperature)  # stable: curves of one temperature stay in order


def _kind(table: Table) -> type[Sweep] | type[Relaxation] | type[Creep]:
    """Kind of curve given by the columns of a table."""
    kinds = {Sweep: ("frequency", "storage", "loss"), Relaxation: ("time", "modulus"), Creep: ("time", "compliance")}
    for kind, wanted in kinds.items():
        if set(wanted) <= set(table.columns):
            return kind
    seen = ", ".join(f"{quantity} ({table.names[i]!r})" for quantity, i in table.columns.items())
    raise ValueError(
        f"{table.path}, line {table.header}: recognised {seen or 'no column'} among {table.names}; wanted frequency, "
        "storage and loss, or time and modulus, or time and compliance. Name them, for example "
        'columns={"storage": "Gp"}'
    )


def _deformation(table: Table, quantity: str) -> Deformation:
    """Deformation, from the symbol (E or G) or word in the header of a modulus."""
    name = table.stem(quantity)
    words = name.lower()
    tension, shear = "tens" in words or "young" in words, "shear" in words
    if not (tension or shear) and quantity != "compliance":  # J is written for both compliances
        tension, shear = "E" in name, "G" in name
    if tension == shear:
        raise ValueError(f'{table.where(quantity)}: tension or shear? Declare it, for example deformation="shear"')
    return "tension" if tension else "shear"


def _check_unit_of_frequency(table: Table) -> None:
    """Refuse an angular frequency in Hz, an ambiguity of a factor of 2 pi."""
    if table.units["frequency"].endswith("hz") and re.fullmatch(r"w|ω|(?i:omega|ang.*)", table.stem("frequency")):
        raise ValueError(
            f"{table.where('frequency')}: an angular frequency in Hz; wanted rad/s, or a frequency in Hz. Declare "
            'which, for example units={"frequency": "rad/s"}, on a command line --units frequency rad/s'
        )


def _check_outliers(table: Table, quantity: str, values: np.ndarray, rows: np.ndarray) -> None:
    """Refuse a value more than ``OUTLIER`` decades from the running median of its curve, naming line and column."""
    rows = rows[values[rows] > 0]  # a loss modulus may be zero
    if len(rows) < 5:
        return
    logs = np.log10(values[rows])
    off = logs - median_filter(logs, 5, mode="reflect")
    worst = int(np.abs(off).argmax())
    if abs(off[worst]) > OUTLIER:
        line, column = table.lines[rows[worst]], table.names[table.columns[quantity]]
        raise ValueError(
            f"{table.path}, line {line}, column {column!r} ({quantity}): {table.texts(quantity)[rows[worst]]} is "
            f"{abs(off[worst]):.1f} decades {'above' if off[worst] > 0 else 'below'} the values beside it; wanted a "
            "continuous curve: mend or remove the row"
        )


DRIFT = 2.0  # largest range of the measured temperature within one isothermal curve [K]


def _isothermal(table: Table, measured: np.ndarray | None, scatter: float) -> list[np.ndarray]:
    """Row numbers of each curve: rows of equal label and nominal temperature, or else of equal temperature."""
    groups = [np.arange(len(table.lines))]
    if "set" in table.columns:
        labels = np.array(table.texts("set"))
        groups = [np.flatnonzero(labels == label) for label in dict.fromkeys(labels.tolist())]
    if "nominal" in table.columns:
        nominal = table.numbers("nominal")
        groups = [part for group in groups for part in _clusters(group, nominal, scatter)]
    if measured is None:
        return groups
    parts = []
    for group in groups:
        # A label defines a curve even if the measured temperature scatters, unless it spans several temperatures.
        whole = len(groups) > 1 and np.ptp(measured[group]) <= DRIFT
        parts += [group] if whole else _clusters(group, measured, scatter)
    for part in parts:
        if np.ptp(measured[part]) > DRIFT:
            raise ValueError(
                f"{table.where('temperature')}: {np.ptp(measured[part]):.3g} K between the rows of one curve, which "
                f"begins in line {table.lines[part[0]]}; wanted at most {DRIFT:g} K. Name the column that tells the "
                'curves apart: columns={"set": ...}'
            )
    return parts


def _clusters(rows: np.ndarray, values: np.ndarray, gap: float) -> list[np.ndarray]:
    """Groups of rows whose consecutive sorted values differ by at most ``gap``, each in row order."""
    order = rows[np.argsort(values[rows], kind="stable")]
    ends = np.flatnonzero(np.diff(values[order]) > gap) + 1
    return [np.sort(part) for part in np.split(order, ends)]


def _vector(curve: _Curve, name: str, *, low: str) -> np.ndarray:
    """An attribute as a read-only copy [n] of finite numbers that are positive, or at least not negative."""
    values = np.array(getattr(curve, name), dtype=np.float64)
    if values.ndim != 1 or not len(values):
        raise ValueError(f"{name}: shape {values.shape}, wanted [n] with at least one value")
    good = np.isfinite(values) & ((values > 0) if low == "more than 0" else (values >= 0))
    if not good.all():
        i = int(np.argmin(good))
        raise ValueError(f"{name}[{i}] = {values[i]:g}: wanted finite and {low}")
    values.setflags(write=False)
    object.__setattr__(curve, name, values)
    return values
