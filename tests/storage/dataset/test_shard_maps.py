"""Textures and maps in shards: once each, unseen by strangers, there for every reader of ours."""

import dataclasses
import io
import re
import tarfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.manifest import index_shard, write_manifest
from storage.dataset.shard import contents_of, iterate_samples, read_members, write_shard, write_tar
from storage.dataset.statistics import dataset_statistics
from storage.dataset.training_data import open_training_data
from storage.dataset.verify import verify_dataset
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.records.map_references import MAP_NAME, map_member
from storage.records.packed_maps import pack_environment
from storage.records.sample import Sample, decode_scene, encode_sample, sample_key
from tests.pipeline.documents.dataset_by_hand import edit_manifest, write_dataset
from tests.scenes_by_hand import tiny_sample
from tests.textured_by_hand import colour_texture, number_texture, sky, textured_sample

TRAIN = "train-000000.tar"
MAPS = {
    "colours": map_member(colour_texture().sha256),
    "other colours": map_member(colour_texture(1).sha256),
    "roughness": map_member(number_texture().sha256),
    "sky": map_member(sky().sha256),
}


def four_samples() -> list[Sample]:
    """Return a plain sample, two of one look, and one with other colours and no sky."""
    return [
        tiny_sample(sample_key(0)),
        textured_sample(sample_key(1)),
        textured_sample(sample_key(2)),
        textured_sample(sample_key(3), 1, environment=None),
    ]


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    made = write_dataset(
        tmp_path, {TRAIN: four_samples(), "test-000001.tar": [textured_sample(sample_key(4))]}
    )
    digest = sha256_hex(made.folder.objects_lock.read_bytes())
    return open_dataset(str(edit_manifest(made, objects_lock_sha256=digest)))


def names_in(path: Path) -> list[str]:
    with tarfile.open(path) as archive:
        return archive.getnames()


def test_each_map_stands_once_before_the_first_sample_that_uses_it(dataset: Dataset) -> None:
    shard = dataset.folder.shard(TRAIN)
    names = names_in(shard)
    assert sorted(name for name in names if MAP_NAME.fullmatch(name)) == sorted(MAPS.values())
    places = {what: names.index(name) for what, name in MAPS.items()}
    first = {key: names.index(f"{sample_key(key)}.json") for key in range(4)}
    assert places["other colours"] > first[2] and places["other colours"] < first[3]
    for what in ("colours", "roughness", "sky"):
        assert first[0] < places[what] < first[1]
    assert index_shard(shard).num_samples == 4
    with shard.open("rb") as stream:
        contents = contents_of(stream, TRAIN)
    assert list(contents.samples) == [sample_key(key) for key in range(4)]
    data = shard.read_bytes()
    for name, held in contents.maps.items():
        with tarfile.open(shard) as archive:
            member = archive.extractfile(name)
            assert member is not None
            assert data[held.offset : held.offset + held.num_bytes] == member.read()


def test_equal_samples_give_equal_files_in_any_order_of_members(tmp_path: Path) -> None:
    samples = [(sample.key, encode_sample(sample)) for sample in four_samples()]
    for name in ("a.tar", "b.tar"):
        write_shard(tmp_path / name, [(key, dict(reversed(m.items()))) for key, m in samples])
    assert (tmp_path / "a.tar").read_bytes() == (tmp_path / "b.tar").read_bytes()
    assert list(iterate_samples(tmp_path / "a.tar")) == samples


def test_stock_webdataset_sees_samples_as_before(dataset: Dataset) -> None:
    """Every member of every sample, and nothing of the maps; decoding and batching work."""
    import webdataset

    url = str(dataset.folder.shard(TRAIN))
    read = list(webdataset.WebDataset(url, shardshuffle=False).decode())
    assert [each["__key__"] for each in read] == [sample_key(key) for key in range(4)]
    for each in read:
        own = {name for name in each if not name.startswith("__")}
        assert own == {"0.exr", "1.exr", "json", "scene.safetensors"}
    pairs = webdataset.WebDataset(url, shardshuffle=False).to_tuple("0.exr", "json").batched(4)
    ((pictures, records),) = list(pairs)
    assert len(pictures) == len(records) == 4


