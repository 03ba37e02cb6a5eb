"""The two formulations of the simulator: where the grid lies, what a state is, and how large a step may be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal, Protocol

import torch
from torch import Tensor

from torchsoro.simulation.assembly import on_lattice
from torchsoro.simulation.attachment import refuse_nodes
from torchsoro.simulation.checkpoints import NODE_SHARE
from torchsoro.simulation.contact import Plane, check_updated
from torchsoro.simulation.courant import UNIFORM, Courant, total_courant, updated_courant
from torchsoro.simulation.kernels import layout
from torchsoro.simulation.loads import Attached
from torchsoro.simulation.material import Gas, Prony
from torchsoro.simulation.ops.affine import velocity_gradient
from torchsoro.simulation.ops.lattice import Lattice
from torchsoro.simulation.ops.scene import Inputs, Scene
from torchsoro.simulation.ops.state import total_state, updated_state

FormulationName = Literal["updated", "total"]
# Density of air in the total-Lagrangian form [kg/m3]: small, yet large enough that waves of the chambers' fictitious
# shear modulus are slower than the solid's.
AIR = 3.0
TRANSFERS = {"apic": 0.0, "flip": 1.0}
Placed = tuple[Scene, Inputs, Tensor, Tensor, Tensor]
"""Scene, inputs, positions [B, N, 3] m, velocities [B, N, 3] m/s and weights [B, N] of the simulated points."""


class Formulation(Protocol):
    """What the simulator asks of a formulation."""

    name: ClassVar[FormulationName]
    air_density: ClassVar[float]
    """Density of the air in a chamber unless another is given [kg/m3]."""

    @property
    def limit(self) -> float | None:
        """Largest Courant number of a step; ``STABLE_COURANT`` if None."""
        ...

    @property
    def hollow(self) -> int:
        """Number of chambers that hold no particles."""
        ...

    @property
    def blend(self) -> float:
        """0 for APIC, 1 for affine FLIP."""
        ...

    def courant(self, attached: Attached, prony: Prony | None, dt: float, cell: float) -> Courant:
        """Courant number of a step ``dt`` [s] in cells of ``cell`` [m]."""
        ...

    def check_planes(self, planes: Sequence[Plane]) -> None:
        """Refuse planes with gradients that are not computed (``ValueError``)."""
        ...

    def check_loads(self, attached: Attached) -> None:
        """Refuse what the formulation cannot simulate (``ValueError``)."""
        ...

    def in_lanes(self, like: Tensor) -> bool:
        """Whether simulations run in lanes, where forces have one row for all steps."""
        ...

    def check_continued(self, before: float, dt: float, prony: Prony | None) -> None:
        """Refuse to go on with a step ``dt`` [s] from a trajectory with another, ``before`` (``ValueError``)."""
        ...

    def place(self, scene: Scene, inputs: Inputs, x: Tensor, velocity: Tensor, weight: Tensor) -> Placed:
        """From particles to the points that are simulated, in all data by particle (``ValueError`` if they do not fit).

        ``x`` are positions [B, N, 3] m, ``velocity`` [B, N, 3] m/s, ``weight`` [B, N].
        """
        ...

    def initial(self, scene: Scene, inputs: Inputs, x: Tensor, velocity: Tensor, *, moving: bool) -> Tensor:
        """State of the undeformed body; ``moving`` is false where all velocities are zero."""
        ...

    def started(self, scene: Scene, displacement: Tensor, velocity: Tensor, shape: tuple[int, ...]) -> Tensor:
        """State of this shape without history, from displacements and velocities of the nodes [B, nodes, 3]."""
        ...

    def state_shape(self, scene: Scene, inputs: Inputs) -> tuple[int, ...]:
        """Shape of a state."""
        ...

    def node_share(self, scene: Scene, state: Tensor) -> float:
        """Memory that a substep keeps for its gradient, nodes included, over that of its state."""
        ...


@dataclass(frozen=True)
class Updated:
    """MLS-MPM, the paper's: the grid stays, and particles move through it.

    Attributes:
        transfer: "apic" or "flip"; see :class:`torchsoro.Simulator`.

    Raises:
        ValueError: for an unknown transfer.
    """

    transfer: str = "apic"
    name: ClassVar[FormulationName] = "updated"
    air_density: ClassVar[float] = float(Gas().density)

    def __post_init__(self) -> None:
        """Check the transfer."""
        _check_transfer(self.transfer)

    def __str__(self) -> str:
        """As arguments of the simulator."""
        return f"transfer={self.transfer!r}"

    @property
    def blend(self) -> float:
        """0 for APIC, 1 for affine FLIP."""
        return TRANSFERS[self.transfer]

    @property
    def limit(self) -> None:
        """That of the measured bodies."""
        return None

    @property
    def hollow(self) -> int:
        """Every chamber holds particles."""
        return 0

    def courant(self, attached: Attached, prony: Prony | None, dt: float, cell: float) -> Courant:
        """See :func:`torchsoro.simulation.stability.courant`."""
        return updated_courant(attached, prony, dt, cell)

    def check_planes(self, planes: Sequence[Plane]) -> None:
        """Planes are of the grid; the first one of each axis shifts it, which is the gradient by its offset."""
        check_updated(planes)

    def check_loads(self, attached: Attached) -> None:
        """There are no nodes to attach anything to."""
        refuse_nodes(attached)

    def in_lanes(self, like: Tensor) -> bool:
        """Particles have none."""
        return False

    def check_continued(self, before: float, dt: float, prony: Prony | None) -> None:
        """Histories do not depend on the step."""

    def place(self, scene: Scene, inputs: Inputs, x: Tensor, velocity: Tensor, weight: Tensor) -> Placed:
        """Particles may be anywhere."""
        return scene, inputs, x, velocity, weight

    def initial(self, scene: Scene, inputs: Inputs, x: Tensor, velocity: Tensor, *, moving: bool) -> Tensor:
        """State [B, S, N]."""
        spin = velocity_gradient(x, velocity, origin=inputs.origin, cell=scene.cell) if moving else None
        return updated_state(x, velocity, inputs.prony.shape[1], affine=spin)

    def started(self, scene: Scene, displacement: Tensor, velocity: Tensor, shape: tuple[int, ...]) -> Tensor:
        """The grid knows nothing of the body before a step."""
        raise ValueError("start: a Start of nodes, wanted Body.velocity, or a state, in the updated formulation")

    def state_shape(self, scene: Scene, inputs: Inputs) -> tuple[int, ...]:
        """[B, S, N]."""
        batch, _, count = inputs.coefficients.shape
        return batch, layout.state_components(inputs.prony.shape[1]), count

    def node_share(self, scene: Scene, state: Tensor) -> float:
        """An estimate: how many nodes a body touches changes as it moves."""
        return NODE_SHARE


@dataclass(frozen=True)
class Total:
    """Total-Lagrangian: the grid is the body's own lattice and moves with it.

    Attributes:
        lanes: Whether a CPU fills its vector registers, by kernels of its own; else it runs those of a GPU.
        lattice: Of the body, whose ``places`` (those of ``index``) are the places of its particles: cells of any
            width, with chambers that hold no particles, and nodes on its faces. If None, a uniform one around the
            particles.
        limit: Largest Courant number of a step; ``stability.STABLE_COURANT`` if None. A full lattice bears more.
        device: Where to simulate a body whose tensors are on a CPU, as "cuda"; with them if None. Of simulations that
            are marked and record probes only.
    """

    lanes: bool = field(default=True, repr=False)
    lattice: Lattice | None = field(default=None, repr=False)
    limit: float | None = field(default=None, repr=False)
    device: str | None = field(default=None, repr=False)
    name: ClassVar[FormulationName] = "total"
    air_density: ClassVar[float] = AIR

    def __str__(self) -> str:
        """As arguments of the simulator."""
        return f"formulation={self.name!r}"

    @property
    def blend(self) -> float:
        """Without meaning: particles do not leave their cells."""
        return 0.0

    def courant(self, attached: Attached, prony: Prony | None, dt: float, cell: float) -> Courant:
        """See :func:`torchsoro.simulation.stability.courant`."""
        steep = UNIFORM / cell**2 if self.lattice is None else max(a.steep for a in self.lattice.axes)
        return total_courant(attached, prony, dt, steep)

    @property
    def hollow(self) -> int:
        """Those with walls."""
        return 0 if self.lattice is None or self.lattice.walls is None else self.lattice.walls.count

    def check_planes(self, planes: Sequence[Plane]) -> None:
        """Every plane has all gradients."""

    def check_loads(self, attached: Attached) -> None:
        """Loads on nodes want the lattice whose nodes they are of."""
        given = [load for load in attached.more if getattr(load, "particles", ...) is None]
        if self.lattice is None and given:
            raise ValueError(f"loads: a {type(given[0]).__name__} on nodes, wanted Total(lattice=...), or particles")

    def in_lanes(self, like: Tensor) -> bool:
        """On a CPU, unless told otherwise."""
        return self.lanes and not like.is_cuda

    def check_continued(self, before: float, dt: float, prony: Prony | None) -> None:
        """The state keeps Z = H - b S of a Maxwell element, and b depends on the step."""
        if before != dt and prony is not None and prony.elements:
            raise ValueError(
                f"start: a trajectory with a substep of {before:g} s, wanted the {dt:g} s of this run, on which the "
                "histories of Maxwell elements depend in the total-Lagrangian formulation"
            )

    def place(self, scene: Scene, inputs: Inputs, x: Tensor, velocity: Tensor, weight: Tensor) -> Placed:
        """To all points of the particles' lattice."""
        lattice = self.lattice
        if lattice is None:
            lattice = Lattice.around(x[0], scene.cell)
        else:
            lattice.check(x[0])
        where = None if self.device is None else torch.device(self.device)
        return on_lattice(replace(scene, lanes=self.lanes, device=where), inputs, x, velocity, weight, lattice)

    def initial(self, scene: Scene, inputs: Inputs, x: Tensor, velocity: Tensor, *, moving: bool) -> Tensor:
        """State [B, L]."""
        assert scene.lattice is not None
        present, elements = scene.kind != layout.ABSENT, inputs.prony.shape[1]
        return total_state(scene.lattice, x, velocity, present, elements, scene.softens)

    def started(self, scene: Scene, displacement: Tensor, velocity: Tensor, shape: tuple[int, ...]) -> Tensor:
        """State [B, L]."""
        assert scene.lattice is not None
        for name, t in (("displacement", displacement), ("velocity", velocity)):
            if t.shape[1:] != (scene.lattice.nodes, 3):
                raise ValueError(f"start.{name}: shape {tuple(t.shape)}, wanted [..., {scene.lattice.nodes}, 3]")
        motion = torch.stack([displacement, velocity], 1).transpose(2, 3).flatten(1)
        return torch.nn.functional.pad(motion, (0, shape[1] - motion.shape[1]))

    def state_shape(self, scene: Scene, inputs: Inputs) -> tuple[int, ...]:
        """[B, L]."""
        assert scene.lattice is not None
        batch, _, points = inputs.coefficients.shape
        return batch, layout.lattice_components(scene.lattice.nodes, points, inputs.prony.shape[1], scene.softens)

    def node_share(self, scene: Scene, state: Tensor) -> float:
        """One vector of the nodes is kept beside a state."""
        assert scene.lattice is not None
        return 1 + 3 * scene.lattice.nodes / state.shape[1]


