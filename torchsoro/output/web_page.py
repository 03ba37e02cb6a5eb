"""A motion as one HTML page that opens from disk without a network: surface, cut, pressure, drawn by WebGL 2."""

from __future__ import annotations

import base64
import os
import zlib
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from jinja2.utils import htmlsafe_json_dumps
from markupsafe import Markup
from matplotlib.colors import to_rgb

from torchsoro.output.motion import Motion
from torchsoro.output.scene import BODY, BODY_SECTION, FULL, REST, WALL, WALL_SECTION
from torchsoro.output.section import Mesh, cavities, joined, surfaces
from torchsoro.storage import atomic_write

FILE = "motion.html"
_TEMPLATES = Path(__file__).parent / "templates"
_STEP = 0.01  # mm, to which vertices are rounded


def write_page(motion: Motion, path: str | os.PathLike[str]) -> Path:
    """Write the page; it is there whole or not at all.

    Args:
        motion: What to show.
        path: An .html file.

    Returns:
        The path.

    Raises:
        ValueError: for another suffix, or a folder that does not exist.
    """
    target = Path(path)
    if target.suffix != ".html" or not target.parent.is_dir():
        raise ValueError(f"path: got {str(target)!r}, want an .html file in a folder that exists")
    meshes = _meshes(motion)
    vertices, places = joined(meshes)
    faces = [mesh[1] + places[name].start for name, mesh in meshes.items()]
    modes = motion.carry(vertices)
    origin = np.asarray(motion.domain.origin)
    # Modes weigh as much as their largest amplitude: what is rounded has that factor, what is told is without it.
    largest = np.maximum(np.abs(motion.amplitude).max(axis=0, initial=0.0), 1e-12)
    scaled = 1e3 * largest[:, None, None] * modes
    whole = [_differences(values) for values in (1e3 * (vertices - origin), *scaled)]
    index = np.diff(np.concatenate(faces).ravel(), prepend=0)
    packed = zlib.compress(np.concatenate([index, *whole]).astype("<i4").tobytes(), 9)
    about = _about(motion, meshes, vertices, largest)
    environment = jinja2.Environment(loader=jinja2.FileSystemLoader(_TEMPLATES), autoescape=True)
    text = environment.get_template("motion.html").render(
        name=motion.name,
        about=htmlsafe_json_dumps(about, separators=(",", ":")),
        packed=base64.b64encode(packed).decode(),
        script=Markup((_TEMPLATES / "motion.js").read_text(encoding="utf-8")),
    )
    with atomic_write(target) as file:
        file.write(text.encode())
    return target


def _meshes(motion: Motion) -> dict[str, Mesh]:
    """The outer surface; inside of it the cavities, fronts towards the air, and the outer faces of their walls."""
    meshes = surfaces(motion.domain, motion.gamma)
    if "cavity" in meshes:
        vertices, faces = meshes["cavity"]
        meshes["cavity"] = vertices, faces[:, ::-1]
        # A little inside, so that a wall that nothing covers shows as the outer surface.
        meshes["shell"] = cavities(motion.domain, inset=0.05 * float(motion.domain.spacing))
    return meshes


def _differences(values: np.ndarray) -> np.ndarray:
    """Whole steps [3 * V] from one vertex to the next, component by component; their running sum gives the values."""
    return np.diff(np.rint(values / _STEP), axis=0, prepend=0.0).T.ravel()


def _about(motion: Motion, meshes: dict[str, Mesh], vertices: np.ndarray, largest: np.ndarray) -> dict[str, Any]:
    """What the page is told in words and short lists; lengths in mm from the lower corner of the body at rest."""
    origin = np.asarray(motion.domain.origin)
    looks = {
        "body": (BODY, BODY_SECTION, True),
        "wall": (WALL, BODY_SECTION, True),
        "cavity": (BODY, WALL_SECTION, True),
        "shell": (BODY_SECTION, WALL_SECTION, False),
    }
    parts, start = [], 0
    for name, (_, faces) in meshes.items():
        front, back, lit = looks[name]
        part = {"name": name, "start": start, "count": len(faces), "outer": name in ("body", "wall")}
        parts.append({**part, "front": list(front), "back": list(back), "lit": lit})
        start += len(faces)
    center = (motion.camera - origin) * 1e3
    high = np.asarray(motion.domain.size) * 1e3
    planes = [{"axis": p.axis, "side": p.side, "corners": p.corners.round(3).tolist()} for p in motion.stage]
    ticks = [
        {"text": f"{distance:.0f} mm" if distance == 0 else f"{distance:.0f}", "at": at.round(3).tolist()}
        for distance, at in (pair for p in motion.stage[:1] for pair in zip(p.distances, p.ticks, strict=True))
    ]
    return {
        "vertices": len(vertices),
        "faces": start,
        "modes": len(largest),
        "step": _STEP,
        "time": np.round(motion.time, 5).tolist(),
        "pressure": np.round(motion.pressure * 1e-3, 3).tolist(),
        "travel": np.round(motion.travel * 1e3, 4).tolist(),
        "center": np.round(center.T, 3).tolist(),
        "shift": np.round(motion.shift.T * 1e3, 4).tolist(),
        "amplitude": np.round(motion.amplitude / largest, 5).T.tolist(),
        "middle": np.round(center.mean(axis=0), 3).tolist(),
        "extent": round(float(np.linalg.norm(high)), 3),
        "low": [0.0, 0.0, 0.0],
        "high": high.tolist(),
        "parts": parts,
        "planes": planes,
        "ticks": ticks,
        "colors": {"rest": list(to_rgb(REST)), "full": list(to_rgb(FULL))},
    }
