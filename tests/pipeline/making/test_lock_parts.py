"""Objects frozen in parts: scenes begin with the first, and what is frozen never changes."""

import dataclasses
import shutil
from collections import Counter
from pathlib import Path

import pytest

from pipeline.builds.named import named_build
from pipeline.making.lock_parts import LockPart
from pipeline.making.pipeline import make_dataset
from pipeline.making.publication import Publication
from pipeline.making.run import Run, ShardJob
from storage.dataset.dataset import open_dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.settings import SplitSettings
from storage.dataset.splits import part_of_object, part_of_shard, shard_name, split_of_shard
from storage.digests import sha256_of_file
from storage.errors import TrilightError
from storage.records.lock_rows import LockRows
from storage.records.objects import OBJECT, TEXTURE, read_objects_lock
from tests.pipeline.making.parts_kit import PARTS, parts_by_hand, parts_order, textures_in
from tests.pipeline.making.tiny_scenes_kit import Undocumented

SPLITS = SplitSettings(scenes_per_shard=4, shards_per_cycle=6, object_parts=PARTS)


def test_every_part_has_shards_of_all_splits() -> None:
    found = {(part_of_shard(n, SPLITS), split_of_shard(n, SPLITS)) for n in range(6 * PARTS)}
    assert len(found) == 3 * PARTS
    one_split = dataclasses.replace(SPLITS, one_split=True)
    assert [part_of_shard(n, one_split) for n in range(4)] == [0, 1, 0, 1]


def test_parts_of_objects_follow_from_their_uids() -> None:
    parts = [part_of_object(f"object {n}", SPLITS) for n in range(400)]
    assert all(150 < parts.count(part) < 250 for part in range(PARTS))
    assert {part_of_object("a", dataclasses.replace(SPLITS, object_parts=1))} == {0}


def test_one_part_leaves_the_record_as_it_was() -> None:
    build = named_build("smoke")
    assert "object_parts" not in build.as_json()["splits"]
    parts = dataclasses.replace(build, splits=dataclasses.replace(build.splits, object_parts=2))
    assert parts.as_json()["splits"]["object_parts"] == 2
    assert parts.digest != build.digest


def test_of_listed_scenes_no_object_is_drawn() -> None:
    with pytest.raises(TrilightError, match="expected 1 where scenes are listed"):
        dataclasses.replace(SPLITS, listed_scenes=4)


@pytest.fixture
def made_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[object]:
    return parts_by_hand(tmp_path, monkeypatch)


def test_scenes_begin_with_the_first_part(tmp_path: Path, made_in_order: list[object]) -> None:
    """A longer dataset goes on with the other part; what was frozen stays, and all verifies."""
    out = tmp_path / "set"
    make_dataset(parts_order(str(out), 8), Undocumented())  # two shards of the first cycle
    objects = [uid for uid in made_in_order if isinstance(uid, str)]
    assert made_in_order == [*objects, *range(8)]
    splits = _splits(out)
    assert {part_of_object(uid, splits) for uid in objects} == {0}
    first = read_objects_lock(out / "objects.lock.jsonl")
    assert [row.uid for row in first] == sorted(objects)
    made_in_order.clear()
    outcome = make_dataset(parts_order(str(out), 28), Undocumented())  # into the second cycle
    later = read_objects_lock(out / "objects.lock.jsonl")
    assert outcome.num_objects_used == len(later) == 60
    assert [row for row in later if row.uid in objects] == first
    kinds = [type(one) for one in made_in_order]
    changes = [kind for n, kind in enumerate(kinds) if n == 0 or kind != kinds[n - 1]]
    assert changes == [int, str, int]  # the first part was frozen before
    assert open_dataset(str(out)).manifest.num_scenes == 28
    folder = DatasetFolder(out)
    for number in range(PARTS):
        part = LockPart(folder=folder, splits=splits, number=number)
        expected = [row for row in later if part_of_object(row.uid, splits) == number]
        assert list(LockRows(part.lock)) == expected
    shutil.rmtree(folder.staged_locks)  # as whoever deletes .staging
    (out / "train-000000.tar").unlink()
    made_in_order.clear()
    assert make_dataset(parts_order(str(out), 28), Undocumented()).digest == outcome.digest
    assert made_in_order == [0, 1, 2, 3]
    assert read_objects_lock(out / "objects.lock.jsonl") == later


def test_a_kill_between_lock_and_manifest_leaves_a_part_to_be_frozen(
    tmp_path: Path, made_in_order: list[object], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "set"
    make_dataset(parts_order(str(out), 8), Undocumented())
    before = (out / "objects.lock.jsonl").read_bytes()

    def killed(publication: Publication, **changes: object) -> None:
        if "objects_lock_sha256" in changes:
            raise KeyboardInterrupt
        write(publication, **changes)

    write = Publication._write
    monkeypatch.setattr(Publication, "_write", killed)
    with pytest.raises(KeyboardInterrupt):
        make_dataset(parts_order(str(out), 28), Undocumented())
    assert (out / "objects.lock.jsonl").read_bytes() != before
    monkeypatch.setattr(Publication, "_write", write)
    make_dataset(parts_order(str(out), 28), Undocumented())
    frozen = open_dataset(str(out)).manifest.objects_lock_sha256
    assert frozen == sha256_of_file(out / "objects.lock.jsonl")
    assert len(read_objects_lock(out / "objects.lock.jsonl")) == 60


def test_render_children_are_those_of_a_part(
    tmp_path: Path, made_in_order: list[object], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process that makes shards of two parts must not draw from the first of them alone."""
    out, keys = tmp_path / "set", []
    make_dataset(parts_order(str(out), 28), Undocumented())
    job = Run.job

    def noted(run: Run, num_at_once: int) -> ShardJob:
        keys.append(job(run, num_at_once).lock_sha256)
        return job(run, num_at_once)

    monkeypatch.setattr(Run, "job", noted)
    for number in (0, 6):
        (out / shard_name(number, SPLITS)).unlink()
    make_dataset(parts_order(str(out), 28), Undocumented())
    assert len(keys) == len(set(keys)) == PARTS


def test_textures_of_the_user_serve_every_part(tmp_path: Path, made_in_order: list[object]) -> None:
    """They are frozen with the first; one more is none of this dataset, one less an error."""
    out, textures = tmp_path / "set", textures_in(tmp_path / "textures", 1, 2)

    def make(scenes: int) -> str:
        order = parts_order(str(out), scenes, textures=textures)
        return make_dataset(order, Undocumented()).digest

    make(8)
    textures_in(textures, 3)
    digest = make(28)
    rows = read_objects_lock(out / "objects.lock.jsonl")
    kinds = Counter(row.kind for row in rows)
    assert kinds == {OBJECT: 60, TEXTURE: 2}
    folder = DatasetFolder(out)
    assert read_objects_lock(folder.lock_part("maps")) == [r for r in rows if r.kind == TEXTURE]
    shutil.rmtree(folder.staged_locks)  # as whoever deletes .staging
    (out / "train-000000.tar").unlink()
    assert make(28) == digest
    (textures / "cloth1.png").unlink()
    (out / "train-000000.tar").unlink()
    with pytest.raises(TrilightError, match="'texture:cloth1' is missing or no longer usable"):
        make(28)


def _splits(out: Path) -> SplitSettings:
    splits = open_dataset(str(out)).manifest.settings["splits"]
    return SplitSettings(**splits)
