"""Frozen objects, textures and maps: opened where scenes draw them, trusted as the lock says."""

import csv
import dataclasses
import io
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from pipeline.documents.rights import encode_attribution
from pipeline.generation import freeze_objects, pipeline, render_workers, scene_worker
from pipeline.generation.dataset_writer import DatasetWriter
from pipeline.generation.freeze_objects import AcceptedMaps, ObjectLock
from pipeline.generation.generate_options import GenerateOptions
from pipeline.generation.prepare_isolated import asset_store
from pipeline.generation.scene_origins import AcceptedObjects, ComposedScenes, require_same
from pipeline.generation.scene_worker import AssetMissing, SceneAttempt, SplitPool, user_maps
from pipeline.objects.maps.prepared import prepare_map
from pipeline.presets.registry import preset_settings
from pipeline.scenes.triangle_budget import PooledAsset, draw_rows
from scene_templates.scene_maps import UserMap, draw_user_map
from storage.conventions import SPLITS
from storage.dataset.verify import check_sample
from storage.errors import Rejected, TrilightError
from storage.records.asset import decode_asset
from storage.records.object_index import ObjectIndex
from storage.records.objects import (
    SKY,
    TEXTURE,
    LockedObject,
    encode_objects_lock,
    read_objects_lock,
)
from storage.records.texture import MapSource
from storage.seeds import SceneKey, rng_for
from storage.typed_json import read_json_lines
from tests.infra.child_here import ChildHere
from tests.pipeline.documents.dataset_by_hand import locked, write_dataset
from tests.pipeline.generation.frozen_kit import BUILD, SOURCE, asked, frozen, prepared
from tests.pipeline.generation.test_dataset_writer import begin_tiny
from tests.pipeline.objects.maps.test_maps import exr, noise, png, sun_map
from tests.pipeline.scenes.small_pool import ListPool, composed, first_scene, small_pool
from tests.scenes_by_hand import tiny_sample

NUM_OBJECTS = 30


Made = tuple[DatasetWriter, AcceptedObjects]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Made]:
    folder = tmp_path_factory.mktemp("frozen")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TRILIGHT_CACHE", str(folder / "cache"))
        writer = begin_tiny(folder / "set")
        yield writer, frozen(writer, [prepared(n) for n in range(NUM_OBJECTS)])


def _opened(accepted: AcceptedObjects, split: str = "train") -> SplitPool:
    assert isinstance(accepted.origin, ComposedScenes)
    return SplitPool(accepted.origin, split, asset_store())


def _rows(writer: DatasetWriter) -> list[LockedObject]:
    return [row for row in read_objects_lock(writer.folder.objects_lock) if row.split == "train"]


def test_scenes_of_opened_objects_are_those_of_objects_in_memory(made: Made) -> None:
    """Those in memory are every object of the split."""
    writer, accepted = made
    stored = {
        each.asset_sha256: asset_store().asset_path(each.asset_name)
        for each in map(prepared, range(NUM_OBJECTS))
    }
    whole = [
        PooledAsset(locked=row, asset=decode_asset(stored[row.asset_sha256].read_bytes()))
        for row in _rows(writer)
    ]
    opened = _opened(accepted)
    assert [entry.locked for entry in opened] == [entry.locked for entry in whole]
    for room in (30, 60, 200, 5000):  # some objects do not fit, or all do
        draws = [
            [draw_rows(np.random.default_rng(n), pool.fits, 2, room) for n in range(20)]
            for pool in (opened, ListPool(whole))
        ]
        assert draws[0] == draws[1]
    for index in range(2):
        one, other = (
            first_scene(BUILD.scenes, pool, seed=1, scene_index=index) for pool in (opened, whole)
        )
        assert one.objects == other.objects
        assert np.array_equal(one.vertex_positions, other.vertex_positions)


