"""The same kernels on a CUDA device: skipped where there is none."""

from __future__ import annotations

import pytest
import torch

import torchsoro
from torchsoro import Chamber, DesignField, Domain, Prony, Simulator, Solid, fill, ground, square_wave


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
