"""merge, select and reshard of finished datasets: what goes in comes out, once, with its maps.

What cannot be done is refused in one clear line, and leaves nothing.
"""

import dataclasses
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from pipeline.generation.derive_dataset import (
    DeriveOptions,
    Selection,
    derive_dataset,
    derive_shards,
)
from pipeline.shards.finished_dataset import open_finished
from pipeline.shards.pack_shards import pack_shard
from storage.dataset import layout
from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import derivation_of, index_shard, write_manifest
from storage.dataset.shard import open_shard, write_shard
from storage.dataset.staging import read_staged_scene
from storage.dataset.verify import verify_dataset
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.records.objects import (
    Failure,
    LockedObject,
    encode_objects_lock,
    read_failures,
    read_objects_lock,
)
from storage.records.sample import Sample, encode_sample, sample_key
from storage.records.scene import Scene
from tests.columns_kit import COAT, declared
from tests.for_each import for_each
from tests.pipeline.documents.dataset_by_hand import (
    files_of,
    furnished,
    locked,
    sample,
    write_dataset,
)
from tests.pipeline.generation.test_dataset_writer import begin_tiny
from tests.scenes_by_hand import stage_scene
from tests.textured_by_hand import (
    colour_texture,
    number_texture,
    sky,
    textured_sample,
    textured_scene,
)
from tests.train.toy import toy_sample

SETTINGS: dict[str, Any] = {
    "build": "smoke",
    "renders": {"noise_floor_db": 40.0, "max_spp": 256, "resolution": 16},
    "scenes": {"max_triangles": 9},
    "splits": {"scenes_per_shard": 2},
}
TRAIN_OBJECT = dataclasses.replace(locked("a"), asset_sha256="a" * 64)
TEST_OBJECT = dataclasses.replace(locked("c", "CC-BY-4.0", split="test"), asset_sha256="c" * 64)


def lit(index: int, salt: int, uids: Sequence[str], template: str = "plane") -> Sample:
    """Return a sample whose scene no other (index, salt) has; floors rise with the index."""
    scene: Scene = furnished(uids, template)
    scene.materials[0, 0] = 0.3 + 0.001 * index + 0.1 * salt
    return sample(index, scene, noise_floor_db=36.0 + index)


def scenes(salt: int, *, train: str = "a", test: str = "c") -> dict[str, list[Sample]]:
    """Return four scenes for training in two shards, and two for testing."""
    return {
        "train-000000.tar": [lit(0, salt, [train]), lit(1, salt, [], "wall")],
        "train-000001.tar": [lit(2, salt, [train], "wall"), lit(3, salt, [train])],
        "test-000002.tar": [lit(4, salt, [test], "wall"), lit(5, salt, [test])],
    }


def finished(
    root: Path,
    shards: Mapping[str, Sequence[Sample]],
    *,
    objects: Sequence[LockedObject] = (TRAIN_OBJECT, TEST_OBJECT, locked("unused", "MIT")),
    seed: int = 0,
    **more: Any,
) -> Path:
    """Write a finished dataset, as `write_dataset` does with more of its arguments."""
    stated = {
        "build": "smoke",
        "settings": {**SETTINGS, "seed": seed},
        "num_scenes": 2 * len(shards),
        "objects_lock_sha256": sha256_hex(encode_objects_lock(objects)),
    }
    write_dataset(root, shards, objects=objects, order=list, **{**stated, **more})
    return root


MERGE = DeriveOptions(operation="merge")


def select(**chosen: Any) -> DeriveOptions:
    return DeriveOptions(operation="select", selection=Selection(**chosen))


def reshard(scenes_per_shard: int) -> DeriveOptions:
    return DeriveOptions(operation="reshard", scenes_per_shard=scenes_per_shard)


def made(out: Path, derive: DeriveOptions, *places: Path) -> Dataset:
    """Make a whole dataset, documents and all."""
    derive_dataset([str(place) for place in places], derive, out)
    assert verify_dataset(out).problems == []
    return open_dataset(str(out))


def shards_made(out: Path, derive: DeriveOptions, *places: Path) -> Dataset:
    """Make all that a digest covers, without the documents, which take seconds."""
    derive_shards([open_finished(str(place)) for place in places], derive, DatasetFolder(out))
    assert verify_dataset(out).problems == []
    return open_dataset(str(out))


