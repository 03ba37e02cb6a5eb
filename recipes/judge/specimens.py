"""Bodies with what their experimenter believes, the same in every case: so tables made once serve all cases."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from experiment import Trial, toml
from lobatto import Floats, Mesh, box_mesh
from march import mesh_of


@dataclass(frozen=True, kw_only=True)
class Specimen:
    """A body and what is done to it.

    Attributes:
        name: Key of ``SPECIMENS``.
        setup: Tables of setup.toml.
        trials: Given ones and, last, the one held out.
        rate: Of the camera [Hz].
        edge: Of the judge's elements [m].
        effects: Names that make sense for it.
        outside: Effects outside the library that make sense for it.
    """

    name: str
    setup: dict[str, Any]
    trials: tuple[Trial, ...]
    rate: float
    edge: float
    effects: tuple[str, ...]
    outside: tuple[str, ...]

    @property
    def length(self) -> float:
        """Longest edge of the body [m]."""
        return float(max(self.setup["body"]["size"]))

    @property
    def body_mass(self) -> float:
        """Believed mass [kg]."""
        volume = np.prod(self.setup["body"]["size"])
        boxes = [c["box"] for c in self.setup.get("chamber", [])] + self.setup["body"].get("missing", [])
        for low, high in boxes:
            volume -= np.prod(np.asarray(high) - np.asarray(low))
        return float(volume * self.setup["material"]["density"])

    def write(self, folder: Path, recording: dict[str, Any]) -> None:
        """Write setup.toml, and the outer surface of a body that is no box."""
        told = {**self.setup, "recording": recording}
        if self.setup["body"].get("missing"):
            told["body"] = {"shape": "mesh", "file": "body.stl"}
            (folder / "body.stl").write_bytes(stl(surface(self.setup["body"])))
        (folder / "setup.toml").write_text(toml(told))


def surface(body: dict[str, Any]) -> Floats:
    """Outer surface of a box less what is missing, of elements as large as they can be: triangles [T, 3, 3] m."""
    mesh = box_mesh(body["origin"], body["size"], [], math.inf, body["missing"])
    corners = mesh.nodes[mesh.outside.nodes[:, [0, 2, 8, 6]]]
    outward = np.where(mesh.outside.sign[:, None, None] > 0, corners, corners[:, ::-1])
    return np.concatenate([outward[:, [0, 1, 2]], outward[:, [0, 2, 3]]])


def stl(triangles: Floats) -> bytes:
    """Triangles [T, 3, 3] as a binary STL."""
    facet = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    facets = np.zeros(len(triangles), facet)
    facets["corners"] = triangles
    facets["normal"] = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    facets["normal"] /= np.linalg.norm(facets["normal"], axis=1, keepdims=True)
    return bytes(80) + np.uint32(len(facets)).tobytes() + facets.tobytes()


def _setup(title: str, size: Sequence[float], origin: Sequence[float], **tables: Any) -> dict[str, Any]:
    material = {"density": 1070.0, "youngs_modulus": 240e3, "poisson_ratio": 0.4, "prony": [[0.3, 0.004]]}
    start: dict[str, Any] = {
        "title": title,
        "gravity": tables.pop("gravity", [0.0, 0.0, -9.81]),
        "duration": tables.pop("duration", 1.0),
    }
    if "start" not in tables:
        start["start"] = "rest"
    markers = [{"name": f"m{i + 1}", "at": list(at)} for i, at in enumerate(tables.pop("markers"))]
    kind = {"kind": "mocap"} if tables.pop("mocap", True) else {"kind": "video", "axes": ["x", "z"]}
    return {
        **start,
        "body": {"shape": "box", "size": list(size), "origin": list(origin)},
        "material": {**material, **tables.pop("material", {})},
        **tables,
        "marker": markers,
        "recording": kind,
    }


def _load(box: Sequence[Sequence[float]], force: Sequence[float], start: float = 0.0) -> dict[str, Any]:
    return {"box": [list(b) for b in box], "force": list(force), "start": start}


MATERIAL = ("viscoelastic", "modulus", "soft_side", "density", "attached_mass", "stiffening", "softening", "drag")
AIR = ("pressure_lag", "pressure_loss", "leak", "air_stiffness")
SUPPLY_LAG = 0.008  # of each of the two volumes in series through which pressure reaches a chamber [s]
WALKING_LAG = 0.018  # the same of bodies that walk [s]: with 8 ms they hop, and land elsewhere on every mesh
WALKING = (
    *("viscoelastic", "modulus", "soft_side", "density", "attached_mass", "tether", "friction", "gravity_tilt"),
    *AIR,
)


@functools.cache
def bar() -> Specimen:
    """A bar clamped at one end and let go: under its weight, and under loads."""
    tip = [[-0.012, 0.009, 0.016], [0.0, 0.021, 0.028]]
    setup = _setup(
        "soft bar, let go",
        (0.096, 0.030, 0.028),
        (-0.096, 0.0, 0.0),
        clamp=[{"box": [[-0.097, -0.001, -0.001], [-0.0959, 0.031, 0.029]]}],
        markers=[
            (0, 0.015, 0.028), (0, 0.002, 0.020), (0, 0.028, 0.005), (-0.032, 0.015, 0.028), (-0.048, 0, 0.014),
            (-0.066, 0.030, 0.020),
        ],
    )  # fmt: skip
    trials = (
        Trial(name="a"),
        Trial(name="b", tables={"load": [_load(tip, (0, 0, -0.45))]}),
        Trial(name="c", tables={"load": [_load(tip, (0, 0.40, 0.15), 0.2)]}),
        Trial(name="d", held_out=True, tables={"load": [_load(tip, (0, -0.2, -0.3), 0.1)]}),
    )
    names = (*MATERIAL, "tether", "gravity_tilt", "initial_motion")
    return Specimen(
        name="bar", setup=setup, trials=trials, rate=125, edge=0.008, effects=names,
        outside=("sloshing", "magnet", "gust", "heat"),
    )  # fmt: skip


@functools.cache
def post() -> Specimen:
    """A standing post, pushed by loads that come one after the other; filmed from the side."""
    top = [[0.008, 0.008, 0.066], [0.026, 0.020, 0.078]]
    front = [[0.022, 0.002, 0.066], [0.034, 0.026, 0.078]]
    setup = _setup(
        "standing post, pushed",
        (0.034, 0.028, 0.078),
        (0.0, 0.0, 0.0),
        material={"youngs_modulus": 190e3, "density": 1100.0, "prony": [[0.5, 0.003]]},
        clamp=[{"box": [[-0.001, -0.001, -0.001], [0.035, 0.029, 0.0001]]}],
        markers=[
            (0.017, 0.0, 0.078), (0.004, 0.0, 0.070), (0.030, 0.0, 0.066), (0.006, 0.0, 0.046), (0.028, 0.0, 0.050),
            (0.017, 0.0, 0.026),
        ],
        mocap=False,
    )  # fmt: skip
    trials = (
        Trial(name="a", tables={"load": [_load(top, (0.8, 0, 0), 0.05), _load(top, (-1.4, 0, 0), 0.45)]}),
        Trial(name="b", tables={"load": [_load(front, (0, 0, -1.2)), _load(top, (0.5, 0, 0), 0.4)]}),
        Trial(name="c", tables={"load": [_load(top, (-1.2, 0, 0.4), 0.1), _load(top, (1.2, 0, -0.4), 0.5)]}),
        Trial(name="d", held_out=True, tables={"load": [_load(top, (1.1, 0, 0)), _load(front, (-0.4, 0, -0.8), 0.5)]}),
    )
    names = (*MATERIAL, "tether", "gravity_tilt", "initial_motion")
    return Specimen(
        name="post", setup=setup, trials=trials, rate=120, edge=0.0085, effects=names,
        outside=("sloshing", "magnet", "gust", "heat"),
    )  # fmt: skip


def _pulses(duration: float, *stops: tuple[float, float], lag: float = SUPPLY_LAG) -> tuple[tuple[float, float], ...]:
    """Pressure behind two volumes in series, each with a lag [s]; the supply steps at (time [s], pressure [Pa])."""
    t = np.arange(0, duration + 0.1, 0.004)
    target = np.zeros_like(t)
    for start, pressure in stops:
        target[t >= start] = pressure
    p, now, share = np.empty_like(t), np.zeros(2), 1 - np.exp(-0.004 / lag)
    for i, goal in enumerate(target):
        now[0] += share * (goal - now[0])
        now[1] += share * (now[0] - now[1])
        p[i] = now[1]
    return tuple((round(float(a), 6), round(float(b), 3)) for a, b in zip(t, p, strict=True))


@functools.cache
def finger() -> Specimen:
    """A hanging finger with a chamber off its middle, bent by patterns of pressure."""
    setup = _setup(
        "pneumatic finger",
        (0.096, 0.024, 0.028),
        (0.0, 0.0, 0.0),
        gravity=[9.81, 0.0, 0.0],
        material={"youngs_modulus": 155e3, "density": 1060.0, "prony": [[0.4, 0.005]]},
        clamp=[{"box": [[-0.001, -0.001, -0.001], [0.0001, 0.025, 0.029]]}],
        chamber=[{"name": "c1", "box": [[0.008, 0.006, 0.014], [0.088, 0.018, 0.022]], "air_stiffness": 0.0}],
        markers=[
            (0.096, 0.012, 0.026), (0.096, 0.002, 0.004), (0.096, 0.022, 0.004), (0.068, 0.012, 0.0),
            (0.042, 0.0, 0.006), (0.042, 0.024, 0.006), (0.054, 0.012, 0.028),
        ],
    )  # fmt: skip
    trials = (
        Trial(name="a", pressure=_pulses(1.0, (0.08, 18e3), (0.55, 0.0))),
        Trial(name="b", pressure=_pulses(1.0, *((0.05 + 0.16 * i, 14e3 * (1 - i % 2)) for i in range(6)))),
        Trial(name="c", pressure=_pulses(1.0, (0.05, 6e3), (0.3, 12e3), (0.5, 20e3), (0.75, 9e3))),
        Trial(name="d", held_out=True, pressure=_pulses(1.0, (0.1, 20e3), (0.35, 8e3), (0.6, 16e3), (0.85, 0.0))),
    )
    names = (*MATERIAL, *AIR, *AIR, "tether", "gravity_tilt", "initial_motion")
    return Specimen(
        name="finger", setup=setup, trials=trials, rate=125, edge=0.0062, effects=names,
        outside=("sloshing", "magnet", "gust", "heat"),
    )  # fmt: skip


def _thrown(name: str, held_out: bool, *start: float, spin: Sequence[float] = (0, 0, 0)) -> Trial:
    tables: dict[str, Any] = {"start": {"velocity": list(start)}}
    if any(spin):
        tables["start"]["angular_velocity"] = list(spin)
    return Trial(name=name, held_out=held_out, tables=tables)


@functools.cache
def pad() -> Specimen:
    """A pad that lies on a plate to which it is believed to stick; an edge is lifted, or pushed to and fro."""
    right = [[0.078, 0.008, 0.0], [0.090, 0.032, 0.014]]
    left = [[0.0, 0.008, 0.0], [0.012, 0.032, 0.014]]
    setup = _setup(
        "soft pad on a plate, lifted and pushed",
        (0.090, 0.040, 0.014),
        (0.0, 0.0, 0.0003),
        duration=0.8,
        material={"youngs_modulus": 80e3, "density": 1100.0, "prony": [[0.8, 0.004]]},
        plane=[{"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0], "friction": "stick"}],
        markers=[
            (0.090, 0.020, 0.010), (0.090, 0.006, 0.006), (0.070, 0.020, 0.0143), (0.045, 0.0, 0.008),
            (0.0, 0.020, 0.010), (0.020, 0.030, 0.0143),
        ],
    )  # fmt: skip

    def pulls(name: str, *steps: tuple[Any, ...], held_out: bool = False) -> Trial:
        return Trial(name=name, held_out=held_out, tables={"load": [_load(*step) for step in steps]})

    trials = (
        pulls("a", (right, (0, 0, 0.17), 0.1), (right, (0, 0, -0.17), 0.5)),
        pulls("b", (left, (0.3, 0, 0), 0.08), (left, (-0.3, 0, 0), 0.2), (left, (-0.35, 0, 0), 0.45),
              (left, (0.35, 0, 0), 0.58)),
        pulls("c", (right, (0.10, 0.10, 0.12), 0.1), (right, (-0.10, -0.10, -0.12), 0.3), (left, (0, 0, 0.15), 0.45)),
        pulls("d", (right, (-0.15, 0.05, 0.13), 0.1), (right, (0.15, -0.05, -0.03), 0.35), held_out=True),
    )  # fmt: skip
    names = ("friction", "friction", "adhesion", "adhesion", "wall_offset", "density", "viscoelastic",
             "attached_mass", "modulus", "soft_side")  # fmt: skip
    return Specimen(
        name="pad", setup=setup, trials=trials, rate=150, edge=0.0031, effects=names,
        outside=("foam", "magnet", "gust", "sloshing"),
    )  # fmt: skip


@functools.cache
def slider() -> Specimen:
    """A flat block that slides on a plate of believed friction; filmed from the side."""
    setup = _setup(
        "soft block, sliding",
        (0.072, 0.048, 0.024),
        (0.0, 0.0, 0.002),
        duration=0.6,
        material={"youngs_modulus": 320e3, "density": 1080.0, "prony": [[0.8, 0.003]]},
        start={"velocity": [0.5, 0.0, 0.0]},
        plane=[{"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0], "friction": 0.4}],
        markers=[
            (0.036, 0.0, 0.026), (0.066, 0.0, 0.022), (0.006, 0.0, 0.022), (0.058, 0.0, 0.008), (0.014, 0.0, 0.008),
        ],
        mocap=False,
    )  # fmt: skip
    trials = (
        _thrown("a", False, 0.5, 0, 0),
        _thrown("b", False, 0.8, 0, -0.1),
        _thrown("c", False, -0.4, 0, -0.25),
        _thrown("d", True, 0.65, 0, -0.15),
    )
    names = ("friction", "friction", "adhesion", "wall_offset", "gravity_tilt", "initial_motion", "attached_mass")
    return Specimen(
        name="slider",
        setup=setup,
        trials=trials,
        rate=150,
        edge=0.012,
        effects=names,
        outside=("foam", "magnet", "gust"),
    )


def _beats(period: float, *peaks: float) -> tuple[tuple[float, float], ...]:
    """Pressure that comes and goes, to each peak once a period [s]."""
    stops = [(0.06 + period * (i + on / 2), (1 - on) * p) for i, p in enumerate(peaks) for on in (0, 1)]
    return _pulses(1.0, *stops, lag=WALKING_LAG)


def _walks() -> tuple[Trial, ...]:
    """Trials of a body that walks, of different rhythms."""
    return (
        Trial(name="a", pressure=_beats(0.22, *(13e3,) * 4)),
        Trial(name="b", pressure=_beats(0.30, 15e3, 10e3, 15e3)),
        Trial(name="c", pressure=_beats(0.18, *(12e3,) * 5)),
        Trial(name="d", held_out=True, pressure=_beats(0.26, 14e3, 13e3, 11e3)),
    )


@functools.cache
def crawler() -> Specimen:
    """A block with a chamber off its middle, which walks on a plate to which it is believed to stick."""
    setup = _setup(
        "pneumatic block that walks on a plate",
        (0.064, 0.036, 0.036),
        (0.0, 0.0, 0.0002),
        material={"youngs_modulus": 140e3, "density": 1080.0, "prony": [[0.4, 0.004]]},
        chamber=[{"name": "c1", "box": [[0.008, 0.008, 0.0082], [0.040, 0.028, 0.0202]], "air_stiffness": 0.0}],
        plane=[{"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0], "friction": "stick"}],
        markers=[
            (0.032, 0.018, 0.0362), (0.060, 0.004, 0.0362), (0.060, 0.032, 0.0362), (0.004, 0.018, 0.0362),
            (0.064, 0.018, 0.018), (0.052, 0.0, 0.010),
        ],
    )  # fmt: skip
    return Specimen(
        name="crawler", setup=setup, trials=_walks(), rate=150, edge=0.0041, effects=WALKING,
        outside=("foam", "magnet", "gust", "sloshing"),
    )  # fmt: skip


@functools.cache
def block() -> Specimen:
    """A block that is thrown on a plate, lands on its base and comes to rest."""
    setup = _setup(
        "soft block, thrown",
        (0.046, 0.038, 0.026),
        (0.0, 0.0, 0.004),
        duration=0.5,
        material={"youngs_modulus": 220e3, "density": 1090.0, "prony": [[1.0, 0.004]]},
        start={"velocity": [0.5, 0.0, 0.0]},
        plane=[{"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0], "friction": 0.5}],
        markers=[
            (0.023, 0.019, 0.030), (0.043, 0.004, 0.030), (0.043, 0.034, 0.030), (0.003, 0.019, 0.030),
            (0.046, 0.019, 0.014), (0.006, 0.0, 0.012),
        ],
    )  # fmt: skip
    trials = (
        _thrown("a", False, 0.5, 0, 0),
        _thrown("b", False, 0.35, 0.3, 0.1),
        _thrown("c", False, -0.6, 0, 0, spin=(0, 0, 3)),
        _thrown("d", True, 0.45, -0.2, 0, spin=(0, 0, -2)),
    )
    names = (
        "friction",
        "friction",
        "initial_motion",
        "attached_mass",
        "viscoelastic",
        "gravity_tilt",
        "adhesion",
        "modulus",
    )
    return Specimen(
        name="block", setup=setup, trials=trials, rate=200, edge=0.0066, effects=names,
        outside=("foam", "magnet", "gust", "sloshing"),
    )  # fmt: skip


@functools.cache
def robot() -> Specimen:
    """A trunk with a chamber on four legs, which walks on a plate to which it is believed to stick."""
    setup = _setup(
        "pneumatic robot on four legs",
        (0.064, 0.036, 0.038),
        (0.0, 0.0, 0.0002),
        material={"youngs_modulus": 150e3, "density": 1080.0, "prony": [[0.4, 0.004]]},
        chamber=[{"name": "c1", "box": [[0.012, 0.008, 0.0162], [0.048, 0.028, 0.0262]], "air_stiffness": 0.0}],
        plane=[{"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0], "friction": "stick"}],
        markers=[
            (0.032, 0.018, 0.0382), (0.060, 0.004, 0.0382), (0.060, 0.032, 0.0382), (0.004, 0.018, 0.0382),
            (0.064, 0.018, 0.026), (0.052, 0.0, 0.006), (0.010, 0.0, 0.006),
        ],
    )  # fmt: skip
    setup["body"]["missing"] = [
        [[0.016, 0.0, 0.0002], [0.048, 0.036, 0.0122]],
        [[0.0, 0.012, 0.0002], [0.016, 0.024, 0.0122]],
        [[0.048, 0.010, 0.0002], [0.064, 0.026, 0.0122]],
        [[0.056, 0.0, 0.0002], [0.064, 0.010, 0.0122]],
        [[0.056, 0.026, 0.0002], [0.064, 0.036, 0.0122]],
    ]
    return Specimen(
        name="robot", setup=setup, trials=_walks(), rate=150, edge=0.0041, effects=WALKING,
        outside=("foam", "magnet", "gust", "sloshing"),
    )  # fmt: skip


SPECIMENS = {
    "bar": bar,
    "finger": finger,
    "pad": pad,
    "slider": slider,
    "post": post,
    "crawler": crawler,
    "block": block,
    "robot": robot,
}
FORMER = ("bar", "finger", "pad", "slider", "post")  # of which the batches up to the tenth were drawn


@functools.cache
def mesh_for(name: str, finer: float = 1.0) -> Mesh:
    """Mesh of a specimen; ``finer`` divides its elements' edge."""
    specimen = SPECIMENS[name]()
    return mesh_of(specimen.setup, specimen.edge / finer)
