"""The functions that the kernels are made of: shape functions, stress laws and their adjoints."""

import pytest
import taichi as ti
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import config
from problems import rotations

import torchsoro
from torchsoro.simulation.kernels import contact, spline, stress, tensor, total, total_adjoint
from torchsoro.simulation.kernels.compiled import remove_stale_code

# The annotations of kernels must be values: no ``from __future__ import annotations`` here.
Reals = ti.types.ndarray(dtype=ti.f64, ndim=1)


@ti.func
def nothing():
    pass


@ti.func
def vector(a: ti.template(), i):
    return ti.Vector([a[3 * i], a[3 * i + 1], a[3 * i + 2]])


@ti.func
def matrix(a: ti.template(), i):
    return tensor.load_matrix(a, 9 * i, 1)


@ti.func
def put(a: ti.template(), i, m):
    tensor.store_matrix(a, 9 * i, 1, m)


@ti.kernel
def run_spline(inverse_cell: ti.f64, x: Reals, base: Reals, w: Reals, dw: Reals, n: ti.i32):
    for i in range(n):
        place = vector(x, i)
        node = spline.base_node(place, inverse_cell)
        f = place * inverse_cell - node
        for c in ti.static(range(3)):
            base[3 * i + c] = node[c]
        put(w, i, spline.weights(f))
        put(dw, i, spline.slopes(f))


@ti.kernel
def run_tensor(a: Reals, b: Reals, cof: Reals, dot: Reals, back: Reals, scratch: Reals, n: ti.i32):
    for i in range(n):
        A, B = matrix(a, i), matrix(b, i)
        put(cof, i, tensor.cofactor(A))
        dot[i] = tensor.contract(A, B)
        tensor.store_symmetric(scratch, 6 * i, 1, A + A.transpose())
        put(back, i, tensor.load_symmetric(scratch, 6 * i, 1))


@ti.kernel
def run_solid(F: Reals, Q: Reals, bulk: ti.f64, shear: ti.f64, void_fraction: ti.f64, P: Reals, S: Reals, n: ti.i32):
    for i in range(n):
        put(P, i, stress.piola(matrix(F, i), matrix(Q, i), bulk, shear, 1, void_fraction))
        if void_fraction < 1:
            put(S, i, stress.pull_back(matrix(F, i), stress.least_ratio(void_fraction)))


@ti.kernel
def run_solid_adjoint(
    F: Reals,
    Q: Reals,
    moduli: Reals,
    bar: Reals,
    F_bar: Reals,
    Q_bar: Reals,
    moduli_bar: Reals,
    S_bar: Reals,
    n: ti.i32,
):
    for i in range(n):
        shear = moduli[3 * i + 1]
        f, q, by_bulk, by_shear, _, void_fraction = stress.piola_adjoint(
            matrix(F, i), matrix(Q, i), moduli[3 * i], shear, 1, moduli[3 * i + 2], matrix(bar, i)
        )
        put(F_bar, i, f)
        put(Q_bar, i, q)
        moduli_bar[3 * i] = by_bulk
        moduli_bar[3 * i + 1] = by_shear
        moduli_bar[3 * i + 2] = void_fraction
        put(S_bar, i, stress.pull_back_adjoint(matrix(F, i), stress.least_ratio(moduli[3 * i + 2]), matrix(bar, i)))


@ti.kernel
def run_viscous(
    J: Reals, L: Reals, eta: Reals, bar: Reals, tau: Reals, J_bar: Reals, L_bar: Reals, eta_bar: Reals, n: ti.i32
):
    for i in range(n):
        put(tau, i, stress.viscous_stress(J[i], matrix(L, i), eta[2 * i], eta[2 * i + 1]))
        j, gradient, shear, volume = stress.viscous_stress_adjoint(
            J[i], matrix(L, i), eta[2 * i], eta[2 * i + 1], matrix(bar, i)
        )
        J_bar[i] = j
        put(L_bar, i, gradient)
        eta_bar[2 * i] = shear
        eta_bar[2 * i + 1] = volume


