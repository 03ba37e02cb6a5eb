"""Five small sealed cases, explained without their truth and scored with it."""

from __future__ import annotations

import shutil
from pathlib import Path

BATCH = Path(__file__).parent / "judged"
RECIPES = Path(__file__).parents[1] / "recipes"


def test_sealed_cases_are_explained_in_a_copy_and_scored(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(RECIPES / "judge")
    import explain
    import score

    for case in sorted((BATCH / "cases").iterdir()):
        copy, answer = tmp_path / case.name, tmp_path / "answers" / case.name
        shutil.copytree(case, copy)
        setup = copy / "setup.toml"
        # The first half is enough, in half the time.
        setup.write_text(setup.read_text().replace("duration = 1.0", "duration = 0.5"))
        explain.main(explain.Options(experiment=copy, out=answer, budget=0.5))
        trial = copy / "heldout" / "d" / "trial.toml"
        explain.main(explain.Options(predict=answer / "model.toml", trial=trial, out=answer / "predicted.csv"))
    table = score.score(BATCH, answers=(f"tool={tmp_path / 'answers'}",))["tool"]
    assert table["false alarms, nulls and decoys (<= 10 %)"].endswith(" 0/2")
    assert table["right name when it commits, strong (>= 80 %)"].endswith(" 2/2")
    assert table["outside the library: unknown (>= 60 %)"].endswith(" 1/1")
    assert float(table["held-out after / before, sealed trial"].split()[0]) < 0.4
    assert float(table["parameter error, median (<= 25 %)"].split()[0]) < 25.0
