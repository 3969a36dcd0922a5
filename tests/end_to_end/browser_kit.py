"""A real browser without a window: Debian's Chromium, spoken to by its DevTools protocol."""

import base64
import contextlib
import itertools
import json
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import connect
from websockets.sync.connection import Connection

PATIENCE_S = 120.0
"""A page with its scripts takes a second; on busy machines many times that."""

_LOCAL_NETWORK_CHECKS = (
    "LocalNetworkAccessChecks",
    "LocalNetworkAccessChecksWebSockets",
    "BlockInsecurePrivateNetworkRequests",
)


_ON_THE_WAY = "Inspected target navigated or closed"


class OnTheWay(AssertionError):
    """The page was left while it was asked."""


class Browser:
    """One page of a browser."""

    def __init__(self, line: Connection) -> None:
        self._line = line
        self._numbers = itertools.count(1)
        self._session: str | None = None
        self._replies: dict[str, str] = {}
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        attached = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command and return its answer."""
        number = next(self._numbers)
        session = {"sessionId": self._session} if self._session else {}
        self._line.send(
            json.dumps({"id": number, "method": method, "params": parameters, **session})
        )
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            message = json.loads(self._line.recv(timeout=PATIENCE_S))
            if message.get("method") == "Fetch.requestPaused":
                self._fulfil(message["params"])
            if message.get("id") == number:
                if message.get("error", {}).get("message") == _ON_THE_WAY:
                    raise OnTheWay(method)
                assert "error" not in message, (method, message["error"])
                return dict(message["result"])
        raise AssertionError(f"{method}: no answer")

    def serve(self, url: str, page: str) -> None:
        """Let a URL be answered with a page, whoever would answer it; all others go their way.

        So a page is of an origin whose name, since, has been pointed to another address.
        """
        self._replies[url] = page
        self.call("Fetch.enable", patterns=[{"urlPattern": known} for known in self._replies])

    def _fulfil(self, paused: dict[str, Any]) -> None:
        body = base64.b64encode(self._replies[paused["request"]["url"]].encode()).decode()
        answer = {"requestId": paused["requestId"], "responseCode": 200, "body": body}
        answer["responseHeaders"] = [{"name": "Content-Type", "value": "text/html"}]
        message = {"id": next(self._numbers), "method": "Fetch.fulfillRequest", "params": answer}
        self._line.send(json.dumps({**message, "sessionId": self._session}))

    def open(self, url: str) -> None:
        """Go to a URL and wait until its document is there."""
        self.call("Page.navigate", url=url)
        self.until("document.readyState === 'complete' && location.href !== 'about:blank'")

    def run(self, script: str) -> Any:
        """Return what an expression gives, awaited."""
        done = self.call(
            "Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in done, done["exceptionDetails"]
        return done["result"].get("value")

    def until(self, condition: str) -> None:
        """Wait until an expression holds."""
        deadline = time.monotonic() + PATIENCE_S
        while not self._holds(condition):
            assert time.monotonic() < deadline, (condition, self.run("document.body.innerText"))
            time.sleep(0.2)

    def until_file(self, path: Path) -> None:
        """Wait until a file is saved."""
        deadline = time.monotonic() + PATIENCE_S
        while not path.exists():
            assert time.monotonic() < deadline, path
            time.sleep(0.1)

    def _holds(self, condition: str) -> bool:
        try:
            return bool(self.run(f"Boolean({condition})"))
        except OnTheWay:  # a click has led to another page, which is asked next
            return False

    def write(self, text: str) -> None:
        """Type into what has the focus."""
        self.call("Input.insertText", text=text)

    def press(self, key: str, *, shift: bool = False) -> None:
        """Press a key and let it go; `key` as DOM events name it."""
        code = {"Tab": 9, "Enter": 13, " ": 32, "Escape": 27, "ArrowLeft": 37, "ArrowUp": 38,
                "ArrowRight": 39, "ArrowDown": 40}.get(key, ord(key[0].upper()))  # fmt: skip
        text = {"Enter": "\r"}.get(key, key if len(key) == 1 else "")
        parts = {"key": key, "windowsVirtualKeyCode": code, "modifiers": 8 if shift else 0}
        down = {**parts, "text": text} if text else parts
        self.call("Input.dispatchKeyEvent", type="keyDown", **down)
        self.call("Input.dispatchKeyEvent", type="keyUp", **parts)

    def tab_to(self, selector: str) -> None:
        """Press Tab until an element has the focus."""
        for _ in range(200):
            self.press("Tab")
            if self.run(f"document.activeElement.matches({json.dumps(selector)})"):
                return
        raise AssertionError(f"{selector} is out of reach of the keyboard")

    def drag(self, selector: str, right_px: int, down_px: int) -> None:
        """Press the mouse in the middle of an element, move it, and let it go."""
        at = f"document.querySelector({json.dumps(selector)})"
        self.run(f"{at}.scrollIntoView({{block: 'center'}})")
        x, y = self.run(
            f"(() => {{const b = {at}.getBoundingClientRect();"
            "return [b.x + b.width / 2, b.y + b.height / 2]})()"
        )
        steps = [("mousePressed", 0.0), ("mouseMoved", 0.5), ("mouseMoved", 1.0)]
        for kind, share in [*steps, ("mouseReleased", 1.0)]:
            self.call(
                "Input.dispatchMouseEvent", type=kind, x=x + share * right_px,
                y=y + share * down_px, button="left", buttons=int(kind != "mouseReleased"),
                clickCount=1,
            )  # fmt: skip

    def in_colours(self, scheme: str) -> None:
        """Let pages be told that the user wants `light` or `dark`."""
        wish = {"name": "prefers-color-scheme", "value": scheme}
        self.call("Emulation.setEmulatedMedia", features=[wish])

    def show(self, width: int, height: int) -> None:
        """Make the page as wide and high as a screen."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=1, mobile=width < 600,
        )  # fmt: skip

    def picture(self, path: Path) -> None:
        """Write what is seen as PNG."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot")["data"]))


@contextlib.contextmanager
def browser(*options: str) -> Iterator[Browser]:
    """A browser of its own profile; skips where there is none."""
    program = shutil.which("chromium")
    if program is None:
        pytest.skip("Chromium is not installed: apt-get install chromium")
    command = [program, "--headless=new", "--remote-debugging-port=0", "--disable-gpu"]
    command += ["--no-first-run", "--disable-background-networking", "--disable-dev-shm-usage"]
    # as in browsers that let every page ask this machine: no server may rely on the others
    command += [f"--disable-features={','.join(_LOCAL_NETWORK_CHECKS)}"]
    command += ["--no-sandbox"] if os.geteuid() == 0 else []  # it refuses root otherwise
    with tempfile.TemporaryDirectory(prefix="trilight-browser-") as folder:
        process = subprocess.Popen(
            [*command, f"--user-data-dir={folder}", *options, "about:blank"],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            start_new_session=True,
        )  # fmt: skip
        try:
            with connect(_address(Path(folder)), max_size=None, open_timeout=PATIENCE_S) as line:
                yield Browser(line)
                line.send(json.dumps({"id": 0, "method": "Browser.close"}))
                process.wait(PATIENCE_S)
        finally:
            process.kill()
            process.wait()


def _address(profile: Path) -> str:
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        with contextlib.suppress(OSError, ValueError):
            port, path = (profile / "DevToolsActivePort").read_text().splitlines()
            return f"ws://127.0.0.1:{port}{path}"
        time.sleep(0.1)
    raise AssertionError("the browser did not start")
