"""A folder of scene files: nothing outside of it is read, and its files are frozen by digest."""

import dataclasses
import json
import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from pipeline.exchange.scene_files import SceneFiles, find_scene_files
from pipeline.generation import render_workers
from pipeline.generation.dataset_writer import begin_or_resume_dataset
from pipeline.generation.generate_options import GenerateOptions
from pipeline.generation.generation_run import resolve_inputs
from pipeline.generation.scene_origins import accept_scene_files, build_once, settings_for_files
from pipeline.isolation import ChildPool
from pipeline.presets.registry import preset_settings
from pipeline.presets.settings import DatasetSettings
from pipeline.shards.pack_shards import PublishedShards
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import read_manifest
from storage.errors import Rejected, TrilightError
from storage.records.objects import read_objects_lock
from storage.records.scene import Scene
from tests.pipeline.exchange.exchange_kit import build_json
from tests.pipeline.generation.tiny_scenes_kit import NO_OBJECTS

CAMERA = {"position": [0, -2, 0], "look_at": [0, 0, 0], "up": [0, 0, 1], "fov": 40}


@pytest.fixture
def folder(tmp_path: Path, shared: Path) -> Path:
    """A folder of two small scenes that share a mesh."""
    root = tmp_path / "scenes"
    (root / "meshes").mkdir(parents=True)
    source = shared / "renderformer_scenes"
    shutil.copy(source / "objects/crystals/green.obj", root / "meshes/green.obj")
    shutil.copy(source / "templates/lighting/tri.obj", root / "meshes/tri.obj")
    example = json.loads((source / "crystals.json").read_text())
    scene = {**example, "objects": {n: example["objects"][n] for n in ("green", "light_0")}}
    scene["objects"]["green"]["mesh_path"] = "meshes/green.obj"
    scene["objects"]["light_0"]["mesh_path"] = "meshes/tri.obj"
    (root / "a.json").write_text(json.dumps(scene))
    scene["cameras"] = [CAMERA, CAMERA]
    (root / "b.json").write_text(json.dumps(scene))
    return root


def _change(folder: Path, name: str, **change: Any) -> None:
    """Change the object `green` of a scene file."""
    scene = json.loads((folder / name).read_text())
    scene["objects"]["green"].update(change)
    (folder / name).write_text(json.dumps(scene))


def _build(folder: Path, name: str = "a.json") -> Scene:
    return build_json(folder, name, licence="MIT", num_views=1, scene_index=3, seed=9)


def _settings(folder: Path, views: int | None = None) -> DatasetSettings:
    return settings_for_files(preset_settings("smoke"), find_scene_files(str(folder)), views)


def _files(folder: Path, *names: str, **unusable: str) -> SceneFiles:
    root, assets = folder.resolve(), preset_settings("smoke").assets
    sha256: dict[str, str] = {}
    for name in names:
        sha256 |= build_once(root, name, assets, 1, "scale")[0]
    return SceneFiles(root=root, names=names, sha256=sha256, unusable=unusable, licence="MIT")


def _scene(files: SceneFiles, scene_index: int, settings: DatasetSettings) -> Scene:
    views = settings.scenes.num_views
    return files.scene(scene_index, settings.assets, num_views=views, seed=settings.seed)


def _accept(folder: Path, out: Path, licence: str = "CC-BY-4.0") -> object:
    found, settings = find_scene_files(str(folder)), _settings(folder)
    publication = begin_or_resume_dataset(PublishedShards(DatasetFolder(out)), settings, {}, 1)
    return accept_scene_files(found, licence, settings, publication).origin


def test_a_scene_says_where_it_comes_from_and_remesh_keeps_its_place_and_number(
    folder: Path,
) -> None:
    scene = _build(folder)
    green, light = scene.objects
    assert (green.name, green.kind, green.uid) == ("green", "object", "meshes/green.obj")
    assert (light.name, light.kind, light.uid) == ("light_0", "emitter", "")
    assert scene.provenance["template"] == "renderformer-json"
    assert (scene.provenance["scene_index"], scene.provenance["seed"]) == (3, 9)
    assert scene.provenance["scene_file"]["name"] == "a.json"
    assert str(folder) not in json.dumps(dict(scene.provenance))
    plain = scene
    _change(folder, "a.json", remesh=True, remesh_target_face_num=60)
    scene = _build(folder)
    mine, theirs = scene.object_index == 0, plain.object_index == 0
    assert 30 < mine.sum() <= 60
    assert theirs.sum() == 84
    for corner in ("min", "max"):
        found = getattr(scene.vertex_positions[scene.faces[mine]], corner)(axis=(0, 1))
        wanted = getattr(plain.vertex_positions[plain.faces[theirs]], corner)(axis=(0, 1))
        assert abs(found - wanted).max() < 0.05  # of an object that is 0.3 high


