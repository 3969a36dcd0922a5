"""Commands on one scene: `trilight inspect`, and children that are killed change nothing."""

import dataclasses
import json
import multiprocessing
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from infra.render.path_tracer import PathTracer, RenderChild
from infra.render.quality import ToStatedError
from pipeline.exchange.convert import convert_scene
from pipeline.exchange.open_scene import SceneSource
from pipeline.exchange.reader import SceneReader
from pipeline.exchange.usd.write_usd import write_usd
from pipeline.generation import inspect_scene as inspecting
from pipeline.generation.inspect_scene import ROWS, VIEWS, inspect_scene, seen_into, turntable_poses
from pipeline.renders.mitsuba_variant import Device, Variant, choose_variant
from pipeline.renders.settings import NoiseTargets
from storage.conventions import look_at_c2w
from storage.dataset.shard import write_shard
from storage.errors import TrilightError
from storage.records.profiles import PROFILES
from storage.records.sample import encode_sample, sample_key
from storage.records.scene import ObjectKind, SceneObject
from storage.records.scene_file import encode_scene
from storage.renderer import Camera
from tests.command_line import trilight
from tests.infra.child_here import use_children_here
from tests.scenes_by_hand import tiny_sample, tiny_scene

KINDS: tuple[tuple[str, ObjectKind], ...] = (
    ("floor", "shell"),
    ("walls", "shell"),
    ("thing", "object"),
)


