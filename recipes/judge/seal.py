"""Make sealed cases: recordings whose cause is written down where who explains them cannot look.

    python recipes/judge/seal.py --out runs/judge/test --batch test --effects 60 --nulls 60 --pairs 10 --outside 12 \
        --seed-from-os
    python recipes/judge/seal.py --out runs/judge/calibration --batch calibration ...   # to tune on; disjoint seeds

Writes OUT/cases/<id>/, which may be shown, OUT/truth.sealed and its SHA-256, and OUT/sealed/ with the recordings of the
held-out trials. Each motion is a job of its own, and kept until its case is made, as soon as all its motions are there:
processes end together, and, interrupted, the same command goes on. What is always there and never counts as physics:
the modulus may be off by 10 %, the pressure by 5 %, beside clock, scale, frame, marker places, noise and losses. The
effect "modulus" is at least 25 %. Half of the nulls are decoys: errors of measurement larger than stated.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import multiprocessing
import os
import secrets
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from believed import believed_motion
from camera import DECOYS, film, instants
from effects import LIBRARY, OUTSIDE
from lobatto import Floats
from march import Broken
from motions import MOTIONS, Job, Motion, Plan, by_gpu, draws, motions_of, needed
from specimens import FORMER, SPECIMENS, Specimen, mesh_for
from visible import detectability
from world import Line, World

Body = Literal["bar", "finger", "pad", "slider", "post", "crawler", "block", "robot"]
BATCHES = ("calibration", "test", "smoke")
BELIEVED = "sealed/believed"  # folder of motions as believed, which cases share


def plans(
    effects: int, nulls: int, pairs: int, outside: int, rng: np.random.Generator, every: Sequence[str] = FORMER
) -> list[Plan]:
    """A shuffled list in which the specimens ``every`` and names come about equally often."""
    found: list[dict[str, Any]] = []
    names = sorted(name for name in LIBRARY if any(name in SPECIMENS[s]().effects for s in every))
    unknown = [name for name in OUTSIDE if any(name in SPECIMENS[s]().outside for s in every)]
    for i in range(effects):
        if i % len(names) == 0:
            rng.shuffle(names)
        name = names[i % len(names)]
        able = [s for s in every if name in SPECIMENS[s]().effects]
        found.append({"kind": "effect", "specimen": str(rng.choice(able)), "effects": (name,)})
    for i in range(nulls):
        kind = DECOYS[i // 2 % len(DECOYS)] if i % 2 else ""
        found.append({"kind": "decoy" if kind else "null", "specimen": every[i % len(every)], "decoy": kind})
    for i in range(pairs):
        specimen = every[i % len(every)]
        able = sorted(set(SPECIMENS[specimen]().effects))
        first, second = rng.choice(able, 2, replace=False)
        both = sorted((str(first), str(second)), key=lambda name: name != "modulus")  # others are relative to it
        found.append({"kind": "pair", "specimen": specimen, "effects": tuple(both)})
    for i in range(outside):
        name = unknown[i % len(unknown)]
        able = [s for s in every if name in SPECIMENS[s]().outside]
        found.append({"kind": "outside", "specimen": str(rng.choice(able)), "effects": (name,)})
    order = rng.permutation(len(found))
    return [Plan(name=f"case-{n:03d}", **found[i]) for n, i in enumerate(order)]


def unsure(specimen: Specimen, times: dict[int, Floats], finer: float, kept: Path) -> list[list[Floats]]:
    """What each trial changes by if the modulus is 5 % higher, and, with a chamber, the pressure 3 %."""
    plain, *others = _expected(specimen)
    return [
        [
            believed_motion(specimen.name, i, world, finer, kept)(t)
            - believed_motion(specimen.name, i, plain, finer, kept)(t)
            for i, t in times.items()
        ]
        for world in others
    ]


def _expected(specimen: Specimen) -> list[World]:
    """What is believed, and that with what is never known well a little off."""
    worlds = [World(), World(modulus=1.05)]
    if "chamber" in specimen.setup:
        worlds.append(World(line=Line(gain=1.03)))
    return worlds


def make(plan: Plan, seed: list[int], out: Path, finer: float = 1.0) -> dict[str, Any]:
    """Simulate, film and write one case; returns its truth."""
    rng = np.random.default_rng(seed)
    specimen = SPECIMENS[plan.specimen]()
    started = time.perf_counter()
    for draw in draws(plan, specimen, rng):
        errors, bare, drawn = draw.errors, draw.bare, draw.effects
        try:
            moved = [[m.markers() for m in world] for world in motions_of(plan, draw, finer, out / MOTIONS)]
            runs, plain = moved[0], moved[-1]
            break
        except Broken:
            continue
    else:
        raise RuntimeError(f"{plan.name}: all draws of {plan.effects} on {plan.specimen} turned inside out")
    folder, kept, common = out / "cases" / plan.name, out / "sealed" / plan.name, out / BELIEVED
    folder.mkdir(parents=True, exist_ok=True)
    kept.mkdir(parents=True, exist_ok=True)
    recording = dict(specimen.setup["recording"])
    if errors.told:
        recording["noise"] = float(f"{errors.noise:.2g}")
    specimen.write(folder, recording)
    count, trials, believed = len(errors.places), {}, 0.0
    for trial, moved, still in zip(specimen.trials, runs, plain, strict=True):
        told, _ = instants(specimen, errors, trial.name)
        record = film(specimen, errors, told, moved[:, :count], rng)
        axes = ["xyz".index(a) for a in record.axes]
        place = folder / ("heldout" if trial.held_out else "trials") / trial.name
        trial.write(place)
        record.write((kept if trial.held_out else place) / "markers.csv")
        if trial.held_out:
            # Free of measurement errors: what a perfect prediction for the stated markers and true times is.
            true = instants(specimen, errors, trial.name)[1]
            replace(record, time=true, value=moved[:, count:], axes="xyz").write(kept / "clean.csv")
            if not trial.tables:
                (place / "trial.toml").write_text("# as in setup.toml\n")
            guess = believed_motion(plan.specimen, len(specimen.trials) - 1, World(), finer, common)(true)
            believed = np.sqrt(np.mean((guess - moved[:, count:])[..., axes] ** 2))
        effect = float(np.sqrt(np.mean((moved - still)[:, :count, axes] ** 2)))
        trials[trial.name] = {
            "held_out": trial.held_out,
            "rms_effect_mm": 1e3 * effect,
            "effect_over_noise": effect / errors.noise,
            "motion_rms_mm": 1e3 * float(np.sqrt(np.mean((moved - moved[0])[:, :count, axes] ** 2))),
        }
    visible = 0.0
    if drawn:
        given = [i for i, t in enumerate(specimen.trials) if not t.held_out]
        times = {i: instants(specimen, errors, specimen.trials[i].name)[1] for i in given}
        visible = detectability(
            specimen,
            list(times.values()),
            [(runs[i] - plain[i])[:, :count] for i in given],
            [plain[i][:, :count] for i in given],
            unsure(specimen, times, finer, common),
            errors.noise,
        )
    young = specimen.setup["material"]["youngs_modulus"]
    return {
        "case": plan.name,
        "kind": plan.kind,
        "specimen": plan.specimen,
        "body_length_m": specimen.length,
        "axes": "".join(specimen.setup["recording"].get("axes", "xyz")),
        "effects": [e.table() for e in drawn],
        "expected_verdict": {"null": "nothing_missing", "decoy": "nothing_missing", "outside": "unknown_physics"}.get(
            plan.kind, "explained"
        ),
        "decoy": plan.decoy,
        "strength": visible,
        "nuisance": {"youngs_modulus": young * bare.modulus, "pressure_gain": bare.line.gain},
        "measurement": errors.table(),
        "trials": trials,
        "believed_heldout_rms_mm": 1e3 * float(believed),
        "seconds": time.perf_counter() - started,
    }


def _work(job: Job) -> str:
    plan, seed, out, finer = job
    target = out / "sealed" / f"{plan.name}.json"
    truth = make(plan, seed, out, finer)
    part = target.with_suffix(".part")
    part.write_text(json.dumps(truth, indent=1))
    part.rename(target)
    for motion in needed(job):
        motion.path.unlink(missing_ok=True)
    return f"{plan.name} done in {truth['seconds']:.0f} s"


def _simulate(job: tuple[str, int, World, float, Path]) -> str:
    name, number, world, finer, kept = job
    believed_motion(name, number, world, finer, kept)
    return f"{name}: motion {number} as believed"


def _one(motion: Motion) -> str:
    with contextlib.suppress(Broken):
        motion.markers()
    return f"{motion.body}: motion {motion.number}"


class _Here(Executor):
    """Does what it is given at once, in this process."""

    def submit(self, what: Callable[..., Any], /, *args: Any, **more: Any) -> Future[Any]:
        done: Future[Any] = Future()
        done.set_result(what(*args, **more))
        return done


def _made(
    pool: Executor, processes: int, believed: Sequence[tuple[str, int, World, float, Path]], jobs: Sequence[Job]
) -> Iterator[str]:
    """Make what is believed, all motions, and each case as soon as its own are there; tells what is done."""
    todo: deque[tuple[int, Callable[..., str], Any]] = deque((-1, _simulate, one) for one in believed)
    first = [[m for m in needed(job) if not m.path.exists()] for job in jobs]
    todo += [(k, _one, m) for k, motions in enumerate(first) for m in motions]
    count, simulated, every = [len(motions) for motions in first], 0, sum(map(len, first))
    todo.extendleft((k, _work, jobs[k]) for k, motions in enumerate(first) if not motions)
    running: dict[Future[str], tuple[int, Callable[..., str]]] = {}
    while todo or running:
        while todo and len(running) < processes:
            k, what, given = todo.popleft()
            running[pool.submit(what, given)] = k, what
        for done in wait(running, return_when=FIRST_COMPLETED).done:
            k, what = running.pop(done)
            if what is not _one:
                yield done.result()
                continue
            simulated += 1
            yield f"{done.result()}, {simulated} of {every}"
            count[k] -= 1
            if not count[k]:
                # A draw that turns out broken is followed by another.
                more = [m for m in needed(jobs[k]) if not m.path.exists()]
                count[k], every = len(more), every + len(more)
                todo.extendleft([(k, _one, m) for m in more] or [(k, _work, jobs[k])])


def _lasting(name: str, finer: float) -> float:
    """Of a trial, in proportion: elements by steps."""
    mesh = mesh_for(name, finer)
    return len(mesh.cells) * SPECIMENS[name]().setup["duration"] * finer / SPECIMENS[name]().edge


def _wanted(
    out: Path, batch: str, seed: int | None, counts: tuple[int, ...], finer: float, bodies: Sequence[str]
) -> dict[str, Any]:
    """The settings of an interrupted batch, which must be these, or new ones."""
    path = out / "sealed" / "seed.json"
    if path.exists():
        before = json.loads(path.read_text())
        before.setdefault("bodies", list(FORMER))
        now = {"batch": batch, "counts": list(counts), "finer": finer, "bodies": list(bodies)}
        differ = [k for k, v in now.items() if before[k] != v]
        if differ or (seed is not None and seed != before["seed"]):
            raise ValueError(f"out = {out}: holds a batch with other settings ({', '.join(differ) or 'seed'}); "
                             "wanted the same or an empty folder")  # fmt: skip
        return before
    if seed is None:
        raise ValueError("seed = None: wanted --seed NUMBER or --seed-from-os")
    path.parent.mkdir(parents=True, exist_ok=True)
    now = {"batch": batch, "seed": seed, "counts": list(counts), "finer": finer, "bodies": list(bodies)}
    path.write_text(json.dumps(now))
    os.chmod(path, 0o600)
    return now


def seal(
    *,
    out: Path,
    batch: Literal["calibration", "test", "smoke"] = "test",
    effects: int = 60,
    nulls: int = 60,
    pairs: int = 10,
    outside: int = 12,
    bodies: tuple[Body, ...] = FORMER,
    seed: int | None = None,
    seed_from_os: bool = False,
    only: tuple[Body, ...] = (),
    processes: int = 2,
    gpu: bool = False,
    finer: float = 1.0,
    finish: bool = False,
) -> str:
    """Make a batch, or go on with it.

    Args:
        out: Folder of the batch.
        batch: Batches of different names share no random number, whatever the seed.
        effects: Cases with one effect of the library.
        nulls: Cases without; every second is a decoy.
        pairs: Cases with two effects.
        outside: Cases with an effect outside the library.
        bodies: Specimens to draw from.
        seed: Of all draws.
        seed_from_os: Take the seed from the operating system; it is kept in the sealed file only.
        only: Make the cases of these bodies now and leave the others to a later call, on another machine for
            instance, to which ``sealed/seed.json`` is copied: a case hangs on the seed and its number alone.
        processes: That work side by side.
        gpu: Make motions on a GPU first, hundreds at once; processes make the others. They are the same to rounding,
            and, where a body meets a plane, to what rounding grows to.
        finer: Divides the elements' edge; below 1 for a quick look.
        finish: Make no more cases, write the truth of those that are there.

    Returns:
        SHA-256 of truth.sealed, or nothing while cases are left to be made.

    Raises:
        ValueError: If the folder holds a batch with other settings, a new batch gets no seed, or two, or a GPU is asked
            for where there is none.
    """
    if seed is not None and seed_from_os:
        raise ValueError(f"seed = {seed}: also seed_from_os, wanted one of the two")
    counts = (effects, nulls, pairs, outside)
    fresh = secrets.randbits(63) if seed_from_os and not (out / "sealed" / "seed.json").exists() else seed
    kept = _wanted(out, batch, fresh, counts, finer, bodies)
    entropy = [BATCHES.index(batch), kept["seed"]]
    todo = plans(*counts, np.random.default_rng(entropy), bodies)
    jobs = [
        (plan, [*entropy, number], out, finer)
        for number, plan in enumerate(todo)
        if not (out / "sealed" / f"{plan.name}.json").exists()
    ]
    print(f"{len(todo)} cases, {len(todo) - len(jobs)} of them there already", flush=True)
    if finish:
        unmade = {plan.name for plan, *_ in jobs}
        todo, jobs = [plan for plan in todo if plan.name not in unmade], []
    every, jobs = len(jobs), [job for job in jobs if not only or job[0].specimen in only]
    left = every - len(jobs)
    # What lasts longest is begun first, so that no process is left alone with it.
    slow = sorted({job[0].specimen for job in jobs}, key=lambda name: -_lasting(name, finer))
    jobs.sort(key=lambda job: slow.index(job[0].specimen))
    believed = [
        (name, i, world, finer, out / BELIEVED)
        for name in slow for i in range(len(SPECIMENS[name]().trials)) for world in _expected(SPECIMENS[name]())
    ]  # fmt: skip
    for line in by_gpu(believed, jobs) if gpu else ():
        print(line, flush=True)
    with _Here() if processes == 1 else ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
        for line in _made(pool, processes, believed, jobs):
            print(line, flush=True)
    if left:
        print(f"{left} cases of other bodies are left to be made; the truth is sealed when all are there")
        return ""
    truths = [json.loads((out / "sealed" / f"{plan.name}.json").read_text()) for plan in todo]
    for truth in truths:
        truth.pop("seconds", None)  # by which no two makings would have the same hash
    held = {
        str(p.relative_to(out)): hashlib.sha256(p.read_bytes()).hexdigest()
        for folder in ("cases", "sealed") for plan in todo for p in sorted((out / folder / plan.name).rglob("*"))
        if p.is_file()
    }  # fmt: skip
    text = json.dumps({**kept, "cases": truths, "files": held}, indent=1)
    (out / "truth.sealed").write_text(text)
    digest = hashlib.sha256(text.encode()).hexdigest()
    (out / "truth.sha256").write_text(f"{digest}  truth.sealed\n")
    visible = [t["strength"] for t in truths if t["effects"]]
    spread = f"; strengths {min(visible):.2g} to {max(visible):.2g}" if visible else ""
    print(f"{len(truths)} cases{spread}\nSHA-256 of truth.sealed: {digest}")
    return digest


if __name__ == "__main__":
    tyro.cli(seal)
