"""Every number of a design run in one place, and the command line that is made of it."""

from __future__ import annotations

import argparse
import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import torch
import tyro


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of a design run; SI units, z up. The defaults are the paper's walker."""

    robot: Literal["walker", "climber"] = "walker"
    """On the ground, or between two walls; what the recipe is named after."""
    preset: Literal["desk", "paper"] = "paper"
    """Where the other numbers come from before they are overridden: coarse, or the paper's size."""
    out: Path = Path("runs/walker")
    """Folder of the run."""
    resume: bool = False
    """Continue the run in the folder."""
    amend: bool = False
    """Let settings differ from the run's on resume; what changed, and when, is noted in ``amendments.json``."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to compute; auto takes CUDA if there is one."""
    iterations: int = 400
    """Most iterations; the stopping rule may end earlier."""

    size: tuple[float, float, float] = (0.035, 0.035, 0.035)
    """Edges of the body [m]."""
    particles: tuple[int, int, int] = (40, 40, 40)
    """Particles along the edges; a grid cell is two particle spacings."""
    chamber: tuple[float, float, float] = (0.0175, 0.0175, 0.0175)
    """Outer edges of the air chamber in the middle [m]."""
    wall: float = 0.00175
    """Thickness of the chamber wall [m]."""
    room: float = 0.07
    """Space around the body in the analysis box [m]."""

    youngs_modulus: float = 0.44e6
    """Equilibrium Young's modulus [Pa]."""
    poisson_ratio: float = 0.4
    """Poisson ratio."""
    density: float = 1070.0
    """Density of the solid [kg/m3]."""
    elements: int = 3
    """Maxwell elements of the paper's Table S1, 0 to 5."""
    material: Path | None = None
    """Another solid instead, Maxwell elements and all: a material.toml, as recipes/material.py writes."""
    epsilon: float = 1e-5
    """What the void keeps of the solid's mass and stiffness."""
    power: float = 3.0
    """Exponent of the interpolation between void and solid."""
    air_stiffness: float = 0.14e6
    """Air spring of the chamber [Pa]; 0 for a regulated supply."""
    air_viscosity: float = 1.83e-5
    """Shear viscosity of the air [Pa s]."""
    air_density: float | Literal["auto"] = "auto"
    """Density of the air [kg/m3]; auto: 3, but in the updated formulation the paper's 100, artificially high."""

    pressure: float = 80e3
    """Supply pressure while the valve is open [Pa]."""
    frequency: float = 5.0
    """Cycles per second [Hz]."""
    duty: float = 0.5
    """Part of a cycle with the valve open."""
    rise: float = 0.015
    """Time constant of filling [s]."""
    fall: float = 0.025
    """Time constant of venting [s]."""
    pressure_file: Path | None = None
    """Measured pressure instead: CSV with columns time_s and pressure_pa, from the start of the actuation."""

    gravity: float = 9.8
    """[m/s2]."""
    slope: float = 0.0
    """Uphill slope as a fraction: 0.3 is 30 %."""
    friction: Literal["stick"] | float = "stick"
    """Ground and walls hold what is pressed on them, or a Coulomb coefficient."""
    wall_distance: float = 0.035
    """Distance between the climber's walls [m]."""
    gravity_steps: int = 0
    """Raise gravity from zero in so many steps (the climber's continuation); 0 for full gravity from the start."""
    gravity_every: int = 20
    """Iterations between two steps of gravity."""

    dt: float | Literal["auto"] = "auto"
    """Substep [s]; auto takes the largest that is stable. The paper's is 1e-5."""
    halvings: int = 2
    """How often a design on which the simulation breaks down is tried again with half the substep."""
    settle: float = 0.25
    """Time before the actuation starts, to come to rest [s]."""
    duration: float = 0.5
    """Time of actuation [s]."""
    sample_every: float = 0.0025
    """Time between two recorded samples [s]."""
    formulation: Literal["total", "updated"] = "total"
    """Total-Lagrangian, several times faster and without losses; or updated MLS-MPM, the paper's."""
    transfer: Literal["apic", "flip"] = "apic"
    """Transfer between particles and grid, of the updated formulation."""
    void_range: tuple[float, float] = (0.1, 0.3)
    """Densities between which stress goes over from a law of void, which stands being crushed, to the solid's."""
    memory: float = 0.0
    """Memory for the gradient [GiB]; 0 for 2 on a CPU and 16 on a GPU."""

    filter_radius: float = 0.00525
    """Radius of the density filter [m]."""
    beta: float = 8.0
    """Sharpness of the projection."""
    counted: Literal["design", "body"] = "design"
    """Whose centre of gravity travels: the design domain's (the paper's) or the chamber wall's, too."""
    upright: float = 0.0
    """Weight of falling over against travel; 0 in the paper, whose longer runs punish a fall by themselves."""
    sink: float = 0.02
    """What the centre of gravity may sink before it counts as falling, in heights of the body."""
    learning_rate: float = 0.02
    """Of Adam."""
    clip: float = 3.0
    """Largest norm of the gradient; 0 for any. A tumble has one of hundreds, which Adam would remember for long."""
    c_max: float = 0.0125
    """Largest allowed intermediate density C."""
    penalty: float = 1e-3
    """First penalty on C."""
    growth: float = 10.0
    """Factor by which the penalty grows at a plateau."""
    window: int = 4
    """Iterations in each mean of the plateau and stopping rule."""
    tolerance: float = 1e-3
    """Relative change of the mean loss that counts as a plateau."""
    patience: int = 0
    """Iterations after which the penalty grows without a plateau, too, while C is above its limit; 0: never."""
    picture_every: int = 5
    """Iterations between two pictures in TensorBoard."""
    shape_every: int = 10
    """Iterations between two designs that are kept in the folder's shapes."""
    frames: int = 60
    """Pictures in the movie."""
    offset: float = 0.0
    """Thickness added to the outer surface of the printed part [m]."""
    port: float = 0.0
    """Diameter of the air port [m]; 0 for two fifths of the cavity's edge."""

    def __post_init__(self) -> None:
        """Refuse what no module checks by itself."""
        for name in ("upright", "sink", "gravity", "slope", "settle", "room", "memory", "offset", "port", "clip"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"{name} = {value}: wanted finite and at least 0")
        for name in ("duration", "frequency", "learning_rate", "wall_distance", "dt", "pressure", "sample_every"):
            value = getattr(self, name)
            if value != "auto" and not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} = {value}: wanted finite and positive")
        whole = [("settle", "sample_every"), ("duration", "sample_every")]
        if self.dt != "auto":
            whole = [("settle", "dt"), ("duration", "dt"), ("sample_every", "dt"), *whole[:1]]
        for name, unit in whole:
            value, part = getattr(self, name), getattr(self, unit)
            if abs(round(value / part) * part - value) > 1e-6 * value:
                raise ValueError(f"{name} = {value:g} s: wanted a whole number of {unit} = {part:g} s")
        for name in ("iterations", "window", "gravity_every", "picture_every", "shape_every", "frames"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} = {getattr(self, name)}: wanted at least 1")
        for name in ("gravity_steps", "halvings", "patience"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} = {getattr(self, name)}: wanted at least 0")
        if not 0 <= self.void_range[0] < self.void_range[1] <= 1:
            raise ValueError(f"void_range = {self.void_range}: wanted two increasing densities from 0 to 1")
        if not 0 < self.c_max < 0.25:
            raise ValueError(f"c_max = {self.c_max}: wanted more than 0 and less than 0.25")
        if self.device == "cuda" and not torch.cuda.is_available():
            raise ValueError("device = 'cuda': this machine has no CUDA device that torch can use; wanted 'cpu'")

    def gravity_scale(self, iteration: int) -> float:
        """Share of gravity in an iteration (the climber's continuation): min(1, floor(k / every) / steps)."""
        if self.gravity_steps == 0:
            return 1.0
        return min(1.0, (iteration // self.gravity_every) / self.gravity_steps)

    @property
    def target(self) -> torch.device:
        """The device to compute on."""
        auto = "cuda" if torch.cuda.is_available() else "cpu"
        return torch.device(auto if self.device == "auto" else self.device)

    @property
    def free(self) -> tuple[str, ...]:
        """Names of settings that do not change the numbers of a run and may differ on resume."""
        here = ("out", "resume", "amend", "iterations", "device", "memory")
        return (*here, "picture_every", "shape_every", "frames", "offset", "port")


def from_command_line(
    presets: Mapping[str, Settings], *, description: str | None, arguments: Sequence[str] | None = None
) -> Settings:
    """Read settings from the command line: a preset, and any of its numbers overridden.

    Args:
        presets: Named settings; without ``--preset``, "paper" is taken on CUDA and "desk" elsewhere.
        description: Text on top of ``--help``.
        arguments: Instead of the process's own.

    Returns:
        The settings; ends the process with a message if a flag is unknown or a value out of range.
    """
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--preset", default=None)
    first.add_argument("--device", default="auto")
    known, _ = first.parse_known_args(arguments)
    gpu = known.device == "cuda" or (known.device == "auto" and torch.cuda.is_available())
    name = known.preset or ("paper" if gpu else "desk")
    # Of a preset that does not exist, tyro says so.
    default = presets.get(name, presets["desk"])
    # The help joins lines that begin with a letter to paragraphs; commands are to keep theirs.
    text = re.sub(r"\n *(?=(?:python|tensorboard) )", "\n$ ", description or "")
    return tyro.cli(Settings, args=arguments, default=default, description=text)
