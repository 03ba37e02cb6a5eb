"""The twin: a setup's body on a grid that fits it, and what acts on it, as one scenario that hypotheses may change."""

from __future__ import annotations

import dataclasses
import itertools
import math
from dataclasses import KW_ONLY, dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from torchsoro.sim2real.data.experiment import Setup, Trial
from torchsoro.sim2real.data.schema import Box, ForceTable, PlaneTable
from torchsoro.sim2real.twin.frequency import Frequency
from torchsoro.sim2real.twin.grid import Axis, Grid, divide
from torchsoro.sim2real.twin.scenario import Scenario
from torchsoro.simulation.contact import Plane
from torchsoro.simulation.loads import Force
from torchsoro.simulation.material import Prony

STEPS = 16  # of equal size, in which a force ramps up
NEAR = 0.005  # of the body's edge, within which a flat face counts as that of a chamber, to avoid thin cells
CELLS = 200_000  # of a grid, with which a simulation takes hours


@dataclass(frozen=True, kw_only=True, eq=False)
class MarkerTrajectory:
    """How markers moved; float64.

    Attributes:
        time: [S] s, evenly spaced.
        position: [..., S, M, 3] m.
        velocity: [..., S, M, 3] m/s.
        deformation: Deformation gradient at the markers [..., S, M, 3, 3].
        sound: Which of a batch did not diverge, bool [...].
        dt: Largest substep [s].
    """

    time: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    deformation: np.ndarray
    sound: np.ndarray
    dt: float

    def alone(self, number: int | np.ndarray = 0) -> MarkerTrajectory:
        """One of a batch, or several."""
        if self.position.ndim == 3:
            return self
        names = "position", "velocity", "deformation", "sound"
        return dataclasses.replace(self, **{name: getattr(self, name)[number] for name in names})

    def following(self, first: MarkerTrajectory) -> MarkerTrajectory:
        """A batch with another motion [S, M, ...] before its own, sampled at the same times."""
        names = "position", "velocity", "deformation", "sound"
        return dataclasses.replace(
            self, **{n: np.concatenate([getattr(first, n)[None], getattr(self, n)]) for n in names}
        )

    def plus(self, other: MarkerTrajectory, share: float = 1.0) -> MarkerTrajectory:
        """With a share of another motion [S', M, ...] added, which is constant after its last sample."""
        at = np.minimum(np.arange(len(self.time)), len(other.time) - 1)
        return dataclasses.replace(
            self,
            position=self.position + share * other.position[at],
            velocity=self.velocity + share * other.velocity[at],
            deformation=self.deformation + share * other.deformation[at],
        )


