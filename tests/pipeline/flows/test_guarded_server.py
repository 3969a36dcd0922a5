"""Our Prefect server: own names and pages pass its door, and a port that is taken is told."""

import asyncio
import socket
import stat
import subprocess
import sys
import threading
from collections.abc import MutableMapping
from pathlib import Path
from typing import Any

import pytest

from pipeline.flows.guarded_server import Door
from pipeline.flows.prefect_server import wait_until_healthy
from storage.cache import open_private, private_folder
from storage.errors import TrilightError
from tests.for_each import for_each

PORT = 4200


async def _application(scope: Any, receive: Any, send: Any) -> None:
    """Answer what comes through; a websocket is accepted."""
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
        return
    await send({"type": "http.response.start", "status": 200, "headers": [(b"x-inner", b"1")]})
    await send({"type": "http.response.body", "body": b"inner"})


def _answer(kind: str = "http", **headers: str) -> list[MutableMapping[str, Any]]:
    sent: list[MutableMapping[str, Any]] = []

    async def send(message: MutableMapping[str, Any]) -> None:
        sent.append(message)

    async def receive() -> MutableMapping[str, Any]:
        return {"type": "http.request", "body": b""}

    raw = [(name.encode(), value.encode()) for name, value in headers.items()]
    scope = {"type": kind, "headers": raw, "path": "/api/deployments/filter"}
    asyncio.run(Door(_application, ["server", "My-Host"])(scope, receive, send))
    return sent


@for_each(
    "host",
    ["127.0.0.1:4200", "localhost:4200", "localhost", "10.1.2.3:4200", "[::1]:4200", "server:4200",
     "SERVER", "my-host"],
)  # fmt: skip
def test_own_names_and_addresses_are_answered(host: str) -> None:
    for origin in ({}, {"origin": f"http://{host.lower()}"}):
        start, body = _answer(host=host, **origin)
        assert (start["status"], body["body"]) == (200, b"inner")
        assert (b"content-security-policy", b"frame-ancestors 'none'") in start["headers"]
        assert (b"x-inner", b"1") in start["headers"]
        assert _answer("websocket", host=host, **origin) == [{"type": "websocket.accept"}]


@for_each(
    "host",
    ["evil.example", f"evil.example:{PORT}", "localhost.evil.example", "127.0.0.1.evil.example",
     "me@evil.example", "127.0.0.1@evil.example", "2130706433", "0x7f.1", "server.", "",
     "[", "a b"],
)  # fmt: skip
def test_other_names_are_refused(host: str) -> None:
    """A page may let its own name point to 127.0.0.1: its origin is then this very host."""
    for origin in ({}, {"origin": f"http://{host}"}):
        start, body = _answer(host=host, **origin)
        assert start["status"] == 403 and b"no name of this server" in body["body"]
        assert (b"content-security-policy", b"frame-ancestors 'none'") in start["headers"]
        (closed,) = _answer("websocket", host=host, **origin)
        assert closed["type"] == "websocket.close"


@for_each(
    "origin",
    ["http://evil.example", "null", "", f"http://127.0.0.1:{PORT + 1}", "http://127.0.0.1",
     f"http://localhost:{PORT}", f"http://127.0.0.1:{PORT}.evil.example", "file://"],
)  # fmt: skip
def test_pages_of_other_origins_are_refused(origin: str) -> None:
    start, body = _answer(host=f"127.0.0.1:{PORT}", origin=origin)
    assert start["status"] == 403 and b"other origins" in body["body"]
    (closed,) = _answer("websocket", host=f"127.0.0.1:{PORT}", origin=origin)
    assert closed["type"] == "websocket.close"


def test_a_request_without_a_host_is_refused() -> None:
    assert _answer()[0]["status"] == 403


def test_without_a_password_there_is_no_server() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "pipeline.flows.guarded_server", "--port", "1"],
        env={"PATH": "/usr/bin:/bin"}, cwd=Path(__file__).parents[3],
        capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert done.returncode == 1
    assert "PREFECT_SERVER_API_AUTH_STRING is not set; expected USER:PASSWORD" in done.stderr


def test_what_is_private_is_so_from_the_first_byte(tmp_path: Path) -> None:
    folder = tmp_path / "a" / "b"
    private_folder(folder)
    with open_private(folder / "log", "ab") as stream:
        stream.write(b"x")
    modes = [stat.S_IMODE(path.stat().st_mode) for path in (folder, folder / "log")]
    assert modes == [0o700, 0o600]
    folder.chmod(0o755)
    assert stat.S_IMODE(private_folder(folder).stat().st_mode) == 0o700
    folder.chmod(0o1777)
    with pytest.raises(TrilightError, match="shared by all users"):
        private_folder(folder)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o1777


def test_an_answer_that_is_no_http_is_not_our_server(tmp_path: Path) -> None:
    """Seen once: a Dask scheduler answered, and the start ended in a traceback."""
    ending = [sys.executable, "-c", "import time; time.sleep(0.5)"]
    with socket.create_server(("127.0.0.1", 0)) as listener, subprocess.Popen(ending) as server:

        def answer() -> None:
            while True:
                try:
                    connection, _ = listener.accept()
                except OSError:
                    return
                with connection:
                    connection.sendall(b":\x00\x00\x00\x00compression\n\n")

        threading.Thread(target=answer, daemon=True).start()
        url = f"http://127.0.0.1:{listener.getsockname()[1]}"
        with pytest.raises(TrilightError, match="did not start"):
            wait_until_healthy(url, server, tmp_path / "server.log")
