"""Inputs of the recipe ``material``: each ends in a result or in a message with exit code 2, and leaves no half."""

from __future__ import annotations

import re
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchsoro import cli

RESULTS = {"material.toml", "report.html", "master.csv"}
OMEGA = np.geomspace(0.01, 100.0, 12)


def table(swap: bool = False, scale: float = 1.0, seed: int | None = None) -> list[list[str]]:
    """A standard linear solid with two elements, in shear."""
    times, moduli = np.array([0.1, 3.0]), np.array([4e5, 2e5])
    wt = OMEGA[:, None] * times
    part = moduli * wt / (1 + wt**2)
    storage, loss = 1e5 + (part * wt).sum(1), part.sum(1)
    if seed is not None:
        storage, loss = 1e6 * np.random.default_rng(seed).random((2, len(OMEGA)))
    if swap:
        storage, loss = loss, storage
    rows = np.stack([OMEGA, scale * storage, scale * loss], 1)
    return [["omega_rad_per_s", "G_storage_Pa", "G_loss_Pa"], *([repr(v) for v in row] for row in rows.tolist())]


def text(rows: list[list[str]], delimiter: str = ",") -> str:
    return "\n".join(delimiter.join(row) for row in rows) + "\n"


def edited(row: int, column: int, value: str) -> str:
    rows = table()
    rows[row][column] = value
    return text(rows)


@dataclass
class Ended:
    code: int
    error: str
    written: set[str]


