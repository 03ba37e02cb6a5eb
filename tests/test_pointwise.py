"""Pointwise stress against the kernels and closed forms, stress-free sides, and derivatives."""

import math
from dataclasses import replace

import pytest
import taichi as ti
import torch
from hypothesis import given
from hypothesis import strategies as st
from problems import DT, H, block, simulator, vector

import torchsoro
from torchsoro import Prony, Solid
from torchsoro.rheology.pointwise import Law, equibiaxial, history, pull_back, simple_shear, stress, uniaxial
from torchsoro.simulation.kernels import constitutive, layout
from torchsoro.simulation.ops.lattice import Lattice
from torchsoro.simulation.ops.state import updated_state

# The annotations of kernels must be values: no ``from __future__ import annotations`` here.
Reals = ti.types.ndarray(dtype=ti.f64, ndim=1)
Integers = ti.types.ndarray(dtype=ti.i32, ndim=1)

SOLID = Solid(youngs_modulus=1.2, poisson_ratio=0.42, linear_stiffening=0.3, quadratic_stiffening=0.2)


@ti.kernel
def drive(
    gradients: Reals, state: Reals, coefficients: Reals, prony: Reals, none: Reals, flags: Integers, elements: ti.i32,
    tau: Reals, steps: ti.i32,
):  # fmt: skip
    """Deform one particle by the simulator's own steps, and note its Kirchhoff stress after each."""
    ti.loop_config(serialize=True)
    for n in range(steps):
        change = constitutive.load_matrix(gradients, 9 * n, 1)
        constitutive.deform(True, state, 0, 0, coefficients, 0, 1, prony, 0, elements, -1, change, flags)
        found = constitutive.stress(True, state, 0, coefficients, 0, 1, prony, 0, elements, -1, none, 0)
        constitutive.store_matrix(tau, 9 * n, 1, found)


def noise(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def even(count, dt):
    return torch.full((count,), dt, dtype=torch.float64)


@pytest.mark.parametrize("elements", [0, 1, 5])
def test_stress_history_equals_updated_kernel_of_one_particle(elements):
    torchsoro.init("cpu")
    steps, dt, prony = 80, 1e-3, Prony.paper(elements)
    waves = torch.sin(torch.linspace(0.05, 4, steps).double()[:, None] * vector(1.0, 2.3, 5.1))
    F = torch.eye(3).double() + torch.einsum("tk,kij->tij", 0.25 * waves, noise(3, 3, 3, seed=4))
    assert float(torch.linalg.det(F).min()) > 0.2
    assert float(torch.linalg.matrix_norm(F, 2).max()) > 1.5
    before = torch.cat([torch.eye(3).double()[None], F[:-1]])
    gradients = F @ torch.linalg.inv(before) - torch.eye(3)
    zeros = torch.zeros(1, 1, 3, dtype=torch.float64)
    state = updated_state(zeros, zeros, elements).reshape(-1)
    coefficients = torch.zeros(layout.COEFFICIENTS, dtype=torch.float64)
    coefficients[layout.BULK], coefficients[layout.SHEAR] = SOLID.bulk, SOLID.shear
    coefficients[layout.STIFFENING : layout.STIFFENING + 2] = vector(0.3, 0.2)
    tau, none, flags = torch.zeros(steps, 3, 3).double(), torch.zeros(1).double(), torch.zeros(2, dtype=torch.int32)
    numbers = torch.cat([prony.discrete(dt).reshape(-1), torch.zeros(1)]).contiguous()
    drive(gradients.reshape(-1), state, coefficients, numbers, none, flags, elements, tau.view(-1), steps)
    assert not flags.any()
    found = stress(F, even(steps, dt), Law.of(SOLID, prony)) @ F.mT
    assert float((found - tau).abs().max()) < 1e-12 * float(tau.abs().max())


def test_stress_history_equals_total_lagrangian_kernel():
    # A cube of a single cell, flung apart; it keeps Z = H - b S.
    _, body = block((2, 2, 2))
    body = replace(body, velocity=(body.position - body.position.mean(0)) @ (400 * noise(3, 3)))
    body = replace(body, stiffening=vector(0.3, 0.2).expand(8, 2))
    sim, prony = simulator(formulation="total", dt=DT / 2), Prony.paper(3)
    lattice, finals, final = Lattice.around(body.position, 2 * H), [], None
    for _ in range(40):
        final = sim(body, duration=DT / 2, gravity=(0.0, 0.0, 0.0), prony=prony, start=final).final
        finals.append(final[0])
    d = torch.stack(finals)[:, : 3 * lattice.nodes].view(40, 3, lattice.nodes)
    F = lattice.gradient(d)[..., 3] + torch.eye(3).double()
    assert float((F - torch.eye(3)).abs().max()) > 0.1
    law = Law.of(SOLID, prony)
    S = pull_back(F, law)
    for e, (_, b, _) in enumerate(prony.discrete(DT / 2)):
        one = replace(law, moduli=torch.ones(1).double(), times=prony.times[e : e + 1])
        wanted = (history(S, even(40, DT / 2), one) - b * S)[-1]
        Z = finals[-1][6 * lattice.nodes :].view(3, 6, 8)[e, :, 3]
        six = torch.stack([wanted[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))])
        torch.testing.assert_close(Z, six, rtol=0, atol=1e-12 * float(six.abs().max()))


