"""`make release` and `trilight push`: what is made, what is refused, what a hub receives."""

import base64
import hashlib
import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from infra.release import push_to_hub as pushing
from infra.release.__main__ import (
    NETWORK,
    RIVALS,
    ComparedScene,
    _sum_and_say,
    _write_network,
    chosen_scenes,
    write_page,
)
from infra.release.push_to_hub import kind_of, planned_upload, require_within_limits
from model.open import open_network
from pipeline.documents.checksums import SUMS, published_files
from storage.dataset.dataset import Dataset
from storage.dataset.verify import verify_dataset
from storage.errors import TrilightError
from storage.metrics import psnr_log_db
from tests.command_line import expect_output, run_program
from tests.conftest import ROOT
from tests.http_server import Handler, running
from tests.pipeline.documents.dataset_by_hand import (
    five_scenes,
    furnished,
    read,
    sample,
    write_dataset,
)
from tests.storage.dataset.test_verify import opened


def beside(key: int) -> ComparedScene:
    """Return a scene whose pictures differ from the traced one, the network's by a tenth."""
    made = sample(key, furnished([]), noise_floor_db=41.26)
    target = made.radiance_rgb[0]
    return "test", made, {NETWORK: target + 0.1 * key, "1 sample, filtered": target + 0.15}


def test_the_previews_are_those_that_the_page_on_publishing_promises() -> None:
    *first, last = RIVALS
    words = f"by {', '.join(map(str, first))} and {last} samples with a denoiser"
    assert words in (ROOT / "docs/how-to/publish.md").read_text()


def test_the_page_shows_everybody_and_opens_from_disk(tmp_path: Path) -> None:
    scenes = [beside(1), beside(2)]
    page = write_page(tmp_path, scenes, about=[("dataset", "x")])
    tags = read(page.read_bytes())
    pictures = [link for link in tags.links if link.endswith(".png")]
    assert len(pictures) == 2 * 4 and all((tmp_path / name).is_file() for name in pictures)
    text = " ".join(" ".join(tags.text).split())
    rows = [
        [psnr_log_db(pictures[name], made.radiance_rgb[0]) for _, made, pictures in scenes]
        for name in scenes[0][2]
    ]
    network, one_sample = (f"{np.median(row):.1f} {min(row):.1f}" for row in rows)
    assert f"network {network} 1 sample, filtered {one_sample} 1 of 2" in text
    assert "traced, stated error 41.3 dB" in text
    assert not {"script", "link"} & set(tags.tags)
    assert planned_upload(tmp_path, "ada/page")[0] == "space"
    write_page(tmp_path, [beside(2)], about=[])
    left = {path.name[:9] for path in (tmp_path / "pictures").iterdir()}
    assert left == {"000000002"}, "an earlier page's pictures would be uploaded too"


def test_scenes_are_those_that_nobody_learned_from(tmp_path: Path) -> None:
    dataset = five_scenes(tmp_path / "five")
    assert {shard.split for shard, _ in chosen_scenes(dataset, 24)} == {"test"}
    shards = {"train-000000.tar": [sample(key, furnished(["a"])) for key in range(4)]}
    only_train = write_dataset(tmp_path / "train", shards)
    assert [shard.split for shard, _ in chosen_scenes(only_train, 3)] == ["train"] * 3
    for none, count in ((write_dataset(tmp_path / "none", {}), 24), (dataset, 0), (dataset, -1)):
        with pytest.raises(TrilightError, match=f"pictures is {count}, .* at least one scene"):
            chosen_scenes(none, count)


def test_a_network_that_is_released_opens(tmp_path: Path) -> None:
    _write_network(tmp_path)
    assert open_network(str(tmp_path)).config.view_stage == "hits"
    assert (tmp_path / "README.md").read_text().startswith("---\n")
    assert planned_upload(tmp_path, "ada/network")[0] == "model"


