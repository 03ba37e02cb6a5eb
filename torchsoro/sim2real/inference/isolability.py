"""Which effects an experiment can detect and tell apart, by its times, markers, noise and discretization error.

The recorded coordinates do not enter. Responses are simulated at the setup as stated, at small strengths; see
:mod:`torchsoro.sim2real.inference.cosines`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchsoro.sim2real.hypotheses.hypothesis import Hypothesis
from torchsoro.sim2real.hypotheses.library import library
from torchsoro.sim2real.inference.cosines import SCORE, PriorResidual, Response, cleared, compare
from torchsoro.sim2real.inference.fit import FitProblem
from torchsoro.sim2real.inference.likelihood import BREAKS
from torchsoro.sim2real.inference.noise import NoiseModel
from torchsoro.sim2real.inference.observation import ObservationModel
from torchsoro.sim2real.inference.observed import Motions
from torchsoro.sim2real.inference.touching import averaged
from torchsoro.sim2real.twin.twin import MarkerTrajectory

SAME = 0.97  # cosine above which one effect passes for another
SMALL = 0.1  # strength of a weak response, over that of the weakest probe point, at least: it is linear there
ROUNDING = 0.05  # whitened length of a response, below which it may be rounding in single precision


@dataclass(frozen=True, kw_only=True, eq=False)
class Isolability:
    """Which effects an experiment can detect and tell apart.

    Attributes:
        effects: Names of E effects.
        quantities: First quantity of each, and its unit.
        detectable: Strength at which each is detectable, in that unit [E]; infinite if never.
        cosines: How much of the change by effect i, where it is first detectable, effect j can imitate [E, E], 0 to 1.
        changes: Of the motion by one noticeable change, one for each direction in which an effect acts, as far as weak
            ones tell, of each trial [T, M, A, D] m; without what breaks down or moves nothing.
        owners: Name of the effect of each of these [D].
    """

    effects: tuple[str, ...]
    quantities: tuple[tuple[str, str], ...]
    detectable: np.ndarray
    cosines: np.ndarray
    changes: Motions
    owners: tuple[str, ...]

    def confused(self, threshold: float = SAME) -> list[tuple[str, str]]:
        """Pairs of effects, of which the second can imitate the first: the experiment cannot tell them apart."""
        pairs = np.argwhere(self.cosines - np.eye(len(self.effects)) > threshold)
        return [(self.effects[i], self.effects[j]) for i, j in pairs]

    def as_json(self) -> dict[str, Any]:
        """For explanation.json; null where an effect is never detectable."""
        return {
            "effects": list(self.effects),
            "detectable": [
                {"quantity": name, "unit": unit, "value": float(value) if math.isfinite(value) else None}
                for (name, unit), value in zip(self.quantities, self.detectable, strict=True)
            ],
            "alike": np.round(self.cosines, 4).tolist(),
            "score": SCORE,
        }


def isolability(
    problem: FitProblem, effects: Sequence[Hypothesis] | None = None, *, score: float = SCORE
) -> Isolability:
    """Which effects an experiment can detect and tell apart, by one simulation of each probe point.

    Args:
        problem: Recordings, of which only the times count, and twin.
        effects: Hypotheses; those of the library that apply if None.
        score: Gain in chi-squared at which an effect is detectable.

    Raises:
        ValueError: if the simulation of the setup as stated breaks down.
    """
    thought_of = problem.thought_of(library() if effects is None else effects)
    effects = [e for e in thought_of if not e.rugged]
    n = len(problem.common)
    # Effects that are fitted always need no simulation of their own.
    fitted = {type(e): k for k, (e, _) in enumerate(problem.common)}
    others = [e for e in effects if type(e) not in fitted]
    small = max(SMALL, problem.step)
    looks = [_probe_points(effect, problem, small) for effect in others]
    probe_points = [[*weak, *strong] for weak, strong in looks]
    still = np.concatenate([np.zeros((1, n)), small * np.eye(n)])
    asked = [
        ((e,), np.pad(np.concatenate(mine), ((0, 0), (n, 0)))) for e, mine in zip(others, probe_points, strict=True)
    ]
    problem = problem.only(problem.trials, even=True)
    base, *found = averaged(problem, [((), still), *asked], problem.few_looks)
    if not all(m.sound.all() for m in base):
        raise ValueError(BREAKS)
    believed = [m.alone(0) for m in base]
    moved = [moved_by(problem.observation, believed, motions) for motions in (base, *found)]
    blocks = [whitened(problem.noise_models, by) for by in moved]
    blocks[0] = blocks[0][:, 1:] / small
    by = errors_of(problem.observation, problem.noise_models, believed)
    common, *rest = np.split(
        shortened(blocks, by, problem.observation), np.cumsum([b.shape[1] for b in blocks])[:-1], 1
    )
    known = {
        id(effect): _response(effect, mine, block, np.all([m.sound for m in motions], axis=0), small)
        for effect, mine, block, motions in zip(others, probe_points, rest, found, strict=True)
    }
    for effect in effects:
        if type(effect) in fitted:
            k = fitted[type(effect)]
            column = common[:, k : k + 1] * effect.quantities[0].scale / problem.common[k][1]
            free = np.ones(1, bool)
            known[id(effect)] = Response(paths=((np.ones(1), column),), cones=((column, free),), either=True)
    responses = [known[id(effect)] for effect in effects]
    detectable, cosines = compare(responses, common, prior_residual_of(problem), score)
    first = [e.quantities[0] for e in effects]
    changes, owners = _seen(problem, _noticeable(problem, effects, [own for own, _ in looks], moved, small))
    return Isolability(
        effects=tuple(e.name for e in effects),
        quantities=tuple((q.name, q.unit) for q in first),
        detectable=detectable * np.array([q.scale for q in first]),
        cosines=cosines,
        changes=changes,
        owners=owners,
    )


def _noticeable(
    problem: FitProblem,
    effects: Sequence[Hypothesis],
    probe_points: Sequence[Sequence[np.ndarray]],
    moved: Sequence[Motions],
    small: float,
) -> list[tuple[str, Motions]]:
    """Changes by one noticeable change of each effect [T, M, A, D] m, with its name, from those by weak ones."""
    fitted = {type(e): k for k, (e, _) in enumerate(problem.common)}
    rest = iter(zip(probe_points, moved[1:], strict=True))
    found: list[tuple[str, Motions]] = []
    for effect in effects:
        if (k := fitted.get(type(effect))) is not None:
            share = effect.quantities[0].scale / problem.common[k][1] / small
            found.append((effect.name, tuple(share * m[..., [1 + k]] for m in moved[0])))
        else:
            own, by = next(rest)
            strength = np.linalg.norm(np.concatenate(own)[:, : len(effect.quantities)], axis=1)
            found.append((effect.name, tuple(m[..., : len(strength)] / strength for m in by)))
    return found


def prior_residual_of(problem: FitProblem) -> PriorResidual:
    """Prior residuals of modulus and pressure at values in tolerances."""
    return lambda x: problem.prior_residual(x, np.zeros(len(x), bool))[0]


def moved_by(
    observation: ObservationModel, believed: Sequence[MarkerTrajectory], motions: Sequence[MarkerTrajectory]
) -> Motions:
    """Change of what would be recorded, for a batch of motions, of each trial [T, M, A, B] m; 0 for broken ones."""
    sound = np.all([m.sound for m in motions], axis=0)
    still = np.zeros(len(observation.deviations))
    found = []
    for i, (base, motion) in enumerate(zip(believed, motions, strict=True)):
        seen = observation.observe(base, i, still)
        each = [
            observation.observe(motion.alone(k), i, still) - seen if good else 0 * seen for k, good in enumerate(sound)
        ]
        found.append(np.stack(each, -1))
    return tuple(found)


def whitened(noise_models: Sequence[NoiseModel], changes: Motions) -> np.ndarray:
    """Changes of all trials over their errors [N, B]."""
    return np.concatenate([model.whiten(change) for model, change in zip(noise_models, changes, strict=True)])


def errors_of(
    observation: ObservationModel, noise_models: Sequence[NoiseModel], believed: Sequence[MarkerTrajectory]
) -> np.ndarray:
    """Whitened change by each measurement error [N, L]."""
    still = np.zeros(len(observation.deviations))
    slopes = [observation.linearise(motion, i, still)[1] for i, motion in enumerate(believed)]
    return np.concatenate([noise_model.whiten(by) for noise_model, by in zip(noise_models, slopes, strict=True)])


def shortened(blocks: Sequence[np.ndarray], by: np.ndarray, observation: ObservationModel) -> np.ndarray:
    """Changes projected off the measurement errors, in as few rows as keep all lengths and angles."""
    left = cleared(np.concatenate(blocks, 1), by, 1 / observation.deviations)
    return np.asarray(np.linalg.qr(left, mode="r"))


def _seen(problem: FitProblem, changes: Sequence[tuple[str, Motions]]) -> tuple[Motions, tuple[str, ...]]:
    """Those together that move something that was recorded, of each trial [T, M, A, D] m, and the names of each."""
    found = []
    owners = [name for name, of in changes for _ in range(of[0].shape[-1])]
    for i, trial in enumerate(problem.trials):
        assert trial.recording is not None
        seen = np.isfinite(trial.recording.position)[..., None]
        found.append(np.where(seen, np.concatenate([of[i] for _, of in changes], -1), 0.0))
    some = np.any([change.any(axis=(0, 1, 2)) for change in found], axis=0)
    return tuple(change[..., some] for change in found), tuple(o for o, kept in zip(owners, some, strict=True) if kept)


def _probe_points(effect: Hypothesis, problem: FitProblem, small: float) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Weak and strong probe points of an effect: alternatives, each with directions [D, K] in scales.

    A weak one suffices for an effect whose response begins at zero strength. One that has a threshold, as sliding on a
    plane, is also simulated at full strengths.
    """
    weak = effect.weak_probe_points(problem.twin, small)
    if effect.joint:  # of many places, every other
        return weak[:: -2 if effect.local else 1], []
    if effect.local or len(effect.quantities) > 1 or not problem.scenarios[0].planes:
        return weak, []
    known = sorted(effect.probe_points(problem.twin), key=lambda d: abs(d[0, 0]))
    return weak, [known[0], known[-1]]


