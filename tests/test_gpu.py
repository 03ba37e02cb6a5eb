"""The same kernels on a CUDA device: skipped where there is none."""

from __future__ import annotations

import dataclasses

import pytest
import torch

import torchsoro
from torchsoro import Chamber, DesignField, Domain, Gas, Prony, Simulator, Solid, fill, ground, square_wave
from torchsoro.design.blending import fill_blended
from torchsoro.design.placement import Placement
from torchsoro.simulation.actuation import Waveform


def pulsed_cube(device: str, dtype: torch.dtype, transfer: str) -> tuple[float, torch.Tensor]:
    """Travel of a cube with a pulsed chamber on leaning ground, and its gradient by the design field."""
    torchsoro.init(device)
    chamber = Chamber(name="air", center=(0, 0, 0.0175), size=(0.0175,) * 3, wall=0.035 / 12)
    domain = Domain(size=(0.035,) * 3, particles=(12,) * 3, origin=(-0.0175, -0.0175, 0.0), chambers=(chamber,))
    field = DesignField(domain, radius=0.007, dtype=dtype).to(device)
    x = domain.positions
    with torch.no_grad():
        field.phi.copy_((0.8 * torch.sin(200 * x[:, 0] + 1) * torch.cos(150 * x[:, 2])).reshape(domain.shape))
    simulator = Simulator(cell=domain.cell, dt=8e-5, low=(-0.1,) * 3, high=(0.1, 0.1, 0.15), transfer=transfer)
    trajectory = simulator(
        fill(domain, field(), solid=Solid(), epsilon=1e-3),
        duration=500 * 8e-5,
        prony=Prony.paper(3),
        pressure=square_wave(amplitude=80e3, frequency=5, rise=0.015, fall=0.025, end=0.5),
        planes=(ground(friction=0.5),),
        gravity=(-1.0, 0.0, -9.8),
    )
    travel = trajectory.center_of_gravity[-1, 0] - trajectory.center_of_gravity[0, 0]
    travel.backward()
    assert field.phi.grad is not None
    return travel.item(), field.phi.grad.double().cpu()


@pytest.mark.slow
@pytest.mark.parametrize("transfer", ["apic", "flip"])
def test_cuda_float32_agrees_with_cpu_float64(cuda: torch.device, transfer: str) -> None:
    exact, exact_gradient = pulsed_cube("cpu", torch.float64, transfer)
    travel, gradient = pulsed_cube(str(cuda), torch.float32, transfer)
    torchsoro.init("cpu")
    assert travel == pytest.approx(exact, rel=2e-3)
    assert (gradient - exact_gradient).norm() < 5e-3 * exact_gradient.norm()


@pytest.mark.slow
def test_a_body_that_meets_itself_does_so_on_cuda_as_on_a_cpu(cuda: torch.device) -> None:
    def closed(device: str, dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
        """Places of two limbs that close on each other, and the gradient by their stiffness."""
        torchsoro.init(device)
        h = 2.5e-3
        domain = Domain(size=(4 * h, 8 * h, 8 * h), particles=(4, 8, 8))
        x = domain.positions
        slot = (x[:, 1] > 2 * h) & (x[:, 1] < 6 * h) & (x[:, 2] > 2 * h)
        gamma = torch.where(slot, 0.0, 1.0).to(device, dtype).requires_grad_()
        speed = torch.zeros_like(x)
        speed[:, 1] = torch.where(x[:, 1] < 4 * h, 1.0, -1.0) * (x[:, 2] / h - 2).clamp(min=0)
        body = fill(domain, gamma, solid=Solid(), epsilon=1e-2, void_range=(0.1, 0.6))
        body = dataclasses.replace(body, velocity=speed.to(device, dtype))
        simulator = Simulator(
            cell=2 * h, dt=8e-5, low=(-0.1,) * 3, high=(0.1,) * 3, formulation="total", self_contact=True
        )
        run = simulator(body, duration=60 * 8e-5, gravity=(0.0, 0.0, 0.0), probes=(~slot).nonzero().squeeze(1))
        run.position[-1, :, 1].square().sum().backward()
        assert gamma.grad is not None
        return run.position[-1].detach().double().cpu(), gamma.grad.double().cpu()

    exact, exact_gradient = closed("cpu", torch.float64)
    places, gradient = closed(str(cuda), torch.float32)
    torchsoro.init("cpu")
    assert (places - exact).abs().max() < 1e-5
    assert (gradient - exact_gradient).norm() < 1e-2 * exact_gradient.norm()


@pytest.mark.slow
def test_a_chamber_between_lattice_planes_has_the_gradient_on_cuda_that_it_has_on_a_cpu(cuda: torch.device) -> None:
    chamber = Chamber(name="air", center=(0.01, 0.01, 0.011), size=(0.01,) * 3, wall=0.0025)
    domain = Domain(size=(0.02,) * 3, particles=(8,) * 3, origin=(0.0, 0.0, 1e-3), chambers=(chamber,))

    def inflated(device: str, dtype: torch.dtype) -> tuple[float, torch.Tensor]:
        """Air at the end, and its gradient by the chamber's centre and edges."""
        torchsoro.init(device)
        placement = Placement(domain)
        with torch.no_grad():
            placement.center += 0.3 * domain.spacing
        shares = placement()
        # Limbs of solid, void between them.
        gamma = (shares.wall + shares.design * (domain.positions[:, 2] < 0.01)).to(device, dtype)
        body = fill_blended(
            domain, gamma, shares, solid=Solid(), gas=Gas(density=3.0, viscosity=0.0), void_range=(0.1, 0.6)
        )
        simulator = Simulator(cell=domain.cell, dt=2e-5, low=(-0.1,) * 3, high=(0.1,) * 3, formulation="total")
        run = simulator(
            body, duration=2e-3, pressure=Waveform(time=torch.tensor([0.0, 1.0]), pressure=torch.full((1, 2), 2e4))
        )
        air = 1e6 * run.chamber_volume[-1].sum()
        air.backward()
        assert placement.center.grad is not None and placement.size.grad is not None
        return air.item(), torch.cat([placement.center.grad, placement.size.grad]).flatten()

    exact, exact_gradient = inflated("cpu", torch.float64)
    air, gradient = inflated(str(cuda), torch.float32)
    torchsoro.init("cpu")
    assert air == pytest.approx(exact, rel=1e-4)
    assert (gradient - exact_gradient).norm() < 1e-2 * exact_gradient.norm()
