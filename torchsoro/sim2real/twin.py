"""The twin: a setup's body as particles, and what acts on it, as one scenario that hypotheses may change."""

from __future__ import annotations

import dataclasses
import itertools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsoro.contact import Plane
from torchsoro.loads import Force
from torchsoro.material import VOID_DRAG, Body, Gas, Prony, Solid
from torchsoro.sim2real.experiment import Boundary, Box, Setup, Trial
from torchsoro.sim2real.scenario import Scenario
from torchsoro.simulator import Simulator

BEHIND = 4  # layers of particles behind the face of a clamp, two cells
# Nodes in a clamp are held half a cell in front of its face, and the strain of a spline rises only slowly from there: a
# bar acts as one that is 0.29 cells shorter. The first cell in front of a clamp is softer by this factor, which gives
# bars of 3 to 6 cells across the frequency of their true length.
SOFTER = 0.61
FILLER = 3e3  # of chambers [Pa], as in Gas
# Of chambers [kg/m3]: a thousandth of the body, but the filler's waves are no faster than those of a soft solid.
AIR = 8.0
SAMPLE = 2.5e-3  # s between two samples, between which motion is a cubic


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """How markers moved; float64.

    Attributes:
        time: [S] s, evenly spaced.
        place: [..., S, M, 3] m.
        velocity: [..., S, M, 3] m/s.
        gradient: Deformation gradient at the markers [..., S, M, 3, 3].
        dt: Substep [s].
    """

    time: Tensor
    place: Tensor
    velocity: Tensor
    gradient: Tensor
    dt: float

    def parts(self, count: int) -> list[Motion]:
        """Equal parts of a batch."""
        cut = {name: getattr(self, name).chunk(count) for name in ("place", "velocity", "gradient")}
        return [dataclasses.replace(self, **{name: c[i] for name, c in cut.items()}) for i in range(count)]

    def alone(self, number: int = 0) -> Motion:
        """One of a batch."""
        if self.place.ndim == 3:
            return self
        return dataclasses.replace(
            self, place=self.place[number], velocity=self.velocity[number], gradient=self.gradient[number]
        )


