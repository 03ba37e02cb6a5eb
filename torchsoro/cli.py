"""The console script ``torchsoro``: each recipe is a command.

    torchsoro --help
    torchsoro walker --slope 0.3

A recipe is found beside this file in an installed package, and in ``recipes/`` of a checkout; only the one that is
asked for is imported. ``torchsoro walker`` and ``python recipes/walker.py`` are the same program.
"""

from __future__ import annotations

import ast
import importlib.util
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

from torchsoro.version import VERSION

COMMANDS = (
    "view",
    "walker",
    "climber",
    "turner",
    "replay",
    "compare",
    "material",
    "film",
    "convert",
    "explain",
    "benchmark",
)
"""Recipes in the order of ``--help``; a recipe that is not there is left out."""


def recipe_folder() -> Path:
    """The folder of the recipes: in the package where it was installed, beside it in a checkout."""
    here = Path(__file__).parent
    return next((folder for folder in (here / "recipes", here.parent / "recipes") if folder.is_dir()), here / "recipes")


def summaries() -> dict[str, str]:
    """Each command and the first sentence of its recipe, which is parsed and not imported."""
    found = {}
    for name in COMMANDS:
        path = recipe_folder() / f"{name}.py"
        if path.exists():
            doc = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
            found[name] = re.split(r"(?<=[.?!])\s|\n\n", doc, maxsplit=1)[0].replace("\n", " ")
    return found


def usage() -> str:
    """The text of ``torchsoro --help``."""
    lines = [f"  {name:10s} {text}" for name, text in summaries().items()]
    head = "usage: torchsoro COMMAND [options]\n\nPneumatic soft robots, designed by gradient. Commands:\n"
    tail = "\n  torchsoro COMMAND --help    options of a command\n  torchsoro --version"
    return "\n".join([head, *lines, tail])


def load(name: str) -> ModuleType:
    """Import a recipe as ``torchsoro.recipes.<name>``.

    Args:
        name: One of ``COMMANDS``.

    Returns:
        The module.

    Raises:
        ValueError: for a command that does not exist.
    """
    if name not in COMMANDS:
        raise ValueError(f"command = {name!r}: wanted one of {', '.join(COMMANDS)}")
    dotted = f"torchsoro.recipes.{name}"
    spec = importlib.util.spec_from_file_location(dotted, recipe_folder() / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[dotted] = module  # dataclasses look their annotations up there
    spec.loader.exec_module(module)
    return module


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command.

    Args:
        arguments: Command and options; the process's own if not given.

    Raises:
        SystemExit: with code 2 for a command that does not exist; otherwise as the recipe ends.
    """
    command, *options = [*(sys.argv[1:] if arguments is None else arguments)] or ["--help"]
    if command in ("-h", "--help", "help"):
        print(usage())
    elif command == "--version":
        print(f"torchsoro {VERSION}")
    else:
        try:
            recipe = load(command)
        except ValueError as error:
            print(f"error: {error}", file=sys.stderr)
            raise SystemExit(2) from None
        sys.argv[0] = f"torchsoro {command}"  # what the usage line and the examples of the recipe's help begin with
        recipe.cli(options)


if __name__ == "__main__":
    main()
