"""What an explanation computes with is never changed after it was made: searches and verdicts see values."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import FrozenInstanceError
from pathlib import Path

import numpy as np
import pytest

from torchsoro.sim2real.inference.fit import FitProblem
from torchsoro.sim2real.inference.gauss_newton import GaussNewton

SIM2REAL = Path(__file__).resolve().parent.parent / "torchsoro" / "sim2real"
# How far an explanation is, and how many simulations it took; no number of a result depends on them.
COUNTERS = {"Progress", "Tally"}
MAKING = {"__init__", "__post_init__"}


def names_of(node: ast.AST) -> str:
    """The dotted name of an expression, "" of any other."""
    if isinstance(node, ast.Name):
        return node.id
    return f"{names_of(node.value)}.{node.attr}" if isinstance(node, ast.Attribute) else ""


def targets(node: ast.AST) -> Iterator[ast.expr]:
    """What a statement assigns to or deletes, tuples taken apart."""
    found: list[ast.expr] = []
    if isinstance(node, ast.Assign | ast.Delete):
        found = list(node.targets)
    elif isinstance(node, ast.AugAssign | ast.AnnAssign | ast.For | ast.NamedExpr | ast.comprehension):
        found = [node.target]
    elif isinstance(node, ast.withitem) and node.optional_vars is not None:
        found = [node.optional_vars]
    while found:
        target = found.pop(0)
        if isinstance(target, ast.Tuple | ast.List):
            found = [*target.elts, *found]
        elif isinstance(target, ast.Starred):
            found = [target.value, *found]
        else:
            yield target


def changes(tree: ast.Module) -> Iterator[str]:
    """Lines that change an object after it was made, in a file of code."""

    def visit(node: ast.AST, owner: str, function: str) -> Iterator[str]:
        if isinstance(node, ast.ClassDef):
            owner, function = node.name, ""
        elif isinstance(node, ast.FunctionDef):
            function = node.name
        if owner not in COUNTERS:
            for target in targets(node):
                inner: ast.AST = target
                while isinstance(inner, ast.Subscript):
                    inner = inner.value
                if isinstance(inner, ast.Attribute) and not (function in MAKING and names_of(inner.value) == "self"):
                    yield f"line {target.lineno}: {ast.unparse(target)}"
            called = names_of(node.func) if isinstance(node, ast.Call) else ""
            if called.split(".")[-1] in ("setattr", "__setattr__", "delattr", "__delattr__") and function not in MAKING:
                yield f"line {node.lineno}: {called}"  # type: ignore[attr-defined]
        for child in ast.iter_child_nodes(node):
            yield from visit(child, owner, function)

    yield from visit(tree, "", "")


@pytest.mark.parametrize("path", sorted(SIM2REAL.rglob("*.py")), ids=lambda p: str(p.relative_to(SIM2REAL)))
def test_no_object_is_changed_after_it_was_made(path):
    assert not list(changes(ast.parse(path.read_text(encoding="utf-8"))))


@pytest.mark.parametrize("path", sorted(SIM2REAL.rglob("*.py")), ids=lambda p: str(p.relative_to(SIM2REAL)))
def test_every_dataclass_of_sim2real_is_frozen_but_for_counters(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ClassDef) and node.name not in COUNTERS:
            for mark in node.decorator_list:
                if ast.unparse(mark).startswith(("dataclass", "dataclasses.dataclass")):
                    assert "frozen=True" in ast.unparse(mark), node.name


@pytest.mark.parametrize(
    ("code", "found"),
    [
        ("problem.twin = other", ["line 1: problem.twin"]),
        ("twin.setup, x = s, 1", ["line 1: twin.setup"]),
        ("self.count[0] += 1", ["line 1: self.count[0]"]),
        ("setattr(solver, 'eager', True)", ["line 1: setattr"]),
        ("class A:\n def __init__(self):\n  self.a = 1\n  other.a = 2", ["line 4: other.a"]),
        ("class A:\n def run(self):\n  self.a = 1", ["line 3: self.a"]),
        ("class Tally:\n def count(self):\n  self.n += 1", []),
        ("x = y.z\nrows[0] = 1", []),
    ],
)
def test_a_change_of_an_object_is_seen_by_the_walk_over_its_code(code, found):
    assert list(changes(ast.parse(code))) == found


def test_problem_twin_and_solver_refuse_another_value(made):
    twin, record = made
    problem = FitProblem(record(None), twin)
    solver = GaussNewton(problem, ())
    for thing, name in ((problem, "twin"), (problem, "even"), (twin, "setup"), (solver, "effects")):
        with pytest.raises(FrozenInstanceError):
            setattr(thing, name, getattr(thing, name))


def test_a_problem_of_one_trial_leaves_that_of_all_trials_as_it_was(made):
    twin, record = made
    problem = FitProblem(record(None), twin)
    other = problem.only(problem.trials[:1], noise=2 * problem.noise)
    assert (len(other.trials), len(problem.trials), other.noise) == (1, 2, 2 * problem.noise)
    assert other.tally is problem.tally
    still = [((), np.zeros((1, len(problem.common))))]
    (one,), (both, _) = other.simulate(still)[0], problem.simulate(still)[0]
    np.testing.assert_array_equal(one.position, both.position)