@ti.kernel
def run_viscous_piola(
    F: Reals, rate: Reals, eta: Reals, bar: Reals, P: Reals, F_bar: Reals, rate_bar: Reals, eta_bar: Reals, n: ti.i32
):
    for i in range(n):
        put(P, i, stress.viscous_piola(matrix(F, i), matrix(rate, i), eta[2 * i], eta[2 * i + 1]))
        f, r, shear, volume = stress.viscous_piola_adjoint(
            matrix(F, i), matrix(rate, i), eta[2 * i], eta[2 * i + 1], matrix(bar, i)
        )
        put(F_bar, i, f)
        put(rate_bar, i, r)
        eta_bar[2 * i] = shear
        eta_bar[2 * i + 1] = volume


@ti.kernel
def run_gas(J: Reals, k: ti.f64, supply: ti.f64, p: Reals, n: ti.i32):
    for i in range(n):
        p[i] = stress.gas_pressure(J[i], k, supply)


@ti.kernel
def run_touch(
    u: Reals, sticks: ti.i32, friction: ti.f64, hold: ti.f64, bar: Reals, r: Reals, u_bar: Reals, by: Reals, n: ti.i32
):
    for i in range(n):
        up = ti.Vector([0.0, 0.0, 1.0], dt=ti.f64)
        out = contact.response(vector(u, i), up, sticks, friction, hold)
        tensor.store_vector(r, 3 * i, 1, out)
        by_u, by_friction, by_hold = contact.response_adjoint(vector(u, i), up, sticks, friction, hold, vector(bar, i))
        tensor.store_vector(u_bar, 3 * i, 1, by_u)
        by[2 * i] = by_friction
        by[2 * i + 1] = by_hold


@pytest.fixture(scope="module", autouse=True)
def started():
    torchsoro.init("cpu")


def out(*shape):
    return torch.zeros(*shape, dtype=torch.float64)


def flat(t):
    return t.contiguous().view(-1)


def deformations(n=32, *, seed=0, size=0.3):
    g = torch.Generator().manual_seed(seed)
    return torch.eye(3, dtype=torch.float64) + size * (torch.rand(n, 3, 3, generator=g, dtype=torch.float64) - 0.5)


def symmetric(n=32, *, seed=1, size=0.3):
    m = deformations(n, seed=seed, size=size) - torch.eye(3, dtype=torch.float64)
    return m + m.mT


def first_piola(F, Q=None, *, bulk=2.3, shear=0.7, void_fraction=0.0):
    """First Piola stress, and pull-back S."""
    P, S = out(*F.shape), out(*F.shape)
    Q = torch.zeros_like(F) if Q is None else Q
    run_solid(flat(F), flat(Q), bulk, shear, void_fraction, flat(P), flat(S), len(F))
    return P, S


def solid(F, Q=None, *, bulk=2.3, shear=0.7):
    """Kirchhoff stress, and pull-back S."""
    P, S = first_piola(F, Q, bulk=bulk, shear=shear)
    return P @ F.mT, S


def splines(x, cell):
    n = len(x)
    base, w, dw = out(n, 3), out(n, 3, 3), out(n, 3, 3)
    run_spline(1 / cell, flat(x), flat(base), flat(w), flat(dw), n)
    return base, w, dw


positions = st.lists(st.tuples(*[st.floats(-3, 3)] * 3), min_size=1, max_size=20)


@given(places=positions, cell=st.floats(0.01, 10))
def test_weights_are_a_partition_of_unity_and_reproduce_linear_fields(places, cell):
    x = torch.tensor(places, dtype=torch.float64)
    base, w, dw = splines(x, cell)
    nodes = base.unsqueeze(1) + torch.arange(3.0, dtype=torch.float64).view(1, 3, 1)
    assert bool((w >= 0).all())
    torch.testing.assert_close(w.sum(1), torch.ones_like(x), rtol=0, atol=1e-12)
    torch.testing.assert_close(cell * (w * nodes).sum(1), x, rtol=1e-12, atol=1e-11)
    torch.testing.assert_close(dw.sum(1), torch.zeros_like(x), rtol=0, atol=1e-11)
    torch.testing.assert_close((dw * nodes).sum(1), torch.ones_like(x), rtol=0, atol=1e-9)
    # The second moment is a quarter of a cell squared: the D of APIC.
    distance = nodes - (x / cell).unsqueeze(1)
    torch.testing.assert_close((w * distance**2).sum(1), torch.full_like(x, 0.25), rtol=0, atol=1e-9)


