"""A folder over HTTP on the loopback, by Python's own server, which counts what it sends."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any


class ByteServer:
    """Where it is, and what has left it: heads and contents of all answers."""

    def __init__(self) -> None:
        self.url = ""
        self.num_bytes = 0
        self._lock = threading.Lock()

    def count(self, num_bytes: int) -> None:
        """Add what was sent; called in several threads."""
        with self._lock:
            self.num_bytes += num_bytes


class _Handler(SimpleHTTPRequestHandler):
    counter: ByteServer
    protocol_version = "HTTP/1.1"

    def setup(self) -> None:
        super().setup()
        send = self.wfile.write

        def write(data: Any) -> int:
            self.counter.count(len(data))
            return send(data)

        self.wfile.write = write  # type: ignore[method-assign]

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""


@contextmanager
def serve_bytes(folder: Path) -> Iterator[ByteServer]:
    """Serve a folder on a free port while the block runs."""
    counter = ByteServer()
    handler = type("Handler", (_Handler,), {"counter": counter})
    with ThreadingHTTPServer(
        ("127.0.0.1", 0), lambda *given: handler(*given, directory=str(folder))
    ) as server:
        server.daemon_threads = True
        counter.url = f"http://127.0.0.1:{server.server_address[1]}"
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        try:
            yield counter
        finally:
            server.shutdown()
            thread.join()
