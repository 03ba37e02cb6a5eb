"""Posterior probabilities of what may be missing.

Candidates are: nothing is missing; a discrepancy that no effect explains; each effect; each pair. Their evidences are
compared after an adjustment for how errors really vary. The covariance of the errors takes markers and axes nearly as
independent, while errors of contact move the whole body: sums over samples are then more uncertain than it says. Along
the change D by an effect, draws d of the twin's error tell by how much (magnitude adjustment of a composite
likelihood: Ribatet, Cooley and Davison 2012),

    kappa = 1 + sum_k mean_d (D' C^-1 d)^2 / (D' C^-1 D),

the mean over draws d of one kind k, C without what it has of d, and the likelihood is taken to the power of 1 / kappa.
The draws count in full, whatever share c of its price the residual shows: an error along the change is taken up by the
effect, and not left.

Where the most probable model leaves a discrepancy that matters, none is right, and what separates evidences is mostly
how well that discrepancy happens to fit its covariance. Then its size decides: N independent numbers whose variance is
not known, of root mean square r, left by a model with K numbers of its own, have the likelihood (Schwarz 1978)

    ln p = -N ln r - K/2 ln N,

times what the prior says of stated numbers. So it does between modes of one name, by r alone. An extension always
leaves less than what it extends, so that beside that it is no more probable than by evidence.

Two names are told apart no better than the twin can. What the first leaves may be the twin's error, up to the size that
this is priced at, and it may lie along their difference. With an error of that size, all samples count as few numbers,
as few as the most lasting draw of the twin's error amounts to in a trial: cells that are too stiff are so in all of
them. By this likelihood, with the priors as they are, another name is as probable as it is at least. It is at most as
probable as the first, but for how much less it strains beliefs: that a stated number is off by many tolerances is
improbable whatever the twin errs by. An extension has a number more, by which it fits the twin's error as well: beside
what it extends, the error is as large as it is priced. Nothing and what moves the body by less than the twin may err
are compared in the same way.

An effect that is missing may be too weak to be seen. It predicts what nothing predicts, and is told beside that,
whatever its name, see :func:`torchsoro.sim2real.inference.visible.too_weak`. By the prior of strengths a quarter is
less than one noticeable change: that has no name.

Nothing with a stated number that is off by more than is credible is not nothing: its probability is that of the
number's name.

Where size decides and both leave no more than the twin may err, evidence is as good a judge as size, since it knows how
that error varies. A name whose ln evidence is higher by D, adjusted, is at least 1 - exp(-D) times as probable as the
first.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from scipy.stats import t

from torchsoro.sim2real.inference.decision import BELIEVED, FREEDOM, MISSING, STRENGTH
from torchsoro.sim2real.inference.evidence import Model, Posterior, adjusted, ln_strained, mode_of, products
from torchsoro.sim2real.inference.least_squares import closest, ln_evidence_within, told
from torchsoro.sim2real.inference.observed import Data, Motions, independent, size_of
from torchsoro.sim2real.inference.state_space import total

NOTHING, UNSEEN, UNKNOWN = "nothing", "unseen", "unknown"
SEEN = MISSING * 2 * float(t.sf(1 / STRENGTH, FREEDOM))  # prior probability that something is missing that is seen
LN_SEEN, LN_NOT_SEEN = math.log(SEEN), math.log(1 - SEEN)
SAME = 3.0  # standard deviations apart, below which two ends of searches are one mode
CLOSE = 0.2  # of a tolerance, of a noticeable change, or of a tenth of the body, below which they are, too


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidate:
    """One name, by all modes that were found of it.

    Attributes:
        modes: Distinct ones, adjusted, see :attr:`Weighing.modes`.
        size: Root mean square of the change of the motion by it, from what is believed, within tolerances [m].
        left: What it leaves of the recordings, see :func:`remainder` [m].
        ln_evidence: Summed over modes, adjusted.
        probability: Posterior.
        credible: Whether its stated numbers are within their tolerances, or little beyond.
    """

    modes: tuple[Posterior, ...]
    size: float
    left: float
    ln_evidence: float
    probability: float
    credible: bool

    @property
    def name(self) -> str:
        """Of its effects."""
        return self.modes[0].near.model.name

    @property
    def best(self) -> Posterior:
        """The first of its modes."""
        return self.modes[0]


@dataclass(frozen=True, kw_only=True, eq=False)
class Weighing:
    """Posterior probabilities of names.

    Attributes:
        data: Recordings.
        nothing: Modes of the model without an effect.
        effects: Modes of all others.
        names: Number of single effects that can be named.
        rough: Whether looks at one mode differ by chance in touching. Where they do not, they differ as a linear model
            does from a simulation, and the most probable one counts.
    """

    data: Data
    nothing: tuple[Posterior, ...]
    effects: tuple[Posterior, ...]
    names: int
    rough: bool = True

    @cached_property
    def _looks_at_nothing(self) -> list[list[Posterior]]:
        return _alike(self.nothing)

    @cached_property
    def _looks_at_effects(self) -> list[list[Posterior]]:
        return _alike(self.effects)

    @cached_property
    def nulls(self) -> tuple[Posterior, ...]:
        """Distinct modes of the model without an effect, most probable first."""
        return tuple(sorted(map(self._one_of, self._looks_at_nothing), key=lambda p: -p.ln_evidence))

    @property
    def null(self) -> Posterior:
        """The most probable of them."""
        return self.nulls[0]

    def _one_of(self, same: Sequence[Posterior]) -> Posterior:
        """The look that counts of those at one mode, which are sorted."""
        return _middle(same) if self.rough else same[0]

    @property
    def valleys(self) -> tuple[Posterior, ...]:
        """The same modes, each by the look at which it is most probable."""
        return tuple(same[0] for same in self._looks_at_nothing)

    def latest(self, found: Posterior) -> Posterior:
        """The last look at a mode."""
        return [p for p in (*self.nothing, *self.effects) if _same(p, found)][-1]

    @cached_property
    def scatter(self) -> float:
        """Standard deviation of ln evidence where a mode was linearised more than once, a little beside itself.

        Of rough motions that says how much of it hangs on which node touches when.
        """
        if not self.rough:
            return 0.0
        again = [[p.ln_evidence for p in same] for same in (*self._looks_at_nothing, *self._looks_at_effects)]
        free = sum(len(same) - 1 for same in again)
        return math.sqrt(sum(len(same) * float(np.var(same)) for same in again) / free) if free else 0.0

    def change(self, found: Posterior) -> Motions:
        """Of the motion, by an effect: from what is believed, within its tolerances."""
        return tuple(a - b for a, b in zip(self.believed, found.left, strict=True))

    @cached_property
    def bounded(self) -> Posterior:
        """The model without an effect, its beliefs within their tolerances, by the mode that is least beyond them."""

        def beyond(p: Posterior) -> float:
            return max(1.0, float(np.abs(p.near.at[: p.near.model.beliefs]).max(initial=0.0)))

        return within(min(sorted(self.nothing, key=lambda p: -p.ln_evidence), key=beyond))

    @cached_property
    def believed(self) -> Motions:
        """Residuals of the same [T, M, A] m."""
        near = self.bounded.near
        return near.left(mode_of(self.data, near, self.bounded.discrepancy).at)

    @cached_property
    def by_error(self) -> float:
        """Mean adjustment over the changes by all names, by the errors of the most probable model."""
        changes = [self.change(modes[0]) for modes in self.groups.values()]
        columns = tuple(np.stack(same, -1) for same in zip(*changes, strict=True))
        return adjustment(self.data, self.best, columns) if changes else 1.0

    @property
    def scattered(self) -> bool:
        """Whether ln evidence scatters by more than the twin's error leaves uncertain of it."""
        return bool(self.groups) and self.scatter > self.by_error

    @property
    def kappa(self) -> float:
        """Likelihoods are taken to the power of its inverse; differences are no more certain than evidence scatters."""
        return self.scatter if self.scattered else self.by_error

    @cached_property
    def modes(self) -> tuple[Posterior, ...]:
        """Distinct modes of all names: the most probable first, or what leaves the least where none is right."""
        distinct = [self._one_of(looks) for looks in self._looks_at_effects]
        if self.best.matters:
            return tuple(sorted(distinct, key=lambda p: remainder(self.data, p)))
        return tuple(sorted(distinct, key=lambda p: -p.ln_evidence))

    @property
    def leading(self) -> Posterior:
        """The first of the modes with an effect where none is right, else the most probable of all."""
        return self.modes[0] if self.best.matters and self.modes else self.best

    def within_reach(self, found: Sequence[Posterior], behind: float) -> list[Posterior]:
        """Of modes, those that another look may make what is told: no farther behind, in ln of evidence or of size."""
        if not self.best.matters or not self.modes:
            return [p for p in found if p.ln_evidence > self.best.ln_evidence - behind]
        count = independent(self.modes[0].left)
        size = {id(p): math.hypot(remainder(self.data, p), self.data.noise) for p in (*found, self.modes[0])}
        least = size[id(self.modes[0])]
        return [p for p in found if count * math.log(size[id(p)] / least) < behind]

    @cached_property
    def groups(self) -> dict[str, tuple[Posterior, ...]]:
        """The same of each name, in the order of their first ones."""
        found: dict[str, list[Posterior]] = {}
        for p in self.modes:
            found.setdefault(p.near.model.name, []).append(p)
        return {name: tuple(modes) for name, modes in found.items()}

    @cached_property
    def _beliefs(self) -> dict[str, np.ndarray]:
        """Stated numbers that are told with the first mode of each name, in tolerances."""
        modes = {name: first for name, (first, *_) in self.groups.items()}
        return {name: told(self.data, p).at[: p.near.model.beliefs] for name, p in modes.items()}

    def _strain(self, name: str) -> float:
        """Ln of the prior density of these over that at most."""
        at = self._beliefs[name]
        return ln_strained(self.groups[name][0].near.model, at, range(len(at)))

    @cached_property
    def another(self) -> str | None:
        """Name of the stated number that is another one where nothing is missing: off by more than is credible."""
        at = told(self.data, self.null).at[: self.null.near.model.beliefs]
        off = np.abs(at) if len(at) else np.zeros(1)
        return self.null.near.model.stated[int(off.argmax())] if off.max() > BELIEVED else None

    @cached_property
    def best(self) -> Posterior:
        """The most probable of all."""
        return max((*map(self._one_of, self._looks_at_effects), self.null), key=lambda p: p.ln_evidence)

    @cached_property
    def unexplained(self) -> float:
        """What the model without an effect leaves, its beliefs within their tolerances, see :func:`remainder` [m]."""
        return remainder(self.data, self.bounded)

    def _ln_prior(self, model: Model) -> float:
        """Of a name whose effect is seen; a model without effects stands for what has none."""
        pair = math.log(self.names) if len(model.effects) > 1 else 0.0
        return LN_SEEN - math.log(self.names + 1) - pair

    def _bounded(
        self,
        probabilities: dict[str, float],
        by_evidence: dict[str, float],
        ln_prior: dict[str, float],
        left: dict[str, float],
    ) -> dict[str, float]:
        """Probabilities of names that add up to as much, no farther apart than the twin's error allows.

        Args:
            probabilities: By evidence, or by size.
            by_evidence: Their logarithms by evidence, up to a constant.
            ln_prior: Of names.
            left: What they leave [m].
        """
        first = max(probabilities, key=lambda name: probabilities[name])
        best = self.groups[first][0]
        priced = best.near.numerics.size
        error = min(remainder(self.data, best, priced=False), priced)
        if not probabilities[first] or not error:
            return probabilities
        ln_p = {name: math.log(max(p, 1e-300)) for name, p in probabilities.items()}
        count = best.near.numerics.count

        @cache
        def ln_within(name: str, size: float) -> float:
            return ln_prior[name] + ln_evidence_within(self.data, self.groups[name][0].near, size, count)

        for name, (mode, *_) in self.groups.items():
            # What moves the body by no more than the twin may err, or leaves more, is no name for the difference.
            if size_of(self.change(mode)) > priced and left[name] <= mode.near.numerics.size:
                most = max(self._strain(name) - self._strain(first), 0.0)
                # What an extension leaves tells nothing of an error along the number that it has more.
                along = priced if name in best.near.model.simpler else error
                ln_odds = ln_within(name, along) - ln_within(first, along)
                ln_p[name] = max(ln_p[name], ln_p[first] + min(ln_odds, most))
                if (gain := by_evidence[name] - by_evidence[first]) > 0:
                    ln_p[name] = max(ln_p[name], ln_p[first] + math.log(-math.expm1(-gain)))
        whole = sum(probabilities.values())
        return {name: whole * p for name, p in normalised(ln_p).items()}

    def beside_nothing(self, probabilities: dict[str, float], small: dict[str, float]) -> dict[str, float]:
        """Probabilities in which that of nothing is shared with names that move the body by less than the twin may err.

        By the likelihood that tells two names apart no better than the twin can, nothing is one more.

        Args:
            probabilities: Of what is told, those of the small ones counted as nothing.
            small: Of each of these, by evidence.
        """
        numerics, none = self.null.near.numerics, probabilities[NOTHING] - sum(small.values())
        if not small or not numerics.size:
            return probabilities
        count = numerics.count
        ln_nothing = LN_NOT_SEEN + ln_evidence_within(self.data, self.null.near, numerics.size, count)
        ln_odds = {NOTHING: 0.0}
        for name, share in small.items():
            near = self.groups[name][0].near
            by_size = self._ln_prior(near.model) + ln_evidence_within(self.data, near, numerics.size, count)
            by_evidence = math.log(max(share, 1e-300)) - math.log(max(none, 1e-300))
            ln_odds[name] = min(by_evidence, by_size - ln_nothing)
        found = probabilities | {NOTHING: 0.0}
        for name, p in normalised(ln_odds).items():
            found[name] = found.get(name, 0.0) + probabilities[NOTHING] * p
        return found

    def candidates(self) -> tuple[dict[str, float], list[Candidate]]:
        """Posterior probabilities of all names, and what has an effect, most probable first."""
        kappa = self.kappa
        nulls = [adjusted(self.data, p, kappa) for p in self.nulls]
        groups = {name: [adjusted(self.data, p, kappa) for p in modes] for name, modes in self.groups.items()}
        ln_prior = {name: self._ln_prior(modes[0].near.model) for name, modes in groups.items()}
        ln_p = {name: ln_prior[name] + _summed(modes) for name, modes in groups.items()}
        # Without a discrepancy that matters nothing is missing, with one something is that has no name.
        ln_p[NOTHING] = LN_NOT_SEEN + float(np.logaddexp.reduce([p.none.ln_evidence for p in nulls]))
        ln_p[UNKNOWN] = self._ln_prior(self.null.near.model) + float(
            np.logaddexp.reduce([p.some.ln_evidence for p in nulls])
        )
        probabilities = normalised(ln_p)
        left = {name: remainder(self.data, modes[0]) for name, modes in groups.items()}
        if self.best.matters:
            # Whether something is missing is told by evidence, what it is by the size of what is left.
            missing = 1 - probabilities[NOTHING]
            least = min(groups, key=lambda name: left[name]) if groups else None
            count = independent(self.null.left if least is None else self.groups[least][0].left)
            seen = math.hypot(self.unexplained, self.data.noise)
            rest = {UNKNOWN: self._ln_prior(self.null.near.model) - count * math.log(seen)}
            for name, modes in groups.items():
                own = len(modes[0].near.model.own)
                size = math.hypot(left[name], self.data.noise)
                rest[name] = ln_prior[name] - count * math.log(size) - 0.5 * own * math.log(count) + self._strain(name)
            # Those of one effect first, as pairs extend these.
            for name, (mode, *_) in sorted(groups.items(), key=lambda g: len(g[1][0].near.model.effects)):
                for plain in set(mode.near.model.simpler) & set(rest):
                    rest[name] = min(rest[name], rest[plain] + ln_p[name] - ln_p[plain])
            probabilities |= {name: missing * p for name, p in normalised(rest).items()}
        if groups:
            probabilities |= self._bounded({name: probabilities[name] for name in groups}, ln_p, ln_prior, left)
        if self.another in groups:
            probabilities[self.another] += probabilities[NOTHING]
            probabilities[NOTHING] = 0.0
        found = [
            Candidate(
                modes=tuple(modes),
                size=size_of(self.change(self.groups[name][0])),
                left=left[name],
                ln_evidence=_summed(modes),
                probability=probabilities[name],
                credible=bool((np.abs(self._beliefs[name]) <= BELIEVED).all()),
            )
            for name, modes in groups.items()
        ]
        return probabilities, sorted(found, key=lambda c: -c.probability)


