"""What an explanation is asked for; imports nothing that takes long, so that ``--help`` appears at once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro


@dataclass(frozen=True, kw_only=True)
class Options:
    """What to explain."""

    experiment: tyro.conf.Positional[Path | None] = None
    """Folder of the experiment, or the name of one that comes with the package: bar."""
    out: Path
    """Folder for report.html, explanation.json and model.toml; with --predict, the file of the markers."""
    predict: Path | None = None
    """A model.toml, to predict a trial with instead."""
    trial: Path | None = None
    """The trial.toml to predict; with a pressure.csv beside it where the body has a chamber."""
    budget: float = 20.0
    """Time that the explanation may take on two cores, about [minutes]; sets the size of the cells, on any machine."""
    edge: float = 0.0
    """Edge of the cells [m]; 0 for the smallest that the budget allows."""
    walls: int = 1
    """Cells through each wall around a chamber, at least."""
    effects: tuple[str, ...] = ()
    """Names of the effects to consider; the whole library if none is given."""
    device: Literal["cpu", "cuda", "auto"] = "cpu"
    """Where twins are simulated: a GPU takes all variations that are asked for at once, which is of use where they are
    many; "auto" takes one if there is one and the body has so many points."""
    threads: int = 0
    """That simulate side by side; 0 for as many as there are processors."""
