"""Folders of textures and maps to frozen rows: splits by content, and no map of test in train."""

import csv
import dataclasses
import io
from pathlib import Path

import numpy as np
import pytest

from pipeline.builds.named import named_build
from pipeline.builds.settings import BuildSettings
from pipeline.documents.attribution import encode_attribution
from pipeline.making import accept_maps as accepting
from pipeline.making.accept_maps import AcceptedMaps, MapFolders, accept_maps, map_folders
from pipeline.making.dataset_order import DatasetOrder
from pipeline.making.own_maps import own_maps
from pipeline.objects.maps.prepared import MapFiles, prepare_map
from pipeline.scenes.compose import compose_scene
from scene_templates.own_maps import OwnMap, drawn_own
from storage.conventions import SPLITS
from storage.dataset.manifest import Manifest
from storage.dataset.verify import check_sample
from storage.errors import Rejected, TrilightError
from storage.records.objects import SKY, TEXTURE, decode_objects_lock, encode_objects_lock
from storage.records.texture import MapSource
from storage.seeds import rng_for
from tests.infra.child_here import ChildHere
from tests.pipeline.objects.maps.map_files import exr, noise, png, sun_map
from tests.pipeline.scenes.small_pool import small_pool
from tests.scenes_by_hand import tiny_sample

SHARES = {
    "scenes.textures.share": 0.9,
    "scenes.textures.own_share": 1.0,
    "scenes.textures.surfaces.size": 4,
    "scenes.skies.share": 1.0,
    "scenes.skies.own_share": 1.0,
    "scenes.skies.maps.height": 4,
    "splits.held_out_objects": 0.3,
}


@pytest.fixture(scope="module")
def settings() -> BuildSettings:
    return named_build("smoke", changes=SHARES)


@pytest.fixture(scope="module")
def accepted(settings: BuildSettings, tmp_path_factory: pytest.TempPathFactory) -> AcceptedMaps:
    """Twelve of each, one in a second copy, and a map that is no map."""
    root = tmp_path_factory.mktemp("own")
    for number in range(12, 24):
        png(root / "textures" / f"cloth{number}.png", noise(number))
        (root / "skies").mkdir(exist_ok=True)
        exr(root / "skies" / f"sky{number}.exr", sun_map(number))
    png(root / "textures" / "copy.bmp", noise(12))
    exr(root / "skies" / "copy.exr", sun_map(12))
    exr(root / "skies" / "bad.exr", np.full((2, 4, 3), np.nan, np.float32))
    folders = ((TEXTURE, str(root / "textures")), (SKY, str(root / "skies")))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TRILIGHT_CACHE", str(root / "cache"))
        patch.setattr(accepting, "IsolatedChild", ChildHere)
        return accept_maps(MapFolders(folders=folders), settings, workers=1)


def test_rows_have_splits_by_content_and_copies_stay_together(accepted: AcceptedMaps) -> None:
    rows = {locked.uid: locked for locked, _ in accepted.rows}
    assert len(rows) == 26
    assert [failure.reason for failure in accepted.failures] == ["not_a_number"]
    for copy, first in (("texture:copy", "texture:cloth12"), ("sky:copy", "sky:sky12")):
        assert rows[copy].split == rows[first].split
    for kind in (TEXTURE, SKY):
        assert {row.split for row in rows.values() if row.kind == kind} == set(SPLITS)
    assert decode_objects_lock(encode_objects_lock(rows.values()), "lock") == sorted(
        rows.values(), key=lambda row: row.uid
    )


def test_no_texture_or_map_of_test_is_in_train(
    accepted: AcceptedMaps, settings: BuildSettings
) -> None:
    """By their bytes: not only the uids differ, but what scenes show."""
    uids: dict[str, set[str]] = {}
    shown: dict[str, set[str]] = {}
    for split in SPLITS:
        own = own_maps(accepted.rows, split)
        uids[split], shown[split] = set(), set()
        for index in range(5):
            try:
                scene = compose_scene(
                    settings.scenes, small_pool(), seed=0, scene_index=index, attempt=0, own=own
                )
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


