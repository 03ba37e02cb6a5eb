"""The design loop: simulate, judge, step; Adam on field and timing, an augmented Lagrangian for the limit on C."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from torchsoro.design.ensemble import MOST, VARIANTS, Ensemble, fallen, overall, shares
from torchsoro.design.lagrangian import AugmentedLagrangian, ExactPenalty
from torchsoro.design.outcome import Outcome
from torchsoro.design.placement import Placement
from torchsoro.design.processes import Processes
from torchsoro.design.risk import CVaR
from torchsoro.design.robot import Robot
from torchsoro.design.settings import Settings
from torchsoro.design.supply import Supply
from torchsoro.design.training import RunFolder
from torchsoro.errors import SimulationDiverged

Lagrangian = AugmentedLagrangian | ExactPenalty
Observe = Callable[[RunFolder, Robot, torch.Tensor, int], None]

LARGEST_C = 0.25  # of any design
LOOSE = 0.3  # price of loose density, in cells of travel: with 0.5 desk walkers lean, with 3 they hardly move
WALKS = 0.7  # share of the travel of the centre of gravity that the feet of a robot make that does not just lean
KEPT = 8  # designs to step back to
BESIDE = ("supply", "placement")  # what may be designed beside the field
MOST_LOST = 9  # iterations in a row whose gradients are not finite


def simulate(
    robot: Robot, good: dict[str, Any], gravity_scale: float, ensemble: Ensemble | None = None, iteration: int = 0
) -> tuple[torch.Tensor, Outcome, bool]:
    """Simulate the robot's design; where it breaks down or falls over, one nearer to the last that did not, ``good``.

    Falling counts where it is punished: a fallen robot's gradient says nothing about how to stand. If the last of three
    steps back still falls, that is what is returned.

    Args:
        robot: Its field, and what else is designed, are changed where it has to step back.
        good: Of that design (see :func:`design_of`).
        gravity_scale: Share of gravity.
        ensemble: Of the run's scenarios, if it has any.
        iteration: Whose scenarios.

    Returns:
        Density, outcome, and whether they are those of the good design itself.

    Raises:
        SimulationDiverged: if half and a quarter of the way, and the last good design, break down as well.
    """
    for left in (3, 2, 1, 0):
        gamma = robot.density()
        try:
            if ensemble is None:
                outcome = robot(gamma, gravity_scale=gravity_scale)
            else:
                outcome = ensemble.judge(gamma, iteration, gravity_scale)
            if left == 0 or not fell(robot, outcome):
                return gamma, outcome, left == 0
        except SimulationDiverged:
            if left == 0:
                raise
        with torch.no_grad():
            back = 0.5 if left > 1 else 1.0
            robot.field.phi.lerp_(good["phi"].to(robot.field.phi), back)
            for part in good.keys() & set(BESIDE):
                getattr(robot, part).blend_(good[part], back)
        if left == 1:
            robot.field.beta = good["beta"]
    raise AssertionError


def design_of(robot: Robot) -> dict[str, Any]:
    """A copy of the present design: ``phi`` and ``beta`` of the field, ``supply`` and ``placement`` if designed."""
    held: dict[str, Any] = {"phi": robot.field.phi.detach().clone(), "beta": robot.field.beta}
    for part, module in beside(robot).items():
        held[part] = {name: one.detach().clone() for name, one in module.state_dict().items()}
    return held


def beside(robot: Robot) -> dict[str, Supply | Placement]:
    """What is designed beside the field, by name."""
    found: dict[str, Supply | Placement] = {"supply": robot.supply} if robot.supply.designed() else {}
    return found | ({} if robot.placement is None else {"placement": robot.placement})


def take_(robot: Robot, design: dict[str, Any]) -> None:
    """Give a robot the design that :func:`design_of` has copied."""
    with torch.no_grad():
        robot.field.phi.copy_(design["phi"])
    robot.field.beta = design["beta"]
    for part, module in beside(robot).items():
        module.load_state_dict(design[part])


def fell(robot: Robot, outcome: Outcome) -> bool:
    """Whether the robot fell; with scenarios, whether those where it did make more than half of the risk's gradient."""
    down = fallen(robot, outcome)
    if robot.settings.upright == 0 or down.ndim == 0:
        return robot.settings.upright > 0 and bool(down)
    return float(shares(robot, worths(robot, outcome))[down].sum()) > MOST


