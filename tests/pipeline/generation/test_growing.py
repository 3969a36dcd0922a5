"""A dataset of any number of scenes, grown by any steps, is the one that is made at once."""

import contextlib
import os
import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.generation import pipeline
from pipeline.generation.generate_options import GenerateOptions
from pipeline.generation.pipeline import make_dataset, prepare_dataset
from pipeline.presets.registry import DATASET_PRESETS, preset_settings
from pipeline.shards import pack_shards as pack
from storage.dataset.dataset import open_dataset, open_listed
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import read_manifest
from storage.dataset.progress import missing_shards, read_progress, read_status
from storage.dataset.settings import MOST_SCENES
from storage.dataset.splits import (
    MOST_SHARDS,
    cut_splits,
    planned_scenes,
    scenes_of_shard,
    shards_for,
)
from storage.dataset.verify import verify_dataset
from storage.errors import TrilightError
from storage.records.objects import Failure
from storage.records.sample import sample_key
from tests.for_each import case
from tests.pipeline.generation.bucket_kit import OUT, Killed, Machines, Writes
from tests.pipeline.generation.tiny_scenes_kit import Undocumented, tiny_order, without_rendering

SMOKE = preset_settings("smoke").splits
GIVEN_UP = (1, 6, 7)
"""Of shards of four: in the middle of one, and at the end of one."""


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> Counter[int]:
    """Scenes by hand, some of which are given up, with how often each was made."""
    count: Counter[int] = Counter()
    without_rendering(monkeypatch)
    make = pipeline.make_scene

    def some(split: str, scene: int, *more: Any) -> Any:
        count[scene] += 1
        sample, _ = make(split, scene, *more)
        failure = Failure(stage="scenes", item=sample_key(scene), reason="no_camera", message="x")
        return (None if scene in GIVEN_UP else sample), [failure]

    monkeypatch.setattr(pipeline, "make_scene", some)
    return count


def order(root: Path | str, scenes: int, **changes: Any) -> GenerateOptions:
    return tiny_order(out=str(root), scenes=scenes, failure_budget=1.0, **changes)


def make(root: Path | str, scenes: int, **changes: Any) -> str:
    return make_dataset(order(root, scenes, **changes), Undocumented()).digest


def files(root: Path) -> dict[str, bytes]:
    """Return what makes up a dataset."""
    names = ("*.tar", "manifest.json", "failures.jsonl", "objects.lock.jsonl")
    return {path.name: path.read_bytes() for name in names for path in root.glob(name)}


def test_any_growth_ends_as_the_set_made_at_once(tmp_path: Path, made: Counter[int]) -> None:
    rng, sets = np.random.default_rng(7), 0
    walks = [[1, 2, 3, 4, 5], [3, 20], [5, 6, 7, 8], [2, 3, 9, 9, 5]]
    walks += [sorted(map(int, rng.integers(1, 23, rng.integers(2, 6)))) for _ in range(6)]
    for steps in walks:
        with case(steps):
            root, sets = tmp_path / f"grown-{sets}", sets + 1
            made.clear()
            for step in steps:
                make(root, step)
                found = verify_dataset(root)
                assert (found.problems, found.is_finished) == ([], True)
                largest = max(steps[: steps.index(step) + 1])
                status = read_status(str(root))
                counted = status.scenes_done + status.scenes_given_up
                assert found.manifest.num_scenes == counted == largest
            assert made == Counter(range(max(steps))), "no scene is made twice"
            make(tmp_path / f"once-{sets}", max(steps))
            assert files(root) == files(tmp_path / f"once-{sets}")


@contextlib.contextmanager
def killed_at(step: int) -> Iterator[list[int]]:
    """Raise Killed instead of the given file operation, counted over renames, links, deletions."""
    left = [step]

    def counted(call: Any) -> Any:
        def run(*given: Any, **options: Any) -> Any:
            left[0] -= 1
            if left[0] < 0:
                raise Killed
            return call(*given, **options)

        return run

    with pytest.MonkeyPatch.context() as patch:
        for module, name in ((os, "replace"), (os, "link"), (shutil, "rmtree")):
            patch.setattr(module, name, counted(getattr(module, name)))
        yield left


def test_growth_that_is_killed_anywhere_is_finished_by_the_next_command(
    tmp_path: Path, made: Counter[int]
) -> None:
    make(tmp_path / "small", 6)
    whole, small = make(tmp_path / "whole", 11), read_manifest(tmp_path / "small/manifest.json")
    for step in range(200):
        root = tmp_path / f"killed-{step}"
        shutil.copytree(tmp_path / "small", root)
        with killed_at(step) as left, contextlib.suppress(Killed):
            make(root, 11)
        with case(step):
            seen = open_dataset(str(root))
            read = [sample for shard in seen.manifest.shards for sample in seen.read_shard(shard)]
            assert len(read) >= small.num_samples, "what was there can be read"
            faults = [
                text for text in verify_dataset(root).problems if "not in the man" not in text
            ]
            assert faults == []
            assert make(root, 11) == whole
            assert files(root) == files(tmp_path / "whole")
        shutil.rmtree(root)
        if left[0] >= 0:
            break
    assert 20 < step < 199


