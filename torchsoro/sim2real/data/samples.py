"""Samples of a recording that no body can have made: jumps, exchanged markers, rows and values that repeat."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.optimize import linear_sum_assignment

from torchsoro.sim2real.data.recording import Recording

JUMP = 4.0  # times the speed before and after: what moves on as if nothing had happened has not moved so fast between
BESIDE = 4  # samples before and after, that tell the speed there
ALIKE = 0.25  # of a jump, that is left once markers are exchanged
REPEATS = 0.05  # of the rows in which a body moves: cameras and trackers repeat single rows, if any
STEPS = 4.0  # least steps of a value, that a body has to move over three rows for a repeated row to be strange
FINE = 100.0  # least steps of a value, that another marker has to move meanwhile
STILL = 10  # rows of one value, at least, for a marker that is not followed any more


@dataclass(frozen=True, kw_only=True)
class Exchange:
    """Markers whose columns are exchanged from a sample on.

    Attributes:
        start: Number of the first sample.
        order: Which of the former markers each column now holds.
    """

    start: int
    order: tuple[int, ...]


def spikes(recording: Recording) -> np.ndarray:
    """Samples off the path for one row: far from those before and after, which are near to each other.

    Returns:
        bool [T, M].
    """
    count, markers, _ = recording.position.shape
    found = np.zeros((count, markers), bool)
    for m in range(markers):
        rows, step, skip, beside, _ = _steps(recording, m)
        if len(rows) < 3 + BESIDE:
            continue
        least = JUMP * np.maximum(beside, skip / 2)
        found[rows[1:-1], m] = np.minimum(step[:-1], step[1:]) > least
    return found


def exchanges(recording: Recording) -> list[Exchange]:
    """Where several markers jump between two rows, each to where another would have gone on."""
    jumps: dict[int, list[int]] = {}
    for m in range(recording.position.shape[1]):
        rows, step, _, _, aside = _steps(recording, m)
        if len(rows) >= 3 + BESIDE:
            for k in np.flatnonzero(step > JUMP * aside):
                jumps.setdefault(int(rows[k + 1]), []).append(m)
    found = []
    for row, markers in sorted(jumps.items()):
        before = np.stack([recording.position[_last_seen(recording, m, row), m] for m in markers])
        off = np.linalg.norm(recording.position[row, markers][:, None] - before, axis=-1)
        _, order = linear_sum_assignment(off**2)
        if (order == np.arange(len(order))).any():
            continue
        if off[np.arange(len(order)), order].max() < ALIKE * off.diagonal().min():
            whole = np.arange(recording.position.shape[1])
            whole[markers] = np.array(markers)[order]
            found.append(Exchange(start=row, order=tuple(whole.tolist())))
    return found


def put_back(recording: Recording, found: list[Exchange]) -> Recording:
    """A recording whose exchanged markers are back in their own columns."""
    position = recording.position.copy()
    holds = np.arange(position.shape[1])  # which marker each column has
    ends = [*(e.start for e in found[1:]), len(position)]
    for exchange, end in zip(found, ends, strict=True):
        holds = holds[list(exchange.order)]
        position[exchange.start : end, holds] = recording.position[exchange.start : end]
    return dataclasses.replace(recording, position=position)


def repeated(recording: Recording) -> tuple[int, int]:
    """Rows that repeat the one before while the body moves, and all rows in which it does."""
    place = recording.position.reshape(len(recording.time), -1)
    change = np.abs(np.diff(place, axis=0))
    seen = np.isfinite(change)
    quantum = float(np.min(change, initial=np.inf, where=seen & (change > 0)))
    if not np.isfinite(quantum):
        return 0, 0
    same = ((change == 0) | ~seen).all(1) & (change == 0).any(1)
    wide = np.abs(place[2:] - place[:-2])
    moving = np.max(wide, axis=1, initial=0.0, where=np.isfinite(wide)) > STEPS * quantum
    return int((same[:-1] & moving).sum()), int(moving.sum())


def stuck(recording: Recording) -> dict[int, tuple[float, float]]:
    """Markers that keep one value to the last digit while others move: from when to when [s]."""
    place, found = recording.position, {}
    change = np.abs(np.diff(place, axis=0))
    quantum = float(np.min(change, initial=np.inf, where=change > 0))
    still = (change == 0).all(-1)
    for m in range(place.shape[1]):
        first, last = _longest(still[:, m])
        if last - first < max(STILL, len(place) // 10):
            continue
        # Of values as coarse as the motion itself, those of a marker that hardly moves may well stay.
        part = np.delete(place[first : last + 1], m, 1)
        seen = np.isfinite(part)
        moved = np.max(part, axis=0, initial=-np.inf, where=seen) - np.min(part, axis=0, initial=np.inf, where=seen)
        if np.max(moved, initial=0.0) > FINE * quantum:
            found[m] = float(recording.time[first]), float(recording.time[last])
    return found


def _longest(mask: np.ndarray) -> tuple[int, int]:
    """Where the longest run of a mask begins and ends."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    if not len(edges):
        return 0, 0
    lengths = edges[1::2] - edges[::2]
    k = int(lengths.argmax())
    return int(edges[2 * k]), int(edges[2 * k + 1])


def _last_seen(recording: Recording, marker: int, row: int) -> int:
    return int(np.flatnonzero(recording.seen[:row, marker].all(-1))[-1])


def _steps(recording: Recording, marker: int) -> tuple[np.ndarray, ...]:
    """Steps of a marker between the N rows in which it is seen.

    Returns:
        Numbers of the rows [N], steps between them [N - 1], steps that skip one [N - 2], and the largest step beside
        each inner row [N - 2] and beside each step [N - 1], of which those at the row, or the step itself, are no part.
    """
    rows = np.flatnonzero(recording.seen[:, marker].all(-1))
    place = recording.position[rows, marker]
    step = np.linalg.norm(np.diff(place, axis=0), axis=-1)
    skip = np.linalg.norm(place[2:] - place[:-2], axis=-1)
    if len(rows) < 3 + BESIDE:
        return rows, step, skip, np.zeros(0), np.zeros(0)
    # Values have steps of their own, which bodies at rest show.
    floor = float(np.median(step[step > 0])) if (step > 0).any() else np.inf
    padded = np.concatenate([np.zeros(BESIDE), step, np.zeros(BESIDE)])
    before = sliding_window_view(padded, BESIDE).max(1)  # of the steps k - BESIDE to k - 1
    at = np.arange(len(step))
    beside = np.maximum(np.maximum(before[at[:-1]], before[at[1:] + BESIDE + 1]), floor)
    aside = np.maximum(np.maximum(before[at], before[at + BESIDE + 1]), floor)
    return rows, step, skip, beside, aside
