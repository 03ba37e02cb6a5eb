"""Pressure waveforms: interpolation, the closed form of the switched valve, and files that must be refused."""

import math
from itertools import pairwise

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchsoro.simulation.actuation import Waveform, read_pressure_csv, square_wave

torch.set_num_threads(1)

KPA = 1e3


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def valve(t, *, amplitude, frequency, duty, rise, fall, start):
    """Pressure behind the valve at one time, half cycle by half cycle."""
    pressure, begin, cycle = 0.0, start, 0
    if t <= start:
        return 0.0
    while True:
        switch, finish = start + (cycle + duty) / frequency, start + (cycle + 1) / frequency
        for target, constant, until in ((amplitude, rise, switch), (0.0, fall, finish)):
            end = target + (pressure - target) * math.exp(-(min(t, until) - begin) / constant)
            if t <= until:
                return end
            pressure, begin = end, until
        cycle += 1


# Interpolation --------------------------------------------------------------------------------------------------------


def test_waveform_is_linear_between_samples_and_constant_outside():
    waveform = Waveform(time=tensor(0.0, 1.0, 3.0), pressure=tensor(10.0, 20.0, -20.0))
    seen = waveform.at(tensor(-5.0, 0.0, 0.25, 1.0, 2.0, 3.0, 99.0))
    torch.testing.assert_close(seen, tensor(10.0, 10.0, 12.5, 20.0, 0.0, -20.0, -20.0), rtol=0, atol=0)


@given(
    steps=st.lists(st.floats(1e-4, 1.0), min_size=1, max_size=6),
    leading=st.sampled_from([(), (1,), (2, 3)]),
    seed=st.integers(0, 1000),
)
def test_samples_are_reproduced_to_the_bit(steps, leading, seed):
    time = torch.cat([tensor(-0.3), -0.3 + tensor(*steps).cumsum(0)])
    generator = torch.Generator().manual_seed(seed)
    pressure = 1e5 * torch.randn(*leading, len(time), generator=generator, dtype=torch.float64)
    assert torch.equal(Waveform(time=time, pressure=pressure).at(time), pressure)


def test_interpolation_is_differentiable():
    time = tensor(0.0, 0.1, 0.3, 0.35)
    pressure = torch.randn(2, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64, requires_grad=True)
    t = tensor(-0.1, 0.02, 0.1, 0.21, 0.34, 0.5)
    assert torch.autograd.gradcheck(lambda p: Waveform(time=time, pressure=p).at(t), pressure)
    inside = tensor(0.02, 0.21, 0.34).requires_grad_()
    assert torch.autograd.gradcheck(Waveform(time=time, pressure=pressure.detach()).at, inside)
    # The weights of the samples add up to one at every time, also outside.
    (gradient,) = torch.autograd.grad(Waveform(time=time, pressure=pressure).at(t).sum(), pressure)
    torch.testing.assert_close(gradient.sum(dim=1), tensor(6.0, 6.0), rtol=1e-14, atol=0)


def test_pressure_keeps_its_type():
    waveform = Waveform(time=tensor(0.0, 1.0), pressure=torch.tensor([0.0, 1.0]))
    assert waveform.at(tensor(0.5)).dtype == torch.float32
    assert waveform.at(torch.tensor([0.5])).tolist() == [0.5]


@pytest.mark.parametrize(
    ("time", "pressure", "message"),
    [
        (torch.tensor([0, 1]), tensor(0.0, 1.0), "time: got torch.int64"),
        ([0.0, 1.0], tensor(0.0, 1.0), "time: got list"),
        (tensor(0.0, 1.0), torch.tensor([1, 2]), "pressure: got torch.int64"),
        (tensor(0.0), tensor(1.0), r"time: got shape \(1,\), want \[S\] with at least 2"),
        (tensor(0.0, 1.0)[None], tensor(0.0, 1.0), r"time: got shape \(1, 2\)"),
        (tensor(0.0, 1.0), tensor(0.0, 1.0, 2.0), r"pressure: got shape \(3,\), want \[..., 2\]"),
        (tensor(0.0, 1.0, 1.0), tensor(0.0, 1.0, 2.0), "time: got 1 s in sample 2 after 1 s, want strictly"),
        (tensor(0.0, 2.0, 1.0), tensor(0.0, 1.0, 2.0), "time: got 1 s in sample 2 after 2 s"),
        (tensor(0.0, 1.0), tensor(0.0, 1.0).to("meta"), "pressure: got device meta, want cpu"),
        (tensor(0.0, math.nan), tensor(0.0, 1.0), "time: got a value that is not finite"),
        (tensor(0.0, 1.0), tensor(0.0, math.inf), "pressure: got a value that is not finite"),
    ],
)
def test_bad_samples_are_refused(time, pressure, message):
    with pytest.raises(ValueError, match=message):
        Waveform(time=time, pressure=pressure)


@pytest.mark.parametrize("t", [0.5, torch.tensor([1]), torch.tensor(0.5), torch.zeros(2, 2)])
def test_bad_times_are_refused(t):
    with pytest.raises(ValueError, match=r"t: got .*want a floating-point tensor \[T\]"):
        Waveform(time=tensor(0.0, 1.0), pressure=tensor(0.0, 1.0)).at(t)


