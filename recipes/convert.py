"""Turn what a tracking program wrote into the markers.csv of an experiment that recipes/explain.py can explain.

    python recipes/convert.py marksDLC.csv --out my-experiment/trials/a/markers.csv --fps 100 --scale 0.0005
    python recipes/convert.py A.txt B.txt --out my-experiment/trials/a/markers.csv --rename "mass A=tip" "mass B=middle"
    python recipes/convert.py walk.c3d --out my-experiment/trials/a/markers.csv --axes=x,z,-y

Reads data files of Tracker (physlets.org), CSV of DeepLabCut and C3D of motion capture, recognized by ending and first
line. Nothing is resampled, smoothed or filled. Markers of setup.toml must have the same names; others do no harm.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import tyro

from torchsoro.command_line import program
from torchsoro.sim2real.data.recording import AXES, write_table
from torchsoro.sim2real.data.tracking import LIKELIHOOD, Frame, Tracked, read
from torchsoro.storage import check_folder


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """What to turn into what."""

    files: tyro.conf.Positional[tuple[Path, ...]]
    """File of a recording; several where Tracker wrote one for each mass."""
    out: Path
    """The markers.csv."""
    fps: float | None = None
    """Frames per second, for DeepLabCut."""
    scale: float | None = None
    """Metres in a pixel, or in another unit of the file. Needed for DeepLabCut; of Tracker 1; C3D says it itself."""
    axes: str = ""
    """Which of ours the file's axes are, an image's to the right and up: x,z is usual; --axes=-x,z seen from behind."""
    origin: tuple[float, ...] = ()
    """Where our origin is, in the file's coordinates and unit: for DeepLabCut a pixel."""
    start: float | None = None
    """Time of the release by the file's clock [s]; what is before is left out. The first sample if not given."""
    likelihood: float = LIKELIHOOD
    """Below which DeepLabCut's samples are lost."""
    rename: tuple[str, ...] = ()
    """Other names for markers, as old=new."""


def renamed(tracked: Tracked, changes: tuple[str, ...]) -> Tracked:
    """With other names for some markers.

    Args:
        tracked: Markers.
        changes: Each "old=new".

    Raises:
        ValueError: for a change of another form, a marker that is not there, or a name that two would have.
    """
    names: dict[str, str] = {}
    for change in changes:
        old, _, new = change.rpartition("=")
        if old not in tracked.names or not new.strip():
            raise ValueError(f"rename = {change!r}, wanted old=new with old one of {', '.join(tracked.names)}")
        names[old] = new
    found = tuple(names.get(name, name).strip() for name in tracked.names)
    if len(set(found)) < len(found):
        raise ValueError(f"rename: markers would be {', '.join(found)}, wanted names that differ")
    return dataclasses.replace(tracked, names=found)


def main(options: Options) -> None:
    """Write the markers.

    Raises:
        ValueError: for a file that cannot be read or written; nothing is written then.
    """
    if options.out.resolve() in [path.resolve() for path in options.files]:
        raise ValueError(f"out = {options.out}: one of the files to convert, wanted another")
    check_folder("out", options.out.parent, [options.out.name])
    frame = Frame(
        axes=options.axes.replace(" ", "").split(",") if options.axes else None,
        scale=options.scale,
        origin=options.origin or None,
        start=options.start,
    )
    tracked = renamed(read(options.files, frame, fps=options.fps, likelihood=options.likelihood), options.rename)
    write_table(options.out, tracked.columns())
    recording = tracked.recording
    for m, name in enumerate(tracked.names):
        seen = recording.seen[:, m, 0]  # one coordinate, as a sample is lost as a whole
        print(f"{name}: {seen.sum()} of {len(seen)} samples")
    if len(recording.axes) == 2:
        axes = ", ".join(f'"{AXES[a]}"' for a in recording.axes)
        print(f'in setup.toml: [recording] kind = "video", axes = [{axes}]')
    print(f"{options.out}: {recording.time[-1]:g} s")


cli = program(main, Options, __doc__)

if __name__ == "__main__":
    cli()
