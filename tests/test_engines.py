"""Both engines, kernels of a GPU and lanes of a CPU: stress at the same random points, and a walk of a robot."""

import numpy as np
import pytest
import taichi as ti
import torch
from numba import njit
from problems import vector

from torchsoro import Chamber, Domain, Prony, Simulator, Solid, Waveform, fill, ground
from torchsoro.simulation.formulation import Total
from torchsoro.simulation.kernels import lane_laws, stress
from torchsoro.simulation.kernels.lanes import load, store
from torchsoro.simulation.runtime import init

# The annotations of kernels must be values: no ``from __future__ import annotations`` here.
Reals = ti.types.ndarray(dtype=ti.f64, ndim=2)
COUNT, BULK, SHEAR, FACTOR = 512, 7.0, 2.0, 1.25
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))


@ti.func
def matrix(a: ti.template(), i):
    return ti.Matrix([[a[i, 3 * r + c] for c in ti.static(range(3))] for r in ti.static(range(3))])


@ti.func
def put(a: ti.template(), i, at, m):
    for r in ti.static(range(3)):
        for c in ti.static(range(3)):
            a[i, at + 3 * r + c] = m[r, c]


@ti.kernel
def on_a_gpu(
    F: Reals, Q: Reals, B: Reals, bulk: ti.f64, shear: ti.f64, factor: ti.f64, void_fraction: ti.f64, out: Reals
):
    for i in range(COUNT):
        f, q, b = matrix(F, i), matrix(Q, i), matrix(B, i)
        put(out, i, 0, stress.piola(f, q, bulk, shear, factor, void_fraction))
        by_F, by_Q, by_bulk, by_shear, by_factor, by_void = stress.piola_adjoint(
            f, q, bulk, shear, factor, void_fraction, b
        )
        put(out, i, 9, by_F)
        put(out, i, 18, by_Q)
        out[i, 27], out[i, 28], out[i, 29], out[i, 30] = by_bulk, by_shear, by_factor, by_void
        if void_fraction < 1:
            least = stress.least_ratio(void_fraction)
            put(out, i, 31, stress.pull_back(f, least))
            put(out, i, 40, stress.pull_back_adjoint(f, least, (q + q.transpose()) / 2))
        put(out, i, 49, stress.viscous_piola(f, b, shear, bulk))


piola, piola_adjoint, cofactor = lane_laws.piola, lane_laws.piola_adjoint, lane_laws.cofactor
pull_back, pull_back_adjoint = lane_laws.pull_back, lane_laws.pull_back_adjoint
least_ratio, viscous_piola = lane_laws.least_ratio, lane_laws.viscous_piola


@njit
def in_lanes(F, Q, B, given, out):
    """Tensors by component [9, COUNT], symmetric ones as six; ``given`` is the void fraction [COUNT]."""
    for i in range(0, COUNT, 16):
        f = (load(F[0], i), load(F[1], i), load(F[2], i), load(F[3], i), load(F[4], i), load(F[5], i),
             load(F[6], i), load(F[7], i), load(F[8], i))  # fmt: skip
        q = load(Q[0], i), load(Q[4], i), load(Q[8], i), load(Q[1], i), load(Q[5], i), load(Q[2], i)
        b = (load(B[0], i), load(B[1], i), load(B[2], i), load(B[3], i), load(B[4], i), load(B[5], i),
             load(B[6], i), load(B[7], i), load(B[8], i))  # fmt: skip
        v = load(given, i)
        bulk, shear, factor = 0 * v + BULK, 0 * v + SHEAR, 0 * v + FACTOR
        P, cof, ratio = piola(f, q, bulk, shear, factor, v)
        by_F, by_Q, by_bulk, by_shear, by_factor, by_void = piola_adjoint(f, cof, ratio, q, bulk, shear, factor, v, b)
        least = least_ratio(v)
        S = pull_back(f, least)
        # An off-diagonal component counts twice in the full tensor, once here.
        S_bar = pull_back_adjoint(f, cof, ratio, least, (q[0], q[1], q[2], 2 * q[3], 2 * q[4], 2 * q[5]))
        V = viscous_piola(f, b, shear, bulk)
        for k, value in enumerate((*P, *by_F)):
            store(out[k], i, value)
        for k, value in enumerate(by_Q):
            store(out[18 + k], i, value)
        store(out[24], i, by_bulk)
        store(out[25], i, by_shear)
        store(out[26], i, by_factor)
        store(out[27], i, by_void)
        for k, value in enumerate((*S, *S_bar, *V)):
            store(out[28 + k], i, value)


def states(kind: str) -> np.ndarray:
    """Deformation gradients [COUNT, 3, 3]: near rest, stretched up to three times, or crushed."""
    rng = np.random.default_rng(5)
    turn = np.linalg.qr(rng.normal(size=(2, COUNT, 3, 3)))[0]
    turn[..., 0] *= np.linalg.det(turn)[..., None]
    low, high = {"near rest": (0.97, 1.03), "stretched": (0.5, 3.0), "crushed": (0.05, 1.2)}[kind]
    return turn[0] * rng.uniform(low, high, (COUNT, 1, 3)) @ turn[1]


