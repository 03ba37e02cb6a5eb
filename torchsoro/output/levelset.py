"""Level-set functions on a grid finer than the particle lattice: positive inside the body, about a distance [m].

Set operations on such functions (union is ``max``, intersection is ``min``) need no triangle mesh, and the surface
is extracted once.
Grid point (0, 0, 0) lies ``pad`` voxels outside of the body; the planes between regions lie half-way between grid
points.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh
from scipy import ndimage
from scipy.spatial import KDTree
from skimage.measure import marching_cubes

if TYPE_CHECKING:
    from torchsoro.design.domain import Domain


def as_array(values: Any) -> np.ndarray:
    """A NumPy view or copy of an array or of a tensor on any device, detached from the graph."""
    if hasattr(values, "detach"):
        values = values.detach().cpu().numpy()
    return np.asarray(values)


def _spline(count: int, refine: int) -> np.ndarray:
    """Quadratic B-spline weights [count * refine, count] to the finer grid; the end particles continue outside."""
    at = (np.arange(count * refine) + 0.5) / refine - 0.5
    weights = np.zeros((count * refine, count))
    rows = np.arange(count * refine)
    for shift in (-1, 0, 1):
        near = np.rint(at).astype(int) + shift
        d = np.abs(at - near)
        np.add.at(weights, (rows, near.clip(0, count - 1)), np.where(d < 0.5, 0.75 - d**2, 0.5 * (1.5 - d) ** 2))
    return weights


def nearest(domain: Domain, mask: np.ndarray, refine: int, pad: int) -> np.ndarray:
    """A mask per particle on the finer grid: the nearest particle decides, and the padding is empty."""
    grid = mask.astype(bool).reshape(domain.particles)
    return np.pad(np.kron(grid, np.ones((refine,) * 3, dtype=bool)), pad)


def body_function(
    domain: Domain, values: np.ndarray, level: float, refine: int, pad: int
) -> tuple[np.ndarray, np.ndarray]:
    """Level-set function [m] of the body with its cavity filled, and the mask of the cavity."""
    spacing = float(domain.spacing)
    step = spacing / refine
    wall, gas = as_array(domain.wall).astype(bool), as_array(domain.gas).astype(bool)
    filled = np.where(wall | gas, 1.0, values).reshape(domain.particles)
    for axis, count in enumerate(domain.particles):
        filled = np.moveaxis(np.tensordot(_spline(count, refine), filled, axes=(1, axis)), 0, axis)
    # A uniform start at gamma = level counts as solid, as in the paper's first frame.
    body = (filled - level + 1e-6) * spacing
    solid = nearest(domain, wall | gas, refine, 0)
    body[solid] = np.maximum(body[solid], step / 2)
    # The mirrored value behind the face puts the zero exactly on the face of the box.
    padded = np.pad(body, 1, mode="edge")
    outside = np.ones(padded.shape, dtype=bool)
    outside[1:-1, 1:-1, 1:-1] = False
    padded[outside] = -np.abs(padded[outside])
    body = np.pad(padded, pad - 1, constant_values=-step)
    return body, nearest(domain, gas, refine, pad)


def pieces(mask: np.ndarray) -> tuple[np.ndarray, int]:
    """Number the connected pieces of a mask from 1 on (0 elsewhere), and count them; neighbours across faces only.

    So one piece of voxels is one piece of surface.
    """
    labels = np.zeros(mask.shape, dtype=np.int32)
    count: Any = ndimage.label(mask, ndimage.generate_binary_structure(3, 1), output=labels)
    return labels, int(count)


def keep_connected(body: np.ndarray, anchor: np.ndarray, step: float) -> tuple[np.ndarray, tuple[float, ...]]:
    """Keep the piece that holds the anchor (without anchor: the largest); also the volumes left out [mm^3]."""
    labels, count = pieces(body > 0)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    if count == 0:
        return body, ()
    held = np.unique(labels[anchor & (body > 0)])
    if len(held) > 1:
        raise ValueError(
            f"gamma: got chamber walls on {len(held)} bodies that no material connects, want one connected body"
        )
    keep = int(held[0]) if len(held) else 1 + int(np.argmax(sizes[1:]))
    gone = (labels != keep) & (labels > 0)
    volumes = tuple(float(sizes[i]) * (step * 1e3) ** 3 for i in range(1, count + 1) if i != keep)
    return np.where(gone, -step / 2, body), volumes


def grow(body: np.ndarray, offset: float, step: float) -> np.ndarray:
    """Grow the body: the true distance to its triangles, wherever the new surface can be."""
    return distances(body, np.ones(body.shape, dtype=bool), step, offset) + offset


def distances(body: np.ndarray, where: np.ndarray, step: float, reach: float) -> np.ndarray:
    """The true distance to the body's triangles [m], positive inside: up to two voxels there, up to a reach outside.

    Args:
        body: The body.
        where: The grid points for which it is asked, bool; others get its sign.
        step: Between grid points [m].
        reach: Outside of the body [m].
    """
    mesh = march(body, np.zeros(3), step)
    corners = np.asarray(mesh.triangles) * 1e-3
    inside = body > 0
    limit = np.where(inside, 2.0 * step, reach + 2.5 * step)
    to_outside, to_inside = (np.asarray(ndimage.distance_transform_edt(mask)) for mask in (inside, ~inside))
    band = where & (to_outside + to_inside <= limit / step)
    points = np.argwhere(band) * step
    _, near = KDTree(corners.mean(axis=1)).query(points, k=min(8, len(corners)))
    distance = np.full(len(points), np.inf)
    for column in np.asarray(near).reshape(len(points), -1).T:
        closest = trimesh.triangles.closest_point(corners[column], points)
        distance = np.minimum(distance, np.linalg.norm(closest - points, axis=1))
    found = np.where(inside, 2.0 * step, -2.0 * step - reach)
    found[band] = np.where(inside[band], distance, -distance)
    return found


def march(values: np.ndarray, start: np.ndarray, step: float) -> trimesh.Trimesh:
    """The zero surface of a function given in m, as a mesh in mm, outward normals."""
    # Keep the surface off the grid points: there it would give triangles without area.
    least = 0.02 * step
    values = np.where(values > 0, np.maximum(values, least), np.minimum(values, -least))
    # Lorensen's table: skimage's Lewiner variant leaves open edges where voxels touch diagonally.
    vertices, faces, _, _ = marching_cubes(values, 0.0, method="lorensen", gradient_direction="ascent")
    return trimesh.Trimesh((vertices * step + start) * 1e3, faces, process=False)
