"""The run folder of an optimization: settings, metrics, TensorBoard, progress, save and exact resume.

The loop itself stays in the recipe::

    with RunFolder(out, settings, resume=resume) as run:
        if state := run.load():
            field.load_state_dict(state["field"])
            adam.load_state_dict(state["adam"])
        for iteration in run.progress(iterations):
            ...
            run.log(iteration, {"objective/L": travel, "constraint/C": constraint})
            run.save(iteration, field=field, adam=adam)

A killed run loses the iteration it was in and nothing else: every file is either replaced as a whole or, like
``metrics.csv`` and the TensorBoard events, cut back to the last checkpoint on resume. Log an iteration, then save it.

Tags that every recipe shares: ``objective/L``, ``constraint/C``, ``mass``, ``cog/x``, ``cog/y``, ``cog/z``,
``multiplier/...``, ``penalty/...``, ``grad_norm/...``, ``field/...``, ``time/...``.
"""

from __future__ import annotations

import contextlib
import math
import signal
import sys
import threading
import time
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import torch
from torch.utils.tensorboard.writer import SummaryWriter
from tqdm import tqdm

from torchsoro.storage import (
    MetricsFile,
    atomic_write,
    check_folder,
    check_storable,
    plain_settings,
    read_checkpoint,
    read_json,
    read_metrics,
    write_json,
)

_ABSENT = "absent"
_EVENTS = "events.out.tfevents.*"
_WRITTEN = ("settings.json", "metrics.csv", "checkpoint.pt", "amendments.json", _EVENTS)
# What is delivered and kept of a run beside that, to be deleted before another one.
_DELIVERED = (
    "result.json",
    "design.npz",
    "summary.png",
    "shape.stl",
    "shape.3mf",
    "shape.json",
    "motion.npz",
    "motion.html",
    "chambers.json",
)
_DELIVERED += ("walker.mp4", "climber.mp4", "turner.mp4")
_PARTS = {"iteration": int, "settings": dict, "rng_cpu": torch.Tensor, "rng_cuda": list, "items": dict}


