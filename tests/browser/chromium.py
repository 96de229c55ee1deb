"""A headless Chromium for tests and pictures, driven over the DevTools protocol through a pair of pipes.

No driver program, no port and no Python package: the browser reads commands from its descriptor 3 and answers
on descriptor 4, each a JSON object that ends in a zero byte. What a page reports as wrong (console errors,
uncaught exceptions, failed loads, violations of its content security policy) gathers in
:attr:`Page.problems`.
"""

from __future__ import annotations

import base64
import contextlib
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--remote-debugging-pipe",
)
MOVE_PIPES = """
import fcntl, os, sys
ends = [fcntl.fcntl(int(fd), fcntl.F_DUPFD, 10) for fd in sys.argv[1:3]]
for fd, place in zip(ends, (3, 4)):
    os.dup2(fd, place)
os.execv(sys.argv[3], sys.argv[3:])
"""
TIMEOUT_S = 60.0  # the machine may be busy; a page that answers in time never waits this long


class BrowserError(RuntimeError):
    """The browser is missing, died, did not answer in time, or a script in the page failed."""


def find_chromium() -> str | None:
    """The browser's path: ``HIL_CHROMIUM`` when set, else the first known name on PATH."""
    named = os.environ.get("HIL_CHROMIUM")
    return named or next((path for path in map(shutil.which, NAMES) if path), None)


class Browser:
    """A running browser; use it in a ``with`` block. Raises BrowserError when there is none."""

    def __init__(self) -> None:
        path = find_chromium()
        if path is None:
            raise BrowserError(f"no Chromium found: none of {', '.join(NAMES)} on PATH, HIL_CHROMIUM not set")
        self._folder = tempfile.mkdtemp(prefix="hil-chromium-")
        read_commands, self._out = os.pipe()
        self._in, write_answers = os.pipe()
        mover = (sys.executable, "-c", MOVE_PIPES, str(read_commands), str(write_answers))
        with (Path(self._folder) / "said").open("wb") as said:
            self._process = subprocess.Popen(
                [*mover, path, *FLAGS, f"--user-data-dir={self._folder}/profile", "about:blank"],
                pass_fds=(read_commands, write_answers),
                stdout=said,
                stderr=said,
                start_new_session=True,
            )
        os.close(read_commands)
        os.close(write_answers)
        self._buffer = b""
        self._number = 0
        self._pages: dict[str, Page] = {}

    def __enter__(self) -> Browser:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the browser with all its processes and remove its profile."""
        with contextlib.suppress(BrowserError, OSError):
            self.call("Browser.close", timeout_s=5.0)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(5.0)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        os.close(self._in)
        os.close(self._out)
        shutil.rmtree(self._folder, ignore_errors=True)

    def call(
        self, method: str, session: str | None = None, timeout_s: float = TIMEOUT_S, **params: Any
    ) -> dict[str, Any]:
        """Send one command and return its result; events that arrive meanwhile go to their pages."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": params}
        if session is not None:
            message["sessionId"] = session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        deadline = time.monotonic() + timeout_s
        while True:
            answer = self._next(deadline)
            if answer is None:
                raise BrowserError(f"{method}: no answer in {timeout_s:g} s")
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise BrowserError(f"{method}: {answer['error']['message']}")
                result: dict[str, Any] = answer["result"]
                return result

    def listen(self, seconds: float) -> None:
        """Let events arrive for a while."""
        deadline = time.monotonic() + seconds
        while self._next(deadline) is not None:
            pass

    def _next(self, deadline: float) -> dict[str, Any] | None:
        """The next message, after its page has seen it; None when none came before the deadline."""
        while b"\0" not in self._buffer:
            left = deadline - time.monotonic()
            if left <= 0 or not select.select([self._in], [], [], left)[0]:
                return None
            data = os.read(self._in, 1 << 20)
            if not data:
                said = (Path(self._folder) / "said").read_text(errors="replace").strip()
                raise BrowserError(f"the browser has ended; it said: {said[-500:]}")
            self._buffer += data
        raw, _, self._buffer = self._buffer.partition(b"\0")
        message: dict[str, Any] = json.loads(raw)
        page = self._pages.get(message.get("sessionId", ""))
        if page is not None and "method" in message:
            page.on_event(message["method"], message["params"])
        return message

    def page(self, width: int = 1200, height: int = 900) -> Page:
        """A new empty page of that size [CSS pixels], in a browser context of its own."""
        context = self.call("Target.createBrowserContext")["browserContextId"]
        target = self.call("Target.createTarget", url="about:blank", browserContextId=context)["targetId"]
        session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        page = self._pages[session] = Page(self, session)
        for domain in ("Page", "Runtime", "Log", "Network", "Audits"):
            page.call(f"{domain}.enable")
        page.resize(width, height)
        return page