def test_a_smaller_set_that_is_being_made_learns_of_the_larger_one(
    tmp_path: Path, made: Counter[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another maker plans more while the last scene of the smaller set is made."""
    whole, make_scene = make(tmp_path / "whole", 7), pipeline.make_scene

    def late(split: str, scene: int, *more: Any) -> Any:
        if scene == 4:
            monkeypatch.setattr(pipeline, "make_scene", make_scene)
            prepare_dataset(order(tmp_path / "set", 7))
        return make_scene(split, scene, *more)

    monkeypatch.setattr(pipeline, "make_scene", late)
    assert make(tmp_path / "set", 5) == whole
    assert files(tmp_path / "set") == files(tmp_path / "whole")


def test_a_shard_that_grows_is_missing_and_readable(tmp_path: Path, made: Counter[int]) -> None:
    root, whole = tmp_path / "set", make(tmp_path / "whole", 9)
    make(root, 3)
    (root / "README.md").touch()  # no documents are written here
    assert missing_shards(str(root), 3) == []
    assert missing_shards(str(root), 9) == [0, 1, 2]
    assert make(root, 9, shards="1:3") == ""
    status = read_status(str(root))
    assert (status.shards_done, status.shards_planned) == (2, 3)
    assert status.scenes_done == read_progress(DatasetFolder(root)).scenes_done == 5
    assert status.scenes_given_up == 3
    assert not verify_dataset(root).is_finished
    assert [shard.num_samples for shard in open_dataset(str(root)).manifest.shards] == [2, 2, 1]
    assert missing_shards(str(root)) == [0]
    (root / "train-000000.tar").write_bytes(b"damaged")  # its scenes are made again
    shutil.rmtree(root / ".staging")
    assert make(root, 9, shards="0:1") == whole
    assert verify_dataset(root).problems == []


def test_who_packs_a_growing_shard_second_without_locks_has_the_first_ones_result(
    tmp_path: Path, made: Counter[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    make(tmp_path / "set", 3)
    whole, first = make(tmp_path / "whole", 4), pack.write_shard

    def late(path: Path, samples: Any) -> None:
        first(path, samples)
        monkeypatch.setattr(pack, "write_shard", first)
        if (tmp_path / "set") in path.parents:
            pack.pack_shard(DatasetFolder(tmp_path / "set"), path.name, range(4), grows=True)

    monkeypatch.setattr(pack, "write_shard", late)
    assert make(tmp_path / "set", 4) == whole
    folder = DatasetFolder(tmp_path / "set")
    with pytest.raises(
        TrilightError, match=r"train-000001.tar: a file vanished .* run the same command"
    ):
        pack.pack_shard(folder, "train-000001.tar", range(4, 8))


def test_a_bucket_grows_whoever_dies_when(
    tmp_path: Path,
    made: Counter[int],
    bucket: Any,
    machines: Machines,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The n-th write of each run never happens; three machines take turns until one is through."""
    machines.use("plain")
    whole, writes, runs = make(tmp_path / "whole", 11), Writes(monkeypatch), 0
    for scenes in (3, 6, 11):
        for number in range(100):
            writes.left, runs = number // 2, runs + 1
            machines.use("abc"[number % 3])
            with case((scenes, number)), contextlib.suppress(Killed):
                make(OUT, scenes)
                break
            if bucket.exists("shards/set/manifest.json"):
                assert scenes > 3 or verify_dataset(OUT).problems == []
                listed = open_listed(OUT).manifest
                assert len(listed.shards) in (0, shards_for(listed.num_scenes, SMOKE))
        assert open_listed(OUT).manifest.num_scenes == scenes
    assert runs > 30
    assert open_dataset(OUT).digest == whole
    assert verify_dataset(OUT).problems == []
    for name, data in files(tmp_path / "whole").items():
        assert bucket.cat_file(f"shards/set/{name}") == data, name


def test_a_bucket_without_notes_grows(
    tmp_path: Path, made: Counter[int], bucket: Any, machines: Machines
) -> None:
    """A finished set that was copied, grown by two machines to two numbers of scenes."""
    machines.use("plain")
    whole = make(tmp_path / "whole", 7)
    make(tmp_path / "small", 5)
    bucket.put(str(tmp_path / "small"), "shards/set", recursive=True)
    bucket.rm("shards/set/.staging", recursive=True)
    machines.use("a")
    make(OUT, 6)
    machines.use("b")
    assert make(OUT, 7) == whole
    assert verify_dataset(OUT).problems == []


def test_every_preset_makes_one_scene() -> None:
    for name in DATASET_PRESETS:
        splits = preset_settings(name).splits
        assert planned_scenes(1, splits) == shards_for(1, splits) == 1, name
        assert scenes_of_shard(0, cut_splits(1, splits)) == range(1)
        most = min(MOST_SCENES, MOST_SHARDS * splits.scenes_per_shard)
        last = shards_for(most, splits) - 1
        assert scenes_of_shard(last, cut_splits(most, splits)).stop == most
