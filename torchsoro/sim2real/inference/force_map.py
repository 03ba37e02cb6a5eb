"""The force that would be needed: where on the body, when and how strong, from the linear response to small forces.

A force stands in for whatever is missing; it does not say what that is.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from torchsoro.sim2real.data.experiment import Trial
from torchsoro.sim2real.hypotheses.hypothesis import Hypothesis, Quantity
from torchsoro.sim2real.inference.fit import Fit, FitProblem
from torchsoro.sim2real.inference.histories import Solution, chi2_of, simulate, solve
from torchsoro.sim2real.twin.scenario import Scenario
from torchsoro.sim2real.twin.twin import Twin
from torchsoro.simulation.loads import Force

SMALL = 1e-3  # of the body's length, by which a force bends it for its response to be measured
PASSES = 3  # of simulations at most: the response to forces is not quite linear
ROWS = 500  # of a trial, that tell its forces at most: fifty for each of ten windows
SHARES = np.array([1.0, 0.5, 0.25, 0.1])  # of a step that are tried
ENOUGH = 0.05  # of the chi-squared, below which a pass is the last if it gains no more
ROUGH = 0.7  # of what the linear response promises, below which a force is only a hint
INDISTINCT = (
    1.25  # of the chi-squared that the best patch leaves by itself, below which another might be the place as well
)
STRONG = 0.5  # of the largest force, above which others are told


class StepForce(Hypothesis):
    """A dead force on a part of the body, from a time on.

    Args:
        share: Of each node [n], sum 1.
        start: When it begins, in shares of the trial.
        size: That one would notice [N].
    """

    name, affected_quantity = "force", "a force on a part of the body"
    joint = True

    def __init__(self, share: Tensor, start: float, size: float) -> None:
        super().__init__()
        self.share, self.start = share, start
        self.quantities = tuple(Quantity(f"force_{axis}", "N", size) for axis in "xyz")
        self.starts = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """One more force."""
        return scenario.plus(Force(share=self.share, value=values, start=self.start * scenario.duration))


@dataclass(frozen=True, kw_only=True, eq=False)
class Needed:
    """A force of about one direction, on one patch, for a while.

    Attributes:
        trial: Its name.
        place: Middle of the patch [3] m.
        force: Mean over the time [3] N.
        start: [s].
        end: [s].
        whole: Whether that is the whole trial.
    """

    trial: str
    place: np.ndarray
    force: np.ndarray
    start: float
    end: float
    whole: bool

    def __str__(self) -> str:
        """For people."""
        size = float(np.linalg.norm(self.force))
        axis = int(np.abs(self.force).argmax())
        if abs(self.force[axis]) > 0.85 * size:
            along = f"mostly along {'-' if self.force[axis] < 0 else ''}{'xyz'[axis]}"
        else:
            along = "along (" + ", ".join(f"{v:.2f}" for v in self.force / size) + ")"
        place = ", ".join(f"{1e3 * v:.0f}" for v in self.place)
        when = "throughout" if self.whole else f"from {self.start:.2g} to {self.end:.2g} s in"
        return f"a force of {size:.2g} N, {along}, at ({place}) mm, {when} trial {self.trial}"


@dataclass(frozen=True, kw_only=True, eq=False)
class ForceMap:
    """Forces on patches of the body that would explain what is left.

    Attributes:
        trials: Names.
        places: Middle of each patch [P, 3] m.
        windows: Where the windows of each trial begin, and the last one ends [T, W + 1] s.
        forces: [T, P, W, 3] N, constant in a window; zero on patches that are not needed.
        deviations: Standard deviation of each [T, P, W, 3] N; infinite on patches that are not needed.
        chi2s: That a force on each patch by itself would leave [P].
        share: Of the chi-squared that the forces take away by the linear response; measurement errors, modulus and
            pressure are fitted along, with and without them.
        simulated: The same by a simulation with these forces; far below ``share`` if the response is not linear.
    """

    trials: tuple[str, ...]
    places: np.ndarray
    windows: np.ndarray
    forces: np.ndarray
    deviations: np.ndarray
    chi2s: np.ndarray
    share: float
    simulated: float

    @property
    def needed(self) -> list[Needed]:
        """What the map says, the strongest of each trial and patch, strongest first."""
        sizes = np.linalg.norm(self.forces, axis=-1)
        found = []
        for t, p in np.ndindex(*sizes.shape[:2]):
            peak = int(sizes[t, p].argmax())
            f = self.forces[t, p]
            if sizes[t, p, peak] <= STRONG * sizes.max() or sizes[t, p, peak] == 0:
                continue
            on = f @ f[peak] > 0.5 * sizes[t, p, peak] ** 2
            first = peak - int(np.argmin(np.append(on[peak::-1], False))) + 1
            last = peak + int(np.argmin(np.append(on[peak:], False)))
            found.append(
                Needed(
                    trial=self.trials[t],
                    place=self.places[p],
                    force=f[first:last].mean(0),
                    start=float(self.windows[t, first]),
                    end=float(self.windows[t, last]),
                    whole=first == 0 and last == len(on),
                )
            )
        return sorted(found, key=lambda n: -float(np.linalg.norm(n.force)))

    def __str__(self) -> str:
        """For people."""
        needed = self.needed
        if not needed:
            return "No force on the body would explain what is left."
        text = (
            f"It would take {'; '.join(map(str, needed))}. That removes {100 * self.share:.0f} % of chi-squared by "
            f"the linear response, {100 * max(self.simulated, 0.0):.0f} % when simulated."
        )
        if self.simulated < ROUGH * self.share:
            text += " The response is far from linear, so that this is no more than a hint."
        here = int((self.places == needed[0].place).all(-1).argmax())
        others = [p for p in np.flatnonzero(self.chi2s < INDISTINCT * self.chi2s[here]) if p != here]
        if others:
            places = " or ".join("(" + ", ".join(f"{1e3 * v:.0f}" for v in self.places[p]) + ")" for p in others)
            text += f" These markers hardly tell its place from {places} mm."
        return text


def patches(twin: Twin, count: int) -> tuple[np.ndarray, list[Tensor]]:
    """Slices of the body along its longest edge: their middles [P, 3] m, and shares of the nodes [n] of each."""
    s = twin.setup
    low, size, longest = np.array(s.origin), np.array(s.size), int(np.argmax(s.size))
    edges = low[longest] + size[longest] * np.linspace(0, 1, count + 1)
    places = np.tile(low + size / 2, (count, 1))
    places[:, longest] = (edges[1:] + edges[:-1]) / 2
    shares = []
    for begin, end in itertools.pairwise(edges):
        one, other = low.copy(), low + size
        one[longest], other[longest] = begin, end
        shares.append(twin.grid.within((one.tolist(), other.tolist())))
    return places, shares


def force_map(problem: FitProblem, fit: Fit, *, count: int = 4, windows: int = 10) -> ForceMap:
    """Estimate the force that would explain what a fit leaves.

    Each trial has forces of its own on the same patches. They are as small and as steady as cross-validation asks for,
    on as few patches as do; modulus, pressure and measurement errors are fitted along.

    Args:
        problem: Recordings and twin, with the errors that noise and numerics make.
        fit: Without any effect, or the best; of this problem's trials.
        count: Patches along the body.
        windows: Of each trial.

    Raises:
        ValueError: if the fit's simulation, or that of a small force on it, breaks down.
    """
    problem = problem.only([_sparse(t) for t in problem.trials])
    places, shares = patches(problem.twin, count)
    size = _small(problem.twin)
    steps = tuple(StepForce(share, k / windows, size) for share in shares for k in range(windows))
    # Errors that were bent to stand in for a force are no point for a straight line.
    errors = np.clip(fit.errors, -2 * problem.observation.deviations, 2 * problem.observation.deviations)
    effects, at, forces = (*fit.effects, *steps), fit.point, np.zeros((len(problem.trials), count, windows, 3))
    found: Solution | None = None
    before = chi2 = math.inf
    for _ in range(PASSES):
        motions = simulate(problem, effects, at[None], forces[None], slopes=True)
        if found is None:
            before = chi2 = chi2_of(problem, motions, 0, fit.errors, at)
        if not math.isfinite(chi2) or not all(m.sound.all() for m in motions):
            raise ValueError("fit: its simulation breaks down, wanted a point that bears a small force")
        solution, common, errors = solve(problem, errors, at, motions, forces, before)
        found = found or solution
        if not solution.forces.any():
            break
        # The whole way, or less where the response is far from linear.
        ahead = at + SHARES[:, None] * np.append(common, np.zeros(len(at) - len(common)))
        tried = forces + SHARES[:, None, None, None, None] * (solution.forces - forces)
        motions = simulate(problem, effects, ahead, tried)
        left = [chi2_of(problem, motions, k, errors, a) for k, a in enumerate(ahead)]
        best, gained = int(np.argmin(left)), chi2 - min(left)
        if gained <= 0:
            break
        at, forces, chi2 = ahead[best], tried[best], left[best]
        found = dataclasses.replace(solution, forces=forces)
        if gained < ENOUGH * before:
            break
    assert found is not None
    ends = np.array([t.setup.duration for t in problem.trials])
    return ForceMap(
        trials=tuple(t.name for t in problem.trials),
        places=places,
        windows=ends[:, None] * np.linspace(0, 1, windows + 1),
        forces=size * found.forces,
        deviations=size * found.deviations,
        chi2s=found.chi2s,
        share=1 - found.chi2 / before,
        simulated=1 - chi2 / before,
    )


def _sparse(trial: Trial) -> Trial:
    """With every k-th row of its recording, where those are many: forces take a number for each row and window."""
    recording = trial.recording
    if recording is None or len(recording.time) <= ROWS:
        return trial
    return dataclasses.replace(trial, recording=recording.every(math.ceil(len(recording.time) / ROWS)))


def _small(twin: Twin) -> float:
    """A force [N] that bends a bar of the body's size by a small share of its length."""
    s = twin.setup
    thin, wide, long = sorted(s.size)
    return SMALL * long * 3 * s.youngs_modulus * wide * thin**3 / 12 / long**3
