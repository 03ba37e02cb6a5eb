"""Synthetic experiment: simulate an archived robot with an effect that its described model omits.

    python recipes/validate/gap.py walker --hide tube --out runs/gap
    python recipes/explain.py runs/gap --out runs/gap-explained

The robot is simulated by particles in four trials at different pressures; trajectories of eight markers on one side are
recorded with noise. ``setup.toml`` describes the model without the effect named by ``--hide``, and ``simulated.csv`` of
each trial holds the marker trajectories simulated with that model. Effects:

- tube: supply tube at the rear: a mass on a spring and a dashpot;
- relaxation: Maxwell elements, which the paper omitted from long simulations;
- air: the model includes the stiffness of the chamber's air in addition to the pressure that already contains it;
- asymmetry: one side softer than the other;
- nothing: none; gives the discretization error of the twin, the baseline for the others.

The hidden effect is in ``<out>-truth.json``, beside the experiment. This is a demonstration, not a validation: body and
contact are simulated by a formulation other than the twin's, but the effects have the parametric forms that the
hypotheses assume. With ``--no-simulated`` the experiment has no ``simulated.csv``, and the twin simulates by itself.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import trimesh
import tyro
from experiment_files import Files, fresh, setup, write

from torchsoro.command_line import plain_errors
from torchsoro.design.density import without_void
from torchsoro.design.reading import read_settings
from torchsoro.design.robot import Robot, build
from torchsoro.design.settings import Settings
from torchsoro.output.archive import find, load_design
from torchsoro.output.fabricate import surface
from torchsoro.sim2real.data.from_design import believed, elements, far_apart
from torchsoro.simulation.loads import Drag, Load, PointMass, Spring
from torchsoro.simulation.material import Body, Prony

TRIALS, KEPT = {"full": 1.0, "most": 0.8, "less": 0.6}, {"kept": 0.9}  # pressure over that of the design
RATE, FINE = 200.0, 1000.0  # sampling rates of the camera and of the simulation [Hz]
MARKERS = 8
TUBE = {"mass_kg": 2e-3, "stiffness_n_m": 10.0, "damping_n_s_m": 0.02}
REACH = 4e-3  # radius around the rearmost point in which the tube is attached [m]
SOFT = 0.3  # relative reduction of the modulus of the softer side


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Synthetic experiment from an archived robot with a hidden effect."""

    robot: tyro.conf.Positional[str]
    """Name of an archived robot, or a run's folder."""
    out: Path
    """Folder of the experiment."""
    hide: Literal["nothing", "tube", "relaxation", "air", "asymmetry"] = "nothing"
    """Effect in the simulated recording that the model of the experiment omits."""
    strength: float = 1.0
    """Strength of tube or asymmetry, relative to the default."""
    duration: float = 0.2
    """Duration of a trial [s]."""
    settle: float = 0.05
    """Time at rest before the actuation [s]."""
    noise: float = 1e-4
    """Standard deviation of the marker noise [m]."""
    seed: int = 0
    """Seed of the noise."""
    simulated: bool = True
    """Whether the experiment includes the simulation with its described model."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device of the simulation."""


def hidden(options: Options, robot: Robot, body: Body, stiffness: float) -> tuple[Body, list[Load], dict[str, Any]]:
    """Body and loads with the hidden effect, and its true parameters; ``stiffness`` of the air [Pa]."""
    solid = body.chamber < 0
    x = body.position
    if options.hide == "tube":
        rear = -(x @ x.new_tensor(robot.direction))
        last = x[torch.where(solid, rear, -torch.inf).argmax()]
        group = torch.nonzero(solid & ((x - last).norm(dim=-1) < REACH)).squeeze(-1)
        tube = {name: options.strength * value for name, value in TUBE.items()}
        loads = [
            PointMass(particles=group, mass=tube["mass_kg"]),
            Spring(particles=group, stiffness=tube["stiffness_n_m"]),
            Drag(particles=group, coefficient=tube["damping_n_s_m"]),
        ]
        return body, loads, {"name": "tether", "parameters": tube, "location_m": x[group].mean(0).tolist()}
    if options.hide == "asymmetry":
        softer = 1 - options.strength * SOFT * ((x[:, 1] > 0) & solid)
        body = dataclasses.replace(body, bulk=body.bulk * softer, shear=body.shear * softer)
        return body, [], {"name": "soft_side", "parameters": {"fraction": options.strength * SOFT}, "axis": "y"}
    if options.hide == "relaxation":
        return body, [], {"name": "viscoelastic", "parameters": {}, "prony": elements(robot)}
    if options.hide == "air":
        return body, [], {"name": "air_stiffness", "parameters": {"air_stiffness_pa": -stiffness}}
    return body, [], {}