class RunFolder:
    """A folder that holds one optimization run, and continues it exactly.

    Files: ``settings.json``, ``metrics.csv``, ``checkpoint.pt`` and the TensorBoard events. Use it as a context
    manager: SIGTERM then ends the block like Ctrl-C does, abandoning the iteration, and the events are flushed; a block
    that fails before its first ``save`` leaves no files of the run, so that corrected settings can start there.

    Args:
        path: The folder; created if missing.
        settings: Resolved settings of the run: nested mappings or dataclasses of numbers, strings, paths, lists.
        resume: Continue the run that the folder holds. Metrics and events after its checkpoint are dropped; without
            a checkpoint (killed in the first iteration) it starts again from iteration 0.
        overwrite: Start again in a folder that holds a run, whose files are deleted.
        free: Names of settings that may change on resume, such as the number of iterations or the folder itself;
            nested names are joined with dots, and the name of a group frees all of it.
        amend: Let other settings change on resume, too; each change is noted in ``amendments.json`` with the iteration
            from which it holds.

    Attributes:
        path: The folder.
        settings: The settings as written to ``settings.json``.
        start: First iteration to compute, 0 for a new run.

    Raises:
        ValueError: If the folder holds a run and neither ``resume`` nor ``overwrite`` is set, if it holds none and
            ``resume`` is true, if it cannot be written, if the settings differ from the run's (names each key with both
            values), or if a file of it is damaged or missing.
    """

    def __init__(
        self,
        path: str | Path,
        settings: Mapping[str, Any],
        *,
        resume: bool = False,
        overwrite: bool = False,
        free: Collection[str] = (),
        amend: bool = False,
    ) -> None:
        self.path = Path(path)
        self.settings: dict[str, Any] = plain_settings(settings)
        self.start = 0
        rows: list[dict[str, float]] = []
        columns: list[str] = []
        changed: dict[str, tuple[Any, Any]] = {}
        self._refuse_wrong_folder(resume, overwrite)
        self._new = not self.path.exists()
        if overwrite:
            self._delete(*_WRITTEN, *_DELIVERED, "shapes/[0-9]*.npz")
        if resume:
            changed = self._differences(read_json(self.path / "settings.json", dict), free)
            self._refuse(changed, amend, "settings.json")
            if self._checkpoint.exists():
                payload = read_checkpoint(self._checkpoint, _PARTS)
                changed = self._differences(payload["settings"], free)
                self._refuse(changed, amend, "checkpoint.pt")
                self.start = payload["iteration"] + 1
            columns, rows = read_metrics(self.path / "metrics.csv", self.start)
            self._refuse_short_table(columns, rows)
        self.path.mkdir(parents=True, exist_ok=True)
        for file in ("checkpoint.pt", "metrics.csv", "settings.json", "amendments.json"):
            (self.path / f"{file}.tmp").unlink(missing_ok=True)  # a killed process may have left one
        # If the checkpoint turns out not to fit the settings, the run stays as it was.
        held = [self.path / file for file in ("settings.json", "amendments.json")] if resume else []
        self._held = {path: path.read_bytes() if path.exists() else None for path in held}
        self._note(changed)
        write_json(self.path / "settings.json", self.settings, allow_nan=False)
        self._metrics = MetricsFile(self.path / "metrics.csv", columns, rows)
        self._saved = self.start - 1
        self._bar: tqdm | None = None
        self._old_handler: Any = None
        self._wait_for_next_second()
        # Events of iterations that the checkpoint does not contain would otherwise be shown twice.
        self._writer = SummaryWriter(str(self.path), purge_step=self.start if resume else None, flush_secs=10)

    @property
    def _checkpoint(self) -> Path:
        return self.path / "checkpoint.pt"

    @property
    def metrics(self) -> dict[str, list[float]]:
        """Everything logged so far, by column, ``iteration`` first; NaN where an iteration did not log a tag."""
        return self._metrics.by_column()

    def log(self, iteration: int, values: Mapping[str, Any]) -> None:
        """Write scalars to TensorBoard and as one row of ``metrics.csv``, which is on disk on return.

        Args:
            iteration: Iteration from 0; never smaller than the last one. A second call for the same one adds to it.
            values: Numbers or one-element tensors by tag.

        Raises:
            ValueError: If a value is not a single number or the iteration goes back.
        """
        _check_iteration(iteration)
        scalars = {tag: _scalar(tag, value) for tag, value in values.items()}
        self._metrics.add(iteration, scalars)
        for tag, value in scalars.items():
            self._writer.add_scalar(tag, value, iteration)
        if self._bar is not None:
            row = self._metrics.last
            shown = {name: row[tag] for name, tag in (("L", "objective/L"), ("C", "constraint/C")) if tag in row}
            self._bar.set_postfix({name: f"{value:.4g}" for name, value in shown.items()}, refresh=False)

    def log_image(self, tag: str, image: np.ndarray | torch.Tensor, iteration: int) -> None:
        """Write a picture to TensorBoard.

        Args:
            tag: Name of the picture.
            image: Colours, uint8, shape [height, width, 3].
            iteration: Iteration from 0.

        Raises:
            ValueError: If the image has another shape or type.
        """
        _check_iteration(iteration)
        pixels = np.asarray(image)
        if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.dtype != np.uint8:
            raise ValueError(f"image: got {pixels.dtype} of shape {pixels.shape}, wanted uint8 [height, width, 3]")
        self._writer.add_image(tag, pixels, iteration, dataformats="HWC")

    def log_histogram(self, tag: str, values: torch.Tensor, iteration: int) -> None:
        """Write how values [S] are distributed to TensorBoard."""
        _check_iteration(iteration)
        self._writer.add_histogram(tag, values, iteration)

    def log_mesh(
        self,
        tag: str,
        vertices: np.ndarray | torch.Tensor,
        faces: np.ndarray | torch.Tensor,
        colors: np.ndarray | torch.Tensor | None,
        iteration: int,
    ) -> None:
        """Write a surface to TensorBoard's 3-D view.

        Args:
            tag: Name of the mesh.
            vertices: Corners in m with z up, shape [V, 3]; shown in mm, upright.
            faces: Corner indices of the triangles, integer, shape [F, 3].
            colors: Colours of the corners, uint8, shape [V, 3], or None.
            iteration: Iteration from 0.

        Raises:
            ValueError: If a shape or type is wrong, a vertex is not finite, or a face points outside the vertices.
        """
        _check_iteration(iteration)
        points, corners = torch.as_tensor(vertices).detach().cpu(), torch.as_tensor(faces).detach().cpu()
        if points.ndim != 2 or points.shape[1] != 3 or not bool(torch.isfinite(points).all()):
            raise ValueError(f"vertices: got shape {tuple(points.shape)}, wanted finite numbers of shape [V, 3]")
        if corners.ndim != 2 or corners.shape[1] != 3 or corners.is_floating_point():
            raise ValueError(f"faces: got {corners.dtype} of shape {tuple(corners.shape)}, wanted integers [F, 3]")
        if corners.numel() and not 0 <= int(corners.min()) <= int(corners.max()) < len(points):
            raise ValueError(
                f"faces: got indices {int(corners.min())} to {int(corners.max())} of {len(points)} vertices"
            )
        paint = None if colors is None else torch.as_tensor(colors).detach().cpu()
        if paint is not None and (paint.shape != points.shape or paint.dtype != torch.uint8):
            raise ValueError(f"colors: got {paint.dtype} of shape {tuple(paint.shape)}, wanted uint8 [V, 3]")
        # TensorBoard looks along -z with y up, and its camera clips what is nearer than 0.1 units: turn, and use mm.
        shown = 1e3 * torch.stack((points[:, 0], points[:, 2], -points[:, 1]), dim=1).float()
        self._writer.add_mesh(
            tag, shown[None], None if paint is None else paint[None], corners[None].int(), global_step=iteration
        )

    def save(self, iteration: int, **items: Any) -> None:
        """Replace the checkpoint with the state at the end of an iteration, with torch's random state.

        Args:
            iteration: The iteration that is complete.
            **items: Anything with a ``state_dict`` (module, optimizer), tensors, numbers, strings, lists, dicts.

        Raises:
            ValueError: If an item holds something that cannot be loaded again safely, or the iteration goes back.
        """
        _check_iteration(iteration)
        if iteration < self._saved:
            raise ValueError(f"iteration: got {iteration}, wanted at least the {self._saved} of the last checkpoint")
        state = {name: item.state_dict() if hasattr(item, "state_dict") else item for name, item in items.items()}
        check_storable(state, "items")
        self._writer.flush()
        payload = {
            "iteration": iteration,
            "settings": self.settings,
            "rng_cpu": torch.get_rng_state(),
            "rng_cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else [],
            "items": state,
        }
        with atomic_write(self._checkpoint) as file:
            torch.save(payload, file)
        self._saved = iteration

    def load(self) -> dict[str, Any]:
        """Read the checkpoint and set torch's random state to the saved one.

        Call it after the modules are built, since building them may draw random numbers.

        Returns:
            What ``save`` was given, as state dicts and tensors on the CPU, and nothing if there is no checkpoint yet.

        Raises:
            ValueError: If the file is damaged.
        """
        if not self._checkpoint.exists():
            return {}
        payload = read_checkpoint(self._checkpoint, _PARTS)
        torch.set_rng_state(payload["rng_cpu"])
        if torch.cuda.is_available():
            for device, state in enumerate(payload["rng_cuda"][: torch.cuda.device_count()]):
                torch.cuda.set_rng_state(state, device)
        return payload["items"]

    def progress(self, total: int) -> Iterator[int]:
        """Iterate from ``start`` to ``total`` with a bar that shows L, C and the time left.

        Args:
            total: Number of iterations of the whole run.

        Returns:
            The iterations that are left; none if the run has them all.

        Raises:
            ValueError: If ``total`` is negative.
        """
        if total < 0:
            raise ValueError(f"total: got {total}, wanted a number of iterations >= 0")
        return self._iterate(total)

    def _iterate(self, total: int) -> Iterator[int]:
        interval = 0.1 if sys.stderr.isatty() else 10.0  # s; in a log file every refresh is a line
        bar = tqdm(
            total=max(total, self.start),
            initial=self.start,
            mininterval=interval,
            dynamic_ncols=True,
            desc="kernels may have to be compiled",
        )
        with bar as self._bar:
            try:
                for iteration in range(self.start, total):
                    yield iteration
                    if bar.desc:
                        bar.set_description_str("", refresh=False)
                    bar.update()
            finally:
                self._bar = None

    def close(self) -> None:
        """Flush and close the TensorBoard events."""
        self._writer.close()

    def __enter__(self) -> RunFolder:
        """Let SIGTERM unwind the block; signals can be redirected in the main thread only."""
        if threading.current_thread() is threading.main_thread():
            self._old_handler = signal.signal(signal.SIGTERM, signal.default_int_handler)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Close the events, say where an interrupted run stands, and restore the signal handler."""
        if self._old_handler is not None:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)  # torchrun sends it to a process that ends by itself, too
        try:
            self._end(kind)
        finally:
            if self._old_handler is not None:
                signal.signal(signal.SIGTERM, self._old_handler)
                self._old_handler = None

    def _end(self, kind: type[BaseException] | None) -> None:
        self.close()
        if kind is not None and issubclass(kind, ValueError) and self._saved < self.start:
            self._take_back()
        if kind is not None and self._saved < 0:
            self._delete(*_WRITTEN)
            if self._new:
                with contextlib.suppress(OSError):  # something else lies there
                    self.path.rmdir()
        if kind is not None and issubclass(kind, (KeyboardInterrupt, ConnectionError)):
            kept = f"{self._saved + 1} iterations are saved in {self.path}; resume to continue"
            print(f"interrupted: {kept if self._saved >= 0 else 'no iteration was complete'}", file=sys.stderr)

    def _delete(self, *patterns: str) -> None:
        for path in [path for pattern in patterns for path in self.path.glob(pattern)]:
            path.unlink()

    def _take_back(self) -> None:
        """Undo what resuming has written."""
        for path, content in self._held.items():
            if content is None:
                path.unlink(missing_ok=True)
            else:
                with atomic_write(path) as file:
                    file.write(content)

    def _wait_for_next_second(self) -> None:
        # TensorBoard reads event files by name, which holds the second of their making and then the process: one that
        # purges the events of another must come after it.
        seconds = [int(path.name.split(".")[3]) for path in self.path.glob(_EVENTS)]
        now = time.time()
        if seconds and int(now) == max(seconds):
            time.sleep(max(seconds) + 1 - now)

    def _refuse_wrong_folder(self, resume: bool, overwrite: bool) -> None:
        check_folder("out", self.path)
        settings = self.path / "settings.json"
        held = settings.exists() or self._checkpoint.exists() or any(self.path.glob(_EVENTS))
        if held and not (resume or overwrite):
            raise ValueError(
                f"path: {self.path} already holds a run; resume it (--resume), start again in it (--overwrite), "
                "or choose another folder"
            )
        if resume and not settings.exists():
            raise ValueError(f"path: {self.path} holds no run (no settings.json); start without resume")

    def _refuse_short_table(self, columns: list[str], rows: list[dict[str, float]]) -> None:
        """Refuse metrics that lack iterations which the checkpoint has; without any, none was logged."""
        if self.start > 0 and (not columns or (rows and rows[-1]["iteration"] < self.start - 1)):
            seen = f"ends with iteration {rows[-1]['iteration']}" if columns else "is missing"
            raise ValueError(
                f"path: {self.path / 'metrics.csv'} {seen}, wanted all up to {self.start - 1}, that of checkpoint.pt; "
                "restore it, or choose another folder"
            )

    def _differences(self, held: Mapping[str, Any], free: Collection[str]) -> dict[str, tuple[Any, Any]]:
        """What the run has and what is wanted now, of each setting that differs and is not free."""
        here, there = _flatten(self.settings), _flatten(held)
        return {
            name: (there.get(name, _ABSENT), here.get(name, _ABSENT))
            for name in dict.fromkeys((*here, *there))
            if here.get(name, _ABSENT) != there.get(name, _ABSENT)
            and not any(name == group or name.startswith(group + ".") for group in free)
        }

    def _refuse(self, changed: Mapping[str, tuple[Any, Any]], amend: bool, file: str) -> None:
        if changed and not amend:
            listed = "; ".join(f"{name} is {now!r}, the run has {was!r}" for name, (was, now) in changed.items())
            raise ValueError(
                f"settings: these differ from {file} of the run in {self.path}: {listed}; "
                "resume with the settings of the run, or amend it, or start another folder"
            )

    def _note(self, changed: Mapping[str, tuple[Any, Any]]) -> None:
        """Add to the amendments, and drop those from this iteration on, which were never used."""
        path = self.path / "amendments.json"
        held = read_json(path, list) if path.exists() else []
        noted = [one for one in held if one["iteration"] < self.start]
        if changed:
            noted.append({"iteration": self.start, "changes": {name: list(pair) for name, pair in changed.items()}})
        if noted != held:
            write_json(path, noted)


def _flatten(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        if isinstance(value, Mapping):
            flat.update(_flatten(value, f"{prefix}{key}."))
        else:
            flat[prefix + key] = value
    return flat


def _scalar(tag: str, value: Any) -> float:
    if isinstance(value, torch.Tensor | np.ndarray | np.generic) and math.prod(value.shape) == 1:
        value = value.item()
    if not isinstance(value, float | int):
        raise ValueError(f"values[{tag!r}]: got {value!r}, wanted a single number")
    if tag in ("", "iteration"):
        raise ValueError(f"values: got the tag {tag!r}, wanted a name other than '' and 'iteration'")
    return float(value)


def _check_iteration(iteration: int) -> None:
    if not isinstance(iteration, int) or iteration < 0:
        raise ValueError(f"iteration: got {iteration!r}, wanted an integer >= 0")
