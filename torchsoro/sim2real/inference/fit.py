"""Fitting effects to recordings, along with measurement errors, modulus and pressure."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from torchsoro.sim2real.hypotheses.hypothesis import Hypothesis
from torchsoro.sim2real.inference.gauss_newton import Answer, Asked, GaussNewton, Point
from torchsoro.sim2real.inference.likelihood import BREAKS, Effects, Likelihood, Request
from torchsoro.sim2real.inference.probing import ranked_starts
from torchsoro.sim2real.inference.touching import averaged
from torchsoro.sim2real.inference.twin_error import DiscretizationError
from torchsoro.sim2real.twin.twin import MarkerTrajectory, Twin
from torchsoro.simulation.kernels.lanes import LANES

# Damping of the step that leaves a trial out: an unknown that the other trials hardly determine stays as it was.
LEAVE_OUT_DAMPING = 1e-3
ROOM = 2 * LANES  # simulations up to which derivatives are taken along; the same on any machine, as results are
WEAK = 0.2  # of a probe point's strength, at least: the response is also taken there, where it is nearer to linear


@dataclass(frozen=True, kw_only=True, eq=False)
class Fit:
    """The best values of some effects.

    Attributes:
        effects: Fitted effects; none for the null model.
        values: Of each, in SI units; the place [m] of a local one follows its parameters.
        covariances: Of each effect's values.
        ln_factors: By what modulus, pressure and friction are off, see :meth:`Likelihood.ln_factors`.
        errors: Measurement errors, as ``ObservationModel.names``.
        chi2: Whitened sum of squares over recordings, measurement errors and prior residuals.
        samples: Number of samples.
        unknowns: Of the effects.
        seen: Predicted recording of each trial [T, M, A] m.
        whitened: Whitened residual of each trial.
        point: All unknowns that are simulated, in scales.
        end: Where the search ended.
    """

    effects: Effects
    values: tuple[np.ndarray, ...]
    covariances: tuple[np.ndarray, ...]
    ln_factors: dict[str, float]
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

    @property
    def columns(self) -> np.ndarray | None:
        """Derivatives of the whitened residual by the unknowns [N, K]; None where these are not those of the search."""
        return self.end.columns if len(self.end.at) == len(self.point) else None


@dataclass(frozen=True, eq=False, repr=False)
class FitProblem(Likelihood):
    """Recordings and a twin, to which effects are fitted; see :class:`Likelihood` for its other arguments.

    Attributes:
        coarser: A twin with larger cells by which changes of the motion are simulated, and what its stated numbers are
            shifted by there, see :meth:`beside`; none for the twin itself.
    """

    coarser: tuple[Twin, tuple[float, ...]] | None = None

    def finely(self) -> Self:
        """The same by the finer twin as it is, which nothing corrects, with changes of the motion by the twin of now.

        Raises:
            ValueError: without a finer twin.
        """
        if self.fine is None:
            raise ValueError("fine: none, wanted a twin with smaller cells")
        fine = self.by(self.fine)
        error = fine.discretization.replace(chance_in_use=self.discretization.chance_in_use)
        return dataclasses.replace(fine, discretization=error, coarser=(self.twin, tuple(self.shift)))

    @cached_property
    def _coarsely(self) -> Self | None:
        """The same by the twin with larger cells."""
        if self.coarser is None:
            return None
        twin, shift = self.coarser
        return self.only(self.trials, twin=twin, coarser=None, discretization=DiscretizationError(shift=shift))

    def beside(self, asked: Sequence[Asked]) -> list[list[MarkerTrajectory]]:
        """As :meth:`simulate`, but what other points change of the first of each is simulated by larger cells.

        Larger cells change a motion by as much as effects do, but the difference of two motions by a share of it only.

        Args:
            asked: Effects and points; what is known of the first of these is not simulated.
        """
        coarsely = self._coarsely
        if coarsely is None:
            fresh = self.simulate([(a.effects, a.points if a.known is None else a.points[1:]) for a in asked])
            return [_all(a.known, motions) for a, motions in zip(asked, fresh, strict=True)]
        begun = iter(self.simulate([(a.effects, a.points[:1]) for a in asked if a.known is None]))
        found = [next(begun) if a.known is None else a.known for a in asked]
        several = [k for k, a in enumerate(asked) if len(a.points) > 1]
        requests = [(asked[k].effects, asked[k].points) for k in several]
        for k, motions in zip(several, averaged(coarsely, requests, self.looks), strict=True):
            found[k] = [_changed(m.alone(), m, at.alone()) for m, at in zip(motions, found[k], strict=True)]
        return found

    def responses(
        self, requests: Sequence[Request], base: Point, *, roughly: bool = False
    ) -> list[list[MarkerTrajectory]]:
        """As :meth:`simulate`, of points beside a base without an effect; what they change of it by larger cells.

        Args:
            requests: Effects and points.
            base: Beside which.
            roughly: Whether the responses only tell where to begin, so that a few shifts of the planes are enough.
        """
        coarsely = self._coarsely
        if coarsely is None:
            return self.simulate(requests)
        looks = self.few_looks if roughly else self.looks
        middle, *found = averaged(coarsely, [((), base.at[None]), *requests], looks)
        return [
            [_changed(a.alone(), m, at) for a, m, at in zip(middle, motions, base.motions, strict=True)]
            for motions in found
        ]

    def base(self, known: Fit | None = None) -> Point:
        """The point that responses are taken at: the setup as stated, or a fit without effects.

        Raises:
            ValueError: if its simulation breaks down.
        """
        at = np.zeros(len(self.common)) if known is None else known.point
        errors = np.zeros(len(self.observation.deviations)) if known is None else known.errors
        search = GaussNewton(self, ()).linearise(at, errors, np.arange(len(at)))
        asked = next(search)
        try:
            while True:
                asked = search.send(Answer(motions=self.beside([asked])[0]))
        except StopIteration as end:
            point, _ = end.value
        if point is None:
            raise ValueError(BREAKS)
        return point

    def probe(self, effects: Sequence[Hypothesis], base: Point) -> list[list[tuple[float, np.ndarray]]]:
        """How far effects may reduce chi-squared, by one simulation of each probe point and linear responses.

        Args:
            effects: Which.
            base: From where.

        Returns:
            For each effect its probe points, best first: chi-squared that the linear response promises, and the point
            to begin a search with, in scales. Probe points whose simulation breaks down are left out.
        """
        weak = max(WEAK, self.step)
        linear = [e.probe_points(self.twin) if e.joint else e.weak_probe_points(self.twin, weak) for e in effects]
        linear = [[e.with_masses_aside(d, self.twin) for d in own] for e, own in zip(effects, linear, strict=True)]
        points = [own if e.joint else own + e.probe_points(self.twin) for e, own in zip(effects, linear, strict=True)]
        # Where the weak are as strong as the others, most of them are the same.
        apart = [np.unique(np.concatenate(own), axis=0, return_inverse=True) for own in points]
        requests = [
            ((e,), np.concatenate([np.tile(base.at, (len(mine), 1)), mine], 1))
            for e, (mine, _) in zip(effects, apart, strict=True)
        ]
        simulated = [
            [m.alone(places.reshape(-1)) for m in motions]
            for motions, (_, places) in zip(self.responses(requests, base), apart, strict=True)
        ]
        return [
            ranked_starts(self, e, own, len(through_zero), weak, motions, base)
            for e, own, through_zero, motions in zip(effects, points, linear, simulated, strict=True)
        ]

    def fit(
        self,
        tasks: Sequence[tuple[Effects, np.ndarray | None]],
        *,
        errors: np.ndarray | None = None,
        rounds: int = 25,
        settle: bool = True,
    ) -> list[Fit | None]:
        """Fit effects, with modulus, pressure and measurement errors under their priors; all tasks side by side.

        Args:
            tasks: Effects (none, one or two) and where to begin, in scales; all zero if None.
            errors: Measurement errors to begin with.
            rounds: Steps at most, each a simulation of all trials. Derivatives, a simulation for each unknown, are
                taken at the first point, at the last, and where those of an earlier point promise too much.
            settle: Take them at the last point; without it, intervals are rough.

        Returns:
            A fit of each; None where the simulation of the first point breaks down.
        """
        given = np.zeros(len(self.observation.deviations)) if errors is None else errors
        solvers = [GaussNewton(self, effects) for effects, _ in tasks]
        searches = [
            solver.search(start, given, rounds, settle=settle)
            for solver, (_, start) in zip(solvers, tasks, strict=True)
        ]
        ends: list[Point | None] = [None] * len(tasks)
        asked = {i: next(search) for i, search in enumerate(searches)}
        while asked:
            order = list(asked)
            # Where there is room in a batch, derivatives take hardly longer than the step.
            wide = sum(1 + solvers[i].unknowns for i in order) * len(self.trials)
            eager = self.coarser is None and wide <= ROOM
            answers = self.beside([asked[i] for i in order])
            for i, motions in zip(order, answers, strict=True):
                try:
                    asked[i] = searches[i].send(Answer(motions=motions, eager=eager))
                except StopIteration as end:
                    ends[i] = end.value
                    del asked[i]
        return [None if end is None else self._fit(solver, end) for solver, end in zip(solvers, ends, strict=True)]

    def without(self, fit: Fit, number: int) -> Fit:
        """What a fit would be without one of the trials, by one step along its derivatives.

        Args:
            fit: Of this problem.
            number: Of the trial that is left out.
        """
        rows = np.concatenate([np.full(b.count, i != number) for i, b in enumerate(self.noise_models)])
        end = fit.end
        end = dataclasses.replace(end, r=end.r[rows], J=end.J[rows], columns=end.columns[rows])
        step = GaussNewton(self, fit.effects).step(end, LEAVE_OUT_DAMPING)
        weight = 1 / self.observation.deviations
        ahead = end.J.T @ (end.r - end.columns @ step) - weight**2 * end.errors
        errors = end.errors + np.linalg.solve(end.J.T @ end.J + np.diag(weight**2), ahead)
        return dataclasses.replace(fit, point=end.at + step, errors=np.delete(errors, number))

    def _fit(self, solver: GaussNewton, point: Point) -> Fit:
        """A point as a fit, in SI units."""
        scales, effects = self.scales(solver.effects), solver.effects
        covariance = solver.covariance(point) * np.outer(scales, scales)
        values, covariances, k = [], [], len(self.common)
        for effect in effects:
            count = len(effect.quantities) + 3 * effect.local
            values.append(point.at[k : k + count] * scales[k : k + count])
            covariances.append(covariance[k : k + count, k : k + count])
            k += count
        cuts = np.cumsum([b.count for b in self.noise_models])[:-1]
        return Fit(
            effects=effects,
            values=tuple(values),
            covariances=tuple(covariances),
            ln_factors=self.ln_factors(point.at),
            errors=point.errors,
            chi2=point.chi2,
            samples=self.samples,
            unknowns=len(point.at) - len(self.common),
            seen=tuple(self.observation.observe(m, i, point.errors) for i, m in enumerate(point.motions)),
            whitened=tuple(np.split(point.r, cuts)),
            point=point.at,
            end=point,
        )


def _all(known: list[MarkerTrajectory] | None, motions: list[MarkerTrajectory]) -> list[MarkerTrajectory]:
    """Motions of each trial with those that are known before the others."""
    return motions if known is None else [m.following(k) for k, m in zip(known, motions, strict=True)]


def _changed(one: MarkerTrajectory, others: MarkerTrajectory, at: MarkerTrajectory) -> MarkerTrajectory:
    """A motion with what others [B, ...] change of one, where all of them are sound."""
    sound = others.sound & bool(one.sound.all()) & bool(at.sound.all())
    return dataclasses.replace(others.plus(one, -1.0).plus(at), sound=sound)
