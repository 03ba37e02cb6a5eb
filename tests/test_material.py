"""Interpolation, filling, the Prony series and its discrete update, and the stable step."""

import math
from dataclasses import fields, replace

import pytest
import taichi as ti
import torch
from hypothesis import given
from hypothesis import strategies as st
from problems import DT, H, block, simulator

import torchsoro
from torchsoro import Body, Chamber, Domain, Gas, Prony, Region, SimulationDiverged, Solid, fill, simp, stable_step
from torchsoro.design.density import without_void
from torchsoro.simulation.kernels import constitutive, layout
from torchsoro.simulation.ops.state import updated_state
from torchsoro.simulation.stability import STABLE_COURANT, courant

# The annotations of kernels must be values: no ``from __future__ import annotations`` here.
Reals = ti.types.ndarray(dtype=ti.f64, ndim=1)
Integers = ti.types.ndarray(dtype=ti.i32, ndim=1)


@ti.kernel
def shear_particle(
    state: Reals, coefficients: Reals, prony: Reals, none: Reals, flags: Integers, omega: ti.f64, dt: ti.f64,
    amplitude: ti.f64, cycles: ti.i32, per_cycle: ti.i32, elements: ti.i32, answer: Reals,
):  # fmt: skip
    """Shear one particle by amplitude * sin(omega t) in the simulator's own steps; lock in on the last cycle."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        before = ti.cast(0, ti.f64)
        for n in range(cycles * per_cycle):
            after = amplitude * ti.sin(omega * dt * (n + 1))
            gradient = ti.Matrix([[0.0, after - before, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]], dt=ti.f64)
            constitutive.deform(False, state, 0, 0, coefficients, 0, 1, prony, 0, elements, -1, gradient, flags)
            tau = constitutive.stress(False, state, 0, coefficients, 0, 1, prony, 0, elements, -1, none, 0)
            before = after
            if n >= (cycles - 1) * per_cycle:
                answer[0] += 2 * tau[0, 1] * ti.sin(omega * dt * (n + 1)) / (amplitude * per_cycle)
                answer[1] += 2 * tau[0, 1] * ti.cos(omega * dt * (n + 1)) / (amplitude * per_cycle)


def discrete_modulus(prony, omega, dt):
    """G*(omega) of the update H <- a H + b (S' - S), from its z-transform."""
    a, b, g = prony.discrete(dt).unbind(-1)
    z = torch.exp(1j * omega * dt).unsqueeze(-1)
    return 1 + (g * b * (1 - 1 / z) / (1 - a / z)).sum(-1)


# --------------------------------------------------------------------------------------------- storage and loss (17)


@pytest.mark.parametrize("elements", [3, 5])
def test_discrete_storage_and_loss_modulus_follow_eq_17(elements):
    prony = Prony.paper(elements)
    omega = torch.logspace(0, 4, 81, dtype=torch.float64)
    storage, loss = prony.storage_loss(omega)
    for dt in (1e-5, 1e-6):
        G = discrete_modulus(prony, omega, dt)
        off = torch.stack([G.real / storage - 1, G.imag / loss - 1]).abs().amax(1)
        print(f"{elements} elements, dt = {dt:g} s: storage off by {off[0]:.2e}, loss by {off[1]:.2e} at most")
        if dt == 1e-6:
            assert float(off.max()) < 0.01


@pytest.mark.parametrize("elements", [3, 5])
@pytest.mark.parametrize("omega", [10.0, 1e2, 1e3, 1e4])
def test_a_particle_in_the_kernels_has_the_moduli_of_eq_17(elements, omega):
    torchsoro.init("cpu")
    prony = Prony.paper(elements)
    per_cycle = max(400, round(2 * math.pi / (omega * 1e-5)))
    dt = 2 * math.pi / omega / per_cycle
    cycles = 2 + math.ceil(6 * 0.273 * omega / (2 * math.pi)) if omega < 1e3 else 60
    zeros = torch.zeros(1, 1, 3, dtype=torch.float64)
    state = updated_state(zeros, zeros, elements).reshape(-1)
    coefficients = torch.zeros(layout.COEFFICIENTS, dtype=torch.float64)
    coefficients[layout.BULK], coefficients[layout.SHEAR] = 2.0, 1.0
    answer, none, flags = torch.zeros(2).double(), torch.zeros(1).double(), torch.zeros(2, dtype=torch.int32)
    numbers = prony.discrete(dt).reshape(-1).contiguous()
    shear_particle(state, coefficients, numbers, none, flags, omega, dt, 1e-3, cycles, per_cycle, elements, answer)
    storage, loss = prony.storage_loss(torch.tensor([omega], dtype=torch.float64))
    assert not flags.any()
    assert float(answer[0]) == pytest.approx(float(storage), rel=0.01)
    assert float(answer[1]) == pytest.approx(float(loss), rel=0.01)
    # And to rounding (and strain squared) what the recursion says in closed form.
    exact = discrete_modulus(prony, torch.tensor([omega], dtype=torch.float64), dt)
    assert float(answer[0]) == pytest.approx(float(exact.real), rel=1e-3)
    assert float(answer[1]) == pytest.approx(float(exact.imag), rel=1e-3)


def test_the_papers_series_is_relative_to_the_equilibrium_modulus():
    prony = Prony.paper(5)
    assert prony.elements == 5
    assert float(prony.moduli[0]) == pytest.approx(6.36e-4 / 9.06e-4)
    # 1 + sum g_i / g_inf: physics of Table S1, 18 times stiffer at once with three elements, 1104 times with five.
    for elements, wanted in ((0, 1.0), (3, 18.0), (4, 156.0), (5, 1104.0)):
        assert float(1 + Prony.paper(elements).moduli.sum()) == pytest.approx(wanted, rel=5e-3)
    storage, _ = prony.storage_loss(torch.tensor([0.0, 1e12], dtype=torch.float64))
    assert storage.tolist() == pytest.approx([1.0, 1104.0], rel=5e-3)
    storage, loss = prony.storage_loss(torch.tensor([10.0], dtype=torch.float64))
    wt = 10 * prony.times
    assert float(storage) == pytest.approx(1 + float((prony.moduli * wt**2 / (1 + wt**2)).sum()))
    assert float(loss) == pytest.approx(float((prony.moduli * wt / (1 + wt**2)).sum()))


def number(value):
    return torch.tensor([value], dtype=torch.float64)


@given(ratio=st.floats(1e-6, 1e3))
def test_the_update_is_exact_for_a_strain_that_changes_linearly(ratio):
    # dH/dt + H/tau = dS/dt with dS/dt = 1/dt: H(dt) = tau/dt (1 - exp(-dt/tau)).
    a, b, g = Prony(moduli=number(2.0), times=number(1 / ratio)).discrete(1.0)[0]
    assert float(a) == pytest.approx(math.exp(-ratio), rel=1e-12)
    assert float(b) == pytest.approx(-math.expm1(-ratio) / ratio, rel=1e-12)
    assert float(g) == 2.0


def test_prony_is_differentiable():
    def numbers(moduli, times):
        return Prony(moduli=moduli, times=times).discrete(0.1)

    leaves = (torch.rand(2, 3).double().requires_grad_(), (torch.rand(2, 3).double() + 0.1).requires_grad_())
    assert torch.autograd.gradcheck(numbers, leaves)


# ---------------------------------------------------------------------------------------------- interpolation, filling


@given(gamma=st.floats(0, 1), epsilon=st.floats(1e-8, 0.5), power=st.floats(1, 5))
def test_simp(gamma, epsilon, power):
    value = float(simp(torch.tensor(gamma, dtype=torch.float64), epsilon=epsilon, power=power))
    assert value == pytest.approx((1 - epsilon) * gamma**power + epsilon, rel=1e-12)
    assert epsilon * (1 - 1e-12) <= value <= 1 + 1e-12
    ends = simp(torch.tensor([0.0, 1.0]).double(), epsilon=epsilon, power=power)
    assert ends.tolist() == pytest.approx([epsilon, 1.0])


def chambers():
    size = (8 * H, 8 * H, 8 * H)
    middle = (4 * H,) * 3
    return Domain(
        size=size, particles=(8, 8, 8), chambers=(Chamber(name="air", center=middle, size=(4 * H,) * 3, wall=H),)
    )


def test_fill_puts_material_where_it_belongs():
    domain = chambers()
    gamma = torch.rand(domain.count, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    solid, gas = Solid(), Gas(viscosity=2.0, volume_viscosity=3.0)
    body = fill(domain, gamma, solid=solid, gas=gas)
    air = domain.region == Region.GAS
    scale = simp(gamma)[~air]
    assert int(air.sum()) == 8
    assert solid.shear == pytest.approx(0.44e6 / 2.8)
    assert solid.bulk == pytest.approx(0.44e6 / 0.6)
    torch.testing.assert_close(body.shear[~air], solid.shear * scale)
    torch.testing.assert_close(body.bulk[~air], solid.bulk * scale)
    torch.testing.assert_close(body.mass[~air], solid.density * H**3 * scale)
    for value, wanted in (
        (body.shear, Gas().shear),
        (body.bulk, 0.14e6),
        (body.mass, 100 * H**3),
        (body.volume, H**3),
    ):
        torch.testing.assert_close(value[air], torch.full((8,), wanted, dtype=torch.float64))
    assert body.viscosity is not None
    assert body.volume_viscosity is not None
    assert body.viscosity[air].tolist() == [2.0] * 8
    assert body.volume_viscosity[air].tolist() == [3.0] * 8
    assert not body.viscosity[~air].any()
    assert bool((body.chamber >= 0).eq(air).all())
    assert body.chamber.dtype == torch.int32
    single = fill(domain, gamma.float().expand(3, -1), solid=solid)
    assert single.mass.shape == (3, domain.count)
    assert single.mass.dtype == single.position.dtype == torch.float32


def test_fill_is_differentiable():
    domain = chambers()
    gamma = torch.rand(domain.count, generator=torch.Generator().manual_seed(0), dtype=torch.float64).requires_grad_()

    def numbers(g):
        # In units in which all are of order one.
        body = fill(domain, g, solid=Solid())
        return body.mass / 1e-5, body.bulk / 1e6, body.shear / 1e6

    assert torch.autograd.gradcheck(numbers, (gamma,), fast_mode=True)
    (by,) = torch.autograd.grad(fill(domain, gamma, solid=Solid()).mass.sum(), gamma)
    assert not by[domain.region == Region.GAS].any()
    wanted = 1070 * H**3 * (1 - 1e-5) * 3 * gamma.detach() ** 2
    torch.testing.assert_close(by[domain.region != Region.GAS], wanted[domain.region != Region.GAS])


def test_without_void_every_other_particle_is_left_as_it_was():
    domain = chambers()
    gamma = torch.linspace(0, 0.4, domain.count, dtype=torch.float64)
    whole = fill(domain, gamma, solid=Solid(), void_range=(0.1, 0.3))
    body, keep = without_void(whole)
    assert torch.equal(keep, (gamma > 0.1) | (domain.region == Region.GAS))
    assert 0 < int(keep.sum()) < domain.count
    for field in fields(Body):
        value, seen = getattr(whole, field.name), getattr(body, field.name)
        assert (seen is None) == (value is None), field.name
        if value is not None:
            assert torch.equal(seen, value[keep]), field.name
    assert body.void_fraction is not None and bool((body.void_fraction[body.chamber < 0] > 0).any())  # grey stays
    plain = fill(domain, gamma, solid=Solid())
    body, keep = without_void(plain)
    assert body is plain and bool(keep.all()) and len(keep) == domain.count


# --------------------------------------------------------------------------------------------------------- stable step


def test_courant_numbers_of_the_papers_robot():
    domain = Domain(size=(0.007,) * 3, particles=(8, 8, 8))
    body = fill(domain, torch.ones(domain.count, dtype=torch.float64), solid=Solid())
    solid, dt, cell = Solid(), 1e-5, 1.75e-3
    for elements in range(6):
        prony = Prony.paper(elements)
        a, tau = [math.exp(-dt / t) for t in prony.times.tolist()], prony.times.tolist()
        felt = [g * (1 - ai) * t / dt * 2 / (1 + ai) for g, ai, t in zip(prony.moduli.tolist(), a, tau, strict=True)]
        stiff = math.hypot(1.4 * solid.bulk, 1.25 * solid.shear * (1 + sum(felt)))
        found = courant(body, prony, dt=dt, cell=cell)
        assert found.number == pytest.approx(dt / cell * math.sqrt(stiff / solid.density), rel=1e-9)
        # All five elements are within reach of the paper's step.
        assert found.number < STABLE_COURANT
        assert found.term.startswith("elastic waves in the solid")
        named = f"Maxwell element {1 + felt.index(max(felt))}" if felt else "solid"
        assert found.term.endswith(named)
    assert courant(body, None, dt=dt, cell=cell) == courant(body, Prony.paper(0), dt=dt, cell=cell)


def test_courant_number_names_gas_and_viscosity():
    _, body = block((4, 4, 4), air=True, gas=Gas(density=1.2))
    found = courant(body, None, dt=1e-5, cell=1.75e-3)
    assert found.term == "pressure waves in the gas"
    assert found.number == pytest.approx(1e-5 / 1.75e-3 * math.sqrt(1.4 * 0.14e6 / 1.2), rel=1e-9)
    thick = replace(body, viscosity=torch.full_like(body.mass, 1e4))
    assert courant(thick, None, dt=DT, cell=2 * H).term == "viscosity"


@pytest.mark.parametrize("elements", [0, pytest.param(3, marks=pytest.mark.slow), 5])
@pytest.mark.parametrize(("factor", "stable"), [(1.0, True), (1.1, False)])
def test_waves_stay_bounded_up_to_the_stable_step(elements, factor, stable, monkeypatch):
    domain = Domain(size=(8 * H,) * 3, particles=(8, 8, 8))
    body = fill(domain, torch.ones(domain.count, dtype=torch.float64), solid=Solid())
    noise = torch.randn(domain.count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    body, prony = replace(body, velocity=1e-3 * noise), Prony.paper(elements)
    dt = factor * stable_step(body, prony, cell=2 * H)
    monkeypatch.setattr("torchsoro.simulation.simulator.STABLE_COURANT", 2.0)
    sim = simulator(dt=dt, transfer="flip")

    def speed():
        final = sim(body, duration=1500 * dt, gravity=(0.0, 0.0, 0.0), prony=prony).final
        return float(final[0, layout.VELOCITY : layout.AFFINE].abs().max())

    if stable:
        assert speed() < float(1e-3 * noise.abs().max())
    else:
        with pytest.raises(SimulationDiverged):
            speed()


@pytest.mark.parametrize("elements", [0, 3, 5])
def test_stable_step_is_the_limit(elements):
    _, body = block()
    prony = Prony.paper(elements)
    limit = stable_step(body, prony, cell=2 * H)
    assert courant(body, prony, dt=limit, cell=2 * H).number == pytest.approx(STABLE_COURANT, rel=1e-3)
    assert courant(body, prony, dt=1.01 * limit, cell=2 * H).number > STABLE_COURANT
    assert stable_step(body, prony, cell=4 * H) > 1.9 * limit


# ------------------------------------------------------------------------------------------------------------- refusals


def tensors(*rows):
    return [torch.tensor(r, dtype=torch.float64) for r in rows]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Solid(youngs_modulus=-1.0), r"youngs_modulus = -1\.0: wanted finite and positive"),
        (lambda: Solid(youngs_modulus=math.nan), r"youngs_modulus = nan: wanted finite and positive"),
        (lambda: Solid(density=0.0), r"density = 0\.0: wanted finite and positive"),
        (lambda: Solid(density=math.inf), r"density = inf: wanted finite and positive"),
        (lambda: Solid(poisson_ratio=0.5), r"poisson_ratio = 0\.5: wanted at least 0 and less than 0\.5"),
        (lambda: Solid(poisson_ratio=-0.1), r"poisson_ratio = -0\.1: wanted at least 0"),
        (lambda: Solid(poisson_ratio=math.nan), r"poisson_ratio = nan: wanted"),
        (lambda: Gas(density=0.0), r"density = 0\.0: wanted finite and positive"),
        (lambda: Gas(stiffness=-1.0), r"stiffness = -1\.0: wanted finite and at least 0"),
        (lambda: Gas(viscosity=math.inf), r"viscosity = inf: wanted finite and at least 0"),
        (lambda: Gas(volume_viscosity=math.nan), r"volume_viscosity = nan: wanted finite and at least 0"),
        (lambda: Prony.paper(6), r"elements = 6: wanted 0 to 5"),
        (lambda: Prony.paper(-1), r"elements = -1: wanted 0 to 5"),
        (
            lambda: Prony(moduli=torch.ones(2), times=torch.ones(3)),
            r"moduli, times: shapes \(2,\) and \(3,\), wanted the same",
        ),
        (lambda: Prony(moduli=torch.ones(6), times=torch.ones(6)), r"moduli, times: .* M from 0 to 5"),
        (
            lambda: Prony(**dict(zip(("moduli", "times"), tensors([-1.0], [1.0]), strict=True))),
            r"moduli = \[-1\.0\]: wanted finite and at least 0",
        ),
        (
            lambda: Prony(**dict(zip(("moduli", "times"), tensors([1.0], [0.0]), strict=True))),
            r"times = \[0\.0\]: wanted finite and positive",
        ),
        (
            lambda: Prony(**dict(zip(("moduli", "times"), tensors([1.0], [math.inf]), strict=True))),
            r"times = \[inf\]: wanted finite and positive",
        ),
        (lambda: simp(torch.ones(1), epsilon=0.0), r"epsilon = 0\.0: wanted more than 0 and less than 1"),
        (lambda: simp(torch.ones(1), epsilon=1.0), r"epsilon = 1\.0: wanted more than 0 and less than 1"),
        (lambda: simp(torch.ones(1), power=0.0), r"power = 0\.0: wanted finite and positive"),
        (
            lambda: fill(chambers(), torch.ones(7), solid=Solid()),
            r"gamma: shape \(7,\), wanted \[\.\.\., 512\], one value for each particle",
        ),
    ],
)
def test_bad_numbers_are_refused(make, message):
    with pytest.raises(ValueError, match="^" + message):
        make()


