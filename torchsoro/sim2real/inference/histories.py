"""Histories of forces by least squares: steady and small as far as generalised cross-validation asks for it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchsoro.sim2real.inference.fit import FitProblem
from torchsoro.sim2real.inference.likelihood import Effects
from torchsoro.sim2real.twin.twin import MarkerTrajectory

RIDGE = 0.1  # weight of a force itself, beside that of its changes between windows
ROUNDS = 3  # of straight lines, each at the measurement errors of the one before
GAIN = 0.05  # of the cross-validated chi-squared, that one more patch has to take away
COST = 1.4  # of a degree of freedom, by which cross-validation does not follow the noise


@dataclass(frozen=True, kw_only=True, eq=False)
class Solution:
    """Histories on some patches.

    Attributes:
        criterion: Of generalised cross-validation: about the chi-squared of a sample that was left out.
        chi2: Left over.
        forces: [T, P, W, 3], in steps of those that were simulated; zero on patches that were not chosen.
        deviations: Standard deviation of each; infinite there.
        chi2s: That each patch by itself leaves [P]; empty where that was not asked for.
    """

    criterion: float
    chi2: float
    forces: np.ndarray
    deviations: np.ndarray
    chi2s: np.ndarray


class Histories:
    """What forces [T, P, W, 3] may take away of a residual.

    Args:
        G: Response of the residual to each force [N, T P W 3].
        d: The residual [N], of variance 1 if nothing is wrong.
        samples: Its degrees of freedom.
        shape: T trials, P patches, W windows, 3 axes.
    """

    def __init__(self, G: np.ndarray, d: np.ndarray, samples: int, shape: tuple[int, int, int, int]) -> None:
        # A small triangle stands for thousands of samples.
        root = np.asarray(np.linalg.qr(np.concatenate([G, d[:, None]], 1), mode="r"))
        self.G, self.d = root[:, :-1].reshape(len(root), *shape), root[:, -1]
        self.samples, self.shape = samples, shape
        steady = np.diff(np.eye(shape[2]), axis=0)
        # Inverse root of the penalty on a history [W, W].
        self.root = np.linalg.inv(np.linalg.cholesky(steady.T @ steady + RIDGE * np.eye(shape[2])))

    def select(self, before: float) -> Solution:
        """Forces on as few patches as do, added one by one.

        Args:
            before: Chi-squared without any force.
        """
        count = self.shape[1]
        best = Solution(
            criterion=before / self.samples,
            chi2=before,
            forces=np.zeros(self.shape),
            deviations=np.full(self.shape, np.inf),
            chi2s=np.zeros(count),
        )
        chosen: list[int] = []
        alone = np.zeros(0)
        while len(chosen) < count:
            tried = {p: self.solve([*chosen, p]) for p in range(count) if p not in chosen}
            if not chosen:
                alone = np.array([tried[p].chi2 for p in range(count)])
            p = min(tried, key=lambda p: tried[p].criterion)
            if tried[p].criterion > (1 - GAIN) * best.criterion:
                break
            chosen.append(p)
            best = tried[p]
        return dataclasses.replace(best, chi2s=alone)

    def solve(self, chosen: list[int]) -> Solution:
        """Forces on chosen patches, with the weight that generalised cross-validation chooses."""
        T, _, W, _ = self.shape
        A = np.einsum("rtpwa,vw->rtpva", self.G[:, :, chosen], self.root)
        U, s, V = np.linalg.svd(A.reshape(len(A), -1), full_matrices=False)
        c = U.T @ self.d
        outside = float(self.d @ self.d - c @ c)
        options = []
        for weight in s[0] ** 2 * np.logspace(-9, 3, 49):
            kept = s**2 / (s**2 + weight)
            chi2 = outside + float((((1 - kept) * c) ** 2).sum())
            spare = self.samples - COST * kept.sum()
            if spare > 0:
                options.append((chi2 * self.samples / spare**2, weight, chi2, float(kept.sum())))
        criterion, weight, chi2, freedom = min(options)
        z = V.T @ (s / (s**2 + weight) * c)
        spread = V.T * np.sqrt(chi2 / (self.samples - freedom) / (s**2 + weight))
        shape = (T, len(chosen), W, 3)
        forces, deviations = np.zeros(self.shape), np.full(self.shape, np.inf)
        forces[:, chosen] = np.einsum("tpva,vw->tpwa", z.reshape(shape), self.root)
        spread = np.einsum("tpvaj,vw->tpwaj", spread.reshape(*shape, -1), self.root)
        deviations[:, chosen] = np.sqrt((spread**2).sum(-1))
        return Solution(criterion=criterion, chi2=chi2, forces=forces, deviations=deviations, chi2s=np.zeros(0))


class Lines:
    """Straight lines at measurement errors: of the residual by forces, and by what is fitted along.

    Args:
        problem: Recordings and twin.
        errors: Measurement errors.
        at: Point of what is simulated, in scales.
        motions: Of each trial: there, then with a step of each that is common, and of each force that begins.
        forces: That the motions have [T, P, W, 3], in steps of those that are added.
    """

    def __init__(
        self,
        problem: FitProblem,
        errors: np.ndarray,
        at: np.ndarray,
        motions: Sequence[MarkerTrajectory],
        forces: np.ndarray,
    ) -> None:
        self.errors, self.n = errors, len(problem.common)
        trials, count, windows, _ = forces.shape
        r, J = problem.linear(row(motions, 0), errors)
        rows = range(1, 1 + self.n + count * windows * 3)
        slopes = np.stack([r - problem.residual(row(motions, k), errors) for k in rows], 1)
        rise = slopes[:, self.n :].reshape(len(r), count, windows, 3)
        # What begins and ends: the difference of two steps.
        pulse = rise - np.concatenate([rise[:, :, 1:], np.zeros_like(rise[:, :, :1])], 2)
        own = np.repeat(np.arange(trials), [b.count for b in problem.noise_models])
        G = (pulse[:, None] * (own[:, None] == np.arange(trials))[:, :, None, None, None]).reshape(len(r), -1)
        believed, slope = (v[: self.n] for v in problem.prior_residual(at, np.zeros(len(at), bool)))
        weights = np.concatenate([np.maximum(slope, 1e-6), 1 / problem.observation.deviations])
        self.G = np.concatenate([G, np.zeros((len(weights), G.shape[1]))])
        self.target = np.concatenate([r + G @ forces.reshape(-1), -believed, -errors / problem.observation.deviations])
        along = np.concatenate([slopes[:, : self.n] / problem.step, J], 1)
        self.Q, self.R = np.linalg.qr(np.concatenate([along, np.diag(weights)]))
        self.histories = Histories(self._left(self.G), self._left(self.target), len(r), forces.shape)

    def _left(self, rows: np.ndarray) -> np.ndarray:
        return rows - self.Q @ (self.Q.T @ rows)

    def along(self, forces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Changes of modulus and pressure, in scales, and the measurement errors that go with forces."""
        x = np.linalg.solve(self.R, self.Q.T @ (self.target - self.G @ forces.reshape(-1)))
        return x[: self.n], self.errors + x[self.n :]


