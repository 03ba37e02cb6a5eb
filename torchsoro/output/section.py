"""The surfaces of a design at rest, whole or cut by a plane through its walls and chambers, for views that move."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from trimesh.intersections import slice_faces_plane

from torchsoro.design.domain import Domain
from torchsoro.output.fabricate import surface
from torchsoro.output.levelset import as_array, body_function
from torchsoro.output.scene import box_faces, shows_wall

Mesh = tuple[np.ndarray, np.ndarray]
"""Vertices [V, 3] m and triangles [F, 3]."""


@dataclass(frozen=True)
class Cut:
    """A plane of the undeformed body: what lies beyond it is taken away.

    Attributes:
        axis: That it is normal to (0, 1, 2).
        position: On the axis [m].
        side: +1 keeps what has the smaller coordinate, -1 what has the larger.
    """

    axis: int
    position: float
    side: int = 1


def surfaces(domain: Domain, gamma: np.ndarray, *, cut: Cut | None = None, level: float = 0.5) -> dict[str, Mesh]:
    """Surfaces of a design by what they show.

    Args:
        domain: The lattice.
        gamma: Density [N].
        cut: Plane to cut by; None for the whole body.
        level: Density at the surface.

    Returns:
        Meshes at rest: ``body`` and ``wall`` (outer surface where it shows designed material, and chamber wall),
        ``cavity`` (inner faces of the chambers), and with a cut ``body section`` and ``wall section``, the areas of
        material in the plane.

    Raises:
        ValueError: for a density of the wrong shape.
    """
    vertices, faces = surface(domain, gamma, level)
    on_wall = shows_wall(domain, vertices, faces)
    found = {"body": (vertices, faces[~on_wall]), "wall": (vertices, faces[on_wall]), "cavity": cavities(domain)}
    if cut is not None:
        normal, origin = np.zeros(3), np.zeros(3)
        normal[cut.axis], origin[cut.axis] = -cut.side, cut.position
        # trimesh takes away only what lies beyond by more than its tolerance of 1e-8.
        found = {name: slice_faces_plane(*mesh, normal, origin)[:2] for name, mesh in found.items() if len(mesh[1])}
        found |= _areas(domain, gamma, cut, level)
    return {name: _used(*mesh) for name, mesh in found.items() if len(mesh[1])}


def cavities(domain: Domain, inset: float | None = None, cuts: int = 8) -> Mesh:
    """The inner faces of all chambers, or with ``inset`` [m] the faces of their walls, drawn in by so much."""
    if not domain.chambers:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    boxes = [
        box_faces(np.asarray(c.center), np.asarray(c.size) - 2 * (c.wall if inset is None else inset), cuts)
        for c in domain.chambers
    ]
    corners = np.concatenate(boxes).reshape(-1, 3)
    vertices, index = np.unique(np.round(corners, 9), axis=0, return_inverse=True)
    quads = index.reshape(-1, 4)
    return vertices, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _areas(domain: Domain, gamma: np.ndarray, cut: Cut, level: float) -> dict[str, Mesh]:
    """Where the plane meets designed material, and where chamber wall, as triangles on a grid of half spacings."""
    refine = 2 if max(domain.particles) <= 24 else 1
    values, _ = body_function(domain, as_array(gamma).astype(float), level, refine, 2)
    spacing, origin = float(domain.spacing), np.asarray(domain.origin)
    u, v = (axis for axis in range(3) if axis != cut.axis)
    ticks = [np.arange(2 * domain.particles[axis] + 1) * spacing / 2 for axis in (u, v)]
    grid = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1)
    points = np.full((*grid.shape[:2], 3), cut.position - origin[cut.axis])
    points[..., [u, v]] = grid
    # The grid of the function begins one and a half of its steps outside of the body.
    inside = ndimage.map_coordinates(values, points.reshape(-1, 3).T * refine / spacing + 1.5, order=1, mode="nearest")
    number = np.arange(inside.size).reshape(grid.shape[:2])
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.stack([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)], axis=-2).reshape(-1, 3)
    # With the function as height, the part inside is what lies above zero.
    lifted = np.column_stack([grid.reshape(-1, 2), inside])
    scale = 1e3  # trimesh's tolerance is meant for numbers of order one
    flat, faces, _ = slice_faces_plane(lifted * scale, faces, np.array([0.0, 0.0, 1.0]), np.zeros(3))
    vertices = np.full((len(flat), 3), cut.position)
    vertices[:, [u, v]] = flat[:, :2] / scale + origin[[u, v]]
    middle = vertices[faces].mean(axis=1) if len(faces) else np.zeros((0, 3))
    cell = np.floor((middle - origin) / spacing).astype(int).clip(0, np.array(domain.particles) - 1)
    shape = tuple(domain.particles)
    wall, gas = (as_array(mask).reshape(shape)[tuple(cell.T)] for mask in (domain.wall, domain.gas))
    return {"body section": (vertices, faces[~wall & ~gas]), "wall section": (vertices, faces[wall])}


def _used(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """The mesh without vertices that no triangle uses."""
    used, index = np.unique(faces, return_inverse=True)
    return vertices[used], index.reshape(-1, 3)


def joined(meshes: dict[str, Mesh]) -> tuple[np.ndarray, dict[str, slice]]:
    """All vertices in one array, and where those of each mesh are."""
    ends = list(itertools.accumulate((len(vertices) for vertices, _ in meshes.values()), initial=0))
    places = {name: slice(start, end) for name, (start, end) in zip(meshes, itertools.pairwise(ends), strict=True)}
    return np.concatenate([vertices for vertices, _ in meshes.values()] or [np.zeros((0, 3))]), places
