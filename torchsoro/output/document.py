"""Reports as one HTML file that opens from disk: text, tables, and pictures inside it."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
from jinja2.utils import htmlsafe_json_dumps
from markupsafe import Markup
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from torchsoro.output.canvas import pixels
from torchsoro.output.slider import SCRIPT
from torchsoro.storage import atomic_write

TONES = ("first", "second", "third")  # colours of numbers and bars
DPI = 130  # of a figure's picture
COLORS = 256  # of a figure's picture, which makes its file a third as large
LONG = 40  # characters of a cell, above which its column is kept wide enough for whole phrases

_TEMPLATES = jinja2.Environment(
    loader=jinja2.PackageLoader("torchsoro.output"),
    autoescape=True,
    trim_blocks=True,
    lstrip_blocks=True,
    undefined=jinja2.StrictUndefined,
)


class Document:
    """An HTML page that is built from top to bottom; everything is escaped, nothing is fetched.

    Args:
        title: Heading and name of the page.
        lead: The answer, in a paragraph at the top.
    """

    def __init__(self, title: str, lead: str) -> None:
        self._title, self._lead = title, lead
        self._parts: list[dict[str, Any]] = []
        self._script = ""

    def section(self, heading: str) -> None:
        """Begin a section."""
        self._add("section", text=heading)

    def text(self, paragraph: str) -> None:
        """A paragraph."""
        self._add("text", text=paragraph)

    def points(self, lines: Sequence[str]) -> None:
        """A list of sentences; nothing if there is none."""
        if lines:
            self._add("points", lines=list(lines))

    def numbers(self, rows: Sequence[tuple[str, str]]) -> None:
        """Large numbers beside each other, up to three: each as it is written, and what it is of."""
        cells = [{"value": value, "name": name, "tone": tone} for (value, name), tone in zip(rows, TONES, strict=False)]
        self._add("numbers", rows=cells)

    def bars(self, rows: Sequence[tuple[str, float, str, int]], caption: str, *, longest: float = 0.0) -> None:
        """Bars below each other; two such blocks that follow each other stand side by side.

        Args:
            rows: Name (none if it is that of the bar above), length, the same as it is written, and number of the
                colour, 0 to 2.
            caption: Above.
            longest: Length of the whole width; that of the longest bar if 0.

        Raises:
            ValueError: without rows.
        """
        if not rows:
            raise ValueError("rows: wanted at least one")
        whole = longest or max(length for _, length, _, _ in rows) or 1.0
        cells = [
            {"name": name, "value": value, "tone": TONES[tone], "length": f"{max(100 * length / whole, 0.4):.1f}"}
            for name, length, value, tone in rows
        ]
        self._add("bars", rows=cells, caption=caption)

    def code(self, lines: str) -> None:
        """Lines as they are, such as a command or a file."""
        self._add("code", text=lines)

    def table(self, rows: Sequence[Mapping[str, Any]], caption: str = "", *, folded: str = "") -> None:
        """A table.

        Args:
            rows: Their keys become the head. Numbers are shown with four digits; what is missing, NaN or None, as a
                dash. A column of numbers is aligned to the right.
            caption: Above the table.
            folded: A line that the reader has to open to see the table; it is always seen if empty.

        Raises:
            ValueError: without rows.
        """
        if not rows:
            raise ValueError("rows: wanted at least one")
        keys = list(dict.fromkeys(key for row in rows for key in row))
        columns = [{"name": str(key), "number": _numbers([row.get(key) for row in rows])} for key in keys]
        cells = [[shown(row.get(key)) for key in keys] for row in rows]
        self._add("table", columns=columns, rows=cells, caption=caption, folded=folded)

    def figure(self, figure: Figure, caption: str, *, folded: str = "") -> None:
        """A Matplotlib figure, as a picture inside the page; ``folded`` as in :meth:`table`."""
        figure.set_dpi(DPI)
        image = Image.fromarray(pixels(FigureCanvasAgg(figure)))
        stream = io.BytesIO()
        # Of methods, this one keeps colours of few pixels.
        image.quantize(COLORS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(stream, "PNG", optimize=True)
        self.picture(stream.getvalue(), caption, folded=folded)

    def picture(self, png: bytes, caption: str, *, folded: str = "") -> None:
        """A PNG, inside the page; ``folded`` as in :meth:`table`."""
        self._add("picture", data=base64.b64encode(png).decode("ascii"), caption=caption, folded=folded)

    def slider(self, about: Mapping[str, Any], caption: str) -> None:
        """What moves, with a slider over time; nothing is seen of it where scripts do not run, or on paper.

        Args:
            about: Of :func:`torchsoro.output.slider.packed`.
            caption: Below.
        """
        self._script = SCRIPT.read_text(encoding="utf-8")
        self._add("slider", about=htmlsafe_json_dumps(about, separators=(",", ":")), caption=caption)

    def save(self, path: Path) -> Path:
        """Write the page; it is there whole or not at all."""
        template = _TEMPLATES.get_template("document.html")
        page = template.render(
            title=self._title, lead=self._lead, parts=self._parts, long=LONG, script=Markup(self._script)
        )
        with atomic_write(path) as file:
            file.write(page.encode())
        return path

    def _add(self, kind: str, *, folded: str = "", **content: Any) -> None:
        self._parts.append({"kind": kind, "folded": folded, **content})


def _numbers(values: Sequence[Any]) -> bool:
    """Whether all values of a column are numbers, or missing."""
    return all(v is None or (isinstance(v, int | float) and not isinstance(v, bool)) for v in values)


def shown(value: Any) -> str:
    """A cell of a table."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
