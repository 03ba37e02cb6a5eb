"""A printable part: a closed surface, what is to be known of it, and its file."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from torchsoro.output import meshfile
from torchsoro.storage import atomic_write

_SUFFIXES = (".stl", ".3mf", ".ply", ".obj")
_AXES = "x, y, z of the simulation; z up"


@dataclass(frozen=True, kw_only=True)
class Mended:
    """What mending did to thin walls.

    Attributes:
        min_wall_mm: the wanted thickness [mm].
        met: whether the thinnest wall is that thick now, to a fiftieth of a voxel.
        thinnest_wall_before_mm: the thinnest wall without mending, on the same grid [mm].
        volume_mm3: material that was added [mm^3].
        share: the same as a share of the material before.
    """

    min_wall_mm: float
    met: bool
    thinnest_wall_before_mm: float
    volume_mm3: float
    share: float

    def __str__(self) -> str:
        """A line for the terminal."""
        return (
            f"walls mended to {self.min_wall_mm:.2f} mm from {self.thinnest_wall_before_mm:.2f} mm"
            f"{'' if self.met else ', NOT MET'}: {self.volume_mm3:.0f} mm3 added, {100 * self.share:.1f} %"
        )


@dataclass(frozen=True, kw_only=True)
class PartReport:
    """What the printer's operator wants to know about a part.

    Attributes:
        mass_g: volume times density [g].
        volume_mm3: volume of the material [mm^3].
        size_mm: edge lengths of the bounding box [mm].
        cavity_volume_mm3: volume of the chambers' cavities at rest, without the port [mm^3].
        port_open: whether air can flow from every cavity to the outside.
        islands_removed: volumes of the isolated pieces that were left out, largest first [mm^3].
        enclosed_voids: volumes of other hollows without an opening, which would trap resin, largest first [mm^3].
        thinnest_wall_mm: the thinnest wall by ray casting [mm]: from each surface triangle straight inwards to the
            next surface. Only pairs of surfaces within 45 degrees of parallel count (a sharp rim is not a wall), and a
            patch of six voxel faces is left out as noise of the triangulation. NaN if nothing counts.
        thinnest_gap_mm: the narrowest gap, straight outwards to the next surface in the same way [mm], cavity and port
            included. NaN if nothing counts.
        thickness_percentiles_mm: the same thickness by surface area: percent to mm.
        watertight: every edge has two triangles.
        manifold: watertight, consistently wound and with positive volume.
        bodies: number of separate solid pieces.
        euler_number: of the surface; 2 for a body that is a ball or a bottle, 2 more for each closed hollow, 2 less
            for each handle.
        port: axis, diameter and sleeve of the air port, in words; None without one.
        voxel_mm: edge length of the grid that the surface was extracted on [mm].
        mended: what was done to thin walls; None if no thickness was asked for.
        units: of the mesh.
        axes: of the mesh.
    """

    mass_g: float
    volume_mm3: float
    size_mm: tuple[float, float, float]
    cavity_volume_mm3: float
    port_open: bool
    islands_removed: tuple[float, ...]
    enclosed_voids: tuple[float, ...]
    thinnest_wall_mm: float
    thinnest_gap_mm: float
    thickness_percentiles_mm: dict[int, float]
    watertight: bool
    manifold: bool
    bodies: int
    euler_number: int
    port: str | None
    voxel_mm: float
    mended: Mended | None = None
    units: str = "mm"
    axes: str = _AXES

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for a JSON file."""
        return asdict(self)

    def __str__(self) -> str:
        """A few lines for the terminal."""
        islands = ", ".join(f"{v:.3g}" for v in self.islands_removed) or "none"
        lines = [
            f"{' x '.join(f'{s:.2f}' for s in self.size_mm)} {self.units} ({self.axes})",
            f"mass {self.mass_g:.2f} g, material {self.volume_mm3:.0f} mm3, cavity {self.cavity_volume_mm3:.0f} mm3",
            f"thinnest wall {self.thinnest_wall_mm:.2f} mm, gap {self.thinnest_gap_mm:.2f} mm (ray casting)",
            f"isolated pieces removed [mm3]: {islands}",
            f"watertight: {self.watertight}, manifold: {self.manifold}, bodies: {self.bodies}, "
            f"air port open: {self.port_open}",
        ]
        if self.mended is not None:
            lines.insert(3, str(self.mended))
        if self.enclosed_voids:
            lines.append(f"closed hollows that trap resin [mm3]: {', '.join(f'{v:.3g}' for v in self.enclosed_voids)}")
        return "\n".join(lines)


@dataclass(frozen=True, kw_only=True)
class Part:
    """A printable part.

    Attributes:
        mesh: closed surface in mm, z up, in the coordinates of the simulation.
        report: mass, thickness and what was checked.
        added: share of each particle's cell that mending filled [N].
    """

    mesh: trimesh.Trimesh = field(repr=False)
    report: PartReport
    added: np.ndarray = field(repr=False)

    @property
    def notes(self) -> dict[str, str]:
        """What a 3MF says of the part beside its mesh."""
        r = self.report
        said = {"port": r.port or "none", "axes": r.axes, "mass": f"{r.mass_g:.3f} g"}
        return said | {"thinnest_wall": f"{r.thinnest_wall_mm:.3f} mm", "thinnest_gap": f"{r.thinnest_gap_mm:.3f} mm"}

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the mesh as .stl (binary, units in the header), .3mf, .ply or .obj; there whole or not at all.

        Raises:
            ValueError: for another suffix or a folder that does not exist.
        """
        path = Path(path)
        if path.suffix.lower() not in _SUFFIXES:
            raise ValueError(f"path: got {str(path)!r}, want a suffix among {', '.join(_SUFFIXES)}")
        if not path.parent.is_dir():
            raise ValueError(f"path: got {str(path)!r}, want a folder that exists")
        data: Any
        suffix = path.suffix.lower()
        if suffix == ".stl":
            data = meshfile.stl(self.mesh, f"torchsoro; units mm; axes {_AXES}")
        elif suffix == ".3mf":
            data = meshfile.threemf(self.mesh, path.stem, self.notes)
        else:
            data = self.mesh.export(file_type=suffix[1:])
        data = data.encode() if isinstance(data, str) else data
        with atomic_write(path) as file:
            file.write(data)
        return path
