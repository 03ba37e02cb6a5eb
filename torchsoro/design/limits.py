"""Limits of pressures and of printed walls, which more than one place checks."""

from __future__ import annotations

import math

_LEAST_STRAIN = 1e-3  # pressure over modulus, below which nothing moves that could be seen
# Grid points across the least wall of a printed part, at least: with fewer a rod would lose a tenth of its diameter.
_ACROSS = 4
_FINEST = 320  # such points along the longest edge: of a cube some gigabytes, and minutes
ROUNDING = 1e-9  # difference of two lengths that are the same but for rounding, relative or in particle spacings


def points_across(min_wall: float, spacing: float, particles: int) -> int:
    """Grid points per particle and axis with which walls are mended up to a thickness [m].

    Args:
        min_wall: The thickness [m].
        spacing: Of the particles [m].
        particles: Along the longest edge.

    Raises:
        ValueError: if the grid would be too fine.
    """
    refine = math.ceil(_ACROSS * spacing / min_wall - ROUNDING)
    if refine * particles > _FINEST:
        least = _ACROSS * spacing / max(1, _FINEST // particles)
        raise ValueError(f"min_wall = {min_wall:g} m: wanted 0, or at least {least:.3g} m for a body of this size")
    return refine


def check_pressure(name: str, largest: float, modulus: float) -> None:
    """Refuse a pressure that does not deform the body, or that no elastomer of this modulus would stand.

    Args:
        name: How to call it in the message.
        largest: Largest magnitude of the pressure [Pa].
        modulus: Young's modulus of the solid [Pa].

    Raises:
        ValueError: if pressure over modulus is below 0.001 or above 100.
    """
    low, high = _LEAST_STRAIN * modulus, 100 * modulus
    if not low <= largest <= high:
        raise ValueError(
            f"{name} = {largest:g} Pa: wanted from {low:.3g} to {high:.3g} Pa on a Young's modulus of {modulus:g} Pa; "
            "80 kPa is 80000, 0.44 MPa is 440000"
        )
