"""Frozen objects are opened where a scene draws them, and trusted for what the lock says."""

import dataclasses
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from pipeline.making import asked_objects, frozen_pool, pipeline, restore_object
from pipeline.making.accept_objects import accept_objects, trusted_objects
from pipeline.making.attempt_scene import SceneAttempt
from pipeline.making.freeze_objects import AcceptedObjects, require_same
from pipeline.making.frozen_pool import AssetAway, OpenedPool
from pipeline.making.prepare_isolated import asset_store
from pipeline.making.publication import Publication
from pipeline.scenes.fitting import drawn_rows
from pipeline.scenes.pool import PooledAsset, fits_of
from storage.errors import TrilightError
from storage.records.asset import Asset, decode_asset
from storage.records.object_index import ObjectIndex
from storage.records.objects import TEXTURE, read_objects_lock
from tests.pipeline.documents.dataset_by_hand import locked
from tests.pipeline.making.frozen_kit import SOURCE, asked, begun, build, frozen, prepared
from tests.pipeline.scenes.small_pool import first_scene

NUM_OBJECTS = 30


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Publication, AcceptedObjects]]:
    folder = tmp_path_factory.mktemp("frozen")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TRILIGHT_CACHE", str(folder / "cache"))
        publication = begun(folder / "set")
        yield publication, frozen(publication, [prepared(n) for n in range(NUM_OBJECTS)])


def _opened(accepted: AcceptedObjects, split: str = "train") -> OpenedPool:
    assert accepted.pool is not None
    return accepted.pool.opened(split, asset_store())


def _whole(publication: Publication, accepted: AcceptedObjects) -> list[PooledAsset]:
    """The pool as it would be with every object of the split in memory."""
    by_digest = {p.asset_sha256: p.path for p in map(prepared, range(NUM_OBJECTS))}
    return [
        PooledAsset(locked=row, asset=decode_asset(Path(by_digest[row.asset_sha256]).read_bytes()))
        for row in read_objects_lock(publication.folder.objects_lock)
        if row.split == "train"
    ]


def test_scenes_of_opened_objects_are_those_of_objects_in_memory(
    made: tuple[Publication, AcceptedObjects],
) -> None:
    whole, opened = _whole(*made), _opened(made[1])
    assert [entry.locked for entry in opened] == [entry.locked for entry in whole]
    for room in (30, 60, 200, 5000):  # some objects do not fit, or all do
        draws = [
            [drawn_rows(np.random.default_rng(n), fits_of(pool), 2, room) for n in range(20)]
            for pool in (opened, whole)
        ]
        assert draws[0] == draws[1]
    for index in range(2):
        one, other = (
            first_scene(build().scenes, pool, seed=1, scene_index=index) for pool in (opened, whole)
        )
        assert one.objects == other.objects
        assert np.array_equal(one.vertex_positions, other.vertex_positions)


def test_only_a_few_objects_are_open(
    made: tuple[Publication, AcceptedObjects], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frozen_pool, "_MOST_OPEN", 3)
    read: list[bytes] = []

    def counted(data: bytes) -> Asset:
        read.append(data)
        return decode_asset(data)

    monkeypatch.setattr(frozen_pool, "decode_asset", counted)
    pool = _opened(made[1])
    assert not read
    for row in (0, 1, 2, 0, 3, 0, 1):
        assert pool[row].locked.uid == read_objects_lock_uids(made[0])[row]
    assert len(read) == 5  # 0, 1, 2, 3, and 1 again
    assert len(pool._open) == 3
    for row in (-1, len(pool)):
        with pytest.raises(IndexError):
            pool[row]


def read_objects_lock_uids(publication: Publication) -> list[str]:
    rows = read_objects_lock(publication.folder.objects_lock)
    return [row.uid for row in rows if row.split == "train"]


