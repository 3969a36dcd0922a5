"""Buckets of S3 and Google: the same dataset again, written whole and once, mistakes named.

A dataset repository of the Hugging Face hub, from a small server that answers as it does. The
package reads where the hub is when it is imported, so it is asked in a process of its own.
"""

import errno
import hashlib
import json
import os
import shutil
import sys
from collections.abc import Iterator
from http import HTTPStatus
from pathlib import Path
from typing import Any
from unittest import mock
from urllib.parse import parse_qs, unquote

import pytest

from pipeline.generation.dataset_writer import begin_or_resume_dataset
from pipeline.generation.generate_options import GenerateOptions
from pipeline.shards.pack_shards import PublishedShards
from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.layout import dataset_folder
from storage.dataset.training_data import open_training_data
from storage.dataset.verify import verify_dataset
from storage.digests import sha256_hex
from storage.errors import EnvironmentFailure, TrilightError
from storage.records.sample import encode_sample
from storage.remote import store, transfers
from storage.remote import url as remote_url
from storage.remote.store import LocalStore, RemoteStore, Store
from storage.remote.transfers import with_tries
from tests.command_line import run_program
from tests.for_each import case
from tests.http_server import Handler, running
from tests.pipeline.generation.bucket_kit import empty_bucket
from tests.pipeline.generation.test_dataset_writer import ENVIRONMENT, _build
from tests.s3_server import Line, control
from tests.storage.remote.cache_readers import remote
from tests.storage.remote.conftest import SHARD, expected, read, with_changed_byte


def fill(driver: Any, local: Dataset) -> None:
    for path in local.folder.root.iterdir():
        driver.pipe_file(f"shards/set/{path.name}", path.read_bytes())


@pytest.fixture
def s3(moto: int, local: Dataset, cache: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Line]:
    """Put the small dataset into a bucket of S3; returns the line to it."""
    line = Line(moto)
    monkeypatch.setattr(transfers, "PIECE_BYTES", 4096)
    with empty_bucket(moto, monkeypatch) as driver:
        fill(driver, local)
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{line.port}")
        remote_url._driver_of.cache_clear()
        yield line
    line.listener.close()


@pytest.fixture
def emulator() -> Any:
    pytest.importorskip("gcsfs", reason="gs:// needs the package gcsfs")
    return pytest.importorskip("gcp_storage_emulator.server", reason="needs gcp-storage-emulator")


@pytest.fixture
def gs(
    emulator: Any, local: Dataset, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Any]:
    """Put the small dataset into a bucket of Google's emulator; returns the driver of it."""
    server = emulator.create_server("127.0.0.1", 0, in_memory=True, default_bucket="shards")
    server.start()
    port = server._api._httpd.server_address[1]
    monkeypatch.setenv("STORAGE_EMULATOR_HOST", f"http://127.0.0.1:{port}")
    monkeypatch.setattr(transfers, "PIECE_BYTES", 4096)
    remote_url._driver_of.cache_clear()
    driver = remote_url.open_driver(remote("gs://shards"))
    fill(driver, local)
    yield driver
    remote_url._driver_of.cache_clear()
    server.stop()


