"""Tables of measurements from text files and workbooks, with identification of columns and units."""

from __future__ import annotations

import csv
import importlib
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

MODULUS = {"pa": 1.0, "kpa": 1e3, "mpa": 1e6, "gpa": 1e9, "n/m2": 1.0, "n/mm2": 1e6, "dyn/cm2": 0.1}
COMPLIANCE = {"1/pa": 1.0, "1/kpa": 1e-3, "1/mpa": 1e-6, "1/gpa": 1e-9, "m2/n": 1.0, "mm2/n": 1e-6, "cm2/dyn": 10.0}
LARGEST = 10_000_000  # largest file [bytes]; a sweep has about a thousand rows
TEMPERATURE = {"c": 0.0, "k": -273.15}  # offset to deg C
UNITS: dict[str, dict[str, float]] = {
    "frequency": {"hz": 2 * math.pi, "khz": 2e3 * math.pi, "rad/s": 1.0},
    "storage": MODULUS,
    "loss": MODULUS,
    "time": {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0},
    "modulus": MODULUS,
    "compliance": COMPLIANCE,
    "temperature": TEMPERATURE,
    "nominal": TEMPERATURE,
    "set": {},
    "log_a": {"": 1.0, "decades": 1.0},
}
_STORAGE, _LOSS = r"(['\u2032p]|1)", r"(''|\"|\u2033|\u2032\u2032|pp|2)"
_MODULUS = r"(_mod(ulus)?)?"
# Names of columns, with underscores for blanks. Single letters keep their case: t is time, T is temperature.
NAMES = {
    "frequency": r"f|w|ω|(?i:freq(uency)?|omega|ang(ular|\.)?_?freq(uency)?)",
    "storage": rf"[EG]({_STORAGE}|_?(?i:stor(age)?{_MODULUS}))|(?i:stor(age)?{_MODULUS})(_\(?[EG]{_STORAGE}\)?)?",
    "loss": rf"[EG]({_LOSS}|_?(?i:loss{_MODULUS}))|(?i:loss{_MODULUS})(_\(?[EG]{_LOSS}\)?)?",
    "time": r"t|(?i:time)",
    "modulus": rf"[EG](\(t\)|_t|_?(?i:relax(ation)?{_MODULUS}))?|(?i:(relax(ation)?_)?modulus)(_\(?[EG](\(t\))?\)?)?",
    "compliance": r"[JD](\(t\)|_t|_?(?i:creep))?|(?i:(creep_)?compliance)(_\(?[JD](\(t\))?\)?)?",
    "temperature": r"T|T_(?i:measured|sample|actual)|(?i:temp(erature)?(_measured|_sample|_actual)?)",
    "nominal": r"T_(?i:nominal|set|target|program(med)?)|(?i:temp(erature)?_(nominal|set|target|program(med)?))",
    "set": r"(?i:set|sweep|segment|step|run|source(_file)?|file)",
    "log_a": r"(?i:log_?(10)?_?\(?a_?T?\)?)",
}


