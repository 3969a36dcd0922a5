"""The mesh stage in batches: shared by workers, resumed, remembered, and killed with arrays."""

import dataclasses
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.assets.settings import AssetSettings
from pipeline.executors.registry import find_executor
from pipeline.executors.slurm_and_kubernetes import KubernetesOptions, array_job, job_manifest
from pipeline.executors.threads import PLACE
from pipeline.generation.object_batches import (
    ObjectWork,
    PrepareResult,
    cut_objects,
    prepare_in_batches,
)
from pipeline.generation.pipeline import prepare_dataset
from pipeline.objects.listing import Fetched, failure
from storage.dataset.dataset import open_dataset
from storage.dataset.verify import verify_dataset
from storage.errors import TrilightError
from storage.records.objects import ObjectRecord
from storage.remote import store
from storage.remote.url import RemoteUrl, parse_url
from tests.conftest import ROOT
from tests.pipeline.generation.bucket_kit import OUT, Killed, Machines, Writes
from tests.pipeline.generation.frozen_kit import Mesher, object_records, use_mesher
from tests.pipeline.generation.killed_worker import BATCH, KILL_AFTER_S
from tests.pipeline.generation.test_dataset_writer import begin_tiny
from tests.pipeline.generation.tiny_scenes_kit import (
    Undocumented,
    tiny_order,
    without_probe,
    without_rendering,
)


@pytest.fixture
def mesher(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Mesher:
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path / "cache"))
    return use_mesher(monkeypatch, batch=8)


def _prepare(
    records: list[ObjectRecord],
    out: Path,
    fetch: Callable[[list[ObjectRecord]], Fetched] | None = None,
) -> tuple[PrepareResult, int]:
    counted: list[int] = []
    work = ObjectWork(settings=AssetSettings(), writer=begin_tiny(out), fetch=fetch)
    found = prepare_in_batches(records, work, workers=1, done=counted.append)
    return found, sum(counted)


def test_nothing_is_made_twice_and_an_object_more_or_less_changes_one_batch(
    mesher: Mesher, tmp_path: Path
) -> None:
    """Not by a worker that resumes, nor for a later dataset; an object more costs its batch."""
    records = object_records(tmp_path / "objects")
    mesher.reasons["object 00003"] = "no_faces"
    (found, failures), counted = _prepare(records, tmp_path / "one")
    assert [one.record for one in found] == [r for r in records if r.uid != "object 00003"]
    assert [(f.item, f.reason) for f in failures] == [("object 00003", "no_faces")]
    assert counted == 30 == sum(mesher.made.values())
    for out in ("one", "two"):
        assert _prepare(records, tmp_path / out) == ((found, failures), 30)
    assert sum(mesher.made.values()) == 30
    more = object_records(tmp_path / "objects", 31)
    _prepare(more, tmp_path / "two")
    assert sum(mesher.made.values()) == 30 + len(cut_objects(more)[-1])
    whole = cut_objects(records)
    assert [record for batch in whole for record in batch] == records
    assert len(whole) > 2
    assert max(map(len, whole)) <= 16
    for left_out in records:
        cut = cut_objects([record for record in records if record != left_out])
        assert len([batch for batch in cut if batch not in whole]) <= 2  # it may have been a first


def test_what_the_environment_prevented_is_tried_again(mesher: Mesher, tmp_path: Path) -> None:
    records = object_records(tmp_path / "objects")
    mesher.reasons["object 00007"] = "killed"
    (found, failures), _ = _prepare(records, tmp_path / "set")
    assert (len(found), [f.reason for f in failures]) == (29, ["killed"])
    del mesher.reasons["object 00007"]
    for out in ("set", "another"):
        (found, failures), _ = _prepare(records, tmp_path / out)
        assert (len(found), failures) == (30, [])
    assert mesher.made["object 00007"] == 2


def test_only_what_is_prepared_is_fetched(mesher: Mesher, tmp_path: Path) -> None:
    """A download that failed is tried again, with its batch; a later dataset prepares nothing."""
    records = object_records(tmp_path / "cache" / "objects")
    listed = [dataclasses.replace(record, path="") for record in records]
    lost, fetched = {"object 00012"}, list[str]()

    def fetch(asked: list[ObjectRecord]) -> Fetched:
        fetched.extend(record.uid for record in asked)
        uids = {record.uid for record in asked} - lost
        failures = [failure(uid, "download_failed", "x") for uid in lost & {r.uid for r in asked}]
        return [record for record in records if record.uid in uids], failures

    (found, failures), counted = _prepare(listed, tmp_path / "set", fetch)
    assert (len(found), [f.item for f in failures], counted) == (29, ["object 00012"], 30)
    assert sorted(fetched) == [record.uid for record in records]
    lost.clear()
    fetched.clear()
    expected = _prepare(listed, tmp_path / "set", fetch)
    assert len(expected[0][0]) == 30
    (batch,) = [b for b in cut_objects(records) if "object 00012" in {r.uid for r in b}]
    assert fetched == [record.uid for record in batch]
    made = sum(mesher.made.values())
    assert _prepare(listed, tmp_path / "two", fetch) == expected
    assert sum(mesher.made.values()) == made


