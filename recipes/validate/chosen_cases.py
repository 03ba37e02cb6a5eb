"""Which experiments of a folder a recipe is about."""

from __future__ import annotations

from pathlib import Path


def names_of(folder: Path, cases: tuple[str, ...]) -> tuple[str, ...]:
    """The given cases, or all of a folder.

    Raises:
        ValueError: for a folder without one that is given.
    """
    names = cases or tuple(sorted(p.name for p in folder.iterdir() if (p / "setup.toml").exists()))
    for name in names:
        if not (folder / name / "setup.toml").exists():
            raise ValueError(f"cases: {name} is not in {folder}, wanted a folder with setup.toml")
    return names
