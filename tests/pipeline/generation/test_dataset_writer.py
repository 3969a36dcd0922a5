"""A dataset is begun once, refuses to become another, and grows without changing what is there."""

import dataclasses
from pathlib import Path

import pytest

from pipeline.generation import dataset_writer
from pipeline.generation.dataset_writer import DatasetWriter, begin_or_resume_dataset
from pipeline.generation.generate_options import GenerateOptions
from pipeline.generation.generation_run import choose_dataset_variant
from pipeline.objects.generated import generate_objects
from pipeline.presets.registry import preset_settings
from pipeline.presets.settings import DatasetSettings
from pipeline.renders.mitsuba_variant import Device, Variant, _ProbeResult, device_of, environment
from pipeline.shards.pack_shards import PublishedShards, pack_shard
from storage.dataset import layout
from storage.dataset.dataset import open_dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import index_shard, read_manifest
from storage.dataset.progress import read_progress
from storage.dataset.settings import SplitSettings
from storage.dataset.shard import scan_members
from storage.dataset.splits import scenes_of_shard, shard_name
from storage.dataset.staging import is_staged, note_of
from storage.dataset.verify import verify_dataset
from storage.errors import TrilightError
from storage.records.objects import Failure
from storage.records.sample import Sample, sample_key
from tests.for_each import for_each, with_folders
from tests.pipeline.documents.dataset_by_hand import locked
from tests.scenes_by_hand import stage_scene, tiny_sample, tiny_scene

ENVIRONMENT = {"mitsuba_variant": "llvm_ad_rgb", "libraries": {"mitsuba": "3.9.1"}}
LOCKED = locked("a")


def _build(seed: int | None = None) -> DatasetSettings:
    build = preset_settings("smoke", resolution=16, seed=seed)
    return dataclasses.replace(build, scenes=dataclasses.replace(build.scenes, num_views=2))


def begin_tiny(
    root: Path,
    scenes: int = 4,
    accept_environment: bool = False,
    seed: int | None = None,
    **environment: str,
) -> DatasetWriter:
    """Begin a dataset of tiny scenes, four to a shard, two views each."""
    shards, made_in = PublishedShards(DatasetFolder(root)), {**ENVIRONMENT, **environment}
    accepted = accept_environment
    build = _build(seed)
    return begin_or_resume_dataset(shards, build, made_in, scenes, accept_environment=accepted)


def _sample(index: int) -> Sample:
    return dataclasses.replace(tiny_sample(seed=index), key=sample_key(index))


def make_tiny_shard(writer: DatasetWriter, index: int) -> None:
    """Make a shard of four tiny scenes, each with one rejection."""
    build = _build()
    folder, name = writer.folder, shard_name(index, build.splits)
    for scene in scenes_of_shard(index, build.splits):
        failure = Failure(stage="scenes", item=sample_key(scene), reason="no_camera", message="x")
        profile = build.storage.profile
        stage_scene(folder.staged_shard(name), scene, _sample(scene), [failure], profile)
    writer.add_shard(pack_shard(folder, name, scenes_of_shard(index, build.splits)))


def _dataset(root: Path, scenes: int = 8) -> DatasetWriter:
    writer = begin_tiny(root, scenes)
    writer.lock_objects([LOCKED])
    for index in writer.unfinished_shards():
        make_tiny_shard(writer, index)
    writer.finish()
    return writer


def test_the_digest_knows_nothing_of_place_or_order(tmp_path: Path) -> None:
    forwards = _dataset(tmp_path / "a").manifest
    backwards = begin_tiny(tmp_path / "b", 8)
    backwards.lock_objects([LOCKED])
    for index in (1, 0):
        make_tiny_shard(backwards, index)
    assert backwards.finish() == backwards.manifest
    assert backwards.manifest.dataset_digest == forwards.dataset_digest
    assert backwards.manifest == forwards


