"""Designs on disk: a density in a compact file, and a finished robot that can be taken up again from its folder."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsoro.design.domain import Domain
from torchsoro.design.field import DesignField
from torchsoro.design.reading import CHAMBERS, read_settings
from torchsoro.design.resampling import fit_, resampled
from torchsoro.design.robot import build
from torchsoro.design.supply import Supply
from torchsoro.storage import atomic_write

DESIGNS = Path(__file__).resolve().parents[1] / "designs"  # robots that come with the package


def save_design(
    path: Path, domain: Domain, gamma: Tensor, supply: Supply | None = None, mended: Tensor | None = None
) -> Tensor:
    """Write a density with its lattice, the timing of its chambers, and the density with thin walls mended.

    Args:
        path: An .npz file, written as a whole; its folder is made if it is missing.
        domain: The lattice.
        gamma: Density [N], 0 (void) to 1 (material).
        supply: Whose amplitude [share of the pressure], phase [cycles] and duty [1] of each chamber are part of the
            design; none if they are not.
        mended: Density [N] of the part that is delivered, if its walls have been mended.

    Returns:
        The density as it is stored, in float32, in the type and on the device it came in: what to judge and to show.

    Raises:
        ValueError: if the density is not one number for each particle.
    """
    if gamma.shape != (domain.count,):
        raise ValueError(f"gamma: got shape {tuple(gamma.shape)}, wanted one density per particle, ({domain.count},)")
    path.parent.mkdir(parents=True, exist_ok=True)
    stored = gamma.detach().float()
    more: dict[str, Any] = {}
    if supply is not None:
        more = {name: one.detach().numpy() for name, one in supply.named_parameters()}
    if mended is not None:
        more["mended"] = mended.detach().float().cpu().numpy()
    with atomic_write(path) as file:
        np.savez_compressed(
            file,
            gamma=stored.cpu().numpy(),
            shape=np.array(domain.shape),
            spacing=domain.spacing,
            origin=np.array(domain.origin),
            **more,
        )
    return stored.to(gamma)


def load_design(path: Path, domain: Domain, *, mended: bool = True) -> Tensor:
    """Read what :func:`save_design` wrote.

    Args:
        path: The file.
        domain: The lattice that it has to be on.
        mended: The density of the part that is delivered, if its walls have been mended.

    Returns:
        Density [N], float32; files of float16, as they were once written, are read as well.

    Raises:
        ValueError: if there is no such file, it is no design, or it is on another lattice.
    """
    if not path.is_file():
        raise ValueError(f"path: there is no file {path}, wanted a design (.npz)")
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            gamma = stored["mended" if mended and "mended" in stored else "gamma"]
            shape = tuple(int(n) for n in stored["shape"])
            spacing = float(stored["spacing"])
        if gamma.dtype not in (np.float16, np.float32, np.float64):
            raise ValueError(f"densities of type {gamma.dtype}")
        if gamma.shape != (math.prod(shape),):
            raise ValueError(f"densities of shape {gamma.shape} for {shape} particles")
        if not (np.isfinite(gamma).all() and gamma.min() >= 0 and gamma.max() <= 1):
            raise ValueError("densities outside 0 to 1")
    except Exception as error:  # a damaged archive can fail in any way
        # What numpy says of a pickle is how to read what is not safe to read.
        said = "it holds pickled objects" if "pickle" in str(error) else error
        raise ValueError(f"path: {path} is no design ({said}), wanted an .npz with gamma, shape and spacing") from error
    if shape != domain.shape or abs(spacing / domain.spacing - 1) > 1e-6:
        raise ValueError(
            f"path: {path} is on {shape} particles {spacing:g} m apart, wanted {domain.shape} at {domain.spacing:g} m"
        )
    return torch.from_numpy(gamma.astype(np.float32))


@torch.no_grad()
def load_supply(path: Path, supply: Supply) -> None:
    """Put the timing of a design into a supply whose timing is designed; nothing to do for another.

    Args:
        path: What :func:`save_design` wrote.
        supply: Its amplitude, phase and duty are changed.

    Raises:
        ValueError: if there is no such file, or it lacks the timing of so many chambers.
    """
    if not supply.designed():
        return
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            timing = {name: torch.from_numpy(stored[name]) for name, _ in supply.named_parameters()}
        if not all(bool(one.isfinite().all()) for one in timing.values()):
            raise ValueError("numbers that are not finite")
        supply.load_state_dict(timing)
    except Exception as error:  # a damaged archive can fail in any way
        chambers = f"amplitude, phase and duty of {supply.chambers} chambers"
        raise ValueError(f"path: {path} has no timing ({error}), wanted an .npz with {chambers}") from error


def load_resampled(folder: Path, domain: Domain, *, mended: bool = True) -> Tensor:
    """Read the design of an archived robot or a run on another lattice; see :func:`resampled`.

    Args:
        folder: With ``design.npz`` and ``settings.json``.
        domain: The lattice that is wanted.
        mended: See :func:`load_design`.

    Returns:
        Density [N], float32; on the design's own lattice as it is stored.

    Raises:
        ValueError: see :func:`load_design`; also for a body of another size.
    """
    source = build(read_settings(folder / "settings.json", device="cpu", resume=False, scenarios=0)).domain
    return resampled(load_design(folder / "design.npz", source, mended=mended), source, domain)


def begin_with(field: DesignField, robot: str) -> float:
    """Let a field begin with the design of an archived robot or a run, on whatever lattice.

    Args:
        field: Its ``phi`` is changed.
        robot: See :func:`find`.

    Returns:
        Root mean square of what the field's density misses (see :func:`torchsoro.design.resampling.fit_`).

    Raises:
        ValueError: if there is no such robot, its design is damaged, or its body has another size.
    """
    return fit_(field, load_resampled(find(robot), field.domain, mended=False))


def kept_iterations(folder: Path) -> list[int]:
    """Iterations whose designs a run or an archived robot has kept."""
    packed = folder / "shapes.npz"
    if packed.is_file():
        with np.load(packed, allow_pickle=False) as stored:
            return stored["iteration"].tolist()
    return sorted(int(path.stem) for path in (folder / "shapes").glob("*.npz") if path.stem.isdigit())


def load_shape(folder: Path, domain: Domain, iteration: int) -> Tensor:
    """Read the design of an iteration: from a run's ``shapes`` folder, or from an archived robot's ``shapes.npz``.

    Args:
        folder: Of the run or of the archived robot.
        domain: The lattice.
        iteration: One that was kept.

    Returns:
        Density [N], float32; of an archived robot to 1/255.

    Raises:
        ValueError: if the iteration was not kept (names those that were), or is on another lattice.
    """
    packed, kept = folder / "shapes.npz", kept_iterations(folder)
    if iteration not in kept:
        raise ValueError(f"iteration: got {iteration}, {folder} holds {', '.join(map(str, kept)) or 'none'}")
    if not packed.is_file():
        return load_design(folder / "shapes" / f"{iteration:05d}.npz", domain)
    with np.load(packed, allow_pickle=False) as stored:
        gamma = stored["gamma"]
    found = torch.from_numpy(gamma[kept.index(iteration)].astype(np.float32) / 255)
    if found.shape != (domain.count,):
        raise ValueError(f"folder: {packed} holds {len(found)} particles, wanted {domain.count}")
    return found


def archive(run: Path, folder: Path, domain: Domain, iterations: Sequence[int]) -> None:
    """Copy what is worth keeping of a finished run: design, early designs, motion, settings, metrics, result, summary.

    Args:
        run: The run's folder.
        folder: Where to; made if it is missing.
        domain: The run's lattice.
        iterations: Early designs to keep; those the run does not have are left out.

    Raises:
        ValueError: if the run is not finished (it has no design or no summary), or its pressure, material or shape is
            in a file elsewhere.
    """
    files = ("design.npz", "metrics.csv", "summary.png", "settings.json", "result.json")
    if missing := [name for name in files if not (run / name).is_file()]:
        raise ValueError(f"run: {run} has no {', '.join(missing)}, wanted a finished run")
    held = read_settings(run / "settings.json", device="auto")  # of a GPU, maybe, that is not here
    elsewhere = (held.pressure_file, held.material, held.body_mesh, held.chamber_mesh)
    if outside := [str(path) for path in elsewhere if path is not None]:
        raise ValueError(f"run: {run} needs {', '.join(outside)}, wanted a robot that is complete without other files")
    folder.mkdir(parents=True, exist_ok=True)
    files += tuple(name for name in ("amendments.json", "motion.npz", CHAMBERS) if (run / name).is_file())
    for name in files:
        with atomic_write(folder / name) as file:
            file.write((run / name).read_bytes())
    kept = [k for k in iterations if (run / "shapes" / f"{k:05d}.npz").is_file()]
    early = [load_design(run / "shapes" / f"{k:05d}.npz", domain) for k in kept]
    with atomic_write(folder / "shapes.npz") as file:
        gamma = np.stack([(255 * g).round().to(torch.uint8).numpy() for g in early]) if early else np.zeros((0, 0))
        np.savez_compressed(file, iteration=np.array(kept, dtype=np.int64), gamma=gamma)


def find(robot: str) -> Path:
    """The folder of an archived robot or of a run.

    Raises:
        ValueError: if there is none.
    """
    for folder in (DESIGNS / robot, Path(robot)):
        if (folder / "design.npz").is_file():
            return folder
    raise ValueError(
        f"robot = {robot!r}: wanted {', '.join(names()) or 'an archived robot'}, or a finished run's folder"
    )


def read_result(folder: Path) -> dict[str, float | None]:
    """What the design run measured; nothing if it was not written."""
    path = folder / "result.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def names() -> list[str]:
    """The archived robots."""
    return sorted(path.parent.name for path in DESIGNS.glob("*/design.npz"))
