"""Gradients by every number of materials, loads and planes: the central difference in float64, or a refusal."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import fields, replace

import pytest
import torch
from problems import DT, WAYS, H, simulator, vector, ways
from torch import Tensor

from torchsoro import (
    Body,
    Chamber,
    Domain,
    Drag,
    Force,
    Gas,
    Plane,
    PointMass,
    Prony,
    Solid,
    Spring,
    Waveform,
    fill,
    simp,
)
from torchsoro.rheology.pointwise import Law

PARTICLES = (4, 4, 6)
STEPS = 24
SIZE = tuple(n * H for n in PARTICLES)
DOMAIN = Domain(
    size=SIZE,
    particles=PARTICLES,
    chambers=(Chamber(name="air", center=(2 * H, 2 * H, 3 * H), size=SIZE, wall=H),),
)
HELD = torch.arange(24)  # a side of the block
PULLED = torch.arange(72, 96)  # the other
MARKED = torch.arange(26, 40)


def noise(*shape: int, seed: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def shares(count: int) -> Tensor:
    weight = torch.linspace(1.0, 2.0, count, dtype=torch.float64)
    return weight / weight.sum()


# What is differentiated, by the name of the argument: its value, and what would be refused or is no number.
NUMBERS: dict[str, Tensor] = {
    "Solid.youngs_modulus": vector(0.44e6)[0],
    "Solid.poisson_ratio": vector(0.4)[0],
    "Solid.density": vector(1070.0)[0],
    "Solid.linear_stiffening": vector(300.0)[0],
    "Solid.quadratic_stiffening": vector(1e6)[0],
    "Gas.stiffness": vector(2e4)[0],
    "Gas.viscosity": vector(3.0)[0],
    "Gas.volume_viscosity": vector(2.0)[0],
    "Gas.density": vector(90.0)[0],
    "Gas.shear": vector(3e3)[0],
    "Prony.moduli": vector(0.5, 2.0),
    "Prony.times": vector(1e-3, 2e-4),
    "Force.value": torch.stack([vector(0.3, 0.1, 0.0), vector(1.0, -0.4, 0.5), vector(0.2, 0.3, 0.1)]),
    "Force.time": vector(-1e-4, 5.13e-4, 2e-3),
    "PointMass.mass": vector(2e-4)[0],
    "PointMass.share": shares(len(MARKED)),
    "Spring.stiffness": vector(300.0)[0],
    "Spring.shift": vector(2e-4, -1e-4, 3e-4),
    "Spring.share": shares(len(HELD)),
    "Drag.coefficient": vector(0.3)[0],
    "Drag.share": shares(len(PULLED)),
    "Plane.offset": vector(-2.0e-5)[0],
    "Plane.friction": vector(0.3)[0],
    "Plane.adhesion": vector(400.0)[0],
    "second Plane.offset": vector(6 * H + 1.0e-5)[0],
    "second Plane.friction": vector(0.2)[0],
    "second Plane.adhesion": vector(300.0)[0],
    "Waveform.time": vector(-1e-4, 4.19e-4, 2e-3),
    "Waveform.pressure": vector(100.0, 2e3, 500.0).unsqueeze(0),
    "gravity time": vector(-1e-4, 6.17e-4, 2e-3),
    "gravity values": torch.stack([vector(0.0, 0.0, -9.0), vector(2.0, 1.0, -20.0), vector(1.0, 0.0, 5.0)]),
    "weight": 1 + 0.3 * noise(96, seed=5).sin(),
    "fill.gamma": 0.75 + 0.2 * noise(96, seed=1).sin(),
    "fill.epsilon": vector(1e-2)[0],
    "fill.power": vector(3.0)[0],
    "Body.position": torch.zeros(3).double(),  # a shift of all of it
    "Body.mass": torch.ones(96).double(),  # these as factors of what they are
    "Body.volume": torch.ones(96).double(),
    "Body.bulk": torch.ones(96).double(),
    "Body.shear": torch.ones(96).double(),
    "Body.velocity": vector(0.5, 0.1, -0.06) + 0.02 * noise(96, 3, seed=2),
    "Body.viscosity": 3 + noise(96, seed=3).sin(),
    "Body.volume_viscosity": 2 + noise(96, seed=4).sin(),
    "Body.void_fraction": 0.4 + 0.3 * noise(96, seed=6).sin(),
    "Body.drag": 1e-3 * (2 + noise(96, seed=7).sin()),
    "Body.stiffening": 2 + noise(96, 2, seed=8).sin(),  # of the solid's numbers
}
LENGTHS = dict.fromkeys(("Plane.offset", "second Plane.offset", "Body.position"), 1e-3)  # m, of which to take steps
# Long steps suffer from what is not smooth, as a node that lifts off, short ones from rounding.
STEPS_TRIED = (1e-3, 3e-3, 1e-2, 1e-4, 1e-5, 3e-2)
# Differences by the number of steps from the place: of fourth order to one side and to both, and of eighth, which lets
# steps be longer where a derivative is small beside its rounding.
ONE_SIDED = {0: -25 / 12, 1: 4, 2: -3, 3: 4 / 3, 4: -1 / 4}
FOURTH = {-2: 1 / 12, -1: -2 / 3, 1: 2 / 3, 2: -1 / 12}
EIGHTH = {-4: 1 / 280, -3: -4 / 105, -2: 1 / 5, -1: -4 / 5, 1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}
# Fields that are no numbers: indices, and names of kinds.
NO_NUMBERS = {
    *(f"{load}.particles" for load in ("Force", "PointMass", "Spring", "Drag")),
    *("Plane.axis", "Plane.side", "Plane.landing", "Body.chamber", "Force.start", "Spring.mean"),
}
# A plane has an axis or a normal: test_ops compares gradients of planes with normals.
OBLIQUE = {"Plane.normal"}
# Of the total-Lagrangian form: test_nodes compares their gradients.
OF_NODES = {"Body.softening", "Body.air_stiffness"}
# Likewise: test_contact compares their gradients.
OF_SLIDING = {"Plane.static_friction", "Plane.stribeck_speed"}
# Of solids that are air in part: test_shared_air compares their gradients.
OF_SHARES = {"Body.air_share", "Body.share_stiffness"}
REFUSED = {"Force.share", "Plane.reach"}
# Without effect: the pressure of a chamber is uniform in the total form, air resists no distortion in the updated one.
WITHOUT_EFFECT = {"total": {"Gas.viscosity", "Gas.volume_viscosity"}, "updated": {"Gas.shear"}}
# Those that may be zero, at which a term of the laws might be left out.
ZERO = (
    *("Solid.linear_stiffening", "Solid.quadratic_stiffening", "Gas.stiffness", "Gas.viscosity"),
    *("Gas.volume_viscosity", "Gas.shear", "Prony.moduli", "PointMass.mass", "Spring.stiffness"),
    *("Drag.coefficient", "Plane.friction", "Plane.adhesion", "Body.viscosity", "Body.volume_viscosity"),
    *("Body.void_fraction", "Body.drag", "Body.stiffening"),
)


def motion(numbers: dict[str, Tensor], way: dict[str, str], *, planes: bool) -> list[Tensor]:
    """What is recorded of a hollow block that is blown up, pulled, and may slide in a gap, in units of order one."""

    def of(owner: str) -> dict[str, Tensor]:
        return {
            name.removeprefix(f"{owner}."): value for name, value in numbers.items() if name.startswith(f"{owner}.")
        }

    solid, gas = Solid(**of("Solid")), Gas(**of("Gas"))
    body = fill(
        DOMAIN,
        numbers["fill.gamma"],
        solid=solid,
        gas=gas,
        epsilon=numbers["fill.epsilon"],
        power=numbers["fill.power"],
    )
    own = {
        name: value for name, value in of("Body").items() if name not in ("position", "mass", "volume", "bulk", "shear")
    }
    own["stiffening"] = own["stiffening"] * vector(300.0, 1e6)
    if body.stiffening is not None:
        own["stiffening"] = own["stiffening"] + body.stiffening
    assert body.viscosity is not None and body.volume_viscosity is not None
    own["viscosity"] = own["viscosity"] + body.viscosity
    own["volume_viscosity"] = own["volume_viscosity"] + body.volume_viscosity
    scaled = {name: getattr(body, name) * numbers[f"Body.{name}"] for name in ("mass", "volume", "bulk", "shear")}
    body = replace(body, position=body.position + numbers["Body.position"], **scaled, **own)
    second = of("second Plane")
    if way != WAYS["total"]:
        second["offset"] = numbers["Plane.offset"].detach() + 6 * H  # on the nodes of the grid
    gap = [Plane(axis=2, **of("Plane")), Plane(axis=2, side=-1, **second)]
    run = simulator(**way)(
        body,
        duration=STEPS * DT,
        prony=Prony(**of("Prony")),
        pressure=Waveform(**of("Waveform")),
        gravity=(numbers["gravity time"], numbers["gravity values"]),
        planes=gap if planes else [],
        loads=[
            Force(particles=PULLED, **of("Force")),
            PointMass(particles=MARKED, **of("PointMass")),
            Spring(particles=HELD, **of("Spring")),
            Drag(particles=PULLED, **of("Drag")),
        ],
        sample_every=4 * DT,
        probes=torch.arange(96),
        weight=numbers["weight"],
    )
    return [
        *(run.position / 1e-4, run.velocity / 0.1, run.center_of_gravity / 1e-3, run.center_velocity / 0.1),
        *(run.chamber_volume / 1e-7, run.chamber_pressure / 1e3),
    ]


def changes(numbers: dict[str, Tensor], way: dict[str, str], *, planes: bool) -> Callable[[dict[str, Tensor]], Tensor]:
    """A function of some of the numbers that depends on all of a motion.

    It takes the difference from the motion with the numbers as they are, lest it is lost in rounding.
    """
    with torch.no_grad():
        known = motion(numbers, way, planes=planes)

    def total(changed: dict[str, Tensor]) -> Tensor:
        pairs = zip(motion({**numbers, **changed}, way, planes=planes), known, strict=True)
        parts = [((seen - usual) * noise(*seen.shape, seed=20 + k)).sum() for k, (seen, usual) in enumerate(pairs)]
        return torch.stack(parts).sum()

    return total


def check(
    at: Tensor,
    loss: Callable[[Tensor], Tensor],
    *,
    scale: float | None = None,
    one_sided: bool = False,
    zero: bool = False,
    rtol: float = 1e-6,
) -> None:
    """Compare the adjoint along a random direction with differences, for the best of some steps and orders.

    Args:
        at: Where.
        loss: Of what.
        scale: Size of the direction; that of ``at`` if None.
        one_sided: Whether the differences go forward only.
        zero: Whether the derivative is 0, else it is not.
        rtol: Relative tolerance.
    """
    way = noise(*at.shape, seed=9)
    if one_sided:
        way = way.abs()
    elif float(at.detach().sum()) == pytest.approx(1.0) and at.ndim:
        way = way - way.mean()  # shares stay shares
    way = way * (scale or float(at.abs().mean()))
    value = at.clone().requires_grad_()
    (by,) = torch.autograd.grad(loss(value), value)
    adjoint = float((by * way).sum())
    assert (adjoint == 0) == zero
    seen = []
    for weights, step in itertools.product([ONE_SIDED] if one_sided else [FOURTH, EIGHTH], STEPS_TRIED):
        with torch.no_grad():
            found = sum(w * float(loss(at + k * step * way)) for k, w in weights.items()) / step
        seen.append(found)
        if abs(adjoint - found) <= rtol * abs(found) + 1e-9 * zero:
            return
    raise AssertionError(f"{adjoint} by the adjoint, {seen} by differences")


def test_every_field_is_differentiated_or_refused_or_no_number():
    names = {
        f"{kind.__name__}.{f.name}"
        for kind in (Solid, Gas, Prony, Force, PointMass, Spring, Drag, Plane, Waveform, Body)
        for f in fields(kind)
    }
    compared = {name for name in NUMBERS if name[0].isupper()} | OBLIQUE | OF_NODES | OF_SLIDING | OF_SHARES
    assert names == compared | NO_NUMBERS | REFUSED


def formulation(way: dict[str, str]) -> str:
    return way.get("formulation", "updated")


@pytest.mark.parametrize("name", NUMBERS)
@ways("apic", "total", slow=["apic"])  # the updated form by all numbers at once below
def test_gradient_equals_the_central_difference(name, way):
    if name == "second Plane.offset" and way != WAYS["total"]:
        return  # refused, see below
    total = changes(NUMBERS, way, planes="Plane" in name)
    zero = name in WITHOUT_EFFECT[formulation(way)]
    check(NUMBERS[name], lambda t: total({name: t}), scale=LENGTHS.get(name), zero=zero)


@pytest.mark.parametrize("name", ZERO)
@ways("apic", "total", slow=["apic"])
def test_gradient_at_exactly_zero_equals_the_one_sided_difference(name, way):
    numbers = {**NUMBERS, name: torch.zeros_like(NUMBERS[name])}
    if name.endswith("stiffening"):
        numbers |= {other: torch.zeros_like(NUMBERS[other]) for other in NUMBERS if other.endswith("stiffening")}
    total, zero = changes(numbers, way, planes="Plane" in name), name in WITHOUT_EFFECT[formulation(way)]
    scale = float(NUMBERS[name].abs().mean())
    rtol = 1e-5 if name == "Plane.adhesion" else 1e-6  # nodes lift off within the shortest step that rounding leaves
    check(numbers[name], lambda t: total({name: t}), scale=scale, one_sided=True, zero=zero, rtol=rtol)


@pytest.mark.slow
def test_flip_gradient_along_all_numbers_at_once_equals_the_central_difference():
    along = {
        name: noise(*value.shape, seed=k) * (LENGTHS.get(name) or float(value.abs().mean()))
        for k, (name, value) in enumerate(NUMBERS.items())
        if not name.endswith((".share", ".offset"))
    }

    total = changes(NUMBERS, WAYS["flip"], planes=True)

    def loss(t: Tensor) -> Tensor:
        return total({name: NUMBERS[name] + t * direction for name, direction in along.items()})

    check(torch.zeros(()).double(), loss, scale=1.0)


def test_a_force_share_that_requires_a_gradient_is_refused():
    share = shares(len(PULLED)).requires_grad_()
    with pytest.raises(ValueError, match=r"^share of a force: requires a gradient, which is not computed"):
        motion({**NUMBERS, "Force.share": share}, WAYS["total"], planes=False)


@ways("apic", "flip")
def test_the_offset_of_a_second_plane_of_an_axis_is_refused_in_the_updated_form(way):
    body = fill(DOMAIN, NUMBERS["fill.gamma"], solid=Solid())
    planes = [Plane(axis=2), Plane(axis=2, side=-1, offset=vector(6 * H)[0].requires_grad_())]
    with pytest.raises(ValueError, match=r"^planes: the offset of plane 1 requires a gradient, but in the updated"):
        simulator(**way)(body, duration=DT, planes=planes)
    simulator(formulation="total")(body, duration=DT, planes=planes)


@ways("apic", "total")
def test_a_gradient_by_a_void_fraction_of_exactly_one_is_refused(way):
    body = fill(DOMAIN, NUMBERS["fill.gamma"], solid=Solid())
    void = torch.zeros(96, dtype=torch.float64)
    void[3] = 1
    simulator(**way)(replace(body, void_fraction=void), duration=DT)
    with pytest.raises(ValueError, match=r"^body\.void_fraction: exactly 1 with a gradient"):
        simulator(**way)(replace(body, void_fraction=void.requires_grad_()), duration=DT)


def test_numbers_of_materials_with_axes_or_of_integers_are_refused():
    for kind, name in ((Solid, "youngs_modulus"), (Solid, "quadratic_stiffening"), (Gas, "density"), (Gas, "shear")):
        for value in (vector(1.0), torch.tensor(1), "1", True):
            with pytest.raises(ValueError, match=rf"^{name}\b.*wanted a number"):
                kind(**{name: value})


def test_numbers_of_a_solid_keep_their_gradient_in_the_pointwise_law():
    numbers = {f.name: NUMBERS[f"Solid.{f.name}"].clone().requires_grad_() for f in fields(Solid)}
    law = Law.of(Solid(**numbers))
    (law.shear + law.bulk + law.stiffening.sum()).backward()
    assert {name for name, value in numbers.items() if value.grad is None} == {"density"}


def test_densities_between_which_void_begins_have_gradients():
    gamma = torch.linspace(0, 0.5, 96, dtype=torch.float64)

    def loss(between: Tensor) -> Tensor:
        body = fill(DOMAIN, gamma, solid=Solid(), void_range=(between[0], between[1]))
        assert body.void_fraction is not None
        return (body.void_fraction * noise(96, seed=0)).sum()

    assert torch.autograd.gradcheck(loss, vector(0.104, 0.303).requires_grad_())


def test_exponent_and_floor_of_the_interpolation_have_gradients_also_at_density_zero():
    gamma = torch.linspace(0, 1, 5, dtype=torch.float64)
    given = [vector(1e-2)[0].requires_grad_(), vector(3.0)[0].requires_grad_()]
    assert torch.autograd.gradcheck(lambda epsilon, power: simp(gamma, epsilon=epsilon, power=power), given)
