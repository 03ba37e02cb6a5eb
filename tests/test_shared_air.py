"""Solids of which a share is air of a chamber: gradients, both engines, and gas as a special case."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from problems import constant, problem, with_shared_air, without_normals
from test_lattice_forces import one_at_once, uneven
from test_ops import check

from torchsoro import Chamber, Domain, Gas, Prony, Simulator, Solid, fill
from torchsoro.simulation.kernels import layout
from torchsoro.simulation.material import Body

DOMAIN = Domain(
    size=(0.02,) * 3,
    particles=(8,) * 3,
    origin=(0.0, 0.0, 1e-3),
    chambers=(Chamber(name="air", center=(0.01, 0.01, 0.011), size=(0.01,) * 3, wall=0.0025),),
)


@one_at_once
def test_gradcheck_by_shares_of_air_and_what_acts_on_them(lanes):
    p = with_shared_air(problem(formulation="total", lattice=uneven(), batch=2, lanes=lanes))
    assert check(p, "coefficients", "pressure", "state")


@pytest.mark.slow
def test_both_engines_give_the_same_motion_and_gradients_by_shares():
    found = []
    for lanes in (True, False):
        p = with_shared_air(problem(formulation="total", lattice=uneven(), batch=2, lanes=lanes))
        assert p.scene.lattice is not None
        motion = 6 * p.scene.lattice.nodes  # void has no history
        p.tensors["state"][:, motion:] = 0
        leaves = p.leaves()
        outputs = p.run(leaves)[:8]
        total = torch.stack([(out * torch.linspace(0.5, 1.5, out.numel()).view_as(out)).sum() for out in outputs]).sum()
        by = dict(zip(leaves, torch.autograd.grad(total, list(leaves.values())), strict=True))
        by["planes"], by["state"] = without_normals(by["planes"]), by["state"][:, :motion]
        found.append([outputs[0][:, :motion], *outputs[1:], *by.values()])
        assert bool((by["coefficients"][:, layout.AIR_SHARE][:, p.scene.air >= 0] != 0).all())
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-11, atol=1e-12)


def shared(body: Body, gas: Gas) -> Body:
    """The same body, whose gas is solids that are air altogether."""
    air = body.chamber >= 0
    assert body.void_fraction is not None
    return replace(
        body,
        air_share=air.to(body.mass),
        share_stiffness=torch.where(air, float(gas.stiffness), 0.0).to(body.mass),
        bulk=torch.where(air, 0.0, body.bulk),
        viscosity=None,
        void_fraction=torch.where(air, 1.0, body.void_fraction),
    )


def test_a_share_of_one_is_gas():
    simulator = Simulator(cell=DOMAIN.cell, dt=1e-5, low=(-0.1,) * 3, high=(0.1,) * 3, formulation="total")
    gas = Gas(density=3.0, viscosity=0.0)
    body = fill(DOMAIN, DOMAIN.wall.double(), solid=Solid(), gas=gas, void_range=(0.1, 0.3))
    how = {"duration": 1e-3, "prony": Prony.paper(2), "pressure": constant(2e4)}
    one, other = simulator(body, **how), simulator(shared(body, gas), **how)
    assert float((one.chamber_volume[-1] / one.chamber_volume[0] - 1).abs()) > 1e-3
    for name in ("final", "chamber_volume", "chamber_pressure", "center_of_gravity"):
        assert torch.equal(getattr(one, name), getattr(other, name)), name


def test_shares_that_no_chamber_has_are_refused():
    simulator = Simulator(cell=DOMAIN.cell, dt=1e-5, low=(-0.1,) * 3, high=(0.1,) * 3, formulation="total")
    gas = Gas(density=3.0)
    body = shared(fill(DOMAIN, DOMAIN.wall.double(), solid=Solid(), gas=gas, void_range=(0.1, 0.3)), gas)
    assert body.air_share is not None
    for share in (body.air_share + 0.1, 2 * body.air_share):
        with pytest.raises(ValueError, match=r"body.air_share: up to [12].*, wanted 0 to 1, and 0 where body.chamber"):
            simulator(replace(body, air_share=share), duration=1e-4)
    with pytest.raises(ValueError, match=r"body.share_stiffness: given without body.air_share"):
        simulator(replace(body, air_share=None), duration=1e-4)
    updated = Simulator(cell=DOMAIN.cell, dt=1e-5, low=(-0.1,) * 3, high=(0.1,) * 3, formulation="updated")
    with pytest.raises(ValueError, match=r"body.air_share: which the updated formulation has not"):
        updated(body, duration=1e-4)


def test_a_kind_names_the_chamber_that_a_solid_encloses():
    p = with_shared_air(problem(formulation="total"))
    assert p.scene.shared and p.scene.gas_chambers == 2
    assert set(p.scene.air.unique().tolist()) == {layout.ABSENT, -1, 0, 1}
