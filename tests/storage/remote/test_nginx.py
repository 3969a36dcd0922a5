"""The same dataset behind a real web server, which is made to fail, stall and die meanwhile."""

import io
import os
import shutil
import signal
import socket
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from storage.dataset.dataset import Dataset
from storage.dataset.shard import scan_members
from storage.dataset.verify import verify_dataset
from storage.remote import tries
from storage.remote import url as remote_url
from tests.storage.remote.conftest import SHARD, expected, read, until

NGINX = shutil.which("nginx", path=f"{os.environ.get('PATH', '')}:/usr/sbin:/usr/local/sbin")

CONFIG = """
daemon off; master_process off; pid {here}/pid; error_log {here}/error.log;
events {{}}
http {{
  log_format short '$request_method $uri $status $http_range $body_bytes_sent';
  access_log {here}/access.log short;
  client_body_temp_path {here}/t; proxy_temp_path {here}/t; fastcgi_temp_path {here}/t;
  uwsgi_temp_path {here}/t; scgi_temp_path {here}/t;
  server {{
    listen 127.0.0.1:{port}; root {root};
    location / {{
      if (-f {here}/down) {{ return 500; }}
      if (-f {here}/slow) {{ set $limit_rate 4000; }}
    }}
  }}
}}
"""


class Nginx:
    """A server that can be killed and started again on the same port."""

    def __init__(self, here: Path, root: Path) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.here = here
        self.url = f"http://127.0.0.1:{self.port}"
        here.mkdir()
        (here / "nginx.conf").write_text(CONFIG.format(here=here, root=root, port=self.port))

    def start(self) -> None:
        command = [str(NGINX), "-p", str(self.here), "-c", str(self.here / "nginx.conf")]
        self.process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        until(lambda: socket.socket().connect_ex(("127.0.0.1", self.port)) == 0)

    def kill(self) -> None:
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    def requests(self) -> list[list[str]]:
        """Return method, file, status, range and bytes of what was asked."""
        return [line.split() for line in (self.here / "access.log").read_text().splitlines()]


@pytest.fixture
def nginx(
    local: Dataset, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Nginx]:
    if NGINX is None:
        pytest.skip("no nginx here; install the distribution's package (Debian: nginx-light)")
    monkeypatch.setattr(tries, "PAUSE_S", 0.2)
    monkeypatch.setattr(remote_url, "_SILENCE_S", 1.0)
    remote_url._driver_of.cache_clear()
    server = Nginx(tmp_path / "nginx", local.folder.root)
    server.start()
    try:
        yield server
    finally:
        server.kill()
        remote_url._driver_of.cache_clear()


def start_reading(url: str) -> tuple[threading.Thread, list[dict[str, bytes]]]:
    found: list[dict[str, bytes]] = []
    thread = threading.Thread(target=lambda: found.extend(read(url)))
    thread.start()
    return thread, found


def test_errors_are_outlived(nginx: Nginx, local: Dataset) -> None:
    (nginx.here / "down").touch()
    thread, found = start_reading(nginx.url)
    until(lambda: ["GET", "/manifest.json", "500"] in [row[:3] for row in nginx.requests()])
    (nginx.here / "down").unlink()
    thread.join()
    assert found == expected(local)


def test_a_server_that_dies_and_comes_back_goes_on_where_it_was(
    nginx: Nginx, local: Dataset, cache: Path
) -> None:
    (nginx.here / "slow").touch()
    thread, found = start_reading(nginx.url)
    until(lambda: any(path.stat().st_size > 2000 for path in cache.glob("*.part")))
    nginx.kill()
    (nginx.here / "slow").unlink()
    nginx.start()
    thread.join()
    assert found == expected(local)
    last = [row for row in nginx.requests() if row[1] == f"/{SHARD}"][-1]
    assert last[2] == "206" and last[3].startswith("bytes=") and last[3] != "bytes=0-"
    assert int(last[4]) < local.shards_of("train")[0].num_bytes


def test_changed_and_missing_shards_are_named(nginx: Nginx, local: Dataset) -> None:
    assert verify_dataset(nginx.url, fast=True).problems == []
    assert verify_dataset(nginx.url).problems == []
    path = local.folder.root / SHARD
    content = bytearray(path.read_bytes())
    first = next(scan_members(io.BytesIO(content), SHARD))
    content[first.offset + first.num_bytes // 2] ^= 1
    path.write_bytes(content)
    (local.folder.root / "test-000005.tar").unlink()
    assert verify_dataset(nginx.url, fast=True).bad_shards == ["test-000005.tar"]
    found = verify_dataset(nginx.url)
    assert found.bad_shards == ["test-000005.tar", SHARD]
    assert any("sha256" in line and SHARD in line for line in found.problems)
    assert "test-000005.tar: missing" in found.problems