def test_discrete_decay_and_gain_equal_prony_discrete():
    prony, dt = Prony.paper(5), torch.logspace(-8, 1, 10, dtype=torch.float64)
    decay, gain = Law.of(SOLID, prony).discrete(dt)
    for k, step in enumerate(dt.tolist()):
        both = torch.stack([decay[k], gain[k]], -1)
        torch.testing.assert_close(both, prony.discrete(step)[:, :2], rtol=1e-12, atol=1e-300)


# ------------------------------------------------------------------------------------------------------- free sides


def path(count=60):
    time = torch.linspace(0, 1, count + 1, dtype=torch.float64)[1:]
    return torch.stack([1 + 1.2 * torch.sin(3 * time), 1 - 0.5 * time, 1 + 0.4 * torch.sin(20 * time)])


@pytest.mark.parametrize("poisson_ratio", [0.0, 0.4, 0.499])
def test_lateral_stress_vanishes_and_axial_stress_matches_full_path(poisson_ratio):
    # The middle path is compressed; each has steps of its own.
    law = Law.of(replace(SOLID, poisson_ratio=poisson_ratio), Prony.paper(3))
    stretch = path()
    dt = torch.logspace(-4, -1, 3, dtype=torch.float64)[:, None] * torch.linspace(0.5, 2, 60).double()
    for test, axes in ((uniaxial, (0, 2, 2)), (equibiaxial, (0, 0, 2))):
        found, free = test(stretch, dt, law)
        stretches = (stretch, stretch, free)
        P = stress(torch.diag_embed(torch.stack([stretches[a] for a in axes], -1)), dt, law)
        scale = float(P.abs().max())
        assert float(P[..., 2, 2].abs().max()) < 1e-11 * scale
        assert float((P[..., 0, 0] - found).abs().max()) < 1e-12 * scale
        assert float((P[..., 1, 1] - (P[..., 2, 2] if axes[1] == 2 else P[..., 0, 0])).abs().max()) < 1e-12 * scale


def test_nearly_incompressible_stress_matches_closed_forms_of_yeoh():
    law = Law.of(replace(SOLID, poisson_ratio=0.5 - 1e-9))
    stretch = torch.linspace(0.5, 5, 46, dtype=torch.float64)
    dt, mu = even(46, 1.0), float(law.shear)
    for test, thinned, power in (
        (uniaxial, stretch**2 + 2 / stretch, -2),
        (equibiaxial, 2 * stretch**2 + stretch**-4, -5),
    ):
        x = thinned - 3
        wanted = mu * (1 + 0.3 * x + 0.2 * x**2) * (stretch - stretch**power)
        torch.testing.assert_close(test(stretch, dt, law)[0], wanted, rtol=1e-4, atol=1e-6)
    g = torch.linspace(-3, 3, 46, dtype=torch.float64)
    torch.testing.assert_close(simple_shear(g, dt, law), mu * g * (1 + 0.3 * g**2 + 0.2 * g**4), rtol=1e-12, atol=1e-12)


