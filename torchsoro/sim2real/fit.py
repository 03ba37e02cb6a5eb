"""Fitting an effect to recordings: Gauss-Newton on the twin, along with measurement errors, modulus and pressure."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import lsq_linear

from torchsoro.errors import SimulationDiverged
from torchsoro.sim2real.body_effects import Modulus
from torchsoro.sim2real.experiment import Experiment, Trial
from torchsoro.sim2real.hypothesis import Hypothesis
from torchsoro.sim2real.outer_effects import PressureGain
from torchsoro.sim2real.residual import Band, Camera, Priors, estimate_noise
from torchsoro.sim2real.scenario import Scenario, together
from torchsoro.sim2real.twin import Motion, Twin

STEP = 0.05  # of a scale, for differences
FIRST = 0.5  # the longest step of a search, in shares of what is there plus two scales


@dataclass(frozen=True, kw_only=True)
class Beliefs:
    """What a setup's numbers are good for: standard deviations of ln of the modulus and of the pressure."""

    modulus: float = 0.1
    pressure: float = 0.05


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
    """

    effects: tuple[Hypothesis, ...]
    values: tuple[np.ndarray, ...]
    covariances: tuple[np.ndarray, ...]
    belief: np.ndarray
    errors: np.ndarray
    misfit: float
    samples: int
    unknowns: int
    seen: tuple[np.ndarray, ...]
    whitened: tuple[np.ndarray, ...]
    point: np.ndarray

    @property
    def deviations(self) -> tuple[np.ndarray, ...]:
        """Standard deviations of the values."""
        return tuple(np.sqrt(np.maximum(np.diag(c), 0)) for c in self.covariances)

    @property
    def name(self) -> str:
        """Of the effects."""
        return " + ".join(e.name for e in self.effects) or "nothing"


class Problem:
    """Recordings, a twin and its error: what is needed to fit.

    Args:
        experiment: What to explain.
        twin: Its body.
        trials: To fit; those with a recording if None.
        numerics: The twin's own error for each trial [M, A] m; none if None.
        beliefs: See there.
        priors: Of measurement errors.
        noise: [m]; that of the setup, or estimated, if None.
        report: Called with a line after each simulation.
    """

    def __init__(
        self,
        experiment: Experiment,
        twin: Twin,
        *,
        trials: Sequence[Trial] | None = None,
        numerics: Sequence[np.ndarray] | None = None,
        beliefs: Beliefs | None = None,
        priors: Priors | None = None,
        noise: float | None = None,
        report: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.experiment, self.twin, self.report = experiment, twin, report
        self.trials = tuple(experiment.trials if trials is None else trials)
        recordings = [t.recording for t in self.trials if t.recording is not None]
        self.noise = noise or experiment.setup.noise or estimate_noise(recordings)
        shape = recordings[0].place.shape[1:]
        self.numerics = list(numerics or [np.zeros(shape)] * len(recordings))
        self.camera = Camera(experiment.setup, self.trials, priors)
        self.bands = [Band(r, self.noise, n) for r, n in zip(recordings, self.numerics, strict=True)]
        self.scenarios = [twin.scenario(t) for t in self.trials]
        beliefs = beliefs or Beliefs()
        self.common: list[tuple[Hypothesis, float]] = [(Modulus(), beliefs.modulus)]
        if experiment.setup.cavities:
            self.common.append((PressureGain(), beliefs.pressure))
        self.simulations, self.seconds = 0, 0.0

    # Simulating -------------------------------------------------------------------------------------------------

    def scales(self, effects: Sequence[Hypothesis]) -> np.ndarray:
        """Of all that is fitted by simulating: modulus, pressure, the effects, places."""
        found = [deviation for _, deviation in self.common]
        for effect in effects:
            found += [q.scale for q in effect.quantities]
            found += [0.1 * s for s in self.twin.setup.size] if effect.local else []
        return np.array(found)

    def bounds(self, effects: Sequence[Hypothesis]) -> tuple[np.ndarray, np.ndarray]:
        """Of the unknowns, in scales."""
        low, high = [-6.0] * len(self.common), [6.0] * len(self.common)
        for effect in effects:
            low += [q.least for q in effect.quantities]
            high += [q.most for q in effect.quantities]
            if effect.local:
                s = self.twin.setup
                low += [10 * o / z for o, z in zip(s.origin, s.size, strict=True)]
                high += [10 * o / z + 10 for o, z in zip(s.origin, s.size, strict=True)]
        return np.array(low), np.array(high)

    def vary(self, scenario: Scenario, effects: Sequence[Hypothesis], points: np.ndarray) -> Scenario:
        """A scenario at points [B, K], in scales."""
        values = torch.from_numpy(points * self.scales(effects))
        at = 0
        for effect, _ in self.common:
            scenario = effect(scenario, values[:, at : at + 1], self.twin)
            at += 1
        for effect in effects:
            count = len(effect.quantities) + 3 * effect.local
            part = values[:, at : at + count]
            at += count
            if bool((part[:, : len(effect.quantities)] != 0).any()):
                scenario = effect(scenario, part, self.twin)
        return scenario

    def simulate(self, effects: Sequence[Hypothesis], points: np.ndarray) -> list[Motion]:
        """Motions of all trials at points [B, K], each with a leading batch.

        Raises:
            SimulationDiverged: if one breaks down.
        """
        begin = time.perf_counter()
        varied = [self.vary(s, effects, points) for s in self.scenarios]
        whole = together(varied, len(points))
        if whole is None:
            found = [self.twin.simulate(s) for s in varied]
        else:
            found = self.twin.simulate(whole).parts(len(varied))
        spent = time.perf_counter() - begin
        self.simulations += len(points) * len(found)
        self.seconds += spent
        names = " + ".join(e.name for e in effects) or "nothing"
        self.report(f"{names}: {len(points) * len(found)} simulations, {spent:.1f} s")
        return found

    # Fitting ----------------------------------------------------------------------------------------------------

    def base(self, known: Fit | None = None) -> Point:
        """Where effects are looked at from: what is believed, or a fit without effects, with derivatives."""
        at = np.zeros(len(self.common)) if known is None else known.point
        errors = np.zeros(len(self.camera.deviations)) if known is None else known.errors
        ones = np.ones(len(at))
        return self._linearise((), at, errors, ones, np.arange(len(at)), 1e9 * ones)

    def look(self, effect: Hypothesis, base: Point) -> list[tuple[float, np.ndarray]]:
        """How much an effect may explain, from one simulation of each of its looks and straight lines between.

        Args:
            effect: Which.
            base: From where.

        Returns:
            For each look, best first: the misfit that it would leave, and the point to begin a search with, in scales.

        Raises:
            SimulationDiverged: if a look breaks down.
        """
        low, high = self.bounds([effect])
        count, kinds = len(self.common), len(effect.quantities)
        looks = effect.looks(self.twin)
        points = np.concatenate([np.concatenate([np.tile(base.at, (len(d), 1)), d], 1) for d in looks])
        motions = self.simulate([effect], points)
        left = [
            np.concatenate(self.residual([m.alone(k) for m in motions], base.errors)[0]) for k in range(len(points))
        ]
        own = {type(effect)}
        prior = [0.0 if type(e) in own else 1.0 for e, _ in self.common]
        prior = np.concatenate([prior, 1 / self.camera.deviations])
        known, at = np.concatenate([base.at, base.errors]), 0
        ranked = []
        for directions in looks:
            n = len(directions)
            slopes = np.stack([base.r - r for r in left[at : at + n]], 1)
            if effect.joint:
                # What adds up: any strength within bounds.
                begin, reach = base.r, self._reach(directions[:, :kinds], low[count:], high[count:])
                offset = np.zeros(n)
            else:
                begin, reach, offset = left[at], (np.array([-0.5]), np.array([0.5])), np.ones(1)
            at += n
            J = np.concatenate([slopes, base.columns, base.J], 1)
            rows = np.concatenate([np.zeros((len(prior), n)), np.diag(prior)], 1)
            free = np.full(len(prior), np.inf)
            found = lsq_linear(
                np.concatenate([J, rows]),
                np.concatenate([begin, -prior * known]),
                bounds=(np.concatenate([reach[0], -free]), np.concatenate([reach[1], free])),
            )
            strength = (offset + found.x[:n]) @ directions[:, :kinds]
            if not effect.joint and kinds > 1:
                # A relaxation time does not grow with the strength.
                strength[1:] = directions[0, 1:kinds]
            start = np.concatenate([base.at + found.x[n : n + count], strength, directions[0, kinds:]])
            ranked.append((2 * float(found.cost), np.clip(start, low, high)))
        return sorted(ranked, key=lambda look: look[0])

    @staticmethod
    def _reach(directions: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far directions may be scaled within bounds, and within eight times themselves."""
        least, most = [], []
        for d in directions:
            k = int(np.flatnonzero(d)[0])
            ends = sorted((low[k] / d[k], high[k] / d[k]))
            least.append(max(ends[0], -8.0))
            most.append(min(ends[1], 8.0))
        return np.array(least), np.array(most)

    def residual(self, motions: Sequence[Motion], errors: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Whitened residuals of all trials, and their derivatives by the measurement errors."""
        left, slopes = [], []
        for i, (motion, trial, band) in enumerate(zip(motions, self.trials, self.bands, strict=True)):
            assert trial.recording is not None
            seen, by = self.camera.see(motion, i, errors)
            left.append(band.whiten(trial.recording.place - seen))
            slopes.append(band.whiten(by))
        return left, slopes

    def measure(
        self, motions: Sequence[Motion], errors: np.ndarray
    ) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        """The best measurement errors for motions: misfit with their priors, errors, residual, slopes."""
        weight = 1 / self.camera.deviations
        best = (math.inf, errors, np.zeros(0), np.zeros((0, 0)))
        for _ in range(8):
            left, slopes = self.residual(motions, errors)
            r, J = np.concatenate(left), np.concatenate(slopes)
            misfit = float(r @ r + ((errors * weight) ** 2).sum())
            if misfit < best[0]:
                gained = best[0] - misfit
                best = (misfit, errors, r, J)
                if gained < 0.05:
                    break
            else:  # too far
                errors = (errors + best[1]) / 2
                continue
            H = J.T @ J + np.diag(weight**2)
            errors = errors + np.linalg.solve(H, J.T @ r - weight**2 * errors)
        return best

    def fit(
        self,
        effects: Sequence[Hypothesis] = (),
        start: np.ndarray | None = None,
        *,
        errors: np.ndarray | None = None,
        rounds: int = 25,
    ) -> Fit:
        """Fit effects, with modulus, pressure and measurement errors at their beliefs.

        Args:
            effects: None, one or two.
            start: Where to begin, in scales; all zero if None.
            errors: Measurement errors to begin with.
            rounds: Steps at most, each a simulation of all trials. Derivatives, a simulation for each unknown, are
                taken at the first point, at the last, and where a step gains little.

        Raises:
            SimulationDiverged: if the first point breaks down.
        """
        size = len(self.scales(effects))
        low, high = self.bounds(effects)
        at = np.zeros(size) if start is None else np.clip(np.asarray(start, float), low, high)
        errors = np.zeros(len(self.camera.deviations)) if errors is None else errors
        priors = np.zeros(size)
        # The effect "modulus" is the modulus without its prior; beside it the common one has nothing to do.
        own = {type(effect) for effect in effects}
        held = np.zeros(size, dtype=bool)
        for i, (effect, _) in enumerate(self.common):
            priors[i] = 1.0
            held[i] = type(effect) in own
            at[i] = 0.0 if held[i] else at[i]
        places = np.array([False] * len(self.common) + [p for e in effects for p in _marks(e)])
        damping, moving = 1e-2, np.flatnonzero(~held)
        current = self._linearise(effects, at, errors, priors, moving, high)
        anew = True  # whether the derivatives are those of this point
        for _ in range(rounds):
            step = self._step(current, priors, held, places, low, high, damping)
            try:
                ahead = self._linearise(effects, current.at + step, current.errors, priors, moving[:0], high)
            except SimulationDiverged:
                ahead = None
            gained = 0.0 if ahead is None else current.misfit - ahead.misfit
            if ahead is not None and gained > 0:
                columns = _corrected(current, ahead)
                current, damping = dataclasses.replace(ahead, columns=columns), max(damping / 5, 1e-4)
                settled, anew = anew and gained < max(0.5, 1e-3 * ahead.misfit), False
                if settled:
                    break
            elif anew:
                if damping > 10:
                    break
                damping *= 10
                continue
            # Derivatives that were carried along have done what they can.
            if gained < 0.05 * current.misfit:
                current, anew = self._linearise(effects, current.at, current.errors, priors, moving, high), True
        if not anew:
            current = self._linearise(effects, current.at, current.errors, priors, moving, high)
        return self._report(effects, current, priors, held)

    def _linearise(self, effects, at, errors, priors, moving, high) -> Point:
        """The misfit at a point, and derivatives by the unknowns ``moving``."""
        steps = np.where(at + STEP > high, -STEP, STEP)
        motions = self.simulate(effects, np.concatenate([at[None], at + np.eye(len(at))[moving] * steps]))
        base = [m.alone(0) for m in motions]
        misfit, errors, r, J = self.measure(base, errors)
        columns = np.zeros((len(r), len(at)))
        for k, i in enumerate(moving, start=1):
            left, _ = self.residual([m.alone(k) for m in motions], errors)
            columns[:, i] = (r - np.concatenate(left)) / steps[i]
        misfit += float(((at * priors) ** 2).sum())
        return Point(misfit=misfit, at=at, errors=errors, r=r, J=J, columns=columns, motions=base)

    def _step(self, point: Point, priors, held, places, low, high, damping) -> np.ndarray:
        """One Gauss-Newton step in the unknowns, with the measurement errors eliminated, within bounds."""
        weight, fixed, step = 1 / self.camera.deviations, held.copy(), np.zeros_like(point.at)
        most = np.where(places, 1.5, FIRST * np.abs(point.at) + 2.0)
        for _ in range(len(step)):
            free = ~fixed
            whole = np.concatenate([point.columns[:, free], point.J], 1)
            prior = np.concatenate([priors[free] ** 2, weight**2])
            H = whole.T @ whole + np.diag(prior)
            n = int(free.sum())
            H[np.arange(n), np.arange(n)] *= 1 + damping
            H[np.arange(n), np.arange(n)] += 1e-6
            g = whole.T @ point.r - prior * np.concatenate([point.at[free], point.errors])
            step = np.zeros_like(point.at)
            step[free] = np.linalg.solve(H, g)[:n]
            step = np.clip(step, -most, most)
            ahead = point.at + step
            beyond = free & (((ahead < low) & (point.at <= low)) | ((ahead > high) & (point.at >= high)))
            if not beyond.any():
                break
            fixed |= beyond
        return np.clip(point.at + step, low, high) - point.at

    def _report(self, effects, point: Point, priors, held) -> Fit:
        left, _ = self.residual(point.motions, point.errors)
        weight = 1 / self.camera.deviations
        whole = np.concatenate([point.columns[:, ~held], point.J], 1)
        H = whole.T @ whole + np.diag(np.concatenate([priors[~held] ** 2 + 1e-9, weight**2]))
        size, n = len(point.at), int((~held).sum())
        covariance = np.zeros((size, size))
        covariance[np.ix_(~held, ~held)] = np.linalg.pinv(H)[:n, :n]
        scales = self.scales(effects)
        values, covariances, k = [], [], len(self.common)
        for effect in effects:
            count = len(effect.quantities) + 3 * effect.local
            values.append(point.at[k : k + count] * scales[k : k + count])
            covariances.append((covariance * np.outer(scales, scales))[k : k + count, k : k + count])
            k += count
        return Fit(
            effects=tuple(effects),
            values=tuple(values),
            covariances=tuple(covariances),
            belief=(point.at * scales)[: len(self.common)],
            errors=point.errors,
            misfit=point.misfit,
            samples=sum(b.count for b in self.bands),
            unknowns=size - len(self.common),
            seen=tuple(self.camera.see(m, i, point.errors)[0] for i, m in enumerate(point.motions)),
            whitened=tuple(left),
            point=point.at,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Point:
    """Where a search stands: unknowns in scales, measurement errors, whitened residual, slopes by both, motions."""

    misfit: float
    at: np.ndarray
    errors: np.ndarray
    r: np.ndarray
    J: np.ndarray
    columns: np.ndarray
    motions: list[Motion]


def _marks(effect: Hypothesis) -> list[bool]:
    """Which of an effect's unknowns are its place."""
    return [False] * len(effect.quantities) + [True] * (3 * effect.local)


def _corrected(before: Point, after: Point) -> np.ndarray:
    """Derivatives by the unknowns that agree with what a step did (Broyden's update)."""
    step = after.at - before.at
    expected = before.r - before.columns @ step - before.J @ (after.errors - before.errors)
    return before.columns - np.outer(after.r - expected, step) / float(step @ step)
