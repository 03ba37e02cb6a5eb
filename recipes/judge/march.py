"""Explicit finite elements through time: one trial of one experiment in one world.

Total-Lagrangian, float64, central differences without damping of their own. The law is the compressible neo-Hookean one

    W = mu/2 (tr Cb - 3) + K/2 [(J - 1)^2 / 2 + (ln J)^2 / 2],   Cb = J^(-2/3) F^T F,

with Maxwell elements on its deviatoric part, of which the pulled-back stress S = (I - (tr Cb / 3) Cb^-1) / J is kept:
H' = -H / tau + S', sigma_dev = mu dev(Fb (S + sum g H) Fb^T).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from kernels import LANES, advance, area_vectors, drag, material, push
from lobatto import Floats, Ints, Mesh, box_mesh
from numpy.typing import NDArray
from world import World, chain_step

SAFETY = 0.8
STICK = 1e6
# Stiffness of the plate over that of the thinnest layer of elements. With 1 in place of 16, bodies bounce higher:
# a thrown block moves differently by 0.8 mm, a body that hops by millimetres.
PLATE = 16.0
AGREE = 1e-5  # root mean square difference [m] of motions of a step and of half of it, below which it is short enough
HALVINGS = 5  # of the step, at most
LANDING = 10.0  # loss of nodes that press on the plate, over the impedance of plane waves: they land without chatter


class Broken(RuntimeError):
    """An element turned inside out."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Plane:
    """Ground or wall.

    Attributes:
        point: On it [3] m.
        normal: Unit vector to the side of the body [3].
        friction: Coulomb coefficient; very large sticks.
    """

    point: Floats
    normal: Floats
    friction: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    """A trial as the solver sees it.

    Attributes:
        mesh: Of the body.
        shear: mu [Pa].
        bulk: K [Pa].
        density: [kg/m3].
        elements: Maxwell elements (relative modulus, time [s]).
        held: Clamped nodes [N].
        gravity: [3] m/s2.
        velocity: At the start [3] m/s.
        spin: At the start, about the body's centre [3] rad/s.
        loads: Nodes, weights, force [N], and start [s] of each dead load.
        plane: Ground, if any.
        air: Stiffness of the air in the chamber that is believed [Pa].
        pressure: Times [s] and pressures [Pa], both empty without a chamber.
        started: Time since the first trial began [s].
        lasting: Time of all trials together [s].
    """

    mesh: Mesh
    shear: float
    bulk: float
    density: float
    elements: tuple[tuple[float, float], ...]
    held: NDArray[np.bool_]
    gravity: Floats
    velocity: Floats
    spin: Floats
    loads: tuple[tuple[Ints, Floats, Floats, float], ...]
    plane: Plane | None
    air: float
    pressure: tuple[Floats, Floats]
    started: float = 0.0
    lasting: float = 1.0


def _filled(box: Sequence[Sequence[float]], mesh: Mesh, parts: int = 9) -> Floats:
    low = np.maximum(np.asarray(box[0], float), mesh.nodes.min(0))
    high = np.minimum(np.asarray(box[1], float), mesh.nodes.max(0))
    s = (np.arange(parts) + 0.5) / parts
    grid = np.stack(np.meshgrid(s, s, s, indexing="ij"), -1).reshape(-1, 3)
    return low + grid * (high - low)


def mesh_of(setup: dict[str, Any], target: float) -> Mesh:
    """Mesh of the body of setup.toml, elements about ``target`` [m] long."""
    body = setup["body"]
    chambers = [c["box"] for c in setup.get("chamber", [])]
    return box_mesh(body["origin"], body["size"], chambers, target, body.get("missing", ()))