def simulate(robot: Robot, body: Body, loads: list[Load], probes: torch.Tensor, rate: float) -> dict[str, np.ndarray]:
    """Times [T] s and positions of the marker particles [T, M, 3] m of a trial."""
    motion = robot.simulator()(
        body,
        duration=robot.settings.settle + robot.settings.duration,
        prony=robot.prony,
        pressure=robot.pressure,
        gravity=robot.gravity,
        planes=robot.planes,
        loads=loads,
        sample_every=1 / rate,
        probes=probes,
    )
    return {"time": motion.time.cpu().double().numpy(), "place": motion.position.cpu().double().numpy()}


def nominal(options: Options, settings: Settings, gamma: torch.Tensor, probes: torch.Tensor) -> dict[str, np.ndarray]:
    """As :func:`simulate`, with the model described in the experiment, by these settings."""
    robot = build(settings)
    if options.hide == "relaxation":
        robot.prony = Prony.paper(0)
    body, _ = without_void(robot.filled(gamma))
    return simulate(robot, body, [], probes, FINE)


def columns(track: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Columns of a table of markers."""
    named = {
        f"m{i}_{a}_m": track["place"][:, i, k] for i in range(track["place"].shape[1]) for k, a in enumerate("xyz")
    }
    return {"time_s": track["time"], **named}


def main(options: Options) -> dict[str, Any]:
    """Simulate the robot and write the experiment.

    Returns:
        What was hidden.

    Raises:
        ValueError: for a robot that does not exist, or a folder that holds an experiment already.
        SimulationDiverged: if the simulation breaks down.
    """
    fresh(options.out)
    folder = find(options.robot)
    base = read_settings(folder / "settings.json", device=options.device)
    air = base.air_stiffness * (2 if options.hide == "air" else 1)
    rng, trials, truth = np.random.default_rng(options.seed), {}, {}
    for name, share in (TRIALS | KEPT).items():
        timed = {"settle": options.settle, "duration": options.duration, "sample_every": 1 / RATE}
        settings = dataclasses.replace(base, pressure=share * base.pressure, **timed)
        robot = build(settings)
        gamma = load_design(folder / "design.npz", robot.domain).to(settings.target)
        body, _ = without_void(robot.filled(gamma))
        body, loads, truth = hidden(options, robot, body, base.air_stiffness)
        side = torch.nonzero((body.chamber < 0) & (body.position[:, 1] < robot.domain.origin[1] + robot.domain.spacing))
        side = side.squeeze(-1)
        probes = side[far_apart(body.position[side].cpu().numpy(), MARKERS)]
        track = simulate(robot, body, loads, probes, RATE)
        track["place"] += options.noise * rng.standard_normal(track["place"].shape)
        time = torch.arange(0.0, float(track["time"][-1]) + 2e-3, 1e-3, dtype=torch.float64)
        supply = robot.pressure.at(time).reshape(-1).double().numpy()
        chamber = robot.domain.chambers[0].name
        thought = dataclasses.replace(settings, air_stiffness=air)
        trials[name] = Files(
            kept=name in KEPT,
            markers=columns(track),
            pressure={"time_s": time.numpy(), f"{chamber}_pa": supply},
            simulated=columns(nominal(options, thought, gamma, probes)) if options.simulated else None,
        )
        print(f"{name}: moved by {1e3 * np.abs(track['place'] - track['place'][0]).max():.1f} mm")
    places = body.position[probes].cpu().numpy().tolist()
    known = [] if options.hide == "relaxation" else elements(robot)
    length = options.settle + options.duration
    text = believed(robot, title=robot.settings.robot, duration=length, prony=known, air_stiffness=air)
    write(options.out, setup(text, {f"m{i}": at for i, at in enumerate(places)}, options.noise), trials)
    trimesh.Trimesh(*surface(robot.domain, gamma.cpu().numpy())).export(options.out / "body.stl")
    (options.out.parent / f"{options.out.name}-truth.json").write_text(json.dumps(truth, indent=2) + "\n")
    print(options.out)
    return truth


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Options, description=__doc__))
