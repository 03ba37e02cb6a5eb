"""Augmented Lagrangian for one inequality constraint, with a schedule that waits for each plateau.

Maximise an objective L subject to a violation ``g <= 0`` by minimising

    loss = -L + lambda K + sigma / 2 K^2 ,    K = max(g, 0) ,

while the multiplier lambda and the penalty sigma grow in steps. The loss is left alone until it stops improving, so
that a constraint that would lead into poor local optima (as a limit on intermediate densities does) comes in late.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Literal

import torch
from torch import Tensor, nn


class Plateau(nn.Module):
    """Tells when a sequence has levelled off: the mean of its last n values is close to that of the n before.

    A plateau needs *more* than 2 n values since the last reset, and

        |mean(last n) - mean(n before)| < tolerance |mean(n before)|   (or both are equal).

    The values seen are buffers, so that a checkpoint continues the sequence where it was.

    Args:
        window: Number n of values in a mean.
        tolerance: Relative change that counts as level.

    Raises:
        ValueError: An argument is out of range.
    """

    recent: Tensor
    count: Tensor

    def __init__(self, *, window: int = 4, tolerance: float = 1e-3) -> None:
        """Start with no values."""
        super().__init__()
        if isinstance(window, bool) or not isinstance(window, int) or window < 1:
            raise ValueError(f"window: got {window!r}, want a whole number >= 1")
        if not (math.isfinite(tolerance) and tolerance > 0.0):
            raise ValueError(f"tolerance: got {tolerance!r}, want a finite number > 0")
        self.window = window
        self.tolerance = float(tolerance)
        self.register_buffer("recent", torch.full((2 * window,), math.nan, dtype=torch.float64))
        self.register_buffer("count", torch.tensor(0, dtype=torch.int64))

    @torch.no_grad()
    def update(self, value: float) -> bool:
        """Append a value and return whether the sequence is level.

        Raises:
            ValueError: The value is not finite.
        """
        value = _finite("value", value)
        self.recent.copy_(torch.cat([self.recent[1:], self.recent.new_tensor([value])]))
        self.count += 1
        if int(self.count) <= 2 * self.window:
            return False
        before, last = (float(mean) for mean in self.recent.view(2, self.window).mean(dim=1))
        return last == before or abs(last - before) < self.tolerance * abs(before)

    @torch.no_grad()
    def reset(self) -> None:
        """Forget all values."""
        self.recent.fill_(math.nan)
        self.count.zero_()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Event:
    """What :meth:`AugmentedLagrangian.update` did at a plateau.

    Attributes:
        kind: "multiplier" or "penalty" for the one that was raised, "stop" when the design is converged and admissible.
        multiplier: Multiplier from here on.
        penalty: Penalty from here on.
    """

    kind: Literal["multiplier", "penalty", "stop"]
    multiplier: float
    penalty: float

    @property
    def stop(self) -> bool:
        """Whether to end the optimization."""
        return self.kind == "stop"

    @property
    def reset_optimizer(self) -> bool:
        """Whether to recreate the optimizer: the loss changed, and Adam's moments belong to the old one."""
        return self.kind != "stop"


