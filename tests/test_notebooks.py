"""The notebooks run: travel grows, losses fall, a fitted ball bounces less, an effect of one's own is found."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"


def executed(name, last, monkeypatch, folder):
    """The notebook, run in a folder, with one more cell."""
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.delenv("MPLBACKEND", raising=False)
    notebook = nbformat.read(NOTEBOOKS / name, as_version=4)
    notebook.cells.append(nbformat.v4.new_code_cell(last))
    NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    ).execute()
    return notebook


@pytest.mark.notebook
@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_a_cube_that_is_designed_travels_farther_and_becomes_a_watertight_part(monkeypatch, tmp_path):
    monkeypatch.setenv("TORCHSORO_NOTEBOOK_STEPS", "3")
    last = "print(way[-1] - way[0], grey[0] - grey[-1], part.report.watertight)"
    notebook = executed("01_design_a_walker.ipynb", last, monkeypatch, tmp_path)
    farther, less_grey, watertight = notebook.cells[-1].outputs[-1].text.split()
    assert float(farther) > 0
    assert float(less_grey) > 0
    assert watertight == "True"
    assert (tmp_path / "walker.stl").stat().st_size > 1000


@pytest.mark.notebook
@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # those of the kernel's client are not ours
def test_networks_of_pressure_and_density_learn_through_the_simulator(monkeypatch, tmp_path):
    monkeypatch.setenv("TORCHSORO_NOTEBOOK_STEPS", "4")
    losses = "print(volume_loss[-1] / volume_loss[0], bend_loss[-1] - bend_loss[0])"
    notebook = executed("04_compose_with_torch.ipynb", losses, monkeypatch, tmp_path)
    ratio, change = map(float, notebook.cells[-1].outputs[-1].text.split())
    assert ratio < 0.8
    assert change < -0.01
    drawn = [o for cell in notebook.cells for o in cell.get("outputs", []) if "image/png" in o.get("data", {})]
    assert len(drawn) == 2


@pytest.mark.notebook
@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_a_fitted_resin_bounces_the_less_the_more_elements_it_has(monkeypatch, tmp_path):
    monkeypatch.setenv("TORCHSORO_NOTEBOOK_CELLS", "4")
    notebook = executed("02_from_rheometer_to_material.ipynb", "print(*restitution)", monkeypatch, tmp_path)
    restitution = list(map(float, notebook.cells[-1].outputs[-1].text.split()))
    assert len(restitution) == 6
    assert restitution[0] > 0.85  # four cells across the ball are few
    assert 0.4 < restitution[3] < 0.65
    assert all(more < less + 0.01 for less, more in pairwise(restitution))


@pytest.mark.notebook
@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_an_effect_of_ones_own_is_found_among_those_of_the_package(monkeypatch, tmp_path):
    said = (
        "one, other = (v.ranking[0] for v in (first, second))\n"
        "print(one.name, one.posterior.ln_evidence, second.kind, other.posterior.ln_evidence, fit.name, value)"
    )
    notebook = executed("03_explain_a_recording.ipynb", said, monkeypatch, tmp_path)
    nearest, score, kind, higher, name, value = notebook.cells[-1].outputs[-1].text.split()
    assert (nearest, kind, name) == ("tether", "explained", "eddy_brake")
    assert float(higher) > float(score) + 5.0  # one number instead of six
    assert float(value) == pytest.approx(0.1, rel=0.03)


def test_the_committed_notebooks_hold_their_figures_and_stay_small():
    paths = sorted(NOTEBOOKS.glob("*.ipynb"))
    assert paths
    for path in paths:
        assert path.stat().st_size < 300_000
        notebook = nbformat.read(path, as_version=4)
        nbformat.validate(notebook)
        outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
        assert any("image/png" in output.get("data", {}) for output in outputs)
        assert not any(output.output_type == "error" for output in outputs)
