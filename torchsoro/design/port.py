"""The air port of a part: a round hole from each chamber to the outside, with a sleeve if it is wanted."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class AirPort:
    """A straight round hole from the middle of each chamber to the outside.

    Attributes:
        direction: unit vector along a coordinate axis, from the chamber outwards; (-1, 0, 0) is the rear of the walker.
        diameter: of the hole [m].
        sleeve: least thickness of the wall around the hole, as far as it runs beside the body [m]: a tube that is added
            where a hole would leave a thin rim. 0 for none.
    """

    direction: tuple[float, float, float] = (-1.0, 0.0, 0.0)
    diameter: float
    sleeve: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what is not an axis or not a hole."""
        if sorted(abs(float(c)) for c in self.direction) != [0.0, 0.0, 1.0]:
            raise ValueError(f"direction: got {self.direction}, want a unit vector along an axis, such as (-1, 0, 0)")
        if not (math.isfinite(self.diameter) and self.diameter > 0):
            raise ValueError(f"diameter: got {self.diameter} m, want a positive length")
        if not (math.isfinite(self.sleeve) and self.sleeve >= 0):
            raise ValueError(f"sleeve: got {self.sleeve} m, want 0 or a positive length")

    def __str__(self) -> str:
        """In words, for a file."""
        way = ("-" if min(self.direction) < 0 else "+") + "xyz"[self.axis]
        sleeve = f", sleeve {1e3 * self.sleeve:.3f} mm" if self.sleeve else ""
        return f"from each chamber's middle along {way}, diameter {1e3 * self.diameter:.3f} mm{sleeve}"

    @property
    def axis(self) -> int:
        """The coordinate axis of the hole (0, 1 or 2)."""
        return int(np.argmax(np.abs(self.direction)))