def samples_of(dataset: Dataset) -> dict[str, tuple[str, dict[str, bytes]]]:
    """Return split and members of every sample, by key."""
    return {
        sample.key: (shard.split, encode_sample(sample))
        for shard in dataset.manifest.shards
        for sample in dataset.read_shard(shard)
    }


def given(shards: dict[str, list[Sample]], offset: int = 0) -> dict[str, tuple[str, dict]]:
    return {
        sample_key(int(sample.key) + offset): (name.partition("-")[0], encode_sample(sample))
        for name, of_shard in shards.items()
        for sample in of_shard
    }


def test_a_merge_holds_every_scene_under_its_raised_key_and_says_where_it_is_from(
    tmp_path: Path,
) -> None:
    a, b = finished(tmp_path / "a", scenes(0)), finished(tmp_path / "b", scenes(1), seed=1)
    merged = made(tmp_path / "c", MERGE, a, b)
    assert samples_of(merged) == given(scenes(0)) | given(scenes(1), 6)
    assert [shard.name for shard in merged.manifest.shards] == [
        "train-000000.tar", "train-000001.tar", "test-000002.tar",
        "train-000003.tar", "train-000004.tar", "test-000005.tar",
    ]  # fmt: skip
    for shard in open_dataset(str(a)).manifest.shards:  # the first source's shards stay as they are
        assert merged.folder.shard(shard.name).read_bytes() == (a / shard.name).read_bytes()
    manifest = merged.manifest
    derivation = derivation_of(manifest.settings)
    assert derivation is not None and derivation.operation == "merge"
    for source, root, offset in zip(derivation.sources, (a, b), (0, 6), strict=True):
        of_source = open_dataset(str(root)).manifest
        assert source["digest"] == of_source.dataset_digest
        assert source["settings"] == of_source.settings
        assert (source["key_offset"], source["num_scenes"]) == (offset, 6)
    assert "seed" not in manifest.settings  # they differ in it
    assert manifest.settings["renders"]["resolution"] == 16
    assert (manifest.num_scenes, manifest.num_samples) == (12, 12)
    body = (tmp_path / "c" / "README.md").read_text()
    assert all(str(source["digest"]) in body for source in derivation.sources)


def test_a_merge_of_a_merge_nests_and_one_of_a_selection_gives_no_key_twice(
    tmp_path: Path,
) -> None:
    """A selection keeps its keys, which then go beyond its number of scenes."""
    roots = [finished(tmp_path / str(salt), scenes(salt), seed=salt) for salt in range(3)]
    shards_made(tmp_path / "ab", MERGE, *roots[:2])
    merged = shards_made(tmp_path / "abc", MERGE, tmp_path / "ab", roots[2])
    assert samples_of(merged) == given(scenes(0)) | given(scenes(1), 6) | given(scenes(2), 12)
    derivation = derivation_of(merged.manifest.settings)
    assert derivation is not None
    assert "derived" in derivation.sources[0]["settings"]
    assert derivation.sources[1]["key_offset"] == 12
    shards_made(tmp_path / "c", select(split="test"), roots[0])
    merged = shards_made(tmp_path / "d", MERGE, tmp_path / "c", roots[1])
    test_part = {"test-000002.tar": scenes(0)["test-000002.tar"]}
    assert samples_of(merged) == given(test_part) | given(scenes(1), 6)


def test_equal_inputs_give_equal_bytes_wherever_they_lie(tmp_path: Path) -> None:
    """All files, documents too; neither clock nor place is in them."""
    results = []
    for place in ("one", "two/deeper"):
        a = finished(tmp_path / place / "a", scenes(0))
        b = finished(tmp_path / place / "b", scenes(1), seed=1)
        made(tmp_path / place / "merge", MERGE, a, b)
        for derive in (select(split="train"), reshard(3)):
            shards_made(tmp_path / place / derive.operation, derive, a)
        results.append(files_of(tmp_path / place))
        assert not [path.name for path in (tmp_path / place).iterdir() if path.name[0] == "."]
    assert results[0] == results[1]
    documents = ("README.md", "LICENSE.md", "croissant.json", "attribution.csv")
    assert {f"merge/{name}" for name in documents} <= set(results[0])


