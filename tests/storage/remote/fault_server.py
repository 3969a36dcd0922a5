"""A web server that gives ranges, counts what it sends, and breaks in every way it is told to."""

import hashlib
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote


@dataclass(frozen=True, kw_only=True)
class Fault:
    """What goes wrong with one answer."""

    status: int = 0
    """Answered instead of the content."""
    cut_after: int | None = None
    """Bytes after which the connection ends."""
    stall_after: int | None = None
    """Bytes after which nothing more comes."""
    flip: bool = False
    """One bit in the middle is another."""
    no_length: bool = False
    """The answer does not say how long it is: its end is the end of the connection."""
    other_part: bool = False
    """The part that is sent begins one byte late, and says so."""


@dataclass
class Server:
    """What the server has and how it behaves; may be changed while it runs."""

    url: str = ""
    root: Path = Path()
    faults: dict[str, list[Fault]] = field(default_factory=dict)
    """By file name, one for each GET in turn; after the last one all is well."""
    always: dict[str, Fault] = field(default_factory=dict)
    """By file name, for every GET."""
    ranges: bool = True
    needed_query: str = ""
    """Without it nothing is given."""
    sent: int = 0
    """Bytes of content that went out."""
    gets: list[tuple[str, str]] = field(default_factory=list)
    """File name and range of every GET."""
    lock: threading.Lock = field(default_factory=threading.Lock)
    closing: threading.Event = field(default_factory=threading.Event)


class _Handler(BaseHTTPRequestHandler):
    server_state: Server
    protocol_version = "HTTP/1.1"

    def do_HEAD(self) -> None:
        self._answer(Fault())

    def do_GET(self) -> None:
        state = self.server_state
        name = unquote(self.path.partition("?")[0]).lstrip("/")
        with state.lock:
            state.gets.append((name, self.headers.get("Range", "")))
            waiting = state.faults.get(name, [])
            fault = state.always.get(name) or (waiting.pop(0) if waiting else Fault())
        self._answer(fault)

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""

    def _answer(self, fault: Fault) -> None:
        state = self.server_state
        path, _, query = self.path.partition("?")
        file = state.root / unquote(path).lstrip("/")
        status = fault.status or (403 if query != state.needed_query else 0)
        if status or not file.is_file():
            self.send_response(status or 404)
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        data = bytearray(file.read_bytes())
        self._send(data, self._first(len(data), fault), fault)

    def _first(self, length: int, fault: Fault) -> int:
        asked = self.headers.get("Range", "")
        if not self.server_state.ranges or not asked.endswith("-"):
            return 0
        return int(asked.removeprefix("bytes=").removesuffix("-")) + fault.other_part

    def _send(self, data: bytearray, first: int, fault: Fault) -> None:
        etag = hashlib.sha256(data).hexdigest()[:8]
        if fault.flip:
            data[(first + len(data)) // 2] ^= 1
        self.send_response(206 if first else 200)
        if first:
            self.send_header("Content-Range", f"bytes {first}-{len(data) - 1}/{len(data)}")
        if not fault.no_length:
            self.send_header("Content-Length", str(len(data) - first))
        self.send_header("ETag", f'"{etag}"')
        self.end_headers()
        if self.command == "HEAD":
            return
        stop = fault.cut_after if fault.stall_after is None else fault.stall_after
        body = data[first:][:stop]
        self.wfile.write(body)
        with self.server_state.lock:
            self.server_state.sent += len(body)
        if fault.stall_after is not None:
            self.server_state.closing.wait(20)
        self.close_connection |= stop is not None or fault.no_length


@contextmanager
def serve(root: Path) -> Iterator[Server]:
    """Run a server of a folder on a free port of the loopback; its URL has no final slash."""
    state = Server(root=root)
    handler = type("Handler", (_Handler,), {"server_state": state})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    state.url = f"http://127.0.0.1:{server.server_address[1]}"
    try:
        yield state
    finally:
        state.closing.set()
        server.shutdown()
        thread.join()
        server.server_close()