def test_a_second_start_looks_at_no_object(
    made: tuple[Publication, AcceptedObjects], monkeypatch: pytest.MonkeyPatch
) -> None:
    """And at all of them where it is asked for another source, or there is no index of the lock."""
    publication, accepted = made

    def look(source: str, **more: object) -> None:
        raise LookupError(source)

    monkeypatch.setattr(asked_objects, "list_objects", look)
    assert accept_objects(asked(publication)) == accepted
    for source, licence in (("another", None), (SOURCE, "MIT")):
        with pytest.raises(LookupError):
            accept_objects(asked(publication, source, licence))
    index, lock = publication.folder.staged_index, publication.folder.objects_lock
    for path in (index, lock):
        was = path.read_bytes()
        for damaged in (b"", was[:40], was + b" "):
            path.write_bytes(damaged)
            if (path, damaged) != (index, was + b" "):  # which tells nothing about the lock
                assert trusted_objects(asked(publication)) is None
        path.write_bytes(was)
    assert trusted_objects(asked(publication)) == accepted


def test_a_file_that_is_not_the_locked_one_is_away(
    made: tuple[Publication, AcceptedObjects],
) -> None:
    pool = _opened(made[1])
    name = pool._index.asset_name(pool._first)
    path = asset_store().asset_path(name)
    was = path.read_bytes()
    try:
        for damage in (path.unlink, lambda: path.write_bytes(was[:-1]), lambda: _swap(path, pool)):
            damage()
            with pytest.raises(AssetAway) as caught:
                pool[0]
            assert (caught.value.uid, caught.value.asset_name) == (
                read_objects_lock_uids(made[0])[0],
                name,
            )
    finally:
        path.write_bytes(was)
    assert pool[0].locked.uid == read_objects_lock_uids(made[0])[0]


def _swap(path: Path, pool: OpenedPool) -> None:
    """Put another object of the same store in the place of one."""
    other = asset_store().asset_path(pool._index.asset_name(pool._first + 1))
    path.write_bytes(other.read_bytes())


def test_an_index_that_contradicts_the_objects_is_refused(
    made: tuple[Publication, AcceptedObjects],
) -> None:
    """A wrong number of triangles would quietly change what is drawn."""
    path = made[0].folder.staged_index
    was = path.read_bytes()
    index = ObjectIndex(path)
    _, begin = index._arrays["least"]
    row = index._data + begin + 4 * index.facts.splits["train"].start
    path.write_bytes(was[:row] + bytes([was[row] ^ 1]) + was[row + 1 :])
    try:
        with pytest.raises(TrilightError, match=r"objects\.index: says otherwise of 'object .*Del"):
            _opened(made[1])[0]
    finally:
        path.write_bytes(was)


def test_an_object_that_is_away_is_brought_back_for_the_same_attempt(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls: list[tuple[object, ...]] = []
    away = [("a", "1"), ("b", "2")]

    def call(child: object, function: object, *args: object) -> SceneAttempt:
        calls.append(args)
        return SceneAttempt(sample=None, failures=[], away=away[0] if away else None)

    def restore(uid: str, name: str) -> None:
        calls.append((uid, name))
        away.pop(0)

    monkeypatch.setattr(pipeline, "call_with_retries", call)
    child: object = None
    pipeline.make_scene("train", 7, 1, child, restore)  # type: ignore[arg-type]
    assert calls == [("train", 7, 0), ("a", "1"), ("train", 7, 0), ("b", "2"), ("train", 7, 0)]


def test_an_object_that_is_there_again_is_found(tmp_path: Path) -> None:
    """A worker that lives long has listed the source before."""
    source = ("builtin:4", None, tmp_path / "objects", ("MIT", "CC0-1.0"))
    uid = restore_object._listed(*source).allowed[0].uid
    shutil.rmtree(tmp_path / "objects")
    record = restore_object.found_again(*source, uid)
    assert record is not None and Path(record.path).exists()


def test_a_frozen_row_that_is_gone_or_has_changed_is_named() -> None:
    row = locked("texture:cloth", kind=TEXTURE)
    require_same("textures", {row.uid: row}, [row, locked("a")])
    with pytest.raises(TrilightError, match="'texture:cloth' is missing or no longer usable"):
        require_same("textures", {row.uid: row}, [])
    with pytest.raises(TrilightError, match="'texture:cloth' has changed"):
        require_same("textures", {row.uid: row}, [dataclasses.replace(row, licence="MIT")])
