"""What cannot be merged, selected or resharded is refused in one clear line, and leaves nothing."""

import dataclasses
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from pipeline.generation.begin_dataset import begin_dataset
from pipeline.generation.derive_dataset import derive_dataset
from pipeline.shards.derive import DeriveOptions
from pipeline.shards.plans import Selection
from storage.dataset.dataset import open_dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import write_manifest
from storage.dataset.verify import verify_dataset
from storage.errors import TrilightError
from tests.for_each import for_each
from tests.pipeline.generation.test_dataset_writer import ENVIRONMENT, _build
from tests.pipeline.generation.test_derive_dataset import (
    TEST_OBJECT,
    TRAIN_OBJECT,
    finished,
    scenes,
    shards_made,
)

MERGE = DeriveOptions(operation="merge")


def refused(out: Path, derive: DeriveOptions, *places: Path | str) -> str:
    """Return the message of a refusal that leaves nothing where the dataset would be."""
    with pytest.raises(TrilightError) as caught:
        derive_dataset([str(place) for place in places], derive, out)
    message = str(caught.value)
    assert "\n" not in message
    assert not out.exists() and not list(out.parent.glob(".*"))
    return message


def changed_settings(root: Path, group: str, **values: Any) -> Path:
    manifest = open_dataset(str(root)).manifest
    settings = {**manifest.settings, group: {**manifest.settings.get(group, {}), **values}}
    write_manifest(root / "manifest.json", dataclasses.replace(manifest, settings=settings))
    return root


@for_each("uid, sha256", [("c", "1" * 64), ("x", TEST_OBJECT.asset_sha256)])
def test_a_leak_between_splits_is_named(tmp_path: Path, uid: str, sha256: str) -> None:
    """Of the same name with another budget; of the same file, which catalogues call otherwise."""
    a = finished(tmp_path / "a", scenes(0))
    other = [
        dataclasses.replace(TRAIN_OBJECT, uid=uid, asset_sha256=sha256),
        dataclasses.replace(TEST_OBJECT, uid="y", asset_sha256="2" * 64),
    ]
    b = finished(tmp_path / "b", scenes(1, train=uid, test="y"), objects=other)
    assert verify_dataset(b).problems == []
    message = refused(tmp_path / "c", MERGE, a, b)
    assert f"object '{uid}' is in test of" in message and "and in train of" in message
    assert "trilight shards select" in message
    train_only = tmp_path / "train"
    derive = DeriveOptions(operation="select", selection=Selection(split="train"))
    shards_made(train_only, derive, a)
    shards_made(tmp_path / "c", MERGE, train_only, b)  # as the message advises


def test_the_same_scene_twice_is_refused(tmp_path: Path) -> None:
    a, b = finished(tmp_path / "a", scenes(0)), finished(tmp_path / "b", scenes(0), seed=1)
    assert "scene 000000000 of" in (message := refused(tmp_path / "c", MERGE, a, b))
    assert "expected each scene once" in message
    assert "expected each scene once" in refused(tmp_path / "c", MERGE, a, a)


@for_each(
    ("group", "values", "name"),
    [
        ("renders", {"resolution": 32}, "renders.resolution is 32; expected 16"),
        ("renders", {"per_light": True}, "renders.per_light is True; expected False"),
        ("storage", {"passes": ["object"]}, "storage.passes is ['object']; expected False"),
    ],
)
def test_what_does_not_fit_together_is_named(
    tmp_path: Path, group: str, values: dict[str, Any], name: str
) -> None:
    a, b = finished(tmp_path / "a", scenes(0)), finished(tmp_path / "b", scenes(1))
    assert name in refused(tmp_path / "c", MERGE, a, changed_settings(b, group, **values))
    other = finished(tmp_path / "other", scenes(1), num_views=3)
    assert "number of views is 3; expected 2" in refused(tmp_path / "c", MERGE, a, other)


