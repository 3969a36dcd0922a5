"""`trilight revisit`, from a finished dataset to a new one, with real pictures.

One dataset is made by a real child; the others are made in this process, which costs no start.
"""

import dataclasses
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from infra.cli.overrides import BaseSettings, with_base_settings
from infra.repair import repair
from pipeline.exchange.usd.write_usd import write_usd_shard
from pipeline.executors.threads import ThreadRunner
from pipeline.generation import render_workers
from pipeline.generation.generate_options import (
    GenerateOptions,
    RevisitOptions,
    to_generate_options,
)
from pipeline.generation.pipeline import make_dataset
from pipeline.isolation import IsolatedChild
from pipeline.renders.renderer import SceneRenderer
from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.shard import open_shard
from storage.dataset.verify import verify_dataset
from storage.errors import TrilightError
from storage.records.scene_facts import lights
from tests.for_each import case, for_each
from tests.infra.child_here import ChildHere
from tests.pipeline.generation.tiny_scenes_kit import Undocumented
from tests.scenes_by_hand import tiny_scene

TINY = {
    "renders.max_spp": 16,
    "renders.min_spp": 16,
    "splits.scenes_per_shard": 1,
    "storage.profile": "compact",
}


def generated(out: Path, num_views: int, **changes: Any) -> Dataset:
    order = GenerateOptions(
        build="smoke",
        objects="builtin:12",
        out=str(out),
        scenes=2,
        resolution=16,
        changes={**TINY, "scenes.num_views": num_views, **changes},
        workers=1,
    )
    make_dataset(order, Undocumented())
    return open_dataset(str(out))


def order_of(source: Path, out: Path, **asked: Any) -> GenerateOptions:
    order = to_generate_options(RevisitOptions(dataset=str(source), out=str(out), **asked))
    return dataclasses.replace(with_base_settings(order, BaseSettings(like=str(source))), workers=1)


def revisited(source: Path, out: Path, **asked: Any) -> Dataset:
    make_dataset(order_of(source, out, **asked), Undocumented())
    dataset = open_dataset(str(out))
    assert not verify_dataset(dataset).problems
    return dataset


def members(dataset: Dataset) -> dict[str, bytes]:
    return {
        f"{shard.name}/{key}.{suffix}": data
        for shard in dataset.manifest.shards
        for key, of_key in open_shard(dataset.folder.shard(shard.name))
        for suffix, data in of_key.items()
    }


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Dataset]:
    """Scenes are made in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(render_workers, "IsolatedChild", ChildHere)
        yield generated(tmp_path_factory.mktemp("source") / "one", 1)
        render_workers.close_children()


def test_another_view_is_that_of_a_dataset_with_more_views(
    source: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Copied pictures and new ones are those of `generate` with two views, byte for byte.

    So are the passes that are stored beside both of them.
    """
    passes = {"storage.passes": ["depth"]}
    monkeypatch.setattr(render_workers, "IsolatedChild", IsolatedChild)
    more = revisited(source.folder.root, tmp_path / "more", cameras="2", changes=passes)
    monkeypatch.setattr(render_workers, "IsolatedChild", ChildHere)
    fresh = generated(tmp_path / "fresh", 2, **passes)
    found, expected = members(more), members(fresh)
    assert found.keys() == expected.keys()
    for name in expected:
        if name.endswith(".json"):
            now, then = json.loads(found[name]), json.loads(expected[name])
            step = {"dataset_digest": source.digest, "key": name[-14:-5], "attempt": 0, "seed": 0}
            assert now["provenance"].pop("revisited") == [step]
            for record in (now, then):
                record["provenance"].pop("settings_sha256")
            assert now == then
        else:
            assert found[name] == expected[name], name
    before = {name: data for name, data in members(source).items() if name.endswith(".exr")}
    assert before and before == {name: found[name] for name in before}
    added = {name for name in found if ".0." in name} - before.keys()
    assert added == {name.replace(".0.exr", ".0.passes.exr") for name in before}
    assert more.objects_lock() == source.objects_lock()
    names = [[(row.name, row.split) for row in each.manifest.shards] for each in (more, source)]
    assert names[0] == names[1]


