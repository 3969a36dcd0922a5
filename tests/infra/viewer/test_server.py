"""Who is answered, what the pages are made of, and a page that waits for what it shows."""

import contextlib
import dataclasses
import io
import itertools
import json
import os
import re
import shlex
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any
from unittest import mock
from urllib.parse import urlencode

import numpy as np
import pytest
from PIL import Image
from starlette.responses import JSONResponse, Response

from infra.render.path_tracer import RenderChild
from infra.viewer import open_source
from infra.viewer.list_handlers import THUMBNAIL_PX, DatasetHandlers, FolderHandlers
from infra.viewer.open_source import PageHandlers, deferred_routes, page_of, scene_list
from infra.viewer.server import (
    HOST,
    MAX_BODY_BYTES,
    MAX_PATH,
    STATIC,
    NotFound,
    PageServer,
    Request,
    Routes,
    refusal,
)
from pipeline.exchange.convert import write_scene
from pipeline.flows import guarded_server
from pipeline.generation.derive_dataset import Selection, list_scenes
from pipeline.renders.mitsuba_variant import Variant, choose_variant
from storage.conventions import preview_srgb8
from storage.dataset.dataset import Dataset
from storage.errors import TrilightError
from storage.records.sample import Sample
from tests.for_each import case
from tests.infra.run_by_hand import write_run
from tests.infra.viewer.served_kit import Asker, served
from tests.pipeline.documents.dataset_by_hand import furnished, locked, sample, write_dataset
from tests.scenes_by_hand import tiny_scene

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
        return JSONResponse({"path": question.path, "body": question.body})


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
        {"Origin": f"http://{HERE}", "Content-Length": "2", "Transfer-Encoding": "chunked"},
    ),
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