@pytest.mark.usefixtures("bare_reports")
def test_sums_are_of_what_is_uploaded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dataset = five_scenes(tmp_path / "dataset")
    _write_network(tmp_path / "network")
    write_page(tmp_path / "gallery", [beside(1)], about=[])
    _sum_and_say(tmp_path)
    assert "trilight push" in capsys.readouterr().out
    root = dataset.folder.root
    lines = (root / SUMS).read_text().splitlines()
    assert {line.split("  ")[1] for line in lines} >= {"manifest.json", "train-000000.tar"}
    assert not (root / "report.html").exists()
    expect_output("inspect", root, "--scenes", "1")
    lines = (root / SUMS).read_text().splitlines()
    assert "report.html" in {line.split("  ")[1] for line in lines}, "sums went stale"
    for line in lines:
        digest, _, name = line.partition("  ")
        assert hashlib.sha256((root / name).read_bytes()).hexdigest() == digest, name
    (tmp_path / "network" / "README.md").write_text("a card by hand")
    with pytest.raises(TrilightError, match=r"SHA256SUMS: README.md is not as it says"):
        planned_upload(tmp_path / "network", "ada/network")


TOKEN = "hf_mine"


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    made = opened(five_scenes(tmp_path / "set"))
    (made.folder.root / "README.md").write_text("# A set\n")
    logs = made.folder.root / "logs"
    logs.mkdir(exist_ok=True)
    (logs / "train-000000.tar.jsonl").write_text("{}\n")
    return made


PUSHES = """
import json, os, sys
from tests.command_line import trilight

for token, words in json.loads(sys.argv[1]):
    os.environ["HF_TOKEN"] = token
    ended = trilight(["push", *words])
    print(json.dumps([ended.exit_code, ended.stdout, ended.stderr, os.listdir(sys.argv[2])]))
"""
"""Pushes with tokens, in a process of its own: the package reads where the hub is at import.

It prints the exit status, stdout and stderr of each push, and what the hub holds after it.
"""


def test_the_hub_gets_every_file_and_reads_as_it_was(dataset: Dataset, tmp_path: Path) -> None:
    there, made = tmp_path / "hub", list[dict[str, Any]]()
    there.mkdir()
    with running(_Hub, root=there, token=TOKEN, made=made) as url:
        words = [str(dataset.folder.root), "ada/set", "--json"]
        asked = [("hf_other", words), (TOKEN, [*words, "--private"]), (TOKEN, words)]
        # it uploads there, and touches nothing of the user's
        kept = {name: value for name, value in os.environ.items() if not name.startswith("HF_")}
        quiet = {"HF_HUB_DISABLE_XET": "1", "HF_HUB_DISABLE_PROGRESS_BARS": "1"}
        hub = {"HF_ENDPOINT": url, "HF_TOKEN": TOKEN, "HF_HOME": str(tmp_path / "home")}
        command = [sys.executable, "-c", PUSHES, json.dumps(asked), str(there)]
        ended = run_program(command, env={**kept, **quiet, **hub}).stdout.splitlines()
    refused, public, result = map(json.loads, ended)
    assert refused[0] == 1 and "set HF_TOKEN" in refused[1] + refused[2]
    assert public[0] == 1 and "already and public" in public[1] + public[2]
    assert refused[3] == public[3] == [], "a refused push has sent nothing"
    assert result[0] == 0, result[2]
    said = json.loads(result[1])
    assert said["address"] == f"{url}/datasets/ada/set"
    assert made[-1]["type"] == "dataset" and made[-1]["name"] == "set"
    root = dataset.folder.root
    sent = set(map(Path, published_files(root)))
    assert said["files"] == len(sent)
    assert not any(path.parts[0] == "logs" for path in sent)
    for path in sent:
        assert (there / path).read_bytes() == (root / path).read_bytes(), path
    assert not verify_dataset(there).problems


def test_what_kind_a_folder_is_and_what_sends_nothing(dataset: Dataset, tmp_path: Path) -> None:
    assert kind_of(dataset.folder.root) == "dataset"
    for name, kind in (("model.safetensors", "model"), ("index.html", "space")):
        place = tmp_path / kind
        place.mkdir()
        (place / name).write_bytes(b"x")
        assert kind_of(place) == kind
    with pytest.raises(TrilightError, match="expected a folder of this machine"):
        kind_of(tmp_path / "absent")
    words = ["push", str(dataset.folder.root), "ada/my_set-1.0"]
    said = expect_output(*words, "--private", "--dry-run")
    assert "Would be uploaded" in said
    assert f"Next: trilight {' '.join(words)} --private" in said
    # nothing is sent that nobody could use
    root = dataset.folder.root
    for name in ("set", "a/b/c", "ada/my set", "ada/-set", "a--b/set", "ada/set.git"):
        with pytest.raises(TrilightError, match="expected USER/NAME"):
            planned_upload(root, name)
    (root / "README.md").unlink()
    with pytest.raises(TrilightError, match="has no README"):
        planned_upload(root, "ada/set")
    next(iter(root.glob("train-*.tar"))).unlink()
    with pytest.raises(TrilightError, match="is damaged"):
        planned_upload(root, "ada/set")


