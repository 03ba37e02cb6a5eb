"""The judge's solver against recordings of another finite element code, whose truth is known.

    python recipes/judge/verify.py recordings FOLDER     # case-*/ with setup.toml, trials/, heldout/ and truth.json
    python recipes/judge/verify.py meshes FOLDER --case case-P2
    python recipes/judge/verify.py specimens [BODY ...]  # what finer meshes change in the judge's own bodies

The truth is put in, measurement errors too; what is left should be the noise.
"""

from __future__ import annotations

import json
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from believed import expected
from experiment import Recording, Trial, read_setup
from lobatto import Floats
from march import March, case_of, mesh_of
from specimens import SPECIMENS, mesh_for
from world import Line, Lump, World

NEAR = 0.02  # by which modulus and pressure are off, for what a change of them changes


def told(effects: list[dict[str, Any]]) -> tuple[World, float]:
    """World of a truth.json, and the time constant [s] of a first-order line."""
    world, lag = World(), 0.0
    for effect in effects:
        p = effect["parameters"]
        match effect["name"]:
            case "viscoelastic":
                world = replace(world, elements=tuple(tuple(e) for e in p["prony"]))
            case "modulus":
                world = replace(world, modulus=p["factor"])
            case "attached_mass":
                world = replace(world, lumps=(Lump(point=tuple(effect["location_m"]), mass=p["mass_kg"]),))
            case "pressure_lag":
                lag = p["time_constant_s"]
            case "friction":
                world = replace(world, friction=(p["coefficient"], p["coefficient"], 1.0))
    return world, lag


def _late(trace: tuple[tuple[float, float], ...], lag: float) -> tuple[tuple[float, float], ...]:
    if not lag or not trace:
        return trace
    times, values = np.array(trace).T
    fine = np.arange(0, times[-1], lag / 400)
    supply, out, now = np.interp(fine, times, values), np.zeros_like(fine), values[0]
    keep = math.exp(-1 / 400)
    for i, p in enumerate(supply):
        now = keep * now + (1 - keep) * p
        out[i] = now
    return tuple(zip(fine.tolist(), out.tolist(), strict=True))


def predicted(setup: dict[str, Any], trial: Trial, world: World, points: Floats, t: Floats, edge: float) -> Floats:
    """Positions [T, P, 3] m of the body points [P, 3] at times t [T] s."""
    mesh = mesh_of(setup, edge)
    case = case_of({**setup, **trial.tables}, mesh, trial.pressure)
    return March(case, world).run(t, *mesh.interpolation(points))


def _trials(folder: Path) -> list[tuple[Path, Trial]]:
    return [(p, Trial.read(p)) for kind in ("trials", "heldout") for p in sorted((folder / kind).iterdir())]


def recordings(folder: Path, /, *, edge: float = 0.0, cases: tuple[str, ...] = ()) -> list[dict[str, Any]]:
    """Table of root mean square differences.

    Args:
        folder: Holds case-*/.
        edge: Of the elements [m]; 0 takes 7.5 mm, and 5 mm where there is a chamber.
        cases: Names; all if empty.
    """
    rows = []
    for place in sorted(folder.glob("case-*")):
        if cases and place.name not in cases:
            continue
        setup, truth = read_setup(place), json.loads((place / "truth.json").read_text())
        world, lag = told(truth["effects"])
        errors = truth["measurement"]
        at = np.array([m["at"] for m in setup["marker"]], float)
        moved = at + np.array(errors["marker_place_error_m"])
        for path, trial in _trials(place):
            started = time.perf_counter()
            record = Recording.read(path / "markers.csv")
            late = replace(trial, pressure=_late(trial.pressure, lag))
            instants = record.time + errors["clock_offset_s"][trial.name]
            x = predicted(setup, late, world, moved, instants, edge or (0.006 if "chamber" in setup else 0.0075))
            x = errors["scale"] * x[..., ["xyz".index(a) for a in record.axes]]
            gap = x - record.value
            row = {
                "case": place.name,
                "effect": ", ".join(e["name"] for e in truth["effects"]) or "none",
                "trial": trial.name,
                "noise_mm": 1e3 * errors["noise_m"],
                "here_mm": 1e3 * math.sqrt(np.nanmean(gap**2)),
                "nominal_mm": truth["trials"][trial.name]["rms_nominal_vs_recording_mm"],
                "motion_mm": truth["trials"][trial.name]["motion_rms_mm"],
                "seconds": time.perf_counter() - started,
            }
            rows.append(row)
            print("  ".join(f"{k} {v:.4g}" if isinstance(v, float) else str(v) for k, v in row.items()), flush=True)
    return rows


