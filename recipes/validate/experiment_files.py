"""Write an experiment that ``explain.py`` reads: ``setup.toml`` and the folders of its trials."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from torchsoro.sim2real.data.from_design import marker_tables
from torchsoro.sim2real.data.recording import write_table


def setup(text: str, markers: Mapping[str, Sequence[float]], noise: float = 5e-5) -> str:
    """Text of setup.toml with the markers and the standard deviation of motion capture noise [m]."""
    return f'{text}\n{marker_tables(markers)}\n[recording]\nkind = "mocap"\nnoise = {noise}\n'


@dataclasses.dataclass(frozen=True, kw_only=True)
class Files:
    """Files of a trial.

    Attributes:
        kept: Whether the trial is held out for prediction.
        markers: Columns of markers.csv.
        pressure: Columns of pressure.csv, if there is one.
        trial: Text of trial.toml, if there is one.
        simulated: Columns of simulated.csv, if there is one.
    """

    kept: bool
    markers: dict[str, np.ndarray]
    pressure: dict[str, np.ndarray] | None = None
    trial: str = ""
    simulated: dict[str, np.ndarray] | None = None


def fresh(out: Path) -> Path:
    """Folder of a new experiment.

    Raises:
        ValueError: if it contains trials already.
    """
    if (out / "trials").exists() or (out / "heldout").exists():
        raise ValueError(f"out = {out}: holds an experiment already, wanted a new folder")
    return out


def write(out: Path, text: str, trials: Mapping[str, Files]) -> None:
    """Write an experiment."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "setup.toml").write_text(text, encoding="utf-8")
    for trial, files in trials.items():
        folder = out / ("heldout" if files.kept else "trials") / trial
        write_table(folder / "markers.csv", files.markers)
        for name, columns in (("pressure", files.pressure), ("simulated", files.simulated)):
            if columns is not None:
                write_table(folder / f"{name}.csv", columns)
        if files.trial:
            (folder / "trial.toml").write_text(files.trial, encoding="utf-8")
