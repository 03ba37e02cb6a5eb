"""Where the whole body is in a trial, as believed and as explained, beside the recorded markers."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from torchsoro.sim2real.data.experiment import Setup, Trial
from torchsoro.sim2real.data.schema import Marker
from torchsoro.sim2real.inference.fit import Fit, FitProblem
from torchsoro.sim2real.inference.likelihood import BREAKS
from torchsoro.sim2real.inference.observation import ObservationModel
from torchsoro.sim2real.inference.twin_error import DiscretizationError
from torchsoro.sim2real.report.improvement import Worst
from torchsoro.sim2real.twin.batch import SAMPLE
from torchsoro.sim2real.twin.grid import BODY
from torchsoro.sim2real.twin.twin import Twin

NEAR = 8  # vertices that a place moves with
FRAMES = 60  # of a motion, that are kept
FACES = 1200  # of a surface, at most
MOST = 4_000_000  # vertices times samples, which take a gigabyte


@dataclass(frozen=True, kw_only=True, eq=False)
class BodyMotion:
    """Surfaces and markers of a trial, in the frame of the setup, into which recorded places are brought.

    Attributes:
        trial: Its name.
        time: Of the frames by the recording's clock [F] s.
        worst: Number of the frame in which the recording is the furthest from what was believed.
        marker: Number of the marker that is.
        rest: The surface at rest [V, 3] m.
        faces: Vertices of the surface's polygons [Q, 3 or 4].
        believed: The surface [F, V, 3] m.
        explained: The same [F, V, 3] m.
        markers: As believed and as explained [2, F, M, 3] m.
        recorded: Markers [F, M, 3] m; along an axis that was not recorded, as explained.
    """

    trial: str
    time: np.ndarray
    worst: int
    marker: int
    rest: np.ndarray
    faces: np.ndarray
    believed: np.ndarray
    explained: np.ndarray
    markers: np.ndarray
    recorded: np.ndarray

    @property
    def travel(self) -> float:
        """How far a place of the surface gets from where it begins, at most [m]."""
        return max(float(np.linalg.norm(x - x[0], axis=-1).max()) for x in (self.believed, self.explained))

    def moved(self, place: np.ndarray) -> np.ndarray:
        """Where a place of the body at rest [3] m is at the worst moment, as explained: with the surface around it."""
        near = np.argsort(np.linalg.norm(self.rest - place, axis=1))[:NEAR]
        return place + (self.explained[self.worst] - self.rest)[near].mean(0)

    def planes(self, setup: Setup) -> np.ndarray:
        """Corners of planes across an axis, as far as the body gets, one after the other [F, 4 P, 3] m."""
        whole = np.concatenate([self.believed, self.explained]).reshape(-1, 3)
        low, high, found = whole.min(0), whole.max(0), []
        for plane in setup.planes:
            normal = np.abs(plane.normal) / np.linalg.norm(plane.normal)
            axis = int(normal.argmax())
            if normal[axis] < 1 - 1e-6:
                continue
            for one, other in ((low, low), (high, low), (high, high), (low, high)):
                corner = np.array(plane.point, float)
                corner[(axis + 1) % 3], corner[(axis + 2) % 3] = one[(axis + 1) % 3], other[(axis + 2) % 3]
                found.append(corner)
        return np.tile(np.reshape(found, (1, -1, 3)), (len(self.time), 1, 1))


def body_motion(problem: FitProblem, fit: Fit, trial: Trial, clock: float, worst: Worst) -> BodyMotion:
    """The body in a trial, by the finest twin at hand; from recorded places, errors of clock and frame are taken away.

    Args:
        problem: The fit's.
        fit: What explains the difference.
        trial: With a recording; one of the problem or another.
        clock: Offset of the recording's clock, as explained [s].
        worst: Of this trial.

    Raises:
        ValueError: where a simulation breaks down, or is so long that it does not fit into memory with a whole surface.
    """
    recording = trial.recording
    assert recording is not None
    twin = problem.fine or problem.twin
    places, faces = surface(twin)
    count, markers = len(places), twin.setup.markers
    points = [Marker(name=f"p{k}", at=(float(x), float(y), float(z))) for k, (x, y, z) in enumerate(places)]
    setup = dataclasses.replace(twin.setup, markers=(*points, *markers), axes=(0, 1, 2))
    # What the finer twin would add is in its own motion.
    none = DiscretizationError(shift=() if problem.fine else problem.discretization.shift)
    there = problem.only([trial], twin=dataclasses.replace(twin, setup=setup), discretization=none, slips=())
    samples = round(there.scenarios[0].until / SAMPLE)
    if samples * len(places) > MOST:
        raise ValueError(
            f"trial {trial.name} is {samples * SAMPLE:g} s long, wanted at most {MOST * SAMPLE / len(places):.3g} s"
        )
    motions = [m.alone() for (m,) in there.simulate([problem.as_stated, (fit.effects, fit.point[None])])]
    if not all(m.sound.all() for m in motions):
        raise ValueError(BREAKS)
    kept = np.unique(np.append(np.linspace(0, len(recording.time) - 1, FRAMES).round().astype(int), worst.sample))
    seen = dataclasses.replace(recording, time=recording.time[kept], position=recording.position[kept])
    observation = ObservationModel(setup, [dataclasses.replace(trial, recording=seen)], problem.priors)
    known = fit.errors[len(problem.trials) :]
    # Of the clock's rate, scale and frame; of places, only markers have one.
    errors = np.concatenate([[clock], known[:5], np.zeros(3 * count), known[5 : 5 + 3 * len(markers)]])
    believed, explained = (observation.observe(m, 0, errors) for m in motions)
    recorded = explained[:, count:].copy()
    recorded[..., list(problem.experiment.setup.axes)] = seen.position
    back = Rotation.from_rotvec(known[2:5]).as_matrix() / math.exp(known[1])
    believed, explained, recorded = (x @ back for x in (believed, explained, recorded))
    return BodyMotion(
        trial=trial.name,
        time=seen.time,
        worst=int(np.searchsorted(kept, worst.sample)),
        marker=worst.marker,
        rest=places,
        faces=faces,
        believed=believed[:, :count],
        explained=explained[:, :count],
        markers=np.stack([believed[:, count:], explained[:, count:]]),
        recorded=recorded,
    )


def surface(twin: Twin) -> tuple[np.ndarray, np.ndarray]:
    """The outside of a body at rest: its mesh, coarsened, or the sides of a box's cells, divided to be about even.

    Returns:
        Vertices [V, 3] m, and polygons [Q, 3 or 4].
    """
    if twin.setup.surface is not None:
        # Corners of cells that are filled in part lie off the body.
        mesh, width = twin.setup.surface.mesh, 0.02 * max(twin.setup.size)
        vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces)
        while len(faces) > FACES:
            vertices, faces = _clustered(vertices, faces, width)
            width *= 1.2
        return vertices, faces
    # Chambers are inside.
    solid = np.pad(twin.grid.hole >= BODY, 1)
    planes = [axis.planes for axis in twin.grid.axes]
    rows = []
    for axis in range(3):
        one, two = (axis + 1) % 3, (axis + 2) % 3
        for side in (-1, 1):
            inner = np.argwhere(solid & ~np.roll(solid, -side, axis)) - 1
            # Counter-clockwise as seen from outside.
            for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))[::side]:
                corner = inner.copy()
                corner[:, axis] += side > 0
                corner[:, one] += a
                corner[:, two] += b
                rows.append(corner)
    sides = np.concatenate([np.stack(rows[4 * k : 4 * k + 4], 1) for k in range(6)])
    corners, index = np.unique(sides.reshape(-1, 3), axis=0, return_inverse=True)
    vertices = np.stack([planes[a][corners[:, a]] for a in range(3)], -1)
    faces = index.reshape(-1, 4)
    while 8 * len(faces) <= FACES:
        vertices, faces = _divided(vertices, faces)
    return vertices, faces


def _clustered(vertices: np.ndarray, faces: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """A mesh whose vertices in each cube of this width [m] are one (Rossignac and Borrel 1993)."""
    _, index = np.unique(np.floor(vertices / width).astype(int), axis=0, return_inverse=True)
    count = np.bincount(index.ravel())
    middle = np.stack([np.bincount(index.ravel(), x) / count for x in vertices.T], -1)
    corners = index.ravel()[faces]
    one, two, three = corners.T
    corners = corners[(one != two) & (two != three) & (three != one)]
    _, first = np.unique(np.sort(corners, 1), axis=0, return_index=True)
    return middle, corners[np.sort(first)]


def _divided(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each quadrilateral as four."""
    quads = vertices[faces]
    after = np.roll(quads, -1, 1)
    ends, middle = (quads + after) / 2, quads.mean(1, keepdims=True).repeat(4, 1)
    parts = np.stack([quads, ends, middle, np.roll(ends, 1, 1)], 2).reshape(-1, 3)
    found, index = np.unique(parts.round(9), axis=0, return_inverse=True)
    return found, index.reshape(-1, 4)
