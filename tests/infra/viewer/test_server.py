"""Who is answered, what the pages are made of, and a page that waits for what it shows."""

import contextlib
import re
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from infra.viewer import server as viewer_server
from infra.viewer.open_source import DeferredHandlers, page_of
from infra.viewer.server import (
    MAX_BODY_BYTES,
    MAX_PATH,
    STATIC,
    NotFound,
    PageServer,
    Request,
    Response,
    Routes,
    json_response,
    refusal,
)
from storage.errors import TrilightError
from tests.for_each import case
from tests.infra.run_by_hand import write_run
from tests.infra.viewer.served_kit import Asker, served

PORT, WORD = 4711, "secret"
HERE = f"127.0.0.1:{PORT}"


class EchoRoom:
    """Answers what it was asked, and makes mistakes when told to."""

    def routes(self) -> Routes:
        names = ("GET api/echo", "GET api/below/", "POST api/echo")
        return dict.fromkeys(names, self._echo)

    def close(self) -> None:
        pass

    def _echo(self, question: Request) -> Response:
        if "mistake" in question.query:
            raise TrilightError("that is a mistake.")
        if "bug" in question.query:
            raise ZeroDivisionError
        return json_response({"path": question.path, "body": question.body})


@pytest.fixture(scope="module")
def asker() -> Iterator[Asker]:
    with served(EchoRoom()) as found:
        yield found


