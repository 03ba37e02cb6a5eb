"""The laws run by Taichi, in lanes and by plain Python, and their adjoints against central differences."""

import ast
import inspect
import math
from types import FunctionType

import numpy as np
import pytest
import taichi as ti
from numba import njit

from torchsoro.simulation import laws as text
from torchsoro.simulation.kernels.lanes import load, store
from torchsoro.simulation.kernels.laws_lanes import laws as lane_laws
from torchsoro.simulation.kernels.laws_taichi import laws
from torchsoro.simulation.runtime import init

NAMES = [name for name, law in vars(text).items() if isinstance(law, FunctionType)]
STATES = 500
CONSTANT = {"stick", "dt", "reach", "touch", "push"}  # arguments that the adjoints give no gradient by


def arguments(name: str) -> np.ndarray:
    """Random arguments of a law [STATES, arguments], of order one, by the names that they have."""
    rng = np.random.default_rng(3)
    normal = rng.normal(size=(3, STATES))
    normal /= np.linalg.norm(normal, axis=0)
    columns = []
    for argument in inspect.signature(getattr(text, name)).parameters:
        if argument in ("n0", "n1", "n2"):
            column = normal[int(argument[1])]
        elif argument == "stick":
            column = rng.integers(0, 2, STATES)
        elif argument == "push":
            column = rng.choice([0.0, 0.5], STATES)
        elif argument in ("dt", "reach", "sink", "depth", "span", "slow"):
            column = rng.uniform(0.2, 1, STATES)
        elif argument == "touch":
            column = rng.uniform(0.05, 0.2, STATES)
        elif argument in ("square", "a", "b"):
            column = rng.uniform(-0.1, 1, STATES)
        elif argument in ("friction", "more", "hold"):
            column = rng.uniform(0, 1, STATES) * rng.integers(0, 2, STATES)
        else:
            column = rng.normal(size=STATES)
        columns.append(column)
    return np.stack(columns, 1)


def by_python(name: str, given: np.ndarray) -> np.ndarray:
    """What a law returns for arguments [n, arguments], in plain Python."""
    found = [getattr(text, name)(*row) for row in given.tolist()]
    return np.array(found, dtype=np.float64).reshape(len(given), -1)


def by_lanes(name: str, given: np.ndarray, results: int) -> np.ndarray:
    """The same in lanes of a vector register, in the precision of the arguments."""
    count, width = given.shape
    rows = np.pad(given.T, ((0, 0), (0, -count % 16)), "edge")
    n = rows.shape[1]
    asked = ", ".join(f"load(a, {k * n} + i)" for k in range(width))
    kept = "; ".join(f"store(out, {k * n} + i, r[{k}])" for k in range(results)) if results > 1 else "store(out, i, r)"
    scope = {"law": getattr(lane_laws, name), "load": load, "store": store}
    exec(f"def run(a, out):\n for i in range(0, {n}, 16):\n  r = law({asked})\n  {kept}", scope)
    out = np.zeros(results * n, given.dtype)
    njit(scope["run"])(np.ascontiguousarray(rows).reshape(-1), out)
    return out.reshape(results, n)[:, :count].T.astype(float)


def by_taichi(name: str, given: np.ndarray, results: int) -> np.ndarray:
    """The same by Taichi."""
    init()
    law, (count, width) = getattr(laws, name), given.shape

    @ti.kernel
    def run(a: ti.types.ndarray(), out: ti.types.ndarray()):
        for i in range(count):
            found = law(*[a[i, k] for k in ti.static(range(width))])
            if ti.static(results == 1):
                out[i, 0] = found
            else:
                for k in ti.static(range(results)):
                    out[i, k] = found[k]

    out = np.zeros((count, results), given.dtype)
    run(given, out)
    return out


@pytest.mark.parametrize(
    ("dtype", "within"), [pytest.param(np.float32, 1e-5, marks=pytest.mark.slow), (np.float64, 1e-12)]
)
@pytest.mark.parametrize("name", NAMES)
def test_taichi_lanes_and_python_agree_on_a_law(name, dtype, within):
    given = arguments(name).astype(dtype)
    expected = by_python(name, given)
    assert np.isfinite(expected).all()
    size = 1 + np.abs(expected)
    for found in (by_lanes(name, given, expected.shape[1]), by_taichi(name, given, expected.shape[1])):
        assert (np.abs(found - expected) / size).max() < within


@pytest.mark.parametrize("name", [name for name in NAMES if name.endswith("_adjoint")])
def test_an_adjoint_agrees_with_central_differences(name):
    forward = name.removesuffix("_adjoint")
    parameters = list(inspect.signature(getattr(text, forward)).parameters)
    given, step = arguments(name), 1e-6
    inputs, bars = given[:, : len(parameters)], given[:, len(parameters) :]
    found = by_python(name, given)
    constant = CONSTANT | ({"n0", "n1", "n2"} if forward == "response" else set())
    wanted = [k for k, parameter in enumerate(parameters) if parameter not in constant]
    assert found.shape[1] == len(wanted)
    checked = 0
    for column, k in enumerate(wanted):
        move = np.zeros(len(parameters))
        move[k] = step
        count = bars.shape[1]
        plus, here, minus, twice = (
            (by_python(forward, inputs + by * move)[:, :count] * bars).sum(1) / step for by in (1, 0, -1, 2)
        )
        # Away from corners, where slopes to either side differ.
        smooth = np.abs(plus - 2 * here + minus) + np.abs(twice - 2 * plus + here) < 1e-3
        checked += smooth.sum()
        np.testing.assert_allclose(found[smooth, column], ((plus - minus) / 2)[smooth], rtol=1e-6, atol=1e-6)
    assert checked > 0.9 * STATES * len(wanted)


def test_numbers_in_the_laws_are_exact_in_float32():
    tree = ast.parse(inspect.getsource(text))
    numbers = [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)]
    numbers = [value for value in numbers if isinstance(value, int | float)]
    assert numbers
    assert all(math.isclose(float(np.float32(value)), value, rel_tol=0, abs_tol=0) for value in numbers)


def test_what_is_lost_below_the_largest_stretch_is_that_of_ogden_and_roxburgh():
    for below in np.linspace(0.0, 3.0, 31):
        left, largest = text.softening(2.0 - below, 2.0, 0.4, 0.5)
        assert left == pytest.approx(1 - 0.4 * math.erf(below / 0.5), abs=0.4 * 5e-4)
        assert largest == 2.0
    assert text.softening(2.5, 2.0, 0.4, 0.5) == (1.0, 2.5)