def _response(
    effect: Hypothesis, probe_points: list[np.ndarray], columns: np.ndarray, sound: np.ndarray, small: float
) -> Response:
    """An effect's changes [N, K] by probe point, without those whose simulation breaks down."""
    kinds = len(effect.quantities)
    backwards = np.array([q.least < 0 for q in effect.quantities])
    numbers = np.split(np.arange(len(sound)), np.cumsum([len(d) for d in probe_points])[:-1])
    kept = [(d, columns[:, k]) for d, k in zip(probe_points, numbers, strict=True) if sound[k].all()]
    paths, cones = [], []
    if effect.joint:
        for directions, mine in kept:
            cones.append((mine, backwards[np.abs(directions[:, :kinds]).argmax(1)]))
            # Strengths are in the first quantity's unit: directions in that unit count, the most visible of them.
            same_unit = [q.unit == effect.quantities[0].unit for q in effect.quantities]
            some = mine[:, directions[:, :kinds][:, same_unit].any(1)]
            turn = np.linalg.svd(some, full_matrices=False)[2][:1]
            paths.append((np.array([small]), some @ turn.T * (1 if turn.sum() > 0 else -1)))
        return Response(paths=tuple(paths), cones=tuple(cones), either=bool(backwards[0]))
    if kinds == 1 and not effect.local and kept and np.linalg.norm(kept[0][1]) < ROUNDING:
        # Its response has a threshold.
        strong = [(d[0, 0], mine) for d, mine in kept if d[0, 0] * kept[-1][0][0, 0] > 0]
        course = np.concatenate([mine for _, mine in strong], 1)
        paths = [(np.abs([d for d, _ in strong]), course)]
        pairs = [course[:, max(k - 1, 0) : k + 1] for k in range(len(strong))]
        cones = [(pair, np.zeros(pair.shape[1], bool)) for pair in pairs]
    else:
        weak = kept[:1] if kinds == 1 and not effect.local else kept
        paths = [(np.abs(d[0, :1]), mine) for d, mine in weak]
        cones = [(mine, np.zeros(1, bool)) for _, mine in weak]
    return Response(paths=tuple(paths), cones=tuple(cones), either=bool(backwards[0]))