def test_a_file_that_has_changed_is_looked_at(mesher: Mesher, tmp_path: Path) -> None:
    cases = [
        (".ply", "object 00009.ply", True),
        (".ply", "beside.bin", False),
        (".gltf", "beside.bin", True),
        (".glb", "sub/deeper.bin", True),
        (".glb", "another.glb", False),
        (".usda", "another.usda", True),
    ]
    for number, (suffix, changed, is_made_again) in enumerate(cases):
        folder = tmp_path / f"objects{number}"
        records = object_records(folder, suffix=suffix)
        mesher.made.clear()
        _prepare(records, tmp_path / f"{number}-one")
        path = folder / changed
        path.parent.mkdir(exist_ok=True)
        path.write_text("something else")
        _prepare(records, tmp_path / f"{number}-two")
        assert (max(mesher.made.values()) == 2) == is_made_again, (suffix, changed)


def test_a_damaged_result_or_one_of_another_user_is_made_again(
    mesher: Mesher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a cache it counts as missing; beside the dataset the error names the next step."""
    records = object_records(tmp_path / "objects", 3)
    expected = _prepare(records, tmp_path / "one")
    for number, damage in enumerate((b"", b"{}\n", b'{"uid": "x"}\n', b"\xff", b'"uid"\n')):
        for path in (tmp_path / "cache" / "object-batches").rglob("*.jsonl"):
            path.write_bytes(damage)
        assert _prepare(records, tmp_path / f"again{number}") == expected
        assert max(mesher.made.values()) == 2 + number
    read = Path.read_bytes
    unreadable = tmp_path / "cache"

    def refused(path: Path) -> bytes:
        if path.is_relative_to(unreadable) and path.suffix == ".jsonl" and path.exists():
            raise PermissionError(13, "Permission denied", str(path))
        return read(path)

    monkeypatch.setattr(Path, "read_bytes", refused)
    made = max(mesher.made.values())
    assert _prepare(records, tmp_path / "two") == expected
    assert max(mesher.made.values()) == made + 1
    unreadable = tmp_path / "two"
    with pytest.raises(TrilightError, match="Permission denied; expected a file that every worker"):
        _prepare(records, tmp_path / "two")


NUM_OBJECTS = 120


@pytest.fixture
def lock_of_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> bytes:
    """The lock that one worker freezes alone."""
    without_probe(monkeypatch)
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path / "alone-cache"))
    mesher = use_mesher(monkeypatch, batch=BATCH)
    objects, out = tmp_path / "objects", tmp_path / "alone"
    object_records(objects, NUM_OBJECTS)
    prepare_dataset(tiny_order(out=str(out), objects=str(objects), scenes=4))
    assert set(mesher.made.values()) == {1} and len(mesher.made) == NUM_OBJECTS
    return (out / "objects.lock.jsonl").read_bytes()


def test_rejected_objects_are_not_tried_again_from_another_folder(
    mesher: Mesher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is frozen is found in the batches of all objects, also without the index of the lock."""
    without_probe(monkeypatch)
    rejected = {"object 00003", "object 00017"}
    mesher.reasons = dict.fromkeys(rejected, "no_faces")
    object_records(tmp_path / "objects")
    os.symlink(tmp_path / "objects", tmp_path / "same")
    out = tmp_path / "set"
    for objects in ("objects", "same"):
        prepare_dataset(tiny_order(out=str(out), objects=str(tmp_path / objects), scenes=4))
    assert set(mesher.made.values()) == {1} and len(mesher.made) == 30
    failures = (out / "failures.jsonl").read_text()
    assert [failures.count(uid) for uid in sorted(rejected)] == [1, 1]


def _start(words: Sequence[str], **environment: str) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-m", "tests.pipeline.generation.killed_worker", *words],
        cwd=ROOT, env={**os.environ, **environment}, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip


@pytest.mark.slow("kills")
@pytest.mark.parametrize("is_bucket", [False, True], ids=["folder", "bucket"])
def test_workers_share_the_objects(
    is_bucket: bool, lock_of_one: bytes, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """One of them is killed, and what it had in hand is prepared by another one."""
    if is_bucket:
        request.getfixturevalue("bucket")
    out, notes = OUT if is_bucket else str(tmp_path / "set"), tmp_path / "notes"
    notes.mkdir()
    words = [out, str(tmp_path / "objects"), str(notes), "3"]
    killed = _start([*words, str(BATCH // 2)], TRILIGHT_CACHE=str(tmp_path / "killed"))
    others = [_start(words, TRILIGHT_CACHE=str(tmp_path / name)) for name in "12"]
    for process in (killed, *others):
        said, _ = process.communicate(timeout=300)
        assert process.returncode == (-9 if process is killed else 0), said
    made = {path.name: path.read_text().splitlines() for path in notes.iterdir()}
    assert all(0 < len(uids) < NUM_OBJECTS for uids in made.values())
    times = Counter(uid for uids in made.values() for uid in uids)
    assert len(times) == NUM_OBJECTS
    twice = {uid for uid, count in times.items() if count > 1}
    assert twice <= set(made[str(killed.pid)])
    batches = cut_objects(object_records(tmp_path / "objects", NUM_OBJECTS))
    lost = [batch for batch in batches if twice & {record.uid for record in batch}]
    assert max(times.values()) <= 2 and len(lost) <= 2, "the two batches in hand"
    assert open_dataset(out).lock_bytes() == lock_of_one


def test_a_kill_before_any_write_leaves_the_same_lock(
    lock_of_one: bytes, machines: Machines, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The n-th write of each run never happens; two machines take turns until one gets through."""
    monkeypatch.setattr(store, "LEASE_S", 0.0)
    monkeypatch.setattr("pipeline.generation.object_batches._NUM_OBJECTS", NUM_OBJECTS // 2)
    order = tiny_order(out=OUT, objects=str(tmp_path / "objects"), scenes=4)
    writes, runs = Writes(monkeypatch), 0
    while True:
        writes.left, runs = runs, runs + 1
        machines.use("ab"[runs % 2])
        try:
            prepare_dataset(order)
            break
        except Killed:
            pass
    assert runs > 5
    assert open_dataset(OUT).lock_bytes() == lock_of_one


def _machine(tmp_path: Path, name: str) -> store.RemoteStore:
    url = parse_url(OUT, what="bucket")
    assert isinstance(url, RemoteUrl)
    return store.RemoteStore(url, tmp_path / name)


def test_a_claim_keeps_other_machines_off_until_it_ends(
    bucket: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It ends with its block, and for a machine that dies when the lease is over."""
    a, b = _machine(tmp_path, "a"), _machine(tmp_path, "b")
    for holder, other in ((a, b), (b, a)):
        with (
            holder.hold_lock("x") as ours,
            other.hold_lock("x") as theirs,
            other.hold_lock("y") as free,
        ):
            assert (ours, theirs, free) == (True, False, True)
    with monkeypatch.context() as patch:
        patch.setattr(store.RemoteStore, "put", lambda *given: None)  # it dies
        with a.hold_lock("z") as ours:
            assert ours
    with b.hold_lock("z") as theirs, _machine(tmp_path, "a").hold_lock("z") as again:
        assert (theirs, again) == (False, True), "a machine that is started again has its claims"
    monkeypatch.setattr(store, "LEASE_S", 0.0)
    with b.hold_lock("z") as theirs:
        assert theirs


@pytest.mark.slow("kills")
def test_arrays_that_are_killed_end_in_the_digest_of_one_that_was_not(
    bucket: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each array goes on where the one before was killed: four of Kubernetes, then one of Slurm."""
    order, rng, killed = tiny_order(out=OUT, scenes=12), np.random.default_rng(0), 0
    options = KubernetesOptions(image="not pulled", cores=2)
    without_rendering(monkeypatch)
    monkeypatch.setattr("pipeline.executors.threads.ThreadRunner", Undocumented)
    alone = dataclasses.replace(order, out=str(tmp_path / "whole"))
    find_executor("threads", None, None).make(alone, None)
    missing = [0, 1]
    for number, on in enumerate([*4 * ["kubernetes"], "slurm"]):
        job = array_job(order, per_task=2, at_once=None, on=on)
        assert set(job.tasks) <= set(missing)  # only what is missing
        missing = list(job.tasks)
        for place, task in enumerate(job.tasks):
            pod = job_manifest(job, options)["spec"]["template"]["spec"]["containers"][0]
            variables = {row["name"]: row["value"] for row in pod["env"]}
            if on == "slurm":
                variables["SLURM_ARRAY_TASK_ID"] = str(task)
            else:
                variables |= {PLACE: str(place), KILL_AFTER_S: str(rng.uniform(0, 0.4))}
            variables["TRILIGHT_CACHE"] = str(tmp_path / f"{number}-{place}")
            run = _start([*pod["command"][1:-1], on], **variables)
            said, _ = run.communicate(timeout=300)
            assert run.returncode in (0, -9), said
            killed += run.returncode == -9
    assert killed >= 2
    assert array_job(order, per_task=2, at_once=None).tasks == []
    assert verify_dataset(OUT).problems == []
    assert open_dataset(OUT).digest == open_dataset(str(tmp_path / "whole")).digest