def test_slopes_are_derivatives_of_the_weights():
    g = torch.Generator().manual_seed(2)
    x = torch.rand(50, 3, generator=g, dtype=torch.float64) * 6 - 3
    e = 1e-6
    base, _, dw = splines(x, 1.0)
    (up, w_up, _), (down, w_down, _) = splines(x + e, 1.0), splines(x - e, 1.0)
    assert torch.equal(up, base)
    assert torch.equal(down, base)
    torch.testing.assert_close((w_up - w_down) / (2 * e), dw, rtol=0, atol=1e-9)


def test_weights_are_continuous_where_the_nodes_change():
    x = torch.tensor([[0.5, 1.5, 2.5]], dtype=torch.float64)
    (_, below, below_slope), (_, above, above_slope) = splines(x - 1e-12, 1.0), splines(x + 1e-12, 1.0)
    for a, b in ((below, above), (below_slope, above_slope)):
        torch.testing.assert_close(a[:, 1:], b[:, :2], rtol=0, atol=1e-10)
        torch.testing.assert_close(a[:, 0], torch.zeros(1, 3, dtype=torch.float64), rtol=0, atol=1e-10)


def test_tensor_functions_agree_with_torch():
    a, b = deformations(seed=3, size=2.0), deformations(seed=4, size=2.0)
    cof, dot, back, scratch = out(32, 3, 3), out(32), out(32, 3, 3), out(32, 6)
    run_tensor(*(flat(t) for t in (a, b, cof, dot, back, scratch)), 32)
    torch.testing.assert_close(cof, torch.linalg.det(a)[:, None, None] * torch.linalg.inv(a).mT, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(dot, (a * b).sum((1, 2)), rtol=1e-13, atol=1e-13)
    assert torch.equal(back, a + a.mT)


def test_no_stress_without_strain():
    tau, S = solid(rotations(8))
    assert float(tau.abs().max()) < 1e-14
    assert float(S.abs().max()) < 1e-14


def test_stress_is_the_derivative_of_the_energy():
    # Eqs. 6-7: W = mu/2 (tr Cb - 3) + K/2 [ (J - 1)^2 + (ln J)^2 ] / 2, and tau = dW/dF F^T.
    bulk, shear = 2.3, 0.7
    F = deformations(size=0.8).requires_grad_()
    J = torch.linalg.det(F)
    assert float(J.detach().min()) > 0.3
    trace = (J ** (-2 / 3)) * (F * F).sum((1, 2))
    energy = shear / 2 * (trace - 3) + bulk / 4 * ((J - 1) ** 2 + torch.log(J) ** 2)
    (P,) = torch.autograd.grad(energy.sum(), F)
    tau, _ = solid(F.detach(), bulk=bulk, shear=shear)
    torch.testing.assert_close(tau, (P @ F.mT).detach(), rtol=1e-12, atol=1e-13)


def test_pull_back_is_the_deviatoric_stress():
    # mu dev(Bb) = J mu Fb S Fb^T: an element that has followed everything adds its modulus to the elastic one.
    F = deformations(size=0.8)
    J = torch.linalg.det(F)[:, None, None]
    Fb = F * J ** (-1 / 3)
    tau, S = solid(F, bulk=0.0)
    torch.testing.assert_close(J * 0.7 * (Fb @ S @ Fb.mT), tau, rtol=1e-12, atol=1e-13)
    twice, _ = solid(F, S, bulk=0.0)
    torch.testing.assert_close(twice, 2 * tau, rtol=1e-12, atol=1e-13)


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000), size=st.floats(0.01, 0.9))
def test_frame_indifference(seed, size):
    F, Q, R = deformations(seed=seed, size=size), symmetric(seed=seed + 1), rotations(32, seed=seed)
    tau, S = solid(F, Q)
    turned_tau, turned_S = solid(R @ F, Q)
    assert float((turned_tau - R @ tau @ R.mT).abs().max()) <= 1e-10 * float(tau.abs().max())
    assert float((turned_S - S).abs().max()) <= 1e-10 * float(S.abs().max())
    torch.testing.assert_close(tau, tau.mT, rtol=0, atol=1e-14)


