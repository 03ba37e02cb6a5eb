"""Input that explain.py cannot use: a message that names it, before any simulation, and nothing written."""

from __future__ import annotations

import dataclasses
import math
import shutil
import tempfile
import tracemalloc
from pathlib import Path

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st
from setups import CLAMP, marker, material

from torchsoro.sim2real import pipeline
from torchsoro.sim2real.data.recording import read_table
from torchsoro.sim2real.inference.model import read_model
from torchsoro.sim2real.inputs import RECORDINGS, chosen, read_inputs
from torchsoro.sim2real.options import Options
from torchsoro.sim2real.twin.twin import Twin

SETUP = f"""title = "finger"
duration = 0.5

[body]
size = [0.08, 0.02, 0.02]

{material()}
{CLAMP}
[[chamber]]
name = "one"
box = [[0.01, 0.005, 0.005], [0.035, 0.015, 0.015]]

[[chamber]]
name = "two"
box = [[0.045, 0.005, 0.005], [0.07, 0.015, 0.015]]

[[plane]]
point = [0.0, 0.0, -0.05]
normal = [0.0, 0.0, 1.0]
friction = 0.3

[[load]]
box = [[0.07, 0.0, 0.0], [0.08, 0.02, 0.02]]
force = [0.0, 0.0, -0.1]

{marker("tip", 0.08, 0.01, 0.02)}
{marker("side", 0.04, 0.0, 0.01)}
[recording]
noise = 1e-4
"""
TIME = np.arange(0.0, 0.5, 0.01)
MODEL = """
[model]
edge = 0.01
walls = 1
across = 2
ln_modulus = 0.0
ln_pressure = 0.0

[[effect]]
name = "drag"
density_drag_kg_m3 = 600.0
"""


def markers(time=TIME, scale: float = 1.0, seed: int = 0) -> str:
    """A table of two markers that swing."""
    rng = np.random.default_rng(seed)
    rows = ["time_s," + ",".join(f"{m}_{a}_m" for m in ("tip", "side") for a in "xyz")]
    for t, noise in zip(time, 1e-4 * rng.normal(size=(len(time), 6)), strict=True):
        swing = 0.002 * math.sin(20 * t)
        places = scale * (np.array([0.08, 0.01, 0.02 + swing, 0.04, 0.0, 0.01 + swing]) + noise)
        rows.append(",".join(f"{v:.9g}" for v in (t, *places)))
    return "\n".join(rows) + "\n"


