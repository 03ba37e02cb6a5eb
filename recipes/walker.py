"""A cube with an air chamber becomes a walker, by gradient through the simulator.

    python recipes/walker.py                                  # coarse, on a laptop
    python recipes/walker.py --preset paper                   # the paper's size; chosen by itself on a GPU
    python recipes/walker.py --slope 0.3 --out runs/uphill    # uphill, in a folder of its own
    python recipes/walker.py --resume                         # go on after Ctrl-C or a kill
    python recipes/walker.py --resume --amend --learning-rate 0.01    # go on with another setting, which is noted
    tensorboard --logdir runs                                 # watch it

Every number of the settings can be overridden: --help lists them.
"""

from __future__ import annotations

import dataclasses
import json
import math
import statistics
import time
from pathlib import Path
from typing import Any

import torch

from torchsoro.archive import save_design
from torchsoro.errors import SimulationDiverged
from torchsoro.lagrangian import AugmentedLagrangian
from torchsoro.results import deliver, show_shape
from torchsoro.robot import Outcome, Robot, walker
from torchsoro.settings import Settings, from_command_line, plain_errors
from torchsoro.storage import atomic_write
from torchsoro.training import RunFolder

PAPER = Settings(
    preset="paper",
    out=Path("runs/walker"),
    # Travel is so rough that it never levels off to the paper's 0.1 % while C is too high: without patience the penalty
    # would stay at its first value for ever.
    penalty=1.0,
    patience=20,
    # Half a second is short: a robot that falls on its nose from high up gets as far as one that walks.
    upright=4.0,
    sink=0.05,
    # Grey limbs between the ground and a pressurised chamber are crushed: most that may happen to void may to them.
    filler=(0.1, 0.5),
    halvings=1,
)
DESK = dataclasses.replace(
    PAPER,
    preset="desk",
    particles=(12, 12, 12),
    wall=0.035 / 12,
    elements=2,
    dt=1e-4,
    settle=0.05,
    duration=0.2,
    sample_every=0.0025,
    iterations=30,
    filter_radius=0.007,
    filler=(0.1, 0.3),
    halvings=2,
    patience=6,
    # In a single cycle, falling on the nose would be the longest stride.
    upright=8.0,
    sink=0.008,
    learning_rate=0.04,
    window=2,
    tolerance=0.1,
)


def simulate(robot: Robot, good: torch.Tensor, gravity_scale: float) -> tuple[torch.Tensor, Outcome]:
    """Simulate the robot's design; where it breaks down or falls over, one nearer to the last that did not, ``good``.

    Falling counts where it is punished: a fallen robot's gradient says nothing about how to stand. If the last of three
    steps back still falls, that is what is returned.

    Raises:
        SimulationDiverged: if half, a quarter and an eighth of the way break down as well.
    """
    for left in (3, 2, 1, 0):
        gamma = robot.field()
        try:
            outcome = robot(gamma, gravity_scale=gravity_scale)
            if left == 0 or not fell(robot, outcome):
                return gamma, outcome
        except SimulationDiverged:
            if left == 0:
                raise
        with torch.no_grad():
            robot.field.phi.lerp_(good.to(robot.field.phi), 0.5)
    raise AssertionError


def fell(robot: Robot, outcome: Outcome) -> bool:
    """Whether the centre of gravity sank by more than a tenth of the height beyond what is allowed."""
    s = robot.settings
    return s.upright > 0 and outcome.fall.item() > 0.1 * s.size[2]


def better(worth: float, violation: float, best: dict[str, Any] | None, lagrangian: AugmentedLagrangian) -> bool:
    """Whether a design is better than the best so far: one within the limit, of such the one that goes farther.

    As long as none is within the limit, what is gained and what is violated weigh as in the loss of now.
    """
    if best is None:
        return True
    if violation <= 0 or best["violation"] <= 0:
        return (violation <= 0, worth) > (best["violation"] <= 0, best["worth"])
    pairs = (worth, violation), (best["worth"], best["violation"])
    new, old = (float(lagrangian(torch.tensor(w), torch.tensor(v))) for w, v in pairs)
    return new < old


