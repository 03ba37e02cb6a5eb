"""A material on disk, ``material.toml``: what a recipe simulates, where it comes from, and what was left out of it."""

from __future__ import annotations

import dataclasses
import json
import tomllib
from collections.abc import Mapping
from pathlib import Path

import torch

from torchsoro.simulation.material import Prony, Solid
from torchsoro.simulation.plausible import DENSITY, MODULUS
from torchsoro.storage import atomic_write

_SOLID = {"youngs_modulus_Pa": "youngs_modulus", "poisson_ratio": "poisson_ratio", "density_kg_per_m3": "density"}
_STIFFENING = ("linear_stiffening", "quadratic_stiffening")  # not in a file of a neo-Hookean solid
_RANGES = {"youngs_modulus_Pa": MODULUS, "density_kg_per_m3": DENSITY}
_MAXWELL = ("modulus_over_equilibrium", "time_s")


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Material:
    """What a file holds.

    Attributes:
        solid: The equilibrium solid.
        prony: Its Maxwell elements, relative to the equilibrium modulus, slowest first; at most five.
        left_out: For people: what of the measurement this material does not have.
        source: For people: measured where and how; plain text by name.
    """

    solid: Solid
    prony: Prony
    left_out: str = ""
    source: Mapping[str, str] = dataclasses.field(default_factory=dict)


def write_material(path: Path, material: Material) -> Path:
    """Write a material; numbers read back as the same floats.

    Args:
        path: A .toml file, written as a whole; its folder must exist.
        material: What to write.
    """
    lines = ["# A material for torchsoro. Moduli of the Maxwell elements are relative to the equilibrium modulus.", ""]
    lines.append(f"left_out = {_quoted(material.left_out)}")
    lines += ["", "[solid]", *(f"{key} = {float(getattr(material.solid, name))!r}" for key, name in _SOLID.items())]
    stiffening = {name: float(getattr(material.solid, name)) for name in _STIFFENING}
    if any(stiffening.values()):
        lines += [f"{name} = {value!r}" for name, value in stiffening.items()]
    order = material.prony.times.detach().argsort(descending=True)
    for modulus, time in zip(
        material.prony.moduli.detach()[order].tolist(), material.prony.times.detach()[order].tolist(), strict=True
    ):
        lines += ["", "[[maxwell]]", f"modulus_over_equilibrium = {modulus!r}", f"time_s = {time!r}"]
    lines += ["", "[source]", *(f"{_quoted(key)} = {_quoted(value)}" for key, value in material.source.items()), ""]
    with atomic_write(path) as file:
        file.write("\n".join(lines).encode())
    return path


def read_material(path: Path) -> Material:
    """Read a material.

    Raises:
        ValueError: if there is no such file, it is no TOML, or a number is missing, unknown or out of range; names it.
    """
    try:
        found = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"path: {path} holds no material ({error}), wanted a material.toml") from error
    unknown = set(found) - {"left_out", "solid", "maxwell", "source"}
    if unknown:
        raise ValueError(f"path: {path} has {', '.join(sorted(unknown))}, wanted left_out, solid, maxwell and source")
    table = found.get("solid", {})
    stiffens = isinstance(table, dict) and any(name in table for name in _STIFFENING)
    solid = _numbers(table, (*_SOLID, *(_STIFFENING if stiffens else ())), f"{path}: [solid]")
    elements = [
        _numbers(element, _MAXWELL, f"{path}: [[maxwell]] number {number}")
        for number, element in enumerate(found.get("maxwell", []), start=1)
    ]
    for name, (low, high) in _RANGES.items():
        if not low <= solid[name] <= high:
            raise ValueError(f"{path}: {name} = {solid[name]:g}, wanted {low:g} to {high:g}: is the unit right?")
    maxwell = torch.tensor([[e[name] for name in _MAXWELL] for e in elements], dtype=torch.float64).reshape(-1, 2)
    return Material(
        solid=Solid(**{_SOLID.get(key, key): value for key, value in solid.items()}),
        prony=Prony(moduli=maxwell[:, 0].clone(), times=maxwell[:, 1].clone()),
        left_out=str(found.get("left_out", "")),
        source={key: str(value) for key, value in found.get("source", {}).items()},
    )


def _numbers(table: object, wanted: tuple[str, ...], where: str) -> dict[str, float]:
    names = set(table) if isinstance(table, dict) else set()
    wrong = [f"unknown {name}" for name in sorted(names - set(wanted))]
    wrong += [f"no {name}" for name in wanted if name not in names]
    if wrong:
        raise ValueError(f"{where}: {', '.join(wrong)}; wanted {', '.join(wanted)}")
    assert isinstance(table, dict)
    for name, value in table.items():
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError(f"{where}: {name} = {value!r}, wanted a number")
    return {name: float(value) for name, value in table.items()}


def _quoted(text: str) -> str:
    """A TOML string: JSON's escapes are among TOML's."""
    return json.dumps(text, ensure_ascii=False)