def test_links_are_followed_within_the_folder_alone_and_a_pipe_is_no_scene_file(
    folder: Path,
) -> None:
    """`tests/hostile` has such meshes."""
    shutil.copy(folder / "b.json", folder.parent / "c.json")
    (folder / "c.json").symlink_to(folder.parent / "c.json")
    os.mkfifo(folder / "d.json")
    unusable = find_scene_files(str(folder)).unusable
    assert list(unusable) == ["c.json", "d.json"]
    assert "c.json is c.json, which leads out" in unusable["c.json"]
    assert "d.json: cannot be read (not a plain file)" in unusable["d.json"]
    (folder / "within.obj").symlink_to("meshes/green.obj")
    _change(folder, "a.json", mesh_path="./meshes/../within.obj")
    assert _build(folder).objects[0].uid == "meshes/green.obj"
    (folder / "x.obj").symlink_to("y.obj")
    (folder / "y.obj").symlink_to("x.obj")
    _change(folder, "a.json", mesh_path="x.obj")
    with pytest.raises(TrilightError, match="objects.green.mesh_path is x.obj"):
        _build(folder)


def test_folders_that_give_nothing(tmp_path: Path) -> None:
    with pytest.raises(TrilightError, match="no such folder"):
        find_scene_files(str(tmp_path / "nowhere"))
    with pytest.raises(TrilightError, match=r"0 files \*.json"):
        find_scene_files(str(tmp_path))
    (tmp_path / "a.json").write_text("{")
    with pytest.raises(TrilightError, match="none of the 1 scene files is usable; the first: a.js"):
        find_scene_files(str(tmp_path))


def test_without_wish_there_are_as_many_views_as_every_file_has_and_no_maps_are_drawn(
    folder: Path, tmp_path: Path
) -> None:
    assert _settings(folder).scenes.num_views == 1
    found = find_scene_files(str(folder))
    assert found.unused_camera_notes(1) == ("b.json: 1 of 2 cameras not used, from cameras[1] on",)
    _change(folder, "a.json", colour="red")
    assert find_scene_files(str(folder)).notes == ("a.json: unknown field objects.green.colour",)
    with pytest.raises(TrilightError, match="--views is 2; expected 1 to 1.*in a.json"):
        _settings(folder, views=2)
    with pytest.raises(TrilightError, match="--views is 0"):
        _settings(folder, views=0)
    with pytest.raises(TrilightError, match="only with --scenes-from"):
        GenerateOptions(views=1)
    shares = {"scenes.textures.share": 0.5, "scenes.textures.own_share": 1.0}
    options = GenerateOptions(scenes_from=str(folder), changes=shares)
    with pytest.raises(TrilightError, match="textures.own_share is 1, but --textures is not given"):
        resolve_inputs(options, DatasetFolder(tmp_path / "set"))


