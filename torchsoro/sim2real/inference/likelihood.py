"""The likelihood: simulations with effects, and their whitened residuals against recordings."""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property
from typing import Any, Self

import numpy as np
import torch

from torchsoro.sim2real.data.experiment import Experiment, Trial
from torchsoro.sim2real.hypotheses.body_effects import Modulus
from torchsoro.sim2real.hypotheses.hypothesis import Hypothesis
from torchsoro.sim2real.hypotheses.outer_effects import Friction
from torchsoro.sim2real.hypotheses.supply_effects import PressureGain
from torchsoro.sim2real.inference.noise import LASTING, NoiseModel, estimate_noise
from torchsoro.sim2real.inference.observation import MarkerSlip, ObservationModel, Priors
from torchsoro.sim2real.inference.twin_error import DiscretizationError
from torchsoro.sim2real.twin.batch import THREADS, simulate
from torchsoro.sim2real.twin.scenario import Scenario
from torchsoro.sim2real.twin.twin import MarkerTrajectory, Twin

EDGE = 0.15  # width of the edge of a prior, over its tolerance
FEWEST = 8  # samples of the first part of a trial, below which it is not used
STEP = 0.05  # of an unknown, in its scale, for difference quotients
SECANT = 1.0  # the most of the same, where chance in touching would drown less: a noticeable change
LOOKS = 7  # shifts of the planes over which such differences are averaged, at most
# The same where a mean decides only where to begin, or from which strength on an effect is seen: the error is 1.5 times
# that of the mean over all, which takes more than twice as long.
FEW_LOOKS = 3
CALM = 0.5  # of the noise: chance in which node touches when that is less adds less than a quarter to its variance
VALLEYS = 2.0  # times the noise: chance of sliding blocks, whose searches end where they should, is up to 1.3
WITHIN = 0.3  # slope of the prior residual within its tolerance, where values are nearly as good as another

BREAKS = "setup: its simulation breaks down, wanted a body that withstands its loads"


def silent(*_told: object) -> None:
    """Report nothing."""


# What is fitted always, as files and reports call it.
STATED: dict[type[Hypothesis], str] = {Modulus: "ln_modulus", PressureGain: "ln_pressure", Friction: "ln_friction"}

Effects = tuple[Hypothesis, ...]
Request = tuple[Effects, np.ndarray]  # effects, and points to simulate them at [B, K]


@dataclass(frozen=True, kw_only=True)
class Tolerances:
    """Tolerances of ln of the stated modulus, of the stated pressure, and of stated coefficients of friction.

    Repeated pulls on one floor differ by a tenth. Besides, a soft body that slides sticks here and there, which
    lengthens its way by up to 5 % as fine cells, and another code's floor, have it.
    """

    modulus: float = 0.1
    pressure: float = 0.05
    friction: float = 0.1


@dataclass
class Tally:
    """Number of simulations; the only thing here that changes."""

    simulations: int = 0

    def count(self, simulations: int) -> None:
        """So many more."""
        self.simulations += simulations


