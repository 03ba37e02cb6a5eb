"""Have every case of a batch explained, in a copy that holds nothing else, and note the hashes of the answers.

    python recipes/judge/ask.py runs/judge/test --answers runs/judge/answers --tool "python recipes/explain.py"
    python recipes/judge/ask.py BATCH --answers ANSWERS --gpus 4 --workers 32 --extra="--device cuda --threads 2"

Runs ``TOOL CASE --out DIR EXTRA`` and then, where it left a model.toml, ``TOOL --predict DIR/model.toml --trial
TRIAL.toml --out CSV EXTRA`` for the trial whose markers stay sealed. Interrupted, the same command goes on; an answer
is never asked for twice.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import hashlib
import json
import os
import queue
import shlex
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import tyro
from tqdm import tqdm

SHARING = "nvidia-cuda-mps-control"
"""NVIDIA's multi-process service; without it the processes on a GPU take turns, and small kernels leave it idle."""

SERVED = Path("/tmp/nvidia-mps/control")
"""Where it is while somebody else's runs, unless told otherwise."""

PIPE = "CUDA_MPS_PIPE_DIRECTORY"
"""Variable by which a process finds it."""

SEED = "sealed/seed.json"
"""Of a batch, with how many cases it will have."""

LOOK = 5.0
"""Time between two looks for cases that have been made [s]."""

STOPPED = threading.Event()
"""Set once a run is interrupted: what the tools have not answered by then is asked for the next time."""


class Interrupted(Exception):
    """The run ends before this case has its answer."""


def _call(command: list[str], timeout: float, variables: dict[str, str]) -> str:
    """Run; returns what went wrong, or nothing.

    Raises:
        Interrupted: if the run ends before the command does.
    """
    surroundings, end = {**os.environ, **variables}, time.monotonic() + timeout
    # In a session of its own: Ctrl-C is no answer of the tool, and what it starts ends with it.
    tool = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=surroundings, start_new_session=True
    )
    while True:
        try:
            said, wrong = tool.communicate(timeout=min(1.0, max(end - time.monotonic(), 0.01)))
            return "" if tool.returncode == 0 else f"exit {tool.returncode}: {(wrong or said)[-800:]}"
        except subprocess.TimeoutExpired:
            if not STOPPED.is_set() and time.monotonic() < end:
                continue
        with contextlib.suppress(ProcessLookupError):
            os.killpg(tool.pid, signal.SIGKILL)
        tool.communicate()
        if STOPPED.is_set():
            raise Interrupted
        return f"took more than {timeout:.0f} s"


def _read(path: Path) -> dict[str, Any]:
    """An explanation, or the verdict "failed" with what is wrong with it."""
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        return {"verdict": "failed", "error": f"explanation.json: {error}", "effects": []}
    if not isinstance(found, dict) or not isinstance(found.get("verdict"), str):
        return {"verdict": "failed", "error": "explanation.json: without a verdict", "effects": []}
    return found


