"""Several starts of one design: which is taken, what is left out, and that a cut-off run goes on."""

from __future__ import annotations

import dataclasses
import json
import shutil
from typing import Any

import pytest
import torch
from tiny import tiny

from torchsoro.design import starts
from torchsoro.design.loop import optimize
from torchsoro.design.robot import Robot, walker
from torchsoro.design.starts import CHANGE, disturb, optimize_starts
from torchsoro.errors import SimulationDiverged
from torchsoro.simulation.threads import threads_here

BROKEN = SimulationDiverged(step=1, time=0.0, particle=0, quantity="F", remedy="none")


def test_the_best_start_is_what_the_run_ends_with(tmp_path):
    settings = tiny(tmp_path / "run", starts=3, c_max=0.2499, iterations=2)
    robot = walker(settings)
    found = optimize_starts(robot)
    alone = []
    for index in range(3):
        one = walker(tiny(tmp_path / f"alone{index}", c_max=0.2499, iterations=2))
        if index:
            disturb(one.field, index)
        alone.append(optimize(one))
    best = max(alone, key=lambda one: one.worth)
    assert found.worth == best.worth and len({one.worth for one in alone}) == 3
    assert torch.equal(found.gamma, best.gamma) and torch.equal(robot.field().detach(), best.gamma)
    told = (settings.out / "metrics.csv").read_text()
    assert told in [(settings.out / f"start-{k}" / "metrics.csv").read_text() for k in (1, 2, 3)]
    assert (settings.out / "settings.json").exists()


def test_a_run_that_starts_again_leaves_no_start_of_the_former(tmp_path):
    path = tmp_path / "run"
    optimize_starts(walker(tiny(path, starts=3, iterations=1)))
    for other in ("start-mine", "start-4"):  # another run, beyond the former's starts
        shutil.copytree(path / "start-1", path / other)
    with pytest.raises(ValueError, match="feature"):
        optimize_starts(walker(tiny(path, feature=5e-3, overwrite=True)))
    assert len(list(path.glob("start-*"))) == 5  # refused, so that nothing is deleted
    for count, left in ((2, {"start-1", "start-2"}), (1, set())):
        optimize_starts(walker(tiny(path, starts=count, overwrite=True, iterations=1)))
        assert {folder.name for folder in path.glob("start-*")} == left | {"start-mine", "start-4"}


def test_a_run_is_resumed_with_several_starts_or_one_as_it_began(tmp_path):
    for name, count, other in (("one", 1, 2), ("two", 2, 1)):
        settings = tiny(tmp_path / name, starts=count, iterations=1)
        optimize_starts(walker(settings))
        before = sorted(tmp_path.rglob("*"))
        with pytest.raises(ValueError, match=f"starts = {other}: .* holds a run of {count}, wanted that"):
            optimize_starts(walker(dataclasses.replace(settings, starts=other, resume=True)))
        assert sorted(tmp_path.rglob("*")) == before


def test_starts_one_after_the_other_end_as_side_by_side(tmp_path):
    beside = optimize_starts(walker(tiny(tmp_path / "beside", starts=2, iterations=2)))
    with threads_here(1):
        after = optimize_starts(walker(tiny(tmp_path / "after", starts=2, iterations=2)))
    assert torch.equal(beside.gamma, after.gamma)


def test_a_start_differs_by_a_millionth(tmp_path):
    field = walker(tiny(tmp_path)).field
    before = field.phi.detach().clone()
    disturb(field, 1)
    assert float((field.phi.detach() - before).std()) == pytest.approx(CHANGE, rel=0.2)


def ended(worth: float, violation: float) -> dict[str, Any]:
    return {"worth": worth, "violation": violation}


@pytest.mark.parametrize(
    "judged, taken",
    [
        ((ended(1.0, -1e-3), ended(2.0, -1e-4)), 1),  # within the limit, the farther
        ((ended(1.0, -1e-3), ended(2.0, 1e-4)), 0),  # within the limit before beyond
        ((ended(1.0, 1e-3), ended(0.5, 1e-4)), 1),  # beyond, the nearer
        ((None, ended(0.5, 1e-4)), 1),  # what broke down is left out
    ],
)
def test_the_farthest_within_the_limit_is_taken(tmp_path, monkeypatch, judged, taken):
    gammas = []

    def judge(robot: Robot, observe: Any) -> Any:
        index = int(robot.settings.out.name.removeprefix("start-")) - 1
        found = optimize(robot, observe)
        gammas.append((index, found.gamma))
        if judged[index] is None:
            raise BROKEN
        return dataclasses.replace(found, **judged[index])

    monkeypatch.setattr(starts, "optimize", judge)
    found = optimize_starts(walker(tiny(tmp_path / "run", starts=2, iterations=1)))
    assert torch.equal(found.gamma, dict(gammas)[taken])


def test_where_every_start_breaks_down_so_does_the_run(tmp_path, monkeypatch):
    def broken(robot: Robot, observe: Any) -> Any:
        raise BROKEN

    monkeypatch.setattr(starts, "optimize", broken)
    with pytest.raises(SimulationDiverged):
        optimize_starts(walker(tiny(tmp_path / "run", starts=2)))
    assert not (tmp_path / "run").exists()  # so that it can be started again with other settings


def test_a_cut_off_run_goes_on_and_ends_the_same(tmp_path):
    whole = optimize_starts(walker(tiny(tmp_path / "whole", starts=2)))
    settings = tiny(tmp_path / "cut", starts=2)

    def interrupted(run: Any, robot: Robot, gamma: torch.Tensor, iteration: int) -> None:
        if iteration == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        optimize_starts(walker(settings), interrupted)
    assert any(path.name in ("start-1", "start-2") for path in settings.out.iterdir())
    assert json.loads((settings.out / "settings.json").read_text())["starts"] == 2  # for a --resume by itself
    resumed = optimize_starts(walker(dataclasses.replace(settings, resume=True)))
    assert torch.equal(whole.gamma, resumed.gamma) and whole.worth == resumed.worth
    with pytest.raises(ValueError, match="already holds a run"):
        optimize_starts(walker(settings))
    again = optimize_starts(walker(dataclasses.replace(settings, overwrite=True)))
    assert torch.equal(again.gamma, whole.gamma)
    with pytest.raises(ValueError, match="holds no run of several starts"):
        optimize_starts(walker(tiny(tmp_path / "none", starts=2, resume=True)))
