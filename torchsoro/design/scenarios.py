"""Scenarios: what a robot meets that its design does not decide, as distributions, and samples of them.

Torch is imported where it is used: the settings check their ranges without it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from torch import Tensor

    from torchsoro.simulation.actuation import Waveform
    from torchsoro.simulation.material import Body

Friction = float | Literal["stick"]

STICK = 1e30  # Coulomb coefficient that holds whatever is pressed on a plane, as "stick" does; finite in float32
# Largest tilt, pitch and roll [degrees]: a larger one is in another unit, or no floor to walk on.
STEEPEST = 60.0
HEAVIEST = 1.0  # largest mass of a tube [kg]: some forty robots of 35 mm; a larger one is in grams
# Longest step of a supply behind a lag [s], between which its pressure is linear: a fraction of a short line's lag.
FINEST = 1e-3
# Steps per time constant beyond which a lag is none: exp(-500) is zero beside any pressure, and still has a gradient.
PROMPT = 500.0

NOMINAL = {
    "friction": None,
    "tilt_x": 0.0,
    "tilt_y": 0.0,
    "pressure_gain": 1.0,
    "lag": 0.0,
    "modulus_factor": 1.0,
    "density_factor": 1.0,
    "tube_mass": 0.0,
    "pitch": 0.0,
    "roll": 0.0,
    "drop": 0.0,
}
"""What each quantity is for the robot of the settings alone; None is their friction."""

LIMITS = {
    "tilt_x": (-STEEPEST, STEEPEST, "degrees"),
    "tilt_y": (-STEEPEST, STEEPEST, "degrees"),
    "pressure_gain": (0.0, 10.0, "times the pressure"),
    "lag": (0.0, 10.0, "s"),
    "modulus_factor": (0.01, 100.0, "times the modulus"),
    "density_factor": (0.01, 100.0, "times the density"),
    "tube_mass": (0.0, HEAVIEST, "kg"),
    "pitch": (-STEEPEST, STEEPEST, "degrees"),
    "roll": (-STEEPEST, STEEPEST, "degrees"),
    "drop": (0.0, 10.0, "m"),
}
"""Least and largest of every quantity but friction, with its unit: beyond, it is most likely in another one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ScenarioBatch:
    """Scenarios to simulate at once; every tensor [S] is a differentiable input, and None leaves the robot as it is.

    Attributes:
        count: S.
        friction: Coulomb coefficient of all planes; ``STICK`` holds.
        tilt_x: Uphill slope of the floor along +x, beyond the settings' [degrees]; gravity leans, the floor stays.
        tilt_y: Likewise along +y.
        pressure_gain: Factor of the supply's pressure.
        lag: Time constant of a line behind the supply [s].
        modulus_factor: Factor of the solid's Young's modulus, Maxwell elements included.
        density_factor: Factor of the solid's density.
        tube_mass: Hangs where the chambers have their air ports, with inertia and weight [kg].
        pitch: Angle about y by which the robot leans forward at the start [degrees].
        roll: Angle about x by which it leans to its right, -y, at the start [degrees].
        drop: Height of its lowest corner at the start, above where the settings put it [m].

    Raises:
        ValueError: for a tensor that is not floating point [S].
    """

    count: int
    friction: Tensor | None = None
    tilt_x: Tensor | None = None
    tilt_y: Tensor | None = None
    pressure_gain: Tensor | None = None
    lag: Tensor | None = None
    modulus_factor: Tensor | None = None
    density_factor: Tensor | None = None
    tube_mass: Tensor | None = None
    pitch: Tensor | None = None
    roll: Tensor | None = None
    drop: Tensor | None = None

    def __post_init__(self) -> None:
        """Check the shapes."""
        if self.count < 1:
            raise ValueError(f"count = {self.count}: wanted at least one scenario")
        for name, value in self.given.items():
            if tuple(value.shape) != (self.count,) or not value.is_floating_point():
                raise ValueError(
                    f"{name}: {value.dtype} {tuple(value.shape)}, wanted a floating-point tensor ({self.count},)"
                )

    @property
    def given(self) -> dict[str, Tensor]:
        """The tensors that are there, by name."""
        return {name: value for name in NOMINAL if (value := getattr(self, name)) is not None}

    @property
    def posed(self) -> bool:
        """Whether a body may lean, or hang above the ground, at the start."""
        pose = [t for t in (self.pitch, self.roll, self.drop) if t is not None]
        return any(t.requires_grad or bool(t.any()) for t in pose)

    def part(self, index: Sequence[int]) -> ScenarioBatch:
        """The scenarios of these indices, in this order."""
        chosen = list(index)
        return replace(self, count=len(chosen), **{name: value[chosen] for name, value in self.given.items()})

    def stiffest(self) -> ScenarioBatch:
        """The one whose waves are the fastest, which sets the step of all."""
        import torch

        ratio = torch.ones(self.count, dtype=torch.float64)
        for factor, power in ((self.modulus_factor, 1), (self.density_factor, -1)):
            ratio = ratio if factor is None else ratio * factor.detach().cpu().double() ** power
        return self.part([int(ratio.argmax())])

    def row(self, index: int) -> dict[str, float]:
        """Numbers of a scenario by name; those that the robot's settings decide are left out."""
        return {name: float(value[index].detach()) for name, value in self.given.items()}


