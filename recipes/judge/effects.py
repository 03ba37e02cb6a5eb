"""Effects by name: how their strength and place are drawn, what form they take here, and what is scored.

The forms differ from plain textbook terms on purpose. ``parameters`` holds the numbers that an explanation is scored
on; ``form`` what was really put in.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from lobatto import Floats
from march import turned
from specimens import Specimen
from world import ATMOSPHERE, Chain, Line, Lump, Vector, World

Draw = Callable[[World, Specimen, np.random.Generator], tuple[World, "Effect"]]


@dataclass(frozen=True, kw_only=True)
class Effect:
    """What was put in.

    Attributes:
        name: Of the library, or of what is outside of it.
        parameters: Scored numbers, the unit at the end of the name.
        form: Numbers of the form that it has here.
        location: In the undeformed body [m], of a local effect.
        window: First and last time [s], of an effect that acts for a while only.
        outside: Whether it is outside the library.
    """

    name: str
    parameters: dict[str, float]
    form: dict[str, Any]
    location: Vector | None = None
    window: tuple[float, float] | None = None
    outside: bool = False

    def table(self) -> dict[str, Any]:
        """For truth.sealed, with the keys of truth.json."""
        return {
            "name": self.name,
            "parameters": self.parameters,
            "form": self.form,
            "location_m": self.location,
            "time_window_s": self.window,
            "out_of_library": self.outside,
        }


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """A number between low and high whose logarithm is uniform."""
    return float(math.exp(rng.uniform(math.log(low), math.log(high))))


def _either(rng: np.random.Generator, low: float, high: float) -> float:
    factor = log_uniform(rng, low, high)
    return factor if rng.random() < 0.5 else 1 / factor


def _vector(v: Floats) -> Vector:
    return (float(v[0]), float(v[1]), float(v[2]))


def _spot(specimen: Specimen, rng: np.random.Generator) -> Vector:
    """A point on the surface, in the outer half where the body is clamped, below nothing that stands on the ground."""
    body = specimen.setup["body"]
    low, size = np.asarray(body["origin"]), np.asarray(body["size"])
    point = low + size * rng.uniform(0.1, 0.9, 3)
    if "clamp" in specimen.setup:
        axis = int(np.argmax(size))
        fixed = np.asarray(specimen.setup["clamp"][0]["box"])[:, axis].mean()
        away = rng.uniform(0.4, 0.95) * size[axis]
        point[axis] = low[axis] + away if fixed < low[axis] + size[axis] / 2 else low[axis] + size[axis] - away
        sides = [a for a in range(3) if a != axis]
        side = int(rng.choice(sides))
        point[side] = low[side] + size[side] * float(rng.integers(2))
    else:
        point[2] = low[2] + size[2]
    return _vector(point)


def viscoelastic(world: World, s: Specimen, rng: np.random.Generator) -> tuple[World, Effect]:
    """Two fast Maxwell elements."""
    slow, fast = rng.uniform(2e-3, 5e-3), rng.uniform(0.5e-3, 1.5e-3)
    total, share = log_uniform(rng, 0.15e-3, 6e-3), rng.uniform(0.3, 0.8)
    elements = ((share * total / slow, slow), ((1 - share) * total / fast, fast))
    law = s.setup["material"]
    shear = law["youngs_modulus"] / (2 * (1 + law["poisson_ratio"]))
    effect = Effect(
        name="viscoelastic",
        parameters={"viscosity_pa_s": world.modulus * shear * total},
        form={"prony": elements},
    )
    return replace(world, elements=elements), effect


def modulus(world: World, s: Specimen, rng: np.random.Generator) -> tuple[World, Effect]:
    """At least 25 % off, on top of the case's own error."""
    factor = _either(rng, 1.25, 1.8) * world.modulus
    factor = max(factor, 1.25) if factor > 1 else min(factor, 0.8)
    return replace(world, modulus=factor), Effect(name="modulus", parameters={"factor": factor}, form={})


def soft_side(world: World, s: Specimen, rng: np.random.Generator) -> tuple[World, Effect]:
    """One side softer, smoothly across some millimetres."""
    body = s.setup["body"]
    low, size = np.asarray(body["origin"]), np.asarray(body["size"])
    axis, way = int(rng.integers(3)), float(rng.choice((-1, 1)))
    normal = np.zeros(3)
    normal[axis] = way
    middle = low + size / 2
    part = float(rng.uniform(0.3, 0.6))
    at = middle + normal * size[axis] * (0.5 - part)
    fraction, width = log_uniform(rng, 0.05, 0.6), float(rng.uniform(0.002, 0.006))
    centre = middle + normal * size[axis] * (0.5 - part / 2)
    world = replace(world, soft=fraction, soft_at=_vector(at), soft_normal=_vector(normal), soft_width=width)
    form = {"normal": _vector(normal), "part": part, "width_m": width}
    return world, Effect(name="soft_side", parameters={"fraction": fraction}, form=form, location=_vector(centre))


