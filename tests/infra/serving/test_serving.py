"""`make serve`: a part that fails takes the others along; `make stop`: exactly what was started."""

import contextlib
import http.server
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import pytest

from infra.serving import local
from infra.serving.limits import limits
from infra.serving.local import running, start, stop
from pipeline.flows.limits import DISK_LIMIT, GPU_LIMIT
from pipeline.flows.prefect_server import TOLD_BY_ITS_STARTER, wait_until_healthy
from storage.errors import TrilightError
from tests.for_each import case

SLEEP = [sys.executable, "-c", "import time; time.sleep(120)"]


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path))
    monkeypatch.delenv("PREFECT_SERVER_API_AUTH_STRING", raising=False)
    (tmp_path / "serve").mkdir()
    return tmp_path / "serve" / "mark"


def _until_seen(number: int) -> None:
    """Wait: a process that has just begun shows no environment for an instant."""
    deadline = time.monotonic() + 10
    while len(running()) < number and time.monotonic() < deadline:
        time.sleep(0.01)


def test_stop_ends_what_was_started_and_no_stranger(cache: Path) -> None:
    cache.write_text("ours")
    marks = ("ours", "ours-too", "other")
    processes = [
        subprocess.Popen(SLEEP, env={**os.environ, "TRILIGHT_SERVED": mark}, start_new_session=True)
        for mark in marks
    ]
    try:
        _until_seen(1)
        with pytest.raises(TrilightError, match="runs already"):
            start(host="127.0.0.1", port=4321, workers=1)
        assert stop() == 1
        assert processes[0].wait(30) != 0
        assert [process.poll() for process in processes[1:]] == [None, None]
        assert stop() == 0
    finally:
        for process in processes:
            process.kill()
            process.wait()


def test_stop_leaves_it_to_the_starter_to_tell_what_may_save(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second SIGTERM would end training before it has saved; who does not end is killed."""
    monkeypatch.setattr(local, "_END_S", 0.5)
    cache.write_text("ours")
    environment = {**os.environ, "TRILIGHT_SERVED": "ours", TOLD_BY_ITS_STARTER: "1"}
    with subprocess.Popen(SLEEP, env=environment, start_new_session=True) as process:
        _until_seen(1)
        assert stop() == 1
        assert process.wait(30) == -signal.SIGKILL


def test_a_port_of_somebody_else_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local.shutil, "which", lambda name: name)
    monkeypatch.setattr(local, "_launch", lambda *arguments: pytest.fail("launched"))
    monkeypatch.setattr(local, "_RELEASE_S", 0.2)  # this stranger never releases the port
    with socket.create_server(("127.0.0.1", 0)) as stranger:
        port = stranger.getsockname()[1]
        with pytest.raises(TrilightError, match=rf"127.0.0.1:{port} cannot.*Set TRILIGHT_PORT"):
            start(host="127.0.0.1", port=port, workers=1)


def test_an_answer_counts_only_while_our_server_lives(tmp_path: Path) -> None:
    class Ends:
        """A server that cannot bind, and ends while a stranger answers for it."""

        answers = 0

        def poll(self) -> int | None:
            self.answers += 1
            return None if self.answers == 1 else 1

    with healthy_server() as url, pytest.raises(TrilightError, match="did not start"):
        wait_until_healthy(url, cast(Any, Ends()), tmp_path / "log")


@contextlib.contextmanager
def healthy_server() -> Iterator[str]:
    class Healthy(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.end_headers()

        def log_message(self, format: str, *arguments: object) -> None:
            pass

    with http.server.HTTPServer(("127.0.0.1", 0), Healthy) as stranger:
        threading.Thread(target=stranger.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{stranger.server_port}/api"
        stranger.shutdown()


WRONG_VARIABLES = [
    ("TRILIGHT_PORT", "x"), ("TRILIGHT_PORT", "0"), ("TRILIGHT_PORT", "65536"),
    ("TRILIGHT_HOST", "::1"), ("TRILIGHT_WORKERS", "0"), ("TRILIGHT_WORKERS", "-1"),
]  # fmt: skip


def test_wrong_variables_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local.shutil, "which", lambda name: name)
    for variable, value in WRONG_VARIABLES:
        with case((variable, value)), monkeypatch.context() as patch:
            patch.setenv(variable, value)
            with pytest.raises(SystemExit, match=rf"{variable} is '{value}'; expected"):
                local.main(["start"])


def test_workers_share_the_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRILIGHT_CORES", "9")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0,1,2")
    assert local._share(0, 1) == {}
    two = [local._share(number, 2) for number in range(2)]
    assert [share["CUDA_VISIBLE_DEVICES"] for share in two] == ["0,2", "1"]
    assert [share["TRILIGHT_CORES"] for share in two] == ["4", "4"]
    four = [local._share(number, 4)["CUDA_VISIBLE_DEVICES"] for number in range(4)]
    assert four == ["0", "1", "2", "0"]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert local._share(11, 12) == {"TRILIGHT_CORES": "1"}


def test_cards_are_those_of_this_machine_or_of_all_workers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0,1,2")
    assert limits({}) == {DISK_LIMIT: 2, GPU_LIMIT: 3}
    assert limits({"TRILIGHT_CARDS": "16"})[GPU_LIMIT] == 16
    for wrong in ("0", "-1", "many", "", "100001"):
        with pytest.raises(TrilightError, match=f"TRILIGHT_CARDS is '{wrong}'; expected a whole"):
            limits({"TRILIGHT_CARDS": wrong})
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert limits({})[GPU_LIMIT] == 1  # a limit of 0 would let nothing begin
