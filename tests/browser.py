"""Headless Chromium for tests of pages, driven through its WebDriver in plain HTTP."""

from __future__ import annotations

import base64
import contextlib
import io
import json
import shutil
import socket
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
]


class Browser:
    """One window."""

    def __init__(self, base: str) -> None:
        self._base = base

    def call(self, path: str, method: str = "POST", **body: Any) -> Any:
        """A command of the WebDriver protocol."""
        data = json.dumps(body).encode() if method == "POST" else None
        request = urllib.request.Request(self._base + path, data, {"Content-Type": "application/json"}, method=method)
        with urllib.request.urlopen(request, timeout=60) as answer:
            return json.loads(answer.read())["value"]

    def open(self, address: str) -> None:
        """Go to a page."""
        self.call("/url", url=address)

    def run(self, script: str) -> Any:
        """Run a function's body in the page, and return its result."""
        return self.call("/execute/sync", script=script, args=[])

    def wait(self, condition: str, seconds: float = 40.0) -> None:
        """Wait until an expression is true."""
        end = time.monotonic() + seconds
        while not self.run(f"return Boolean({condition})"):
            assert time.monotonic() < end, f"{condition} did not become true within {seconds} s: {self.errors()}"
            time.sleep(0.1)

    def picture(self) -> np.ndarray:
        """What the window shows, uint8 [height, width, 3]."""
        with Image.open(io.BytesIO(base64.b64decode(self.call("/screenshot", "GET")))) as image:
            return np.asarray(image.convert("RGB"))

    def errors(self) -> list[str]:
        """Errors in the page's log since the last call."""
        entries = self.call("/se/log", type="browser")
        return [entry["message"] for entry in entries if entry["level"] == "SEVERE"]


@contextlib.contextmanager
def browser(profile: Path, width: int = 900, height: int = 700) -> Iterator[Browser]:
    """A browser with an empty profile; skips the test where there is none."""
    chromium, driver = shutil.which("chromium") or shutil.which("google-chrome"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("needs chromium and chromedriver on the path")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    options = {
        "binary": chromium,
        "args": [*FLAGS, f"--user-data-dir={profile}", f"--window-size={width},{height}"],
    }
    wanted = {"alwaysMatch": {"goog:chromeOptions": options, "goog:loggingPrefs": {"browser": "ALL"}}}
    with subprocess.Popen([driver, f"--port={port}"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            base = f"http://127.0.0.1:{port}"
            for _ in range(100):
                with contextlib.suppress(OSError), urllib.request.urlopen(base + "/status", timeout=5):
                    break
                time.sleep(0.1)
            session = Browser(base).call("/session", capabilities=wanted)["sessionId"]
            window = Browser(f"{base}/session/{session}")
            try:
                yield window
            finally:
                window.call("", "DELETE")
        finally:
            process.terminate()
