"""What may stand in ``setup.toml`` and ``trial.toml``: tables, keys and the values that each may have.

The models check types and ranges of single tables; a :class:`pydantic.ValidationError` is put into words that name
file, table, key, value and what is wanted. What several tables say together is checked where they are read
(:mod:`torchsoro.sim2real.data.experiment`).
"""

from __future__ import annotations

import math
import tomllib
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from annotated_types import Ge, Gt, Interval, Le
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    Strict,
    StrictInt,
    StrictStr,
    ValidationError,
    model_validator,
)
from pydantic_core import ErrorDetails

from torchsoro.sim2real.data.recording import brief
from torchsoro.simulation.plausible import DENSITY, MODULUS

# Ranges that hold every soft body and its motion in SI units, as those of its material do; what lies outside is in
# another unit.
LENGTH = (1e-4, 10.0)  # m, edges of a body
LONGEST = 1000.0  # s, a trial
MODES = 5  # Maxwell elements

Number = Annotated[float, Strict(), Field(allow_inf_nan=False)]
Vector = tuple[Number, Number, Number]
Coordinate = Annotated[Number, Interval(ge=-1e4, le=1e4)]
Place = tuple[Coordinate, Coordinate, Coordinate]
Edge = Annotated[Number, Interval(ge=LENGTH[0], le=LENGTH[1])]
Speed = Annotated[Number, Interval(ge=-1e3, le=1e3)]
Turn = Annotated[Number, Interval(ge=-1e4, le=1e4)]
Pull = Annotated[Number, Interval(ge=-1e6, le=1e6)]
Time = Annotated[Number, Interval(ge=0.0, le=LONGEST)]
Model = TypeVar("Model", bound=BaseModel)


def _ordered(box: tuple[Place, Place]) -> tuple[Place, Place]:
    if not all(low < high for low, high in zip(*box, strict=True)):
        raise ValueError
    return box


def _named(name: str) -> str:
    if not 0 < len(name) <= 64 or name != name.strip() or not name.isprintable():
        raise ValueError
    return name


def _different(axes: tuple[str, ...]) -> tuple[str, ...]:
    if not axes or len(set(axes)) != len(axes):
        raise ValueError
    return axes


def _ending(end: float) -> float:
    if not (0 <= end <= LONGEST or end == math.inf):
        raise ValueError
    return end


def _directed(normal: Vector) -> Vector:
    if not 1e-6 <= math.hypot(*normal) <= 1e6:
        raise ValueError
    return normal


def _at_rest(start: object) -> object:
    return {} if start == "rest" else start


Box = tuple[Place, Place]
CheckedBox = Annotated[Box, AfterValidator(_ordered)]
Name = Annotated[StrictStr, AfterValidator(_named)]

_BOX = "two corners [[x, y, z], [x, y, z]] in metres, the lower corner first"
_NAME = "a text of 1 to 64 printable characters without blanks at its ends"
_VECTOR = "three finite numbers"


