"""A web browser without a screen, steered by its DevTools protocol: pictures of a page, clicks, and values of scripts.

Needs chromium or chrome, and the package websockets, which viser brings along.
"""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import tempfile
import time
import urllib.request
from pathlib import Path
from types import TracebackType
from typing import Any

_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
# SwiftShader draws WebGL on the CPU; the sandbox needs rights that containers do not have.
_FLAGS = [
    "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader", "--hide-scrollbars",
    "--enable-unsafe-swiftshader", "--remote-debugging-port=0", "--no-first-run",
]  # fmt: skip
_START = 60.0  # [s]


def find_browser() -> str | None:
    """Return the path of an installed browser, or None."""
    return next((path for name in _NAMES if (path := shutil.which(name))), None)


class Browser:
    """One page in a browser. Use it in a `with` statement.

    Args:
        url: of the page.
        size: (width, height) [pixels] of the window.

    Raises:
        FileNotFoundError: no browser is installed.
        TimeoutError: the browser does not start.
    """

    def __init__(self, url: str, size: tuple[int, int] = (1280, 800)) -> None:
        from websockets.sync.client import connect

        path = find_browser()
        if path is None:
            raise FileNotFoundError("no browser: expected chromium or chrome on the PATH; install chromium")
        self._folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        window = f"--window-size={size[0]},{size[1]}"
        command = [path, *_FLAGS, window, f"--user-data-dir={self._folder.name}", url]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self._num_calls = 0
        try:
            self._socket = connect(self._find_page(), max_size=None)
        except BaseException:
            self._stop()
            raise

    def __enter__(self) -> Browser:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._socket.close()
        self._stop()

    def _stop(self) -> None:
        self._process.kill()
        self._process.wait()
        self._folder.cleanup()

    def _find_page(self) -> str:
        """Return the address of the page's DevTools, once the browser is up."""
        port_file, end = Path(self._folder.name) / "DevToolsActivePort", time.monotonic() + _START
        while time.monotonic() < end:
            if port_file.exists() and (lines := port_file.read_text().split()):
                with urllib.request.urlopen(f"http://127.0.0.1:{lines[0]}/json") as answer:
                    pages = [page for page in json.load(answer) if page["type"] == "page"]
                if pages:
                    return pages[0]["webSocketDebuggerUrl"]
            time.sleep(0.05)
        raise TimeoutError(f"the browser did not start within {_START:g} s")

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """Call a method of the DevTools protocol and return its result."""
        self._num_calls += 1
        self._socket.send(json.dumps({"id": self._num_calls, "method": method, "params": params}))
        while True:
            answer = json.loads(self._socket.recv(timeout=_START))
            if answer.get("id") == self._num_calls:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']['message']}")
                return answer["result"]

    def evaluate(self, script: str) -> Any:
        """Return the value of a JavaScript expression."""
        answer = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        return answer["result"].get("value")

    def wait_for(self, script: str, seconds: float = _START) -> Any:
        """Wait until a JavaScript expression is true and return its value.

        Raises:
            TimeoutError: it does not become true.
        """
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if value := self.evaluate(script):
                return value
            time.sleep(0.1)
        raise TimeoutError(f"not true within {seconds:g} s: {script}")

    def click(self, x: float, y: float) -> None:
        """Click with the left button at a pixel of the page."""
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            button = {} if kind == "mouseMoved" else {"button": "left", "clickCount": 1}
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **button)
            time.sleep(0.1)

    def picture(self) -> bytes:
        """Return a PNG of the page."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
