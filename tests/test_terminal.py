"""Terminal flow of melts and its absence in solids; what the horizon makes of a melt."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from published import RECORDINGS, recordings

from torchsoro.rheology.horizon import solidified
from torchsoro.rheology.measured import Creep, Sweep
from torchsoro.rheology.spectrum import Spectrum
from torchsoro.rheology.terminal import terminal_flow

MELT = Spectrum(
    equilibrium=0.0, moduli=np.array([2e5, 1e5, 5e4]), times=np.array([1e-2, 1.0, 30.0]), deformation="shear"
)
VISCOSITY = float(MELT.moduli @ MELT.times)
SOLID = Spectrum(equilibrium=1e5, moduli=MELT.moduli, times=MELT.times, deformation="shear")
OMEGA = np.geomspace(1e-3, 1e3, 50)


def sweep(spectrum, omega=OMEGA, noise=0.02, seed=0):
    draw = 1 + noise * np.random.default_rng(seed).standard_normal((2, len(omega)))
    storage, loss = spectrum.storage_loss(omega) * draw
    return Sweep(omega=omega, storage=storage, loss=loss, temperature=20.0, deformation="shear")


@pytest.mark.parametrize("seed", range(10))
def test_slopes_of_a_melt_are_2_and_1_within_their_errors(seed):
    flow = terminal_flow(sweep(MELT, np.geomspace(1e-4, 1e2, 60), seed=seed))
    assert flow is not None
    for slope, exact in zip(flow.slopes, (2.0, 1.0), strict=True):
        assert slope.error < 0.1
        assert abs(slope.value - exact) < 2 * slope.error
    assert flow.viscosity == pytest.approx(VISCOSITY, rel=0.03)
    assert flow.time == pytest.approx(float(MELT.moduli @ MELT.times**2) / VISCOSITY, rel=0.05)


@pytest.mark.parametrize("seed", range(10))
def test_a_solid_and_a_critical_gel_do_not_flow(seed):
    times = np.geomspace(1e-6, 1e8, 80)
    gel = Spectrum(equilibrium=0.0, moduli=1e4 * times**-0.8, times=times, deformation="shear")
    assert terminal_flow(sweep(SOLID, seed=seed)) is None
    assert terminal_flow(sweep(gel, seed=seed)) is None
    assert terminal_flow(sweep(MELT, OMEGA[OMEGA > 1], seed=seed)) is None  # the data end above the terminal zone


@pytest.mark.parametrize(("spectrum", "flows"), [(MELT, True), (SOLID, False)])
def test_creep_flows_where_the_compliance_grows_with_time(spectrum, flows):
    time = np.geomspace(1e-3, 1e4, 60)
    found = terminal_flow(Creep(time=time, compliance=spectrum.creep(time), temperature=20.0, deformation="shear"))
    assert (found is not None) == flows
    if found is not None:
        assert found.viscosity == pytest.approx(VISCOSITY, rel=0.05)


def test_horizon_turns_the_slow_elements_of_a_melt_into_the_modulus_and_reports_both():
    found = solidified(sweep(MELT), horizon=10.0, lowest=1.0)
    assert found.flow is not None
    assert found.spectrum.equilibrium == pytest.approx(5e4, rel=0.05)
    np.testing.assert_allclose(found.spectrum.moduli, MELT.moduli[:2], rtol=0.1)
    for interval in found.spectrum.intervals:
        assert not interval.unknown and interval.high < 1.3 * interval.low
    assert found.remark.startswith("Terminal flow: ")
    assert "modulus left after 10 s, 0.0" in found.remark
    lost = 1 - found.spectrum.storage_loss(np.array(1.0))[1] / MELT.storage_loss(np.array(1.0))[1]
    assert f"neglects {lost:.0%} of the loss modulus" in found.remark


def test_a_solid_keeps_its_equilibrium_modulus_without_a_remark():
    found = solidified(sweep(SOLID), horizon=100.0, lowest=1.0)
    assert (found.remark, found.flow) == ("", None)
    assert found.spectrum.equilibrium_interval is not None
    assert found.spectrum.equilibrium_interval.low <= 1e5 <= found.spectrum.equilibrium_interval.high


def test_a_melt_without_modulus_at_the_horizon_is_refused_with_its_longest_time():
    with pytest.raises(ValueError, match=r"no modulus left after 2e\+02 s; .*--horizon below .*, (29|3\d) s"):
        solidified(sweep(MELT), horizon=200.0, lowest=1.0)


@recordings
@pytest.mark.parametrize(("file", "molar_mass"), [("PI_225.9k_T-35.tts", 225.9), ("PI_634.5k_T-35.tts", 634.5)])
def test_polyisoprene_flows_with_a_viscosity_that_grows_as_the_power_3_4_of_its_molar_mass(file, molar_mass):
    folder = Path(RECORDINGS) / "rheology-polyisoprene-tts" / "master_curves_reference"
    table = np.loadtxt(folder / file, skiprows=1)
    table = table[np.unique(table[:, 0], return_index=True)[1]]
    curve = Sweep(omega=table[:, 0], storage=table[:, 1], loss=table[:, 2], temperature=-35.0, deformation="shear")
    flow = terminal_flow(curve)
    assert flow is not None
    print(file, flow.sentence)
    assert flow.slopes[0].value > 1.5 and flow.slopes[1].value == pytest.approx(1.0, abs=0.15)