@dataclass(frozen=True, eq=False)
class Twin:
    """A body on a grid, clamped, with chambers, and markers that move with it.

    Attributes:
        setup: What is believed.
        edge: Of a cell, about [m]; walls around chambers, and chambers, have more cells if they need them.
        walls: Cells through each wall around a chamber, at least.
        across: Cells across a body without a chamber, at least.
        device: Where it is simulated, "cpu" or "cuda".
        highest: Supply to which shares of lost pressure refer [Pa], the highest of all trials; 0 for that of each.

    Raises:
        ValueError: for an edge or walls with which there are too many cells, a clamp that holds nothing or all of the
            body, or a chamber that does not lie inside the body.
    """

    setup: Setup
    _: KW_ONLY
    edge: float
    walls: int = 3
    across: int = 3
    device: str = "cpu"
    highest: float = 0.0

    def __post_init__(self) -> None:
        """Check the numbers, and that the body can be laid on a grid and held."""
        setup, edge, walls, across = self.setup, self.edge, self.walls, self.across
        if not (edge > 0 and walls > 0 and across > 0):
            raise ValueError(f"edge = {edge:g} m, walls = {walls}, across = {across}, wanted positive numbers")
        cells = math.prod(max(s / edge, across, walls * bool(setup.chambers)) for s in setup.size)
        if not cells <= CELLS:
            raise ValueError(
                f"edge = {edge:g} m, walls = {walls}: {cells:.2g} cells in a body of "
                f"{' x '.join(f'{s:g}' for s in setup.size)} m, wanted at most {CELLS}: cells that are larger, or a "
                "body that is less slender"
            )
        if self.grid.open:
            raise ValueError("chamber: opens to the outside of the mesh, wanted walls all around")
        if self.held[self.nodal(self.volumes).numpy() > 0].all():
            raise ValueError("clamp: the boxes hold the whole body, wanted a part of it that can move")

    @cached_property
    def grid(self) -> Grid:
        """Cells that end where the body and its chambers do."""
        setup, walls, surface, axes = self.setup, self.walls, self.setup.surface, []
        for axis in range(3):
            begin, end = setup.origin[axis], setup.origin[axis] + setup.size[axis]
            creases = sorted({c.box[side][axis] for c in setup.chambers for side in (0, 1)})
            if creases and not begin < creases[0] < creases[-1] < end:
                raise ValueError(
                    f"chamber: from {creases[0]:g} to {creases[-1]:g} m along {'xyz'[axis]}, wanted between {begin:g} "
                    f"and {end:g} m, within the body"
                )
            faces = [] if surface is None else surface.faces[axis]
            near = NEAR * setup.size[axis]
            inner = sorted([*creases, *(f for f in faces if not any(abs(f - c) < near for c in creases))])
            breaks = [begin, *inner, end]
            least = [walls if setup.chambers else 1] * (len(breaks) - 1)
            # With one cell in every interval, motions quadratic along two axes have no strain at points (hourglassing).
            widest = int(np.diff(breaks).argmax())
            least[widest] = max(least[widest], 2, 0 if setup.chambers else self.across - len(inner))
            # Double knots at the faces of chambers: two walls that share a node would be coupled across the chamber. At
            # those of a mesh, legs would be too soft: with larger cells, robots respond better by 4 times without them.
            axes.append(Axis(divide(breaks, least, self.edge), creases))
        x, y, z = axes
        return Grid((x, y, z), [c.box for c in setup.chambers], None if surface is None else surface.filled)

    @cached_property
    def frequency(self) -> Frequency:
        """The highest that the grid bears."""
        return Frequency(self.grid)

    @cached_property
    def held(self) -> np.ndarray:
        """Which nodes the clamps hold, bool [n]."""
        held = np.zeros(self.nodes, bool)
        for low, high in self.setup.clamps:
            on = self.grid.lattice.inside(low, high).numpy()
            held |= on
            if not on.any():
                raise ValueError(f"clamp: box {low}, {high}, wanted one that holds a part of the body, in metres")
        return held

    @cached_property
    def faces(self) -> tuple[tuple[int, int], ...]:
        """Axis and side of the faces of the body that clamps cover."""
        return tuple(f for f in (_face(box, self.setup) for box in self.setup.clamps) if f is not None)

    @property
    def count(self) -> int:
        """Number of points."""
        return len(self.grid.points)

    @property
    def positions(self) -> Tensor:
        """Points of the body [P, 3] m."""
        return torch.from_numpy(self.grid.points)

    @property
    def volumes(self) -> Tensor:
        """Of the points [P] m3."""
        return torch.from_numpy(self.grid.volumes)

    @property
    def nodes(self) -> int:
        """Number of nodes."""
        return self.grid.lattice.nodes

    @property
    def places(self) -> Tensor:
        """Of the nodes [n, 3] m; values there of a linear field are its coefficients."""
        return self.grid.lattice.node_places

    def depth(self, places: Tensor, axis: int, side: int) -> Tensor:
        """How far places [..., 3] are in front of a face, within the body [m]."""
        face = self.setup.origin[axis] + (self.setup.size[axis] if side > 0 else 0.0)
        return side * (face - places[..., axis])

    def nodal(self, amounts: Tensor) -> Tensor:
        """Amounts [..., P] at the points, over the nodes [..., n]."""
        return self.grid.collect(amounts)

    def at(self, places: Tensor) -> Tensor:
        """Shares of the nodes [B, n] of what is attached at places [B, 3] m, the nearest of the body."""
        found = self.grid.lattice.splines(*self.grid.nearest(places.numpy()))
        nodes, weights, _ = (torch.from_numpy(a) for a in found)
        return torch.zeros(len(places), self.nodes, dtype=torch.float64).scatter_add(1, nodes, weights)

    def scenario(self, trial: Trial) -> Scenario:
        """What is believed about a trial."""
        s = trial.setup
        prony = None
        if s.prony:
            pairs = torch.tensor(s.prony, dtype=torch.float64)
            prony = Prony(moduli=pairs[:, 0].clone(), times=pairs[:, 1].clone())
        center = torch.tensor(s.center, dtype=torch.float64)
        spin = torch.tensor(s.angular_velocity, dtype=torch.float64).expand(self.nodes, 3)
        nodes = self.nodes
        return Scenario(
            youngs_modulus=torch.full((self.count,), s.youngs_modulus, dtype=torch.float64),
            poisson_ratio=torch.tensor(s.poisson_ratio, dtype=torch.float64),
            density=torch.full((self.count,), s.density, dtype=torch.float64),
            prony=prony,
            stiffening=torch.zeros(2, dtype=torch.float64),
            softening=torch.tensor([0.0, 1.0], dtype=torch.float64),
            air_stiffness=torch.tensor([c.air_stiffness for c in s.chambers], dtype=torch.float64),
            pressure=trial.pressure,
            gravity=torch.tensor(s.gravity, dtype=torch.float64),
            displacement=torch.zeros(nodes, 3, dtype=torch.float64),
            velocity=torch.tensor(s.velocity, dtype=torch.float64) + torch.cross(spin, self.places - center, dim=-1),
            planes=tuple(_plane(p) for p in s.planes),
            loads=tuple(step for force in s.forces for step in _steps(force, self.grid.within(force.box))),
            duration=s.duration,
            until=s.duration,
        )


