"""One sample as it is rendered, and commands on one scene, whose killed children change nothing."""

import dataclasses
import multiprocessing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from infra.render.path_tracer import PathTracer, RenderChild
from pipeline.exchange.convert import convert_scene
from pipeline.exchange.reader import SceneReader, SceneSource
from pipeline.exchange.usd.write_usd import write_usd
from pipeline.generation import inspect_scene as inspecting
from pipeline.generation import scene_worker as rendering
from pipeline.generation.inspect_scene import ROWS, VIEWS, inspect_scene, seen_into, turntable_poses
from pipeline.generation.scene_origins import RenderInput
from pipeline.generation.scene_worker import ViewProgress, render_sample
from pipeline.presets.registry import preset_settings
from pipeline.presets.settings import DatasetSettings
from pipeline.renders.mitsuba_variant import Device, Variant, activate, choose_variant
from pipeline.renders.renderer import RenderedView
from pipeline.renders.settings import measured_settings
from storage.conventions import look_at_c2w
from storage.dataset.layout import DatasetFolder
from storage.dataset.shard import write_shard
from storage.errors import Rejected, TrilightError
from storage.records.objects import Failure
from storage.records.passes import passes_exr
from storage.records.profiles import PROFILES
from storage.records.sample import decode_sample, encode_sample, sample_key
from storage.records.scene import Scene, SceneObject
from storage.records.scene_file import encode_scene
from storage.renderer import Camera, Sampling
from storage.seeds import seed_for
from storage.settings.described import settings_record
from storage.settings.overrides import json_or_word
from tests.command_line import expect_json, expect_mistake
from tests.infra.child_here import use_children_here
from tests.pipeline.scenes.small_pool import first_scene, small_pool
from tests.scenes_by_hand import tiny_sample, tiny_scene


