"""What a finished run leaves for people: the design, a printable part, a movie of the gait, a page that sums it up."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import statistics
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchsoro.command_line import parse_resolution, progress_bar
from torchsoro.design.chambers import check_new
from torchsoro.design.ensemble import Ensemble, Evaluation, end, evaluate
from torchsoro.design.objective import intermediate_density, mean_stride
from torchsoro.design.processes import Processes, joined, world_size
from torchsoro.design.robot import Robot
from torchsoro.design.rounding import changes, rounded, rounding_line, save_chambers
from torchsoro.design.settings import Settings
from torchsoro.design.starts import optimize_starts
from torchsoro.design.supply import Supply
from torchsoro.design.training import RunFolder
from torchsoro.output.archive import begin_with, save_design
from torchsoro.output.fabricate import surface
from torchsoro.output.folding import folded, folding_line
from torchsoro.output.loose import loose_line, loose_share, travel_of, without_loose
from torchsoro.output.motion import FILE as MOTION
from torchsoro.output.motion import decompose, read_motion
from torchsoro.output.part import Part
from torchsoro.output.picture import movie, shape_image, summary
from torchsoro.output.printable import farthest, mended, mending_line, print_part, told_of
from torchsoro.output.web_page import FILE as PAGE
from torchsoro.output.web_page import write_page
from torchsoro.storage import plain_settings, write_json


def design(robot: Robot, name: str) -> dict[str, float]:
    """Run the design loop, with the shape in TensorBoard as it grows, write what came out of it, and print the result.

    Args:
        robot: What to design; ``robot.settings.out`` is the folder.
        name: Names the movie and the summary.

    Returns:
        The final metrics (see :func:`show`), the iteration of the design, the number of iterations, and their time
        [s]: median of forward and backward, and in all; of chambers that are designed, which are then rounded to
        lattice planes, what :func:`torchsoro.design.rounding.changes` says. Also written to ``result.json``, with null
        for NaN.

    Raises:
        ValueError: see :func:`torchsoro.design.starts.optimize_starts`; also if the design has no connected body, if
            there are more processes or slopes than scenarios, or no robot to start from.
        ConnectionError: if another process ends before this one.
    """
    s = robot.settings
    if not s.resume:
        check_new(s, robot.domain.chambers, robot.port)
    if s.slopes and (s.scenarios < len(s.slopes) or s.slope or s.robot == "climber"):
        raise ValueError(
            f"slopes = {s.slopes}: wanted at least as many scenarios, not {s.scenarios}, and none for a climber or "
            f"beside a slope of {s.slope:g}"
        )
    if s.iterations <= s.counts_from:
        print(
            f"iterations = {s.iterations}: gravity and the thickness of features still grow until iteration "
            f"{s.counts_from}, from which on designs count; the last one is delivered",
            file=sys.stderr,
        )
    if world_size() > 1:
        if s.starts > 1:
            raise ValueError(f"starts = {s.starts}: wanted 1 in several processes, which share scenarios")
        Processes(world=world_size()).deal(s.scenarios)
    with joined(s.target.type == "cuda") as processes:
        if not processes.agree(json.dumps(numbers_of(s))):
            raise ValueError(
                "settings: they differ between processes, wanted the same on all hosts: share the run's folder, or "
                "give every flag again"
            )
        if processes.rank:
            Ensemble(robot, processes).serve()
            return {}
        try:
            if s.start_from and not (s.resume and (s.out / "checkpoint.pt").exists()):
                begin_with(robot.field, s.start_from)
            optimized = optimize_starts(robot, observe, processes)
        except (ConnectionError, KeyboardInterrupt):  # the others wait for something else, and notice by themselves
            raise
        except Exception:
            end(processes)
            raise
        end(processes)
    history, gamma, chosen, part = optimized.metrics, optimized.gamma, optimized.iteration, None
    if s.mended_to and robot.placement is None:
        gamma, chosen, part = farthest(robot, optimized)
    more = {
        "iteration": len(history["iteration"]) - 1 if chosen is None else chosen,
        "iterations": len(history["iteration"]),
        "forward": statistics.median(history["time/forward"]),
        "backward": statistics.median(history["time/backward"]),
        "seconds": sum(history["time/iteration"]),
        **(robot.supply.numbers() if designed_supply(robot) is not None else {}),
    }
    if robot.placement is not None:
        sharp = rounded(robot)
        gamma = sharp.density().detach()
        save_chambers(s.out, sharp)
        save_design(s.out / "design.npz", sharp.domain, gamma, designed_supply(sharp))
        more |= changes(robot, sharp, history)
        robot = sharp
    found = deliver(s.out, robot, gamma, history, name=name, chosen=chosen, part=part, more=more)
    print(report(found, s))
    return found


def numbers_of(s: Settings) -> dict[str, Any]:
    """The settings that change the numbers of a run."""
    return {name: one for name, one in plain_settings(dataclasses.asdict(s)).items() if name not in s.free}


def observe(run: RunFolder, robot: Robot, gamma: torch.Tensor, iteration: int) -> None:
    """Show the shape in TensorBoard, and keep the design, as often as the settings say."""
    if iteration % robot.settings.picture_every == 0:
        show_shape(run, robot, gamma, iteration)
    # Other checks would take designs with other chambers than the delivered ones for bodies without walls.
    if iteration % robot.settings.shape_every == 0 and robot.placement is None:
        save_design(run.path / "shapes" / f"{iteration:05d}.npz", robot.domain, gamma)


def designed_supply(robot: Robot) -> Supply | None:
    """The robot's supply if its timing is part of the design."""
    return robot.supply if robot.supply.designed() else None


