"""What a material is made of, and for which simulation: the options of ``recipes/material.py``."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Literal

import tyro

MOST = 60  # elements of a master curve: more than any data determine


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """What to make a material of, and for which simulation."""

    file: tyro.conf.Positional[Path]
    """Table of frequency sweeps, relaxation or creep tests: text, .xls or .xlsx."""
    out: Path
    """Folder for the material and the report."""
    deformation: Literal["tension", "shear"] | None = None
    """What the moduli resist, where the file does not say."""
    units: dict[str, str] = dataclasses.field(default_factory=dict)
    """Units that the file does not state, such as ``--units frequency Hz storage MPa loss MPa``."""
    columns: dict[str, str] = dataclasses.field(default_factory=dict)
    """Columns that the file does not name, such as ``--columns storage "E prime"``."""
    temperature: float | None = None
    """Of a file without a column of it [deg C]."""
    reference: float | None = None
    """Temperature of the robot [deg C], to which all is shifted; 20 if left out, or the nearest that was measured."""
    vertical: bool = False
    """Shift moduli, too, and not only frequencies."""
    moduli: Literal["both", "storage", "loss"] = "both"
    """Which of a sweep's moduli tell the shifts; an instrument's loss modulus is often off at high stiffness."""
    elements: int | Literal["auto"] = "auto"
    """Maxwell elements of the master curve; auto lets the data decide."""
    equilibrium: float | None = None
    """Equilibrium modulus from another test [Pa], where the data do not reach it."""
    horizon: float = 10.0
    """What takes longer than this to relax counts as permanent [s]."""
    poisson_ratio: float = 0.4
    """Poisson ratio of the simulated solid."""
    density: float = 1070.0
    """Density [kg/m3]."""
    cell: float = 1.75e-3
    """Grid cell of the simulation [m]."""
    dt: float | Literal["auto"] = "auto"
    """Step of the simulation [s]; auto takes half of what the elastic solid alone bears."""
    formulation: Literal["total", "updated"] = "total"
    """Form of the simulator."""
    band: tuple[float, float] = (1.0, 100.0)
    """Lowest and highest frequency that the robot sees [Hz]: from its cycle to its impacts."""

    def __post_init__(self) -> None:
        """Refuse numbers that no stage can use, before any is begun."""
        positive = ("horizon", "density", "cell", "dt", "equilibrium")
        for name in (*positive, "reference", "temperature"):
            value = getattr(self, name)
            if value in ("auto", None):
                continue
            low, wanted = (0.0, "positive") if name in positive else (-273.15, "above -273.15 deg C")
            if not low < value < math.inf:
                raise ValueError(f"{name} = {value}: wanted finite and {wanted}")
        if not 0 <= self.poisson_ratio < 0.5:
            raise ValueError(f"poisson_ratio = {self.poisson_ratio}: wanted at least 0 and less than 0.5")
        if self.elements != "auto" and not 1 <= self.elements <= MOST:
            raise ValueError(f"elements = {self.elements}: wanted 1 to {MOST}, or auto")
        if not 0 < self.band[0] < self.band[1] < math.inf:
            raise ValueError(f"band = {self.band}: wanted a lower and a higher frequency in Hz")
        for name, parts in (("units", self.units), ("columns", self.columns)):
            if not all(parts.values()):
                raise ValueError(f"{name} = {parts}: wanted a name for each quantity")