def density(world: World, s: Specimen, rng: np.random.Generator) -> tuple[World, Effect]:
    """Of the whole body."""
    factor = _either(rng, 1.015, 1.6)
    return replace(world, density=factor), Effect(name="density", parameters={"factor": factor}, form={})


def attached_mass(world: World, s: Specimen, rng: np.random.Generator) -> tuple[World, Effect]:
    """A lump stuck to the surface."""
    mass, radius = s.body_mass * log_uniform(rng, 0.005, 0.25), float(rng.uniform(0.003, 0.007))
    point = _spot(s, rng)
    lump = Lump(point=point, mass=mass, radius=radius)
    effect = Effect(name="attached_mass", parameters={"mass_kg": mass}, form={"radius_m": radius}, location=point)
    return replace(world, lumps=(*world.lumps, lump)), effect


def tether(world: World, s: Specimen, rng: np.random.Generator) -> tuple[World, Effect]:
    """A hanging chain; scored on the mass that it hangs on the body at rest, and its stiffness over 4 mm."""
    point = np.asarray(_spot(s, rng))
    down = np.asarray(s.setup["gravity"]) / 9.81
    aside = rng.standard_normal(3)
    aside -= (aside @ down) * down
    aside /= np.linalg.norm(aside)
    span = float(rng.uniform(0.05, 0.10))
    support = point + span * (aside - 0.4 * float(rng.uniform(-1, 1)) * down)
    size = log_uniform(rng, 0.03, 1.0)
    chain = Chain(
        point=_vector(point),
        support=_vector(support),
        length=float(np.linalg.norm(support - point) * rng.uniform(0.99, 1.04)),
        mass=0.25 * s.body_mass * size,
        stiffness=80 * size * float(rng.uniform(0.3, 1)),
        damping=0.2 * size,
    )
    gravity = np.asarray(s.setup["gravity"], float)

    def pull(start: Floats) -> Floats:
        end = chain.relaxed(start, gravity)[0] - start
        stretch = float(np.linalg.norm(end)) - chain.numbers()[1]
        return max(chain.numbers()[2] * stretch, 0.0) * end / np.linalg.norm(end)

    away = (point - support) / np.linalg.norm(point - support)
    step = 4e-3
    stiffness = float((pull(point - step * away) - pull(point + step * away)) @ away) / (2 * step)
    effect = Effect(
        name="tether",
        parameters={"mass_kg": float(pull(point) @ down) / 9.81, "stiffness_n_m": stiffness},
        form={"support_m": chain.support, "length_m": chain.length, "mass_kg": chain.mass,
              "stiffness_n_m": chain.stiffness, "damping_n_s_m": chain.damping, "beads": chain.beads},
        location=chain.point,
    )  # fmt: skip
    return replace(world, chains=(*world.chains, chain)), effect


def _full(s: Specimen) -> float:
    return max(p for trial in s.trials for _, p in trial.pressure)


def pressure_lag(world: World, s: Specimen, rng: np.random.Generator) -> tuple[World, Effect]:
    """Two volumes in series."""
    lag = log_uniform(rng, 0.004, 0.08)
    effect = Effect(name="pressure_lag", parameters={"time_constant_s": lag}, form={"volumes": 2})
    return replace(world, line=replace(world.line, lag=lag)), effect


def pressure_loss(world: World, s: Specimen, rng: np.random.Generator) -> tuple[World, Effect]:
    """A fraction that grows with the pressure: half as large near zero."""
    loss = log_uniform(rng, 0.05, 0.45)
    full = _full(s)
    effect = Effect(name="pressure_loss", parameters={"fraction": 0.9 * loss}, form={"fraction_at_full": loss})
    return replace(world, line=replace(world.line, loss=loss, full=full)), effect


def leak(world: World, s: Specimen, rng: np.random.Generator) -> tuple[World, Effect]:
    """An orifice behind a supply that takes its time to fill the chamber."""
    strength, filling = log_uniform(rng, 0.05, 0.6), log_uniform(rng, 0.006, 0.03)
    root = (-strength + math.sqrt(strength**2 + 4)) / 2
    effect = Effect(
        name="leak",
        parameters={"fraction": 1 - root**2},
        form={"orifice": strength, "filling_s": filling},
    )
    return replace(world, line=replace(world.line, leak=strength, filling=filling, full=_full(s))), effect