def report(result: Mapping[str, Any], settings: Settings) -> str:
    """What :func:`design` returned, in a few lines."""
    spread = f"\n{spread_line(result, settings.scenarios)}" if settings.scenarios else ""
    return (
        f"travel L = {1e3 * result['L']:.2f} mm in {settings.duration:g} s; {numbers(result)}\n{mending_line(result)}"
        f"{rounding_line(result)}{loose_line(result)}{folding_line(result, settings)}"
        f"{result['iterations']} iterations of {result['forward']:.1f} s forward and {result['backward']:.1f} s "
        f"backward (medians), {result['seconds']:.0f} s in all; everything is in {settings.out}{spread}"
    )


def spread_line(found: Mapping[str, Any], count: int) -> str:
    """What an evaluation's numbers say of the travel in so many scenarios, in a line."""
    parts = (("lowest", "L_min"), ("lowest tenth", "L_lowest_tenth"), ("mean", "L_mean"), ("highest", "L_max"))
    listed = ", ".join(f"{name} {1e3 * found[key]:.2f} mm" for name, key in parts)
    broken = f", {found['diverged']} broke down" if found["diverged"] else ""
    return f"{count} scenarios: {listed}; {found['falls']} falls{broken}"


def numbers(found: Mapping[str, Any]) -> str:
    """Stride, C with its limit, and mass of a design, for a picture or a line."""
    stride = "no whole cycle"
    if found["stride"] is not None and not math.isnan(found["stride"]):
        stride = f"stride {1e3 * found['stride']:.2f} mm (mean of whole cycles)"
    limit = f"limit {found['C_limit']:g}{'' if found['C_within_limit'] else ' NOT MET'}"
    feet = f"feet {1e3 * found['feet']:.2f} mm, " if found.get("feet") is not None else ""
    if found.get("turn_left") is not None:
        left, right = (math.degrees(found[f"turn_{side}"]) for side in ("left", "right"))
        feet = f"turns {left:.1f} degrees to the left, {right:.1f} to the right, {feet}"
    return f"{feet}{stride}, C = {found['C']:.4f} ({limit}), mass {1e3 * found['mass']:.2f} g"


def show_shape(run: RunFolder, robot: Robot, gamma: torch.Tensor, iteration: int) -> None:
    """Put the present shape into TensorBoard, as a picture and as a mesh."""
    density = gamma.detach().cpu().numpy()
    domain = robot.rounded_domain
    vertices, faces = surface(domain, density)
    run.log_mesh("shape/mesh", vertices, faces, None, iteration)
    title = f"iteration {iteration}"
    picture = shape_image(domain=domain, gamma=density, planes=drawn_planes(robot), title=title)
    run.log_image("shape/picture", picture, iteration)


def drawn_planes(robot: Robot) -> tuple[tuple[int, float, int], ...]:
    """The robot's planes as pictures take them, oblique ones left out: axis, place, free side."""
    return tuple((plane.axis, float(plane.offset), plane.side) for plane in robot.planes if plane.axis is not None)