class Page:
    """One page. ``problems``: all it reported as wrong; ``requests``: every address it asked for."""

    def __init__(self, browser: Browser, session: str) -> None:
        self._browser, self._session = browser, session
        self.problems: list[str] = []
        self.requests: list[str] = []
        self._loaded = False

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """A DevTools command of this page."""
        return self._browser.call(method, self._session, **params)

    def on_event(self, method: str, params: dict[str, Any]) -> None:
        """Keep what matters of an event."""
        if method == "Page.loadEventFired":
            self._loaded = True
        elif method == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"])
        elif method == "Runtime.exceptionThrown":
            details = params["exceptionDetails"]
            self.problems.append(details.get("exception", {}).get("description") or details["text"])
        elif method == "Runtime.consoleAPICalled" and params["type"] in ("error", "warning", "assert"):
            said = (str(item.get("value", item.get("description"))) for item in params["args"])
            self.problems.append(" ".join(said))
        elif method == "Log.entryAdded" and params["entry"]["level"] in ("error", "warning"):
            self.problems.append(params["entry"]["text"])
        elif method == "Network.loadingFailed" and not params.get("canceled"):
            self.problems.append(f"load failed: {params['errorText']}")
        elif method == "Audits.issueAdded":
            self.problems.append(f"issue: {params['issue']['code']}")

    def resize(self, width: int, height: int) -> None:
        """Set the size of the viewport [CSS pixels]."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )

    def dark(self, on: bool = True) -> None:
        """Prefer dark colours, or light ones."""
        feature = {"name": "prefers-color-scheme", "value": "dark" if on else "light"}
        self.call("Emulation.setEmulatedMedia", features=[feature])

    def open(self, address: str | Path) -> None:
        """Load an address or a file, and wait until it is loaded."""
        url = address.resolve().as_uri() if isinstance(address, Path) else address
        self._loaded = False
        answer = self.call("Page.navigate", url=url)
        if "errorText" in answer:
            raise BrowserError(f"{url}: {answer['errorText']}")
        deadline = time.monotonic() + TIMEOUT_S
        while not self._loaded:
            if time.monotonic() > deadline:
                raise BrowserError(f"{url}: not loaded in {TIMEOUT_S:g} s")
            self._browser.listen(0.05)

    def evaluate(self, script: str) -> Any:
        """The value of a JavaScript expression; a promise is awaited. Raises BrowserError when it throws."""
        answer = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            details = answer["exceptionDetails"]
            raise BrowserError(details.get("exception", {}).get("description") or details["text"])
        return answer["result"].get("value")

    def wait_for(self, script: str, timeout_s: float = TIMEOUT_S) -> Any:
        """Evaluate until the value is truthy, and return it. Raises BrowserError when it never is."""
        deadline = time.monotonic() + timeout_s
        while not (value := self.evaluate(script)):
            if time.monotonic() > deadline:
                raise BrowserError(f"never true in {timeout_s:g} s: {script}; problems: {self.problems}")
            self._browser.listen(0.05)
        return value

    def box(self, selector: str, index: int = 0) -> tuple[float, float, float, float]:
        """Left, top, width, height in the viewport of an element, scrolled into view."""
        found = self.evaluate(
            f"(() => {{ const e = document.querySelectorAll({json.dumps(selector)})[{index}];"
            " if (!e) return null; e.scrollIntoView({block: 'center', behavior: 'instant'});"
            " const r = e.getBoundingClientRect(); return [r.left, r.top, r.width, r.height]; })()"
        )
        if found is None:
            raise BrowserError(f"there is no element {selector} [{index}]")
        left, top, width, height = found
        return left, top, width, height

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        """One mouse event at a place in the viewport: mousePressed, mouseMoved, mouseReleased, mouseWheel."""
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def click(self, selector: str, index: int = 0, count: int = 1) -> None:
        """Click, or double-click (``count`` 2), the middle of an element with the real mouse."""
        left, top, width, height = self.box(selector, index)
        x, y = left + width / 2, top + height / 2
        self.mouse("mouseMoved", x, y)
        for n in range(1, count + 1):
            self.mouse("mousePressed", x, y, button="left", clickCount=n)
            self.mouse("mouseReleased", x, y, button="left", clickCount=n)

    def drag(self, selector: str, start: float, end: float, index: int = 0) -> None:
        """Drag across an element at half its height, from one share of its width to another."""
        left, top, width, height = self.box(selector, index)
        y = top + height / 2
        self.mouse("mouseMoved", left + start * width, y)
        self.mouse("mousePressed", left + start * width, y, button="left", clickCount=1)
        for share in (0.25, 0.5, 0.75, 1.0):
            x = left + (start + (end - start) * share) * width
            self.mouse("mouseMoved", x, y, button="left", buttons=1)
        self.mouse("mouseReleased", left + end * width, y, button="left", clickCount=1)

    def type(self, text: str) -> None:
        """Type text into what has the focus."""
        self.call("Input.insertText", text=text)

    def picture(self, path: Path, clip: tuple[float, float, float, float] | None = None) -> None:
        """Save a PNG of the viewport, or of a clip (left, top, width, height) of the whole page."""
        params: dict[str, Any] = {"format": "png"}
        if clip is not None:
            left, top, width, height = clip
            params["clip"] = {"x": left, "y": top, "width": width, "height": height, "scale": 1}
            params["captureBeyondViewport"] = True
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", **params)["data"]))


@contextlib.contextmanager
def chromium() -> Iterator[Browser]:
    """A browser, closed at the end. Raises BrowserError when there is none or it does not start."""
    with Browser() as browser:
        browser.call("Browser.getVersion")
        yield browser
