"""All that one simulation is told, and several of them told as one batch."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsoro.actuation import Waveform
from torchsoro.contact import Plane
from torchsoro.loads import Drag, Force, Load, Spring
from torchsoro.material import Prony


@dataclass(frozen=True, kw_only=True, eq=False)
class Scenario:
    """All that a simulation is told; leading axes [...] are a batch of variations.

    Attributes:
        stiffness: Young's modulus of each particle [..., N] Pa; of a chamber's, that of what fills it.
        poisson_ratio: Of the solid [...].
        density: Of each particle [..., N] kg/m3.
        prony: Maxwell elements.
        viscosity: Shear viscosity of the solid [..., N] Pa s.
        air_stiffness: Pressure that a chamber loses as its volume doubles [..., chambers] Pa.
        pressure: Supply [..., chambers, S] Pa; None without a chamber.
        gravity: [..., 3] m/s2.
        velocity: At the start [..., N, 3] m/s.
        planes: Ground and walls.
        loads: What is attached.
        duration: [s].
    """

    stiffness: Tensor
    poisson_ratio: Tensor
    density: Tensor
    prony: Prony | None
    viscosity: Tensor
    air_stiffness: Tensor
    pressure: Waveform | None
    gravity: Tensor
    velocity: Tensor
    planes: tuple[Plane, ...]
    loads: tuple[Load, ...]
    duration: float

    def replace(self, **changes) -> Scenario:
        """A scenario with other values."""
        return dataclasses.replace(self, **changes)


# Fields that are tensors, with their axes that are not a batch.
_TENSORS = {
    **{"stiffness": 1, "poisson_ratio": 0, "density": 1, "viscosity": 1, "air_stiffness": 1},
    **{"gravity": 1, "velocity": 2},
}


def together(scenarios: Sequence[Scenario], count: int) -> Scenario | None:
    """Several scenarios of a body as one batch: the variations of the first, then those of the second, ...

    Args:
        scenarios: Each with a batch of ``count`` variations, or none.
        count: Variations of each.

    Returns:
        The batch, as long as the longest; None if they differ in what a batch has in common, such as their planes.
    """
    first = scenarios[0]
    if len(scenarios) == 1:
        return first
    alike = [[(p.axis, p.side, p.sticks) for p in s.planes] for s in scenarios]
    if any(a != alike[0] for a in alike) or any((s.prony is None) != (first.prony is None) for s in scenarios):
        return None
    loads = _loads(scenarios, count)
    if loads is None:
        return None

    def cat(tensors: Sequence[Tensor], rank: int) -> Tensor:
        return torch.cat([t.expand(count, *t.shape[t.ndim - rank :]) for t in tensors])

    changes: dict = {name: cat([getattr(s, name) for s in scenarios], rank) for name, rank in _TENSORS.items()}
    series = [s.prony for s in scenarios if s.prony is not None]
    if series:
        changes["prony"] = Prony(moduli=cat([p.moduli for p in series], 1), times=cat([p.times for p in series], 1))
    waves = [s.pressure for s in scenarios if s.pressure is not None]
    if waves:
        time = torch.unique(torch.cat([w.time.double() for w in waves]))
        values = [dataclasses.replace(w, time=w.time.double(), pressure=w.pressure.double()).at(time) for w in waves]
        values = [v if v.ndim > 1 else v.unsqueeze(0) for v in values]
        changes["pressure"] = Waveform(time=time, pressure=cat(values, 2))
    changes["planes"] = tuple(_plane([s.planes[i] for s in scenarios], cat) for i in range(len(first.planes)))
    return first.replace(**changes, loads=loads, duration=max(s.duration for s in scenarios))


def _plane(planes: Sequence[Plane], cat) -> Plane:
    """One plane of all scenarios."""
    numbers = {
        name: cat([torch.as_tensor(getattr(p, name), dtype=torch.float64) for p in planes], 0)
        for name in ("offset", "adhesion", *(() if planes[0].sticks else ("friction",)))
    }
    return dataclasses.replace(planes[0], **numbers)


def _loads(scenarios: Sequence[Scenario], count: int) -> tuple[Load, ...] | None:
    """Forces of each scenario, zero in the others; springs and drag, which all of them have; None if they differ."""
    found: list[Load] = []
    for number, scenario in enumerate(scenarios):
        for load in scenario.loads:
            if isinstance(load, Force):
                tail = load.value.shape[-1:] if load.time is None else load.value.shape[-2:]
                value = torch.zeros(len(scenarios), count, *tail, dtype=load.value.dtype)
                value[number] = load.value
                found.append(dataclasses.replace(load, value=value.flatten(0, 1)))
    rest = [[load for load in s.loads if not isinstance(load, Force)] for s in scenarios]
    if any([type(load) for load in loads] != [type(load) for load in rest[0]] for loads in rest):
        return None
    for same in zip(*rest, strict=True):
        if not all(isinstance(load, Spring | Drag) and load.share is not None for load in same):
            return None
        if any(not torch.equal(load.particles, same[0].particles) for load in same):
            return None
        name = "stiffness" if isinstance(same[0], Spring) else "coefficient"
        amounts = [torch.as_tensor(getattr(load, name), dtype=torch.float64).expand(count) for load in same]
        shares = [load.share.expand(count, load.share.shape[-1]) for load in same]  # pyright: ignore[reportOptionalMemberAccess]
        found.append(dataclasses.replace(same[0], **{name: torch.cat(amounts), "share": torch.cat(shares)}))
    return tuple(found)