@dataclass(frozen=True, eq=False, repr=False)
class Likelihood:
    """Recordings, a twin and its error, and chi-squared of motions.

    Attributes:
        experiment: What to explain.
        twin: Its body.
        trials: To fit, with a recording each; those of the experiment if none are given.
        discretization: The twin's own error.
        tolerances: Of modulus, pressure and friction.
        priors: Of measurement errors.
        noise: [m]; that of the setup, or estimated, if 0 is given.
        lasting: Share of the noise's variance that lasts from sample to sample; 0 for white noise.
        slips: Markers that have slipped.
        fine: A finer twin, for :meth:`corrected`.
        threads: That simulate.
        even: Whether all simulations of a call take the same time step, so that its error cancels in differences.
        report: Called with a line after each batch of simulations.
        watch: Called in it with its size, in simulated seconds, and the share that is done.
        tally: Of all simulations of this and of what is derived from it.
    """

    experiment: Experiment
    twin: Twin
    _: KW_ONLY
    trials: tuple[Trial, ...] = ()
    discretization: DiscretizationError = field(default_factory=DiscretizationError)
    tolerances: Tolerances = field(default_factory=Tolerances)
    priors: Priors = field(default_factory=Priors)
    noise: float = 0.0
    lasting: float = LASTING
    slips: tuple[MarkerSlip, ...] = ()
    fine: Twin | None = None
    threads: int = THREADS
    even: bool = False
    report: Callable[[str], None] = silent
    watch: Callable[[float, float], None] = silent
    tally: Tally = field(default_factory=Tally)

    def __post_init__(self) -> None:
        """Put in what was not given."""
        trials = tuple(self.trials) or self.experiment.trials
        recordings = [t.recording for t in trials if t.recording is not None]
        noise = self.noise or self.experiment.setup.noise or estimate_noise(recordings)
        for name, value in (
            ("trials", trials),
            ("noise", noise),
            ("discretization", self.discretization.among(trials)),
        ):
            object.__setattr__(self, name, value)

    @cached_property
    def observation(self) -> ObservationModel:
        """From motions to recordings."""
        return ObservationModel(self.experiment.setup, self.trials, self.priors, self.slips)

    @cached_property
    def noise_models(self) -> tuple[NoiseModel, ...]:
        """Of each trial."""
        return tuple(
            NoiseModel(t.recording, self.noise, self.discretization.of(t), self.lasting)
            for t in self.trials
            if t.recording is not None
        )

    @cached_property
    def samples(self) -> int:
        """Number of samples of all trials."""
        return sum(b.count for b in self.noise_models)

    @cached_property
    def scenarios(self) -> tuple[Scenario, ...]:
        """What is believed of each trial, until the end of its recording."""
        return tuple(self.twin.scenario(t).replace(until=self.observation.until(i)) for i, t in enumerate(self.trials))

    @property
    def touches(self) -> bool:
        """Whether a trial has planes."""
        return any(s.planes for s in self.scenarios)

    @property
    def chance(self) -> float:
        """Error by chance in which node touches a plane when, over the noise."""
        return self.discretization.chance / self.noise if self.touches else 0.0

    @property
    def rough(self) -> bool:
        """Whether chance makes chi-squared rough: bodies on planes, unless their motion is known not to hang on it."""
        return self.chance > CALM

    @property
    def many_valleys(self) -> bool:
        """Whether it is so rough that searches end in valleys nearby."""
        return self.chance > VALLEYS

    @property
    def drowned(self) -> float:
        """Error by chance of the difference of two motions that are a noticeable change apart, over what is calm."""
        chance = self.discretization.chance_in_use if self.touches else 0.0
        return math.sqrt(2) * chance / (CALM * self.noise) if math.isfinite(chance) else 0.0

    @property
    def step(self) -> float:
        """Of unknowns, in their scales, for difference quotients: so long that this error is calm, if it can be."""
        if self.rough and math.isfinite(self.chance):
            return SECANT
        return float(np.clip(self.drowned, STEP, SECANT))

    @property
    def looks(self) -> int:
        """Shifts of the planes over which differences are averaged, so that it is calm where no step is enough."""
        return int(np.clip(math.ceil((self.drowned / SECANT) ** 2), 1, LOOKS))

    @property
    def few_looks(self) -> int:
        """The same where a mean decides only where to begin, or from which strength on an effect is seen."""
        return min(self.looks, FEW_LOOKS)

    @property
    def searched_finely(self) -> bool:
        """Whether the finer twin searches, too: of bodies that meet planes, however noisy their recordings are."""
        return self.touches and self.finer_twin is not None

    @cached_property
    def common(self) -> tuple[tuple[Hypothesis, float], ...]:
        """What is fitted always, with its tolerance: modulus, and where there are such pressure and friction."""
        known: list[tuple[Hypothesis, float]] = [(Modulus(), self.tolerances.modulus)]
        if self.experiment.setup.chambers:
            known.append((PressureGain(), self.tolerances.pressure))
        if any(p.friction != "stick" for t in self.experiment.trials for p in t.setup.planes):
            known.append((Friction(), self.tolerances.friction))
        return tuple(known)

    @property
    def as_stated(self) -> Request:
        """The setup as stated, without an effect."""
        return (), np.zeros((1, len(self.common)))

    def ln_factors(self, point: np.ndarray) -> dict[str, float]:
        """By what the stated numbers are off at a point [K] in scales, as logarithms by name."""
        scales = self.scales(())
        return {STATED[type(e)]: float(point[k] * scales[k]) for k, (e, _) in enumerate(self.common)}

    @cached_property
    def shift(self) -> np.ndarray:
        """Of ln of the stated numbers, with which the twin moves as a finer one does."""
        return np.array(self.discretization.shift or [0.0] * len(self.common))

    def only(self, trials: Sequence[Trial], **changes: Any) -> Self:
        """The same of other trials, with other slips, another twin, or another error of the twin."""
        return dataclasses.replace(self, trials=tuple(trials), **changes)

    def by(self, twin: Twin) -> Self:
        """The same by the finer twin, corrected by what still smaller cells add; touching hangs on chance as much."""
        chance = self.discretization.chance
        error = DiscretizationError(chance=chance, chance_in_use=chance, correction=self.discretization.smaller)
        return self.only(self.trials, twin=twin, discretization=error)

    def corrected(self, at: np.ndarray) -> Self:
        """The same, corrected by the finer twin where one is now: at the stated numbers [K], in scales.

        A simulation of one's own is of what is believed, and stays what it is.
        """
        (found,) = self._finer(self.trials, [((), at[None])])
        correction = {**self.discretization.correction, **found}
        return self.only(self.trials, discretization=self.discretization.replace(correction=correction))

    def corrected_each(self, points: Sequence[Request]) -> Self:
        """The same, but effects are corrected by the finer twin where each of them is now, at one point."""
        # What is left out is predicted by the finer twin itself, where there is one.
        left_out = () if self.finer_twin is not None else self.experiment.heldout
        found = self._finer([*self.trials, *(t for t in left_out if t.recording is not None)], points)
        known = self.discretization
        own = {e: {**known.correction, **mine} for (e, _), mine in zip(points, found, strict=True)}
        return self.only(self.trials, discretization=known.replace(own={**known.own, **own}))

    def _finer(self, trials: Sequence[Trial], points: Sequence[Request]) -> list[dict[str, MarkerTrajectory]]:
        """What the finer twin adds at points, by trial; nothing to those with a simulation of one's own."""
        trials = [t for t in trials if t.name not in self.stated]
        if self.fine is None or not trials:
            return [{} for _ in points]
        there = self.by(self.fine).only(trials)
        bare = self.only(trials, discretization=self.discretization.replace(correction={}, own={}))
        coarse = bare.simulate(points)
        return [added(trials, a, b) for a, b in zip(coarse, there.simulate(points), strict=True)]

    @property
    def stated(self) -> dict[str, MarkerTrajectory]:
        """Of the corrections, those by a simulation of one's own."""
        trials, known = (*self.experiment.trials, *self.experiment.heldout), self.discretization.correction
        return {t.name: known[t.name] for t in trials if t.simulated and t.name in known}

    @property
    def finer_twin(self) -> Twin | None:
        """The finer twin; none where trials come with a simulation of their own, which stands in for it."""
        return None if self.stated else self.fine

    def thought_of(self, effects: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Those of the effects that apply to a trial."""
        return [e for e in effects if any(e.applies(scenario, self.twin) for scenario in self.scenarios)]

    def early(self, share: float) -> Self | None:
        """The same of the beginning of the trials, where a wrong frequency has not become a wrong phase.

        None where a trial has too few samples then.
        """
        cut = []
        for t in self.trials:
            assert t.recording is not None
            begin = max(float(t.recording.time[0]), 0.0)
            end = begin + share * (t.setup.duration - begin)
            if np.count_nonzero(t.recording.time <= end) < FEWEST:
                return None
            setup = dataclasses.replace(t.setup, duration=end)
            cut.append(dataclasses.replace(t, setup=setup, recording=t.recording.until(end)))
        return self.only(cut)

    # Simulating -------------------------------------------------------------------------------------------------

    def scales(self, effects: Effects) -> np.ndarray:
        """Of all that is fitted by simulating: modulus, pressure, the effects, places."""
        found = [tolerance for _, tolerance in self.common]
        for effect in effects:
            found += [q.scale for q in effect.quantities]
            found += [0.1 * s for s in self.twin.setup.size] if effect.local else []
        return np.array(found)

    def bounds(self, effects: Effects) -> tuple[np.ndarray, np.ndarray]:
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

    def steps(self, effects: Effects, at: np.ndarray, columns: np.ndarray | None = None) -> np.ndarray:
        """Of the unknowns at a point [K], in scales, for difference quotients: to the side where there is room.

        Unknowns that move the body nearly alike, as a modulus and a softer end do, differ by little in their
        derivatives, which the curvature over a step must not hide. So an unknown that changes the motion by more than
        the noise has a step that is shorter in proportion.

        Args:
            effects: That are simulated, beside what is fitted always.
            at: The point.
            columns: Derivatives of the whitened residual near it [N, K], where they are known.
        """
        low, high = self.bounds(effects)
        longest = np.full(len(at), self.step)
        if columns is not None and self.step <= STEP:
            longest /= np.maximum(np.sqrt((columns**2).mean(0)), 1.0)
        up, down = np.minimum(longest, high - at), np.minimum(longest, at - low)
        return np.where(up >= down, up, -down)

    def vary(self, scenario: Scenario, effects: Effects, points: np.ndarray) -> Scenario:
        """A scenario at points [B, K], in scales."""
        values = torch.from_numpy(points * self.scales(effects))
        values[:, : len(self.shift)] += torch.from_numpy(self.shift)
        at = 0
        for effect, _ in self.common:
            scenario = effect(scenario, values[:, at : at + 1], self.twin)
            at += 1
        for effect in effects:
            count = len(effect.quantities) + 3 * effect.local
            part = values[:, at : at + count]
            at += count
            if effect.applies(scenario, self.twin) and bool((part[:, : len(effect.quantities)] != 0).any()):
                scenario = effect(scenario, part, self.twin)
        return scenario

    def simulate(
        self, requests: Sequence[Request], of: Sequence[Sequence[int]] | None = None
    ) -> list[list[MarkerTrajectory]]:
        """For each request, the motions of its trials, each with a leading batch; all at once.

        Args:
            requests: Effects and points.
            of: Numbers of the trials of each; all if None.
        """
        if not requests:
            return []  # without a word to the progress
        begin = time.perf_counter()
        asked = [range(len(self.trials)) for _ in requests] if of is None else of
        lanes = [(k, i) for k, own in enumerate(asked) for i in own]
        varied = [self.vary(self.scenarios[i], *requests[k]) for k, i in lanes]
        found: list[list[MarkerTrajectory]] = [[] for _ in requests]
        size = sum(s.until * s.batch for s in varied)
        watch = functools.partial(self.watch, size)
        watch(0.0)
        moving = simulate(self.twin, varied, threads=self.threads, even=self.even, watch=watch)
        for (k, i), motion in zip(lanes, moving, strict=True):
            error, name = self.discretization, self.trials[i].name
            known = error.own.get(requests[k][0], error.correction)
            found[k].append(motion.plus(known[name]) if name in known else motion)
        spent = time.perf_counter() - begin
        simulations = sum(len(points) * len(own) for (_, points), own in zip(requests, asked, strict=True))
        self.tally.count(simulations)
        self.report(f"{simulations} simulations, {spent:.1f} s")
        return found

    # Residuals --------------------------------------------------------------------------------------------------

    def residual(self, motions: Sequence[MarkerTrajectory], errors: np.ndarray) -> np.ndarray:
        """Whitened residual of all trials [N]; of motions with a batch [N, B]."""
        left = []
        for i, (motion, trial, noise_model) in enumerate(zip(motions, self.trials, self.noise_models, strict=True)):
            assert trial.recording is not None
            off = trial.recording.position - self.observation.observe(motion, i, errors)
            left.append(noise_model.whiten(off if off.ndim == 3 else np.moveaxis(off, 0, -1)))
        return np.concatenate(left)

    def linear(self, motions: Sequence[MarkerTrajectory], errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As :meth:`residual`, and its slopes by the measurement errors."""
        left, slopes = [], []
        for i, (motion, trial, noise_model) in enumerate(zip(motions, self.trials, self.noise_models, strict=True)):
            assert trial.recording is not None
            seen, by = self.observation.linearise(motion, i, errors)
            left.append(noise_model.whiten(trial.recording.position - seen))
            slopes.append(noise_model.whiten(by))
        return np.concatenate(left), np.concatenate(slopes)

    def measure(
        self, motions: Sequence[MarkerTrajectory], errors: np.ndarray
    ) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        """The best measurement errors for motions: chi-squared with their priors, errors, residual, slopes."""
        weight = 1 / self.observation.deviations
        best = (math.inf, errors, np.zeros(0), np.zeros((0, 0)))
        for _ in range(6):
            r, J = self.linear(motions, errors)
            chi2 = float(r @ r + ((errors * weight) ** 2).sum())
            if chi2 < best[0]:
                gained = best[0] - chi2
                best = (chi2, errors, r, J)
                if gained < 0.05 + 1e-4 * chi2:
                    break
            else:  # too far
                errors = (errors + best[1]) / 2
                continue
            H = J.T @ J + np.diag(weight**2)
            errors = errors + np.linalg.solve(H, J.T @ r - weight**2 * errors)
        return best

    def prior_residual(self, at: np.ndarray, held: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals of the stated numbers by their priors at a point, and their slopes; zero where ``held``.

        The prior is nearly flat within the tolerance and falls steeply beyond.
        """
        n = len(self.common)
        out = np.maximum(np.abs(at[:n]) - 1, 0) / EDGE
        r, slope = np.zeros(len(at)), np.zeros(len(at))
        r[:n] = np.sign(at[:n]) * np.hypot(WITHIN * at[:n], out)
        slope[:n] = np.where(out > 0, 1 / EDGE, WITHIN)
        return np.where(held, 0.0, r), np.where(held, 0.0, slope)


def added(
    trials: Sequence[Trial], coarse: Sequence[MarkerTrajectory], fine: Sequence[MarkerTrajectory]
) -> dict[str, MarkerTrajectory]:
    """By trial, what a finer twin adds to motions [S, M, ...]; nothing where one of them broke down."""
    return {
        t.name: b.alone().plus(a.alone(), -1.0)
        for t, a, b in zip(trials, coarse, fine, strict=True)
        if a.sound.all() and b.sound.all()
    }