def formulation_of(formulation: FormulationName | Formulation, transfer: str | None = None) -> Formulation:
    """The formulation with a name.

    Args:
        formulation: "updated" or "total"; or a formulation, which is returned.
        transfer: Of the updated formulation by name: "apic", which None stands for, or "flip".

    Raises:
        ValueError: if there is no such formulation or transfer, or for a transfer beside a formulation that is no name.
    """
    if transfer is not None:
        _check_transfer(transfer)
    if isinstance(formulation, Updated | Total):
        if transfer is not None:
            raise ValueError(f"transfer = {transfer!r} beside formulation = {formulation!r}: wanted only one of both")
        return formulation
    kinds: dict[Any, Formulation] = {"updated": Updated(transfer or "apic"), "total": Total()}
    if formulation not in kinds:
        raise ValueError(f'formulation = {formulation!r}: wanted "updated" or "total"')
    return kinds[formulation]


def check_self_contact(wanted: bool, formulation: Formulation) -> None:
    """Refuse contact of a body with itself in a formulation that has none.

    Raises:
        ValueError: naming what is in its way.
    """
    if not isinstance(wanted, bool):
        raise ValueError(f"self_contact = {wanted!r}: wanted True or False")
    if not wanted:
        return
    if not isinstance(formulation, Total):
        raise ValueError(
            f'self_contact = True: beside formulation = {formulation.name!r}, wanted "total"; '
            "in the updated formulation parts of a body meet on the grid"
        )
    if formulation.lattice is not None:
        raise ValueError("self_contact = True: beside Total(lattice=...), wanted particles on a uniform lattice")
    if formulation.device is not None:
        raise ValueError(f"self_contact = True: beside Total(device={formulation.device!r}), wanted it with the body")


def _check_transfer(transfer: str) -> None:
    if transfer not in TRANSFERS:
        raise ValueError(f"transfer = {transfer!r}: wanted one of {', '.join(map(repr, TRANSFERS))}")