@dataclass(frozen=True, kw_only=True)
class Table:
    """Rows of a file with the identified columns and their units.

    Attributes:
        path: File.
        header: Line number of the header row, from 1.
        names: Header of each column.
        columns: Column index of each quantity, from 0.
        rivals: Header of a second column that matches the same quantity, where there is one.
        units: Unit of each quantity, as spelled in ``UNITS``; empty where unknown.
        lines: Line number of each row of data, from 1.
        rows: Cells of each row of data.
        decimal: Whether a comma is read as a decimal sign.
    """

    path: Path
    header: int
    names: list[str]
    columns: dict[str, int]
    rivals: dict[str, str]
    units: dict[str, str]
    lines: list[int]
    rows: list[list[str]]
    decimal: bool

    def where(self, quantity: str) -> str:
        """File, header line and column of a quantity, the start of an error message."""
        return f"{self.path}, line {self.header}, column {self.names[self.columns[quantity]]!r} ({quantity})"

    def stem(self, quantity: str) -> str:
        """Header of a quantity's column without the unit."""
        name = self.names[self.columns[quantity]]
        return next((stem for stem, unit in _readings(name) if unit in UNITS[quantity]), name)

    def texts(self, quantity: str) -> list[str]:
        """Cells of the column of a quantity.

        Raises:
            ValueError: if two columns match the quantity, or a row is too short.
        """
        if quantity in self.rivals:
            rival = self.rivals[quantity]
            raise ValueError(
                f"{self.where(quantity)}, or {rival!r}? Choose one, for example columns={{{quantity!r}: {rival!r}}}, "
                f"on a command line --columns {quantity} {rival!r}"
            )
        column = self.columns[quantity]
        for line, row in zip(self.lines, self.rows, strict=True):
            if column >= len(row):
                raise ValueError(
                    f"{self.path}, line {line}: {len(row)} columns, wanted at least {column + 1}, for "
                    f"{self.names[column]!r} ({quantity})"
                )
        return [row[column] for row in self.rows]

    def numbers(self, quantity: str, *, positive: bool = False) -> np.ndarray:
        """A quantity in SI units, temperatures in deg C; angular frequency for "frequency".

        Raises:
            ValueError: naming the line, for a value that is not finite, or not positive if ``positive``; naming the
                column, for an unknown unit.
        """
        known = UNITS[quantity]
        unit = self.units[quantity]
        if unit not in known:
            spelled = ", ".join(repr(name) for name in _SPELLED[quantity])
            raise ValueError(
                f"{self.where(quantity)}: {f'unit {unit!r}' if unit else 'no unit'}, wanted one of {spelled}. "
                f"Declare it, for example units={{{quantity!r}: {_SPELLED[quantity][0]!r}}}, on a command line "
                f"--units {quantity} {_SPELLED[quantity][0]}"
            )
        values = []
        for line, text in zip(self.lines, self.texts(quantity), strict=True):
            value = _number(text, self.decimal)
            if value is None or not math.isfinite(value) or (positive and value <= 0):
                wanted = "a finite number" + (" more than 0" if positive else "")
                name = self.names[self.columns[quantity]]
                raise ValueError(f"{self.path}, line {line}, column {name!r} ({quantity}): {text!r}, wanted {wanted}")
            values.append(value)
        return np.array(values) + known[unit] if known is TEMPERATURE else np.array(values) * known[unit]


_SPELLED = {
    "frequency": ("Hz", "kHz", "rad/s"),
    **dict.fromkeys(("storage", "loss", "modulus"), ("Pa", "kPa", "MPa", "GPa", "N/mm2", "dyn/cm2")),
    "time": ("s", "ms", "min", "h"),
    "compliance": ("1/Pa", "1/kPa", "1/MPa", "1/GPa", "mm2/N", "cm2/dyn"),
    **dict.fromkeys(("temperature", "nominal"), ("C", "K")),
    "log_a": ("decades",),
}


def load(path: Path, columns: Mapping[str, str | int], units: Mapping[str, str], sheet: str | None) -> Table:
    """Find the table in a file.

    Args:
        path: Text, or a workbook by its suffix .xls, .xlsx, .xlsm or .ods.
        columns: Declared columns; see :func:`torchsoro.rheology.measured.read`.
        units: Declared units.
        sheet: Sheet of a workbook, or None.

    Raises:
        ValueError: if no header row is found, or the declarations do not fit it.
        FileNotFoundError: if there is no such file.
        ModuleNotFoundError: for a workbook, without python-calamine.
    """
    for name, declared, what in (("columns", columns, UNITS), ("units", units, _SPELLED)):
        unknown = sorted(set(declared) - set(what))
        if unknown:
            raise ValueError(f"{name}: {unknown[0]!r}, wanted some of {', '.join(map(repr, what))}")
    for quantity, unit in units.items():
        if _spell(unit) not in UNITS[quantity]:
            raise ValueError(f"units: {unit!r} for {quantity!r}, wanted one of {', '.join(_SPELLED[quantity])}")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    if (size := path.stat().st_size) > LARGEST:
        raise ValueError(f"{path}: {size / 1e6:.0f} MB, wanted at most {LARGEST / 1e6:.0f} MB: average its rows")
    if not size:
        raise ValueError(f"{path}: is empty, wanted a table")
    for rows, decimal in _splits(path, sheet):
        found = _header(rows, columns)
        if found is not None:
            table = _table(path, rows, found, columns, units, decimal)
            if "modulus" in columns and "stress" in table.names[table.columns["modulus"]].lower():
                raise ValueError(f"{table.where('modulus')}: a stress, wanted a modulus: divide it by the strain")
            return table
    rows = next(iter(_splits(path, sheet)))[0][:3]
    first = "; ".join(" | ".join(row)[:60] for row in rows)
    declared = f" with the columns {dict(columns)}" if columns else ""
    words = " ".join(cell.lower() for row in rows for cell in row)
    if not columns and "stress" in words and "strain" in words:
        raise ValueError(
            f"{path}: stress and strain ({first}), wanted moduli over frequency, or a modulus or compliance over time: "
            "of a relaxation test, stress over strain. Tests to failure are fitted by torchsoro.rheology.hyperelastic"
        )
    raise ValueError(
        f"{path}: no header row names quantities{declared}; the first rows are: {first}. Wanted frequency, storage and "
        'loss, or time and modulus or compliance. Name the columns, for example columns={"frequency": 0, "storage": 1}'
        ", on a command line --columns frequency 0 storage 1"
    )


