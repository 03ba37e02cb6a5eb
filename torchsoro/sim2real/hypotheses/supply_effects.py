"""Effects in the supply of a chamber: what reaches it of the pressure, how late, and how its air gives way."""

from __future__ import annotations

import dataclasses
import math

import numba
import numpy as np
import torch
from torch import Tensor

from torchsoro.sim2real.hypotheses.hypothesis import LAW, Hypothesis, Quantity, Simpler
from torchsoro.sim2real.twin.scenario import Scenario
from torchsoro.sim2real.twin.twin import Twin
from torchsoro.simulation.actuation import Waveform

SAMPLE = 2e-3  # between samples of a pressure behind a line [s]
SUBSTEPS = 4  # of a sample, in which air escapes


class PressureGain(Hypothesis):
    """The chamber gets less, or more, than the supply's pressure."""

    name, affected_quantity, model_form_deviation = "pressure_loss", "chamber pressure", LAW
    quantities = (Quantity("ln_factor", "1", 0.05, -30.0, 12.0),)
    starts = ((-1.0,), (-4.0,), (-10.0,))

    def reported(self, values: np.ndarray, scenario: Scenario, twin: Twin) -> dict[str, tuple[float, str]]:
        """What is lost."""
        return {"fraction": (1 - math.exp(values[0]), "1")}

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """P exp(a)."""
        assert scenario.pressure is not None
        pressure = _chambers(scenario.pressure) * values[:, 0].exp()[:, None, None]
        return scenario.replace(pressure=dataclasses.replace(scenario.pressure, pressure=pressure))

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a chamber."""
        return scenario.pressure is not None


class ThrottledLoss(Hypothesis):
    """A share is lost at any pressure, and a throttle takes more the higher it is: (1 - c) p_supply = p + b p^2 / P.

    P is the highest supply of all trials. Air that seeps away behind a throttle in proportion to p loses b p^2 / P in
    it (turbulent flow). Of a steady supply P the share a is lost, where b = (a - c) / (1 - a)^2 and
    c = a (1 + evenness) / 2.
    """

    name, affected_quantity, model_form_deviation = "pressure_loss", "chamber pressure", LAW
    nonnegative = frozenset({"fraction"})
    quantities = (Quantity("fraction_at_highest", "1", 0.05, 0.0, 19.0), Quantity("evenness", "1", 0.5, -2.0, 2.0))
    starts = ((2.0, -1.0), (6.0, -1.0))

    def reported(self, values: np.ndarray, scenario: Scenario, twin: Twin) -> dict[str, tuple[float, str]]:
        """By the name of the other form."""
        return {"fraction": (float(values[0]), "1")}

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Less pressure; of pressures below the surroundings', as of those above."""
        assert scenario.pressure is not None
        supply = _chambers(scenario.pressure).double()
        share = values[:, 0].clamp(0, 0.99)
        steady = share * (1 + values[:, 1].clamp(-1, 1)) / 2
        throttle = ((share - steady) / (1 - share) ** 2)[:, None, None]
        most = _highest(scenario, twin, supply)
        left = supply * (1 - steady)[:, None, None]
        # The root of b q^2 + q = |left| / P, in a form that does not cancel where b is small.
        behind = 2 * left / (1 + torch.sqrt(1 + 4 * throttle * left.abs() / most))
        return scenario.replace(pressure=dataclasses.replace(scenario.pressure, pressure=behind))

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a chamber."""
        return scenario.pressure is not None


def _highest(scenario: Scenario, twin: Twin, supply: Tensor) -> Tensor:
    """The pressure to which shares that are lost refer [..., chambers, 1] Pa: one for all trials, if it is known."""
    own = supply.abs().amax(-1, keepdim=True)
    faint = float(scenario.youngs_modulus.mean()) * 1e-9  # a pressure that moves nothing
    return (torch.full_like(own, twin.highest) if twin.highest else own).clamp(min=faint)


def _chambers(supply: Waveform) -> Tensor:
    """Pressure [..., chambers, S]."""
    return supply.pressure if supply.pressure.ndim > 1 else supply.pressure.unsqueeze(0)


def _sampled(scenario: Scenario, batch: int) -> tuple[Tensor, Tensor]:
    """Even, fine samples of a supply: times [S] s, and pressures [B, chambers, S] Pa."""
    supply = scenario.pressure
    assert supply is not None
    time = torch.arange(0.0, max(scenario.duration, scenario.until) + 2 * SAMPLE, SAMPLE, dtype=torch.float64)
    p = Waveform(time=supply.time.double(), pressure=_chambers(supply).double()).at(time)
    return time, p.expand(batch, *p.shape[-2:])


def lagged(scenario: Scenario, tau: Tensor) -> Waveform:
    """The exact answer of a first-order lag [B] s to a piecewise linear supply."""
    time, p = _sampled(scenario, len(tau))
    ratio = SAMPLE / tau.clamp(min=1e-9)[:, None]
    keep, early = torch.exp(-ratio), -torch.expm1(-ratio) / ratio
    # Exact for a supply that changes linearly in a sample.
    pushed = (early - keep).unsqueeze(-1) * p[..., :-1] + (1 - early).unsqueeze(-1) * p[..., 1:]
    found, kept = torch.cat([p[..., :1], pushed], -1).movedim(-1, 0).contiguous().numpy(), keep.numpy()
    for k in range(1, len(found)):
        found[k] += kept * found[k - 1]
    late = torch.where(tau[:, None, None] > 0, torch.from_numpy(found).movedim(0, -1), p)
    return Waveform(time=time, pressure=late)


class PressureLag(Hypothesis):
    """The line fills and empties with a lag: tau p' = p_supply - p."""

    name, affected_quantity, model_form_deviation = "pressure_lag", "chamber pressure", LAW
    quantities = (Quantity("time_constant_s", "s", 0.01, 0.0, 100.0),)
    starts = ((1.0,), (3.0,), (8.0,))

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Late."""
        return scenario.replace(pressure=lagged(scenario, values[:, 0]))

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a chamber."""
        return scenario.pressure is not None