def test_only_a_few_objects_are_open(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene_worker, "_MOST_OPEN", 3)
    decode = Mock(wraps=decode_asset)
    monkeypatch.setattr(scene_worker, "decode_asset", decode)
    pool = _opened(made[1])
    assert not decode.called
    for row in (0, 1, 2, 0, 3, 0, 1):
        assert pool[row].locked.uid == _rows(made[0])[row].uid
    assert decode.call_count == 5  # 0, 1, 2, 3, and 1 again
    assert pool._open.cache_info().currsize == 3
    for row in (-1, len(pool)):
        with pytest.raises(IndexError):
            pool[row]


def test_a_second_start_looks_at_no_object(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    """And at all of them where it is asked for another source, or there is no index of the lock."""
    writer, accepted = made

    def look(source: str, **more: object) -> None:
        raise LookupError(source)

    monkeypatch.setattr(freeze_objects, "list_objects", look)
    assert asked(writer).accept() == accepted
    for source, licence in (("another", None), (SOURCE, "MIT")):
        with pytest.raises(LookupError):
            asked(writer, source, licence).accept()
    index, lock = writer.folder.staged_index, writer.folder.objects_lock
    for path in (index, lock):
        was = path.read_bytes()
        for damaged in (b"", was[:40], was + b" "):
            path.write_bytes(damaged)
            if (path, damaged) != (index, was + b" "):  # which tells nothing about the lock
                assert asked(writer).load() is None
        path.write_bytes(was)
    assert asked(writer).load() == accepted


def test_a_file_that_is_not_the_locked_one_is_away(made: Made) -> None:
    pool = _opened(made[1])
    name = pool._index.asset_name(pool._first)
    path = asset_store().asset_path(name)
    was = path.read_bytes()
    other = asset_store().asset_path(pool._index.asset_name(pool._first + 1)).read_bytes()
    try:
        for damage in (None, was[:-1], other):
            path.unlink(missing_ok=True)
            if damage is not None:
                path.write_bytes(damage)
            with pytest.raises(AssetMissing) as caught:
                pool[0]
            uid = _rows(made[0])[0].uid
            assert (caught.value.uid, caught.value.asset_name) == (uid, name)
    finally:
        path.write_bytes(was)
    assert pool[0].locked.uid == uid


def test_an_index_that_contradicts_the_objects_is_refused(made: Made) -> None:
    """A wrong number of triangles would quietly change what is drawn."""
    path = made[0].folder.staged_index
    was = path.read_bytes()
    index = ObjectIndex(path)
    row = index._columns["least"].offset + 4 * index.facts.splits["train"].start
    path.write_bytes(was[:row] + bytes([was[row] ^ 1]) + was[row + 1 :])
    try:
        with pytest.raises(TrilightError, match=r"objects\.index: says otherwise of 'object .*Del"):
            _opened(made[1])[0]
    finally:
        path.write_bytes(was)


def test_an_object_that_is_away_is_brought_back_for_the_same_attempt() -> None:
    calls: list[tuple[object, ...]] = []
    away = [("a", "1"), ("b", "2")]

    def attempt(method: object, *args: object) -> SceneAttempt:
        calls.append(args)
        return SceneAttempt(sample=None, failures=[], missing_asset=away[0] if away else None)

    def restore(uid: str, name: str) -> None:
        calls.append((uid, name))
        away.pop(0)

    child: object = SimpleNamespace(call_method=attempt)
    pipeline.make_scene("train", 7, 1, child, restore)  # type: ignore[arg-type]
    assert calls == [("train", 7, 0), ("a", "1"), ("train", 7, 0), ("b", "2"), ("train", 7, 0)]


def test_an_object_that_is_there_again_is_found(tmp_path: Path) -> None:
    """A worker that lives long has listed the source before."""
    source = ("builtin:4", None, tmp_path / "objects", ("MIT", "CC0-1.0"))
    uid = render_workers._list_source(*source).records[0].uid
    shutil.rmtree(tmp_path / "objects")
    record = render_workers.find_object(*source, uid)
    assert record is not None and Path(record.path).exists()


def test_a_frozen_row_that_is_gone_or_has_changed_is_named() -> None:
    row = locked("texture:cloth", kind=TEXTURE)
    require_same("textures", {row.uid: row}, [row])
    with pytest.raises(TrilightError, match="'a' is new"):
        require_same("textures", {row.uid: row}, [row, locked("a")])
    with pytest.raises(TrilightError, match="'texture:cloth' is missing or no longer usable"):
        require_same("textures", {row.uid: row}, [])
    with pytest.raises(TrilightError, match="'texture:cloth' has changed"):
        require_same("textures", {row.uid: row}, [dataclasses.replace(row, licence="MIT")])


SHARES = {
    "scenes.textures.share": 0.9,
    "scenes.textures.own_share": 1.0,
    "scenes.textures.surfaces.size": 4,
    "scenes.skies.share": 1.0,
    "scenes.skies.own_share": 1.0,
    "scenes.skies.maps.height": 4,
    "splits.held_out_objects": 0.3,
}


SETTINGS = preset_settings("smoke", changes=SHARES)


@pytest.fixture(scope="module")
def accepted(tmp_path_factory: pytest.TempPathFactory) -> AcceptedMaps:
    """Twelve of each, one in a second copy, and a map that is no map."""
    root = tmp_path_factory.mktemp("own")
    for number in range(12, 24):
        png(root / "textures" / f"cloth{number}.png", noise(number))
        (root / "skies").mkdir(exist_ok=True)
        exr(root / "skies" / f"sky{number}.exr", sun_map(number))
    png(root / "textures" / "copy.bmp", noise(12))
    exr(root / "skies" / "copy.exr", sun_map(12))
    exr(root / "skies" / "bad.exr", np.full((2, 4, 3), np.nan, np.float32))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TRILIGHT_CACHE", str(root / "cache"))
        patch.setattr(freeze_objects, "IsolatedChild", ChildHere)
        folders = {TEXTURE: str(root / "textures"), SKY: str(root / "skies")}
        stated: dict[str, Any] = {"source": "", "licence": None, "writer": None}
        return ObjectLock(settings=SETTINGS, map_folders=folders, **stated).accept_maps()


def test_rows_have_splits_by_content_and_copies_stay_together(accepted: AcceptedMaps) -> None:
    rows = {locked.uid: locked for locked, _ in accepted.rows}
    assert len(rows) == 26
    assert [failure.reason for failure in accepted.failures] == ["not_a_number"]
    for copy, first in (("texture:copy", "texture:cloth12"), ("sky:copy", "sky:sky12")):
        assert rows[copy].split == rows[first].split
    for kind in (TEXTURE, SKY):
        assert {row.split for row in rows.values() if row.kind == kind} == set(SPLITS)
    lock = encode_objects_lock(rows.values())
    in_order = sorted(rows.values(), key=lambda row: row.uid)
    assert read_json_lines(lock, LockedObject, "lock") == in_order


def test_no_texture_or_map_of_test_is_in_train(accepted: AcceptedMaps) -> None:
    """By their bytes: not only the uids differ, but what scenes show."""
    uids: dict[str, set[str]] = {}
    shown: dict[str, set[str]] = {}
    for split in SPLITS:
        own = user_maps(accepted.rows, split)
        uids[split], shown[split] = set(), set()
        for index in range(5):
            try:
                key = SceneKey(0, index)
                scene = composed(SETTINGS.scenes, small_pool(), key, user_maps=own)
            except Rejected:
                continue
            scene.check()
            uids[split].update(scene.provenance["maps"])
            shown[split].update(t.sha256 for t in scene.textures if t.channels == 3)
            assert scene.environment is not None
            assert scene.provenance["sky"]["family"] == "own"
            sky = scene.environment.radiance_rgb / scene.environment.radiance_rgb.max()
            shown[split].add(str(np.round(np.sort(sky.ravel()), 4).tolist()))
        assert uids[split]
    specular = set.intersection(*shown.values())  # F0 of no metal, the same constant everywhere
    assert len(specular) <= 1
    for one, other in (("train", "test"), ("train", "validation"), ("validation", "test")):
        assert not uids[one] & uids[other]
        assert not (shown[one] & shown[other]) - specular
    split_of = {locked.uid: locked.split for locked, _ in accepted.rows}
    assert all(split_of[uid] == split for split in SPLITS for uid in uids[split])


def test_without_own_ones_a_scene_is_what_it_was(accepted: AcceptedMaps) -> None:
    """Folders change no draw while their shares are 0, and procedural ones stay where none is."""
    changes = {name: 0.0 for name in SHARES if name.endswith("own_share")}
    plain = preset_settings("smoke", changes=SHARES | changes).scenes
    own = user_maps(accepted.rows, "train")
    first, second = (
        composed(plain, small_pool(), SceneKey(0, 3), **given) for given in ({}, {"user_maps": own})
    )
    assert [t.sha256 for t in first.textures] == [t.sha256 for t in second.textures]
    assert "maps" not in second.provenance


def test_documents_name_them_and_a_stranger_in_a_scene_is_a_fault(
    accepted: AcceptedMaps, tmp_path: Path
) -> None:
    rows = [locked for locked, _ in accepted.rows]
    table = list(csv.DictReader(io.StringIO(encode_attribution(rows).decode())))
    done = {row["uid"]: row["changes"] for row in table}
    assert "laid on other surfaces" in done["texture:copy"] and "turned" in done["sky:copy"]
    sample, locked = tiny_sample(), {row.uid: row for row in rows}
    manifest = write_dataset(tmp_path, {}).manifest
    trains = next(row.uid for row in rows if row.split == "train")
    held = next(row.uid for row in rows if row.split == "test")
    named = {**sample.scene.provenance, "maps": [trains, held, "sky:unknown"]}
    shown = dataclasses.replace(sample, scene=sample.scene.with_provenance(named))
    faults = "; ".join(check_sample(shown, "train", manifest, locked))
    assert f"object {held!r} belongs to split test" in faults
    assert "object 'sky:unknown' is not in objects.lock.jsonl" in faults and trains not in faults


def test_share_alike_licences_never_meet() -> None:
    def map_under(licence: str) -> UserMap:
        return UserMap(uid=licence, source=MapSource(licence=licence), load=dict)

    own = [map_under("CC-BY-SA-4.0"), map_under("CC-BY-SA-3.0"), map_under("CC0-1.0")]
    drawn = {
        found.uid
        for number in range(50)
        if (found := draw_user_map(rng_for(number, "own"), own, 1.0, ["CC-BY-SA-3.0", "MIT"]))
    }
    assert drawn == {"CC-BY-SA-3.0", "CC0-1.0"}
    assert draw_user_map(rng_for(0, "own"), own[:1], 1.0, ["CC-BY-SA-3.0"]) is None


def test_folders_and_shares_belong_together() -> None:
    with pytest.raises(TrilightError, match="--skies is not given"):
        GenerateOptions(textures="t", changes=SHARES).map_folders()
    with pytest.raises(TrilightError, match=r"--textures is given, but .*own_share 0"):
        GenerateOptions(textures="t").map_folders()
    with pytest.raises(TrilightError, match="--scenes-from scenes was given with --textures"):
        GenerateOptions(textures="t", scenes_from="scenes")
    with pytest.raises(TrilightError, match="only with --textures or --skies"):
        GenerateOptions(map_licence="MIT")


def test_files_that_lie_are_refused_with_their_part(tmp_path: Path) -> None:
    broken = tmp_path / "a_roughness.png"
    broken.write_bytes(b"\x89PNG\r\n\x1a\n")
    files = {"base": png(tmp_path / "a.png", noise(1)), "roughness": broken}
    with pytest.raises(Rejected, match="roughness: it is cut off, or no PNG"):
        prepare_map(TEXTURE, files, 4)
    wide = exr(tmp_path / "wide.exr", np.ones((1, 8193, 3), np.float32))
    with pytest.raises(Rejected, match="twice as wide as high"):
        prepare_map(SKY, {"map": wide}, 4)
