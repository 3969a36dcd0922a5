"""A dataset made in a bucket by machines that share nothing else: one digest, whoever dies when."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from pipeline.executors.array_job import array_job
from pipeline.generation.dataset_order import DatasetOrder
from pipeline.generation.dataset_writer import DatasetWriter
from pipeline.shards.pack import pack_shard
from storage.dataset.dataset import open_dataset
from storage.dataset.progress import read_status
from storage.dataset.staging import is_staged, stage_scene
from storage.dataset.verify import verify_dataset
from storage.errors import TrilightError
from tests.pipeline.generation.bucket_kit import OUT, Machines, other_shard
from tests.pipeline.generation.test_dataset_writer import (
    _build,
    _dataset,
    _locked,
    _sample,
    make_tiny_shard,
)
from tests.s3_server import control
from tests.scenes_by_hand import tiny_sample

FIRST, SECOND = "train-000000.tar", "train-000001.tar"


def make(writer: DatasetWriter, *shards: int) -> None:
    """Freeze the objects where nobody has, make shards that are missing, and list all, if so."""
    if not writer.manifest.objects_lock_sha256:
        writer.lock_objects([_locked()])
    for index in set(shards) & set(writer.unfinished_shards()):
        make_tiny_shard(writer, index)
    writer.finish()


def names(bucket: Any) -> set[str]:
    bucket.invalidate_cache()
    return {path.removeprefix("shards/set/") for path in bucket.find("shards/set")}


def test_an_array_is_of_what_a_bucket_lacks(bucket: Any, machines: Machines) -> None:
    machines.use("a")
    splits = {f"splits.{name}": value for name, value in vars(_build().splits).items()}
    order = DatasetOrder(build="smoke", out=OUT, scenes=8, changes=splits)
    assert array_job(order, per_task=None, at_once=None).tasks == [0, 1]
    with machines.maker("a") as writer:
        make(writer, 0)
        assert FIRST in names(bucket)
        assert array_job(order, per_task=None, at_once=None).tasks == [1]
        assert read_status(OUT).shards_done == 1
        assert [entry.name for entry in open_dataset(OUT).manifest.shards] == [FIRST]
        bucket.rm_file(f"shards/set/.staging/entries/{FIRST}.json")  # as a kill before it leaves it
        assert open_dataset(OUT).manifest.shards == ()
        assert array_job(order, per_task=None, at_once=None).tasks == [0, 1]


def test_the_first_writer_of_a_shard_wins(bucket: Any, machines: Machines) -> None:
    """Also where the second has made other bytes, as another processor may."""
    with machines.maker("a") as first:
        make(first)
        with machines.maker("b") as second:
            make(second)
            other = other_shard(second)
            machines.use("a")
            make(first, 0)
            machines.use("b")
            second.add_shard(other)
            make(second, 1)
        machines.use("a")
        (listed,) = (entry for entry in open_dataset(OUT).manifest.shards if entry.name == FIRST)
        assert listed != other
        assert listed in second.manifest.shards
    assert verify_dataset(OUT).problems == []


def test_an_old_list_that_arrives_late_is_mended(
    bucket: Any, machines: Machines, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between two requests of the first maker the second one plans more, and finishes it."""
    send_manifest = DatasetWriter.publish_manifest

    def late(self: DatasetWriter) -> None:
        monkeypatch.setattr(DatasetWriter, "publish_manifest", send_manifest)
        with machines.maker("b", 8) as second:
            make(second, 1)
        machines.use("a")
        assert len(open_dataset(OUT).manifest.shards) == 2
        send_manifest(self)
        assert open_dataset(OUT).manifest.num_scenes == 4

    with machines.maker("a", 4) as first:
        first.lock_objects([_locked()])
        make_tiny_shard(first, 0)
        monkeypatch.setattr(DatasetWriter, "publish_manifest", late)
        listed = first.finish()
    assert listed is not None and len(listed.shards) == 2
    assert open_dataset(OUT).manifest == listed
    assert verify_dataset(OUT).problems == []


def test_other_objects_and_other_settings_are_refused(bucket: Any, machines: Machines) -> None:
    with machines.maker("a") as first, machines.maker("b") as second:
        machines.use("a")
        first.lock_objects([_locked()])
        machines.use("b")
        with pytest.raises(TrilightError, match=rf"{OUT}: another worker has frozen other objects"):
            second.lock_objects([dataclasses.replace(_locked(), uid="b")])
        second.lock_objects([_locked()])
    changed = {"renders.resolution": 32}
    with (
        pytest.raises(TrilightError, match=rf"{OUT}: this dataset was begun with another setting"),
        machines.maker("c", **changed),
    ):
        pass


