"""Prefect's server: its door, a port that is taken, the deployment found, and what refusals say."""

import asyncio
import json
import socket
import stat
import subprocess
import sys
import threading
import time
from collections.abc import MutableMapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from uuid import UUID, uuid4

import httpx
import pytest
import uvicorn
from prefect.client.schemas.objects import FlowRun
from prefect.settings import PREFECT_API_URL, temporary_settings
from prefect.states import Completed, Failed, Running, Scheduled, State

from pipeline.flows import guarded_server
from pipeline.flows.guarded_server import guard_requests
from pipeline.flows.prefect_flows import generate_scenes
from pipeline.flows.prefect_server import (
    name_prefect_failures,
    prefect_server,
    wait_until_healthy,
)
from pipeline.flows.submission import (
    find_deployment,
    page_of,
    parameters,
    poll_run,
    server,
    workers_online,
)
from pipeline.generation.generate_options import GenerateOptions
from storage.cache import open_private, private_folder
from storage.errors import TrilightError
from tests.command_line import run_program
from tests.for_each import case, for_each
from tests.http_server import serve


class Server:
    """What a server would answer, without one."""

    api_url = "http://127.0.0.1:1/api/"

    def __init__(self, deployments: list[str], states: tuple[State, ...] = ()) -> None:
        self.deployments = [
            SimpleNamespace(id=uuid4(), name=name, work_pool_name=f"pool of {name}")
            for name in deployments
        ]
        self.states = list(states)
        self.artifacts: list[Any] = []

    def read_deployments(self, *, flow_filter: Any) -> list[Any]:
        assert flow_filter.name.any_ == ["generate-scenes"]
        return self.deployments

    def read_flow_run(self, run: UUID) -> FlowRun:
        return FlowRun(id=run, flow_id=uuid4(), state=self.states.pop(0))

    def read_artifacts(self, *, artifact_filter: Any) -> list[Any]:
        return self.artifacts

    def read_workers_for_work_pool(self, pool: str) -> list[Any]:
        return [SimpleNamespace(status=status) for status in ("ONLINE", "OFFLINE", "ONLINE")]


def test_the_deployment_of_make_serve_comes_first_then_the_only_one_or_one_that_is_named() -> None:
    served: Any = Server(["cluster", "local"])
    assert find_deployment(served, "generate-scenes", None) is served.deployments[1]
    run = uuid4()
    assert page_of(served, run).endswith(f"/runs/flow-run/{run}")
    assert workers_online(served, "pool of local") == 2
    for deployments, wanted in ((["cluster"], None), (["a", "b"], "b")):
        served = Server(deployments)
        assert find_deployment(served, "generate-scenes", wanted) is served.deployments[-1]
    for deployments, wanted, complaint in (
        ([], None, "no deployment of the flow generate-scenes. Run make serve"),
        (["a", "b"], None, "--deployment is None; expected one of a, b"),
        (["local"], "other", "--deployment is 'other'; expected one of local"),
    ):
        served = Server(deployments)
        with case(complaint), pytest.raises(TrilightError, match=complaint):
            find_deployment(served, "generate-scenes", wanted)


def test_parameters_are_what_the_flow_takes() -> None:
    """Prefect's own check of the flow's form accepts them, and nothing at its default is sent."""
    order = GenerateOptions(
        build="smoke",
        scenes=5,
        allow_licences=("CC-BY-4.0",),
        changes={"renders.max_spp": 64, "scenes.lights.coloured_share": 0.5},
    )
    given = parameters(order)
    assert given == {
        "build": "smoke",
        "scenes": 5,
        "allow_licences": ["CC-BY-4.0"],
        "changes": {"renders": {"max_spp": 64}, "scenes": {"lights": {"coloured_share": 0.5}}},
    }
    checked = generate_scenes.validate_parameters(given)
    assert checked["changes"].renders.max_spp == 64


def test_a_run_is_looked_at_until_it_has_ended_and_one_that_failed_is_no_success() -> None:
    served = Server(["local"], (Scheduled(), Running(), Completed(message="all there")))
    table = [{"what": "scenes in shards", "value": "3 of 4"}]
    served.artifacts = [
        SimpleNamespace(type="progress", data=75.0, key="shards", updated=1),
        SimpleNamespace(type="table", data=json.dumps(table), key="progress", updated=2),
    ]
    slept: list[float] = []
    seen = list(poll_run(served, uuid4(), slept.append))  # type: ignore[arg-type]
    assert [state.name for state, _, _ in seen] == ["Scheduled", "Running", "Completed"]
    state, percent, tables = seen[-1]
    assert state.is_completed() and state.message == "all there"
    assert percent == 75.0
    assert tables == {"progress": {"scenes in shards": "3 of 4"}}
    assert len(slept) == 2
    served = Server(["local"], (Failed(message="no space"),))
    ((state, *_),) = poll_run(served, uuid4())  # type: ignore[arg-type]
    assert (state.is_completed(), state.message) == (False, "no space")


