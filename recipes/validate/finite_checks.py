"""Fits of the simulator's solid to published finite-strain tests, and prediction of held-out tests.

    python recipes/validate/finite_checks.py RECORDINGS     # two to five minutes

RECORDINGS is a folder with ``viscoelastic-shear-and-tension`` (a clear adhesive in shear, an unnamed material in
tension) and ``silicone-tensile-tests``; absent folders are skipped with a message. The functions return their rows.

Interpretation of the files:

- Uniaxial loading and unloading: columns of stretch and nominal stress, times of the file, which equal accumulated
  stretch over rate. The published curves are smoothed to about 85 points; one begins with a decreasing stretch.
- Stepped cyclic shear: columns of shear stress and strain by name, since force and displacement are exchanged in one
  file. From the times of the files the rates are 1, 2, 5 and 6 strains per *minute*; the file without a number has a
  rate of 2 1/min, the one labelled 0.1 1/s a rate of 6 1/min.
- Monotonic shear: the times of the files do not correspond to a constant shear rate. The unlabelled column, linear in
  these times, is strain / sqrt(1 + strain^2 / 4), which saturates at 2; the shear rate at the end would be 40 to 170
  times the rate in the file name. :func:`clocks` fits the tests with these times and with strain / rate: the latter
  gives the smaller error, slightly up to a strain of 2 and by half over the whole range, and is used.
- Silicones: engineering strain (cross-head) and engineering stress. Three files have times continued as text by a
  spreadsheet (40.9, 40.10, 40.11), one a decreasing last time; times are therefore strain / rate, from speed and gauge
  length in the head of the file. The fits do not depend on the times. Samples after the largest stress (rupture) are
  omitted, 1 to 3 samples of three files.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import tyro
from tables import Row, show

from torchsoro.rheology.finite import Experiment, read
from torchsoro.rheology.hyperelastic import Fit, Interval, fit, ladder

SHEAR_AND_TENSION, SILICONES = "viscoelastic-shear-and-tension", "silicone-tensile-tests"
LAWS = ("neo-Hooke", "Yeoh, C20", "Yeoh, C20 and C30")
MODERATE = 2.0  # strain in shear; beyond it the adhesive is far from where a robot goes
_PER_MINUTE = {"": 2, "_0d1": 6, "_1": 1, "_5": 5}  # strains, by the ends of the names of the stepped shear tests


def until(experiment: Experiment, largest: float) -> Experiment:
    """Test truncated before the first sample whose deformation exceeds ``largest``."""
    beyond = np.flatnonzero(experiment.deformation > largest)
    return experiment.part(np.arange(beyond[0] if len(beyond) else len(experiment.time)))


def tension(folder: Path) -> dict[float, list[Experiment]]:
    """Load-unload tests by their rate [1/s]."""
    tests: dict[float, list[Experiment]] = {}
    for path in sorted((folder / "uniaxial-loading-unloading-test").glob("*.csv")):
        tests.setdefault(_rate(path), []).append(read(path))
    return tests


def monotonic(folder: Path, *, clock: bool = False) -> dict[float, list[Experiment]]:
    """Monotonic shear tests by rate [1/s], with times strain / rate, or those of the files if ``clock``."""
    paths = sorted((folder / "monotonic-shear-test").glob("*.csv"))
    return {_rate(path): [read(path, rate=None if clock else _rate(path))] for path in paths}


def stepped(folder: Path) -> dict[float, list[Experiment]]:
    """Stepped cyclic tests in shear by their rate [1/min]."""
    base = folder / "cyclic-shear-relaxation-test"
    rates = sorted((rate, end) for end, rate in _PER_MINUTE.items())
    return {rate: [read(base / f"shear_relaxation{end}.csv")] for rate, end in rates}


def _rate(path: Path) -> float:
    """Rate in the last part of the file name: 0d03 is 0.03."""
    return float(path.stem.split("_")[-1].replace("d", "."))


def split(
    tests: Mapping[float, Sequence[Experiment]], held: Sequence[float], *, specimens: bool = False, elements: int = 2
) -> Row:
    """Fit a law without and with Maxwell elements to tests of some rates and predict the others: relative errors [%].

    Both laws are Yeoh laws with C20 and C30; the number of Maxwell elements minimises the BIC on the fitted tests.

    Args:
        tests: Tests by rate.
        held: Held-out rates.
        specimens: Whether a stress factor of each test is fitted, also for the held-out tests.
        elements: Largest number of Maxwell elements.
    """
    known = [e for rate in tests if rate not in held for e in tests[rate]]
    other = [e for rate in held for e in tests[rate]]
    start = time.perf_counter()
    fits = ladder(known, most=elements, specimens=specimens)
    elastic, viscous = fits[0], min(fits, key=lambda f: f.bic)
    row: Row = {
        "fitted": " ".join(f"{rate:g}" for rate in tests if rate not in held),
        "predicted": " ".join(f"{rate:g}" for rate in held),
        "tests": f"{len(known)}, {len(other)}",
        "specimens": "differ" if specimens else "alike",
        "elements": len(viscous.times),
    }
    for what, those in (("fit", known), ("prediction", other)):
        for name, found in (("elastic", elastic), ("viscous", viscous)):
            row[f"{what}, {name} [%]"] = 100 * found.error_of(those, specimens=specimens)
    return row | {
        "shear modulus [kPa]": _interval(viscous, "shear", 1e-3),
        "g": " ".join(_interval(viscous, f"g{i + 1}") for i in range(len(viscous.times))) or "-",
        "tau [s]": " ".join(_interval(viscous, f"tau{i + 1}") for i in range(len(viscous.times))) or "-",
        "time [s]": time.perf_counter() - start,
    }


def shear_and_tension(folder: Path) -> list[Row]:
    """Prediction of held-out rates from half or two thirds of the rates, for each kind of test."""
    rows: list[Row] = []

    def add(what: str, tests: Mapping[float, Sequence[Experiment]], helds: Sequence[Sequence[float]], **given) -> None:
        rows.extend({"test": what, **split(tests, held, **given)} for held in helds)

    each = lambda tests: [[rate] for rate in tests]  # noqa: E731
    add("tension, 1/s", found := tension(folder), each(found))
    for name, largest in ((f"to {MODERATE:g}", MODERATE + 0.02), ("whole", math.inf)):  # steps overshoot a little
        found = _until(monotonic(folder), largest)
        add(f"shear {name}, 1/s", found, each(found))
        found = _until(stepped(folder), largest)
        for specimens in (False, True):
            add(f"stepped shear {name}, 1/min", found, [[2, 6], [1, 5]], specimens=specimens)
    return rows


def clocks(folder: Path) -> list[Row]:
    """Error of a fit to all rates of monotonic shear, with times of the files and with times strain / rate."""
    rows: list[Row] = []
    for name, largest in ((f"to {MODERATE:g}", MODERATE), ("whole", math.inf)):
        for reading, clock in (("as written", True), ("strain / rate", False)):
            tests = _until(monotonic(folder, clock=clock), largest)
            known = [e for those in tests.values() for e in those]
            ends = " ".join(f"{_speed(e)[0]:.2g} to {_speed(e)[1]:.2g};" for e in known).rstrip(";")
            best = min(ladder(known, most=2), key=lambda f: f.bic)
            rows.append(
                {"strain": name, "times": reading, "rates seen [1/s]": ends, "error of fit [%]": 100 * best.error}
            )
    return rows


def silicones(folder: Path) -> list[Row]:
    """Elastic laws fitted to each silicone up to rupture, with intervals.

    They are wide where a law does not follow the curve: its residuals go together, so that they tell little. C30 is 0
    where it would be negative, as the stress would then fall at some stretch. The last two columns are the error of the
    law at stretches up to 2, and what it would be there if it was fitted to them only.
    """
    rows: list[Row] = []
    for path in sorted(folder.glob("*.csv")):
        whole = read(path, rate=pull_rate(path))
        test = whole.part(np.arange(int(whole.stress.argmax()) + 1))
        start = until(test, 2.0)
        for order, law in enumerate(LAWS):
            found = fit([test], order=order)
            rows.append(
                {
                    "material": path.stem,
                    "samples": len(test.time),
                    "left out": len(whole.time) - len(test.time),
                    "stretch": float(test.deformation[-1]),
                    "law": law,
                    "shear modulus [kPa]": _interval(found, "shear", 1e-3),
                    "C20 [kPa]": _interval(found, "C20", 1e-3),
                    "C30 [Pa]": _interval(found, "C30"),
                    "error [%]": 100 * found.error,
                    "to stretch 2 [%]": 100 * found.error_of([start]),
                    "fitted to 2 [%]": 100 * fit([start], order=order).error,
                }
            )
    return rows


def pull_rate(path: Path) -> float:
    """Strain rate [1/s]: cross-head speed over gauge length, from the head of a file.

    Raises:
        ValueError: if the head has no such line.
    """
    head = path.read_text(encoding="utf-8-sig", errors="replace")
    found = []
    for name in (r"Speed \(mm/min\)", r"Length \(mm\)"):
        line = re.search(rf"{name};([0-9.]+);", head)
        if line is None:
            raise ValueError(f"{path}: no line {name.replace(chr(92), '')}, wanted the number after it")
        found.append(float(line[1]))
    return found[0] / found[1] / 60


def _until(tests: Mapping[float, Sequence[Experiment]], largest: float) -> dict[float, list[Experiment]]:
    return {rate: [until(e, largest) for e in those] for rate, those in tests.items()}


def _speed(experiment: Experiment) -> tuple[float, float]:
    """Slowest and fastest rate of deformation between samples [1/s], in magnitude."""
    speed = np.abs(np.diff(experiment.deformation) / np.diff(experiment.time))
    return float(speed.min()), float(speed.max())


def _interval(found: Fit, name: str, unit: float = 1.0) -> str:
    """Constant with its interval as text; "?" for bounds more than a factor of 100 apart."""
    interval: Interval | None = found.intervals.get(name)
    if interval is None:
        return "-"
    value, low, high = (unit * v for v in (interval.value, interval.low, interval.high))
    if name not in ("C20", "C30"):
        return f"{value:.3g} (?)" if high > 100 * low else f"{value:.3g} ({low:.3g} to {high:.3g})"
    value = 0.0 if abs(value) < 1e-6 * (high - low) else value  # held at 0, where the law would lose its stability
    return f"{value:.3g} ({low:.3g} to {high:.3g})"


def main(recordings: tyro.conf.Positional[Path]) -> None:
    """Print the tables of the tests that are there.

    Args:
        recordings: Folder of the recordings.
    """
    tables: tuple[tuple[str, str, Callable[[Path], list[Row]]], ...] = (
        (SHEAR_AND_TENSION, "Monotonic shear: which times the three rates agree with", clocks),
        (SHEAR_AND_TENSION, "Fitted on some rates, predicting others: relative errors", shear_and_tension),
        (SILICONES, "Silicones pulled to rupture: laws without viscosity, intervals at 90 %", silicones),
    )
    for name, title, table in tables:
        if (recordings / name).is_dir():
            show(title, table(recordings / name))
        else:
            print(f"\n{title}: skipped, there is no folder {recordings / name}")


if __name__ == "__main__":
    tyro.cli(main)
