"""Reports as one HTML file that opens from disk: text, tables, and pictures inside it."""

from __future__ import annotations

import base64
import html
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from torchsoro.storage import atomic_write

LONG = 40  # characters of a cell, from which on it is broken into lines

_STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.55 system-ui, sans-serif; color: #1f2933; }
body { max-width: 62rem; margin: 2.5rem auto; padding: 0 1.2rem; }
h1 { font-size: 1.7rem; line-height: 1.25; margin: 0 0 .8rem; }
h2 { font-size: 1.2rem; margin: 2.2rem 0 .6rem; border-bottom: 1px solid #dde3ea; padding-bottom: .25rem; }
p.lead { font-size: 1.08rem; background: #f2f6fa; border-left: 4px solid #396ba3; padding: .8rem 1rem; }
table { border-collapse: collapse; margin: .8rem 0 1.2rem; font-size: .9rem; display: block; overflow-x: auto; }
th, td { padding: .3rem .75rem; text-align: right; border-bottom: 1px solid #e4e9ef; white-space: nowrap; }
th { background: #f7f9fb; font-weight: 600; white-space: normal; }
th:first-child, td:first-child { text-align: left; }
td.long { text-align: left; white-space: normal; min-width: 14rem; }
figure { margin: 1rem 0 1.4rem; }
img { max-width: 100%; height: auto; }
figcaption, caption { color: #5b6875; font-size: .9rem; text-align: left; caption-side: top; padding: .2rem 0; }
pre { background: #f7f9fb; padding: .8rem 1rem; overflow-x: auto; font-size: .85rem; }
@media print { body { margin: 0; } figure, table { break-inside: avoid; } }
"""


class Document:
    """An HTML page that is built from top to bottom; everything is escaped, nothing is fetched.

    Args:
        title: Heading and name of the page.
        lead: The answer, in a paragraph at the top.
    """

    def __init__(self, title: str, lead: str) -> None:
        self._title = title
        self._parts = [f"<h1>{html.escape(title)}</h1>", f'<p class="lead">{html.escape(lead)}</p>']

    def section(self, heading: str) -> None:
        """Begin a section."""
        self._parts.append(f"<h2>{html.escape(heading)}</h2>")

    def text(self, paragraph: str) -> None:
        """A paragraph."""
        self._parts.append(f"<p>{html.escape(paragraph)}</p>")

    def code(self, lines: str) -> None:
        """Lines as they are, such as a command or a file."""
        self._parts.append(f"<pre>{html.escape(lines)}</pre>")

    def table(self, rows: Sequence[Mapping[str, Any]], caption: str = "") -> None:
        """Rows; their keys become the head. Numbers with four digits; what is missing, NaN or None as a dash.

        Raises:
            ValueError: without rows.
        """
        if not rows:
            raise ValueError("rows: wanted at least one")
        keys = list(dict.fromkeys(key for row in rows for key in row))
        head = "".join(f"<th>{html.escape(str(key))}</th>" for key in keys)
        body = "".join("<tr>" + "".join(_cell(shown(row.get(key))) for key in keys) + "</tr>" for row in rows)
        title = f"<caption>{html.escape(caption)}</caption>" if caption else ""
        self._parts.append(f"<table>{title}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>")

    def figure(self, figure: Figure, caption: str) -> None:
        """A Matplotlib figure, as a picture inside the page."""
        stream = io.BytesIO()
        figure.savefig(stream, format="png", dpi=150)
        self.picture(stream.getvalue(), caption)

    def picture(self, png: bytes, caption: str) -> None:
        """A PNG, inside the page."""
        data = base64.b64encode(png).decode("ascii")
        text = html.escape(caption)
        self._parts.append(
            f'<figure><img alt="{text}" src="data:image/png;base64,{data}"><figcaption>{text}</figcaption></figure>'
        )

    def save(self, path: Path) -> Path:
        """Write the page; it is there whole or not at all."""
        head = f'<meta charset="utf-8"><title>{html.escape(self._title)}</title><style>{_STYLE}</style>'
        lines = [
            "<!doctype html>",
            f'<html lang="en"><head>{head}</head>',
            "<body>",
            *self._parts,
            "</body></html>",
            "",
        ]
        with atomic_write(path) as file:
            file.write("\n".join(lines).encode())
        return path


def _cell(text: str) -> str:
    kind = ' class="long"' if len(text) > LONG else ""
    return f"<td{kind}>{html.escape(text)}</td>"


def shown(value: Any) -> str:
    """A cell of a table."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
