"""A solid that stiffens with stretch (Yeoh): its law and adjoints in the kernels, and in bodies."""

import math
from dataclasses import replace

import pytest
import taichi as ti
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import DT, H, block, rotations, simulator, vector, ways

import torchsoro
from torchsoro import Chamber, Domain, Gas, Prony, Region, Solid, fill
from torchsoro.simulation.kernels import stress, tensor
from torchsoro.simulation.material import SOFTEST
from torchsoro.simulation.ops.lattice import Lattice
from torchsoro.simulation.stability import courant

# The annotations of kernels must be values: no ``from __future__ import annotations`` here.
Reals = ti.types.ndarray(dtype=ti.f64, ndim=1)

BULK, SHEAR, LINEAR, SQUARE, VOID_FRACTION = range(5)
FREE = (0.0, 0.0, 0.0)
LAW = (2.3, 0.7, 0.4, 0.9, 0.0)


@ti.func
def matrix(a: ti.template(), i):
    return tensor.load_matrix(a, 9 * i, 1)


@ti.kernel
def run_solid(F: Reals, Q: Reals, law: Reals, P: Reals, S: Reals, n: ti.i32):
    for i in range(n):
        c, f = 5 * i, matrix(F, i)
        least = stress.least_ratio(law[c + VOID_FRACTION])
        factor = stress.stiffening(f, least, law[c + LINEAR], law[c + SQUARE])
        mu = law[c + SHEAR]
        p = stress.piola(f, matrix(Q, i), law[c + BULK], mu, factor, law[c + VOID_FRACTION])
        tensor.store_matrix(P, 9 * i, 1, p)
        tensor.store_matrix(S, 9 * i, 1, factor * stress.pull_back(f, least))


@ti.kernel
def run_adjoint(F: Reals, Q: Reals, law: Reals, P_bar: Reals, S_bar: Reals, F_bar: Reals, law_bar: Reals, n: ti.i32):
    for i in range(n):
        c, f = 5 * i, matrix(F, i)
        least = stress.least_ratio(law[c + VOID_FRACTION])
        factor = stress.stiffening(f, least, law[c + LINEAR], law[c + SQUARE])
        mu = law[c + SHEAR]
        by_F, _Q, bulk, shear, factor_bar, void_fraction = stress.piola_adjoint(
            f, matrix(Q, i), law[c + BULK], mu, factor, law[c + VOID_FRACTION], matrix(P_bar, i)
        )
        by_F += stress.pull_back_adjoint(f, least, factor * matrix(S_bar, i))
        factor_bar += tensor.contract(matrix(S_bar, i), stress.pull_back(f, least))
        by_factor, linear, square = stress.stiffening_adjoint(f, least, law[c + LINEAR], law[c + SQUARE], factor_bar)
        tensor.store_matrix(F_bar, 9 * i, 1, by_F + by_factor)
        law_bar[c + BULK], law_bar[c + SHEAR], law_bar[c + VOID_FRACTION] = bulk, shear, void_fraction
        law_bar[c + LINEAR], law_bar[c + SQUARE] = linear, square


@pytest.fixture(scope="module", autouse=True)
def started():
    torchsoro.init("cpu")


def rows(law, count):
    law = torch.as_tensor(law, dtype=torch.float64)
    return law.expand(count, 5).contiguous()


def solid(F, Q=None, law=LAW):
    """First Piola stress, and S with stiffening."""
    P, S = torch.zeros_like(F), torch.zeros_like(F)
    Q = torch.zeros_like(F) if Q is None else Q
    given = (F.contiguous(), Q.contiguous(), rows(law, len(F)), P, S)
    run_solid(*(t.view(-1) for t in given), len(F))
    return P, S


def deformations(count=32, *, seed=0, size=1.0):
    g = torch.Generator().manual_seed(seed)
    return torch.eye(3).double() + size * (torch.rand(count, 3, 3, generator=g, dtype=torch.float64) - 0.5)


def energy(F, law=LAW):
    bulk, shear, a, b, _ = law
    J = torch.linalg.det(F)
    x = J ** (-2 / 3) * (F * F).sum((-1, -2)) - 3
    C20, C30 = a * shear / 4, b * shear / 6
    return shear / 2 * x + C20 * x**2 + C30 * x**3 + bulk / 4 * ((J - 1) ** 2 + torch.log(J) ** 2)


# ----------------------------------------------------------------------------------------------------------- the law