def _steps(table: ForceTable, share: Tensor) -> list[Force]:
    """A ramp is a sum of steps; the end of a force is an opposite force that begins then."""
    value, steps = torch.tensor(table.force, dtype=torch.float64), STEPS if table.ramp > 0 else 1
    starts = [table.start + table.ramp * (k + 0.5) / steps for k in range(steps)]
    forces = [Force(share=share, value=value / steps, start=start) for start in starts]
    return [*forces, Force(share=share, value=-value, start=table.end)] if table.end < math.inf else forces


def _face(box: Box, setup: Setup) -> tuple[int, int] | None:
    """Axis and side of the face of the body that a clamp covers; None if it holds another part."""
    low, high = box
    thin = 1e-9
    for axis, side in itertools.product(range(3), (-1, 1)):
        others = [a for a in range(3) if a != axis]
        begin, end = setup.origin[axis], setup.origin[axis] + setup.size[axis]
        covers = all(
            low[a] <= setup.origin[a] + thin and high[a] >= setup.origin[a] + setup.size[a] - thin for a in others
        )
        face = end if side > 0 else begin
        if covers and low[axis] <= face + thin and high[axis] >= face - thin:
            return axis, side
    return None


def _plane(plane: PlaneTable) -> Plane:
    point, normal = (torch.tensor(v, dtype=torch.float64) for v in (plane.point, plane.normal))
    zero = torch.zeros((), dtype=torch.float64)
    friction = plane.friction if isinstance(plane.friction, str) else zero + plane.friction
    return Plane.through(point, normal=normal, friction=friction, adhesion=zero, reach=zero, landing="inelastic")