def test_the_limits_of_the_hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(TrilightError, match="holds no file"):
        require_within_limits(tmp_path)
    for number in range(3):
        (tmp_path / f"{number}.bin").write_bytes(bytes(10 * (number + 1)))
    (tmp_path / "below").mkdir()
    (tmp_path / "below" / "3.bin").write_bytes(bytes(1))
    assert require_within_limits(tmp_path) == (4, 61)
    for limit, value, message in (
        ("MOST_FILES", 3, "4 files; the hub advises at most 3"),
        ("MOST_ENTRIES", 2, "3 entries in one folder; the hub advises at most 2"),
        ("MOST_FILE_BYTES", 29, "30 bytes in one file"),
    ):
        with monkeypatch.context() as patched:
            patched.setattr(pushing, limit, value)
            with pytest.raises(TrilightError, match=message):
                require_within_limits(tmp_path)


LARGE = (".tar", ".safetensors")
"""Files that go by themselves; all others go within the commit."""


class _Hub(Handler):
    root: Path
    token: str
    made: list[dict[str, Any]]
    """Repositories that it was asked to make."""

    def do_GET(self) -> None:
        self.reply_json({"id": "ada/set", "sha": "0" * 40, "siblings": [], "private": False})

    def do_PUT(self) -> None:
        place = self.root / ".objects" / self.path.rpartition("/")[2]
        place.parent.mkdir(exist_ok=True)
        place.write_bytes(self._body())
        self.reply_json({})

    def do_POST(self) -> None:
        body = self._body()
        if self.headers["Authorization"] != f"Bearer {self.token}":
            self.reply_json({"error": "Invalid username or password."}, status=401)
        elif self.path == "/api/repos/create":
            asked = json.loads(body)
            self.made.append(asked)
            kind = {"model": ""}.get(asked.get("type", "model"), f"{asked.get('type')}s/")
            name = f"{asked['organization']}/{asked['name']}"
            self.reply_json({"url": f"{self._here}/{kind}{name}", "name": name, "id": "1"})
        elif self.path == "/api/validate-yaml":
            self.reply_json({"errors": [], "warnings": []})
        elif "/preupload/" in self.path:
            names = [entry["path"] for entry in json.loads(body)["files"]]
            self.reply_json({"files": [self._mode(name) for name in names]})
        elif self.path.endswith("/objects/batch"):
            wanted = json.loads(body)["objects"]
            self.reply_json(
                {"transfer": "basic", "objects": [self._place(each) for each in wanted]}
            )
        else:
            assert "/commit/" in self.path, self.path
            self._commit(body)
            self.reply_json(
                {"commitOid": "1" * 40, "commitUrl": f"{self._here}/datasets/ada/set/commit/1"}
            )

    @property
    def _here(self) -> str:
        return f"http://{self.headers['Host']}"

    def _body(self) -> bytes:
        return self.rfile.read(int(self.headers["Content-Length"] or 0))

    def _mode(self, name: str) -> dict[str, Any]:
        mode = "lfs" if name.endswith(LARGE) else "regular"
        return {"path": name, "uploadMode": mode, "shouldIgnore": False}

    def _place(self, wanted: dict[str, Any]) -> dict[str, Any]:
        upload = {"href": f"{self._here}/put/{wanted['oid']}"}
        return {"oid": wanted["oid"], "size": wanted["size"], "actions": {"upload": upload}}

    def _commit(self, body: bytes) -> None:
        for line in map(json.loads, body.splitlines()):
            value = line["value"]
            if line["key"] == "file":
                data = base64.b64decode(value["content"])
            elif line["key"] == "lfsFile":
                data = (self.root / ".objects" / value["oid"]).read_bytes()
            else:
                continue
            place = self.root / value["path"]
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_bytes(data)
