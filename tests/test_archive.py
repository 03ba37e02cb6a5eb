"""Designs on disk: what survives in a small file, what is refused, and settings that come back as they were."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tiny import TINY

from torchsoro.design.domain import Domain
from torchsoro.design.reading import lasting, read_settings
from torchsoro.design.settings import Settings
from torchsoro.output.archive import archive, load_design, load_shape, save_design
from torchsoro.storage import plain_settings

FILES = ("design.npz", "metrics.csv", "summary.png", "settings.json", "result.json")


def lattice(*particles: int, spacing: float = 0.005) -> Domain:
    size = tuple(n * spacing for n in particles)
    return Domain(size=(size[0], size[1], size[2]), particles=(particles[0], particles[1], particles[2]))


DOMAIN = lattice(4, 5, 6)


def density(seed: int = 0, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    return torch.rand(DOMAIN.count, generator=torch.Generator().manual_seed(seed), dtype=dtype)


# Designs --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_design_comes_back_in_single_precision(dtype, tmp_path):
    gamma = density(dtype=dtype).requires_grad_()
    path = tmp_path / "new" / "folder" / "design.npz"
    stored = save_design(path, DOMAIN, gamma)
    assert stored.dtype == dtype and not stored.requires_grad
    found = load_design(path, DOMAIN)
    assert found.dtype == torch.float32
    assert torch.equal(found, gamma.detach().float()) and torch.equal(found, stored.float())
    assert torch.equal(save_design(path, DOMAIN, stored), stored)  # a second time nothing is lost
    assert [file.name for file in path.parent.iterdir()] == ["design.npz"]


def test_a_design_in_half_precision_is_read_as_it_is(tmp_path):
    gamma = density().half()
    held = {"shape": np.array(DOMAIN.shape), "spacing": DOMAIN.spacing}
    np.savez_compressed(tmp_path / "design.npz", gamma=gamma.numpy(), **held)
    assert torch.equal(load_design(tmp_path / "design.npz", DOMAIN), gamma.float())


@pytest.mark.parametrize("bad", [np.full(120, 1.5), np.full(120, np.nan), np.array(["a"] * 120), np.array([{}] * 120)])
def test_densities_that_are_none_are_refused_without_advice_to_load_them_unsafely(bad, tmp_path):
    np.savez(tmp_path / "design.npz", gamma=bad, shape=np.array(DOMAIN.shape), spacing=DOMAIN.spacing)
    with pytest.raises(ValueError, match=r"design\.npz is no design") as error:
        load_design(tmp_path / "design.npz", DOMAIN)
    assert "allow_pickle" not in str(error.value)


def test_only_one_density_for_each_particle_is_saved(tmp_path):
    for gamma in (density()[1:], density()[None], density().reshape(4, 5, 6)):
        with pytest.raises(ValueError, match=r"gamma: got shape .*, wanted one density per particle, \(120,\)"):
            save_design(tmp_path / "design.npz", DOMAIN, gamma)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("other", [lattice(5, 4, 6), lattice(4, 5, 6, spacing=0.00501), lattice(8, 10, 12)])
def test_a_design_on_another_lattice_is_refused(other, tmp_path):
    save_design(tmp_path / "design.npz", DOMAIN, density())
    with pytest.raises(ValueError, match=r"is on \(4, 5, 6\) particles 0\.005 m apart, wanted \(") as error:
        load_design(tmp_path / "design.npz", other)
    assert f"wanted {other.shape} at {other.spacing:g} m" in str(error.value)


def test_a_damaged_design_is_named(tmp_path):
    path = tmp_path / "design.npz"
    save_design(path, DOMAIN, density())
    whole = path.read_bytes()
    for content in (b"", b"text", whole[:20], whole[: len(whole) // 2], whole[:-1]):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"design\.npz is no design"):
            load_design(path, DOMAIN)


def test_a_changed_byte_is_found_or_changes_nothing(tmp_path):
    path = tmp_path / "design.npz"
    gamma = save_design(path, DOMAIN, density())
    whole, refused = path.read_bytes(), 0
    for at in range(0, len(whole), 3):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :])
        try:
            assert torch.equal(load_design(path, DOMAIN), gamma), at
        except ValueError as error:
            refused += "is no design" in str(error)
    assert refused > len(whole) / 9  # one in three of those looked at; of the others some are not read


def test_what_lacks_a_part_of_a_design_is_refused(tmp_path):
    path = tmp_path / "design.npz"
    whole = {"gamma": density().numpy(), "shape": np.array(DOMAIN.shape), "spacing": DOMAIN.spacing}
    for name in whole:
        np.savez(path, **{key: value for key, value in whole.items() if key != name})
        with pytest.raises(ValueError, match=f"is no design .*{name}"):
            load_design(path, DOMAIN)
    np.savez(path, **{**whole, "gamma": density().numpy()[1:]})
    with pytest.raises(ValueError, match=r"is no design \(densities of shape \(119,\) for \(4, 5, 6\) particles\)"):
        load_design(path, DOMAIN)
    with pytest.raises(ValueError, match=r"there is no file .*other\.npz"):
        load_design(tmp_path / "other.npz", DOMAIN)


# Runs and archived robots ---------------------------------------------------------------------------------------------


@pytest.fixture
def run(tmp_path) -> Path:
    """The folder of a finished run that kept the designs of iterations 0 and 5."""
    path = tmp_path / "run"
    for iteration in (0, 5):
        save_design(path / "shapes" / f"{iteration:05d}.npz", DOMAIN, density(iteration))
    save_design(path / "design.npz", DOMAIN, density(9))
    for name in FILES[1:]:
        (path / name).write_bytes(name.encode())
    written(path / "settings.json", TINY)
    return path


def test_an_archived_robot_keeps_its_files_and_those_early_designs_that_there_are(run, tmp_path):
    folder = tmp_path / "robots" / "mine"
    archive(run, folder, DOMAIN, (0, 3, 5, 10))
    assert {file.name for file in folder.iterdir()} == {*FILES, "shapes.npz"}
    for name in FILES:
        assert (folder / name).read_bytes() == (run / name).read_bytes()
    for iteration in (0, 5):
        here, there = (load_shape(path, DOMAIN, iteration) for path in (run, folder))
        assert torch.equal(here, density(iteration))
        assert there.dtype == torch.float32
        torch.testing.assert_close(there, here, rtol=0, atol=0.5 / 255 + 1e-6)
    assert not torch.allclose(load_shape(folder, DOMAIN, 0), load_shape(folder, DOMAIN, 5), atol=0.1)


def test_a_run_of_a_gpu_is_archived_where_there_is_none(run, tmp_path, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    settings = json.loads((run / "settings.json").read_text())
    (run / "settings.json").write_text(json.dumps({**settings, "device": "cuda"}))
    archive(run, tmp_path / "mine", DOMAIN, (0,))
    assert read_settings(tmp_path / "mine" / "settings.json", device="cpu").device == "cpu"


def test_of_an_iteration_that_was_not_kept_those_are_named_that_were(run, tmp_path):
    archive(run, tmp_path / "mine", DOMAIN, (0, 5))
    for folder in (run, tmp_path / "mine"):
        with pytest.raises(ValueError, match=r"iteration: got 3, .* holds 0, 5$"):
            load_shape(folder, DOMAIN, 3)
    archive(run, tmp_path / "none", DOMAIN, (7,))
    for folder in (tmp_path / "none", tmp_path / "nowhere"):
        with pytest.raises(ValueError, match=r"iteration: got 0, .* holds none$"):
            load_shape(folder, DOMAIN, 0)


def test_an_early_design_on_another_lattice_is_refused(run, tmp_path):
    archive(run, tmp_path / "mine", DOMAIN, (0, 5))
    for folder in (run, tmp_path / "mine"):
        with pytest.raises(ValueError, match=r"wanted"):
            load_shape(folder, lattice(8, 10, 12), 0)


@pytest.mark.parametrize("missing", FILES)
def test_an_unfinished_run_is_not_archived(missing, run, tmp_path):
    (run / missing).unlink()
    with pytest.raises(ValueError, match=rf"run has no {missing}, wanted a finished run"):
        archive(run, tmp_path / "mine", DOMAIN, (0, 5))
    assert not (tmp_path / "mine").exists()


# Settings -------------------------------------------------------------------------------------------------------------


def written(path: Path, settings: Settings, **more: Any) -> Path:
    """The settings as a run writes them."""
    path.write_text(json.dumps({**plain_settings(dataclasses.asdict(settings)), **more}))
    return path


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"friction": 0.5, "dt": "auto", "air_density": 2.5, "robot": "climber", "resume": True},
        {"friction": "stick", "dt": 1e-4, "air_density": "auto", "pressure_file": Path("measured/trace.csv")},
        {
            "out": Path("/somewhere/else"),
            "size": (0.04, 0.05, 0.06),
            "particles": (8, 10, 12),
            "void_range": (0.0, 0.5),
        },
    ],
)
def test_settings_come_back_from_json_value_and_type(changes, tmp_path):
    settings = dataclasses.replace(TINY, **{"settle": 0.01, "sample_every": 0.001, **changes})
    found = read_settings(written(tmp_path / "settings.json", settings))
    assert found == settings
    for field in dataclasses.fields(Settings):
        held, seen = (getattr(s, field.name) for s in (settings, found))
        assert type(seen) is type(held), field.name
        if isinstance(held, tuple):
            assert [type(v) for v in seen] == [type(v) for v in held], field.name


def test_settings_can_be_replaced_before_they_are_judged_and_missing_ones_keep_their_defaults(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    path = tmp_path / "settings.json"
    path.write_text('{"device": "cuda", "slope": 0.3}')
    with pytest.raises(ValueError, match="device = 'cuda'"):
        read_settings(path)
    assert read_settings(path, device="cpu", frames=7) == Settings(device="cpu", slope=0.3, frames=7)


def test_settings_that_do_not_exist_are_named(tmp_path):
    path = written(tmp_path / "settings.json", TINY, slop=0.3, colour="red")
    with pytest.raises(ValueError, match=r"has colour, slop, wanted names of the settings only"):
        read_settings(path)


@pytest.mark.parametrize("content", [None, "", "{", "[1]", "3"])
def test_a_file_without_settings_is_named(content, tmp_path):
    path = tmp_path / "settings.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(ValueError, match=r"settings\.json holds (no settings|a list|a int).*, wanted the settings"):
        read_settings(path)


def test_a_bad_value_in_the_file_is_refused_by_name(tmp_path):
    for name, value in (("gravity", -9.8), ("c_max", 0.3), ("duration", math.pi)):
        with pytest.raises(ValueError, match=name):
            read_settings(written(tmp_path / "settings.json", TINY, **{name: value}))


def test_a_robot_that_is_watched_for_longer_has_room_to_walk():
    short = Settings(device="cpu", duration=0.4, room=0.07)
    assert (lasting(short, 2.0).duration, lasting(short, 2.0).room) == (2.0, 0.5)
    assert lasting(short, 0.2).room == 0.07
    assert lasting(Settings(device="cpu", duration=0.4, room=0.8), 2.0).room == 0.8