def test_a_summary_and_a_sheet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use_children_here(monkeypatch)
    monkeypatch.setattr(inspecting, "_RESOLUTION", 32)
    monkeypatch.setattr(inspecting, "_SPP", 16)
    variant = dataclasses.replace(choose_variant(), note="the GPU renders no right picture")
    monkeypatch.setattr(inspecting, "choose_variant", {"auto": variant}.__getitem__)
    write_usd(tmp_path / "a.usdz", tiny_scene())
    words = ["inspect", str(tmp_path / "a.usdz"), "--turntable", str(tmp_path / "t.png"), "--json"]
    result = trilight(words)
    assert result.exit_code == 0, result.exception
    found = json.loads(result.output)
    assert found["triangles"] == 3 and found["lights"] == 1
    assert found["objects"] == "1 emitter, 1 shell"
    assert found["notes"] == ["the GPU renders no right picture; see trilight doctor"]
    sheet = np.asarray(Image.open(tmp_path / "t.png"))
    assert sheet.shape[0] * VIEWS == sheet.shape[1] * ROWS**2
    tiles = np.split(sheet, ROWS)
    assert all(tile.max() > 50 for row in tiles for tile in np.split(row, VIEWS // ROWS, axis=1))


def test_every_pose_sees_all_of_the_scene() -> None:
    scene = tiny_scene()
    points = np.concatenate([scene.vertex_positions[:4], np.ones((4, 1), np.float32)], axis=1)
    for pose in turntable_poses(scene):
        local = np.einsum("ij,vj->vi", np.linalg.inv(pose), points)
        assert (np.abs(local[:, :2]) < np.tan(np.radians(20)) * -local[:, 2:3]).all()


def test_mistakes(tmp_path: Path) -> None:
    write_usd(tmp_path / "a.usda", tiny_scene())
    for words, message in (
        ([str(tmp_path / "a.usda"), "--turntable", "x.jpg"], "the name of a file X.png"),
        ([str(tmp_path), "--turntable", "x.png"], "expected one scene"),
        ([str(tmp_path / "absent.usda")], "no such file"),
    ):
        result = trilight(["inspect", *words])
        assert isinstance(result.exception, TrilightError)
        with pytest.raises(TrilightError, match=message):
            raise result.exception


def test_walls_before_the_objects_are_left_out() -> None:
    floor, wall, thing = (SceneObject(name=name, kind=kind) for name, kind in KINDS)
    walls = [[[x, -1, 0], [x, 1, 0], [x, 0, 1]] for x in (1, -1)]
    corners = [*walls, [[0, 0, 0.1], [0.1, 0, 0.1], [0, 0.1, 0.3]], [[1, 0, 0], [0, 1, 0], [0] * 3]]
    room = tiny_scene(
        vertex_positions=np.array(corners, np.float32).reshape(-1, 3),
        vertex_normals=np.tile(np.array([0, 0, 1], np.float32), (12, 1)),
        faces=np.arange(12, dtype=np.uint32).reshape(4, 3),
        material_index=np.zeros(4, np.uint16),
        object_index=np.array([1, 1, 2, 0], np.uint16),
        objects=(floor, wall, thing),
    )
    for x, kept in ((5, [1, 2, 3]), (-5, [0, 2, 3]), (0.5, [0, 1, 2, 3])):
        pose = look_at_c2w(eye=[x, 0.2, 0.5], target=[0, 0, 0], up=[0, 0, 1])
        shown = seen_into(room, pose.astype(np.float32))
        assert shown.faces[:, 0].tolist() == [3 * row for row in kept]
        assert shown.object_index.tolist() == room.object_index[kept].tolist()
    floor_only = tiny_scene()
    assert seen_into(floor_only, floor_only.c2w[0]) is floor_only


def kill_children() -> int:
    """Kill every child of this process; return how many there were."""
    children = multiprocessing.active_children()
    for child in children:
        child.kill()
        child.join()
    return len(children)


@pytest.fixture
def source(tmp_path: Path) -> SceneSource:
    path = tmp_path / "scene.safetensors"
    path.write_bytes(encode_scene(tiny_scene()))
    return SceneSource(path=path, key=None)


def test_reading(source: SceneSource) -> None:
    with SceneReader() as reader:
        for _ in range(2):
            assert encode_scene(reader.load(source).scene) == encode_scene(tiny_scene())
            assert kill_children()


def test_converting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two scenes of a shard; the child is killed between them. Expected is what no child made."""
    shard, profile = tmp_path / "train-000000.tar", PROFILES[0]
    samples = [dataclasses.replace(tiny_sample(seed=n), key=sample_key(n)) for n in range(2)]
    write_shard(shard, [(sample.key, encode_sample(sample, profile)) for sample in samples])

    def converted(folder: Path, between: Callable[[], object]) -> list[bytes]:
        folder.mkdir()
        target = folder / "scene.safetensors"
        source = SceneSource(path=shard, key=None)

        def done(finished: int, of: int) -> None:
            between()

        found = convert_scene(source, target, budget=None, done=done)
        return [path.read_bytes() for path in found.files]

    kills: list[int] = []

    def kill_once() -> None:
        if not kills:
            kills.append(kill_children())

    with monkeypatch.context() as patch:
        use_children_here(patch)
        whole = converted(tmp_path / "whole", lambda: 0)
    assert len(whole) == 2
    assert converted(tmp_path / "killed", kill_once) == whole
    assert kills == [1]


def test_inspecting(source: SceneSource, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The child is killed between the facts and the pictures."""

    def kill_and_choose(device: Device) -> Variant:
        assert kill_children()
        return choose_variant(device=device)

    monkeypatch.setattr(inspecting, "choose_variant", kill_and_choose)
    monkeypatch.setattr(inspecting, "_turntable", _grey)
    assert inspect_scene(source, tmp_path / "sheet.png").facts["views"] > 0
    assert (tmp_path / "sheet.png").exists()


def _grey(source: SceneSource, variant: Variant) -> NDArray[np.uint8]:
    return np.full((2, 4, 3), 128, np.uint8)


def test_rendering() -> None:
    """The child is killed between two passes of samples; the next one opens the scene again."""
    scene, kills = tiny_scene(), list[int]()
    quality = ToStatedError(targets=NoiseTargets(log_db=99.0), max_spp=64)
    tracer = PathTracer(RenderChild(choose_variant(), threads=1), quality, 8)
    disturbed = False

    def sampled(step: object) -> None:
        if disturbed and not kills:
            kills.append(kill_children())

    def picture() -> NDArray[np.float32]:
        return loaded.render(Camera.of_scene(scene, 0), sampled).radiance_rgb

    try:
        loaded = tracer.load(scene, "a scene")
        undisturbed = picture()
        disturbed = True
        assert np.array_equal(picture(), undisturbed)
        assert kills == [1]
    finally:
        tracer.close()
