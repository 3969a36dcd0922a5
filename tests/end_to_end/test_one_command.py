"""Real objects with their licenses, and mistakes that one line answers."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from storage.dataset.dataset import open_dataset
from storage.records.objects import read_failures
from tests.end_to_end.conftest import Trilight
from tests.end_to_end.production_kit import copy_objects

SMALL = ("--resolution", "32", "--noise-floor", "20", "--scenes", "4")


@pytest.mark.slow("commands")
def test_real_objects_with_their_licences(trilight: Trilight, shared: Path, tmp_path: Path) -> None:
    rows = [json.loads(row) for row in (shared / "objects/objects.jsonl").open()]
    refusable = [row for row in rows if row["licence"] != "CC0-1.0"]
    chosen = [*refusable, *(row for row in rows[:24] if row not in refusable)]
    objects = copy_objects(shared / "objects", tmp_path / "objects", chosen)
    made = trilight("generate", "smoke", "--objects", str(objects), "--out", "set", *SMALL)
    assert made.returncode == 0, made.stderr
    dataset = open_dataset(str(tmp_path / "set"))
    refused = [f for f in read_failures(dataset.folder.failures) if f.stage == "objects"]
    assert len(refused) == 5
    assert {failure.reason for failure in refused} == {"licence_refused"}
    used = {o.licence for s in dataset.manifest.shards for x in dataset.read_shard(s)
            for o in x.scene.objects}  # fmt: skip
    assert used == {"CC0-1.0"}


BAD_INPUT = [
    (("generate", "nonsense"), "build 'nonsense' is unknown; expected one of smoke"),
    (("generate", "smoke", "--objects", "nowhere"), "nowhere"),
    (("generate", "smoke", "--objects", "empty"), "empty"),
    (("generate", "smoke", "--objects", "broken"), "none was accepted"),
    (("generate", "smoke", "--objects", "twice"), "objects.jsonl:2: uid 'a' is already used"),
    (("generate", "smoke", "--out", "/proc/nowhere"), "cannot write"),
    (("generate", "smoke", "--resolution", "100"), "resolution"),
    (("generate", "smoke", "--scenes", "0"), "scenes is 0"),
    (("generate", "smoke", "--workers", "0"), "workers is 0"),
    (("verify", "empty"), "no manifest.json"),
    (("inspect", "empty"), "no manifest.json"),
    (("train", "smoke", "--data", "empty"), "no manifest.json"),
    (("train", "nonsense", "--data", "empty"), "'nonsense'"),
    (("shards", "merge", "empty", "empty", "--out", "c"), "no manifest.json"),
    (("shards", "select", "empty", "--out", "c", "--split", "no"), "--split is 'no'"),
    (("bench", "nonsense"), "experiment 'nonsense' is unknown"),
]


def test_bad_input_is_one_clear_line(refused: Callable[..., str], tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "torn.stl").write_bytes(b"solid nothing")
    (tmp_path / "twice").mkdir()
    row = {"uid": "a", "path": "a.stl", "title": "", "licence": "CC0-1.0", "attribution": "",
           "source_url": ""}  # fmt: skip
    (tmp_path / "twice" / "a.stl").write_bytes(b"solid nothing")
    (tmp_path / "twice" / "objects.jsonl").write_text(2 * (json.dumps(row) + "\n"))
    for arguments, message in BAD_INPUT:
        assert message in refused(*arguments), arguments
