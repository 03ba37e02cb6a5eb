"""The structure of the package: the direction of the imports, the size of the files, what lies at the top."""

from __future__ import annotations

import ast
import functools
import subprocess
import sys
from pathlib import Path

import pytest

import torchsoro

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "torchsoro"

# A module may import those of a line above its own; modules on one line do not know each other. The files of a folder
# that is listed as a whole ("kernels") may import each other, as long as that makes no circle.
ORDER = """
errors storage
document
runtime
domain
field actuation contact selfcontact
material
materialfile loads
kernels
ops
assembly
simulator
rheology
objective
lagrangian
training
levelset
fabricate
scene
page
picture
settings
archive
robot
results
sim2real.recording sim2real.surface
sim2real.experiment sim2real.scenario sim2real.grid sim2real.tracking
sim2real.twin
sim2real.ensemble
sim2real.hypothesis sim2real.residual
sim2real.body_effects
sim2real.outer_effects
sim2real.library
sim2real.likelihood sim2real.likeness
sim2real.fit
sim2real.histories
sim2real.heldout sim2real.isolability sim2real.model sim2real.numerics sim2real.forcemap
sim2real.next_experiment
sim2real.ranking
sim2real.search
sim2real.verdict sim2real.phases
sim2real.drawings
sim2real.report
"""
RANK = {name: rank for rank, line in enumerate(ORDER.split("\n")) for name in line.split()}
FOLDERS = {"kernels", "ops", "rheology"}

KNOWS_TORCH_AND_TAICHI = {"ops", "runtime"}
TOP_LEVEL = {
    "pyproject.toml",
    "constraints.txt",
    "LICENSE",
    "README.md",
    "CHANGELOG.md",
    "torchsoro",
    "recipes",
    "tests",
    "notebooks",
}
LONGEST = 500  # lines


def module_name(path: Path) -> str:
    """``kernels.stress`` for torchsoro/kernels/stress.py, ``kernels`` for its __init__.py, '' for the root."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


FILES = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}
MODULES = [name for name in FILES if name]


def line_of(module: str) -> str:
    """The entry of the order that a module stands under."""
    folder = module.split(".")[0]
    return folder if folder in FOLDERS else module


@functools.cache
def imported(module: str) -> tuple[set[str], set[str]]:
    """The modules of torchsoro ('' is the root itself) and the other top-level packages that a module imports."""
    inside: set[str] = set()
    outside: set[str] = set()

    def note(dotted: str) -> None:
        first, _, rest = dotted.partition(".")
        if first != "torchsoro":
            outside.add(first)
            return
        while rest and rest not in FILES:  # the last part is a name in the module
            rest = rest.rpartition(".")[0]
        inside.add(rest)

    path = FILES[module]
    package = ["torchsoro", *path.relative_to(PACKAGE).parent.parts]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            for alias in node.names:
                note(alias.name)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            source = ".".join([*base, *(node.module or "").split(".")]).rstrip(".")
            for alias in node.names:
                note(f"{source}.{alias.name}")
    return inside - {module}, outside


@pytest.mark.parametrize("module", MODULES)
def test_imports_point_one_way(module):
    if module == "sim2real":  # only re-exports
        return
    assert line_of(module) in RANK, f"give torchsoro.{module} its place in ORDER"
    for other in imported(module)[0]:
        assert other, f"torchsoro.{module} imports from the package root; import from the module that defines the name"
        assert line_of(other) in RANK, f"give torchsoro.{other} its place in ORDER"
        same_folder = line_of(module) == line_of(other) and line_of(module) in FOLDERS
        assert same_folder or RANK[line_of(other)] < RANK[line_of(module)], f"torchsoro.{module} imports {other}"


def test_no_module_imports_itself_through_others():
    graph = {module: imported(module)[0] & set(MODULES) for module in MODULES}
    while leaves := [module for module, needs in graph.items() if not needs & graph.keys()]:
        for module in leaves:
            del graph[module]
    assert not graph, f"a circle among {sorted(graph)}"


@pytest.mark.parametrize("module", ["", *MODULES])
def test_only_the_bridge_knows_torch_and_taichi(module):
    outside = imported(module)[1]
    if line_of(module) == "kernels":
        assert "torch" not in outside
    elif line_of(module) not in KNOWS_TORCH_AND_TAICHI:
        assert "taichi" not in outside


def test_no_module_is_called_utils():
    assert not [name for name in MODULES if {"utils", "util", "helpers", "misc"} & set(name.split("."))]


def test_importing_the_package_starts_no_taichi():
    code = (
        "import sys, warnings; warnings.simplefilter('ignore'); import torchsoro\n"
        "if 'taichi' in sys.modules:\n"
        "    from taichi.lang import impl\n"
        "    assert impl.get_runtime().prog is None, 'ti.init was called by the import'"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_every_public_name_is_defined_in_one_module():
    names = getattr(torchsoro, "__all__", [])
    assert len(set(names)) == len(names)
    for name in names:
        homes = [module for module in MODULES if name in defined(module)]
        own = name in defined("")
        assert len(homes) + own == 1 or name == "__version__", f"torchsoro.{name} is defined in {homes}"


@functools.cache
def defined(module: str) -> set[str]:
    """Names that the top level of a module defines, imports left out."""
    found: set[str] = set()
    for node in ast.parse(FILES[module].read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef):
            found.add(node.name)
        elif isinstance(node, ast.Assign):
            found.update(target.id for target in node.targets if isinstance(target, ast.Name))
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            found.add(node.target.id)
    return found


def test_no_file_is_too_long():
    files = [path for folder in ("torchsoro", "recipes", "tests") for path in (ROOT / folder).rglob("*.py")]
    lengths = {str(path.relative_to(ROOT)): len(path.read_text(encoding="utf-8").splitlines()) for path in files}
    assert not {name: length for name, length in lengths.items() if length > LONGEST}


def test_the_top_level_holds_only_what_is_allowed():
    try:
        done = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout")
    names = {line.split("/")[0] for line in done.stdout.splitlines()}
    assert not {name for name in names if not name.startswith(".")} - TOP_LEVEL