def test_damage_and_what_is_not_finished_are_refused(tmp_path: Path) -> None:
    a, out = finished(tmp_path / "a", scenes(0)), tmp_path / "c"
    reshard = DeriveOptions(operation="reshard", scenes_per_shard=3)
    manifest = open_dataset(str(a)).manifest
    write_manifest(a / "manifest.json", dataclasses.replace(manifest, num_scenes=7))
    assert "3 of 4 shards" in refused(out, reshard, a)
    write_manifest(a / "manifest.json", manifest)
    shard = a / "train-000001.tar"
    data = bytearray(shard.read_bytes())
    data[len(data) // 2] ^= 1
    shard.write_bytes(data)
    assert "sha256 differs" in refused(out, reshard, a)
    shard.unlink()
    assert "missing" in refused(out, reshard, a)
    (a / "objects.lock.jsonl").write_bytes(b"")
    assert "objects.lock.jsonl" in refused(out, reshard, a)
    assert "no manifest.json" in refused(out, reshard, tmp_path / "nowhere")
    assert "on this machine" in refused(out, reshard, "https://u:secret@example.org/a?token=x")
    assert "secret" not in refused(out, reshard, "https://u:secret@example.org/a?token=x")


@for_each(
    ("derive", "expected"),
    [
        (
            DeriveOptions(operation="select", selection=Selection(template="no")),
            "none of the 6 scenes",
        ),
        (DeriveOptions(operation="reshard", scenes_per_shard=0), "--scenes-per-shard is 0"),
    ],
)
def test_arguments_that_make_nothing_are_refused(
    tmp_path: Path, derive: DeriveOptions, expected: str
) -> None:
    assert expected in refused(tmp_path / "c", derive, finished(tmp_path / "a", scenes(0)))
    with pytest.raises(TrilightError, match="--split is 'tset'"):
        Selection(split="tset")


def test_nothing_is_overwritten_and_nothing_grows(tmp_path: Path) -> None:
    a, out = finished(tmp_path / "a", scenes(0)), tmp_path / "c"
    reshard = DeriveOptions(operation="reshard", scenes_per_shard=3)
    out.mkdir()
    derive_dataset([str(a)], reshard, out)  # an empty folder is no reason to refuse
    with pytest.raises(TrilightError, match="is there already"):
        derive_dataset([str(a)], reshard, out)
    with pytest.raises(TrilightError, match=r"made by `trilight shards reshard`.*cannot grow"):
        begin_dataset(DatasetFolder(out), _build(), ENVIRONMENT, 4, accept_environment=False)


KILLED = """
import sys
from pathlib import Path
from pipeline.generation import derive_dataset as flow
from pipeline.shards.derive import DeriveOptions

def stop(done, total):
    if done > 4:  # three are read, one is written
        print("here", flush=True)
        import time
        time.sleep(60)

derive = DeriveOptions(operation="reshard", scenes_per_shard=3)
flow.derive_dataset([sys.argv[1]], derive, Path(sys.argv[2]), progress=stop)
"""


def test_a_kill_leaves_no_dataset_and_the_next_run_makes_it(tmp_path: Path) -> None:
    a, out = finished(tmp_path / "a", scenes(0)), tmp_path / "c"
    run = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(a), str(out)], stdout=subprocess.PIPE, text=True
    )
    assert run.stdout is not None and run.stdout.readline() == "here\n"
    reshard = DeriveOptions(operation="reshard", scenes_per_shard=3)
    with pytest.raises(TrilightError, match="another process"):
        derive_dataset([str(a)], reshard, out)
    os.kill(run.pid, signal.SIGKILL)
    run.wait()
    assert not out.exists()
    assert list(tmp_path.glob(".c.part/*.tar"))
    (tmp_path / ".c.part" / "train-000009.tar").write_bytes(b"of a larger one")
    derive_dataset([str(a)], reshard, out)
    assert verify_dataset(out).problems == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "c"]
