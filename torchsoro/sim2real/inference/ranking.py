"""Effects that were fitted, best first: what each gains, in what units, and which lean on what is not believed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchsoro.sim2real.hypotheses.body_effects import Modulus
from torchsoro.sim2real.hypotheses.outer_effects import PressureGain
from torchsoro.sim2real.inference.fit import Fit
from torchsoro.sim2real.inference.likelihood import EDGE

FORM = 0.001  # of what an effect takes away, that may be due to its form: nature's is never just the hypothesis'
BELIEVED = 1 + 3 * EDGE  # of its tolerance, that a believed number may be off
MISTRUST = 12.0  # of the score, that measurement errors beyond belief cost at most
FAINT = 4.0  # of the score, below which nothing is worth a fit
LEANS = 20.0  # of the score, that an effect must do better than a free modulus if it needs that too
BENT = 3.0  # standard deviations of a measurement error, beyond which it tells against an effect


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidate:
    """An effect and how well it does.

    Attributes:
        fit: The best of it.
        score: What it gains in ln of the likelihood over nothing, less what its parameters are worth. Residuals of a
            wrong model are neither white nor of the variance that was thought: the gain counts in units of what the
            best effect leaves, neighbouring samples that are alike count once, no difference counts that the form of
            an effect may make, and measurement errors far beyond belief tell against it.
        gain: The same over nothing with any modulus and pressure, without allowance for its form.
        explained: Share of the misfit beyond noise and numerics that it takes away.
        heldout_ratio: Error on trials that were left out over that without an effect; not a number where none was.
    """

    fit: Fit
    score: float
    gain: float
    explained: float
    heldout_ratio: float = math.nan


def rank(fits: Sequence[Fit], null_model: Fit, believed: float, deviations: np.ndarray) -> list[Candidate]:
    """Score fits that are better than nothing, best first.

    Args:
        fits: Of effects.
        null_model: The fit without any.
        believed: Its misfit within beliefs.
        deviations: That measurement errors are believed to have.
    """
    fits = [fit for fit in fits if fit.chi2 < null_model.chi2]
    if not fits:
        return []
    best = min(fits, key=lambda fit: fit.chi2)
    alike = correlation(best)
    gained = believed - best.chi2
    bare = 2 * max(1.0, best.chi2 / best.samples) * alike
    unit = max(bare, 2 * FORM * gained)
    worth = 0.5 * math.log(min(best.samples / alike, 1 / FORM))
    unconstrained = [f for f in fits if f.effects and all(isinstance(e, Modulus | PressureGain) for e in f.effects)]
    # Others lean on a modulus, or a pressure, that is not believed: they must do more than what sets it free.
    fits = [
        f
        for f in fits
        if not any(max(_strained(g), BELIEVED) < _strained(f) and f.chi2 > g.chi2 - LEANS * unit for g in unconstrained)
    ]
    found = [
        Candidate(
            fit=fit,
            score=(believed - fit.chi2) / unit - fit.unknowns * worth - _bent(fit, deviations),
            # What sets a modulus free gains over one that is believed.
            gain=((believed if fit in unconstrained else null_model.chi2) - fit.chi2) / bare - fit.unknowns * worth,
            explained=min((believed - fit.chi2) / max(believed - fit.samples, 1.0), 1.0),
        )
        for fit in fits
    ]
    return sorted(found, key=lambda c: -c.score)


def varied(fit: Fit) -> float:
    """By how much its effects make ln of the modulus higher on a stiff side than on average."""
    return sum(e.varies(v) for e, v in zip(fit.effects, fit.values, strict=True))


def _strained(fit: Fit) -> float:
    """How far beyond belief modulus or pressure are, in tolerances; the belief may be that of a body's stiff side."""
    off = np.abs(fit.point[: len(fit.ln_factors)])
    stiffer = varied(fit)
    if fit.ln_factors[0] < 0:
        off[0] *= max(1 + stiffer / float(fit.ln_factors[0]), 0.0)
    return float(off.max())


def _bent(fit: Fit, deviations: np.ndarray) -> float:
    """What it costs that measurement errors are far beyond belief: something, as beliefs may be wrong."""
    return min(0.5 * float((np.maximum(np.abs(fit.errors / deviations) - BENT, 0.0) ** 2).sum()), MISTRUST)


def correlation(fit: Fit) -> float:
    """How many neighbouring samples of the whitened residual say the same."""
    above = below = 0.0
    for r in fit.whitened:
        above += float(r[1:] @ r[:-1])
        below += float(r @ r)
    rho = min(max(above / max(below, 1e-300), 0.0), 0.98)
    return (1 + rho) / (1 - rho)
