"""Planes that the body cannot pass: ground and walls, with stick or Coulomb friction, and adhesion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, kw_only=True, eq=False)
class Plane:
    """An axis-aligned plane; the body stays on its free side.

    In the updated formulation contact acts on grid nodes on and behind the plane. The grid is laid so that a layer of
    nodes lies on the first plane of each axis, wherever that is; a further plane of the same axis should be a whole
    number of cells away. In the total one it acts on the surface of the body, at any distance of planes.

    Attributes:
        axis: 0, 1 or 2: the plane's normal is x, y or z.
        offset: Where it cuts the axis [m], a number or a tensor [...]; in the updated formulation its gradient
            is that of shifting the grid, and a further plane of the same axis has none.
        side: +1 if the body lies on the positive side, else -1.
        friction: "stick" (no slip while pressed on, the paper's rule) or Coulomb coefficient, number or tensor [...].
        adhesion: Traction that must be overcome to lift off [Pa], which also presses on for friction; number or tensor
            [...].

    Raises:
        ValueError: for an axis, side, friction or adhesion out of range.
    """

    axis: int
    offset: float | Tensor = 0.0
    side: int = 1
    friction: str | float | Tensor = "stick"
    adhesion: float | Tensor = 0.0

    def __post_init__(self) -> None:
        """Check the values."""
        if self.axis not in (0, 1, 2):
            raise ValueError(f"axis = {self.axis!r}: wanted 0 (x), 1 (y) or 2 (z)")
        if self.side not in (1, -1):
            raise ValueError(f"side = {self.side!r}: wanted +1 or -1")
        if isinstance(self.friction, str) and self.friction != "stick":
            raise ValueError(f"friction = {self.friction!r}: wanted 'stick' or a coefficient of at least 0")
        for name in ("friction", "adhesion", "offset"):
            value = getattr(self, name)
            if not isinstance(value, str):
                least = -torch.inf if name == "offset" else 0.0
                number = torch.as_tensor(value).detach()
                if not bool((torch.isfinite(number) & (number >= least)).all()):
                    raise ValueError(f"{name} = {value}: wanted finite{'' if name == 'offset' else ' and at least 0'}")

    @property
    def sticks(self) -> bool:
        """Whether the plane holds what is pressed on it."""
        return isinstance(self.friction, str)

    def numbers(self) -> tuple[float | Tensor, float | Tensor, float | Tensor]:
        """Offset, Coulomb coefficient (0 where it sticks) and adhesion, as kernels take them."""
        return self.offset, 0.0 if isinstance(self.friction, str) else self.friction, self.adhesion


def ground(height: float | Tensor = 0.0, *, friction: str | float | Tensor = "stick") -> Plane:
    """A floor with its normal upward (z).

    Args:
        height: Its height [m].
        friction: See :class:`Plane`.
    """
    return Plane(axis=2, offset=height, friction=friction)


def check_offsets(planes: Sequence[Plane]) -> None:
    """Refuse gradients by the offsets of planes of an axis that do not shift the grid of the updated formulation.

    Raises:
        ValueError: if the offset of a plane requires a gradient, and a plane before it has the same axis.
    """
    for k, plane in enumerate(planes):
        shifts = all(other.axis != plane.axis for other in planes[:k])
        if not shifts and isinstance(plane.offset, Tensor) and plane.offset.requires_grad:
            raise ValueError(
                f"planes: the offset of plane {k} requires a gradient, but in the updated formulation only the first "
                f"plane of axis {plane.axis} has one, wanted an offset without, or the total-Lagrangian formulation"
            )
