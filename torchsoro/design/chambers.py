"""The chambers of a robot: where they lie in the body, where their air ports leave it, what hangs there."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from torchsoro.design.domain import Chamber, Domain, check_port
from torchsoro.design.mesh import UNITS, read_surface
from torchsoro.design.placement import LEAST_CAVITY, Placement
from torchsoro.design.port import AirPort
from torchsoro.design.settings import Settings


def chambers_of(s: Settings, center: tuple[float, float, float]) -> tuple[Chamber, ...]:
    """The chambers of the settings around a place: a surface, one box, or several side by side along an axis.

    Each of several has its share of the cavity's length and a wall of its own all around, so that together they hold
    the air of the one, and their box is longer by two walls for each that is added. The lattice checks their places.

    Raises:
        ValueError: for several chambers of a surface, and for chambers that are designed or whose place is given
            together with what excludes that.
    """
    _check(s)
    if s.chamber_mesh is not None:
        if s.chambers > 1:
            raise ValueError(f"chambers = {s.chambers}: wanted 1 with a chamber_mesh, which is a single chamber")
        return (Chamber(name="chamber", wall=s.wall, shape=read_surface(s.chamber_mesh, UNITS[s.mesh_unit])),)
    if s.chambers == 1:
        return _given(s, (Chamber(name="chamber", center=center, size=s.chamber, wall=s.wall),))
    axis = "xyz".index(s.chamber_axis)
    each = (s.chamber[axis] - 2 * s.wall) / s.chambers + 2 * s.wall
    size = tuple(each if a == axis else edge for a, edge in enumerate(s.chamber))
    made = []
    for k in range(s.chambers):
        shift = (k - (s.chambers - 1) / 2) * each
        place = tuple(c + shift * (a == axis) for a, c in enumerate(center))
        made.append(Chamber(name=f"chamber {k + 1}", center=_triple(place), size=_triple(size), wall=s.wall))
    return _given(s, tuple(made))


def _check(s: Settings) -> None:
    """Refuse box chambers that are given beside a surface, and designed ones with what knows their place before."""
    for name in ("chamber_centers", "chamber_sizes"):
        if s.chamber_mesh is not None and getattr(s, name):
            raise ValueError(f"{name} = {getattr(s, name)} with chamber_mesh = {s.chamber_mesh}: wanted one of them")
    if not s.chamber_design:
        return
    designed = f"chamber_design = {s.chamber_design}"
    for name, wanted in (("chamber_mesh", None), ("body_mesh", None), ("feature", 0.0)):
        if (value := getattr(s, name)) != wanted:
            raise ValueError(f"{designed} with {name} = {value}: wanted one of them left out")
    if s.formulation != "total":
        raise ValueError(
            f"{designed} with formulation = {s.formulation!r}: wanted 'total', whose particles may be partly air"
        )


def check_new(s: Settings, chambers: Sequence[Chamber], port: AirPort) -> None:
    """Refuse of a run that begins what it would tell at its end, or never.

    Raises:
        ValueError: for settings of designed chambers where none are, or a port that runs into another chamber.
    """
    if s.chamber_design:
        return
    usual = {one.name: one.default for one in dataclasses.fields(Settings)}
    for name in ("chamber_edges", "chamber_volume", "chamber_until", "chamber_rate"):
        if getattr(s, name) != usual[name]:
            raise ValueError(
                f"{name} = {getattr(s, name)}: without chamber_design, wanted place or size there, or this left out"
            )
    if s.chamber_mesh is None:
        try:
            check_port(chambers, port)
        except ValueError as error:
            way = "wanted chambers along chamber_axis, which decides on its direction"
            raise ValueError(f"{error}; {way}") from error


def _given(s: Settings, chambers: tuple[Chamber, ...]) -> tuple[Chamber, ...]:
    """The same where the settings say that they lie, and as large as they say."""
    centers = s.chamber_centers or tuple(one.center for one in chambers)
    sizes = s.chamber_sizes or tuple(one.size for one in chambers)
    return tuple(
        Chamber(name=one.name, center=center, size=size, wall=one.wall)
        for one, center, size in zip(chambers, centers, sizes, strict=True)
    )


def placement_of(s: Settings, domain: Domain, symmetry: tuple[str, ...]) -> Placement | None:
    """What of the chambers of the settings is designed; None where all is given.

    Args:
        s: The settings.
        domain: With the chambers to begin with.
        symmetry: Axes along which the body has mirror symmetry.

    Raises:
        ValueError: see :class:`torchsoro.design.placement.Placement`.
    """
    if not s.chamber_design:
        return None
    least, most = s.chamber_edges
    if s.port:
        least = max(least, max(s.port, LEAST_CAVITY * domain.spacing) + 2 * s.wall)
    return Placement(
        domain,
        designed=s.chamber_design,
        symmetry=symmetry,
        axis=s.chamber_axis,
        edges=(least or None, most or None),
        cavity=s.port,  # which has to fit into every one
        fixed_volume=s.chamber_volume == "fixed",
    )


def with_chambers(s: Settings, chambers: Sequence[Chamber]) -> Settings:
    """The settings of the same robot with these chambers, which are given."""
    return dataclasses.replace(s, chamber_design=(), **chamber_settings(chambers))


def chamber_settings(chambers: Sequence[Chamber]) -> dict[str, tuple[tuple[float, float, float], ...]]:
    """The settings that say where box chambers lie and how large they are."""
    return {
        "chamber_centers": tuple(one.center for one in chambers),
        "chamber_sizes": tuple(one.size for one in chambers),
    }


def port_of(s: Settings, chambers: tuple[Chamber, ...], travel: tuple[float, float, float]) -> AirPort:
    """From each chamber to the outside: to the rear, which is against the travel, or downward for a climber.

    Where one of several chambers is behind the others, the ports go upward instead, or sideways.
    """
    direction = _triple(tuple(-d for d in travel))
    if s.chambers > 1 and travel["xyz".index(s.chamber_axis)]:
        direction = (0.0, 1.0, 0.0) if s.chamber_axis == "z" else (0.0, 0.0, 1.0)
    cavity = min(edge - 2 * s.wall for one in chambers for edge in one.size)
    return AirPort(direction=direction, diameter=s.port or 0.4 * cavity)


def sockets(domain: Domain, direction: tuple[float, float, float]) -> tuple[Tensor, Tensor]:
    """Particles of each chamber wall's outermost layer in the direction of the air port, where tubes hang.

    Returns:
        Their numbers [n], and the share of the tubes that hangs on each [n]: as much on every chamber.
    """
    along = domain.positions @ domain.positions.new_tensor(direction)
    shares = torch.zeros_like(along)
    for index in range(len(domain.chambers)):
        shell = domain.shell(index)
        outermost = shell & (along > along[shell].max() - 0.5 * domain.spacing)
        shares += outermost / (outermost.sum() * len(domain.chambers))
    found = shares.nonzero().squeeze(1)
    return found, shares[found]


def _triple(values: tuple[float, ...]) -> tuple[float, float, float]:
    x, y, z = values
    return x, y, z