@pytest.mark.parametrize("law", [LAW, (2.3, 0.7, -0.5, 0.2, 0.0), (2.3, 0.7, 0.0, 0.0, 0.0)])
def test_stress_is_the_derivative_of_yeohs_energy(law):
    F = deformations().requires_grad_()
    assert float(torch.linalg.det(F.detach()).min()) > 0.1
    (P,) = torch.autograd.grad(energy(F, law).sum(), F)
    torch.testing.assert_close(solid(F.detach(), law=law)[0], P, rtol=1e-11, atol=1e-12)


def test_without_bulk_and_void_s_is_the_whole_stress():
    # tau = J mu Fb S Fb^T: what the Maxwell elements follow is all of the hyperelastic stress.
    F = deformations()
    J = torch.linalg.det(F)[:, None, None]
    law = (0.0, *LAW[1:])
    P, S = solid(F, law=law)
    Fb = F * J ** (-1 / 3)
    torch.testing.assert_close(P @ F.mT, J * 0.7 * (Fb @ S @ Fb.mT), rtol=1e-11, atol=1e-12)
    torch.testing.assert_close(solid(F, S, law=law)[0], 2 * P, rtol=1e-11, atol=1e-12)


def test_uniaxial_stress_of_an_incompressible_yeoh_solid():
    # sigma_1 - sigma_3 = 2 (l^2 - 1/l) (C10 + 2 C20 x + 3 C30 x^2), x = l^2 + 2/l - 3.
    stretch = torch.linspace(0.4, 6.0, 29, dtype=torch.float64)
    F = torch.diag_embed(torch.stack([stretch, stretch**-0.5, stretch**-0.5], -1))
    P, _ = solid(F)
    tau = P @ F.mT
    _, mu, a, b, _ = LAW
    C10, C20, C30 = mu / 2, a * mu / 4, b * mu / 6
    x = stretch**2 + 2 / stretch - 3
    wanted = 2 * (stretch**2 - 1 / stretch) * (C10 + 2 * C20 * x + 3 * C30 * x**2)
    torch.testing.assert_close(tau[:, 0, 0] - tau[:, 2, 2], wanted, rtol=1e-12, atol=1e-12)


def test_simple_shear_of_yeohs_solid():
    # tau_12 = 2 g W', and the first normal stress difference is g tau_12; W' = dW/dI1 at x = g^2.
    g = torch.linspace(-4, 4, 17, dtype=torch.float64)
    F = torch.eye(3).double().repeat(17, 1, 1)
    F[:, 0, 1] = g
    P, _ = solid(F)
    tau = P @ F.mT
    _, mu, a, b, _ = LAW
    wanted = g * mu * (1 + a * g**2 + b * g**4)
    torch.testing.assert_close(tau[:, 0, 1], wanted, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(P[:, 0, 1], wanted, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(tau[:, 0, 0] - tau[:, 1, 1], g * wanted, rtol=1e-12, atol=1e-11)


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000), size=st.floats(0.01, 1.0), a=st.floats(-1, 3), b=st.floats(0.3, 3))
def test_frame_indifference(seed, size, a, b):
    F, Q, R = deformations(seed=seed, size=size), deformations(seed=seed + 1), rotations(32, seed=seed)
    Q = Q + Q.mT
    law = (2.3, 0.7, a, b, 0.0)
    (P, S), (turned, same) = solid(F, Q, law), solid(R @ F, Q, law)
    assert float((turned - R @ P).abs().max()) <= 1e-10 * float(P.abs().max())
    assert float((same - S).abs().max()) <= 1e-10 * float(S.abs().max())