def write(folder: Path, name: str, text: str | bytes) -> None:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(text if isinstance(text, bytes) else text.encode())


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A good experiment, beside a model.toml and a trial to predict."""
    place = tmp_path_factory.mktemp("inputs")
    for seed, trial in enumerate(("trials/a", "trials/b", "heldout/c", "new")):
        write(place / "experiment", f"{trial}/pressure.csv", "time_s,one_pa,two_pa\n0,0,0\n0.1,5000,0\n0.5,5000,0\n")
        if trial != "new":
            write(place / "experiment", f"{trial}/markers.csv", markers(seed=seed))
    write(place / "experiment", "setup.toml", SETUP)
    write(place / "experiment", "new/trial.toml", "duration = 0.1\n")
    write(place / "experiment", "model.toml", SETUP + MODEL)
    return place / "experiment"


@pytest.fixture
def folder(whole, tmp_path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "experiment"))


def listing(place: Path) -> list[str]:
    return sorted(str(path) for path in place.rglob("*"))


def refuse(folder: Path, message: str, out: Path | None = None, **options) -> None:
    """Assert that an explanation is refused in these words, and that nothing was written."""
    before = listing(folder.parent)
    with pytest.raises(ValueError, match=message):
        read_inputs(Options(**{"experiment": folder, "out": out or folder.parent / "out", **options}))
    assert listing(folder.parent) == before


def test_a_good_experiment_is_accepted_with_byte_order_marks(folder):
    for name in ("setup.toml", "trials/a/markers.csv", "trials/a/pressure.csv"):
        write(folder, name, b"\xef\xbb\xbf" + (folder / name).read_bytes())
    found = read_inputs(Options(experiment=folder, out=folder.parent / "out"))
    assert [t.name for t in found.trials] == ["a", "b"] and [t.name for t in found.kept] == ["c"]
    assert found.fine.count > found.twin.count and not found.notes and not found.hints
    highest = max(float(t.pressure.pressure.abs().max()) for t in found.trials)
    assert found.twin.highest == found.fine.highest == highest > 0


def test_a_third_twin_is_of_a_body_that_sticks(folder):
    asked = Options(experiment=folder, out=folder.parent / "out", budget=1e3)
    assert read_inputs(asked).finest is None
    write(folder, "setup.toml", SETUP.replace("friction = 0.3", 'friction = "stick"'))
    found = read_inputs(asked)
    assert found.finest is not None and found.finest.edge < found.fine.edge


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"edge": 1e-5}, r"edge = 1e-05 m, walls = 1: .* cells in a body of 0\.08 x 0\.02 x 0\.02 m, wanted at most"),
        ({"edge": math.nan}, "edge = nan, wanted a positive length"),
        ({"edge": -0.01}, r"edge = -0\.01, wanted a positive length"),
        ({"edge": 0.5}, r"edge = 0\.5 m, wanted at most 0\.08 m"),
        ({"edge": 0.002, "budget": 0.01}, r"edge = 0\.002 m, walls = 1: about .* minutes, wanted at most 100 times"),
        ({"walls": -1}, "walls = -1, wanted 1 to 32"),
        ({"walls": 10**9}, "walls = 1000000000, wanted 1 to 32"),
        ({"threads": -2}, "threads = -2, wanted 1 to 1024, or 0"),
        ({"budget": math.nan}, "budget = nan, wanted a positive number of minutes"),
        ({"budget": 0.0}, r"budget = 0\.0, wanted a positive number of minutes"),
        ({"budget": 1e-3}, r"budget: 0\.001 minutes, wanted .* or more"),
        ({"effects": ("wind",)}, "effects = wind: wanted names out of"),
        ({"experiment": None}, "experiment: not given, wanted a folder"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_options_out_of_range_are_refused_by_name(folder, options, message):
    refuse(folder, message, **options)


def test_an_output_folder_that_cannot_be_made_is_refused(folder):
    taken = folder.parent / "file"
    taken.write_text("")
    refuse(folder, r"out = .*file: is a file, wanted a folder", out=taken)
    refuse(folder, r"out = .*out: lies under .*file, which is a file", out=taken / "further" / "out")
    refuse(folder, r"out = /proc/out: not writable", out=Path("/proc/out"))
    with pytest.raises(ValueError, match="holds a folder trials, wanted no folder of a result's name"):
        pipeline.predict_markers(Options(predict=taken, trial=taken, out=folder / "trials"))


def test_a_folder_that_is_no_experiment_is_refused(folder):
    refuse(folder / "none", r"experiment = .*none: not there, wanted a folder", out=folder.parent / "out")
    refuse(folder / "setup.toml", r"experiment = .*setup\.toml: a file, wanted a folder", out=folder.parent / "out")
    refuse(folder / "trials", r"experiment = .*trials: no setup\.toml", out=folder.parent / "out")
    (folder / "trials").rename(folder / "recordings")
    refuse(folder, "no trial, wanted folders trials/<name>")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[recording]", "[recording]\naxes = 3", r"\[recording\]: axes = 3, wanted some of \"x\", \"y\", \"z\""),
        ("[recording]", '[recording]\naxes = ["x", "x"]', r"axes = \['x', 'x'\], wanted some of"),
        ("[recording]", "[recording]\naxes = []", r"axes = \[\], wanted some of"),
        ("[recording]\nnoise = 1e-4", "recording = 3", r"\[\[marker\]\] number 2: unknown recording, wanted name, at"),
        ("[[0.5, 0.01]]", "[[0.5, inf]]", r"prony = \[\[0\.5, inf\]\], wanted at most five pairs"),
        ("[[0.5, 0.01]]", "[[0.5, 0.01, 1]]", r"prony = .*, wanted at most five pairs"),
        ("[[0.5, 0.01]]", "0.5", r"prony = 0\.5, wanted at most five pairs"),
        ("duration = 0.5", "duration = 0.5\ngravity = [true, false, true]", r"gravity = \[True, False, True\], wanted"),
        ("duration = 0.5", 'duration = "0.5"', r"duration = '0\.5', wanted a finite number of seconds"),
        ("duration = 0.5", "duration = 500.0e3", r"duration = 500000\.0, wanted a finite number of seconds"),
        ("duration = 0.5", "duration = 1" + "0" * 400, r"duration = 1000.*, wanted a finite number of seconds"),
        ("duration = 0.5", "duration = 1" + "0" * 5000, r"setup\.toml: Exceeds the limit"),
        ("duration = 0.5", "duration = 0.5\nstart = 3", r"start = 3, wanted \"rest\", or a table"),
        ("duration = 0.5", "duration = 0.5\n[start]\nvelocity = [1, 2]", r"\[start\]: velocity = \[1, 2\], wanted"),
        ('name = "tip"', 'name = ""', r"\[\[marker\]\] number 1: name = '', wanted a text of 1 to 64"),
        ('name = "tip"', 'name = "side"', r"\[\[marker\]\] names side, side, wanted each once"),
        ('name = "two"', 'name = "one"', r"\[\[chamber\]\] names one, one, wanted each once"),
        ("noise = 1e-4", "noise = 10", r"\[recording\]: noise = 10 m, wanted at most 0\.008 m"),
        ("noise = 1e-4", "noise = 0", r"noise = 0, wanted a positive number of metres"),
        ("[0.0001, 0.021, 0.021]", "[1, 1, 1]", r"\[\[clamp\]\] box .* holds the whole body"),
        ("[-0.001, -0.001, -0.001], [0.0001", "[0.2, -0.1, -0.1], [0.3", "clamp: box .* wanted one that holds a part"),
        ("[[0.045, 0.005", "[[0.025, 0.005", r"\[\[chamber\]\] one and two overlap"),
        ("[0.07, 0.015, 0.015]", "[0.09, 0.015, 0.015]", "chamber: from 0.01 to 0.09 m along x, wanted between 0"),
        ("size = [0.08, 0.02, 0.02]", "size = [80, 20, 20]", r"size = \[80, 20, 20\], wanted .* is the unit right"),
        ("size = [0.08, 0.02, 0.02]", "size = [8e-5, 2e-5, 2e-5]", r"size = .*, wanted .* is the unit right"),
        ("size = [0.08, 0.02, 0.02]", "size = [0.08, 0.02]", r"\[body\]: size = \[0\.08, 0\.02\], wanted three"),
        ("size = [0.08, 0.02, 0.02]", "", r"\[body\]: no size, wanted one as shape = 'box'"),
        ("poisson_ratio = 0.4", "poisson_ratio = 0.4999999", r"poisson_ratio = 0\.4999999, wanted .* to 0\.4999"),
        ("density = 1000.0", "density = 1.0", r"density = 1\.0, wanted 10 to 30000 kg/m3: is the unit right"),
        ("youngs_modulus = 1e5", "youngs_modulus = 0.1", r"youngs_modulus = 0\.1, wanted 100 to 1e\+10 Pa"),
        ("[material]", "[stuff]", r"no \[?material\]?, wanted a table \[material\]"),
        ("[material]", "[[material]]", r"material = .*, wanted a table \[material\]"),
        ("normal = [0.0, 0.0, 1.0]", "normal = [0, 0, 0]", r"\[\[plane\]\] number 1: normal = .*, wanted .*not"),
        ("friction = 0.3", "friction = true", r"friction = True, wanted \"stick\" or a coefficient"),
        ("force = [0.0, 0.0, -0.1]", "force = [0, 0, -0.1]\nend = 0", r"\[\[load\]\] number 1: end = 0, wanted"),
        ("force = [0.0, 0.0, -0.1]", "force = [0, 0, -0.1]\nstart = 1e300", r"start = 1e\+300, wanted a time"),
        ("[[0.07, 0.0, 0.0], [0.08", "[[0.7, 0.0, 0.0], [0.8", r"trials/a: box = .*: no part of the body"),
        ("[[load]]", "[load]", r"load = .*, wanted \[\[load\]\] tables"),
        ("[[marker]]", "[[markers]]", r"unknown markers, wanted title, "),
        ("at = [0.08, 0.01, 0.02]", "at = [80, 10, 20]", r"\[\[marker\]\] tip at .* mm outside of the body"),
    ],
)  # fmt: skip
def test_a_setup_that_does_not_fit_is_refused_by_table_and_key(folder, old, new, message):
    assert old in SETUP
    write(folder, "setup.toml", SETUP.replace(old, new))
    refuse(folder, message)


def test_a_body_that_is_too_slender_for_a_grid_is_refused(folder):
    setup = SETUP[: SETUP.index("[[chamber]]")] + SETUP[SETUP.index("[[plane]]") :]
    write(folder, "setup.toml", setup.replace("size = [0.08, 0.02, 0.02]", "size = [10.0, 2e-4, 2e-4]"))
    for path in folder.rglob("pressure.csv"):
        path.unlink()
    refuse(folder, "a body that is less slender")


def test_binary_files_are_refused(folder):
    noise = bytes(range(256)) * 50
    for name in ("setup.toml", "trials/b/markers.csv", "trials/b/pressure.csv", "trials/b/trial.toml"):
        before = (folder / name).read_bytes() if (folder / name).exists() else None
        write(folder, name, noise)
        refuse(folder, rf"{Path(name).name}: .*wanted a")
        (folder / name).unlink() if before is None else write(folder, name, before)
    write(folder, "trials/b/markers.csv", "a" * 200_000)
    refuse(folder, r"markers\.csv: field larger than field limit.*wanted a table")


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (markers().replace("tip_x_m", "side_x_m", 1), "column 'side_x_m' is there 2 times, wanted each once"),
        (markers().replace("tip_x_m", "end_x_m", 1), "wanted also tip_x_m"),
        (markers(TIME[::-1]), "time: 0.48 s in sample 2 after 0.49 s, wanted times that increase"),
        (markers(1000 * TIME), "times from 0 to 490 with 1 samples within the trial: are they milliseconds"),
        (markers(np.arange(0.0, 500.0, 100.0)), "times from 0 to 400 with 1 samples .* are they milliseconds"),
        (markers(np.arange(50.0)), "times from 0 to 49 with 1 samples .* wanted seconds from release"),
        (markers(TIME / 60), "times from 0 to 0.00816.*, wanted seconds from release"),
        (markers(1e6 + TIME), r"times from 1e\+06 to 1e\+06, wanted seconds from release"),
        (markers(scale=1000), "read as: lengths in millimetres; wanted"),
        ("\n".join(",".join([*r.split(",")[:4], "", "", ""]) if k else r for k, r in enumerate(markers().split("\n"))
                   if r), "marker side has no sample"),
        (markers().replace("\n0.25,", "\n0.25,1e9,0,0,0,0,0\n0.2501,", 1), "tip is at .* at 0.25 s, .* 0.4 m"),
        (markers().replace("\n0.25,", "\n0.25,inf,0,0,0,0,0\n0.2501,", 1), "position: an infinite number"),
        (markers().replace("\n0.25,", "\nx0.25,"), "line 27: 'time_s' = 'x0.25', wanted a number"),
        ("", "0 lines, wanted names of columns"),
    ],
)  # fmt: skip
def test_a_table_of_markers_that_does_not_fit_is_refused(folder, table, message):
    write(folder, "trials/b/markers.csv", table)
    refuse(folder, rf"(trials/b/)?markers\.csv: .*({message})")


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("time_s,one_pa\n0,0\n1,1\n", "wanted also two_pa"),
        ("time_s,one_pa,two_pa\n0,0,0\n0,1,1\n", "time: .* want strictly increasing"),
        ("time_s,one_pa,two_pa\n0,,0\n1,1,1\n", "not finite"),
        ("time_s,one_pa,two_pa\n0,0,0\n1,1e9,1\n", r"a pressure of 1e\+09, wanted at most 1e\+06 Pa"),
        ("time_s,one_pa,two_pa\n3,0,0\n4,1,1\n", "times from 3 to 4, wanted the pressure from 0 to 0.5"),
        ("time_s,one_pa,two_pa\n" + "".join(f"{10 * k},1,1\n" for k in range(50)), "times from 0 to 490, wanted"),
    ],
)
def test_a_pressure_that_does_not_fit_is_refused(folder, table, message):
    write(folder, "trials/b/pressure.csv", table)
    refuse(folder, rf"trials/b/pressure\.csv: .*{message}")


def test_forty_thousand_rows_are_thinned_to_what_the_simulation_shows(folder):
    part = [f"0.08,0.01,0.02{k},0.04,0,0.01{k % 5}\n" for k in range(7)]
    with (folder / "trials/b/markers.csv").open("w") as file:
        file.write("time_s,tip_x_m,tip_y_m,tip_z_m,side_x_m,side_y_m,side_z_m\n")
        file.writelines(f"{1.25e-5 * k:.7f},{part[k % 7]}" for k in range(40_001))
    found = read_inputs(Options(experiment=folder, out=folder.parent / "out"))
    recording = found.trials[1].recording
    assert recording is not None and len(recording.time) == 401 and recording.time[0] == 0
    (note,) = found.notes
    assert note.startswith("trial b: of 40001 rows of markers.csv one in 100 is used, or one in 1.25 ms; ")


def test_a_table_is_read_in_a_few_times_the_memory_of_its_numbers(tmp_path):
    (tmp_path / "t.csv").write_text("a,b\n" + "".join(f"{k},\n" for k in range(60_000)))
    tracemalloc.start()
    found = read_table(tmp_path / "t.csv")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert found["a"][-1] == 59_999 and np.isnan(found["b"]).all()
    assert peak < 8 * 60_000 * 2 * 8


def test_a_long_recording_is_thinned_further_where_rows_between_follow_from_those_kept(folder):
    write(folder, "setup.toml", SETUP.replace("duration = 0.5", "duration = 20.0"))
    for path in folder.rglob("markers.csv"):
        write(path.parent, path.name, markers(np.arange(0.0, 20.0, 0.003), seed=len(path.parent.name)))
    found = read_inputs(Options(experiment=folder, out=folder.parent / "out", budget=1e4))
    assert [len(t.recording.time) for t in found.trials if t.recording is not None] == [3334, 3334]
    assert found.notes[0].startswith("trial a: of 6667 rows of markers.csv one in 2 is used, or one in 6 ms; ")
    for path in folder.rglob("markers.csv"):  # a swing in four rows
        rows = [row.split(",") for row in path.read_text().splitlines()]
        for row in rows[1:]:
            row[3] = f"{0.02 + 0.002 * math.sin(500 * float(row[0])):.6f}"
        write(path.parent, path.name, "\n".join(map(",".join, rows)))
    refuse(folder, r"trial a: markers\.csv has 6667 rows from 0 to 19\.998 s, wanted at most 4000: of every 2 rows one "
                   r"cannot stand for the others, which are .* mm off a smooth curve", budget=1e4)  # fmt: skip


def test_noise_that_cannot_be_estimated_is_asked_for(folder):
    write(folder, "setup.toml", SETUP.replace("noise = 1e-4", ""))
    assert read_inputs(Options(experiment=folder, out=folder.parent / "out")).trials
    still = "time_s,tip_x_m,tip_y_m,tip_z_m,side_x_m,side_y_m,side_z_m\n" + "".join(
        f"{t:g},0.08,0.01,0.02,0.04,0,0.01\n" for t in TIME
    )
    for name in ("a", "b"):
        write(folder, f"trials/{name}/markers.csv", still)
    refuse(folder, r"repeat each other and show no noise, wanted noise = .* under \[recording\]")
    for name in ("a", "b"):
        rows = still.replace("0.08,0.01,0.02", ",,").split("\n")  # one marker is never seen, the other in pairs
        rows[2::3] = [row[: row.index(",")] + "," * 6 for row in rows[2::3]]
        rows[1] = "0,0.08,0.01,0.02,0.04,0,0.01"
        write(folder, f"trials/{name}/markers.csv", "\n".join(rows))
    refuse(folder, r"no marker has four samples in a row .* wanted noise = ")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[model]", "[modell]", r"no model, wanted a table \[model\], as explain\.py writes it"),
        ("edge = 0.01", 'edge = "0.01"', r"\[model\]: edge = '0\.01', wanted a positive length"),
        ("edge = 0.01", "edge = -1.0", r"\[model\]: edge = -1\.0, wanted a positive length"),
        ("walls = 1", "walls = 1.5", r"\[model\]: walls = 1\.5, wanted 1 to 100 cells"),
        ("ln_modulus = 0.0", "ln_modulus = nan", r"\[model\]: ln_modulus = nan, wanted"),
        ("ln_modulus = 0.0", "", r"\[model\]: no ln_modulus, wanted"),
        ("[[effect]]", "[effect]", r"effect = .*, wanted \[\[effect\]\] tables"),
        ('name = "drag"', 'name = "wind"', r"\[\[effect\]\] name = 'wind', wanted one of"),
        ('name = "drag"', "name = 3", r"\[\[effect\]\] number 1: name = 3, wanted the name of an effect"),
        ("= 600.0", '= "600"', r".*density_drag_kg_m3 = '600', wanted a finite number"),
        ("= 600.0", "= [600.0]", r".*density_drag_kg_m3 = \[600\.0\], wanted a finite number"),
        ("[body]", "[other]", r"no body, wanted a table \[body\]"),
    ],
)
def test_a_file_that_is_no_model_is_refused(folder, monkeypatch, old, new, message):
    monkeypatch.setattr("torchsoro.sim2real.inference.model.simulate", None)
    text = (folder / "model.toml").read_text()
    assert old in text
    write(folder, "model.toml", text.replace(old, new))
    options = Options(predict=folder / "model.toml", trial=folder / "new" / "trial.toml", out=folder.parent / "m.csv")
    with pytest.raises(ValueError, match=rf"model\.toml: {message}"):
        pipeline.predict_markers(options)
    for name in ("setup.toml", "none.toml", "trials", "trials/a/markers.csv"):
        with pytest.raises(ValueError, match=rf"{name}: .*wanted"):
            pipeline.predict_markers(dataclasses.replace(options, predict=folder / name))
    assert not options.out.exists()


@pytest.mark.parametrize(("line", "coefficient"), [("", 0.3), ("ln_friction = 0.1\n", 0.3 * math.exp(0.1))])
def test_a_model_knows_by_what_stated_friction_is_off(folder, line, coefficient):
    text = (folder / "model.toml").read_text()
    write(folder, "model.toml", text.replace("[[effect]]", f"{line}[[effect]]"))
    model = read_model(folder / "model.toml")
    twin = Twin(model.setup, edge=model.edge, walls=model.walls, across=model.across)
    trial = read_inputs(Options(experiment=folder, out=folder.parent / "out")).trials[0]
    (plane,) = model.apply(twin.scenario(trial), twin).planes
    assert plane.friction.item() == pytest.approx(coefficient)


@pytest.mark.parametrize(("device", "wanted"), [("cuda", "cuda"), ("cpu", "cpu"), ("auto", "cpu")])
def test_a_trial_is_predicted_where_it_is_asked_for(folder, monkeypatch, device, wanted):
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("torchsoro.sim2real.inference.model.simulate", lambda twin, *_, **__: pytest.fail(twin.device))
    options = Options(predict=folder / "model.toml", trial=folder / "new" / "trial.toml", out=folder.parent / "m.csv")
    with pytest.raises(pytest.fail.Exception, match=f"^{wanted}$"):
        pipeline.predict_markers(dataclasses.replace(options, device=device))


def test_a_trial_to_predict_must_be_named_and_there(folder):
    options = Options(predict=folder / "model.toml", out=folder.parent / "m.csv")
    with pytest.raises(ValueError, match=r"predict, trial: wanted a model\.toml, and the trial\.toml"):
        pipeline.predict_markers(options)
    for name in ("none/trial.toml", "setup.toml"):
        with pytest.raises(ValueError, match=r"trial = .*: wanted a file named trial\.toml"):
            pipeline.predict_markers(dataclasses.replace(options, trial=folder / name))
    assert not options.out.exists()


# Drawn inputs -----------------------------------------------------------------------------------------------------

CELLS = st.sampled_from(["", "nan", "inf", "-1", "1e300", "0", "x", "1e-300", "0.5", "true", "\0", "1,2", '"', "٣"])
VALUES = st.one_of(
    st.floats().map(repr),
    st.integers(-(10**30), 10**30).map(str),
    st.sampled_from(
        ["true", '"x"', "[]", "{}", "[1, 2, 3]", "[[0.1, 0.2]]", "1979-05-27", "nan", "-inf", '""', "[", "0"]
    ),
)


@st.composite
def mutations(draw) -> tuple[str, bytes]:
    """A file of the experiment and what stands in it instead."""
    name = draw(st.sampled_from(["setup.toml", "trials/a/markers.csv", "trials/b/pressure.csv", "trials/b/trial.toml"]))
    if name == "setup.toml" or name.endswith("trial.toml"):
        lines = SETUP.split("\n") if name == "setup.toml" else ["duration = 0.4", "gravity = [0, 0, 0]"]
        keyed = [k for k, line in enumerate(lines) if "=" in line]
        for k in draw(st.lists(st.sampled_from(keyed), min_size=1, max_size=2)):
            key = lines[k].split("=")[0]
            lines[k] = draw(st.one_of(VALUES.map(lambda v, key=key: f"{key}= {v}"), st.just(""), st.just(lines[k] * 2)))
        text = "\n".join(lines)
    else:
        text = markers() if "markers" in name else "time_s,one_pa,two_pa\n0,0,0\n0.1,5000,0\n0.5,5000,0\n"
        rows = [row.split(",") for row in text.split("\n")[:-1]]
        for _ in range(draw(st.integers(1, 3))):
            row = draw(st.integers(0, len(rows) - 1))
            rows[row][draw(st.integers(0, len(rows[row]) - 1))] = draw(CELLS)
        kept = draw(st.integers(1, len(rows)))
        text = "\n".join(",".join(row) for row in rows[: draw(st.sampled_from([kept, len(rows)]))])
    found = text.encode()
    cut = draw(st.one_of(st.just(len(found)), st.integers(0, len(found))))
    return name, found[:cut]


@hypothesis.settings(
    max_examples=6 * hypothesis.settings.default.max_examples, suppress_health_check=list(hypothesis.HealthCheck)
)
@hypothesis.given(
    mutation=mutations(),
    options=st.fixed_dictionaries(
        {},
        optional={
            "budget": st.one_of(st.floats(20, 100), st.floats()),
            "edge": st.one_of(st.floats(0.008, 0.05), st.floats()),
            "walls": st.integers(-1, 4),
            "threads": st.integers(-1, 1100),
            "effects": st.lists(st.sampled_from(["drag", "modulus", "modulus", "wind"]), max_size=1).map(tuple),
        },
    ),
)
def test_drawn_input_is_accepted_or_refused_and_nothing_is_written(whole, mutation, options):
    with tempfile.TemporaryDirectory() as place:
        folder = Path(shutil.copytree(whole, Path(place) / "experiment"))
        write(folder, *mutation)
        before = listing(Path(place))
        try:
            found = read_inputs(Options(experiment=folder, out=Path(place) / "out", **options))
        except ValueError as error:
            assert len(str(error)) > 20 and "want" in str(error), error
        else:
            assert found.trials
        assert listing(Path(place)) == before


@pytest.mark.parametrize(
    ("asked", "seconds", "there", "wanted"),
    [
        ("auto", 100.0, True, "cuda"),
        ("auto", 100.0, False, "cpu"),
        ("auto", 5.0, True, "cpu"),
        ("cpu", 1e3, True, "cpu"),
    ],
)
def test_a_gpu_is_chosen_where_there_is_one_and_much_to_simulate(monkeypatch, asked, seconds, there, wanted):
    monkeypatch.setattr("torch.cuda.is_available", lambda: there)
    assert chosen(asked, seconds) == wanted


def test_an_experiment_that_comes_along_is_found_by_its_name_unless_a_folder_has_it(whole, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shipped = read_inputs(Options(experiment=Path("bar"), out=tmp_path / "out"))
    assert shipped.experiment.folder == RECORDINGS / "bar"
    assert len(shipped.trials) == 3 and len(shipped.kept) == 1 and not shipped.hints
    shutil.copytree(whole, "bar")
    assert read_inputs(Options(experiment=Path("bar"), out=tmp_path / "out")).experiment.folder == Path("bar")
    for name in ("nowhere", "./nowhere/bar"):
        with pytest.raises(ValueError, match=f"{Path(name)}: not there, wanted a folder"):
            read_inputs(Options(experiment=Path(name), out=tmp_path / "out"))