def aim(robot: Robot, outcome: Outcome, iteration: int) -> torch.Tensor:
    """What an iteration maximises under the limit on C, in cells, as Adam wants gradients of order one; by scenario.

    That is travel less falling, and less the mass as a share of the solid body's. A body that stands on one spot has
    next to no gradient by where it ends, whatever its legs; it has one by how far it reaches while it is inflated:
    ``settings.inflated`` of that counts at first, and nothing once the projection is sharp. What a turner
    travels is the arc of half its width, :func:`arc`.
    """
    s = robot.settings
    early = 1 - min(1.0, iteration / s.sharpen[1]) if s.sharpen[1] else 1.0
    if s.robot == "turner":
        whole, inflated = arc(robot, outcome.turn), arc(robot, outcome.turn_inflated)
    else:
        whole = torch.lerp(outcome.travel, outcome.soles, s.feet) - s.feet * leaning(outcome.travel, outcome.soles, 1.1)
        inflated = outcome.inflated
    way = torch.lerp(whole, inflated, s.inflated * early) - s.upright * outcome.fall
    return way / robot.domain.cell - s.lightness * outcome.mass / robot.full_mass


def worth_of(robot: Robot, outcome: Outcome) -> float:
    """What a design is worth, in cells: travel less falling and, where feet count, next to nothing if it leans."""
    return float(overall(robot, worths(robot, outcome))) / robot.domain.cell


def worths(robot: Robot, outcome: Outcome) -> torch.Tensor:
    """The same in each scenario [...] m, without a gradient."""
    s = robot.settings
    turns = s.robot == "turner"
    way = (arc(robot, outcome.turn) if turns else outcome.travel) - s.upright * outcome.fall
    if s.feet > 0 and not turns:
        way = way - 100 * leaning(outcome.travel, outcome.feet, 1.01)
    return way.detach()


def arc(robot: Robot, angle: torch.Tensor) -> torch.Tensor:
    """Way [m] of a point half a body's width off the axis of a turn by an angle [rad]."""
    return 0.5 * robot.settings.size[1] * angle


def leaning(travel: torch.Tensor, feet: torch.Tensor, margin: float) -> torch.Tensor:
    """What the feet lack of the share of the travel that they make of a robot that walks, with a margin [m]."""
    return torch.relu(margin * WALKS * travel - feet)


def settle(robot: Robot, placement: Placement, gravity_scale: float) -> dict[str, float]:
    """Round the chambers of a design to lattice planes for good, and simulate it before and after.

    That is in the settings' own scenario.

    Args:
        robot: The robot.
        placement: Its chambers; changed.
        gravity_scale: Share of gravity.

    Returns:
        Travel [m] and what is maximised (see :func:`worth_of`) before and after, by their tags; nothing if the
        simulation breaks down.
    """
    found: dict[str, float] = {}
    try:
        for when in ("unrounded", "rounded"):
            if when == "rounded":
                placement.settle_()
            with torch.no_grad():
                outcome = robot(robot.density(), gravity_scale=gravity_scale)
            found |= {f"chamber/L_{when}": float(outcome.travel), f"chamber/objective_{when}": worth_of(robot, outcome)}
    except SimulationDiverged:
        placement.settle_()
        return {}
    return found


def better(worth: float, violation: float, best: dict[str, Any] | None, lagrangian: Lagrangian) -> bool:
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


@dataclass(frozen=True, kw_only=True, eq=False)
class Optimized:
    """What a design run ends with.

    Attributes:
        gamma: Density of the best design [N] (see :func:`better`).
        iteration: Iteration that it is of; None where no iteration had full gravity, and it is the last.
        worth: What it is worth, in cells (see :func:`worth_of`); minus infinity where ``iteration`` is None.
        violation: C above its limit; infinite where ``iteration`` is None.
        metrics: Everything logged, by column (see ``RunFolder.metrics``).
        lately: The last designs that neither broke down nor fell, as :func:`take_` takes them, and their ``iteration``.
    """

    gamma: torch.Tensor
    iteration: int | None
    worth: float
    violation: float
    metrics: dict[str, list[float]]
    lately: list[dict[str, Any]] = dataclasses.field(default_factory=list)


