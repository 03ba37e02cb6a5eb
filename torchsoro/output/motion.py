"""The recorded motion of a robot in a small file, as a few spatial modes with their amplitudes over time.

Displacements are decomposed by proper orthogonal decomposition of the snapshots (Sirovich, Q. Appl. Math. 45, 1987):
position_s = rest + mean_s + sum_k amplitude_sk mode_k. Whatever is interpolated linearly from the particles, such as a
surface, moves by the same amplitudes.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from torchsoro.design.domain import Chamber, Domain
from torchsoro.output.levelset import as_array
from torchsoro.output.page import check_frames, check_planes
from torchsoro.output.scene import PlaneTuple, Skin, camera_path, plane_extent
from torchsoro.storage import atomic_write

FILE = "motion.npz"
TOLERANCE = 5e-6  # m; root-mean-square error of a coordinate, 1/175 of the spacing of the particles in the paper
MOST_SAMPLES = 240  # of the file; three cycles of the paper's pressure as finely as they are recorded
_VOID = 0.1  # density below which particles follow no material and are not kept


@dataclass(frozen=True)
class Patch:
    """A plane as it is drawn; lengths in mm from the lower corner of the body at rest.

    Attributes:
        axis: That it is normal to.
        side: Side of the robot, +1 or -1.
        corners: [4, 3], in the order of a strip of two triangles.
        ticks: Places [T, 3] of round distances along the travel, on one edge.
        distances: Of the ticks [T].
    """

    axis: int
    side: int
    corners: np.ndarray
    ticks: np.ndarray
    distances: np.ndarray


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """A design and its motion over S samples; see :func:`decompose`, which makes one, and :func:`read_motion`.

    Attributes:
        name: Of the robot.
        domain: The lattice of N particles.
        gamma: Density [N].
        time: Of the samples [S] s, increasing.
        pressure: Gauge pressure [S] Pa.
        shift: Mean displacement of the material [S, 3] m.
        amplitude: Of the modes [S, K].
        modes: Displacement at unit amplitude [K, N, 3] m, without the mean; zero in the void.
        planes: Ground and walls.
        direction: Unit vector of the wanted travel.
        tilt: Angle of the slope whose ground was kept level [degrees].
        period: Of the pressure [s].
    """

    name: str
    domain: Domain
    gamma: np.ndarray
    time: np.ndarray
    pressure: np.ndarray
    shift: np.ndarray
    amplitude: np.ndarray
    modes: np.ndarray
    planes: tuple[PlaneTuple, ...]
    direction: tuple[float, float, float]
    tilt: float
    period: float

    @cached_property
    def rest(self) -> np.ndarray:
        """Positions of the particles at rest [N, 3] m."""
        return as_array(self.domain.positions)

    @property
    def material(self) -> np.ndarray:
        """Which particles were kept: those that are not void, bool [N]."""
        return _material(self.domain, self.gamma)

    def positions(self, samples: Sequence[int] | np.ndarray | slice = slice(None)) -> np.ndarray:
        """Positions of all particles [S, N, 3] m at some of the samples; void moves with the mean of the material."""
        deformation = np.tensordot(self.amplitude[samples], self.modes, axes=1)
        return self.rest + self.shift[samples][:, None] + deformation

    @cached_property
    def center(self) -> np.ndarray:
        """Centre of gravity of the designed material [S, 3] m."""
        weight = self.gamma * as_array(self.domain.design)
        weight = weight / weight.sum()
        return weight @ self.rest + self.shift + self.amplitude @ np.einsum("kni,n->ki", self.modes, weight)

    @property
    def travel(self) -> np.ndarray:
        """Travel of the centre of gravity since the first sample [S] m."""
        return (self.center - self.center[0]) @ np.array(self.direction)

    @cached_property
    def camera(self) -> np.ndarray:
        """Where a camera looks that follows the robot [S, 3] m."""
        return camera_path(self.center, self.direction)

    def at(self, time: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Shift [3] m, amplitudes [K] and pressure [Pa] at a time [s], linear between samples."""
        table = np.column_stack([self.shift, self.amplitude, self.pressure])
        row = np.array([np.interp(time, self.time, column) for column in table.T])
        return row[:3], row[3:-1], float(row[-1])

    def carry(self, points: np.ndarray) -> np.ndarray:
        """Displacement of points of the body at unit amplitude of each mode.

        Args:
            points: At rest [V, 3] m.

        Returns:
            [K, V, 3] m: a point is at ``points + shift + amplitude . modes``.
        """
        skin = Skin(self.domain, points, self.gamma)
        return np.array([skin.matrix @ mode for mode in self.modes]).reshape(-1, len(points), 3)

    @cached_property
    def stage(self) -> tuple[Patch, ...]:
        """Ground and walls, as far as the robot gets."""
        origin, size = np.asarray(self.domain.origin), np.asarray(self.domain.size)
        bounds = 1e3 * np.stack([self.shift.min(axis=0), self.shift.max(axis=0) + size])
        planes = [(axis, 1e3 * (offset - origin[axis]), side) for axis, offset, side in self.planes]
        along = int(np.argmax(np.abs(self.direction)))
        return tuple(_patch(plane, planes, bounds, along) for plane in planes)

    def save(self, path: Path) -> None:
        """Write the motion; the file is there whole or not at all.

        Mode shapes are rounded to :data:`TOLERANCE`, which moves no coordinate by more than a few times as much since
        the amplitudes of a sample are at most one in norm, and are stored as differences between neighbouring
        particles, which compress well.
        """
        whole = np.rint(self.modes[:, self.material] / TOLERANCE)
        differences = np.diff(whole, axis=1, prepend=0.0)
        kind = np.int16 if np.abs(differences).max(initial=0.0) < 2**15 else np.int32
        domain = self.domain
        about = {
            "name": self.name,
            "size": domain.size,
            "particles": domain.particles,
            "origin": domain.origin,
            "chambers": [{"name": c.name, "center": c.center, "size": c.size, "wall": c.wall} for c in domain.chambers],
            "planes": self.planes,
            "direction": self.direction,
            "tilt": self.tilt,
            "period": self.period,
            "step": TOLERANCE,
        }
        with atomic_write(path) as file:
            np.savez_compressed(
                file,
                about=np.array(json.dumps(about)),
                gamma=self.gamma.astype(np.float16),
                time=self.time,
                pressure=self.pressure.astype(np.float32),
                shift=self.shift.astype(np.float32),
                amplitude=self.amplitude.astype(np.float32),
                # Component by component, so that equal bytes come one after the other.
                modes=differences.astype(kind).transpose(0, 2, 1),
            )


