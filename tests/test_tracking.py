"""What tracking programs write becomes a markers.csv."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st

from torchsoro.sim2real.data.recording import Recording
from torchsoro.sim2real.data.tracking import Frame, read, read_c3d, read_deeplabcut, read_tracker

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "recipes"))

ONE = "mass A\t\t\nt\tx\ty\n1.000E-1\t1.0E-2\t2.0E-2\n1.100E-1\t1.1E-2\t\n1.200E-1\t1.2E-2\t2.2E-2\n"
BESIDE = """#multi:
\ttip\t\tbase 1\t
t\tx\ty\tx\ty
0,00\t0,01\t0,02\t0,03\t0,04
0,01\t0,011\t0,021\t\t
0,02\t0,012\t0,022\t0,032\t0,042
"""
BELOW = """tip,,
t,x,y,v_{x}
0,0.01,0.02,
0.01,0.011,0.021,0.1
0.02,0.012,0.022,

base,,
t,x,y
0.0100000001,0.03,0.04
0.03,0.031,0.041
"""
DEEPLABCUT = """scorer,net,net,net,net,net,net
bodyparts,tip,tip,tip,base,base,base
coords,x,y,likelihood,x,y,likelihood
0,100.0,50.0,0.99,10.0,80.0,0.99
1,102.0,48.0,0.98,10.0,80.0,0.40
3,104.0,46.0,0.97,10.0,80.0,
"""
ANIMALS = """scorer,net,net,net,net,net,net
individuals,arm,arm,arm,single,single,single
bodyparts,tip,tip,tip,frame,frame,frame
coords,x,y,likelihood,x,y,likelihood
0,1,2,1,3,4,1
1,1,2,1,3,4,1
2,1,2,1,3,4,1
"""


def file(folder: Path, text: str | bytes, name: str = "marks.txt") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


# Tracker ----------------------------------------------------------------------------------------------------------


def test_a_mass_of_tracker(tmp_path):
    found = read([file(tmp_path, ONE)])
    assert found.names == ("mass A",) and found.recording.axes == (0, 2)
    np.testing.assert_allclose(found.recording.time, [0, 0.01, 0.02], atol=1e-12)
    # y was not seen in the second frame: the sample is lost.
    lost = np.nan
    np.testing.assert_allclose(found.recording.position[:, 0], [[0.01, 0.02], [lost, lost], [0.012, 0.022]])


@pytest.mark.parametrize("delimiter", [";", ","])
def test_other_delimiters_and_no_name(tmp_path, delimiter):
    text = ONE.split("\n", 1)[1].replace("\t", delimiter)
    found = read_tracker([file(tmp_path, text, "tip.csv")])
    assert found.names == ("tip",)
    np.testing.assert_allclose(found.recording.position[2, 0], [0.012, 0.022])


def test_masses_beside_each_other_with_decimal_commas(tmp_path):
    found = read([file(tmp_path, BESIDE)])
    assert found.names == ("tip", "base 1")
    np.testing.assert_allclose(found.recording.position[2], [[0.012, 0.022], [0.032, 0.042]])
    assert found.recording.seen[:, 1, 0].tolist() == [True, False, True]


def test_masses_below_each_other_are_put_on_all_frames(tmp_path):
    found = read([file(tmp_path, BELOW)])
    assert found.names == ("tip", "base")
    np.testing.assert_allclose(found.recording.time, [0, 0.01, 0.02, 0.03], atol=1e-9)
    assert found.recording.seen[..., 0].T.tolist() == [[True, True, True, False], [False, True, False, True]]


def test_a_file_for_each_mass(tmp_path):
    other = ONE.replace("mass A", "mass B").replace("1.0E-2", "3.0E-2")
    found = read([file(tmp_path, ONE, "a.txt"), file(tmp_path, other, "b.txt")])
    assert found.names == ("mass A", "mass B")
    np.testing.assert_allclose(found.recording.position[0], [[0.01, 0.02], [0.03, 0.02]])


def test_axes_scale_origin_and_start(tmp_path):
    frame = Frame(axes=("-y", "x"), scale=10.0, origin=(0.01, 0.01), start=0.11)
    with pytest.raises(ValueError, match=r"marks\.txt: 2 samples from 0\.11 s on, wanted at least 3"):
        read([file(tmp_path, ONE)], frame)
    found = read([file(tmp_path, ONE + "0.13\t0.013\t0.023\n")], frame)
    assert found.recording.axes == (0, 1)
    np.testing.assert_allclose(found.recording.time, [0, 0.01, 0.02], atol=1e-12)
    np.testing.assert_allclose(found.recording.position[1:, 0], [[0.12, -0.02], [0.13, -0.03]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"marks\.txt: empty, wanted a table"),
        (b"\xff\xfe\x00\x01", r"marks\.txt: .*; wanted a text file of Tracker or DeepLabCut"),
        ("frame\tx\ty\n1\t2\t3\n", r"'frame\\tx\\ty', wanted columns t, x, y"),
        (ONE.replace("x\ty", "x\tr"), r"line 2: columns t, x, r, wanted t, and x and y of each mass"),
        (ONE.replace("1.1E-2", "far"), r"line 4: x = 'far', wanted a number or nothing"),
        (ONE.replace("1.2E-2", "inf"), r"marks\.txt: position: an infinite number"),
        (ONE.replace("1.200E-1", "0.105"), r"mass A: t = 0\.105 after 0\.11, wanted times that increase"),
        (ONE + ONE, r"mass A: t = 0\.1 after 0\.12"),
        (ONE + "lost\t\t\n", r"'lost', wanted columns t, x, y"),
        (ONE + "lost\t\t\n0.2\t1\t2\n", r"'lost', wanted columns t, x, y"),
        (ONE[: ONE.index("1.000")], r"mass 'mass A' is there twice or has no row"),
        (BESIDE.replace("base 1", "tip"), r"masses 'tip', 'tip', wanted a name above each x"),
        ("t\tx\ty\n0\t\t\n1\t\t\n2\t\t\n", r"no sample of marks from 0 s on"),
    ],
)
def test_refuses_what_is_no_export_of_tracker(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        read([file(tmp_path, text)])


def test_refuses_files_that_do_not_go_together(tmp_path):
    path = file(tmp_path, ONE)
    with pytest.raises(ValueError, match=r"mass 'mass A' is there twice"):
        read([path, path])
    with pytest.raises(ValueError, match=r"wanted one file, or some that Tracker exported"):
        read([path, file(tmp_path, DEEPLABCUT, "marks.csv")])
    with pytest.raises(ValueError, match=r"no file: wanted one file"):
        read([])
    with pytest.raises(ValueError, match=r"none\.txt.*wanted a text file"):
        read([tmp_path / "none.txt"])


# DeepLabCut -------------------------------------------------------------------------------------------------------


def test_deeplabcut_in_metres_with_z_up(tmp_path):
    path = file(tmp_path, DEEPLABCUT, "marks.csv")
    found = read([path], Frame(scale=1e-3, origin=(10, 80)), fps=100.0)
    assert found.names == ("tip", "base") and found.recording.axes == (0, 2)
    np.testing.assert_allclose(found.recording.time, [0, 0.01, 0.03])  # a frame is missing
    np.testing.assert_allclose(found.recording.position[:, 0], [[0.09, 0.03], [0.092, 0.032], [0.094, 0.034]])
    assert found.recording.seen[:, 1, 0].tolist() == [True, False, False]
    sure = read_deeplabcut(path, Frame(scale=1e-3), fps=100.0, likelihood=0.3)
    assert sure.recording.seen[:, 1, 0].tolist() == [True, True, False]
    np.testing.assert_allclose(sure.recording.position[0, 0], [0.1, -0.05])


def test_deeplabcut_of_several_individuals(tmp_path):
    found = read([file(tmp_path, ANIMALS)], Frame(scale=1.0), fps=1.0)
    assert found.names == ("arm_tip", "frame")
    np.testing.assert_allclose(found.recording.position[0], [[1, -2], [3, -4]])


@pytest.mark.parametrize(
    ("change", "settings", "message"),
    [
        (("", ""), {"fps": None}, r"marks\.csv: fps = None, wanted frames per second$"),
        (("", ""), {"fps": 0.0}, r"fps = 0\.0"),
        (("", ""), {"frame": Frame()}, r"scale = None"),
        (("", ""), {"likelihood": 95.0}, r"likelihood = 95\.0"),
        (("", ""), {"likelihood": 1.0}, r"no sample of tip, base"),
        (("", ""), {"frame": Frame(scale=1.0, axes=("x", "y", "z"))}, r"axes = x, y, z, .* wanted 2 of each"),
        (("", ""), {"frame": Frame(scale=1.0, origin=(1.0,))}, r"origin = \(1\.0,\), wanted 2 of each"),
        (("bodyparts", "parts"), {}, r"rows scorer, parts, coords, wanted scorer, bodyparts, coords first"),
        (("coords,x,y", "coords,x,z"), {}, r"tip has columns x, z, likelihood, wanted x, y, likelihood"),
        (("50.0,", ""), {}, r"row '0' has 6 cells, wanted 7"),
        (("50.0", "high"), {}, r"frame 0: 'high' = 'high', wanted a number or nothing"),
        (("\n1,", "\n0,"), {}, r"3 frames of 2 parts, wanted 3, with increasing numbers"),
        (("\n0,", "\nimg0.png,"), {}, r"'img0\.png', wanted a number"),
        (("3,104.0,46.0,0.97,10.0,80.0,\n", ""), {}, r"2 frames of 2 parts"),
    ],
)
def test_refuses_what_is_no_table_of_deeplabcut(tmp_path, change, settings, message):
    path = file(tmp_path, DEEPLABCUT.replace(*change) if change[0] else DEEPLABCUT, "marks.csv")
    with pytest.raises(ValueError, match=message):
        read_deeplabcut(path, **{"frame": Frame(scale=1e-3), "fps": 100.0, **settings})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"axes": ("x", "up")}, r"axes = x, up, wanted different ones"),
        ({"axes": ("x", "-x")}, r"axes = x, -x, wanted different ones"),
        ({"axes": ("x", "")}, r"axes = x, , wanted different ones"),
        ({"scale": -1.0}, r"scale = -1\.0, wanted metres in"),
        ({"origin": (0.0, float("nan"))}, r"origin = \(0\.0, nan\), start = None, wanted finite"),
        ({"start": float("inf")}, r"start = inf, wanted finite"),
    ],
)
def test_refuses_what_is_no_frame(settings, message):
    with pytest.raises(ValueError, match=message):
        Frame(**settings)


# C3D --------------------------------------------------------------------------------------------------------------


def captured(path: Path, unit: str = "mm", names: tuple[str, ...] = ("tip", "base")) -> Path:
    ezc3d = pytest.importorskip("ezc3d", reason="ezc3d, which writes C3D, is not installed")
    c3d = ezc3d.c3d()
    c3d["parameters"]["POINT"]["RATE"]["value"] = [200.0]
    c3d["parameters"]["POINT"]["LABELS"]["value"] = list(names)
    c3d["parameters"]["POINT"]["UNITS"]["value"] = [unit]
    points = np.ones((4, len(names), 5))
    points[:3] = np.arange(15.0 * len(names)).reshape(3, len(names), 5)
    points[:3, -1, 2] = np.nan
    c3d["data"]["points"] = points
    c3d.write(str(path))
    return path


def test_c3d_in_its_own_unit(tmp_path):
    found = read([captured(tmp_path / "walk.c3d")])
    assert found.names == ("tip", "base") and found.recording.axes == (0, 1, 2)
    np.testing.assert_allclose(found.recording.time, np.arange(5) / 200)
    np.testing.assert_allclose(found.recording.position[:, 0], 1e-3 * np.array([[k, 10 + k, 20 + k] for k in range(5)]))
    assert found.recording.seen[:, 1, 0].tolist() == [True, True, False, True, True]


def test_c3d_with_y_up(tmp_path):
    path = captured(tmp_path / "walk.c3d", "px").rename(tmp_path / "walk.C3D")
    found = read([path], Frame(axes=("x", "z", "-y"), scale=1.0, origin=(0, 0, 20)))
    assert found.recording.axes == (0, 1, 2)
    # tip is at (1, 11, 21) of the file, with ours at z = 20 of it
    np.testing.assert_allclose(found.recording.position[1, 0], [1, -1, 11])


def test_c3d_of_many_points(tmp_path):
    names = tuple(f"m{k}" for k in range(300))  # a list of names holds 255
    assert read([captured(tmp_path / "many.c3d", names=names)]).names == names


def test_refuses_what_is_no_c3d(tmp_path):
    with pytest.raises(ValueError, match=r"walk\.c3d: lengths in 'px', wanted m, cm, mm, or a scale"):
        read([captured(tmp_path / "walk.c3d", "px")])
    with pytest.raises(ValueError, match=r"markers 'tip', 'tip', wanted names that differ"):
        read([captured(tmp_path / "twice.c3d", names=("tip", "tip"))])
    for name, content in (("a.c3d", b"\x02X" + bytes(600)), ("b.c3d", b"\x02P" + bytes(600)), ("c.c3d", b"")):
        with pytest.raises(ValueError, match=rf"{name}: .*; wanted a C3D file"):
            read([file(tmp_path, content, name)])
    with pytest.raises(ValueError, match=r"none\.c3d.*; wanted a C3D file"):
        read([tmp_path / "none.c3d"])


def test_says_which_package_reads_c3d(tmp_path, monkeypatch):
    def missing(name):
        raise ModuleNotFoundError(name)

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(ValueError, match=r"ezc3d, which reads C3D, is not installed, wanted: pip install ezc3d"):
        read_c3d(file(tmp_path, b"\x02P", "walk.c3d"))


# The recipe -------------------------------------------------------------------------------------------------------


def test_the_recipe_writes_what_an_experiment_reads(tmp_path, capsys):
    from convert import Options, main

    out = tmp_path / "trials" / "a" / "markers.csv"
    path = file(tmp_path, DEEPLABCUT, "marks.csv")
    main(Options(files=(path,), out=out, fps=100.0, scale=1e-3, origin=(10, 80), axes="-x, z", rename=("tip=end, 1",)))
    found = Recording.read(out, ["base", "end, 1"], (0, 2))
    np.testing.assert_allclose(found.time, [0, 0.01, 0.03])
    np.testing.assert_allclose(found.position[:, 1], [[-0.09, 0.03], [-0.092, 0.032], [-0.094, 0.034]])
    np.testing.assert_allclose(found.position[0, 0], [0, 0], atol=1e-12)
    assert found.seen[:, 0, 0].tolist() == [True, False, False]
    told = capsys.readouterr().out
    assert "base: 1 of 3 samples" in told and 'kind = "video", axes = ["x", "z"]' in told
    before = out.read_bytes()
    for rename in (("nose=tip",), ("tip=base",), ("tip",), ("tip=",)):
        with pytest.raises(ValueError, match=r"rename.*wanted"):
            main(Options(files=(path,), out=out, fps=100.0, scale=1e-3, rename=rename))
    assert out.read_bytes() == before and [p.name for p in out.parent.iterdir()] == ["markers.csv"]


def test_the_recipe_converts_motion_capture(tmp_path):
    from convert import Options, main

    out = tmp_path / "markers.csv"
    path = captured(tmp_path / "walk.c3d")
    main(Options(files=(path,), out=out))
    found = Recording.read(out, ["tip", "base"])
    written = read([path]).recording
    np.testing.assert_allclose(found.position, written.position, rtol=1e-8)
    np.testing.assert_allclose(found.time, written.time)


def test_an_output_that_would_overwrite_a_recording_or_cannot_be_written_is_refused(tmp_path):
    from convert import Options, main

    path = file(tmp_path, ONE)
    for out, message in ((path, "one of the files to convert"), (path / "a.csv", "is a file"), (tmp_path, "a folder")):
        with pytest.raises(ValueError, match=rf"out = .*{message}"):
            main(Options(files=(path,), out=out))
    assert path.read_text() == ONE and [p.name for p in tmp_path.iterdir()] == [path.name]


@hypothesis.settings(suppress_health_check=[hypothesis.HealthCheck.function_scoped_fixture], max_examples=100)
@hypothesis.given(
    text=st.sampled_from([ONE, BESIDE, BELOW, DEEPLABCUT, ANIMALS]),
    changes=st.lists(
        st.tuples(
            st.integers(0, 200), st.sampled_from(["", "\t", ",", "\n", "nan", "1e999", "x", "-1", "\0", '"', ";"])
        ),
        max_size=4,
    ),
    settings=st.fixed_dictionaries(
        {},
        optional={
            "fps": st.floats(),
            "scale": st.floats(),
            "axes": st.sampled_from(["x,z", "x", "x,x", "-z,y", "up"]),
            "origin": st.lists(st.floats(), max_size=3).map(tuple),
            "start": st.floats(),
            "likelihood": st.floats(),
            "rename": st.sampled_from([("tip=end",), ("mass A=",), ("=",), ("tip=base", "base=tip")]),
        },
    ),
)
def test_drawn_recordings_are_converted_or_refused_with_nothing_written(tmp_path, text, changes, settings):
    from convert import Options, main

    for at, cell in changes:
        text = text[:at] + cell + text[at + 1 :]
    out = tmp_path / "out" / "markers.csv"
    out.unlink(missing_ok=True)
    try:
        main(Options(files=(file(tmp_path, text),), out=out, **{"fps": 100.0, "scale": 1e-3, **settings}))
    except ValueError as error:
        assert "wanted" in str(error) and not out.exists()
    else:
        assert out.exists()