@pytest.mark.parametrize("void_fraction", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("kind", ["near rest", "stretched", "crushed"])
def test_stress_laws_and_adjoints_of_both_engines_agree(kind, void_fraction):
    init()
    rng = np.random.default_rng(6)
    F, Q, B = states(kind), rng.normal(size=(COUNT, 3, 3)) * 0.1, rng.normal(size=(COUNT, 3, 3))
    Q = Q + Q.transpose(0, 2, 1)
    slow = np.zeros((COUNT, 58))
    on_a_gpu(*(np.ascontiguousarray(a.reshape(COUNT, 9)) for a in (F, Q, B)), BULK, SHEAR, FACTOR, void_fraction, slow)
    by_Q = slow[:, 18:27].reshape(COUNT, 3, 3)
    S = slow[:, 31:40].reshape(COUNT, 3, 3)
    parts = [slow[:, :18], *((2 - (a == b)) * by_Q[:, a, b][:, None] for a, b in PAIRS), slow[:, 27:31]]
    parts += [*(S[:, a, b][:, None] for a, b in PAIRS), slow[:, 40:]]
    expected = np.concatenate(parts, 1)
    held = np.ones(expected.shape[1], bool)
    held[28:43] = void_fraction < 1  # void has no Maxwell elements
    for dtype, within in ((np.float64, 1e-12), (np.float32, 1e-5)):
        found = np.zeros((expected.shape[1], COUNT), dtype)
        rows = (np.ascontiguousarray(a.reshape(COUNT, 9).T.astype(dtype)) for a in (F, Q, B))
        in_lanes(*rows, np.full(COUNT, void_fraction, dtype), found)
        # Rounding of F and of sums over it: by the size of a point's largest term.
        J = np.linalg.det(F)
        size = np.abs(expected).max(1, keepdims=True) * (1 + 1 / J.clip(0.05)[:, None] ** 2)
        off = (np.abs(found.T - expected) / size)[:, held]
        assert off.max() < within, np.unravel_index(off.argmax(), off.shape)


# ---------------------------------------------------------------------------------------------------------------- walks


class Walker:
    """A cube of eight particles with an air chamber that settles and then walks for one cycle, in float64."""

    edge, pressure, duration = 0.035, 40e3, 0.25

    def __init__(self) -> None:
        spacing = self.edge / 8
        self.domain = Domain(
            size=(self.edge,) * 3,
            particles=(8, 8, 8),
            chambers=(Chamber(name="air", center=(self.edge / 2,) * 3, size=(self.edge / 2,) * 3, wall=spacing),),
        )
        x = self.domain.positions.double() / self.edge
        self.density = 0.4 + 0.02 * torch.sin(9 * x[:, 0] - 2.5) * torch.cos(7 * x[:, 1] - 3.5)

    def __call__(self, *, lanes: bool) -> tuple[torch.Tensor, torch.Tensor]:
        """Travel L of the centre of gravity in the cycle, and its gradient by the density."""
        gamma = self.density.clone().requires_grad_()
        body = fill(self.domain, gamma, solid=Solid(), epsilon=1e-3, void_range=(0.1, 0.3))
        valve = vector(0.0, 0.0, 1.0, 1.0, 0.0, 0.0).unsqueeze(0)
        run = Simulator(cell=self.edge / 4, dt=1e-4, low=(-0.1,) * 3, high=(0.1,) * 3, formulation=Total(lanes=lanes))(
            body,
            duration=self.duration,
            prony=Prony.paper(3),
            pressure=Waveform(time=vector(0.0, 0.05, 0.08, 0.15, 0.18, 0.25), pressure=self.pressure * valve),
            planes=[ground()],
            sample_every=0.05,
            weight=body.mass.detach(),
        )
        x = run.center_of_gravity[:, 0]
        travel = x[-1] - x[1]
        return travel.detach(), torch.autograd.grad(travel, gamma)[0]

    def learn(self) -> None:
        """Go uphill until it walks."""
        for _ in range(30):
            travel, by = self(lanes=True)
            if travel > 3e-3:
                return
            self.density = (self.density + 0.05 * by / by.square().mean().sqrt()).clamp(0, 1)
        raise AssertionError("it does not walk")


@pytest.mark.slow
def test_both_engines_agree_on_a_walking_cycle_to_1e9_in_travel_and_1e7_in_its_gradient():
    walker = Walker()
    walker.learn()
    (one, by_one), (other, by_other) = walker(lanes=True), walker(lanes=False)
    print(
        f"travel {float(one):.3g} m: differs by {float(abs(other / one - 1)):.1e}, gradient by "
        f"{float((by_other - by_one).norm() / by_one.norm()):.1e}"
    )
    assert float(abs(other - one)) <= 1e-9 * float(abs(one))
    assert float((by_other - by_one).norm()) <= 1e-7 * float(by_one.norm())