def row(motions: Sequence[MarkerTrajectory], number: int) -> list[MarkerTrajectory]:
    """One of a batch for each trial."""
    return [m.alone(number) for m in motions]


def solve(
    problem: FitProblem,
    errors: np.ndarray,
    at: np.ndarray,
    motions: Sequence[MarkerTrajectory],
    forces: np.ndarray,
    before: float,
) -> tuple[Solution, np.ndarray, np.ndarray]:
    """Forces with changes of what is common and the measurement errors that go with them.

    Args:
        problem: Recordings and twin.
        errors: Measurement errors to begin with.
        at: Point of what is simulated, in scales.
        motions: As :class:`Lines` has them.
        forces: That the motions have [T, P, W, 3], in steps of those that are added.
        before: Chi-squared without any force.
    """
    solution, common = None, np.zeros(0)
    for _ in range(ROUNDS):
        lines = Lines(problem, errors, at, motions, forces)
        solution = lines.histories.select(before)
        common, errors = lines.along(solution.forces)
    assert solution is not None
    return solution, common, errors


def chi2_of(
    problem: FitProblem, motions: Sequence[MarkerTrajectory], number: int, errors: np.ndarray, at: np.ndarray
) -> float:
    """Of one of a batch with its best measurement errors, and of what is believed; infinite if it broke down."""
    if not all(m.sound[number] for m in motions):
        return math.inf
    believed = problem.prior_residual(at, np.zeros(len(at), bool))[0]
    return problem.measure(row(motions, number), errors)[0] + float((believed**2).sum())


def simulate(
    problem: FitProblem, effects: Effects, at: np.ndarray, forces: np.ndarray, *, slopes: bool = False
) -> list[MarkerTrajectory]:
    """Each trial at points [R, K] with its own forces [R, T, P, W, 3], in steps; the first also with more steps."""
    found = []
    for t, trial in enumerate(problem.trials):
        points = np.concatenate([at, np.diff(forces[:, t], axis=2, prepend=0.0).reshape(len(at), -1)], 1)
        if slopes:
            moves = np.eye(points.shape[1])
            moves[: at.shape[1]] *= problem.step
            moves = np.delete(moves, np.s_[len(problem.common) : at.shape[1]], axis=0)
            points = np.concatenate([points, points[0] + moves])
        # One trial fills all lanes.
        (motions,) = problem.only([trial]).simulate([(effects, points)])
        found += motions
    return found
