"""A pneumatic robot on its ground or between walls: design field, material, actuation and simulator in one module."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor, nn

from torchsoro.design.blending import fill_blended, solid_shares
from torchsoro.design.chambers import chambers_of, placement_of, port_of, sockets
from torchsoro.design.connected import connected
from torchsoro.design.density import fill, without_void
from torchsoro.design.domain import Domain
from torchsoro.design.field import DesignField
from torchsoro.design.mesh import UNITS, read_surface
from torchsoro.design.objective import center_of_gravity, intermediate_density, total_mass, travel, yaw
from torchsoro.design.outcome import Outcome
from torchsoro.design.placement import Membership
from torchsoro.design.scenarios import ScenarioBatch, leaning_gravity, posed, supplied, varied
from torchsoro.design.settings import Settings
from torchsoro.design.supply import supply_of
from torchsoro.errors import SimulationDiverged
from torchsoro.simulation.actuation import Waveform
from torchsoro.simulation.contact import Plane, ground
from torchsoro.simulation.formulation import Formulation, formulation_of
from torchsoro.simulation.loads import PointMass
from torchsoro.simulation.material import Body, Gas, Prony, Solid
from torchsoro.simulation.material_file import read_material
from torchsoro.simulation.ops.lanes import fewest
from torchsoro.simulation.ops.lattice import Lattice
from torchsoro.simulation.simulator import Simulator
from torchsoro.simulation.sums import pairwise_sum
from torchsoro.simulation.trajectory import Start, Trajectory

LANES = 16  # simulations that a CPU carries on at a time


class Robot(nn.Module):
    """A cube with one or several gas chambers, to be designed; everything follows from the settings.

    Args:
        settings: See :class:`Settings`.
        planes: What it moves on.
        direction: Unit vector of the wanted travel.
        symmetry: Axes along which left and right are alike.

    Raises:
        ValueError: for settings that do not fit together, before any simulation.
    """

    def __init__(
        self,
        settings: Settings,
        *,
        planes: tuple[Plane, ...],
        direction: tuple[float, float, float],
        symmetry: tuple[str, ...],
    ) -> None:
        super().__init__()
        s = self.settings = settings
        s.check_memory()
        for name in ("pitch_range", "roll_range", "drop_range"):
            if any(getattr(s, name)) and (s.robot != "walker" or s.formulation != "total"):
                raise ValueError(
                    f"{name} = {getattr(s, name)}: wanted 0 0, but of a walker in the total-Lagrangian formulation, "
                    "which alone has a pose at the start"
                )
        self.planes, self.direction = planes, direction
        half = (s.size[0] / 2, s.size[1] / 2)
        chambers = chambers_of(s, (0.0, 0.0, s.size[2] / 2))
        self.port = port_of(s, chambers, direction)
        self.domain = Domain(
            size=s.size,
            particles=s.particles,
            origin=(-half[0], -half[1], 0.0),
            chambers=chambers,
            body=None if s.body_mesh is None else read_surface(s.body_mesh, UNITS[s.mesh_unit]),
            # Cut through limbs afterwards, a port would leave thin ones.
            port=self.port if s.feature else None,
        )
        self.field = DesignField(self.domain, radius=s.filter_radius, beta=s.beta, symmetry=symmetry).to(s.target)
        self.placement = placement_of(s, self.domain, symmetry)
        self.solid = Solid(youngs_modulus=s.youngs_modulus, poisson_ratio=s.poisson_ratio, density=s.density)
        self.formulation: Formulation = formulation_of(s.formulation, s.transfer)
        air = s.air_density
        if air == "auto":
            air = self.formulation.air_density
        self.gas = Gas(stiffness=s.air_stiffness, viscosity=s.air_viscosity, density=air)
        self.prony = Prony.paper(s.elements)
        if s.material is not None:
            found = read_material(s.material)
            self.solid, self.prony = found.solid, found.prony
        self.supply = supply_of(s, float(self.solid.youngs_modulus))
        angle = math.atan(s.slope)
        # Uphill along +x, with the ground kept level: gravity leans back instead.
        self.gravity = (-s.gravity * math.sin(angle), 0.0, -s.gravity * math.cos(angle))
        self.design = self.domain.design.to(s.target)
        self.wall = self.domain.wall.to(s.target)
        self.soles = _outermost(self.domain, planes).to(s.target)
        # Density scales mass and stiffness alike: the step is good for every design, or for none.
        with torch.no_grad():
            everywhere = self.filled(torch.ones(self.domain.count))
        self.full_mass = float(everywhere.mass[~self.domain.gas].sum())
        if s.scenarios:
            stiff, light = (torch.tensor([factor]) for factor in (s.modulus_range[1], s.density_range[0]))
            everywhere = varied(everywhere, ScenarioBatch(count=1, modulus_factor=stiff, density_factor=light))
        s.check_memory(self.simulator(1).step(everywhere, self.prony, duration=s.duration, sample_every=s.sample_every))

    def forward(
        self,
        gamma: Tensor,
        *,
        gravity_scale: float = 1.0,
        everything: bool = False,
        void: bool = True,
        pressure: Waveform | None = None,
        progress: Callable[[int, int], None] | None = None,
        scenarios: ScenarioBatch | None = None,
        dt: float | None = None,
        membership: Membership | None = None,
    ) -> Outcome:
        """Simulate a design and judge it.

        Args:
            gamma: Density [N]; or of each scenario [S, N], which all void is simulated with.
            gravity_scale: Share of gravity.
            everything: Record every particle (for pictures) and not only the centre of gravity.
            void: Simulate void, too. Without it a finished design takes half the time, for a slightly different motion;
                in what is recorded, void then moves with the centre of gravity.
            pressure: Of the chambers, from the start of the simulation; the supply's own if None.
            progress: See :meth:`Simulator.forward`.
            scenarios: To simulate at once, instead of the settings' own one.
            dt: Substep [s], which is not halved where the simulation breaks down; the settings' if None.
            membership: What chambers that are designed make of each particle, shares [..., N]; those of now if None.

        Returns:
            Travel, intermediate density, mass, centre of gravity, trajectory.

        Raises:
            SimulationDiverged: if the simulation breaks down.
        """
        s = self.settings
        member = self.membership(gamma) if membership is None else membership
        body = self.filled(gamma, member)
        solid, weight = self.weights(body, gamma, member)
        pressure = self.pressure if pressure is None else pressure
        trajectory = self._simulate(body, weight, gravity_scale, everything, void, pressure, progress, scenarios, dt)
        end = s.settle + s.duration

        def until(moment: float) -> Tensor:
            seen, time = trajectory.center_of_gravity, trajectory.time
            return travel(seen, time, start=s.settle, end=moment, direction=self.direction)

        closes = s.sample_every * max(1, round(min(s.duty / s.frequency, s.duration) / s.sample_every))
        height, center = trajectory.center_of_gravity[..., 2], center_of_gravity(body.position, weight)
        stands = height[..., 0]
        if scenarios is not None and scenarios.posed:  # what a body that leans or drops at the start loses is no fall
            stands = center[..., 2].expand(stands.shape)
        return Outcome(
            travel=until(end),
            feet=self.feet(trajectory, gamma, near=False),
            soles=self.feet(trajectory, gamma, near=True),
            inflated=until(s.settle + closes),
            turn=self.turned(trajectory, gamma, end),
            turn_inflated=self.turned(trajectory, gamma, s.settle + closes),
            intermediate=intermediate_density(gamma, self.design) if member is None else member.intermediate(gamma),
            mass=total_mass(solid),
            fall=torch.relu(stands - self.clearance(gamma) - height.amin(-1) - s.sink * s.size[2]),
            center=center,
            trajectory=trajectory,
            dt=trajectory.dt,
        )

    @torch.no_grad()
    def clearance(self, gamma: Tensor) -> Tensor:
        """Height of the solid above the ground of a body that stands [...] m, in whole layers; 0 without a ground.

        An eroded design has lost its lowest layers, and lands before it walks.

        Args:
            gamma: Density [..., N].
        """
        none = torch.zeros((), dtype=gamma.dtype, device=gamma.device)
        if not any(plane.axis == 2 and plane.side == 1 for plane in self.planes):
            return none
        layer = ((self.domain.positions[:, 2] - self.domain.origin[2]) / self.domain.spacing).floor().to(gamma)
        solid = torch.where(gamma >= 0.5, layer, math.inf).amin(-1)
        return torch.where(solid.isfinite(), solid, 0.0) * self.domain.spacing

    def density(self, threshold: float = 0.0) -> Tensor:
        """Density of the present design [N], as far as it is connected if the settings say so.

        Args:
            threshold: Of the field's projection, which erodes or dilates it.

        Returns:
            With a gradient by the field and by chambers that are designed.
        """
        gamma, wall = self._designed(threshold)
        if not self.settings.connected:
            return gamma
        whole = connected(gamma, wall, self.domain.shape)
        return torch.lerp(gamma, whole, self.settings.sharp(self.field.beta))

    def loose(self) -> Tensor:
        """Mean density over the design domain of what is not connected with a chamber, with a gradient."""
        gamma, wall = self._designed()
        return (gamma - connected(gamma, wall, self.domain.shape))[self.design].mean()

    def _designed(self, threshold: float = 0.0) -> tuple[Tensor, Tensor]:
        """Density as designed, and which particles are walls of chambers."""
        if self.placement is None:
            return self.field(threshold=threshold), self.domain.wall
        member = self.placement()
        gamma = self.field(threshold=threshold, shares=(member.design, member.wall))
        return gamma, member.wall.detach() > 0.5

    @property
    def rounded_domain(self) -> Domain:
        """The domain; chambers that are designed lie where they are now, rounded to lattice planes."""
        return self.domain if self.placement is None else replace(self.domain, chambers=self.placement.rounded())

    @property
    def socket(self) -> tuple[Tensor, Tensor]:
        """Particles of the chambers' walls from which tubes hang, rounded if designed, and the share of each [n]."""
        particles, share = sockets(self.rounded_domain, self.port.direction)
        return particles.to(self.settings.target), share.to(self.settings.target)

    def membership(self, like: Tensor) -> Membership | None:
        """What chambers that are designed make of each particle, in the type of a tensor; None if they are given."""
        return None if self.placement is None else self.placement().to(like)

    def weights(
        self, body: Body, gamma: Tensor | None = None, member: Membership | None = None
    ) -> tuple[Tensor, Tensor]:
        """Masses of the solid with the chamber walls, and of what is counted in the travel, each [..., N] kg.

        Args:
            body: The body.
            gamma: Its density [..., N]; wanted where chambers are designed.
            member: What these make of each particle.
        """
        if member is not None and gamma is not None:
            whole = self.domain.volume * float(self.solid.density)
            s = self.settings
            wall, designed = solid_shares(gamma, member, epsilon=s.epsilon, power=s.power)
            solid = whole * (wall + designed)
            return solid, solid if s.counted == "body" else whole * designed
        none = torch.zeros_like(body.mass)
        solid = torch.where(self.design | self.wall, body.mass, none)
        return solid, solid if self.settings.counted == "body" else torch.where(self.design, body.mass, none)

    def feet(self, trajectory: Trajectory, gamma: Tensor, *, near: bool = False) -> Tensor:
        """Travel of the feet since the actuation starts [m]; zero if there are none at the end.

        Feet are the particles of the outermost layers that touch a plane at the end, to a quarter of a spacing; they
        count by the cube of their density.

        Args:
            trajectory: With those layers among its probes.
            gamma: Density [N].
            near: Count all of those layers, by exp(-2 h / spacing) at a height h above the touch, instead.
        """
        place, probes = self._soles(trajectory)
        first = self._sample(trajectory, self.settings.settle)
        spacing = self.domain.spacing
        end, begin = place[..., -1, :, :], place[..., first, :, :]
        away = [plane.side * (end[..., plane.axis] - float(plane.offset)) for plane in self.planes]
        height = torch.relu(torch.stack(away).amin(0) - 0.5 * spacing)
        counts = torch.exp(-2 * height / spacing) if near else (height.detach() < 0.25 * spacing).to(height)
        share = gamma[..., probes].clamp(min=0) ** 3 * counts
        moved = (end - begin) @ place.new_tensor(self.direction)
        return pairwise_sum(share * moved) / pairwise_sum(share).clamp(min=torch.finfo(share.dtype).tiny)

    def turned(self, trajectory: Trajectory, gamma: Tensor, moment: float) -> Tensor:
        """Angle by which the soles turned about z from the start of the actuation to a moment [rad].

        That is the rotation that fits them best (see :func:`torchsoro.design.objective.yaw`); they count by the cube of
        their density.

        Args:
            trajectory: With the soles among its probes.
            gamma: Density [N].
            moment: Time, s.
        """
        place, probes = self._soles(trajectory)
        first, last = (self._sample(trajectory, t) for t in (self.settings.settle, moment))
        return yaw(place[..., first, :, :], place[..., last, :, :], gamma[..., probes].clamp(min=0) ** 3)

    def _soles(self, trajectory: Trajectory) -> tuple[Tensor, Tensor]:
        """Positions over time [..., S, n, 3] m of the layers that face a plane, and their particles [n]."""
        at = torch.isin(trajectory.probes, self.soles.to(trajectory.probes))
        return trajectory.position[..., at, :], trajectory.probes[at]

    def _sample(self, trajectory: Trajectory, moment: float) -> int:
        """The sample nearest to a time [s]."""
        return int((trajectory.time - moment).abs().argmin())

    @property
    def pressure(self) -> Waveform:
        """What the supply gives now, from the start of the simulation, with a gradient by a timing that is designed."""
        return self.supply()

    def filled(self, gamma: Tensor, member: Membership | None = None) -> Body:
        """The domain filled with a density [N].

        Args:
            gamma: The density.
            member: What chambers that are designed make of each particle, if that is known already.
        """
        s = self.settings
        how: dict[str, Any] = {"solid": self.solid, "gas": self.gas, "epsilon": s.epsilon, "power": s.power}
        how["void_range"] = s.void_range
        member = self.membership(gamma) if member is None else member
        return fill(self.domain, gamma, **how) if member is None else fill_blended(self.domain, gamma, member, **how)

    def _simulate(
        self,
        body: Body,
        weight: Tensor,
        gravity_scale: float,
        everything: bool,
        void: bool,
        pressure: Waveform,
        progress: Callable[[int, int], None] | None,
        scenarios: ScenarioBatch | None,
        dt: float | None,
    ) -> Trajectory:
        """Simulate; a design on which the step is too long is simulated again with half the step."""
        s = self.settings
        rest, keep = body.position, torch.ones_like(self.design)
        probes = torch.arange(len(rest), device=rest.device) if everything else self.soles
        if not void:
            body, keep = without_void(body)
            weight, probes = weight[keep], probes[keep[probes]]
        number = keep.cumsum(0) - 1
        gravity = tuple(gravity_scale * g for g in self.gravity)
        met: dict[str, Any] = {"body": body, "pressure": pressure, "gravity": gravity, "planes": self.planes}
        if scenarios is not None:
            particles, share = self.socket
            met |= self.varied(body, scenarios, (number[particles], share), pressure, gravity_scale)
        for halving in range(1 if dt else s.halvings + 1):
            try:
                trajectory = self.simulator(2**halving, dt)(
                    **met,
                    duration=s.settle + s.duration,
                    prony=self.prony,
                    sample_every=s.sample_every,
                    weight=weight,
                    probes=number[probes],
                    progress=progress,
                )
                if everything and not void:
                    return self._with_void(trajectory, rest, keep)
                return replace(trajectory, probes=probes)
            except SimulationDiverged:
                if dt or halving == s.halvings:
                    raise
        raise AssertionError

    def varied(
        self,
        body: Body,
        scenarios: ScenarioBatch,
        socket: tuple[Tensor, Tensor],
        pressure: Waveform,
        gravity_scale: float = 1.0,
    ) -> dict[str, Any]:
        """What differs by scenario, as arguments of the simulator; what is not given stays as it is.

        Args:
            body: Without scenarios.
            scenarios: [S].
            socket: Particles of the body from which tubes hang, and the share of each [n].
            pressure: Of the supply.
            gravity_scale: Share of gravity.
        """
        s, b = self.settings, scenarios
        found: dict[str, Any] = {"body": varied(body, b), "pressure": supplied(pressure, b)}
        if b.tilt_x is not None or b.tilt_y is not None:
            found["gravity"] = leaning_gravity(gravity_scale * s.gravity, s.slope, b)
        if b.friction is not None:
            one = {"friction": b.friction, "static_friction": None}  # a scenario has a single coefficient
            found["planes"] = tuple(replace(plane, **one) for plane in self.planes)
        if b.tube_mass is not None:
            found["loads"] = (PointMass(particles=socket[0], mass=b.tube_mass, share=socket[1]),)
        if b.posed:
            nodes = Lattice.around(body.position, self.domain.cell).node_places
            moved = posed(nodes, s.size, b).to(body.position)
            found["start"] = Start(displacement=moved, velocity=torch.zeros_like(moved))
        if not b.given:  # the results have the leading axis nevertheless
            found["body"] = replace(body, mass=body.mass.expand(b.count, len(body.position)))
        return found

    def step(self, gamma: Tensor, scenarios: ScenarioBatch) -> float:
        """The substep [s] of scenarios, of whichever of them are simulated together."""
        s = self.settings
        body, tubes = self.filled(gamma.detach()), replace(scenarios, tube_mass=None)
        stiff = varied(body, tubes.stiffest())
        return self.simulator().step(stiff, self.prony, duration=s.settle + s.duration, sample_every=s.sample_every)

    def _with_void(self, trajectory: Trajectory, rest: Tensor, keep: Tensor) -> Trajectory:
        """Every particle's motion [S, N, 3]: of void, which was left out, that of the centre of gravity."""
        moved = trajectory.center_of_gravity - trajectory.center_of_gravity[0]
        position, velocity = rest + moved[:, None], torch.zeros_like(rest).expand(len(moved), -1, -1).clone()
        position[:, keep], velocity[:, keep] = trajectory.position, trajectory.velocity
        probes = torch.arange(len(rest), device=rest.device)
        return replace(trajectory, position=position, velocity=velocity, probes=probes)

    def carried(self, count: int, whole: int | None = None) -> int:
        """Simulations that are carried on where so many are asked for, as a share of so many: a CPU's lanes are filled.

        Where the whole is so few that lanes are cells of each simulation, none is added.
        """
        if not self.formulation.in_lanes(self.field.phi) or (whole or count) < self._fewest:
            return count
        return count + -count % LANES

    @cached_property
    def _fewest(self) -> int:
        return fewest(Lattice.around(self.domain.positions.double(), self.domain.cell))

    def simulator(self, parts: int = 1, dt: float | None = None) -> Simulator:
        """A simulator, in whose box it moves, that takes a part of the usual step; or the step ``dt`` [s]."""
        s = self.settings
        half = (s.size[0] / 2, s.size[1] / 2)
        return Simulator(
            cell=self.domain.cell,
            dt=dt or ("auto" if s.dt == "auto" else s.dt / parts),
            safety=0.9 / parts,
            low=(-half[0] - s.room, -half[1] - s.room, -s.room),
            high=(half[0] + s.room, half[1] + s.room, s.size[2] + s.room),
            formulation=self.formulation,
            memory_budget=int(s.memory * 2**30) or None,
            together=self.carried(s.scenarios) or None,  # by however many processes
            self_contact=s.self_contact,
        )


