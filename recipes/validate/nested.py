"""Compare the evidence of an explanation's leading candidates with nested sampling.

    pip install -e '.[nested]'
    python recipes/validate/nested.py EXPERIMENT OTHER ... --leading 3

An explanation integrates by Laplace's approximation: with simulations that are linear near their best numbers, and the
discrepancy by a parabola. Here all of it is sampled (Lange 2023, nautilus): each sample is a simulation of its own,
with beliefs, strengths and places from their priors, and a discrepancy from its prior. Only measurement errors, in
which recordings are nearly linear, are integrated as there. Both take the coarse simulation, moved by what the finer
one adds where the candidate is best. Printed are ln evidences over the most probable candidate, and whether their order
is the same.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import tyro
from threadpoolctl import threadpool_limits

from torchsoro.command_line import Count, options, program
from torchsoro.sim2real.hypotheses.library import library
from torchsoro.sim2real.inference.candidates import data_of, held_of, near
from torchsoro.sim2real.inference.evidence import Discrepancy, Linearised, grams, infer, ranges
from torchsoro.sim2real.inference.fit import Fit, FitProblem
from torchsoro.sim2real.inference.laplace import posterior
from torchsoro.sim2real.inference.search import search
from torchsoro.sim2real.inference.state_space import total
from torchsoro.sim2real.inference.twin_error import DiscretizationError
from torchsoro.sim2real.inputs import read_inputs
from torchsoro.sim2real.options import Options as ExplainOptions
from torchsoro.sim2real.pipeline import correct

WORST = -1e10  # ln likelihood of what breaks down


@options
class Options:
    """Which experiments, and how finely they are sampled."""

    experiments: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of experiments."""
    leading: Count = 3
    """Candidates that are compared, the most probable ones by Laplace's approximation."""
    live: Count = 200
    """Points that nested sampling keeps alive."""
    samples: Count = 200
    """Effective number of samples of the posterior."""
    budget: float = 20.0
    """Of the explanation, which chooses the cells [minutes]."""
    threads: int = 0
    """That simulate; 0 for as many as there are processors."""


def likelihood(problem: FitProblem, fit: Fit, found: Linearised) -> Callable[[np.ndarray], np.ndarray]:
    """Ln likelihoods at points of the unit cube [B, K + 3]: quantiles of the unknowns, of s, tau and c."""
    data, moving = data_of(problem), ~held_of(problem, fit.effects)
    count = int(moving.sum())
    model, faults = found.model, found.at[count:]
    coarse = problem.only(problem.trials, discretization=DiscretizationError(shift=tuple(problem.shift)))
    few = dataclasses.replace(model, priors=model.priors[count:], own=(), stated=(), released=())

    def linear(points: np.ndarray) -> list[Linearised | None]:
        """By the measurement errors alone, at points of the other unknowns [B, K]."""
        full = np.zeros((len(points), len(moving)))
        full[:, moving] = points
        (motions,) = coarse.simulate([(fit.effects, full)])
        made: list[Linearised | None] = []
        for b in range(len(points)):
            if not all(m.sound[b] for m in motions):
                made.append(None)
                continue
            seen = [coarse.observation.linearise(m.alone(b), i, faults) for i, m in enumerate(motions)]
            left = tuple(t.position - s for t, (s, _) in zip(data.trials, seen, strict=True))
            by = tuple(J for _, J in seen)
            made.append(Linearised(model=few, at=faults, residuals=left, slopes=by, numerics=found.numerics))
        return made

    (best,) = linear(found.at[None, :count])
    assert best is not None
    shift = [a - b for a, b in zip(found.residuals, best.residuals, strict=True)]
    low, high = ranges(data, found.numerics)

    def ln_likelihood(cube: np.ndarray) -> np.ndarray:
        points = np.stack([p.quantile(u) for p, u in zip(model.priors[:count], cube.T[:count], strict=True)], 1)
        # As probable that no discrepancy matters as that one does.
        quantiles = np.concatenate([np.clip(2 * cube[:, -3:-2] - 1, 0, 1), cube[:, -2:]], 1)
        discrepancies = [Discrepancy(*map(float, x)) for x in np.exp(low + quantiles * (high - low))]
        values = np.full(len(cube), WORST)
        for b, one in enumerate(linear(points)):
            if one is not None:
                left = tuple(r + d for r, d in zip(one.residuals, shift, strict=True))
                moved = dataclasses.replace(one, residuals=left)
                gram = total(grams(data, moved, discrepancies[b]))
                values[b] = posterior(gram, faults, few.priors).ln_evidence
        return values

    return ln_likelihood


def sampled(problem: FitProblem, fit: Fit, found: Linearised, asked: Options) -> tuple[float, int]:
    """Ln evidence by nested sampling, and the number of simulations of all trials."""
    nautilus = importlib.import_module("nautilus")
    count = len(found.at) - len(problem.observation.deviations)
    sampler = nautilus.Sampler(
        lambda u: u,
        likelihood(problem, fit, found),
        n_dim=count + 3,
        n_live=asked.live,
        n_networks=1,
        n_batch=64,
        vectorized=True,
        pass_dict=False,
        seed=1,
    )
    sampler.run(n_eff=asked.samples, f_live=0.05)
    return float(sampler.log_z), int(sampler.n_like)


@threadpool_limits.wrap(limits=1)
def main(asked: Options) -> None:
    """Compare, and print."""
    agree = 0
    for experiment in asked.experiments:
        options = ExplainOptions(
            experiment=experiment, out=Path("runs/nested"), budget=asked.budget, threads=asked.threads
        )
        inputs = read_inputs(options)
        problem = correct(inputs)
        effects = problem.thought_of(inputs.effects or library())
        problem, null_model, ends = search(problem, effects, 60 * asked.budget, lambda line: None)
        fits = [null_model, *ends]
        weighed = [
            (infer(data_of(problem), one).ln_evidence, fit, one)
            for fit, one in zip(fits, near(problem, fits), strict=True)
            if one is not None
        ]
        best: dict[str, tuple[float, Fit, Linearised]] = {}
        for row in sorted(weighed, key=lambda row: -row[0]):
            best.setdefault(row[1].name, row)
        rows = list(best.values())[: asked.leading]
        found = [sampled(problem, fit, one, asked) for _, fit, one in rows]
        tops = rows[0][0], max(z for z, _ in found)
        print(f"{experiment.name}: ln evidence over the most probable, Laplace / nested sampling (simulations)")
        for (z, fit, _), (other, count) in zip(rows, found, strict=True):
            print(f"  {fit.name}: {z - tops[0]:.1f} / {other - tops[1]:.1f} ({count})", flush=True)
        same = bool(np.all(np.diff([z for z, _ in found]) < 0))
        agree += same
        print(f"  {'the same order' if same else 'another order'}", flush=True)
    print(f"The same order in {agree} of {len(asked.experiments)}.")


cli = program(main, Options, __doc__)

if __name__ == "__main__":
    cli()