@dataclass(frozen=True, kw_only=True)
class Scenarios:
    """Distributions of a robot's scenarios, uniform between two bounds and independent of each other.

    Friction is uniform in the friction angle, atan of the coefficient, which is 90 degrees where nothing slides. The
    defaults vary nothing. Units are those of :class:`ScenarioBatch`.

    Attributes:
        friction: Coulomb coefficient, or "stick"; None for that of the settings.
        tilt_x: [degrees].
        tilt_y: [degrees].
        pressure_gain: Factor.
        lag: [s].
        modulus_factor: Factor.
        density_factor: Factor.
        tube_mass: [kg].
        pitch: [degrees].
        roll: [degrees].
        drop: [m].
        slopes: Uphill slopes, rise over run, whose angles are added to ``tilt_x``: in the order of the scenarios, the
            same number of them each, to one. Consecutive points of the sequence are spread evenly, so that each slope
            meets all of the other ranges.

    Raises:
        ValueError: for bounds that do not increase, or out of range; names the quantity.
    """

    friction: tuple[Friction, Friction] | None = None
    tilt_x: tuple[float, float] = (0.0, 0.0)
    tilt_y: tuple[float, float] = (0.0, 0.0)
    pressure_gain: tuple[float, float] = (1.0, 1.0)
    lag: tuple[float, float] = (0.0, 0.0)
    modulus_factor: tuple[float, float] = (1.0, 1.0)
    density_factor: tuple[float, float] = (1.0, 1.0)
    tube_mass: tuple[float, float] = (0.0, 0.0)
    pitch: tuple[float, float] = (0.0, 0.0)
    roll: tuple[float, float] = (0.0, 0.0)
    drop: tuple[float, float] = (0.0, 0.0)
    slopes: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """Check the bounds."""
        for name, (least, most, unit) in LIMITS.items():
            check_range(name, getattr(self, name), least, most, unit)
        if self.friction is not None:
            check_friction("friction", self.friction)

    def sample(self, count: int, seed: int) -> ScenarioBatch:
        """Draw scenarios by a scrambled Sobol sequence, the same for the same seed.

        Every quantity has an axis of its own in the sequence, whether it varies or not: what one is does not depend on
        which others vary.

        Args:
            count: S.
            seed: Of the scrambling, at least 0.

        Returns:
            The scenarios, float64, on the CPU; None for quantities that stay at their nominal value.

        Raises:
            ValueError: for a count below 1 or that of the slopes, or a negative seed.
        """
        import torch

        if count < 1:
            raise ValueError(f"count = {count}: wanted at least one scenario")
        if count < len(self.slopes):
            raise ValueError(f"count = {count}: wanted at least one scenario for each of {len(self.slopes)} slopes")
        if seed < 0:
            raise ValueError(f"seed = {seed}: wanted at least 0")
        engine = torch.quasirandom.SobolEngine(len(NOMINAL), scramble=True, seed=seed)
        drawn = dict(zip(NOMINAL, engine.draw(count, dtype=torch.float64).unbind(1), strict=True))
        found: dict[str, Tensor] = {}
        for name, share in drawn.items():
            bounds = getattr(self, name)
            if bounds is None or bounds == (NOMINAL[name], NOMINAL[name]):
                continue
            if name == "friction":
                low, high = (math.pi / 2 if mu == "stick" else math.atan(mu) for mu in bounds)
                angle = low + (high - low) * share
                found[name] = torch.where(angle < math.pi / 2 - 1e-9, angle.tan(), STICK)
            else:
                found[name] = torch.lerp(torch.full_like(share, bounds[0]), torch.full_like(share, bounds[1]), share)
        if self.slopes:
            place = torch.arange(count) * len(self.slopes) // count
            angle = torch.rad2deg(torch.tensor(self.slopes, dtype=torch.float64).atan())[place]
            found["tilt_x"] = angle + found["tilt_x"] if "tilt_x" in found else angle
        return ScenarioBatch(count=count, **found)