def air_stiffness(world: World, s: Specimen, rng: np.random.Generator) -> tuple[World, Effect]:
    """Air closed off in chamber and line, by Boyle's law."""
    closed = log_uniform(rng, 0.05, 1.0)
    stiffness = closed * (ATMOSPHERE + 0.5 * _full(s))
    effect = Effect(name="air_stiffness", parameters={"air_stiffness_pa": stiffness}, form={"closed": closed})
    return replace(world, line=replace(world.line, closed=closed)), effect


def friction(world: World, s: Specimen, rng: np.random.Generator) -> tuple[World, Effect]:
    """Stribeck: larger at rest."""
    believed = s.setup["plane"][0]["friction"]
    sliding = log_uniform(rng, 0.12, 0.9) if believed == "stick" else believed * _either(rng, 1.1, 3.0)
    rest, speed = sliding * float(rng.uniform(1.1, 1.5)), log_uniform(rng, 0.01, 0.1)
    form = {"at_rest": rest, "stribeck_m_s": speed, "believed": believed}
    effect = Effect(name="friction", parameters={"coefficient": sliding}, form=form)
    return replace(world, friction=(sliding, rest, speed)), effect


def adhesion(world: World, s: Specimen, rng: np.random.Generator) -> tuple[World, Effect]:
    """A traction that grows and fades with the gap, without history."""
    traction, reach = log_uniform(rng, 5, 1000), float(rng.uniform(1e-4, 5e-4))
    effect = Effect(
        name="adhesion",
        parameters={"energy_j_m2": math.e * traction * reach},
        form={"traction_pa": traction, "reach_m": reach},
    )
    return replace(world, adhesion=traction, adhesion_reach=reach), effect


def wall_offset(world: World, s: Specimen, rng: np.random.Generator) -> tuple[World, Effect]:
    """Ground higher or lower."""
    low = s.setup["body"]["origin"][2]
    offset = log_uniform(rng, 0.4 * low, 3 * low)
    if offset > 0.9 * low or rng.random() < 0.5:
        offset = -offset
    return replace(world, plane_offset=offset), Effect(name="wall_offset", parameters={"offset_m": offset}, form={})


def gravity_tilt(world: World, s: Specimen, rng: np.random.Generator) -> tuple[World, Effect]:
    """Gravity turned about an axis across it, of a filmed body about that of the camera."""
    down = np.asarray(s.setup["gravity"]) / 9.81
    axis = np.array([0.0, 1.0, 0.0]) if "axes" in s.setup["recording"] else rng.standard_normal(3)
    axis -= (axis @ down) * down
    axis /= np.linalg.norm(axis)
    angle = math.radians(log_uniform(rng, 0.8, 20)) * float(rng.choice((-1, 1)))
    form = {"gravity": _vector(turned(9.81 * down, angle * axis))}
    effect = Effect(name="gravity_tilt", parameters={"angle_rad": abs(angle)}, form=form)
    return replace(world, gravity_turn=_vector(angle * axis)), effect


def initial_motion(world: World, s: Specimen, rng: np.random.Generator) -> tuple[World, Effect]:
    """A clamped body already swings; a thrown one spins and is a little faster. Scored on the largest speed."""
    way = rng.standard_normal(3)
    if "axes" in s.setup["recording"]:
        way[1] = 0
    if "clamp" in s.setup:
        way[int(np.argmax(s.setup["body"]["size"]))] = 0
        way /= np.linalg.norm(way)
        speed = log_uniform(rng, 0.01, 0.6)
        effect = Effect(name="initial_motion", parameters={"speed_m_s": speed}, form={"direction": _vector(way)})
        return replace(world, velocity=_vector(speed * way)), effect
    way /= np.linalg.norm(way)
    rate = log_uniform(rng, 0.1, 5)
    speed = 0.01 * rate
    spin = rate * (np.array([0, 1.0, 0]) * float(rng.choice((-1, 1))))
    reach = 0.5 * math.hypot(s.setup["body"]["size"][0], s.setup["body"]["size"][2])
    effect = Effect(
        name="initial_motion",
        parameters={"speed_m_s": rate * reach + speed},
        form={"spin_rad_s": _vector(spin), "velocity_m_s": _vector(speed * way)},
    )
    return replace(world, velocity=_vector(speed * way), spin=_vector(spin)), effect


def drag(world: World, s: Specimen, rng: np.random.Generator) -> tuple[World, Effect]:
    """Quadratic, on the normal motion of the surface; scored as fluid density times drag coefficient.

    The force on a body of frontal area A is that times A v^2 / 2; here half of it acts on the front, half on the back.
    The largest is that of a plate across its motion in water.
    """
    value = log_uniform(rng, 8, 500)
    effect = Effect(name="drag", parameters={"density_drag_kg_m3": 4 * value}, form={})
    return replace(world, drag=value), effect


