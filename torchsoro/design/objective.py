"""What a design is judged by: how far it travels, what it weighs, and how much of it is neither void nor solid.

All functions are differentiable and accept leading batch axes. Lengths in m, masses in kg, times in s. Equation numbers
are those of Kobayashi et al., "Computational synthesis of locomotive soft robots by topology optimization".

Constraints are written ``g <= 0`` throughout: the violation of Eq. 15 is ``intermediate_density(...) - limit``, which
is negative or zero for an admissible design.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torchsoro.errors import refuse_gradients
from torchsoro.simulation.sums import pairwise_sum


def center_of_gravity(x: Tensor, mass: Tensor) -> Tensor:
    """Centre of gravity, Eq. 14: ``x_g = sum_p m_p x_p / sum_p m_p``.

    Args:
        x: Particle positions, m, [..., N, 3].
        mass: Particle masses, kg, [..., N]. Its leading axes broadcast against those of ``x``: masses [N] go with the
            frames [S, N, 3] of one simulation, masses [B, 1, N] with those of a batch [B, S, N, 3].

    Returns:
        Centre of gravity, m, [..., 3].

    Raises:
        ValueError: Shapes do not fit, or the total mass is not positive.
    """
    if x.ndim < 2 or x.shape[-1] != 3:
        raise ValueError(f"x: got shape {tuple(x.shape)}, want [..., N, 3]")
    if mass.ndim < 1 or mass.shape[-1] != x.shape[-2]:
        raise ValueError(f"mass: got shape {tuple(mass.shape)}, want [..., {x.shape[-2]}] as in x")
    try:
        torch.broadcast_tensors(x[..., 0], mass)
    except RuntimeError:
        raise ValueError(
            f"mass: got shape {tuple(mass.shape)}, want leading axes that broadcast against {tuple(x.shape[:-2])} of x"
        ) from None
    total = total_mass(mass)
    if not bool((total.detach() > 0.0).all()):
        raise ValueError(f"mass: got a total of {float(total.detach().min())} kg, want more than 0")
    return pairwise_sum(mass.unsqueeze(-2) * x.mT) / total.unsqueeze(-1)


def total_mass(mass: Tensor) -> Tensor:
    """Total mass, kg, [...], of particle masses [..., N]."""
    if mass.ndim < 1:
        raise ValueError(f"mass: got shape {tuple(mass.shape)}, want [..., N]")
    return pairwise_sum(mass)


def travel(cog: Tensor, time: Tensor, *, start: float, end: float, direction: Tensor | Sequence[float]) -> Tensor:
    """Distance travelled in a direction, Eq. 13: ``L = (x_g(end) - x_g(start)) . e``.

    Args:
        cog: Centre of gravity over time, m, [..., S, 3].
        time: Times of its samples, s, [S].
        start: Start of the interval, s; a sample of ``time``.
        end: End of the interval, s; a later sample of ``time``.
        direction: Unit vector e, [3].

    Returns:
        Distance, m, [...].

    Raises:
        ValueError: Shapes do not fit, ``start`` or ``end`` is not a sample, or the direction is not a unit vector.
    """
    refuse_gradients(start=start, end=end)
    unit = _checked_history(cog, time, direction)
    first, last = _sample(time, start, "start"), _sample(time, end, "end")
    if last <= first:
        raise ValueError(f"end: got {end} s, want a time after start ({start} s)")
    return (cog[..., last, :] - cog[..., first, :]) @ unit


def stride(cog: Tensor, time: Tensor, *, start: float, period: float, direction: Tensor | Sequence[float]) -> Tensor:
    """Advance in each whole cycle of the actuation, ``(x_g(start + (k + 1) T) - x_g(start + k T)) . e``.

    Args:
        cog: Centre of gravity over time, m, [..., S, 3].
        time: Times of its samples, s, [S].
        start: Begin of the first cycle, s.
        period: Duration T of a cycle, s. Every ``start + k T`` up to the last sample is a sample of ``time``.
        direction: Unit vector e, [3].

    Returns:
        Advance per cycle, m, [..., cycles]; an unfinished last cycle is left out.

    Raises:
        ValueError: Shapes do not fit, no cycle is complete, an end of a cycle is not a sample, or the direction is not
            a unit vector.
    """
    refuse_gradients(start=start, period=period)
    unit = _checked_history(cog, time, direction)
    if not (math.isfinite(period) and period > 0.0):
        raise ValueError(f"period: got {period!r} s, want a finite time > 0")
    first = _sample(time, start, "start")
    latest = float(time[-1])
    cycles = math.floor((latest - start + _tolerance(time, latest)) / period)
    if cycles < 1:
        raise ValueError(f"period: got {period} s from start = {start} s, want a whole cycle before {latest:.9g} s")
    ends = [_sample(time, start + k * period, f"start + {k} period") for k in range(1, cycles + 1)]
    return cog[..., [first, *ends], :].diff(dim=-2) @ unit


def mean_stride(way: np.ndarray, time: np.ndarray, *, start: float, period: float) -> float:
    """Advance per cycle of a recorded path, over all its whole cycles; the cycles need not end on samples.

    Args:
        way: Distance along the direction of travel, m, [S].
        time: Times of the samples, s, [S].
        start: Begin of the first cycle, s.
        period: Duration of a cycle, s.

    Returns:
        The mean, m; NaN if no cycle is complete.
    """
    cycles = math.floor((time[-1] - start) / period + 1e-6)
    if cycles < 1:
        return math.nan
    first, last = np.interp([start, start + cycles * period], time, way)
    return float(last - first) / cycles


def yaw(rest: Tensor, place: Tensor, weight: Tensor) -> Tensor:
    """Angle of the rotation about z that maps points to where they are later with the least weighted square error.

    Kabsch's problem in the plane has the closed form, with x and y relative to their weighted means,

        theta = atan2( sum_p w_p (x_p y'_p - y_p x'_p) , sum_p w_p (x_p x'_p + y_p y'_p) ) .

    Args:
        rest: Positions at first, m, [..., P, 3].
        place: Positions later, m, of the same shape.
        weight: Weights of the points, at least 0, [..., P]; need not add up to one.

    Returns:
        Angle in (-pi, pi], rad, [...]; positive from x to y, to the left seen from above.

    Raises:
        ValueError: Shapes do not fit.
    """
    if rest.ndim < 2 or rest.shape[-1] != 3 or place.shape != rest.shape or weight.shape[-1:] != rest.shape[-2:-1]:
        shapes = ", ".join(str(tuple(one.shape)) for one in (rest, place, weight))
        raise ValueError(f"rest, place, weight: got shapes {shapes}, want [..., P, 3] twice and [..., P]")
    share = weight / pairwise_sum(weight).unsqueeze(-1).clamp(min=torch.finfo(weight.dtype).tiny)
    (x, y), (u, v) = ((p - pairwise_sum(share * p).unsqueeze(-1) for p in one.unbind(-1)[:2]) for one in (rest, place))
    across, along = x * v - y * u, x * u + y * v
    return torch.atan2(pairwise_sum(weight * across), pairwise_sum(weight * along))


def intermediate_density(gamma: Tensor, design: Tensor) -> Tensor:
    """Mean of ``gamma (1 - gamma)`` over the design domain, C of Eq. 15: 0 for black and white, at most 0.25.

    Args:
        gamma: Density, [..., N]. All particles have the same reference volume.
        design: Which particles are designed, bool [N].

    Returns:
        C, dimensionless, [...].

    Raises:
        ValueError: Shapes or types do not fit, or no particle is designed.
    """
    if design.dtype != torch.bool or design.ndim != 1:
        raise ValueError(f"design: got {design.dtype} {tuple(design.shape)}, want a bool tensor [N]")
    if gamma.ndim < 1 or gamma.shape[-1] != len(design):
        raise ValueError(f"gamma: got shape {tuple(gamma.shape)}, want [..., {len(design)}] as in design")
    if not bool(design.any()):
        raise ValueError("design: got no design particle, want at least one")
    designed = gamma[..., design]
    return (designed * (1.0 - designed)).mean(dim=-1)


def _checked_history(cog: Tensor, time: Tensor, direction: Tensor | Sequence[float]) -> Tensor:
    """Check a centre of gravity over time, and return the direction in its type and on its device."""
    if time.ndim != 1 or len(time) == 0 or not time.is_floating_point():
        raise ValueError(f"time: got {time.dtype} {tuple(time.shape)}, want a floating-point tensor [S]")
    if cog.ndim < 2 or cog.shape[-2:] != (len(time), 3):
        raise ValueError(f"cog: got shape {tuple(cog.shape)}, want [..., {len(time)}, 3] as in time")
    unit = torch.as_tensor(direction, dtype=cog.dtype, device=cog.device)
    if unit.shape != (3,):
        raise ValueError(f"direction: got shape {tuple(unit.shape)}, want [3]")
    length = float(unit.detach().norm())
    if not abs(length - 1.0) <= 1e-5:
        raise ValueError(f"direction: got a length of {length:.6g}, want a unit vector")
    return unit


def _tolerance(time: Tensor, value: float) -> float:
    """How far a time may be from a sample and still be that sample, s: 1 ns and the rounding of the samples."""
    return 1e-9 + 4.0 * torch.finfo(time.dtype).eps * abs(value)


def _sample(time: Tensor, value: float, name: str) -> int:
    """Index of the sample at a time."""
    if not math.isfinite(value):
        raise ValueError(f"{name}: got {value!r} s, want a finite time")
    distance = (time.detach().double() - value).abs()
    index = int(distance.argmin())
    if float(distance[index]) > _tolerance(time, value):
        raise ValueError(
            f"{name}: got {value:.9g} s, want the time of a sample; the nearest is {float(time[index]):.9g} s "
            f"(sample {index})"
        )
    return index