def test_a_selection_keeps_keys_bytes_and_only_the_rights_of_what_it_holds(tmp_path: Path) -> None:
    a = finished(tmp_path / "a", scenes(0))
    whole = given(scenes(0))
    rows = [
        (select(split="train"), [0, 1, 2, 3]),
        (select(split="test"), [4, 5]),
        (select(template="wall"), [1, 2, 4]),
        (select(min_noise_floor_db=39.0), [3, 4, 5]),
        (select(split="train", template="plane", min_noise_floor_db=37.0), [3]),
    ]
    for number, (derive, keys) in enumerate(rows):
        chosen = samples_of(shards_made(tmp_path / str(number), derive, a))
        assert chosen == {sample_key(key): whole[sample_key(key)] for key in keys}, derive
    train = made(tmp_path / "train", select(split="train"), a)
    assert [entry.uid for entry in read_objects_lock(train.folder.objects_lock)] == ["a"]
    assert 'license: "cc0-1.0"' in train.folder.card.read_text()
    assert "CC-BY-4.0" not in train.folder.attribution.read_text()


def test_resharding_divides_each_split_evenly_and_many_shards_stand_in_parts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two files in a folder stand for 4,096."""
    a = finished(tmp_path / "a", scenes(0))
    resharded = shards_made(tmp_path / "c", reshard(3), a)
    assert [(s.name, s.num_samples) for s in resharded.manifest.shards] == [
        ("train-000000.tar", 3), ("train-000001.tar", 1), ("test-000002.tar", 2),
    ]  # fmt: skip
    assert samples_of(resharded) == given(scenes(0))
    assert resharded.manifest.settings["splits"]["scenes_per_shard"] == 3
    back = shards_made(tmp_path / "d", reshard(2), tmp_path / "c")
    before = open_dataset(str(a)).manifest.shards
    assert [shard.sha256 for shard in back.manifest.shards] == [each.sha256 for each in before]
    monkeypatch.setattr(layout, "FILES_PER_FOLDER", 2)
    parts = shards_made(tmp_path / "e", reshard(1), tmp_path / "c")
    assert [shard.name for shard in parts.manifest.shards[1:4]] == [
        "train-000001.tar", "part-0001/train-000002.tar", "part-0001/train-000003.tar",
    ]  # fmt: skip
    assert samples_of(parts) == given(scenes(0))


def test_rejections_follow_their_scenes(tmp_path: Path) -> None:
    def failure(item: str, stage: str = "scenes") -> Failure:
        return Failure(stage=stage, item=item, reason="no_room", message="m")

    failures = [failure("000000001"), failure("000000005.1", "renders"), failure("e", "objects")]
    given_up = {name: of[:1] if "test" in name else of for name, of in scenes(0).items()}
    a = finished(tmp_path / "a", given_up, failures=failures)
    b = finished(tmp_path / "b", scenes(1), failures=failures[:1])
    merged = shards_made(tmp_path / "c", MERGE, a, b)
    items = [row.item for row in read_failures(merged.folder.failures)]
    assert items == ["e", "000000005.1", "000000001", "000000007"]  # 5 was given up in a
    assert "000000006" in samples_of(merged)
    chosen = shards_made(tmp_path / "d", select(template="wall"), a)
    assert [row.item for row in read_failures(chosen.folder.failures)] == ["e", "000000001"]


def test_objects_that_two_sources_prepared_otherwise_are_both_named(tmp_path: Path) -> None:
    """Two presets cut the same object to other budgets: one uid, two assets, one split."""
    a = finished(tmp_path / "a", scenes(0))
    rows = [
        dataclasses.replace(entry, asset_sha256=f"{number}" * 64)
        for number, entry in enumerate(read_objects_lock(a / "objects.lock.jsonl"))
    ]
    b = finished(tmp_path / "b", scenes(1), objects=rows)
    merged = shards_made(tmp_path / "c", MERGE, a, b)
    locked = read_objects_lock(merged.folder.objects_lock)
    assert [entry.uid for entry in locked] == ["a", "a", "c", "c"]
    shutil.rmtree(tmp_path / "c")
    assert shards_made(tmp_path / "c", MERGE, a, b).digest == merged.digest


def _textured(index: int, look: int) -> Sample:
    """Return a textured scene that no other index has."""
    scene = textured_scene(look, environment=sky())
    scene.vertex_positions[4:, 2] += 0.01 * index
    provenance = {**scene.provenance, "template": "textured"}
    plain = lit(index, 0, [])
    return dataclasses.replace(plain, scene=dataclasses.replace(scene, provenance=provenance))


def textured_scenes() -> dict[str, list[Sample]]:
    """Return a plain and a textured scene in one shard, and two of two looks in another."""
    return {
        "train-000000.tar": [lit(0, 3, []), _textured(1, 0)],
        "train-000001.tar": [_textured(2, 0), _textured(3, 1)],
    }


def maps_in(dataset: Dataset) -> list[list[str]]:
    """Return the names of the maps in each shard."""
    names = []
    for shard in dataset.manifest.shards:
        with dataset.open_shard(shard, checked=True) as opened:
            names.append(list(opened.maps))
    return names


def test_each_new_shard_has_once_the_maps_that_it_needs_and_no_other(tmp_path: Path) -> None:
    """By a selection, and by resharding."""
    a = finished(tmp_path / "a", textured_scenes())
    chosen = shards_made(tmp_path / "chosen", select(where=f'key == "{sample_key(3)}"'), a)
    held = [colour_texture(1).sha256, number_texture().sha256, sky().sha256]
    assert sorted(maps_in(chosen)[0]) == sorted(f"__map-{sha256}__" for sha256 in held)
    left = shards_made(tmp_path / "left", select(where='template == "plane"'), a)
    assert left.manifest.num_samples == 1 and maps_in(left) == [[]]
    whole = shards_made(tmp_path / "b", reshard(4), a)
    (shard,) = whole.manifest.shards
    assert [len(names) for names in maps_in(whole)] == [4]
    apart = shards_made(tmp_path / "c", reshard(1), a)
    assert [len(names) for names in maps_in(apart)] == [0, 3, 3, 3]
    assert samples_of(apart) == samples_of(whole) == given(textured_scenes())
    again = shards_made(tmp_path / "d", reshard(4), tmp_path / "c")
    assert [each.sha256 for each in again.manifest.shards] == [shard.sha256]


def test_staged_scenes_bring_their_maps_into_the_shard(tmp_path: Path) -> None:
    folder = DatasetFolder(tmp_path)
    samples = [textured_sample(sample_key(index), index // 2) for index in range(3)]
    staged = folder.staged_shard("train-000000.tar")
    for index, each in enumerate(samples):
        stage_scene(staged, index, each, [], "compact")
        assert read_staged_scene(staged, index)[0] == encode_sample(each, "compact")
    packed = pack_shard(folder, "train-000000.tar", range(3))
    assert len(open_shard(folder.shard(packed.name)).maps) == 4
    other = tmp_path / "train-000009.tar"
    write_shard(other, [(sample.key, encode_sample(sample, "compact")) for sample in samples])
    assert index_shard(other).sha256 == packed.sha256


def refused(out: Path, derive: DeriveOptions, *places: Path | str) -> str:
    """Return the message of a refusal that leaves nothing where the dataset would be."""
    with pytest.raises(TrilightError) as caught:
        derive_dataset([str(place) for place in places], derive, out)
    assert "\n" not in str(caught.value)
    assert not out.exists() and not list(out.parent.glob(".*"))
    return str(caught.value)


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
    shards_made(train_only, select(split="train"), a)
    shards_made(tmp_path / "c", MERGE, train_only, b)  # as the message advises


def test_the_same_scene_twice_is_refused(tmp_path: Path) -> None:
    a, b = finished(tmp_path / "a", scenes(0)), finished(tmp_path / "b", scenes(0), seed=1)
    assert "scene 000000000 of" in (message := refused(tmp_path / "c", MERGE, a, b))
    assert "expected each scene once" in message
    assert "expected each scene once" in refused(tmp_path / "c", MERGE, a, a)


def test_what_does_not_fit_together_is_named(tmp_path: Path) -> None:
    a = finished(tmp_path / "a", scenes(0))
    for group, field, value, name in (
        ("renders", "resolution", 32, "renders.resolution is 32; expected 16"),
        ("renders", "per_light", True, "renders.per_light is True; expected False"),
        ("storage", "passes", ["object"], "storage.passes is ['object']; expected False"),
    ):
        settings = {**SETTINGS, group: {**SETTINGS.get(group, {}), field: value}}
        b = finished(tmp_path / field, scenes(1), settings=settings)
        assert name in refused(tmp_path / "c", MERGE, a, b)
    other = finished(tmp_path / "other", scenes(1), num_views=3)
    assert "number of views is 3; expected 2" in refused(tmp_path / "c", MERGE, a, other)


def test_a_key_that_is_no_number_is_refused_before_a_shard_is_written(tmp_path: Path) -> None:
    odd = dataclasses.replace(lit(0, 2, ["a"]), key="chair")
    first = finished(tmp_path / "a", scenes(1))
    second = finished(tmp_path / "b", {"train-000000.tar": [odd]}, seed=1)
    out = DatasetFolder(tmp_path / "out")
    sources = [open_finished(str(place)) for place in (first, second)]
    with pytest.raises(TrilightError, match="'chair': expected a number as key"):
        derive_shards(sources, MERGE, out)
    assert not out.root.exists()


def test_damage_what_is_not_finished_and_what_holds_nothing_are_refused(tmp_path: Path) -> None:
    a, out, derive = finished(tmp_path / "a", scenes(0)), tmp_path / "c", reshard(3)
    assert "none of the 6 scenes" in refused(out, select(template="no"), a)
    with pytest.raises(TrilightError, match="split is 'tset'; expected"):
        Selection(split="tset")  # type: ignore[arg-type]
    manifest = open_dataset(str(a)).manifest
    write_manifest(a / "manifest.json", dataclasses.replace(manifest, num_scenes=7))
    assert "3 of 4 shards" in refused(out, derive, a)
    write_manifest(a / "manifest.json", manifest)
    shard = a / "train-000001.tar"
    data = bytearray(shard.read_bytes())
    data[len(data) // 2] ^= 1
    shard.write_bytes(data)
    assert "sha256 differs" in refused(out, derive, a)
    shard.unlink()
    assert "missing" in refused(out, derive, a)
    (a / "objects.lock.jsonl").write_bytes(b"")
    assert "objects.lock.jsonl" in refused(out, derive, a)
    assert "no such folder" in refused(out, derive, tmp_path / "nowhere")
    assert "on this machine" in refused(out, derive, "https://u:secret@example.org/a?token=x")
    assert "secret" not in refused(out, derive, "https://u:secret@example.org/a?token=x")


def test_a_column_that_is_not_declared_here_is_no_damage(tmp_path: Path) -> None:
    with declared(COAT):
        coated = toy_sample(0)
        coated.scene.materials[0, -1] = 0.5
        a = finished(tmp_path / "a", {"train-000000.tar": [coated]})
    said = refused(tmp_path / "b", select(where="lights_per_scene > 0"), a)
    assert "'coat' is not declared here" in said and "damaged" not in said


KILLED = """
import sys
from pathlib import Path
from pipeline.generation import derive_dataset as flow
from pipeline.generation.derive_dataset import DeriveOptions