def stiffening(world: World, s: Specimen, rng: np.random.Generator) -> tuple[World, Effect]:
    """Gent: mu / (1 - (I1 - 3) / Jm); scored on 1 / Jm."""
    value = log_uniform(rng, 0.25, 6.0)
    effect = Effect(name="stiffening", parameters={"coefficient": value}, form={"limit": 1 / value})
    return replace(world, gent=value), effect


def softening(world: World, s: Specimen, rng: np.random.Generator) -> tuple[World, Effect]:
    """Ogden and Roxburgh; scored on the largest fraction lost, 1 / r."""
    depth, energy = log_uniform(rng, 0.05, 0.65), log_uniform(rng, 30, 600)
    effect = Effect(name="softening", parameters={"depth": depth}, form={"r": 1 / depth, "energy_pa": energy})
    return replace(world, softening=depth, softening_energy=energy), effect


def sloshing(world: World, s: Specimen, rng: np.random.Generator) -> tuple[World, Effect]:
    """A mass that swings on the body in a soft spring."""
    mass, frequency = s.body_mass * log_uniform(rng, 0.03, 0.2), float(rng.uniform(3, 9))
    point = _spot(s, rng)
    lump = Lump(point=point, mass=mass, frequency=frequency, damping=float(rng.uniform(0.02, 0.1)))
    form = {"mass_kg": mass, "frequency_hz": frequency, "damping": lump.damping}
    effect = Effect(name="sloshing", parameters={}, form=form, location=point, outside=True)
    return replace(world, lumps=(*world.lumps, lump)), effect


def magnet(world: World, s: Specimen, rng: np.random.Generator) -> tuple[World, Effect]:
    """A fixed point near the body draws a point of it."""
    point = np.asarray(_spot(s, rng))
    way = rng.standard_normal(3)
    way[2] = abs(way[2])
    fixed = point + way / np.linalg.norm(way) * rng.uniform(0.015, 0.03)
    strength = 9.81 * s.body_mass * log_uniform(rng, 1, 6)
    form = {"at_m": _vector(fixed), "force_at_10mm_n": strength}
    effect = Effect(name="magnet", parameters={}, form=form, location=_vector(point), outside=True)
    return replace(world, magnet=(_vector(point), _vector(fixed), strength)), effect


def gust(world: World, s: Specimen, rng: np.random.Generator) -> tuple[World, Effect]:
    """A wind for some tenths of a second."""
    duration = s.setup["duration"]
    start = float(rng.uniform(0.2, 0.6)) * duration
    window = (start, start + float(rng.uniform(0.1, 0.3)) * duration)
    angle = rng.uniform(0, 2 * math.pi)
    pressure = 9.81 * s.body_mass / np.prod(sorted(s.setup["body"]["size"])[1:]) * log_uniform(rng, 0.4, 3)
    traction = _vector(pressure * np.array([math.cos(angle), 0.3, math.sin(angle)]))
    effect = Effect(name="gust", parameters={}, form={"traction_pa": traction}, window=window, outside=True)
    return replace(world, gust=(traction, *window)), effect


def heat(world: World, s: Specimen, rng: np.random.Generator) -> tuple[World, Effect]:
    """The body warms up: its modulus falls from the first trial to the last."""
    lost = log_uniform(rng, 0.15, 0.5)
    return replace(world, heat=lost), Effect(name="heat", parameters={}, form={"lost_at_end": lost}, outside=True)


def foam(world: World, s: Specimen, rng: np.random.Generator) -> tuple[World, Effect]:
    """A floor that gives and damps."""
    stiffness = log_uniform(rng, 3e4, 5e5)
    loss = stiffness * log_uniform(rng, 2e-3, 2e-2)
    form = {"stiffness_pa_m": stiffness, "loss_pa_s_m": loss}
    return replace(world, foam=stiffness, foam_loss=loss), Effect(name="foam", parameters={}, form=form, outside=True)


LIBRARY: dict[str, Draw] = {
    f.__name__: f
    for f in (
        viscoelastic, modulus, soft_side, density, attached_mass, tether, pressure_lag, pressure_loss, leak, friction,
        adhesion, wall_offset, gravity_tilt, initial_motion, drag, stiffening, softening, air_stiffness,
    )
}  # fmt: skip
OUTSIDE: dict[str, Draw] = {f.__name__: f for f in (sloshing, magnet, gust, heat, foam)}


def own_world(s: Specimen, rng: np.random.Generator) -> World:
    """What differs in every case: the modulus by up to 10 %, the pressure gain by up to 5 %."""
    gain = float(rng.uniform(0.95, 1.05)) if "chamber" in s.setup else 1.0
    return World(modulus=float(rng.uniform(0.9, 1.1)), line=Line(gain=gain))
