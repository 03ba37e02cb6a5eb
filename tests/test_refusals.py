"""Arguments that the simulator refuses before any work, with the value seen and the value wanted."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from problems import DT, H, block, constant, simulator, vector, ways

from torchsoro import DesignField, Force, Gas, Prony, Simulator, Solid, ground, stable_step, stride, travel

FREE = (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"cell": 0.0}, r"cell = 0\.0: wanted finite and positive"),
        ({"cell": math.nan}, r"cell = nan: wanted finite and positive"),
        ({"dt": -1e-5}, r"dt = -1e-05: wanted finite and positive"),
        ({"dt": math.inf}, r"dt = inf: wanted finite and positive"),
        ({"memory_budget": 0}, r"memory_budget = 0: wanted finite and positive"),
        ({"segment": -3}, r"segment = -3: wanted finite and positive"),
        ({"low": (0.0, 0.0)}, r"low, high = .*: wanted three numbers each, over 6 cells apart"),
        ({"low": (0.1, 0.0, 0.0)}, r"low, high = .*: wanted three numbers each, over 6 cells apart"),
        ({"high": (0.1, 0.1, math.nan)}, r"low, high = .*: wanted three numbers each, over 6 cells apart"),
        ({"transfer": "pic"}, r"transfer = 'pic': wanted one of 'apic', 'flip'"),
    ],
)
def test_bad_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match="^" + message):
        simulator(**settings)


def changed(name, make):
    """The body of the refusal tests, with one of its tensors made wrong."""
    _, body = block()
    value = getattr(body, name)
    return replace(body, **{name: make(body.mass if value is None else value)})


def numbered(*chambers):
    """Makes chambers of these numbers, of a particle each."""
    return lambda x: torch.cat([torch.tensor(chambers, dtype=x.dtype), x[len(chambers) :]])


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (lambda: changed("position", lambda x: x.half()), r"body\.position: dtype torch\.float16, wanted float32 or"),
        (lambda: changed("position", lambda x: x.long()), r"body\.position: dtype torch\.int64, wanted float32 or"),
        (lambda: changed("position", lambda x: x[:, :2]), r"body\.position: shape \(64, 2\), wanted \[\.\.\., 64, 3\]"),
        (lambda: changed("position", lambda x: x[0]), r"body\.position: shape \(3,\), wanted \[\.\.\., N, 3\]"),
        (lambda: changed("position", lambda x: x * math.nan), r"body\.position: value nan, wanted finite"),
        (lambda: changed("position", lambda x: x.to("meta")), r"body\.position: torch\.float64 on meta, wanted"),
        (lambda: changed("position", lambda x: x + 0.2), r"body\.position: .* wanted inside the analysis box"),
        (lambda: changed("mass", lambda x: x.float()), r"body\.mass: torch\.float32 on cpu, wanted torch\.float64 on"),
        (lambda: changed("mass", lambda x: x.to("meta")), r"body\.mass: torch\.float64 on meta, wanted .* on cpu"),
        (lambda: changed("mass", lambda x: x[:5]), r"body\.mass: shape \(5,\), wanted \[\.\.\., 64\]"),
        (lambda: changed("mass", lambda x: 0 * x), r"body\.mass: value 0\.0, wanted finite and positive"),
        (lambda: changed("volume", lambda x: -x), r"body\.volume: value -.*, wanted finite and positive"),
        (lambda: changed("bulk", lambda x: -x), r"body\.bulk: value -.*, wanted finite and at least 0"),
        (lambda: changed("shear", lambda x: x * math.inf), r"body\.shear: value inf, wanted finite and at least 0"),
        (lambda: changed("viscosity", lambda x: x - 1), r"body\.viscosity: value -1\.0, wanted finite and at least 0"),
        (lambda: changed("volume_viscosity", lambda x: x[:5]), r"body\.volume_viscosity: shape \(5,\), wanted"),
        (lambda: changed("velocity", lambda x: x), r"body\.velocity: shape \(64,\), wanted \[\.\.\., 64, 3\]"),
        (lambda: changed("velocity", lambda x: torch.full((64, 3), math.inf).double()), r"body\.velocity: value inf"),
        (lambda: changed("chamber", lambda x: x[:5]), r"body\.chamber: shape \(5,\), wanted \[64\]"),
        (lambda: changed("chamber", lambda x: x - 1), r"body\.chamber: numbers \[-2\], wanted -1 for a solid, and"),
        (lambda: changed("chamber", numbered(0, 2)), r"body\.chamber: numbers \[-1, 0, 2\], wanted .* 0 to one less"),
    ],
)
def test_bad_bodies_are_refused(body, message):
    with pytest.raises(ValueError, match="^" + message):
        simulator()(body(), duration=10 * DT)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"duration": 0.0}, r"duration = 0\.0: wanted finite and positive"),
        ({"duration": math.nan}, r"duration = nan: wanted finite and positive"),
        ({"duration": 1.5 * DT}, r"duration = 7\.5e-05 s: wanted a whole number of substeps of 5e-05 s"),
        ({"duration": 0.3 * DT}, r"duration = 1\.5e-05 s: wanted a whole number"),
        ({"sample_every": 2.5 * DT}, r"sample_every = 0\.000125 s: wanted a whole number of substeps"),
        ({"sample_every": -DT}, r"sample_every = -5e-05: wanted finite and positive"),
        ({"gravity": (0.0, -9.81)}, r"gravity: shape \(2,\), wanted \[\.\.\., 3\]"),
        ({"gravity": (0.0, 0.0, math.nan)}, r"gravity = .*: wanted finite"),
        (
            {"gravity": (vector(0.0, 1.0), torch.zeros(2, 2))},
            r"gravity: .* of \(2, 2\), wanted \[S\] and \[\.\.\., S, 3\]",
        ),
        ({"gravity": (vector(0.0, 0.0), torch.zeros(2, 3))}, r"gravity: time: .* strictly increasing"),
        ({"loads": [Force(particles=torch.arange(3), value=torch.zeros(4, 3), time=vector(0.0, 1.0))]}, "Force: times"),
        ({"pressure": constant(1.0)}, r"pressure: 1 chambers, wanted the body's 0"),
        ({"probes": torch.tensor([0.5])}, r"probes: places of shape \(1,\), wanted finite places \[P, 3\] m"),
        ({"probes": torch.tensor([[1]])}, r"probes: torch\.int64 of shape \(1, 1\), wanted int64 \[P\]"),
        ({"probes": torch.tensor([64])}, r"probes: 64 to 64, wanted 0 to 63"),
        ({"probes": torch.tensor([-1, 3])}, r"probes: -1 to 3, wanted 0 to 63"),
        ({"weight": torch.ones(5)}, r"weight: shape \(5,\), wanted \[\.\.\., 64\]"),
        ({"weight": torch.zeros(64)}, r"weight: .*wanted .*positive sum"),
        ({"gravity": torch.zeros(2, 3), "planes": [ground(torch.zeros(3))]}, r"leading axes .* wanted .*broadcast"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    _, body = block()
    with pytest.raises(ValueError, match="^" + message):
        simulator()(body, **{"duration": 10 * DT, **arguments})


def test_an_automatic_step_needs_whole_samples():
    with pytest.raises(ValueError, match=r"duration = 0\.01 s: wanted a whole number of samples of 0\.003 s"):
        simulator(dt="auto")(block()[1], duration=0.01, sample_every=0.003)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda s: s[..., :-1],
            r"a state of shape \(1, .*\), wanted \(1, .*\), as for 1 simulation\(s\) of this body with 0",
        ),
        (lambda s: s.expand(2, *s.shape[1:]), r"a state of shape \(2, .*\), wanted \(1, "),
        (lambda s: s.float(), r"torch\.float32 on cpu, wanted torch\.float64 on cpu as body\.position"),
        (lambda s: s.to("meta"), r"torch\.float64 on meta, wanted torch\.float64 on cpu"),
        (lambda s: s * math.nan, r"a state with values that are not finite"),
        (lambda s: s.tolist(), r"list, wanted a Trajectory or its final state"),
    ],
)
@ways("apic", "total")
def test_bad_start_is_refused_by_its_name(way, change, message):
    _, body = block()
    sim = simulator(**way)
    start = change(sim(body, duration=DT).final)
    with pytest.raises(ValueError, match="^start: " + message):
        sim(body, duration=10 * DT, start=start)


def test_start_of_the_other_formulation_is_refused():
    _, body = block()
    updated, total = simulator(), simulator(formulation="total")
    with pytest.raises(ValueError, match=r"^start: a state of shape .*in the 'updated' formulation"):
        updated(body, duration=DT, start=total(body, duration=DT))
    with pytest.raises(ValueError, match=r"^start: a state of shape .*in the 'total' formulation"):
        total(body, duration=DT, start=updated(body, duration=DT))


def test_pressure_of_too_few_chambers_is_refused():
    _, body = block((4, 4, 6), air=True)
    with pytest.raises(ValueError, match=r"^pressure: 2 chambers, wanted the body's 1"):
        simulator()(body, duration=10 * DT, pressure=constant(1.0, 2.0))


@pytest.mark.parametrize("elements", [0, 3, 5])
def test_a_step_above_the_limit_is_refused(elements):
    _, body = block()
    prony = Prony.paper(elements)
    limit = stable_step(body, prony, cell=2 * H)
    assert len(simulator(dt=0.99 * limit)(body, duration=0.99 * limit, prony=prony).time) == 2
    step = 1.05 * limit
    with pytest.raises(
        ValueError, match=rf"^dt = {step:g} s: above the limit of about [\d.e-]+ s, set by elastic"
    ) as refusal:
        simulator(dt=step)(body, duration=step, prony=prony)
    said = float(str(refusal.value).split("about ")[1].split(" s")[0])
    # What it says is near, and on the safe side or hardly off: stiffness falls as the step grows.
    assert said == pytest.approx(limit, rel=0.05)
    assert ("Maxwell element" in str(refusal.value)) == (elements > 0)


def test_the_limit_of_the_gas_is_refused_by_name():
    _, body = block((4, 4, 6), air=True, gas=Gas(density=0.5))
    with pytest.raises(ValueError, match=r"set by pressure waves in the gas"):
        simulator()(body, duration=DT)


@pytest.mark.parametrize("poisson_ratio", [0.0, 0.4, 0.49])
def test_the_limit_grows_with_the_cell(poisson_ratio):
    _, body = block(solid=Solid(poisson_ratio=poisson_ratio))
    assert stable_step(body, None, cell=4 * H) == pytest.approx(2 * stable_step(body, None, cell=2 * H), rel=1e-3)


def test_a_box_of_few_cells_is_refused():
    with pytest.raises(ValueError, match="over 6 cells apart"):
        Simulator(cell=0.01, dt=1e-5, low=FREE, high=(0.06, 0.1, 0.1))


@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("cell", lambda n: Simulator(cell=n, dt=1e-4, low=(-1.0,) * 3, high=(1.0,) * 3)),
        ("dt", lambda n: Simulator(cell=5e-3, dt=n, low=(-1.0,) * 3, high=(1.0,) * 3)),
        ("low", lambda n: Simulator(cell=5e-3, dt=1e-4, low=(n, -1.0, -1.0), high=(1.0,) * 3)),
        ("duration", lambda n: simulator()(block()[1], duration=n)),
        ("sample_every", lambda n: simulator()(block()[1], duration=0.01, sample_every=n)),
        ("end", lambda n: travel(torch.zeros(2, 3), torch.tensor([0.0, 0.01]), start=0.0, end=n, direction=(1, 0, 0))),
        ("period", lambda n: stride(torch.zeros(2, 3), torch.arange(2.0), start=0.0, period=n, direction=(1, 0, 0))),
        ("beta", lambda n: DesignField(block()[0], radius=0.01, beta=n)),
    ],
)
def test_tensor_with_gradient_is_refused_where_only_a_number_is_taken(name, call):
    with pytest.raises(ValueError, match=f"{name} = .*wanted a number"):
        call(torch.tensor(0.01, dtype=torch.float64, requires_grad=True))
