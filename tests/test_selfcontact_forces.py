"""Contact of a body with itself: physics, the gradient, the list of pairs, and what is refused; both engines."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from problems import H, block, momenta, simulator, vector
from tiny import TINY
from torch import Tensor

from torchsoro import Body, Simulator, Solid, Trajectory, fill, ground
from torchsoro.design.robot import build
from torchsoro.design.settings import Settings
from torchsoro.output.folding import folded, folding_line
from torchsoro.simulation.formulation import Total
from torchsoro.simulation.laws import repulsion
from torchsoro.simulation.ops import selfcontact
from torchsoro.simulation.ops.lattice import Lattice
from torchsoro.simulation.ops.selfcontact import Surface
from torchsoro.simulation.selfcontact import overlapping
from torchsoro.simulation.stability import stable_step
from torchsoro.simulation.threads import threads_here

# On a GPU this contact is refused, so that its kernels are for comparison only.
one_at_once = pytest.mark.parametrize(
    "lanes", [pytest.param(True, id="lanes"), pytest.param(False, id="taichi", marks=pytest.mark.slow)]
)
DT = 8e-5  # s
WEIGHTLESS = (0.0, 0.0, 0.0)


def touching(*, on: bool = True, lanes: bool = True, **more) -> Simulator:
    """A simulator of bodies that feel themselves."""
    return simulator(**{"dt": DT, "formulation": Total(lanes=lanes), "self_contact": on, **more})


def cut(body: Body, keep: Tensor, velocity: Tensor | None = None) -> Body:
    """Some of the particles of a body."""
    count = len(keep)
    fields = {f.name: getattr(body, f.name) for f in dataclasses.fields(body)}
    found = Body(**{n: v[keep] if v is not None and v.shape[:1] == (count,) else v for n, v in fields.items()})
    return found if velocity is None else dataclasses.replace(found, velocity=velocity)


def fork(speed: float = 8.0) -> Body:
    """Two limbs, two particles thick and four apart, on a common foot; their tips close at a speed [m/s]."""
    _, body = block((4, 8, 8))
    y, z = body.position[:, 1] / H, body.position[:, 2] / H
    keep = (y < 2) | (y > 6) | (z < 2)
    v = torch.zeros_like(body.position)
    v[:, 1] = torch.where(y < 4, 1.0, -1.0) * (z - 2).clamp(min=0) / 8 * speed
    return cut(body, keep, v[keep])


def blocks(speed: float) -> Body:
    """Two free blocks, six spacings apart, that approach each other at a speed [m/s] along x."""
    _, body = block((14, 4, 4))
    x = body.position[:, 0] / H
    keep = (x < 4) | (x > 10)
    v = torch.zeros_like(body.position)
    v[:, 0] = torch.where(x < 7, 0.5, -0.5) * speed
    return cut(body, keep, v[keep])


def inside(body: Body, run: Trajectory) -> int:
    """Particles that lie in another part of the body at the worst."""
    solid = torch.ones(len(body.position), dtype=torch.bool)
    return int(overlapping(run.position, body.position, solid, spacing=H).sum(-1).max())


def watched(sim: Simulator, body: Body, steps: int, **more) -> Trajectory:
    """A run with all particles recorded at twenty samples."""
    every = torch.arange(len(body.position))
    settings = {"gravity": WEIGHTLESS, "probes": every, "sample_every": steps / 20 * DT, **more}
    return sim(body, duration=steps * DT, **settings)


# ------------------------------------------------------------------------------------------------------------- physics


@one_at_once
def test_limbs_that_close_do_not_pass_through_each_other(lanes):
    body = fork()
    apart, through = (watched(touching(on=on, lanes=lanes), body, 200) for on in (True, False))
    assert inside(body, through) > 20
    assert inside(body, apart) == 0


def test_a_roof_that_falls_on_its_floor_comes_to_lie_on_it():
    # A C that lies on the ground, a twentieth as stiff, whose roof sags by ten times gravity against drag.
    _, body = block((10, 4, 8))
    x, z = body.position[:, 0] / H, body.position[:, 2] / H
    keep = (z < 2) | (z > 6) | (x < 2)
    body = cut(body, keep)
    soft = dataclasses.replace(body, bulk=body.bulk / 20, shear=body.shear / 20, drag=200 * body.mass)
    load = {"gravity": (0.0, 0.0, -100.0), "planes": [ground(friction=0.5)]}
    runs = [watched(touching(on=on), soft, 2000, **load) for on in (True, False)]
    assert inside(soft, runs[1]) > 4
    assert inside(soft, runs[0]) == 0
    # They rest on each other, with their outermost particles one to one and a half spacings apart.
    assert float(runs[0].velocity[-1].norm(dim=-1).max()) < 0.02
    end = runs[0].position[-1]
    roof, floor = end[(z[keep] > 6) & (x[keep] > 8)], end[z[keep] < 2]
    nearest = torch.cdist(roof, floor).amin() / H
    assert 0.9 < float(nearest) < 1.5


@one_at_once
def test_pair_forces_keep_momentum_and_angular_momentum(lanes):
    body = dataclasses.replace(fork(), velocity=fork().velocity + vector(0.3, -0.2, 0.1))
    sims = [touching(on=on, lanes=lanes) for on in (True, False)]
    met, free = (watched(sim, body, 60) for sim in sims)
    assert float((met.position[-1] - free.position[-1]).norm(dim=-1).max()) > 0.5 * H
    start = watched(sims[0], body, 20, sample_every=DT)
    momentum = [momenta(body, run.final, 2 * H) for run in (start, met)]
    scale = float((body.mass.unsqueeze(-1) * body.velocity).abs().sum())
    for (before, after), size in zip(zip(*momentum, strict=True), (scale, scale * 8 * H), strict=True):
        assert float((after - before).abs().max()) < 1e-12 * size


@pytest.mark.parametrize("speed", [pytest.param(1.0, marks=pytest.mark.slow), 6.0])
def test_elastic_blocks_bounce_and_keep_their_energy_at_the_largest_step(speed):
    body = blocks(speed)
    lattice = Lattice.around(body.position, 2 * H)
    assert lattice.index is not None
    dt = 0.999 * stable_step(body, None, cell=2 * H, formulation=Total())
    sim, final, found = touching(dt=dt), None, []
    mass = lattice.nodal_mass(lattice.spread(body.mass).unsqueeze(0))[0]
    left = lattice.node_places[:, 0] < 7 * H
    each = max(2, round(12 * H / speed / dt / 60))
    for _ in range(60):
        before = sim(body, duration=(each - 1) * dt, gravity=WEIGHTLESS, start=final).final
        final = sim(body, duration=dt, gravity=WEIGHTLESS, start=before).final
        # Of symplectic Euler, velocities are those of half a step before; so is the place in the middle.
        d = (before + final)[0, : 3 * lattice.nodes].view(3, -1) / 2
        v = final[0, 3 * lattice.nodes : 6 * lattice.nodes].view(3, -1)
        F = (lattice.gradient(d.unsqueeze(0))[0].permute(2, 0, 1) + torch.eye(3).double())[lattice.index]
        J = torch.linalg.det(F)
        trace = J ** (-2 / 3) * (F * F).sum((1, 2))
        strain = body.volume * (body.shear / 2 * (trace - 3) + body.bulk / 4 * ((J - 1) ** 2 + torch.log(J) ** 2))
        found.append(float(strain.sum() + (mass * v * v).sum() / 2))
    means = [float((mass * v[0])[side].sum() / mass[side].sum()) for side in (left, ~left)]
    assert means[0] < -0.15 * speed and means[1] > 0.15 * speed  # they have parted again
    energy = torch.tensor(found) / found[0]
    assert float(energy.min()) < 0.95  # some was in the repulsion
    assert float(energy.max()) < 1.03  # it sways by a hundredth before they meet, too
    assert float(energy[-15:].mean() / energy[:5].mean()) == pytest.approx(1, abs=5e-3)


def test_the_energy_of_the_repulsion_is_that_of_its_force():
    reach, a, b = 2.0, 3.0, 5.0
    stiffness = 2 * a * b / (a + b)

    def energy(r: float) -> float:
        return stiffness * reach * max(0.0, 1 - r * r / reach) ** 3 / 6

    for r in np.linspace(0.05, 1.6, 40):
        force = repulsion(r * r, reach, a, b) * r
        slope = (energy(r + 1e-5) - energy(r - 1e-5)) / 2e-5
        assert force == pytest.approx(-slope, rel=1e-6, abs=1e-8)


def test_void_repels_nothing_and_the_weaker_part_sets_the_force():
    body = blocks(1.0)
    right = body.position[:, 0] > 7 * H
    none = dataclasses.replace(body, void_fraction=torch.where(right, 1.0, 0.0).double())
    softer = torch.where(right, 1e-4, 1.0).double()
    soft = dataclasses.replace(body, bulk=softer * body.bulk, shear=softer * body.shear, mass=softer * body.mass)
    lost = {}
    for name, one in (("solid", body), ("void", none), ("soft", soft)):
        met, free = (watched(touching(on=on), one, 340) for on in (True, False))
        lost[name] = float((free.velocity - met.velocity)[-1, ~right, 0].mean())
    assert lost["solid"] > 0.3
    assert lost["void"] == 0
    assert 0 < lost["soft"] < 1e-3


# ------------------------------------------------------------------------------------------------------- the gradient


@pytest.mark.parametrize(
    ("lanes", "batch"),
    [
        *((True, n) for n in (1, 16)),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in ((True, 3), (True, 18), (False, 2))),
    ],
)
def test_gradients_are_those_of_central_differences(lanes, batch):
    g = torch.Generator().manual_seed(batch)
    body, sim = fork(), touching(lanes=lanes)
    count = len(body.position)

    def some(*shape: int) -> Tensor:
        return torch.rand(batch, *shape, generator=g, dtype=torch.float64)

    given = {
        "velocity": body.velocity * (1 + 0.1 * some(1, 1)),
        "mass": body.mass * (1 + 0.1 * some(count)),
        "bulk": body.bulk * (1 + 0.1 * some(count)),
        "shear": body.shear * (1 + 0.1 * some(count)),
        "void_fraction": 0.3 * some(count),
    }
    weights = some(count, 3) - 0.5

    def value(sim: Simulator, **tensors: Tensor) -> Tensor:
        run = watched(sim, dataclasses.replace(body, **tensors), 60)
        return ((run.position[:, -1] + 1e-3 * run.velocity[:, 10]) * weights).sum((1, 2))

    assert float((value(sim, **given) - value(touching(on=False, lanes=lanes), **given)).abs().min()) > 1e-4
    leaves = {name: t.clone().requires_grad_() for name, t in given.items()}
    found = torch.autograd.grad(value(sim, **leaves).sum(), list(leaves.values()))
    for (name, t), bar in zip(given.items(), found, strict=True):
        way = (torch.rand(t.shape, generator=g, dtype=torch.float64) - 0.5) * t.abs().mean()
        step = 1e-5 if name == "velocity" else 1e-4
        plus, minus = (value(sim, **{**given, name: t + sign * step * way}) for sign in (1, -1))
        slopes, exact = (plus - minus) / (2 * step), (bar * way).flatten(1).sum(1)
        assert float((exact - slopes).abs().max() / slopes.abs().max()) < 1e-6, name


def test_the_gradient_of_a_design_holds_through_a_gait_in_which_limbs_meet():
    domain, _ = block((4, 8, 8))
    x = domain.positions.double() / H
    g = torch.Generator().manual_seed(0)
    # A block whose middle is nearly void: matter that is crushed between the limbs, and grey at their faces.
    slot = (x[:, 1] > 2) & (x[:, 1] < 6) & (x[:, 2] > 2)
    gamma = torch.where(slot, 0.02, 0.95).double() + 0.04 * torch.rand(domain.count, generator=g, dtype=torch.float64)
    gamma[(x[:, 1] > 5) & slot] += 0.3
    v = torch.zeros(domain.count, 3, dtype=torch.float64)
    v[:, 1] = torch.where(x[:, 1] < 4, 8.0, -8.0) * (x[:, 2] - 2).clamp(min=0) / 8
    weights = torch.rand(domain.count, 3, generator=g, dtype=torch.float64) - 0.5

    def value(gamma: Tensor, on: bool = True) -> Tensor:
        body = fill(domain, gamma, solid=Solid(), epsilon=1e-2, void_range=(0.1, 0.6))
        run = watched(touching(on=on), dataclasses.replace(body, velocity=v), 60)
        return (run.position[-1] * weights * (gamma.detach() > 0.9).unsqueeze(-1)).sum()

    design = gamma.clone().requires_grad_()
    met = value(design)
    assert abs(float(met.detach() - value(gamma, on=False))) > 1e-5
    (bar,) = torch.autograd.grad(met, design)
    way = torch.rand(domain.count, generator=g, dtype=torch.float64) - 0.5
    slope = float(value(gamma + 1e-5 * way) - value(gamma - 1e-5 * way)) / 2e-5
    assert float(bar @ way) == pytest.approx(slope, rel=1e-6)


# ------------------------------------------------------------------------------------------------- the list of pairs


@one_at_once
def test_results_do_not_depend_on_when_pairs_are_listed(lanes, monkeypatch):
    body = fork()
    whole = watched(touching(lanes=lanes), body, 60)
    monkeypatch.setattr(selfcontact, "SKIN", 0.11)
    often = watched(touching(lanes=lanes), body, 60)
    assert torch.equal(whole.position, often.position) and torch.equal(whole.final, often.final)


def test_bits_do_not_depend_on_threads_nor_those_of_the_motion_on_segments():
    found = []
    for threads, segment in ((1, None), (2, None), (1, 7)):
        body = fork()
        shear = body.shear.clone().requires_grad_()
        with threads_here(threads):
            run = watched(touching(segment=segment), dataclasses.replace(body, shear=shear), 60)
            (bar,) = torch.autograd.grad(run.position[-1].square().sum(), shear)
        found.append((run.position.detach(), bar))
    for position, bar in found[1:]:
        assert torch.equal(position, found[0][0])
        torch.testing.assert_close(bar, found[0][1], rtol=1e-10, atol=0)
    assert torch.equal(found[0][1], found[1][1])


def test_a_run_that_goes_on_is_that_in_one():
    body = fork()
    whole = touching()(body, duration=60 * DT, gravity=WEIGHTLESS, sample_every=10 * DT)
    half = touching()(body, duration=30 * DT, gravity=WEIGHTLESS, sample_every=10 * DT)
    rest = touching()(body, duration=30 * DT, gravity=WEIGHTLESS, sample_every=10 * DT, start=half)
    assert torch.equal(rest.final, whole.final)


@pytest.mark.slow
def test_both_engines_agree():
    runs = [watched(touching(lanes=lanes), fork(), 100) for lanes in (True, False)]
    assert float((runs[0].position - runs[1].position).abs().max()) < 1e-8 * H


def test_simulations_side_by_side_are_those_alone_and_one_that_breaks_down_disturbs_none():
    body = fork()
    speeds = torch.linspace(0.2, 1.1, 17, dtype=torch.float64).view(-1, 1, 1)
    speeds[3] = 1e6
    many = watched(touching(), dataclasses.replace(body, velocity=speeds * body.velocity), 60, divergence="mark")
    assert not bool(many.sound[3]) and int(many.sound.sum()) == 16
    for n in (0, 9, 16):
        one = watched(touching(), dataclasses.replace(body, velocity=speeds[n] * body.velocity), 60)
        assert float((many.position[n] - one.position).abs().max()) < 1e-12


def test_a_body_that_does_not_meet_itself_is_that_without_contact_to_the_bit():
    body = fork(speed=0.5)
    runs = [watched(touching(on=on), body, 60) for on in (True, False)]
    assert torch.equal(runs[0].position, runs[1].position)


@given(seed=st.integers(0, 10**6), width=st.floats(0.5, 8.0), shift=st.sampled_from([0.0, -20.0]))
def test_the_cell_list_finds_what_a_search_over_all_pairs_finds(seed, width, shift):
    g = torch.Generator().manual_seed(seed)
    count = 80
    x = width * torch.rand(count, 3, generator=g, dtype=torch.float64) + shift
    reference = 6 * torch.rand(count, 3, generator=g, dtype=torch.float64)
    solid = torch.rand(count, generator=g) < 0.9
    x[5], x[6, 1] = torch.nan, torch.inf
    none = torch.zeros(count, 27)
    surface = Surface(points=torch.arange(count), nodes=none.long(), weights=none.double(), places=reference)
    keys = surface.pairs(x.numpy(), solid.numpy(), 1.0)
    there = solid & torch.isfinite(x).all(1)
    near = torch.cdist(x.nan_to_num(), x.nan_to_num()) < selfcontact.REACH + selfcontact.SKIN
    met = near & (torch.cdist(reference, reference) > selfcontact.APART) & there & there[:, None]
    wanted = met.triu(1).nonzero() @ torch.tensor([count, 1])
    assert np.array_equal(np.unique(keys), wanted.numpy())


def test_the_surface_is_all_matter_but_what_is_buried_in_solid():
    domain, _ = block((8, 8, 8))
    gamma = torch.ones(domain.count, dtype=torch.float64)
    x = domain.positions / H
    gamma[(x[:, 0] > 3) & (x[:, 0] < 5) & (x[:, 2] > 4)] = 0  # a slot two particles wide
    body = fill(domain, gamma, solid=Solid(), void_range=(0.1, 0.3))
    found = []

    def note(scene, coefficients):
        found.append(kept(scene, coefficients))
        return found[-1]

    kept = Surface.of
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Surface, "of", staticmethod(note))
        touching()(body, duration=DT)
    points = set(found[0].points.tolist())
    cells = domain.positions.div(H).floor().long()
    void = {tuple(c) for c in cells[gamma == 0].tolist()}

    def buried(c: list[int]) -> bool:
        around = [(c[0] + a, c[1] + b, c[2] + d) for a in (-1, 0, 1) for b in (-1, 0, 1) for d in (-1, 0, 1)]
        return all(0 <= min(n) and max(n) < 8 and n not in void for n in around)

    wanted = {i for i, c in enumerate(cells.tolist()) if tuple(c) not in void and not buried(c)}
    assert points == wanted
    assert 0 < len(wanted) < domain.count - len(void)


# -------------------------------------------------------------------------------------------------- design and checks


def test_a_robot_is_designed_with_contact_alone_and_in_scenarios():
    robot = build(dataclasses.replace(TINY, self_contact=True))
    assert robot.simulator().self_contact
    g = torch.Generator().manual_seed(0)
    gamma = torch.rand(robot.domain.count, generator=g).requires_grad_()
    outcome = robot(gamma)
    outcome.travel.backward()
    assert gamma.grad is not None and bool(torch.isfinite(gamma.grad).all()) and bool(gamma.grad.any())
    placed = build(dataclasses.replace(TINY, self_contact=True, chamber_design=("place",)))
    travel = placed(gamma.detach()).travel
    assert bool(torch.isfinite(travel))
    several = build(dataclasses.replace(TINY, self_contact=True, scenarios=3))
    batch = several.settings.distribution.sample(3, 0)
    together = several(gamma.detach(), scenarios=batch)
    assert together.travel.shape == (3,) and bool(torch.isfinite(together.travel).all())


@pytest.mark.parametrize(
    ("more", "match"),
    [
        ({"formulation": "updated"}, r"self_contact = True: beside formulation = 'updated', wanted \"total\""),
        ({"formulation": Total(device="cuda")}, r"self_contact = True: beside Total\(device='cuda'\), wanted"),
        ({"formulation": Total(lattice=Lattice.uniform((4, 4, 4), (0, 0, 0), 2 * H))}, r"beside Total\(lattice=...\)"),
        ({"self_contact": "yes", "formulation": "total"}, r"self_contact = 'yes': wanted True or False"),
    ],
)
def test_contact_is_refused_where_there_is_none(more, match):
    with pytest.raises(ValueError, match=match):
        simulator(**{"self_contact": True, **more})


def test_settings_refuse_contact_in_the_updated_formulation():
    with pytest.raises(ValueError, match="self_contact = True: beside formulation = 'updated', wanted 'total'"):
        Settings(self_contact=True, formulation="updated")


def test_a_run_says_that_its_body_folds_into_itself():
    robot = build(TINY)
    density = np.ones(robot.domain.count, np.float32)
    rest = robot.domain.positions.float()
    flat = rest.clone()
    upper = rest[:, 2] > 0.6 * rest[:, 2].max()
    flat[upper, 2] -= 0.5 * float(rest[:, 2].max())  # the upper part lies in the lower one
    run = Trajectory(
        time=torch.arange(3.0), position=torch.stack([rest, flat, rest]), velocity=torch.zeros(3, len(rest), 3),
        deformation=torch.zeros(3, 0, 3, 3), center_of_gravity=rest.mean(0).expand(3, 3),
        center_velocity=torch.zeros(3, 3), chamber_volume=torch.zeros(3, 1), chamber_pressure=torch.zeros(3, 1),
        probes=torch.arange(len(rest)), sound=torch.tensor(True), final=torch.zeros(1, 1), dt=1e-4,
    )  # fmt: skip
    count = folded(robot, density, run)
    assert count > 10
    line = folding_line({"folded": count}, TINY)
    assert f"{count} particles lie in another part" in line and "--self-contact" in line
    assert "--self-contact" not in folding_line({"folded": count}, dataclasses.replace(TINY, self_contact=True))
    still = dataclasses.replace(run, position=rest.expand(3, -1, -1))
    assert folded(robot, density, still) == 0 and folding_line({"folded": 0}, TINY) == ""