def case_of(setup: dict[str, Any], mesh: Mesh, pressure: Sequence[tuple[float, float]] = (), **times: float) -> Case:
    """The believed trial, from the tables of setup.toml that trial.toml has already changed."""
    law = setup["material"]
    young, nu = law["youngs_modulus"], law["poisson_ratio"]
    held = np.zeros(len(mesh.nodes), bool)
    for clamp in setup.get("clamp", []):
        for low, high in [clamp["box"]]:
            held |= ((mesh.nodes > np.asarray(low) - 1e-9) & (mesh.nodes < np.asarray(high) + 1e-9)).all(1)
    loads = []
    for load in setup.get("load", []):
        nodes, weights = mesh.spread(_filled(load["box"], mesh))
        loads.append((nodes, weights, np.asarray(load["force"], float), float(load.get("start", 0.0))))
    plane = None
    for table in setup.get("plane", []):
        friction = STICK if table["friction"] == "stick" else float(table["friction"])
        normal = np.asarray(table["normal"], float)
        point = np.asarray(table["point"], float)
        plane = Plane(point=point, normal=normal / np.linalg.norm(normal), friction=friction)
    start = setup.get("start", "rest")
    start = {} if start == "rest" else start
    trace = np.asarray(pressure, float).reshape(-1, 2)
    return Case(
        mesh=mesh,
        shear=young / (2 * (1 + nu)),
        bulk=young / (3 * (1 - 2 * nu)),
        density=law["density"],
        elements=tuple((float(g), float(t)) for g, t in law.get("prony", [])),
        held=held,
        gravity=np.asarray(setup["gravity"], float),
        velocity=np.asarray(start.get("velocity", (0, 0, 0)), float),
        spin=np.asarray(start.get("angular_velocity", (0, 0, 0)), float),
        loads=tuple(loads),
        plane=plane,
        air=sum(c.get("air_stiffness", 0.0) for c in setup.get("chamber", [])),
        pressure=(trace[:, 0], trace[:, 1]),
        **times,
    )


def turned(vector: Floats, rotation: Sequence[float] | Floats) -> Floats:
    """A vector [..., 3] turned by a rotation vector [rad]."""
    angle = float(np.linalg.norm(rotation))
    if angle == 0:
        return np.asarray(vector, float)
    axis = np.asarray(rotation) / angle
    along = (vector @ axis)[..., None] * axis
    return along + math.cos(angle) * (vector - along) + math.sin(angle) * np.cross(axis, vector)


