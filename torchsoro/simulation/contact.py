"""Planes that the body cannot pass: ground and walls, with stick or Coulomb friction, and adhesion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from torchsoro.simulation.kernels import layout


@dataclass(frozen=True, kw_only=True, eq=False)
class Plane:
    """A plane; the body stays on its free side.

    In the updated formulation contact acts on grid nodes on and behind the plane. The grid is laid so that a layer of
    nodes lies on the first plane of each axis, wherever that is; a further plane of the same axis should be a whole
    number of cells away. In the total one it acts on the surface of the body, at any distance and slope of planes.

    Attributes:
        axis: 0, 1 or 2: the plane's normal is x, y or z. None for a plane with a ``normal``.
        normal: [..., 3] of any length, to the body's side, numbers or a tensor; total formulation only.
        offset: Where it cuts the axis [m], or how far it is from the origin along its normal; a number or a tensor
            [...]. In the updated formulation its gradient is that of shifting the grid, and a further plane of the same
            axis has none.
        side: +1 if the body lies on the positive side of an axis, else -1.
        friction: "stick" (no slip while pressed on, the paper's rule) or Coulomb coefficient, number or tensor [...].
        static_friction: Coulomb coefficient mu_s at rest, number or tensor [...]; None: no other than ``friction``. If
            given, ``friction`` is mu_k, that of fast sliding, and at a speed v it is
            mu_k + (mu_s - mu_k) / (1 + (v / v_s)^2) with the Stribeck speed v_s; total formulation only.
        stribeck_speed: Speed at which half of that difference is left [m/s], number or tensor [...].
        adhesion: Traction that must be overcome to lift off [Pa], which also presses on for friction; number or tensor
            [...].
        reach: Distance within which adhesion also pulls surfaces that do not touch [m], number or tensor [...] without
            gradient; total formulation only.
        landing: "inelastic", or "elastic"; total formulation only. Nodes that land inelastically stop on the plane and
            lose their energy: a share of the blow that shrinks with the cells. Elastically they meet springs behind the
            plane, with half of a node's mass over the square of the step, and keep energy, but for friction, stick and
            adhesion; under a load they stand a little behind the plane, and without damping they do not come to rest.

    Raises:
        ValueError: for an axis, normal, side, friction, adhesion, reach or landing out of range, or a static friction
            below friction or of a plane that sticks.
    """

    axis: int | None = None
    normal: Sequence[float] | Tensor | None = None
    offset: float | Tensor = 0.0
    side: int = 1
    friction: str | float | Tensor = "stick"
    static_friction: float | Tensor | None = None
    stribeck_speed: float | Tensor = 0.05
    adhesion: float | Tensor = 0.0
    reach: float | Tensor = 0.0
    landing: Literal["inelastic", "elastic"] = "inelastic"

    def __post_init__(self) -> None:
        """Check the values."""
        if self.normal is None:
            if self.axis not in (0, 1, 2):
                raise ValueError(f"axis = {self.axis!r}: wanted 0 (x), 1 (y) or 2 (z), or a normal")
        elif self.axis is not None or self.side != 1:
            raise ValueError(
                f"axis = {self.axis!r}, side = {self.side!r}: wanted neither beside a normal, which points to the body"
            )
        else:
            normal = torch.as_tensor(self.normal).detach()
            if normal.shape[-1:] != (3,) or not bool(torch.isfinite(normal).all() & (normal != 0).any(-1).all()):
                raise ValueError(f"normal = {self.normal}: wanted [..., 3], finite and not zero")
        if self.side not in (1, -1):
            raise ValueError(f"side = {self.side!r}: wanted +1 or -1")
        if self.landing not in ("inelastic", "elastic"):
            raise ValueError(f"landing = {self.landing!r}: wanted 'inelastic' or 'elastic'")
        if isinstance(self.friction, str) and self.friction != "stick":
            raise ValueError(f"friction = {self.friction!r}: wanted 'stick' or a coefficient of at least 0")
        for name in ("friction", "adhesion", "reach", "offset"):
            value = getattr(self, name)
            if not isinstance(value, str):
                least = -torch.inf if name == "offset" else 0.0
                number = torch.as_tensor(value).detach()
                if not bool((torch.isfinite(number) & (number >= least)).all()):
                    raise ValueError(f"{name} = {value}: wanted finite{'' if name == 'offset' else ' and at least 0'}")
        self._check_static()
        if isinstance(self.reach, Tensor) and self.reach.requires_grad:
            raise ValueError("reach: requires a gradient, but adhesion begins at once within its reach; wanted none")

    def _check_static(self) -> None:
        slow = torch.as_tensor(self.stribeck_speed).detach()
        if not bool((torch.isfinite(slow) & (slow > 0)).all()):
            raise ValueError(f"stribeck_speed = {self.stribeck_speed}: wanted finite and positive, in m/s")
        if self.static_friction is None:
            return
        if isinstance(self.static_friction, str):
            raise ValueError(f"static_friction = {self.static_friction!r}: wanted a coefficient")
        if isinstance(self.friction, str):
            raise ValueError(f"static_friction = {self.static_friction}: of a plane that sticks, wanted a coefficient")
        static, sliding = (torch.as_tensor(v).detach() for v in (self.static_friction, self.friction))
        if not bool((torch.isfinite(static) & (static >= sliding)).all()):
            raise ValueError(
                f"static_friction = {self.static_friction}: wanted finite and at least friction = {self.friction}"
            )

    @property
    def sticks(self) -> bool:
        """Whether the plane holds what is pressed on it."""
        return isinstance(self.friction, str)

    @property
    def pulls_from_afar(self) -> bool:
        """Whether adhesion reaches beyond what touches."""
        return bool((torch.as_tensor(self.reach) > 0).any())

    @classmethod
    def through(cls, point: Sequence[float] | Tensor, *, normal: Sequence[float] | Tensor, **settings) -> Plane:
        """The plane through a point [..., 3] m with a normal [..., 3]; further arguments as of the class."""
        at, n = (t if t.is_floating_point() else t.double() for t in map(torch.as_tensor, (point, normal)))
        offset = (at * n).sum(-1) / torch.linalg.vector_norm(n, dim=-1) if n.shape[-1:] == at.shape[-1:] == (3,) else at
        return cls(normal=normal, offset=offset, **settings)

    def numbers(self) -> tuple[float | Tensor, ...]:
        """What kernels take of a plane: ``PLANE`` numbers, in the order of ``kernels.layout``."""
        normal: Sequence[float] | Tensor = [float(a == self.axis) for a in range(3)]
        if self.normal is not None:
            n = torch.as_tensor(self.normal)
            n = n if n.is_floating_point() else n.double()
            normal = (n / torch.linalg.vector_norm(n, dim=-1, keepdim=True)).unbind(-1)
        friction = 0.0 if isinstance(self.friction, str) else self.friction
        more = 0.0 if self.static_friction is None else self.static_friction - friction
        return self.offset, friction, self.adhesion, self.reach, *normal, more, self.stribeck_speed

    def integers(self) -> list[int]:
        """The ``PLANE_INTEGERS`` integers, likewise; the axis of a plane with a normal is -1."""
        found = {
            layout.PLANE_AXIS: -1 if self.axis is None else self.axis,
            layout.PLANE_SIGN: self.side,
            layout.PLANE_STICK: int(self.sticks),
            layout.PLANE_ELASTIC: int(self.landing == "elastic"),
        }
        return [found[place] for place in range(layout.PLANE_INTEGERS)]


def ground(
    height: float | Tensor = 0.0,
    *,
    friction: str | float | Tensor = "stick",
    static_friction: float | Tensor | None = None,
    stribeck_speed: float | Tensor = 0.05,
    landing: Literal["inelastic", "elastic"] = "inelastic",
) -> Plane:
    """A floor with its normal upward (z).

    Args:
        height: Its height [m].
        friction: See :class:`Plane`.
        static_friction: See :class:`Plane`.
        stribeck_speed: See :class:`Plane`.
        landing: See :class:`Plane`.
    """
    grip = {"friction": friction, "static_friction": static_friction, "stribeck_speed": stribeck_speed}
    return Plane(axis=2, offset=height, landing=landing, **grip)


def check_updated(planes: Sequence[Plane]) -> None:
    """Refuse what the updated formulation does not have: of planes normals, reach and the like, and some gradients.

    Raises:
        ValueError: for a plane with a normal, reach, static friction or elastic landing; or if the offset of a plane
            requires a gradient, and a plane before it has the same axis.
    """
    for k, plane in enumerate(planes):
        given = {
            "normal": plane.normal is not None,
            "landing": plane.landing != "inelastic",
            "reach": plane.pulls_from_afar,
            "static_friction": plane.static_friction is not None,
        }
        for name in (name for name, there in given.items() if there):
            raise ValueError(
                f"planes: plane {k} has {name} = {getattr(plane, name)}, which the updated formulation has not; wanted "
                "an axis, inelastic landing, one friction and no reach, or the total-Lagrangian formulation"
            )
        shifts = all(other.axis != plane.axis for other in planes[:k])
        if not shifts and isinstance(plane.offset, Tensor) and plane.offset.requires_grad:
            raise ValueError(
                f"planes: the offset of plane {k} requires a gradient, but in the updated formulation only the first "
                f"plane of axis {plane.axis} has one, wanted an offset without, or the total-Lagrangian formulation"
            )
