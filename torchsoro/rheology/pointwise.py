"""The simulator's material at one point: the stress of a prescribed history of deformation, as its kernels find it.

The same laws and the same discrete update as in ``kernels.stress`` and ``kernels.constitutive``, in torch: neo-Hooke or
Yeoh (``Solid``) with Maxwell elements whose history follows H <- a H + b (S' - S), the exact exponential of a step in
which S changes linearly. Many tests at once, each with its own steps, and laws in a batch.

All of it is differentiable in the law's numbers, in two ways: by autograd; and, faster for the few numbers of a law and
the many of a curve, by a complex step: a law with an imaginary part of 1e-30 in one of its numbers has 1e-30 times the
derivative by it in the imaginary part of the stress, to rounding (Squire and Trapp 1998).

Paths begin at rest: the step before the first sample leads there from the undeformed state. Steps may differ; the
simulator's are all the same.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsoro.material import Prony, Solid

_NEWTON = 60  # steps at most; four or five do, but for wild laws


@dataclass(frozen=True, kw_only=True, eq=False)
class Law:
    """Numbers of a material at a point, with leading axes that broadcast against each other and against the tests.

    Attributes:
        shear: Equilibrium shear modulus at rest, mu [...] Pa.
        bulk: Bulk modulus K [...] Pa; the stress of simple shear does not depend on it.
        stiffening: a and b: mu grows to mu (1 + a x + b x^2) at x = I1b - 3 [..., 2].
        moduli: Of the Maxwell elements, relative to mu [..., M].
        times: Their relaxation times [..., M] s.
    """

    shear: Tensor
    bulk: Tensor
    stiffening: Tensor
    moduli: Tensor
    times: Tensor

    @classmethod
    def of(cls, solid: Solid, prony: Prony | None = None) -> Law:
        """The law of a solid of the simulator, without leading axes."""
        numbers = (solid.shear, solid.bulk, (solid.linear_stiffening, solid.quadratic_stiffening))
        shear, bulk, stiffening = (torch.tensor(n, dtype=torch.float64) for n in numbers)
        none = torch.zeros(0, dtype=torch.float64)
        moduli, times = (none, none) if prony is None else (prony.moduli, prony.times)
        return cls(shear=shear, bulk=bulk, stiffening=stiffening, moduli=moduli, times=times)

    def factor(self, x: Tensor) -> Tensor:
        """By what mu is multiplied at x = I1b - 3 [..., T]."""
        a, b = self.stiffening.unsqueeze(-1).unbind(-2)
        return 1 + x * (a + b * x)

    def discrete(self, dt: Tensor) -> tuple[Tensor, Tensor]:
        """Decay a and gain b of each element [..., T, M] for steps dt [..., T] s, as ``Prony.discrete`` for one."""
        ratio = dt.unsqueeze(-1) / self.times.unsqueeze(-2)
        return torch.exp(-ratio), -torch.expm1(-ratio) / ratio


def pull_back(F: Tensor, law: Law) -> Tensor:
    """What the Maxwell elements follow: the pull-back S of the deviatoric stress over mu [..., T, 3, 3]."""
    J, C = _ratio(F), F.mT @ F
    trace = C.diagonal(dim1=-2, dim2=-1).sum(-1)
    factor = law.factor(J ** (-2 / 3) * trace - 3)
    plain = torch.eye(3, dtype=F.dtype) / _all(J) - _cofactor(C) * _all(trace / (3 * J**3))
    return _all(factor) * plain


def piola(F: Tensor, Q: Tensor, law: Law) -> Tensor:
    """First Piola stress [..., T, 3, 3] Pa for Q = sum_i g_i H_i."""
    J = _ratio(F)
    shrink = J ** (-2 / 3)
    factor = law.factor(shrink * (F * F).sum((-1, -2)) - 3)
    FA = _all(factor) * F + _all(J) * (F.to(Q.dtype) @ Q)
    mu = law.shear.unsqueeze(-1) * shrink
    pressure = law.bulk.unsqueeze(-1) / 2 * (J * (J - 1) + torch.log(J)) - mu * (F * FA).sum((-1, -2)) / 3
    return _all(mu) * FA + _all(pressure / J) * _cofactor(F)


def history(S: Tensor, dt: Tensor, law: Law) -> Tensor:
    """Q = sum_i g_i H_i [..., T, 3, 3] along a path of S, step by step.

    Args:
        S: From :func:`pull_back`.
        dt: Length of the step that leads to each sample [..., T] s.
        law: For the Maxwell elements.
    """
    if not law.times.shape[-1]:
        return torch.zeros_like(S)
    decay, gain = law.discrete(dt)
    change = torch.cat([S[..., :1, :, :], S.diff(dim=-3)], -3).flatten(-2)
    H, found = torch.zeros((), dtype=S.dtype), []
    for n in range(S.shape[-3]):
        H = decay[..., n, :, None] * H + gain[..., n, :, None] * change[..., n, None, :]
        found.append((law.moduli.unsqueeze(-1) * H).sum(-2))
    return torch.stack(found, -2).unflatten(-1, (3, 3))


def stress(F: Tensor, dt: Tensor, law: Law) -> Tensor:
    """First Piola (nominal) stress [..., T, 3, 3] Pa along a path of deformation gradients.

    Args:
        F: [..., T, 3, 3], float64.
        dt: Length of the step that leads to each sample [..., T] s, positive.
        law: The material.

    Raises:
        ValueError: for a volume ratio or a step that is not positive, or shapes that do not fit.
    """
    if F.shape[-2:] != (3, 3) or F.ndim < 3 or dt.shape[-1:] != F.shape[-3:-2]:
        raise ValueError(f"F, dt: shapes {tuple(F.shape)} and {tuple(dt.shape)}, wanted [..., T, 3, 3] and [..., T]")
    _check("det F", _ratio(F))
    _check("dt", dt)
    return piola(F, history(pull_back(F, law), dt, law), law)


def simple_shear(strain: Tensor, dt: Tensor, law: Law) -> Tensor:
    """Shear stress [..., T] Pa, nominal and true, of simple shear x = X + strain Y.

    Args:
        strain: Amount of shear [..., T].
        dt: Length of the step that leads to each sample [..., T] s.
        law: The material.
    """
    along = torch.zeros(3, 3, dtype=strain.dtype)
    along[0, 1] = 1
    return stress(torch.eye(3, dtype=strain.dtype) + _all(strain) * along, dt, law)[..., 0, 1]


def uniaxial(stretch: Tensor, dt: Tensor, law: Law) -> tuple[Tensor, Tensor]:
    """Nominal stress [..., T] Pa and lateral stretch [..., T] of tension or compression with free sides.

    Args:
        stretch: Along the force [..., T], positive.
        dt: Length of the step that leads to each sample [..., T] s.
        law: The material; K must be positive.

    Raises:
        ValueError: for a stretch or step that is not positive, or if no lateral stretch frees the sides.
    """
    return _with_free(stretch, dt, law, 2)


def equibiaxial(stretch: Tensor, dt: Tensor, law: Law) -> tuple[Tensor, Tensor]:
    """Nominal stress [..., T] Pa in the plane, and stretch of the thickness; as :func:`uniaxial`."""
    return _with_free(stretch, dt, law, 1)


def _with_free(stretch: Tensor, dt: Tensor, law: Law, sides: int) -> tuple[Tensor, Tensor]:
    """Principal stretches, of which ``sides`` (1 or 2) equal ones are found so that no stress acts along them."""
    if dt.shape[-1:] != stretch.shape[-1:]:
        raise ValueError(f"dt: shape {tuple(dt.shape)}, wanted a length for each of {tuple(stretch.shape)} samples")
    _check("stretch", stretch)
    _check("dt", dt)
    isochoric = (sides - 3) / sides * torch.log(stretch)
    if not law.times.shape[-1]:  # without a memory all samples at once
        each = replace(
            law, shear=law.shear.unsqueeze(-1), bulk=law.bulk.unsqueeze(-1), stiffening=law.stiffening.unsqueeze(-2)
        )
        none = torch.zeros(2, dtype=stretch.dtype)
        step = _Step(given=stretch, Q=none, felt=none[0], law=each, sides=sides)
        log_free = step.solve(isochoric)
        stress = step.balance(log_free)[3]
        return stress, torch.exp(log_free).expand(stress.shape)
    decay, gain = law.discrete(dt)
    felt = (law.moduli.unsqueeze(-2) * gain).sum(-1)
    H = S = torch.zeros(2, dtype=gain.dtype)  # along what is given, and what is free
    log_free, last = torch.zeros((), dtype=stretch.dtype), 0
    stresses, frees = [], []
    for n in range(stretch.shape[-1]):
        kept = decay[..., n, :, None] * H - gain[..., n, :, None] * S.unsqueeze(-2)
        Q = (law.moduli.unsqueeze(-1) * kept).sum(-2)
        step = _Step(given=stretch[..., n], Q=Q, felt=felt[..., n], law=law, sides=sides)
        log_free = step.solve(log_free + isochoric[..., n] - last)
        last = isochoric[..., n]
        S, stress = step.balance(log_free)[2:]
        H = kept + gain[..., n, :, None] * S.unsqueeze(-2)
        stresses.append(stress)
        frees.append(torch.exp(log_free).expand(stress.shape))
    return torch.stack(stresses, -1), torch.stack(frees, -1)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Step:
    """One step with free sides, in the principal stretches l_1 (given) and l_2 (free).

    Attributes:
        given: l_1 [...].
        Q: What the elements keep, but for what S of this step adds: sum_i g_i (a H - b S_before) [..., 2].
        felt: sum_i g_i b_i, by which S of this step adds [...].
        law: The material.
        sides: How many of the three stretches are free.
    """

    given: Tensor
    Q: Tensor
    felt: Tensor
    law: Law
    sides: int

    def solve(self, guess: Tensor) -> Tensor:
        """The ln l_2 that frees the sides, with its first derivatives."""
        law = replace(self.law, **{name: _plain(getattr(self.law, name)) for name in ("shear", "bulk", "stiffening")})
        plain = replace(self, given=_plain(self.given), Q=_plain(self.Q), felt=_plain(self.felt), law=law)
        u = _plain(guess)
        for _ in range(_NEWTON):
            value, slope, *_ = plain.balance(u)
            change = (value / slope).clamp(-0.5, 0.5)
            u = u - change
            if bool((change.abs() < 1e-13).all()):
                break
        else:
            raise ValueError("no lateral stretch frees the sides: the law loses its stiffness, or bulk is not positive")
        # One more step changes nothing, but brings the derivatives of the implicit function.
        value, slope, *_ = self.balance(u)
        return u - value / _plain(slope)

    def balance(self, u: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """At u = ln l_2: Kirchhoff stress along l_2 and its slope by u, S along both, nominal stress along l_1."""
        law, m = self.law, self.sides
        c = (3 - m) / 3
        (a, b), (q_1, q_2) = law.stiffening.unbind(-1), self.Q.unbind(-1)
        first, second = self.given**2, torch.exp(2 * u)
        J = self.given ** (3 - m) * torch.exp(m * u)
        shrink = J ** (-2 / 3)
        trace = (3 - m) * first + m * second
        x = shrink * trace - 3
        factor, gap = 1 + x * (a + b * x), second - first
        # The deviatoric parts of Fb A Fb^T along l_2 and l_1 differ by ``spread``, and their sum is zero.
        at_once, kept = factor * (1 + self.felt) * gap, J * (second * q_2 - first * q_1)
        spread = shrink * (at_once + kept)
        mean = law.bulk / 2 * (J * (J - 1) + torch.log(J))
        slope = (a + 2 * b * x) * 2 * m * c * shrink * gap * (1 + self.felt) * gap
        slope = slope + 2 * factor * (1 + self.felt) * second + m * kept + 2 * J * second * q_2
        slope = c * law.shear * (shrink * slope - 2 * m / 3 * spread) + law.bulk / 2 * m * (J * (2 * J - 1) + 1)
        S = torch.stack([factor / J * (1 - trace / (3 * square)) for square in (first, second)], -1)
        return mean + c * law.shear * spread, slope, S, (mean - m / 3 * law.shear * spread) / self.given


def _plain(t: Tensor) -> Tensor:
    """Without gradient, and without the imaginary part that carries one."""
    return t.detach().real


def _cofactor(F: Tensor) -> Tensor:
    """The matrices det(F) F^-T [..., 3, 3]."""
    return torch.stack([torch.linalg.cross(F[..., i - 2, :], F[..., i - 1, :]) for i in range(3)], -2)


def _ratio(F: Tensor) -> Tensor:
    return (F[..., 0, :] * torch.linalg.cross(F[..., 1, :], F[..., 2, :])).sum(-1)


def _all(t: Tensor) -> Tensor:
    return t[..., None, None]


def _check(name: str, value: Tensor) -> None:
    if not bool((torch.isfinite(value) & (value > 0)).all()):
        bad = value[~(torch.isfinite(value) & (value > 0))]
        raise ValueError(f"{name} = {float(bad[0])}: wanted finite and positive")