def test_a_summary_a_sheet_and_mistakes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use_children_here(monkeypatch)
    monkeypatch.setattr(inspecting, "_RESOLUTION", 32)
    monkeypatch.setattr(inspecting, "_SPP", 16)
    variant = dataclasses.replace(choose_variant(), note="the GPU renders no right picture")
    monkeypatch.setattr(inspecting, "choose_variant", {"auto": variant}.__getitem__)
    write_usd(tmp_path / "a.usdz", tiny_scene())
    found = expect_json("inspect", tmp_path / "a.usdz", "--turntable", tmp_path / "t.png")
    assert found["triangles"] == 3 and found["lights"] == 1
    assert found["objects"] == "1 emitter, 1 shell"
    assert found["notes"] == ["the GPU renders no right picture; see trilight doctor"]
    sheet = np.asarray(Image.open(tmp_path / "t.png"))
    assert sheet.shape[0] * VIEWS == sheet.shape[1] * ROWS**2
    tiles = np.split(sheet, ROWS)
    assert all(tile.max() > 50 for row in tiles for tile in np.split(row, VIEWS // ROWS, axis=1))
    for words, message in (
        ([str(tmp_path / "a.usdz"), "--turntable", "x.jpg"], "the name of a file X.png"),
        ([str(tmp_path), "--turntable", "x.png"], "expected one scene"),
        ([str(tmp_path / "absent.usda")], "no such file"),
    ):
        assert message in expect_mistake("inspect", *words)


def test_every_pose_sees_all_of_the_scene() -> None:
    scene = tiny_scene()
    points = np.concatenate([scene.vertex_positions[:4], np.ones((4, 1), np.float32)], axis=1)
    for pose in turntable_poses(scene):
        local = np.einsum("ij,vj->vi", np.linalg.inv(pose), points)
        assert (np.abs(local[:, :2]) < np.tan(np.radians(20)) * -local[:, 2:3]).all()


def test_walls_before_the_objects_are_left_out() -> None:
    floor, wall = (SceneObject(name=name, kind="shell") for name in ("floor", "walls"))
    thing = SceneObject(name="thing", kind="object")
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


def test_reading_and_inspecting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The child is killed between two scenes; then between the facts and the pictures."""
    source = SceneSource(path=tmp_path / "scene.safetensors", key=None)
    source.path.write_bytes(encode_scene(tiny_scene()))
    with SceneReader() as reader:
        for _ in range(2):
            assert encode_scene(reader.load(source).scene) == encode_scene(tiny_scene())
            assert kill_children()

    def kill_and_choose(device: Device) -> Variant:
        assert kill_children()
        return choose_variant(device=device)

    monkeypatch.setattr(inspecting, "choose_variant", kill_and_choose)
    monkeypatch.setattr(inspecting, "_turntable", _grey)
    assert inspect_scene(source, tmp_path / "sheet.png")[0]["views"] > 0
    assert (tmp_path / "sheet.png").exists()


def _grey(source: SceneSource, variant: Variant) -> NDArray[np.uint8]:
    return np.full((2, 4, 3), 128, np.uint8)


def test_rendering() -> None:
    """The child is killed between two passes of samples; the next one opens the scene again."""
    scene, kills = tiny_scene(), list[int]()
    settings = measured_settings(8, {"noise_floor_db": 99.0}, max_spp=64)
    tracer = PathTracer(RenderChild(choose_variant(), threads=1), settings)
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


BUILD = preset_settings("smoke", resolution=16)
KEY = "000000000"


@pytest.fixture(scope="module")
def scene() -> Scene:
    return first_scene(BUILD.scenes, small_pool(), seed=BUILD.seed, scene_index=0)


class _Renderer:
    """Refuses its second and third picture, which are of view 1; all others are grey."""

    def __init__(self, scene: Scene, settings: object, light_seed: int | None) -> None:
        self.turns = 0

    def view_steps(
        self, c2w: NDArray[np.float32], fov_deg: float, seed: int
    ) -> Iterator[Sampling | RenderedView]:
        self.turns += 1
        if 2 <= self.turns <= 3:
            raise Rejected("black_view", f"seed {seed}")
        yield Sampling(spp=8, expected_spp=8, missing_db=None)
        yield RenderedView(
            radiance_rgb=np.full((16, 16, 3), 0.5, np.float32),
            spp=8,
            noise_floor_db=20.0,
            noise_floor_linear_db=20.0,
            object_noise_floor_db=20.0,
            at_cap=False,
            core_s=0.0,
            hits=np.ones((16, 16), np.bool_),
        )


def test_a_record_says_all_three_floors_and_the_target_that_was_missed(scene: Scene) -> None:
    activate(choose_variant())
    changes = {"renders.min_spp": 8, "renders.max_spp": 8, "renders.noise_floor_db": 1.0}
    missed = {**changes, "renders.noise_floor_linear_db": 95.0, "renders.min_mean_radiance": 0}
    reached = {**missed, "renders.noise_floor_linear_db": 0.1}
    records = []
    for each in (missed, reached):
        build = preset_settings("smoke", resolution=16, changes=each)
        sample = render_sample(KEY, RenderInput(scene=scene), build, [], ViewProgress(None, 0))
        records.append(decode_sample(KEY, encode_sample(sample)).views)
    assert [view.at_cap for view in records[0]] == [True] * scene.num_views
    assert [view.at_cap for view in records[1]] == [False] * scene.num_views
    for view in (*records[0], *records[1]):
        floors = (view.noise_floor_db, view.noise_floor_linear_db, view.object_noise_floor_db)
        assert len(set(floors)) == 3


def test_a_refused_camera_is_replaced_and_told(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of a file is not: it ends the scene."""
    monkeypatch.setattr(rendering, "SceneRenderer", _Renderer)
    failures: list[Failure] = []
    sample = render_sample(KEY, RenderInput(scene=scene), BUILD, failures, ViewProgress(None, 0))
    before = scene.provenance["camera_attempts"]
    after = sample.scene.provenance["camera_attempts"]
    assert [row.item for row in failures] == [f"{KEY}.1"] * 2
    assert [row.reason for row in failures] == ["black_view"] * 2
    assert before[1] == failures[0].attempt < failures[1].attempt < after[1]
    others = [view for view in range(scene.num_views) if view != 1]
    assert [after[view] for view in others] == [before[view] for view in others]
    np.testing.assert_array_equal(sample.scene.c2w[others], scene.c2w[others])
    assert (sample.scene.c2w[1] != scene.c2w[1]).any()
    assert [view.camera_attempt for view in sample.views] == after
    assert [view.seed for view in sample.views] == [
        seed_for(BUILD.seed, "samples", 0, view, attempt) for view, attempt in enumerate(after)
    ]
    of_file = RenderInput(scene=scene, kept_cameras=2)
    failures.clear()
    with pytest.raises(Rejected, match="black_view: view 1: seed "):
        render_sample(KEY, of_file, BUILD, failures, ViewProgress(None, 0))
    assert failures == []


ASKED = {"storage.passes": json_or_word("[normal, depth,object]")}
NAMES = ("object", "depth_axis_m", "shading_normal")


def build(**changes: object) -> DatasetSettings:
    small = {"scenes.num_views": 2, "renders.min_spp": 8, "renders.max_spp": 8}
    return preset_settings("smoke", resolution=16, changes={**small, **changes})


def test_passes_that_are_asked_for_are_settings_in_the_order_of_the_table_and_rendered() -> None:
    assert settings_record(build(**ASKED))["storage"]["passes"] == list(NAMES)
    assert build(**ASKED).digest == build(**{"storage.passes": list(NAMES)}).digest
    assert build(**ASKED).digest != build().digest
    with pytest.raises(TrilightError, match=r"storage.passes.*no pass 'dept'; did you mean depth"):
        build(**{"storage.passes": ["dept"]})
    with pytest.raises(TrilightError, match="profile' is 'tiny'; expected"):
        build(**{"storage.profile": "tiny"})
    activate(choose_variant())
    scene = tiny_scene(provenance={"camera_attempts": [0, 0]})
    sample, plain = (
        render_sample("000000007", RenderInput(scene=scene), settings, [], ViewProgress(None, 7))
        for settings in (build(**ASKED), build())
    )
    expected = tuple(passes_exr(scene, NAMES, view=view, resolution=16) for view in range(2))
    assert sample.passes_exr == expected and plain.passes_exr is None
    np.testing.assert_array_equal(plain.radiance_rgb, sample.radiance_rgb)


DONE: Any = object()


def _steps() -> Iterator[Sampling | RenderedView]:
    for spp in (32, 64, 96, 256):
        yield Sampling(spp=spp, expected_spp=128, missing_db=None)
    yield DONE


def _told(folder: DatasetFolder) -> list[str]:
    at_work = folder.staging / "at_work"
    return [path.read_text() for path in at_work.iterdir()] if at_work.is_dir() else []


def test_a_view_counts_in_part_and_quick_passes_are_told_once_and_to_nobody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 128 samples that are expected, and no more than the whole where there are more."""
    folder, told = DatasetFolder(tmp_path), list[float]()
    with monkeypatch.context() as patch:
        patch.setattr(rendering, "_EVERY_S", 0.0)
        patch.setattr(rendering, "tell_views", lambda *words: told.append(words[2]))
        assert ViewProgress(folder, 5).render_view(2, _steps()) is DONE
    assert told == [2.25, 2.5, 2.75, 3.0]
    progress = ViewProgress(folder, 5)
    assert progress.render_view(0, _steps()) is DONE
    assert progress.render_view(1, _steps()) is DONE
    assert _told(folder) == ["0.250"]
    progress.end()
    assert _told(folder) == []
    nobody = ViewProgress(None, 5)
    assert nobody.render_view(0, _steps()) is DONE
    nobody.end()
