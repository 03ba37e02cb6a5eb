"""Mending of a printable part: where a wall is thinner than wanted, its surface is moved outwards.

A wall is thin where a ray from surface to surface (see :mod:`torchsoro.output.thickness`) is shorter than wanted: there
a ball of the wanted diameter does not fit in. It is what a morphological opening by the ball removes, without the rims
and corners that an opening rounds. The middles of these rays are the medial part of the thin walls. Around each, within
such a ball, the part is dilated by what the ray lacks: by half of it on either side, or by more on one side where the
other one is a cavity, a port or the face of the box, which stay as they are. That is: a wall of a chamber grows
outwards, a sole on the ground upwards.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from torchsoro.output import levelset, thickness

# Added to the wanted length in the first pass, in grid points: the triangles of a curved surface cut off up to that
# much. Each pass adds as much again, up to half a voxel with what places are off by.
MARGIN, LARGEST = 0.125, 0.375
PASSES = 8  # at most; measured: four archived robots need three to six
_LOOK = 0.25  # grid points between two looks for room along a ray


def mend(
    body: np.ndarray,
    hollowed: Callable[[np.ndarray], np.ndarray],
    free: np.ndarray,
    length: float,
    start: np.ndarray,
    step: float,
) -> np.ndarray:
    """Thicken the thin walls of a part.

    Args:
        body: Level-set function of its solid with cavities and ports filled [m], positive inside.
        hollowed: Makes the part of the body: cuts cavities and ports.
        free: Distance to what solid must not fill [m]: cavities, ports, what is outside of the box; negative in there.
        length: Wanted thickness of walls [m].
        start: Position of grid point (0, 0, 0) [m].
        step: Between grid points [m].

    Returns:
        The body with thicker walls; itself where none is thin.
    """
    for attempt in range(1, PASSES + 1):
        wall = thin_walls(hollowed(body), length, start, step)
        if wall is None:
            break
        wanted = length / step + min(attempt * MARGIN, LARGEST)
        middle, growth = _placed((wall.middle - start) / step, wall.way, wall.length / step, wanted, free / step)
        if not len(middle):
            break
        body = _dilated(body, middle, growth, wanted, free, step)
    return body


def thin_walls(shape: np.ndarray, length: float, start: np.ndarray, step: float) -> thickness.Thin | None:
    """The walls of a part that are thinner than a length [m]; None if they are no more than noise."""
    wall = thickness.thin(levelset.march(shape, start, step), shape, start, step, length - thickness.TOLERANCE * step)
    return wall if wall.area.sum() > thickness.PATCH * (1e3 * step) ** 2 else None


def clearance(taken: np.ndarray, low: np.ndarray, high: np.ndarray, start: np.ndarray, step: float) -> np.ndarray:
    """Distance to the taken grid points' cells, and to the outside of a box [m], negative in there.

    Args:
        taken: What has to stay free, bool.
        low: Lower corner of the box [m].
        high: Upper corner of the box [m].
        start: Position of grid point (0, 0, 0) [m].
        step: Between grid points [m].
    """
    found = np.full(taken.shape, np.inf)
    if taken.any():
        outside, inside = (np.asarray(ndimage.distance_transform_edt(mask)) for mask in (~taken, taken))
        found = step * np.where(taken, 0.5 - inside, outside - 0.5)
    for axis, count in enumerate(taken.shape):
        at = start[axis] + step * np.arange(count)
        along = np.minimum(at - low[axis], high[axis] - at)
        found = np.minimum(found, along.reshape([-1 if a == axis else 1 for a in range(3)]))
    return found


def _placed(
    middle: np.ndarray, way: np.ndarray, length: np.ndarray, wanted: float, free: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Middles of the walls once they are as thick as wanted, and by how much one side has to grow; in grid points.

    Walls without the room for it are left out.

    Args:
        middle: Of the rays [n, 3].
        way: Unit vectors along them [n, 3].
        length: Of them [n].
        wanted: Thickness.
        free: Distance to what stays free.
    """
    lacks = wanted - length
    room = []
    for side in (-1.0, 1.0):
        found = np.zeros(len(middle))
        on = np.ones(len(middle), dtype=bool)
        for far in np.arange(_LOOK, wanted + _LOOK, _LOOK):
            place = middle + side * (0.5 * length + far)[:, None] * way
            on &= ndimage.map_coordinates(free, place.T, order=1, mode="nearest") >= 0
            found[on] = far
        room.append(found)
    before = np.clip(0.5 * lacks, lacks - room[1], room[0])
    after = lacks - before
    fits = (before >= 0) & (before <= room[0] + _LOOK) & (after <= room[1] + _LOOK)
    return (middle + (0.5 * (after - before))[:, None] * way)[fits], np.maximum(before, after)[fits]


def _dilated(
    body: np.ndarray, middle: np.ndarray, growth: np.ndarray, wanted: float, free: np.ndarray, step: float
) -> np.ndarray:
    """The body grown around the middles, not beyond a ball of the wanted diameter around each, in grid points."""
    # A little larger, so that a wall is as even as the one that was dilated, and not made of balls.
    radius = 0.5 * wanted + 0.5
    reach = radius + 1
    away = np.ones(body.shape, dtype=bool)
    away[tuple(np.rint(middle).astype(int).T)] = False
    near = np.asarray(ndimage.distance_transform_edt(away)) <= reach + 1
    distance, nearest = KDTree(middle).query(np.argwhere(near), distance_upper_bound=reach)
    # The body's function is no distance; distances meet in the right place.
    own = levelset.distances(body, near, step, step * float(growth.max()))
    new = np.full(body.shape, -np.inf)
    by = step * np.append(growth, 0.0)[nearest]
    new[near] = np.minimum(np.minimum(step * (radius - distance), own[near] + by), free[near])
    changed = (new > np.maximum(own, -step) + thickness.TOLERANCE * step) & (own < step)
    around = ndimage.binary_dilation(changed, np.ones((3, 3, 3), dtype=bool))
    return np.where(around, np.maximum(own, new), body)