def test_every_answer_is_shut_in_and_a_stranger_gets_one_sentence(asker: Asker) -> None:
    for path in ("", "static/style.css", "api/echo", "api/nothing"):
        _, _, headers = asker.ask(path)
        policy = headers["Content-Security-Policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy and "http" not in policy
        assert headers["Referrer-Policy"] == "no-referrer"
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert not [name for name in headers if name.lower().startswith("access-control")]
    status, answer, headers = asker.ask("api/echo", word="guessed")
    assert status == 403
    assert "whole address" in answer["error"]
    assert "api" not in str(answer)
    assert not [name for name in headers if name.lower().startswith("access-control")]


def test_routes_mistakes_and_bodies(asker: Asker) -> None:
    """No path leads out of the list of files."""
    for path in [
        "static/../guard.py", "static/%2e%2e/guard.py", "static//etc/passwd", "../etc/passwd",
        "static/..%2f..%2fcli%2fview.py", "static/three", "static/", "%00", "api", "scene",
    ]:  # fmt: skip
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
    monkeypatch.setattr(guarded_server, "REQUEST_S", 0.5)
    try:
        for number in range(150):
            lines.append(socket.create_connection(("127.0.0.1", asker.port), timeout=20))
            lines[-1].sendall(halves[number % 3])
            if number % 10 == 9:
                assert asker.ask("api/below/a")[0] == 200
        assert time.monotonic() - began < 20, "nobody waited"
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
    assert HOST == "127.0.0.1"
    with served(EchoRoom()) as asker:
        assert len(asker.word) >= 32
        with pytest.raises(TrilightError, match=f"--port is {asker.port}"):
            PageServer({}, port=asker.port)


def test_pages_load_what_is_there_and_nothing_from_elsewhere() -> None:
    own = [path for path in STATIC.iterdir() if path.suffix in (".html", ".js", ".css")]
    assert len(own) > 8
    named = 0
    for path, page in itertools.product(own, ("scene", "dataset", "folder")):
        text = path.read_text().replace("http://www.w3.org/2000/svg", "").replace("PAGE", page)
        for place in re.findall(r'(?:(?:src|href)="static|from "\.)/([^"]+)"', text):
            assert (STATIC / place).is_file(), (path, place)
            named += 1
        assert "http:" not in text and "https:" not in text and "//cdn" not in text, path
        assert "innerHTML" not in text and "eval(" not in text, path
        assert "<script>" not in text and " style=" not in text and "onclick=" not in text, path
    assert named > 3 * 9


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
    opened, answers = Future[PageHandlers](), list[Response]()
    routes = deferred_routes("scene.html", opened)
    assert routes["GET "](Request(path="", query={})).media_type == "text/html"
    asked = threading.Thread(
        target=lambda: answers.append(routes["GET api/"](Request(path="api/echo", query={})))
    )
    asked.start()
    asked.join(0.05)
    assert asked.is_alive() and not answers
    opened.set_result(EchoRoom())
    asked.join(10)
    assert b"api/echo" in bytes(answers[0].body)
    with pytest.raises(NotFound):
        routes["POST api/"](Request(method="POST", path="api/none", query={}))


CUBE, BALL = locked("cube"), locked("ball")


def samples() -> dict[str, list[Sample]]:
    scenes = [furnished(["cube"] * (1 + row % 3), ("plane", "wall")[row % 2]) for row in range(8)]
    made = [
        sample(row, scene, noise_floor_db=30.0 + row, coverage=0.1 * row, spp=64 + row)
        for row, scene in enumerate(scenes)
    ]
    return {"train-000000.tar": made[:5], "validation-000001.tar": made[5:]}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    root = tmp_path_factory.mktemp("sets") / "a set"
    return write_dataset(root, samples(), objects=[CUBE, BALL])


@pytest.fixture(scope="module")
def dataset_asker(dataset: Dataset) -> Iterator[Asker]:
    child = RenderChild(
        Variant(name="llvm_ad_rgb", libllvm="", note=""), threads=1
    )  # nothing is traced here
    room = DatasetHandlers(dataset, str(dataset.folder.root), child, None)
    room.index._thread.join()
    with served(room, "dataset.html") as found:
        yield found


def test_what_is_shown_is_what_the_printed_command_selects(
    dataset_asker: Asker, dataset: Dataset
) -> None:
    for query in [
        {},
        {"split": "train"},
        {"split": "validation", "template": "wall"},
        {"where": "triangles_per_scene >= 6 and triangles_per_scene <= 8"},
        {"where": "lights_per_scene <= 0"},
        {"split": "train", "where": "min(noise_floor_db) >= 31.5 and min(noise_floor_db) <= 35"},
        {"where": "min(coverage) >= 0.3 and max(coverage) <= 0.7 and min(spp) > 60"},
    ]:
        with case(query):
            found = dataset_asker.ask(f"api/rows?{urlencode(query)}")[1]
            words = shlex.split(found["command"])
            assert bool(words) == bool(query)
            options = dict(zip(words[4::2], words[5::2], strict=True))
            if words:
                assert words[:4] == ["trilight", "shards", "select", str(dataset.folder.root)]
                assert Path(options["--out"]) == dataset.folder.root.with_name("a set-selected")
            stated: dict[str, Any] = {
                name: options.get(f"--{name}") for name in ("split", "template", "where")
            }
            selection = Selection(**stated)
            assert {row.pop("views") for row in found["rows"]} <= {2}
            assert found["rows"] == list_scenes(dataset, selection)


def test_the_facts_of_a_dataset_name_its_preset_as_people_type_it(dataset: Dataset) -> None:
    manifest = dataclasses.replace(dataset.manifest, build="smoke")
    stored = Dataset(dataset.store, manifest)
    room = DatasetHandlers(stored, "stored", mock.Mock(spec=["close"]), None)  # traces nothing
    facts = room.routes()["GET api/dataset"](Request(path="api/dataset", query={}))
    assert json.loads(bytes(facts.body))["build"] == "tiny"
    room.close()


def test_rows_come_page_by_page_and_pictures_and_scenes_as_stored(dataset_asker: Asker) -> None:
    falling = dataset_asker.ask("api/rows?sort=floor&descending=1")[1]["rows"]
    assert [row["floor"] for row in falling] == sorted(30.0 + row for row in range(8))[::-1]
    rest = dataset_asker.ask("api/rows?from=6")[1]
    assert rest["total"] == 8 and len(rest["rows"]) == 2
    for wrong in (
        "sort=age", "split=all", "where=lights_per_scene", "where=min(noise_floor_db)%20>=%20x",
        "where=max(roughness)%20<%201",
    ):  # fmt: skip
        assert dataset_asker.ask(f"api/rows?{wrong}")[0] == 422, wrong
    status, png, _ = dataset_asker.ask("api/thumbnail/000000006/1?px=16")
    assert status == 200
    wanted = preview_srgb8(samples()["validation-000001.tar"][1].radiance_rgb[1])
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(png))), wanted)
    for wrong, status in (
        ("000000006/9", 404), ("000000006/x", 404), ("000000099/0", 422), ("../0", 422),
        ("000000006/0?px=9999", 422), ("000000006/0?px=-1", 422), ("000000006", 404),
    ):  # fmt: skip
        assert dataset_asker.ask(f"api/thumbnail/{wrong}")[0] == status, wrong
    assert b'id="stage"' in dataset_asker.ask("scene/000000003/")[1]
    facts = dataset_asker.ask("scene/000000003/api/scene")[1]
    assert facts["target_px"] == 16 and "target" in [each["name"] for each in facts["engines"]]
    assert dataset_asker.ask("scene/000000003/static/scene.js")[0] == 200
    for wrong in ("scene/000000099/api/scene", "scene/x/../../", "scene/", "scene/a/b/api/scene"):
        assert dataset_asker.ask(wrong)[0] in (404, 422), wrong