# The switched valve ---------------------------------------------------------------------------------------------------


@given(
    amplitude=st.floats(-50.0 * KPA, 100.0 * KPA),
    frequency=st.floats(0.5, 50.0),
    duty=st.floats(0.05, 0.95),
    rise=st.floats(0.02, 2.0),
    fall=st.floats(0.02, 2.0),
    start=st.floats(0.0, 1.0),
    cycles=st.floats(0.1, 4.0),
    samples=st.integers(4, 60),
)
def test_square_wave_samples_are_the_closed_form(amplitude, frequency, duty, rise, fall, start, cycles, samples):
    shape = {"amplitude": amplitude, "frequency": frequency, "duty": duty, "start": start}
    shape |= {"rise": rise / frequency, "fall": fall / frequency}
    end = start + cycles / frequency
    waveform = square_wave(**shape, end=end, samples_per_period=samples)
    expected = tensor(*[valve(t, **shape) for t in waveform.time.tolist()])
    torch.testing.assert_close(waveform.pressure, expected, rtol=0, atol=1e-9 * max(abs(amplitude), 1.0))
    assert waveform.time[0] == 0.0
    assert waveform.time[-1] == end
    assert float(waveform.time[waveform.time >= start].diff().max()) <= 1.0 / frequency / 2 * (1 + 1e-9)
    assert ((waveform.pressure * math.copysign(1.0, amplitude)) >= 0.0).all()
    assert (waveform.pressure.abs() <= abs(amplitude)).all()


def test_square_wave_by_hand():
    # 80 kPa at 5 Hz, 1:1: 0.1 s open, 0.1 s venting, from 0.25 s on.
    waveform = square_wave(amplitude=80.0 * KPA, frequency=5.0, rise=0.02, fall=0.05, start=0.25, end=0.75)
    seen = waveform.at(tensor(0.0, 0.1, 0.25, 0.27, 0.35, 0.40, 0.45, 1.0))
    top = 80.0 * KPA * (1 - math.exp(-5))
    bottom = top * math.exp(-2)
    final = valve(0.75, amplitude=80.0 * KPA, frequency=5.0, duty=0.5, rise=0.02, fall=0.05, start=0.25)
    expected = [0.0, 0.0, 0.0, 80.0 * KPA * (1 - math.exp(-1)), top, top * math.exp(-1), bottom, final]
    torch.testing.assert_close(seen, tensor(*expected), rtol=1e-9, atol=1e-6)
    assert len(waveform.time) == 1 + int(2.5 * 400) + 1
    for switch in (0.25, 0.35, 0.45, 0.55, 0.65, 0.75):
        assert float((waveform.time - switch).abs().min()) < 1e-12


def test_square_wave_interpolates_the_exponentials_to_the_sampling_error():
    shape = {"amplitude": 80.0 * KPA, "frequency": 5.0, "duty": 0.5, "rise": 0.02, "fall": 0.03, "start": 0.1}
    t = torch.linspace(0.0, 0.7, 5003, dtype=torch.float64)
    exact = tensor(*[valve(one, **shape) for one in t.tolist()])
    errors = []
    for samples in (100, 200, 400):
        waveform = square_wave(**shape, end=0.7, samples_per_period=samples)
        errors.append(float((waveform.at(t) - exact).abs().max()))
        step = 0.2 / samples
        assert errors[-1] <= 1.02 * 80.0 * KPA * (step / 0.02) ** 2 / 8  # interpolation error of exp(-t / rise)
    for coarse, fine in pairwise(errors):
        assert coarse / fine == pytest.approx(4.0, rel=0.05)


def test_square_wave_reaches_its_periodic_state():
    # In the periodic state the extremes solve p+ = A + (p- - A) a, p- = p+ b.
    rise, fall = math.exp(-0.1 / 0.08), math.exp(-0.1 / 0.12)
    high = 80.0 * KPA * (1 - rise) / (1 - rise * fall)
    waveform = square_wave(amplitude=80.0 * KPA, frequency=5.0, rise=0.08, fall=0.12, end=4.0)
    seen = waveform.at(tensor(3.9, 4.0))
    torch.testing.assert_close(seen, tensor(high, high * fall), rtol=1e-9, atol=0)


NUMBERS = {"amplitude": 5e4, "frequency": 20.0, "duty": 0.4, "rise": 4e-3, "fall": 7e-3, "start": 3e-3}


@pytest.mark.parametrize("name", NUMBERS)
def test_gradient_of_a_square_wave_by_each_number_is_the_central_difference(name):
    at = torch.tensor([1e-3, 9.04e-3, 0.02353, 0.04007, 0.0777, 0.10003], dtype=torch.float64)  # none at a sample

    def pressures(value: torch.Tensor | float) -> torch.Tensor:
        return square_wave(**{**NUMBERS, name: value}, end=0.12).at(at) / NUMBERS["amplitude"]

    number = torch.tensor(NUMBERS[name], dtype=torch.float64, requires_grad=True)
    for i, pressure in enumerate(pressures(number)):
        (slope,) = torch.autograd.grad(pressure, number, retain_graph=True)
        step = 1e-5 * NUMBERS[name]
        difference = (pressures(NUMBERS[name] + step)[i] - pressures(NUMBERS[name] - step)[i]) / (2 * step)
        assert float(slope) * NUMBERS[name] == pytest.approx(float(difference) * NUMBERS[name], abs=1e-7)


