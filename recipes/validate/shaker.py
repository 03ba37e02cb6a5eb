"""A mass on a pair of rubber discs on a shaker: transmissibility from a material, in closed form and simulated.

The shaker moves the outer plates of two discs across their axis, and the mass between the discs follows by their shear.
``material_checks.py`` compares with measurements of a rubber whose DMA is known.
"""

from __future__ import annotations

import csv
import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from structures import EXACT, HELD_LENGTH, block

from torchsoro import Plane, PointMass, Prony, Simulator, Solid

AREA = math.pi / 4 * (0.0335**2 - 0.0118**2)  # area of one disc [m2]
THICKNESS = 0.006  # thickness of one disc [m]
RUBBER = 0.0148  # mass of both discs [kg]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Sine:
    """A measured steady-state sweep: frequencies [n] Hz, and acceleration of the mass over that of the base [n]."""

    frequency: np.ndarray
    transmissibility: np.ndarray


def read_sine(path: Path) -> Sine:
    """Read a sweep with the columns freq_hz, base_accel_ms2 and mass_accel_ms2.

    Raises:
        ValueError: if a column is missing.
    """
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    names = ("freq_hz", "base_accel_ms2", "mass_accel_ms2")
    if not rows or not set(names) <= set(rows[0]):
        raise ValueError(f"path: {path} lacks some of the columns {', '.join(names)}")
    frequency, base, mass = (np.array([float(row[name]) for row in rows]) for name in names)
    return Sine(frequency=frequency, transmissibility=mass / base)


def closed_form(storage: np.ndarray, loss: np.ndarray, frequency: np.ndarray, mass: float) -> np.ndarray:
    """Transmissibility |k / (k - m w^2)| of a mass on two discs, k = 2 G* A / h, m with a third of the rubber's mass.

    Args:
        storage: Storage modulus G' at the frequencies [n] Pa.
        loss: Loss modulus G'' at the frequencies [n] Pa.
        frequency: Frequencies [n] Hz.
        mass: Mass of the block between the discs [kg].
    """
    stiffness = 2 * (storage + 1j * loss) * AREA / THICKNESS
    return np.abs(stiffness / (stiffness - (mass + RUBBER / 3) * (2 * math.pi * frequency) ** 2))


def simulated(
    solid: Solid,
    prony: Prony,
    frequency: np.ndarray,
    masses: Sequence[float],
    *,
    across: int = 4,
    width: float = 0.024,
    duration: float = 0.04,
) -> np.ndarray:
    """Simulated transmissibility of a mass between two rubber blocks, in the frame of the shaken base.

    The outer faces are fixed, and a pulse of base acceleration acts as body force on everything else; the
    transmissibility is the ratio of the spectra. Cells between the blocks, 30 times as stiff, carry the mass. The
    blocks have the thickness of the discs; masses are scaled by the ratio of the areas and reduced by 2 % for the
    bending of a block of this width (Rivlin and Saunders: 1 + h^2 / (3 w^2)).

    Args:
        solid: Equilibrium solid of the rubber.
        prony: Maxwell elements of the rubber.
        frequency: Frequencies [n] Hz.
        masses: Masses of the block between the discs [kg], simulated as a batch.
        across: Number of cells through the thickness.
        width: Width of the block [m].
        duration: Duration of the simulation, after which the motion has decayed [s].

    Returns:
        Transmissibility [masses, n].
    """
    cell = THICKNESS / across
    wide = 2 * round(width / cell)
    # Held, rubber, mass, rubber, held; the first node in front of a clamp is held, too: see HELD_LENGTH in structures.
    rubber = block((wide, wide, 4 * across + 12), cell, (-width / 2, -width / 2, -2 * cell), solid)
    above = 2 * THICKNESS + 2 * cell  # the upper clamp's face
    plate = (rubber.position[:, 2] - above / 2).abs() < cell
    middle = torch.nonzero(plate).flatten()
    stiff = torch.where(plate, 30.0, 1.0)
    rubber = dataclasses.replace(rubber, bulk=rubber.bulk * stiff, shear=rubber.shear * stiff)
    acting = THICKNESS - HELD_LENGTH * cell  # the clamp shortens what it holds
    ratio = (wide * cell / 2) ** 2 / acting / (AREA / THICKNESS) / (1 + acting**2 / (3 * width**2))
    carried = torch.tensor([m * ratio for m in masses], dtype=EXACT)
    pulse = 2e-3  # s
    instants = torch.linspace(0, duration, 2001, dtype=EXACT)
    shake = torch.where(instants < pulse, torch.sin(math.pi * instants / pulse) ** 2, torch.zeros_like(instants))
    pull = torch.zeros(len(instants), 3, dtype=EXACT)
    pull[:, 0] = -shake
    simulator = Simulator(cell=cell, dt="auto", low=(-0.1,) * 3, high=(0.1,) * 3, formulation="total")
    with torch.no_grad():
        seen = simulator(
            rubber,
            duration=duration,
            prony=prony,
            gravity=(instants, pull),
            planes=[
                plane
                for i in range(3)
                for plane in (
                    Plane(axis=2, offset=(0.51 - i) * cell, adhesion=1e12),
                    Plane(axis=2, offset=above - (0.51 - i) * cell, side=-1, adhesion=1e12),
                )
            ],
            loads=[PointMass(particles=middle, mass=carried)],
            sample_every=duration / 2000,
            probes=middle,
        )
    moved = (seen.position - seen.position[:, :1])[..., 0].mean(-1).numpy()  # [masses, S]
    base = np.interp(seen.time.numpy(), instants.numpy(), shake.numpy())
    wave = np.exp(-2j * math.pi * np.outer(frequency, seen.time.numpy()))
    answer = -((2 * math.pi * frequency) ** 2) * (wave @ moved.T).T / (wave @ base)
    return np.abs(1 + answer)
