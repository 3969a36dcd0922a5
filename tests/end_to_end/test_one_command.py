"""From objects to shards to a training model with the documents' commands, small."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image

from storage.dataset.dataset import open_dataset
from storage.records.objects import read_failures
from tests.end_to_end.conftest import Trilight

SMALL = ("--resolution", "32", "--noise-floor", "20", "--scenes", "12")
"""A dozen scenes: three shards, the last of which is for validation."""


@pytest.mark.slow
def test_objects_to_shards_to_a_model(trilight: Trilight, tmp_path: Path) -> None:
    made = trilight(
        "generate", "smoke", "--objects", "builtin:24", "--out", "set", *SMALL, "--json"
    )
    assert made.returncode == 0, made.stderr
    outcome = json.loads(made.stdout[made.stdout.index("{") :])
    assert outcome["scenes"] == 12
    assert outcome["views"] == 48

    verified = trilight("verify", "set", "--json")
    assert verified.returncode == 0, verified.stdout
    assert json.loads(verified.stdout)["dataset_digest"] == outcome["dataset_digest"]

    with Image.open(tmp_path / "set" / "contact_sheet.png") as sheet:
        assert min(sheet.size) > 400
        assert len(sheet.getcolors(1 << 24) or []) > 1000  # pictures, not an empty sheet
    assert outcome["dataset_digest"] in (tmp_path / "set" / "README.md").read_text()
    for name in ("LICENSE.md", "attribution.csv", "croissant.json", "report.html"):
        assert (tmp_path / "set" / name).stat().st_size > 100

    trained = trilight("train", "smoke", "--data", "set", "--out", "run", "--steps", "60")
    assert trained.returncode == 1
    assert "resolution" in trained.stderr  # the smoke run needs 64 pixels, and says so

    again = trilight(
        "generate", "smoke", "--objects", "builtin:24", "--out", "set", *SMALL, "--json"
    )
    assert json.loads(again.stdout[again.stdout.index("{") :])["seconds"] < outcome["seconds"]


@pytest.mark.slow
def test_real_objects_with_their_licences(trilight: Trilight, shared: Path, tmp_path: Path) -> None:
    source = str(shared / "objects")
    small = (*SMALL[:-1], "4")
    made = trilight("generate", "smoke", "--objects", source, "--out", "set", *small)
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


@pytest.mark.parametrize(("arguments", "message"), BAD_INPUT)
def test_bad_input_is_one_clear_line(
    refused: Callable[..., str], tmp_path: Path, arguments: tuple[str, ...], message: str
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "torn.stl").write_bytes(b"solid nothing")
    (tmp_path / "twice").mkdir()
    row = {"uid": "a", "path": "a.stl", "title": "", "licence": "CC0-1.0", "attribution": "",
           "source_url": ""}  # fmt: skip
    (tmp_path / "twice" / "a.stl").write_bytes(b"solid nothing")
    (tmp_path / "twice" / "objects.jsonl").write_text(2 * (json.dumps(row) + "\n"))
    assert message in refused(*arguments)
