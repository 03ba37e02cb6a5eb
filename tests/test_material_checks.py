"""Validation recipe of superposition and Prony fits: its functions, and skipped data sets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from published import RECORDINGS, recordings

from torchsoro.rheology.measured import Sweep
from torchsoro.rheology.spectrum import Interval, Spectrum, fit
from torchsoro.rheology.superposition import Shift, master

SOLID = Spectrum(
    equilibrium=1e6, moduli=np.full(8, 3e6), times=np.geomspace(1e-5, 1e2, 8), deformation="tension", temperature=20.0
)


def sweeps(shift: Shift) -> list[Sweep]:
    omega = 2 * np.pi * np.geomspace(0.1, 100, 10)
    curves = []
    for t, a in zip(shift.temperatures, shift.log_a, strict=True):
        storage, loss = SOLID.storage_loss(omega * 10**a)
        curves.append(Sweep(omega=omega, storage=storage, loss=loss, temperature=float(t), deformation="tension"))
    return curves


def test_master_curve_separates_into_sweeps_and_shift_factors_are_recovered(checks):
    shift = Shift(
        temperatures=np.array([0.0, 10.0, 20.0, 30.0]), log_a=np.array([2.23, 1.05, 0.0, -0.92]), reference=20.0
    )
    curves = sweeps(shift)
    apart = checks.taken_apart(master(curves, shift), shift)
    for mine, theirs in zip(apart, curves, strict=True):
        np.testing.assert_allclose(mine.omega, theirs.omega, rtol=1e-9)
        np.testing.assert_allclose(mine.storage, theirs.storage, rtol=1e-9)
    row, _ = checks.compared("itself", apart, shift, limit=0.05, reference=20.0)
    assert row["met"] == "yes"
    assert row["apart, ours"] < 0.01
    wrong = Shift(temperatures=shift.temperatures, log_a=1.5 * shift.log_a, reference=20.0)
    row, _ = checks.compared("another list", curves, wrong, limit=0.05, reference=20.0)
    assert row["met"] == "no"
    assert row["apart, theirs"] > 3 * row["apart, ours"]


def test_table_s1_moduli_recovered_at_2_percent_noise(checks):
    (row,) = checks.resin(noises=(0.02,), seeds=2)
    assert (row["with five elements"], row["moduli"], row["or said"]) == (2, 12, 12)
    assert checks.wide(1.0, Interval(low=0.9, high=1.1))
    assert not checks.wide(1.0, Interval(low=0.99, high=1.01))
    assert checks.wide(1.0, Interval(low=0.99, high=1.01, unknown="for a reason"))


def test_absent_recording_folders_are_skipped(checks, tmp_path, capsys):
    for check, folder in checks.FOLDERS.items():
        checks.main(tmp_path, check)
        assert f"{check}: skipped" in (out := capsys.readouterr().out) and str(tmp_path / folder) in out


@pytest.mark.filterwarnings("ignore")  # those of pandas are meant for pyvisco
def test_error_norm_not_above_pyvisco_for_same_number_of_terms(checks):
    pytest.importorskip("pyvisco", reason="what is compared with; an extra")
    omega = np.geomspace(1e-3, 1e6, 91)
    storage, loss = SOLID.storage_loss(omega) * (1 + 0.02 * np.random.default_rng(1).standard_normal((2, 91)))
    curve = Sweep(omega=omega, storage=storage, loss=loss, temperature=20.0, deformation="tension")
    rows = checks.beside_pyvisco(curve, fit(curve))
    theirs = [row for row in rows if row["fit"].startswith("pyvisco")]
    for row in theirs:
        ours = [r["e (Eq. 17c)"] for r in rows if r["fit"].startswith("ours") and r["terms"] <= row["terms"]]
        assert min(ours) <= row["e (Eq. 17c)"]


@pytest.mark.slow
@recordings
def test_storage_modulus_mismatch_of_raw_adhesive_sweeps_below_30_percent_of_published(checks):
    row = checks.adhesive(Path(RECORDINGS) / "dma-nrel-polymer")[-1]
    assert row["met"] == "no"
    assert row["apart, ours"] < 0.3 * row["apart, theirs"]


@recordings
@pytest.mark.slow
def test_resonance_of_rubber_discs_predicted_from_dma_within_13_percent(checks):
    rows = checks.shaker(Path(RECORDINGS) / "dma-shaker-rubber" / "material_a", across=())
    for row in rows:
        if row["material"].startswith(("fitted", "for the simulator")):
            assert row["over measured"] == pytest.approx(1, abs=0.13)
            assert row["height over measured"] == pytest.approx(1, abs=0.06)
        if row["material"] == "elastic":
            assert row["over measured"] < 0.75
