"""What `make serve` starts, attacked by requests, origins and rebinding; then it does its work."""

import contextlib
import http
import http.client
import json
import os
import stat
import subprocess
import sys
import time
import tomllib
from base64 import b64encode
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from infra.serving.deployments import read_deployments
from pipeline.flows.prefect_server import DISK_LIMIT, GPU_LIMIT
from storage.dataset.verify import verify_dataset
from tests.end_to_end.browser_kit import Browser, browser
from tests.end_to_end.production_kit import (
    FEW_SAMPLES_CHANGES,
    START,
    START_S,
    STOP,
    call,
    copy_of_the_project,
    documented_run,
    documented_serving,
    free_port,
)
from tests.for_each import for_each

ATTACK = (Path(__file__).parent / "attack.html").read_text()
EVIL = "evil.example"
RESOLVED = f"--host-resolver-rules=MAP {EVIL} 127.0.0.1"
DESKTOP, PHONE = (1280, 900), (400, 800)

pytestmark = [pytest.mark.slow("servers"), pytest.mark.timeout(1800)]


class Server:
    """A server, and who asks it."""

    def __init__(
        self, url: str, password: str | None, folder: Path, environment: Mapping[str, str]
    ) -> None:
        self.host = url.removeprefix("http://").removesuffix("/api")
        self.password = password
        self.folder = folder
        self.environment = environment

    def ask(
        self, method: str, path: str, body: Any = None, *, known: bool = True, **headers: str
    ) -> tuple[int, Any]:
        """Return status and answer; the caller knows the password or not, and is at `host`.

        On a busy disk SQLite is locked for a moment, which Prefect says by a status of its own.
        """
        for _ in range(10):
            status, answer = self._ask(method, path, body, known, headers)
            if status != http.HTTPStatus.SERVICE_UNAVAILABLE:
                break
            time.sleep(2.0)
        return status, answer

    def _ask(
        self, method: str, path: str, body: Any, known: bool, headers: dict[str, str]
    ) -> tuple[int, Any]:
        line = http.client.HTTPConnection(self.host, timeout=60)
        sent = {"content-type": "application/json", "host": self.host}
        if known and self.password:
            sent["authorization"] = f"Basic {b64encode(self.password.encode()).decode()}"
        sent |= {name.replace("_", "-"): value for name, value in headers.items()}
        line.request(method, path, None if body is None else json.dumps(body), sent)
        answer = line.getresponse()
        text = answer.read()
        line.close()
        try:
            return answer.status, json.loads(text)
        except ValueError:
            return answer.status, text.decode()

    def deployment(self) -> str:
        _, found = self.ask("POST", "/api/deployments/filter", {})
        return str(next(row["id"] for row in found if row["entrypoint"].endswith("_scenes")))

    def num_runs(self) -> int:
        status, number = self.ask("POST", "/api/flow_runs/count", {})
        assert status == 200
        return int(number)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """What `make serve` starts in a checkout, with nothing exported but where its files lie."""
    checkout = tmp_path_factory.mktemp("served")
    copy_of_the_project(checkout)
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    bare = {**kept, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    bare |= {"TRILIGHT_CACHE": str(checkout / "cache")}
    try:
        told = call(START, {**bare, "TRILIGHT_PORT": str(free_port())}, 2 * START_S, checkout)
        assert told.splitlines()[-1] == f"Next: {' '.join(documented_serving()[1].split()[:5])}"
        api = tomllib.loads((checkout / "prefect.toml").read_text())["api"]
        yield Server(api["url"], api["auth_string"], checkout / "cache", bare)
    finally:
        call(STOP, bare, START_S, checkout)
        assert not (checkout / "prefect.toml").is_symlink()


def test_pool_limits_and_deployments_are_made(server: Server) -> None:
    """Without its limit a flow takes as many graphics cards as there are runs."""
    _, limits = server.ask("POST", "/api/v2/concurrency_limits/filter", {})
    assert {DISK_LIMIT, GPU_LIMIT} <= {row["name"] for row in limits}
    _, deployed = server.ask("POST", "/api/deployments/filter", {})
    rows = [row for row in read_deployments() if row["name"] == "local"]
    assert {row["entrypoint"] for row in deployed} == {row["entrypoint"] for row in rows}
    assert {row["work_pool_name"] for row in deployed} == {"local"}


WISHES: tuple[dict[str, Any], ...] = (
    {"command": "/usr/bin/touch PWNED"}, {"env": {"LD_PRELOAD": "/tmp/x.so"}},
    {"env.LD_PRELOAD": "/tmp/x.so"}, {"working_dir": "/tmp"}, {"image": "x"},
    {"service_account_name": "x"},
)  # fmt: skip


def test_requests_of_strangers_are_refused(server: Server) -> None:
    """Those of the attack that began this, and their kin."""
    path = f"/api/deployments/{server.deployment()}/create_flow_run"
    run: dict[str, Any] = {"job_variables": WISHES[0]}
    port = server.host.rpartition(":")[2]
    preflight = {"access_control_request_method": "POST"}
    preflight["access_control_request_headers"] = "content-type"
    refused: list[tuple[int, tuple[int, Any]]] = []
    for known in (True, False):  # who knows the password is refused too, in a page of others
        for headers in (
            {"origin": f"http://{EVIL}"}, {"origin": "null"}, {"host": EVIL},
            {"host": EVIL, "origin": f"http://{EVIL}"},
            {"host": f"{EVIL}:{port}", "origin": f"http://{EVIL}:{port}"},
        ):  # fmt: skip
            for verb, what, body in (
                ("OPTIONS", path, None), ("POST", "/api/deployments/filter", {}),
                ("POST", path, run), ("GET", "/api/health", None), ("GET", "/", None),
            ):  # fmt: skip
                sent = {**headers, **(preflight if verb == "OPTIONS" else {})}
                refused.append((403, server.ask(verb, what, body, known=known, **sent)))
    for body in ({}, run):  # another user of this machine, a container
        refused.append((401, server.ask("POST", path, body, known=False)))
        refused.append((401, server.ask("POST", path, body, authorization="Basic YTpi")))
    refused.append((401, server.ask("GET", "/api/admin/settings", known=False)))
    assert [(status, got) for status, got in refused if got[0] != status] == []
    assert len(refused) == 55 and server.num_runs() == 0


@for_each("wish", WISHES)
def test_nobody_chooses_what_runs_the_flow(server: Server, wish: dict[str, Any]) -> None:
    """With the password: neither for a run nor for a deployment, whose runs are then refused."""
    deployment = f"/api/deployments/{server.deployment()}"
    asked = {"job_variables": wish}
    status, told = server.ask("POST", f"{deployment}/create_flow_run", asked)
    assert status == 422 and "Additional properties are not allowed" in str(told)
    assert server.ask("PATCH", deployment, asked)[0] == 204  # Prefect looks when a run is made
    status, told = server.ask("POST", f"{deployment}/create_flow_run", {})
    assert status == 422 and "Additional properties are not allowed" in str(told)
    assert server.ask("PATCH", deployment, {"job_variables": {}})[0] == 204
    assert server.num_runs() == 0


def test_what_the_server_keeps_is_its_users_alone(server: Server) -> None:
    """Modes of all files; and the password is in one of them, and in no list of processes."""
    assert server.password
    secret = server.password.partition(":")[2]
    holds = []
    for folder in (server.folder / "serve", server.folder / "prefect"):
        for path in (folder, *folder.rglob("*")):
            if "ui" in path.parts or path.name == "mark":  # what Prefect publishes; no secret
                continue
            mode = stat.S_IMODE(path.stat().st_mode)
            assert mode & 0o077 == 0, f"{path}: {mode:o}"
            if path.is_file() and secret.encode() in path.read_bytes():
                holds.append(path.name)
    assert holds == ["prefect.toml"]
    assert (server.folder / "prefect" / "prefect.db").exists()
    lines = [path.read_bytes() for path in Path("/proc").glob("[0-9]*/cmdline") if path.exists()]
    assert any(b"guarded_server" in line for line in lines)
    assert not any(secret.encode() in line for line in lines)


def _attack_of(server: Server, page: Browser, url: str) -> dict[str, str]:
    """Return what each attempt of the page came to."""
    target = url.rpartition("/")[0] if EVIL in url else f"http://{server.host}"
    known = {"TARGET": target, "DEPLOYMENT": server.deployment(), "COMMAND": "/usr/bin/touch PWNED"}
    constants = "".join(f"const {name} = {json.dumps(value)};" for name, value in known.items())
    page.serve(url, ATTACK.replace("<script>", f"<script>{constants}", 1))
    page.open(url)
    assert page.run("location.href") == url
    told: dict[str, str] = page.run("attack()")
    tree = page.call("Page.getFrameTree")["frameTree"]
    frames = [row["frame"] for row in tree.get("childFrames", ())]
    shown = [row for row in frames if "/runs" in row["url"] and "unreachableUrl" not in row]
    told["frame"] = "answered framed" if shown else "refused"
    return told


def _origins(server: Server) -> dict[str, str]:
    port = server.host.rpartition(":")[2]
    return {
        "another port of this machine": f"http://127.0.0.1:{free_port()}/attack",
        "another name of this machine": f"http://localhost:{port}/attack",
        "a page of the internet": f"http://{EVIL}/attack",
        "the same, whose name points here by now": f"http://{EVIL}:{port}/attack",
    }


def test_no_page_of_another_origin_gets_anything(server: Server) -> None:
    for who, url in _origins(server).items():
        with browser(RESOLVED) as page:
            told = _attack_of(server, page, url)
        assert len(told) > 20
        won = {name: how for name, how in told.items() if not how.startswith(("refused", "sent"))}
        assert won == {}, who
        assert server.num_runs() == 0, who
    assert server.ask("GET", f"/api/deployments/{server.deployment()}")[0] == 200


def test_the_same_page_does_as_it_likes_with_prefect_alone(tmp_path: Path) -> None:
    """What the attempts above are worth: nobody is refused by a server that is not guarded."""
    port = free_port()
    environment = {"PATH": "/usr/bin:/bin", "PREFECT_HOME": str(tmp_path), "DO_NOT_TRACK": "1"}
    environment["PREFECT_SERVER_UI_STATIC_DIRECTORY"] = str(tmp_path / "ui")
    command = [sys.executable, "-m", "prefect", "server", "start", "--port", str(port)]
    with subprocess.Popen(
        command, cwd=tmp_path, env=environment, stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    ) as process:  # fmt: skip
        try:
            alone = Server(f"http://127.0.0.1:{port}/api", None, tmp_path, environment)
            deadline = time.monotonic() + START_S
            status = 0
            while status != 200:
                assert time.monotonic() < deadline, "the server did not start"
                with contextlib.suppress(OSError):
                    status, _ = alone.ask("GET", "/api/health")
                time.sleep(0.2)
            _, flow = alone.ask("POST", "/api/flows/", {"name": "f"})
            given = {"name": "local", "flow_id": flow["id"], "entrypoint": "f_scenes"}
            won: set[str] = set()
            for _ in range(5):  # a server that has just started breaks off answers on a busy disk
                assert alone.ask("POST", "/api/deployments/", given)[0] in (200, 201)  # deleted?
                with browser(RESOLVED) as page:
                    told = _attack_of(alone, page, _origins(alone)["another port of this machine"])
                won |= {name for name, how in told.items() if how.startswith("answered")}
                if won >= {"read: deployments", "run: json", "socket: events in", "frame"}:
                    return
        finally:
            process.kill()
    raise AssertionError((won, told))


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost"])
def test_its_own_page_opens_with_the_password(server: Server, name: str, tmp_path: Path) -> None:
    url = f"http://{name}:{server.host.rpartition(':')[2]}"
    with browser() as page:
        page.show(*DESKTOP)
        page.open(url)
        page.until("document.querySelector('input')")
        for password, next_ in (("admin:pass", "login"), (server.password, "dashboard")):
            page.run("document.querySelector('input').focus()")
            page.run("document.querySelector('input').select()")
            page.write(str(password))
            page.run("document.querySelector('button[type=submit]').click()")
            time.sleep(1.0 if next_ == "login" else 0.0)
            page.until(f"location.pathname.includes({next_!r})")
        for size in (DESKTOP, PHONE):
            page.show(*size)
            page.open(f"{url}/deployments")
            page.until("document.body.innerText.includes('generate-scenes')")
            assert page.run("document.documentElement.scrollWidth") <= size[0]
            page.picture(tmp_path / f"{size[0]}.png")
            assert (tmp_path / f"{size[0]}.png").stat().st_size > 10_000


def test_the_lines_of_the_readme_need_nothing_exported(server: Server, tmp_path: Path) -> None:
    """The server has started; a run ends as its documents say."""
    checkout = server.folder.parent
    run = documented_run(
        objects="builtin:6",
        scenes=4,
        resolution=64,
        changes=json.dumps(FEW_SAMPLES_CHANGES),
        out=tmp_path / "mine",
    )
    call(run, server.environment, 900, checkout)
    assert verify_dataset(tmp_path / "mine").problems == []
