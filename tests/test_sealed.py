"""Five small sealed cases, explained without their truth and scored with it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from torchsoro.sim2real.pipeline import Options, explain

BATCH = Path(__file__).parent / "judged"
RECIPES = Path(__file__).parents[1] / "recipes"


def half(case: Path, folder: Path) -> Path:
    """A copy of a case whose trials last half as long, which is enough to tell its effect."""
    copy = Path(shutil.copytree(case, folder))
    setup = copy / "setup.toml"
    setup.write_text(setup.read_text().replace("duration = 1.0", "duration = 0.5"))
    return copy


@pytest.mark.slow
def test_density_of_a_sealed_case_is_found_among_three_effects(tmp_path):
    copy = half(BATCH / "cases" / "case-111", tmp_path / "case")
    for trial in sorted((copy / "trials").iterdir())[1:]:  # one is enough to tell these three apart
        shutil.rmtree(trial)
    effects = ("density", "drag", "gravity_tilt")
    found = explain(Options(experiment=copy, out=tmp_path / "out", budget=0.5, effects=effects))
    answer = json.loads((tmp_path / "out" / "explanation.json").read_text())
    assert (found.verdict.kind, answer["set"]) == ("explained", ["density"])
    assert (tmp_path / "out" / "report.html").exists()


@pytest.mark.slow
def test_sealed_cases_are_explained_in_a_copy_and_scored(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(RECIPES / "judge")
    import explain
    import score

    for case in sorted((BATCH / "cases").iterdir()):
        copy, answer = tmp_path / case.name, tmp_path / "answers" / case.name
        half(case, copy)
        explain.main(explain.Options(experiment=copy, out=answer, budget=0.5))
        trial = copy / "heldout" / "d" / "trial.toml"
        explain.main(explain.Options(predict=answer / "model.toml", trial=trial, out=answer / "predicted.csv"))
    table = score.score(BATCH, answers=(f"tool={tmp_path / 'answers'}",))["tool"]
    assert table["false alarms, nulls and decoys (<= 10 %)"].endswith(" 0/2")
    assert table["right name when it commits, strong (>= 80 %)"].endswith(" 2/2")
    assert table["outside the library: unknown (>= 60 %)"].endswith(" 1/1")
    assert float(table["held-out after / before, sealed trial"].split()[0]) < 0.4
    assert float(table["parameter error, median (<= 25 %)"].split()[0]) < 25.0
