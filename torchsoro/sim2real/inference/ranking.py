"""Ranking of fitted effects by a penalised gain in log-likelihood."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchsoro.sim2real.hypotheses.body_effects import Modulus
from torchsoro.sim2real.hypotheses.outer_effects import PressureGain
from torchsoro.sim2real.inference.fit import Fit
from torchsoro.sim2real.inference.likelihood import EDGE

# Share of the reduction of chi-squared that the form of the model may be wrong by: differences between effects below it
# do not count.
MODEL_FORM = 0.001
BELIEVED = 1 + 3 * EDGE  # tolerances by which a stated number may be off and still be credible
MISTRUST = 12.0  # score that measurement errors beyond their priors cost at most
FAINT = 4.0  # score below which an effect is not worth a fit
LEANS = 20.0  # score by which an effect that needs a modulus beyond its tolerance must exceed the modulus by itself
BENT = 3.0  # prior standard deviations of a measurement error, above which it costs score


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidate:
    """An effect and how well it does.

    Attributes:
        fit: The best of it.
        score: Gain in log-likelihood over the null model with credible modulus and pressure, less a penalty for each
            parameter. Residuals of a wrong model are neither white nor of the stated variance: the gain is divided by
            the residual variance of the best effect and by the correlation length of its residuals, and by the model
            form's share of the reduction; measurement errors far beyond their priors are subtracted.
        gain: The same over the null model with any modulus and pressure, without the allowance for the model form.
        explained: Share of chi-squared in excess of the number of samples that it removes.
        heldout_ratio: Error on trials left out of the fit over that of the null model; not a number without any.
    """

    fit: Fit
    score: float
    gain: float
    explained: float
    heldout_ratio: float = math.nan


def rank(fits: Sequence[Fit], null_model: Fit, believed: float, deviations: np.ndarray) -> list[Candidate]:
    """Score fits that are better than the null model, best first.

    Args:
        fits: Of effects.
        null_model: The fit without any.
        believed: Its chi-squared with modulus and pressure within what is credible.
        deviations: Prior standard deviations of the measurement errors.
    """
    fits = [fit for fit in fits if fit.chi2 < null_model.chi2]
    if not fits:
        return []
    best = min(fits, key=lambda fit: fit.chi2)
    inflation = correlation(best)
    gained = believed - best.chi2
    bare = 2 * max(1.0, best.chi2 / best.samples) * inflation
    unit = max(bare, 2 * MODEL_FORM * gained)
    worth = 0.5 * math.log(min(best.samples / inflation, 1 / MODEL_FORM))
    unconstrained = [f for f in fits if f.effects and all(isinstance(e, Modulus | PressureGain) for e in f.effects)]
    # An effect that needs an incredible modulus or pressure must exceed a fit in which that number is unconstrained.
    fits = [
        f
        for f in fits
        if not any(max(_strained(g), BELIEVED) < _strained(f) and f.chi2 > g.chi2 - LEANS * unit for g in unconstrained)
    ]
    found = [
        Candidate(
            fit=fit,
            score=(believed - fit.chi2) / unit - fit.unknowns * worth - _bent(fit, deviations),
            # An unconstrained modulus gains over a credible one.
            gain=((believed if fit in unconstrained else null_model.chi2) - fit.chi2) / bare - fit.unknowns * worth,
            explained=min((believed - fit.chi2) / max(believed - fit.samples, 1.0), 1.0),
        )
        for fit in fits
    ]
    return sorted(found, key=lambda c: -c.score)


def varied(fit: Fit) -> float:
    """Excess of ln of the modulus on a stiff side over its mean, by all effects of a fit."""
    return sum(e.varies(v) for e, v in zip(fit.effects, fit.values, strict=True))


def _strained(fit: Fit) -> float:
    """How far modulus or pressure are off, in tolerances; the stated modulus may be that of the body's stiff side."""
    off = np.abs(fit.point[: len(fit.ln_factors)])
    stiffer = varied(fit)
    if fit.ln_factors[0] < 0:
        off[0] *= max(1 + stiffer / float(fit.ln_factors[0]), 0.0)
    return float(off.max())


def _bent(fit: Fit, deviations: np.ndarray) -> float:
    """Score that measurement errors beyond their priors cost: bounded, as the priors may be wrong."""
    return min(0.5 * float((np.maximum(np.abs(fit.errors / deviations) - BENT, 0.0) ** 2).sum()), MISTRUST)


def correlation(fit: Fit) -> float:
    """Correlation length of the whitened residual, in samples, from its lag-one autocorrelation."""
    above = below = 0.0
    for r in fit.whitened:
        above += float(r[1:] @ r[:-1])
        below += float(r @ r)
    rho = min(max(above / max(below, 1e-300), 0.0), 0.98)
    return (1 + rho) / (1 - rho)