class AirStiffness(Hypothesis):
    """The chamber's pressure falls as it grows: p = p_supply - k (V/V0 - 1)."""

    name, affected_quantity, model_form_deviation = "air_stiffness", "chamber pressure by its volume", LAW
    quantities = (Quantity("air_stiffness_pa", "Pa", 2e4, 0.0, 50.0),)
    starts = ((1.0,), (5.0,))

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Added to what is believed."""
        return scenario.replace(air_stiffness=scenario.air_stiffness + values[:, :1])

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a chamber."""
        return scenario.pressure is not None


class AirTwice(Hypothesis):
    """There is less air to compress than believed, as where the pressure was measured in the chamber itself."""

    name, affected_quantity = "air_stiffness", "chamber pressure by its volume"
    quantities = (Quantity("share", "1", 0.1, -10.0, 0.0),)
    starts = ((-3.0,), (-10.0,))

    def reported(self, values: np.ndarray, scenario: Scenario, twin: Twin) -> dict[str, tuple[float, str]]:
        """What is to be added."""
        return {"air_stiffness_pa": (float(values[0]) * float(scenario.air_stiffness.max()), "Pa")}

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """A share of what is believed less."""
        return scenario.replace(air_stiffness=scenario.air_stiffness * (1 + values[:, :1]))

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a chamber whose air is believed to be compressed."""
        return scenario.pressure is not None and bool((scenario.air_stiffness > 0).any())


class Leak(Hypothesis):
    """A part of the supply is lost behind a line that fills slowly: tau p' = (1 - a) p_supply - p."""

    name, affected_quantity, model_form_deviation = "leak", "chamber pressure", LAW
    quantities = (Quantity("fraction", "1", 0.05, 0.0, 19.0), Quantity("time_constant_s", "s", 0.01, 0.0, 100.0))
    starts = tuple((f, t) for f in (1.0, 5.0) for t in (1.0, 3.0))

    def simpler(self, values: np.ndarray) -> list[Simpler]:
        """A lag, at a pressure that is as much lower; at once, a loss."""
        lost = np.log1p(-values[:1])
        return [Simpler("pressure_lag", values[1:], ln_pressure=float(lost[0])), Simpler("pressure_loss", lost)]

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Less pressure, later."""
        assert scenario.pressure is not None
        less = _chambers(scenario.pressure) * (1 - values[:, 0])[:, None, None]
        scenario = scenario.replace(pressure=dataclasses.replace(scenario.pressure, pressure=less))
        return scenario.replace(pressure=lagged(scenario, values[:, 1]))

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a chamber."""
        return scenario.pressure is not None


