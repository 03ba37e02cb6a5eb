"""The air port of a part: a round hole from each chamber to the outside, with a sleeve if it is wanted."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from torchsoro.design.domain import Chamber, Domain


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


def check_port(domain: Domain, port: AirPort) -> None:
    """Refuse a port without a chamber, wider than a cavity, or that runs into another chamber.

    Raises:
        ValueError: saying which.
    """
    if not domain.chambers:
        raise ValueError("port: got one for a domain without a chamber, want None")
    across = [a for a in range(3) if a != port.axis]
    for chamber in domain.chambers:
        room = min(chamber.size[a] for a in across) - 2 * chamber.wall
        if port.diameter > room:
            raise ValueError(
                f"port.diameter: got {port.diameter} m, want at most {room:.4g} m, the cavity of {chamber.name!r}"
            )
        for other in domain.chambers:
            if other is not chamber and _runs_into(chamber, other, port):
                raise ValueError(
                    f"port.direction: got {port.direction}, by which the port of {chamber.name!r} "
                    f"runs into chamber {other.name!r}"
                )


def _runs_into(chamber: Chamber, other: Chamber, port: AirPort) -> bool:
    apart = [abs(other.center[a] - chamber.center[a]) for a in range(3)]
    beside = any(apart[a] > (other.size[a] + port.diameter) / 2 for a in range(3) if a != port.axis)
    return not beside and (other.center[port.axis] - chamber.center[port.axis]) * port.direction[port.axis] > 0


def away_from_ports(
    domain: Domain, port: AirPort, shape: tuple[int, ...], start: np.ndarray, step: float
) -> np.ndarray:
    """Distance to the ports, positive outside of them [m]."""
    result = np.full(shape, np.inf)
    for chamber in domain.chambers:
        radial, along = _about(chamber, port, shape, start, step)
        result = np.minimum(result, np.where(along >= 0, radial, np.inf))
    return result


def with_sleeve(domain: Domain, port: AirPort, body: np.ndarray, start: np.ndarray, step: float) -> np.ndarray:
    """The body with a tube around each port, from the chamber to where the last of the body is beside the hole."""
    for chamber in domain.chambers:
        radial, along = _about(chamber, port, body.shape, start, step)
        beside = (body > 0) & (np.abs(radial) <= port.sleeve) & (along >= 0)
        if beside.any():
            end = np.broadcast_to(along, body.shape)[beside].max() + step / 2  # a face of the box, if it reaches one
            tube = np.minimum(np.minimum(port.sleeve - radial, end - along), along + step / 2)
            # Alike on both sides of the box's faces, so that these stay where they are.
            near = np.where(tube > -2 * step, np.clip(body, -step / 2, step / 2), body)
            body = np.maximum(near, tube)
    return body


def _about(
    chamber: Chamber, port: AirPort, shape: tuple[int, ...], start: np.ndarray, step: float
) -> tuple[np.ndarray, np.ndarray]:
    """Distance to the side of a chamber's port, and along it from the chamber's middle [m], that broadcast."""
    axes = [start[a] + step * np.arange(shape[a]) for a in range(3)]
    x = np.meshgrid(*[axes[a] - chamber.center[a] for a in range(3)], indexing="ij", sparse=True)
    radial = np.sqrt(sum(x[a] ** 2 for a in range(3) if a != port.axis)) - port.diameter / 2
    return radial, x[port.axis] * port.direction[port.axis]
