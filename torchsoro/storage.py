"""What a run leaves on disk: files replaced as a whole, a table of metrics, and settings that JSON gives back."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import enum
import io
import json
import math
import os
import tempfile
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

# torch is imported where it is used: tables are read and written without it.


@contextlib.contextmanager
def atomic_write(path: str | Path) -> Iterator[BinaryIO]:
    """Open a file for writing that appears under its name only when it is complete and on disk.

    Args:
        path: The file to create or to replace; its folder must exist.

    Yields:
        A binary file. If the block raises or the process dies, what stood at ``path`` before stays untouched.
    """
    path = Path(path)
    temporary = path.with_name(path.name + ".tmp")  # the same folder: a rename is atomic only within one file system
    try:
        with open(temporary, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    if os.name == "posix":
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def check_folder(name: str, folder: Path, files: Iterable[str] = ()) -> None:
    """Refuse a folder into which results cannot be written, before they are computed; nothing is made.

    Args:
        name: Of the argument, for messages.
        folder: Need not exist.
        files: Names of the files that are to be written there.

    Raises:
        ValueError: if the folder is a file or lies under one, cannot be written, or has a folder in a file's place.
    """
    try:
        nearest = next(place for place in (folder.absolute(), *folder.absolute().parents) if place.exists())
        if not nearest.is_dir():
            under = "" if nearest == folder.absolute() else f" lies under {nearest}, which"
            raise ValueError(f"{name} = {folder}:{under} is a file, wanted a folder")
        with tempfile.TemporaryFile(dir=nearest):
            pass
        taken = [file for file in files if (folder / file).is_dir()]
    except OSError as error:
        raise ValueError(f"{name} = {folder}: not writable ({error.strerror}), wanted a folder that is") from error
    if taken:
        raise ValueError(f"{name} = {folder}: holds a folder {taken[0]}, wanted no folder of a result's name")


class MetricsFile:
    """The rows of ``metrics.csv``, in memory and on disk.

    Args:
        path: The file; written anew.
        columns: Names of the columns, ``iteration`` first.
        rows: The rows to begin with.
    """

    def __init__(self, path: Path, columns: list[str], rows: list[dict[str, float]]) -> None:
        self._path = path
        self._columns = columns or ["iteration"]
        self._rows = rows
        self._rewrite()

    @property
    def last(self) -> dict[str, float]:
        """The row of the last iteration."""
        return self._rows[-1]

    def by_column(self) -> dict[str, list[float]]:
        """The values of each column; NaN where a row has none."""
        return {column: [row.get(column, math.nan) for row in self._rows] for column in self._columns}

    def add(self, iteration: int, scalars: dict[str, float]) -> None:
        """Add to the row of an iteration; it is on disk on return.

        Args:
            iteration: The last iteration or a later one.
            scalars: Numbers by column; a new name makes a new column.

        Raises:
            ValueError: If the iteration goes back.
        """
        last = self._rows[-1]["iteration"] if self._rows else -1
        if iteration < last:
            raise ValueError(f"iteration: got {iteration}, wanted at least the {last} logged last")
        new = [tag for tag in scalars if tag not in self._columns]
        self._columns += new
        if iteration == last:
            self._rows[-1].update(scalars)
        else:
            self._rows.append({"iteration": iteration, **scalars})
        if new or iteration == last:
            self._rewrite()
            return
        with open(self._path, "a", encoding="utf-8", newline="") as file:
            file.write(self._text(self._rows[-1:]))
            file.flush()
            os.fsync(file.fileno())

    def _text(self, rows: list[dict[str, float]]) -> str:
        # repr reads back as the same float, so the file of a resumed run equals that of an uninterrupted one.
        cells = [[repr(row[column]) if column in row else "" for column in self._columns] for row in rows]
        return _csv_text(cells)

    def _rewrite(self) -> None:
        with atomic_write(self._path) as file:
            file.write((_csv_text([self._columns]) + self._text(self._rows)).encode())


def _csv_text(rows: list[list[str]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def read_metrics(path: Path, start: int) -> tuple[list[str], list[dict[str, float]]]:
    """Read a table of metrics whose last line may be cut off.

    Args:
        path: The file; one that is missing counts as empty.
        start: Rows of this iteration and later ones are dropped.

    Returns:
        The names of the columns, and the rows.

    Raises:
        ValueError: If a line cannot be read; names it.
    """
    if not path.exists():
        return [], []
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"path: {path} is damaged ({error}); choose another folder") from error
    header, *lines = list(csv.reader(io.StringIO(text[: text.rfind("\n") + 1]))) or [[]]
    rows: list[dict[str, float]] = []
    for number, line in enumerate(lines, start=2):
        try:
            iteration = int(line[0])
            values = {tag: float(cell) for tag, cell in zip(header[1:], line[1:], strict=True) if cell}
        except (ValueError, IndexError) as error:
            raise ValueError(f"path: {path} is damaged in line {number} ({error}); choose another folder") from error
        if iteration < start:
            rows.append({"iteration": iteration, **values})
    return header, rows


def read_json(path: Path, kind: type) -> Any:
    """Read a JSON file of a run.

    Args:
        path: The file.
        kind: ``dict`` or ``list``, what it has to hold.

    Raises:
        ValueError: If it holds something else, or cannot be read.
    """
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"path: {path} is damaged ({error}); choose another folder") from error
    if not isinstance(found, kind):
        seen = type(found).__name__
        raise ValueError(f"path: {path} is damaged (holds a {seen}, wanted a {kind.__name__}); choose another folder")
    return found


def write_json(path: Path, value: Any, *, allow_nan: bool = True) -> None:
    """Replace a file by a value as indented JSON, atomically.

    Args:
        path: The file.
        value: What JSON can hold.
        allow_nan: Whether numbers may be NaN or infinite.

    Raises:
        ValueError: for such a number where none may be.
    """
    text = json.dumps(value, indent=2, allow_nan=allow_nan) + "\n"
    with atomic_write(path) as file:
        file.write(text.encode())


def read_checkpoint(path: Path, parts: Mapping[str, type]) -> dict[str, Any]:
    """Read what ``torch.save`` wrote, after a look at the checksums of the zip format, which torch passes over.

    Args:
        path: The file.
        parts: Names and types that it has to hold.

    Returns:
        The parts, with tensors on the CPU.

    Raises:
        ValueError: If the file is damaged, lacks a part, or holds more than tensors, numbers, text and containers.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            broken = archive.testzip()
    except Exception as error:  # a damaged archive can fail in any way
        raise ValueError(f"path: {path} is damaged ({error}); choose another folder") from error
    if broken is not None:
        raise ValueError(f"path: {path} is damaged (checksum of {broken}); choose another folder")
    foreign = f"path: {path} is not a checkpoint of a run"
    import torch

    try:
        payload = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # not quoted: torch advises to read what is not safe to read
        raise ValueError(f"{foreign}: it holds more than tensors, numbers, text and containers") from error
    if not isinstance(payload, dict):
        raise ValueError(f"{foreign}: it holds a {type(payload).__name__}")
    if wrong := [name for name, kind in parts.items() if not isinstance(payload.get(name), kind)]:
        raise ValueError(f"{foreign}: it lacks {', '.join(wrong)}")
    return payload


