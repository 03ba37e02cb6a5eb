"""Moving surfaces and dots as a part of a page: a slider over time, drawn by a short script from numbers beside it."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

SCRIPT = Path(__file__).parent / "templates" / "slider.js"
STEPS = 20000  # in which the extent of all places is divided


@dataclass(frozen=True, kw_only=True, eq=False)
class Moving:
    """What moves in the same frames: a surface, or dots where it has no faces.

    Attributes:
        name: Beside its switch.
        color: As in CSS.
        places: [F, V, 3] m; not a number where it is not known.
        faces: Polygons [Q, 3 or 4]; None for dots.
    """

    name: str
    color: str
    places: np.ndarray
    faces: np.ndarray | None = None


def packed(time: np.ndarray, moving: Sequence[Moving], *, begin: int, azimuth: float) -> dict[str, Any]:
    """What the script draws from: short lists, and places as whole numbers in 16 bits, compressed.

    Args:
        time: Of the frames [F] s.
        moving: What to draw.
        begin: Number of the frame that is shown first.
        azimuth: From where it is looked at first, in degrees as Matplotlib has them.

    Returns:
        JSON's types; lengths in mm.
    """
    whole = 1e3 * np.concatenate([m.places for m in moving], 1)
    low, high = np.nanmin(whole, (0, 1)), np.nanmax(whole, (0, 1))
    step = float((high - low).max()) / STEPS or 1.0
    # One more than any place stands for what is not known; differences between frames compress well.
    steps = np.where(np.isnan(whole), STEPS + 1, np.rint((whole - low) / step)).astype(np.int64)
    differences = np.diff(steps, axis=0, prepend=0).astype("<i2")
    parts, start = [], 0
    for m in moving:
        count = m.places.shape[1]
        faces = None if m.faces is None else m.faces.tolist()
        parts.append({"name": m.name, "color": m.color, "start": start, "count": count, "faces": faces})
        start += count
    return {
        "time": np.round(time, 4).tolist(),
        "begin": begin,
        "azimuth": azimuth,
        "low": low.tolist(),
        "high": high.tolist(),
        "step": step,
        "unknown": STEPS + 1,
        "count": start,
        "parts": parts,
        "packed": base64.b64encode(zlib.compress(differences.tobytes(), 9)).decode(),
    }


def unpacked(data: dict[str, Any]) -> np.ndarray:
    """Places [F, V, 3] mm as the script reads them."""
    differences = np.frombuffer(zlib.decompress(base64.b64decode(data["packed"])), "<i2")
    steps = np.cumsum(differences.astype(np.int64).reshape(len(data["time"]), data["count"], 3), 0)
    return np.where(steps == data["unknown"], np.nan, np.array(data["low"]) + data["step"] * steps)