def slope(function, x, direction, e=1e-6):
    """Central difference along a direction, one for each row."""
    return (function(x + e * direction) - function(x - e * direction)) / (2 * e)


@pytest.mark.parametrize(("void_fraction", "crushed"), [(0.0, False), (0.3, False), (0.3, True), (1.0, False)])
def test_adjoints_of_the_solid(void_fraction, crushed):
    F, Q, bar = deformations(), symmetric(), deformations(seed=5, size=2.0)
    if crushed:
        ratio = torch.linspace(-1.0, 0.19, 32, dtype=torch.float64)
        F = F * ((ratio / torch.linalg.det(F)).abs().pow(1 / 3) * ratio.sign())[:, None, None]
    S_like = symmetric(seed=9)
    moduli = torch.rand(32, 3, generator=torch.Generator().manual_seed(6), dtype=torch.float64) + 0.5
    moduli[:, 2] = void_fraction
    found = [out(32, 3, 3), out(32, 3, 3), out(32, 3), out(32, 3, 3)]
    run_solid_adjoint(*(flat(t) for t in (F, Q, moduli, bar, *found)), 32)
    F_bar, Q_bar, moduli_bar, _ = found
    d, dQ = deformations(seed=7, size=2.0), symmetric(seed=8, size=2.0)

    def power(f=F, q=Q, m=moduli):
        rows = [
            first_piola(f[i : i + 1], q[i : i + 1], bulk=b, shear=s, void_fraction=v)[0]
            for i, (b, s, v) in enumerate(m.tolist())
        ]
        return (torch.cat(rows) * bar).sum((1, 2))

    def agree(found, wanted):
        torch.testing.assert_close(found, wanted, rtol=1e-6, atol=1e-7)

    agree((F_bar * d).sum((1, 2)), slope(lambda f: power(f=f), F, d))
    agree((Q_bar * dQ).sum((1, 2)), slope(lambda q: power(q=q), Q, dQ))
    for k in range(3 if 0 < void_fraction < 1 else 2):
        one = torch.nn.functional.one_hot(torch.tensor(k), 3).expand(32, 3).double()
        agree(moduli_bar[:, k], slope(lambda m: power(m=m), moduli, one))
    # Of the pull-back, for a symmetric gradient.
    run_solid_adjoint(*(flat(t) for t in (F, Q, moduli, S_like, *found)), 32)
    if void_fraction < 1:
        agree(
            (found[3] * d).sum((1, 2)),
            slope(lambda f: (first_piola(f, void_fraction=void_fraction)[1] * S_like).sum((1, 2)), F, d),
        )


@pytest.mark.parametrize("elements", [0.0, 0.7, 3.0, 17.0])
def test_a_partly_void_solid_bears_being_turned_inside_out_and_still_pushes_back(elements):
    push = []
    for J in (0.5, 0.2, 0.01, -0.3, -0.5, -1.0, -2.0):
        F = torch.eye(3, dtype=torch.float64)[None].clone()
        F[0, 0, 0] = J
        _, S = first_piola(F, void_fraction=0.3)
        P, _ = first_piola(F, elements * S, void_fraction=0.3)
        assert bool(torch.isfinite(P).all() and torch.isfinite(S).all())
        push.append(float(P[0, 0, 0]))
    assert max(push) < -1.0


def test_void_is_a_law_of_its_own_with_an_energy_and_stands_being_turned_inside_out():
    g = torch.Generator().manual_seed(3)
    F = (2 * torch.randn(64, 3, 3, generator=g, dtype=torch.float64)).requires_grad_()
    J = torch.linalg.det(F)
    assert float(J.detach().min()) < -1
    assert float(J.detach().max()) > 1
    volumetric = torch.where(J >= 1, torch.log(J.clamp(min=1)), (J - 1) - (J - 1) ** 2 / 2)
    energy = 0.7 * ((F * F).sum((1, 2)) / 2 - volumetric)
    (P,) = torch.autograd.grad(energy.sum(), F)
    found, _ = first_piola(F.detach(), void_fraction=1.0)
    torch.testing.assert_close(found, P, rtol=1e-11, atol=1e-11)
    rest, _ = first_piola(rotations(8), void_fraction=1.0)
    assert float(rest.abs().max()) < 1e-14


