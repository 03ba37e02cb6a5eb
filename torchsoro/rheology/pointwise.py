"""Stress of the simulator's material at one point under a prescribed deformation history.

Constitutive laws and discrete update equal those of ``kernels.stress`` and ``kernels.constitutive``: neo-Hookean or
Yeoh solid (``Solid``) with Maxwell elements whose history variables follow H <- a H + b (S' - S), the exact exponential
update for S linear within a step. Tests, each with its own steps, and laws are evaluated in batches.

The stress is differentiable with respect to the constants of the law by autograd and by the complex step, which is
faster for few constants and many samples: with an imaginary part of 1e-30 in one constant, the imaginary part of the
stress over 1e-30 is the derivative to rounding (Squire and Trapp 1998).

Histories start from the undeformed, relaxed state; the first step leads to the first sample. Unlike in the simulator,
steps may differ in length.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsoro.simulation.material import Prony, Solid

_NEWTON = 60  # largest number of Newton iterations; four or five suffice for common constants


@dataclass(frozen=True, kw_only=True, eq=False)
class Law:
    """Constants of a material at a point; leading axes broadcast against each other and against the tests.

    Attributes:
        shear: Equilibrium shear modulus mu in the undeformed state [...] Pa.
        bulk: Bulk modulus K [...] Pa; the stress of simple shear does not depend on it.
        stiffening: Coefficients a and b of the modulus mu (1 + a x + b x^2), x = I1b - 3 [..., 2].
        moduli: Moduli of the Maxwell elements over mu [..., M].
        times: Relaxation times [..., M] s.
    """

    shear: Tensor
    bulk: Tensor
    stiffening: Tensor
    moduli: Tensor
    times: Tensor

    @classmethod
    def of(cls, solid: Solid, prony: Prony | None = None) -> Law:
        """The law of a solid of the simulator, without leading axes."""
        numbers = (solid.shear, solid.bulk, solid.linear_stiffening, solid.quadratic_stiffening)
        shear, bulk, *stiffening = (torch.as_tensor(n, dtype=torch.float64) for n in numbers)
        none = torch.zeros(0, dtype=torch.float64)
        moduli, times = (none, none) if prony is None else (prony.moduli, prony.times)
        return cls(shear=shear, bulk=bulk, stiffening=torch.stack(stiffening), moduli=moduli, times=times)

    def factor(self, x: Tensor) -> Tensor:
        """Stiffening factor of mu at x = I1b - 3 [..., T]."""
        a, b = self.stiffening.unsqueeze(-1).unbind(-2)
        return 1 + x * (a + b * x)

    def discrete(self, dt: Tensor) -> tuple[Tensor, Tensor]:
        """Decay a and gain b of each element [..., T, M] for steps dt [..., T] s, as ``Prony.discrete`` for one."""
        ratio = dt.unsqueeze(-1) / self.times.unsqueeze(-2)
        return torch.exp(-ratio), -torch.expm1(-ratio) / ratio


def pull_back(F: Tensor, law: Law) -> Tensor:
    """Pull-back S of the deviatoric stress over mu, the input of the Maxwell elements [..., T, 3, 3]."""
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
    """Viscous overstress Q = sum_i g_i H_i [..., T, 3, 3] along a history of S.

    Args:
        S: From :func:`pull_back`.
        dt: Duration of the step that ends at each sample [..., T] s.
        law: Material with the Maxwell elements.
    """
    if not law.times.shape[-1]:
        return torch.zeros_like(S)
    decay, gain = law.discrete(dt)
    H = _recurrence(decay.unsqueeze(-1), gain.unsqueeze(-1) * _change(S.flatten(-2)).unsqueeze(-2))
    return (law.moduli[..., None, :, None] * H).sum(-2).unflatten(-1, (3, 3))


def _change(S: Tensor) -> Tensor:
    """Increments from step to step [..., T, k], from zero before the first."""
    return torch.cat([S[..., :1, :], S.diff(dim=-2)], -2)


def _recurrence(decay: Tensor, drive: Tensor) -> Tensor:
    """Parallel scan of H_n = decay_n H_(n-1) + drive_n [..., T, M, k] with H = 0 before the first step.

    Args:
        decay: [..., T, M, 1].
        drive: [..., T, M, k].
    """
    span, count = 1, drive.shape[-3]
    while span < count:
        late, early = slice(span, None), slice(None, count - span)
        joined = drive[..., late, :, :] + decay[..., late, :, :] * drive[..., early, :, :]
        drive = torch.cat([drive[..., :span, :, :], joined], -3)
        joined = decay[..., late, :, :] * decay[..., early, :, :]
        decay = torch.cat([decay[..., :span, :, :], joined], -3)
        span *= 2
    return drive


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
    law = replace(law, shear=law.shear.unsqueeze(-1), bulk=law.bulk.unsqueeze(-1))
    free = _Free(given=stretch, dt=dt, law=law, sides=sides)
    log_free = free.solve((sides - 3) / sides * torch.log(stretch))
    stress = free.balance(log_free)[2]
    return stress, torch.exp(log_free).expand(stress.shape)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Free:
    """History with stress-free sides in principal stretches: l_1 prescribed, l_2 unknown.

    Attributes:
        given: Prescribed stretch l_1 [..., T].
        dt: Duration of each step [..., T] s.
        law: Material, with an axis for the steps in mu and K.
        sides: Number of unknown principal stretches, 1 or 2.
    """

    given: Tensor
    dt: Tensor
    law: Law
    sides: int

    def solve(self, u: Tensor) -> Tensor:
        """Unknown ln l_2 [..., T] of zero lateral stress, with first derivatives, by Newton iteration from a guess.

        All time steps are iterated at once; the Jacobian neglects the coupling to previous steps through the history
        variables. That coupling is weak for nearly incompressible laws; otherwise steps converge in temporal order.
        """
        real = {k: _plain(getattr(self.law, k)) for k in ("shear", "bulk", "stiffening", "moduli", "times")}
        plain = replace(self, given=_plain(self.given), dt=_plain(self.dt), law=Law(**real))
        u = _plain(u)
        for rounds in range(1, _NEWTON + u.shape[-1]):  # noqa: B007
            value, slope, _ = plain.balance(u)
            change = (value / slope).clamp(-0.5, 0.5)
            u = u - change
            if bool((change.abs() < 1e-13).all()):
                break
        else:
            raise ValueError("no lateral stretch frees the sides: the law loses its stiffness, or bulk is not positive")
        # As many iterations again leave the value unchanged and yield the derivatives of the implicit function.
        for _ in range(rounds if self.moving else 0):
            value, slope, _ = self.balance(u)
            u = u - value / _plain(slope)
        return u

    @property
    def moving(self) -> bool:
        """Whether a derivative is requested, by autograd or complex step."""
        numbers = (self.given, *(getattr(self.law, k) for k in ("shear", "bulk", "stiffening", "moduli", "times")))
        return any(t.is_complex() or t.requires_grad for t in numbers)

    def balance(self, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Kirchhoff stress along l_2 at u = ln l_2, its derivative by u within a step, nominal stress along l_1."""
        law, m = self.law, self.sides
        c = (3 - m) / 3
        a, b = law.stiffening.unsqueeze(-2).unbind(-1)
        first, second = self.given**2, torch.exp(2 * u)
        J = self.given ** (3 - m) * torch.exp(m * u)
        shrink = J ** (-2 / 3)
        trace = (3 - m) * first + m * second
        x = shrink * trace - 3
        factor, gap = 1 + x * (a + b * x), second - first
        Q, felt = torch.zeros(2, dtype=u.dtype), torch.zeros((), dtype=u.dtype)
        if law.times.shape[-1]:
            S = torch.stack([factor / J * (1 - trace / (3 * square)) for square in (first, second)], -1)
            decay, gain = law.discrete(self.dt)
            H = _recurrence(decay.unsqueeze(-1), gain.unsqueeze(-1) * _change(S).unsqueeze(-2))
            Q = (law.moduli[..., None, :, None] * H).sum(-2)
            felt = (law.moduli.unsqueeze(-2) * gain).sum(
                -1
            )  # share of the increment of S that acts within its own step
        # The deviatoric parts of Fb A Fb^T along l_2 and l_1 differ by ``spread``, and their sum is zero.
        q_1, q_2 = Q.unbind(-1)
        spread = shrink * (factor * gap + J * (second * q_2 - first * q_1))
        mean = law.bulk / 2 * (J * (J - 1) + torch.log(J))
        # For the slope, contributions of previous steps are separated from those of the current one.
        kept = J * (second * q_2 - first * q_1) - factor * felt * gap
        kept_2 = J * second * q_2 - felt * factor * (second - trace / 3)
        slope = (a + 2 * b * x) * 2 * m * c * shrink * gap * (1 + felt) * gap
        slope = slope + 2 * factor * (1 + felt) * second + m * kept + 2 * kept_2
        slope = c * law.shear * (shrink * slope - 2 * m / 3 * spread) + law.bulk / 2 * m * (J * (2 * J - 1) + 1)
        return mean + c * law.shear * spread, slope, (mean - m / 3 * law.shear * spread) / self.given


def _plain(t: Tensor) -> Tensor:
    """Real part, detached from the graph."""
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
