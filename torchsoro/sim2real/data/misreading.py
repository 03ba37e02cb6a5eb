"""How the columns of a recording may have been misread, told from where its markers are at release.

The setup states where markers are in the undeformed body. Each way to read the columns (axes in another order or
mirrored, another unit, another origin, names of markers exchanged, displacements for places) says where the recording
begins. They are compared by their posterior probabilities: deviations from a stated place are Student-t, a shift of the
origin is uniform in a wide box, and a mistake of a kind has a small prior probability that its variants share.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchsoro.sim2real.data.recording import AXES

# Recorded over stated lengths, and what is wrong then.
UNITS = {
    1e3: "lengths in millimetres",
    1e2: "lengths in centimetres",
    1 / 0.0254: "lengths in inches",
    1e-3: "lengths in metres, and those of setup.toml in millimetres",
}
MISTAKE = 1 / 20  # prior probability of a mistake of each kind: one in twenty recordings
SURE = 1000.0  # odds, above which a way to read is taken for the right one
AS_GOOD = 20.0  # odds of the best, below which another is told along with it
FREEDOM = 4.0  # degrees of freedom of the deviation from a stated place, which thus may be ten tolerances
ROOM = 10.0  # longest edges of the body, by which an origin may be shifted
FITS = 3.0  # tolerances (root mean square), within which a way to read fits


@dataclass(frozen=True, kw_only=True, eq=False)
class Reading:
    """A way to read the columns of M markers along A recorded axes.

    Attributes:
        recorded: Axes that the columns are named after, 0 to 2.
        axes: That they hold.
        signs: Of them: -1 where mirrored; all 0 for displacements in place of places.
        factor: Recorded over stated lengths.
        shift: From the stated origin to that of the recording [A] m; none where it is the stated one.
        opposite: Whether a mirrored axis is counted from the opposite face of the body.
        order: Which stated marker each column holds [M].
        away: Root mean square distance from the stated places along the axes [m].
        ln_odds: Natural logarithm of the odds to the recording as it stands.
    """

    recorded: tuple[int, ...]
    axes: tuple[int, ...]
    signs: tuple[int, ...]
    factor: float
    shift: np.ndarray | None
    opposite: bool
    order: np.ndarray
    away: float
    ln_odds: float

    @property
    def names_only(self) -> bool:
        """Whether nothing but names of markers is exchanged."""
        return self._plain and self.shift is None

    @property
    def origin_only(self) -> bool:
        """Whether nothing but the origin is another."""
        return self._plain and not self._moved

    @property
    def _plain(self) -> bool:
        return self.axes == self.recorded and set(self.signs) == {1} and self.factor == 1

    @property
    def _moved(self) -> list[int]:
        return [int(k) for k in np.flatnonzero(self.order != np.arange(len(self.order)))]

    def says(self, names: Sequence[str]) -> str:
        """What is wrong, in words.

        Args:
            names: Of the markers.
        """
        found = []
        if not any(self.signs):
            found.append("columns hold displacements, not places")
        elif not (self.axes == self.recorded and set(self.signs) == {1}):
            found.append(directions(self.recorded, self.axes, self.signs, opposite=self.opposite))
        if self.factor != 1:
            found.append(UNITS[self.factor])
        if self.shift is not None:
            found.append(f"origin shifted by ({', '.join(f'{1e3 * s:.1f}' for s in self.shift)}) mm")
        if self._moved:
            found.append(f"columns of {_and([names[k] for k in self._moved])} exchanged")
        return " and ".join(found)


def directions(recorded: Sequence[int], axes: Sequence[int], signs: Sequence[int], *, opposite: bool = False) -> str:
    """What columns of recorded axes hold instead, in words.

    Args:
        recorded: Axes that the columns are named after, 0 to 2.
        axes: That they hold.
        signs: Of them.
        opposite: Whether a mirrored axis is counted from the opposite face of the body.
    """
    mirrored = [AXES[a] for a, s in zip(axes, signs, strict=True) if s < 0]
    where = " and counted from the opposite face of the body" if opposite else ""
    if list(axes) == list(recorded):
        return f"{_and(mirrored)} mirrored{where}"
    other = [AXES[a] for a, b in zip(axes, recorded, strict=True) if a != b]
    if not mirrored and len(other) == 2 and sorted(axes) == sorted(recorded):
        return f"{_and(sorted(other))} swapped"
    held = [("-" if s < 0 else "") + AXES[a] for a, s in zip(axes, signs, strict=True)]
    return f"columns {', '.join(AXES[a] for a in recorded)} hold {', '.join(held)}{where}"


def _and(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def misreadings(
    first: np.ndarray,
    stated: np.ndarray,
    *,
    velocity: np.ndarray,
    clock: float,
    axes: Sequence[int],
    box: tuple[np.ndarray, np.ndarray],
    tolerance: float,
) -> tuple[float, list[Reading]]:
    """Ways to read a recording that fit where its markers begin, where the recording as it stands does not.

    Args:
        first: Places at release [M, A] m; not a number where a marker was not seen.
        stated: Where they are by the setup when they are first seen [M, 3] m.
        velocity: Of each marker, as stated [M, 3] m/s.
        clock: Standard deviation of the offset of the recording's clock [s].
        axes: Recorded axes [A].
        box: Lower and upper corner of the undeformed body [m].
        tolerance: Standard deviation of a coordinate about the stated one, where nothing was misread [m].

    Returns:
        Root mean square distance from the stated places as it stands [m], and the readings: the best, and those that
        are about as probable; none if the recording fits as it stands, or nothing else does.
    """
    seen = np.flatnonzero(np.isfinite(first).all(1))
    if not len(seen):
        return 0.0, []
    there, known = first[seen], stated[seen]
    plain = _Option(axes=tuple(axes), signs=(1,) * len(axes), factor=1.0, shift="none", ordered=True)
    judge = _Judge(
        there=there,
        known=known,
        velocity=velocity[seen],
        clock=clock,
        axes=tuple(axes),
        box=np.array(box),
        tolerance=tolerance,
    )
    asis, level = judge.reading(plain)
    if asis.away <= FITS * tolerance:
        return asis.away, []
    found = []
    for option in judge.options():
        reading, ln_probability = judge.reading(option)
        if reading.away <= FITS * tolerance and ln_probability - level > math.log(SURE):
            whole = np.arange(len(first))
            whole[seen] = seen[reading.order]
            found.append(replace(reading, order=whole, ln_odds=ln_probability - level))
    found.sort(key=lambda r: -r.ln_odds)
    return asis.away, [r for r in found if found[0].ln_odds - r.ln_odds < math.log(AS_GOOD)]


@dataclass(frozen=True, kw_only=True)
class _Option:
    """Axes, signs and factor as of a reading; the origin: "none", "opposite" or "free"; names as they are or not."""

    axes: tuple[int, ...]
    signs: tuple[int, ...]
    factor: float
    shift: str
    ordered: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class _Judge:
    """Places at release [M, A], and places [M, 3] and velocities as stated, and how probable an option is by them."""

    there: np.ndarray
    known: np.ndarray
    velocity: np.ndarray
    clock: float
    axes: tuple[int, ...]
    box: np.ndarray
    tolerance: float

    @property
    def reach(self) -> float:
        """Longest edge of the body [m]."""
        return float(np.ptp(self.box, axis=0).max())

    def options(self) -> list[_Option]:
        """All ways to read but the one as it stands."""
        count = len(self.axes)
        frames = [
            (axes, signs)
            for axes in itertools.permutations(range(3), count)
            for signs in itertools.product((1, -1), repeat=count)
        ]
        orders = (True, False) if len(self.there) > 1 else (True,)
        found = []
        for (axes, signs), factor, ordered in itertools.product(frames, (1.0, *UNITS), orders):
            shifts = ("none", "opposite", "free") if min(signs) < 0 else ("none", "free")
            found += [
                _Option(axes=axes, signs=signs, factor=factor, shift=shift, ordered=ordered)
                for shift in shifts
                if (axes, signs, factor, shift, ordered) != (self.axes, (1,) * count, 1.0, "none", True)
            ]
        still = [_Option(axes=self.axes, signs=(0,) * count, factor=f, shift="none", ordered=True) for f in (1.0, 1e3)]
        return found + (still if len(self.there) > 1 else [])

    def reading(self, option: _Option) -> tuple[Reading, float]:
        """The reading of an option, and the natural logarithm of its probability."""
        axes, signs = list(option.axes), np.array(option.signs)
        there, known = self.there / option.factor, self.known[:, axes] * signs
        if option.shift == "opposite":
            known = known + np.where(signs < 0, self.box.sum(0)[axes], 0.0)
        shift = None
        if option.shift == "free":
            shift = there.mean(0) - known.mean(0)
            known = known + shift
        order = np.arange(len(there))
        if not option.ordered:
            _, order = linear_sum_assignment(((there[:, None] - known) ** 2).sum(-1))
        gap, velocity = there - known[order], (self.velocity[:, axes] * signs)[order]
        # One offset of the clock moves all markers along their velocities: the most probable one, and what it costs.
        weight = (self.tolerance / self.clock) ** 2
        offset = float((gap * velocity).sum() / ((velocity**2).sum() + weight))
        apart = float(((gap - offset * velocity) ** 2).sum())
        off = apart + weight * offset**2
        if shift is not None and np.abs(shift).max() > ROOM * self.reach:
            off = math.inf
        n, nu = there.size, FREEDOM
        ln = -(nu + n) / 2 * math.log1p(off / (nu * self.tolerance**2)) - n * math.log(option.factor)
        reading = Reading(
            recorded=self.axes,
            axes=option.axes,
            signs=option.signs,
            factor=option.factor,
            shift=shift,
            opposite=option.shift == "opposite",
            order=order,
            away=math.sqrt(apart / n),
            ln_odds=0.0,
        )
        return reading, ln + self._prior(option, order)

    def _prior(self, option: _Option, order: np.ndarray) -> float:
        mistake, count, found = math.log(MISTAKE), len(self.axes), 0.0
        if option.axes != self.axes or set(option.signs) != {1}:
            found += mistake - math.log(math.perm(3, count) * 2**count)
        if option.factor != 1:
            found += mistake - math.log(len(UNITS))
        if option.shift == "opposite":
            found += math.log(0.5)
        if option.shift == "free":
            found += mistake - count * math.log(2 * ROOM * self.reach / self.tolerance)
        if moved := int((order != np.arange(len(order))).sum()):
            m = len(order)
            found += mistake - (math.log(m * (m - 1) / 2) if moved == 2 else math.lgamma(m + 1))
        return found
