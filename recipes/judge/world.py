"""What nature does beyond the belief: a record of departures, each of which changes nothing at its default."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Vector = tuple[float, float, float]
ATMOSPHERE = 101325.0


@dataclass(frozen=True, kw_only=True)
class Lump:
    """A mass stuck to the body around a point, its weight included.

    Attributes:
        point: In the undeformed body [m].
        mass: [kg].
        radius: It is spread over a ball of this radius [m].
        frequency: If positive, it hangs in a soft spring of this frequency [Hz] instead, as liquid that sloshes.
        damping: Damping ratio of that spring.
    """

    point: Vector
    mass: float
    radius: float = 0.005
    frequency: float = 0.0
    damping: float = 0.05


@dataclass(frozen=True, kw_only=True)
class Chain:
    """A hanging tube: beads joined by springs that do not push, from the body to a fixed support.

    Attributes:
        point: Where it is attached to the undeformed body [m].
        support: Fixed end [m].
        length: Unstretched [m].
        mass: [kg].
        stiffness: Of the whole chain when taut [N/m].
        damping: Of the whole chain when taut [N s/m].
        beads: Their number.
    """

    point: Vector
    support: Vector
    length: float
    mass: float
    stiffness: float
    damping: float
    beads: int = 6

    def numbers(self) -> Floats:
        """Mass of a bead, and rest length, stiffness and damping of a link."""
        links = self.beads + 1
        each = (self.mass / self.beads, self.length / links, self.stiffness * links, self.damping * links)
        return np.array(each)

    def relaxed(self, start: Floats, gravity: Floats) -> Floats:
        """Beads at rest [beads, 3] m with the attached end held at ``start``."""
        s = np.linspace(0, 1, self.beads + 2)[1:-1, None]
        sag = math.sqrt(max(self.length**2 - math.dist(start, self.support) ** 2, 0.0)) / 2
        down = gravity / max(float(np.linalg.norm(gravity)), 1e-9)
        x = start * (1 - s) + np.asarray(self.support) * s + 4 * s * (1 - s) * sag * down
        v = np.zeros_like(x)
        numbers = self.numbers()
        numbers[3] = 0.7 * math.sqrt(numbers[2] * numbers[0])
        dt = 0.2 * math.sqrt(numbers[0] / numbers[2])
        _relax(x, v, start, np.asarray(self.support, dtype=float), numbers, gravity, dt, 30000)
        return x


@numba.njit(cache=True)
def chain_step(x, v, start, start_v, support, numbers, gravity, dt, slow):
    """Advance the beads by dt [s]; returns the force on the attached end [3] N."""
    n = x.shape[0]
    pull = np.zeros((n + 1, 3))
    for link in range(n + 1):
        d = np.empty(3)
        length = 0.0
        rate = 0.0
        for a in range(3):
            p = start[a] if link == 0 else x[link - 1, a]
            q = support[a] if link == n else x[link, a]
            d[a] = q - p
            length += d[a] * d[a]
        length = math.sqrt(length) + 1e-12
        for a in range(3):
            p = start_v[a] if link == 0 else v[link - 1, a]
            q = 0.0 if link == n else v[link, a]
            rate += (q - p) * d[a] / length
        if length > numbers[1]:
            tension = max(numbers[2] * (length - numbers[1]) + numbers[3] * rate, 0.0)
            for a in range(3):
                pull[link, a] = tension * d[a] / length
    for i in range(n):
        for a in range(3):
            v[i, a] += dt * (gravity[a] + (pull[i + 1, a] - pull[i, a]) / numbers[0])
            v[i, a] *= 1 - slow * dt
            x[i, a] += dt * v[i, a]
    return pull[0]


@numba.njit(cache=True)
def _relax(x, v, start, support, numbers, gravity, dt, steps):
    still = np.zeros(3)
    for _ in range(steps):
        chain_step(x, v, start, still, support, numbers, gravity, dt, 5.0)


@dataclass(frozen=True, kw_only=True)
class Line:
    """The supply line between the pressure gauge and the chamber.

    Attributes:
        gain: Factor on the measured pressure (the gauge's error).
        lag: Total delay of two equal volumes in series [s].
        loss: Fraction lost at ``full``; half as large a fraction near zero pressure.
        leak: Coefficient of an orifice: the steady pressure p obeys p + leak sqrt(p full) = p_supply.
        filling: Time in which the supply fills the leaking chamber [s].
        closed: Ratio of the chamber's volume to that of chamber and line closed off together; 0 is a regulated
            supply, 1 air that is sealed in the chamber alone.
        full: Pressure to which loss and leak refer [Pa].
    """

    gain: float = 1.0
    lag: float = 0.0
    loss: float = 0.0
    leak: float = 0.0
    filling: float = 0.008
    closed: float = 0.0
    full: float = 20e3

    def arriving(self, supply: Floats, dt: float) -> Floats:
        """Pressure [T] Pa at the chamber from that measured, dt [s] apart; its volume acts in ``inside``."""
        p = self.gain * supply
        p = p * (1 - self.loss * (0.5 + 0.5 * np.clip(p / self.full, 0, 2)))
        if self.leak:
            out, now = np.empty_like(p), p[0]
            for i, target in enumerate(p):
                flow = self.leak * math.copysign(math.sqrt(abs(now) * self.full), now)
                now += dt / self.filling * (target - now - flow)
                out[i] = now
            p = out
        if self.lag:
            keep = math.exp(-2 * dt / self.lag)
            for _ in range(2):
                out, now = np.empty_like(p), p[0]
                for i, target in enumerate(p):
                    now = keep * now + (1 - keep) * target
                    out[i] = now
                p = out
        return p

    def inside(self, arriving: float, volume_ratio: float) -> float:
        """Pressure in a chamber [Pa] that has grown to ``volume_ratio`` of its first volume."""
        if not self.closed:
            return arriving
        return (arriving + ATMOSPHERE) / (1 + self.closed * (volume_ratio - 1)) - ATMOSPHERE


@dataclass(frozen=True, kw_only=True)
class World:
    """Departures from the belief.

    Attributes:
        modulus: Factor on Young's modulus.
        density: Factor on the density.
        elements: Maxwell elements beside the believed ones, ((relative modulus, time [s]), ...).
        soft: Fraction by which the modulus falls on one side; smooth across ``soft_width``.
        soft_at: Point of the plane that bounds the soft side [m].
        soft_normal: Points into the soft side.
        soft_width: [m].
        gent: 1 / J_m of a Gent solid.
        softening: 1 / r of Ogden and Roxburgh.
        softening_energy: Their m [Pa].
        lumps: Masses attached.
        chains: Tubes attached.
        line: Supply line.
        friction: Coefficients of sliding and of rest, and the Stribeck speed [m/s]; None: as believed.
        adhesion: Largest traction of the ground [Pa].
        adhesion_reach: Gap at which it acts [m].
        plane_offset: Of the ground along its normal [m].
        foam: Stiffness of a soft floor [Pa/m]; 0: rigid.
        foam_loss: [Pa s/m].
        gravity_turn: Rotation vector of gravity [rad].
        velocity: Added at the start [m/s]: to every point of a free body, to the far end of a clamped one, falling
            with the square of the distance from the clamp.
        spin: Angular velocity added at the start [rad/s], of a free body.
        drag: Pressure on every side, in front and behind, over the square of its normal motion [kg/m3]: a quarter of
            fluid density times drag coefficient.
        magnet: Point of the undeformed body that is drawn, the fixed point that draws [m], and the force at 10 mm [N],
            which falls with the cube of the distance.
        gust: Traction of a wind [Pa, 3] on the surface that faces it, then its first and last time [s].
        heat: Fraction of the modulus lost by the end of the last trial.
    """

    modulus: float = 1.0
    density: float = 1.0
    elements: tuple[tuple[float, float], ...] = ()
    soft: float = 0.0
    soft_at: Vector = (0.0, 0.0, 0.0)
    soft_normal: Vector = (0.0, 0.0, 1.0)
    soft_width: float = 0.004
    gent: float = 0.0
    softening: float = 0.0
    softening_energy: float = 100.0
    lumps: tuple[Lump, ...] = ()
    chains: tuple[Chain, ...] = ()
    line: Line = Line()
    friction: Vector | None = None
    adhesion: float = 0.0
    adhesion_reach: float = 3e-4
    plane_offset: float = 0.0
    foam: float = 0.0
    foam_loss: float = 0.0
    gravity_turn: Vector = (0.0, 0.0, 0.0)
    velocity: Vector = (0.0, 0.0, 0.0)
    spin: Vector = (0.0, 0.0, 0.0)
    drag: float = 0.0
    magnet: tuple[Vector, Vector, float] | None = None
    gust: tuple[Vector, float, float] | None = None
    heat: float = 0.0