def optimize(robot: Robot, name: str) -> dict[str, float]:
    """Run the design loop to the stopping rule and write what came out of it: the best design (see :func:`better`).

    Travel is rough, so that the last design is seldom the best. Designs count once gravity is whole.

    Args:
        robot: What to design.
        name: Names the movie and the summary.

    Returns:
        The final metrics (see ``results.deliver``), the number of iterations, and their time [s]: median of forward and
        backward, and in all. Also written to ``result.json``.
    """
    s, field = robot.settings, robot.field
    if s.target.type == "cpu":
        torch.set_num_threads(1)  # Taichi's threads do the work; torch's would spin beside them

    def new_adam() -> torch.optim.Adam:
        return torch.optim.Adam(field.parameters(), lr=s.learning_rate)

    adam = new_adam()
    lagrangian = AugmentedLagrangian(
        previous=0.25 - s.c_max,
        penalty=s.penalty,
        window=s.window,
        tolerance=s.tolerance,
        growth=s.growth,
        patience=s.patience,
    )
    stopped = False
    good = field.phi.detach().clone()
    best: dict[str, Any] | None = None
    with RunFolder(s.out, dataclasses.asdict(s), resume=s.resume, free=s.free, amend=s.amend) as run:
        if state := run.load():
            field.load_state_dict(state["field"])
            adam.load_state_dict(state["adam"])
            lagrangian.load_state_dict(state["lagrangian"])
            stopped, best, good = state["stopped"], state["best"], state["good"]
        for k in run.progress(run.start if stopped else s.iterations):
            begin = time.perf_counter()
            gamma, outcome = simulate(robot, good, s.gravity_scale(k))
            violation = outcome.intermediate - s.c_max
            # Adam wants gradients of order one: travel counts in grid cells.
            worth = (outcome.travel - s.upright * outcome.fall) / robot.domain.cell
            loss = lagrangian(worth, violation)
            middle = time.perf_counter()
            adam.zero_grad()
            loss.backward()
            if not fell(robot, outcome):
                good = field.phi.detach().clone()
            norm = torch.nn.utils.clip_grad_norm_(field.parameters(), s.clip or math.inf, error_if_nonfinite=True)
            if s.gravity_scale(k) == 1.0 and better(worth.item(), violation.item(), best, lagrangian):
                best = {
                    "iteration": k,
                    "worth": worth.item(),
                    "violation": violation.item(),
                    "phi": field.phi.detach().clone(),
                }
            end = time.perf_counter()
            adam.step()
            field.clamp_()
            event = lagrangian.update(loss.item(), violation.item())
            if event is not None and event.reset_optimizer:
                adam = new_adam()
            stopped = event is not None and event.stop and s.gravity_scale(k) == 1.0
            center = outcome.center.detach()
            run.log(
                k,
                {
                    "objective/L": outcome.travel.detach(),
                    "constraint/C": outcome.intermediate.detach(),
                    "objective/fall": outcome.fall.detach(),
                    "mass": outcome.mass.detach(),
                    **{f"cog/{axis}": center[i] for i, axis in enumerate("xyz")},
                    "multiplier/C": lagrangian.multiplier,
                    "penalty/C": lagrangian.penalty,
                    "grad_norm/phi": norm,
                    "field/gamma_mean": gamma.detach().mean(),
                    "simulation/dt": outcome.dt,
                    "time/forward": middle - begin,
                    "time/backward": end - middle,
                    "time/iteration": time.perf_counter() - begin,
                },
            )
            if k % s.picture_every == 0:
                show_shape(run, robot, gamma, k)
            if k % s.shape_every == 0:
                save_design(run.path / "shapes" / f"{k:05d}.npz", robot.domain, gamma)
            run.save(k, field=field, adam=adam, lagrangian=lagrangian, stopped=stopped, best=best, good=good)
            if stopped:
                break
        if best is not None:
            with torch.no_grad():
                field.phi.copy_(best["phi"])
        chosen = None if best is None else best["iteration"]
        metrics = deliver(s.out, robot, field().detach(), run.metrics, name=name, chosen=chosen)
    found = {
        **metrics,
        "iterations": len(run.metrics["iteration"]),
        "forward": statistics.median(run.metrics["time/forward"]),
        "backward": statistics.median(run.metrics["time/backward"]),
        "seconds": sum(run.metrics["time/iteration"]),
    }
    with atomic_write(s.out / "result.json") as file:
        plain = {name: None if math.isnan(value) else value for name, value in found.items()}
        file.write((json.dumps(plain, indent=2) + "\n").encode())
    return found


def report(result: dict[str, float], settings: Settings) -> str:
    """What ``optimize`` returned, in one sentence."""
    return (
        f"L = {1e3 * result['L']:.2f} mm in {settings.duration:g} s, stride {1e3 * result['stride']:.2f} mm per cycle, "
        f"C = {result['C']:.4f}, mass = {1e3 * result['mass']:.2f} g after {result['iterations']} iterations "
        f"of {result['forward']:.1f} s forward and {result['backward']:.1f} s backward, "
        f"{result['seconds']:.0f} s in all; everything is in {settings.out}"
    )


def main(settings: Settings) -> dict[str, float]:
    """Design a walker."""
    return optimize(walker(dataclasses.replace(settings, robot="walker")), "walker")


if __name__ == "__main__":
    chosen = from_command_line({"desk": DESK, "paper": PAPER}, description=__doc__)
    with plain_errors():
        result = main(chosen)
    print(report(result, chosen))
