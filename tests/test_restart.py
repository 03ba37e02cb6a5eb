"""Runs that go on from earlier ones: state and clock."""

from __future__ import annotations

import pytest
import torch
from problems import DT, block, simulator, vector, ways

from torchsoro import Force, Prony, Waveform, ground

FREE = (0.0, 0.0, 0.0)


def ramps(steps: int) -> dict[str, object]:
    """Pressure, gravity and a force that change over so many substeps, for a body of 4 x 4 x 6 particles with air."""
    time = vector(0.0, 0.4, 1.0) * steps * DT
    rise = vector(0.0, 1.0, 0.2)
    return {
        "prony": Prony.paper(3),
        "planes": [ground()],
        "pressure": Waveform(time=time, pressure=300.0 * rise.unsqueeze(0)),
        "gravity": (time, rise.unsqueeze(1) * vector(1.0, 0.3, -9.0)),
        "loads": [Force(particles=torch.arange(90, 96), value=rise.unsqueeze(1) * vector(0.0, 1e-3, 2e-3), time=time)],
        "sample_every": 5 * DT,
        "probes": torch.tensor([0, 95]),
    }


@ways("apic", "flip", "total")
def test_two_halves_of_a_ramp_equal_the_whole_bit_for_bit(way):
    _, body = block((4, 4, 6), air=True)
    sim, arguments = simulator(**way), ramps(150)
    whole = sim(body, duration=150 * DT, **arguments)
    first = sim(body, duration=70 * DT, **arguments)
    second = sim(body, duration=80 * DT, start=first, **arguments)
    assert torch.equal(second.final, whole.final)
    for name in ("time", "position", "velocity", "center_of_gravity", "center_velocity", "chamber_volume"):
        assert torch.equal(getattr(second, name), getattr(whole, name)[14:]), name
    assert torch.equal(second.chamber_pressure, whole.chamber_pressure[14:])
    # From the state alone the ramp begins again.
    again = sim(body, duration=80 * DT, start=first.final, **arguments)
    assert torch.equal(again.time, whole.time[:17])
    assert float((again.chamber_pressure[0] - whole.chamber_pressure[14]).abs()) > 10.0


@ways("apic", "total")
def test_a_run_goes_on_with_another_substep_at_the_time_of_the_last(way):
    _, body = block()
    first = simulator(dt=DT, **way)(body, duration=7 * DT, gravity=FREE)
    shorter = {"duration": 3 * DT, "sample_every": 0.75 * DT, "gravity": FREE}
    second = simulator(dt=0.75 * DT, **way)(body, start=first, **shorter)
    torch.testing.assert_close(second.time, DT * (7 + 0.75 * torch.arange(5).double()), rtol=1e-12, atol=0)


def test_another_substep_is_refused_for_histories_of_the_total_form():
    _, body = block()
    first = simulator(formulation="total")(body, duration=4 * DT, prony=Prony.paper(1))
    with pytest.raises(ValueError, match=r"^start: a trajectory with a substep of 5e-05 s, wanted the 2\.5e-05 s"):
        simulator(formulation="total", dt=DT / 2)(body, duration=4 * DT, prony=Prony.paper(1), start=first)