def deliver(
    path: Path,
    robot: Robot,
    gamma: torch.Tensor,
    history: Mapping[str, Sequence[float]],
    *,
    name: str,
    chosen: int | None = None,
    part: Part | None = None,
    more: Mapping[str, float] | None = None,
) -> dict[str, float]:
    """Write the design of a finished run into its folder, as ``design.npz``, and show it there: see :func:`show`.

    The design comes first, then its numbers and the part, pictures last.

    Args:
        path: The folder.
        robot: The robot.
        gamma: Its density [N]; judged as it is stored.
        history: Metrics of the run, for the summary.
        name: Of the robot: names the movie and the page.
        chosen: Iteration that the design is of; the last if None.
        part: Of a design whose settings ask for a least wall, if it has been made already.
        more: What else ``result.json`` is to tell.

    Returns:
        What :func:`show` measured, and ``more``.

    Raises:
        ValueError: if the design has no connected body to print; all but the part is written before.
    """
    s = robot.settings
    gamma = save_design(path / "design.npz", robot.domain, gamma, designed_supply(robot))
    part, delivered = mended(robot, gamma, part)
    if part is not None:
        save_design(path / "design.npz", robot.domain, gamma, designed_supply(robot), delivered)
    found = None
    if s.scenarios:
        with progress_bar(f"{s.scenarios} scenarios") as progress:
            batch = s.distribution.sample(s.scenarios, s.scenario_seed)
            found = evaluate(robot, delivered, batch, progress=progress)
    told = {**({} if found is None else found.numbers()), **(more or {})}
    how: dict[str, Any] = {"history": history, "chosen": chosen, "scenarios": found, "part": part, "more": told}
    return show(path, robot, gamma, name=name, **how)[0]


@torch.no_grad()
def show(
    path: Path,
    robot: Robot,
    gamma: torch.Tensor,
    *,
    name: str,
    history: Mapping[str, Sequence[float]] | None = None,
    chosen: int | None = None,
    void: bool = True,
    scenarios: Evaluation | None = None,
    part: Part | None = None,
    more: Mapping[str, float] | None = None,
) -> tuple[dict[str, float], Part]:
    """Simulate a gait with every particle recorded, and write what people look at and print.

    Numbers and part come first. A movie or a page that cannot be drawn, for want of an encoder, is told and left out.

    Files: ``<name>.mp4``, ``motion.npz`` and ``motion.html`` (the motion, for recipes/view.py and for a browser), with
    a history ``summary.png``, and ``shape.stl`` and ``shape.3mf`` with ``shape.json`` (what the part weighs and how
    thin it gets).

    Args:
        path: Folder to write to.
        robot: The robot.
        gamma: Its density [N].
        name: Of the robot: names the movie and the page.
        history: Metrics of its run.
        chosen: Iteration of that run that the design is of; the last if None.
        void: Simulate void, too.
        scenarios: What the design does in its scenarios, for the summary.
        part: Of a design whose settings ask for a least wall, if it has been made already.
        more: What ``result.json`` is to tell beside what is measured; not written if None.

    Returns:
        Travel L [m], that of the feet [m], mean stride over whole cycles [m] (NaN if there is none), C, its limit and
        whether it is met, mass [kg], how many particles lie in another part of the body at the worst (``folded``), of a
        turner its angles to the left, and to the right with the supply mirrored [rad], where pieces are loose their
        share of the solid (``loose``) and the travel without them [m] (``L_connected``, NaN if that breaks down),
        thinnest wall and gap of the part [m] (NaN if there is none), of one whose walls were to be mended what
        :func:`told_of` says, ``more``; and the printable part. All but C are those of the part with its walls mended.

    Raises:
        ValueError: if the design has no connected body to print; all but the part is written before.
    """
    s = robot.settings
    part, delivered = mended(robot, gamma, part)
    with progress_bar(f"simulating {name}") as progress:
        outcome = robot(delivered, everything=True, void=void, progress=progress)
    density = delivered.cpu().numpy()
    trajectory = outcome.trajectory
    frames = trajectory.position.cpu().numpy()
    time = trajectory.time.cpu().double().numpy()
    center = trajectory.center_of_gravity.cpu().double().numpy()
    intermediate = intermediate_density(gamma, robot.design)
    found = {
        "L": float(outcome.travel),
        "feet": float(outcome.feet),
        "stride": mean_stride(center @ np.array(robot.direction), time, start=s.settle, period=1 / s.frequency),
        "C": float(intermediate),
        "C_limit": s.c_max,
        # Rounding differs between the run's device and this one.
        "C_within_limit": bool(intermediate <= s.c_max * (1 + 1e-4)),
        "mass": float(outcome.mass),
        "folded": folded(robot, density, trajectory),
    }
    if s.robot == "turner":
        with progress_bar(f"simulating {name}, supply mirrored") as progress:
            other = robot(delivered, void=void, pressure=robot.supply(mirrored=True), progress=progress)
        found |= {"turn_left": float(outcome.turn), "turn_right": -float(other.turn)}
    if part is not None:
        with progress_bar(f"simulating {name}, not mended") as progress:
            found |= told_of(part, robot(gamma, void=void, progress=progress))
    whole = without_loose(robot, delivered)
    if (share := loose_share(delivered, whole)) > 0:
        with progress_bar(f"simulating {name}, loose pieces left out") as progress:
            found |= {"loose": share, "L_connected": travel_of(robot, whole, void, progress)}
    found |= more or {}
    bodiless: ValueError | RuntimeError | None = None
    try:
        part = part or print_part(robot, density)
    except (ValueError, RuntimeError) as error:
        bodiless = error
    else:
        found["thinnest_wall"] = 1e-3 * part.report.thinnest_wall_mm
        found["thinnest_gap"] = 1e-3 * part.report.thinnest_gap_mm
        save_part(path, part)
    if more is not None:
        plain = {key: None if math.isnan(value) else value for key, value in found.items()}
        write_json(path / "result.json", plain)
    begin = np.array([np.interp(s.settle, time, component) for component in center.T])
    drawn = np.unique(np.linspace(0, len(time) - 1, min(s.frames, len(time))).round().astype(int))
    supply = mean_pressure(robot, trajectory.time)
    width, height = parse_resolution(s.resolution)
    shown = {
        "domain": robot.domain,
        "gamma": density,
        "planes": drawn_planes(robot),
        "direction": robot.direction,
        "tilt": math.degrees(math.atan(s.slope)),
    }
    way = f"travel L = {1e3 * found['L']:.2f} mm"
    if s.robot == "turner":
        left, right = (math.degrees(found[f"turn_{side}"]) for side in ("left", "right"))
        way = f"turns by {left:.1f} degrees to the left, {right:.1f} to the right"
    title = f"{name}: {way} in {s.duration:g} s"
    record(path, name, robot, shown, frames, time, supply)
    if history is not None:
        with or_told(path / "summary.png"):
            summary(
                path / "summary.png",
                **shown,
                frames=frames,
                time=time,
                pressure=supply,
                displacement=center - begin,
                start=s.settle,
                history=history,
                chosen=chosen,
                limit=s.c_max,
                period=1 / s.frequency,
                title=title,
                note=numbers({**found, "turn_left": None}),  # which the title tells
                scenarios=None if scenarios is None else scenarios.travel,
            )
    print(f"writing {path / name}.mp4", file=sys.stderr, flush=True)
    with or_told(path / f"{name}.mp4"):
        movie(
            path / f"{name}.mp4",
            **shown,
            frames=frames[drawn],
            time=time[drawn],
            pressure=supply[drawn],
            displacement=(center - begin)[drawn],
            fps=s.fps,
            width=width,
            height=height,
            follow=s.follow,
            title=title,
        )
    if part is None:
        assert bodiless is not None
        raise bodiless
    return found, part


