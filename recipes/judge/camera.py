"""What a recording adds to the motion: clock, scale, rotation, marker places, noise, losses, and decoys."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from experiment import Recording
from lobatto import Floats
from march import turned
from specimens import Specimen

DECOYS = ("scale", "clock_rate", "slipping_marker", "swapped_markers")


@dataclass(frozen=True, kw_only=True)
class Errors:
    """Measurement errors of a case.

    Attributes:
        noise: Standard deviation [m].
        slow: Share of the variance that lasts some 30 ms.
        told: Whether setup.toml states the noise.
        clock: The recording of each trial starts that late [s].
        clock_rate: Recorded seconds to a true one, less 1.
        scale: Of lengths, about the origin.
        rotation: Of the frame, a vector [rad].
        places: Of the markers from where setup.toml has them [markers][3] m.
        lost: Share of samples that are lost.
        slip: Marker, time [s] from which, and shift [m] in three coordinates; None: none slips.
        swap: Two markers whose names are swapped in all trials; None: none.
    """

    noise: float
    slow: float
    told: bool
    clock: dict[str, float]
    clock_rate: float
    scale: float
    rotation: tuple[float, float, float]
    places: tuple[tuple[float, float, float], ...]
    lost: float
    slip: tuple[int, float, tuple[float, float, float]] | None = None
    swap: tuple[int, int] | None = None

    def table(self) -> dict[str, Any]:
        """For truth.sealed."""
        return asdict(self)


def draw_errors(specimen: Specimen, rng: np.random.Generator) -> Errors:
    """Ordinary errors, as every case has them."""
    video = "axes" in specimen.setup["recording"]
    count = len(specimen.setup["marker"])
    axis = np.array([0.0, 1.0, 0.0]) if video else _unit(rng)
    rotation = math.radians(rng.uniform(-0.5, 0.5)) * axis
    return Errors(
        noise=float(math.exp(rng.uniform(math.log(5e-5), math.log(2e-4)))),
        slow=float(rng.uniform(0.1, 0.5)),
        told=bool(rng.random() < 0.5),
        clock={trial.name: float(rng.uniform(0, 8e-3)) for trial in specimen.trials},
        clock_rate=0.0,
        scale=float(1 + 0.01 * rng.uniform(-1, 1)) if video else 1.0,
        rotation=(float(rotation[0]), float(rotation[1]), float(rotation[2])),
        places=tuple(
            (float(d[0]), float(d[1]), float(d[2])) for d in np.clip(rng.normal(0, 3e-4, (count, 3)), -1e-3, 1e-3)
        ),
        lost=float(rng.uniform(0, 0.03)),
    )


def _unit(rng: np.random.Generator) -> Floats:
    v = rng.standard_normal(3)
    return v / np.linalg.norm(v)


def decoy(errors: Errors, kind: str, specimen: Specimen, rng: np.random.Generator) -> Errors:
    """Errors large enough to be taken for physics by who does not know better."""
    count = len(errors.places)
    match kind:
        case "scale":
            return replace(errors, scale=1 + 0.03 * float(rng.choice((-1, 1))))
        case "clock_rate":
            return replace(errors, clock_rate=0.01 * float(rng.choice((-1, 1))))
        case "slipping_marker":
            shift = _unit(rng) * rng.uniform(1.5e-3, 4e-3)
            start = float(rng.uniform(0.2, 0.7)) * specimen.setup["duration"]
            slip = (int(rng.integers(count)), start, (float(shift[0]), float(shift[1]), float(shift[2])))
            return replace(errors, slip=slip)
        case "swapped_markers":
            first, second = rng.choice(count, 2, replace=False)
            return replace(errors, swap=(int(first), int(second)))
    raise ValueError(f"kind = {kind!r}: wanted one of {', '.join(DECOYS)}")


def instants(specimen: Specimen, errors: Errors, trial: str) -> tuple[Floats, Floats]:
    """Times that the recording states, and the true ones [T] s."""
    told = np.arange(0, specimen.setup["duration"] - 8e-3, 1 / specimen.rate)
    return told, told / (1 + errors.clock_rate) + errors.clock[trial]


def _noise(shape: tuple[int, int, int], rate: float, errors: Errors, rng: np.random.Generator) -> Floats:
    keep = math.exp(-1 / (0.03 * rate))
    slow = rng.standard_normal(shape)
    for i in range(1, shape[0]):
        slow[i] = keep * slow[i - 1] + math.sqrt(1 - keep**2) * slow[i]
    fast = rng.standard_normal(shape)
    return errors.noise * (math.sqrt(errors.slow) * slow + math.sqrt(1 - errors.slow) * fast)


def film(specimen: Specimen, errors: Errors, told: Floats, motion: Floats, rng: np.random.Generator) -> Recording:
    """The recording of a motion [T, markers, 3] m at told times [T] s."""
    x = motion.copy()
    if errors.slip is not None:
        marker, start, shift = errors.slip
        x[:, marker] += np.clip((told - start) / 0.01, 0, 1)[:, None] * np.asarray(shift)
    if errors.swap is not None:
        first, second = errors.swap
        x[:, [first, second]] = x[:, [second, first]]
    x = errors.scale * turned(x, errors.rotation)
    axes = "".join(specimen.setup["recording"].get("axes", "xyz"))
    x = x[..., ["xyz".index(a) for a in axes]]
    x = x + _noise(x.shape, specimen.rate, errors, rng)
    x[rng.random(x.shape[:2]) < errors.lost] = np.nan
    if rng.random() < 0.3:
        start, marker = int(rng.integers(len(told))), int(rng.integers(x.shape[1]))
        x[start : start + int(rng.integers(3, 15)), marker] = np.nan
    return Recording(time=told, names=tuple(m["name"] for m in specimen.setup["marker"]), axes=axes, value=x)