def test_viscous_piola_is_the_viscous_stress_and_has_its_adjoint():
    F, rate, bar = deformations(), deformations(seed=3, size=2.0), deformations(seed=4, size=2.0)
    eta = torch.rand(32, 2, generator=torch.Generator().manual_seed(6), dtype=torch.float64)

    def run(f=F, r=rate, e=eta):
        found = [out(32, 3, 3), out(32, 3, 3), out(32, 3, 3), out(32, 2)]
        run_viscous_piola(*(flat(t) for t in (f, r, e, bar, *found)), 32)
        return found

    P, F_bar, rate_bar, eta_bar = run()
    J = torch.linalg.det(F)
    L = rate @ torch.linalg.inv(F)
    tau, *rest = out(32, 3, 3), out(32), out(32, 3, 3), out(32, 2)
    run_viscous(J, flat(L), flat(eta), flat(bar), flat(tau), rest[0], flat(rest[1]), flat(rest[2]), 32)
    torch.testing.assert_close(P @ F.mT, tau, rtol=1e-11, atol=1e-12)
    d = deformations(seed=7, size=2.0)
    for bar_of, name, x in ((F_bar, "f", F), (rate_bar, "r", rate)):
        by = slope(lambda t, name=name: (run(**{name: t})[0] * bar).sum((1, 2)), x, d)
        torch.testing.assert_close((bar_of * d).sum((1, 2)), by, rtol=1e-6, atol=1e-7)
    for k in range(2):
        one = torch.nn.functional.one_hot(torch.tensor(k), 2).expand(32, 2).double()
        by = slope(lambda e: (run(e=e)[0] * bar).sum((1, 2)), eta, one)
        torch.testing.assert_close(eta_bar[:, k], by, rtol=1e-6, atol=1e-7)


def test_viscous_stress_and_its_adjoint():
    g = torch.Generator().manual_seed(9)
    J = torch.rand(32, generator=g, dtype=torch.float64) + 0.5
    L, bar = deformations(seed=10, size=2.0), deformations(seed=11, size=2.0)
    eta = torch.rand(32, 2, generator=g, dtype=torch.float64)
    leaves = [t.clone().requires_grad_() for t in (J, L, eta)]
    j, gradient, (shear, volume) = leaves[0], leaves[1], leaves[2].unbind(1)
    spread = (volume - 2 / 3 * shear) * gradient.diagonal(dim1=1, dim2=2).sum(-1)
    expected = shear[:, None, None] * (gradient + gradient.mT) + spread[:, None, None] * torch.eye(3).double()
    expected = j[:, None, None] * expected
    by = torch.autograd.grad((expected * bar).sum(), leaves)
    tau, J_bar, L_bar, eta_bar = out(32, 3, 3), out(32), out(32, 3, 3), out(32, 2)
    run_viscous(*(flat(t) for t in (J, L, eta, bar, tau, J_bar, L_bar, eta_bar)), 32)
    torch.testing.assert_close(tau, expected.detach(), rtol=1e-12, atol=1e-13)
    for found, wanted in zip((J_bar, L_bar, eta_bar), by, strict=True):
        torch.testing.assert_close(found, wanted, rtol=1e-12, atol=1e-12)
    # A rigid rotation is not resisted, and pure shear viscosity has no pressure.
    spin = L - L.mT
    run_viscous(*(flat(t) for t in (J, spin, eta, bar, tau, J_bar, L_bar, eta_bar)), 32)
    assert float(tau.abs().max()) < 1e-14


def test_gas_pressure():
    J, p = torch.tensor([1.0, 0.9, 1.2], dtype=torch.float64), out(3)
    run_gas(J, 140e3, 80e3, p, 3)
    torch.testing.assert_close(p, torch.tensor([80e3, 94e3, 52e3], dtype=torch.float64), rtol=1e-12, atol=0)


def response(u, *, stick=0, friction=0.0, hold=0.0, bar=None):
    u = torch.as_tensor(u, dtype=torch.float64).reshape(-1, 3)
    bar = torch.zeros_like(u) if bar is None else bar
    r, u_bar, by = torch.zeros_like(u), torch.zeros_like(u), out(len(u), 2)
    run_touch(flat(u), stick, friction, hold, flat(bar), flat(r), flat(u_bar), flat(by), len(u))
    return r, u_bar, by