def test_scenes_that_wait_are_kept_for_their_dataset_only(bucket: Any, machines: Machines) -> None:
    with machines.maker("a") as writer:
        make(writer)
        staged = writer.folder.staged_shard(FIRST)
        stage_scene(staged, 0, tiny_sample(), [], "lossless")
    with machines.maker("a"):
        assert is_staged(staged, 0)
    bucket.rm("shards/set", recursive=True)
    with machines.maker("a") as writer:
        assert not is_staged(staged, 0)
        assert not writer.manifest.objects_lock_sha256


def test_a_shard_that_was_deleted_is_made_again(bucket: Any, machines: Machines) -> None:
    with machines.maker("a") as writer:
        make(writer, 0, 1)
        digest = writer.manifest.dataset_digest
    bucket.rm_file(f"shards/set/{FIRST}")
    with machines.maker("b") as writer:
        assert writer.unfinished_shards() == [0]
        make(writer, 0)
    assert open_dataset(OUT).digest == digest
    assert verify_dataset(OUT).problems == []


def test_a_shard_is_listed_only_when_it_is_in_the_bucket(bucket: Any, machines: Machines) -> None:
    """A thread, or another process of this machine, packs it while somebody publishes."""
    with machines.maker("a") as writer:
        make(writer, 0)
        folder, profile = writer.folder, _build().storage.profile
        for index in range(4, 8):
            stage_scene(folder.staged_shard(SECOND), index, _sample(index), [], profile)
        pack_shard(folder, SECOND, range(4, 8))
        writer.finish()
        assert [entry.name for entry in open_dataset(OUT).manifest.shards] == [FIRST]
        assert verify_dataset(OUT).problems == []
        assert writer.unfinished_shards() == []
    assert [entry.name for entry in open_dataset(OUT).manifest.shards] == [FIRST, SECOND]


def test_a_larger_wish_of_one_maker_is_known_to_all(bucket: Any, machines: Machines) -> None:
    with machines.maker("a", 4) as first:
        make(first, 0)
        with machines.maker("b", 8):
            machines.use("a")
            assert first.unfinished_shards() == [1]
            assert first.manifest.num_scenes == 8
    with machines.maker("c", 4) as third:
        assert third.num_shards == 2


def test_a_sent_shard_need_not_be_fetched(
    bucket: Any, machines: Machines, monkeypatch: pytest.MonkeyPatch
) -> None:
    with machines.maker("a") as writer:
        make(writer, 0)
        assert not writer.folder.shard(FIRST).exists()

        def never(*arguments: Any) -> None:
            raise AssertionError("fetched")

        monkeypatch.setattr("storage.remote.cache.download", never)
        dataset = open_dataset(OUT)
        assert len(list(dataset.read_shard(dataset.manifest.shards[0]))) == 4


def test_access_that_is_lost_in_the_middle_loses_nothing(
    bucket: Any, machines: Machines, moto: int, tmp_path: Path
) -> None:
    expected = _dataset(tmp_path / "plain").manifest.dataset_digest
    with machines.maker("a") as writer:
        make(writer, 0)
        control(moto, "reset-auth", b"0")
        try:
            with pytest.raises(TrilightError) as caught:
                make_tiny_shard(writer, 1)
        finally:
            control(moto, "reset-auth", b"inf")
        assert writer.folder.shard(SECOND).exists()
    text = str(caught.value)
    assert text.startswith(f"out '{OUT}': cannot be written") and "\n" not in text
    assert "access that lets you list, read and write" in text and "s3cret" not in text
    with machines.maker("a") as writer:
        assert writer.unfinished_shards() == []
        writer.finish()
    assert open_dataset(OUT).digest == expected


def test_what_is_lacking_is_said_at_once(bucket: Any, machines: Machines, moto: int) -> None:
    bucket.rm("shards", recursive=True)
    with (
        pytest.raises(TrilightError, match=rf"out '{OUT}': cannot be written .*404.*that exists"),
        machines.maker("a"),
    ):
        pass
    bucket.mkdir("shards")
    for name, message in (("x.tar", "there are shards but no manifest"), ("README.md", "replace")):
        bucket.pipe_file(f"shards/set/{name}", b"theirs")
        with pytest.raises(TrilightError, match=rf"{OUT}: .*{message}"), machines.maker("a"):
            pass
        bucket.rm_file(f"shards/set/{name}")
    assert names(bucket) == set()
