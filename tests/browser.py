"""A page in headless Chromium, driven by its DevTools protocol; tests skip where there is none."""

from __future__ import annotations

import base64
import itertools
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import connect

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("chrome")
needs_chromium = pytest.mark.skipif(
    CHROMIUM is None, reason="there is no Chromium: apt-get install chromium"
)
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-quic", "--no-first-run", "--mute-audio"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    *("--disable-dev-shm-usage", "--remote-debugging-port=0", "--remote-allow-origins=*"),
    # WebGL without a GPU
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
)


class Page:
    """An open page.

    Attributes:
        errors: what went wrong in its scripts.
        asked: addresses that it has asked for.
    """

    def __init__(self, socket: Any) -> None:
        self._socket, self._numbers = socket, itertools.count(1)
        self.errors: list[str] = []
        self.asked: list[str] = []
        for domain in ("Page", "Runtime", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Result of a command of the protocol."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            said = json.loads(self._socket.recv(timeout=60))
            if said.get("method") == "Runtime.exceptionThrown":
                self.errors.append(json.dumps(said["params"]["exceptionDetails"])[:500])
            if said.get("method") == "Network.requestWillBeSent":
                self.asked.append(said["params"]["request"]["url"])
            if said.get("id") == number:
                assert "result" in said, said
                return dict(said["result"])

    def evaluate(self, script: str) -> Any:
        """Value of an expression in the page."""
        found = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        return found["result"].get("value")

    def wait_for(self, condition: str | Callable[[], Any], seconds: float = 120.0) -> Any:
        """The value of an expression in the page, or of a function here, once it is true."""
        deadline = time.monotonic() + seconds
        while True:
            found = self.evaluate(condition) if isinstance(condition, str) else condition()
            if found:
                return found
            assert time.monotonic() < deadline, (condition, self.errors)
            time.sleep(0.2)

    def screenshot(self, path: Path) -> Path:
        """Saves what the page shows as PNG."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot")["data"]))
        return path


@contextmanager
def open_page(url: str, profile: Path, size: tuple[int, int] = (1280, 800)) -> Iterator[Page]:
    """A page at an address, until the block is left.

    Args:
        profile: a new folder for Chromium's own files.
        size: of the window, pixels.
    """
    assert CHROMIUM is not None
    where = [f"--user-data-dir={profile}", f"--window-size={size[0]},{size[1]}", "about:blank"]
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with subprocess.Popen([CHROMIUM, *FLAGS, *where], **silent) as browser:  # type: ignore[call-overload]
        try:
            active = profile / "DevToolsActivePort"
            deadline = time.monotonic() + 60.0
            while not active.exists() or not active.read_text().strip():
                assert browser.poll() is None and time.monotonic() < deadline
                time.sleep(0.1)
            port = active.read_text().split()[0]
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=60) as answer:
                target = next(t for t in json.load(answer) if t["type"] == "page")
            with connect(
                target["webSocketDebuggerUrl"], max_size=None, ping_interval=None
            ) as socket:
                page = Page(socket)
                page.call("Page.navigate", url=url)
                yield page
        finally:
            browser.kill()  # a page that draws does not hear SIGTERM in time


def text_of_what_asks_nobody(file: Path, profile: Path, ready: str) -> str:
    """The text of a page in a file, once it shows an element `ready`; its scripts run without an
    error, and it asks no other machine for anything."""
    with open_page(file.as_uri(), profile) as page:
        page.wait_for(f"document.querySelectorAll('{ready}').length")
        shown = str(page.evaluate("document.body.innerText"))
        assert page.errors == []
        assert all(url.startswith(("file:", "blob:", "data:")) for url in page.asked)
    return shown