def _patch(plane: PlaneTuple, planes: Sequence[PlaneTuple], bounds: np.ndarray, along: int) -> Patch:
    low, high = plane_extent(plane, planes, bounds)
    axis, place, side = plane
    first, second = (a for a in range(3) if a != axis)
    corners = np.zeros((4, 3))
    corners[:, axis] = place
    corners[:, first], corners[:, second] = [low[first], high[first]] * 2, np.repeat([low[second], high[second]], 2)
    distances = np.arange(math.ceil(low[along] / 10) * 10, high[along] + 1e-9, 10.0) if along != axis else np.zeros(0)
    ticks = np.tile(corners[0], (len(distances), 1))
    ticks[:, along] = distances
    return Patch(axis, side, corners, ticks, distances)


def _material(domain: Domain, gamma: np.ndarray) -> np.ndarray:
    return (gamma > _VOID) | as_array(domain.wall) | as_array(domain.gas)


def decompose(
    *,
    name: str,
    domain: Domain,
    gamma: Any,
    frames: Any,
    time: Any,
    pressure: Any,
    planes: Sequence[PlaneTuple] = ((2, 0.0, 1),),
    direction: Sequence[float] = (1.0, 0.0, 0.0),
    tilt: float = 0.0,
    period: float = 0.2,
    tolerance: float = TOLERANCE,
) -> Motion:
    """Decompose a recorded motion into as few modes as describe it.

    Args:
        name: Of the robot.
        domain: The lattice.
        gamma: Density per particle [N].
        frames: Positions of the particles [S, N, 3] m; more than :data:`MOST_SAMPLES` are thinned out evenly.
        time: Of the frames [S] s.
        pressure: Gauge pressure at the frames [S] Pa.
        planes: Ground and walls.
        direction: Unit vector of the travel.
        tilt: Angle of the slope [degrees].
        period: Of the pressure [s].
        tolerance: Root-mean-square error of a coordinate of a particle [m] that modes may be left out for.

    Returns:
        The motion.

    Raises:
        ValueError: for arrays of the wrong shape or not finite, times that do not increase, planes that are none.
    """
    check_planes(planes)
    recorded = as_array(frames)
    count = len(recorded) if recorded.ndim else 0
    drawn = np.unique(np.linspace(0, max(count - 1, 0), min(count, MOST_SAMPLES)).round().astype(int))
    moved = check_frames(domain, recorded[drawn] if count else recorded)
    density = as_array(gamma).astype(np.float16).astype(float)  # as in the file
    if density.shape != (domain.count,):
        raise ValueError(f"gamma: got shape {density.shape}, want one density per particle, ({domain.count},)")
    times, supply = (as_array(values).astype(float) for values in (time, pressure))
    for label, values in (("time", times), ("pressure", supply)):
        if values.shape != (count,) or not np.isfinite(values).all():
            raise ValueError(f"{label}: got shape {values.shape}, want one finite number per frame, ({count},)")
    if (np.diff(times) <= 0).any():
        raise ValueError("time: got times that do not increase, want increasing times in s")
    kept = _material(domain, density)
    displacement = moved[:, kept] - as_array(domain.positions)[kept]
    shift = displacement.mean(axis=1)
    residual = (displacement - shift[:, None]).reshape(len(drawn), -1)
    # Method of snapshots: eigenvectors of the Gram matrix, the largest first; what is left out is told by the others.
    energy, basis = np.linalg.eigh(residual @ residual.T)
    energy, basis = energy[::-1].clip(0), basis[:, ::-1]
    remaining = np.sqrt(np.append(np.cumsum(energy[::-1])[::-1], 0.0) / max(residual.size, 1))
    modal = int(np.argmax(remaining <= tolerance))
    modes = np.zeros((modal, domain.count, 3))
    modes[:, kept] = (basis[:, :modal].T @ residual).reshape(modal, -1, 3)
    x, y, z = (float(component) for component in direction)
    return Motion(
        name=name,
        domain=domain,
        gamma=density,
        time=times[drawn],
        pressure=supply[drawn],
        shift=shift,
        amplitude=basis[:, :modal],
        modes=modes,
        planes=tuple((axis, float(offset), side) for axis, offset, side in planes),
        direction=(x, y, z),
        tilt=float(tilt),
        period=float(period),
    )


