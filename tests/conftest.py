"""Settings that every test runs under, and the fixtures that more than one file needs."""

from __future__ import annotations

import gc
import importlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

# Here and in processes that tests start: what is small gains nothing by threads, and two processes share two cores.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("TI_CPU_MAX_NUM_THREADS", "1")

import hypothesis
import matplotlib
import pytest
import torch
from problems import problem
from ringing import bar
from tiny import tiny

os.environ["MPLBACKEND"] = "Agg"  # also for the processes that tests start
matplotlib.use("Agg")
gc.set_threshold(20_000, 20, 20)  # to look for cycles takes a tenth of the time to compile
torch.set_num_threads(1)  # the tensors are small: threads cost more than they give, and two cores are shared
# Recipes are programs and no package: as modules they are found by name.
RECIPES = Path(__file__).parents[1] / "recipes"
sys.path += [str(RECIPES), str(RECIPES / "validate"), str(RECIPES / "baselines")]

hypothesis.settings.register_profile("slow", max_examples=25, deadline=None, derandomize=True, database=None)
hypothesis.settings.register_profile("quick", hypothesis.settings.get_profile("slow"), max_examples=8)


def _whole(config: pytest.Config) -> bool:
    """Whether all tests run, and not only some files or some that were chosen."""
    chosen = config.args_source is not pytest.Config.ArgsSource.TESTPATHS
    return not (chosen or config.option.keyword or config.option.markexpr)


def pytest_configure(config: pytest.Config) -> None:
    """Draw more examples with ``--slow``; judge the coverage of the whole suite only, not that of some of it."""
    hypothesis.settings.load_profile("slow" if config.option.slow else "quick")
    coverage = config.pluginmanager.get_plugin("_cov")
    if coverage is not None and not _whole(config):
        coverage.options.cov_fail_under = 0


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: Any) -> None:
    """Tell a process for which type of numbers it compiles the vector kernels before its first test, if for any."""
    types = {"gw0": "float32", "gw1": "float64"} if _whole(node.config) else {}
    node.workerinput["compiles"] = types.get(node.gateway.id, "")


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile what else each of two processes would compile, one of them while the other waits or does it again."""
    if compiles := getattr(session.config, "workerinput", {}).get("compiles"):
        p = problem(formulation="total")
        p.tensors = {name: t.to(getattr(torch, compiles)) for name, t in p.tensors.items()}
        torch.stack([output.sum() for output in p.run(p.leaves())]).sum().backward()


def pytest_addoption(parser: pytest.Parser) -> None:
    """The flag that runs everything."""
    parser.addoption("--slow", action="store_true", help="run the tests that are marked slow, too")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark every test that asks for the fixture ``cuda`` as ``gpu``; skip slow ones without ``--slow``."""
    for item in items:
        if "cuda" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.gpu)
        if item.get_closest_marker("slow") is not None and not config.option.slow:
            item.add_marker(pytest.mark.skip(reason="slow: runs with --slow"))


def pytest_collection_finish(session: pytest.Session) -> None:
    """Leave what is there by now, which stays, out of the search for cycles of objects."""
    gc.freeze()


@pytest.fixture
def cuda() -> torch.device:
    """The CUDA device; skips the test where there is none."""
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    return torch.device("cuda")


@pytest.fixture(scope="session")
def recipes() -> dict[str, ModuleType]:
    """The recipes around a run, as modules."""
    names = ("walker", "climber", "turner", "replay", "compare", "material_checks")
    return {name: importlib.import_module(name) for name in names}


@pytest.fixture(scope="session")
def checks(recipes) -> ModuleType:
    """The recipe of material checks, as a module."""
    return recipes["material_checks"]


@pytest.fixture(scope="session")
def straight(recipes, tmp_path_factory) -> tuple[Path, dict[str, float]]:
    """The folder of an uninterrupted run of a tiny walker, to be left as it is, and what it returned."""
    path = tmp_path_factory.mktemp("runs") / "straight"
    return path, recipes["walker"].main(tiny(path))


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    """A bar's twin, and a function that makes recordings of it."""
    return bar(tmp_path_factory.mktemp("bar"))


@pytest.fixture(scope="module")
def judge() -> Iterator[SimpleNamespace]:
    """The programs of the judge, as modules by name."""
    pytest.importorskip("numba")
    folder = RECIPES / "judge"
    sys.path.insert(0, str(folder))
    try:
        yield SimpleNamespace(**{p.stem: importlib.import_module(p.stem) for p in sorted(folder.glob("*.py"))})
    finally:
        sys.path.remove(str(folder))