def build(settings: Settings) -> Robot:
    """The robot that the settings name."""
    return {"walker": walker, "climber": climber, "turner": turner}[settings.robot](settings)


def walker(settings: Settings) -> Robot:
    """A robot on the ground that is to travel along +x, symmetric left and right (y)."""
    planes = (ground(0.0, friction=settings.friction),)
    return Robot(settings, planes=planes, direction=(1.0, 0.0, 0.0), symmetry=("y",))


def climber(settings: Settings) -> Robot:
    """A robot between two walls, normal to x, that is to travel upward, symmetric about both vertical mid planes."""
    half = settings.wall_distance / 2
    if settings.wall_distance < settings.size[0]:
        raise ValueError(f"wall_distance = {settings.wall_distance} m: wanted at least the body's {settings.size[0]} m")
    planes = (
        Plane(axis=0, offset=-half, side=1, friction=settings.friction),
        Plane(axis=0, offset=half, side=-1, friction=settings.friction),
    )
    return Robot(settings, planes=planes, direction=(0.0, 0.0, 1.0), symmetry=("x", "y"))


def turner(settings: Settings) -> Robot:
    """A walker whose chambers lie side by side in y, mirror images of each other, and which is to turn to the left.

    The body is symmetric: with the supply mirrored it turns as far to the right.

    Raises:
        ValueError: for a supply that works both sides alike, on which a symmetric body goes straight on.
    """
    s = settings
    if s.chambers < 2 or s.chamber_axis != "y":
        raise ValueError(
            f"chambers = {s.chambers}, chamber_axis = {s.chamber_axis!r}: wanted at least 2 along 'y' to turn"
        )
    lists = (s.amplitudes, s.phases, s.duties)
    if all(values == values[::-1] for values in lists):
        raise ValueError(
            f"amplitudes, phases, duties = {', '.join(map(str, lists))}: "
            "wanted some that differ from left to right, or the robot goes straight on"
        )
    return walker(settings)


def _outermost(domain: Domain, planes: tuple[Plane, ...]) -> Tensor:
    """Particles of the layers that face a plane [n]."""
    place, faces = domain.positions, torch.zeros(domain.count, dtype=torch.bool)
    for plane in planes:
        along = plane.side * place[:, plane.axis]
        faces |= along < along.min() + 0.5 * domain.spacing
    return faces.nonzero().squeeze(1)
