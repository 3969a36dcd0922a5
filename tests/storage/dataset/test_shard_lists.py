"""Lists and brace patterns of shards: what they stand for, and what is never opened or run."""

import os
import shutil
import sys
import tarfile
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest

from infra.cli.options import value_of
from storage.dataset.dataset import open_dataset
from storage.dataset.layout import dataset_folder
from storage.dataset.mixed_data import open_mixture
from storage.dataset.shard import write_shard
from storage.dataset.shard_places import expand_pattern, listed_shards
from storage.dataset.training_data import open_training_data
from storage.errors import TrilightError
from storage.records.sample import encode_sample
from storage.remote.url import parse_local_path
from tests.for_each import case, for_each
from tests.pipeline.documents.dataset_by_hand import five_scenes
from tests.scenes_by_hand import tiny_sample


@for_each(
    ("pattern", "names"),
    [
        ("a.tar", ["a.tar"]),
        ("a-{08..11}.tar", ["a-08.tar", "a-09.tar", "a-10.tar", "a-11.tar"]),
        ("{a,b}-{1..2}.tar", ["a-1.tar", "a-2.tar", "b-1.tar", "b-2.tar"]),
        ("a{,x}.tar", ["a.tar", "ax.tar"]),
        ("{7..7}", ["7"]),
    ],
)
def test_patterns(pattern: str, names: list[str]) -> None:
    assert expand_pattern(pattern) == names


@for_each(
    ("patterns", "message"),
    [
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
    ],
)
def test_what_is_refused(patterns: list[str], message: str) -> None:
    with pytest.raises(TrilightError, match=message) as caught:
        listed_shards(patterns)
    assert "expected" in str(caught.value) and "s3cret" not in str(caught.value)


def test_splits_are_read_from_names() -> None:
    names = ["a/train-0.tar", "validation-0.tar", "s3://b/test-000001.tar", "x.tar"]
    splits = [place.split for place in listed_shards(names)]
    assert splits == ["train", "validation", "test", "train"]


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
                assert open_mixture([text]).digest == open_dataset(text).digest
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


def test_roots_and_shards_are_not_mixed(tmp_path: Path) -> None:
    for data in (["a", "b.tar"], ["a", "b"], []):
        with pytest.raises(TrilightError, match="expected one dataset, or shards only"):
            open_training_data(data)
    with pytest.raises(TrilightError, match="validation split holds no scene; .*in a list"):
        open_training_data(["train-0.tar"]).split("validation")


def test_a_shard_that_is_missing_is_named(tmp_path: Path) -> None:
    shards = open_training_data([f"{tmp_path}/none.tar"]).split("train")
    with pytest.raises(TrilightError, match=r"none\.tar.*cannot be read .*expected a file"):
        shards.num_samples(0)


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _same_key(path: Path) -> None:
    sample = tiny_sample("000000000")
    path.unlink()  # a shard is never written over
    write_shard(path, [(sample.key, encode_sample(sample))])


def _continued(path: Path) -> None:
    """The end of the first shard's last sample, as a torn pair of shards would hold it."""
    members = encode_sample(tiny_sample("000000001"))
    path.unlink()
    write_shard(path, [("000000001", {"1.exr": members["1.exr"]})])


def _extended(path: Path) -> None:
    """An extended header that claims a terabyte: nobody may take memory for it."""
    header = tarfile.TarInfo("000000009.json")
    header.type, header.size = tarfile.XHDTYPE, 1 << 40
    path.write_bytes(header.tobuf(tarfile.GNU_FORMAT) + bytes(4096))


def _pickled(path: Path) -> None:
    """WebDataset would unpickle it: that would make a folder."""
    bomb = b"cos\nmkdir\n(S'" + str(path.parent / "ran").encode() + b"'\ntR."
    members = encode_sample(tiny_sample("000000009"))
    path.unlink()
    write_shard(path, [("000000009", {**members, "json": bomb, "extra.pyd": bomb})])


HOSTILE = {
    "cut short": (_cut, "cut short"),
    "a key of another shard": (_same_key, "sample 000000000 is in another shard too"),
    "members of another shard's sample": (_continued, "000000001 is in another shard too"),
    "an extended header": (_extended, "refused"),
    "a pickle": (_pickled, "000000009.json is not JSON"),
}

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


@for_each(("spoil", "message"), HOSTILE.values())
def test_hostile_shards_are_refused_and_run_nothing(
    tmp_path: Path, spoil: Callable[[Path], None], message: str
) -> None:
    five_scenes(tmp_path)
    shutil.copy(tmp_path / "train-000001.tar", tmp_path / "train-000002.tar")
    spoil(tmp_path / "train-000002.tar")
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


def test_the_hook_would_notice(tmp_path: Path) -> None:
    with audited() as seen:
        eval(compile("1", "x", "eval"))
        (tmp_path / "a").mkdir()
    assert len(seen) >= 2


def test_an_unreadable_sample_is_named_with_its_shard(tmp_path: Path) -> None:
    """Where nothing is checked, a changed byte of a picture is found when it is unpacked, or by
    the hash of a manifest; a member that is lacking is always found."""
    members = encode_sample(tiny_sample("000000003"))
    del members["1.exr"]
    write_shard(tmp_path / "train-0.tar", [("000000003", members)])
    shards = open_training_data([f"{tmp_path}/train-0.tar"]).split("train")
    with (
        closing(shards.open(0)) as shard,
        pytest.raises(TrilightError, match=r"train-0\.tar: sample 000000003: .*1\.exr.* missing"),
    ):
        shard.sample(0)
