"""Which motions a case of a batch needs, and how they are made: one by one, or many at once on a GPU."""

from __future__ import annotations

import functools
import hashlib
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from believed import Begun, begun, expected, expected_path, keep
from camera import Errors, decoy, draw_errors, instants
from effects import LIBRARY, OUTSIDE, Effect, own_world
from lobatto import Floats
from march import Broken
from specimens import SPECIMENS, Specimen
from world import World

MOTIONS = "sealed/motions"  # folder of motions of cases that are not made yet
DRAWS = 60  # of a case, until a body bears what was drawn


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What a case is to be.

    Attributes:
        name: Of its folder.
        kind: "effect", "null", "decoy", "pair" or "outside".
        specimen: Its body.
        effects: Names to draw.
        decoy: Kind of decoy, or "".
    """

    name: str
    kind: str
    specimen: str
    effects: tuple[str, ...] = ()
    decoy: str = ""


Job = tuple[Plan, list[int], Path, float]
"""A case to be made: its plan, its seed, the folder of the batch, and what divides the elements' edge."""


@dataclass(frozen=True, kw_only=True)
class Draw:
    """What a case may be; the next one is taken where a body does not bear it.

    Attributes:
        errors: Of measurement.
        bare: World without the effects.
        world: With them.
        effects: Drawn.
    """

    errors: Errors
    bare: World
    world: World
    effects: tuple[Effect, ...]

    @property
    def worlds(self) -> tuple[World, ...]:
        """That are simulated."""
        return (self.world, self.bare) if self.effects else (self.world,)


def draws(plan: Plan, specimen: Specimen, rng: np.random.Generator) -> Iterator[Draw]:
    """What a case may be, one after the other."""
    for _ in range(DRAWS):
        errors = draw_errors(specimen, rng)
        bare = world = own_world(specimen, rng)
        drawn: list[Effect] = []
        for name in plan.effects:
            world, effect = {**LIBRARY, **OUTSIDE}[name](world, specimen, rng)
            drawn.append(effect)
        if plan.decoy:
            errors = decoy(errors, plan.decoy, specimen, rng)
        yield Draw(errors=errors, bare=bare, world=world, effects=tuple(drawn))


@dataclass(frozen=True, kw_only=True)
class Motion:
    """One trial of a body in a world, as its markers move: simulated once, and kept in a file.

    Attributes:
        body: Name of the specimen.
        number: Of its trial.
        world: What is not as stated.
        errors: Of measurement: where the markers are, and when they are seen.
        finer: Divides the elements' edge.
        kept: Folder of the file.
    """

    body: str
    number: int
    world: World
    errors: Errors
    finer: float
    kept: Path

    @property
    def path(self) -> Path:
        """Of its file."""
        text = repr((self.body, self.number, self.world, self.errors, self.finer))
        return self.kept / f"{hashlib.sha256(text.encode()).hexdigest()[:24]}.npy"

    def begun(self) -> Begun:
        """The march, its instants [T] s, and the markers' places, first as they are, then as they are said to be."""
        off = np.asarray(self.errors.places)
        march, points = begun(self.body, self.number, self.world, self.finer, off)
        specimen = SPECIMENS[self.body]()
        return march, instants(specimen, self.errors, specimen.trials[self.number].name)[1], points

    def markers(self) -> Floats:
        """Markers of the trial [T, 2 markers, 3] m, first where they are, then where they are said to be.

        Raises:
            Broken: if the body does not bear it.
        """
        if not self.path.exists():
            march, t, recorded = self.begun()
            try:
                found = march.run(t, *recorded)
            except Broken:
                found = np.zeros(0)
            keep(self.path, found)
        found = np.load(self.path, allow_pickle=False)
        if not found.size:
            raise Broken(f"{self.body}, motion {self.number}")
        return found


def motions_of(plan: Plan, draw: Draw, finer: float, kept: Path) -> list[list[Motion]]:
    """What is to be simulated of a case: of each world, each trial."""
    count = len(SPECIMENS[plan.specimen]().trials)
    return [
        [
            Motion(body=plan.specimen, number=i, world=world, errors=draw.errors, finer=finer, kept=kept)
            for i in range(count)
        ]
        for world in draw.worlds
    ]


def needed(job: Job) -> list[Motion]:
    """Motions of the draw that a case is as far as is known, and of those before it that are broken."""
    plan, seed, out, finer = job
    found: list[Motion] = []
    for draw in draws(plan, SPECIMENS[plan.specimen](), np.random.default_rng(seed)):
        mine = list(itertools.chain.from_iterable(motions_of(plan, draw, finer, out / MOTIONS)))
        found += mine
        if not any(m.path.exists() and not np.load(m.path, allow_pickle=False).size for m in mine):
            break
    return found


def by_gpu(believed: Sequence[tuple[str, int, World, float, Path]], jobs: Sequence[Job]) -> Iterator[str]:
    """Make on a GPU all motions that it can, those of a body together; a broken draw is followed by another."""
    from fleet import MOST, Fleet, able, start  # here: few who make a batch have a GPU

    start(gpu=True)
    todo: dict[str, dict[Path, Callable[[], Begun]]] = {}
    for name, number, world, finer, kept in believed:
        path = expected_path(name, number, world, finer, kept)
        todo.setdefault(name, {})[path] = functools.partial(expected, name, number, world, finer)
    while True:
        for motion in itertools.chain.from_iterable(map(needed, jobs)):
            if able(motion.world):
                todo.setdefault(motion.body, {})[motion.path] = motion.begun
        todo = {name: {p: begin for p, begin in of.items() if not p.exists()} for name, of in todo.items()}
        if not any(todo.values()):
            return
        for name, of in todo.items():
            paths = list(of)
            for some in (paths[i : i + MOST] for i in range(0, len(paths), MOST)):
                marches, times, points = zip(*(of[path]() for path in some), strict=True)
                for path, markers in zip(some, Fleet(marches, times, points).run(), strict=True):
                    keep(path, markers)
                yield f"{name}: {len(some)} motions on the GPU"
