"""Objects frozen in parts by machines that share a bucket and nothing else."""

from pathlib import Path
from typing import Any

import pytest

from infra.cli.generate_report import report
from pipeline.making import object_parts
from pipeline.making.pipeline import make_dataset
from storage.dataset.dataset import open_dataset
from storage.dataset.layout import dataset_folder
from storage.dataset.splits import part_of_object
from storage.dataset.verify import verify_dataset
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.records.objects import TEXTURE
from storage.remote import bucket as remote_bucket
from tests.pipeline.making.bucket_kit import OUT, Killed, Machines, Writes, killed_before
from tests.pipeline.making.parts_kit import parts_by_hand, parts_order, textures_in
from tests.pipeline.making.test_lock_parts import SPLITS
from tests.pipeline.making.tiny_scenes_kit import Undocumented

pytest.importorskip("s3fs", reason="needs the package s3fs (setup-all)")
pytest.importorskip("moto", reason="needs the package moto with its server (setup-all)")

LOCK = "shards/set/objects.lock.jsonl"


@pytest.fixture
def made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[object]:
    return parts_by_hand(tmp_path, monkeypatch)


def _make(out: str, shards: str | None = None, scenes: int = 28) -> Any:
    order = parts_order(out, scenes, shards)
    return make_dataset(order, Undocumented())


def _objects(made: list[object]) -> list[str]:
    found = [one for one in made if isinstance(one, str)]
    made.clear()
    return found


def _in_one_folder(machines: Machines, folder: Path, made: list[object]) -> tuple[str, bytes]:
    machines.use("plain")
    outcome = _make(str(folder))
    made.clear()
    return outcome.digest, (folder / "objects.lock.jsonl").read_bytes()


def test_each_machine_prepares_what_its_shards_draw_from(
    bucket: Any,
    machines: Machines,
    made: list[object],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    digest, lock = _in_one_folder(machines, tmp_path / "plain", made)
    machines.use("a")
    outcome = _make(OUT, "0:6")  # the first cycle
    report(dataset_folder(OUT), outcome, 1.0, as_json=False)
    assert f"MIT ({outcome.num_objects_used})" in capsys.readouterr().out
    of_a = _objects(made)
    assert {part_of_object(uid, SPLITS) for uid in of_a} == {0}
    growing = open_dataset(OUT)
    assert not bucket.exists(LOCK)
    assert [row.uid for row in growing.objects_lock()] == sorted(of_a)
    assert verify_dataset(OUT).problems == []
    machines.use("b")
    outcome = _make(OUT, "6:7")
    of_b = _objects(made)
    assert {part_of_object(uid, SPLITS) for uid in of_b} == {1}
    assert len(of_a) + len(of_b) == 60
    assert outcome.digest == digest
    assert bucket.cat_file(LOCK) == lock
    found = open_dataset(OUT)
    assert found.manifest.objects_lock_sha256 == sha256_hex(lock)
    assert verify_dataset(OUT).problems == []


def test_a_longer_dataset_gets_more_parts(
    bucket: Any, machines: Machines, made: list[object], tmp_path: Path
) -> None:
    digest, lock = _in_one_folder(machines, tmp_path / "plain", made)
    machines.use("a")
    _make(OUT, scenes=24)
    assert bucket.cat_file(LOCK) != lock
    machines.use("b")
    assert _make(OUT, scenes=28).digest == digest
    assert bucket.cat_file(LOCK) == lock
    assert verify_dataset(OUT).problems == []


def test_machines_share_the_work_of_a_part(
    bucket: Any, machines: Machines, made: list[object], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What one has prepared before it died, the other one does not look at."""
    monkeypatch.setattr(object_parts, "_MEAN_OBJECTS", 4)
    monkeypatch.setattr(object_parts, "_AT_ONCE", 1)
    machines.use("a")
    with killed_before(monkeypatch, "create", ".lock.jsonl"):
        _make(OUT, "0:6")
    assert _objects(made)
    machines.use("b")
    _make(OUT, "0:6")
    assert _objects(made) == []


def test_a_kill_before_any_request_loses_nothing(
    bucket: Any,
    machines: Machines,
    made: list[object],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The n-th write of each run never happens; two machines take turns until one gets through."""
    digest, lock = _in_one_folder(machines, tmp_path / "plain", made)
    writes, runs = Writes(monkeypatch), 0
    while True:
        writes.left, runs = runs // 2, runs + 1
        machines.use("ab"[runs % 2])
        try:
            outcome = _make(OUT)
            break
        except Killed:
            continue
    assert runs > 10
    assert outcome.digest == digest
    assert bucket.cat_file(LOCK) == lock
    assert verify_dataset(OUT).problems == []


def test_machines_have_the_same_textures(
    bucket: Any, machines: Machines, made: list[object], tmp_path: Path
) -> None:
    textures = textures_in(tmp_path / "textures", 1, 2)
    for name, shards in (("a", "0:6"), ("b", "6:7")):
        machines.use(name)
        make_dataset(parts_order(OUT, 28, shards, textures), Undocumented())
    found = open_dataset(OUT).objects_lock()
    assert [row.uid for row in found if row.kind == TEXTURE] == ["texture:cloth1", "texture:cloth2"]
    assert len(found) == 62
    assert verify_dataset(OUT).problems == []
    (textures / "cloth1.png").unlink()
    machines.use("c")
    with pytest.raises(TrilightError, match="'texture:cloth1' is missing or no longer usable"):
        make_dataset(parts_order(OUT, 56, "12:13", textures), Undocumented())


def test_who_has_other_objects_is_told(
    bucket: Any, machines: Machines, made: list[object], monkeypatch: pytest.MonkeyPatch
) -> None:
    create, name = remote_bucket.Bucket.create, "shards/set/.staging/object_locks/0000.lock.jsonl"

    def late(self: Any, name: str, content: object) -> bool:
        if name.endswith("0000.lock.jsonl"):
            bucket.pipe_file(f"shards/set/{name}", b'{"uid": "another"}\n')
        return create(self, name, content)  # type: ignore[arg-type]

    monkeypatch.setattr(remote_bucket.Bucket, "create", late)
    machines.use("a")
    with pytest.raises(TrilightError, match="frozen .*0000.lock.jsonl in the meantime.*Run the"):
        _make(OUT, "0:6")
    assert bucket.cat_file(name) == b'{"uid": "another"}\n'
