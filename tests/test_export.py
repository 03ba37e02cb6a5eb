"""Motions for other programs: what is read back from the files is what was recorded."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import meshio
import moving
import numpy as np
import pytest

from torchsoro.output.export import export_vtu


@pytest.fixture(scope="module")
def motion():
    return moving.motion()


@pytest.fixture(scope="module")
def series(motion, tmp_path_factory):
    return export_vtu(motion, tmp_path_factory.mktemp("vtu") / "made")


def test_collection_lists_one_file_for_each_sample_at_its_time(motion, series):
    listed = ET.parse(series).getroot().findall("./Collection/DataSet")
    assert [float(entry.attrib["timestep"]) for entry in listed] == pytest.approx(motion.time.tolist())
    names = [entry.attrib["file"] for entry in listed]
    assert sorted(path.name for path in series.parent.iterdir()) == sorted([*names, series.name])


@pytest.mark.parametrize("sample", [0, 13, 40])
def test_points_displacement_speed_density_and_pressure_are_read_back(motion, series, sample):
    mesh = meshio.read(series.parent / f"table_{sample:04d}.vtu")
    kept = motion.material
    truth = moving.bending(motion.time)[:, kept]
    np.testing.assert_allclose(mesh.points, truth[sample], atol=2e-5)
    np.testing.assert_allclose(mesh.point_data["displacement"], truth[sample] - motion.rest[kept], atol=2e-5)
    speed = np.linalg.norm(np.gradient(truth, motion.time, axis=0)[sample], axis=1)
    np.testing.assert_allclose(mesh.point_data["speed"], speed, atol=2e-3)
    np.testing.assert_allclose(mesh.point_data["density"], motion.gamma[kept])
    assert mesh.field_data["pressure"].item() == pytest.approx(motion.pressure[sample])
    assert mesh.field_data["TimeValue"].item() == pytest.approx(motion.time[sample])


def test_hexahedra_at_rest_have_the_volume_between_the_particles(motion, series):
    mesh = meshio.read(series.parent / "table_0000.vtu")
    cells = mesh.cells_dict["hexahedron"]
    a, b, d, e = (motion.rest[motion.material][cells[:, i]] for i in (0, 1, 3, 4))
    volume = np.einsum("ci,ci->c", np.cross(b - a, d - a), e - a)
    np.testing.assert_allclose(volume, motion.domain.volume)  # positive: corners are in VTK's order
    # Between 12 x 12 x 8 particles, between a leg's and the body, and between the body and the chamber's lowest layer.
    body, leg, chamber = 11 * 11 * 7, 2 * 2 * 4, 5 * 5
    assert len(cells) == body + 4 * leg + chamber


def test_export_below_a_file_is_refused_before_anything_is_written(motion, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match=r"folder = .* lies under .*, which is a file"):
        export_vtu(motion, tmp_path / "file" / "below")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
