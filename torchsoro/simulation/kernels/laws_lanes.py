"""The laws as functions of vectors of sixteen lanes, from the text that Taichi and plain Python run.

Lanes have no branches: both branches of an ``if`` are computed, and each variable takes its value in the one that
holds.
"""

from __future__ import annotations

import ast
import math
from pathlib import Path
from types import SimpleNamespace

from torchsoro.simulation import laws as text
from torchsoro.simulation.kernels.lanes import larger, law, magnitude, select, smaller, square_root

_CALLS = {"max": larger, "min": smaller, "abs": magnitude, "sqrt": square_root}
_LOGIC = {ast.And: ast.BitAnd, ast.Or: ast.BitOr}


class _Named(ast.NodeTransformer):
    """Gives variables their present names, and conditions the operators of masks."""

    def __init__(self, names: dict[str, str]) -> None:
        self.names = names

    def visit_Name(self, node: ast.Name) -> ast.expr:
        """A variable by the name of its latest value."""
        return ast.copy_location(ast.Name(self.names.get(node.id, node.id), node.ctx), node)

    def visit_BoolOp(self, node: ast.BoolOp) -> ast.expr:
        """``a and b`` becomes ``a & b``."""
        found, *others = [self.visit(value) for value in node.values]
        for other in others:
            found = ast.BinOp(found, _LOGIC[type(node.op)](), other)
        return ast.copy_location(found, node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> ast.expr:
        """``not a`` becomes ``~a``."""
        op = ast.Invert() if isinstance(node.op, ast.Not) else node.op
        return ast.copy_location(ast.UnaryOp(op, self.visit(node.operand)), node)


class _Branchless:
    """Writes a function without branches: every assignment makes a variable of its own."""

    def __init__(self) -> None:
        self.count = 0

    def fresh(self, name: str) -> str:
        """A name that no variable has."""
        self.count += 1
        return f"{name}_{self.count}"

    def block(self, body: list[ast.stmt], names: dict[str, str]) -> list[ast.stmt]:
        """The statements of a block; ``names`` become those of the variables' values after it."""
        found: list[ast.stmt] = []
        for statement in body:
            if isinstance(statement, ast.If):
                found += self.branch(statement, names)
            elif isinstance(statement, ast.Assign):
                value = _Named(names).visit(statement.value)
                found.append(ast.Assign([self.target(statement.targets[0], names)], value))
            elif isinstance(statement, ast.AugAssign):
                value = ast.BinOp(ast.Name(str(statement.target.id), ast.Load()), statement.op, statement.value)
                value = _Named(names).visit(value)
                found.append(ast.Assign([self.target(statement.target, names)], value))
            elif isinstance(statement, ast.Return):
                found.append(ast.Return(_Named(names).visit(statement.value)))
            elif not isinstance(statement, ast.Expr):
                raise SyntaxError(f"line {statement.lineno} of the laws: wanted assignments, branches and a return")
        return found

    def target(self, node: ast.expr, names: dict[str, str]) -> ast.expr:
        """New names for what is assigned to."""
        if isinstance(node, ast.Tuple):
            return ast.Tuple([self.target(element, names) for element in node.elts], ast.Store())
        assert isinstance(node, ast.Name)
        names[node.id] = self.fresh(node.id)
        return ast.Name(names[node.id], ast.Store())

    def branch(self, statement: ast.If, names: dict[str, str]) -> list[ast.stmt]:
        """Both branches, then a choice for each variable that differs."""
        condition = self.fresh("holds")
        test = ast.Assign([ast.Name(condition, ast.Store())], _Named(names).visit(statement.test))
        yes, no = dict(names), dict(names)
        found = [test, *self.block(statement.body, yes), *self.block(statement.orelse, no)]
        for name in sorted((yes.keys() | no.keys()) - {n for n in yes if yes[n] == no.get(n)}):
            if name in yes and name in no:
                parts: list[ast.expr] = [ast.Name(n, ast.Load()) for n in (condition, yes[name], no[name])]
                names[name] = self.fresh(name)
                call = ast.Call(ast.Name("select", ast.Load()), parts, [])
                found.append(ast.Assign([ast.Name(names[name], ast.Store())], call))
        return found


def _compiled() -> SimpleNamespace:
    path = Path(str(text.__file__))
    tree = ast.parse(path.read_text(encoding="utf-8"))
    functions = [node for node in tree.body if isinstance(node, ast.FunctionDef)]
    for node in functions:
        arguments = {a.arg: a.arg for a in node.args.args}
        # Numba's cache tells functions of a file by their first lines, which stay what they are.
        node.body = [ast.copy_location(statement, node) for statement in _Branchless().block(node.body, arguments)]
    names = {name: value for name, value in vars(text).items() if isinstance(value, int | float)}
    # A module that Numba finds when it reads compiled code from disk.
    names |= {"select": select, **_CALLS, "__name__": __name__}
    assert all(getattr(math, name, None) is None or name in _CALLS for name in vars(text) if name[0] != "_")
    for node in functions:
        own = ast.fix_missing_locations(ast.Module([node], []))
        exec(compile(own, str(path), "exec"), names)
        names[node.name] = law(names[node.name])
    return SimpleNamespace(**{name: value for name, value in names.items() if not name.startswith("_")})


laws = _compiled()
