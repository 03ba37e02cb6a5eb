"""Every number of a design run in one place, checked one by one and together."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from torchsoro.command_line import AtLeastZero, Count, CountOrZero, Positive, Share, options, parse_resolution
from torchsoro.design.limits import ROUNDING, check_pressure, points_across
from torchsoro.design.processes import world_size
from torchsoro.design.scenarios import LIMITS, Scenarios, check_friction, check_range

if TYPE_CHECKING:
    import torch

# torch is imported where it is used: the command line lists the settings without it.

_SOFTEST = 1e3  # Pa; below the softest gels, so that a smaller modulus is one in another unit
_STEEPEST = 2.0  # rise over run, 63 degrees; a larger slope is one in percent or degrees
_LEAST_SAMPLES = 2  # of a cycle
# Memory of a run, for an estimate [bytes]: of a particle (state, density filter, fields), of a recorded position and
# velocity and what is drawn from them, of a substep (times, pressure, gravity).
_PARTICLE, _FRAME, _STEP = 1024, 48, 64

_Length = Annotated[float, Field(strict=True, ge=1e-6, le=1e3)]
_Density = Annotated[float, Field(strict=True, ge=0, le=1)]
_Friction = Literal["stick"] | AtLeastZero
_Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
_Range = tuple[_Finite, _Finite]
_Place = tuple[_Finite, _Finite, _Finite]
_Edges = tuple[_Length, _Length, _Length]


def cuda_available() -> bool:
    """Whether torch can use a CUDA device."""
    import torch

    return torch.cuda.is_available()


@options
class Settings:
    """Settings of a design run; SI units, z up. The defaults are the paper's walker."""

    robot: Literal["walker", "climber", "turner"] = "walker"
    """On the ground, between two walls, or turning on the spot; what the recipe is named after."""
    preset: Literal["desk", "paper"] = "paper"
    """Where the other numbers come from before they are overridden: coarse, or the paper's size."""
    out: Path = Path("runs/walker")
    """Folder of the run."""
    resume: bool = False
    """Continue the run in the folder."""
    overwrite: bool = False
    """Start again in a folder that holds a run, whose files are deleted."""
    amend: bool = False
    """Let settings differ from the run's on resume; what changed, and when, is noted in ``amendments.json``."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to compute; auto takes CUDA if there is one."""
    iterations: Count = 400
    """Most iterations; the stopping rule may end earlier."""
    starts: Count = 1
    """Designs from initial fields that differ by a millionth, of which the best is delivered; side by side on a CPU."""
    start_from: str = ""
    """Archived robot or finished run whose design is the first, on whatever lattice; an even grey if left out."""
    seconds: AtLeastZero = 0.0
    """Time after which no further iteration begins and the best design is delivered [s]; 0 for any."""

    size: tuple[_Length, _Length, _Length] = (0.035, 0.035, 0.035)
    """Edges of the body [m]."""
    particles: tuple[Count, Count, Count] = (40, 40, 40)
    """Particles along the edges; a grid cell is two particle spacings."""
    chamber: tuple[_Length, _Length, _Length] = (0.0175, 0.0175, 0.0175)
    """Outer edges of the air chamber in the middle [m]."""
    wall: _Length = 0.00175
    """Thickness of the chamber wall [m]."""
    chambers: Annotated[int, Field(strict=True, ge=1, le=16)] = 1
    """Chambers side by side in the middle, each with a wall of its own; together they hold the air of the one."""
    chamber_axis: Literal["x", "y", "z"] = "x"
    """Axis along which several chambers lie, the first at its lower end."""
    chamber_centers: tuple[_Place, ...] = ()
    """Centre of each box chamber [m], x = y = 0 and z = 0 in the middle of the lower face; as above if left out."""
    chamber_sizes: tuple[_Edges, ...] = ()
    """Outer edges of each box chamber [m], walls included; as above if left out."""
    chamber_design: tuple[Literal["place", "size"], ...] = ()
    """What of each box chamber is designed with the body, beginning with what is given; nothing if left out."""
    chamber_edges: tuple[AtLeastZero, AtLeastZero] = (0.0, 0.0)
    """Least and most outer edge of a designed chamber [m]; 0 for a layer of air in its wall, and for the body."""
    chamber_volume: Literal["free", "fixed"] = "free"
    """Whether designed chambers keep the volume of their air, all together."""
    chamber_until: CountOrZero = 0
    """Iteration from which designed chambers stay, on lattice planes, and the body goes on; 0: rounded at the end."""
    chamber_rate: Positive = 0.05
    """Learning rate of a designed chamber, in particle spacings."""
    body_mesh: Path | None = None
    """Closed surface of the body within ``size``, whose lower face is at z = 0 and centred at x = y = 0: STL or MSH."""
    chamber_mesh: Path | None = None
    """Closed surface of the chamber's air, in place of ``chamber``; a wall of ``wall`` is laid around it."""
    mesh_unit: Literal["m", "cm", "mm", "um", "in"] = "mm"
    """Unit of both meshes."""
    room: AtLeastZero = 0.07
    """Space around the body in the analysis box [m]."""

    youngs_modulus: Annotated[float, Field(strict=True, gt=0, le=1e12)] = 0.44e6
    """Equilibrium Young's modulus [Pa]."""
    poisson_ratio: Annotated[float, Field(strict=True, ge=0, lt=0.5)] = 0.4
    """Poisson ratio."""
    density: Annotated[float, Field(strict=True, ge=1, le=1e5)] = 1070.0
    """Density of the solid [kg/m3]."""
    elements: Annotated[int, Field(strict=True, ge=0, le=5)] = 3
    """Maxwell elements of the paper's Table S1, 0 to 5."""
    material: Path | None = None
    """Another solid instead, Maxwell elements and all: a material.toml, as recipes/material.py writes."""
    epsilon: Share = 1e-5
    """What the void keeps of the solid's mass and stiffness."""
    power: Positive = 3.0
    """Exponent of the interpolation between void and solid."""
    air_stiffness: AtLeastZero = 0.14e6
    """Air spring of the chamber [Pa]; 0 for a regulated supply."""
    air_viscosity: AtLeastZero = 1.83e-5
    """Shear viscosity of the air in the updated formulation [Pa s]; the total one has none."""
    air_density: Positive | Literal["auto"] = "auto"
    """Density of the air [kg/m3]; auto: 3, but in the updated formulation the paper's 100, artificially high."""

    pressure: Positive = 80e3
    """Supply pressure while the valve is open [Pa]."""
    frequency: Positive = 5.0
    """Cycles per second [Hz]."""
    duty: Share = 0.5
    """Part of a cycle with the valve open."""
    rise: Positive = 0.015
    """Time constant of filling [s]."""
    fall: Positive = 0.025
    """Time constant of venting [s]."""
    amplitudes: tuple[_Density, ...] = ()
    """Largest pressure of each of several chambers, as a share of ``pressure``; all 1 if left out."""
    phases: tuple[_Density, ...] = ()
    """First opening of the valve of each of several chambers, in cycles after the start; all 0 if left out."""
    duties: tuple[Share, ...] = ()
    """Part of a cycle with the valve open, of each of several chambers; ``duty`` if left out."""
    timing: tuple[Literal["amplitude", "phase", "duty"], ...] = ()
    """What of each chamber's valve is designed with the body, beginning with what is given; nothing if left out."""
    timing_rate: Positive = 0.02
    """Learning rate of a designed timing, whose numbers are shares of pressure and cycle."""
    pressure_file: Path | None = None
    """Measured pressure instead: CSV with columns time_s and pressure_pa, from the start of the actuation."""

    gravity: AtLeastZero = 9.8
    """[m/s2]."""
    slope: AtLeastZero = 0.0
    """Uphill slope as a fraction: 0.3 is 30 %."""
    friction: Literal["stick"] | AtLeastZero = "stick"
    """Ground and walls hold what is pressed on them, or a Coulomb coefficient."""
    wall_distance: _Length = 0.035
    """Distance between the climber's walls [m]."""
    gravity_steps: CountOrZero = 0
    """Raise gravity from zero in so many steps (the climber's continuation); 0 for full gravity from the start."""
    gravity_every: Count = 20
    """Iterations between two steps of gravity."""

    scenarios: CountOrZero = 0
    """Scenarios in which each design is simulated, drawn from the ranges below; 0 for the settings' own one alone."""
    risk: str = "mean"
    """What of the scenarios is maximised: mean, worst, or cvar:0.3 for the mean of the worst three tenths."""
    fresh: bool = False
    """Draw other scenarios in every iteration instead of the same ones."""
    scenario_seed: CountOrZero = 0
    """Seed of the scenarios; with ``fresh`` that of the first iteration, from which the others count on."""
    friction_range: tuple[_Friction, _Friction] = (0.3, "stick")
    """Coulomb coefficient, at even steps of the friction angle."""
    tilt_range: _Range = (-5.0, 5.0)
    """Slope of the floor beyond ``slope``, along x and across [degrees]."""
    slopes: tuple[AtLeastZero, ...] = ()
    """Uphill slopes to which the tilt is added, of as many scenarios each, as fractions; ``slope`` if left out."""
    pressure_range: _Range = (0.85, 1.15)
    """Factor of the supply's pressure."""
    lag_range: _Range = (0.0, 0.0)
    """Time constant of a line behind the supply [s]."""
    modulus_range: _Range = (0.8, 1.2)
    """Factor of Young's modulus."""
    density_range: _Range = (1.0, 1.0)
    """Factor of the solid's density."""
    tube_range: _Range = (0.002, 0.002)
    """Mass of a supply tube that hangs on the air ports, in equal parts on those of several chambers [kg]."""
    pitch_range: _Range = (0.0, 0.0)
    """Angle by which the robot leans forward at the start [degrees]."""
    roll_range: _Range = (0.0, 0.0)
    """Angle by which it leans to its right at the start [degrees]."""
    drop_range: _Range = (0.0, 0.0)
    """Height from which it is dropped at the start [m]."""

    dt: Positive | Literal["auto"] = "auto"
    """Substep [s]; auto takes 0.9 of the largest stable one. The paper's is 1e-5."""
    halvings: Annotated[int, Field(strict=True, ge=0, le=10)] = 2
    """How often a design on which the simulation breaks down is tried again with half the substep."""
    settle: AtLeastZero = 0.25
    """Time before the actuation starts, to come to rest [s]."""
    duration: Positive = 0.5
    """Time of actuation [s]."""
    sample_every: Positive = 0.0025
    """Time between two recorded samples [s]."""
    formulation: Literal["total", "updated"] = "total"
    """Total-Lagrangian, several times faster and without losses; or updated MLS-MPM, the paper's."""
    transfer: Literal["apic", "flip"] = "apic"
    """Transfer between particles and grid, of the updated formulation."""
    self_contact: bool = False
    """Let parts of the body that fold onto each other repel each other, void excepted, in the total formulation."""
    void_range: tuple[_Density, _Density] = (0.1, 0.3)
    """Densities between which stress goes over from a law of void, which stands being crushed, to the solid's."""
    memory: AtLeastZero = 0.0
    """Memory for the gradient [GiB]; 0 for 2 on a CPU and 6 on a GPU, or the least that it takes, if that is more."""

    filter_radius: _Length = 0.00525
    """Radius of the density filter [m]."""
    beta: Positive = 8.0
    """Sharpness of the projection."""
    final_beta: Positive = 24.0
    """The same from the second iteration of ``sharpen`` on."""
    sharpen: tuple[CountOrZero, CountOrZero] = (0, 0)
    """Iterations between which the projection sharpens, and steps shrink in proportion; 0 0 for the paper's, never."""
    feature: AtLeastZero = 0.0
    """Least thickness of walls and gaps [m]; scenarios meet the design, an eroded and a dilated one in turn. 0: any."""
    connected: bool = False
    """Simulate material only as far as it is connected with a chamber, so that the body is in one piece."""
    counted: Literal["design", "body"] = "design"
    """Whose centre of gravity travels: the design domain's (the paper's) or the chamber wall's, too."""
    feet: _Density = 0.0
    """Share of the feet's travel, against that of the centre of gravity, in what is maximised; 0 in the paper."""
    inflated: _Density = 0.0
    """Share at first of the travel while inflated, in place of the whole; fades until the projection is sharp."""
    upright: AtLeastZero = 0.0
    """Weight of falling over against travel; 0 in the paper, whose longer runs punish a fall by themselves."""
    sink: AtLeastZero = 0.02
    """What the centre of gravity may sink before it counts as falling, in heights of the body."""
    lightness: AtLeastZero = 0.0
    """Weight of the mass, as a share of the solid body's, against travel in cells; 0 in the paper."""
    learning_rate: Positive = 0.02
    """Of Adam."""
    clip: AtLeastZero = 3.0
    """Largest norm of the motion's gradient; 0 for any. A tumble has one of hundreds, which Adam remembers."""
    c_max: Annotated[float, Field(strict=True, gt=0, lt=0.25)] = 0.0125
    """Largest allowed intermediate density C."""
    penalty: Positive = 1e-3
    """First penalty on C; of a projection that sharpens, the price of C in the end."""
    growth: Annotated[float, Field(strict=True, gt=1, allow_inf_nan=False)] = 10.0
    """Factor by which the penalty grows at a plateau."""
    window: Count = 4
    """Iterations in each mean of the plateau and stopping rule."""
    tolerance: Positive = 1e-3
    """Relative change of the mean loss that counts as a plateau."""
    patience: CountOrZero = 0
    """Iterations after which the penalty grows without a plateau, too, while C is above its limit; 0: never."""
    picture_every: Count = 5
    """Iterations between two pictures in TensorBoard."""
    shape_every: Count = 10
    """Iterations between two designs that are kept in the folder's shapes."""
    frames: Count = 60
    """Pictures in the movie."""
    resolution: str = "960x640"
    """Of the movie: width x height in pixels."""
    fps: Count = 20
    """Pictures of the movie per second."""
    follow: bool = False
    """Let the movie's camera follow the robot."""
    offset: AtLeastZero = 0.0
    """Thickness added to the outer surface of the printed part [m]."""
    min_wall: AtLeastZero | None = None
    """Thickness up to which thin walls of the printed part are mended [m]; 0 leaves them as they are designed. If left
    out, that of ``feature``, or of ``wall`` if that is less."""
    port: AtLeastZero = 0.0
    """Diameter of the air port [m]; 0 for two fifths of the cavity's edge."""

    def __post_init__(self) -> None:
        """Refuse values that do not fit together, and such that are most likely in another unit."""
        self._check_units()
        self._check_times()
        self._check_scenarios()
        parse_resolution(self.resolution)
        if self.fps > 120:
            raise ValueError(f"fps = {self.fps}: wanted at most 120")
        if self.self_contact and self.formulation != "total":
            raise ValueError(
                f"self_contact = True: beside formulation = {self.formulation!r}, wanted 'total'; "
                "in the updated formulation parts of a body meet on the grid"
            )
        if not self.void_range[0] < self.void_range[1]:
            raise ValueError(f"void_range = {self.void_range}: wanted two increasing densities from 0 to 1")
        if self.offset > 0.25 * min(self.size):
            raise ValueError(
                f"offset = {self.offset:g} m: wanted at most a quarter of the body, {min(self.size) / 4:g} m"
            )
        if self.mended_to > 0.25 * min(self.size):
            raise ValueError(
                f"min_wall = {self.mended_to:g} m: wanted at most a quarter of the body, {min(self.size) / 4:g} m"
            )
        if self.mended_to > 0:
            points_across(self.mended_to, self.size[0] / self.particles[0], max(self.particles))
        self._check_chambers()
        edges = [edge - 2 * self.wall for edge in self.chamber]
        edges["xyz".index(self.chamber_axis)] /= self.chambers
        cavity = min(edges) if not self.chamber_sizes else min(map(min, self.chamber_sizes)) - 2 * self.wall
        low = 0.0 if self.chamber_sizes else 0.05 * cavity  # one that was designed may have grown
        if self.chamber_mesh is None and self.port > 0 and not low <= self.port <= (1 + ROUNDING) * cavity:
            raise ValueError(f"port = {self.port:g} m: wanted 0, or {low:.3g} m to the cavity's edge, {cavity:.3g} m")
        if self.sharpen != (0, 0) and not self.sharpen[0] < self.sharpen[1]:
            raise ValueError(f"sharpen = {self.sharpen}: wanted two increasing iterations, or 0 0")
        for flags in (("resume", "overwrite"), ("amend", "overwrite")):
            if all(getattr(self, flag) for flag in flags):
                raise ValueError(f"{' and '.join(flags)}: wanted one of them, to go on with a run or to start again")
        if self.device == "cuda" and not cuda_available():
            raise ValueError("device = 'cuda': this machine has no CUDA device that torch can use; wanted 'cpu'")

    def _check_chambers(self) -> None:
        """Refuse a timing without several chambers, or of another number of them."""
        for name in ("amplitudes", "phases", "duties"):
            values = getattr(self, name)
            if values and self.chambers == 1:
                raise ValueError(f"{name} = {values}: wanted none for a single chamber, or several chambers (chambers)")
            if values and len(values) != self.chambers:
                raise ValueError(f"{name} = {values}: wanted one for each of the {self.chambers} chambers")
        for name in ("chamber_centers", "chamber_sizes"):
            values = getattr(self, name)
            if values and len(values) != self.chambers:
                raise ValueError(f"{name} = {values}: wanted one for each of the {self.chambers} chambers (chambers)")
        if "phase" in self.timing and self.chambers == 1:
            raise ValueError(f"timing = {self.timing}: wanted no phase for a single chamber, which would only wait")

    def _check_units(self) -> None:
        """Refuse what is far from any elastomer and any slope that is walked on."""
        if self.youngs_modulus < _SOFTEST:
            raise ValueError(
                f"youngs_modulus = {self.youngs_modulus:g} Pa: wanted at least {_SOFTEST:g} Pa; 0.44 MPa is 440000"
            )
        if self.material is None:
            check_pressure("pressure", self.pressure, self.youngs_modulus)
        if self.slope > _STEEPEST:
            raise ValueError(
                f"slope = {self.slope:g}: wanted rise over run, at most {_STEEPEST:g}; "
                "30 % is 0.3, 30 degrees are 0.577"
            )

    def _check_times(self) -> None:
        """Refuse times that are no whole number of the shorter ones, and cycles too short to be sampled."""
        whole = [("settle", "sample_every"), ("duration", "sample_every")]
        if self.dt != "auto":
            whole = [("settle", "dt"), ("duration", "dt"), ("sample_every", "dt"), *whole[:1]]
        for name, unit in whole:
            value, part = getattr(self, name), getattr(self, unit)
            if value > 1e9 * part:
                raise ValueError(f"{name} = {value:g} s: wanted at most 1e9 times {unit} = {part:g} s")
            if abs(round(value / part) * part - value) > 1e-6 * value:
                raise ValueError(f"{name} = {value:g} s: wanted a whole number of {unit} = {part:g} s")
        if self.frequency * self.sample_every * _LEAST_SAMPLES > 1:
            raise ValueError(
                f"frequency = {self.frequency:g} Hz: wanted at most {1 / (_LEAST_SAMPLES * self.sample_every):g} Hz, "
                f"{_LEAST_SAMPLES} samples of sample_every = {self.sample_every:g} s in each cycle"
            )

    def _check_scenarios(self) -> None:
        """Refuse bad ranges, a bad risk, and features that the filter cannot tell."""
        if self.feature > 0:
            from torchsoro.design.features import threshold_of

            threshold_of(self.filter_radius, self.feature)
            if 0 < self.scenarios < 3:
                raise ValueError(
                    f"feature = {self.feature:g} m: wanted at least 3 scenarios (scenarios = {self.scenarios}), as the "
                    "design, an eroded and a dilated one take turns in them"
                )
        check_friction("friction_range", self.friction_range)
        for name, (least, most, unit) in LIMITS.items():
            setting = {"tilt_x": "tilt", "tilt_y": "tilt"}.get(name, name.partition("_")[0])
            check_range(f"{setting}_range", getattr(self, f"{setting}_range"), least, most, unit)
        if any(slope > _STEEPEST for slope in self.slopes):
            raise ValueError(f"slopes = {self.slopes}: wanted rise over run, at most {_STEEPEST:g}; 30 % is 0.3")
        if self.risk != "mean":
            from torchsoro.design.risk import parse_risk

            parse_risk(self.risk)

    @property
    def distribution(self) -> Scenarios:
        """Of the scenarios."""
        return Scenarios(
            friction=self.friction_range,
            tilt_x=self.tilt_range,
            tilt_y=self.tilt_range,
            slopes=self.slopes,
            pressure_gain=self.pressure_range,
            lag=self.lag_range,
            modulus_factor=self.modulus_range,
            density_factor=self.density_range,
            tube_mass=self.tube_range,
            pitch=self.pitch_range,
            roll=self.roll_range,
            drop=self.drop_range,
        )

    def check_memory(self, dt: float | None = None) -> None:
        """Refuse a run that the device cannot hold.

        Args:
            dt: Substep [s], once it is known.

        Raises:
            ValueError: if an estimate of its memory is more than the device has.
        """
        nx, ny, nz = self.particles
        time = self.settle + self.duration
        each = nx * ny * nz * (_PARTICLE + _FRAME * time / self.sample_every) + (0 if dt is None else _STEP * time / dt)
        need = each * max(1, self.scenarios)
        if self.target.type == "cuda":
            import torch

            need = each * max(1, math.ceil(self.scenarios / world_size()))  # each process has a GPU
            have = torch.cuda.get_device_properties(self.target).total_memory
        else:
            have = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else math.inf
        if need > have:
            steps = "" if dt is None else f", {time / dt:.3g} substeps of {dt:.3g} s"
            raise ValueError(
                f"particles = {self.particles}, duration = {self.duration:g} s: about {need / 2**30:.3g} GiB "
                f"({nx * ny * nz} particles, {time / self.sample_every:.3g} samples{steps}); "
                f"wanted at most the {have / 2**30:.3g} GiB of this {self.target.type}"
            )

    def sharpened(self, iteration: int) -> float:
        """How far the projection has sharpened in an iteration, from 0 to 1."""
        first, last = self.sharpen
        return 1.0 if iteration >= last else max(0.0, (iteration - first) / (last - first))

    def sharpness(self, iteration: int) -> float:
        """Sharpness of the projection in an iteration: rises by the same factor in each."""
        return self.beta * (self.final_beta / self.beta) ** self.sharpened(iteration) if self.sharpen[1] else self.beta

    def sharp(self, beta: float) -> float:
        """How far a projection of this sharpness has sharpened, from 0 to 1; 1 where it never does."""
        if not self.sharpen[1] or self.final_beta == self.beta:
            return 1.0
        return min(1.0, max(0.0, math.log(beta / self.beta) / math.log(self.final_beta / self.beta)))

    def gravity_scale(self, iteration: int) -> float:
        """Share of gravity in an iteration (the climber's continuation): min(1, floor(k / every) / steps)."""
        if self.gravity_steps == 0:
            return 1.0
        return min(1.0, (iteration // self.gravity_every) / self.gravity_steps)

    @property
    def counts_from(self) -> int:
        """First iteration whose design may be the best: with full gravity, and the whole thickness of features."""
        first, last = self.sharpen
        return max(self.gravity_every * self.gravity_steps, 2 * last - first if self.feature else 0)

    @property
    def mended_to(self) -> float:
        """Thickness up to which thin walls of the printed part are mended [m]; 0 for none."""
        return min(self.feature, self.wall) if self.min_wall is None else self.min_wall

    @property
    def target(self) -> torch.device:
        """The device to compute on."""
        import torch

        auto = "cuda" if torch.cuda.is_available() else "cpu"
        return torch.device(auto if self.device == "auto" else self.device)

    @property
    def free(self) -> tuple[str, ...]:
        """Names of settings that do not change the numbers of a run and may differ on resume."""
        here = ("out", "resume", "amend", "overwrite", "iterations", "starts", "seconds", "device", "memory")
        return (
            *here,
            "picture_every",
            "shape_every",
            "frames",
            "resolution",
            "fps",
            "follow",
            "offset",
            "min_wall",
            # Cut out of the body while designing, or what the least chamber has to hold.
            *(() if self.feature or self.chamber_design else ("port",)),
        )