@pytest.mark.parametrize(("void_fraction", "crushed"), [(0.0, False), (0.3, False), (0.3, True)])
def test_adjoints_of_the_stiffening_solid(void_fraction, crushed):
    g = torch.Generator().manual_seed(6)

    def noise(*shape):
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    F, Q, P_bar, S_bar, d = deformations(), noise(32, 3, 3), noise(32, 3, 3), noise(32, 3, 3), noise(32, 3, 3)
    Q, S_bar = Q + Q.mT, S_bar + S_bar.mT
    if crushed:
        ratio = torch.linspace(-1.0, 0.19, 32, dtype=torch.float64)
        F = F * ((ratio / torch.linalg.det(F)).abs().pow(1 / 3) * ratio.sign())[:, None, None]
    law = torch.rand(32, 5, generator=g, dtype=torch.float64) + 0.5
    law[:, VOID_FRACTION] = void_fraction
    F_bar, law_bar = torch.zeros(32, 3, 3).double(), torch.zeros(32, 5).double()
    run_adjoint(*(t.contiguous().view(-1) for t in (F, Q, law, P_bar, S_bar, F_bar, law_bar)), 32)

    def power(F=F, law=law):
        P, S = solid(F, Q, law)
        return (P * P_bar).sum((1, 2)) + (S * S_bar).sum((1, 2))

    e = 1e-6
    slope = (power(F=F + e * d) - power(F=F - e * d)) / (2 * e)
    torch.testing.assert_close((F_bar * d).sum((1, 2)), slope, rtol=2e-6, atol=2e-6)
    for k in range(5 if void_fraction else 4):
        one = e * torch.nn.functional.one_hot(torch.tensor(k), 5).double()
        slope = (power(law=law + one) - power(law=law - one)) / (2 * e)
        torch.testing.assert_close(law_bar[:, k], slope, rtol=2e-6, atol=2e-6)


# -------------------------------------------------------------------------------------------------------- in bodies


def stretched(*, a=0.8, b=0.5, **more):
    """A block that is flung apart to a stretch of 1.3 to 1.4, and its stiffening."""
    _, body = block((4, 4, 6))
    rate = vector(-1200.0, -1200.0, 2500.0).diag()
    body = replace(body, velocity=(body.position - body.position.mean(0)) @ rate)
    return replace(body, stiffening=vector(a, b).expand(96, 2), **more)


def travelled(body, way, *, prony=None, dt=DT / 4, steps=80):
    run = simulator(dt=dt, **way)(
        body,
        duration=steps * dt,
        gravity=FREE,
        prony=prony,
        sample_every=steps * dt,
        probes=torch.arange(96),
    )
    g = torch.Generator().manual_seed(3)
    return (run.position[-1] * torch.randn(96, 3, generator=g, dtype=torch.float64)).sum(), run.final


@ways("apic", "total")
@pytest.mark.parametrize("size", [1.0, 0.0])
def test_gradients_of_a_body_that_stiffens(way, size):
    body, prony = stretched(a=0.8 * size, b=0.5 * size), Prony.paper(2)

    def end(leaves):
        moved = replace(body, **{name: leaves[name] for name in ("stiffening", "shear", "velocity")})
        return travelled(moved, way, prony=Prony(moduli=leaves["moduli"], times=prony.times))[0]

    given = {name: getattr(body, name) for name in ("stiffening", "shear", "velocity")} | {"moduli": prony.moduli}
    leaves = {name: t.clone().requires_grad_() for name, t in given.items()}
    found = dict(zip(leaves, torch.autograd.grad(end(leaves), list(leaves.values())), strict=True))
    for seed, (name, scale) in enumerate({"stiffening": 1e-4, "shear": 1e1, "velocity": 1e-4, "moduli": 1e-4}.items()):
        for column in range(2 if name == "stiffening" else 1):
            change = torch.rand(given[name].shape, generator=torch.Generator().manual_seed(seed)).double() * scale
            if name == "stiffening":
                change = change * vector(1 - column, column)
            ends = [end({**given, name: given[name] + sign * change}) for sign in (-1, 1)]
            assert float((found[name] * change).sum()) == pytest.approx(float(ends[1] - ends[0]) / 2, rel=2e-5), name
    # It matters: without, the body goes elsewhere.
    plain = travelled(replace(body, stiffening=None), way, prony=prony)[1]
    assert bool((travelled(body, way, prony=prony)[1] - plain).abs().max() > 1e-4 * H) == (size > 0)


@ways("apic", "flip", "total")
def test_stiffening_of_zero_is_neo_hookean(way):
    body = stretched(a=0.0, b=0.0)
    zero = body.stiffening.clone().requires_grad_()  # type: ignore[union-attr]
    finals = [
        travelled(replace(body, stiffening=s), way, prony=Prony.paper(3))[1] for s in (None, body.stiffening, zero)
    ]
    assert torch.equal(finals[0], finals[1])  # the same kernel
    torch.testing.assert_close(finals[2].detach(), finals[0], rtol=1e-11, atol=1e-12)


