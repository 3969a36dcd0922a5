"""Cameras wrap the renderer: a refused picture asks for the next camera of its view alone."""

from collections.abc import Generator

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.builds.named import named_build
from pipeline.making import render_sample as module
from pipeline.making.render_sample import BegunScene, render_sample
from pipeline.making.view_progress import ViewProgress
from pipeline.renders.results import RenderedView, Sampling
from pipeline.renders.variant import activate, choose_variant
from pipeline.scenes.compose import compose_scene
from storage.errors import Rejected
from storage.records.objects import Failure
from storage.records.sample import decode_sample, encode_sample
from storage.records.scene import Scene
from storage.seeds import seed_for
from tests.pipeline.scenes.small_pool import small_pool

BUILD = named_build("smoke", resolution=16)
KEY = "000000000"


@pytest.fixture(scope="module")
def scene() -> Scene:
    for attempt in range(16):
        try:
            return compose_scene(
                BUILD.scenes, small_pool(), seed=BUILD.seed, scene_index=0, attempt=attempt
            )
        except Rejected:
            continue
    raise AssertionError("no scene in sixteen attempts")


class _Renderer:
    """Refuses its second and third picture, which are of view 1; all others are grey."""

    def __init__(self, scene: Scene, settings: object) -> None:
        self.turns = 0

    def view_steps(
        self, c2w: NDArray[np.float32], fov_deg: float, seed: int
    ) -> Generator[Sampling, None, RenderedView]:
        self.turns += 1
        if 2 <= self.turns <= 3:
            raise Rejected("black_view", f"seed {seed}")
        yield Sampling(spp=8, expected_spp=8, missing_db=None)
        return RenderedView(
            radiance_rgb=np.full((16, 16, 3), 0.5, np.float32),
            spp=8,
            noise_floor_db=20.0,
            noise_floor_linear_db=20.0,
            object_noise_floor_db=20.0,
            at_cap=False,
            hits=np.ones((16, 16), np.bool_),
        )


def test_a_record_says_all_three_floors_and_the_target_that_was_missed(scene: Scene) -> None:
    activate(choose_variant())
    changes = {"renders.min_spp": 8, "renders.max_spp": 8, "renders.noise_floor_db": 1.0}
    missed = {**changes, "renders.noise_floor_linear_db": 95.0, "renders.min_mean_radiance": 0}
    reached = {**missed, "renders.noise_floor_linear_db": 0.1}
    records = []
    for each in (missed, reached):
        build = named_build("smoke", resolution=16, changes=each)
        sample = render_sample(KEY, BegunScene(scene=scene), build, [], ViewProgress(None, 0))
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
    sample = render_sample(KEY, BegunScene(scene=scene), BUILD, failures, ViewProgress(None, 0))
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
            KEY, BegunScene(scene=scene, kept_cameras=2), BUILD, failures, ViewProgress(None, 0)
        )
    assert failures == []
