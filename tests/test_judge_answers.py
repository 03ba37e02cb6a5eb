"""The judge asks and scores: what counts as an answer, and what it is compared with."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest


def _service(judge, tmp_path, monkeypatch):
    """Stand in for the service that shares a GPU; returns the file where it notes its calls."""
    service = tmp_path / "bin" / judge.ask.SHARING
    service.parent.mkdir()
    calls = tmp_path / "calls"
    service.write_text(
        f'#!/bin/sh\n[ "$1" = -d ] && echo start${{CUDA_VISIBLE_DEVICES}} >> {calls} || cat >> {calls}\n'
    )
    service.chmod(0o755)
    monkeypatch.setenv("PATH", f"{service.parent}:{os.environ['PATH']}")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "5,3,1")
    monkeypatch.delenv("CUDA_MPS_PIPE_DIRECTORY", raising=False)
    monkeypatch.setattr(judge.ask, "SERVED", tmp_path / "none")
    return calls


@pytest.mark.skipif(sys.platform == "win32", reason="the service of the test is a shell script")
def test_ask_shares_workers_out_to_gpus_and_begins_with_what_takes_longest(judge, tmp_path, monkeypatch):
    setups = {"case-0": "", "case-1": "[[chamber]]", "case-2": "[[plane]]\n[[chamber]]", "case-3": "[[plane]]"}
    for name, setup in setups.items():
        (tmp_path / "batch" / "cases" / name).mkdir(parents=True)
        (tmp_path / "batch" / "cases" / name / "setup.toml").write_text(setup)
    tool, order = tmp_path / "tool.py", tmp_path / "order"
    tool.write_text(
        "import json, os, pathlib, sys, time\n"
        f"with open({str(order)!r}, 'a') as order: print(pathlib.Path(sys.argv[1]).name, file=order)\n"
        "time.sleep(0.2)\n"
        "out = pathlib.Path(sys.argv[3])\n"
        "out.mkdir()\n"
        "seen = {'gpu': os.environ['CUDA_VISIBLE_DEVICES'], 'pipe': os.environ['CUDA_MPS_PIPE_DIRECTORY']}\n"
        "(out / 'explanation.json').write_text(json.dumps({'verdict': 'nothing_missing', 'effects': [], **seen}))\n"
    )
    calls = _service(judge, tmp_path, monkeypatch)
    command, answers = f"{sys.executable} {tool}", tmp_path / "answers"
    judge.ask.ask(tmp_path / "batch", answers=answers, tool=command, workers=4, gpus=2)
    told = [json.loads(path.read_text()) for path in sorted(answers.rglob("explanation.json"))]
    assert sorted(found["gpu"] for found in told) == ["3", "3", "5", "5"]
    assert len({found["pipe"] for found in told}) == 1
    assert calls.read_text().split() == ["start", "quit"]
    order.unlink()
    monkeypatch.setenv("CUDA_MPS_PIPE_DIRECTORY", "served already")
    judge.ask.ask(tmp_path / "batch", answers=tmp_path / "served", tool=command, workers=2, gpus=1)
    assert calls.read_text().split() == ["start", "quit"]
    order.unlink()
    judge.ask.ask(tmp_path / "batch", answers=tmp_path / "one", tool=command, workers=1, gpus=1)
    assert order.read_text().split() == ["case-2", "case-1", "case-3", "case-0"]
    with pytest.raises(ValueError, match=r"gpus = 4: .* has 3"):
        judge.ask.ask(tmp_path / "batch", answers=tmp_path / "none", tool=command, workers=4, gpus=4)
    with pytest.raises(ValueError, match="gpus = 2: wanted 0 to workers = 1"):
        judge.ask.ask(tmp_path / "batch", answers=tmp_path / "none", tool=command, gpus=2)
    assert not (tmp_path / "none").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="the service of the test is a shell script")
def test_ask_asks_again_alone_what_a_fault_on_a_shared_gpu_has_ended(judge, tmp_path, monkeypatch):
    for name in ("case-0", "case-1", "case-2", "case-3"):
        (tmp_path / "batch" / "cases" / name / "heldout" / "a").mkdir(parents=True)
        (tmp_path / "batch" / "cases" / name / "heldout" / "a" / "trial.toml").write_text("")
        (tmp_path / "batch" / "cases" / name / "setup.toml").write_text("")
    tool = tmp_path / "tool.py"
    tool.write_text(
        "import json, os, pathlib, sys\n"
        "predicts, shared = sys.argv[1] == '--predict', 'CUDA_MPS_PIPE_DIRECTORY' in os.environ\n"
        "if predicts: case = pathlib.Path(sys.argv[2]).read_text()\n"
        "else: case, out = pathlib.Path(sys.argv[1]).name, pathlib.Path(sys.argv[3])\n"
        "if case == ('case-3' if predicts else 'case-1') and shared: sys.exit('CUDA_ERROR_ILLEGAL_ADDRESS')\n"
        "if predicts: sys.exit()\n"
        "if case == 'case-2': sys.exit('no such body')\n"
        "out.mkdir()\n"
        "(out / 'model.toml').write_text(case)\n"
        "found = {'verdict': 'nothing_missing', 'effects': [], 'shared': shared}\n"
        "(out / 'explanation.json').write_text(json.dumps(found))\n"
    )
    calls, answers = _service(judge, tmp_path, monkeypatch), tmp_path / "answers"
    asked = {"answers": answers, "tool": f"{sys.executable} {tool}", "gpus": 1}
    judge.ask.ask(tmp_path / "batch", workers=2, **asked)
    told = [json.loads((answers / f"case-{k}" / "explanation.json").read_text()) for k in range(4)]
    assert [found["verdict"] for found in told] == [*["nothing_missing"] * 2, "failed", "nothing_missing"]
    assert [found.get("shared") for found in told] == [True, False, None, False]
    assert not any("prediction_error" in found for found in told)
    assert calls.read_text().split() == ["start", "quit"]


def test_intervals_are_those_of_clopper_and_pearson(judge):
    low, high = judge.score.Rate(hits=18, of=30).interval
    assert (round(low, 2), round(high, 2)) == (0.41, 0.77)
    assert judge.score.Rate(hits=0, of=10).interval == (0.0, pytest.approx(0.3085, abs=1e-4))


def test_probabilities_are_compared_with_how_often_they_are_right(judge):
    def told(k, truth, likely, probability, **more):
        common = {"case": f"case-{k}", "specimen": "bar", "kind": "effect" if truth else "null", "length": 0.1}
        return judge.answers.Scored(
            **common, strength=3.0, truth=truth, verdict="explained", likely=likely, probability=probability, **more
        )

    rows = judge.score.table(
        [
            told(0, ("drag",), "drag", 0.9),
            told(1, ("drag",), "leak", 0.9),
            told(2, ("leak",), "leak", 0.5),
            told(3, (), "nothing", 1.0, priced_ratio=1.5, noise_ratio=0.9),
        ],
        1.0,
    )
    assert rows["names told with 0.8 to 1, right"].endswith("1/2")
    # In the fifth from 0.8 to 1 two of three are right where 2.8 were told, in that around 0.5 one where 0.5 was.
    error = rows["  expected calibration error of the most probable"]
    assert error == f"{(0.8 + 0.5) / 4:.2f} (4)"
    assert rows["own error, as told / real, nothing missing"].startswith("1.5 ")
    assert rows["noise, as told / real, where it is not stated"].startswith("0.9 ")


def test_the_track_record_of_names_is_found_again(judge):
    """Odds by which names are drawn that are wrong, and the calibration of names that were all told with one."""
    rng, record = np.random.default_rng(2), (0.15, 3.0)
    left = rng.exponential(0.3, 4000)
    known = [(1.0, bool(rng.random() > judge.track_record.doubt(x, *record)), float(x)) for x in left]
    found = judge.track_record.fitted(known)
    assert found == pytest.approx(record, rel=0.2)
    told = [(p * (1 - judge.track_record.doubt(x, *found)), r, x) for p, r, x in known]
    before, after = (float(judge.track_record.calibration(rows).split()[3][:-1]) for rows in (known, told))
    assert before > 0.2 and after < 0.03


def test_the_error_that_is_told_is_compared_with_that_of_the_sealed_trial(judge, tmp_path):
    folder, sealed = tmp_path / "answers" / "case-000", tmp_path / "sealed" / "case-000"
    time, place = np.linspace(0.0, 1.0, 5), np.zeros((5, 1, 3))
    clean = judge.experiment.Recording(time=time, value=place, names=("m1",), axes="xyz")
    for where, value in ((folder / "predicted.csv", place + 2e-4), (sealed / "clean.csv", place)):
        where.parent.mkdir(parents=True)
        judge.experiment.Recording(time=time, value=value, names=clean.names, axes="xyz").write(where)
    answer = {
        "verdict": "nothing_missing",
        "effects": [],
        "noise": {"simulation_m": 3e-4, "standard_deviation_m": 9e-5},
    }
    (folder / "explanation.json").write_text(json.dumps(answer))
    truth = {"case": "case-000", "specimen": "bar", "kind": "null", "strength": 0.0, "body_length_m": 0.1}
    found = judge.answers.match({**truth, "effects": [], "believed_heldout_rms_mm": 0.4}, folder.parent, tmp_path, {})
    assert found.priced_ratio == pytest.approx(1.5)
    assert found.noise_ratio is None  # older batches do not say
    for stated, ratio in (True, None), (False, pytest.approx(0.9)):
        camera = {"noise": 1e-4, "told": stated}
        asked = {**truth, "effects": [], "believed_heldout_rms_mm": 0.4, "measurement": camera}
        assert judge.answers.match(asked, folder.parent, tmp_path, {}).noise_ratio == ratio
    assert found.sealed_ratio == pytest.approx(0.5)
    # A prediction counts as a whole or not at all, whatever the order of its markers and with others beside them.
    read, write = judge.experiment.Recording.read, judge.experiment.Recording
    guess = read(folder / "predicted.csv")

    def ratio(time, value, names):
        write(time=time, value=value, names=names, axes="xyz").write(folder / "predicted.csv")
        whole = {**truth, "effects": [], "believed_heldout_rms_mm": 0.4, "axes": "xz"}
        return judge.answers.match(whole, folder.parent, tmp_path, {}).sealed_ratio

    more = np.concatenate([np.full_like(guess.value, 9.0), guess.value], 1)
    assert ratio(guess.time, more, ("other", "m1")) == pytest.approx(0.5)
    assert ratio(guess.time[:3], guess.value[:3], ("m1",)) is None
    assert ratio(guess.time, np.where(guess.time[:, None, None] == 0.5, np.nan, guess.value), ("m1",)) is None
    assert ratio(guess.time, guess.value, ("m2",)) is None
    (folder / "predicted.csv").write_text("")
    assert (
        judge.answers.match(
            {**truth, "effects": [], "believed_heldout_rms_mm": 0.4}, folder.parent, tmp_path, {}
        ).sealed_ratio
        is None
    )


def test_an_answer_of_another_form_counts_as_none(judge, tmp_path):
    clean = judge.experiment.Recording(time=np.arange(3.0), value=np.zeros((3, 1, 3)), names=("m1",), axes="xyz")
    clean.write(tmp_path / "sealed" / "case-000" / "clean.csv")
    effect = {"name": "drag", "parameters": {}, "location_m": None}
    truth = {"case": "case-000", "specimen": "bar", "kind": "effect", "strength": 3.0, "body_length_m": 0.1}
    truth |= {"effects": [effect], "believed_heldout_rms_mm": 0.4}
    path = tmp_path / "answers" / "case-000" / "explanation.json"
    path.parent.mkdir(parents=True)
    for text in ("[]", "{", '{"verdict": "perhaps"}', '{"verdict": "explained", "effects": [{"parameters": {}}]}'):
        path.write_text(text)
        assert judge.answers.match(truth, path.parent.parent, tmp_path, {}).verdict == "failed"
    pair = {"verdict": "cannot_distinguish", "set": ["drag + leak", "leak"], "probabilities": {"b + a": 1.0}}
    path.write_text(json.dumps(pair))
    found = judge.answers.match(truth, path.parent.parent, tmp_path, {"effects": {"a": "drag", "b": "leak"}})
    assert found.set == ("drag", "leak") and found.likely == "drag + leak"


def test_an_interrupted_ask_keeps_no_answer_and_ends_its_tools(judge, tmp_path):
    for name in ("case-0", "case-1", "case-2"):
        (tmp_path / "batch" / "cases" / name).mkdir(parents=True)
        (tmp_path / "batch" / "cases" / name / "setup.toml").write_text("")
    tool = tmp_path / "tool.py"
    tool.write_text(
        "import os, pathlib, sys, time\n"
        f"pathlib.Path({str(tmp_path)!r}, f'pid-{{os.getpid()}}').write_text('')\n"
        "time.sleep(60)\n"
    )
    command = [sys.executable, judge.ask.__file__, str(tmp_path / "batch"), "--answers", str(tmp_path / "answers")]
    asking = subprocess.Popen(
        [*command, "--tool", f"{sys.executable} {tool}", "--workers", "2"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        for _ in range(600):
            if len(begun := list(tmp_path.glob("pid-*"))) == 2:
                break
            time.sleep(0.05)
        asking.send_signal(signal.SIGTERM)
        assert asking.wait(timeout=30) != 0
    finally:
        asking.kill()
    assert len(begun) == 2 and begun == list(tmp_path.glob("pid-*"))
    assert not list((tmp_path / "answers").rglob("explanation.json"))
    for path in begun:
        with pytest.raises(ProcessLookupError):
            os.kill(int(path.name.removeprefix("pid-")), 0)


def test_further_arguments_are_those_of_both_commands(judge, tmp_path):
    case = tmp_path / "batch" / "cases" / "case-0"
    (case / "heldout" / "c").mkdir(parents=True)
    (case / "heldout" / "c" / "trial.toml").write_text("")
    (case / "setup.toml").write_text("")
    tool = tmp_path / "tool.py"
    tool.write_text(
        "import pathlib, sys\n"
        "out = pathlib.Path(sys.argv[sys.argv.index('--out') + 1])\n"
        "if '--predict' in sys.argv:\n"
        "    out.write_text(' '.join(sys.argv[-2:]))\n"
        "else:\n"
        "    out.mkdir()\n"
        "    (out / 'model.toml').write_text('')\n"
        "    (out / 'explanation.json').write_text('{\"verdict\": \"' + ' '.join(sys.argv[-2:]) + '\"}')\n"
    )
    command = f"{sys.executable} {tool}"
    judge.ask.ask(tmp_path / "batch", answers=tmp_path / "answers", tool=command, extra="--device cuda")
    answer = tmp_path / "answers" / "case-0"
    assert json.loads((answer / "explanation.json").read_text())["verdict"] == "--device cuda"
    assert (answer / "predicted.csv").read_text() == "--device cuda"


def test_ask_takes_what_is_no_explanation_for_a_failure(judge, tmp_path):
    (tmp_path / "batch" / "cases" / "case-0").mkdir(parents=True)
    (tmp_path / "batch" / "cases" / "case-0" / "setup.toml").write_text("")
    tool = tmp_path / "tool.py"
    tool.write_text(
        "import pathlib, sys\n"
        "out = pathlib.Path(sys.argv[3])\n"
        "out.mkdir()\n"
        "(out / 'explanation.json').write_text('[1]')\n"
    )
    judge.ask.ask(tmp_path / "batch", answers=tmp_path / "answers", tool=f"{sys.executable} {tool}")
    found = json.loads((tmp_path / "answers" / "case-0" / "explanation.json").read_text())
    assert found["verdict"] == "failed" and "without a verdict" in found["error"]
    with pytest.raises(ValueError, match=r"tool = 'no-such-tool': wanted a command line that begins with a program"):
        judge.ask.ask(tmp_path / "batch", answers=tmp_path / "answers", tool="no-such-tool")


def test_ask_follows_a_batch_that_is_still_being_made(judge, tmp_path, monkeypatch):
    batch, answers = tmp_path / "batch", tmp_path / "answers"
    monkeypatch.setattr(judge.ask, "LOOK", 0.05)

    def made(name: str) -> None:
        (batch / "cases" / name).mkdir(parents=True)
        (batch / "cases" / name / "setup.toml").write_text("")

    def answered(case, *_):
        # What is made next is there by halves while the first one is answered, and whole once it is.
        if case.name == "case-1":
            made("case-0")
            threading.Timer(0.3, lambda: (batch / "sealed" / "case-0.json").write_text("{}")).start()
            threading.Timer(0.6, lambda: (batch / "truth.sealed").write_text("{}")).start()
        else:
            assert (batch / "sealed" / "case-0.json").exists()
        (answers / case.name).mkdir()
        (answers / case.name / "explanation.json").write_text("{}")
        return {"verdict": "nothing_missing", "judge_seconds": 0.0}

    with pytest.raises(ValueError, match=r"wanted a folder with sealed/seed.json, made by seal.py"):
        judge.ask.ask(batch, answers=answers, tool="true", follow=True)
    made("case-1")
    (batch / "sealed").mkdir()
    (batch / "sealed" / "seed.json").write_text('{"counts": [1, 1, 0, 0]}')
    (batch / "sealed" / "case-1.json").write_text("{}")
    monkeypatch.setattr(judge.ask, "answer", answered)
    judge.ask.ask(batch, answers=answers, tool="true", follow=True)
    assert sorted(path.name for path in answers.glob("case-*")) == ["case-0", "case-1"]