def read_motion(path: str | os.PathLike[str]) -> Motion:
    """Read what :meth:`Motion.save` wrote.

    Args:
        path: The file, or the folder that holds it as ``motion.npz``.

    Raises:
        ValueError: if there is no such file, or it is no motion.
    """
    file = Path(path) / FILE if Path(path).is_dir() else Path(path)
    if not file.is_file():
        raise ValueError(
            f"path: there is no {file}, wanted the motion of a finished run; recipes/replay.py simulates the robot "
            f"again and writes it to its --out"
        )
    try:
        with file.open("rb") as opened, np.load(opened, allow_pickle=False) as stored:
            about = json.loads(str(stored["about"]))
            arrays = {key: stored[key] for key in ("gamma", "time", "pressure", "shift", "amplitude", "modes")}
        chambers = tuple(Chamber(**{k: _tuple(v) for k, v in c.items()}) for c in about["chambers"])
        size, particles, origin = (_tuple(about[key]) for key in ("size", "particles", "origin"))
        domain = Domain(size=size, particles=particles, origin=origin, chambers=chambers)
        gamma = arrays["gamma"].astype(float)
        differences = arrays["modes"].transpose(0, 2, 1)
        modes = np.zeros((len(differences), domain.count, 3))
        modes[:, _material(domain, gamma)] = np.cumsum(differences, axis=1, dtype=np.int64) * about["step"]
        samples = len(arrays["time"])
        shapes = {"pressure": (samples,), "shift": (samples, 3), "amplitude": (samples, len(modes))}
        for key, shape in shapes.items():
            if arrays[key].shape != shape:
                raise ValueError(f"{key} of shape {arrays[key].shape} for {shape}")
    except Exception as error:  # a damaged file can fail in any way
        raise ValueError(f"path: {file} holds no motion, or is damaged; wanted what a finished run wrote") from error
    return Motion(
        name=about["name"],
        domain=domain,
        gamma=gamma,
        time=arrays["time"].astype(float),
        pressure=arrays["pressure"].astype(float),
        shift=arrays["shift"].astype(float),
        amplitude=arrays["amplitude"].astype(float),
        modes=modes,
        planes=tuple(_tuple(plane) for plane in about["planes"]),
        direction=_tuple(about["direction"]),
        tilt=float(about["tilt"]),
        period=float(about["period"]),
    )


def _tuple(value: Any) -> Any:
    """JSON's lists as tuples."""
    return tuple(value) if isinstance(value, list) else value
