"""Recordings that are disturbed by a millionth."""

from __future__ import annotations

import csv
import importlib

import numpy as np
from ringing import SETUP
from test_experiment import experiment

disturbed = importlib.import_module("disturbed")


def read(path):
    with path.open(newline="") as file:
        head, *rows = csv.reader(file)
    return head, np.array([[float(x) if x else np.nan for x in row] for row in rows])


def test_coordinates_are_disturbed_and_times_and_lost_samples_are_not(tmp_path):
    header = "time_s," + ",".join(f"{m}_{a}_m" for m in ("tip", "side") for a in "xyz")
    rows = "\n".join(f"{0.005 * k},0.06,0.01,0.02,,0,0.01" for k in range(40))
    experiment(tmp_path / "bar", SETUP, f"{header}\n{rows}\n")
    copies = []
    for seed in (0, 1, 1, 2):
        disturbed.disturb(tmp_path / "bar", tmp_path / f"copy{len(copies)}", seed)
        copies.append(read(next((tmp_path / f"copy{len(copies)}").rglob("markers.csv"))))
    known, same, once, again, other = read(next((tmp_path / "bar").rglob("markers.csv"))), *copies
    for head, values in copies:
        assert head == known[0]
        assert np.array_equal(values[:, 0], known[1][:, 0])
        assert np.array_equal(np.isnan(values), np.isnan(known[1]))
        assert np.nanmax(np.abs(values - known[1])) < 6e-6 * 0.06
    assert np.array_equal(same[1], known[1], equal_nan=True)
    assert np.array_equal(once[1], again[1], equal_nan=True)
    assert np.nanmax(np.abs(once[1] - other[1])) > 0