def restore(
    state: dict[str, Any],
    robot: Robot,
    adam: torch.optim.Adam,
    lagrangian: Lagrangian,
    path: Path,
) -> tuple[bool, dict[str, Any] | None, list[dict[str, Any]]]:
    """Put a checkpoint's state into field, what is designed beside it, optimizer and schedule.

    Args:
        state: As saved by :func:`optimize`.
        robot: Whose field, and maybe supply and chambers, are designed.
        adam: The optimizer of their parameters.
        lagrangian: The schedule.
        path: Folder of the run, for messages.

    Returns:
        Whether the run has stopped; the best design so far; the last ones that did not break down.

    Raises:
        ValueError: if a part is missing, or of another shape than the lattice.
    """
    where = f"path: {path / 'checkpoint.pt'}"
    field, others = robot.field, beside(robot)
    numbers = [one for module in others.values() for one in module.designed()]
    wanted = ("field", "adam", "lagrangian", "stopped", "best", "good", *others)
    if missing := [name for name in wanted if name not in state]:
        raise ValueError(f"{where} lacks {', '.join(missing)}, wanted the state of a design run; start another folder")
    try:
        moments = [
            (value, wanted)
            for own, wanted in zip(state["adam"]["state"].values(), (field.phi, *numbers), strict=False)
            for value in own.values()
            if value.ndim
        ]
        best = state["best"]
        designs = [one for one in (state["field"], *state["good"], best) if one is not None]
        pairs = [(one["phi"], field.phi) for one in designs] + moments
        for part, module in others.items():
            parts = [state[part], *(one[part] for one in designs[1:])]
            pairs += [(one[name], own) for one in parts for name, own in module.named_parameters()]
        if wrong := [(tuple(one.shape), tuple(own.shape)) for one, own in pairs if one.shape != own.shape]:
            raise ValueError(f"a design of shape {wrong[0][0]}, wanted {wrong[0][1]}")
        field.load_state_dict(state["field"])
        for part, module in others.items():
            module.load_state_dict(state[part])
        adam.load_state_dict(state["adam"])
        lagrangian.load_state_dict(state["lagrangian"])
    except (AttributeError, IndexError, KeyError, RuntimeError, TypeError, ValueError) as error:
        raise ValueError(f"{where} does not fit the run ({error}); start another folder") from error
    return bool(state["stopped"]), best, state["good"]


def spread(robot: Robot, outcome: Outcome, lost: int) -> dict[str, float]:
    """How the travel spreads over the scenarios, falls, and gradients that overflowed, by their tags.

    ``tenth`` is the mean of the lowest tenth, as where a finished design is evaluated. With a least thickness of
    features, the mean of the design's variants, too.
    """
    travel = outcome.travel.detach().double()
    variants = VARIANTS if robot.settings.feature else ()
    quantities = {"min": travel.min(), "tenth": CVaR(0.1)(travel), "mean": travel.mean(), "max": travel.max()}
    return {
        **{f"scenarios/L_{name}": float(value) for name, value in quantities.items()},
        **{f"scenarios/L_{name}": float(travel[i :: len(variants)].mean()) for i, name in enumerate(variants)},
        "scenarios/falls": int(fallen(robot, outcome).sum()),
        "scenarios/gradients_lost": lost,
    }


def _schedule(s: Settings) -> Lagrangian:
    """The loss under the limit on C."""
    if s.sharpen[1]:
        return ExactPenalty(price=s.penalty)
    return AugmentedLagrangian(
        previous=LARGEST_C - s.c_max,
        penalty=s.penalty,
        window=s.window,
        tolerance=s.tolerance,
        growth=s.growth,
        patience=s.patience,
    )