def adjustment(data: Data, found: Posterior, changes: Motions) -> float:
    """Kappa, on average over changes of the motion.

    Args:
        data: Recordings.
        found: Whose errors count.
        changes: Of each trial [T, M, A, E] m.
    """
    numerics, n = found.near.numerics, changes[0].shape[-1]
    if not numerics.draws or not n:
        return 1.0
    gained = []
    for k, draw in enumerate(numerics.draws):
        # A sample that was lost tells nothing of a change either.
        columns = [
            np.concatenate([np.where(np.isfinite(d)[..., None], c, np.nan), d[..., None]], -1)
            for c, d in zip(changes, draw, strict=True)
        ]
        # What a draw is worth to an effect is seen where it is none of the errors that are known.
        product = total(products(data, numerics.without(k), found.discrepancy, columns)).product
        gained.append(product[:n, n] ** 2 / np.maximum(np.diag(product)[:n], 1e-300))
    kinds = np.array(numerics.kinds or (0,) * len(gained))
    return 1.0 + float(sum(np.mean(np.array(gained)[kinds == kind]) for kind in np.unique(kinds)))


def normalised(ln_p: dict[str, float]) -> dict[str, float]:
    """Probabilities in proportion, that add up to one."""
    most = max(ln_p.values())
    whole = sum(math.exp(value - most) for value in ln_p.values())
    return {name: math.exp(value - most) / whole for name, value in ln_p.items()}