def test_forces_on_the_nodes_are_the_slope_of_the_energy():
    body = replace(stretched(), velocity=None)
    lattice = Lattice.around(body.position, 2 * H)
    d = (0.2 * H * torch.randn(3, lattice.nodes, generator=torch.Generator().manual_seed(5)).double()).requires_grad_()
    F = lattice.gradient(d.unsqueeze(0))[0].permute(2, 0, 1) + torch.eye(3).double()
    law = (Solid().bulk, Solid().shear, 0.8, 0.5, 0.0)
    (slope,) = torch.autograd.grad((body.volume * energy(F, law)).sum(), d)
    start = torch.cat([d.detach().reshape(-1), torch.zeros(3 * lattice.nodes).double()]).unsqueeze(0)
    dt = 1e-9
    final = simulator(dt=dt, formulation="total")(body, duration=dt, gravity=FREE, start=start).final
    v = final[0, 3 * lattice.nodes :].view(3, -1)
    force = -v * lattice.nodal_mass(body.mass.unsqueeze(0))[0] / dt
    torch.testing.assert_close(force, slope, rtol=1e-9, atol=1e-9 * float(slope.abs().max()))


def test_fill_gives_the_solid_its_stiffening_and_the_gas_none():
    domain = Domain(
        size=(8 * H,) * 3,
        particles=(8, 8, 8),
        chambers=(Chamber(name="air", center=(4 * H,) * 3, size=(4 * H,) * 3, wall=H),),
    )
    gamma = torch.rand(2, domain.count, dtype=torch.float64)
    body = fill(domain, gamma, solid=Solid(linear_stiffening=0.3, quadratic_stiffening=0.1), gas=Gas())
    air = domain.region == Region.GAS
    assert body.stiffening is not None
    assert bool((body.stiffening[~air] == vector(0.3, 0.1)).all())
    assert not body.stiffening[air].any()
    assert fill(domain, gamma, solid=Solid()).stiffening is None
    run = simulator(formulation="total")(body, duration=2 * DT, gravity=FREE)
    assert run.final.shape[0] == 2


# ------------------------------------------------------------------------------------------------------ stable step


@pytest.mark.parametrize("formulation", ["updated", "total"])
def test_stiffening_does_not_change_the_limit_at_rest(formulation):
    _, plain = block()
    body = replace(plain, stiffening=vector(0.3, 0.2).expand(64, 2))
    settings = {"dt": 1e-6, "cell": 2 * H, "formulation": formulation}
    assert courant(body, Prony.paper(3), **settings) == courant(plain, Prony.paper(3), **settings)


@pytest.mark.parametrize(("a", "b"), [(math.nan, 0.0), (0.0, -0.1), (-0.1, 0.0), (-0.7, 0.25), (0.0, math.inf)])
def test_a_law_whose_stress_falls_is_refused(a, b):
    with pytest.raises(ValueError, match=r"^linear_stiffening, quadratic_stiffening = .*: wanted a, b with b >= 0 and"):
        Solid(linear_stiffening=a, quadratic_stiffening=b)


@given(log_b=st.floats(-12, 6), over=st.floats(0, 5))
def test_the_stress_of_a_solid_that_is_accepted_falls_nowhere(log_b, over):
    b = math.exp(log_b)
    a = (over - SOFTEST) * math.sqrt(b)
    Solid(linear_stiffening=a, quadratic_stiffening=b)
    for invariant, stress_of, low in (
        (lambda v: v**2, lambda v: v, 0.0),
        (lambda v: v**2 + 2 / v - 3, lambda v: v - v**-2, 0.05),
        (lambda v: 2 * v**2 + v**-4 - 3, lambda v: v - v**-5, 0.2),
    ):
        v = torch.linspace(low, 40, 20_001, dtype=torch.float64)
        x = invariant(v)
        assert bool(((1 + a * x + b * x**2) * stress_of(v)).diff().gt(0).all())


@pytest.mark.parametrize(
    ("stiffening", "message"),
    [
        (torch.zeros(64).double(), r"body\.stiffening: shape \(64,\), wanted \[\.\.\., 64, 2\]"),
        (torch.zeros(64, 2), r"body\.stiffening: torch\.float32 on cpu, wanted torch\.float64 on cpu"),
        (torch.full((64, 2), math.inf).double(), r"body\.stiffening: value inf, wanted finite"),
    ],
)
def test_bad_stiffening_is_refused(stiffening, message):
    _, body = block()
    with pytest.raises(ValueError, match="^" + message):
        simulator()(replace(body, stiffening=stiffening), duration=10 * DT)
