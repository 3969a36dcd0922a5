"""Shards: reproducible bytes, atomic appearance, and a reader that trusts nothing."""

import io
import tarfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from storage.atomic import atomic_writer, remove_leftovers
from storage.dataset.dataset import Dataset
from storage.dataset.manifest import index_shard
from storage.dataset.shard import (
    contents_of,
    iterate_samples,
    read_members,
    scan_members,
    write_shard,
    write_tar,
)
from storage.dataset.training_data import open_training_data
from storage.digests import sha256_of_file
from storage.errors import TrilightError
from storage.records.map_references import MAP_NAME, map_member
from storage.records.profiles import PROFILES, Profile, keeps_law
from storage.records.sample import Sample, decode_scene, encode_sample, sample_key
from storage.records.scene_file import encode_arrays
from tests.for_each import for_each
from tests.pipeline.documents.dataset_by_hand import write_dataset
from tests.scenes_by_hand import tiny_sample
from tests.textured_by_hand import colour_texture, number_texture, sky, textured_sample

MEMBERS = {"json": b"{}", "scene.safetensors": b"abc", "0.exr": b"x" * 1000}


def _tar(path: Path, entries: Iterable[tarfile.TarInfo | tuple[str, bytes]]) -> Path:
    with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as archive:
        for entry in entries:
            if isinstance(entry, tarfile.TarInfo):
                archive.addfile(entry)
            else:
                info = tarfile.TarInfo(entry[0])
                info.size = len(entry[1])
                archive.addfile(info, io.BytesIO(entry[1]))
    return path


def test_bytes_are_pinned(tmp_path: Path) -> None:
    """A new library that writes other bytes would change every dataset digest: notice it here."""
    write_shard(tmp_path / "pinned.tar", [("000000000", MEMBERS)])
    assert sha256_of_file(tmp_path / "pinned.tar") == PINNED


PINNED = "34fe3b8b9ef7e13f706ad65041b050257f8fafe56d80fb5364e220a7f4e3a41c"


@for_each("profile", PROFILES)
def test_stock_webdataset_reads_a_shard(tmp_path: Path, profile: Profile) -> None:
    """In three lines, which stand in docs/reference/formats.md; it undoes `.gz` by itself."""
    import OpenEXR
    import webdataset
    from safetensors.numpy import load

    sample = tiny_sample()
    url = str(tmp_path / "train-000000.tar")
    write_shard(tmp_path / "train-000000.tar", [(sample.key, encode_sample(sample, profile))])

    for read in webdataset.WebDataset(url, shardshuffle=False).decode():
        arrays = load(read["scene.safetensors.gz" if profile == "compact" else "scene.safetensors"])
        picture = OpenEXR.File(io.BytesIO(read["0.exr"])).channels()["RGB"].pixels

        assert read["__key__"] == sample.key
        assert read["json"]["objects"][0]["name"] == "floor"
        assert np.array_equal(arrays["vertex_positions"], sample.scene.vertex_positions)
        assert keeps_law(sample.radiance_rgb[0], picture.astype(np.float32), 41.5)


@for_each("kept_blocks", range(1, 20))
def test_a_shard_cut_at_any_block_is_refused(tmp_path: Path, kept_blocks: int) -> None:
    whole, cut = tmp_path / "whole.tar", tmp_path / "cut.tar"
    write_shard(whole, [("000000000", MEMBERS), ("000000001", MEMBERS)])
    content = whole.read_bytes().rstrip(b"\0")
    cut.write_bytes(content[: min(kept_blocks * 512, len(content))])
    with pytest.raises(TrilightError, match=r"cut\.tar"):
        list(iterate_samples(cut))


def _link(kind: bytes) -> tarfile.TarInfo:
    info = tarfile.TarInfo("000000000.json")
    info.type, info.linkname = kind, "/etc/passwd"
    return info


HOSTILE = {
    "path": [("../000000000.json", b"{}")],
    "absolute path": [("/tmp/000000000.json", b"{}")],
    "folder": [("a/000000000.json", b"{}")],
    "no suffix": [("README", b"")],
    "symbolic link": [_link(tarfile.SYMTYPE)],
    "hard link": [_link(tarfile.LNKTYPE)],
    "device": [_link(tarfile.CHRTYPE)],
    "member twice": [("000000000.json", b"{}"), ("000000000.json", b"{}")],
    "sample in two places": [("0.json", b"{}"), ("1.json", b"{}"), ("0.exr", b"")],
}


@for_each("entries", HOSTILE.values())
def test_hostile_members_are_refused(
    tmp_path: Path, entries: list[tarfile.TarInfo | tuple[str, bytes]]
) -> None:
    with pytest.raises(TrilightError, match="refused|twice"):
        list(iterate_samples(_tar(tmp_path / "hostile.tar", entries)))


def test_a_member_that_claims_too_much_is_refused(tmp_path: Path) -> None:
    info = tarfile.TarInfo("000000000.json")
    info.size = 1 << 40
    (tmp_path / "bomb.tar").write_bytes(info.tobuf(tarfile.GNU_FORMAT) + b"{}")
    with pytest.raises(TrilightError, match="claims"):
        list(iterate_samples(tmp_path / "bomb.tar"))


def test_a_failed_write_leaves_what_was_there_and_leftovers_go(tmp_path: Path) -> None:
    path, leftover = tmp_path / "file", tmp_path / "folder" / "a.tar.123.part"
    path.write_bytes(b"before")
    with pytest.raises(ZeroDivisionError), atomic_writer(path) as stream:
        stream.write(b"half")
        raise ZeroDivisionError
    assert path.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [path]
    leftover.parent.mkdir()
    leftover.write_bytes(b"half")
    remove_leftovers(tmp_path)
    assert not leftover.exists()
    assert path.exists()


