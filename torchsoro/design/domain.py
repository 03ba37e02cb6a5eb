"""The undeformed robot: a body on a regular particle lattice, with air chambers cut into it.

Body and chambers are boxes, or of closed surfaces (``torchsoro.design.mesh``).

Everything is in SI units, z points up, and all positions (the body's, the chambers', a marker's) share one frame.
Particles are numbered with z fastest: ``index = (ix * ny + iy) * nz + iz``.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import itertools
import math
from collections.abc import Sequence
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from torchsoro.design.limits import ROUNDING
from torchsoro.design.mesh import Surface, check_fit, lined
from torchsoro.design.port import AirPort

_ON_PLANE = 1e-6  # how far a chamber face may be from a lattice plane, in particle spacings
_AXES = ("x", "y", "z")
_NOT_GIVEN = (math.nan, math.nan, math.nan)

Box = tuple[tuple[int, int, int], tuple[int, int, int]]  # lower and upper lattice planes


class Region(enum.IntEnum):
    """What a particle is made of."""

    DESIGN = 0
    """Material whose density is designed."""
    WALL = 1
    """Chamber wall: always solid."""
    GAS = 2
    """Air inside a chamber."""
    OUTSIDE = 3
    """Of the lattice, but not of the body, or where an air port passes: always void."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Chamber:
    """A pneumatic actuator: air enclosed in a wall of constant thickness.

    Args:
        name: Name of the chamber, unique within its domain.
        center: Centre of a box in the frame of the body, m; follows from ``shape`` if that is given.
        size: Outer edge lengths of a box, wall included, m; of the box around ``shape`` and its wall.
        wall: Wall thickness, m; around a shape, whole layers of particles of at least that.
        shape: Closed surface of the air in the frame of the body, instead of a box.

    Raises:
        ValueError: A length is not positive and finite, there is no wall, or the wall leaves no room for air.
    """

    name: str
    center: tuple[float, float, float] = _NOT_GIVEN
    size: tuple[float, float, float] = _NOT_GIVEN
    wall: float
    shape: Surface | None = None

    def __post_init__(self) -> None:
        """Check the lengths on their own; their fit on the lattice is the domain's to check."""
        if not isinstance(self.name, str) or not self.name:
            raise ValueError(f"name: got {self.name!r}, want a non-empty string")
        where = f"chamber {self.name!r}"
        if self.shape is not None:
            if not (self.center is _NOT_GIVEN and self.size is _NOT_GIVEN):
                raise ValueError(f"{where}: center, size: got {self.center}, {self.size} with a shape, want neither")
            if not (math.isfinite(self.wall) and self.wall > 0.0):
                raise ValueError(f"{where}: wall: got {self.wall!r} m: a chamber without wall, want a thickness > 0")
            corner, edges = self.shape.origin, self.shape.size
            object.__setattr__(self, "center", tuple(o + e / 2 for o, e in zip(corner, edges, strict=True)))
            object.__setattr__(self, "size", tuple(e + 2 * self.wall for e in edges))
            return
        object.__setattr__(self, "center", _triple(f"{where}: center", self.center))
        object.__setattr__(self, "size", _triple(f"{where}: size", self.size, positive=True))
        if not (math.isfinite(self.wall) and self.wall > 0.0):
            raise ValueError(f"{where}: wall: got {self.wall!r} m: a chamber without wall, want a thickness > 0")
        if 2.0 * self.wall >= min(self.size):
            raise ValueError(
                f"{where}: wall: got {self.wall!r} m, want less than half the smallest outer edge "
                f"({min(self.size)!r} m), so that there is room for air"
            )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Domain:
    """A box filled with a regular lattice of particles, two per axis and grid cell, cell-centred.

    Tensors are made on first use, live on the CPU, and are shared: do not write to them.

    Args:
        size: Edge lengths of the body, m.
        particles: Number of particles along x, y, z. The spacing must come out equal along the three axes.
        origin: Lower corner of the body, m.
        chambers: Air chambers. Every face of a box, inner and outer, lies on a lattice plane; of a shape, the particles
            whose centres lie inside are air.
        body: Closed surface of the body within the box; the whole box if None.
        port: Air port whose way from each chamber to the outside stays free, so that limbs are designed around it;
            None where it may be cut through them afterwards.

    Raises:
        ValueError: A length or count is not positive and finite; the spacing is not cubic; a chamber leaves the body,
            overlaps another, shares its name, or has a face between two lattice planes; the port does not fit the
            chambers.

    Example:
        The paper's walker: a 35 mm cube of 64,000 particles.

        >>> actuator = Chamber(name="air", center=(0.0175, 0.0175, 0.0175), size=(0.0175, 0.0175, 0.0175), wall=0.00175)
        >>> walker = Domain(size=(0.035, 0.035, 0.035), particles=(40, 40, 40), chambers=(actuator,))
        >>> int(walker.gas.sum()), int(walker.wall.sum()), int(walker.design.sum())
        (4096, 3904, 56000)
    """

    size: tuple[float, float, float]
    particles: tuple[int, int, int]
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    chambers: tuple[Chamber, ...] = ()
    body: Surface | None = None
    port: AirPort | None = None

    def __post_init__(self) -> None:
        """Check that body, lattice, chambers and port fit together."""
        object.__setattr__(self, "size", _triple("size", self.size, positive=True))
        object.__setattr__(self, "origin", _triple("origin", self.origin))
        counts = tuple(self.particles)
        if len(counts) != 3 or any(isinstance(n, bool) or not isinstance(n, int) or n < 1 for n in counts):
            raise ValueError(f"particles: got {self.particles!r}, want three whole numbers >= 1")
        object.__setattr__(self, "particles", counts)
        object.__setattr__(self, "chambers", tuple(self.chambers))

        spacings = [length / count for length, count in zip(self.size, counts, strict=True)]
        if max(spacings) - min(spacings) > ROUNDING * max(spacings):
            raise ValueError(
                f"particles: got {counts} on a body of {self.size} m, a spacing of "
                f"{tuple(float(f'{h:.6g}') for h in spacings)} m, want the same spacing along the three axes"
            )
        if self.body is not None:
            check_fit("body", self.body, self.origin, self.size, self.spacing)
        for chamber in self.chambers:
            if not isinstance(chamber, Chamber):
                raise ValueError(f"chambers: got {chamber!r}, want Chamber objects")
            if not self._masks(chamber)[1].any():
                raise ValueError(f"chambers: chamber {chamber.name!r} holds no particle, want more particles")
        for one, other in itertools.combinations(self.chambers, 2):
            if one.name == other.name:
                raise ValueError(f"chambers: got two named {one.name!r}, want unique names")
            if (self._masks(one)[0] & self._masks(other)[0]).any():
                raise ValueError(f"chambers: got {one.name!r} overlapping {other.name!r}, want them apart")
        if self.port is not None:
            check_port(self.chambers, self.port)

    # The lattice ------------------------------------------------------------------------------------------------

    @cached_property
    def spacing(self) -> float:
        """Distance between neighbouring particles, m."""
        return self.size[0] / self.particles[0]

    @property
    def cell(self) -> float:
        """Edge length of a grid cell, two particle spacings, m."""
        return 2.0 * self.spacing

    @property
    def volume(self) -> float:
        """Reference volume of one particle, m^3."""
        return self.spacing**3

    @property
    def shape(self) -> tuple[int, int, int]:
        """Particles along x, y, z."""
        return self.particles

    @property
    def count(self) -> int:
        """Number of particles N."""
        return math.prod(self.particles)

    @cached_property
    def positions(self) -> Tensor:
        """Reference positions, m, float64 [N, 3]."""
        axes = [
            start + (torch.arange(n, dtype=torch.float64) + 0.5) * self.spacing
            for start, n in zip(self.origin, self.particles, strict=True)
        ]
        return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)

    # The regions ------------------------------------------------------------------------------------------------

    @cached_property
    def region(self) -> Tensor:
        """What each particle is made of, a :class:`Region` value, int64 [N]."""
        region = torch.full(self.shape, int(Region.DESIGN), dtype=torch.int64)
        region[~torch.from_numpy(self._filled)] = int(Region.OUTSIDE)
        region[torch.from_numpy(self._ways)] = int(Region.OUTSIDE)
        for chamber in self.chambers:
            shell, cavity = self._masks(chamber)
            region[torch.from_numpy(shell)] = int(Region.WALL)
            region[torch.from_numpy(cavity)] = int(Region.GAS)
        return region.flatten()

    @cached_property
    def chamber(self) -> Tensor:
        """For a gas particle the index of its chamber in ``chambers``, for every other one -1; int32 [N]."""
        chamber = torch.full(self.shape, -1, dtype=torch.int32)
        for index, one in enumerate(self.chambers):
            chamber[torch.from_numpy(self._masks(one)[1])] = index
        return chamber.flatten()

    def shell(self, index: int) -> Tensor:
        """Which particles are the wall of the chamber of this index, bool [N]."""
        whole, cavity = self._masks(self.chambers[index])
        return torch.from_numpy(whole & ~cavity).flatten()

    @cached_property
    def design(self) -> Tensor:
        """Which particles are designed, bool [N]."""
        return self.region == Region.DESIGN

    @cached_property
    def wall(self) -> Tensor:
        """Which particles are chamber wall, bool [N]."""
        return self.region == Region.WALL

    @cached_property
    def gas(self) -> Tensor:
        """Which particles are air, bool [N]."""
        return self.region == Region.GAS

    @cached_property
    def outside(self) -> Tensor:
        """Which particles of the lattice are no part of the body, bool [N]."""
        return self.region == Region.OUTSIDE

    # Views and look-ups -----------------------------------------------------------------------------------------

    def lattice(self, values: Tensor) -> Tensor:
        """View one number per particle as a volume.

        Args:
            values: Numbers in particle order, [..., N].

        Returns:
            The same numbers as [..., nx, ny, nz].

        Raises:
            ValueError: The last axis does not count the particles.
        """
        if values.ndim == 0 or values.shape[-1] != self.count:
            raise ValueError(f"values: got shape {tuple(values.shape)}, want [..., {self.count}]")
        return values.reshape(*values.shape[:-1], *self.shape)

    def nearest(self, points: Tensor, among: Tensor | None = None) -> Tensor:
        """Find the particle nearest to each point of the undeformed body, for example to each marker.

        Of several equally near particles (to 1e-9 squared spacings) the one with the lowest index wins.

        Args:
            points: Positions, m, floating point [P, 3].
            among: Particles that may be chosen, bool [N]; all by default.

        Returns:
            Particle indices, int64 [P], on the CPU.

        Raises:
            ValueError: Wrong shape or dtype, a position that is not finite, or an empty choice.
        """
        if not isinstance(points, Tensor) or points.ndim != 2 or points.shape[1] != 3 or not points.is_floating_point():
            raise ValueError(f"points: got {_describe(points)}, want a floating-point tensor [P, 3]")
        if not bool(torch.isfinite(points).all()):
            raise ValueError("points: got a position that is not finite, want finite coordinates in m")
        if among is None:
            candidates = torch.arange(self.count)
        elif among.dtype != torch.bool or among.shape != (self.count,):
            raise ValueError(f"among: got {_describe(among)}, want a bool tensor [{self.count}]")
        else:
            candidates = among.detach().cpu().nonzero().flatten()
        if candidates.numel() == 0:
            raise ValueError("among: got no particle at all, want at least one to choose from")

        positions = self.positions[candidates]
        indices = torch.empty(len(points), dtype=torch.int64)
        for i, point in enumerate(points.detach().to("cpu", torch.float64)):
            distance = ((positions - point) / self.spacing).square().sum(dim=1)
            # Rounding turns the near-ties of a marker midway between particles into ties, which argmin
            # breaks by order: the choice does not depend on the last bit of the marker's position.
            indices[i] = candidates[distance.round(decimals=9).argmin()]
        return indices

    # Chambers on the lattice ------------------------------------------------------------------------------------

    @cached_property
    def _filled(self) -> np.ndarray:
        """Which particles the body has, bool [nx, ny, nz]."""
        return np.ones(self.shape, bool) if self.body is None else self._inside(self.body)

    @cached_property
    def _ways(self) -> np.ndarray:
        """Particles whose cells the port's holes touch outside of the chambers, about, bool [nx, ny, nz]."""
        found = np.zeros(self.shape, bool)
        if self.port is None:
            return found
        place = self.positions.numpy().reshape(*self.shape, 3)
        across = [a for a in range(3) if a != self.port.axis]
        for chamber in self.chambers:
            off = place - np.array(chamber.center)
            beside = np.hypot(*(off[..., a] for a in across)) < (self.port.diameter + self.spacing) / 2
            found |= beside & (off @ np.array(self.port.direction) > 0)
        return found

    def _inside(self, surface: Surface) -> np.ndarray:
        """Which particles' centres lie inside of a surface, bool [nx, ny, nz]."""
        axes = [start + (np.arange(n) + 0.5) * self.spacing for start, n in zip(self.origin, self.shape, strict=True)]
        return surface.filled(*axes)

    @functools.lru_cache(maxsize=32)  # noqa: B019  # a domain lives as long as its program
    def _masks(self, chamber: Chamber) -> tuple[np.ndarray, np.ndarray]:
        """Particles of a chamber with its wall, and those of its air, bool [nx, ny, nz]; checks that they fit."""
        where = f"chambers: chamber {chamber.name!r}"
        if chamber.shape is None:
            shell, cavity = np.zeros(self.shape, bool), np.zeros(self.shape, bool)
            shell[_slices(self._shell(chamber))] = True
            cavity[_slices(self._cavity(chamber))] = True
        else:
            check_fit(f"{where}: shape", chamber.shape, self.origin, self.size, self.spacing)
            if chamber.wall < self.spacing * (1 - ROUNDING):
                raise ValueError(
                    f"{where}: wall: got {chamber.wall} m, want at least one spacing ({self.spacing:.6g} m)"
                )
            cavity = self._inside(chamber.shape)
            around = lined(cavity, chamber.wall / self.spacing)
            pad = (around.shape[0] - self.shape[0]) // 2
            shell = around[pad:-pad, pad:-pad, pad:-pad]
            if around.sum() > shell.sum():
                raise ValueError(
                    f"{where}: shape: got a wall of {chamber.wall} m that leaves the domain, want it inside"
                )
        if (shell & ~self._filled).any():
            raise ValueError(
                f"{where}: got {int((shell & ~self._filled).sum())} particles outside of the body, want none"
            )
        return shell, cavity

    def _shell(self, chamber: Chamber) -> Box:
        """Lattice planes of the outer faces of a chamber."""
        return self._planes(chamber, 0.0)

    def _cavity(self, chamber: Chamber) -> Box:
        """Lattice planes of the inner faces, between wall and air; checks the chamber against the lattice."""
        (outer_low, outer_high), (low, high) = self._shell(chamber), self._planes(chamber, chamber.wall)
        where = f"chambers: chamber {chamber.name!r}"
        if min(outer_low) < 0 or any(top > n for top, n in zip(outer_high, self.particles, strict=True)):
            upper = tuple(o + s for o, s in zip(self.origin, self.size, strict=True))
            raise ValueError(
                f"{where} with center {chamber.center} and size {chamber.size} m leaves the body, "
                f"want it inside {self.origin} to {upper} m"
            )
        if any(inner <= outer for inner, outer in zip(low, outer_low, strict=True)):
            raise ValueError(f"{where}: wall: got {chamber.wall} m, want at least one spacing ({self.spacing:.6g} m)")
        if any(top <= bottom for bottom, top in zip(low, high, strict=True)):
            raise ValueError(f"{where}: wall: got {chamber.wall} m, want at least one layer of air inside it")
        return low, high

    def _planes(self, chamber: Chamber, inset: float) -> Box:
        """Lattice planes of a chamber shrunk by ``inset`` on every side; refuses faces between two planes."""
        corners: list[tuple[int, ...]] = []
        for side in (-1.0, 1.0):
            planes = []
            for axis in range(3):
                face = chamber.center[axis] + side * (0.5 * chamber.size[axis] - inset)
                exact = (face - self.origin[axis]) / self.spacing
                if abs(exact - round(exact)) > _ON_PLANE:
                    raise ValueError(
                        f"chambers: chamber {chamber.name!r} has a{' wall' if inset else 'n outer'} face at "
                        f"{_AXES[axis]} = {face:.9g} m, {exact:.6g} spacings from the lower face of the body, "
                        f"want a whole number of spacings ({self.spacing:.6g} m)"
                    )
                planes.append(round(exact))
            corners.append(tuple(planes))
        return corners[0], corners[1]  # pyright: ignore[reportReturnType]  # three planes each


