"""Textures and maps travel with their samples: merge, select, reshard, staging and packing."""

import dataclasses
from pathlib import Path

from pipeline.shards.derive import Derive
from pipeline.shards.pack import pack_shard
from pipeline.shards.plans import Selection
from storage.dataset.dataset import Dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import index_shard
from storage.dataset.shard import contents_of, write_shard
from storage.dataset.staging import read_staged_scene, stage_scene
from storage.records.sample import Sample, encode_sample, sample_key
from tests.pipeline.making.derive_kit import finished, lit, scenes
from tests.pipeline.making.test_derive_dataset import MERGE, given, samples_of, shards_made
from tests.textured_by_hand import (
    colour_texture,
    number_texture,
    sky,
    textured_sample,
    textured_scene,
)


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
        with dataset.files.open(shard, checked=True) as stream:
            names.append(list(contents_of(stream, shard.name).maps))
    return names


def test_a_merge_carries_maps_and_knows_what_it_has(tmp_path: Path) -> None:
    a = finished(tmp_path / "a", textured_scenes())
    b = finished(tmp_path / "b", scenes(1), seed=1)
    merged = shards_made(tmp_path / "c", MERGE, b, a)
    expected = {**given(scenes(1)), **given(textured_scenes(), offset=6)}
    found = samples_of(merged)
    assert sorted(found) == sorted(expected)
    assert {key: members for key, (_, members) in found.items()} == {
        key: members for key, (_, members) in expected.items()
    }


def test_a_selection_takes_the_maps_that_it_needs_and_no_other(tmp_path: Path) -> None:
    a = finished(tmp_path / "a", textured_scenes())
    chosen = Derive(operation="select", selection=Selection(where=f'key == "{sample_key(3)}"'))
    made = shards_made(tmp_path / "b", chosen, a)
    held = [colour_texture(1).sha256, number_texture().sha256, sky().sha256]
    assert sorted(maps_in(made)[0]) == sorted(f"__map-{sha256}__" for sha256 in held)
    plain = Derive(operation="select", selection=Selection(where='template == "plane"'))
    left = shards_made(tmp_path / "c", plain, a)
    assert left.manifest.num_samples == 1 and maps_in(left) == [[]]


def test_resharding_stores_each_map_once_in_each_new_shard(tmp_path: Path) -> None:
    a = finished(tmp_path / "a", textured_scenes())
    whole = shards_made(tmp_path / "b", Derive(operation="reshard", scenes_per_shard=4), a)
    (shard,) = whole.manifest.shards
    assert [len(names) for names in maps_in(whole)] == [4]
    apart = shards_made(tmp_path / "c", Derive(operation="reshard", scenes_per_shard=1), a)
    assert [len(names) for names in maps_in(apart)] == [0, 3, 3, 3]
    assert samples_of(apart) == samples_of(whole) == given(textured_scenes())
    again = shards_made(
        tmp_path / "d", Derive(operation="reshard", scenes_per_shard=4), tmp_path / "c"
    )
    assert [each.sha256 for each in again.manifest.shards] == [shard.sha256]


def test_staged_scenes_bring_their_maps_into_the_shard(tmp_path: Path) -> None:
    folder = DatasetFolder(tmp_path)
    samples = [textured_sample(sample_key(index), index // 2) for index in range(3)]
    staged = folder.staged_shard("train-000000.tar")
    for index, sample in enumerate(samples):
        stage_scene(staged, index, sample, [], "compact")
        assert read_staged_scene(staged, index).members == encode_sample(sample, "compact")
    packed = pack_shard(folder, "train-000000.tar", range(3))
    with folder.shard(packed.name).open("rb") as stream:
        assert len(contents_of(stream, packed.name).maps) == 4
    other = tmp_path / "train-000009.tar"
    write_shard(other, [(sample.key, encode_sample(sample, "compact")) for sample in samples])
    assert index_shard(other).sha256 == packed.sha256
