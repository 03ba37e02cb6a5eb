"""Air ports on the grid of a part: where their holes are, and sleeves around them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from torchsoro.design.port import AirPort

if TYPE_CHECKING:
    from torchsoro.design.domain import Chamber, Domain


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
