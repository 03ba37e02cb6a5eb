"""Where settings come from: a command line over a preset, or the file that a run has left."""

from __future__ import annotations

import argparse
import dataclasses
import json
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from torchsoro.command_line import CommandLine, as_called, plain_errors
from torchsoro.design.processes import take_gpu
from torchsoro.design.settings import Settings, cuda_available

CHAMBERS = "chambers.json"  # settings of the chambers that a run has designed, beside those that it began with
ROAM = 0.5  # m around a body that is watched for longer than its design run took
# Flags by theme, for --help: each group begins with a field and goes on to the next that is named here.
GROUPS = {
    "robot": "run",
    "size": "body",
    "youngs_modulus": "material",
    "pressure": "actuation",
    "gravity": "surroundings",
    "scenarios": "scenarios",
    "dt": "simulation",
    "filter_radius": "optimization",
    "picture_every": "output",
}


def design_program(
    main: Callable[[Settings], object], presets: Mapping[str, Settings], description: str | None
) -> CommandLine:
    """The command line of a design recipe; see :func:`torchsoro.command_line.program`.

    Args:
        main: What the recipe does with its settings.
        presets: See :func:`from_command_line`.
        description: Text on top of ``--help``.
    """

    def cli(arguments: Sequence[str] | None = None) -> None:
        take_gpu()
        with plain_errors():
            main(from_command_line(presets, description=description, arguments=arguments))

    return cli


def from_command_line(
    presets: Mapping[str, Settings], *, description: str | None, arguments: Sequence[str] | None = None
) -> Settings:
    """Read settings from the command line: a preset, and any of its numbers overridden.

    A run that is resumed has its own settings in place of a preset.

    Args:
        presets: Named settings; without ``--preset``, "paper" is taken on CUDA and "desk" elsewhere.
        description: Text on top of ``--help``.
        arguments: Instead of the process's own.

    Returns:
        The settings; ends the process with a message if a flag is unknown or a value of the wrong kind.

    Raises:
        ValueError: if a value is out of its range.
    """
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--preset", default=None)
    first.add_argument("--device", default="auto")
    first.add_argument("--out", type=Path)
    first.add_argument("--resume", action="store_true")
    first.add_argument("-h", "--help", action="store_true")
    known, _ = first.parse_known_args(arguments)
    # The help does not wait for torch to say whether there is a GPU, and shows the desk preset.
    gpu = known.device == "cuda" or (known.device == "auto" and not known.help and cuda_available())
    name = known.preset or ("paper" if gpu else "desk")
    # A preset that does not exist is refused by tyro.
    default = presets.get(name, presets["desk"])
    out = known.out or default.out
    if known.resume and known.preset is None and (begun := out / "settings.json").is_file():
        now = {"out": out, "device": known.device, "amend": False, "overwrite": False}  # of this call, not of the run
        default = _settings(begun, _object(begun), now)
    # The help joins lines that begin with a letter to paragraphs; commands are to keep theirs.
    text = re.sub(r"\n *(?=(?:python|torchsoro|tensorboard) )", "\n$ ", as_called(description))
    groups = tyro.cli(_grouped(default), args=arguments, description=text, config=(tyro.conf.OmitArgPrefixes,))
    chosen = {name: value for group in vars(groups).values() for name, value in vars(group).items()}
    return Settings(**chosen)


def _grouped(default: Settings) -> type[Any]:
    """The settings as a dataclass of groups, each of which is a dataclass of fields without checks."""
    members: dict[str, list[tuple[str, Any, Any]]] = {}
    title = ""
    described: Any = Settings
    for name, field in described.__pydantic_fields__.items():
        title = GROUPS.get(name, title)
        kind = Annotated[field.annotation, tyro.conf.arg(help=field.description)]
        member = (name, kind, dataclasses.field(default=getattr(default, name)))
        members.setdefault(title, []).append(member)
    groups = []
    for title, fields in members.items():
        group = dataclasses.make_dataclass(title, fields, frozen=True)
        groups.append((group.__name__, group, dataclasses.field(default_factory=group)))
    return dataclasses.make_dataclass("Groups", groups, frozen=True)


def read_settings(path: Path, **changes: object) -> Settings:
    """Read the settings of a run.

    Chambers whose place or size was designed are given, as they were delivered, once there is a ``chambers.json``.

    Args:
        path: Its ``settings.json``.
        **changes: Settings to replace.

    Returns:
        The settings; names that the file does not have keep their defaults.

    Raises:
        ValueError: if there is no such file, it is damaged, a name in it is none of the settings, or a value is out of
            its range.
    """
    delivered = path.with_name(CHAMBERS)
    return _settings(path, _object(path) | (_object(delivered) if delivered.is_file() else {}), changes)


def lasting(s: Settings, duration: float) -> Settings:
    """The settings with another time of actuation [s]; a walk that lasts longer leaves the box of the design run."""
    room = max(s.room, ROAM) if duration > s.duration else s.room
    return dataclasses.replace(s, duration=duration, room=room)


def _object(path: Path) -> dict[str, Any]:
    """What a file of settings holds."""
    wanted = "wanted the settings.json of a run"
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"path: {path} holds no settings ({error}), {wanted}") from error
    if not isinstance(found, dict):
        raise ValueError(f"path: {path} holds a {type(found).__name__}, {wanted}")
    return found


def _settings(path: Path, found: dict[str, Any], changes: Mapping[str, object]) -> Settings:
    """Those that were found in a file, with changes."""
    if unknown := sorted(set(found) - {field.name for field in dataclasses.fields(Settings)}):
        raise ValueError(f"path: {path} has {', '.join(unknown)}, wanted names of the settings only")
    try:
        return Settings(**{**found, **changes})
    except ValueError as error:
        raise ValueError(f"path: {path}: {error}") from error