def test_a_kept_picture_is_copied_and_not_rendered(
    source: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No path is traced where all pictures are kept."""
    monkeypatch.setattr(SceneRenderer, "view_steps", None)
    kept = revisited(source.folder.root, tmp_path / "kept", shards="0:1")
    before, now = members(source), members(kept)
    pictures = {name: data for name, data in now.items() if name.endswith(".exr")}
    assert pictures and pictures == {name: before[name] for name in pictures}


def test_lights_materials_and_resolution_change_on_request(source: Dataset, tmp_path: Path) -> None:
    asked = {"cameras": "plane:2", "lights": "2", "materials": "new", "resolution": 24, "seed": 5}
    new = revisited(source.folder.root, tmp_path / "new", **asked)
    assert new.manifest.num_views == 2
    for then, now in zip(source.samples(), new.samples(), strict=True):
        assert now.radiance_rgb.shape == (2, 24, 24, 3)
        assert len(lights(now.scene)) == 2
        assert not np.array_equal(now.scene.materials[:1], then.scene.materials[:1])
        assert not any(np.array_equal(pose, then.scene.c2w[0]) for pose in now.scene.c2w)
        assert now.scene.provenance["new_cameras"] == {"layout": "plane", "seed": 5}
        step = now.scene.provenance["revisited"][-1]
        assert (step["dataset_digest"], step["key"]) == (source.digest, then.key)


@for_each("asked", [{"lights": "new"}, {"materials": "new"}, {"seed": 1}])
def test_a_kept_camera_is_rendered_again_where_it_would_see_something_else(
    source: Dataset, tmp_path: Path, asked: dict[str, Any]
) -> None:
    new = revisited(source.folder.root, tmp_path / "new", shards="0:1", **asked)
    for then, now in zip(source.samples(), new.samples(), strict=False):
        assert np.array_equal(now.scene.c2w, then.scene.c2w)
        assert not np.array_equal(now.radiance_rgb, then.radiance_rgb)
        changed = not np.array_equal(now.scene.materials, then.scene.materials)
        assert changed == ("seed" not in asked)


def test_given_cameras_are_those_of_every_scene(source: Dataset, tmp_path: Path) -> None:
    """And all cameras of the first frame where a file has several."""
    path, scene = tmp_path / "frames.usdc", tiny_scene()
    write_usd_shard(path, [("a", scene), ("b", scene), ("c", scene)])
    asked = order_of(source.folder.root, tmp_path / "given", cameras=str(path))
    poses = [camera["c2w"] for camera in asked.changes["revisit"]["given_cameras"]]
    assert poses == [pose.ravel().tolist() for pose in scene.c2w]
    look = {"position": [0, -2, 1], "look_at": [0, 0, 0], "up": [0, 0, 1], "fov": 40}
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps({"cameras": [look]}))
    given = revisited(source.folder.root, tmp_path / "given", cameras=str(path), shards="0:1")
    for sample in given.samples():
        assert np.allclose(sample.scene.c2w[0, :3, 3], [0, -2, 1], atol=1e-6)  # float32
        assert sample.scene.fov_deg.tolist() == [40]


def test_a_run_goes_on_after_a_kill_and_a_bad_shard_is_repaired(
    source: Dataset, tmp_path: Path
) -> None:
    """The run that nothing disturbs is the expectation."""
    asked = {"cameras": "new:1", "seed": 9}
    digest = revisited(source.folder.root, tmp_path / "whole", **asked).digest
    first = order_of(source.folder.root, tmp_path / "set", shards="0:1", **asked)
    make_dataset(first, Undocumented())
    order = order_of(source.folder.root, tmp_path / "set", **asked)
    make_dataset(order, ThreadRunner())
    shard = open_dataset(str(tmp_path / "set")).manifest.shards[0].name
    (tmp_path / "set" / shard).write_bytes(b"not a shard")
    repair(str(tmp_path / "set"), [shard], objects=None, scenes_from=None)
    again = open_dataset(str(tmp_path / "set"))
    assert again.digest == digest
    assert not verify_dataset(again).problems


def test_another_source_and_scenes_of_files_without_layout_are_refused(
    source: Dataset, tmp_path: Path
) -> None:
    order = order_of(source.folder.root, tmp_path / "set")
    other = dict(order.changes["revisit"], source_digest="0" * 64)
    changed = dataclasses.replace(order, changes={**order.changes, "revisit": other})
    with pytest.raises(TrilightError, match="its dataset digest is .*; expected 0000"):
        make_dataset(changed, Undocumented())
    assert not (tmp_path / "set" / "manifest.json").exists()
    of_files = {"splits.listed_scenes": 4}
    for name, value in (("cameras", "new:2"), ("lights", "new")):
        asked = {"changes": of_files, name: value}
        order = order_of(source.folder.root, tmp_path / "set", **asked)
        refusal = f"its scenes are of files, .* draws no {name}; expected"
        with pytest.raises(TrilightError, match=refusal):
            make_dataset(order, Undocumented())
        assert not (tmp_path / "set" / "manifest.json").exists()


def test_a_damaged_source_is_named_and_not_repaired_from_other_objects(
    source: Dataset, tmp_path: Path
) -> None:
    """That is refused before a shard is moved."""
    copy = tmp_path / "copy"
    shutil.copytree(source.folder.root, copy)
    shard = copy / source.manifest.shards[0].name
    data = bytearray(shard.read_bytes())
    data[len(data) // 2] ^= 1
    shard.write_bytes(bytes(data))
    with pytest.raises(TrilightError, match=r"not those of the manifest \(sha256 differs\)"):
        make_dataset(order_of(copy, tmp_path / "set", cameras="2"), Undocumented())
    assert not (tmp_path / "set" / shard.name).exists()
    before = {path.name: path.read_bytes() for path in copy.iterdir() if path.is_file()}
    with pytest.raises(TrilightError, match="name the source that has it by --objects"):
        repair(str(copy), [shard.name], objects="builtin:1", scenes_from=None)
    assert {path.name: path.read_bytes() for path in copy.iterdir() if path.is_file()} == before


def test_words_that_mean_nothing_are_one_line(source: Dataset, tmp_path: Path) -> None:
    for asked, message in (
        ({"cameras": "bogus"}, "--cameras is 'bogus'; expected keep; a number"),
        ({"cameras": "0"}, "cameras: 0 for each scene; expected 1 to 1000"),
        ({"lights": "none"}, "--lights is 'none'; expected keep, new, or a number"),
        ({"lights": "65"}, "num_lights is 65; expected a whole number from 1 to 64"),
        ({"materials": "old"}, "materials is 'old'; expected keep or new"),
    ):
        with case(asked), pytest.raises(TrilightError, match=message):
            order_of(source.folder.root, tmp_path / "set", **asked)
        assert not (tmp_path / "set").exists(), asked
