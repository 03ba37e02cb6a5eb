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

# Rooms from the ground up: a module may import those of a lower line, and those of its own room as long as that makes
# no circle. A room is a folder, or a file that lies beside the folders.
ORDER = """
errors version
storage command_line
simulation.laws simulation.axis simulation.sums
simulation.kernels
simulation.threads simulation.tracing
simulation.runtime
simulation.ops
simulation
rheology
design
benchmark
output
sim2real.data
sim2real.twin
sim2real.hypotheses
sim2real.inference
sim2real.report
sim2real.options sim2real.progress
sim2real.inputs
sim2real.pipeline
cli
"""
RANK = {name: rank for rank, line in enumerate(ORDER.split("\n")) for name in line.split()}

KNOWS_TORCH_AND_TAICHI = {"simulation.ops", "simulation.runtime", "benchmark"}
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
    "docs",
}
LONGEST = 500  # lines


def module_name(path: Path) -> str:
    """``simulation.material`` for its file, ``simulation`` for the folder's __init__.py, '' for the root."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


FILES = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}
MODULES = [name for name in FILES if name]


def room_of(module: str) -> str:
    """The entry of the order that a module stands under: the longest that begins its name."""
    rooms = [room for room in RANK if module == room or module.startswith(room + ".")]
    return max(rooms, key=len, default="")


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
    if not imported(module)[0]:
        return
    assert room_of(module), f"give torchsoro.{module} its place in ORDER"
    for other in imported(module)[0]:
        assert other, f"torchsoro.{module} imports from the package root; import from the module that defines the name"
        assert room_of(other), f"give torchsoro.{other} its place in ORDER"
        same_room = room_of(module) == room_of(other)
        assert same_room or RANK[room_of(other)] < RANK[room_of(module)], f"torchsoro.{module} imports {other}"


def test_no_module_imports_itself_through_others():
    graph = {module: imported(module)[0] & set(MODULES) for module in MODULES}
    while leaves := [module for module, needs in graph.items() if not needs & graph.keys()]:
        for module in leaves:
            del graph[module]
    assert not graph, f"a circle among {sorted(graph)}"


@pytest.mark.parametrize("module", ["", *MODULES])
def test_only_the_bridge_knows_torch_and_taichi(module):
    outside = imported(module)[1]
    if room_of(module) == "simulation.kernels":
        assert "torch" not in outside
    elif room_of(module) not in KNOWS_TORCH_AND_TAICHI:
        assert "taichi" not in outside


def test_no_program_among_the_recipes_is_imported_by_another_file():
    files = sorted((ROOT / "recipes").rglob("*.py"))
    programs = {path.stem for path in files if "__main__" in path.read_text(encoding="utf-8")}
    for path in files:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not programs & {name for name in names if "." not in name}, f"{path.name} imports {names}"


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


def test_explaining_imports_nothing_that_only_robots_and_meshes_need():
    code = (
        "import sys, torchsoro.sim2real.pipeline\n"
        "found = {'trimesh', 'meshio', 'networkx'} & set(sys.modules)\n"
        "assert not found, found"
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
