"""Material file of a robot from synthetic sweeps and creep of a known Prony series; shaker simulation."""

from __future__ import annotations

import dataclasses
import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from tiny import TINY

from torchsoro import cli
from torchsoro.design.robot import walker
from torchsoro.simulation.material import Prony, Solid
from torchsoro.simulation.material_file import read_material

RECIPES = Path(__file__).parents[1] / "recipes"
MODULUS = 0.44e6  # Pa
TEMPERATURES = (5.0, 20.0, 30.0, 40.0)


@pytest.fixture(scope="module")
def modules() -> dict[str, ModuleType]:
    # A package of another project has the recipe's name.
    return {"material": cli.load("material"), "shaker": importlib.import_module("shaker")}


def moduli(prony: Prony, omega: np.ndarray) -> np.ndarray:
    return np.stack([part.numpy() for part in prony.storage_loss(torch.from_numpy(omega))])


def sweeps(path: Path, prony: Prony, permanent: float = 1.0) -> Path:
    """Sweeps at four temperatures of the paper's resin, WLF with C1 = 5 and C2 = 100 K at 20 C; 1 % of noise."""
    rng = np.random.default_rng(5)
    frequency = np.geomspace(0.01, 100, 25)
    lines = ["T_C,f_Hz,E_storage_MPa,E_loss_MPa"]
    for t in TEMPERATURES:
        shift = 10 ** (-5 * (t - 20) / (100 + t - 20))
        storage, loss = moduli(prony, 2 * np.pi * frequency * shift)
        storage = storage - 1 + permanent
        noise = np.exp(0.01 * rng.standard_normal((2, len(frequency))))
        rows = zip(frequency, noise[0] * storage * MODULUS / 1e6, noise[1] * loss * MODULUS / 1e6, strict=True)
        lines += [f"{t},{f!r},{e!r},{g!r}" for f, e, g in (map(float, row) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.slow
def test_prony_series_recovered_within_3_percent_from_sweep_file(modules, tmp_path):
    recipe = modules["material"]
    truth = Prony.paper(3)
    file = sweeps(tmp_path / "resin.csv", truth)
    options = recipe.Options(file=file, out=tmp_path / "out", reference=20.0, band=(1.0, 50.0))
    found = recipe.main(options)
    assert abs(found.shift.log_a - [5 * 15 / 85, 0, -5 * 10 / 110, -5 * 20 / 120]).max() < 0.02
    read = read_material(tmp_path / "out" / "material.toml")
    assert read.solid.youngs_modulus == pytest.approx(MODULUS, rel=0.02)
    omega = 2 * np.pi * np.geomspace(1, 50, 20)
    scale = read.solid.youngs_modulus / MODULUS
    np.testing.assert_allclose(scale * moduli(read.prony, omega), moduli(truth, omega), rtol=0.03)
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert page.count("<img") == 3
    assert read.left_out in page.replace("&#x27;", "'")
    robot = walker(dataclasses.replace(TINY, material=tmp_path / "out" / "material.toml", dt="auto"))
    assert robot.prony.elements == read.prony.elements
    again = recipe.main(dataclasses.replace(options, file=tmp_path / "out" / "master.csv", out=tmp_path / "again"))
    assert again.shift is None
    assert again.solidified.spectrum.error == pytest.approx(found.solidified.spectrum.error, rel=1e-6)


@pytest.mark.slow
def test_relaxation_slower_than_horizon_adds_to_equilibrium_modulus(modules, tmp_path):
    file = sweeps(tmp_path / "slow.csv", Prony(moduli=torch.tensor([1.0, 1.0]), times=torch.tensor([3.0, 0.01])))
    options = modules["material"].Options(file=file, out=tmp_path / "out", reference=20.0, horizon=0.3)
    found = modules["material"].main(options)
    assert found.material.solid.youngs_modulus == pytest.approx(2 * MODULUS, rel=0.05)
    assert found.material.left_out.startswith("The modulus left after 0.3 s, 0.8")


def test_melt_without_given_equilibrium_modulus_is_refused(modules, tmp_path):
    file = sweeps(tmp_path / "melt.csv", Prony(moduli=torch.ones(1), times=torch.full((1,), 1e-3)), permanent=0.0)
    with pytest.raises(ValueError, match=r"melt\.csv: the material flows, .*--equilibrium"):
        modules["material"].main(modules["material"].Options(file=file, out=tmp_path / "out", reference=20.0))


@pytest.mark.slow
def test_prony_series_recovered_within_2_percent_from_creep_compliance(modules, tmp_path):
    # Retardation after 1e-6, 3e-6 and 5e-6 1/Pa at 20 C; at 35 C a tenth of the time for it.
    time, retarded, compliances = np.geomspace(1e-3, 1e2, 60), np.array([0.01, 1.0]), np.array([3e-6, 5e-6])
    lines, rng = ["T_C,time_s,creep_compliance_1_per_Pa"], np.random.default_rng(3)
    for t, shift in ((20.0, 1.0), (35.0, 0.1)):
        creep = 1e-6 + ((1 - np.exp(-time[:, None] / (shift * retarded))) * compliances).sum(1)
        noisy = creep * np.exp(0.01 * rng.standard_normal(60))
        lines += [f"{t},{x!r},{y!r}" for x, y in zip(time.tolist(), noisy.tolist(), strict=True)]
    file = tmp_path / "creep.csv"
    file.write_text("\n".join(lines) + "\n")
    recipe = modules["material"]
    options = recipe.Options(file=file, out=tmp_path / "out", deformation="shear", reference=20.0, poisson_ratio=0.4)
    found = recipe.main(options)
    assert found.shift.log_a == pytest.approx([0.0, -1.0], abs=0.03)
    assert found.material.solid.shear == pytest.approx(1 / 9e-6, rel=0.02)
    instantaneous = found.solidified.spectrum.equilibrium + found.solidified.spectrum.moduli.sum()
    assert instantaneous == pytest.approx(1e6, rel=0.05)
    truth = 1e-6 + ((1 - np.exp(-time[:, None] / retarded)) * compliances).sum(1)
    np.testing.assert_allclose(found.solidified.spectrum.creep(time), truth, rtol=0.02)
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert page.count("<img") == 3
    again = recipe.main(dataclasses.replace(options, file=tmp_path / "out" / "master.csv", out=tmp_path / "again"))
    assert again.material.solid.youngs_modulus == pytest.approx(found.material.solid.youngs_modulus, rel=1e-6)
    early = recipe.main(dataclasses.replace(options, horizon=0.1))
    assert early.material.solid.shear == pytest.approx(1 / 4e-6, rel=0.1)
    assert early.material.left_out.startswith("The modulus left after 0.1 s")
    with pytest.raises(ValueError, match="equilibrium = 100000: wanted none with creep tests"):
        recipe.main(dataclasses.replace(options, equilibrium=1e5))


@pytest.mark.slow
def test_simulated_transmissibility_peak_within_6_percent_of_closed_form(modules):
    shaker = modules["shaker"]
    solid = Solid(youngs_modulus=1.2e7, poisson_ratio=0.4, density=1200.0)
    prony = Prony(moduli=torch.tensor([0.6]).double(), times=torch.tensor([5e-4]).double())
    frequency, mass = np.linspace(200, 900, 200), 0.3
    storage, loss = solid.shear * moduli(prony, 2 * np.pi * frequency)
    exact = shaker.closed_form(storage, loss, frequency, mass)
    top = int(exact.argmax())
    stiffness = 2 * storage[top] * shaker.AREA / shaker.THICKNESS
    assert frequency[top] == pytest.approx(np.sqrt(stiffness / (mass + shaker.RUBBER / 3)) / (2 * np.pi), rel=0.05)
    (seen,) = shaker.simulated(solid, prony, frequency, [mass], across=2, width=0.018, duration=0.03)
    assert frequency[seen.argmax()] == pytest.approx(frequency[top], rel=0.06)
    assert seen.max() == pytest.approx(exact[top], rel=0.05)
