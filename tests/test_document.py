"""The HTML page: escaped, whole, self-contained, and its tables."""

from __future__ import annotations

import math
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from browser import browser
from matplotlib.figure import Figure

from torchsoro.output.document import Document
from torchsoro.output.slider import Moving, packed


class Page(HTMLParser):
    """Collects the cells, the addresses, and the tags that were opened and not closed."""

    def __init__(self) -> None:
        super().__init__()
        self.cells: list[str] = []
        self.sources: list[str] = []
        self.open: list[str] = []

    def handle_starttag(self, tag, attrs):
        self.sources += [value for name, value in attrs if name in ("src", "href")]
        if tag not in ("img", "meta"):
            self.open.append(tag)
        if tag in ("td", "th"):
            self.cells.append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] in ("td", "th"):
            self.cells[-1] += data


def read(path) -> Page:
    page = Page()
    page.feed(path.read_text(encoding="utf-8"))
    assert not page.open
    return page


def test_a_page_is_one_file_that_fetches_nothing(tmp_path):
    document = Document("A <title> & more", "It's <b>1 < 2</b>.")
    figure = Figure()
    figure.subplots().plot([0, 1])
    document.section("Pictures")
    document.figure(figure, 'with a "caption"')
    document.code("a < b")
    text = (path := document.save(tmp_path / "report.html")).read_text(encoding="utf-8")
    assert "A &lt;title&gt; &amp; more" in text and "<b>" not in text
    assert [source[:22] for source in read(path).sources] == ["data:image/png;base64,"]


def test_a_table_shows_every_column_and_a_dash_for_what_is_missing(tmp_path):
    document = Document("t", "l")
    document.table([{"a": 1.23456789, "b": math.nan}, {"a": True, "c": "x<y"}, {"a": None, "b": 2}], "caption")
    found = read(document.save(tmp_path / "t.html")).cells
    assert found == ["a", "b", "c", "1.235", "-", "-", "yes", "-", "x<y", "-", "2", "-"]


def test_a_table_without_rows_is_refused():
    with pytest.raises(ValueError, match="rows: wanted at least one"):
        Document("t", "l").table([])


def test_bars_are_as_long_as_their_share_of_the_longest(tmp_path):
    document = Document("t", "l")
    document.bars([("one", 2.0, "2 mm", 0), ("", 0.5, "0.5 mm", 1)], "errors")
    document.bars([("a", 0.3, "30 %", 1)], "probabilities", longest=1.0)
    text = document.save(tmp_path / "t.html").read_text(encoding="utf-8")
    read(tmp_path / "t.html")
    assert re.findall(r'class="(\w+)" width="([\d.]+)"', text) == [
        ("first", "100.0"),
        ("second", "25.0"),
        ("second", "30.0"),
    ]
    assert text.count("<dt>") == 2 and "<script>" not in text
    with pytest.raises(ValueError, match="rows: wanted at least one"):
        document.bars([], "errors")


def test_what_moves_is_drawn_in_a_browser_by_its_slider(tmp_path):
    corners = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.1, 0.0, 0.05], [0.0, 0.0, 0.05]])
    places = corners + np.linspace(0, 0.1, 5)[:, None, None] * np.array([1.0, 0.0, 0.0])
    moving = [Moving(name="plate", color="rgb(200, 0, 0)", places=places, faces=np.array([[0, 1, 2, 3]]))]
    document = Document("t", "l")
    document.slider(packed(np.linspace(0, 1, 5), moving, begin=1, azimuth=-90.0), "A plate.")
    page = document.save(tmp_path / "t.html")
    with browser(tmp_path / "profile") as window:
        window.open(page.as_uri())
        window.wait("document.querySelector('[data-part=state]').textContent !== ''")
        first = window.run("return document.querySelector('[data-part=state]').textContent")
        middles = [window.run(MIDDLE)]
        window.run(
            "const time = document.querySelector('[data-part=time]'); time.value = 4;"
            "time.dispatchEvent(new Event('input'))"
        )
        middles.append(window.run(MIDDLE))
    assert first == "0.250 s"
    # From a quarter to all of the way of 100 mm, where all that moves spans 200 mm.
    assert middles[1] - middles[0] > 50


# Mean place of what is red, in pixels of the canvas.
MIDDLE = """
const canvas = document.querySelector("canvas"), { width, height } = canvas;
const pixels = canvas.getContext("2d").getImageData(0, 0, width, height).data;
let sum = 0, count = 0;
for (let i = 0; i < pixels.length; i += 4)
  if (pixels[i + 3] && pixels[i] > 100 && pixels[i + 1] < 50) { sum += (i / 4) % width; count += 1; }
return sum / count;
"""
