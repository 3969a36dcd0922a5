"""A real S3 server of the package registry (moto), and a line to it that can be cut."""

import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import suppress

import pytest

CREDENTIALS = {
    "AWS_ACCESS_KEY_ID": "ada",
    "AWS_SECRET_ACCESS_KEY": "s3cret",
    "AWS_DEFAULT_REGION": "us-east-1",
}


class Line:
    """A line to the server that can be cut: the next answers end after so many bytes."""

    def __init__(self, to_port: int) -> None:
        self.to_port = to_port
        self.cuts: list[int] = []
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.port = self.listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self.listener.accept()
            except OSError:
                return
            server = socket.create_connection(("127.0.0.1", self.to_port))
            for source, target, back in ((client, server, False), (server, client, True)):
                threading.Thread(
                    target=self._pump, args=(source, target, back), daemon=True
                ).start()

    def _pump(self, source: socket.socket, target: socket.socket, back: bool) -> None:
        try:
            while data := source.recv(65536):
                if back and self.cuts and len(data) > self.cuts[0]:
                    target.sendall(data[: self.cuts.pop(0)])
                    break
                target.sendall(data)
        except OSError:
            pass
        for end in (source, target):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)  # closing alone would wait for the other thread
            end.close()


@pytest.fixture(scope="session")
def moto() -> Iterator[int]:
    """Run the server for all tests of a folder; returns its port on the loopback."""
    pytest.importorskip("s3fs", reason="needs the package s3fs (setup-all)")
    pytest.importorskip("moto", reason="needs the package moto with its server (setup-all)")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = int(free.getsockname()[1])
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    server = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        while socket.socket().connect_ex(("127.0.0.1", port)):
            time.sleep(0.05)
        yield port
    finally:
        server.kill()
        server.wait()


def control(port: int, what: str, data: bytes = b"") -> None:
    """Empty the server, or say after how many requests it begins to check who asks."""
    request = urllib.request.Request(
        f"http://127.0.0.1:{port}/moto-api/{what}",
        data=data,
        headers={"Content-Type": "text/plain"},
    )
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    opener.open(request).close()