@pytest.mark.slow("every")
def test_stock_datasets_sees_samples_as_before(dataset: Dataset, tmp_path: Path) -> None:
    """Hugging Face's reader skips names without a point."""
    load_dataset = pytest.importorskip("datasets").load_dataset
    read = load_dataset(
        "webdataset",
        data_files=str(dataset.folder.shard(TRAIN)),
        split="train",
        streaming=True,
        cache_dir=str(tmp_path / "cache"),
    )
    assert [each["__key__"] for each in read] == [sample_key(key) for key in range(4)]


def looks(sample: Sample) -> list[str]:
    scene = sample.scene
    names = [texture.sha256 for texture in scene.textures]
    return [*names, "" if scene.environment is None else scene.environment.sha256]


def test_every_reader_finds_the_maps(dataset: Dataset) -> None:
    expected = [looks(sample) for sample in four_samples()]
    (shard,) = dataset.shards_of("train")
    whole = list(dataset.read_shard(shard))
    assert [looks(sample) for sample in whole] == expected
    assert [encode_sample(each) for each in whole] == [encode_sample(s) for s in four_samples()]
    scenes = list(dataset.read_scenes(shard))
    assert [scene.scene.textures[0].sha256 for scene in scenes[1:]] == [e[0] for e in expected[1:]]
    by_key = list(dataset.read_samples(shard, [sample_key(3), sample_key(2)]))
    assert [looks(sample) for sample in by_key] == [expected[3], expected[2]]
    path = dataset.folder.shard(TRAIN)
    record = decode_scene(
        sample_key(3), read_members(path, sample_key(3), ("json", "scene.safetensors"))
    )
    assert record.scene.textures[0].sha256 == expected[3][0]
    for data in ([str(dataset.folder.root)], [str(path)]):
        opened = open_training_data(data).split("train").open(0)
        assert [looks(opened.sample(row)) for row in (3, 2, 0)] == [
            expected[row] for row in (3, 2, 0)
        ]
        opened.close()


def test_members_that_are_asked_for_alone_bring_no_map(dataset: Dataset) -> None:
    path = dataset.folder.shard(TRAIN)
    assert set(read_members(path, sample_key(1), ["0.exr"])) == {"0.exr"}


def test_the_scene_digest_tells_textures_apart(tmp_path: Path) -> None:
    digests = set()
    for row, sample in enumerate([textured_sample(), textured_sample(seed=1), tiny_sample()]):
        made = write_dataset(tmp_path / str(row), {TRAIN: [sample]})
        digests.add(dataset_statistics(made).scene_digest)
    assert len(digests) == 3


def repacked(dataset: Dataset, change: Callable[[dict[str, bytes]], object]) -> list[str]:
    """Return what is wrong with the dataset after its train shard was written with a change."""
    (entry,) = dataset.shards_of("train")
    path = dataset.folder.shard(TRAIN)
    samples = list(iterate_samples(path))
    for _, members in samples:
        change(members)
    path.unlink()
    write_shard(path, samples)
    shards = (index_shard(path), *dataset.shards_of("test"))
    write_manifest(dataset.folder.manifest, dataclasses.replace(dataset.manifest, shards=shards))
    assert entry.name == TRAIN
    return list(verify_dataset(dataset.folder.root).problems)


def test_a_whole_dataset_has_no_fault(dataset: Dataset) -> None:
    for fast in (False, True):
        assert verify_dataset(dataset.folder.root, fast=fast).problems == []


def test_a_missing_map_is_a_finding(dataset: Dataset) -> None:
    problems = repacked(dataset, lambda members: members.pop(MAPS["roughness"], None))
    assert [line.split(": ")[1] for line in problems] == [
        f"sample {sample_key(k)}" for k in (1, 2, 3)
    ]
    assert all("is missing; expected a member __map-" in line for line in problems)


def test_a_map_of_other_content_is_a_finding(dataset: Dataset) -> None:
    def change(members: dict[str, bytes]) -> None:
        if MAPS["colours"] in members:
            members[MAPS["colours"]] = members[MAPS["roughness"]]

    problems = repacked(dataset, change)
    assert len(problems) == 2 and "has the content" in problems[0]


def _with_sky(value: float) -> Callable[[dict[str, bytes]], None]:
    """Return a change to a sky of one wrong value, named as its content is."""
    other = sky(radiance_rgb=np.full((2, 4, 3), value, np.float32))

    def change(members: dict[str, bytes]) -> None:
        if members.pop(MAPS["sky"], None) is not None:
            members["json"] = members["json"].replace(sky().sha256.encode(), other.sha256.encode())
            members[map_member(other.sha256)] = pack_environment(other)

    return change