def _splits(path: Path, sheet: str | None) -> Iterator[tuple[list[list[str]], bool]]:
    """Candidate splits of a file into rows of cells, each with whether a comma may be the decimal sign."""
    if path.suffix.lower() in (".xls", ".xlsx", ".xlsm", ".ods"):
        for rows in _workbook(path, sheet):
            yield rows, False
        return
    if sheet is not None:
        raise ValueError(f"sheet = {sheet!r}: {path} is text; wanted None")
    raw = path.read_bytes()
    encoding = "utf-16" if raw[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    if encoding != "utf-16" and b"\0" in raw:
        raise ValueError(f"{path}: holds binary data, wanted text, or a workbook by its suffix .xls, .xlsx or .ods")
    try:
        text = raw.decode(encoding)
    except UnicodeDecodeError:
        text = raw.decode("latin-1")  # older instruments: the degree sign is one byte
    lines = text.splitlines()
    for delimiter in ("\t", ";", ","):
        try:
            rows = [next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), []) for line in lines]
        except csv.Error as error:
            raise ValueError(f"{path}: {error}; wanted a table of text") from error
        # Some instruments separate the header by tabs and the rows by blanks.
        for i, line in enumerate(lines):
            words = line.split()
            if len(rows[i]) == 1 and words and _number(words[0], False) is not None:
                rows[i] = words
        yield [[cell.strip() for cell in row] for row in rows], delimiter != ","
    yield [line.split() for line in lines], True


def _workbook(path: Path, sheet: str | None) -> Iterator[list[list[str]]]:
    """Rows of a sheet, or of each sheet in turn."""
    try:
        calamine = importlib.import_module("python_calamine")
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"{path}: workbooks are read by python-calamine, which is not installed. Install the extra excel (pip "
            'install "torchsoro[excel]"), or open the file in a spreadsheet and save its sheet as CSV'
        ) from error
    try:
        book = calamine.CalamineWorkbook.from_path(str(path))
    except (calamine.CalamineError, OSError) as error:
        raise ValueError(f"{path}: {error}; wanted a workbook, or a table of text with another suffix") from error
    if sheet is not None and sheet not in book.sheet_names:
        raise ValueError(f"sheet = {sheet!r}: {path} has {', '.join(map(repr, book.sheet_names))}")
    for name in book.sheet_names if sheet is None else [sheet]:
        rows = book.get_sheet_by_name(name).to_python(skip_empty_area=False)
        yield [[str(cell).strip() for cell in row] for row in rows]


def _header(rows: Sequence[list[str]], columns: Mapping[str, str | int]) -> int | None:
    """Number of the header row: the first with all declared names, or two quantities; -1 for a table without one."""
    named = [column for column in columns.values() if isinstance(column, str)]
    for i, row in enumerate(rows):
        known = {found[0] for cell in row if (found := _quantity(cell)) is not None} - {"set"}
        if named and all(name in row for name in named):
            return i
        if not named and len(known) >= 2:
            return i
    numbered = [column for column in columns.values() if isinstance(column, int)]
    if len(numbered) > 1 and len(numbered) == len(columns) and any(len(row) > max(numbered) for row in rows):
        return -1
    return None