def run(folder: Path, content: str | bytes | None, *options: str, name: str = "sweep.csv", out: str = "out") -> Ended:
    """Run the recipe in this process."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    if content is not None:
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    before = set(folder.rglob("*"))
    recipe = cli.load("material")
    stream, kept = Captured(), sys.stderr
    sys.stderr = stream
    try:
        recipe.cli([str(folder / name), "--out", str(folder / out), *options])
        code = 0
    except SystemExit as end:
        code = int(end.code or 0)
    finally:
        sys.stderr = kept
    written = {p.name for p in folder.rglob("*") if p not in before and p.is_file()}
    return Ended(code, stream.text, written)


class Captured:
    """Standard error."""

    def __init__(self) -> None:
        self.text = ""

    def write(self, text: str) -> int:
        self.text += text
        return len(text)

    def flush(self) -> None:
        """Nothing to do."""

    def isatty(self) -> bool:
        """It is none."""
        return False


@pytest.mark.parametrize(
    ("content", "options", "message"),
    [
        (None, (), r"file: .*sweep\.csv: no such file"),
        ("", (), r"sweep\.csv: is empty, wanted a table"),
        (b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR", (), "holds binary data, wanted text"),
        (text(table(swap=True)), (), "storage and loss in their own columns: are they swapped"),
        (text(table(seed=3)), (), r"misses the values by \d\d%.*wanted measurements of one linear"),
        (text(table(scale=1e9)), (), r"modulus from .*wanted from 1e-09 to 1\.3e\+12 in SI units"),
        (edited(5, 1, "4e12"), (), r"line 6, column 'G_storage_Pa' \(storage\): 4e12 is \d\.\d decades above"),
        (edited(5, 1, "nan"), (), r"line 6, column 'G_storage_Pa' \(storage\): 'nan', wanted a finite number"),
        (edited(5, 2, "inf"), (), r"line 6, column 'G_loss_Pa' \(loss\): 'inf', wanted a finite number"),
        (edited(5, 1, "-4e5"), (), r"line 6, .*'-4e5', wanted a finite number more than 0"),
        (edited(5, 2, "-4e5"), (), r"loss.*-400000: wanted finite and 0 or more"),
        (edited(5, 0, table()[4][0]), (), r"lines 5 and 6: omega .* twice in one curve, wanted once"),
        (edited(0, 0, "omega (Hz)"), (), "an angular frequency in Hz; wanted rad/s.*--units frequency rad/s"),
        (edited(0, 1, "G_storage"), (), "no unit, wanted one of 'Pa'.*--units storage Pa"),
        (text(table()[:4]), (), "3 points, wanted at least 5"),
        (text(table()[:1]), (), "no rows of data under the header"),
        (text(table()), ("--horizon", "-1"), "horizon = -1.0: wanted finite and positive"),
        (text(table()), ("--reference", "nan"), "reference = nan: wanted finite and above -273.15 deg C"),
        (text(table()), ("--temperature", "20", "--reference", "40"), "reference = 40: .*measured at 20 deg C only"),
        (text(table()), ("--band", "10", "1"), r"band = \(10.0, 1.0\): wanted a lower and a higher"),
        (text(table()), ("--elements", "1000000"), "elements = 1000000: wanted 1 to 60"),
        (text(table()), ("--equilibrium", "inf"), "equilibrium = inf: wanted finite and positive"),
        (text(table()), ("--dt", "1"), r"dt = 1 s: wanted at most"),
        (text(table()), ("--units", "storage", "psi"), "units: 'psi' for 'storage', wanted one of Pa"),
        (
            text(table()),
            ("--columns", "storage", "nope"),
            r"no header row names quantities with the columns \{'storage': 'nope'\}",
        ),
        (text(table()), ("--columns", "storage", "7"), "storage.*column 7, but .* has 3"),
    ],
)
def test_bad_input_is_named_with_exit_code_2_and_nothing_written(tmp_path, content, options, message):
    ended = run(tmp_path / "case", content, *options)
    assert ended.code == 2
    assert re.search(message, re.sub(r"[\s│]+", " ", ended.error)), ended.error
    assert not ended.written


@pytest.mark.parametrize("out", ["sweep.csv", "sweep.csv/run", "x" * 300, "/proc/run"])
def test_out_that_cannot_be_written_is_refused_before_the_file_is_read(tmp_path, out):
    ended = run(tmp_path / "case", "no table", out=out)
    assert ended.code == 2 and "error: out = " in ended.error


@pytest.mark.parametrize("missing", [True, False])
def test_a_workbook_without_its_reader_or_of_text_is_refused(tmp_path, monkeypatch, missing):
    if missing:
        monkeypatch.setitem(sys.modules, "python_calamine", None)
    else:
        pytest.importorskip("python_calamine")
    ended = run(tmp_path / "case", text(table()), name="sweep.xlsx")
    assert ended.code == 2
    assert ("extra excel" if missing else "wanted a workbook") in ended.error


@pytest.mark.parametrize(
    "content",
    [
        pytest.param("\ufeff" + text(table()), marks=pytest.mark.slow),
        text([table()[0], *([c.replace(".", ",") for c in row] for row in table()[1:])], ";"),
        pytest.param(text(table()[:1] + table()[:0:-1]), marks=pytest.mark.slow),
    ],
    ids=["byte order mark", "decimal commas", "falling frequencies"],
)
def test_a_table_as_instruments_write_it_becomes_the_material(tmp_path, content):
    ended = run(tmp_path / "case", content)
    assert (ended.code, ended.written) == (0, RESULTS)
    found = (tmp_path / "case" / "out" / "material.toml").read_text()
    assert "youngs_modulus_Pa = 2800" in found or "youngs_modulus_Pa = 2799" in found  # 2 (1 + 0.4) 0.1 MPa


numbers = st.one_of(
    st.sampled_from(["nan", "inf", "-inf", "0", "-1", "1e-300", "1e300", "1", "0.3", "20", "1e-5", "auto", "x", ""]),
    st.floats(allow_nan=False, width=32).map(repr),
)
flags = st.sampled_from(
    ["horizon", "reference", "temperature", "equilibrium", "poisson-ratio", "density", "cell", "dt", "elements"]
)
options = st.lists(
    st.one_of(
        st.tuples(flags, numbers).map(lambda pair: (f"--{pair[0]}", pair[1])),
        st.tuples(numbers, numbers).map(lambda pair: ("--band", *pair)),
        st.sampled_from(
            [("--vertical",), ("--moduli", "loss"), ("--deformation", "tension"), ("--units", "loss", "kPa")]
        ),
        st.tuples(st.sampled_from(["storage", "set", "nothing"]), numbers).map(lambda pair: ("--columns", *pair)),
    ),
    max_size=3,
).map(lambda parts: [word for part in parts for word in part])
cells = st.one_of(numbers, st.text(max_size=8), st.floats(min_value=1e-3, max_value=1e7).map(repr))


@st.composite
def contents(draw):
    """A table with some cells, rows and characters spoiled; or anything."""
    kind = draw(st.sampled_from(["table", "table", "table", "bytes", "text"]))
    if kind == "bytes":
        return draw(st.binary(max_size=200))
    if kind == "text":
        return draw(st.text(max_size=200)).encode("utf-8", "surrogatepass")
    rows = table(swap=draw(st.integers(0, 9)) == 0, seed=draw(st.sampled_from([None, None, None, 1])))
    for _ in range(draw(st.integers(0, 2))):
        rows[draw(st.integers(0, len(rows) - 1))][draw(st.integers(0, 2))] = draw(cells)
    if draw(st.booleans()):
        rows = rows[: draw(st.integers(0, len(rows)))]
    made = text(rows, draw(st.sampled_from([",", ";", "\t", " "])))
    return made.encode(draw(st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "latin-1"])), "replace")


@pytest.mark.slow
@settings(max_examples=5 * settings.default.max_examples)
@given(content=contents(), options=options)
def test_drawn_inputs_end_in_a_result_or_in_a_message(tmp_path_factory, content, options):
    ended = run(tmp_path_factory.getbasetemp() / "drawn", content, *options)
    assert ended.code in (0, 2)
    if ended.code == 0:
        assert ended.written == RESULTS
    else:
        assert not ended.written and ended.error