@contextlib.contextmanager
def or_told(picture: Path) -> Iterator[None]:
    """Say which picture cannot be drawn, and why, and go on without it: it is drawn of what is kept elsewhere."""
    try:
        yield
    except (ImportError, OSError, RuntimeError) as error:  # no encoder, or one that does not know the codec
        print(f"{picture} is left out: {error}", file=sys.stderr, flush=True)


def save_part(path: Path, part: Part) -> None:
    """Write a part into a folder: ``shape.stl``, ``shape.3mf`` and ``shape.json``."""
    part.save(path / "shape.stl")
    part.save(path / "shape.3mf")
    write_json(path / "shape.json", part.report.as_dict())


@torch.no_grad()
def mean_pressure(robot: Robot, time: torch.Tensor) -> np.ndarray:
    """Gauge pressure of the supply at some times [S] Pa, the mean over the chambers."""
    pressure = robot.pressure
    return pressure.at(time.cpu().to(pressure.time)).reshape(-1, len(time)).mean(0).numpy()


def record(
    path: Path,
    name: str,
    robot: Robot,
    shown: Mapping[str, Any],
    frames: np.ndarray,
    time: np.ndarray,
    supply: np.ndarray,
) -> None:
    """Write the motion since the actuation starts, at most its last three cycles: ``motion.npz`` and ``motion.html``.

    Args:
        path: Folder to write to.
        name: Of the robot.
        robot: The robot.
        shown: Its lattice, density, planes, direction and tilt.
        frames: Positions of the particles [S, N, 3] m.
        time: Of the frames [S] s.
        supply: Gauge pressure at the frames [S] Pa.
    """
    s = robot.settings
    period = 1 / s.frequency
    on = time >= max(s.settle, time[-1] - 3 * period) - 1e-3 * s.sample_every
    motion = decompose(name=name, frames=frames[on], time=time[on], pressure=supply[on], period=period, **shown)
    motion.save(path / MOTION)
    # As it is read from the file: the page shows what the viewer does.
    write_page(read_motion(path / MOTION), path / PAGE)