def optimize(robot: Robot, observe: Observe | None = None, processes: Processes | None = None) -> Optimized:
    """Run the design loop to the stopping rule, in the folder ``robot.settings.out``.

    Travel is a rough function of the design, so that the last design is seldom the best. Designs count from the first
    iteration with full gravity on, and with the whole thickness of features. Where gradients overflow again and again,
    the run ends with its best design.

    Args:
        robot: What to design.
        observe: Called with the run folder, the robot, the density and the iteration, after each has been logged.
        processes: That share the scenarios; this is number 0.

    Raises:
        ValueError: if the folder holds another run (see :class:`RunFolder`).
        SimulationDiverged: if the simulation breaks down on a design and on those nearer to the last good one, or if
            gradients overflow again and again and no design is within the limit on C.
    """
    s, field, supply, others = robot.settings, robot.field, robot.supply, beside(robot)
    if s.feature and not s.scenarios:
        raise ValueError(f"feature = {s.feature:g} m with scenarios = 0: wanted at least 3 scenarios")
    timing, placement = supply.designed(), robot.placement
    spacing, chambers = robot.domain.spacing, [] if placement is None else placement.designed()
    if s.target.type == "cpu":
        torch.set_num_threads(1)  # Taichi's threads do the work; torch's would spin beside them

    beside_field = [(timing, s.timing_rate), (chambers, s.chamber_rate * spacing)]
    groups = [(list(field.parameters()), s.learning_rate), *(pair for pair in beside_field if pair[0])]

    def new_adam() -> torch.optim.Adam:
        return torch.optim.Adam([{"params": part, "lr": rate} for part, rate in groups])

    adam = new_adam()
    lagrangian = _schedule(s)
    stopped = False
    good: list[dict[str, Any]] = [design_of(robot)]
    best: dict[str, Any] | None = None
    ensemble = Ensemble(robot, processes) if s.scenarios else None
    lost = 0  # iterations in a row without a gradient
    end_at = time.perf_counter() + s.seconds if s.seconds else math.inf
    folder = RunFolder(s.out, dataclasses.asdict(s), resume=s.resume, overwrite=s.overwrite, free=s.free, amend=s.amend)
    with folder as run:
        if state := run.load():
            stopped, best, good = restore(state, robot, adam, lagrangian, run.path)
            lost = state.get("lost", 0)
            field.beta = s.sharpness(run.start - 1)
        until = s.chamber_until or math.inf  # from where on the chambers stay
        for k in run.progress(run.start if stopped else s.iterations):
            begin = time.perf_counter()
            told: dict[str, Any] = {}
            if placement is not None and k >= until and not placement.settled:
                told = settle(robot, placement, s.gravity_scale(k))
                best = None  # earlier designs would change as they are rounded
            placing = [] if placement is None else placement.designed()
            # Steps shrink as the projection sharpens, so that they change the density as before.
            field.beta = s.sharpness(k)
            if isinstance(lagrangian, ExactPenalty):
                lagrangian.demand(s.sharpened(k))
            for group, (_, rate) in zip(adam.param_groups, groups, strict=True):  # of now, which may be amended
                group["lr"] = rate
            adam.param_groups[0]["lr"] = s.learning_rate * s.beta / field.beta
            among: dict[str, Any] = {} if ensemble is None else {"ensemble": ensemble, "iteration": k}
            gamma, outcome, back = simulate(robot, good[-1], s.gravity_scale(k), **among)
            violation, aims = outcome.intermediate - s.c_max, aim(robot, outcome, k)
            goal = overall(robot, aims)
            loss = lagrangian(goal.detach(), violation)
            if s.connected:
                loose = robot.loose()
                loss = loss + LOOSE * loose
                told["constraint/loose"] = loose.detach()
            middle = time.perf_counter()
            # Only the gradient of the motion is clipped: beside that of a rough one the price of C would vanish.
            price, *prices = torch.autograd.grad(loss, (field.phi, *placing), retain_graph=True)
            adam.zero_grad()
            if ensemble is None:
                (-goal).backward()
            else:
                moved = (field.phi, *timing, *placing)
                for one, gradient in zip(moved, ensemble.gradient(gamma, aims), strict=True):
                    one.grad = gradient
            norm = torch.nn.utils.clip_grad_norm_(field.parameters(), s.clip or math.inf)
            # By itself: a designed timing's few numbers have far larger gradients than each of the field's many.
            timing_norm = torch.nn.utils.clip_grad_norm_(timing, s.clip or math.inf)
            # By one spacing, as a limit by one metre would be some hundreds of times as tight.
            placing_norm = spacing * torch.nn.utils.clip_grad_norm_(placing, (s.clip or math.inf) / spacing)
            design = {"iteration": k, **design_of(robot)}
            if norm.isfinite() and timing_norm.isfinite() and placing_norm.isfinite():
                lost = 0
                if not (back or fell(robot, outcome)):
                    good = [*good[1 - KEPT :], design]
            else:
                # Through so rough a motion it overflows and says nothing.
                lost += 1
                adam.zero_grad(set_to_none=False)
                if lost > MOST_LOST and (best is None or best["violation"] > 0):
                    raise SimulationDiverged(
                        step=0,
                        time=0.0,
                        particle=None,
                        quantity=f"gradient of norm {float(norm)} in iteration {k} and the {MOST_LOST} before",
                        remedy="a smaller step (dt), a lower pressure, or smaller weights (penalty, upright)",
                    )
            if back and len(good) > 1:
                good.pop()  # the next failure goes farther back, or it would be the same again
            for one, more in zip((field.phi, *placing), (price, *prices), strict=True):
                one.grad = more if one.grad is None else one.grad + more
            worth, excess = worth_of(robot, outcome), float(violation.detach())
            counts = k >= s.counts_from
            if counts and better(worth, excess, best, lagrangian):
                best = {"worth": worth, "violation": excess, **design}
            end = time.perf_counter()
            timed = {f"supply/{name}": value for name, value in supply.numbers().items()} if timing else {}
            timed |= {"grad_norm/supply": timing_norm} if timing else {}
            if placement is not None:
                timed |= {f"chamber/{name}": value for name, value in placement.numbers().items()}
                timed |= {"grad_norm/chamber": placing_norm}
            adam.step()
            field.clamp_()
            for module in others.values():
                module.clamp_()
            event = lagrangian.update(loss.item(), excess)
            if event is not None and event.reset_optimizer:
                adam = new_adam()
            whole = counts and (until == math.inf or k >= until)
            stopped = lost > MOST_LOST or (event is not None and event.stop and whole)
            center = outcome.center.detach()
            run.log(
                k,
                {
                    "objective/L": overall(robot, outcome.travel.detach()),
                    "objective/feet": overall(robot, outcome.feet.detach()),
                    "constraint/C": outcome.intermediate.detach(),
                    "objective/fall": overall(robot, -outcome.fall.detach()).abs(),
                    "mass": outcome.mass.detach(),
                    **{f"cog/{axis}": center[i] for i, axis in enumerate("xyz")},
                    "multiplier/C": lagrangian.multiplier,
                    "penalty/C": lagrangian.penalty,
                    "grad_norm/phi": norm,
                    "field/beta": field.beta,
                    "field/gamma_mean": gamma.detach().mean(),
                    **({"objective/turn": overall(robot, outcome.turn.detach())} if s.robot == "turner" else {}),
                    **timed,
                    **told,
                    "simulation/dt": outcome.dt,
                    "time/forward": middle - begin,
                    "time/backward": end - middle,
                    "time/iteration": time.perf_counter() - begin,
                    **({} if ensemble is None else spread(robot, outcome, ensemble.lost)),
                },
            )
            if ensemble is not None:
                run.log_histogram("scenarios/L", outcome.travel.detach(), k)
            if observe is not None:
                observe(run, robot, gamma.detach(), k)
            kept = {"stopped": stopped, "lost": lost, "best": best, "good": good, **others}
            run.save(k, field=field, adam=adam, lagrangian=lagrangian, **kept)
            if stopped or time.perf_counter() > end_at:
                break
        take_(robot, best or good[-1])  # without a best one the last that was simulated: the field is a step beyond
        none = {"iteration": None, "worth": -math.inf, "violation": math.inf}
        told = {name: (best or none)[name] for name in none}
        return Optimized(gamma=robot.density().detach(), metrics=run.metrics, lately=good, **told)
