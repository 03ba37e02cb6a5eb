"""Closed surfaces from files: where they have flat faces, what lies inside, and whether they fit on a lattice."""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

# trimesh and meshio take a second to import, and most bodies are boxes: whoever needs one imports it. A module that is
# loaded when it is first looked at would be loaded at once, as ``inspect.getmodule`` looks at all.
if TYPE_CHECKING:
    from trimesh import Trimesh


FLAT = 0.999  # cosine of the angle to an axis, above which a triangle lies across it
WIDE = 0.05  # of the area of the body's box across an axis, from which on faces at one place count
UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254}  # [m]; a file of triangles states none
SAMPLES = 400  # points of a surface at which its thickness is measured
THIN = 0.1  # share of them that may be thinner than a lattice spacing: at sharp edges every body is
BESIDE = 0.75  # beyond the wall's thickness [spacings], so that a layer covers edges and corners, too


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """A closed surface.

    Attributes:
        mesh: In m.
    """

    mesh: Trimesh

    @property
    def origin(self) -> tuple[float, float, float]:
        """Lower corner of its box [m]."""
        x, y, z = self.mesh.bounds[0].tolist()
        return x, y, z

    @property
    def size(self) -> tuple[float, float, float]:
        """Edge lengths of its box [m]."""
        x, y, z = self.mesh.extents.tolist()
        return x, y, z

    @functools.cached_property
    def faces(self) -> tuple[list[float], list[float], list[float]]:
        """Where along each axis it has flat faces across it, apart from the ends of its box [m]."""
        normals, areas, middles = self.mesh.face_normals, self.mesh.area_faces, self.mesh.triangles_center
        found: tuple[list[float], list[float], list[float]] = ([], [], [])
        for axis in range(3):
            low, length = self.origin[axis], self.size[axis]
            across = np.abs(normals[:, axis]) > FLAT
            at, area = middles[across, axis], areas[across]
            shares = np.round((at - low) / length, 4)
            for share in np.unique(shares):
                mine = shares == share
                if 0 < share < 1 and area[mine].sum() > WIDE * np.prod(self.size) / length:
                    found[axis].append(float(at[mine].mean()))
        return found

    def filled(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Which points of a lattice lie inside, bool [X, Y, Z]: those with an odd number of surfaces below them.

        Args:
            x: Coordinates [X] m.
            y: Coordinates [Y] m.
            z: Coordinates [Z] m, increasing.
        """
        columns = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
        # A little aside, as a column that meets an edge would meet two triangles.
        start = np.column_stack([columns + 1e-7 * max(self.size), np.full(len(columns), self.origin[2] - 1.0)])
        upwards = np.tile([0.0, 0.0, 1.0], (len(start), 1))
        places, rays, _ = self.mesh.ray.intersects_location(start, upwards, multiple_hits=True)
        found = np.zeros((len(columns), len(z)), bool)
        order = np.argsort(rays, kind="stable")
        heights, rays = places[order, 2], rays[order]
        begins = np.searchsorted(rays, np.arange(len(columns) + 1))
        for k, (begin, end) in enumerate(itertools.pairwise(begins)):
            found[k] = np.searchsorted(np.sort(heights[begin:end]), z) % 2 == 1
        return found.reshape(len(x), len(y), len(z))


def read_surface(path: Path, scale: float = 1.0, origin: tuple[float, float, float] | None = None) -> Surface:
    """Read a closed surface.

    Args:
        path: STL, OBJ or PLY file; or gmsh's .msh, of triangles, or of tetrahedra whose outside is taken.
        scale: Metres for each unit of the file.
        origin: Where the lower corner of its box is to be [m]; where it is in the file if None.

    Raises:
        ValueError: if the file cannot be read, or its surface is not closed.
    """
    try:
        if not path.is_file():
            raise ValueError(f"{path}: no such file, wanted the body's surface")
        return _read(path, path.stat().st_mtime_ns, scale, origin)
    except OSError as error:
        raise ValueError(f"{path}: {error}; wanted the body's surface as STL, OBJ or PLY") from error


@functools.lru_cache(maxsize=4)
def _read(path: Path, _stamp: int, scale: float, origin: tuple[float, float, float] | None) -> Surface:
    import trimesh

    try:
        mesh = _gmsh(path) if path.suffix.lower() == ".msh" else trimesh.load_mesh(path)
    except Exception as error:  # whatever the reader of that format raises
        raise ValueError(f"{path}: {error}; wanted a surface as STL, OBJ, PLY or MSH") from error
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise ValueError(f"{path}: holds no surface, wanted triangles")
    if not mesh.is_watertight:
        raise ValueError(f"{path}: the surface is open, wanted a closed one: repair it where it was drawn")
    mesh.apply_scale(scale)
    if origin is not None:
        mesh.apply_translation(np.array(origin) - mesh.bounds[0])
    return Surface(mesh=mesh)


def _gmsh(path: Path) -> Trimesh:
    """The triangles of a mesh of gmsh, or the faces that only one of its tetrahedra has."""
    import meshio
    import trimesh

    mesh = meshio.read(path)
    faces = mesh.get_cells_type("triangle")
    if not len(faces) and len(tetrahedra := mesh.get_cells_type("tetra")):
        sides = tetrahedra[:, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]].reshape(-1, 3)
        _, first, counts = np.unique(np.sort(sides, axis=1), axis=0, return_index=True, return_counts=True)
        faces = sides[first[counts == 1]]
    return trimesh.Trimesh(mesh.points, faces)


def check_fit(
    name: str, surface: Surface, low: tuple[float, float, float], size: tuple[float, float, float], spacing: float
) -> None:
    """Refuse a surface that a lattice cannot hold.

    Args:
        name: Of the argument, for messages.
        surface: The surface.
        low: Lower corner of the lattice's box [m].
        size: Its edges [m].
        spacing: Between two particles [m].

    Raises:
        ValueError: if the surface is larger than the box, leaves it, or is thinner than a spacing at more than a tenth
            of its area.
    """
    import trimesh

    has = " x ".join(f"{length:.4g}" for length in surface.size)
    box = " x ".join(f"{length:.4g}" for length in size)
    if any(length > edge * (1 + 1e-6) for length, edge in zip(surface.size, size, strict=True)):
        raise ValueError(
            f"{name}: {has} m in a domain of {box} m, wanted one that fits: is the unit of the file right?"
        )
    if max(surface.size) < spacing:
        raise ValueError(
            f"{name}: {has} m in a domain of {box} m, wanted more than its spacing of {spacing:.4g} m: is the file's "
            "unit right?"
        )
    reach = [1e-6 * edge for edge in size]
    for axis, letter in enumerate("xyz"):
        begin, end = surface.origin[axis], surface.origin[axis] + surface.size[axis]
        if begin < low[axis] - reach[axis] or end > low[axis] + size[axis] + reach[axis]:
            raise ValueError(
                f"{name}: from {begin:.4g} to {end:.4g} m along {letter}, wanted within {low[axis]:.4g} to "
                f"{low[axis] + size[axis]:.4g} m, the domain"
            )
    points, faces = trimesh.sample.sample_surface(surface.mesh, SAMPLES, seed=0)[:2]
    inwards = -surface.mesh.face_normals[faces]
    thickness = trimesh.proximity.longest_ray(surface.mesh, points + 1e-6 * max(surface.size) * inwards, inwards)
    thin = float((thickness < spacing).mean())
    if thin > THIN:
        raise ValueError(
            f"{name}: thinner than the spacing of {spacing:.4g} m at {thin:.0%} of its surface, wanted at least that: "
            "take more particles or a thicker shape"
        )


def lined(cavity: np.ndarray, thickness: float) -> np.ndarray:
    """A cavity and a wall around it.

    Args:
        cavity: Which particles are air, bool [X, Y, Z].
        thickness: Of the wall [spacings].

    Returns:
        bool [X + 2 p, Y + 2 p, Z + 2 p], with p = ceil(thickness) + 1 particles more on every side.
    """
    padded = np.pad(cavity, int(np.ceil(thickness)) + 1)
    return np.asarray(ndimage.distance_transform_edt(~padded)) < thickness + BESIDE
