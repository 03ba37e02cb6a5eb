"""From what a design is worth in each of several scenarios to one number, to be maximised."""

from __future__ import annotations

import torch
from torch import Tensor, nn

WANTED = "'mean', 'worst' or 'cvar:' with a level, such as cvar:0.3"


class Mean(nn.Module):
    """The mean over scenarios."""

    def forward(self, values: Tensor) -> Tensor:
        """Of values [S]."""
        return _checked(values).mean()


class Worst(nn.Module):
    """The least of all scenarios; its gradient is that of this one."""

    def forward(self, values: Tensor) -> Tensor:
        """Of values [S]."""
        return _checked(values).amin()


class CVaR(nn.Module):
    """Conditional value at risk: the mean of the worst fraction of the scenarios.

    Of S values in increasing order the i-th, from 0, counts with clamp(S a - i, 0, 1) / (S a) at a level a: the
    scenario at the border by the part that belongs to the fraction. So it is the mean at level 1, and the worst at
    levels up to 1 / S; and piecewise linear in the values, with an exact gradient where their order is strict.

    Args:
        level: The fraction, above 0 and at most 1.

    Raises:
        ValueError: for another level.
    """

    def __init__(self, level: float) -> None:
        super().__init__()
        if isinstance(level, bool) or not isinstance(level, float | int) or not 0 < level <= 1:
            raise ValueError(f"level = {level!r}: wanted a fraction of the scenarios, more than 0 and at most 1")
        self.level = float(level)

    def extra_repr(self) -> str:
        """For ``print``."""
        return f"level={self.level:g}"

    def forward(self, values: Tensor) -> Tensor:
        """Of values [S]."""
        ordered = _checked(values).sort(stable=True).values
        number = self.level * len(ordered)
        share = (number - torch.arange(len(ordered), dtype=torch.float64)).clamp(0, 1) / number
        return (share.to(ordered) * ordered).sum()


Risk = Mean | Worst | CVaR


def parse_risk(text: str) -> Risk:
    """The functional that a text names: ``mean``, ``worst``, ``cvar:0.3``.

    Raises:
        ValueError: for another text, or a level outside (0, 1].
    """
    plain = {"mean": Mean, "worst": Worst}
    if text in plain:
        return plain[text]()
    name, _, level = text.partition(":")
    try:
        number = float(level) if name == "cvar" else None
    except ValueError:
        number = None
    if number is None:
        raise ValueError(f"risk = {text!r}: wanted {WANTED}")
    if not 0 < number <= 1:
        raise ValueError(f"risk = {text!r}: wanted a level of more than 0 and at most 1")
    return CVaR(number)


def _checked(values: Tensor) -> Tensor:
    if values.ndim != 1 or len(values) == 0:
        raise ValueError(f"values: shape {tuple(values.shape)}, wanted [S], one of each scenario")
    return values
