"""A dataset repository of the Hugging Face hub, from a small server that answers as it does.

The package reads where the hub is when it is imported, so it is asked in a process of its own.
"""

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, unquote

import pytest

from storage.dataset.dataset import Dataset
from storage.digests import sha256_hex
from storage.records.sample import encode_sample
from tests.conftest import ROOT
from tests.http_server import Handler, running
from tests.storage.remote.conftest import SHARD, with_changed_byte

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


pytest.importorskip("huggingface_hub", reason="hf:// needs the package huggingface_hub")

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
    with running(_Hub, root=local.folder.root) as url:
        yield url


def run(hub: str, cache: Path, *arguments: str) -> tuple[list[list[str]], list[str], list[int]]:
    """Run READ in a process that knows this hub; returns its bad shards, samples and sizes."""
    code = f"import json, sys\n{READ}\nprint(json.dumps([verified, read, replaced]))"
    ran = subprocess.run(
        [sys.executable, "-c", code, DATASET, *arguments],
        cwd=ROOT,
        env={**os.environ, "HF_ENDPOINT": hub, "HF_HOME": str(cache.parent / "hub")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
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
