"""From the optimised density to a part for the printer.

The density on the particle lattice becomes one level-set function on a finer grid. Chamber wall, cavity, air port and
thickness offset are set operations on that function, and the surface is extracted once at the end. No triangle mesh is
ever cut by another one, so the result cannot leak.

The density between the particles is the quadratic B-spline of their values, the one that the simulator transfers with.
It keeps flat faces and sheets one particle thick at their true thickness. Wall and cavity are taken from the nearest
particle, so their planes lie exactly on the region boundaries, and the outside of the body lies on the box, half a
spacing outside of the outermost particle centres.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import ndimage

from torchsoro.design.domain import check_port
from torchsoro.design.limits import points_across
from torchsoro.design.port import AirPort
from torchsoro.output import levelset, mend, thickness
from torchsoro.output.levelset import as_array
from torchsoro.output.part import Mended, Part, PartReport
from torchsoro.output.port import away_from_ports, with_sleeve

if TYPE_CHECKING:
    from torchsoro.design.domain import Domain


def fabricate(
    domain: Domain,
    gamma: Any,
    *,
    density: float,
    level: float = 0.5,
    offset: float = 0.0,
    port: AirPort | None = None,
    minimum_thickness: float | None = None,
    min_wall: float = 0.0,
    refine: int | None = None,
) -> Part:
    """Turn a density field into one closed, printable body.

    The chamber wall is always solid and the cavity always hollow, whatever ``gamma`` says there. Pieces that are not
    connected to the
    chamber wall are removed and reported (the paper removed one by hand). The offset grows the outer surface along
    its normal, as the paper did for the climber by 0.4375 mm; the cavity keeps its size.

    Args:
        domain: the lattice, with wall and gas.
        gamma: density per particle, 0 (void) to 1 (material), shape [N].
        density: of the material [kg/m^3].
        level: density at the surface; the paper uses 0.5.
        offset: how far the outer surface is moved outwards [m].
        port: the air port; None leaves the cavity closed.
        minimum_thickness: the thinnest wall that the printer can make [m]; None only reports it.
        min_wall: thickness up to which thin walls are mended, within the box of the body grown by the offset, and the
            port gets a sleeve, if that is not enough [m]; 0 leaves them as they are (see :mod:`torchsoro.output.mend`).
        refine: grid points per particle and axis; None takes about 60 along the longest side, and at least 2; at least
            four across ``min_wall``.

    Returns:
        The part, in mm.

    Raises:
        ValueError: for arguments out of range, for a design without a connected body on the chamber wall, for a port
            that does not fit, for a ``min_wall`` too thin for the grid, and for a wall below ``minimum_thickness``.
    """
    values = _density(domain, gamma)
    _positive("density", density, "kg/m3")
    _check_level(level)
    if not (math.isfinite(offset) and offset >= 0):
        raise ValueError(f"offset: got {offset} m, want 0 or a positive length")
    if minimum_thickness is not None:
        _positive("minimum_thickness", minimum_thickness, "m")
    if refine is not None and not (isinstance(refine, int) and 2 <= refine <= 32):
        raise ValueError(f"refine: got {refine}, want a whole number from 2 to 32")
    if port is not None:
        check_port(domain.chambers, port)
    spacing = float(domain.spacing)
    if not (math.isfinite(min_wall) and min_wall >= 0):
        raise ValueError(f"min_wall: got {min_wall} m, want 0 or a positive length")
    if refine is None:
        refine = max(2, math.ceil(60 / max(domain.particles)))
        if port is not None:  # at least four grid points across the hole
            refine = min(32, max(refine, math.ceil(4 * spacing / port.diameter)))
        if min_wall > 0:
            refine = max(refine, points_across(min_wall, spacing, max(domain.particles)))
    step = spacing / refine
    if port is not None and port.diameter < 2 * step:
        raise ValueError(
            f"port.diameter: got {port.diameter} m, want at least {2 * step:.3g} m, two points of the grid"
        )

    pad = 2 + math.ceil(offset / step)
    body, gas = levelset.body_function(domain, values, level, refine, pad)
    start = np.asarray(domain.origin, dtype=float) - (pad - 0.5) * step  # position of grid point (0, 0, 0)
    fine = levelset.nearest(domain, as_array(domain.wall), refine, pad)
    body, islands = levelset.keep_connected(body, fine, step)
    _check_design(domain, values, level, body, refine, pad)
    if offset > 0:
        body = levelset.grow(body, offset, step)
    if port is not None and port.sleeve > 0:
        body = with_sleeve(domain, port, body, start, step)
    # Equal and opposite on both sides of the cavity's planes, so that the surface lies on them.
    rim = ndimage.binary_dilation(gas, np.ones((3, 3, 3), dtype=bool)) & ~gas
    hole = None if port is None else away_from_ports(domain, port, body.shape, start, step)

    def hollowed(body: np.ndarray) -> tuple[np.ndarray, tuple[float, ...]]:
        shape = np.where(gas, -step / 2, np.where(rim, np.minimum(body, step / 2), body))
        if hole is None:
            return shape, ()
        shape = np.minimum(shape, hole)
        return levelset.keep_connected(shape, fine & ~(shape < 0), step)  # the hole may have cut off a rim

    shape, cut = plain, _ = hollowed(body)
    if min_wall > 0 and mend.thin_walls(plain, min_wall, start, step) is not None:
        taken = gas | levelset.nearest(domain, as_array(domain.outside), refine, pad)
        low = np.asarray(domain.origin, dtype=float) - offset
        high = low + np.asarray(domain.size) + 2 * offset
        free = mend.clearance(taken, low, high, start, step)
        free = free if hole is None else np.minimum(free, hole)

        def mended(body: np.ndarray) -> tuple[np.ndarray, tuple[float, ...]]:
            return hollowed(mend.mend(body, lambda one: hollowed(one)[0], free, min_wall, start, step))

        shape, cut = mended(body)
        if port is not None and mend.thin_walls(shape, min_wall, start, step) is not None:
            # A hole that cuts through limbs leaves shreds, of which mending makes others.
            wide = replace(port, sleeve=max(port.sleeve, min_wall + mend.LARGEST * step))
            shape, cut = mended(with_sleeve(domain, wide, body, start, step))
    islands = islands + cut

    mesh = levelset.march(shape, start, step)
    empty, _ = levelset.pieces(shape <= 0)
    is_open = bool(gas.any() and (empty[gas] == empty[0, 0, 0]).all())
    if port is not None and not is_open:
        raise ValueError(f"port: got {port}, want one that opens every cavity to the outside")
    hollows = np.bincount(empty.ravel())
    known = {0, int(empty[0, 0, 0]), *np.unique(empty[gas]).tolist()}
    lengths, area = thickness.walls(mesh, shape, start, step)
    thinnest = thickness.thinnest(lengths, area, step)
    gap = thickness.thinnest(*thickness.gaps(mesh, shape, start, step), step)
    if minimum_thickness is not None and thinnest < minimum_thickness * 1e3 * (1 - 1e-6):
        raise ValueError(
            f"minimum_thickness: got a thinnest wall of {thinnest * 1e-3:.3g} m, "
            f"want at least {minimum_thickness:.3g} m; "
            f"an offset of {offset + minimum_thickness - thinnest * 1e-3:.3g} m would make it so"
        )
    shells = mesh.split(only_watertight=False)
    volume = float(mesh.volume)
    watertight = bool(mesh.is_watertight)
    report = PartReport(
        mass_g=volume * 1e-9 * density * 1e3,
        volume_mm3=volume,
        size_mm=(float(mesh.extents[0]), float(mesh.extents[1]), float(mesh.extents[2])),
        cavity_volume_mm3=float(as_array(domain.gas).sum()) * (spacing * 1e3) ** 3,
        port_open=is_open,
        islands_removed=tuple(sorted(islands, reverse=True)),
        enclosed_voids=tuple(
            sorted((float(n) * (step * 1e3) ** 3 for i, n in enumerate(hollows) if i not in known), reverse=True)
        ),
        thinnest_wall_mm=thinnest,
        thinnest_gap_mm=gap,
        thickness_percentiles_mm={p: thickness.quantile(lengths, area, p / 100) for p in (1, 5, 25, 50, 75, 95)},
        watertight=watertight,
        manifold=watertight and bool(mesh.is_winding_consistent) and volume > 0,
        bodies=sum(1 for shell in shells if shell.volume > 0),
        euler_number=int(mesh.euler_number),
        port=None if port is None else str(port),
        voxel_mm=step * 1e3,
        mended=None if min_wall == 0 else _mended(min_wall, plain, thinnest, volume, start, step),
    )
    if not report.manifold or report.bodies != 1:
        raise RuntimeError(f"the surface is not one closed body; please report this with the density field:\n{report}")
    return Part(mesh=mesh, report=report, added=_added(domain, plain, shape, refine, pad))


def _mended(
    min_wall: float, plain: np.ndarray, thinnest: float, volume: float, start: np.ndarray, step: float
) -> Mended:
    """What mending did to the part of this level-set function [m], whose wall [mm] and volume [mm3] are now these."""
    before = levelset.march(plain, start, step)
    return Mended(
        min_wall_mm=1e3 * min_wall,
        met=not thinnest < 1e3 * (min_wall - thickness.TOLERANCE * step),
        thinnest_wall_before_mm=thickness.thinnest(*thickness.walls(before, plain, start, step), step),
        volume_mm3=volume - float(before.volume),
        share=volume / float(before.volume) - 1,
    )


def _added(domain: Domain, plain: np.ndarray, shape: np.ndarray, refine: int, pad: int) -> np.ndarray:
    """Share of each particle's cell that is solid in a part and was not in the plain one [N]."""
    new = ((shape > 0) & ~(plain > 0))[pad:-pad, pad:-pad, pad:-pad]
    nx, ny, nz = domain.particles
    return new.reshape(nx, refine, ny, refine, nz, refine).mean(axis=(1, 3, 5)).ravel()


