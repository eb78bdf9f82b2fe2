"""A page in a browser without a window, looked at and clicked on through Chromium's own protocol."""

from __future__ import annotations

import base64
import contextlib
import io
import json
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import browser_command
from PIL import Image

# What a label of viser's panel stands beside: the nearest element around it that holds such a thing.
_BESIDE = """(() => {
  let around = [...document.querySelectorAll('label, div')].find(
    each => !each.children.length && each.textContent.trim() === %s);
  for (let i = 0; around && i < 7; i++) {
    around = around.parentElement;
    const found = around && around.querySelector(%s);
    if (found) { window.found = found; return true; }
  }
  return false;
})()"""
_NAMED = """(() => {
  window.found = [...document.querySelectorAll(%s)].filter(each => each.textContent.trim() === %s).pop();
  return Boolean(window.found);
})()"""


class Page:
    """A page that is open."""

    def __init__(self, address: str) -> None:
        client = pytest.importorskip("websockets.sync.client", reason="extra `viewer` is not installed")
        self._socket, self._calls = client.connect(address, max_size=None), 0

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """A method of the protocol."""
        self._calls += 1
        self._socket.send(json.dumps({"id": self._calls, "method": method, "params": parameters}))
        while (answer := json.loads(self._socket.recv(timeout=120))).get("id") != self._calls:
            pass
        assert "error" not in answer, answer
        return answer["result"]

    def value(self, script: str) -> Any:
        """What a script gives."""
        answer = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def picture(self) -> np.ndarray:
        """What the page looks like, [H, W, 3] uint8."""
        content = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))

    def press(self, text: str) -> None:
        """The button that says so."""
        self._find(_NAMED % (json.dumps("button, span"), json.dumps(text)))
        self.value("found.click()")

    def tick(self, label: str) -> None:
        """The box beside a label."""
        self._find(_BESIDE % (json.dumps(label), json.dumps("input[type=checkbox]")))
        self.value("found.click()")

    def type(self, label: str, number: float) -> None:
        """Into the number field beside a label."""
        self._find(_BESIDE % (json.dumps(label), json.dumps("input[inputmode]")))
        self.value("found.focus(); found.select()")
        self.call("Input.insertText", text=str(number))
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key="Enter", code="Enter", windowsVirtualKeyCode=13)

    def choose(self, label: str, option: str) -> None:
        """Of the list beside a label."""
        self._find(_BESIDE % (json.dumps(label), json.dumps("input")))
        place = self.value("(() => { const b = found.getBoundingClientRect(); return [b.x + 9, b.y + 9]; })()")
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=place[0], y=place[1], button="left", clickCount=1)
        self._find(_NAMED % (json.dumps("[role=option]"), json.dumps(option)))
        self.value("found.click()")

    def _find(self, script: str) -> None:
        end = time.monotonic() + 30
        while not self.value(script):
            assert time.monotonic() < end, f"the page has no such thing: {script}"
            time.sleep(0.1)

    def close(self) -> None:
        """Lets go of the page."""
        self._socket.close()


@contextlib.contextmanager
def opened(address: str, profile: Path, downloads: Path, *options: str) -> Iterator[Page]:
    """A browser that looks at an address while the block runs, and saves what it is sent in a folder."""
    command = [*browser_command(profile), *options, "--remote-debugging-port=0", address]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        end, found = time.monotonic() + 60, None
        while found is None:
            assert time.monotonic() < end, "the browser does not answer"
            time.sleep(0.1)
            with contextlib.suppress(OSError, IndexError, StopIteration):
                port = (profile / "DevToolsActivePort").read_text().split()[0]
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=10) as answer:
                    found = next(each for each in json.load(answer) if each["type"] == "page")
        with contextlib.closing(Page(found["webSocketDebuggerUrl"])) as page:
            page.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(downloads))
            yield page
    finally:
        process.terminate()
        process.wait(60)