def _table(
    path: Path,
    rows: Sequence[list[str]],
    header: int,
    declared: Mapping[str, str | int],
    units: Mapping[str, str],
    decimal: bool,
) -> Table:
    """Table of the rows below the header row."""
    width = max(map(len, rows))
    names = rows[header] if header >= 0 else [f"column {i}" for i in range(width)]
    columns, rivals, spelled = _columns(path, names, declared)
    begin = header + 1
    used = [i for quantity, i in columns.items() if quantity != "set"]
    if header < 0:  # the first row of numbers
        good = (all(i < len(row) and _number(row[i], decimal) is not None for i in used) for row in rows)
        begin = next((i for i, ok in enumerate(good) if ok), len(rows))
    elif begin < len(rows) and all(_number(cell, decimal) is None for cell in rows[begin]):
        below = rows[begin]
        for quantity, i in columns.items():
            if not spelled[quantity] and i < len(below):
                spelled[quantity] = _spell(below[i])
        begin += 1
    spelled.update({quantity: _spell(unit) for quantity, unit in units.items()})
    kept = [i for i in range(begin, len(rows)) if any(rows[i]) and not rows[i][0].startswith("#")]
    if not kept:
        raise ValueError(f"{path}, line {begin + 1}: no rows of data under the header, wanted at least one")
    return Table(
        path=path,
        header=max(header, begin - 1 if header < 0 else header) + 1,
        names=names,
        columns=columns,
        rivals=rivals,
        units=spelled,
        lines=[i + 1 for i in kept],
        rows=[rows[i] for i in kept],
        decimal=decimal,
    )


def _columns(
    path: Path, names: Sequence[str], declared: Mapping[str, str | int]
) -> tuple[dict[str, int], dict[str, str], dict[str, str]]:
    """Column index of each quantity, header of a second matching column, and unit from the header."""
    columns: dict[str, int] = {}
    rivals: dict[str, str] = {}
    units: dict[str, str] = {}
    for quantity, column in declared.items():
        index = list(names).index(column) if isinstance(column, str) else column
        if not 0 <= index < len(names):
            raise ValueError(f"columns: {quantity!r} in column {column}, but {path} has {len(names)}, counted from 0")
        columns[quantity] = index
        units[quantity] = next((unit for _, unit in _readings(names[index]) if unit in UNITS[quantity]), "")
    for index, name in enumerate(names):
        found = _quantity(name)
        if found is None or index in columns.values() or found[0] in declared:
            continue
        quantity, unit = found
        if quantity not in columns:
            columns[quantity], units[quantity] = index, unit
        elif names[columns[quantity]] != name:  # of columns with equal names the first is used
            rivals[quantity] = name
    if "nominal" in columns and "temperature" not in columns:
        columns["temperature"], units["temperature"] = columns["nominal"], units["nominal"]
    return columns, rivals, units


def _quantity(name: str) -> tuple[str, str] | None:
    """Quantity and unit named by a column header, the unit empty if absent; None for an unknown name."""
    for stem, unit in _readings(name):
        for quantity, pattern in NAMES.items():
            if re.fullmatch(pattern, stem) and (not unit or unit in UNITS[quantity]):
                return quantity, unit
    return None


def _readings(name: str) -> Iterator[tuple[str, str]]:
    """Candidate splits of a column header into name and unit: ``E' (MPa)``, ``f / Hz``, ``G_loss_Pa``, ``T``."""
    name = re.sub(r"[\s_]+", "_", name.strip())
    if match := re.fullmatch(r"(.+?)_?[(\[](.*)[)\]]", name):
        yield match[1], _spell(match[2])
    if match := re.fullmatch(r"(.+?)_?[/,]_?(.+)", name):
        yield match[1], _spell(match[2])
    parts = name.split("_")
    for i in range(1, len(parts)):
        yield "_".join(parts[:i]), _spell("_".join(parts[i:]))
    yield name, ""


def _spell(unit: str) -> str:
    """Unit in the spelling of ``UNITS``; unknown units in lower case."""
    unit = unit.strip().strip("[]()").lower().replace("_", " ").replace("²", "2").replace("^", "").replace("**", "")
    unit = re.sub(r"^(°|deg(rees)?)?\s*(c|k)(elsius|elvin)?$", r"\3", unit)
    unit = re.sub(r"^(\S+)\s*[-⁻][1¹]$", r"1/\1", re.sub(r"\s*\bper\s+|\s*/\s*", "/", unit))
    unit = {"sec": "s", "hr": "h", "rad/sec": "rad/s", "-": "", "n/mm²": "n/mm2"}.get(unit, unit)
    return "1" + unit if unit.startswith("/") else unit


def _number(text: str, decimal: bool) -> float | None:
    """Number in a cell, or None."""
    try:
        return float(text.replace(",", ".") if decimal else text)
    except ValueError:
        return None
