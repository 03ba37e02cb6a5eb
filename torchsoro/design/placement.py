"""Place and size of box chambers as parameters of the design, and what they make of each particle of the lattice.

A chamber is a box of air in a wall of constant thickness. A particle is air, wall or designed by shares that vary
smoothly with the distances to the faces, so that a gait has a gradient by centre and edges; on lattice planes, with a
narrow transition, the shares are 0 and 1: the regions of :class:`torchsoro.design.domain.Domain`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchsoro.design.domain import Chamber, Domain
from torchsoro.design.limits import ROUNDING

# Width of the transition at a face, in particle spacings. With one or less, a chamber on lattice planes has a gradient
# of zero, as all particles are half a spacing from its faces; with two, walls of one spacing would take 7 % of one from
# the air at each face, instead of 2 %.
TRANSITION = 1.5
SETTLED = 0.5  # the same of chambers that stay on lattice planes: any up to 1 gives shares of 0 and 1
LEAST_CAVITY = 1.0  # edge of a cavity, in particle spacings: the layer of air that a lattice needs
DESIGNED = ("place", "size")
_AXES = ("x", "y", "z")
_HALVINGS = 80  # of the factor by which edges reach a volume: a double's 53 bits, from a factor of e^20
_WIDEST = 20.0  # logarithm of that factor, at most


@dataclass(frozen=True, kw_only=True, eq=False)
class Membership:
    """Shares of air, wall and design in each particle, which sum to 1; float64 [N] on the CPU.

    Attributes:
        air: Of the chambers' air.
        wall: Of the chambers' walls.
        design: Of what is designed. Where there is air there is none of it, and the reverse.
        chamber: The chamber whose air it is, -1 for none; int32 [N].
    """

    air: Tensor
    wall: Tensor
    design: Tensor
    chamber: Tensor

    def to(self, like: Tensor) -> Membership:
        """The same in the type and on the device of a tensor."""
        shares = {name: getattr(self, name).to(like) for name in ("air", "wall", "design")}
        return Membership(**shares, chamber=self.chamber.to(like.device))

    def designed(self, gamma: Tensor) -> Tensor:
        """Density of the designed share of each particle, 0 where it has none.

        Args:
            gamma: Density of the particles [..., N], walls included: their share of it is 1.
        """
        there = self.design > 0
        share = torch.where(there, self.design, 1.0)
        return torch.where(there, (gamma - self.wall) / share, 0.0).clamp(0, 1)

    def intermediate(self, gamma: Tensor) -> Tensor:
        """C of Eq. 15 over the designed shares [...]; see :func:`torchsoro.design.objective.intermediate_density`."""
        density = self.designed(gamma)
        return (self.design * density * (1 - density)).sum(-1) / self.design.sum(-1)


class Placement(nn.Module):
    """Centres and outer edges of box chambers, within the body and apart from each other.

    Both are parameters [chambers, 3] m, float64 on the CPU, on the way bounded by :meth:`clamp_` after each optimizer
    step, as the design variable is. Chambers keep their order along one axis, and the mirror symmetry of the body: a
    chamber on a mid plane stays there, one beside it moves with its image.

    With I the product over the axes of smooth steps at the faces of a box, from 0 outside to 1 inside, and the outer
    boxes' sum taken from 1, that is D, air and design are T(I_cavity - D) and T(D - I_cavity), where T is the smooth
    step from 0 to 1. So they exclude each other, and what is left to one is wall: between them it rises to 1, whatever
    its thickness.

    Args:
        domain: The body, whose chambers are the first ones: boxes, on lattice planes.
        designed: What is designed, of "place" and "size".
        symmetry: Axes along which the body has mirror symmetry.
        axis: Along which several chambers follow each other.
        edges: Least and most outer edge [m]; None for two walls with a cavity between, and the body's edges.
        cavity: Least edge of a cavity [m], kept when faces are rounded, too; ``LEAST_CAVITY`` spacings if that is more.
        fixed_volume: Whether the volume of all cavities together stays that of the first ones.
        transition: Width of the smooth steps, in particle spacings.

    Raises:
        ValueError: There is no chamber, or one of a surface; a name is none of those; an edge is beyond the bounds, or
            these exclude each other; chambers are not in order along the axis, or no mirror images; the body is of a
            surface; the transition is not positive.
    """

    def __init__(
        self,
        domain: Domain,
        *,
        designed: Sequence[str] = DESIGNED,
        symmetry: Sequence[str] = (),
        axis: str = "x",
        edges: tuple[float | None, float | None] = (None, None),
        cavity: float = 0.0,
        fixed_volume: bool = False,
        transition: float = TRANSITION,
    ) -> None:
        super().__init__()
        if unknown := sorted(set(designed) - set(DESIGNED)):
            raise ValueError(f"designed: got {', '.join(unknown)}, want some of {', '.join(DESIGNED)}")
        if not domain.chambers or any(one.shape is not None for one in domain.chambers) or domain.body is not None:
            raise ValueError("domain: got no chamber, or a body or chamber of a surface, want boxes")
        if not (math.isfinite(transition) and transition > 0):
            raise ValueError(f"transition: got {transition!r} spacings, want a positive number")
        self.domain, self.axis, self.fixed_volume = domain, _AXES.index(axis), fixed_volume
        self.width = transition * domain.spacing
        self.walls = torch.tensor([one.wall for one in domain.chambers], dtype=torch.float64).unsqueeze(-1)
        center, size = (
            torch.tensor([getattr(one, name) for one in domain.chambers], dtype=torch.float64)
            for name in ("center", "size")
        )
        # Of a cavity between lattice planes, in spacings.
        self._layers = max(LEAST_CAVITY, float(math.ceil(cavity / domain.spacing - ROUNDING)))
        self.low = torch.tensor(domain.origin, dtype=torch.float64)
        self.high = self.low + torch.tensor(domain.size, dtype=torch.float64)
        self.least, self.most = self._bounds(*edges, size)
        self.images = tuple((_AXES.index(a), self._images(_AXES.index(a), center, size)) for a in symmetry)
        faces = torch.stack([center - size / 2, center + size / 2], -1)[:, self.axis]
        if bool((faces[:-1, 1] > faces[1:, 0] + ROUNDING * domain.spacing).any()):
            raise ValueError(f"axis: got {axis!r}, want one along which the chambers follow each other without overlap")
        self.register_parameter("center", nn.Parameter(center, requires_grad="place" in designed))
        self.register_parameter("size", nn.Parameter(size, requires_grad="size" in designed))
        self.center: nn.Parameter
        self.size: nn.Parameter
        # Whether the chambers stay on lattice planes; part of a checkpoint.
        self.register_buffer("settled", torch.tensor(False))
        self.settled: Tensor
        self.register_load_state_dict_post_hook(_stay)
        self.volume_wanted = float((size - 2 * self.walls).prod(-1).sum())

    def _bounds(self, least: float | None, most: float | None, size: Tensor) -> tuple[Tensor, Tensor]:
        """Least and most outer edges [chambers, 3] m, checked against the first ones."""
        h = self.domain.spacing
        found = 2 * self.walls + LEAST_CAVITY * h if least is None else torch.full_like(self.walls, least)
        lows = found.expand(-1, 3).contiguous()
        highs = (self.high - self.low).expand(len(size), 3).contiguous()
        highs = highs if most is None else highs.clamp(max=most)
        slack = ROUNDING * h
        if bool((lows < 2 * self.walls + LEAST_CAVITY * h - slack).any()) or bool((lows > highs + slack).any()):
            raise ValueError(
                f"edges: got {(least, most)} m, want at least two walls and {LEAST_CAVITY:g} particle spacing "
                f"({float(2 * self.walls.max()) + LEAST_CAVITY * h:.4g} m), and at most the body's {self.domain.size} m"
            )
        if bool(((size < lows - slack) | (size > highs + slack)).any()):
            raise ValueError(
                f"edges: got {(least, most)} m with chambers of {size.tolist()} m, want these from "
                f"{lows.tolist()} to {highs.tolist()} m"
            )
        return torch.minimum(lows, size), torch.maximum(highs, size)  # to the last bit

    def _images(self, axis: int, center: Tensor, size: Tensor) -> list[int]:
        """Of each chamber the one that is its mirror image about the mid plane of an axis."""
        mirrored = center.clone()
        mirrored[:, axis] = self.low[axis] + self.high[axis] - center[:, axis]
        apart = (mirrored[:, None] - center).abs().amax(-1) + (size[:, None] - size).abs().amax(-1)
        if bool((apart.amin(1) > 1e-6 * self.domain.spacing).any()):
            raise ValueError(f"symmetry: got {_AXES[axis]!r}, want chambers that are mirror images along it")
        return apart.argmin(1).tolist()

    def designed(self) -> list[nn.Parameter]:
        """The parameters that are designed."""
        return [one for one in self.parameters() if one.requires_grad]

    # Boxes ------------------------------------------------------------------------------------------------------------

    def boxes(self) -> tuple[Tensor, Tensor]:
        """Centres and outer edges [chambers, 3] m: the parameters, made symmetric and of a volume that is fixed."""
        center, size = self._symmetric(self.center, self.size)
        if self.fixed_volume and not self.settled:
            cavity = size - 2 * self.walls
            size = cavity * (self.volume_wanted / cavity.prod(-1).sum()) ** (1 / 3) + 2 * self.walls
        return center, size

    def volume(self) -> Tensor:
        """Volume of each cavity [chambers] m3."""
        return (self.boxes()[1] - 2 * self.walls).prod(-1)

    def forward(self) -> Membership:
        """Shares of air, wall and design in each particle, with a gradient by centres and edges."""
        center, size = self.boxes()
        cavity = self._inside(center, size / 2 - self.walls)
        free = 1 - self._inside(center, size / 2).sum(0)
        air = _step(cavity - free)
        design = _step(free - cavity.sum(0))
        chamber = torch.where((air > 0).any(0), air.argmax(0), -1)
        whole = air.sum(0)
        return Membership(air=whole, wall=1 - whole - design, design=design, chamber=chamber.to(torch.int32))

    def _inside(self, center: Tensor, half: Tensor) -> Tensor:
        """Smooth indicator of boxes of these half edges [chambers, N]."""
        along, width = [], min(self.width, SETTLED * self.domain.spacing) if self.settled else self.width
        for a, (first, n) in enumerate(zip(self.domain.origin, self.domain.shape, strict=True)):
            off = first + (torch.arange(n, dtype=torch.float64) + 0.5) * self.domain.spacing - center[:, a : a + 1]
            steps = [_step((half[:, a : a + 1] + side * off) / width + 0.5) for side in (-1, 1)]
            along.append(steps[0] * steps[1])
        return torch.einsum("ci,cj,ck->cijk", *along).flatten(1)

    def _symmetric(self, center: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
        """The mean with the mirror images."""
        for axis, images in self.images:
            mirrored = center[images]
            across = torch.arange(3) == axis
            mirrored = torch.where(across, self.low + self.high - mirrored, mirrored)
            center, size = 0.5 * (center + mirrored), 0.5 * (size + size[images])
        return center, size

    # Bounds -----------------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def clamp_(self) -> Placement:
        """Bring the parameters back into their bounds in place, as after each optimizer step; return self.

        Edges are bounded first, chambers that overlap are then moved apart, and all are moved into the body.
        """
        center, size = self._symmetric(self.center, self.size)
        if self.size.requires_grad:
            size = self._of_volume(size) if self.fixed_volume else self._bounded(size)
            self.size.copy_(size)
        if self.designed():
            self.center.copy_(self._apart(torch.clamp(center, self.low + size / 2, self.high - size / 2), size))
        return self

    def _bounded(self, size: Tensor) -> Tensor:
        """Outer edges within their bounds, which along the axis leave room for all chambers."""
        size = torch.clamp(size, self.least, self.most)
        a = self.axis
        beyond, room = size[:, a] - self.least[:, a], self.high[a] - self.low[a] - self.least[:, a].sum()
        if float(beyond.sum()) > float(room):
            size = size.clone()
            size[:, a] = self.least[:, a] + beyond * room / beyond.sum()
        return size

    def _of_volume(self, size: Tensor) -> Tensor:
        """Edges in the same proportion, as far as bounds allow, that enclose the volume that is fixed."""
        low, high, cavity = -_WIDEST, _WIDEST, self._bounded(size) - 2 * self.walls
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            found = self._bounded(math.exp(middle) * cavity + 2 * self.walls)
            more = float((found - 2 * self.walls).prod(-1).sum()) < self.volume_wanted
            low, high = (middle, high) if more else (low, middle)
        return self._bounded(math.exp(high) * cavity + 2 * self.walls)

    def _apart(self, center: Tensor, size: Tensor) -> Tensor:
        """Centres of chambers that do not overlap along the axis, and lie in the body."""
        a, count = self.axis, len(center)
        at, half = center[:, a].tolist(), (size[:, a] / 2).tolist()
        low, high = float(self.low[a]), float(self.high[a])
        for k in range(1, count):  # half of an overlap each, as of mirror images
            lacking = max(0.0, at[k - 1] + half[k - 1] + half[k] - at[k])
            at[k - 1], at[k] = at[k - 1] - lacking / 2, at[k] + lacking / 2
        for k in range(count):
            at[k] = max(at[k], low + half[k] if k == 0 else at[k - 1] + half[k - 1] + half[k])
        for k in reversed(range(count)):
            at[k] = min(at[k], high - half[k] if k == count - 1 else at[k + 1] - half[k + 1] - half[k])
        center = center.clone()
        center[:, a] = torch.tensor(at, dtype=center.dtype)
        return center

    # What becomes of them ---------------------------------------------------------------------------------------------

    @torch.no_grad()
    def rounded(self) -> tuple[Chamber, ...]:
        """The chambers with every face on the nearest lattice plane; half-way, on the inner one if that leaves air.

        Where the volume is fixed, some faces go to the next plane inward instead, if that brings a cavity nearer to its
        volume.
        """
        h, origin = self.domain.spacing, torch.tensor(self.domain.origin, dtype=torch.float64)
        center, size = self.boxes()
        low, high = (center - size / 2 - origin) / h, (center + size / 2 - origin) / h
        first, last = torch.floor(low + 0.5 + ROUNDING), torch.ceil(high - 0.5 - ROUNDING)
        hollow = last - first > 2 * self.walls / h + self._layers - 0.5
        first, last = torch.where(hollow, first, torch.floor(low)), torch.where(hollow, last, torch.ceil(high))
        planes, wanted = torch.stack([first, last], -1), torch.stack([low, high], -1)
        if self.fixed_volume and not self.settled:
            self._near_volume_(planes, wanted)
        made = []
        for one, faces in zip(self.domain.chambers, planes, strict=True):
            x, y, z = (origin + h * faces.mean(-1)).tolist()
            a, b, c = (h * (faces[:, 1] - faces[:, 0])).tolist()
            made.append(Chamber(name=one.name, center=(x, y, z), size=(a, b, c), wall=one.wall))
        return tuple(made)

    def _near_volume_(self, planes: Tensor, wanted: Tensor) -> None:
        """Bring cavities nearer to their volumes by faces that go inward, in place; images stay images.

        Args:
            planes: Of the faces, in spacings [chambers, 3, 2].
            wanted: The same of the chambers before they are rounded.
        """
        inward = torch.stack([torch.ceil(wanted[..., 0] - ROUNDING), torch.floor(wanted[..., 1] + ROUNDING)], -1)
        walls = torch.round(2 * self.walls / self.domain.spacing)
        volume = (wanted[..., 1] - wanted[..., 0] - walls).prod(-1)
        for k, nearest in enumerate(planes.clone()):
            other = next(((axis, images[k]) for axis, images in self.images if images[k] < k), None)
            if other is not None:
                axis, image = other
                planes[k] = planes[image]
                planes[k, axis] = self.domain.shape[axis] - planes[image, axis].flip(0)
                continue
            tied = [axis for axis, images in self.images if images[k] == k]
            best = (math.inf, math.inf)
            for chosen in itertools.product((False, True), repeat=6):
                goes = torch.tensor(chosen).view(3, 2)
                found = torch.where(goes, inward[k], nearest)
                cavity = found[:, 1] - found[:, 0] - walls[k]
                if bool((goes[tied, 0] != goes[tied, 1]).any()) or bool((cavity < self._layers).any()):
                    continue
                off = abs(float(cavity.prod() / volume[k]) - 1)
                rank = (round(off, 9), float((found - wanted[k]).square().sum()))
                if rank < best:
                    best, planes[k] = rank, found

    @torch.no_grad()
    def settle_(self) -> Placement:
        """Round the chambers to lattice planes, in place and for good; return self.

        Nothing is designed from then on, and the shares of the particles are those of the regions, 0 and 1.
        """
        chambers = self.rounded()
        for name in ("center", "size"):
            getattr(self, name).copy_(torch.tensor([getattr(one, name) for one in chambers], dtype=torch.float64))
        self.settled.fill_(True)
        self.requires_grad_(False)
        return self

    def numbers(self) -> dict[str, float]:
        """Centre and outer edges of each chamber [m] as ``center_x_1``, ``size_x_1``, ...; ``volume`` of all [m3]."""
        with torch.no_grad():
            center, size = self.boxes()
            return numbered(center.tolist(), size.tolist()) | {"volume": float(self.volume().sum())}

    @torch.no_grad()
    def blend_(self, other: Mapping[str, Tensor], share: float) -> None:
        """Move in place towards another state by a share of the way."""
        if self.settled:
            return
        for name, one in self.named_parameters():  # centres, too, which growing chambers push
            one.lerp_(other[name].to(one), share)
        self.clamp_()  # between two shapes of a volume that is fixed lies another volume

    def extra_repr(self) -> str:
        """Present values for ``print(placement)``."""
        return ", ".join(f"{name}={one.tolist()} m" for name, one in self.named_parameters())


def _stay(placement: nn.Module, _: object) -> None:
    """Chambers that have settled are not designed, either, once their state has been read."""
    if placement.settled:
        placement.requires_grad_(False)


def numbered(center: Sequence[Sequence[float]], size: Sequence[Sequence[float]]) -> dict[str, float]:
    """Centres and outer edges [m] of chambers by name and number, as ``center_x_1``."""
    return {
        f"{name}_{axis}_{number}": value
        for name, rows in (("center", center), ("size", size))
        for number, row in enumerate(rows, start=1)
        for axis, value in zip(_AXES, row, strict=True)
    }


def _step(u: Tensor) -> Tensor:
    """Smooth step from 0 at 0 to 1 at 1."""
    u = u.clamp(0, 1)
    return u * u * (3 - 2 * u)