def test_a_damaged_shard_costs_itself_alone(tmp_path: Path) -> None:
    broken = write_dataset(tmp_path / "broken", samples(), objects=[CUBE, BALL])
    shard = broken.folder.root / "train-000000.tar"
    shard.write_bytes(shard.read_bytes()[:5000])
    room = DatasetHandlers(broken, "broken", mock.Mock(spec=["close"]), None)
    room.index._thread.join()
    assert {row.columns["split"] for row in room.index.rows} >= {"validation"}
    assert len(room.index.problems) == 1 and "train-000000.tar" in room.index.problems[0]
    room.close()


NAMES = ["a & <b>.h5", "notes.json", "rooms/tiny.safetensors"]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of two scenes, a file that is none, and much that is not listed."""
    root = tmp_path_factory.mktemp("scenes")
    for name in ("rooms", ".hidden", "meshes"):
        (root / name).mkdir()
    scene = tiny_scene()
    write_scene(root / NAMES[2], scene)
    pictures = np.full((scene.num_views, 16, 16, 3), 0.25, np.float32)
    write_scene(root / NAMES[0], scene, pictures)
    (root / NAMES[1]).write_text('{"title": "no scene"}')
    for name in (".hidden/x.glb", ".x.glb", "meshes/x.obj", "readme.txt", "shard.tar"):
        (root / name).touch()
    return root


@pytest.fixture(scope="module")
def folder_asker(root: Path) -> Iterator[Asker]:
    child = RenderChild(choose_variant(), threads=1)
    with served(FolderHandlers(root, child, None), "folder.html") as found:
        yield found


def test_the_list_is_of_files_that_may_be_scenes(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "loop").symlink_to(root, target_is_directory=True)
    with pytest.raises(TrilightError, match="holds no scene; expected .*json"):
        scene_list(tmp_path)
    os.symlink(root / NAMES[1], tmp_path / "linked.json")
    assert scene_list(tmp_path) == (["linked.json"], False)
    monkeypatch.setattr(open_source, "MOST_FILES", 2)
    assert scene_list(root) == (NAMES[:2], True)


def test_each_file_tells_what_it_holds_and_shows_it(folder_asker: Asker) -> None:
    facts = folder_asker.ask("api/folder")[1]
    assert facts["files"] == NAMES and not facts["is_cut"]
    assert facts["forms"] == [".h5", ".json", ".safetensors"]
    about = folder_asker.ask("api/about/2")[1]
    assert (about["triangles"], about["lights"], about["views"]) == (3, 1, 2)
    stored = np.asarray(Image.open(io.BytesIO(folder_asker.ask("api/thumbnail/0")[1])))
    wanted = preview_srgb8(np.full((1, 1, 3), 0.25, np.float32))
    assert (stored == wanted).all(), "the picture that the file holds"
    traced = Image.open(io.BytesIO(folder_asker.ask("api/thumbnail/2")[1]))
    assert traced.size == (THUMBNAIL_PX, THUMBNAIL_PX) and np.unique(np.asarray(traced)).size > 10
    status, said, _ = folder_asker.ask("api/about/1")
    assert status == 422 and "notes.json: " in said["error"]
    for wrong in ("3", "-1", "x", "../0", "%D9%A3", "0/1"):
        assert folder_asker.ask(f"api/about/{wrong}")[0] == 404, wrong
    # and opens as a page of its own
    assert b'id="stage"' in folder_asker.ask("scene/0/")[1]
    facts = folder_asker.ask("scene/0/api/scene")[1]
    assert facts["name"] == NAMES[0] and facts["target_px"] == 16
    assert {f"samples-{spp}" for spp in (1, 4, 16, 64)} < {
        each["name"] for each in facts["engines"]
    }
    assert "target" not in {
        each["name"] for each in folder_asker.ask("scene/2/api/scene")[1]["engines"]
    }
    assert folder_asker.ask("scene/1/api/scene")[0] == 422
    for wrong in ("scene/3/api/scene", "scene/a/api/scene", "scene/../0/", "scene/"):
        assert folder_asker.ask(wrong)[0] == 404, wrong
