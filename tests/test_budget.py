"""Stability of Maxwell elements at a time step, and reduced Prony series."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchsoro.rheology.budget import budget, choose, substitutes
from torchsoro.rheology.plot import draw_budget
from torchsoro.rheology.spectrum import Spectrum
from torchsoro.simulation.material import Body, Prony, Solid
from torchsoro.simulation.stability import STABLE_COURANT, courant, stable_step

CELL, STEP = 1.75e-3, 1e-5  # of the paper
BAND = (2 * math.pi * 5, 2 * math.pi * 100)  # locomotion to impacts
WIDE = np.geomspace(1e-6, 1e2, 25)
LONG = Spectrum(equilibrium=1e5, moduli=2e4 * WIDE**-0.4, times=WIDE, deformation="shear")  # a power law


def paper(dt=STEP, elements=5, **change):
    return budget(Prony.paper(elements), Solid(), **{"cell": CELL, "band": BAND, "dt": dt} | change)


def particle(viscosity=0.0):
    one = torch.ones(1, dtype=torch.float64)
    solid = Solid()
    return Body(
        position=torch.zeros(1, 3),
        mass=one * solid.density,
        volume=one,
        bulk=one * solid.bulk,
        shear=one * solid.shear,
        chamber=torch.full((1,), -1, dtype=torch.int32),
        viscosity=one * viscosity,
    )


def errors(material, full, omega):
    """Largest relative differences, from Eq. 17 of the simulator's own Prony."""
    there = [torch.stack(p.storage_loss(omega)) for p in (material.prony(), full)]
    there[0][1] += material.viscosity / Solid().shear * omega
    return (there[0] / there[1] - 1).abs().amax(1).tolist()


# ---------------------------------------------------------------------------------------------------------- the table
@pytest.mark.parametrize(
    ("elements", "stiffening", "instantaneous", "algorithmic"),
    [(0, 1.00, 0.170, 0.170), (3, 18.0, 0.371, 0.368), (4, 156, 1.01, 0.745), (5, 1104, 2.66, 0.807)],
)
def test_algorithmic_stiffness_of_table_s1_matches_design_values(elements, stiffening, instantaneous, algorithmic):
    """The Courant numbers of pressure waves, with g and with g b, of the design notes."""
    rows = paper().elements[: elements + 1]
    total = sum(e.modulus for e in rows)
    assert total == pytest.approx(stiffening, rel=4e-3)
    # "felt" is g b 2 / (1 + a), the highest frequency; the notes have g b.
    gb = 1 + sum(e.felt * (1 + math.exp(-STEP / e.time)) / 2 for e in rows[1:])
    for factor, expected in ((total, instantaneous), (gb, algorithmic)):
        wave = math.sqrt((Solid().bulk + 4 / 3 * factor * Solid().shear) / Solid().density)
        assert wave * STEP / CELL == pytest.approx(expected, rel=5e-3)
    assert rows[-1].stable  # with the exact-exponential update, at 10 us


@pytest.mark.parametrize("formulation", ["updated", "total"])
@pytest.mark.parametrize("dt", [1e-5, 2.5e-5])
def test_courant_numbers_and_largest_steps_equal_those_of_simulator(formulation, dt):
    for row in paper(dt, formulation=formulation).elements:
        series = Prony.paper(row.number)
        number = courant(particle(), series, dt=dt, cell=CELL, formulation=formulation).number
        assert row.courant == pytest.approx(number, rel=1e-12)
        assert row.stable == (number <= STABLE_COURANT)
        step = stable_step(particle(), series, cell=CELL, formulation=formulation)
        assert row.step == pytest.approx(step, rel=3e-4)
        assert row.cost == pytest.approx(dt / step, rel=3e-4)


def test_loss_modulus_lost_without_elements_4_and_5_matches_design_values():
    """4, 17 and 26 % of the loss modulus that is kept, at 5, 50 and 100 Hz: the design notes."""
    for hertz, share in ((5, 0.04), (50, 0.17), (100, 0.26)):
        omega = 2 * math.pi * hertz
        lost = paper(band=(omega, omega * 1.0001)).elements[4].loss_lost
        assert lost / (1 - lost) == pytest.approx(share, abs=0.006)


