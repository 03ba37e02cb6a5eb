"""A model on disk, ``model.toml``: a setup with what was found to be missing from it, and what it predicts."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchsoro.sim2real.data.experiment import Setup, Trial, read_trial, setup_of
from torchsoro.sim2real.data.recording import Recording
from torchsoro.sim2real.data.schema import ModelFile, read_tables, validated
from torchsoro.sim2real.hypotheses.hypothesis import Hypothesis
from torchsoro.sim2real.hypotheses.library import library
from torchsoro.sim2real.inference.fit import Fit
from torchsoro.sim2real.inference.likelihood import STATED
from torchsoro.sim2real.twin.batch import THREADS, simulate
from torchsoro.sim2real.twin.scenario import Scenario
from torchsoro.sim2real.twin.twin import Twin
from torchsoro.storage import atomic_write

_HEAD = "# A setup with what was found to be missing: [model] and [[effect]]; the rest is as believed.\n"


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """What a file holds.

    Attributes:
        tables: Of the setup, as believed.
        setup: The same, read.
        edge: Of the twin's cells [m].
        walls: Of them through each wall, at least.
        across: Of them across a body without a chamber, at least.
        ln_modulus: What the modulus is off.
        ln_pressure: What the pressure is off.
        ln_friction: What coefficients of friction are off.
        highest_pressure: See :class:`~torchsoro.sim2real.twin.twin.Twin` [Pa].
        effects: What was missing, with its values [K], places included.
    """

    tables: dict[str, Any]
    setup: Setup
    edge: float
    walls: int
    across: int
    ln_modulus: float
    ln_pressure: float
    ln_friction: float
    highest_pressure: float
    effects: tuple[tuple[Hypothesis, np.ndarray], ...]

    def apply(self, scenario: Scenario, twin: Twin) -> Scenario:
        """A scenario with all that was found."""
        for stated, name in STATED.items():
            effect, value = stated(), torch.tensor([[getattr(self, name)]], dtype=torch.float64)
            if effect.applies(scenario, twin):
                scenario = effect(scenario, value, twin)
        for effect, found in self.effects:
            if effect.applies(scenario, twin):
                scenario = effect(scenario, torch.from_numpy(found)[None], twin)
        return scenario


def write_model(path: Path, setup: Path, fit: Fit, twin: Twin) -> None:
    """Write a setup with a fit's findings.

    Args:
        path: Of the model; its folder exists.
        setup: The setup.toml that was believed, which is copied, as is the body's mesh beside it.
        fit: What was found.
        twin: To predict with; one as fine as that which corrected the fit's.
    """
    lines = [
        _HEAD,
        setup.read_text(encoding="utf-8-sig").rstrip(),
        "",
        "[model]",
        f"edge = {twin.edge!r}",
        f"walls = {twin.walls}",
        f"across = {twin.across}",
        f"highest_pressure = {twin.highest!r} # Pa, to which shares of lost pressure refer",
    ]
    lines += [f"{name} = {fit.ln_factors.get(name, 0.0)!r}" for name in STATED.values()]
    for effect, values in zip(fit.effects, fit.values, strict=True):
        lines += ["", "[[effect]]", f"name = {json.dumps(effect.name)}"]
        count = len(effect.quantities)
        for quantity, value in zip(effect.quantities, values[:count].tolist(), strict=True):
            lines.append(f"{quantity.name} = {value!r} # {quantity.unit}")
        if effect.local:
            lines.append(f"at = {values[count:].tolist()!r} # m")
    mesh = read_tables(setup)["body"].get("file")
    if mesh is not None and not Path(mesh).is_absolute():
        source, copy = setup.parent.resolve() / mesh, path.parent.resolve() / mesh
        if source != copy:
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, copy)
    with atomic_write(path) as file:
        file.write(("\n".join(lines) + "\n").encode())


def read_model(path: Path, effects: Sequence[Hypothesis] | None = None) -> Model:
    """Read a model.

    Args:
        path: Of the file.
        effects: Those that may be in it; the library if None.

    Raises:
        ValueError: if the file cannot be read, or an effect or a parameter of it is missing or unknown.
    """
    tables = read_tables(path)
    parts = {name: tables.pop(name) for name in ModelFile.model_fields if name in tables}
    file = validated(ModelFile, parts, str(path))
    known: dict[str, list[Hypothesis]] = {}
    for effect in library() if effects is None else effects:
        known.setdefault(effect.name, []).append(effect)
    found = []
    for table in file.effect:
        alike = known.get(table.name, [])
        if not alike:
            raise ValueError(f"{path}: [[effect]] name = {table.name!r}, wanted one of {', '.join(known)}")
        # Some share a name, as friction of planes that were thought to stick and of others.
        wants = [[*(q.name for q in e.quantities), *(["at"] if e.local else [])] for e in alike]
        names = [*table.values, *(["at"] if table.at else [])]
        fits = [e for e, wanted in zip(alike, wants, strict=True) if set(names) == set(wanted)]
        if not fits:
            wanted = " or ".join(", ".join(w) for w in wants)
            raise ValueError(f"{path}: [[effect]] {table.name} has {', '.join(names)}, wanted {wanted}")
        values = [*(table.values[q.name] for q in fits[0].quantities), *(table.at or ())]
        found.append((fits[0], np.array(values, dtype=float)))
    return Model(tables=tables, setup=setup_of(tables, path), effects=tuple(found), **dict(file.model))


def predict_trial(
    model: Model, trial: Path, source: Path, threads: int = THREADS, device: str = "cpu"
) -> dict[str, np.ndarray]:
    """Markers in a trial that nobody has recorded yet, by the finer twin alone: no ``simulated.csv`` counts here.

    Args:
        model: What is known.
        trial: Its trial.toml; a pressure.csv stands beside it where the body has a chamber.
        source: Where the model comes from, for messages.
        threads: That simulate.
        device: Where it is simulated, "cpu" or "cuda".

    Returns:
        Columns of a markers.csv.

    Raises:
        ValueError: if the trial cannot be read, or the simulation breaks down.
    """
    if trial.name != "trial.toml" or not trial.is_file():
        raise ValueError(f"trial = {trial}: wanted a file named trial.toml")
    told: Trial = read_trial(trial.parent, model.tables, source)
    cells = {"edge": model.edge, "walls": model.walls, "across": model.across}
    twin = Twin(told.setup, **cells, device=device, highest=model.highest_pressure)
    motion = simulate(twin, [model.apply(twin.scenario(told), twin)], threads=threads)[0].alone()
    if not motion.sound:
        raise ValueError(f"{trial}: the motion is not finite, wanted a trial that the body bears")
    axes = told.setup.axes
    return Recording(time=motion.time, position=motion.position[..., list(axes)], axes=axes).columns(
        [m.name for m in told.setup.markers]
    )
