"""The HTML page: escaped, whole, self-contained, and its tables."""

from __future__ import annotations

import math
from html.parser import HTMLParser

import pytest
from matplotlib.figure import Figure

from torchsoro.output.document import Document


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