def check_port(chambers: Sequence[Chamber], port: AirPort) -> None:
    """Refuse a port without a chamber, wider than a cavity, or that runs into another chamber.

    Raises:
        ValueError: saying which.
    """
    if not chambers:
        raise ValueError("port: got one for a domain without a chamber, want None")
    across = [a for a in range(3) if a != port.axis]
    for chamber in chambers:
        room = min(chamber.size[a] for a in across) - 2 * chamber.wall
        if port.diameter > (1 + ROUNDING) * room:
            raise ValueError(
                f"port.diameter: got {port.diameter} m, want at most {room:.4g} m, the cavity of {chamber.name!r}"
            )
        for other in chambers:
            if other is not chamber and _runs_into(chamber, other, port):
                raise ValueError(
                    f"port.direction: got {port.direction}, by which the port of {chamber.name!r} "
                    f"runs into chamber {other.name!r}"
                )


def _runs_into(chamber: Chamber, other: Chamber, port: AirPort) -> bool:
    apart = [abs(other.center[a] - chamber.center[a]) for a in range(3)]
    beside = any(apart[a] > (other.size[a] + port.diameter) / 2 for a in range(3) if a != port.axis)
    return not beside and (other.center[port.axis] - chamber.center[port.axis]) * port.direction[port.axis] > 0


def _triple(name: str, values: tuple[float, float, float], *, positive: bool = False) -> tuple[float, float, float]:
    """Check three lengths and return them as floats."""
    want = f"three finite lengths{' > 0' if positive else ''} in m"
    try:
        x, y, z = (float(value) for value in values)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: got {values!r}, want {want}") from None
    if not all(math.isfinite(value) and (value > 0.0 or not positive) for value in (x, y, z)):
        raise ValueError(f"{name}: got {values!r}, want {want}")
    return x, y, z


def _slices(box: Box) -> tuple[slice, ...]:
    """The particles of a lattice box."""
    return tuple(slice(low, high) for low, high in zip(*box, strict=True))


def _describe(value: object) -> str:
    """Name the kind of a value for an error message."""
    return f"{value.dtype} {tuple(value.shape)}" if isinstance(value, Tensor) else repr(value)