def meshes(folder: Path, /, *, case: str = "case-P2", edges: tuple[float, ...] = (0.015, 0.01, 0.0075, 0.005)) -> None:
    """Markers of trial a on finer and finer meshes, against the finest [mm]."""
    setup, trial = read_setup(folder / case), Trial.read(folder / case / "trials" / "a")
    points, t = np.array([m["at"] for m in setup["marker"]], float), np.arange(0, 0.6, 0.005)
    runs = {edge: predicted(setup, trial, World(), points, t, edge) for edge in sorted(edges, reverse=True)}
    finest = runs[min(runs)]
    for edge, x in runs.items():
        rms = 1e3 * math.sqrt(float(np.mean((x - finest) ** 2)))
        print(f"{case}  edge {1e3 * edge:.3g} mm  rms to the finest {rms:.4f} mm", flush=True)


def _as_stated(name: str, worlds: tuple[World, ...], finer: float, gpu: bool) -> Floats:
    """Stated markers in all trials of a body in some worlds [worlds, trials, T, M, 3] m, each 5 ms."""
    count = len(SPECIMENS[name]().trials)
    marches, times, points = zip(
        *(expected(name, number, world, finer) for world in worlds for number in range(count)), strict=True
    )
    if gpu:
        from fleet import Fleet  # here: few have a GPU

        found = Fleet(marches, times, points).run()
    else:
        found = [march.run(t, *where) for march, t, where in zip(marches, times, points, strict=True)]
    return np.stack(found)[:, ::5].reshape(len(worlds), count, -1, *found[0].shape[1:])


def specimens(bodies: tuple[str, ...] = (), /, *, finer: tuple[float, ...] = (1.5,), gpu: bool = False) -> None:
    """Markers of the judge's bodies as stated, on its mesh and on finer ones, against the finest [mm].

    Printed are the root mean square difference over all trials, and what is left of it once modulus and pressure are
    fitted, which are uncertain in any case.

    Args:
        bodies: Names; all if none is given.
        finer: Divide the elements' edge.
        gpu: March on a GPU.
    """
    if gpu:
        from fleet import start

        start(gpu=True)
    for name in bodies or SPECIMENS:
        chamber = "chamber" in SPECIMENS[name]().setup
        beside = (World(modulus=1 + NEAR), World(line=Line(gain=1 + NEAR)))[: 1 + chamber]
        stated, *others = _as_stated(name, (World(), *beside), 1.0, gpu)
        columns = np.stack([(other - stated).ravel() for other in others], -1)
        found = {1.0: stated, **{factor: _as_stated(name, (World(),), factor, gpu)[0] for factor in sorted(finer)}}
        finest = found.pop(max(found))
        moved = 1e3 * float(np.sqrt(np.mean((finest - finest[:, :1]) ** 2)))
        print(f"{name}, against elements {max(finer):g} times finer, of a motion of {moved:.3g} mm:")
        for factor, x in found.items():
            off = (finest - x).ravel()
            left = off - columns @ np.linalg.lstsq(columns, off, rcond=None)[0]
            whole, rest = (1e3 * float(np.sqrt(np.mean(d**2))) for d in (off, left))
            print(f"  {len(mesh_for(name, factor).cells)} elements: {whole:.3f} mm, {rest:.3f} beside modulus and "
                  "pressure", flush=True)  # fmt: skip


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict({"recordings": recordings, "meshes": meshes, "specimens": specimens})
