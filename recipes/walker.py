"""A cube with an air chamber becomes a walker, by gradient through the simulator.

    python recipes/walker.py                                  # coarse, on a laptop
    python recipes/walker.py --preset paper                   # the paper's size; chosen by itself on a GPU
    python recipes/walker.py --slope 0.3 --out runs/uphill    # uphill, in a folder of its own
    python recipes/walker.py --resume                         # go on after Ctrl-C or a kill
    tensorboard --logdir runs                                 # watch it

Every number of the settings can be overridden: --help lists them.
"""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from pathlib import Path

import torch

from torchsoro.errors import SimulationDiverged
from torchsoro.lagrangian import AugmentedLagrangian
from torchsoro.results import deliver, show_shape
from torchsoro.robot import Outcome, Robot, walker
from torchsoro.settings import Settings, from_command_line, plain_errors
from torchsoro.training import RunFolder

PAPER = Settings(preset="paper", out=Path("runs/walker"))
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
    iterations=20,
    filter_radius=0.007,
    # In a single cycle, falling on the nose would be the longest stride.
    upright=8.0,
    sink=0.008,
    learning_rate=0.04,
    penalty=10.0,
    window=2,
    tolerance=0.1,
)


def simulate(robot: Robot, good: torch.Tensor, gravity_scale: float) -> tuple[torch.Tensor, Outcome]:
    """Simulate the robot's design; where it breaks down, one nearer to the last design that did not, ``good``.

    Raises:
        SimulationDiverged: if half, a quarter and an eighth of the way break down as well.
    """
    for _ in range(3):
        gamma = robot.field()
        try:
            return gamma, robot(gamma, gravity_scale=gravity_scale)
        except SimulationDiverged:
            with torch.no_grad():
                robot.field.phi.lerp_(good.to(robot.field.phi), 0.5)
    gamma = robot.field()
    return gamma, robot(gamma, gravity_scale=gravity_scale)


def optimize(robot: Robot, name: str) -> dict[str, float]:
    """Run the design loop to the stopping rule and write what came out of it: the best design within the limit on C.

    Travel is rough, so that the last design is seldom the best; without any within the limit the last is taken.

    Args:
        robot: What to design.
        name: Names the movie and the summary.

    Returns:
        The final metrics (see ``results.deliver``) and the number of iterations.
    """
    s, field = robot.settings, robot.field
    if s.target.type == "cpu":
        torch.set_num_threads(1)  # Taichi's threads do the work; torch's would spin beside them

    def new_adam() -> torch.optim.Adam:
        return torch.optim.Adam(field.parameters(), lr=s.learning_rate)

    adam = new_adam()
    lagrangian = AugmentedLagrangian(
        previous=0.25 - s.c_max, penalty=s.penalty, window=s.window, tolerance=s.tolerance, growth=s.growth
    )
    stopped = False
    good = field.phi.detach().clone()
    best = {"worth": -math.inf, "phi": good}
    with RunFolder(s.out, dataclasses.asdict(s), resume=s.resume, free=s.free) as run:
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
            good = field.phi.detach().clone()
            norm = torch.nn.utils.clip_grad_norm_(field.parameters(), s.clip or math.inf, error_if_nonfinite=True)
            if violation.item() <= 0 and worth.item() > best["worth"]:
                best = {"worth": worth.item(), "phi": good}
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
            run.save(k, field=field, adam=adam, lagrangian=lagrangian, stopped=stopped, best=best, good=good)
            if stopped:
                break
        if best["worth"] > -math.inf:
            with torch.no_grad():
                field.phi.copy_(best["phi"])
        metrics = deliver(s.out, robot, field().detach(), run.metrics, name=name)
    seconds = {key: statistics.median(run.metrics[f"time/{key}"]) for key in ("forward", "backward")}
    return {**metrics, **seconds, "iterations": len(run.metrics["iteration"])}


def report(result: dict[str, float], settings: Settings) -> str:
    """What ``optimize`` returned, in one sentence."""
    return (
        f"L = {1e3 * result['L']:.2f} mm in {settings.duration:g} s, stride {1e3 * result['stride']:.2f} mm per cycle, "
        f"C = {result['C']:.4f}, mass = {1e3 * result['mass']:.2f} g after {result['iterations']} iterations "
        f"of {result['forward']:.1f} s forward and {result['backward']:.1f} s backward; everything is in {settings.out}"
    )


def main(settings: Settings) -> dict[str, float]:
    """Design a walker."""
    return optimize(walker(settings), "walker")


if __name__ == "__main__":
    chosen = from_command_line({"desk": DESK, "paper": PAPER}, description=__doc__)
    with plain_errors():
        result = main(chosen)
    print(report(result, chosen))
