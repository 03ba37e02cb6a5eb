"""Have every case of a batch explained, in a copy that holds nothing else, and note the hashes of the answers.

    python recipes/judge/ask.py runs/judge/test --answers runs/judge/answers --tool "python recipes/explain.py"

Runs ``TOOL CASE --out DIR`` and then, where it left a model.toml, ``TOOL --predict DIR/model.toml --trial TRIAL.toml
--out CSV`` for the trial whose markers stay sealed. Interrupted, the same command goes on; an answer is never asked
for twice.
"""

from __future__ import annotations

import concurrent.futures
import hashlib
import json
import shlex
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import tyro
from tqdm import tqdm


def _call(command: list[str], timeout: float) -> str:
    """Run; returns what went wrong, or nothing."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)
    except subprocess.TimeoutExpired:
        return f"took more than {timeout:.0f} s"
    return "" if done.returncode == 0 else f"exit {done.returncode}: {(done.stderr or done.stdout)[-800:]}"


def answer(case: Path, tool: list[str], answers: Path, timeout: float, extra: list[str]) -> dict[str, Any]:
    """One case; returns its explanation, or the verdict "failed" with the reason."""
    with tempfile.TemporaryDirectory() as folder:
        copy, out = Path(folder) / case.name, Path(folder) / "answer"
        shutil.copytree(case, copy)
        started = time.perf_counter()
        wrong = _call([*tool, str(copy), "--out", str(out), *extra], timeout)
        path = out / "explanation.json"
        if not wrong and not path.exists():
            wrong = "wrote no explanation.json"
        found: dict[str, Any] = {"verdict": "failed", "error": wrong, "effects": []}
        if not wrong:
            found = json.loads(path.read_text())
        found["judge_seconds"] = time.perf_counter() - started
        target = answers / case.name
        part = answers / f"{case.name}.part"
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        if (out / "model.toml").exists():
            shutil.copy(out / "model.toml", part / "model.toml")
            trials = sorted(copy.glob("heldout/*/trial.toml"))
            for trial in trials[:1]:
                csv = part / "predicted.csv"
                model = str(out / "model.toml")
                wrong = _call([*tool, "--predict", model, "--trial", str(trial), "--out", str(csv)], timeout)
                if wrong:
                    found["prediction_error"] = wrong
        (part / "explanation.json").write_text(json.dumps(found, indent=1))
        part.rename(target)
    return found


def ask(
    batch: Path,
    /,
    *,
    answers: Path,
    tool: str = "python recipes/explain.py",
    extra: str = "",
    workers: int = 1,
    timeout: float = 3600,
) -> str:
    """Ask for what has no answer yet.

    Args:
        batch: Folder that seal.py made.
        answers: Folder for the answers, one for each tool or baseline.
        tool: Command line.
        extra: Further arguments.
        workers: Cases side by side; with more than one, tell the tool to use one thread (``--extra``).
        timeout: For one command [s].

    Returns:
        SHA-256 over all answers.
    """
    if not (batch / "cases").is_dir():
        raise ValueError(f"batch = {batch}: wanted a folder with cases/, made by seal.py")
    cases = sorted((batch / "cases").iterdir())
    todo = [case for case in cases if not (answers / case.name / "explanation.json").exists()]
    answers.mkdir(parents=True, exist_ok=True)
    print(f"{len(cases)} cases, {len(cases) - len(todo)} of them answered already", flush=True)
    with concurrent.futures.ThreadPoolExecutor(workers) as pool:
        jobs = {
            pool.submit(answer, case, shlex.split(tool), answers, timeout, shlex.split(extra)): case.name
            for case in todo
        }
        with tqdm(total=len(cases), initial=len(cases) - len(todo), unit="case", smoothing=0) as bar:
            for job in concurrent.futures.as_completed(jobs):
                found = job.result()
                reason = f" ({found['error'][:200]})" if found["verdict"] == "failed" else ""
                bar.write(f"{jobs[job]}: {found['verdict']} in {found['judge_seconds']:.0f} s{reason}")
                bar.update()
    lines = [
        f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.relative_to(answers)}"
        for path in sorted(answers.rglob("*"))
        if path.is_file() and path.name != "answers.sha256"
    ]
    text = "\n".join(lines) + "\n"
    (answers / "answers.sha256").write_text(text)
    digest = hashlib.sha256(text.encode()).hexdigest()
    print(f"SHA-256 of answers.sha256: {digest}")
    return digest


if __name__ == "__main__":
    tyro.cli(ask)
