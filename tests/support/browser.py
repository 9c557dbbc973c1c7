"""Headless Chromium for tests, driven by its DevTools protocol through a pipe: no server, no port, no further package.

With ``--remote-debugging-pipe`` Chromium reads commands from file descriptor 3 and writes answers and events to 4, as
JSON ended by a zero byte.
"""

from __future__ import annotations

import base64
import fcntl
import json
import os
import select
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
PATIENCE = 30.0
"""Seconds until an answer counts as lost; a shared core can take many."""

KEYS = {" ": "Space", "/": "Slash"}
ESCAPE = 27


def find_chromium() -> str | None:
    """Return the browser to use; ``MEMOBENCH_CHROMIUM`` names another one."""
    named = os.environ.get("MEMOBENCH_CHROMIUM")
    return named or next((path for path in map(shutil.which, NAMES) if path), None)


def _high_pipe() -> tuple[int, int]:
    """A pipe whose descriptors are none that the shell is to overwrite."""
    ends = os.pipe()
    high = tuple(fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10) for end in ends)
    for end in ends:
        os.close(end)
    return high[0], high[1]


class Browser:
    """One Chromium with one page.

    Attributes:
        errors: console errors, uncaught exceptions and blocked loads of the page, as texts.
        requests: addresses that the page asked for.
    """

    def __init__(self, profile: Path, width: int = 1280, height: int = 900) -> None:
        chromium = find_chromium()
        assert chromium is not None
        command_in, self._commands = _high_pipe()
        self._answers, answers_out = _high_pipe()
        # A shell moves the pipes to the descriptors 3 and 4 that Chromium expects; --no-sandbox because tests may
        # run as root in a container; --disable-gpu because there may be none.
        words = [
            *(chromium, "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run"),
            *("--hide-scrollbars", "--mute-audio", f"--user-data-dir={profile}", "--remote-debugging-pipe"),
            "about:blank",
        ]
        shell = f'exec "$@" 3<&{command_in} 4>&{answers_out} {command_in}<&- {answers_out}>&-'
        self._log = (profile.parent / f"{profile.name}.log").open("wb")
        self._process = subprocess.Popen(
            ["bash", "-c", shell, "chromium", *words],
            pass_fds=(command_in, answers_out),
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=self._log,
        )
        os.close(command_in)
        os.close(answers_out)
        self._number, self._buffer = 0, b""
        self._events: list[dict[str, Any]] = []
        self.errors: list[str] = []
        self.requests: list[str] = []
        targets = self._call("Target.getTargets")["targetInfos"]
        page = next(target["targetId"] for target in targets if target["type"] == "page")
        self._session = self._call("Target.attachToTarget", targetId=page, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        self.resize(width, height)

    # --- the protocol ---

    def _call(self, method: str, session: str | None = None, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": parameters}
        if session:
            message["sessionId"] = session
        os.write(self._commands, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._receive(method)
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']['message']}")
                return answer["result"]
            self._note(answer)

    def _receive(self, waiting_for: str) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            ready, _, _ = select.select([self._answers], [], [], PATIENCE)
            piece = os.read(self._answers, 1 << 20) if ready else b""
            if not piece:
                raise RuntimeError(f"Chromium did not answer {waiting_for}; its log is {self._log.name}")
            self._buffer += piece
        text, _, self._buffer = self._buffer.partition(b"\0")
        return json.loads(text)

    def _note(self, event: dict[str, Any]) -> None:
        self._events.append(event)
        method, found = event.get("method"), event.get("params", {})
        if method == "Runtime.exceptionThrown":
            details = found["exceptionDetails"]
            self.errors.append(details.get("exception", {}).get("description", details["text"]))
        elif method == "Runtime.consoleAPICalled" and found["type"] in ("error", "warning", "assert"):
            self.errors.append(" ".join(str(arg.get("value", arg.get("description"))) for arg in found["args"]))
        elif method == "Log.entryAdded" and found["entry"]["level"] == "error":
            self.errors.append(found["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            self.requests.append(found["request"]["url"])

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        return self._call(method, self._session, **parameters)

    # --- what tests do ---

    def open(self, address: str) -> None:
        """Load an address from scratch and wait until it is there."""
        self.call("Page.navigate", url="about:blank")
        self.errors.clear()
        self.requests.clear()
        self._events.clear()
        self.call("Page.navigate", url=address)
        self.wait("document.readyState === 'complete' && location.href !== 'about:blank'")

    def js(self, expression: str) -> Any:
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            details = answer["exceptionDetails"]
            raise RuntimeError(details.get("exception", {}).get("description", details["text"]))
        return answer["result"].get("value")

    def wait(self, expression: str) -> Any:
        """Wait until an expression is true and return it."""
        deadline = time.monotonic() + PATIENCE
        while True:
            value = self.js(expression)
            if value:
                return value
            if time.monotonic() > deadline:
                raise AssertionError(f"never true: {expression}; errors of the page: {self.errors}")
            time.sleep(0.05)

    def box(self, selector: str) -> dict[str, float]:
        """Return x, y, width and height of an element on the screen, scrolled into sight.

        The scrolling's own event comes with the next drawn frame; a person's hand comes after it.
        """
        return self.js(
            f"(async () => {{ const e = document.querySelector({json.dumps(selector)}); "
            "e.scrollIntoView({block: 'center', behavior: 'instant'}); "
            "await new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done))); "
            "const b = e.getBoundingClientRect(); return {x: b.x, y: b.y, width: b.width, height: b.height}; })()"
        )

    def click(self, selector: str, across: float = 0.5, down: float = 0.5) -> None:
        """Press and release the mouse within an element, at a fraction of its width and height."""
        box = self.box(selector)
        place = {"x": box["x"] + across * box["width"], "y": box["y"] + down * box["height"]}
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, button="left", clickCount=1, **place)

    def key(self, key: str, modifiers: int = 0) -> None:
        """Press a key on whatever has the focus; modifiers: 1 Alt, 2 Ctrl, 4 Meta, 8 Shift."""
        text = {"text": key} if len(key) == 1 else {}
        # Chromium closes dialogs by the key's number, everything else goes by its name.
        number = {"windowsVirtualKeyCode": ESCAPE} if key == "Escape" else {}
        event = {"key": key, "code": KEYS.get(key, key), "modifiers": modifiers, **number}
        self.call("Input.dispatchKeyEvent", type="keyDown", **event, **text)
        self.call("Input.dispatchKeyEvent", type="keyUp", **event)

    def write(self, selector: str, text: str) -> None:
        self.js(f"document.querySelector({json.dumps(selector)}).focus()")
        self.call("Input.insertText", text=text)

    def choose(self, selector: str, value: str) -> None:
        """Choose an option of a list as a person does: the value changes and the page is told."""
        self.js(
            f"(() => {{ const e = document.querySelector({json.dumps(selector)}); e.value = {json.dumps(value)}; "
            f"if (e.value !== {json.dumps(value)}) throw Error('no such option'); "
            "e.dispatchEvent(new Event('change', {bubbles: true})); })()"
        )

    def resize(self, width: int, height: int) -> None:
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)

    def colours(self, scheme: str) -> None:
        """Pretend that the reader prefers ``light`` or ``dark``."""
        self.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])

    def screenshot(self, path: Path) -> Path:
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))
        return path

    def texts(self, selector: str) -> list[str]:
        return self.js(f"[...document.querySelectorAll({json.dumps(selector)})].map((e) => e.innerText)")

    def close(self) -> None:
        try:
            self._call("Browser.close")
        except (RuntimeError, OSError):
            self._process.terminate()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._commands)
        os.close(self._answers)
        self._log.close()