def test_amplitudes_of_several_chambers_scale_the_wave_of_each():
    one = square_wave(**NUMBERS, end=0.1)
    both = square_wave(**{**NUMBERS, "amplitude": torch.tensor([5e4, -1e4])}, end=0.1)
    torch.testing.assert_close(both.pressure, torch.stack([one.pressure, -0.2 * one.pressure]))


def test_square_wave_ends_cleanly_where_rounding_puts_the_last_switch_beside_the_end():
    for half_cycles in range(1, 60):
        for side in (-math.inf, math.inf):
            end = math.nextafter(0.1 + half_cycles * 0.1, side)
            waveform = square_wave(amplitude=1.0, frequency=5.0, rise=0.1, fall=0.1, start=0.1, end=end)
            assert float(waveform.time.diff().min()) > 1e-4
            assert waveform.time[-1] == end


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"amplitude": math.nan}, "amplitude: got nan"),
        ({"frequency": 0.0}, "frequency: got 0.0"),
        ({"duty": 0.0}, "duty: got 0.0, want more than 0"),
        ({"duty": 1.0}, "duty: got 1.0"),
        ({"duty": math.nan}, "duty: got nan"),
        ({"rise": 0.0}, "rise: got 0.0"),
        ({"fall": -1.0}, "fall: got -1.0"),
        ({"start": -0.1}, "start: got -0.1"),
        ({"end": 0.25}, r"end: got 0.25, want a finite time after start \(0.25 s\)"),
        ({"end": math.inf}, "end: got inf"),
        ({"samples_per_period": 3}, "samples_per_period: got 3"),
        ({"samples_per_period": 10.0}, "samples_per_period: got 10.0"),
    ],
)
def test_bad_square_waves_are_refused(changes, message):
    good = {"amplitude": 8e4, "frequency": 5.0, "rise": 0.02, "fall": 0.02, "start": 0.25, "end": 0.75}
    square_wave(**good)
    with pytest.raises(ValueError, match=message):
        square_wave(**(good | changes))


# Files ----------------------------------------------------------------------------------------------------------------


def write(folder, text):
    path = folder / "pressure.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_file_round_trip_is_exact(tmp_path):
    wave = square_wave(amplitude=8e4, frequency=5.0, rise=0.02, fall=0.02, end=0.3, samples_per_period=20)
    rows = [f"{t!r},{p!r}" for t, p in zip(wave.time.tolist(), wave.pressure.tolist(), strict=True)]
    seen = read_pressure_csv(write(tmp_path, "time_s,pressure_pa\n" + "\n".join(rows)))
    assert torch.equal(seen.time, wave.time)
    assert torch.equal(seen.pressure, wave.pressure)


def test_columns_are_found_by_name(tmp_path):
    text = "\ufeff note , c1_pa,time_s\n\nfirst, 1.5e3 ,0\n,-20,0.004\n\n"
    seen = read_pressure_csv(str(write(tmp_path, text)), pressure_column="c1_pa")
    assert seen.time.tolist() == [0.0, 0.004]
    assert seen.pressure.tolist() == [1500.0, -20.0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"got columns \[\], want also \['time_s', 'pressure_pa'\]"),
        ("time_s,p\n0,1\n", r"got columns \['time_s', 'p'\], want also \['pressure_pa'\]"),
        ("time_s,pressure_pa\n", r"got 0 row\(s\)"),
        ("time_s,pressure_pa\n0,1\n", r"got 1 row\(s\) of numbers, want at least 2"),
        ("time_s,pressure_pa\n0,1\n\n1,high\n", "line 4: got pressure_pa = 'high', want a finite number"),
        ("time_s,pressure_pa\n0,1\n1\n", "line 3: got pressure_pa = ''"),
        ("time_s,pressure_pa\n0,1\n1,nan\n", "line 3: got pressure_pa = 'nan'"),
        ("time_s,pressure_pa\n0,1\ninf,1\n", "line 3: got time_s = 'inf'"),
        ("time_s,pressure_pa\n0,1\n2,1\n1,1\n", "line 4: got time_s = 1.0 after 2.0, want strictly increasing"),
        ("time_s,pressure_pa\n0,1\n0,1\n", "line 3: got time_s = 0.0 after 0.0"),
    ],
)
def test_bad_files_are_refused(tmp_path, text, message):
    with pytest.raises(ValueError, match=message) as caught:
        read_pressure_csv(write(tmp_path, text))
    assert "pressure.csv" in str(caught.value)


def test_missing_file_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"path: got .*nowhere\.csv', want an existing CSV file"):
        read_pressure_csv(tmp_path / "nowhere.csv")