@contextlib.contextmanager
def _shared(gpus: int, workers: int) -> Iterator[dict[str, str]]:
    """The multi-process service, where several workers share a GPU; yields the variables by which they find it."""
    served = PIPE in os.environ or SERVED.exists()
    if workers <= gpus or not gpus or served:
        yield {}
        return
    if shutil.which(SHARING) is None:
        print(f"{SHARING} is not installed: the workers on a GPU take turns, which is several times slower", flush=True)
        yield {}
        return
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        variables = {PIPE: f"{folder}/pipe", "CUDA_MPS_LOG_DIRECTORY": f"{folder}/log"}
        surroundings = {**os.environ, **variables}
        surroundings.pop("CUDA_VISIBLE_DEVICES", None)  # by which it would number the GPUs anew
        for name in variables.values():
            Path(name).mkdir()
        # A daemon keeps what it is given as its output, so that nobody may wait for the end of that.
        begun = subprocess.run(
            [SHARING, "-d"], env=surroundings, check=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        if begun.returncode:
            print(f"{SHARING} -d: exit {begun.returncode}, so that the workers on a GPU take turns", flush=True)
            yield {}
            return
        try:
            yield variables
        finally:
            with contextlib.suppress(subprocess.TimeoutExpired):
                subprocess.run([SHARING], input="quit\n", text=True, env=surroundings, check=False, timeout=60)


def _devices(gpus: int, workers: int) -> list[str]:
    """Which GPU each of the workers uses, as ``CUDA_VISIBLE_DEVICES``; empty where the tool is left to choose."""
    if gpus < 0 or gpus > workers:
        raise ValueError(f"gpus = {gpus}: wanted 0 to workers = {workers}")
    given = os.environ.get("CUDA_VISIBLE_DEVICES")
    names = [str(gpu) for gpu in range(gpus)] if given is None else [name for name in given.split(",") if name.strip()]
    if gpus > len(names):
        raise ValueError(f"gpus = {gpus}: CUDA_VISIBLE_DEVICES = {given} has {len(names)}")
    return [names[worker % gpus] for worker in range(workers)] if gpus else [""] * workers


def _whole(batch: Path) -> list[Path]:
    """Cases of a batch that is being made whose truth is written, so that they are whole."""
    cases = sorted((batch / "cases").glob("*"))
    return [case for case in cases if (batch / "sealed" / f"{case.name}.json").exists()]


def _rank(case: Path) -> int:
    """How long an answer may take, by rank: a robot's mesh, a chamber and a plane each make it longer."""
    setup = (case / "setup.toml").read_text()
    return ("[[plane]]" in setup) + ("[[chamber]]" in setup) + (case / "body.stl").exists()


def _faulted(wrong: str, variables: dict[str, str]) -> bool:
    """Whether a fault on a shared GPU has ended a process, maybe another one's."""
    return "CUDA" in wrong and PIPE in variables


def answer(
    case: Path,
    tool: list[str],
    answers: Path,
    timeout: float,
    extra: list[str],
    variables: dict[str, str] | None = None,
) -> dict[str, Any]:
    """One case; returns its explanation, or the verdict "failed" with the reason.

    A fault on a shared GPU ends the processes of all that share it. It is no answer, and none is written.

    Raises:
        Interrupted: if the run ends before; nothing is kept of the answer then.
    """
    variables = variables or {}
    with tempfile.TemporaryDirectory() as folder:
        copy, out = Path(folder) / case.name, Path(folder) / "answer"
        shutil.copytree(case, copy)
        started = time.perf_counter()
        wrong = _call([*tool, str(copy), "--out", str(out), *extra], timeout, variables)
        found: dict[str, Any] = {"verdict": "failed", "error": wrong, "effects": []}
        if not wrong:
            found = _read(out / "explanation.json")
        elif _faulted(wrong, variables):
            return found
        found["judge_seconds"] = time.perf_counter() - started
        target = answers / case.name
        part = answers / f"{case.name}.part"
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        if (out / "model.toml").exists():
            shutil.copy(out / "model.toml", part / "model.toml")
            trials = sorted(copy.glob("heldout/*/trial.toml"))
            for trial in trials[:1]:
                asked = ["--predict", str(out / "model.toml"), "--trial", str(trial)]
                asked += ["--out", str(part / "predicted.csv"), *extra]
                wrong = _call([*tool, *asked], timeout, variables)
                if _faulted(wrong, variables):
                    shutil.rmtree(part)
                    return found
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
    gpus: int = 0,
    follow: bool = False,
    timeout: float = 3600,
) -> str:
    """Ask for what has no answer yet.

    Args:
        batch: Folder that seal.py made.
        answers: Folder for the answers, one for each tool or baseline.
        tool: Command line.
        extra: Further arguments, of both commands.
        workers: Cases side by side; with more than one, tell the tool to use one thread (``--extra``). What may
            take longest is begun first.
        gpus: Share the workers out to so many GPUs of this machine, and let those on one GPU compute side by side by
            NVIDIA's multi-process service where it is installed (started and ended here, unless it runs); tell the
            tool to use them (``--extra="--device cuda"``).
        follow: Ask for each case of a batch that is still being made as soon as it is whole, until all are.
        timeout: For one command [s].

    Returns:
        SHA-256 over all answers.

    Raises:
        ValueError: If the batch is none, the tool is no program, or there are fewer workers than ``gpus``, or fewer in
            CUDA_VISIBLE_DEVICES.
    """
    STOPPED.clear()
    if not (batch / (SEED if follow else "cases")).exists():
        raise ValueError(f"batch = {batch}: wanted a folder with {SEED if follow else 'cases/'}, made by seal.py")
    if not (command := shlex.split(tool)) or shutil.which(command[0]) is None:
        raise ValueError(f"tool = {tool!r}: wanted a command line that begins with a program")
    _devices(gpus, workers)
    there = _whole(batch) if follow else sorted((batch / "cases").iterdir())
    planned = sum(json.loads((batch / SEED).read_text())["counts"]) if follow else len(there)
    answers.mkdir(parents=True, exist_ok=True)
    known = sum((answers / case.name / "explanation.json").exists() for case in there)
    print(f"{planned} cases, {known} of them answered already", flush=True)
    with tqdm(total=planned, initial=known, unit="case", smoothing=0) as bar:
        begun: set[Path] = set()

        def waiting() -> list[Path]:
            """What is to be begun, the longest first."""
            cases = [case for case in (_whole(batch) if follow else there) if case not in begun]
            return sorted((case for case in cases if not (answers / case.name).exists()), key=_rank, reverse=True)

        def each(workers: int) -> None:
            """Ask for these, and for what is made meanwhile."""
            free: queue.SimpleQueue[str] = queue.SimpleQueue()
            for device in _devices(gpus, workers):
                free.put(device)

            def answered(case: Path) -> dict[str, Any]:
                device = free.get()
                variables = {**sharing, **({"CUDA_VISIBLE_DEVICES": device} if device else {})}
                try:
                    return answer(case, command, answers, timeout, shlex.split(extra), variables)
                finally:
                    free.put(device)

            running: dict[concurrent.futures.Future[dict[str, Any]], Path] = {}
            with _shared(gpus, workers) as sharing, concurrent.futures.ThreadPoolExecutor(workers) as pool:
                try:
                    while True:
                        made = not follow or (batch / "truth.sealed").exists()  # before the cases are counted
                        for case in waiting()[: workers - len(running)] if len(running) < workers else ():
                            begun.add(case)
                            running[pool.submit(answered, case)] = case
                        if not running and made:
                            break
                        if not running:
                            time.sleep(LOOK)
                        for job in concurrent.futures.wait(running, LOOK, concurrent.futures.FIRST_COMPLETED).done:
                            case, found = running.pop(job), job.result()
                            reason = f" ({found.get('error', '')[:200]})" if found["verdict"] == "failed" else ""
                            if (answers / case.name).exists():
                                bar.write(f"{case.name}: {found['verdict']} in {found['judge_seconds']:.0f} s{reason}")
                                bar.update()
                            else:
                                bar.write(f"{case.name}: asked again, as a fault has ended what shared its GPU{reason}")
                except BaseException:
                    STOPPED.set()
                    pool.shutdown(wait=True, cancel_futures=True)
                    raise

        each(workers)
        if left := {case for case in begun if not (answers / case.name).exists()}:
            begun -= left
            each(gpus)
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
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as by Ctrl-C: the tools and NVIDIA's service are ended
    tyro.cli(ask)
