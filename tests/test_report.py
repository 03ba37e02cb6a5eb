"""What the report draws and prints of an explanation: moments, places, intervals, and numbers as in its JSON."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from ringing import effect
from scipy.spatial.transform import Rotation

from torchsoro.design.mesh import Surface
from torchsoro.output.slider import Moving, packed, unpacked
from torchsoro.sim2real.data.schema import PlaneTable
from torchsoro.sim2real.hypotheses.library import library
from torchsoro.sim2real.inference.fit import FitProblem
from torchsoro.sim2real.inference.heldout import predict
from torchsoro.sim2real.inference.phases import mismatches
from torchsoro.sim2real.inference.verdict import weighed
from torchsoro.sim2real.report.body import body_motion, surface
from torchsoro.sim2real.report.drawings import side_view
from torchsoro.sim2real.report.explanation import Explanation, effect_rows
from torchsoro.sim2real.report.improvement import Improvement, distances, worst_of
from torchsoro.sim2real.report.report import FAINT, LEAST_BARS, write
from torchsoro.sim2real.report.words import digits, interval
from torchsoro.simulation.contact import Plane

POSITIVE = {"time_s", "time_constant_s", "mass_kg", "stiffness_n_m", "damping_n_s_m", "reach_m", "viscosity_pa_s"}


@pytest.fixture(scope="module")
def dragged(made):
    """Recordings of a bar in a fluid, and its fit."""
    twin, record = made
    problem = FitProblem(record("drag", (600.0,)), twin)
    (fit,) = problem.fit([((effect("drag"),), np.array([0.0, 20.0]))], rounds=8)
    assert fit is not None
    return problem, fit


@pytest.fixture(scope="module")
def shown(dragged):
    """The second trial as believed and as explained, its worst moment, and the body in it."""
    problem, fit = dragged
    before, after = (predict(problem, fit, problem.trials, believed=b)[1] for b in (True, False))
    trial = problem.trials[1]
    worst = worst_of(1, trial, before.seen, after.seen)
    return trial, before, after, worst, body_motion(problem, fit, trial, after.clock, worst)


@pytest.fixture(scope="module")
def judged(dragged):
    """What is said of them, and their fit without an effect."""
    problem, fit = dragged
    (null_model,) = problem.fit([((), None)], rounds=2)
    return weighed(problem, [effect("drag")], null_model, [fit], report=lambda line: None), null_model


def test_the_marked_moment_has_the_largest_distance_of_all_markers(shown):
    trial, before, after, worst, _ = shown
    apart = distances(trial, before.seen)
    assert np.isnan(apart).any()  # a sample was lost
    assert worst.believed == np.nanmax(apart) == apart[worst.sample, worst.marker]
    assert worst.time == trial.recording.time[worst.sample]
    assert worst.explained == pytest.approx(
        np.linalg.norm(trial.recording.position - after.seen, axis=-1)[worst.sample, worst.marker]
    )


def test_the_body_is_drawn_where_its_markers_are(dragged, shown):
    problem, fit = dragged
    trial, _, after, worst, body = shown
    _, ln_scale, *turn = fit.errors[len(problem.trials) :][:5]
    frame = math.exp(ln_scale) * Rotation.from_rotvec(turn).as_matrix().T
    assert body.time[body.worst] == worst.time and body.trial == trial.name
    kept = np.searchsorted(trial.recording.time, body.time)
    assert np.abs(body.markers[1] @ frame - after.seen[kept]).max() < 1e-6
    np.testing.assert_allclose(body.recorded @ frame, trial.recording.position[kept], atol=1e-12)
    # What is clamped stays where the setup has it.
    held = body.rest[:, 0] < 1e-9
    assert held.any() and np.abs(body.explained[:, held] - body.rest[held]).max() < 2e-4
    # The tip's marker lies on the corner of the surface; only it has an error of its place.
    at_rest, _ = surface(problem.twin)
    tip = np.linalg.norm(at_rest - problem.twin.setup.markers[0].at, axis=1)
    assert tip.min() < 1e-6
    for simulated, markers in ((body.believed, body.markers[0]), (body.explained, body.markers[1])):
        assert np.abs(simulated[:, tip.argmin()] - markers[:, 0]).max() < 2e-3
    # A place of the body is where the surface around it is.
    corner = body.moved(at_rest[tip.argmin()])
    assert np.linalg.norm(corner - body.explained[body.worst][tip.argmin()]) < 1e-3
    moved = np.linalg.norm(body.explained[body.worst] - body.believed[body.worst], axis=1)
    assert moved[tip.argmin()] == pytest.approx(worst.believed, rel=0.2)


def test_a_body_that_would_not_fit_into_memory_is_refused(dragged, shown, monkeypatch):
    trial, _, after, worst, whole = shown
    monkeypatch.setattr("torchsoro.sim2real.report.body.MOST", 10 * whole.believed.shape[1])
    with pytest.raises(ValueError, match=r"trial b is 0\.2\d* s long, wanted at most"):
        body_motion(*dragged, trial, after.clock, worst)


def test_planes_are_drawn_where_they_are_as_far_as_the_body_gets(shown):
    body = shown[-1]
    ground = PlaneTable(point=(0.0, 0.0, -0.005), normal=(0.0, 0.0, 2.0), friction="stick")
    slope = PlaneTable(point=(0.0, 0.0, 0.0), normal=(1.0, 0.0, 1.0), friction="stick")
    corners = body.planes(dataclasses.replace(shown[0].setup, planes=(ground, slope)))
    assert corners.shape == (len(body.time), 4, 3) and (corners[..., 2] == -0.005).all()
    whole = np.concatenate([body.believed, body.explained])[..., :2]
    np.testing.assert_array_equal(corners[..., :2].min((0, 1)), whole.min((0, 1)))
    np.testing.assert_array_equal(corners[..., :2].max((0, 1)), whole.max((0, 1)))
    assert not body.planes(dataclasses.replace(shown[0].setup, planes=())).size


def test_the_surface_is_closed_and_has_the_area_of_the_body(made):
    twin, _ = made
    vertices, faces = surface(twin)
    a, b, c, d = (vertices[faces[:, k]] for k in range(4))
    normals = np.cross(c - a, d - b) / 2
    x, y, z = twin.setup.size
    assert np.linalg.norm(normals, axis=1).sum() == pytest.approx(2 * (x * y + y * z + z * x))
    # Normals point out: the divergence theorem gives the volume.
    assert (normals * (a + b + c + d) / 12).sum() == pytest.approx(x * y * z)


def test_a_fine_mesh_is_coarsened_and_stays_where_it_is():
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.02)
    twin = SimpleNamespace(setup=SimpleNamespace(surface=Surface(mesh=ball), size=(0.04, 0.04, 0.04)))
    vertices, faces = surface(twin)
    assert 300 < len(faces) <= 1200 < len(ball.faces)
    radii = np.linalg.norm(vertices, axis=1)
    assert 0.018 < radii.min() and radii.max() < 0.0201
    coarse = trimesh.Trimesh(vertices, faces)
    assert coarse.area == pytest.approx(ball.area, rel=0.05) and coarse.volume == pytest.approx(ball.volume, rel=0.05)


def test_the_view_from_the_side_keeps_the_axis_along_which_the_worst_marker_is_off(shown):
    trial, _, _, worst, body = shown
    off = np.abs(body.recorded - body.markers[0])[body.worst, worst.marker]
    assert int(off.argmax()) in side_view(body, trial.setup)
    for axis in range(3):
        markers = body.recorded[None].repeat(2, 0)
        markers[0, :, :, axis] += 0.01
        moved = dataclasses.replace(body, markers=markers)
        assert axis in side_view(moved, trial.setup)


@pytest.mark.parametrize("one", library(), ids=lambda e: f"{e.name}-{e.affected_quantity}")
def test_intervals_hold_their_value_and_only_what_is_possible(dragged, one, monkeypatch):
    """With any uncertainty, and with values that are well within their range."""
    known, fit = dragged
    monkeypatch.setattr(type(one), "applies", lambda *experiment: True)
    slippery = Plane.through(torch.zeros(3), normal=torch.tensor([0.0, 0.0, 1.0]), friction=torch.tensor(0.5))
    scenario = known.scenarios[0].replace(planes=(slippery,), air_stiffness=torch.tensor([1e4]))
    problem = SimpleNamespace(twin=known.twin, scenarios=[scenario])
    shares = 1.0, 0.8, 0.6, 0.4, 0.3, 0.2
    values = np.array([s * q.scale * (1 if q.least > -1 else -1) for s, q in zip(shares, one.quantities, strict=False)])
    place = np.array(problem.twin.setup.center if one.local else ())
    for spread in (0.01, 1.0, 30.0):
        deviations = np.concatenate([spread * np.abs(values), 1e-3 * np.ones(len(place))])
        wide = dataclasses.replace(
            fit, effects=(one,), values=(np.concatenate([values, place]),), covariances=(np.diag(deviations**2),)
        )
        (row,) = effect_rows(wide, 1.0, problem)
        limits = {q.name: (q.least * q.scale, q.most * q.scale) for q in one.quantities}
        for name, p in row["parameters"].items():
            low, high = limits.get(name, (-math.inf, math.inf))
            least = 0.0 if name in one.nonnegative | one.ratios | POSITIVE else low
            most = 1.0 if name == "fraction" else high
            assert least <= p["low"] < p["value"] < p["high"] <= most
            if name in POSITIVE and spread <= 1:
                assert p["low"] > 0


def test_an_interval_is_written_in_the_unit_of_its_value():
    assert interval(0.4, 0.2, 1.7, "s") == "200 to 1700 ms"
    assert interval(2.0, 0.2, 3.0, "s") == "0.2 to 3 s"
    assert interval(0.0, 0.0, 0.03, "s") == "0 to 30 ms"
    assert interval(5e-5, 1e-5, 2e-4, "m") == "10 to 200 µm"
    assert interval(math.log(0.02), math.log(0.01), math.log(0.04), "ln s") == "10 to 40 ms"


def test_errors_of_trials_are_averaged_as_squares():
    found = Improvement(trials={"a": (3e-3, 0.0), "b": (4e-3, 1e-3)}, heldout=True, floor=1e-4)
    assert found.believed == pytest.approx(math.sqrt(12.5) * 1e-3)
    assert found.explained == pytest.approx(math.sqrt(0.5) * 1e-3)


def test_places_come_out_of_the_page_as_they_went_in_to_a_20000th_of_their_extent():
    rng = np.random.default_rng(3)
    places = 0.1 * rng.normal(size=(7, 12, 3))
    places[3, 10] = np.nan
    moving = [
        Moving(name="a", color="red", places=places[:, :8], faces=np.arange(8).reshape(2, 4)),
        Moving(name="b", color="black", places=places[:, 8:]),
    ]
    data = packed(np.linspace(0, 1, 7), moving, begin=2, azimuth=-90.0)
    found = unpacked(data)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(places))
    extent = 1e3 * (np.nanmax(places, (0, 1)) - np.nanmin(places, (0, 1))).max()
    assert np.nanmax(np.abs(found - 1e3 * places)) <= 0.51 * extent / 20000
    assert [part["start"] for part in data["parts"]] == [0, 8]


@pytest.mark.parametrize(
    "kind",
    [
        "nothing_missing",
        "cannot_tell",
        "cannot_distinguish",
        "unknown_physics",
        "explained",
    ],
)
@pytest.mark.slow
def test_every_verdict_has_its_page_with_the_numbers_of_its_json(dragged, judged, shown, kind, tmp_path):
    problem, _ = dragged
    _, _, _, worst, body = shown
    found, null_model = judged
    small = dataclasses.replace(found.chosen[0], size=0.012 * found.conclusion.motion)
    chosen = {"cannot_distinguish": 2 * found.chosen[:1], "explained": (small,)}.get(kind, ())
    named = bool(chosen)
    verdict = dataclasses.replace(found, kind=kind, chosen=chosen, heldout={"a": (3e-3, 1e-4), "b": (4e-3, 2e-4)})
    before, after = (tuple(predict(problem, verdict.best, problem.trials, believed=b)) for b in (True, False))
    told = Explanation(
        problem=problem,
        discretization=problem.discretization,
        verdict=verdict,
        before=before,
        after=after,
        drawn=tuple(p.seen for p in before),
        heldout=(),
        seconds=1.0,
        mismatches=tuple(mismatches(problem, null_model, problem.trials, after)),
        worst=worst,
        body=body,
    )
    write(told, problem.trials, tmp_path, {})
    answer = json.loads((tmp_path / "explanation.json").read_text())
    page = (tmp_path / "report.html").read_text()
    assert answer["improvement"]["heldout"] and answer["improvement"]["trials"] == ["a", "b"]
    large = [f"{digits(1e3 * answer['improvement'][key])} mm" for key in ("believed_m", "explained_m", "floor_m")]
    assert re.findall(r"<b>([^<]*)</b>", page) == large and large[0] == "3.54 mm"
    assert ("error as explained by drag" in page) == (len(chosen) > 1) and ("fitted without an effect" in page) != named
    assert ("1.2 % of it, which is too little to matter" in page) == (kind == "explained")
    assert answer["worst"]["trial"] == "b" and answer["worst"]["time_s"] == worst.time
    lengths = [float(x) for x in re.findall(r'<rect class="\w+" width="([\d.]+)"', page)]
    bars = [100 * p for p in sorted(answer["probabilities"].values(), reverse=True)]
    shown = max(LEAST_BARS, sum(b > 100 * FAINT for b in bars))
    assert lengths[:shown] == pytest.approx([max(b, 0.4) for b in bars[:shown]], abs=0.06)
    assert lengths[shown : shown + 4] == pytest.approx([100.0, 5.0, 75.0, 2.5], abs=0.06)
    assert page.count("slider(document.currentScript") == 1 and len(page) < 2e6
