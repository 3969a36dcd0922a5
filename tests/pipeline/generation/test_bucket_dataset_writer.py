"""A dataset made in a bucket by machines that share nothing else: one digest, whoever dies when.

Nothing that the first has said is lost by one that comes late.
"""

import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pipeline.executors.slurm_and_kubernetes import array_job
from pipeline.generation import dataset_writer
from pipeline.generation.dataset_writer import DatasetWriter
from pipeline.generation.generate_options import GenerateOptions
from pipeline.generation.pipeline import prepare_dataset
from pipeline.generation.prepare_isolated import asset_store
from pipeline.generation.scene_origins import ComposedScenes
from pipeline.generation.scene_worker import AssetMissing, SplitPool
from pipeline.shards import pack_shards as pack
from pipeline.shards.pack_shards import pack_shard
from storage.dataset.dataset import open_dataset
from storage.dataset.progress import read_status
from storage.dataset.staging import is_staged
from storage.dataset.verify import verify_dataset
from storage.errors import TrilightError
from storage.records.objects import Failure, decode_failures
from tests.pipeline.generation.bucket_kit import OUT, Killed, Machines, other_shard
from tests.pipeline.generation.frozen_kit import asked, frozen, object_records, prepared, use_mesher
from tests.pipeline.generation.test_dataset_writer import (
    LOCKED,
    _build,
    _dataset,
    _sample,
    make_tiny_shard,
)
from tests.pipeline.generation.tiny_scenes_kit import tiny_order, without_probe
from tests.s3_server import control
from tests.scenes_by_hand import stage_scene, tiny_sample

FIRST, SECOND = "train-000000.tar", "train-000001.tar"


def make(writer: DatasetWriter, *shards: int) -> None:
    """Freeze the objects where nobody has, make shards that are missing, and list all, if so."""
    if not writer.manifest.objects_lock_sha256:
        writer.lock_objects([LOCKED])
    for index in set(shards) & set(writer.unfinished_shards()):
        make_tiny_shard(writer, index)
    writer.finish()


def names(bucket: Any) -> set[str]:
    bucket.invalidate_cache()
    return {path.removeprefix("shards/set/") for path in bucket.find("shards/set")}


def test_an_array_is_of_what_a_bucket_lacks(bucket: Any, machines: Machines) -> None:
    machines.use("a")
    splits = {f"splits.{name}": value for name, value in vars(_build().splits).items()}
    order = GenerateOptions(build="smoke", out=OUT, scenes=8, changes=splits)
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
        first.lock_objects([LOCKED])
        make_tiny_shard(first, 0)
        monkeypatch.setattr(DatasetWriter, "publish_manifest", late)
        listed = first.finish()
    assert listed is not None and len(listed.shards) == 2
    assert open_dataset(OUT).manifest == listed
    assert verify_dataset(OUT).problems == []


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