def test_files_are_frozen_by_digest_with_the_users_licence(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a child, of which each costs seconds."""
    here = SimpleNamespace(call=lambda function, *args: function(*args), close=lambda: None)
    child = "pipeline.generation.scene_origins.asset_child"
    monkeypatch.setattr(child, lambda confined_to: here)
    with pytest.raises(TrilightError, match="--allow-licence 'CC-BY-NC-4.0'"):
        _accept(folder, tmp_path / "theirs", "CC-BY-NC-4.0")
    out = tmp_path / "set"
    _accept(folder, out)
    locked = read_objects_lock(DatasetFolder(out).objects_lock)
    files = ["a.json", "b.json", "meshes/green.obj", "meshes/tri.obj"]
    assert [entry.uid for entry in locked] == files
    assert {(entry.split, entry.licence) for entry in locked} == {("test", "CC-BY-4.0")}
    assert read_manifest(DatasetFolder(out).manifest).num_scenes == 2
    _accept(folder, out)  # the same again
    mesh = folder / "meshes/green.obj"
    before = mesh.read_bytes()
    mesh.write_bytes(before + b"\n")
    with pytest.raises(TrilightError, match="scene files: 'meshes/green.obj' has changed"):
        _accept(folder, out)
    mesh.write_bytes(before)
    _change(folder, "b.json", remesh=False)
    with pytest.raises(TrilightError, match="scene files: 'b.json' has changed"):
        _accept(folder, out)
    shutil.copy(folder / "a.json", folder / "c.json")
    with pytest.raises(TrilightError, match="listed_scenes was 2, now 3"):
        _accept(folder, out)


def test_a_file_that_changes_during_a_run_stops_it(folder: Path) -> None:
    files = _files(folder, "a.json", "b.json")
    settings = _settings(folder)
    assert _scene(files, 1, settings).provenance["scene_file"]["name"] == "b.json"
    with (folder / "meshes/tri.obj").open("a") as stream:
        stream.write("# later\n")
    with pytest.raises(TrilightError, match="meshes/tri.obj: has changed while"):
        _scene(files, 1, settings)


def test_a_run_reads_files_in_a_confined_child(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What it may read is the folder; what it returns is what is read here."""
    settings = _settings(folder)
    (folder / "c.json").write_text((folder / "a.json").read_text())
    files = _files(folder, "a.json", "c.json", **{"c.json": "it is not wanted"})
    no_renderer = cast(Any, lambda number: SimpleNamespace(close=lambda: None))
    monkeypatch.setattr(render_workers, "_render_pool", lambda job: ChildPool(no_renderer, 1))
    job = cast(Any, SimpleNamespace(
        folder=DatasetFolder(tmp_path / "set"), settings=settings, lock_sha256="",
        accepted=SimpleNamespace(origin=files), num_at_once=1, device="",
    ))  # fmt: skip
    try:
        with render_workers.job_children(job) as (_, read):
            assert read is not None
            scene, expected = read(0), _scene(files, 0, settings)
            assert scene.provenance == expected.provenance
            np.testing.assert_array_equal(scene.vertex_positions, expected.vertex_positions)
            with pytest.raises(Rejected, match="it is not wanted"):
                read(1)
            wrong = dataclasses.replace(scene, faces=scene.faces + len(scene.vertex_positions))
            with monkeypatch.context() as patch:  # as a child that has been taken over
                patch.setattr(render_workers, "call_with_retries", lambda *asked: wrong)
                with pytest.raises(TrilightError):
                    read(0)
            (children,) = render_workers._jobs.values()
            assert children.readers is not None
            (child,) = children.readers._children
            assert child._reach == {folder.resolve()}
    finally:
        render_workers.close_children()
    job.accepted.origin = NO_OBJECTS.origin
    with render_workers.job_children(job) as (_, nothing):
        assert nothing is None


def test_a_bad_file_keeps_its_number_and_stops_nobody(folder: Path, tmp_path: Path) -> None:
    """One that is no scene, and one whose mesh is broken; scene k stays the k-th file."""
    (folder / "aa.json").write_text("{")
    shutil.copy(folder / "a.json", folder / "c.json")
    (folder / "broken.obj").write_bytes(b"")
    _change(folder, "c.json", mesh_path="broken.obj", colour="red")
    found, settings = find_scene_files(str(folder)), _settings(folder)
    assert found.names == ("a.json", "aa.json", "b.json", "c.json")
    assert settings.splits.listed_scenes == 4
    files = _accept(folder, tmp_path / "set")
    assert isinstance(files, SceneFiles)
    assert sorted(files.unusable) == ["aa.json", "c.json"]
    for scene_index in (1, 3):
        with pytest.raises(Rejected, match="unusable_scene_file") as rejection:
            _scene(files, scene_index, settings)
        assert found.names[scene_index] in rejection.value.message
    assert _scene(files, 2, settings).provenance["scene_file"]["name"] == "b.json"
    assert {"aa.json", "c.json"} & set(files.sha256) == set()
    _, left_out, unknown, _ = files.notes
    assert left_out.startswith("c.json is left out: c.json: objects.green")
    assert unknown == "c.json: unknown field objects.green.colour"