QUESTIONS: list[tuple[bool, str, str, dict[str, str]]] = [
    (True, "GET", f"/{WORD}/", {}),
    (True, "GET", f"/{WORD}/", {"Sec-Fetch-Site": "none"}),
    (True, "GET", f"/{WORD}/", {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": "document"}),
    (True, "POST", f"/{WORD}/x", {"Origin": f"http://{HERE}", "Content-Length": "2"}),
    (False, "GET", "/", {}),
    (False, "GET", f"/{WORD[:-1]}/", {}),
    (False, "GET", f"/x/../{WORD}/", {}),
    (False, "GET", f"/{WORD}/", {"Host": f"localhost:{PORT}"}),
    (False, "GET", f"/{WORD}/", {"Host": f"evil.example:{PORT}"}),
    (False, "GET", f"/{WORD}/", {"Origin": "null"}),
    (False, "GET", f"/{WORD}/", {"origin": "http://evil.example"}),
    (False, "GET", f"/{WORD}/", {"sec-fetch-site": "cross-site"}),
    (False, "GET", f"/{WORD}/", {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": "image"}),
    (False, "GET", f"/{WORD}/", {"Sec-Fetch-Site": "same-site", "Sec-Fetch-Dest": "script"}),
    (False, "GET", f"/{WORD}/{'x' * MAX_PATH}", {}),
    (False, "POST", f"/{WORD}/x", {"Content-Length": "2"}),
    (False, "POST", f"/{WORD}/x", {"Origin": f"http://{HERE}"}),
    (False, "POST", f"/{WORD}/x", {"Origin": f"http://{HERE}", "Content-Length": "9" * 30}),
    (
        False,
        "POST",
        f"/{WORD}/x",
        {"Origin": "http://evil.example", "Content-Length": "2", "Sec-Fetch-Dest": "document"},
    ),
]


def test_who_may_ask() -> None:
    for passes, method, path, headers in QUESTIONS:
        with case((passes, method, path, headers)):
            asked = {"Host": HERE, **headers}
            assert (refusal(method, path, asked.items(), port=PORT, token=WORD) is None) == passes
            for name, value in asked.items() if passes else ():
                for twice in ([(name, "x")], [(name.upper(), value)]):
                    pairs = [*asked.items(), *twice], [*twice, *asked.items()]
                    for both in pairs:
                        assert refusal(method, path, both, port=PORT, token=WORD) is not None


def test_a_stranger_gets_one_sentence_and_no_header_that_lets_others_read(asker: Asker) -> None:
    status, answer, headers = asker.ask("api/echo", word="guessed")
    assert status == 403
    assert "whole address" in answer["error"]
    assert "api" not in str(answer)
    assert not [name for name in headers if name.lower().startswith("access-control")]


def test_every_answer_is_shut_in(asker: Asker) -> None:
    for path in ("", "static/style.css", "api/echo", "api/nothing"):
        _, _, headers = asker.ask(path)
        policy = headers["Content-Security-Policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy and "http" not in policy
        assert headers["Referrer-Policy"] == "no-referrer"
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert not [name for name in headers if name.lower().startswith("access-control")]


NO_FILES = [
    "static/../guard.py", "static/%2e%2e/guard.py", "static//etc/passwd", "../etc/passwd",
    "static/..%2f..%2fcli%2fview.py", "static/three", "static/", "%00", "api", "scene",
]  # fmt: skip


def test_routes_mistakes_and_bodies(asker: Asker) -> None:
    """No path leads out of the list of files."""
    for path in NO_FILES:
        assert asker.ask(path)[0] == 404, path
    assert asker.ask("api/below/a%20b?x=1")[1]["path"] == "api/below/a b"
    assert asker.ask("api/echo", {"n": 1})[1]["body"] == {"n": 1}
    assert asker.ask("api/echo?mistake=1")[:2] == (422, {"error": "that is a mistake."})
    assert asker.ask("api/below/", {"n": 1})[0] == 404
    assert asker.ask("api/echo", "x" * MAX_BODY_BYTES)[0] == 413


def sent(asker: Asker, verb: str, head: str, text: str = "") -> str:
    """Return the answer to a request that no library would send."""
    with socket.create_connection(("127.0.0.1", asker.port), timeout=30) as line:
        request = f"{verb} /{asker.word}/api/echo HTTP/1.1\r\nHost: {asker.here}\r\n{head}"
        line.sendall(f"{request}Connection: close\r\n\r\n{text}".encode())
        return line.makefile("rb").read().decode()


def test_no_other_verb_is_known_and_a_body_that_is_no_json_is_a_sentence(asker: Asker) -> None:
    for verb in ("PUT", "DELETE", "OPTIONS", "HEAD"):
        answer = sent(asker, verb, "")
        assert answer.startswith("HTTP/1.1 501"), verb
        assert "access-control" not in answer.lower()
    text = "[" * 100_000
    head = f"Origin: http://{asker.here}\r\nContent-Length: {len(text)}\r\n"
    assert "the request is no JSON" in sent(asker, "POST", head, text)
    for value in ("NaN", "-Infinity", "1e999", "-1e999", "9" * 400, "9" * 5000):
        for text in (value, f'{{"edits": {{"lamps": {{"0": {{"gain": [{value}]}}}}}}}}'):
            head = f"Origin: http://{asker.here}\r\nContent-Length: {len(text)}\r\n"
            assert "no JSON with finite numbers" in sent(asker, "POST", head, text), value
    assert asker.ask("api/echo?bug=1")[0] == 500


def test_half_requests_end_and_hold_nobody_up(
    asker: Asker, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Idle ones, half of a head, half of a body with the password, and a slow drip."""
    head = f"POST /{asker.word}/api/echo HTTP/1.1\r\nHost: {asker.here}\r\n"
    head += f"Origin: http://{asker.here}\r\nContent-Length: 1000\r\n\r\n"
    halves = [b"", b"GET / HTTP/1.1\r\nHost: x\r\n", head.encode()]
    lines, began = list[socket.socket](), time.monotonic()
    try:
        for number in range(150):
            lines.append(socket.create_connection(("127.0.0.1", asker.port), timeout=20))
            lines[-1].sendall(halves[number % 3])
            if number % 10 == 9:
                assert asker.ask("api/below/a")[0] == 200
        assert _count_open(lines) <= 64, "the oldest are closed"
        assert time.monotonic() - began < 20, "nobody waited"
        monkeypatch.setattr(viewer_server, "_REQUEST_S", 0.3)
        while _count_open(lines):
            assert time.monotonic() - began < 40
            for line in lines:
                with contextlib.suppress(OSError):
                    line.sendall(b"x")
            time.sleep(0.05)
    finally:
        for line in lines:
            line.close()


def _count_open(lines: list[socket.socket]) -> int:
    def is_open(line: socket.socket) -> bool:
        try:
            return bool(line.recv(1 << 16, socket.MSG_DONTWAIT))
        except BlockingIOError:
            return True
        except OSError:
            return False

    return sum(map(is_open, lines))


def test_it_listens_on_this_machine_alone_and_says_which_port_is_taken() -> None:
    server = PageServer({})
    try:
        assert server.server_address[0] == "127.0.0.1"
        assert len(server.token) >= 32
        assert server.address == f"http://127.0.0.1:{server.server_port}/{server.token}/"
        with pytest.raises(TrilightError, match=f"--port is {server.server_port}"):
            PageServer({}, port=server.server_port)
    finally:
        server.server_close()


def test_pages_load_what_is_there_and_nothing_from_elsewhere() -> None:
    own = [path for path in STATIC.iterdir() if path.suffix in (".html", ".js", ".css")]
    assert len(own) > 8
    named = 0
    for path in own:
        text = path.read_text().replace("http://www.w3.org/2000/svg", "")
        for place in re.findall(r'(?:(?:src|href)="static|from "\.)/([^"]+)"', text):
            assert (STATIC / place).is_file(), (path, place)
            named += 1
        assert "http:" not in text and "https:" not in text and "//cdn" not in text, path
        assert "innerHTML" not in text and "eval(" not in text, path
        assert "<script>" not in text and " style=" not in text and "onclick=" not in text, path
    assert named > 15


def test_every_element_that_a_script_asks_for_is_in_its_page() -> None:
    scripts = {
        "scene.html": ("scene.js", "pictures.js", "edits.js", "ask.js"),
        "dataset.html": ("dataset.js", "ask.js"),
        "folder.html": ("folder.js", "ask.js"),
    }
    for page, names in scripts.items():
        there = set(re.findall(r'id="([\w-]+)"', (STATIC / page).read_text()))
        for name in names:
            text = (STATIC / name).read_text()
            asked = set(re.findall(r'(?:byId|getElementById)\("([\w-]+)"\)', text))
            assert asked and asked <= there, (page, name, asked - there)


def test_the_page_of_a_source(tmp_path: Path) -> None:
    write_run(tmp_path / "run")
    (tmp_path / "set").mkdir()
    with pytest.raises(TrilightError, match="no dataset, and holds no scene"):
        page_of(str(tmp_path / "set"))
    (tmp_path / "set" / "room.glb").touch()
    assert page_of(str(tmp_path / "set")) == "folder.html"
    (tmp_path / "set" / "manifest.json").write_text("{}")
    (tmp_path / "a.tar").touch()
    with pytest.raises(TrilightError, match=r"a training run; .* `tensorboard --logdir /.*/run`"):
        page_of(str(tmp_path / "run"))
    assert page_of(str(tmp_path / "set")) == "dataset.html"
    assert page_of("https://example.org/set") == "dataset.html"
    for scene in ("a.tar", "a.tar::000000000"):
        assert page_of(str(tmp_path / scene)) == "scene.html"
    for missing in ("b.json", "b.tar::1"):
        with pytest.raises(TrilightError, match="no such file"):
            page_of(str(tmp_path / missing))


def test_questions_wait_until_the_source_is_open() -> None:
    later, answers = DeferredHandlers("scene.html"), list[bytes]()
    assert later.routes["GET "](Request(path="", query={})).kind.startswith("text/html")
    asked = threading.Thread(
        target=lambda: answers.append(
            later.routes["GET api/"](Request(path="api/echo", query={})).body
        )
    )
    asked.start()
    asked.join(0.05)
    assert asked.is_alive() and not answers
    later.opened.set_result(EchoRoom())
    asked.join(10)
    assert b"api/echo" in answers[0]
    with pytest.raises(NotFound):
        later.routes["POST api/"](Request(method="POST", path="api/none", query={}))