@given(ratio=st.floats(1e-3, 1e3), count=st.integers(1, 20))
def test_shear_stress_at_constant_rate_matches_maxwell_element_for_any_step(ratio, count):
    # Linear viscoelasticity: mu (rate t + g tau rate (1 - exp(-t/tau))); neo-Hookean to the square of the strain.
    law = Law.of(Solid(), Prony(moduli=vector(2.0), times=vector(1.0)))
    time = ratio * torch.arange(1, count + 1, dtype=torch.float64)
    rate = 1e-6 / float(time[-1])
    wanted = law.shear * rate * (time - 2 * torch.expm1(-time))
    torch.testing.assert_close(simple_shear(rate * time, even(count, ratio), law), wanted, rtol=1e-9, atol=0)


def test_stress_relaxation_after_step_strain_matches_prony_series():
    # Simo's model factors: stress over that of the law alone is 1 + sum g b exp(-t/tau), at any strain.
    prony, dt, count = Prony.paper(2), 1e-3, 40
    with_, without = Law.of(SOLID, prony), Law.of(SOLID)
    g = torch.full((count,), 3.0, dtype=torch.float64)
    a, b, modulus = prony.discrete(dt).unbind(-1)
    wanted = 1 + (modulus * b * a ** torch.arange(count).unsqueeze(-1)).sum(-1)
    found = simple_shear(g, even(count, dt), with_) / simple_shear(g, even(count, dt), without)
    torch.testing.assert_close(found, wanted, rtol=1e-12, atol=0)


# ------------------------------------------------------------------------------------------------------ derivatives


def at(numbers):
    """A law of seven numbers [..., 7], in a batch before the tests."""
    shear, a, b = (numbers[..., k, None] for k in range(3))
    return Law(
        shear=shear,
        bulk=9 * shear,
        stiffening=torch.stack([a, b], -1),
        moduli=numbers[..., None, 3:5],
        times=numbers[..., None, 5:7],
    )


@pytest.mark.parametrize(
    "test", ["shear", *(pytest.param(t, marks=pytest.mark.slow) for t in ("uniaxial", "equibiaxial"))]
)
def test_complex_step_and_autograd_derivatives_match_for_every_constant(test):
    stretch = path(12)
    dt = even(12, 0.05)
    run = {
        "shear": lambda law: simple_shear(stretch - 1, dt, law),
        "uniaxial": lambda law: uniaxial(stretch, dt, law)[0],
    }
    run["equibiaxial"] = lambda law: equibiaxial(stretch, dt, law)[0]
    numbers = vector(0.7, 0.3, 0.2, 1.5, 0.4, 0.1, 0.6)
    leaf = numbers.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda n: run[test](at(n)), (leaf,), atol=1e-8, rtol=1e-6)
    # The complex step, all seven at once.
    slopes = run[test](at(numbers + 1e-30j * torch.eye(7).double())).imag / 1e-30
    weight = noise(3, 12)
    (by,) = torch.autograd.grad((run[test](at(leaf)) * weight).sum(), leaf)
    torch.testing.assert_close((slopes * weight).sum((1, 2)), by, rtol=1e-11, atol=1e-12)


# --------------------------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda law: uniaxial(vector(1.0, -0.1), even(2, 1.0), law), r"stretch = -0\.1: wanted finite and positive"),
        (lambda law: uniaxial(vector(1.0, 1.1), even(2, 0.0), law), r"dt = 0\.0: wanted finite and positive"),
        (lambda law: uniaxial(vector(1.0, 1.1), even(3, 1.0), law), r"dt: shape \(3,\), wanted a length for each"),
        (lambda law: stress(torch.eye(3).double(), even(1, 1.0), law), r"F, dt: shapes \(3, 3\) and \(1,\), wanted"),
        (lambda law: stress(-torch.eye(3).double()[None], even(1, 1.0), law), r"det F = -1\.0: wanted finite and pos"),
        (lambda law: simple_shear(vector(math.nan), even(1, 1.0), law), r"det F = nan: wanted finite and positive"),
        (
            lambda law: uniaxial(vector(1.5), even(1, 1.0), replace(law, bulk=0 * law.bulk, shear=0 * law.shear)),
            r"no lateral stretch frees the",
        ),
    ],
)
def test_non_positive_stretch_step_or_volume_ratio_is_refused(call, message):
    with pytest.raises(ValueError, match="^" + message):
        call(Law.of(SOLID))