@pytest.fixture
def conditional(emulator: Any, gs: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Teach the emulator, which ignores it, what Google's server does with ifGenerationMatch=0."""
    upload = emulator.objects.upload_partial
    handlers = next(row[-1] for row in emulator.HANDLERS if upload in row[-1].values())

    def looking(handler: Any) -> Any:
        def handle(request: Any, response: Any, storage: Any, *more: Any, **options: Any) -> None:
            query, data = request.query, request.data
            if query.get("ifGenerationMatch") == ["0"]:
                name = query["name"][0] if "name" in query else data["meta"]["name"]
                if name in storage.objects.get(request.params["bucket_name"], ()):
                    response.status = HTTPStatus.PRECONDITION_FAILED
                    response.json({"error": {"code": 412, "message": "conditionNotMet"}})
                    return
            handler(request, response, storage, *more, **options)

        return handle

    for method, handler in list(handlers.items()):
        monkeypatch.setitem(handlers, method, looking(handler))


@pytest.mark.parametrize("scheme", ["s3", "gs"])
def test_a_bucket_holds_the_same_dataset(
    scheme: str, local: Dataset, request: pytest.FixtureRequest
) -> None:
    """And what is missing or changed in it later is named."""
    request.getfixturevalue(scheme)
    url = f"{scheme}://shards/set"
    assert open_dataset(url).manifest == local.manifest
    assert read(url) == expected(local)
    assert verify_dataset(url).problems == []
    shards = open_training_data([f"{url}/train-{{000000..000001}}.tar"]).split("train")
    assert [shards.num_samples(number) for number in range(2)] == [2, 2]
    shutil.rmtree(os.environ["TRILIGHT_CACHE"])
    driver = remote_url.open_driver(remote(f"{scheme}://shards"))
    driver.pipe_file(f"shards/set/{SHARD}", with_changed_byte(local.folder.root / SHARD))
    driver.rm_file("shards/set/test-000005.tar")
    assert verify_dataset(url, fast=True).bad_shards == ["test-000005.tar"]
    assert set(verify_dataset(url).bad_shards) == {"test-000005.tar", SHARD}
    with pytest.raises(TrilightError, match="sha256 differs, 2 times"):
        read(url)
    for elsewhere in ("shards/elsewhere", "no-such-bucket/set"):
        with pytest.raises(TrilightError, match=r"no manifest\.json here"):
            read(f"{scheme}://{elsewhere}")


def test_wrong_access_is_named_without_secrets_and_interrupted_reads_go_on(
    s3: Line, moto: int, local: Dataset
) -> None:
    dataset = open_dataset("s3://shards/set")
    control(moto, "reset-auth", b"0")
    try:
        with pytest.raises(TrilightError) as caught:
            expected(dataset)
        with pytest.raises(TrilightError, match="manifest.*cannot be read"):
            open_dataset("s3://shards/set")
    finally:
        control(moto, "reset-auth", b"inf")
    text = str(caught.value)
    assert "cannot be read" in text and "Check the URL and your access" in text
    assert "s3cret" not in text and os.environ["AWS_SECRET_ACCESS_KEY"] not in text
    s3.cuts = [2000, 500, 3000]
    assert expected(dataset) == expected(local)
    assert not s3.cuts


def create_once(made: Store, folder: Path) -> None:
    """In one request and, from 5 MiB on, in several; what is written otherwise replaces it."""
    content = bytes(range(256)) * (11 << 12)
    (folder / "large").write_bytes(content)
    for name, first in (("small", b"small"), ("part-0001/large", folder / "large")):
        assert made.create_if_absent(name, first), name
        assert not made.create_if_absent(name, b"second"), name
        assert not made.create_if_absent(name, folder / "large"), name
    assert (made.get("small"), made.get("small", 3)) == (b"small", b"sma")
    assert made.get("part-0001/large", len(content)) == content
    assert made.get("large") is made.get("large", 1) is None
    made.put("small", b"third")
    made.put("copied/large", folder / "large")
    assert made.get("small") == b"third"
    assert made.get("copied/large", len(content)) == content
    assert made.list() == {"small"}
    assert made.list("part-0001/") == {"part-0001/large"}
    assert made.list("elsewhere") == set()
    with made.hold_lock("small") as ours:
        assert ours
    if isinstance(made, RemoteStore):
        made.require_create()
        made.require_create()  # what is left of the first time says nothing


def test_a_file_is_created_once(moto: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store, "_PART_BYTES", 5 << 20)  # no server takes smaller parts
    with empty_bucket(moto, monkeypatch):
        made = RemoteStore(remote("s3://shards/set"), tmp_path / "work")
        create_once(made, tmp_path)
        assert {"small", "part-0001/large"} < made.list_all()


def test_a_file_is_created_once_at_google(gs: Any, conditional: None, tmp_path: Path) -> None:
    create_once(RemoteStore(remote("gs://shards/made"), tmp_path / "work"), tmp_path)


def test_a_file_is_created_once_in_a_folder(tmp_path: Path) -> None:
    made = LocalStore(tmp_path / "made")
    create_once(made, tmp_path)
    for write in (made.create_if_absent, made.put):  # it is published where it stands
        write("small", tmp_path / "made" / "small")
        assert made.get("small") == b"third"
    assert not list((tmp_path / "made").rglob("*.part"))


def test_a_server_that_ignores_the_condition_is_refused_before_anything_is_begun(gs: Any) -> None:
    """The emulator as it is; two makers could each replace what the other has put there."""
    folder = dataset_folder("gs://shards/made")
    with (
        pytest.raises(TrilightError, match="^out 'gs://shards/made': .*conditional writes"),
        PublishedShards(folder).hold_lock(),
    ):
        begin_or_resume_dataset(PublishedShards(folder), _build(), ENVIRONMENT, 8)
    assert RemoteStore(remote("gs://shards/made")).list_all() == {".staging/once"}
    assert not folder.manifest.exists()


def test_places_that_cannot_be_written_are_refused_by_name() -> None:
    for out, message in {
        "s3://ada:hunter2@shards/set": "out 's3://shards/set' came with a user or password",
        "s3://shards/set?key=hunter2": "out 's3://shards/set' has a query",
        "https://ada:hunter2@host/set": "out 'https://host/set' has the scheme 'https'; expected",
        "hf://datasets/ada/set": "has the scheme 'hf'; expected a folder, or a URL of s3 or gs",
        "s3://": "names no host or bucket",
        "pipe:cat": "is a pipe: command",
    }.items():
        with case(out), pytest.raises(TrilightError, match="^out ") as caught:
            GenerateOptions(out=out)
        assert message in str(caught.value)
        assert "hunter2" not in str(caught.value)


def test_a_full_disk_may_pass_whichever_way_the_bytes_go() -> None:
    full = mock.Mock(side_effect=OSError(errno.ENOSPC, "No space left on device"))
    with pytest.raises(EnvironmentFailure, match="^the disk is full. What was finished is safe"):
        with_tries(full)


REPOSITORY = "ada/set"


class _Hub(Handler):
    root: Path

    def do_GET(self) -> None:
        path = unquote(self.path.partition("?")[0])
        api, files = f"/api/datasets/{REPOSITORY}", f"/datasets/{REPOSITORY}/resolve/main/"
        if path in (api, f"{api}/revision/main"):
            self.reply_json({"id": REPOSITORY, "sha": "0" * 40, "siblings": [], "private": False})
        elif path.startswith(f"{api}/tree/main"):
            self.reply_json([self._entry(file) for file in sorted(self.root.iterdir())])
        elif path.startswith(files) and (self.root / path.removeprefix(files)).is_file():
            self._part((self.root / path.removeprefix(files)).read_bytes())
        else:
            self.reply(404, b"{}", X_Error_Code="RepoNotFound")

    def do_POST(self) -> None:
        body = parse_qs(self.rfile.read(int(self.headers["Content-Length"])).decode())
        wanted = [self.root / name for name in body["paths"]]
        self.reply_json([self._entry(file) for file in wanted if file.is_file()])

    def _entry(self, file: Path) -> dict[str, Any]:
        oid = hashlib.sha1(file.read_bytes(), usedforsecurity=False).hexdigest()
        return {"type": "file", "path": file.name, "size": file.stat().st_size, "oid": oid}

    def _part(self, data: bytes) -> None:
        first, last = self.headers["Range"].removeprefix("bytes=").split("-")
        part = data[int(first) : int(last) + 1]
        self.reply(206, part, Content_Range=f"bytes {first}-{last}/{len(data)}")


DATASET = f"hf://datasets/{REPOSITORY}"

READ = """
import pathlib
from storage.dataset.dataset import open_dataset
from storage.dataset.shard_set import listed_shards
from storage.dataset.verify import verify_dataset
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.records.sample import encode_sample
verified = [verify_dataset(sys.argv[1], fast=fast).bad_shards for fast in (True, False)]
dataset, read = open_dataset(sys.argv[1]), []
for shard in dataset.manifest.shards:
    try:
        for sample in dataset.read_shard(shard):
            read.append(sha256_hex(b"".join(encode_sample(sample).values())))
    except TrilightError as error:
        read.append(str(error))
replaced = []
if len(sys.argv) > 2:
    (place,) = listed_shards([sys.argv[2]])
    for _ in range(2):
        with place.open() as stream:
            replaced.append(len(stream.read()))
        pathlib.Path(sys.argv[3]).write_bytes(bytes(7))
"""


@pytest.fixture
def hub(local: Dataset) -> Iterator[str]:
    pytest.importorskip("huggingface_hub", reason="hf:// needs the package huggingface_hub")
    with running(_Hub, root=local.folder.root) as url:
        yield url


def run(hub: str, cache: Path, *arguments: str) -> tuple[list[list[str]], list[str], list[int]]:
    """Run READ in a process that knows this hub; returns its bad shards, samples and sizes."""
    code = f"import json, sys\n{READ}\nprint(json.dumps([verified, read, replaced]))"
    words = [sys.executable, "-c", code, DATASET, *arguments]
    ran = run_program(words, HF_ENDPOINT=hub, HF_HOME=str(cache.parent / "hub"))
    verified, read, replaced = json.loads(ran.stdout)
    return verified, read, replaced


def test_a_repository_holds_the_same_dataset(hub: str, cache: Path, local: Dataset) -> None:
    """A shard that is replaced is fetched again.

    The package remembers listings; without a hash, only a fresh one tells the new file.
    """
    expected = [
        sha256_hex(b"".join(encode_sample(sample).values()))
        for shard in local.manifest.shards
        for sample in local.read_shard(shard)
    ]
    path = local.folder.root / SHARD
    size = path.stat().st_size
    verified, read, replaced = run(hub, cache, f"{DATASET}/{SHARD}", str(path))
    assert (verified, read, replaced) == ([[], []], expected, [size, 7])


def test_missing_and_changed_shards_are_named(hub: str, cache: Path, local: Dataset) -> None:
    path = local.folder.root / SHARD
    path.write_bytes(with_changed_byte(path))
    (local.folder.root / "test-000005.tar").unlink()
    (fast, full), said, _ = run(hub, cache)
    assert (fast, set(full)) == (["test-000005.tar"], {"test-000005.tar", SHARD})
    assert any("no such file" in line for line in said)
    assert any("sha256 differs, 2 times" in line for line in said)