def plain_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Turn settings into nested dicts of what JSON gives back unchanged.

    Args:
        settings: Mappings or dataclasses of numbers, strings, paths, enums, small tensors, lists.

    Returns:
        The same values with strings, finite numbers, booleans, None, lists and dicts only.

    Raises:
        ValueError: If something else is among them; names it.
    """
    plain = _plain(settings, "")
    if not isinstance(plain, dict):
        raise ValueError(f"settings: got {type(settings).__name__}, wanted a mapping or a dataclass")
    return plain


def _plain(value: Any, name: str) -> Any:
    import torch

    if isinstance(value, enum.Enum):
        return _plain(value.value, name)
    if isinstance(value, np.ndarray | np.generic | torch.Tensor):
        return _plain(value.tolist(), name)
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float) and math.isfinite(value):
        return value
    if isinstance(value, Path | torch.device | torch.dtype):
        return str(value)
    if isinstance(value, list | tuple):
        return [_plain(item, f"{name}[{index}]") for index, item in enumerate(value)]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return {key: _plain(item, f"{name}.{key}" if name else key) for key, item in value.items()}
    raise ValueError(
        f"settings: {name or 'the whole'} is {value!r}, wanted finite numbers, strings, lists and mappings"
    )


def check_storable(value: Any, name: str) -> None:
    """Refuse what ``torch.load(weights_only=True)`` would refuse when it is too late.

    Args:
        value: What is to be saved: tensors, numbers, strings, None, and lists, tuples and mappings of them.
        name: How to call it in the message.

    Raises:
        ValueError: If something else is among it.
    """
    import torch

    if isinstance(value, Mapping):
        for key, item in value.items():
            check_storable(key, f"a key of {name}")
            check_storable(item, f"{name}[{key!r}]")
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            check_storable(item, f"{name}[{index}]")
    elif not isinstance(value, torch.Tensor) and type(value) not in (bool, int, float, str, type(None)):
        kind = type(value).__name__
        raise ValueError(f"{name}: got {kind}, wanted tensors, numbers, strings, lists, dicts or a state_dict")