def test_automatic_step_is_stable_with_all_elements_and_grows_with_cell():
    fine, coarse = paper("auto"), paper("auto", cell=2 * CELL)
    assert fine.stable == coarse.stable == 5 and fine.dt == fine.elements[5].step
    assert 1e-5 < fine.dt < 1.2e-5 < coarse.dt  # the notes: stable at 10 us, not at 12 us


@given(
    gaps=st.lists(st.floats(0.3, 2.0), min_size=1, max_size=7),
    moduli=st.lists(st.floats(0.01, 300.0), min_size=7, max_size=7),
    dt=st.floats(1e-6, 5e-5),
)
def test_courant_number_grows_and_lost_loss_modulus_falls_with_each_faster_element(gaps, moduli, dt):
    times = 1e-7 * 10 ** np.cumsum(gaps)
    material = Spectrum(equilibrium=1.0, moduli=np.array(moduli[: len(gaps)]), times=times, deformation="shear")
    rows = budget(material, Solid(), cell=CELL, band=BAND, dt=dt).elements
    assert [r.time for r in rows[1:]] == sorted(times, reverse=True)
    for slower, faster in itertools.pairwise(rows):
        assert faster.step <= slower.step * 1.0001 and faster.courant >= slower.courant
        assert slower.stable or not faster.stable
        assert 0 <= faster.felt <= faster.modulus
    for slower, faster in itertools.pairwise(rows[1:]):
        assert 0 <= faster.loss_lost <= slower.loss_lost <= 1


# --------------------------------------------------------------------------------------------------------- substitutes
def test_substitute_errors_and_stable_steps_match_direct_evaluation():
    found = {m.name: m for m in substitutes(paper(2e-5), match=BAND[1])}
    assert list(found) == ["all elements", "left out", "lumped into element 3", "viscosity", "refitted"]
    omega = torch.logspace(math.log10(BAND[0]), math.log10(BAND[1]), 500, dtype=torch.float64)
    for name, material in found.items():
        storage, loss = errors(material, Prony.paper(5), omega)
        assert material.storage_error == pytest.approx(storage, rel=0.02, abs=1e-9), name
        assert material.loss_error == pytest.approx(loss, rel=0.02, abs=1e-9), name
        step = stable_step(particle(material.viscosity), material.prony(), cell=CELL)
        assert material.step == pytest.approx(step, rel=3e-4)

    assert found["all elements"].loss_error == 0
    assert len(found["refitted"].moduli) == 4
    assert len(found["viscosity"].moduli) == 3
    assert found["viscosity"].viscosity == pytest.approx(149, abs=0.5)
    assert found["left out"].loss_error == pytest.approx(0.207, abs=0.002)


def test_lumped_element_and_viscosity_match_loss_modulus_at_given_frequency():
    slow = {m.name: m for m in substitutes(paper(2e-5), match=1.0)}
    lumped, viscous = slow["lumped into element 3"], slow["viscosity"]
    assert lumped.moduli[2] * 9.06e-4 == pytest.approx(1.680e-2, rel=1e-3)  # g_3, from 1.27e-2
    assert lumped.loss_error < 0.02  # at 100 Hz
    assert viscous.viscosity == pytest.approx(149, abs=0.5)
    at = torch.tensor([BAND[1]], dtype=torch.float64)
    matched = {m.name: m for m in substitutes(paper(2e-5), match=BAND[1])}
    for name in ("lumped into element 3", "viscosity"):
        assert errors(matched[name], Prony.paper(5), at)[1] < 1e-12


def test_stable_series_has_no_substitute():
    assert [m.name for m in substitutes(paper(1e-5), match=100.0)] == ["all elements"]


@pytest.mark.parametrize(("dt", "formulation"), [(1e-5, "total"), (2e-5, "updated"), (2e-5, "total")])
def test_refitted_elements_are_stable_and_more_accurate_than_lumped(dt, formulation):
    found = {m.name: m for m in substitutes(paper(dt, formulation=formulation), match=BAND[1])}
    best, lumped, left = found["refitted"], found["lumped into element 3"], found["left out"]
    number = courant(particle(), best.prony(), dt=dt, cell=CELL, formulation=formulation).number
    assert number <= STABLE_COURANT * 1.0001
    assert max(best.storage_error, best.loss_error) < max(lumped.storage_error, lumped.loss_error)
    assert best.good[0] == left.good[0] == 0 and best.good[1] > left.good[1] > BAND[0]


