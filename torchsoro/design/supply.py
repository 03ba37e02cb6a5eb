"""The supply of the chambers: a valve for each, with amplitude, phase and duty that are given or designed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from torchsoro.design.limits import check_pressure
from torchsoro.design.settings import Settings
from torchsoro.simulation.actuation import Waveform, read_pressure_csv, side_by_side, square_wave

# Part of a cycle that a designed valve is open, at least and at most [1]: at 5 Hz a tenth of a cycle is 20 ms, about
# the time constant of filling, and a shorter pulse would hardly be felt.
DUTY = (0.1, 0.9)
BOUNDS = {"amplitude": (0.0, 1.0), "phase": (0.0, 1.0), "duty": DUTY}


class Supply(nn.Module):
    """Pressure of each chamber over time, from a valve that switches with the same frequency for all of them.

    The valve of chamber c first opens ``phase_c`` periods after the actuation starts, stays open for ``duty_c`` of each
    period, and fills with up to ``amplitude_c`` times the supply's pressure (see
    :func:`torchsoro.simulation.actuation.square_wave`). These three are parameters [chambers], float64 on the CPU, all
    of order one, so that one learning rate goes with them.

    Designed ones are bounded by :meth:`clamp_` after each optimizer step, as the design variable is: a sigmoid would
    have no finite argument at the bounds, where full pressure and no phase lie, and hardly a gradient near them. Every
    phase is free between 0 and 1, rather than one the reference of the others: each chamber may then lead each other
    one. A delay of all of them gains nothing, and only shortens the walk.

    Args:
        pressure: Of the supply, Pa gauge.
        frequency: Cycles per second, Hz.
        rise: Time constant of filling, s.
        fall: Time constant of venting, s.
        start: Of the actuation, s.
        end: Of the actuation, s.
        amplitude: Largest pressure of each chamber as a share of the supply's, 0 to 1; as long as the chambers.
        phase: First opening of each valve after ``start``, in periods, 0 to 1; all 0 if empty.
        duty: Part of a period that each valve is open, in (0, 1), designed ones within ``DUTY``; all a half if empty.
        designed: Names of those of the three that are designed: they require gradients.
        measured: Pressure [S] of every chamber instead of valves, from the start of the simulation.

    Raises:
        ValueError: Not as many values as chambers, a value out of its range, a name that is none of the three, or a
            measured pressure with valves that are designed.
    """

    def __init__(
        self,
        *,
        pressure: float,
        frequency: float,
        rise: float,
        fall: float,
        start: float,
        end: float,
        amplitude: Sequence[float] = (1.0,),
        phase: Sequence[float] = (),
        duty: Sequence[float] = (),
        designed: Sequence[str] = (),
        measured: Waveform | None = None,
    ) -> None:
        super().__init__()
        self.pressure, self.frequency, self.rise, self.fall = pressure, frequency, rise, fall
        self.start, self.end, self.measured = start, end, measured
        chambers = len(amplitude)
        if unknown := sorted(set(designed) - set(BOUNDS)):
            raise ValueError(f"designed = {', '.join(unknown)}: wanted some of {', '.join(BOUNDS)}")
        if measured is not None and designed:
            raise ValueError(f"designed = {tuple(designed)}: wanted none with a pressure that is measured")
        given = {"amplitude": amplitude, "phase": phase or (0.0,) * chambers, "duty": duty or (0.5,) * chambers}
        for name, values in given.items():
            low, high = BOUNDS[name] if name in designed or name != "duty" else (0.0, 1.0)
            value = torch.tensor(tuple(values), dtype=torch.float64)
            inside = (value >= low) & (value <= high) & ((name != "duty") | ((value > 0) & (value < 1)))
            if len(value) != chambers or not chambers or not bool(inside.all()):
                wanted = f"one for each of the {chambers} chambers, from {low:g} to {high:g}"
                raise ValueError(f"{name} = {tuple(values)}: wanted {wanted}")
            self.register_parameter(name, nn.Parameter(value, requires_grad=name in designed))
        self.amplitude: nn.Parameter
        self.phase: nn.Parameter
        self.duty: nn.Parameter
        self()  # refuses what the valves cannot do

    @property
    def chambers(self) -> int:
        """Number of chambers."""
        return len(self.amplitude)

    def designed(self) -> list[nn.Parameter]:
        """The parameters that are designed; none where all are given."""
        return [one for one in self.parameters() if one.requires_grad]

    def forward(self, *, mirrored: bool = False) -> Waveform:
        """The pressure from the start of the simulation, with a gradient by the parameters.

        Args:
            mirrored: Give the first chamber's valve to the last one, the second's to the last but one, and so on: on a
                body whose chambers are mirror images of each other, the same motion as seen in a mirror.

        Returns:
            Pressure [S] Pa of a single chamber, or of each [chambers, S]; float64 on the CPU.
        """
        if self.measured is not None:
            if self.chambers == 1:
                return self.measured
            pressure = self.measured.pressure.expand(self.chambers, -1)
            return Waveform(time=self.measured.time, pressure=pressure)
        values = torch.stack([self.amplitude, self.phase, self.duty], -1)
        waves = [self._wave(*one.unbind()) for one in (values.flip(0) if mirrored else values)]
        return waves[0] if len(waves) == 1 else side_by_side(waves)

    def each(self, rows: Mapping[str, Tensor]) -> Waveform:
        """The pressure of several supplies that differ from this one in designed parameters, with a gradient by these.

        Args:
            rows: Values [S, chambers] of parameters, by name.

        Returns:
            Pressure [S, chambers, T] Pa at times [S, chambers, T] s.
        """
        count = len(next(iter(rows.values())))
        waves = [
            torch.func.functional_call(self, {name: values[k] for name, values in rows.items()}, ())
            for k in range(count)
        ]
        if self.chambers == 1:
            waves = [side_by_side([wave]) for wave in waves]
        times, pressures = ([getattr(wave, name) for wave in waves] for name in ("time", "pressure"))
        return Waveform(time=torch.stack(times), pressure=torch.stack(pressures))

    def _wave(self, amplitude: Tensor, phase: Tensor, duty: Tensor) -> Waveform:
        period = 1 / self.frequency
        # Beyond the end by the longest delay, whatever the phase: each valve opens before its last sample, and samples
        # move with the opening of their valve only.
        end = self.end if self.chambers == 1 else self.end + period
        return square_wave(
            amplitude=self.pressure * amplitude,
            frequency=self.frequency,
            duty=duty,
            rise=self.rise,
            fall=self.fall,
            start=self.start + phase * period,
            end=end,
        )

    @torch.no_grad()
    def clamp_(self) -> Supply:
        """Bring designed parameters back into their bounds in place, as after each optimizer step; return self."""
        for name, one in self.named_parameters():
            if one.requires_grad:
                one.clamp_(*BOUNDS[name])
        return self

    def numbers(self) -> dict[str, float]:
        """Amplitude [Pa], phase [periods] and duty [1] of each chamber, as ``amplitude_1``, ``phase_1``, ..."""
        scale = {"amplitude": self.pressure, "phase": 1.0, "duty": 1.0}
        return {
            f"{name}_{chamber}": scale[name] * value
            for name, one in self.named_parameters()
            for chamber, value in enumerate(one.tolist(), start=1)
        }

    @torch.no_grad()
    def blend_(self, other: Mapping[str, Tensor], share: float) -> None:
        """Move in place towards another state by a share of the way."""
        for name, one in self.named_parameters():
            one.lerp_(other[name].to(one), share)

    def extra_repr(self) -> str:
        """Present values for ``print(supply)``."""
        values = ", ".join(f"{name}={one.tolist()}" for name, one in self.named_parameters())
        return f"pressure={self.pressure:g} Pa, frequency={self.frequency:g} Hz, {values}"


def supply_of(s: Settings, modulus: float) -> Supply:
    """The supply of the settings: at rest while the robot settles, then valves, or the pressure that was measured.

    Args:
        s: The settings.
        modulus: Young's modulus of the solid, Pa.

    Raises:
        ValueError: for numbers out of their range, and a pressure that does not fit the modulus or the duration.
    """
    if s.pressure_file is not None and (given := [n for n in ("amplitudes", "phases", "duties") if getattr(s, n)]):
        raise ValueError(f"pressure_file: beside {', '.join(given)}, wanted valves or a measured pressure")
    measured = None if s.pressure_file is None else _measured(s, s.pressure_file, modulus)
    if measured is None and s.material is not None:
        check_pressure("pressure", s.pressure, modulus)
    return Supply(
        pressure=s.pressure,
        frequency=s.frequency,
        rise=s.rise,
        fall=s.fall,
        start=s.settle,
        end=s.settle + s.duration,
        amplitude=s.amplitudes or (1.0,) * s.chambers,
        phase=s.phases,
        duty=s.duties or (s.duty,) * s.chambers,
        designed=s.timing,
        measured=measured,
    )


def _measured(s: Settings, path: Path, modulus: float) -> Waveform:
    """A measured gauge pressure, from the start of the simulation."""
    measured = read_pressure_csv(path)
    begin, end = float(measured.time[0]), float(measured.time[-1])
    if abs(begin) > s.sample_every or end < s.duration - s.sample_every:
        raise ValueError(
            f"pressure_file = {path}: from {begin:g} to {end:g} s, wanted times that begin with the "
            f"actuation, at 0, and last for its duration of {s.duration:g} s"
        )
    check_pressure(f"pressure_file = {path}, largest", float(measured.pressure.abs().max()), modulus)
    return Waveform(time=measured.time - measured.time[0] + s.settle, pressure=measured.pressure)
