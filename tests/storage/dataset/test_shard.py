"""Shards: reproducible bytes, atomic appearance, and a reader that trusts nothing.

Lists and brace patterns of shards: what they stand for, and what is never opened or run.
"""

import io
import os
import re
import shutil
import sys
import tarfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from infra.cli.options import value_of
from storage.atomic import atomic_writer, remove_leftovers
from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.layout import dataset_folder
from storage.dataset.manifest import index_shard
from storage.dataset.settings import SplitSettings
from storage.dataset.shard import open_shard, scan_members, write_shard
from storage.dataset.shard_set import expand_pattern, listed_shards
from storage.dataset.splits import shard_name
from storage.dataset.training_data import open_training_data
from storage.digests import sha256_of_file
from storage.errors import TrilightError
from storage.records.packed_maps import MAP_NAME, map_member
from storage.records.profiles import PROFILES, Profile, keeps_law
from storage.records.sample import Sample, decode_scene, encode_sample, sample_key
from storage.records.scene_file import encode_arrays
from storage.remote.url import parse_local_path
from tests.conftest import ROOT
from tests.for_each import case, for_each
from tests.hostile.cases import tar_of
from tests.pipeline.documents.dataset_by_hand import five_scenes, write_dataset
from tests.scenes_by_hand import tiny_sample
from tests.textured_by_hand import colour_texture, number_texture, sky, textured_sample

MEMBERS = {"json": b"{}", "scene.safetensors": b"abc", "0.exr": b"x" * 1000}


def _tar(path: Path, entries: Iterable[tuple[str, bytes]]) -> Path:
    path.write_bytes(tar_of(entries))
    return path


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
        list(open_shard(cut))


def test_members_without_a_suffix_twice_or_behind_their_sample_are_refused(tmp_path: Path) -> None:
    """Kinds of members, their paths and sizes are those of tests/hostile/cases.py."""
    for names in (("README",), ("0.json", "0.json"), ("0.json", "1.json", "0.exr")):
        with case(names), pytest.raises(TrilightError, match="refused|twice"):
            list(open_shard(_tar(tmp_path / "hostile.tar", [(name, b"") for name in names])))
    members = encode_sample(textured_sample())
    name, path = MAPS["sky"], tmp_path / "a.tar"
    late = {suffix: data for suffix, data in members.items() if suffix != name}
    with pytest.raises(TrilightError, match=f"member {name} occurs twice"):
        list(open_shard(_tar(path, [(name, b"a"), (name, b"a")])))
    own = [(f"{sample_key(0)}.{s}", d) for s, d in late.items() if not MAP_NAME.fullmatch(s)]
    others = [(s, d) for s, d in late.items() if MAP_NAME.fullmatch(s)]
    ((key, read),) = open_shard(_tar(path, [*others, *own, (name, members[name])]))
    with pytest.raises(TrilightError, match="is missing; expected a member __map-"):
        decode_scene(key, read)
    with pytest.raises(TrilightError, match=f"sample {sample_key(0)} occurs twice"):
        list(open_shard(_tar(path, [*others, *own[:2], (name, b"a"), *own[2:]])))


def test_a_failed_write_leaves_what_was_there_and_leftovers_go(tmp_path: Path) -> None:
    path, leftover = tmp_path / "file", tmp_path / "folder" / "a.tar.123.part"
    path.write_bytes(b"before")
    with pytest.raises(ZeroDivisionError), atomic_writer(path) as stream:
        stream.write(b"half")
        raise ZeroDivisionError
    with pytest.raises(TrilightError, match="/dev/null is a file"):
        atomic_writer(Path("/dev/null/x")).__enter__()
    assert path.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [path]
    leftover.parent.mkdir()
    leftover.write_bytes(b"half")
    remove_leftovers(tmp_path)
    assert not leftover.exists()
    assert path.exists()


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


def test_headers_find_every_member_and_each_map_before_its_first_sample(dataset: Dataset) -> None:
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
        members = {each.name: each for each in scan_members(stream, TRAIN)}
    contents = open_shard(shard)
    assert list(contents.samples) == [sample_key(key) for key in range(4)]
    assert members.keys() == expected.keys() and set(contents.maps) == set(MAPS.values())
    for name, held in [*members.items(), *contents.maps.items()]:
        assert data[held.offset : held.offset + held.num_bytes] == expected[name]


PINNED = "34fe3b8b9ef7e13f706ad65041b050257f8fafe56d80fb5364e220a7f4e3a41c"