class OrificeLeak(Hypothesis):
    """Air escapes through a hole behind a line: tau p' = p_supply - p - b sqrt(P p).

    P is the highest supply of all trials. Flow through the hole goes with the root of the pressure (turbulent,
    incompressible). Of a steady supply P, the share a is lost, where b = a / sqrt(1 - a).
    """

    name, affected_quantity, model_form_deviation = "leak", "chamber pressure", LAW
    nonnegative = frozenset({"fraction"})
    quantities = (
        Quantity("fraction_at_highest", "1", 0.05, 0.0, 19.0),
        Quantity("time_constant_s", "s", 0.01, 0.0, 100.0),
    )
    starts = tuple((f, t) for f in (2.0, 6.0) for t in (1.0, 3.0))

    def reported(self, values: np.ndarray, scenario: Scenario, twin: Twin) -> dict[str, tuple[float, str]]:
        """By the names of the other form."""
        return {"fraction": (float(values[0]), "1"), "time_constant_s": (float(values[1]), "s")}

    def simpler(self, values: np.ndarray) -> list[Simpler]:
        """Without a hole, a lag, at a pressure as much lower as it is at the highest."""
        return [Simpler("pressure_lag", values[1:], ln_pressure=float(np.log1p(-values[0])))]

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Less pressure, later; of pressures below the surroundings', as of those above."""
        time, p = _sampled(scenario, len(values))
        share, tau = values[:, 0].clamp(0, 0.99), values[:, 1].clamp(min=0)
        hole = share / torch.sqrt(1 - share)
        most = _highest(scenario, twin, p).squeeze(-1).contiguous()
        behind = p.clone().numpy()
        _escape(behind, hole.numpy(), tau.numpy(), most.numpy(), SAMPLE)
        return scenario.replace(pressure=Waveform(time=time, pressure=torch.from_numpy(behind)))

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a chamber."""
        return scenario.pressure is not None


@numba.njit(cache=True)
def _escape(p, hole, tau, most, dt):
    """Pressures [B, chambers, S] behind a line with a hole, in place of those of the supply; implicit in time.

    With q = sqrt(|p|), each of SUBSTEPS solves (r + 1) q^2 + b sqrt(P) q = |r p_before + p_supply|, r = tau / dt; at
    tau = 0 that is the steady state. Before the first sample the supply was at rest.
    """
    for b in range(p.shape[0]):
        slow = tau[b] * SUBSTEPS / dt
        for c in range(p.shape[1]):
            escape = hole[b] * math.sqrt(most[b, c])
            found = last = p[b, c, 0]
            ratio = 0.0
            for k in range(p.shape[2]):
                supply = p[b, c, k]
                for j in range(1, SUBSTEPS + 1):
                    pull = ratio * found + last + (supply - last) * j / SUBSTEPS
                    q = (math.sqrt(escape**2 + 4 * (ratio + 1) * abs(pull)) - escape) / (2 * (ratio + 1))
                    found = q * q if pull > 0 else -q * q
                    ratio = slow
                last = supply
                p[b, c, k] = found
