"""Chamber pressure over time: measured, or modelled as a switched valve with a first-order lag.

Pressures are gauge pressures, Pa, and times are in s.
"""

from __future__ import annotations

import csv
import dataclasses
import math
import os
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

_MOST_SAMPLES = 10_000_000  # of a square wave: 160 MB


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Waveform:
    """Pressure samples, linear in between and constant before the first and after the last.

    Args:
        time: Sample times, s, strictly increasing, floating point [S] with S >= 2; or [chambers, S], of each chamber
            its own, or [batch, chambers, S].
        pressure: Gauge pressure at these times, Pa, floating point [..., S]; leading axes are, for example, chambers.
            May require a gradient.

    Raises:
        ValueError: Wrong shape or type, a number that is not finite, or times that do not increase.
    """

    time: Tensor
    pressure: Tensor

    def __post_init__(self) -> None:
        """Check shapes, types and values."""
        for name, value in (("time", self.time), ("pressure", self.pressure)):
            if not isinstance(value, Tensor) or not value.is_floating_point():
                kind = value.dtype if isinstance(value, Tensor) else type(value).__name__
                raise ValueError(f"{name}: got {kind}, want a floating-point tensor")
        own = self.time.ndim in (2, 3) and self.pressure.shape[-self.time.ndim :] == self.time.shape
        if not (self.time.ndim == 1 or own) or self.time.shape[-1] < 2:
            raise ValueError(
                f"time: got shape {tuple(self.time.shape)}, want [S] with at least 2 samples, or [chambers, S] as in "
                "pressure"
            )
        if self.pressure.ndim == 0 or self.pressure.shape[-1] != self.time.shape[-1]:
            raise ValueError(
                f"pressure: got shape {tuple(self.pressure.shape)}, want [..., {self.time.shape[-1]}] as in time"
            )
        if self.pressure.device != self.time.device:
            raise ValueError(f"pressure: got device {self.pressure.device}, want {self.time.device} as in time")
        for name, value in (("time", self.time), ("pressure", self.pressure)):
            if not bool(torch.isfinite(value.detach()).all()):
                raise ValueError(f"{name}: got a value that is not finite, want finite numbers")
        steps = self.time.detach().diff()
        if not bool((steps > 0.0).all()):
            *row, sample = (steps <= 0.0).nonzero()[0].tolist()
            sample, times = sample + 1, self.time[tuple(row)]
            before, after = times[sample - 1].item(), times[sample].item()
            raise ValueError(
                f"time: got {after:.9g} s in sample {sample} after {before:.9g} s, want strictly increasing times"
            )

    def at(self, t: Tensor) -> Tensor:
        """Interpolate linearly; differentiable with respect to the samples' pressures and times, and to ``t``.

        Args:
            t: Times, s, floating point [T], on the device of the samples.

        Returns:
            Pressure, Pa, [..., T], in the type of the samples.

        Raises:
            ValueError: Wrong shape or type.
        """
        if not isinstance(t, Tensor) or not t.is_floating_point() or t.ndim != 1:
            seen = f"{t.dtype} {tuple(t.shape)}" if isinstance(t, Tensor) else repr(t)
            raise ValueError(f"t: got {seen}, want a floating-point tensor [T]")
        wanted = t.detach().to(self.time.dtype).expand(*self.time.shape[:-1], len(t)).contiguous()
        after = torch.searchsorted(self.time.detach().contiguous(), wanted, right=True)
        after = after.clamp(1, self.time.shape[-1] - 1)
        begin, end = _samples(self.time, after - 1), _samples(self.time, after)
        weight = ((t - begin) / (end - begin)).clamp(0.0, 1.0).to(self.pressure.dtype)
        # lerp is exact at both ends, which p0 + w (p1 - p0) is not.
        return torch.lerp(_samples(self.pressure, after - 1), _samples(self.pressure, after), weight)


def _samples(values: Tensor, index: Tensor) -> Tensor:
    """Samples [..., T] of values [..., S] at indices [T], or at those of each chamber [chambers, T]."""
    if index.ndim == 1:
        return values[..., index]
    return values.gather(-1, index.expand(*values.shape[:-1], index.shape[-1]))