class Table(BaseModel):
    """A table of which every key is known."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class StartTable(Table):
    """How the body moves at t = 0, undeformed; at rest if nothing is said.

    Attributes:
        velocity: Of the whole body [m/s].
        angular_velocity: About the centre of its box [rad/s].
    """

    velocity: tuple[Speed, Speed, Speed] = Field(default=(0.0, 0.0, 0.0), description=f"{_VECTOR} up to 1000 m/s")
    angular_velocity: tuple[Turn, Turn, Turn] = Field(
        default=(0.0, 0.0, 0.0), description=f"{_VECTOR} up to 10000 rad/s"
    )


class BodyTable(Table):
    """The undeformed body: a box, or a closed surface.

    Attributes:
        shape: "box" or "mesh".
        size: Edge lengths of a box [m].
        origin: Lower corner [m]; of a mesh None for where it is in its file.
        file: The mesh, beside setup.toml or below.
        scale: Metres in a unit of the mesh.
    """

    shape: Literal["box", "mesh"] = Field(default="box", description='"box" or "mesh"')
    size: tuple[Edge, Edge, Edge] | None = Field(
        default=None, description=f"three finite numbers from {LENGTH[0]:g} to {LENGTH[1]:g} m: is the unit right?"
    )
    origin: Place | None = Field(default=None, description=f"{_VECTOR} in metres")
    file: Annotated[StrictStr, Field(min_length=1, max_length=1000)] | None = Field(
        default=None, description="the name of an STL, OBJ or PLY file"
    )
    scale: Annotated[Number, Interval(ge=1e-9, le=1e9)] | None = Field(
        default=None, description="a positive number of metres in a unit of the mesh"
    )

    @model_validator(mode="after")
    def _fits_its_shape(self) -> BodyTable:
        wanted, other = (("size",), ("file", "scale")) if self.shape == "box" else (("file",), ("size",))
        if missing := [key for key in wanted if getattr(self, key) is None]:
            raise ValueError(f"no {missing[0]}, wanted one as shape = {self.shape!r}")
        if extra := [key for key in other if getattr(self, key) is not None]:
            raise ValueError(f"unknown {', '.join(extra)}, wanted none as shape = {self.shape!r}")
        return self


class Material(Table):
    """What is believed of the material.

    Attributes:
        density: [kg/m3].
        youngs_modulus: At equilibrium [Pa].
        poisson_ratio: Below 0.5.
        prony: Maxwell elements: modulus relative to equilibrium, relaxation time [s].
    """

    density: Annotated[Number, Interval(ge=DENSITY[0], le=DENSITY[1])] = Field(
        description=f"{DENSITY[0]:g} to {DENSITY[1]:g} kg/m3: is the unit right?"
    )
    youngs_modulus: Annotated[Number, Interval(ge=MODULUS[0], le=MODULUS[1])] = Field(
        description=f"{MODULUS[0]:g} to {MODULUS[1]:g} Pa: is the unit right?"
    )
    poisson_ratio: Annotated[Number, Interval(ge=0.0, le=0.4999)] = Field(
        description="a finite number from 0 to 0.4999; steps get shorter as it nears 0.5, and 0.49 bends the same"
    )
    prony: tuple[
        tuple[
            Annotated[Number, Interval(gt=0.0, le=1e6)],
            Annotated[Number, Interval(ge=1e-9, le=1e9)],
        ],
        ...,
    ] = Field(
        default=(),
        max_length=MODES,
        description="at most five pairs of positive numbers [relative modulus up to 1e6, relaxation time in s]",
    )


class ClampTable(Table):
    """Body points in a box are held still.

    Attributes:
        box: [m].
    """

    box: CheckedBox = Field(description=_BOX)


class ChamberTable(Table):
    """A void inside the body, pressed on all its walls.

    Attributes:
        name: Of the chamber.
        box: [m].
        air_stiffness: Pressure that the chamber loses as its volume doubles [Pa]; 0 for a regulated supply.
    """

    name: Name = Field(description=_NAME)
    box: CheckedBox = Field(description=_BOX)
    air_stiffness: Annotated[Number, Interval(ge=0.0, le=1e9)] = Field(
        default=0.0, description="a finite number of at least 0, in Pa"
    )


class PlaneTable(Table):
    """Ground or wall; the body stays on the side that ``normal`` points to.

    Attributes:
        point: On the plane [m].
        normal: Of any length.
        friction: "stick", or a Coulomb coefficient.
    """

    point: Place = Field(description=f"{_VECTOR} in metres")
    normal: Annotated[Vector, AfterValidator(_directed)] = Field(description=f"{_VECTOR}, not all zero")
    friction: Literal["stick"] | Annotated[Number, Ge(0.0), Le(1e9)] = Field(
        default="stick", description='"stick" or a coefficient of at least 0'
    )


class ForceTable(Table):
    """Dead force on the body points in a box.

    Attributes:
        box: [m].
        force: [N].
        start: [s].
        ramp: Over which it grows at first [s].
        end: [s]; inf if it does not end.
    """

    box: CheckedBox = Field(description=_BOX)
    force: tuple[Pull, Pull, Pull] = Field(description=f"{_VECTOR} up to 1e6 N")
    start: Time = Field(default=0.0, description=f"a time from 0 to {LONGEST:g} s")
    ramp: Time = Field(default=0.0, description=f"a time from 0 to {LONGEST:g} s")
    end: Annotated[float, Strict(), AfterValidator(_ending)] = Field(
        default=math.inf, description=f"a time up to {LONGEST:g} s"
    )

    @model_validator(mode="after")
    def _ends_after_it_has_grown(self) -> ForceTable:
        if not self.end > self.start + self.ramp:
            raise ValueError(f"end = {self.end:g}, wanted one after it has grown, at {self.start + self.ramp:g} s")
        return self


class Marker(Table):
    """A tracked point; it moves with the nearest surface point.

    Attributes:
        name: As in the columns of markers.csv.
        at: In the undeformed body [m].
    """

    name: Name = Field(description=_NAME)
    at: Place = Field(description=f"{_VECTOR} in metres")


class RecordingTable(Table):
    """How markers were recorded.

    Attributes:
        kind: "mocap" (metres) or "video" (scale not exact).
        axes: Recorded axes.
        noise: Standard deviation of a marker's coordinate [m] where it is known.
    """

    kind: Literal["mocap", "video"] = Field(default="mocap", description='"mocap" or "video"')
    axes: Annotated[tuple[Literal["x", "y", "z"], ...], AfterValidator(_different)] = Field(
        default=("x", "y", "z"), description='some of "x", "y", "z", as a list'
    )
    noise: Annotated[Number, Ge(1e-12)] | None = Field(default=None, description="a positive number of metres")


class SetupFile(Table):
    """All tables of setup.toml."""

    title: StrictStr = Field(default="", description="a text")
    gravity: tuple[Speed, Speed, Speed] = Field(
        default=(0.0, 0.0, -9.81), description=f"{_VECTOR}, each at most 1000 m/s2: is the unit right?"
    )
    duration: Annotated[Number, Gt(0.0), Le(LONGEST)] = Field(
        description=f"a finite number of seconds from release, up to {LONGEST:g}"
    )
    start: Annotated[StartTable, BeforeValidator(_at_rest)] = Field(
        default=StartTable(), description='"rest", or a table of velocity and angular_velocity'
    )
    body: BodyTable = Field(description="a table [body]")
    material: Material = Field(description="a table [material]")
    recording: RecordingTable = Field(default=RecordingTable(), description="a table [recording]")
    clamp: tuple[ClampTable, ...] = Field(default=(), description="[[clamp]] tables")
    chamber: tuple[ChamberTable, ...] = Field(default=(), description="[[chamber]] tables")
    plane: tuple[PlaneTable, ...] = Field(default=(), description="[[plane]] tables")
    load: tuple[ForceTable, ...] = Field(default=(), description="[[load]] tables")
    marker: tuple[Marker, ...] = Field(min_length=1, description="[[marker]] tables, at least one")


class ModelTable(Table):
    """Of model.toml: the cells to simulate with, and by what modulus and pressure are off.

    Attributes:
        edge: Of a cell [m].
        walls: Cells through each wall, at least.
        across: Cells across a body without a chamber, at least.
        ln_modulus: Logarithm of the modulus over what is believed.
        ln_pressure: The same of the pressure.
        ln_friction: The same of coefficients of friction.
        highest_pressure: Supply to which shares of lost pressure refer [Pa]; 0 for the highest of each trial.
    """

    edge: Annotated[Number, Interval(gt=0.0, le=LENGTH[1])] = Field(description="a positive length in metres")
    walls: Annotated[StrictInt, Interval(ge=1, le=100)] = Field(description="1 to 100 cells")
    across: Annotated[StrictInt, Interval(ge=1, le=100)] = Field(description="1 to 100 cells")
    ln_modulus: Annotated[Number, Interval(ge=-5.0, le=5.0)] = Field(description="a number from -5 to 5")
    ln_pressure: Annotated[Number, Interval(ge=-5.0, le=5.0)] = Field(description="a number from -5 to 5")
    ln_friction: Annotated[Number, Interval(ge=-5.0, le=5.0)] = Field(default=0.0, description="a number from -5 to 5")
    highest_pressure: Annotated[Number, Ge(0.0)] = Field(default=0.0, description="a pressure in Pa, at least 0")


class EffectTable(BaseModel):
    """Of model.toml: an effect, with its parameters by name.

    Attributes:
        name: Of the effect.
        at: Where it acts, for an effect that has a place [m].
    """

    model_config = ConfigDict(extra="allow", frozen=True)
    __pydantic_extra__: dict[str, Annotated[Number, Interval(ge=-1e9, le=1e9)]] = Field(init=False)

    name: StrictStr = Field(description="the name of an effect")
    at: Place | None = Field(default=None, description=f"{_VECTOR} in metres")

    @property
    def values(self) -> dict[str, float]:
        """Parameters by name."""
        return dict(self.__pydantic_extra__)


class ModelFile(Table):
    """What model.toml has beside the tables of setup.toml."""

    model: ModelTable = Field(description="a table [model], as explain.py writes it")
    effect: tuple[EffectTable, ...] = Field(default=(), description="[[effect]] tables")


def read_tables(file: Path) -> dict[str, Any]:
    """Tables of a TOML file; a byte order mark at its beginning does no harm.

    Raises:
        ValueError: if it cannot be read.
    """
    try:
        return tomllib.loads(file.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError) as error:  # ValueError: TOML, UTF-8, integers of too many digits
        raise ValueError(f"{file}: {error}; wanted a text file in TOML") from error


def validated(model: type[Model], tables: Mapping[str, Any], where: str) -> Model:
    """Tables as a model has them.

    Args:
        model: Of all tables.
        tables: As read.
        where: Where they come from, for messages.

    Raises:
        ValueError: if a table or key is missing, unknown, or has a value of another type or out of range; names up to
            three of them.
    """
    try:
        return model.model_validate(tables)
    except ValidationError as error:
        lines = list(dict.fromkeys(_message(model, tables, e) for e in error.errors(include_url=False)))
        more = [f"and {len(lines) - 3} more"] if len(lines) > 3 else []
        raise ValueError("\n".join(f"{where}: {line}" for line in [*lines[:3], *more])) from None


def _message(model: type[BaseModel], tables: Mapping[str, Any], error: ErrorDetails) -> str:
    """One error in words: the tables that it lies in, key, value, and what the key's description wants."""
    title, value, loc = "", tables, list(error["loc"])
    while len(loc) > 1:
        key = str(loc[0])
        inner = _inner(model.model_fields[key].annotation)
        number = loc[1]
        listed = isinstance(number, int)
        if inner is None or (listed and len(loc) == 2 and error["type"] != "value_error"):
            break
        title += f"[[{key}]] number {number + 1}: " if isinstance(number, int) else f"[{key}]: "
        value = value[key][number] if listed else value[key]
        model, loc = inner, loc[2 if listed else 1 :]
    raised = str(error.get("ctx", {}).get("error", ""))
    if raised:  # by a table as a whole
        return f"{title or f'[{loc[0]}]: '}{raised}"
    key = str(loc[0])
    if key not in model.model_fields and error["type"] == "extra_forbidden":
        return f"{title}unknown {key}, wanted {', '.join(model.model_fields)}"
    field = model.model_fields.get(key)
    wanted = "a finite number" if field is None else field.description
    return (
        f"{title}no {key}, wanted {wanted}"
        if key not in value
        else f"{title}{key} = {brief(value[key])}, wanted {wanted}"
    )


def _inner(annotation: object) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next(filter(None, map(_inner, typing.get_args(annotation))), None)