def surface(
    domain: Domain, gamma: Any, level: float = 0.5, *, refine: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The outer surface of a design at rest, for pictures: no port, no check, islands kept, cavity left out.

    Args:
        domain: the lattice.
        gamma: density per particle, shape [N].
        level: density at the surface.
        refine: grid points per particle and axis; None takes 2 for a coarse lattice and 1 for a fine one.

    Returns:
        Vertices [V, 3] in m, in the coordinates of the simulation, and triangles [F, 3], counter-clockwise seen from
        outside.

    Raises:
        ValueError: for a density of the wrong shape, or not finite, and for a level outside (0, 1).
    """
    values = _density(domain, gamma)
    _check_level(level)
    refine = refine or (2 if max(domain.particles) <= 24 else 1)
    body, _ = levelset.body_function(domain, values, level, refine, 2)
    if not (body > 0).any():
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    step = float(domain.spacing) / refine
    mesh = levelset.march(body, np.asarray(domain.origin, dtype=float) - 1.5 * step, step)
    return np.asarray(mesh.vertices) * 1e-3, np.asarray(mesh.faces)


def _positive(name: str, value: float, unit: str) -> None:
    if not (math.isfinite(value) and value > 0):
        raise ValueError(f"{name}: got {value} {unit}, want a positive number")


def _check_level(level: float) -> None:
    if not 0 < level < 1:
        raise ValueError(f"level: got {level}, want a number between 0 and 1")


def _density(domain: Domain, gamma: Any) -> np.ndarray:
    values = as_array(gamma).astype(np.float64)
    if values.shape != (domain.count,):
        raise ValueError(f"gamma: got shape {values.shape}, want one density per particle, ({domain.count},)")
    if not np.isfinite(values).all():
        raise ValueError(f"gamma: got {int((~np.isfinite(values)).sum())} numbers that are not finite, want 0 to 1")
    if values.min() < -1e-3 or values.max() > 1 + 1e-3:
        raise ValueError(f"gamma: got {values.min():.4g} to {values.max():.4g}, want 0 to 1")
    return np.where(as_array(domain.outside), 0.0, values)


def _check_design(domain: Domain, values: np.ndarray, level: float, body: np.ndarray, refine: int, pad: int) -> None:
    """Refuse a design of which nothing hangs on the chamber wall (or, without a chamber, a design that is nothing)."""
    design = as_array(domain.design)
    if not design.any():
        return
    inner = body[pad:-pad, pad:-pad, pad:-pad] > 0
    nx, ny, nz = domain.particles
    kept = inner.reshape(nx, refine, ny, refine, nz, refine).any(axis=(1, 3, 5)).ravel()
    if not (kept & design & (values >= level)).any():
        place = "is connected to the chamber wall" if domain.chambers else "is there"
        raise ValueError(
            f"gamma: got no connected body: of {int((design & (values >= level)).sum())} design particles at or above "
            f"level {level} none {place}, want a design that hangs together (more iterations, or a lower level)"
        )
