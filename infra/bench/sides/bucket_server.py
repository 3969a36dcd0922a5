"""A bucket on this machine: moto's S3 server, which says how often it was asked."""

import contextlib
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from storage.remote import url as remote_url

_NAME = "makers"
_ENVIRONMENT = {
    "AWS_ACCESS_KEY_ID": "bench",
    "AWS_SECRET_ACCESS_KEY": "bench",
    "AWS_DEFAULT_REGION": "us-east-1",
    "NO_PROXY": "127.0.0.1",
}


@dataclass(frozen=True, kw_only=True)
class BucketServer:
    """The server, until its context is left."""

    url: str
    """Of its bucket."""
    log: Path
    """One line a request."""
    pid: int
    """Its process."""

    def num_requests(self) -> int:
        """Return how often it was asked."""
        return sum(b"HTTP/1.1" in line for line in self.log.read_bytes().splitlines())

    def core_s(self) -> float:
        """Return the core-seconds that it has taken."""
        user, system = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()[11:13]
        return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


@contextlib.contextmanager
def bucket_server() -> Iterator[BucketServer]:
    """Run the server, which the environment of this process and its children names meanwhile."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = int(free.getsockname()[1])
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    wanted = {**_ENVIRONMENT, "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}"}
    before = {name: os.environ.get(name) for name in wanted}
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "requests.log"
        with log.open("wb") as stream:
            server = subprocess.Popen(command, stdout=stream, stderr=stream)
        try:
            os.environ.update(wanted)
            remote_url._driver_of.cache_clear()
            while socket.socket().connect_ex(("127.0.0.1", port)):
                time.sleep(0.05)
            _make_bucket()
            yield BucketServer(url=f"s3://{_NAME}/set", log=log, pid=server.pid)
        finally:
            server.kill()
            server.wait()
            remote_url._driver_of.cache_clear()
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value


def _make_bucket() -> None:
    place = remote_url.parse_url(f"s3://{_NAME}", what="bucket")
    assert isinstance(place, remote_url.RemoteUrl)
    remote_url.open_driver(place).mkdir(_NAME)