class March:
    """One trial under way.

    Attributes:
        x: Positions [N, 3] m.
        v: Velocities half a step behind [N, 3] m/s.
        mass: [N] kg, with what is attached.
        dt: Step [s].
        t: Time of ``x`` [s].
    """

    def __init__(self, case: Case, world: World, step: float = 0.0) -> None:
        """Prepare; a step of 0 takes the longest that is stable."""
        mesh = case.mesh
        self.case, self.world = case, world
        self.x = mesh.nodes.copy()
        self.v = np.zeros_like(self.x)
        self.force = np.zeros_like(self.x)
        self.t = 0.0
        self.mass = np.bincount(mesh.cells.ravel(), mesh.weight.ravel(), len(self.x)) * case.density * world.density
        self.masses = [_ball(mesh, lump.point, lump.radius) for lump in world.lumps]
        for lump, (nodes, weights) in zip(world.lumps, self.masses, strict=True):
            if not lump.frequency:
                self.mass[nodes] += lump.mass * weights
        depth = (mesh.nodes[mesh.cells] - np.asarray(world.soft_at)) @ np.asarray(world.soft_normal)
        factor = world.modulus * (1 - world.soft * 0.5 * (1 + np.tanh(depth / world.soft_width)))
        self.shear, self.bulk = case.shear * factor, case.bulk * factor
        self.elements = np.asarray((*case.elements, *world.elements), float).reshape(-1, 2)
        self.law = np.array([world.gent, world.softening, world.softening_energy])
        self.area = mesh.outside.share(len(self.x))
        self._ground()
        self.dt = step or SAFETY * self.longest()
        self._memory(self.dt)
        self._start()

    def _ground(self) -> None:
        case, world, mesh = self.case, self.world, self.case.mesh
        wave = float((self.bulk + 4 / 3 * self.shear).max())
        plate = PLATE * wave / mesh.size.min(), LANDING * math.sqrt(wave * case.density)
        stiff, loss = (world.foam, world.foam_loss) if world.foam else plate
        self.ground = np.array([stiff, loss, world.adhesion, world.adhesion_reach])
        self.plane, self.coulomb = np.zeros(6), np.array([0.0, 0.0, 1.0])
        if case.plane is None:
            self.area = np.zeros_like(self.area)
        else:
            point = case.plane.point + world.plane_offset * case.plane.normal
            self.plane = np.concatenate([point, case.plane.normal])
            mu = case.plane.friction
            self.coulomb = np.asarray(world.friction or (mu, mu, 1.0), float)

    def _memory(self, dt: float) -> None:
        count, elements = len(self.case.mesh.cells), len(self.elements)
        ratio = dt / self.elements[:, 1]
        self.discrete = np.stack([np.exp(-ratio), -np.expm1(-ratio) / ratio, self.elements[:, 0]], -1)
        self.old = np.zeros((count, 6, LANES))
        self.history = np.zeros((count, elements, 6, LANES))
        self.peak = np.zeros((count, 27))

    def _start(self) -> None:
        case, world, mesh = self.case, self.world, self.case.mesh
        centre = (self.mass[:, None] * self.x).sum(0) / self.mass.sum()
        speed = np.asarray(world.velocity)
        if case.held.any():
            low, high = mesh.nodes.min(0), mesh.nodes.max(0)
            base = mesh.nodes[case.held].mean(0)
            axis = int(np.argmax(np.abs((low + high) / 2 - base)))
            reach = np.abs(mesh.nodes[:, axis] - base[axis])
            self.v += (reach / reach.max())[:, None] ** 2 * speed
        else:
            self.v += case.velocity + speed
            self.v += np.cross(case.spin + np.asarray(world.spin), self.x - centre)
        self.v[case.held] = 0
        self.gravity = turned(case.gravity, world.gravity_turn)
        self.chains = []
        for chain in world.chains:
            nodes, weights = mesh.spread(np.asarray([chain.point], float))
            beads = chain.relaxed(np.asarray(chain.point, float), self.gravity)
            self.chains.append(
                (nodes, weights, beads, np.zeros_like(beads), np.asarray(chain.support, float), chain.numbers())
            )
        self.drawn: tuple[Ints, Floats] | None = None
        self.slosh = [np.zeros((2, 3)) for _ in world.lumps]
        if case.pressure[0].size:
            self.areas = np.zeros((len(mesh.chambers[0].nodes), 9, 3))
            self.first_volume = -area_vectors(self.x, mesh.chambers[0].nodes, mesh.chambers[0].sign, self.areas)
        self.skin = np.zeros((len(mesh.outside.nodes), 9, 3))
        self.kick = 0.5  # of a step: velocities start half a step behind
        self.arriving = np.zeros(0)

    def longest(self) -> float:
        """Longest stable step [s] of small motions, from the highest frequency of the instantaneous stiffness."""
        mesh = self.case.mesh
        stiff = self.shear * (1 + self.elements[:, 0].sum())
        rng = np.random.default_rng(0)
        u = rng.standard_normal(mesh.nodes.shape)
        u[self.case.held] = 0
        top = 0.0
        free, none = np.zeros(3), np.zeros((0, 3))
        scratch = (
            np.zeros((len(mesh.cells), 6, LANES)),
            np.zeros((len(mesh.cells), 0, 6, LANES)),
            np.zeros(mesh.weight.shape),
        )
        root = np.sqrt(self.mass)[:, None]
        for _ in range(60):
            u /= np.linalg.norm(u)
            force = np.zeros_like(u)
            at = mesh.nodes + 1e-7 * u / root
            material(
                at, mesh.nodes, mesh.cells, mesh.size, mesh.weight, stiff, self.bulk, none, *scratch[:2], free,
                scratch[2], force,
            )  # fmt: skip
            force[self.case.held] = 0
            u = -force / root / 1e-7
            top = float(np.linalg.norm(u))
        top += float((self.ground[0] * self.area / self.mass).max())
        return 2 / math.sqrt(1.05 * top)

    def _material(self) -> None:
        mesh = self.case.mesh
        shear, bulk = self.shear, self.bulk
        if self.world.heat:
            factor = 1 - self.world.heat * (self.case.started + self.t) / self.case.lasting
            shear, bulk = shear * factor, bulk * factor
        least = material(
            self.x, mesh.nodes, mesh.cells, mesh.size, mesh.weight, shear, bulk, self.discrete, self.old,
            self.history, self.law, self.peak, self.force,
        )  # fmt: skip
        if not least > 0.2:
            raise Broken(f"an element turned inside out at t = {self.t:.4g} s")

    def _pressure(self, number: int) -> None:
        case = self.case
        if not case.pressure[0].size:
            return
        if number >= len(self.arriving):
            t = np.arange(number + 4096) * self.dt
            self.arriving = self.world.line.arriving(np.interp(t, *case.pressure), self.dt)
        wall = case.mesh.chambers[0]
        ratio = -area_vectors(self.x, wall.nodes, wall.sign, self.areas) / self.first_volume
        inside = self.world.line.inside(float(self.arriving[number]), ratio) - case.air * (ratio - 1)
        push(wall.nodes, self.areas, inside, self.force)

    def _attached(self) -> None:
        for nodes, weights, beads, speed, support, numbers in self.chains:
            start, start_v = weights @ self.x[nodes], weights @ self.v[nodes]
            pull = chain_step(beads, speed, start, start_v, support, numbers, self.gravity, self.dt, 0.0)
            self.force[nodes] += weights[:, None] * pull
        for lump, (nodes, weights), state in zip(self.world.lumps, self.masses, self.slosh, strict=True):
            if lump.frequency:
                omega = 2 * math.pi * lump.frequency
                if self.t == 0:
                    state[0] = weights @ self.x[nodes] + self.gravity / omega**2
                reach = state[0] - weights @ self.x[nodes]
                rate = state[1] - weights @ self.v[nodes]
                pull = lump.mass * (omega**2 * reach + 2 * lump.damping * omega * rate)
                self.force[nodes] += weights[:, None] * pull
                state[1] += self.dt * (self.gravity - pull / lump.mass)
                state[0] += self.dt * state[1]
        if self.world.magnet is not None:
            at, fixed, strength = self.world.magnet
            nodes, weights = self.drawn or _ball(self.case.mesh, at, 0.004)
            self.drawn = nodes, weights
            reach = np.asarray(fixed) - weights @ self.x[nodes]
            far = max(float(np.linalg.norm(reach)), 0.004)
            self.force[nodes] += weights[:, None] * strength * (0.01 / far) ** 3 * reach / far

    def _air(self) -> None:
        wind = self.world.gust
        blowing = wind is not None and wind[1] < self.t < wind[2]
        if not (self.world.drag or blowing):
            return
        outside = self.case.mesh.outside
        area_vectors(self.x, outside.nodes, outside.sign, self.skin)
        if self.world.drag:
            drag(outside.nodes, self.skin, self.v, self.world.drag, self.force)
        if wind is not None and blowing:
            traction = np.asarray(wind[0]) * math.sin(math.pi * (self.t - wind[1]) / (wind[2] - wind[1])) ** 2
            facing = np.maximum(-self.skin @ traction / np.linalg.norm(traction), 0)
            for a in range(3):
                np.add.at(self.force[:, a], outside.nodes, facing * traction[a])

    def step(self, number: int) -> None:
        """One step."""
        self.force[:] = self.mass[:, None] * self.gravity
        self._material()
        self._pressure(number)
        for nodes, weights, force, start in self.case.loads:
            if self.t >= start:
                self.force[nodes] += weights[:, None] * force
        self._attached()
        self._air()
        dt = self.dt
        if number == 0:
            self.force *= self.kick
        advance(
            self.x, self.v, self.mass, self.force, dt, self.case.held, self.plane, self.area, self.ground, self.coulomb
        )
        self.t += dt

    def run(self, instants: Floats, nodes: Ints, shapes: Floats) -> Floats:
        """Positions [T, P, 3] m of points x = sum shapes * x[nodes] at increasing instants [T] s.

        A solid that stiffens, or that is steep below the largest stretch that softened it, needs a step that is shorter
        than near rest by as much as it stretches: that is halved until the motion is the same.

        Raises:
            Broken: if an element turns inside out, or if no step is short enough.
        """
        if not (self.world.gent or self.world.softening):
            return self._run(instants, nodes, shapes)
        found = None
        for k in range(1 + HALVINGS):
            again = March(self.case, self.world, self.dt / 2**k)
            try:
                before, found = found, again._run(instants, nodes, shapes)
            except Broken:
                before = found = None
            if before is not None and found is not None and math.sqrt(np.mean((found - before) ** 2)) < AGREE:
                return found
        raise Broken(f"no step down to {self.dt / 2**HALVINGS:.2g} s is short enough")

    def _run(self, instants: Floats, nodes: Ints, shapes: Floats) -> Floats:
        out = np.zeros((len(instants), len(nodes), 3))
        done, number = 0, 0
        while done < len(instants):
            before, last = np.einsum("pn,pna->pa", shapes, self.x[nodes]), self.t
            self.step(number)
            number += 1
            if self.t > instants[done]:
                after = np.einsum("pn,pna->pa", shapes, self.x[nodes])
                while done < len(instants) and instants[done] < self.t:
                    s = (instants[done] - last) / (self.t - last)
                    out[done] = (1 - s) * before + s * after
                    done += 1
        return out


def _ball(mesh: Mesh, point: Sequence[float], radius: float) -> tuple[Ints, Floats]:
    low, high = np.asarray(point) - radius, np.asarray(point) + radius
    points = _filled((list(low), list(high)), mesh)
    near = np.linalg.norm(points - np.asarray(point), axis=1) <= radius
    return mesh.spread(points[near])
