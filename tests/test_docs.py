"""README and docs: links lead somewhere, code runs, commands and files exist, numbers are the archive's."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import shlex
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from torchsoro import cli
from torchsoro.sim2real.data.schema import (
    BodyTable,
    ChamberTable,
    ClampTable,
    ForceTable,
    Marker,
    Material,
    PlaneTable,
    RecordingTable,
    SetupFile,
)

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs/pages").rglob("*.md"))]
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]
FENCE = re.compile(r"^```(\w*)([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
RUNS = [name for name, page in zip(NAMES, PAGES, strict=True) if "```python\n" in page.read_text(encoding="utf-8")]
SLOW = {"docs/pages/air.md", "docs/pages/design.md"}  # they simulate


def prose(page: Path) -> str:
    """A page without its code blocks."""
    return FENCE.sub("", page.read_text(encoding="utf-8"))


@cache
def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as mkdocs and GitHub make them."""
    found = set()
    for title in re.findall(r"^#+ (.+)$", prose(page), re.MULTILINE):
        plain = re.sub(r"[`*]", "", title).lower()
        found.add(re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", plain)).strip("-"))
    return found


@pytest.mark.parametrize("name", NAMES)
def test_every_internal_link_and_anchor_resolves(name):
    page = ROOT / name
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)) + re.findall(r'(?:src|href)="([^"]+)"', prose(page)):
        if re.match(r"https?:", target):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{name}: {target}"
        assert not anchor or anchor in anchors(file), f"{name}: {target}, wanted one of {sorted(anchors(file))}"


@pytest.mark.parametrize("name", NAMES)
def test_every_file_that_is_mentioned_exists(name):
    text = (ROOT / name).read_text(encoding="utf-8")
    roots = "recipes|torchsoro|notebooks|tests|docs"
    for path in re.findall(rf"(?<![\w/.])((?:{roots})/[\w./-]*\w|\.ci/run)", text):
        assert (ROOT / path).exists() or (ROOT / path).with_suffix(".py").exists(), f"{name}: {path}"
    for module in re.findall(r"`(torchsoro(?:\.\w+)+)`", text):
        parts = module.split(".")
        there = [ROOT.joinpath(*parts[:k]) for k in range(2, len(parts) + 1)]
        assert any(path.is_dir() or path.with_suffix(".py").exists() for path in there), f"{name}: {module}"


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in RUNS]
)
def test_every_python_block_runs(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    run_blocks(ROOT / name)
    assert capsys.readouterr().out.strip(), "wanted something to see"


def run_blocks(page: Path) -> None:
    """Run a page's Python blocks one after the other in this folder, beside the files that it shows by name."""
    blocks = FENCE.findall(page.read_text(encoding="utf-8"))
    for _, options, text in blocks:
        if title := re.search(r'title="([^"]+)"', options):
            file = Path(title[1])
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text, encoding="utf-8")
    names: dict[str, object] = {"__name__": "__main__"}
    for language, _, text in blocks:
        if language == "python":
            exec(compile(text, page.name, "exec"), names)