@pytest.mark.parametrize(
    ("u", "settings", "wanted"),
    [
        ((1.0, 2.0, 0.5), {"stick": 1}, (1.0, 2.0, 0.5)),  # leaving: free
        ((1.0, 2.0, -0.5), {"stick": 1}, (0.0, 0.0, 0.0)),  # pressed on: stuck
        ((3.0, 4.0, -1.0), {}, (3.0, 4.0, 0.0)),  # without friction only the normal part goes
        ((3.0, 4.0, -5.0), {"friction": 0.5}, (1.5, 2.0, 0.0)),  # slides: 5 less 0.5 of 5
        ((3.0, 4.0, -5.0), {"friction": 1.1}, (0.0, 0.0, 0.0)),  # friction suffices
        ((3.0, 4.0, 1.0), {"friction": 0.5, "hold": 2.0}, (2.7, 3.6, 0.0)),  # held back by adhesion: slides
        ((3.0, 4.0, 1.0), {"stick": 1, "hold": 2.0}, (0.0, 0.0, 0.0)),  # held back: stuck
        ((3.0, 4.0, 3.0), {"friction": 0.5, "hold": 2.0}, (3.0, 4.0, 1.0)),  # torn off, slower
    ],
)
def test_contact_response_sticks_slides_or_tears_off(u, settings, wanted):
    r, _, _ = response(u, **settings)
    torch.testing.assert_close(r[0], torch.tensor(wanted, dtype=torch.float64), rtol=0, atol=1e-14)


@pytest.mark.parametrize("stick", [0, 1])
@pytest.mark.parametrize(("friction", "hold"), [(0.0, 0.0), (0.6, 0.0), (0.6, 0.8)])
def test_adjoint_of_the_contact_response_equals_central_differences(stick, friction, hold):
    g = torch.Generator().manual_seed(12)
    u, bar, d = (torch.randn(200, 3, generator=g, dtype=torch.float64) for _ in range(3))
    e = 1e-7
    _, u_bar, by = response(u, stick=stick, friction=friction, hold=hold, bar=bar)

    def power(sign, **change):
        moved = {"friction": friction, "hold": hold, **{k: v + sign * e for k, v in change.items()}}
        return (response(u + (0 if change else sign * e * d), stick=stick, **moved)[0] * bar).sum(1)

    torch.testing.assert_close((power(1) - power(-1)) / (2 * e), (u_bar * d).sum(1), rtol=1e-6, atol=1e-6)
    if friction:
        numeric = (power(1, friction=friction) - power(-1, friction=friction)) / (2 * e)
        torch.testing.assert_close(numeric, by[:, 0], rtol=1e-6, atol=1e-6)
    if hold:
        numeric = (power(1, hold=hold) - power(-1, hold=hold)) / (2 * e)
        torch.testing.assert_close(numeric, by[:, 1], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("features", "shape"), [pytest.param(0, 0, marks=pytest.mark.slow), (1023, 1)])
@pytest.mark.parametrize("march", [total.total_march, total_adjoint.total_march_adjoint], ids=["forward", "adjoint"])
def test_marches_of_a_gpu_are_understood_by_taichi_without_one(march, features, shape, monkeypatch):
    """They are translated, though no code of a GPU is generated."""
    monkeypatch.setattr(ti.simt.block, "sync", nothing)
    reals = [torch.zeros(1)] * (len(march._primal.arguments) - 8)
    march._primal.ensure_compiled(ti.f32, 4, features, shape, 0, 0, 0, torch.zeros(1, dtype=torch.int32), *reals)


def test_compiled_code_of_other_sources_is_removed_from_a_folder_of_the_users_choice_too(tmp_path, monkeypatch):
    folder, other = tmp_path / "kernels_0123", tmp_path / "mine_0123"
    for one in (folder, other):
        one.mkdir()
        (one / "march.nbi").touch()
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))
    remove_stale_code.__wrapped__()
    assert not list(folder.glob("*.nbi")) and (other / "march.nbi").exists()
    (folder / "march.nbi").touch()  # compiled from these sources
    remove_stale_code.__wrapped__()
    assert (folder / "march.nbi").exists()
