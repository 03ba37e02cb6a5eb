"""Thickness of walls and width of gaps of a printable part, by rays through its level-set function.

From the middle of each triangle a ray goes straight inwards, to the next surface: the thickness of the wall there. One
that goes straight outwards and meets the part again has crossed a gap. Pairs of surfaces within 45 degrees of parallel
count: at a sharp rim both tend to zero, which is neither a wall nor a gap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy import ndimage

# Area that is noise of the triangulation, in faces of a voxel; a triangle has about half a face. Measured: the rim of a
# port in a wall of two voxels is 6 % thinner over four of them.
PATCH = 6.0
_STRIDE = 0.5  # along a ray, in grid points
TOLERANCE = 0.02  # what a wall may be thinner than wanted, in grid points: as near as the surface comes to a grid point


def walls(mesh: trimesh.Trimesh, shape: np.ndarray, start: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Thickness of the part behind its triangles.

    Args:
        mesh: Surface [mm].
        shape: Level-set function that it is the zero of [m], positive inside.
        start: Position of grid point (0, 0, 0) [m].
        step: Between grid points [m].

    Returns:
        Thickness [mm], and area [mm2], of the triangles that have one.
    """
    which, length = _rays(mesh, shape, start, step, -np.asarray(mesh.face_normals))
    return 1e3 * length, np.asarray(mesh.area_faces)[which]


@dataclass(frozen=True, kw_only=True)
class Thin:
    """Rays across walls that are thinner than a length.

    Attributes:
        middle: Of each [n, 3] m.
        way: Unit vector along it, from its triangle inwards [n, 3].
        length: [n] m.
        area: Of its triangle [n] mm2.
    """

    middle: np.ndarray
    way: np.ndarray
    length: np.ndarray
    area: np.ndarray


def thin(mesh: trimesh.Trimesh, shape: np.ndarray, start: np.ndarray, step: float, length: float) -> Thin:
    """Where the part is thinner than a length.

    Args:
        mesh: See :func:`walls`.
        shape: See :func:`walls`.
        start: See :func:`walls`.
        step: See :func:`walls`.
        length: [m].
    """
    way = -np.asarray(mesh.face_normals)
    which, found = _rays(mesh, shape, start, step, way, length)
    which, found = which[found < length], found[found < length]
    middle = 1e-3 * np.asarray(mesh.triangles_center)[which] + 0.5 * found[:, None] * way[which]
    return Thin(middle=middle, way=way[which], length=found, area=np.asarray(mesh.area_faces)[which])


def gaps(mesh: trimesh.Trimesh, shape: np.ndarray, start: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Width of the gaps in front of the triangles: between limbs, in a slot, across a cavity or the air port.

    Args:
        mesh: See :func:`walls`.
        shape: See :func:`walls`.
        start: See :func:`walls`.
        step: See :func:`walls`.

    Returns:
        Width [mm], and area [mm2], of the triangles that have one.
    """
    which, length = _rays(mesh, -shape, start, step, np.asarray(mesh.face_normals))
    return 1e3 * length, np.asarray(mesh.area_faces)[which]


def _rays(
    mesh: trimesh.Trimesh,
    shape: np.ndarray,
    start: np.ndarray,
    step: float,
    way: np.ndarray,
    longest: float = math.inf,
) -> tuple[np.ndarray, np.ndarray]:
    """Triangles from whose middles a ray through where the function is positive ends, and its length [m]."""
    at = (np.asarray(mesh.triangles_center) * 1e-3 - start) / step
    limited = np.clip(shape, -step, step) / step
    length = np.full(len(at), np.nan)
    alive = np.flatnonzero(np.asarray(mesh.area_faces) > 0)
    before = np.ones(len(alive))
    most = min(float(np.linalg.norm(shape.shape)), longest / step + 1)
    for k in range(1, 1 + int(most / _STRIDE)):
        if not len(alive):
            break
        place = at[alive] + (k * _STRIDE) * way[alive]
        value = ndimage.map_coordinates(limited, place.T, order=1, mode="nearest")
        out = (value < 0) & (k > 1)
        share = np.clip(before[out] / np.maximum(before[out] - value[out], 1e-12), 0, 1)
        length[alive[out]] = _STRIDE * (k - 1 + share)
        on = ~out & (place >= 0).all(1) & (place <= np.array(shape.shape) - 1).all(1)
        before, alive = np.maximum(value[on], 1e-9), alive[on]
    hit = np.flatnonzero(np.isfinite(length))
    where = at[hit] + length[hit, None] * way[hit]
    ends = [0.5 * np.eye(3)[a] for a in range(3)]
    slope = np.stack(
        [
            ndimage.map_coordinates(limited, (where + e).T, order=1, mode="nearest")
            - ndimage.map_coordinates(limited, (where - e).T, order=1, mode="nearest")
            for e in ends
        ],
        axis=1,
    )
    slope /= np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12)
    facing = -(slope * way[hit]).sum(axis=1) >= math.cos(math.pi / 4)
    return hit[facing], length[hit][facing] * step


def thinnest(lengths: np.ndarray, areas: np.ndarray, step: float) -> float:
    """The length [mm] that all but a patch of ``PATCH`` voxel faces of the area exceeds; NaN if nothing counts.

    A share of the whole area would pass over a strut, whatever its thickness: a thousandth of a walker's surface
    is 9 mm2.

    Args:
        lengths: From :func:`walls` or :func:`gaps` [mm].
        areas: Of the same triangles [mm2].
        step: Between grid points [m].
    """
    total = float(areas.sum())
    return quantile(lengths, areas, min(1.0, PATCH * (step * 1e3) ** 2 / total)) if total else math.nan


def quantile(values: np.ndarray, weights: np.ndarray, share: float) -> float:
    """The value below which this share of the weight lies; NaN without values."""
    if not len(values):
        return math.nan
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][min(int(np.searchsorted(total, share * total[-1])), len(order) - 1)])
