"""Least thickness of walls and gaps by eroded and dilated designs."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny import TINY

from torchsoro.design import loop
from torchsoro.design.domain import Chamber, Domain
from torchsoro.design.ensemble import Ensemble
from torchsoro.design.features import threshold_of
from torchsoro.design.field import DesignField
from torchsoro.design.port import AirPort
from torchsoro.design.robot import walker
from torchsoro.output.fabricate import fabricate

H = 0.001  # m, spacing
FEATURED = {"scenarios": 5, "fresh": True, "clip": 0.0, "lightness": 0.1, "feature": 0.004}


def plate(width: float, radius: float = 8 * H) -> DesignField:
    """A field whose design variable is 1 within a plate across x, and -1 elsewhere; partly at its surfaces."""
    shape = 32, 16, 16
    domain = Domain(size=tuple(n * H for n in shape), particles=shape)
    field = DesignField(domain, radius=radius, symmetry=(), beta=1e3, dtype=torch.float64)
    x = (torch.arange(32, dtype=torch.float64) - 15.5) * H
    inside = ((width / 2 - x.abs()) / H + 0.5).clamp(0, 1)
    with torch.no_grad():
        field.phi.copy_((2 * inside - 1).reshape(32, 1, 1))
    return field


def profile(field: DesignField, threshold: float = 0.0) -> np.ndarray:
    """Density through the plate, in the middle of the body."""
    return field(threshold=threshold).detach().reshape(32, 16, 16)[:, 8, 8].numpy()


def thickness(field: DesignField) -> float:
    """Where the filtered design variable is above zero along x, interpolated [m]."""
    values = field.filtered().detach().reshape(32, 16, 16)[:, 8, 8].numpy()
    at = np.flatnonzero(np.diff(np.sign(values)))
    ends = [k + values[k] / (values[k] - values[k + 1]) for k in at]
    return (ends[1] - ends[0]) * H if len(ends) == 2 else 0.0


@pytest.mark.slow
@pytest.mark.parametrize("feature", [2.5 * H, *(pytest.param(n * H, marks=pytest.mark.slow) for n in (4, 6))])
def test_of_plates_those_that_are_left_when_eroded_are_as_thick_as_asked(feature):
    eta = threshold_of(8 * H, feature)
    left = {}
    for width in np.arange(3.0, 12.0, 0.05) * H:
        field = plate(width)
        left[thickness(field)] = bool(profile(field, eta).max() > 0.5)
    thinnest = min(t for t, there in left.items() if there)
    thickest = max(t for t, there in left.items() if not there)
    assert thinnest >= thickest  # thickness alone decides
    assert thinnest == pytest.approx(feature, abs=0.2 * H)  # the lattice's sums are not integrals


@settings(max_examples=30, deadline=None)
@given(feature=st.floats(0.01, 1.9), radius=st.floats(1e-4, 1.0))
def test_thresholds_grow_with_features_from_zero_to_one_and_know_no_unit(feature, radius):
    eta = threshold_of(radius, feature * radius)
    assert 0 < eta < 1
    assert threshold_of(radius, 1.05 * feature * radius) > eta
    assert eta == pytest.approx(threshold_of(1.0, feature), rel=1e-6, abs=1e-12)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 1000), eta=st.floats(-0.9, 0.9), beta=st.floats(0.5, 20.0))
def test_gaps_of_a_design_are_walls_of_its_negative(seed, eta, beta):
    domain = Domain(size=(8 * H, 7 * H, 6 * H), particles=(8, 7, 6))
    field = DesignField(domain, radius=2.5 * H, beta=beta, symmetry=(), dtype=torch.float64)
    phi = 2 * torch.rand(8, 7, 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 1

    def deep(phi: torch.Tensor, threshold: float) -> torch.Tensor:
        """Density where the filter does not see what is beyond the body."""
        return domain.lattice(field(phi, threshold=threshold))[2:-2, 2:-2, 2:-2]

    torch.testing.assert_close(deep(-phi, -eta), 1 - deep(phi, eta), rtol=0, atol=1e-12)
    more, less = field(phi, threshold=eta), field(phi, threshold=eta + 0.05)
    assert bool((less <= more + 1e-12).all())
    assert float(deep(torch.ones_like(phi), eta).min()) == pytest.approx(1.0)
    assert float(field(-torch.ones_like(phi), threshold=eta).max()) == pytest.approx(0.0, abs=1e-12)


def test_gradcheck_of_an_eroded_design():
    domain = Domain(size=(3 * H, 4 * H, 3 * H), particles=(3, 4, 3))
    field = DesignField(domain, radius=2.5 * H, beta=3.0, symmetry=("y",), dtype=torch.float64)
    phi = 0.9 * (2 * torch.rand(3, 4, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 1)
    assert torch.autograd.gradcheck(lambda p: field(p, threshold=0.3), phi.requires_grad_())


def test_no_threshold_is_equation_12_to_the_bit():
    field = plate(5 * H)
    field.beta = 8.0
    expected = 0.5 * (torch.tanh(8.0 * field.filtered()) / np.tanh(8.0) + 1.0)
    torch.testing.assert_close(field(), expected, rtol=0, atol=1e-15)
    assert torch.equal(field(), field(threshold=0.0))


@pytest.mark.parametrize("threshold", [-1.0, 1.0, float("nan")])
def test_thresholds_that_leave_all_or_nothing_are_refused(threshold):
    with pytest.raises(ValueError, match="threshold: got"):
        plate(5 * H)(threshold=threshold)


@pytest.mark.parametrize("feature", [0.0, -1e-3, 16 * H, float("nan")])
def test_features_that_the_filter_cannot_tell_are_refused(feature):
    with pytest.raises(ValueError, match=r"feature = .* wanted above 0 and below twice the filter radius"):
        threshold_of(8 * H, feature)


def test_settings_want_a_scenario_for_each_variant_and_a_filter_that_is_wide_enough():
    with pytest.raises(ValueError, match=r"feature = 0\.001 m: wanted at least 3 scenarios"):
        dataclasses.replace(TINY, feature=0.001, scenarios=2)
    with pytest.raises(ValueError, match=r"feature = 0\.02 m: wanted above 0 and below twice the filter radius"):
        dataclasses.replace(TINY, feature=0.02, scenarios=3)
    walls = [
        dataclasses.replace(TINY, **{**FEATURED, **more}).mended_to
        for more in ({}, {"feature": 6e-3}, {"min_wall": 0.0})
    ]
    assert walls == [0.004, TINY.wall, 0.0] and TINY.mended_to == 0
    # A finished robot is simulated and compared without any, but not designed.
    finished = walker(dataclasses.replace(TINY, feature=0.004, scenarios=0))
    with pytest.raises(ValueError, match=r"feature = 0\.004 m with scenarios = 0: wanted at least 3 scenarios"):
        loop.optimize(finished)


def test_scenarios_meet_the_design_eroded_and_dilated_in_turn_with_the_gradients_of_single_runs():
    made = walker(dataclasses.replace(TINY, **FEATURED, dt=1e-4, risk="cvar:0.5"))
    with torch.no_grad():
        made.field.phi.copy_(torch.linspace(-0.1, 0.3, 8).reshape(8, 1, 1) + 0.05 * torch.linspace(-1, 1, 8))
    ensemble = Ensemble(made)
    eta = threshold_of(TINY.filter_radius, 0.004)
    assert ensemble.thresholds == (0.0, eta, -eta)
    gamma = made.field()
    outcome = ensemble.judge(gamma, 3, 1.0)
    assert float(outcome.mass.detach()) == pytest.approx(float(made(gamma.detach()).mass))
    aims = loop.aim(made, outcome, 3)
    (found,) = ensemble.gradient(gamma, aims)
    batch, fields = ensemble.sample(3), [made.field(threshold=eta * (0, 1, -1)[k % 3]) for k in range(5)]
    singles = [made(fields[k], scenarios=batch.part([k])) for k in range(5)]
    whole = made.field()
    values = torch.stack([loop.aim(made, dataclasses.replace(one, mass=made(whole).mass), 3)[0] for one in singles])
    torch.testing.assert_close(aims, values, rtol=1e-6, atol=1e-7)
    (wanted,) = torch.autograd.grad(-loop.overall(made, values), made.field.phi)
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-5 * float(wanted.abs().max()))


def test_variants_grow_apart_once_the_projection_is_sharp(monkeypatch):
    made = walker(dataclasses.replace(TINY, **FEATURED, sharpen=(2, 6)))
    ensemble, seen = Ensemble(made), []
    monkeypatch.setattr(Ensemble, "_simulated", lambda self, variants, *_: seen.append(variants))
    for iteration in (6, 8, 10, 13):
        with pytest.raises(AssertionError):
            ensemble.judge(made.field(), iteration, 1.0)
    even, half, sharp, later = seen
    assert torch.equal(even[0], even[1]) and torch.equal(even[0], even[2])
    masses = [float(one[1].sum()) for one in seen]
    assert masses[0] > masses[1] > masses[2] == masses[3] and torch.equal(sharp, later)
    assert torch.equal(half[0], sharp[0])


@pytest.mark.slow
def test_a_run_tells_how_far_its_variants_go(recipes, tmp_path):
    result = recipes["walker"].main(dataclasses.replace(TINY, out=tmp_path / "run", **{**FEATURED, "clip": 3.0}))
    rows = np.genfromtxt(tmp_path / "run" / "metrics.csv", delimiter=",", names=True)
    for name in ("intermediate", "eroded", "dilated"):
        assert np.isfinite(rows[f"scenariosL_{name}"]).all()
    assert len(set(rows["scenariosL_eroded"]) | set(rows["scenariosL_dilated"])) > 2
    # As thick as asked for, but where there is no room, which is told.
    assert result["min_wall"] == pytest.approx(0.004)
    assert result["min_wall_met"] == (result["thinnest_wall"] > 0.0039)


def test_an_eroded_design_wears_off_at_the_faces_of_its_box():
    size, n = 0.02, 20
    domain = Domain(size=(size,) * 3, particles=(n,) * 3)
    field = DesignField(domain, radius=0.004, beta=64.0, symmetry=(), dtype=torch.float64)
    eta = threshold_of(0.004, 0.003)
    phi = -torch.ones(domain.shape, dtype=torch.float64)
    phi[:, :, :2] = 1  # 2 mm at a face, half as thick as the filter tells from a thick plate
    assert float(domain.lattice(field(phi))[:, :, 0].min()) > 0.99
    assert float(field(phi, threshold=eta).max()) < 0.01
    assert float(field(torch.ones_like(phi), threshold=eta)[domain.nearest(torch.full((1, 3), size / 2))]) > 0.99


@pytest.mark.slow
def test_a_port_that_belongs_to_the_domain_leaves_limbs_as_thick_as_they_are():
    chamber = Chamber(name="air", center=(0.01, 0.01, 0.01), size=(0.01,) * 3, wall=0.002)
    port = AirPort(diameter=0.003)
    how = {"size": (0.02,) * 3, "particles": (20,) * 3, "chambers": (chamber,)}
    free, cut = Domain(**how, port=port), Domain(**how)
    way = free.lattice(free.outside)
    assert bool(way[:5, 8:12, 8:12].any()) and not bool(way[5:].any()) and not bool(way[:, :7].any())
    assert torch.equal(way, way.flip(1)) and bool(DesignField(free, radius=0.003).phi.isfinite().all())
    # Of a limb beside the way, a port that is cut afterwards leaves a thin one.
    limb = torch.zeros(20, 20, 20)
    limb[:5, 6:12, 5:15] = 1
    thinnest = {
        name: fabricate(domain, limb.flatten(), density=1e3, port=port).report.thinnest_wall_mm
        for name, domain in (("free", free), ("cut", cut))
    }
    bare = fabricate(free, limb.flatten(), density=1e3).report.thinnest_wall_mm
    assert thinnest["free"] == pytest.approx(bare, rel=0.02)
    assert thinnest["cut"] < 0.8 * bare
    with pytest.raises(ValueError, match=r"port\.diameter: got 0\.02"):
        Domain(**how, port=AirPort(diameter=0.02))
