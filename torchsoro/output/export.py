"""A motion for other programs: a series of VTU files and the .pvd that lists them, as ParaView opens."""

from __future__ import annotations

import os
from pathlib import Path

import meshio
import numpy as np

from torchsoro.output.motion import Motion
from torchsoro.storage import atomic_write, check_folder

# Corners of a hexahedron in VTK's order, as offsets on the lattice.
_CORNERS = np.array(
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], dtype=np.int64
)


def hexahedra(motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """The mesh whose nodes are the particles that are no void.

    Returns:
        Indices of the particles [P], and hexahedra [C, 8] of positions in that list: every eight neighbours on the
        lattice of which none is void.
    """
    kept = motion.material
    shape = motion.domain.shape
    number = np.full(motion.domain.count, -1)
    number[kept] = np.arange(kept.sum())
    lattice = number.reshape(shape)
    nx, ny, nz = (count - 1 for count in shape)
    corners = [lattice[i : i + nx, j : j + ny, k : k + nz].ravel() for i, j, k in _CORNERS]
    cells = np.stack(corners, axis=1)
    return np.flatnonzero(kept), cells[(cells >= 0).all(axis=1)]


def export_vtu(motion: Motion, folder: str | os.PathLike[str]) -> Path:
    """Write the motion as ``<name>_0000.vtu`` and so on, one file for each sample, with ``<name>.pvd``.

    Each file has the positions of the particles as points [m], point data ``displacement`` [m], ``speed`` [m/s] (by
    second-order differences of the recorded samples) and ``density``, and field data ``pressure`` [Pa] and
    ``TimeValue`` [s].

    Args:
        motion: What to write.
        folder: Where to; made if it is missing.

    Returns:
        The .pvd file, which is written last.

    Raises:
        ValueError: if the folder cannot be written to, or the motion has one sample only.
    """
    target = Path(folder)
    if len(motion.time) < 2:
        raise ValueError("motion: got one sample, wanted at least two, of which a speed can be had")
    check_folder("folder", target, [f"{motion.name}.pvd"])
    target.mkdir(parents=True, exist_ok=True)
    kept, cells = hexahedra(motion)
    modes = motion.modes[:, kept]
    speeds = np.gradient(motion.shift, motion.time, axis=0), np.gradient(motion.amplitude, motion.time, axis=0)
    names = []
    for sample, at in enumerate(motion.time):
        displacement = motion.shift[sample] + np.tensordot(motion.amplitude[sample], modes, axes=1)
        velocity = speeds[0][sample] + np.tensordot(speeds[1][sample], modes, axes=1)
        mesh = meshio.Mesh(
            motion.rest[kept] + displacement,
            [("hexahedron", cells)],
            point_data={
                "displacement": displacement.astype(np.float32),
                "speed": np.linalg.norm(velocity, axis=1).astype(np.float32),
                "density": motion.gamma[kept].astype(np.float32),
            },
        )
        names.append(f"{motion.name}_{sample:04d}.vtu")
        _write_vtu(mesh, target / names[-1], {"pressure": motion.pressure[sample], "TimeValue": at})
    lines = [f'    <DataSet timestep="{at:.9g}" file="{name}"/>' for at, name in zip(motion.time, names, strict=True)]
    collection = "\n".join(
        ['<VTKFile type="Collection" version="0.1">', "  <Collection>", *lines, "  </Collection>", "</VTKFile>", ""]
    )
    series = target / f"{motion.name}.pvd"
    with atomic_write(series) as file:
        file.write(collection.encode())
    return series


def _write_vtu(mesh: meshio.Mesh, path: Path, fields: dict[str, float]) -> None:
    """Write a mesh with numbers that belong to it as a whole, which meshio reads but does not write."""
    meshio.write(path, mesh, file_format="vtu")
    arrays = "".join(
        f'<DataArray type="Float64" Name="{name}" NumberOfTuples="1" format="ascii">{float(value)!r}</DataArray>'
        for name, value in fields.items()
    )
    text = path.read_text(encoding="utf-8")
    head, tag, rest = text.partition("<UnstructuredGrid>")
    with atomic_write(path) as file:
        file.write(f"{head}{tag}<FieldData>{arrays}</FieldData>{rest}".encode())
