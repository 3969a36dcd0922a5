"""`trilight push`: what is uploaded, what is refused, and that a hub receives every byte."""

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest

from infra.release import hub_limits
from infra.release.hub_limits import require_within_limits
from infra.release.push import kind_of, planned_upload
from pipeline.documents.sums import published_files
from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.verify import verify_dataset
from storage.digests import sha256_hex
from storage.errors import TrilightError
from tests.command_line import trilight
from tests.conftest import ROOT
from tests.infra.release.hub_upload_server import hub_for_uploads, settings_of
from tests.pipeline.documents.dataset_by_hand import edit_manifest, five_scenes

TOKEN = "hf_mine"


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    five = five_scenes(tmp_path / "set")
    digest = sha256_hex(five.folder.objects_lock.read_bytes())
    made = open_dataset(str(edit_manifest(five, objects_lock_sha256=digest)))
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


def pushed(
    asked: Sequence[tuple[str, list[str]]], settings: Mapping[str, str], there: Path
) -> list[tuple[int, str, str, list[str]]]:
    """Push with tokens in a process of its own: the package reads where the hub is at import.

    Returns:
        The exit status, stdout and stderr of each push, and what the hub holds after it.
    """
    command = [sys.executable, "-c", PUSHES, json.dumps(asked), str(there)]
    done = subprocess.run(
        command, cwd=ROOT, env=settings, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    return [tuple(json.loads(line)) for line in done.stdout.splitlines()]


def test_the_hub_gets_every_file_and_reads_as_it_was(dataset: Dataset, tmp_path: Path) -> None:
    there = tmp_path / "hub"
    there.mkdir()
    with hub_for_uploads(there, TOKEN) as (url, made):
        words = [str(dataset.folder.root), "ada/set", "--json"]
        asked = [("hf_other", words), (TOKEN, [*words, "--private"]), (TOKEN, words)]
        refused, public, result = pushed(asked, settings_of(url, TOKEN, tmp_path / "home"), there)
    assert refused[0] == 1 and "set HF_TOKEN" in refused[1] + refused[2]
    assert public[0] == 1 and "already and public" in public[1] + public[2]
    assert refused[3] == public[3] == [], "a refused push has sent nothing"
    assert result[0] == 0, result[2]
    said = json.loads(result[1])
    assert said["address"] == f"{url}/datasets/ada/set"
    assert made[-1]["type"] == "dataset" and made[-1]["name"] == "set"
    root = dataset.folder.root
    sent = {path.relative_to(root) for path in published_files(root)}
    assert said["files"] == len(sent)
    assert not any(path.parts[0] == "logs" for path in sent)
    for path in sent:
        assert (there / path).read_bytes() == (root / path).read_bytes(), path
    assert not verify_dataset(there).problems


def test_what_kind_a_folder_is(dataset: Dataset, tmp_path: Path) -> None:
    assert kind_of(dataset.folder.root) == "dataset"
    for name, kind in (("model.safetensors", "model"), ("index.html", "space")):
        place = tmp_path / kind
        place.mkdir()
        (place / name).write_bytes(b"x")
        assert kind_of(place) == kind
    with pytest.raises(TrilightError, match="expected a folder of this machine"):
        kind_of(tmp_path / "absent")


def test_nothing_is_sent_that_nobody_could_use(dataset: Dataset, tmp_path: Path) -> None:
    root = dataset.folder.root
    for name in (
        "set",
        "a/b/c",
        "/set",
        "ada/",
        "ada/my set",
        "ada/-set",
        "a--b/set",
        "ada/set.git",
    ):
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
            patched.setattr(hub_limits, limit, value)
            with pytest.raises(TrilightError, match=message):
                require_within_limits(tmp_path)


def test_a_dry_run_sends_nothing(dataset: Dataset) -> None:
    words = ["push", str(dataset.folder.root), "ada/my_set-1.0"]
    result = trilight([*words, "--private", "--dry-run"])
    assert result.exit_code == 0, result.exception
    assert "Would be uploaded" in result.output
    assert f"Next: trilight {' '.join(words)} --private" in result.output
