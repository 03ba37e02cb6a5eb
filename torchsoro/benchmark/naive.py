"""The yardstick of ``benchmark.py``: MLS-MPM forward as a tutorial has it, four plain Taichi kernels a step.

Clear, p2g, grid and g2p are launched one by one from Python, over the full grid, with Taichi's fields and scalar
atomics. The physics are those of the simulator's updated formulation (APIC): neo-Hookean solid with Maxwell elements,
gas under a supply pressure, ground that holds what is pressed on it. There is no gradient, and nothing is optimised.
"""

# To Taichi the annotations of a kernel are values, and what looks like a number in it may be a vector.
# pyright: reportInvalidTypeForm=false, reportGeneralTypeIssues=false, reportIndexIssue=false, reportOperatorIssue=false
# pyright: reportAttributeAccessIssue=false, reportArgumentType=false, reportOptionalOperand=false

import os
from collections.abc import Sequence

os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")

import taichi as ti
import torch
from torch import Tensor

from torchsoro.simulation.material import Body, Prony
from torchsoro.simulation.runtime import init


@ti.func
def pull_back(F):
    """Pull-back S of the deviatoric neo-Hookean stress over mu."""
    J = F.determinant()
    Cb = J ** (-2 / 3) * F.transpose() @ F
    return (ti.Matrix.identity(ti.f32, 3) - Cb.trace() / 3 * Cb.inverse()) / J


@ti.func
def symmetric(h):
    """A symmetric matrix from (xx, yy, zz, xy, yz, xz)."""
    return ti.Matrix([[h[0], h[3], h[5]], [h[3], h[1], h[4]], [h[5], h[4], h[2]]])


