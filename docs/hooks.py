"""What mkdocs does to the pages beside its plugins."""

from __future__ import annotations

import re
from typing import Any


def on_page_content(html: str, **_: Any) -> str:
    """Roles of docstrings, which mean something to Sphinx only: their names stay."""
    return re.sub(r":(?:func|class|meth|mod):(?:torchsoro\.)?\s*(?=<code>)", "", html)
