"""Masses of nodes with the body's moments of inertia: what they keep, and how fast a couple turns a free body."""

from __future__ import annotations

import pytest
import torch
from problems import H, block, simulator, vector

from torchsoro import Force
from torchsoro.simulation.ops.axis_sums import QUADRATURE
from torchsoro.simulation.ops.inertia import Matching
from torchsoro.simulation.ops.lattice import Lattice


def lattice(*points: int) -> Lattice:
    return Lattice.uniform(points, (0.3, -1.0, 2.0), 0.5)


def porous(lat: Lattice, share: float, *, seed: int = 0) -> torch.Tensor:
    """Masses of points [2, points], a share of which are void at a thousandth."""
    g = torch.Generator().manual_seed(seed)
    mass = 1 + torch.rand(2, lat.count, generator=g, dtype=torch.float64)
    return torch.where(torch.rand(2, lat.count, generator=g) < share, 1e-3 * mass, mass)


def moments(mass: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """Mass, first and second moments [B, 13]."""
    products = (x.unsqueeze(2) * x.unsqueeze(1)).flatten(1)
    return mass @ torch.cat([torch.ones_like(x[:, :1]), x, products], 1)


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_second_moments_of_the_nodes_are_less_by_a_quarter_cell_squared_and_all_others_stay(share):
    lat = lattice(12, 10, 16)
    mass = porous(lat, share)
    lumped, matched = lat.to_nodes(mass), lat.nodal_mass(mass)
    change = moments(matched, lat.node_places) - moments(lumped, lat.node_places)
    expected = torch.zeros_like(change)
    expected[:, [4, 8, 12]] = -mass.sum(1, keepdim=True) * lat.cell**2 / 4
    torch.testing.assert_close(change, expected, rtol=1e-9, atol=1e-9 * float(mass.sum()))
    assert float((matched / lumped).min()) > 0.4


@pytest.mark.parametrize(("cells", "least"), [(1, 0.9), (2, 0.7), (4, 0.4), (10, 0.85)])
def test_no_node_loses_more_than_a_stated_share_of_its_mass(cells, least):
    lat = lattice(*(2 * cells,) * 3)
    mass = porous(lat, 0.0)
    assert float((lat.nodal_mass(mass) / lat.to_nodes(mass)).min()) >= least * (1 - 1e-12)


# All of the change; a part, where it fades; none.
@pytest.mark.parametrize(
    ("points", "strength"), [((8, 8, 12), (1.0, 1.0)), ((4, 6, 8), (0.02, 0.98)), ((2, 2, 2), (0, 0.1))]
)
def test_gradient_by_the_lumped_masses_agrees_with_central_differences(points, strength):
    lat = lattice(*points)
    lumped = lat.to_nodes(porous(lat, 0.0))
    spread = torch.full((lat.nodes, 3), lat.cell**2 / 4).double()

    def matching(lumped: torch.Tensor) -> Matching:
        return Matching.of(lumped, lat.node_places, spread)

    g = torch.Generator().manual_seed(1)
    bar = torch.randn(lumped.shape, generator=g, dtype=torch.float64)
    found = matching(lumped)
    assert bool(((found.strength >= strength[0]) & (found.strength <= strength[1])).all())
    by = found.adjoint(bar)
    for _ in range(4):
        way = 1e-6 * lumped * torch.randn(lumped.shape, generator=g, dtype=torch.float64)
        slope = ((matching(lumped + way).matched - matching(lumped - way).matched) * bar).sum() / 2
        torch.testing.assert_close((by * way).sum(), slope, rtol=1e-6, atol=1e-12)


def turned(cells: int) -> float:
    """Rotation of a free bar twice as long as wide by a couple at its ends, over that of a rigid body."""
    width, length = 2 * cells, 4 * cells
    domain, body = block((width, width, length))
    x = body.position - body.position.mean(0)
    ends = [(x[:, 2] * side > (length / 2 - 1) * H).nonzero()[:, 0] for side in (1, -1)]
    force, dt = 1e-4, 1e-4 * 4 / cells if cells > 4 else 1e-4
    loads = [
        Force(particles=end, value=vector(side * force, 0.0, 0.0)) for end, side in zip(ends, (1, -1), strict=True)
    ]
    duration = 0.1
    run = simulator(dt=dt, formulation="total")(
        body,
        duration=duration,
        gravity=(0.0, 0.0, 0.0),
        loads=loads,
        sample_every=duration / 50,
        probes=torch.arange(len(x)),
    )
    u = run.position - run.position[0]
    angle = (x[:, 2] * u[..., 0] - x[:, 0] * u[..., 2]).sum(1) / (x[:, 2] ** 2 + x[:, 0] ** 2).sum()
    # It also bends, around a shape that stays.
    t = run.time
    acceleration = torch.linalg.lstsq(torch.stack([t * t / 2, torch.ones_like(t)], 1), angle.unsqueeze(1)).solution[0]
    size = torch.tensor(domain.size, dtype=torch.float64)
    inertia = float(body.mass.sum() * (size[0] ** 2 + size[2] ** 2)) / 12
    # Forces on particles act at the points of quadrature of their cells.
    couple = force * (length - 2 + 4 * QUADRATURE) * H
    return float(acceleration) * inertia / couple


@pytest.mark.parametrize(("cells", "within"), [(3, 0.02), (4, 0.01)])
def test_a_couple_turns_a_free_bar_within_one_percent_of_the_exact_rotation_at_4_cells(cells, within):
    assert turned(cells) == pytest.approx(1.0, abs=within)