@for_each("place", ["/proc/nowhere/file", "/dev/null/file"])
def test_an_unwritable_place_is_one_clear_line(place: str) -> None:
    with pytest.raises(TrilightError, match="cannot write file"), atomic_writer(Path(place)):
        pass


@settings(deadline=None)  # a busy machine is no failure
@given(
    st.from_regex(r"[0-9a-z]{1,30}\.[a-z]{1,30}", fullmatch=True),
    st.integers(0, 1 << 40),
    st.booleans(),
    st.integers(0, 511),
)
def test_headers_are_read_as_tarfile_reads_them(name: str, size: int, gnu: bool, at: int) -> None:
    """And one in which a byte has changed is refused, wherever it is."""
    member = tarfile.TarInfo(name)
    member.size = size if gnu else size % (1 << 33)
    header = bytearray(member.tobuf(tarfile.GNU_FORMAT if gnu else tarfile.USTAR_FORMAT))
    try:
        (found,) = scan_members(io.BytesIO(header + bytes(1024)), "x")
    except TrilightError as error:
        assert f"claims {member.size} bytes" in str(error) or "is cut short" in str(error)
    else:
        assert (f"{found.key}.{found.suffix}", found.num_bytes) == (name, 0) == (name, member.size)
    header[at] ^= 0x04  # in the sum's own field, 4 turns digits into digits and spaces into $
    with pytest.raises(TrilightError):
        list(scan_members(io.BytesIO(header + bytes(1024)), "x"))


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
    test = [textured_sample(sample_key(4))]
    return write_dataset(tmp_path, {TRAIN: four_samples(), "test-000001.tar": test})


def test_headers_find_every_member_and_each_map_once_before_its_first_sample(
    dataset: Dataset,
) -> None:
    shard = dataset.folder.shard(TRAIN)
    data = shard.read_bytes()
    with tarfile.open(shard) as archive:
        stored = {name: archive.extractfile(name) for name in archive.getnames()}
        expected = {name: member.read() for name, member in stored.items() if member is not None}
    names = list(expected)
    assert sorted(name for name in names if MAP_NAME.fullmatch(name)) == sorted(MAPS.values())
    places = {what: names.index(name) for what, name in MAPS.items()}
    first = {key: names.index(f"{sample_key(key)}.json") for key in range(4)}
    assert places["other colours"] > first[2] and places["other colours"] < first[3]
    for what in ("colours", "roughness", "sky"):
        assert first[0] < places[what] < first[1]
    entry = index_shard(shard)
    assert (entry.split, entry.num_samples, entry.num_bytes) == ("train", 4, len(data))
    with shard.open("rb") as stream:
        contents = contents_of(stream, TRAIN)
        stream.seek(0)
        members = {each.name: each for each in scan_members(stream, TRAIN)}
    assert list(contents.samples) == [sample_key(key) for key in range(4)]
    assert members.keys() == expected.keys() and set(contents.maps) == set(MAPS.values())
    for name, held in [*members.items(), *contents.maps.items()]:
        assert data[held.offset : held.offset + held.num_bytes] == expected[name]


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
    samples = four_samples()
    expected = [looks(sample) for sample in samples]
    (shard,) = dataset.shards_of("train")
    whole = list(dataset.read_shard(shard))
    assert [looks(sample) for sample in whole] == expected
    assert [encode_sample(each) for each in whole] == [encode_sample(each) for each in samples]
    for scene, sample in zip(dataset.read_scenes(shard), samples, strict=True):
        assert (scene.key, scene.views) == (sample.key, sample.views)
        assert encode_arrays(scene.scene) == encode_arrays(sample.scene)
        assert [t.sha256 for t in scene.scene.textures] == [t.sha256 for t in sample.scene.textures]
    by_key = list(dataset.read_samples(shard, [sample_key(3), sample_key(2)]))
    assert [encode_sample(each) for each in by_key] == [encode_sample(samples[k]) for k in (3, 2)]
    path = dataset.folder.shard(TRAIN)
    key = sample_key(3)
    record = decode_scene(key, read_members(path, key, ("json", "scene.safetensors")))
    assert record.scene.textures[0].sha256 == expected[3][0]
    assert set(read_members(path, sample_key(1), ["0.exr"])) == {"0.exr"}, "and no map"
    for data in ([str(dataset.folder.root)], [str(path)]):
        opened = open_training_data(data).split("train").open(0)
        found = [looks(opened.sample(row)) for row in (3, 2, 0)]
        assert found == [expected[row] for row in (3, 2, 0)]
        opened.close()


def test_a_map_twice_or_behind_its_sample_is_refused(tmp_path: Path) -> None:
    members = encode_sample(textured_sample())
    name, path = MAPS["sky"], tmp_path / "a.tar"
    late = {suffix: data for suffix, data in members.items() if suffix != name}
    with pytest.raises(TrilightError, match=f"member {name} occurs twice"):
        list(iterate_samples(_tar(path, [(name, b"a"), (name, b"a")])))
    own = [(f"{sample_key(0)}.{s}", d) for s, d in late.items() if not MAP_NAME.fullmatch(s)]
    others = [(s, d) for s, d in late.items() if MAP_NAME.fullmatch(s)]
    ((key, read),) = iterate_samples(_tar(path, [*others, *own, (name, members[name])]))
    with pytest.raises(TrilightError, match="is missing; expected a member __map-"):
        decode_scene(key, read)
    with pytest.raises(TrilightError, match=f"sample {sample_key(0)} occurs twice"):
        list(iterate_samples(_tar(path, [*others, *own[:2], (name, b"a"), *own[2:]])))


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