def _summed(modes: Sequence[Posterior]) -> float:
    """Ln evidence of all modes."""
    return float(np.logaddexp.reduce([p.ln_evidence for p in modes]))


def _alike(found: Sequence[Posterior]) -> list[list[Posterior]]:
    """Those of each mode, most probable first."""
    modes: list[list[Posterior]] = []
    for p in sorted(found, key=lambda p: -p.ln_evidence):
        mine = [same for same in modes if _same(p, same[0])]
        if mine:
            mine[0].append(p)
        else:
            modes.append([p])
    return modes


def _middle(same: Sequence[Posterior]) -> Posterior:
    """Of those of one mode the one in the middle, the less probable of two."""
    return sorted(same, key=lambda p: p.ln_evidence)[(len(same) - 1) // 2]


def _same(one: Posterior, other: Posterior) -> bool:
    """Whether two modes are one: of one name and form, near in beliefs and in the numbers of effects.

    They are near by the narrower of them, or by what is noticeable: that of rough motions is too narrow.
    """
    model, another = one.near.model, other.near.model
    if (model.name, model.forms) != (another.name, another.forms):
        return False
    own = model.simulated
    off = (one.mode.at - other.mode.at)[own]
    spread = np.sqrt(np.minimum(np.diag(one.mode.covariance)[own], np.diag(other.mode.covariance)[own]))
    return bool((np.abs(off) < np.maximum(SAME * spread, CLOSE)).all())


def apart(one: Posterior, other: Posterior) -> float:
    """Root mean square distance of two predictions [m]."""
    return size_of(tuple(a - b for a, b in zip(one.left, other.left, strict=True)))


def remainder(data: Data, found: Posterior, *, priced: bool = True) -> float:
    """Root mean square of the least that a model leaves, beyond noise and what there is of the twin's own error [m].

    Args:
        data: Recordings.
        found: The model.
        priced: Whether what there is of the twin's own error is taken off.
    """
    near = found.near
    known = data.noise**2
    if priced:
        known += float(((found.discrepancy.twin * near.numerics.amplitude) ** 2).mean())
    return math.sqrt(max(size_of(near.left(closest(data, near).at)) ** 2 - known, 0.0))


def within(null: Posterior) -> Posterior:
    """The model without an effect whose beliefs cannot leave their tolerances; its modes are those of before."""
    model = null.near.model
    bounded = [dataclasses.replace(p, low=-1.0, high=1.0) for p in model.priors[: model.beliefs]]
    model = dataclasses.replace(model, priors=(*bounded, *model.priors[model.beliefs :]))
    return dataclasses.replace(null, near=dataclasses.replace(null.near, model=model))