def test_without_own_ones_a_scene_is_what_it_was(
    accepted: AcceptedMaps, settings: BuildSettings
) -> None:
    """Folders change no draw while their shares are 0, and procedural ones stay where none is."""
    changes = {name: 0.0 for name in SHARES if name.endswith("own_share")}
    plain = named_build("smoke", changes=SHARES | changes).scenes
    own = own_maps(accepted.rows, "train")
    first, second = (
        compose_scene(plain, small_pool(), seed=0, scene_index=3, attempt=0, **given)
        for given in ({}, {"own": own})
    )
    assert [t.sha256 for t in first.textures] == [t.sha256 for t in second.textures]
    assert "maps" not in second.provenance
    record = dataclasses.asdict(settings.scenes)
    assert record["skies"]["own_share"] == 1.0


def test_documents_name_them_and_a_stranger_in_a_scene_is_a_fault(accepted: AcceptedMaps) -> None:
    rows = [locked for locked, _ in accepted.rows]
    table = list(csv.DictReader(io.StringIO(encode_attribution(rows).decode())))
    done = {row["uid"]: row["changes"] for row in table}
    assert "laid on other surfaces" in done["texture:copy"] and "turned" in done["sky:copy"]
    sample, locked = tiny_sample(), {row.uid: row for row in rows}
    manifest = Manifest(
        build="smoke",
        settings={},
        environment={},
        num_scenes=1,
        num_views=sample.scene.num_views,
        objects_lock_sha256="",
        shards=(),
    )
    trains = next(row.uid for row in rows if row.split == "train")
    held = next(row.uid for row in rows if row.split == "test")
    named = {**sample.scene.provenance, "maps": [trains, held, "sky:unknown"]}
    shown = dataclasses.replace(sample, scene=sample.scene.with_provenance(named))
    faults = "; ".join(check_sample(shown, "train", manifest, locked))
    assert f"object {held!r} belongs to split test" in faults
    assert "object 'sky:unknown' is not in objects.lock.jsonl" in faults and trains not in faults


def test_share_alike_licences_never_meet() -> None:
    def map_under(licence: str) -> OwnMap[int]:
        return OwnMap(uid=licence, source=MapSource(licence=licence), load=lambda: 0)

    own = [map_under("CC-BY-SA-4.0"), map_under("CC-BY-SA-3.0"), map_under("CC0-1.0")]
    drawn = {
        found.uid
        for number in range(50)
        if (found := drawn_own(rng_for(number, "own"), own, 1.0, ["CC-BY-SA-3.0", "MIT"]))
    }
    assert drawn == {"CC-BY-SA-3.0", "CC0-1.0"}
    assert drawn_own(rng_for(0, "own"), own[:1], 1.0, ["CC-BY-SA-3.0"]) is None


def test_folders_and_shares_belong_together() -> None:
    with pytest.raises(TrilightError, match="--skies is not given"):
        map_folders(DatasetOrder(textures="t"), named_build("smoke", changes=SHARES))
    with pytest.raises(TrilightError, match=r"--textures is given, but .*own_share 0"):
        map_folders(DatasetOrder(textures="t"), named_build("smoke"))
    with pytest.raises(TrilightError, match="only where scenes are composed"):
        DatasetOrder(textures="t", scenes_from="scenes")
    with pytest.raises(TrilightError, match="only with --textures or --skies"):
        DatasetOrder(map_licence="MIT")


def test_files_that_lie_are_refused_with_their_part(tmp_path: Path) -> None:
    broken = tmp_path / "a_roughness.png"
    broken.write_bytes(b"\x89PNG\r\n\x1a\n")
    files = {"base": png(tmp_path / "a.png", noise(1)), "roughness": broken}
    with pytest.raises(Rejected, match="roughness: it is not a readable picture"):
        prepare_map(MapFiles(kind=TEXTURE, files=files, size=4))
    wide = exr(tmp_path / "wide.exr", np.ones((1, 8193, 3), np.float32))
    with pytest.raises(Rejected, match="expected at most 8192"):
        prepare_map(MapFiles(kind=SKY, files={"map": wide}, size=4))