def test_a_shard_that_is_sent_need_not_be_fetched_and_one_is_listed_only_in_the_bucket(
    bucket: Any, machines: Machines, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A thread, or another process of this machine, packs it while somebody publishes."""
    with machines.maker("a") as writer:
        make(writer, 0)
        assert not writer.folder.shard(FIRST).exists()
        with monkeypatch.context() as patch:
            patch.setattr("storage.remote.shard_cache.download", None)
            dataset = open_dataset(OUT)
            assert len(list(dataset.read_shard(dataset.manifest.shards[0]))) == 4
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
    absent = rf"out '{OUT}': cannot be written .*404.*that exists"
    with pytest.raises(TrilightError, match=absent), machines.maker("a"):
        pass
    bucket.mkdir("shards")
    for name, message in (("x.tar", "there are shards but no manifest"), ("README.md", "replace")):
        bucket.pipe_file(f"shards/set/{name}", b"theirs")
        with pytest.raises(TrilightError, match=rf"{OUT}: .*{message}"), machines.maker("a"):
            pass
        bucket.rm_file(f"shards/set/{name}")
    assert names(bucket) == set()


def _failures(bucket: Any) -> list[Failure]:
    return decode_failures(bucket.cat_file("shards/set/failures.jsonl"))


def test_who_freezes_late_takes_nothing_back(bucket: Any, machines: Machines) -> None:
    with machines.maker("b") as late, machines.maker("a") as first:
        first.add_failures([Failure(stage="assets", item="c", reason="no_faces", message="x")])
        first.lock_objects([LOCKED])
        make_tiny_shard(first, 0)
        rejected = open_dataset(OUT).failures()
        assert len(rejected) == 5
        machines.use("b")
        late.add_failures([Failure(stage="assets", item="b", reason="no_faces", message="x")])
        late.lock_objects([LOCKED])
        assert [entry.name for entry in open_dataset(OUT).manifest.shards] == [FIRST]
        assert set(rejected) < set(open_dataset(OUT).failures())


def test_other_objects_and_settings_are_refused_and_the_first_writer_of_a_shard_wins(
    bucket: Any, machines: Machines
) -> None:
    """With its rejections, and where the second has made other bytes, as another processor may."""
    with machines.maker("a") as first, machines.maker("b") as second:
        machines.use("a")
        first.lock_objects([LOCKED])
        machines.use("b")
        with pytest.raises(TrilightError, match=rf"{OUT}: another worker has frozen other objects"):
            second.lock_objects([dataclasses.replace(LOCKED, uid="b")])
        second.lock_objects([LOCKED])
        other = other_shard(second)
        machines.use("a")
        make_tiny_shard(first, 0)
        machines.use("b")
        second.add_shard(other)
        (listed,) = open_dataset(OUT).manifest.shards
        assert listed.name == FIRST and listed != other
        assert {row.reason for row in open_dataset(OUT).failures()} == {"no_camera"}
        make_tiny_shard(second, 1)
        second.finish()
        assert listed in second.manifest.shards
    assert {row.reason for row in _failures(bucket)} == {"no_camera"}
    assert verify_dataset(OUT).problems == []
    refusal = rf"{OUT}: this dataset was begun with another setting"
    changed = {"renders.resolution": 32}
    with pytest.raises(TrilightError, match=refusal), machines.maker("c", **changed):
        pass


def test_a_shard_whose_maker_died_at_once_gets_the_rejections_of_the_next(
    bucket: Any, machines: Machines
) -> None:
    with machines.maker("a") as writer:
        writer.lock_objects([LOCKED])
        other = other_shard(writer)
        bucket.pipe_file(f"shards/set/{FIRST}", writer.folder.shard(FIRST).read_bytes())
        writer.add_shard(other)
    assert {row.reason for row in open_dataset(OUT).failures()} == {"other"}


def test_a_shard_that_another_machine_has_sent_is_listed_and_a_worker_with_another_cache_named(
    bucket: Any, machines: Machines, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The latter has packed a shard that is neither here nor in the bucket."""
    monkeypatch.setattr(dataset_writer.time, "sleep", lambda seconds: None)
    elsewhere = _dataset(tmp_path / "elsewhere").manifest.shards[1]
    with machines.maker("a") as writer:
        writer.lock_objects([LOCKED])
        with pytest.raises(TrilightError, match="folder is not this one.*TRILIGHT_CACHE"):
            writer.add_shard(elsewhere)
        assert open_dataset(OUT).manifest.shards == ()
        with machines.maker("b") as worker:
            make_tiny_shard(worker, 0)
            (entry,) = open_dataset(OUT).manifest.shards
        machines.use("a")
        writer.add_shard(entry)
        make_tiny_shard(writer, 1)
        listed = writer.finish()
        assert listed is not None and listed.shards[0] == entry
    assert len(_failures(bucket)) == 8


@contextlib.contextmanager
def _ending_together(
    machines: Machines, monkeypatch: pytest.MonkeyPatch
) -> Iterator[tuple[DatasetWriter, DatasetWriter]]:
    """Two makers that find all shards there: the first says that it lists; the second is in use."""
    with machines.maker("a") as first, machines.maker("b") as second:
        machines.use("a")
        first.lock_objects([LOCKED])
        make_tiny_shard(first, 0)
        make_tiny_shard(first, 1)
        assert first.store.create_if_absent(".staging/listing/000000000008", b"\n")
        monkeypatch.setattr(first, "_wait_for_lister", lambda: None)
        machines.use("b")
        second.fetch_lock()
        yield first, second


def test_of_those_who_end_together_one_reads_the_notes(
    bucket: Any, machines: Machines, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The others wait for its list; one that died over its list is waited for in vain."""
    read: list[str] = []
    fetched = pack.fetch_notes

    def told(how: Any, names: Any, at: Any) -> Any:
        read.extend(found := list(names))
        return fetched(how, found, at)

    monkeypatch.setattr(pack, "fetch_notes", told)
    monkeypatch.setattr(dataset_writer, "_PATIENCE_S", 10.0)
    with _ending_together(machines, monkeypatch) as (first, second):
        waits: list[float] = []
        monkeypatch.setattr(dataset_writer.time, "sleep", waits.append)

        def meanwhile(pause_s: float) -> None:
            waits.append(pause_s)
            if len(waits) == 3:
                machines.use("a")
                first.finish()
                machines.use("b")
                read.clear()

        with monkeypatch.context() as patch:
            patch.setattr(dataset_writer.time, "sleep", meanwhile)
            listed = second.finish()
        assert listed == first.manifest and len(waits) == 3 and read == []
        assert second.left_to_others, "documents too: each reads the whole dataset"
        with machines.maker("c") as third:
            assert third.finish() == listed
            assert not third.left_to_others
            assert read == [] and len(waits) == 3
    with machines.maker("d", 16) as longer:
        for number in (2, 3):
            make_tiny_shard(longer, number)
        assert longer.store.create_if_absent(".staging/listing/000000000016", b"\n")
        waits.clear()
        assert longer.finish() is not None
        assert 10 <= sum(waits) < 20, "its maker died over it"
        assert not longer.left_to_others


def test_who_waited_and_then_lists_more_writes_the_documents(
    bucket: Any, machines: Machines, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While it waited for the list of 8 scenes, somebody planned 16 and made them."""
    monkeypatch.setattr(dataset_writer, "_PATIENCE_S", 10.0)
    with _ending_together(machines, monkeypatch) as (first, second):

        def meanwhile(pause_s: float) -> None:
            machines.use("a")
            first.finish()
            with machines.maker("c", 16) as third:
                make_tiny_shard(third, 2)
                make_tiny_shard(third, 3)
            machines.use("b")

        monkeypatch.setattr(dataset_writer.time, "sleep", meanwhile)
        listed = second.finish()
        assert listed is not None and len(listed.shards) == 4
        assert not second.left_to_others
    assert len(open_dataset(OUT).manifest.shards) == 4
    assert verify_dataset(OUT).problems == []


def test_what_a_killed_machine_has_prepared_is_not_prepared_again(
    bucket: Any, machines: Machines, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_probe(monkeypatch)
    mesher = use_mesher(monkeypatch, batch=8)
    object_records(tmp_path / "objects")
    order = tiny_order(out=OUT, objects=str(tmp_path / "objects"), scenes=4)

    def killed(*given: Any) -> None:
        raise Killed

    for machine in "ab":
        machines.use(machine)
        with monkeypatch.context() as patch, pytest.raises(Killed):
            patch.setattr(DatasetWriter, "lock_objects", killed)
            prepare_dataset(order)
    assert len(mesher.made) == 30 == sum(mesher.made.values())


def test_who_comes_later_trusts_the_index_of_the_first(bucket: Any, machines: Machines) -> None:
    """And has no prepared file yet: each is made where a scene draws it."""
    with machines.maker("a") as first:
        accepted = frozen(first, [prepared(number) for number in range(30)])
        assert accepted.num_objects == 30
    with machines.maker("b") as later:
        trusted = asked(later).load()
        assert trusted is not None and isinstance(trusted.origin, ComposedScenes)
        assert trusted.num_objects == 30
        with pytest.raises(AssetMissing):
            SplitPool(trusted.origin, "train", asset_store())[0]