class Twin:
    """A body of particles on a lattice, clamped, with chambers, and markers that move with it.

    Boxes are filled exactly: a particle on a face that is no lattice plane has the share of mass that lies within the
    body, and the share of stiffness that gives it the bending stiffness of the box.

    Args:
        setup: What is believed.
        spacing: Of the particles, half a cell [m].
        device: To simulate on.

    Raises:
        ValueError: for a clamp that is not a whole face, a plane that is not parallel to the axes, a chamber that does
            not fit, or a body with a mesh.
    """

    def __init__(
        self,
        setup: Setup,
        *,
        spacing: float,
        device: str | torch.device = "cpu",
    ) -> None:
        if setup.mesh is not None:
            raise ValueError(f"setup: body of {setup.mesh.name}, wanted a box")
        self.setup, self.spacing = setup, spacing
        self.device = torch.device(device)
        self.faces = [_face(box, setup) for box in setup.clamps]
        low, counts = self._lattice()
        self.low, self.counts = low, counts
        axes = [a + (torch.arange(n, dtype=torch.float64) + 0.5) * spacing for a, n in zip(low, counts, strict=True)]
        places = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        body = [list(setup.origin), [o + s for o, s in zip(setup.origin, setup.size, strict=True)]]
        for axis, side in self.faces:  # what a clamp holds goes on behind it
            body[side > 0][axis] += side * BEHIND * spacing
        share = _overlap(places, spacing, (tuple(body[0]), tuple(body[1])))  # type: ignore[arg-type]
        chamber = torch.full((len(places),), -1, dtype=torch.int32)
        for number, cavity in enumerate(setup.cavities):
            within = _overlap(places, spacing, cavity.box) > 0.5
            if not bool(within.any()):
                raise ValueError(
                    f"chamber {cavity.name!r}: narrower than a particle of {spacing:g} m, wanted a finer twin"
                )
            chamber[within] = number
        keep = share > 1e-3
        self.positions, self.chamber = places[keep], chamber[keep]
        self.air = self.chamber >= 0
        self.share = torch.where(self.air, 1.0, share[keep])
        self.stiff = torch.where(self.air, 1.0, share[keep] * self._bending())
        self.softer = torch.ones_like(self.share)
        for axis, side in self.faces:
            depth = self.depth(axis, side)
            self.softer = torch.where((depth > 0) & (depth < 2 * spacing), SOFTER, self.softer)
        self.probes, self.weights, self.slopes = self._markers(torch.tensor([m.at for m in setup.markers]).double())

    @property
    def count(self) -> int:
        """Number of particles."""
        return len(self.positions)

    def face(self, axis: int, side: int) -> float:
        """Where a face of the body is along its axis [m]."""
        return self.setup.origin[axis] + (self.setup.size[axis] if side > 0 else 0.0)

    def depth(self, axis: int, side: int) -> Tensor:
        """How far particles are in front of a face, within the body [N] m."""
        return side * (self.face(axis, side) - self.positions[:, axis])

    @property
    def inside(self) -> Tensor:
        """Particles of the body proper: not behind a clamp, no air; bool [N]."""
        low = torch.tensor(self.setup.origin, dtype=torch.float64)
        size = torch.tensor(self.setup.size, dtype=torch.float64)
        x = self.positions
        rim = 0.4999 * self.spacing  # the middle of a cut particle may lie outside
        return ((x > low - rim) & (x < low + size + rim)).all(-1) & ~self.air

    def _bending(self) -> Tensor:
        """Factor for the stiffness of outer particles that are cut on both sides alike [N].

        The stiffness of a cut particle acts in its middle, outside of the body, and would stiffen a bar of seven and a
        half layers by 4 %.
        """
        factor = torch.ones(len(self.positions), dtype=torch.float64)
        h = self.spacing
        for axis in range(3):
            begin, size = self.setup.origin[axis], self.setup.size[axis]
            z = (self.positions[:, axis] - begin - size / 2) / h
            half = size / h / 2
            outer = z.abs() + 0.5 > half + 1e-6
            if any(a == axis for a, _ in self.faces) or not bool(outer.any()):
                continue
            layers = torch.unique(z.round(decimals=6))
            rim = layers.abs() + 0.5 > half + 1e-6
            if int(rim.sum()) != 2 or abs(float(layers.sum())) > 1e-6:
                continue
            second = layers**2 + 1 / 12
            cut = float(half + 0.5 - layers.abs().max())
            wanted = (2 * half) ** 3 / 12 - float(second[~rim].sum())
            factor = torch.where(outer, factor * wanted / float(second[rim].sum()) / cut, factor)
        return factor

    def _lattice(self) -> tuple[list[float], list[int]]:
        """Lower corner and counts of a lattice around the body: on the faces of clamps and chambers where possible."""
        s, h = self.setup, self.spacing
        low, counts = [], []
        for axis in range(3):
            clamped = [side for a, side in self.faces if a == axis]
            begin, end = s.origin[axis], s.origin[axis] + s.size[axis]
            anchor = end if 1 in clamped else begin
            exact = abs(s.size[axis] / h - round(s.size[axis] / h)) < 1e-6
            if not clamped and not s.cavities:
                # Both faces are alike.
                anchor = begin if exact else (begin + end) / 2 - h * math.ceil(s.size[axis] / h) / 2
            before = math.ceil((anchor - begin) / h - 1e-6) if anchor > begin else 0
            first = anchor - h * max(before, 0)
            if first > begin + 1e-9:
                first -= h
            if -1 in clamped:
                first = begin - BEHIND * h
            if 1 in clamped:
                end = end + BEHIND * h
                # Whole cells from the clamp.
                layers = math.ceil((end - first) / h - 1e-6)
                first -= (layers % 2) * h
            low.append(first)
            counts.append(math.ceil((end - first) / h - 1e-6))
        return low, counts

    def _markers(self, at: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Eight particles around or beside each marker [M, 8], their weights, and the slopes of those [M, 8, 3]."""
        nx, ny, nz = self.counts
        number = torch.full((nx * ny * nz,), -1, dtype=torch.int64)
        low = torch.tensor(self.low, dtype=torch.float64)
        grid = ((self.positions - low) / self.spacing - 0.5).round().long()
        number[(grid[:, 0] * ny + grid[:, 1]) * nz + grid[:, 2]] = torch.arange(len(grid))
        corners = torch.tensor(list(itertools.product((0, 1), repeat=3)))
        there = number.view(nx, ny, nz)
        probes, weights, slopes = [], [], []
        for point in at:
            exact = (point - low) / self.spacing - 0.5
            corner = exact.floor().long()
            for axis, n in enumerate(self.counts):
                corner[axis] = corner[axis].clamp(0, n - 2)
            # A cell of eight particles that are there, the nearest.
            best, far = None, math.inf
            for offset in itertools.product((0, -1, 1, -2, 2), repeat=3):
                c = corner + torch.tensor(offset)
                if bool((c < 0).any()) or bool((c > torch.tensor(self.counts) - 2).any()):
                    continue
                ids = there[tuple((c + corners).T)]
                if bool((ids < 0).any()) or bool(self.air[ids].any()):
                    continue
                away = float(((c + 0.5 - exact) ** 2).sum())
                if away < far:
                    best, far = (c, ids), away
            if best is None:
                raise ValueError(f"marker at {point.tolist()} m: no part of the body beside it")
            c, ids = best
            t = exact - c
            factor = torch.where(corners == 1, t, 1 - t)
            sign = torch.where(corners == 1, 1.0, -1.0).double() / self.spacing
            probes.append(ids)
            weights.append(factor.prod(-1))
            slopes.append(
                torch.stack([sign[:, a] * factor[:, [b for b in range(3) if b != a]].prod(-1) for a in range(3)], -1)
            )
        return torch.stack(probes), torch.stack(weights), torch.stack(slopes)

    def group(self, box: Box) -> tuple[Tensor, Tensor]:
        """Particles of a box and their shares, whose centre is that of the box.

        Raises:
            ValueError: if the body has no particle there.
        """
        weight = torch.where(self.air, 0.0, _overlap(self.positions, self.spacing, box) * self.share)
        middle = torch.tensor([(a + b) / 2 for a, b in zip(*box, strict=True)], dtype=torch.float64)
        return self._centred(weight, middle, f"box = {box}")

    def around(self, place: Tensor, radius: float | None = None) -> tuple[Tensor, Tensor]:
        """Solid particles within a radius [m] (1.5 spacings if None) of a place, and their shares, centred on it."""
        radius = 1.5 * self.spacing if radius is None else radius
        off = (self.positions - place).norm(dim=-1)
        near = torch.where(self.inside, off, torch.inf)
        reach = max(radius, float(near.min()) + 0.8 * self.spacing)
        weight = (1 - (off / reach) ** 2).clamp(min=0) * self.inside
        return self._centred(weight * self.share, place, f"place = {place.tolist()}")

    def _centred(self, weight: Tensor, middle: Tensor, what: str) -> tuple[Tensor, Tensor]:
        """Shares near to the weights, not negative, whose centre is as near to the middle as possible."""
        group = (weight > 0).nonzero().squeeze(1)
        if len(group) == 0:
            raise ValueError(f"{what}: no part of the body, wanted a place within it")
        w, x = weight[group] / weight[group].sum(), (self.positions[group] - middle) / self.spacing
        for _ in range(50):
            lever = torch.cat([torch.ones_like(x[:, :1]), x], 1)
            lack = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64) - w @ lever
            if float(lack.abs().max()) < 1e-9:
                break
            w = (w * (1 + lever @ torch.linalg.pinv(lever.T @ (w[:, None] * lever)) @ lack)).clamp(min=0)
        return group, w / w.sum()

    def scenario(self, trial: Trial) -> Scenario:
        """What is believed about a trial."""
        s = trial.setup
        solid = Solid(youngs_modulus=s.youngs_modulus, poisson_ratio=s.poisson_ratio, density=s.density)
        prony = None
        if s.prony:
            pairs = torch.tensor(s.prony, dtype=torch.float64)
            prony = Prony(moduli=pairs[:, 0].clone(), times=pairs[:, 1].clone())
        loads = []
        for load in s.loads:
            particles, share = self.group(load.box)
            force = torch.tensor(load.force, dtype=torch.float64)
            if load.start > 0:
                times = torch.tensor([load.start - 1e-6, load.start], dtype=torch.float64)
                loads.append(Force(particles=particles, value=torch.stack([0 * force, force]), time=times, share=share))
            else:
                loads.append(Force(particles=particles, value=force, share=share))
        center = torch.tensor(s.center, dtype=torch.float64)
        spin = torch.tensor(s.angular_velocity, dtype=torch.float64).expand(self.count, 3)
        start = torch.tensor(s.velocity, dtype=torch.float64) + torch.cross(spin, self.positions - center, dim=-1)
        filler = FILLER * 2 * (1 + s.poisson_ratio)
        return Scenario(
            stiffness=torch.where(self.air, filler, solid.youngs_modulus * self.stiff * self.softer),
            poisson_ratio=torch.tensor(s.poisson_ratio, dtype=torch.float64),
            density=torch.where(self.air, AIR, solid.density * self.share),
            prony=prony,
            viscosity=torch.zeros(self.count, dtype=torch.float64),
            air_stiffness=torch.tensor([c.air_stiffness for c in s.cavities], dtype=torch.float64),
            pressure=trial.pressure,
            gravity=torch.tensor(s.gravity, dtype=torch.float64),
            velocity=start,
            planes=tuple(_plane(p) for p in s.planes),
            loads=tuple(loads),
            duration=s.duration,
        )

    def body(self, s: Scenario) -> Body:
        """Particles of a scenario, float32."""
        nu = s.poisson_ratio.unsqueeze(-1)
        volume = self.spacing**3
        bulk, shear = s.stiffness / (3 * (1 - 2 * nu)), s.stiffness / (2 * (1 + nu))
        if self.setup.cavities:
            lost = s.air_stiffness[..., self.chamber.clamp(min=0).long()]
            bulk = torch.where(self.air, lost, bulk)
        drag = torch.where(self.air, VOID_DRAG * AIR * volume, 0.0)
        like = {"dtype": torch.float32, "device": self.device}
        return Body(
            position=self.positions.to(**like),
            mass=(s.density * volume).to(**like),
            volume=torch.full((self.count,), volume, **like),
            bulk=bulk.to(**like),
            shear=shear.to(**like),
            chamber=self.chamber.to(self.device),
            velocity=s.velocity.to(**like),
            viscosity=torch.where(self.air, Gas().viscosity, s.viscosity).to(**like),
            drag=drag.to(**like) if bool(self.air.any()) else None,
        )

    def simulate(self, s: Scenario) -> Motion:
        """Simulate a scenario.

        Args:
            s: What to simulate.

        Raises:
            SimulationDiverged: if it breaks down.
        """
        body = self.body(s)
        cell = 2 * self.spacing
        low = self.positions.amin(0) - 0.5
        high = self.positions.amax(0) + 0.5
        simulator = Simulator(cell=cell, dt="auto", low=low.tolist(), high=high.tolist(), formulation="total")
        held = []
        for axis, side in self.faces:
            face = self.face(axis, side)
            # The body is on the side away from the clamp; the first node in front of its face is held, too.
            held += [
                Plane(axis=axis, offset=face - side * (0.51 - i) * cell, side=-side, adhesion=1e12) for i in range(3)
            ]
        count = math.ceil(s.duration / SAMPLE)
        with torch.no_grad():
            seen = simulator(
                body,
                duration=count * SAMPLE,
                prony=s.prony,
                pressure=s.pressure,
                gravity=s.gravity,
                planes=(*held, *s.planes),
                loads=[dataclasses.replace(load, particles=load.particles.to(self.device)) for load in s.loads],
                sample_every=SAMPLE,
                probes=self.probes.flatten(),
            )
        shape = (*seen.position.shape[:-2], len(self.setup.markers), 8, 3)
        x, v = (t.double().cpu().reshape(shape) for t in (seen.position, seen.velocity))
        return Motion(
            time=seen.time.cpu(),
            place=torch.einsum("...mkc,mk->...mc", x, self.weights),
            velocity=torch.einsum("...mkc,mk->...mc", v, self.weights),
            gradient=torch.einsum("...mkc,mkd->...mcd", x, self.slopes),
            dt=seen.dt,
        )


def _overlap(places: Tensor, spacing: float, box: Box) -> Tensor:
    """Share of each particle's cube that lies in a box [N]."""
    low, high = (torch.tensor(corner, dtype=torch.float64) for corner in box)
    begin, end = torch.maximum(places - spacing / 2, low), torch.minimum(places + spacing / 2, high)
    return ((end - begin) / spacing).clamp(min=0).prod(-1)


def _face(box: Box, setup: Setup) -> tuple[int, int]:
    """Axis and side of the face of the body that a clamp covers."""
    low, high = box
    thin = 1e-9
    for axis in range(3):
        others = [a for a in range(3) if a != axis]
        begin, end = setup.origin[axis], setup.origin[axis] + setup.size[axis]
        covers = all(
            low[a] <= setup.origin[a] + thin and high[a] >= setup.origin[a] + setup.size[a] - thin for a in others
        )
        if covers and low[axis] <= begin + thin < high[axis] < end:
            return axis, -1
        if covers and begin < low[axis] < end - thin <= high[axis]:
            return axis, 1
    raise ValueError(f"clamp: box = {box}, wanted one that holds a whole face of the body")


def _plane(plane: Boundary) -> Plane:
    normal = torch.tensor(plane.normal, dtype=torch.float64)
    unit = normal / normal.norm()
    axis = int(unit.abs().argmax())
    if float(unit.abs()[axis]) < 1 - 1e-9:
        raise ValueError(f"plane: normal = {plane.normal}, wanted one along x, y or z (tilt gravity instead)")
    return Plane(axis=axis, offset=plane.point[axis], side=1 if float(unit[axis]) > 0 else -1, friction=plane.friction)