def _with_bytes(name: str, damage: Callable[[bytes], bytes]) -> Callable[[dict[str, bytes]], None]:
    def change(members: dict[str, bytes]) -> None:
        if name in members:
            members[name] = damage(members[name])

    return change


DAMAGED: dict[str, tuple[Callable[[dict[str, bytes]], None], str]] = {
    "cut": (_with_bytes(MAPS["sky"], lambda data: data[:-10]), "cut short"),
    "a byte in the middle": (
        _with_bytes(MAPS["sky"], lambda data: data[:60] + b"\xff" + data[61:]), "damaged"
    ),
    "no map at all": (_with_bytes(MAPS["sky"], lambda data: b"\0" * len(data)), "damaged"),
    "another sky under its name": (
        _with_bytes(MAPS["sky"], lambda _: pack_environment(sky(1))), "has the content"
    ),
    "NaN": (_with_sky(np.nan), r"radiance_rgb\[0, 0, 0\] is nan; expected finite"),
    "negative radiance": (_with_sky(-1.0), r"is -1\.; expected finite values from 0"),
    "radiance beyond all suns": (_with_sky(1e10), "expected finite values from 0 to 1e"),
}  # fmt: skip


@pytest.mark.parametrize("name", DAMAGED)
def test_a_wrong_sky_is_a_finding_of_each_sample_that_has_it(dataset: Dataset, name: str) -> None:
    """Of those that read for people too: `inspect` ends with one line that names the sample."""
    change, message = DAMAGED[name]
    problems = repacked(dataset, change)
    assert [line.split(": ")[1] for line in problems] == [f"sample {sample_key(k)}" for k in (1, 2)]
    assert all(re.search(message, line) for line in problems), problems
    with pytest.raises(TrilightError, match="trilight verify") as caught:
        list(open_dataset(str(dataset.folder.root)).scenes())
    assert re.search(message, str(caught.value)) and sample_key(1) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_map_that_nobody_uses_is_a_finding(dataset: Dataset) -> None:
    def change(members: dict[str, bytes]) -> None:
        members[map_member("0" * 64)] = b"x"

    problems = repacked(dataset, change)
    assert problems == [f"{TRAIN}: map {map_member('0' * 64)} is used by no sample"]


def test_a_map_twice_or_behind_its_sample_is_refused(tmp_path: Path) -> None:
    members = encode_sample(textured_sample())
    name = MAPS["sky"]
    late = {suffix: data for suffix, data in members.items() if suffix != name}

    def tar(*entries: tuple[str, bytes]) -> Path:
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.tar"
        with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as archive:
            for entry, data in entries:
                info = tarfile.TarInfo(entry)
                info.size = len(data)
                archive.addfile(info, io.BytesIO(data))
        return path

    with pytest.raises(TrilightError, match=f"member {name} occurs twice"):
        list(iterate_samples(tar((name, b"a"), (name, b"a"))))
    own = [(f"{sample_key(0)}.{s}", d) for s, d in late.items() if not MAP_NAME.fullmatch(s)]
    others = [(s, d) for s, d in late.items() if MAP_NAME.fullmatch(s)]
    ((key, read),) = iterate_samples(tar(*others, *own, (name, members[name])))
    with pytest.raises(TrilightError, match="is missing; expected a member __map-"):
        decode_scene(key, read)
    with pytest.raises(TrilightError, match=f"sample {sample_key(0)} occurs twice"):
        list(iterate_samples(tar(*others, *own[:2], (name, b"a"), *own[2:])))


def test_plain_samples_are_written_as_by_webdataset_itself(tmp_path: Path) -> None:
    """Not a byte, and not a member, comes in with the code for maps."""
    from webdataset.writer import TarWriter

    samples = [(sample_key(k), encode_sample(tiny_sample(sample_key(k), seed=k))) for k in (0, 1)]
    ours, theirs = io.BytesIO(), io.BytesIO()
    write_tar(ours, samples)
    with TarWriter(theirs, encoder=False, mtime=0, user="trilight", group="trilight") as writer:
        for key, members in samples:
            writer.write({"__key__": key, **members})
    assert ours.getvalue() == theirs.getvalue()
