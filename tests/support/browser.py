"""A headless Chromium that is driven through two pipes, by the protocol of its developer tools."""

import json
import os
import select
import shutil
import subprocess
import sys
import time
from base64 import b64decode
from pathlib import Path
from typing import Any

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
READY = "(root => root && (root.dataset.ready || root.dataset.failed) || null)(document.documentElement)"
SWITCHES = (
    *("--headless", "--no-sandbox", "--remote-debugging-pipe", "--no-first-run", "--disable-quic", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update", "--disable-extensions", "--mute-audio"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--hide-scrollbars"),
)

START = """import os, sys  # the browser reads from 3 and writes to 4
read, write = (os.dup(os.dup(os.dup(int(number)))) for number in sys.argv[1:3])
os.dup2(read, 3)
os.dup2(write, 4)
os.execv(sys.argv[3], sys.argv[3:])"""


class Browser:
    """One page in a browser of its own; `requests` are the addresses that it has asked for."""

    def __init__(self, folder: Path, width: int, height: int, scale: float = 1, touch: bool = False) -> None:
        read, self._to = os.pipe()
        self._from, write = os.pipe()
        arguments = [*SWITCHES, f"--user-data-dir={folder}", f"--window-size={width},{height}", "about:blank"]
        start = [sys.executable, "-ISc", START, str(read), str(write), str(CHROMIUM), *arguments]
        quiet = subprocess.DEVNULL
        self._process = subprocess.Popen(start, pass_fds=(read, write), stdin=quiet, stdout=quiet, stderr=quiet)
        os.close(read)
        os.close(write)
        self._number, self._bytes, self.requests, self.errors = 0, b"", [], []
        self._session: str | None = None
        target = next(t for t in self.call("Target.getTargets")["targetInfos"] if t["type"] == "page")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")
        self._screen = {"deviceScaleFactor": scale, "mobile": touch}
        self.resize(width, height)
        if touch:
            self.call("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)

    def resize(self, width: int, height: int) -> None:
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, **self._screen)

    def __enter__(self) -> "Browser":
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._to)
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._from)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method and return its result."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._to, json.dumps(message).encode() + b"\0")
        while (answer := self._next()).get("id") != self._number:
            self._note(answer)
        assert "error" not in answer, f"{method}: {answer['error']}"
        result: dict[str, Any] = answer["result"]
        return result

    def _next(self, seconds: float = 60) -> dict[str, Any]:
        while b"\0" not in self._bytes:
            assert select.select([self._from], [], [], seconds)[0], "the browser does not answer"
            more = os.read(self._from, 1 << 20)
            assert more, "the browser has ended"
            self._bytes += more
        line, _, self._bytes = self._bytes.partition(b"\0")
        data: dict[str, Any] = json.loads(line)
        return data

    def _note(self, event: dict[str, Any]) -> None:
        parameters = event.get("params", {})
        if event.get("method") == "Network.requestWillBeSent":
            self.requests.append(parameters["request"]["url"])
        if event.get("method") == "Runtime.exceptionThrown":
            details = parameters["exceptionDetails"]
            self.errors.append(details.get("exception", {}).get("description") or details["text"])
        if event.get("method") == "Log.entryAdded" and parameters["entry"]["level"] == "error":
            self.errors.append(parameters["entry"]["text"])

    def run(self, expression: str) -> Any:
        """Return the value of an expression, or of the promise that it is."""
        done = self.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in done, done["exceptionDetails"]
        return done["result"].get("value")

    def open(self, file: Path, part: str = "") -> None:
        """Open a page, with a part behind #, and wait until it is at rest."""
        self.visit(file.resolve().as_uri() + part)

    def visit(self, address: str) -> None:
        """Open a page at an address, and wait until it is at rest."""
        self.call("Page.navigate", url=address)
        self.rest()

    def rest(self) -> None:
        """Wait until the page shows its full picture."""
        self.wait(READY)

    def wait(self, expression: str, seconds: float = 60) -> Any:
        """Wait until an expression is true; return its value."""
        end = time.monotonic() + seconds
        while not (value := self.run(expression)):
            assert time.monotonic() < end, f"in vain: {expression}; errors of the page: {self.errors}"
            time.sleep(0.03)
        return value

    def key(self, key: str, kinds: tuple[str, ...] = ("keyDown", "keyUp"), modifiers: int = 0) -> None:
        for kind in kinds:
            self.call("Input.dispatchKeyEvent", type=kind, key=key, modifiers=modifiers)

    def mouse(self, kind: str, x: float, y: float, button: str = "none", **more: Any) -> None:
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, clickCount=1, **more)

    def drag(self, start: tuple[float, float], end: tuple[float, float], button: str = "left") -> None:
        held = {"left": 1, "right": 2}[button]
        self.mouse("mousePressed", *start, button, buttons=held)
        self.mouse("mouseMoved", *end, button, buttons=held)
        self.mouse("mouseReleased", *end, button)

    def touch(self, *steps: list[tuple[float, float]]) -> None:
        """Touch at the points of the first step, move through the others, and let go."""
        for i, points in enumerate(steps):
            kind = "touchStart" if i == 0 else "touchMove"
            self.call(
                "Input.dispatchTouchEvent",
                type=kind,
                touchPoints=[{"x": x, "y": y, "id": n} for n, (x, y) in enumerate(points)],
            )
        self.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    def click(self, selector: str) -> None:
        """Click the middle of an element."""
        box = f"(() => {{ const b = document.querySelector({json.dumps(selector)}).getBoundingClientRect();"
        x, y = self.run(f"{box} return [b.x + b.width / 2, b.y + b.height / 2]; }})()")
        self.mouse("mousePressed", x, y, "left", buttons=1)
        self.mouse("mouseReleased", x, y, "left")

    def picture(self) -> bytes:
        """Return what is on the screen, as PNG."""
        return b64decode(self.call("Page.captureScreenshot", format="png")["data"])
