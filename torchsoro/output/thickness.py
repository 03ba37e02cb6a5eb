"""Thickness of walls and width of gaps of a printable part, by rays through its level-set function.

From the middle of each triangle a ray goes straight inwards, to the next surface: the thickness of the wall there. One
that goes straight outwards and meets the part again has crossed a gap. Pairs of surfaces within 45 degrees of parallel
count: at a sharp rim both tend to zero, which is neither a wall nor a gap.
"""

from __future__ import annotations

import math

import numpy as np
import trimesh
from scipy import ndimage

# Area that is noise of the triangulation, in faces of a voxel; a triangle has about half a face. Measured: the rim of a
# port in a wall of two voxels is 6 % thinner over four of them.
PATCH = 6.0
_STRIDE = 0.5  # along a ray, in grid points


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
    return _rays(mesh, shape, start, step, -np.asarray(mesh.face_normals))


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
    return _rays(mesh, -shape, start, step, np.asarray(mesh.face_normals))


def _rays(
    mesh: trimesh.Trimesh, shape: np.ndarray, start: np.ndarray, step: float, way: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Length [mm] of rays from the triangles' middles through where the function is positive, and the areas [mm2]."""
    at = (np.asarray(mesh.triangles_center) * 1e-3 - start) / step
    limited = np.clip(shape, -step, step) / step
    length = np.full(len(at), np.nan)
    alive = np.flatnonzero(np.asarray(mesh.area_faces) > 0)
    before = np.ones(len(alive))
    for k in range(1, 1 + int(np.linalg.norm(shape.shape) / _STRIDE)):
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
    return length[hit][facing] * step * 1e3, np.asarray(mesh.area_faces)[hit][facing]


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
