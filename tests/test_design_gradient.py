"""Gradient of a gait by the design field, through density, material and simulator, against central differences."""

from __future__ import annotations

import pytest
import torch

from torchsoro import Chamber, DesignField, Domain, Gas, Prony, Simulator, Solid, fill, ground, square_wave

DOMAIN = Domain(
    size=(0.02,) * 3,
    particles=(8,) * 3,
    origin=(0.0, 0.0, 1e-3),
    chambers=(Chamber(name="air", center=(0.01, 0.01, 0.011), size=(0.01,) * 3, wall=0.0025),),
)


@pytest.mark.parametrize("form", ["total", pytest.param("updated", marks=pytest.mark.slow)])
def test_gradient_of_travel_by_the_design_field_is_the_central_difference(form):
    field = DesignField(DOMAIN, radius=0.006, symmetry=(), dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    start, way = (torch.rand(DOMAIN.shape, generator=generator, dtype=torch.float64) - 0.5 for _ in range(2))
    simulator = Simulator(cell=DOMAIN.cell, dt=1e-5, low=(-0.1,) * 3, high=(0.1,) * 3, formulation=form)
    pressure = square_wave(amplitude=2e4, frequency=100, rise=5e-4, fall=5e-4, end=2e-3)
    weight = DOMAIN.design.double()

    def travel(step: float) -> torch.Tensor:
        with torch.no_grad():
            field.phi.copy_(0.4 * start + step * way)
        body = fill(DOMAIN, field(), solid=Solid(), gas=Gas(density=3.0), void_range=(0.1, 0.3))
        seen = simulator(
            body, duration=6e-4, prony=Prony.paper(2), pressure=pressure, planes=[ground(friction=0.3)], weight=weight
        )
        return 1e3 * seen.center_of_gravity[-1].sum()

    (gradient,) = torch.autograd.grad(travel(0.0), field.phi)
    slope = float((gradient * way).sum())
    with torch.no_grad():
        difference = float(travel(1e-5) - travel(-1e-5)) / 2e-5
    assert slope == pytest.approx(difference, rel=1e-6)
    assert abs(slope) > 1e-6
