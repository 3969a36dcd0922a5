"""The server of a page: answers guarded requests from a table of routes, on this machine alone."""

import json
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qsl, unquote

from infra.viewer.guard import HOST, MAX_BODY_BYTES, SAFE_HEADERS, new_word, refusal
from storage.errors import TrilightError

MOST_CONNECTIONS = 32
"""Requests that are answered at a time; a browser opens six, and more wait."""

_STALLED_S = 30.0
"""A browser that sends nothing for so long is left."""


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What a request gets."""

    body: bytes
    kind: str = "application/json"
    """Media type."""
    headers: Mapping[str, str] = field(default_factory=dict)
    """Further ones."""


def json_answer(value: Any) -> Answer:
    """Return a value as JSON."""
    return Answer(body=json.dumps(value, allow_nan=False).encode())


@dataclass(frozen=True, kw_only=True)
class Question:
    """A request that may pass."""

    path: str
    """Below the password, decoded, without the first slash."""
    query: Mapping[str, str]
    """What stands behind the question mark."""
    body: Any = None
    """JSON of a POST."""


class NotThere(TrilightError):
    """There is nothing at a path."""


Route = Callable[[Question], Answer]
"""Answers the requests of one path, or of all paths below a prefix that ends in a slash; raises
TrilightError with a sentence for the page, NotThere where there is nothing."""


def routed(routes: Mapping[str, Route], question: Question) -> Answer:
    """Return what the route of a question answers; raises TrilightError as a `Route` does."""
    path = question.path
    for prefix, route in routes.items():
        if path == prefix or (prefix.endswith("/") and path.startswith(prefix)):
            return route(question)
    raise NotThere(f"{path or 'the page'}: nothing is there.")


class PageServer(ThreadingHTTPServer):
    """Listens on loopback; `address` is what a person opens."""

    daemon_threads = True
    request_queue_size = 64

    def __init__(
        self, gets: Mapping[str, Route], posts: Mapping[str, Route], *, port: int = 0
    ) -> None:
        """Take a port; 0 for any that is free.

        Raises:
            TrilightError: the port is taken.
        """
        self.gets, self.posts, self.word = gets, posts, new_word()
        self.places = threading.BoundedSemaphore(MOST_CONNECTIONS)
        try:
            super().__init__((HOST, port), _Handler)
        except OSError as error:
            raise TrilightError(
                f"--port is {port}, which cannot be listened at ({error.strerror}); expected a "
                "free port, or none, and one is found."
            ) from error

    @property
    def address(self) -> str:
        """URL with the password."""
        return f"http://{HOST}:{self.server_port}/{self.word}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing: a browser that goes away in the middle of an answer is no news."""


class _Handler(BaseHTTPRequestHandler):
    """One connection."""

    server: PageServer
    protocol_version = "HTTP/1.1"
    timeout = _STALLED_S
    server_version, sys_version = "trilight", ""

    def do_GET(self) -> None:
        self._answer("GET")

    def do_POST(self) -> None:
        self._answer("POST")

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing: the path holds the password."""

    def _answer(self, method: str) -> None:
        refused = refusal(
            method,
            self.path,
            dict(self.headers.items()),
            port=self.server.server_port,
            word=self.server.word,
        )
        if refused is not None:
            self.close_connection = True
            self._say(refused.status, refused.sentence)
            return
        with self.server.places:
            try:
                self._send(HTTPStatus.OK, self._routed(method))
            except NotThere as error:
                self._say(HTTPStatus.NOT_FOUND, str(error))
            except TrilightError as error:
                self._say(HTTPStatus.UNPROCESSABLE_ENTITY, str(error))

    def _routed(self, method: str) -> Answer:
        path, _, query = self.path.partition("?")
        below = unquote(path.removeprefix(f"/{self.server.word}")).removeprefix("/")
        body = self._body() if method == "POST" else None
        question = Question(path=below, query=dict(parse_qsl(query)), body=body)
        return routed(self.server.posts if method == "POST" else self.server.gets, question)

    def _body(self) -> Any:
        data = self.rfile.read(min(int(self.headers["Content-Length"]), MAX_BODY_BYTES))
        try:
            return json.loads(data)
        except (ValueError, RecursionError) as error:
            raise TrilightError("the request is no JSON.") from error

    def _say(self, status: HTTPStatus, sentence: str) -> None:
        """Send a sentence: to a script as JSON, to a person as text."""
        if "text/html" in self.headers.get("Accept", ""):
            self._send(status, Answer(body=sentence.encode(), kind="text/plain; charset=utf-8"))
        else:
            self._send(status, json_answer({"error": sentence}))

    def _send(self, status: HTTPStatus, answer: Answer) -> None:
        self.send_response(status)
        headers = {"Content-Type": answer.kind, "Content-Length": str(len(answer.body))}
        for name, value in {**SAFE_HEADERS, **headers, **answer.headers}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(answer.body)