@ti.data_oriented
class Naive:
    """A body on a grid of its own, in single precision.

    Args:
        body: One body without a batch; its device is where Taichi works.
        prony: Maxwell elements of the solids.
        cell: Grid cell [m].
        dt: Substep [s].
        low: Lowest node [m].
        nodes: Nodes along x, y and z.
        gravity: Along z [m/s2].
        ground: Whether the plane z = 0 holds what is pressed on it.
    """

    def __init__(
        self,
        body: Body,
        prony: Prony,
        *,
        cell: float,
        dt: float,
        low: Sequence[float],
        nodes: Sequence[int],
        gravity: float = -9.81,
        ground: bool = True,
    ) -> None:
        count = body.position.shape[0]
        init(body.position.device)
        self.cell, self.dt, self.low, self.gravity, self.ground = cell, dt, ti.Vector(list(low)), gravity, ground
        self.numbers = prony.discrete(dt).tolist()
        self.elements = prony.elements
        self.x, self.v = (ti.Vector.field(3, ti.f32, shape=count) for _ in range(2))
        self.C, self.F = (ti.Matrix.field(3, 3, ti.f32, shape=count) for _ in range(2))
        self.H = [ti.Vector.field(6, ti.f32, shape=count) for _ in range(self.elements)]
        self.mass, self.volume, self.bulk, self.shear, self.viscosity = (
            ti.field(ti.f32, shape=count) for _ in range(5)
        )
        self.chamber = ti.field(ti.i32, shape=count)
        self.grid_velocity = ti.Vector.field(3, ti.f32, shape=tuple(nodes))
        self.grid_mass = ti.field(ti.f32, shape=tuple(nodes))
        zero = torch.zeros_like(body.mass)
        for field, value in (
            (self.x, body.position),
            (self.v, torch.zeros_like(body.position) if body.velocity is None else body.velocity),
            (self.F, torch.eye(3).expand(count, 3, 3)),
            (self.mass, body.mass),
            (self.volume, body.volume),
            (self.bulk, body.bulk),
            (self.shear, body.shear),
            (self.viscosity, zero if body.viscosity is None else body.viscosity),
            (self.chamber, body.chamber),
        ):
            field.from_numpy(value.detach().cpu().contiguous().numpy())

    def step(self, pressure: float = 0.0) -> None:
        """Advance by one substep under a supply pressure [Pa]."""
        self.clear()
        self.p2g(pressure)
        self.grid()
        self.g2p()

    @property
    def position(self) -> Tensor:
        """Where the particles are [N, 3] m, on the CPU."""
        return torch.from_numpy(self.x.to_numpy())

    @property
    def velocity(self) -> Tensor:
        """How fast the particles are [N, 3] m/s, on the CPU."""
        return torch.from_numpy(self.v.to_numpy())

    @ti.func
    def place(self, x):
        """Lowest of the 27 nodes that a particle touches, and its distance from that node in cells."""
        at = (x - self.low) / self.cell
        base = ti.cast(at - 0.5, ti.i32)
        return base, at - base

    @ti.func
    def stress(self, p, pressure):
        """Kirchhoff stress of a particle."""
        F = self.F[p]
        unit = ti.Matrix.identity(ti.f32, 3)
        tau = unit * 0.0
        if self.chamber[p] < 0:
            J = F.determinant()
            Fb = J ** (-1 / 3) * F
            Q = unit * 0.0
            for e in ti.static(range(self.elements)):
                Q += self.numbers[e][2] * symmetric(self.H[e][p])
            b = Fb @ Fb.transpose() + J * (Fb @ Q @ Fb.transpose())
            tau = self.shear[p] * (b - b.trace() / 3 * unit) + self.bulk[p] / 2 * (J * (J - 1) + ti.log(J)) * unit
        else:
            J = F[0, 0]  # a gas has a volume and no shape
            L = self.C[p]
            shear = L + L.transpose() - 2 / 3 * L.trace() * unit
            tau = J * (self.viscosity[p] * shear - (self.bulk[p] * (1 - J) + pressure) * unit)
        return tau

    @ti.kernel
    def clear(self):
        """Empty the grid."""
        for n in ti.grouped(self.grid_mass):
            self.grid_mass[n] = 0
            self.grid_velocity[n] = ti.Vector([0.0, 0.0, 0.0])

    @ti.kernel
    def p2g(self, pressure: ti.f32):
        """Every particle adds mass and momentum, with the impulse of its stress, to 27 nodes."""
        for p in self.x:
            base, f = self.place(self.x[p])
            w = [0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2]
            impulse = -self.dt * self.volume[p] * 4 / self.cell**2 * self.stress(p, pressure)
            A = impulse + self.mass[p] * self.C[p]
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                offset = ti.Vector([i, j, k])
                weight = w[i][0] * w[j][1] * w[k][2]
                away = (offset - f) * self.cell
                self.grid_velocity[base + offset] += weight * (self.mass[p] * self.v[p] + A @ away)
                self.grid_mass[base + offset] += weight * self.mass[p]

    @ti.kernel
    def grid(self):
        """Momentum to velocity, gravity, and the ground."""
        for n in ti.grouped(self.grid_mass):
            if self.grid_mass[n] > 0:
                u = self.grid_velocity[n] / self.grid_mass[n]
                u[2] += self.dt * self.gravity
                if ti.static(self.ground):
                    # Half a cell absorbs the rounding of a node that lies on the plane.
                    if self.low[2] + n[2] * self.cell < 0.5 * self.cell and u[2] < 0:
                        u = ti.Vector([0.0, 0.0, 0.0])
                self.grid_velocity[n] = u

    @ti.kernel
    def g2p(self):
        """Every particle gathers its velocity and the gradient of it, moves, and updates its deformation."""
        for p in self.x:
            base, f = self.place(self.x[p])
            w = [0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2]
            v = ti.Vector([0.0, 0.0, 0.0])
            C = ti.Matrix.zero(ti.f32, 3, 3)
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                offset = ti.Vector([i, j, k])
                u = w[i][0] * w[j][1] * w[k][2] * self.grid_velocity[base + offset]
                v += u
                C += 4 / self.cell * u.outer_product(offset - f)
            self.x[p] += self.dt * v
            self.v[p] = v
            self.C[p] = C
            F = self.F[p]
            if self.chamber[p] < 0:
                F_new = F + self.dt * C @ F
                change = pull_back(F_new) - pull_back(F)
                six = ti.Vector([change[0, 0], change[1, 1], change[2, 2], change[0, 1], change[1, 2], change[0, 2]])
                for e in ti.static(range(self.elements)):
                    self.H[e][p] = self.numbers[e][0] * self.H[e][p] + self.numbers[e][1] * six
                self.F[p] = F_new
            else:
                self.F[p][0, 0] = F[0, 0] * (1 + self.dt * C.trace())