def test_equal_samples_give_equal_files_in_any_order_of_members(tmp_path: Path) -> None:
    """A new library that writes other bytes would change every dataset digest: notice it here."""
    write_shard(tmp_path / "pinned.tar", [("000000000", MEMBERS)])
    assert sha256_of_file(tmp_path / "pinned.tar") == PINNED
    samples = [(sample.key, encode_sample(sample)) for sample in four_samples()]
    for name in ("a.tar", "b.tar"):
        write_shard(tmp_path / name, [(key, dict(reversed(m.items()))) for key, m in samples])
    assert (tmp_path / "a.tar").read_bytes() == (tmp_path / "b.tar").read_bytes()
    assert list(open_shard(tmp_path / "a.tar")) == samples


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
    with open_shard(path) as shard_of_path:
        record = decode_scene(key, shard_of_path.members(key, lambda name: "exr" not in name))
        alone = shard_of_path.members(sample_key(1), "0.exr".__eq__)
    assert record.scene.textures[0].sha256 == expected[3][0]
    assert set(alone) == {"0.exr"}, "and no map"
    for data in ([str(dataset.folder.root)], [str(path)]):
        opened = open_training_data(data).split("train").open(0)
        found = [looks(opened.sample(row)) for row in (3, 2, 0)]
        assert found == [expected[row] for row in (3, 2, 0)]
        opened.close()


def test_patterns_and_quoted_ones_name_shards_that_a_dataset_has() -> None:
    for pattern, names in [
        ("a.tar", ["a.tar"]),
        ("a-{08..11}.tar", ["a-08.tar", "a-09.tar", "a-10.tar", "a-11.tar"]),
        ("{a,b}-{1..2}.tar", ["a-1.tar", "a-2.tar", "b-1.tar", "b-2.tar"]),
        ("a{,x}.tar", ["a.tar", "ax.tar"]),
        ("{7..7}", ["7"]),
    ]:
        with case(pattern):
            assert expand_pattern(pattern) == names
    splits = SplitSettings(scenes_per_shard=4)
    for quoting in ("docs/how-to/train-and-evaluate.md", "infra/train_options.py"):
        (pattern,) = re.findall(r"\w+://\S+\.tar\b", (ROOT / quoting).read_text())
        for name in (each.rpartition("/")[2] for each in expand_pattern(pattern)):
            assert name == shard_name(int(name[-10:-4]), splits)


def test_what_is_refused_and_roots_and_shards_are_not_mixed(tmp_path: Path) -> None:
    for patterns, message in [
        (["pipe:touch x; echo a.tar"], "pipe: command"),
        (["http://h/a.tar::http://h/b.tar"], "chained"),
        (["http://h/{a,b::c}.tar"], "chained"),
        (["a-{1..3.tar"], "brace is not closed"),
        (["{a,{b,c}}.tar"], "within another"),
        (["{3..1}.tar"], "backwards"),
        (["{0..999999999999}.tar"], "longer than"),
        (["{0..999}{0..999}.tar"], "more than 100000"),
        (["{0..99999}.tar", "b.tar"], "names 100001 shards"),
        (["a.tar", "{a,b}.tar"], "named twice"),
        (["https://ada:s3cret@h/a.tar?sig=s3cret", "ftp://h?s3cret"], "'ftp'"),
    ]:
        with case(patterns):
            with pytest.raises(TrilightError, match=message) as caught:
                listed_shards(patterns)
            assert "expected" in str(caught.value) and "s3cret" not in str(caught.value)
    for data in (["a", "b.tar"], ["a", "b"], []):
        with pytest.raises(TrilightError, match="expected one dataset, or shards only"):
            open_training_data(data)
    with pytest.raises(TrilightError, match="validation split holds no scene; .*in a list"):
        open_training_data(["train-0.tar"]).split("validation")


def test_a_list_reads_the_same_samples(tmp_path: Path) -> None:
    dataset = five_scenes(tmp_path)
    data = open_training_data([f"{tmp_path}/train-{{000000..000001}}.tar"])
    shards = data.split("train")
    assert data.num_views is None and data.notes
    for number, entry in enumerate(dataset.shards_of("train")):
        with closing(shards.open(number)) as shard:
            assert shards.num_samples(number) == entry.num_samples
            read = [encode_sample(shard.sample(row)) for row in range(len(shard.keys))]
        assert read == [encode_sample(sample) for sample in dataset.read_shard(entry)]
    names = ["a/train-0.tar", "validation-0.tar", "s3://b/test-000001.tar", "x.tar"]
    splits = [place.split for place in listed_shards(names)]
    assert splits == ["train", "validation", "test", "train"], "which are read from names"