def test_five_elements_match_twenty_five_within_1_percent_over_band():
    spent, easy = (budget(LONG, LONG.solid(0.4, 1070.0), cell=CELL, band=BAND, dt=dt) for dt in (3e-5, 1e-5))
    assert spent.stable < easy.stable == 25
    assert [m.name for m in substitutes(easy, match=100.0)] == ["all elements", "refitted"]
    errors = []
    for count in (1, 2, 3, 5):
        few = choose(spent, elements=count)
        assert few.prony().elements <= count and few.step >= spent.dt
        errors.append(max(few.storage_error, few.loss_error))
    assert errors == sorted(errors, reverse=True)
    assert errors[0] > 0.1 and errors[-1] < 0.01
    assert 0 < few.good[0] < BAND[0] and BAND[1] < few.good[1] < math.inf  # a power law goes on, five elements do not
    with pytest.raises(ValueError, match="M from 0 to 5"):
        substitutes(spent, match=100.0)[0].prony()


def test_stable_series_of_five_elements_is_unchanged_by_choose():
    kept = choose(paper(1e-5))
    assert torch.equal(kept.prony().times, Prony.paper(5).times) and kept.loss_error == 0


# ------------------------------------------------------------------------------------------------- told, and refused
def test_elements_4_and_5_are_unstable_at_20_us_and_spring_at_100_us():
    spent = paper(2e-5)
    assert [row["stable"] for row in spent.rows()] == ["yes"] * 4 + ["no"] * 2
    assert spent.elements[5].cost == pytest.approx(2, abs=0.2)
    assert spent.elements[4].loss_lost == pytest.approx(0.21, abs=0.005)
    assert [e.number for e in paper(1.1e-5).elements if not e.stable] == [5]
    assert not paper(1e-4).elements[0].stable


def test_elastic_solid_has_zero_storage_and_loss_error():
    elastic = budget(Prony.paper(0), Solid(), cell=1.75e-3, band=BAND)
    assert (elastic.elements[0].storage_lost, elastic.elements[0].loss_lost) == (0.0, 0.0)
    only = choose(elastic)
    assert (len(only.moduli), only.storage_error, only.loss_error) == (0, 0.0, 0.0)


@pytest.mark.slow
def test_budget_figure_labels_each_substitute_with_its_error(tmp_path):
    spent = paper(2e-5)
    materials = substitutes(spent, match=BAND[1])[1:]
    figure = draw_budget(spent, materials)
    figure.savefig(tmp_path / "budget.png")
    for axis, error in zip(figure.axes, ("storage_error", "loss_error"), strict=True):
        labels = [text.get_text() for text in axis.get_legend().get_texts()]
        for material in materials:
            assert f"{material.name}: off by {100 * getattr(material, error):.2g} %" in labels
        assert "1 / relaxation time, not stable at 20 us" in labels


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"band": (10.0, 1.0)}, "band"),
        ({"cell": 0.0}, "cell"),
        ({"dt": math.nan}, "dt"),
        ({"formulation": "lagrangian"}, "formulation"),
    ],
)
def test_budget_arguments_outside_their_range_are_refused(change, match):
    with pytest.raises(ValueError, match=match):
        paper(**change)


def test_batched_prony_melt_and_invalid_element_counts_are_refused():
    batch = Prony(moduli=torch.ones(2, 1), times=torch.ones(2, 1))
    with pytest.raises(ValueError, match="one material"):
        budget(batch, Solid(), cell=CELL, band=BAND)
    with pytest.raises(ValueError, match="as of a melt"):
        budget(replace(LONG, equilibrium=0.0), Solid(), cell=CELL, band=BAND)
    for count in (0, 6):
        with pytest.raises(ValueError, match=f"elements = {count}"):
            choose(paper(), elements=count)
    with pytest.raises(ValueError, match="without any element"):
        choose(paper(1e-4))
    glass = Spectrum(equilibrium=1e5, moduli=np.array([1e9]), times=np.array([1e-2]), deformation="shear")
    assert choose(budget(glass, Solid(), cell=CELL, band=BAND, dt=1e-5)).storage_error > 0.5  # told, at least