def check_range(name: str, bounds: tuple[float, float], least: float, most: float, unit: str) -> None:
    """Refuse bounds that do not increase or are not within limits.

    Raises:
        ValueError: naming argument, bounds and limits.
    """
    low, high = bounds
    if not least <= low <= high <= most:  # also catches NaN
        raise ValueError(f"{name} = {low:g} {high:g}: wanted two increasing numbers from {least:g} to {most:g} {unit}")


def check_friction(name: str, bounds: tuple[Friction, Friction]) -> None:
    """Refuse bounds of friction that do not increase to "stick" at most.

    Raises:
        ValueError: naming argument and bounds.
    """
    low, high = (math.inf if mu == "stick" else mu for mu in bounds)
    if not 0 <= low <= high:
        raise ValueError(
            f"{name} = {bounds[0]} {bounds[1]}: wanted two increasing coefficients of at least 0, 'stick' the largest"
        )


def supplied(supply: Waveform, batch: ScenarioBatch) -> Waveform:
    """The supply that the chambers of each scenario get: times the gain, behind a line with a first-order lag.

    The lag is tau p' = p_supply - p with p = p_supply at first, exact for a supply that is linear between its samples.

    Args:
        supply: Of the robot, [T] for one chamber, [chambers, T], or of each scenario [S, chambers, T] Pa.
        batch: The scenarios.

    Returns:
        Pressure [S, chambers, T] Pa; the supply itself where neither gain nor lag are given.
    """
    import torch

    from torchsoro.simulation.actuation import Waveform

    if batch.pressure_gain is None and batch.lag is None:
        return supply
    wave = supply if batch.lag is None else _refined(supply)
    time, pressure = wave.time, wave.pressure
    pressure = pressure if pressure.ndim > 1 else pressure.unsqueeze(0)
    if batch.pressure_gain is not None:
        pressure = pressure * batch.pressure_gain.to(pressure)[:, None, None]
    if batch.lag is not None:
        pressure = pressure.expand(batch.count, *pressure.shape[-2:])
        step, tau = time.diff(), batch.lag.to(time)[:, None, None]
        keep = torch.exp(-step / torch.maximum(tau, step / PROMPT))
        early = (tau / step * (1 - keep)).to(pressure)
        keep = keep.to(pressure)
        push = (early - keep) * pressure[..., :-1] + (1 - early) * pressure[..., 1:]
        first = pressure[..., :1]
        # p' = p - p_supply(0), which begins with zero, so that the recursion has no first value.
        late = _recursion(keep.expand_as(push), push - (1 - keep) * first)
        pressure = torch.cat([first, first + late], -1)
    return Waveform(time=time, pressure=pressure)