def test_as_many_scenes_are_planned_as_are_asked_for(tmp_path: Path) -> None:
    writer = begin_tiny(tmp_path, 5)
    assert writer.manifest.num_scenes == 5
    assert writer.unfinished_shards() == [0, 1]
    make_tiny_shard(writer, 0)
    assert (writer.unfinished_shards(), writer.given_up) == ([1], 0)


def test_other_settings_and_another_environment_are_refused_by_name(tmp_path: Path) -> None:
    _dataset(tmp_path)
    other = preset_settings("smoke", resolution=32, seed=3)
    other = dataclasses.replace(other, scenes=_build().scenes)
    with pytest.raises(TrilightError, match=r"renders.resolution was 16, now 32 \(and 1 more\)"):
        begin_or_resume_dataset(PublishedShards(DatasetFolder(tmp_path)), other, ENVIRONMENT, 4)
    with pytest.raises(TrilightError, match="mitsuba_variant was 'llvm_ad_rgb', now 'scalar_rgb'"):
        begin_tiny(tmp_path, mitsuba_variant="scalar_rgb")
    begin_tiny(tmp_path, accept_environment=True, mitsuba_variant="scalar_rgb")


def test_a_dataset_stays_on_the_device_that_it_began_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This machine has a GPU that renders well, and smoke and frozen presets have digests."""
    rows: list[tuple[str, str, Device | None, str, Device]] = [
        ("smoke", "", None, "", "cpu"),
        ("benchmark-v1", "", None, "", "cpu"),
        ("pretrain-256", "", None, "", "gpu"),
        ("pretrain-256", "", "cpu", "", "cpu"),
        ("smoke", "", None, "cuda_ad_rgb", "gpu"),
        ("smoke", "cuda_ad_rgb", None, "", "gpu"),
        ("pretrain-256", "llvm_ad_rgb", None, "", "cpu"),
        ("pretrain-256", "llvm_ad_rgb", "auto", "", "cpu"),
        ("pretrain-256", "llvm_ad_rgb", "gpu", "", "gpu"),
        ("pretrain-256", "llvm_ad_rgb", None, "cuda_ad_rgb", "gpu"),
    ]
    on_cpu = Variant(name="llvm_ad_rgb", libllvm="", note="")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
    monkeypatch.setattr("pipeline.renders.mitsuba_variant._probe", lambda variant: _ProbeResult())
    monkeypatch.setattr("pipeline.renders.mitsuba_variant._on_processor", lambda: on_cpu)
    for folder, (build, begun, device, named, chosen) in with_folders(tmp_path, rows):
        monkeypatch.setenv("TRILIGHT_VARIANT", named)
        monkeypatch.setenv("TRILIGHT_CACHE", str(folder / "cache"))
        if begun:
            begin_tiny(folder, mitsuba_variant=begun)
        order = GenerateOptions(build=build, device=device)
        variant = choose_dataset_variant(order, DatasetFolder(folder))
        assert variant.device == device_of(environment(variant)) == chosen, (begun, order)


@for_each(("before", "now"), [("llvm_ad_rgb", "cuda_ad_rgb"), ("cuda_ad_rgb", "llvm_ad_rgb")])
def test_a_dataset_goes_on_with_another_device_only_where_that_is_accepted(
    before: str, now: str, tmp_path: Path
) -> None:
    begin_tiny(tmp_path, mitsuba_variant=before)
    first, second = ("cpu", "gpu") if before == "llvm_ad_rgb" else ("gpu", "cpu")
    said = f"begun on a {first.upper()} and would go on with a {second.upper()}; choose --device"
    with pytest.raises(TrilightError, match=f"{said} {first} or another --out, or .*--accept-env"):
        begin_tiny(tmp_path, mitsuba_variant=now)
    begin_tiny(tmp_path, accept_environment=True, mitsuba_variant=now)


def test_a_shard_that_missed_the_manifest_is_found(tmp_path: Path) -> None:
    """A kill between the shard's rename and its note's, or the manifest's, leaves it so."""
    whole = _dataset(tmp_path / "a").manifest
    writer = begin_tiny(tmp_path / "b", 8)
    writer.lock_objects([LOCKED])
    for index in range(2):
        make_tiny_shard(writer, index)
    note_of(writer.folder, whole.shards[0].name).unlink()
    assert open_dataset(str(tmp_path / "b")).manifest.shards == whole.shards[1:]
    later = begin_tiny(tmp_path / "b", 8)
    assert later.unfinished_shards() == []
    assert later.finish() == whole == open_dataset(str(tmp_path / "b")).manifest