def stop(done, total):
    if done > 4:  # three are read, one is written
        print("here", flush=True)
        import time
        time.sleep(60)

derive = DeriveOptions(operation="reshard", scenes_per_shard=3)
flow.derive_dataset([sys.argv[1]], derive, Path(sys.argv[2]), progress=stop)
"""


def test_a_kill_leaves_no_dataset_the_next_run_makes_it_and_no_other_changes_it(
    tmp_path: Path,
) -> None:
    a, out, derive = finished(tmp_path / "a", scenes(0)), tmp_path / "c", reshard(3)
    run = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(a), str(out)], stdout=subprocess.PIPE, text=True
    )
    assert run.stdout is not None and run.stdout.readline() == "here\n"
    with pytest.raises(TrilightError, match="another process"):
        derive_dataset([str(a)], derive, out)
    os.kill(run.pid, signal.SIGKILL)
    run.wait()
    assert not out.exists()
    assert list(tmp_path.glob(".c.part/*.tar"))
    (tmp_path / ".c.part" / "train-000009.tar").write_bytes(b"of a larger one")
    out.mkdir()
    derive_dataset([str(a)], derive, out)  # an empty folder is no reason to refuse
    assert verify_dataset(out).problems == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "c"]
    with pytest.raises(TrilightError, match="is there already"):
        derive_dataset([str(a)], derive, out)
    with pytest.raises(TrilightError, match=r"made by `trilight shards reshard`.*cannot grow"):
        begin_tiny(out)