def test_no_server_a_closed_port_and_a_password_without_which_none_begins() -> None:
    with temporary_settings(restore_defaults={PREFECT_API_URL}):
        with pytest.raises(TrilightError, match="no Prefect server is set.*make serve"), server():
            pass
    request = httpx.Request("POST", "http://127.0.0.1:9/api")
    with pytest.raises(TrilightError, match="it requires a password.*PREFECT_API_AUTH_STRING"):
        with name_prefect_failures():
            httpx.Response(401, request=request).raise_for_status()
    words = [sys.executable, "-m", "pipeline.flows.guarded_server", "--port", "1"]
    done = run_program(words, status=1, env={"PATH": "/usr/bin:/bin"}, timeout=60)
    assert "PREFECT_SERVER_API_AUTH_STRING is not set; expected USER:PASSWORD" in done.stderr


def test_what_is_no_prefect_is_said_in_one_sentence_by_every_runner(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """`submit` and `--runner prefect` alike; no proxy stands before one's own machine."""
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")
    with serve() as site:
        site.put("api/admin/version", "<html>")
        cases = {
            "http://127.0.0.1:9/api": "^Prefect at .*: Connection refused. Run make serve, or fix",
            "garbage": "^Prefect at garbage: .* missing an 'http://'",
            f"{site.url}/api": "is no API of Prefect; expected one, such as",
            f"{site.url}/x": "it answers 404",
        }
        for place, said in cases.items():
            monkeypatch.setenv("PREFECT_API_URL", place)
            for opened in (server, prefect_server):
                with case((place, opened)), temporary_settings({PREFECT_API_URL: place}):
                    with pytest.raises(TrilightError, match=said), opened():
                        pass


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
    guarded: Any = guard_requests(_application, ["server", "My-Host"])
    asyncio.run(guarded(scope, receive, send))
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


STRANGERS = (
    "evil.example", f"evil.example:{PORT}", "localhost.evil.example", "127.0.0.1.evil.example",
    "me@evil.example", "127.0.0.1@evil.example", "2130706433", "0x7f.1", "server.", "", "[", "a b",
)  # fmt: skip
OTHER_ORIGINS = (
    "http://evil.example", "null", "", f"http://127.0.0.1:{PORT + 1}", "http://127.0.0.1",
    f"http://localhost:{PORT}", f"http://127.0.0.1:{PORT}.evil.example", "file://",
)  # fmt: skip


def test_other_names_none_and_pages_of_other_origins_are_refused() -> None:
    """A page may let its own name point to 127.0.0.1: its origin is then this very host."""
    assert _answer()[0]["status"] == 403
    names = [
        {"host": host, **more} for host in STRANGERS for more in ({}, {"origin": f"http://{host}"})
    ]
    pages = [{"host": f"127.0.0.1:{PORT}", "origin": origin} for origin in OTHER_ORIGINS]
    rows = [(b"no name of this server", each) for each in names]
    for said, headers in [*rows, *((b"other origins", each) for each in pages)]:
        with case(headers):
            start, body = _answer(**headers)
            assert start["status"] == 403 and said in body["body"]
            assert (b"content-security-policy", b"frame-ancestors 'none'") in start["headers"]
            (closed,) = _answer("websocket", **headers)
            assert closed["type"] == "websocket.close"


def test_half_requests_are_closed_and_slow_answers_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guarded_server, "REQUEST_S", 0.3)

    async def answer_slowly(scope: Any, receive: Any, send: Any) -> None:
        await asyncio.sleep(1.2)
        await _application(scope, receive, send)

    http = guarded_server.request_timeout_protocol()
    config = uvicorn.Config(answer_slowly, port=0, http=http, lifespan="off", log_level="error")
    served = uvicorn.Server(config)
    thread = threading.Thread(target=served.run, daemon=True)
    thread.start()
    while not served.started:
        time.sleep(0.01)
    address = served.servers[0].sockets[0].getsockname()
    whole = b"GET / HTTP/1.1\r\nHost: x\r\n\r\n"
    try:
        for begins in (b"", b"GET", whole[:-2], whole, whole + whole[:-2]):
            with socket.create_connection(address, timeout=20) as line, case(begins):
                line.sendall(begins)
                answer = b"".join(iter(lambda: line.recv(1 << 16), b""))
                assert (b"200 OK" in answer and b"inner" in answer) == (whole in begins)
    finally:
        served.should_exit = True
        thread.join(20)


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