def side_by_side(waveforms: Sequence[Waveform]) -> Waveform:
    """Waveforms of one chamber each, [S], as one of all chambers, [chambers, S], each with its own sample times.

    A shorter one goes on with its last pressure, which it has after its last sample anyway: every millisecond, which is
    no coarser than a lag behind it is computed with.

    Args:
        waveforms: One for each chamber.

    Raises:
        ValueError: There is none, or one has the pressures of several chambers.
    """
    if not waveforms or any(one.pressure.ndim != 1 for one in waveforms):
        shapes = [tuple(one.pressure.shape) for one in waveforms]
        raise ValueError(f"waveforms: got pressures of shapes {shapes}, want at least one, each [S]")
    longest = max(len(one.time) for one in waveforms)
    times, pressures = [], []
    for one in waveforms:
        more = longest - len(one.time)
        later = 1e-3 * (1 + torch.arange(more, dtype=one.time.dtype, device=one.time.device))  # s after the last
        times.append(torch.cat([one.time, one.time[-1].detach() + later]))
        pressures.append(torch.cat([one.pressure, one.pressure[-1].expand(more)]))
    return Waveform(time=torch.stack(times), pressure=torch.stack(pressures))


def square_wave(
    *,
    amplitude: float | Tensor,
    frequency: float | Tensor,
    duty: float | Tensor = 0.5,
    rise: float | Tensor,
    fall: float | Tensor,
    start: float | Tensor = 0.0,
    end: float,
    samples_per_period: int = 400,
) -> Waveform:
    """Pressure behind a valve that switches between 0 and ``amplitude``, as a first-order lag.

    While the valve is open ``p' = (amplitude - p) / rise``, while it vents ``p' = -p / fall``. The samples are the
    exact exponentials, evenly spaced within each half cycle, with one sample at every switching instant. Times and
    pressures of the samples are differentiable in every number that is given as a tensor; their count is not, so that
    a derivative by ``frequency``, ``duty`` or ``start`` is that of the samples there are.

    Args:
        amplitude: Supply pressure, Pa gauge; negative for vacuum. A number, or a tensor [...] such as one per chamber.
        frequency: Cycles per second, Hz. This and what follows: a number or a tensor of no axes.
        duty: Part of each cycle with the valve open, in (0, 1).
        rise: Time constant of filling, s.
        fall: Time constant of venting, s.
        start: First opening of the valve, s, >= 0. The pressure is 0 until then.
        end: Last sample, s, after ``start``; a number.
        samples_per_period: Samples in one full cycle, at least 4.

    Returns:
        Waveform from t = 0 to ``end``, float64 [..., S].

    Raises:
        ValueError: An argument is out of its range.
    """
    height = _double("amplitude", amplitude)
    if not bool(torch.isfinite(height.detach()).all()):
        raise ValueError(f"amplitude: got {amplitude!r}, want a finite pressure in Pa")
    cycles_per_second, open_part, filling, venting, first = (
        _double(name, value, scalar=True)
        for name, value in (("frequency", frequency), ("duty", duty), ("rise", rise), ("fall", fall), ("start", start))
    )
    for name, value in (("frequency", cycles_per_second), ("rise", filling), ("fall", venting)):
        if not (math.isfinite(value.item()) and value.item() > 0.0):
            raise ValueError(f"{name}: got {value.item()!r}, want a finite number > 0")
    if not 0.0 < open_part.item() < 1.0:
        raise ValueError(f"duty: got {open_part.item()!r}, want more than 0 and less than 1")
    if not (math.isfinite(first.item()) and first.item() >= 0.0):
        raise ValueError(f"start: got {first.item()!r}, want a finite time >= 0 s")
    last = _double("end", end, scalar=True).detach()
    if not (math.isfinite(last.item()) and last.item() > first.item()):
        raise ValueError(f"end: got {last.item()!r}, want a finite time after start ({first.item()!r} s)")
    if isinstance(samples_per_period, bool) or not isinstance(samples_per_period, int) or samples_per_period < 4:
        raise ValueError(f"samples_per_period: got {samples_per_period!r}, want a whole number >= 4")
    cycles = (last.item() - first.item()) * cycles_per_second.item()
    if cycles * samples_per_period > _MOST_SAMPLES:
        raise ValueError(
            f"frequency: got {cycles_per_second.item()!r} Hz, {cycles:.3g} cycles of {samples_per_period} samples, "
            f"want at most {_MOST_SAMPLES} samples"
        )

    period = 1.0 / cycles_per_second
    rest = torch.zeros(1 if first.item() > 0.0 else 0, dtype=torch.float64)
    times, pressures = [rest], [rest.expand(*height.shape, len(rest))]
    pressure = torch.zeros_like(height)  # at the beginning of the half cycle
    begin, half_cycle = first, 0
    while begin.item() < last.item():
        valve_open = half_cycle % 2 == 0
        target, constant = (height, filling) if valve_open else (torch.zeros_like(height), venting)
        share = open_part if valve_open else 1.0 - open_part
        # From the start, so that rounding does not add up.
        finish = first + (half_cycle // 2 + (open_part if valve_open else 1.0)) * period
        if finish.item() > last.item() - 1e-9 * period.item():
            finish = last
        length = (finish - begin).item()
        samples = max(2, round(samples_per_period * share.item()))
        samples = max(1, math.ceil(samples * length / (share * period).item() - 1e-6))
        elapsed = torch.linspace(0.0, 1.0, samples + 1, dtype=torch.float64) * (finish - begin)
        lagged = target.unsqueeze(-1) + (pressure - target).unsqueeze(-1) * torch.exp(-elapsed / constant)
        times.append(begin + elapsed[:-1])
        pressures.append(lagged[..., :-1])
        pressure, begin, half_cycle = lagged[..., -1], finish, half_cycle + 1
    times.append(last.reshape(1))
    pressures.append(pressure.unsqueeze(-1))
    return Waveform(time=torch.cat(times), pressure=torch.cat(pressures, -1))


def _double(name: str, value: float | Tensor, *, scalar: bool = False) -> Tensor:
    """A number as a float64 tensor on the CPU, with its gradient."""
    if isinstance(value, Tensor):
        if scalar and value.ndim != 0:
            raise ValueError(
                f"{name}: got a tensor of shape {tuple(value.shape)}, want a number or a tensor of no axes"
            )
        return value.to("cpu", torch.float64)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{name}: got {value!r}, want a number or a tensor")
    return torch.tensor(value, dtype=torch.float64)


def read_pressure_csv(
    path: str | os.PathLike[str], *, time_column: str = "time_s", pressure_column: str = "pressure_pa"
) -> Waveform:
    """Read a measured pressure from a comma-separated file with a header line.

    Args:
        path: File to read. Empty lines are skipped; other columns are ignored.
        time_column: Header of the times, s, which must increase strictly.
        pressure_column: Header of the gauge pressures, Pa.

    Returns:
        Waveform of all rows, float64 [S].

    Raises:
        ValueError: The file or a column is missing, a cell is not a finite number, times do not increase, or there are
            fewer than two rows. The message names the file and the line (the header is line 1 of the file).
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"path: got {str(path)!r}, want an existing CSV file")
    times: list[float] = []
    pressures: list[float] = []
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file, skipinitialspace=True)
            lines = [(reader.line_num, row) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: got no table of text ({error}), want a CSV file") from error
    header = [name.strip() for name in lines[0][1]] if lines else []
    missing = [name for name in (time_column, pressure_column) if name not in header]
    if missing:
        raise ValueError(f"{path}: got columns {header}, want also {missing}")
    columns = (header.index(time_column), header.index(pressure_column))
    for number, row in lines[1:]:
        if not any(cell.strip() for cell in row):
            continue
        where = f"{path}, line {number}"
        time, pressure = (_number(row, column, header[column], where) for column in columns)
        if times and time <= times[-1]:
            raise ValueError(f"{where}: got {time_column} = {time} after {times[-1]}, want strictly increasing times")
        times.append(time)
        pressures.append(pressure)
    if len(times) < 2:
        raise ValueError(f"{path}: got {len(times)} row(s) of numbers, want at least 2")
    return Waveform(
        time=torch.tensor(times, dtype=torch.float64), pressure=torch.tensor(pressures, dtype=torch.float64)
    )


def _number(row: list[str], column: int, name: str, where: str) -> float:
    """One cell as a finite number."""
    cell = row[column] if column < len(row) else ""
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{where}: got {name} = {cell!r}, want a finite number")
    return value