class AugmentedLagrangian(nn.Module):
    """Loss of a constrained problem, and the gated schedule of its multiplier and penalty.

    At each plateau of the loss (see :class:`Plateau`), and only there,

    - if the constraint holds (K = 0): stop;
    - if K < K_prev / 4: lambda <- lambda + sigma K and K_prev <- K;
    - otherwise: sigma <- growth sigma.

    While the constraint holds the loss is -L, so that the stop is the paper's rule on the objective.

    Where the objective is rough its mean may never level off; with ``patience`` the multiplier or the penalty is raised
    in any case when the constraint does not hold so many iterations after the last time. Only a plateau stops.

    The objective should be dimensionless and of order one (a distance in cells, not in metres), since the first
    penalties are small numbers without a unit.

    Args:
        previous: First K_prev, the largest violation there can be. For the intermediate density of Eq. 15, at most
            0.25, it is ``0.25 - C_max``.
        penalty: First penalty sigma.
        window: Number of iterations in each mean of the plateau rule.
        tolerance: Relative change of the mean loss that counts as a plateau.
        growth: Factor by which the penalty grows.
        patience: Iterations after which it grows without a plateau, too; 0 to wait for one.

    Raises:
        ValueError: An argument is out of range.

    Example:
        >>> problem = AugmentedLagrangian(previous=0.25 - 0.0125)
        >>> phi = torch.zeros(8, requires_grad=True)
        >>> loss = problem(objective=phi.sum(), violation=phi.square().mean() - 0.0125)
        >>> loss.backward()
        >>> event = problem.update(loss.item(), violation=-0.0125)  # None until there is a plateau
        >>> event is None
        True

    Reference:
        Kobayashi et al., "Computational synthesis of locomotive soft robots by topology optimization", Eq. 16 and the
        paragraph after it; the schedule is that of their reference 60.
    """

    multiplier: Tensor
    penalty: Tensor
    previous: Tensor

    def __init__(
        self,
        *,
        previous: float,
        penalty: float = 1e-3,
        window: int = 4,
        tolerance: float = 1e-3,
        growth: float = 10.0,
        patience: int = 0,
    ) -> None:
        """Start without multiplier and with the first penalty."""
        super().__init__()
        for name, value in (("previous", previous), ("penalty", penalty)):
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name}: got {value!r}, want a finite number > 0")
        if not (math.isfinite(growth) and growth > 1.0):
            raise ValueError(f"growth: got {growth!r}, want a finite number > 1")
        if isinstance(patience, bool) or not isinstance(patience, int) or patience < 0:
            raise ValueError(f"patience: got {patience!r}, want a whole number >= 0")
        self.patience = patience
        self.growth = float(growth)
        self.plateau = Plateau(window=window, tolerance=tolerance)
        self.register_buffer("multiplier", torch.tensor(0.0, dtype=torch.float64))
        self.register_buffer("penalty", torch.tensor(float(penalty), dtype=torch.float64))
        self.register_buffer("previous", torch.tensor(float(previous), dtype=torch.float64))

    def forward(self, objective: Tensor, violation: Tensor) -> Tensor:
        """Return the loss to minimise.

        Args:
            objective: Objective L to maximise, dimensionless, a scalar tensor.
            violation: Violation g of the constraint g <= 0, a scalar tensor.

        Returns:
            Loss, a scalar tensor in the type of the objective.

        Raises:
            ValueError: An argument is not a scalar.
        """
        for name, value in (("objective", objective), ("violation", violation)):
            if value.ndim != 0:
                raise ValueError(f"{name}: got shape {tuple(value.shape)}, want a scalar: take a mean over a batch")
        excess = torch.relu(violation)
        # Buffers are cloned, because update() changes them in place and backward may come after it.
        multiplier, penalty = (buffer.detach().clone().to(objective) for buffer in (self.multiplier, self.penalty))
        return -objective + multiplier * excess + 0.5 * penalty * excess.square()

    @torch.no_grad()
    def update(self, loss: float, violation: float) -> Event | None:
        """Take note of one iteration, and raise multiplier or penalty at a plateau, or when patience ends.

        Args:
            loss: Value of the loss in this iteration.
            violation: Violation g in this iteration.

        Returns:
            What happened, or None if the schedule waits.

        Raises:
            ValueError: A value is not finite.
        """
        loss, excess = _finite("loss", loss), max(_finite("violation", violation), 0.0)
        late = excess > 0.0 and 0 < self.patience <= int(self.plateau.count) + 1
        if not self.plateau.update(loss) and not late:
            return None
        self.plateau.reset()
        kind: Literal["multiplier", "penalty", "stop"]
        if excess == 0.0:
            kind = "stop"
        elif excess < float(self.previous) / 4.0:
            kind = "multiplier"
            self.multiplier += self.penalty * excess
            self.previous.fill_(excess)
        else:
            kind = "penalty"
            self.penalty *= self.growth
        return Event(kind=kind, multiplier=float(self.multiplier), penalty=float(self.penalty))

    def extra_repr(self) -> str:
        """Current state for ``print(problem)``."""
        return f"multiplier={float(self.multiplier):.6g}, penalty={float(self.penalty):.6g}, growth={self.growth}"


class ExactPenalty(nn.Module):
    """Loss of the same problem with a price on the violation, ``-L + price max(g, 0)``, that is given from outside.

    A price above the multiplier at the optimum holds the limit exactly (the exact penalty function, Nocedal and
    Wright, Numerical Optimization, section 17.2), with no plateau to wait for where the number of iterations is small.

    Args:
        price: At the end.

    Raises:
        ValueError: The price is not finite and positive.
    """

    multiplier: Tensor
    penalty: Tensor

    def __init__(self, *, price: float) -> None:
        """Start without a price."""
        if not (math.isfinite(price) and price > 0.0):
            raise ValueError(f"price: got {price!r}, want a finite number > 0")
        super().__init__()
        self.price = float(price)
        self.register_buffer("multiplier", torch.tensor(0.0, dtype=torch.float64))
        self.register_buffer("penalty", torch.tensor(0.0, dtype=torch.float64))

    def demand(self, share: float) -> None:
        """Set the price to a share of that at the end, from 0 to 1."""
        self.multiplier.fill_(self.price * share)

    def forward(self, objective: Tensor, violation: Tensor) -> Tensor:
        """Return the loss to minimise, as :meth:`AugmentedLagrangian.forward`."""
        return -objective + float(self.multiplier) * torch.relu(violation)

    def update(self, loss: float, violation: float) -> None:
        """Take note of nothing: the price follows the iterations."""


def _finite(name: str, value: float) -> float:
    """A number as a float, refused if it is not finite."""
    value = float(value)
    if not math.isfinite(value):
        raise ValueError(f"{name}: got {value}, want a finite number")
    return value
