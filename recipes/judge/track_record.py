"""How often names that were most probable were wrong in sealed batches, by what they left.

    python recipes/judge/track_record.py BATCH=ANSWERS BATCH=ANSWERS --told BATCH=ANSWERS

Prints the two numbers that ``torchsoro/sim2real/inference/decision.py`` has from there, by which probabilities are
calibrated, and the calibration of other batches with and without them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import tyro
from answers import calibration_error, check, match, truths
from scipy.optimize import minimize

Row = tuple[float, bool, float | None]
"""Probability of the most probable, whether it is the truth, and what it leaves, if it is a name."""


def rows(pair: str) -> list[Row]:
    """Of all answers to a batch, given as BATCH=ANSWERS."""
    batch, answers = map(Path, pair.split("="))
    found = []
    for truth in check(batch)["cases"]:
        path = answers / truth["case"] / "explanation.json"
        case = match(truth, answers, batch, {})
        if not path.exists() or not case.likely:
            continue
        answer = json.loads(path.read_text())
        own = next((r for r in answer["ranking"] if r["name"] == case.likely), None)
        noise, error = answer["noise"]["standard_deviation_m"], answer["noise"]["simulation_m"]
        left = None if own is None else own["unexplained_m"] / math.hypot(noise, error, own["change_m"] / 10)
        found.append((case.probability, case.likely in truths(case), left))
    return found


def doubt(left: float, odds: float, steepness: float) -> float:
    """Probability that a name is wrong that leaves so much, up to a half."""
    now = odds * math.exp(steepness * left)
    return min(now / (1 + now), 0.5)


def fitted(known: Sequence[Row]) -> tuple[float, float]:
    """Odds that a name is wrong that leaves nothing, and growth of their logarithm, of greatest likelihood."""
    names = [(p, right, left) for p, right, left in known if left is not None]

    def lost(x: np.ndarray) -> float:
        told = [(p * (1 - doubt(left, math.exp(x[0]), x[1])), right) for p, right, left in names]
        return -sum(math.log(max(q if right else 1 - q, 1e-9)) for q, right in told)

    ln_odds, steepness = minimize(lost, [-2.0, 2.0], method="Nelder-Mead", options={"maxiter": 2000}).x
    return math.exp(ln_odds), float(steepness)


def calibration(known: Sequence[Row]) -> str:
    """Expected calibration error by fifths, squared error, and names told with 0.8 or more."""
    error = calibration_error([(p, right) for p, right, _ in known])
    squared = sum((p - right) ** 2 for p, right, _ in known) / len(known)
    sure = [(p, right) for p, right, left in known if left is not None and p >= 0.8]
    names = (
        f"{sum(r for _, r in sure)} of {len(sure)} right, told {np.mean([p for p, _ in sure]):.2f}" if sure else "none"
    )
    return f"expected calibration error {error:.3f}, squared error {squared:.3f}; names of 0.8 to 1: {names}"


def main(batches: tuple[str, ...], /, *, told: tuple[str, ...] = ()) -> tuple[float, float]:
    """Print the numbers.

    Args:
        batches: BATCH=ANSWERS, from which they are.
        told: BATCH=ANSWERS, answered without them, on which they are tried.

    Returns:
        The two numbers.
    """
    known = [row for pair in batches for row in rows(pair)]
    numbers = fitted(known)
    names = sum(left is not None for *_, left in known)
    print(f"{names} names: odds of {numbers[0]:.2f} to be wrong, times exp({numbers[1]:.1f} x) where x is left")
    for pair in told:
        before = rows(pair)
        after = [(p if x is None else p * (1 - doubt(x, *numbers)), right, x) for p, right, x in before]
        print(f"{pair}, as told: {calibration(before)}\n{' ' * len(pair)}  with doubt: {calibration(after)}")
    return numbers


if __name__ == "__main__":
    tyro.cli(main)