def test_a_folder_is_a_dataset_whatever_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Made, read and trained on alike: as a pattern, a shard, or what a shell makes of `~`."""
    five_scenes(tmp_path / "home")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    for name in ("{000..003}", "{a", "x.tar", "./~", "~/x.tar", "~no such user", "~", "$HOME"):
        with case(name):
            root = dataset_folder(name).root
            if name != "~":
                shutil.copytree(tmp_path / "home", root, ignore=shutil.ignore_patterns("x.tar"))
            assert value_of(name, Path) == root == parse_local_path(str(root))
            for text in (name, str(root), str(value_of(name, str))):
                assert os.path.samefile(open_dataset(text).folder.root, root)
                assert open_training_data([text], may_mix=True).digest == open_dataset(text).digest
    assert sorted(os.listdir()) == [
        "$HOME",
        "home",
        "x.tar",
        "{000..003}",
        "{a",
        "~",
        "~no such user",
    ]
    Path("{1,2}.json").touch()
    assert expand_pattern("{1,2}.json") == ["{1,2}.json"]


Members = dict[str, bytes]


def _members_of(key: str, *suffixes: str) -> Callable[[Path], tuple[str, Members]]:
    """Return what makes a sample, or some members of it."""
    members = encode_sample(tiny_sample(key))
    return lambda _: (key, {suffix: members[suffix] for suffix in suffixes or members})


def _pickled(folder: Path) -> tuple[str, Members]:
    """WebDataset would unpickle it: that would make a folder."""
    bomb = b"cos\nmkdir\n(S'" + str(folder / "ran").encode() + b"'\ntR."
    members = encode_sample(tiny_sample("000000009"))
    return "000000009", {**members, "json": bomb, "extra.pyd": bomb}


FORBIDDEN = {"os.system", "os.exec", "os.fork", "os.posix_spawn", "subprocess.Popen", "os.mkdir",
             "pickle.find_class", "exec", "compile", "socket.connect"}  # fmt: skip


@contextmanager
def audited() -> Iterator[list[str]]:
    """Collect what Python reports of programs, pickles and foreign code that run meanwhile."""
    seen: list[str] = []
    state = {"on": True}

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if state["on"] and event in FORBIDDEN:
            seen.append(f"{event} {arguments!r}"[:200])

    sys.addaudithook(hook)
    try:
        yield seen
    finally:
        state["on"] = False


@for_each(
    ("hostile", "message"),
    [
        (_members_of("000000000"), "sample 000000000 is in another shard too"),
        # the end of the first shard's last sample, as a torn pair of shards would hold it
        (_members_of("000000001", "1.exr"), "000000001 is in another shard too"),
        (_pickled, "000000009.json is not JSON"),
    ],
)
def test_hostile_shards_are_refused_and_run_nothing(
    tmp_path: Path, hostile: Callable[[Path], tuple[str, Members]], message: str
) -> None:
    five_scenes(tmp_path)
    write_shard(tmp_path / "train-000002.tar", [hostile(tmp_path)])
    shards = open_training_data([f"{tmp_path}/train-{{000000,000002}}.tar"]).split("train")
    before = sorted(path.name for path in tmp_path.iterdir())

    def read_all(number: int) -> None:
        with closing(shards.open(number)) as shard:
            for row in range(len(shard.keys)):
                shard.sample(row)

    read_all(0)  # what is imported on the way compiles, so once before
    with audited() as seen:
        shards.open(0).close()
        with pytest.raises(TrilightError, match=message):
            read_all(1)
    assert not seen
    assert sorted(path.name for path in tmp_path.iterdir()) == before
    with audited() as seen:  # the hook would notice
        eval(compile("1", "x", "eval"))
        (tmp_path / "a").mkdir()
    assert len(seen) >= 2


def test_a_missing_shard_and_an_unreadable_sample_are_named(tmp_path: Path) -> None:
    """Where nothing is checked, a changed byte of a picture is found when it is unpacked, or by
    the hash of a manifest; a member that is lacking is always found."""
    shards = open_training_data([f"{tmp_path}/none.tar"]).split("train")
    with pytest.raises(TrilightError, match=r"none\.tar.*cannot be read .*expected a file"):
        shards.num_samples(0)
    members = encode_sample(tiny_sample("000000003"))
    del members["1.exr"]
    write_shard(tmp_path / "train-0.tar", [("000000003", members)])
    shards = open_training_data([f"{tmp_path}/train-0.tar"]).split("train")
    with (
        closing(shards.open(0)) as shard,
        pytest.raises(TrilightError, match=r"train-0\.tar: sample 000000003: .*1\.exr.* missing"),
    ):
        shard.sample(0)
