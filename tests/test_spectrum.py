"""Relaxation spectra recovered from synthetic curves, coverage of their intervals, and measured master curves."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from torchsoro.rheology.creep import interconverted
from torchsoro.rheology.measured import Creep, Relaxation, Sweep
from torchsoro.rheology.spectrum import Spectrum, error_norm, fit
from torchsoro.simulation.material import Prony, Solid

TABLE_S1 = Spectrum(
    equilibrium=0.44e6,
    moduli=0.44e6 * Prony.paper(5).moduli.numpy()[::-1],
    times=Prony.paper(5).times.numpy()[::-1],
    deformation="tension",
)
MASTER = np.geomspace(1e-2, 1e7, 126)  # the paper's seven frequencies at 18 temperatures, up to its 1e7 rad/s
# pyvisco 2.1.3 on freq_user_master.csv: prony.discretize and fit, then opt.nprony(window="min", opt=1.5) proposes 19
# terms after 3.0 s, whose error by Eq. 17c is this; its own 26 terms, one to a decade, have 98.5, and optimised 53.2.
PYVISCO_TERMS, PYVISCO_ERROR = 19, 57.03


def sweep(spectrum, omega, noise=0.0, seed=0):
    draw = np.random.default_rng(seed).standard_normal((2, len(omega)))
    storage, loss = (m * (1 + noise * r) for m, r in zip(spectrum.storage_loss(omega), draw, strict=True))
    return Sweep(omega=omega, storage=storage, loss=loss, temperature=21.8, deformation=spectrum.deformation)


def creeping(time, compliance):
    return Creep(time=time, compliance=compliance, temperature=20.0, deformation="shear")


def recording(name):
    folder = os.environ.get("TORCHSORO_RECORDINGS")
    if folder is None or not (Path(folder) / name).exists():
        pytest.skip(f"needs the recordings: set TORCHSORO_RECORDINGS to the folder that has {name}")
    return Path(folder) / name


def master_curve(name, skip, unit, **meaning):
    """Columns frequency, storage, loss; no point twice."""
    table = np.loadtxt(recording(name), delimiter="," if name.endswith("csv") else None, skiprows=skip)
    table = table[np.unique(table[:, 0], return_index=True)[1]]
    omega = table[:, 0] * (2 * math.pi if name.endswith("csv") else 1)
    return Sweep(omega=omega, storage=unit * table[:, 1], loss=unit * table[:, 2], **meaning)


# ------------------------------------------------------------------------------------------------------- closed forms
def test_storage_loss_and_relaxation_modulus_of_one_maxwell_element_match_closed_forms():
    one = Spectrum(equilibrium=2.0, moduli=np.array([3.0]), times=np.array([0.5]), deformation="shear")
    storage, loss = one.storage_loss(np.array([2.0, 4.0]))
    np.testing.assert_allclose(storage, [2 + 3 / 2, 2 + 3 * 4 / 5])
    np.testing.assert_allclose(loss, [3 / 2, 3 * 2 / 5])
    np.testing.assert_allclose(one.relaxation(np.array([0.0, 0.5])), [5, 2 + 3 / math.e])


def test_prony_series_has_storage_and_loss_modulus_of_spectrum_within_1e_12():
    prony = TABLE_S1.prony()
    assert torch.equal(prony.times, Prony.paper(5).times)  # the slowest first, as in Table S1
    ours = np.stack(TABLE_S1.storage_loss(MASTER))
    theirs = 0.44e6 * torch.stack(prony.storage_loss(torch.from_numpy(MASTER))).numpy()
    np.testing.assert_allclose(theirs, ours, rtol=1e-12)


def test_solid_modulus_from_tension_is_youngs_and_from_shear_is_shear_modulus():
    assert TABLE_S1.solid(0.4, 1070.0) == Solid()
    assert replace(TABLE_S1, deformation="shear").solid(0.4, 1070.0).shear == pytest.approx(0.44e6)


def test_error_norm_is_the_sum_of_eq_17c():
    spring = Spectrum(equilibrium=3.0, moduli=np.array([4.0]), times=np.array([1.0]), deformation="shear")
    data = Sweep(omega=np.ones(1), storage=np.array([4.0]), loss=np.array([1.0]), temperature=0.0, deformation="shear")
    assert error_norm(spring, data) == pytest.approx((5 / 4 - 1) ** 2 + (2 - 1) ** 2)
    with pytest.raises(ValueError, match="deformation"):
        error_norm(replace(spring, deformation="tension"), data)


# ----------------------------------------------------------------------------------------------------------- recovery
@given(
    gaps=st.lists(st.floats(1.0, 2.5), min_size=1, max_size=4),
    weights=st.lists(st.floats(-1.5, 1.5), min_size=5, max_size=5),
    kind=st.sampled_from(["sweep", "relaxation"]),
)
def test_moduli_and_times_recovered_within_1_percent_from_noiseless_sweep_and_relaxation(gaps, weights, kind):
    times = 1e-3 * 10 ** np.cumsum(gaps)
    truth = Spectrum(
        equilibrium=1e5, moduli=1e5 * 10 ** np.array(weights[: len(gaps)]), times=times, deformation="shear"
    )
    axis = np.geomspace(0.05 / times[-1], 20 / times[0], 150)
    if kind == "sweep":
        data = sweep(truth, axis)
    else:
        t = 1 / axis[::-1]
        data = Relaxation(time=t, modulus=truth.relaxation(t), temperature=20.0, deformation="shear")
    found = fit(data, elements=len(gaps))
    np.testing.assert_allclose(found.times, truth.times, rtol=1e-2)
    np.testing.assert_allclose(found.moduli, truth.moduli, rtol=1e-2)
    assert found.equilibrium == pytest.approx(1e5, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.01, 0.05])
def test_table_s1_moduli_within_5_percent_and_intervals_cover_truth_at_1_and_5_percent_noise(noise):
    truth = np.array([TABLE_S1.equilibrium, *TABLE_S1.moduli])
    off, half, held = [], [], []
    for seed in range(20):
        found = fit(sweep(TABLE_S1, MASTER, noise, seed))
        assert len(found.times) == 5, f"seed {seed}: the evidence wants {len(found.times)} terms"
        values, known = np.array([found.equilibrium, *found.moduli]), (found.equilibrium_interval, *found.intervals)
        off.append(np.abs(values / truth - 1))
        half.append([(i.high - i.low) / 2 / v for i, v in zip(known, values, strict=True)])
        held.append([i.low <= t <= i.high for i, t in zip(known, truth, strict=True)])
    off, half, held = np.array(off), np.array(half), np.array(held)
    print(f"noise {noise:.0%}: worst {off.max(0).round(3)}, covered {held.mean():.3f}, half {half.mean(0).round(3)}")
    # Within 5 %, or the interval says that 5 % cannot be known. With 5 % noise the standard error of three moduli is
    # 2.2 %, the least that any unbiased method can have, so that a few of 120 are off by up to 6.7 %.
    fine = (off <= 0.05) | (half > 0.05)
    assert fine.all() if noise < 0.05 else fine.mean() > 0.95
    assert held.mean() > 0.88  # of 120 intervals at 95 %; 200 seeds cover 0.954, 0.951 and 0.941
    assert half.max() < 3 * noise  # and they say something


def test_given_relaxation_times_narrow_intervals_of_moduli():
    data = sweep(TABLE_S1, MASTER, 0.03, 1)
    free, given = fit(data, elements=5), fit(data, times=TABLE_S1.times, regularization=0)
    widths = [np.array([i.high - i.low for i in f.intervals]) for f in (free, given)]
    assert (widths[1] < widths[0]).all()
    np.testing.assert_allclose(given.moduli, TABLE_S1.moduli, rtol=0.05)


# --------------------------------------------------------------------------------------------------------------- creep
@given(
    gaps=st.lists(st.floats(0.1, 4.0), min_size=1, max_size=6),
    weights=st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6),
    fluidity=st.sampled_from([0.0, 1e-8]),
)
@example(gaps=[2.0, 1.0, 3.0, 1.0, 4.0, 2.0], weights=[0.0] * 6, fluidity=1e-8)  # a liquid over 13 decades
def test_complex_modulus_times_complex_compliance_is_one_after_interconversion(gaps, weights, fluidity):
    times, compliances = 1e-4 * 10 ** np.cumsum(gaps), 1e-6 * 10 ** np.array(weights[: len(gaps)])
    found = interconverted(1e-7, fluidity, compliances, times)
    omega = np.geomspace(1e-6, 1e6, 40)
    compliance = 1e-7 + (compliances / (1 + 1j * omega[:, None] * times)).sum(1) + fluidity / (1j * omega)
    both = Spectrum(equilibrium=found.values[0], moduli=found.values[1:], times=found.times, deformation="shear")
    storage, loss = both.storage_loss(omega)
    np.testing.assert_allclose((storage + 1j * loss) * compliance, 1, rtol=1e-9)
    assert len(found.times) == len(times) + (fluidity > 0)
    time = np.geomspace(1e-3, 1e3 * times[-1], 30)
    creep = 1e-7 + ((1 - np.exp(-time[:, None] / times)) * compliances).sum(1) + fluidity * time
    np.testing.assert_allclose(both.creep(time), creep, rtol=1e-6)


def test_relaxation_spectrum_recovered_from_creep_compliance():
    retarded, compliances = np.array([0.05, 3.0, 100.0]), np.array([1e-6, 3e-6, 5e-6])
    truth = interconverted(1e-6, 0.0, compliances, retarded).values
    time = np.geomspace(1e-3, 1e3, 80)
    compliance = 1e-6 + ((1 - np.exp(-time[:, None] / retarded)) * compliances).sum(1)
    held = []
    for seed in range(6):
        noise = 1 + 0.01 * np.random.default_rng(seed).standard_normal(80)
        found = fit(creeping(time, compliance * noise), elements=3)
        known = (found.equilibrium_interval, *found.intervals)
        held.append([i.low <= t <= i.high for i, t in zip(known, truth, strict=True)])
        np.testing.assert_allclose([found.equilibrium, *found.moduli], truth, rtol=0.06)
    assert np.mean(held) > 0.88  # of 24 intervals at 95 %
    flowing = creeping(time, compliance + 1e-7 * time)
    assert fit(flowing, equilibrium=False).equilibrium == 0
    with pytest.raises(ValueError, match="as of a melt"):
        fit(flowing, equilibrium=False).prony()


# -------------------------------------------------------------------------------------------- what cannot be known
@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2))])
def test_modulus_of_relaxation_time_below_data_window_is_unbounded(seed):
    found = fit(sweep(TABLE_S1, np.geomspace(1e-2, 1e4, 90), 0.02, seed))  # the two fastest lie beyond
    assert found.intervals[0].unknown.startswith("stands for all relaxation faster")
    assert found.intervals[0].high == math.inf
    known = [(v, i) for v, i in zip(found.moduli, found.intervals, strict=True) if not i.unknown]
    assert len(known) >= 2
    for value, truth, interval in ((v, TABLE_S1.moduli[-k], i) for k, (v, i) in enumerate(known[::-1], 1)):
        assert interval.low <= truth <= interval.high or abs(value / truth - 1) < 0.05


def test_intervals_cover_moduli_of_melt_with_one_relaxation_time_below_data_window():
    truth = Spectrum(
        equilibrium=0.0,
        moduli=np.array([5e6, 2e5, 1e5, 5e4]),
        times=np.array([1e-5, 1e-2, 1.0, 30.0]),
        deformation="shear",
    )
    inside = []
    for seed in range(8):
        found = fit(sweep(truth, np.geomspace(1e-3, 1e3, 30), 0.02, seed), elements=4, equilibrium=False)
        assert found.intervals[0].unknown and not any(i.unknown for i in found.intervals[1:])
        for interval, modulus in zip(found.intervals[1:], truth.moduli[1:], strict=True):
            assert interval.high < 1.1 * interval.low
            inside.append(interval.low <= modulus <= interval.high)
    assert sum(inside) >= 21  # of 24 at 95 %


def test_intervals_hold_at_fixed_relaxation_times_for_serially_correlated_residuals():
    # A smooth error, as where isotherms do not quite meet: one term less fits nearly as well.
    times, omega = np.geomspace(1e-5, 1e2, 40), np.geomspace(1e-3, 1e3, 60)
    truth = Spectrum(equilibrium=0.0, moduli=1e4 * times**-0.3, times=times, deformation="shear")
    storage, loss = (m * (1 + 0.03 * np.sin(2 * np.log(omega))) for m in truth.storage_loss(omega))
    found = fit(replace(sweep(truth, omega), storage=storage, loss=loss), equilibrium=False)
    assert found.inflation > 3
    known = [i for i in found.intervals if not i.unknown]
    assert len(known) >= len(found.moduli) - 1 >= 3
    assert any("relaxation times held" in i.condition for i in known)
    assert all(0 < i.low and i.high < 5 * i.low for i in known if i.condition)


def test_interval_of_superfluous_term_starts_at_zero():
    times = np.sort([*TABLE_S1.times, 40.0])
    found = fit(sweep(TABLE_S1, MASTER, 0.02, 3), times=times, regularization=0)
    extra = found.intervals[-1]
    assert extra.low == 0 and extra.unknown == "the data are consistent with zero"
    assert 0 < extra.high < 0.05 * TABLE_S1.equilibrium


def test_prony_series_of_melt_requires_given_equilibrium_modulus():
    melt = Spectrum(equilibrium=0.0, moduli=np.array([3e5, 1e5]), times=np.array([0.1, 10.0]), deformation="shear")
    data = sweep(melt, np.geomspace(1e-3, 1e3, 60), 0.03)
    liquid, asked = fit(data, equilibrium=False), fit(data)
    assert liquid.equilibrium == 0
    assert asked.equilibrium_interval is not None and asked.equilibrium_interval.low == 0
    for found in (liquid, asked):
        with pytest.raises(ValueError, match=r"as of a melt.*give equilibrium="):
            found.prony()
    assert float(liquid.prony(equilibrium=1e5).moduli[0]) == pytest.approx(1, rel=0.1)
    assert fit(data, equilibrium=50.0).equilibrium == 50


@pytest.mark.parametrize(
    ("window", "why"),
    [
        pytest.param((1e-3, 1e4), "the data are consistent with zero", marks=pytest.mark.slow),
        (None, "it is still falling there"),
    ],
)
def test_equilibrium_modulus_of_critical_gel_is_undetermined(window, why):
    times = np.geomspace(1e-4, 1e6, 60)  # a critical gel: a power law far beyond the data
    gel = Spectrum(equilibrium=0.0, moduli=1e4 * times**-0.5, times=times, deformation="shear")
    found = fit(sweep(gel, np.geomspace(1e-2, 1e3, 80), 0.01), window=window)
    assert found.equilibrium_interval.low == 0 and why in found.equilibrium_interval.unknown
    with pytest.raises(ValueError, match="not determined"):
        found.solid(0.4, 1000.0)


def test_interval_of_equilibrium_modulus_widens_with_serially_correlated_residuals():
    white = sweep(TABLE_S1, MASTER, 0.02)
    wave = 1 + 0.028 * np.sin(4 * np.log(MASTER))  # as large, but smooth: as where isotherms do not quite meet
    storage, loss = (m * wave for m in TABLE_S1.storage_loss(MASTER))
    smooth = replace(white, storage=storage, loss=loss)
    found = [fit(data, times=TABLE_S1.times, regularization=0) for data in (white, smooth)]
    assert found[0].inflation == 1 and found[1].inflation > 3
    width = [f.equilibrium_interval.high - f.equilibrium_interval.low for f in found]
    assert width[1] > 1.5 * width[0]


# ----------------------------------------------------------------------------------------------- number and roughness
def test_least_bic_selects_five_terms_of_table_s1_at_2_percent_noise():
    found = fit(sweep(TABLE_S1, MASTER, 0.02))
    best = min(found.evidence, key=lambda c: c.bic)
    assert best.elements == len(found.times) == 5
    errors = [c.error for c in found.evidence]
    assert errors == sorted(errors, reverse=True) and found.floor > 0.8 * found.error
    assert error_norm(found, sweep(TABLE_S1, MASTER, 0.02)) == pytest.approx(found.error)


@pytest.mark.slow
def test_regularization_reduces_error_of_moduli_of_60_terms_below_30_percent():
    times = np.geomspace(1e-7, 1e2, 60)
    truth = Spectrum(equilibrium=1e5, moduli=1e4 * times**-0.25, times=times, deformation="shear")
    data = sweep(truth, np.geomspace(1e-2, 1e7, 120), 0.03)
    rough, smooth = (fit(data, elements=60, times="log", regularization=r) for r in (0, "auto"))
    off = [np.abs(f.moduli / truth.moduli - 1)[5:-5].max() for f in (rough, smooth)]
    assert off[0] > 1 and off[1] < 0.3
    assert min(smooth.evidence, key=lambda c: c.bic).regularization > 0


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"elements": 0}, "elements = 0"),
        ({"times": "linear"}, "times = 'linear'"),
        ({"times": [1.0, -1.0]}, "positive relaxation times"),
        ({"times": [1.0, 2.0], "elements": 3}, "wanted 2, the number of given times"),
        ({"equilibrium": -1.0}, "equilibrium = -1"),
        ({"regularization": 1.0}, "where the times are free"),
        ({"window": (1.0, 0.1)}, "window"),
        ({"elements": 4, "times": "log"}, "wanted more points"),
    ],
)
def test_fit_arguments_outside_their_range_are_refused(change, match):
    with pytest.raises(ValueError, match=match):
        fit(sweep(TABLE_S1, np.array([1.0, 10.0])), **change)


def test_zero_loss_creep_equilibrium_single_point_and_invalid_spectra_are_refused():
    zero = replace(sweep(TABLE_S1, MASTER), loss=np.zeros(len(MASTER)))
    with pytest.raises(ValueError, match=r"loss modulus 0 Pa at 0\.01 rad/s"):
        fit(zero)
    creep = Creep(time=np.array([1.0, 2.0]), compliance=np.ones(2), temperature=20.0, deformation="shear")
    with pytest.raises(ValueError, match="wanted True or False for creep"):
        fit(creep, equilibrium=1e5)
    with pytest.raises(ValueError, match="one point"):
        fit(sweep(TABLE_S1, MASTER[:1]))
    for change, match in (
        ({"times": TABLE_S1.times[::-1]}, "the shortest first"),
        ({"moduli": -TABLE_S1.moduli}, "moduli = .*at least 0"),
        ({"moduli": TABLE_S1.moduli[1:]}, "shapes"),
        ({"equilibrium": math.inf}, "equilibrium = inf"),
        ({"deformation": "torsion"}, "deformation = 'torsion'"),
    ):
        with pytest.raises(ValueError, match=match):
            replace(TABLE_S1, **change)
    with pytest.raises(ValueError, match="equilibrium = 0"):
        TABLE_S1.prony(equilibrium=0.0)
    six = Spectrum(equilibrium=1.0, moduli=np.ones(6), times=np.arange(1.0, 7.0), deformation="shear")
    with pytest.raises(ValueError, match=r"6 terms.*budget\.choose"):
        six.prony()


# ---------------------------------------------------------------------------------------------------- measured curves
@pytest.mark.slow
def test_error_norm_on_published_master_curve_below_pyvisco_with_half_its_terms():
    data = master_curve(
        "dma-nrel-polymer/freq_user_master.csv", 2, 1e6, temperature=-5.0, deformation="tension"
    )  # MPa over Hz
    same, half = (fit(data, elements=n, intervals=False) for n in (PYVISCO_TERMS, 10))
    print(
        f"e of Eq. 17c: {same.error:.2f} with {PYVISCO_TERMS} terms, {half.error:.2f} with 10, pyvisco {PYVISCO_ERROR}"
    )
    assert error_norm(same, data) < 0.3 * PYVISCO_ERROR
    assert error_norm(half, data) < PYVISCO_ERROR
    best = fit(data, times="log", regularization=0)
    assert 11 < best.floor < best.error < 1.2 * best.floor  # storage and loss contradict each other by that much


@pytest.mark.slow
def test_plateau_modulus_of_polyisoprene_melt_is_0_3_to_0_5_mpa():
    name = "rheology-polyisoprene-tts/master_curves_reference/PI_634.5k_T-35.tts"
    data = master_curve(name, 1, 1.0, temperature=-35.0, deformation="shear")
    found = fit(data, equilibrium=False)
    scatter = math.sqrt(found.error / (2 * len(data.omega)))
    print(f"{len(found.times)} terms, relative residual {scatter:.3f}, floor {found.floor:.3f} of {found.error:.3f}")
    assert scatter < 0.04 and len(found.times) <= 14
    assert found.relaxation(np.array([1e10])) < 1e-3  # it flows
    plateau = found.moduli[(found.times > 10) & (found.times < 1e7)].sum()
    assert 3e5 < plateau < 5e5  # entangled polyisoprene: 0.4 MPa