# ------------------------------------------------------------------------- stable step of the total-Lagrangian form


def lattice(shape):
    """Nodes' weights at the points of a box [P, I], and their slopes [P, I, 3] in cells of 1 m."""
    weights, slopes = [], []
    for count in shape:
        w, s = (torch.zeros(count, (count + 1) // 2 + 2, dtype=torch.float64) for _ in range(2))
        for p in range(count):
            x, own = (p % 2 - 0.5) / math.sqrt(3), slice(p // 2, p // 2 + 3)
            w[p, own] = torch.tensor([(0.5 - x) ** 2 / 2, 0.75 - x * x, (0.5 + x) ** 2 / 2], dtype=torch.float64)
            s[p, own] = torch.tensor([x - 0.5, -2 * x, x + 0.5], dtype=torch.float64)
        weights.append(w)
        slopes.append(s)

    def product(*along):
        return torch.kron(torch.kron(along[0], along[1]), along[2])

    steep = [product(*(slopes[c] if c == axis else weights[c] for c in range(3))) for axis in range(3)]
    return product(*weights), torch.stack(steep, -1)


def scaled(shape, scale, solid, **more):
    """A body on that lattice whose points have shares of a solid's density and moduli."""
    count, volume = math.prod(shape), (1.75e-3 / 2) ** 3
    return Body(
        position=torch.zeros(count, 3, dtype=torch.float64),
        mass=solid.density * volume * scale,
        volume=torch.full((count,), volume, dtype=torch.float64),
        bulk=solid.bulk * scale,
        shear=solid.shear * scale,
        chamber=torch.full((count,), -1, dtype=torch.int32),
        **more,
    )


def grows(shape, body, prony, dt, steps=400):
    """Whether noise grows in the linear lattice, stepped as the simulator does."""
    weights, slopes = lattice(shape)
    slopes = slopes / 1.75e-3
    mass = (weights.T @ body.mass).unsqueeze(-1)
    v = torch.randn(len(mass), 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    d, start = torch.zeros_like(v), v.norm()

    def parts(field):
        H = torch.einsum("pib,ia->pab", slopes, field)
        volumetric = torch.einsum("paa,bc->pbc", H, torch.eye(3, dtype=torch.float64))
        return H + H.mT - 2 / 3 * volumetric, volumetric

    before, history = 0.0, [0.0] * prony.elements
    for _ in range(steps):
        S, volumetric = parts(d)
        history = [a * H + b * (S - before) for H, (a, b, _) in zip(history, prony.discrete(dt), strict=True)]
        before = S
        felt = S + sum((g * H for H, g in zip(history, prony.moduli, strict=True)), torch.zeros_like(S))
        stress = body.bulk[:, None, None] * volumetric + body.shear[:, None, None] * felt
        if body.viscosity is not None:
            stress = stress + body.viscosity[:, None, None] * parts(v)[0]
        force = torch.einsum("pib,pab->ia", slopes, stress * body.volume[:, None, None])
        v = v - dt * force / mass
        d = d + dt * v
    return not float(v.norm()) < 30 * float(start)


@given(
    shape=st.sampled_from([(1, 1, 1), (1, 1, 4), (2, 2, 2), (3, 2, 1), (4, 3, 2)]),
    poisson=st.floats(0, 0.49),
    stiffened=st.floats(0, 3).map(lambda x: 10.0**x),
    lowest=st.sampled_from([0.0, -1.0, -5.0]),
    seed=st.integers(0, 999),
)
def test_no_lattice_is_unstable_below_a_total_courant_number_of_one(shape, poisson, stiffened, lowest, seed):
    solid, dt, dx = Solid(poisson_ratio=poisson), 1e-5, 1.75e-3
    scale = 10 ** (lowest * torch.rand(math.prod(shape), generator=torch.Generator().manual_seed(seed)).double())
    body = scaled(shape, scale, solid)
    body = replace(body, shear=stiffened * body.shear)
    weights, slopes = lattice(shape)
    P, I = weights.shape  # noqa: E741
    eye = torch.eye(3, dtype=torch.float64)
    # H of the motion of node i along c, per square root of its mass.
    H = torch.einsum("pib,ac,i->pabic", slopes / dx, eye, (weights.T @ body.mass) ** -0.5).reshape(P, 3, 3, 3 * I)
    trace = torch.einsum("paad->pd", H)
    even = (H + H.transpose(1, 2)) / 2 - eye[..., None] * trace[:, None, None] / 3
    stiffness = torch.einsum("p,pd,pe->de", body.bulk * body.volume, trace, trace)
    stiffness += torch.einsum("p,pabd,pabe->de", 2 * body.shear * body.volume, even, even)
    highest = float(torch.linalg.eigvalsh(stiffness)[-1]) ** 0.5
    found = courant(body, None, dt=dt, cell=dx, formulation="total").number
    assert highest * dt / 2 <= found * (1 + 1e-9)
    if shape == (1, 1, 1):
        # The bound is sharp: a lone particle reaches it.
        assert highest * dt / 2 == pytest.approx(found, rel=1e-6)


@pytest.mark.parametrize("viscosity", [None, 20.0])
@pytest.mark.parametrize("elements", [0, pytest.param(3, marks=pytest.mark.slow), 5])
def test_a_total_lagrangian_lattice_steps_stably_up_to_a_courant_number_of_one(elements, viscosity, monkeypatch):
    monkeypatch.setattr("torchsoro.simulation.stability.STABLE_COURANT", 1.0)
    prony, solid, cell = Prony.paper(elements), Solid(), 1.75e-3
    for shape in ((1, 1, 1), (3, 2, 2)):
        count = math.prod(shape)
        scale = torch.rand(count, generator=torch.Generator().manual_seed(1), dtype=torch.float64) ** 3 + 1e-5
        body = scaled(shape, scale, solid, viscosity=None if viscosity is None else viscosity * scale)
        limit = stable_step(body, prony, cell=cell, formulation="total")
        assert not grows(shape, body, prony, 0.995 * limit)
        if count == 1:  # nothing is less stable than a lone particle
            assert grows(shape, body, prony, 1.01 * limit)


def test_total_courant_number_names_what_sets_it():
    _, body = block((4, 4, 4), air=True)
    dt, cell, solid = 1e-5, 1.75e-3, Solid()

    def found(body, prony=None):
        return courant(body, prony, dt=dt, cell=cell, formulation="total")

    elastic = dt / cell * math.sqrt(9 / 8 * 3 * solid.bulk / solid.density)
    assert found(body).number == pytest.approx(elastic, rel=1e-9)
    assert found(body).term == "elastic waves in the solid"
    # The paper's gas would set the updated form's limit here; its stiffness and viscosity carry no waves now.
    heavy = replace(body, bulk=torch.where(body.chamber >= 0, 1e9, body.bulk))
    assert heavy.viscosity is not None
    assert found(replace(heavy, viscosity=torch.where(body.chamber >= 0, 1e9, heavy.viscosity))) == found(body)
    prony = Prony.paper(5)
    stiff = solid.shear * (1 + float(prony.step_moduli(dt).sum()))
    assert found(body, prony).number == pytest.approx(dt / cell * math.sqrt(9 / 4 * stiff / solid.density), rel=1e-9)
    assert found(body, prony).term.endswith("most by Maxwell element 4")
    # A fictitious shear modulus as large as the solid's on a tenth of its mass; Maxwell elements have no part in it.
    filled = replace(body, shear=torch.where(body.chamber >= 0, solid.bulk, body.shear))
    assert found(filled).term == "elastic waves of the chambers' fictitious shear modulus"
    assert found(filled).number == pytest.approx(dt / cell * math.sqrt(9 / 4 * solid.bulk / 100), rel=1e-9)
    thick = replace(body, viscosity=torch.full_like(body.mass, 50.0))
    both = solid.shear + 2 * 50.0 / dt
    assert found(thick).term == "viscosity"
    assert found(thick).number == pytest.approx(dt / cell * math.sqrt(9 / 4 * both / solid.density), rel=1e-9)
    # A batch has the number of its worst body.
    twice = replace(body, bulk=torch.stack([body.bulk, 4 * body.bulk]), shear=torch.stack([body.shear, body.shear]))
    assert found(twice).number == pytest.approx(2 * elastic, rel=1e-9)


@pytest.mark.parametrize(("elements", "microseconds"), [(0, 36.4), (3, 22.7), (5, 7.11)])
def test_total_stable_step_of_the_papers_resin(elements, microseconds):
    domain = Domain(size=(0.007,) * 3, particles=(8, 8, 8))
    body = fill(domain, torch.ones(domain.count, dtype=torch.float64), solid=Solid())
    found = stable_step(body, Prony.paper(elements), cell=1.75e-3, formulation="total")
    assert found == pytest.approx(microseconds * 1e-6, rel=0.025)
    number = courant(body, Prony.paper(elements), dt=found, cell=1.75e-3, formulation="total").number
    assert number == pytest.approx(STABLE_COURANT, rel=1e-3)


def test_an_unknown_formulation_is_refused():
    _, body = block()
    with pytest.raises(ValueError, match=r"^formulation = 'eulerian': wanted \"updated\" or \"total\""):
        courant(body, None, dt=DT, cell=2 * H, formulation="eulerian")
    with pytest.raises(ValueError, match=r"^formulation = 'flip': wanted"):
        stable_step(body, None, cell=2 * H, formulation="flip")