@pytest.mark.slow
def test_the_experiment_of_the_page_is_explained(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_blocks(ROOT / "docs/pages/explain.md")
    command = [sys.executable, "-m", "torchsoro.cli", "explain", "my-experiment", "--out", "out", "--budget", "1"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=550)
    assert done.returncode == 0, done.stderr
    assert {"report.html", "explanation.json"} <= {file.name for file in (tmp_path / "out").iterdir()}


def commands(page: Path) -> list[list[str]]:
    """Calls of recipes in the shell blocks and the inline code of a page, as words."""
    text = page.read_text(encoding="utf-8")
    lines = [
        line for language, _, block in FENCE.findall(text) if language in ("bash", "text") for line in block.split("\n")
    ]
    lines += re.findall(r"`([^`\n]+)`", prose(page)) + re.findall(r"^    (python .+)$", text, re.MULTILINE)
    found = []
    for line in lines:
        for part in re.split(r"&&|, then ", line):
            if re.match(r"(torchsoro [a-z]|torchsoro --|python recipes/)", part.strip()):
                found.append(shlex.split(part.strip(), comments=True))
    return found


@cache
def options_of(script: str) -> str:
    """The source of a recipe and of what it imports of its own folder and of torchsoro's command lines."""
    path = ROOT / script
    beside = [p for p in path.parent.glob("*.py") if re.search(rf"\b{p.stem}\b", path.read_text(encoding="utf-8"))]
    more = [ROOT / "torchsoro/design/settings.py", *(ROOT / "torchsoro").rglob("*.py")]
    return "\n".join(p.read_text(encoding="utf-8") for p in [path, *beside, *more])


@cache
def flags_of(command: str) -> set[str]:
    """Flags in the help of a command."""
    with contextlib.redirect_stdout(io.StringIO()) as told, pytest.raises(SystemExit):
        cli.main([command, "--help"])
    return set(re.findall(r"--[\w-]+", told.getvalue()))


@pytest.mark.parametrize("name", NAMES)
def test_every_command_is_a_recipe_that_knows_its_flags(name, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["torchsoro"])
    for words in commands(ROOT / name):
        flags = {re.sub(r"=.*", "", w) for w in words if w.startswith("--")}
        if words[0] == "torchsoro":
            command = words[1] if not words[1].startswith("--") else ""
            known = {"--help", "--version"}
            if command:
                assert command in cli.summaries(), f"{name}: {' '.join(words)}"
                known |= flags_of(command)
            assert flags <= known, f"{name}: {' '.join(words)}: {flags - known}"
        else:
            assert (ROOT / words[1]).exists(), f"{name}: {words[1]}"
            source = options_of(words[1])
            for flag in flags - {"--help"}:
                field = flag[2:].removeprefix("no-").replace("-", "_")
                assert re.search(rf"^\s+{field}: ", source, re.MULTILINE), f"{name}: {' '.join(words)}: {flag}"


def test_every_field_of_an_experiment_is_described():
    page = (ROOT / "docs/pages/explain.md").read_text(encoding="utf-8")
    tables = {
        "body": BodyTable,
        "material": Material,
        "clamp": ClampTable,
        "chamber": ChamberTable,
        "plane": PlaneTable,
    }
    tables |= {"load": ForceTable, "marker": Marker, "recording": RecordingTable}
    for name, model in tables.items():
        text = re.split(r"^(?:`\[|#)", part_of(page, name), maxsplit=1, flags=re.M)[0]
        for field in model.model_fields:
            assert f"| `{field}` |" in text, f"[{name}]: {field}"
    for field in SetupFile.model_fields:
        assert f"`{field}`" in page or f"[{field}]" in page, field


def part_of(page: str, table: str) -> str:
    """What the page says under the heading of a table."""
    found = re.search(rf"^`\[+{table}\]+`.*?$(.*)", page, re.M | re.S)
    assert found, table
    return found[1]


def result(robot: str) -> dict[str, float]:
    """What the archive holds of a robot."""
    return json.loads((ROOT / "torchsoro/designs" / robot / "result.json").read_text())


def test_the_numbers_of_the_archived_robots_are_those_of_their_files():
    numbers = (ROOT / "docs/pages/numbers.md").read_text(encoding="utf-8")
    readme = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    r = result("walker")
    way = f"{1e3 * r['stride']:.1f} mm; {1e3 * r['L']:.1f} mm"
    assert f"| {way} |" in numbers
    rest = f"{r['C']:.4f}, {r['iterations']}, {r['forward'] + r['backward']:.1f} s, {r['seconds'] / 60:.1f} min (H200)"
    assert rest in numbers
    for robot in ("slope30", "slope58", "climber"):
        r = result(robot)
        row = next(line for line in numbers.splitlines() if f"{1e3 * r['L']:.1f} mm" in line and "iterations" in line)
        assert f"C = {r['C']:.4f}, {r['iterations']} iterations" in row
        assert f"{r['seconds'] / 60:.0f} min" in row
    for robot in ("walker", "climber"):
        r = result(robot)
        assert f"{1e3 * r['L']:.1f} mm in half a second" in readme
        assert f"{1e3 * r['stride']:.1f} mm per cycle" in readme


def test_the_readme_is_read_in_five_minutes():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 150
    assert len(text.split()) <= 900


def test_pictures_are_small():
    for picture in (ROOT / "docs/pages/pictures").glob("*"):
        assert picture.stat().st_size < 1_000_000, picture.name


@pytest.mark.slow
def test_the_site_builds_strictly(tmp_path):
    command = [
        sys.executable,
        "-m",
        "mkdocs",
        "build",
        "--strict",
        "-f",
        "docs/mkdocs.yml",
        "-d",
        str(tmp_path / "site"),
    ]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "site/index.html").read_text(encoding="utf-8")
    assert "fonts.googleapis" not in page
