"""How much of an effect the ordinary errors of a recording could not imitate."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from lobatto import Floats
from march import turned
from specimens import Specimen


def detectability(
    specimen: Specimen,
    times: Sequence[Floats],
    change: Sequence[Floats],
    plain: Sequence[Floats],
    unsure: Sequence[Sequence[Floats]],
    noise: float,
) -> float:
    """Root mean square of an effect over the noise, after the best imitation by measurement errors and modulus.

    Imitated by: clock of each trial, scale, frame, place of each marker, modulus and pressure, with their usual sizes
    as priors.

    Args:
        specimen: The body, for its axes.
        times: Instants of each trial [T] s.
        change: What the effect changes in each trial [T, markers, 3] m.
        plain: Motion without it [T, markers, 3] m.
        unsure: Changes by one usual error of each believed number that may be off [numbers][trials][T, markers, 3] m.
        noise: Standard deviation [m].
    """
    axes = ["xyz".index(a) for a in specimen.setup["recording"].get("axes", "xyz")]
    count = plain[0].shape[1]
    columns: list[Floats] = []

    def add(sizes: Sequence[Floats], prior: float) -> None:
        columns.append(prior * np.concatenate([s[..., axes].ravel() for s in sizes]))

    speed = [np.gradient(x, t, axis=0) for x, t in zip(plain, times, strict=True)]
    nothing = [np.zeros_like(x) for x in plain]
    for i in range(len(plain)):
        add([s if j == i else n for j, (s, n) in enumerate(zip(speed, nothing, strict=True))], 5e-3)
    add(plain, 0.01)
    for a in range(3):
        axis = np.zeros(3)
        axis[a] = 1e-6
        add([(turned(x, axis) - x) / 1e-6 for x in plain], 0.01)
    for marker in range(count):
        for a in range(3):
            unit = np.zeros((count, 3))
            unit[marker, a] = 1
            add([n + unit for n in nothing], 5e-4)
    for parts in unsure:
        add(parts, 1.0)
    matrix = np.stack(columns, 1) / noise
    target = np.concatenate([c[..., axes].ravel() for c in change]) / noise
    both = np.concatenate([matrix, np.eye(matrix.shape[1])])
    known = np.concatenate([target, np.zeros(matrix.shape[1])])
    answer = np.linalg.lstsq(both, known, rcond=None)[0]
    return float(math.sqrt(np.sum((known - both @ answer) ** 2) / len(target)))
