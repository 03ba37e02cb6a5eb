"""Gauss-Newton on simulated residuals, with measurement errors eliminated in every step.

A search is a generator: it asks for simulations and waits, so that those of many searches can be simulated together.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Generator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from torchsoro.sim2real.inference.likelihood import Effects, Likelihood
from torchsoro.sim2real.twin.twin import MarkerTrajectory

LONGEST_STEP = 0.5  # of a search, over the unknown's size plus four scales
LONGEST_MOVE = 1.5  # of a place in a step, in tenths of the body's size
DAMPING = 1e-2  # of the first step (Levenberg and Marquardt), times the diagonal of the normal matrix
DAMPING_LIMITS = (1e-4, 10.0)  # least damping of a step; a search ends that would need more than the most
LITTLE = (0.5, 1e-3)  # gain in chi-squared, and its share, below which a search has converged
CRUDE = 3.0  # times as long as wanted are steps of difference quotients that are not to be trusted
LEADS = 0.5  # of the gain that a step promises, which derivatives of an earlier point have to lead to


@dataclass(frozen=True, eq=False)
class Asked:
    """What a search asks for.

    Attributes:
        effects: That are simulated.
        points: Where [B, K], in scales: a point, and those beside it that its derivatives need.
        known: Motions of each trial at the first of them, where it has been simulated before.
    """

    effects: Effects
    points: np.ndarray
    known: list[MarkerTrajectory] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Answer:
    """What a search is sent for what it asks.

    Attributes:
        motions: Of each trial, in a batch of all points.
        eager: Whether derivatives may be asked for with every step, as where there is room for their simulations.
    """

    motions: list[MarkerTrajectory]
    eager: bool = False


Search = Generator[Asked, Answer, "Point | None"]
Linearisation = Generator[Asked, Answer, "tuple[Point | None, bool]"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Point:
    """Where a search stands.

    Attributes:
        chi2: Whitened sum of squares over recordings, measurement errors and prior residuals.
        at: Unknowns that are simulated, in their scales [K].
        errors: Measurement errors that are best there [L].
        r: Whitened residual [N].
        J: Its derivatives by the measurement errors, with their sign changed [N, L].
        columns: The same by the unknowns [N, K].
        motions: Of each trial.
        crude: Whether derivatives were taken with much longer steps than they ask for.
    """

    chi2: float
    at: np.ndarray
    errors: np.ndarray
    r: np.ndarray
    J: np.ndarray
    columns: np.ndarray
    motions: list[MarkerTrajectory]
    crude: bool = False


@dataclass(frozen=True, eq=False)
class GaussNewton:
    """Searches for the best values of some effects.

    Attributes:
        likelihood: What chi-squared is of.
        effects: That are fitted, along with modulus and pressure.
    """

    likelihood: Likelihood
    effects: Effects

    @cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Of the unknowns, in scales."""
        return self.likelihood.bounds(self.effects)

    @property
    def unknowns(self) -> int:
        """Number of unknowns that are simulated."""
        return len(self.bounds[0])

    @cached_property
    def held(self) -> np.ndarray:
        """Unknowns that stay as stated: the modulus beside an effect that is the modulus without its prior."""
        held = [any(isinstance(e, type(one)) for e in self.effects) for one, _ in self.likelihood.common]
        return np.array(held + [False] * (self.unknowns - len(held)))

    @cached_property
    def places(self) -> np.ndarray:
        """Unknowns that are coordinates of a place."""
        places = [[False] * len(e.quantities) + [True] * (3 * e.local) for e in self.effects]
        return np.array([False] * len(self.likelihood.common) + [p for own in places for p in own])

    @cached_property
    def weight(self) -> np.ndarray:
        """Of the measurement errors."""
        return 1 / self.likelihood.observation.deviations

    def search(self, start: np.ndarray | None, errors: np.ndarray, rounds: int, *, settle: bool) -> Search:
        """A search from a point.

        Args:
            start: Unknowns, in scales; zero if None.
            errors: Measurement errors to begin with.
            rounds: Steps at most.
            settle: Whether derivatives are taken at the last point, which intervals need.

        Returns:
            The last point; None where the simulation of the first breaks down.
        """
        at = np.zeros(self.unknowns) if start is None else np.clip(np.asarray(start, float), *self.bounds)
        at = np.where(self.held, 0.0, at)
        damping, moving = DAMPING, np.flatnonzero(~self.held)
        current, eager = yield from self.linearise(at, errors, moving)
        if current is None:
            return None
        fresh = not current.crude  # whether the derivatives were simulated at this point, and well
        for _ in range(rounds):
            step = self.step(current, damping)
            # A step that rounding swallows leads nowhere, too: nothing could be learnt from it of the derivatives.
            if not (current.at + step != current.at).any():
                break
            promised = self.promised(current, step)
            if _little(promised, current.chi2):
                if fresh:
                    break
                leads = False
            else:
                complete = eager
                asked = moving if eager else moving[:0]
                ahead, eager = yield from self.linearise(current.at + step, current.errors, asked, current)
                gained = 0.0 if ahead is None else current.chi2 - ahead.chi2
                if ahead is not None and gained > 0:
                    if not complete:
                        ahead = dataclasses.replace(ahead, columns=self.columns(current, ahead))
                    converged = fresh and _little(gained, ahead.chi2)
                    current, damping = ahead, max(damping / 5, DAMPING_LIMITS[0])
                    fresh = complete and not ahead.crude
                    if converged:
                        break
                elif fresh:
                    if damping > DAMPING_LIMITS[1]:
                        break
                    damping *= 10
                    continue
                leads = fresh or gained > LEADS * promised
            if not leads:
                again, eager = yield from self.linearise(current.at, current.errors, moving, current, current.motions)
                if again is None:
                    break
                current, fresh = again, True
        if settle and not fresh:
            again, _ = yield from self.linearise(current.at, current.errors, moving, current, current.motions)
            current = again or current
        return current

    def linearise(
        self,
        at: np.ndarray,
        errors: np.ndarray,
        moving: np.ndarray,
        before: Point | None = None,
        known: list[MarkerTrajectory] | None = None,
    ) -> Linearisation:
        """A point with its derivatives by the unknowns ``moving``, None if its simulation breaks down.

        Beside it whether the next may have derivatives, too, as where there is room for them.

        Args:
            at: Where.
            errors: Measurement errors to begin with.
            moving: Numbers of the unknowns.
            before: A point nearby, whose derivatives tell how long steps may be.
            known: Motions there.
        """
        steps = self.likelihood.steps(self.effects, at, None if before is None else before.columns)
        answer = yield Asked(self.effects, np.concatenate([at[None], at + np.eye(len(at))[moving] * steps]), known)
        return self._point(at, errors, moving, steps, answer.motions), answer.eager

    def _point(
        self, at: np.ndarray, errors: np.ndarray, moving: np.ndarray, steps: np.ndarray, motions: list[MarkerTrajectory]
    ) -> Point | None:
        """A point from the motions there and beside it."""
        likelihood = self.likelihood
        if not np.all([m.sound for m in motions]):
            return None
        base = [m.alone(0) for m in motions]
        chi2, errors, r, J = likelihood.measure(base, errors)
        columns, crude = np.zeros((len(r), len(at))), False
        if len(moving):
            beside = likelihood.residual(motions, errors)[:, 1:]
            columns[:, moving] = (r[:, None] - beside) / steps[moving]
            wanted = np.abs(likelihood.steps(self.effects, at, columns))
            crude = bool((np.abs(steps) > CRUDE * wanted)[moving].any())
        chi2 += float((likelihood.prior_residual(at, self.held)[0] ** 2).sum())
        if not (math.isfinite(chi2) and np.isfinite(columns).all()):
            return None
        return Point(chi2=chi2, at=at, errors=errors, r=r, J=J, columns=columns, motions=base, crude=crude)

    def step(self, point: Point, damping: float) -> np.ndarray:
        """One Gauss-Newton step in the unknowns, with the measurement errors eliminated, within bounds."""
        fixed, step = self.held.copy(), np.zeros_like(point.at)
        low, high = self.bounds
        prior, slope = self.likelihood.prior_residual(point.at, self.held)
        most = np.where(self.places, LONGEST_MOVE, LONGEST_STEP * (np.abs(point.at) + 4.0))
        for _ in range(len(step)):
            free = ~fixed
            whole = np.concatenate([point.columns[:, free], point.J], 1)
            H = whole.T @ whole + np.diag(np.concatenate([slope[free] ** 2, self.weight**2]))
            n = int(free.sum())
            H[np.arange(n), np.arange(n)] *= 1 + damping
            H[np.arange(n), np.arange(n)] += 1e-6
            pull = np.concatenate([slope[free] * prior[free], self.weight**2 * point.errors])
            step = np.zeros_like(point.at)
            step[free] = np.linalg.solve(H, whole.T @ point.r - pull)[:n]
            step = np.clip(step, -most, most)
            ahead = point.at + step
            below, above = (ahead < low) & (point.at <= low), (ahead > high) & (point.at >= high)
            beyond = free & (below | above)
            if not beyond.any():
                break
            fixed |= beyond
        return np.clip(point.at + step, low, high) - point.at

    def promised(self, point: Point, step: np.ndarray) -> float:
        """By how much a step reduces chi-squared, as far as derivatives hold, with the best measurement errors."""
        r = point.r - point.columns @ step
        H = point.J.T @ point.J + np.diag(self.weight**2)
        more = np.linalg.solve(H, point.J.T @ r - self.weight**2 * point.errors)
        left, errors = r - point.J @ more, self.weight * (point.errors + more)
        prior, _ = self.likelihood.prior_residual(point.at + step, self.held)
        return point.chi2 - float(left @ left + errors @ errors + prior @ prior)

    def columns(self, before: Point, after: Point) -> np.ndarray:
        """Derivatives by the unknowns that agree with what a step did (Broyden's update).

        Of a step that is shorter than those of difference quotients, chance in touching would decide what it did.
        """
        step = after.at - before.at
        if float(np.abs(step).max()) < self.likelihood.step:
            return before.columns
        expected = before.r - before.columns @ step - before.J @ (after.errors - before.errors)
        return before.columns - np.outer(after.r - expected, step) / float(step @ step)

    def covariance(self, point: Point) -> np.ndarray:
        """Of the unknowns at a point, in scales [K, K]; zero where they are held."""
        free = ~self.held
        _, slope = self.likelihood.prior_residual(point.at, self.held)
        whole = np.concatenate([point.columns[:, free], point.J], 1)
        prior = np.concatenate([slope[free] ** 2 + 1e-9, self.likelihood.observation.deviations**-2])
        n = int(free.sum())
        found = np.zeros((len(point.at), len(point.at)))
        found[np.ix_(free, free)] = np.linalg.pinv(whole.T @ whole + np.diag(prior))[:n, :n]
        return found


def _little(gained: float, chi2: float) -> bool:
    """Whether a gain in chi-squared is of no account."""
    least, share = LITTLE
    return gained < max(least, share * chi2)
