"""A page that is served for a test, and who asks it."""

import contextlib
import http.client
import json
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from typing import Any

from infra.viewer.open_source import PageHandlers, deferred_routes
from infra.viewer.server import PageServer


class Asker:
    """Sends requests as a browser would, or as a stranger."""

    def __init__(self, server: PageServer) -> None:
        self.port, self.word = server.port, server.token
        self.here = f"127.0.0.1:{self.port}"

    def ask(
        self, path: str, body: Any = None, *, word: str | None = None, **headers: str
    ) -> tuple[int, Any, http.client.HTTPMessage]:
        """Return status, answer (JSON where it is some) and headers."""
        line = http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)
        sent = {"Host": self.here, "Origin": f"http://{self.here}"} if body is not None else {}
        sent = {**sent, **{name.replace("_", "-"): text for name, text in headers.items()}}
        data = None if body is None else json.dumps(body)
        whole = f"/{self.word if word is None else word}/{path}"
        line.request("GET" if body is None else "POST", whole, data, sent)
        answer = line.getresponse()
        bytes_ = answer.read()
        line.close()
        try:
            return answer.status, json.loads(bytes_), answer.headers
        except ValueError:
            return answer.status, bytes_, answer.headers


@contextlib.contextmanager
def served(room: PageHandlers, page: str = "scene.html") -> Iterator[Asker]:
    """Serve a room for the block."""
    opened = Future[PageHandlers]()
    opened.set_result(room)
    server = PageServer(deferred_routes(page, opened))
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    try:
        yield Asker(server)
    finally:
        room.close()
        server.close()
        thread.join()
