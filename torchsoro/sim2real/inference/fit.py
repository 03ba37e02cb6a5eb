"""Fitting effects to recordings: Gauss-Newton on the twin, along with measurement errors, modulus and pressure.

Searches ask for simulations and wait; those of all searches are simulated together (:meth:`Problem.fit`).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from torchsoro.sim2real.hypotheses.hypothesis import Hypothesis
from torchsoro.sim2real.inference.likelihood import BREAKS, Effects, Likelihood, Request
from torchsoro.sim2real.twin.twin import MarkerMotion

STEP = 0.05  # of a scale, for differences
STIFF = 1e-3  # damping of the step without a trial: what the others hardly tell stays as it was
WEAK = 0.2  # of a look, at which effects are looked at too, since what is weak may be lost in what is not linear
FAR = 8.0  # times a look whose parts add up, up to which strength
NEAR = 0.6  # of a look, up to which a weak one is trusted; from there on it is looked at by itself
FIRST = 0.5  # the longest step of a search, in shares of what is there plus two scales

Search = Generator[Request, list[MarkerMotion], "Point | None"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Point:
    """Where a search stands: unknowns in scales, measurement errors, whitened residual, slopes by both, motions."""

    chi2: float
    at: np.ndarray
    errors: np.ndarray
    r: np.ndarray
    J: np.ndarray
    columns: np.ndarray
    motions: list[MarkerMotion]


@dataclass(frozen=True, kw_only=True, eq=False)
class Fit:
    """The best that an effect can do.

    Attributes:
        effects: Fitted effects.
        values: Of each, in SI units; the place [m] of a local one follows its parameters.
        covariances: Of each effect's values.
        belief: ln factors of modulus, and of pressure where there is one.
        errors: Measurement errors, as ``Camera.names``.
        misfit: Whitened sum of squares over recordings, and over beliefs.
        samples: Number of samples.
        unknowns: Of the effects.
        seen: What would have been recorded in each trial [T, M, A] m.
        whitened: Residual of each trial, divided by what may be.
        point: All that was fitted by simulating, in scales.
        end: Where the search ended.
    """

    effects: Effects
    values: tuple[np.ndarray, ...]
    covariances: tuple[np.ndarray, ...]
    ln_factors: np.ndarray
    errors: np.ndarray
    chi2: float
    samples: int
    unknowns: int
    seen: tuple[np.ndarray, ...]
    whitened: tuple[np.ndarray, ...]
    point: np.ndarray
    end: Point

    @property
    def name(self) -> str:
        """Of the effects."""
        return " + ".join(e.name for e in self.effects) or "nothing"


class FitProblem(Likelihood):
    """What effects are fitted to; see :class:`Likelihood` for its arguments."""

    eager = False  # whether derivatives come with every step

    # Looking ----------------------------------------------------------------------------------------------------

    def base(self, known: Fit | None = None) -> Point:
        """Where effects are looked at from: what is believed, or a fit without effects, with derivatives.

        Raises:
            ValueError: if it breaks down.
        """
        at = np.zeros(len(self.common)) if known is None else known.point
        errors = np.zeros(len(self.observation.deviations)) if known is None else known.errors
        held = np.zeros(len(at), bool)
        return self._whole(self._linearise((), at, errors, held, np.arange(len(at)), 1e9 + 0 * at))

    def probe(self, effects: Sequence[Hypothesis], base: Point) -> list[list[tuple[float, np.ndarray]]]:
        """How much effects may explain, from one simulation of each of their looks and straight lines between.

        Args:
            effects: Which.
            base: From where.

        Returns:
            For each, its looks, best first: the misfit that it would leave, and the point to begin a search with, in
            scales. Looks that break down are left out.
        """
        linear = [e.probe_points(self.twin) if e.joint else e.weak_probe_points(self.twin, WEAK) for e in effects]
        linear = [[e.with_masses_aside(d, self.twin) for d in mine] for e, mine in zip(effects, linear, strict=True)]
        probe_points = [
            mine if e.joint else mine + e.probe_points(self.twin) for e, mine in zip(effects, linear, strict=True)
        ]
        requests = [
            ((e,), np.concatenate([np.concatenate([np.tile(base.at, (len(d), 1)), d], 1) for d in mine]))
            for e, mine in zip(effects, probe_points, strict=True)
        ]
        simulated = self.simulate(requests)
        return [
            self._rank(e, mine, len(adding), motions, base)
            for e, mine, adding, motions in zip(effects, probe_points, linear, simulated, strict=True)
        ]

    def _rank(
        self, effect: Hypothesis, probe_points: list[np.ndarray], linear: int, motions: list[MarkerMotion], base: Point
    ) -> list[tuple[float, np.ndarray]]:
        """As :meth:`look`, of one effect; the first ``linear`` of its looks add up."""
        low, high = self.bounds((effect,))
        count, kinds = len(self.common), len(effect.quantities)
        held = np.array([isinstance(e, type(effect)) for e, _ in self.common])
        believed, slope = self.prior_residual(base.at, held)
        prior = np.concatenate([slope, 1 / self.observation.deviations])
        known = np.concatenate([np.where(slope > 0, believed / np.where(slope > 0, slope, 1), 0), base.errors])
        sound = np.all([m.sound for m in motions], axis=0)
        ranked, at = [], 0
        if held.any():
            # What the belief held, set free: no look is needed for that.
            H = np.concatenate([np.concatenate([base.columns, base.J], 1), np.diag(prior)])
            target = np.concatenate([base.r, -prior * known])
            x = np.linalg.lstsq(H, target, rcond=None)[0]
            common, strength = base.at + x[:count], np.zeros(kinds)
            for i in np.flatnonzero(held):
                strength[0] = common[i] * self.common[i][1] / effect.quantities[0].scale
                common[i] = 0.0
            left = float(((target - H @ x) ** 2).sum())
            ranked.append((left, np.clip(np.concatenate([common, strength]), low, high)))
        for number, directions in enumerate(probe_points):
            n = len(directions)
            mine = range(at, at + n)
            at += n
            if not sound[list(mine)].all():
                continue
            left = [self.residual([m.alone(k) for m in motions], base.errors) for k in mine]
            slopes = np.stack([base.r - r for r in left], 1)
            if number < linear:
                # Any strength within bounds.
                far = FAR if effect.joint or effect.local else NEAR / WEAK
                begin, reach = base.r, _reach(directions[:, :kinds], low[count:], high[count:], far)
                offset = np.zeros(n)
            else:
                begin, reach, offset = left[0], (np.array([-0.5]), np.array([0.5])), np.ones(1)
            J = np.concatenate([slopes, base.columns, base.J], 1)
            rows = np.concatenate([np.zeros((len(prior), n)), np.diag(prior)], 1)
            free = np.full(len(prior), np.inf)
            H = np.concatenate([J, rows])
            target = np.concatenate([begin, -prior * known])
            # Normal equations: a few dozen unknowns and thousands of samples.
            scale = np.sqrt((H**2).sum(0)) + 1e-300
            ridge = np.concatenate([H / scale, 1e-4 * np.eye(len(scale))])
            root = np.asarray(np.linalg.qr(ridge, mode="r"))
            inner = np.linalg.solve(root.T, (H / scale).T @ target)
            found = lsq_linear(
                root,
                inner,
                bounds=(np.concatenate([reach[0], -free]) * scale, np.concatenate([reach[1], free]) * scale),
            )
            x = found.x / scale
            cost = 2 * float(found.cost) + float(target @ target - inner @ inner)
            strength = (offset + x[:n]) @ directions[:, :kinds]
            if not effect.joint and kinds > 1:
                # A relaxation time does not grow with the strength.
                strength[1:] = directions[0, 1:kinds]
            common = base.at + x[n : n + count]
            for i in np.flatnonzero(held):  # the effect takes over what the belief held
                strength[0] += common[i] * self.common[i][1] / effect.quantities[0].scale
                common[i] = 0.0
            share = np.abs(x[:n]) + 1e-9
            start = np.concatenate([common, strength, share @ directions[:, kinds:] / share.sum()])
            ranked.append((cost, np.clip(start, low, high)))
        return sorted(ranked, key=lambda probe: probe[0])

    # Fitting ----------------------------------------------------------------------------------------------------

    def fit(
        self,
        tasks: Sequence[tuple[Effects, np.ndarray | None]],
        *,
        errors: np.ndarray | None = None,
        rounds: int = 25,
        settle: bool = True,
    ) -> list[Fit | None]:
        """Fit effects, with modulus, pressure and measurement errors at their beliefs; all tasks side by side.

        Args:
            tasks: Effects (none, one or two) and where to begin, in scales; all zero if None.
            errors: Measurement errors to begin with.
            rounds: Steps at most, each a simulation of all trials. Derivatives, a simulation for each unknown, are
                taken at the first point, at the last, and where a step gains little.
            settle: Take them at the last point; without it, intervals are rough.

        Returns:
            A fit of each; None where the first point breaks down.
        """
        given = np.zeros(len(self.observation.deviations)) if errors is None else errors
        searches = [self._search(effects, start, given, rounds, settle) for effects, start in tasks]
        ends: list[Point | None] = [None] * len(tasks)
        asked = {i: next(search) for i, search in enumerate(searches)}
        while asked:
            order = list(asked)
            # Derivatives are for nothing where there is room.
            wide = sum(1 + len(self.scales(tasks[i][0])) for i in order) * len(self.trials)
            self.eager = wide <= self.ensemble.room
            answers = self.simulate([asked[i] for i in order])
            for i, motions in zip(order, answers, strict=True):
                try:
                    asked[i] = searches[i].send(motions)
                except StopIteration as end:
                    ends[i] = end.value
                    del asked[i]
        return [
            None if end is None else self._report(effects, end) for (effects, _), end in zip(tasks, ends, strict=True)
        ]

    def without(self, fit: Fit, number: int) -> Fit:
        """What a fit would be without one of the trials, by one step along its derivatives.

        Args:
            fit: Of this problem.
            number: Of the trial that is left out.
        """
        held = self._held(fit.effects)
        low, high = self.bounds(fit.effects)
        places = np.array([False] * len(self.common) + [p for e in fit.effects for p in _marks(e)])
        rows = np.concatenate([np.full(b.count, i != number) for i, b in enumerate(self.noise_models)])
        end = fit.end
        end = dataclasses.replace(end, r=end.r[rows], J=end.J[rows], columns=end.columns[rows])
        step = self._step(end, held, places, low, high, STIFF)
        weight = 1 / self.observation.deviations
        ahead = end.J.T @ (end.r - end.columns @ step) - weight**2 * end.errors
        errors = end.errors + np.linalg.solve(end.J.T @ end.J + np.diag(weight**2), ahead)
        return dataclasses.replace(fit, point=end.at + step, errors=np.delete(errors, number))

    def _whole(self, search: Search) -> Point:
        """Run one search by itself."""
        asked = next(search)
        try:
            while True:
                asked = search.send(self.simulate([asked])[0])
        except StopIteration as end:
            if end.value is None:
                raise ValueError(BREAKS) from None
            return end.value

    def _held(self, effects: Effects) -> np.ndarray:
        """The effect "modulus" is the modulus without its belief; beside it the common one has nothing to do."""
        held = [any(isinstance(e, type(common)) for e in effects) for common, _ in self.common]
        return np.array(held + [False] * (len(self.scales(effects)) - len(held)))

    def _search(
        self, effects: Effects, start: np.ndarray | None, errors: np.ndarray, rounds: int, settle: bool
    ) -> Search:
        low, high = self.bounds(effects)
        at = np.zeros(len(low)) if start is None else np.clip(np.asarray(start, float), low, high)
        held = self._held(effects)
        at = np.where(held, 0.0, at)
        places = np.array([False] * len(self.common) + [p for e in effects for p in _marks(e)])
        damping, moving = 1e-2, np.flatnonzero(~held)
        current = yield from self._linearise(effects, at, errors, held, moving, high)
        if current is None:
            return None
        anew = True  # whether the derivatives are those of this point
        for _ in range(rounds):
            step = self._step(current, held, places, low, high, damping)
            if not step.any():
                break
            eager = self.eager
            ahead = yield from self._linearise(
                effects, current.at + step, current.errors, held, moving if eager else moving[:0], high
            )
            gained = 0.0 if ahead is None else current.chi2 - ahead.chi2
            if ahead is not None and gained > 0:
                if not eager:
                    ahead = dataclasses.replace(ahead, columns=_corrected(current, ahead))
                settled = anew and gained < max(0.5, 1e-3 * ahead.chi2)
                current, damping, anew = ahead, max(damping / 5, 1e-4), eager
                if settled:
                    break
            elif anew:
                if damping > 10:
                    break
                damping *= 10
                continue
            # Derivatives that were carried along have done what they can.
            if not anew and gained < 0.3 * current.chi2:
                fresh = yield from self._linearise(effects, current.at, current.errors, held, moving, high)
                if fresh is None:
                    break
                current, anew = fresh, True
        if settle and not anew:
            fresh = yield from self._linearise(effects, current.at, current.errors, held, moving, high)
            current = fresh or current
        return current

    def _linearise(self, effects, at, errors, held, moving, high) -> Search:
        """The misfit at a point, and derivatives by the unknowns ``moving``; None if it breaks down."""
        steps = np.where(at + STEP > high, -STEP, STEP)
        motions = yield effects, np.concatenate([at[None], at + np.eye(len(at))[moving] * steps])
        if not np.all([m.sound for m in motions]):
            return None
        base = [m.alone(0) for m in motions]
        chi2, errors, r, J = self.measure(base, errors)
        columns = np.zeros((len(r), len(at)))
        for k, i in enumerate(moving, start=1):
            left = self.residual([m.alone(k) for m in motions], errors)
            columns[:, i] = (r - left) / steps[i]
        chi2 += float((self.prior_residual(at, held)[0] ** 2).sum())
        if not (math.isfinite(chi2) and np.isfinite(columns).all()):
            return None
        return Point(chi2=chi2, at=at, errors=errors, r=r, J=J, columns=columns, motions=base)

    def _step(self, point: Point, held, places, low, high, damping) -> np.ndarray:
        """One Gauss-Newton step in the unknowns, with the measurement errors eliminated, within bounds."""
        weight, fixed, step = 1 / self.observation.deviations, held.copy(), np.zeros_like(point.at)
        believed, slope = self.prior_residual(point.at, held)
        most = np.where(places, 1.5, FIRST * np.abs(point.at) + 2.0)
        for _ in range(len(step)):
            free = ~fixed
            whole = np.concatenate([point.columns[:, free], point.J], 1)
            prior = np.concatenate([slope[free] ** 2, weight**2])
            H = whole.T @ whole + np.diag(prior)
            n = int(free.sum())
            H[np.arange(n), np.arange(n)] *= 1 + damping
            H[np.arange(n), np.arange(n)] += 1e-6
            pull = np.concatenate([slope[free] * believed[free], weight**2 * point.errors])
            step = np.zeros_like(point.at)
            step[free] = np.linalg.solve(H, whole.T @ point.r - pull)[:n]
            step = np.clip(step, -most, most)
            ahead = point.at + step
            beyond = free & (((ahead < low) & (point.at <= low)) | ((ahead > high) & (point.at >= high)))
            if not beyond.any():
                break
            fixed |= beyond
        return np.clip(point.at + step, low, high) - point.at

    def _report(self, effects: Effects, point: Point) -> Fit:
        held = self._held(effects)
        _, slope = self.prior_residual(point.at, held)
        whole = np.concatenate([point.columns[:, ~held], point.J], 1)
        prior = np.concatenate([slope[~held] ** 2 + 1e-9, self.observation.deviations**-2])
        size, n = len(point.at), int((~held).sum())
        covariance = np.zeros((size, size))
        covariance[np.ix_(~held, ~held)] = np.linalg.pinv(whole.T @ whole + np.diag(prior))[:n, :n]
        scales = self.scales(effects)
        values, covariances, k = [], [], len(self.common)
        for effect in effects:
            count = len(effect.quantities) + 3 * effect.local
            values.append(point.at[k : k + count] * scales[k : k + count])
            covariances.append((covariance * np.outer(scales, scales))[k : k + count, k : k + count])
            k += count
        cuts = np.cumsum([b.count for b in self.noise_models])[:-1]
        return Fit(
            effects=effects,
            values=tuple(values),
            covariances=tuple(covariances),
            ln_factors=(point.at * scales)[: len(self.common)],
            errors=point.errors,
            chi2=point.chi2,
            samples=self.samples,
            unknowns=size - len(self.common),
            seen=tuple(self.observation.observe(m, i, point.errors) for i, m in enumerate(point.motions)),
            whitened=tuple(np.split(point.r, cuts)),
            point=point.at,
            end=point,
        )


def _marks(effect: Hypothesis) -> list[bool]:
    """Which of an effect's unknowns are its place."""
    return [False] * len(effect.quantities) + [True] * (3 * effect.local)


def _reach(directions: np.ndarray, low: np.ndarray, high: np.ndarray, far: float) -> tuple[np.ndarray, np.ndarray]:
    """How far directions may be scaled within bounds, and up to ``far`` times themselves."""
    least, most = [], []
    for d in directions:
        k = int(np.flatnonzero(d)[0])
        ends = sorted((low[k] / d[k], high[k] / d[k]))
        least.append(max(ends[0], -far))
        most.append(min(ends[1], far))
    return np.array(least), np.array(most)


def _corrected(before: Point, after: Point) -> np.ndarray:
    """Derivatives by the unknowns that agree with what a step did (Broyden's update)."""
    step = after.at - before.at
    expected = before.r - before.columns @ step - before.J @ (after.errors - before.errors)
    return before.columns - np.outer(after.r - expected, step) / float(step @ step)