@for_each("fast", [False, True])
def test_damage_is_named(tmp_path: Path, fast: bool) -> None:
    shard = _dataset(tmp_path).manifest.shards[0]
    name = shard.name
    with (tmp_path / name).open("rb") as stream:
        *_, last = scan_members(stream, name)
    data = bytearray((tmp_path / name).read_bytes())
    data[last.offset + last.num_bytes // 2] ^= 1
    (tmp_path / name).write_bytes(data)
    problems = verify_dataset(tmp_path, fast=fast).problems
    assert fast == (not problems)  # a changed byte is seen only by its hash
    assert all(problem.startswith(name) for problem in problems)
    (tmp_path / name).write_bytes(data[:-512])
    assert verify_dataset(tmp_path, fast=fast).problems


def _make_again(writer: DatasetWriter, samples: list[Sample]) -> None:
    """Replace the first shard by one of these samples."""
    name = shard_name(0, _build().splits)
    for index, sample in enumerate(samples):
        again = dataclasses.replace(sample, key=sample_key(index))
        stage_scene(writer.folder.staged_shard(name), index, again, [], "lossless")
    writer.folder.shard(name).unlink()  # the first writer of a shard wins
    writer.add_shard(pack_shard(writer.folder, name, range(len(samples))))
    writer.finish()


def test_an_object_of_another_split_and_share_alike_licences_that_meet_are_named(
    tmp_path: Path,
) -> None:
    writer = _dataset(tmp_path, 4)
    writer.folder.objects_lock.unlink()  # objects are frozen once
    writer.lock_objects([dataclasses.replace(LOCKED, split="test")])
    assert verify_dataset(tmp_path).problems == []  # the tiny scenes use no object
    floor, light = tiny_scene().objects
    used = dataclasses.replace(floor, kind="object", uid="a")
    sample = dataclasses.replace(_sample(0), scene=tiny_scene(objects=(used, light)))
    _make_again(writer, [sample] * 4)
    assert "belongs to split test" in verify_dataset(tmp_path).problems[0]
    licences = ("CC-BY-SA-4.0", "CC-BY-SA-3.0", "CC-BY-SA-3.0")
    writer.folder.objects_lock.unlink()
    writer.lock_objects([dataclasses.replace(LOCKED, uid=uid) for uid in "abc"])
    samples = []
    for index in range(4):
        placed = [
            dataclasses.replace(floor, name=uid, kind="object", uid=uid, licence=licence)
            for uid, licence in zip("abc", licences, strict=True)
        ][index % 2 :]
        objects = (floor, light, *placed)
        samples.append(dataclasses.replace(_sample(index), scene=tiny_scene(objects=objects)))
    _make_again(writer, samples)
    problems = [text for text in verify_dataset(tmp_path).problems if "share-alike" in text]
    assert [problem.split(":")[1] for problem in problems] == [
        " sample 000000000", " sample 000000002",
    ]  # fmt: skip
    assert "CC-BY-SA-3.0 and CC-BY-SA-4.0 meet" in problems[0]


@for_each("name", ["README.md", "LICENSE.md"])
def test_documents_of_others_are_not_replaced(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("theirs")
    with pytest.raises(TrilightError, match=rf"{name} is there.*another --out"):
        begin_tiny(tmp_path)
    assert not (tmp_path / "manifest.json").exists()
    (tmp_path / "train-000000.tar").write_bytes(b"")
    with pytest.raises(TrilightError, match=r"shards but no manifest\.json"):
        begin_tiny(tmp_path)


def test_a_shard_in_the_folder_of_a_worker_alone_is_no_shard(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such a run would go on for ever: what is packed would be missing again and again."""
    pauses: list[float] = []
    elsewhere = _dataset(tmp_path / "worker", 4).manifest.shards[0]
    writer = begin_tiny(tmp_path / "here", 4)
    monkeypatch.setattr(dataset_writer.time, "sleep", pauses.append)
    with pytest.raises(TrilightError, match="a worker has packed .* folder is not this one"):
        writer.add_shard(elsewhere)
    assert sum(pauses) > 60  # a network file system may keep a listing for a minute
    assert writer.unfinished_shards() == [0]

    def appear(seconds: float) -> None:
        name = elsewhere.name
        (tmp_path / "here" / name).write_bytes((tmp_path / "worker" / name).read_bytes())

    monkeypatch.setattr(dataset_writer.time, "sleep", appear)
    writer.add_shard(elsewhere)
    assert open_dataset(str(tmp_path / "here")).manifest.shards == (elsewhere,)


def _most_entries(root: Path) -> int:
    folders = [root, *(path for path in root.rglob("*") if path.is_dir())]
    return max(sum(1 for _ in folder.glob("[a-z0-9]*[0-9].*")) for folder in folders)


def test_a_dataset_in_parts_is_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Shards, rejections and logs move together; reading and verifying find them.

    Two files in a folder stand for 4,096: the rule is the same.
    """
    splits = SplitSettings(scenes_per_shard=4)
    assert shard_name(0, splits) == "train-000000.tar"
    assert shard_name(4093, splits) == "test-004093.tar"
    assert shard_name(4096, splits) == "part-0001/train-004096.tar"
    assert shard_name(999_999, splits) == "part-0244/train-999999.tar"
    monkeypatch.setattr(layout, "FILES_PER_FOLDER", 2)
    writer = _dataset(tmp_path, scenes=20)
    shards = writer.manifest.shards
    names = [shard.name for shard in shards]
    assert names == [
        "train-000000.tar", "train-000001.tar", "part-0001/validation-000002.tar",
        "part-0001/train-000003.tar", "part-0002/train-000004.tar",
    ]  # fmt: skip
    assert read_manifest(tmp_path / "manifest.json") == writer.manifest
    found = verify_dataset(tmp_path)
    assert (found.problems, found.manifest.num_samples) == ([], 20)
    dataset = open_dataset(str(tmp_path))
    keys = [s.key for shard in dataset.manifest.shards for s in dataset.read_shard(shard)]
    assert keys == [sample_key(index) for index in range(20)]
    assert _most_entries(tmp_path) == 2
    assert writer.unfinished_shards() == []
    assert read_progress(writer.folder).scenes_done == 20
    path = tmp_path / names[3]
    moved = path.rename(tmp_path / "away")
    assert verify_dataset(tmp_path).problems == ["part-0001/train-000003.tar: missing"]
    assert writer.unfinished_shards() == [3]
    moved.rename(path)
    assert index_shard(path) == shards[3]
    path.with_name("train-000009.tar").write_bytes(b"")
    assert verify_dataset(tmp_path).problems == ["part-0001/train-000009.tar: not in the manifest"]


def test_staged_scenes_and_built_in_objects_stand_in_parts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(layout, "FILES_PER_FOLDER", 2)
    for index in range(5):
        stage_scene(tmp_path / "shard", index, _sample(index), [], "lossless")
    assert all(is_staged(tmp_path / "shard", index) for index in range(5))
    objects = generate_objects("builtin:30", tmp_path / "objects")
    assert len({entry.uid for entry in objects}) == 30
    assert all("part" not in entry.uid for entry in objects)
    assert _most_entries(tmp_path) == 2