def _refined(supply: Waveform) -> Waveform:
    """The same with samples in between, where some chamber's are further apart than ``FINEST``."""
    import torch

    steps = supply.time.detach().diff()
    parts = (steps.reshape(-1, steps.shape[-1]).amax(0) / FINEST - 1e-6).ceil().clamp(min=1).long()
    if bool((parts == 1).all()):
        return supply
    at = torch.repeat_interleave(torch.arange(len(parts)), parts)
    share = (torch.arange(len(at)) - (parts.cumsum(0) - parts)[at]).to(supply.time) / parts[at]

    def between(values: Tensor) -> Tensor:
        weight = share.to(values)
        return torch.cat([torch.lerp(values[..., at], values[..., at + 1], weight), values[..., -1:]], -1)

    return replace(supply, time=between(supply.time), pressure=between(supply.pressure))


def _recursion(keep: Tensor, push: Tensor) -> Tensor:
    """Solve p_k = keep_k p_(k-1) + push_k from p_0 = 0, [..., K], in log2(K) passes over all k (Hillis and Steele)."""
    import torch

    reach = 1
    while reach < push.shape[-1]:
        push = torch.cat([push[..., :reach], push[..., reach:] + keep[..., reach:] * push[..., :-reach]], -1)
        keep = torch.cat([keep[..., :reach], keep[..., reach:] * keep[..., :-reach]], -1)
        reach *= 2
    return push


def varied(body: Body, batch: ScenarioBatch) -> Body:
    """The bodies of the scenarios: moduli and masses of the solid [S, N], void and its drag included."""
    import torch

    # What is partly air is solid, too: the air's own mass is 0.3 % of a solid's.
    solid = body.chamber < 0 if body.air_share is None else body.air_share < 1

    def factor(values: Tensor) -> Tensor:
        return torch.where(solid, values.to(body.mass)[:, None], torch.ones_like(body.mass))

    if batch.modulus_factor is not None:
        by = factor(batch.modulus_factor)
        body = replace(body, bulk=body.bulk * by, shear=body.shear * by)
    if batch.density_factor is not None:
        by = factor(batch.density_factor)
        body = replace(body, mass=body.mass * by, drag=None if body.drag is None else body.drag * by)
    return body


def leaning_gravity(size: float, slope: float, batch: ScenarioBatch) -> Tensor:
    """Gravity [S, 3] m/s2 of this size, seen from floors with an uphill slope along +x, rise over run, and a tilt."""
    import torch

    flat = torch.zeros(batch.count, dtype=torch.float64)
    along = flat + math.atan(slope) if batch.tilt_x is None else math.atan(slope) + torch.deg2rad(batch.tilt_x)
    across = flat if batch.tilt_y is None else torch.deg2rad(batch.tilt_y)
    up = (along.sin(), across.sin() * along.cos(), across.cos() * along.cos())
    return -size * torch.stack(up, -1)


def posed(places: Tensor, size: tuple[float, float, float], batch: ScenarioBatch) -> Tensor:
    """By how much the scenarios' initial pose displaces places of the undeformed body [n, 3] m: [S, n, 3] m.

    The body turns about y and then about x, through the middle of its lower face, and is lifted so that the lowest
    corner of its box is where it was, and by the drop.

    Args:
        places: Reference places, with x = y = z = 0 in the middle of the lower face.
        size: Edges of the body [m].
        batch: The scenarios.
    """
    import torch

    zero = torch.zeros(batch.count, dtype=torch.float64)
    pitch, roll, drop = (zero if t is None else t.double() for t in (batch.pitch, batch.roll, batch.drop))
    c, s, one, none = torch.deg2rad(pitch).cos(), torch.deg2rad(pitch).sin(), zero + 1, zero
    by_pitch = torch.stack([c, none, s, none, one, none, -s, none, c], -1).view(-1, 3, 3)
    c, s = torch.deg2rad(roll).cos(), torch.deg2rad(roll).sin()
    by_roll = torch.stack([one, none, none, none, c, -s, none, s, c], -1).view(-1, 3, 3)
    turn = by_roll @ by_pitch - torch.eye(3, dtype=torch.float64)
    half = [size[0] / 2, size[1] / 2]
    corners = torch.tensor([[x * half[0], y * half[1], 0.0] for x in (-1, 1) for y in (-1, 1)], dtype=torch.float64)
    lift = drop - (corners @ turn.mT)[..., 2].amin(-1)
    moved = places.detach().cpu().double() @ turn.mT
    return moved + torch.stack([none, none, lift], -1)[:, None]
