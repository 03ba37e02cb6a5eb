"""Where the published recordings are, for tests that need them."""

import os

import pytest

RECORDINGS = os.environ.get("TORCHSORO_RECORDINGS")
recordings = pytest.mark.skipif(RECORDINGS is None, reason="TORCHSORO_RECORDINGS does not name the recordings' folder")
