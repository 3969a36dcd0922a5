"""A sample as it is rendered: cameras that are replaced, stored passes, and how far it is."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.generation import render_sample as module
from pipeline.generation import render_sample as rendering
from pipeline.generation.render_sample import RenderInput, ViewProgress, render_sample
from pipeline.presets.registry import preset_settings
from pipeline.presets.settings import DatasetSettings
from pipeline.renders.mitsuba_variant import activate, choose_variant
from pipeline.renders.results import RenderedView
from pipeline.scenes.compose import compose_scene
from storage.dataset.layout import DatasetFolder
from storage.errors import Rejected, TrilightError
from storage.records.objects import Failure
from storage.records.passes.pictures import passes_exr
from storage.records.sample import decode_sample, encode_sample
from storage.records.scene import Scene
from storage.renderer import Sampling
from storage.seeds import SceneKey, seed_for
from storage.settings.overrides import json_or_word
from tests.pipeline.scenes.small_pool import small_pool
from tests.scenes_by_hand import tiny_scene

BUILD = preset_settings("smoke", resolution=16)
KEY = "000000000"


@pytest.fixture(scope="module")
def scene() -> Scene:
    for attempt in range(16):
        try:
            return compose_scene(BUILD.scenes, small_pool(), SceneKey(BUILD.seed, 0, attempt))
        except Rejected:
            continue
    raise AssertionError("no scene in sixteen attempts")


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
    monkeypatch.setattr(module, "SceneRenderer", _Renderer)
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


def test_a_refused_camera_of_a_file_ends_the_scene(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "SceneRenderer", _Renderer)
    failures: list[Failure] = []
    with pytest.raises(Rejected, match="black_view: view 1: seed "):
        render_sample(
            KEY, RenderInput(scene=scene, kept_cameras=2), BUILD, failures, ViewProgress(None, 0)
        )
    assert failures == []


ASKED = {"storage.passes": json_or_word("[normal, depth,object]")}
NAMES = ("object", "depth_axis_m", "shading_normal")


def build(**changes: object) -> DatasetSettings:
    small = {"scenes.num_views": 2, "renders.min_spp": 8, "renders.max_spp": 8}
    return preset_settings("smoke", resolution=16, changes={**small, **changes})


def test_what_stores_some_says_so_in_the_order_of_the_table() -> None:
    assert build(**ASKED).as_json()["storage"]["passes"] == list(NAMES)
    assert build(**ASKED).digest == build(**{"storage.passes": list(NAMES)}).digest
    assert build(**ASKED).digest != build().digest
    with pytest.raises(TrilightError, match=r"storage.passes.*no pass 'dept'; did you mean depth"):
        build(**{"storage.passes": ["dept"]})
    with pytest.raises(TrilightError, match="profile' is 'tiny'; expected"):
        build(**{"storage.profile": "tiny"})


def test_a_rendered_sample_holds_what_is_asked() -> None:
    activate(choose_variant())
    scene = tiny_scene(provenance={"camera_attempts": [0, 0]})
    sample = render_sample(
        "000000007", RenderInput(scene=scene), build(**ASKED), [], ViewProgress(None, 7)
    )
    expected = tuple(passes_exr(scene, NAMES, view=view, resolution=16) for view in range(2))
    assert sample.passes_exr == expected
    plain = render_sample("000000007", RenderInput(scene=scene), build(), [], ViewProgress(None, 7))
    assert plain.passes_exr is None
    np.testing.assert_array_equal(plain.radiance_rgb, sample.radiance_rgb)


DONE: Any = object()


def _steps() -> Iterator[Sampling | RenderedView]:
    for spp in (32, 64, 96, 256):
        yield Sampling(spp=spp, expected_spp=128, missing_db=None)
    yield DONE


def _told(folder: DatasetFolder) -> list[str]:
    at_work = folder.staging / "at_work"
    return [path.read_text() for path in at_work.iterdir()] if at_work.is_dir() else []


def test_a_view_counts_in_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 128 samples that are expected, and no more than the whole where there are more."""
    folder, told = DatasetFolder(tmp_path), list[float]()
    monkeypatch.setattr(rendering, "_EVERY_S", 0.0)
    monkeypatch.setattr(rendering, "tell_views", lambda *words: told.append(words[2]))
    assert ViewProgress(folder, 5).render_view(2, _steps()) is DONE
    assert told == [2.25, 2.5, 2.75, 3.0]


def test_quick_passes_are_told_once_and_to_nobody(tmp_path: Path) -> None:
    folder = DatasetFolder(tmp_path)
    progress = ViewProgress(folder, 5)
    assert progress.render_view(0, _steps()) is DONE
    assert progress.render_view(1, _steps()) is DONE
    assert _told(folder) == ["0.250"]
    progress.end()
    assert _told(folder) == []
    nobody = ViewProgress(None, 5)
    assert nobody.render_view(0, _steps()) is DONE
    nobody.end()
