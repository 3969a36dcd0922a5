"""Laws of judging: hits against a ray tracer, scores against storage, a rival that is a median."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from storage.conventions import camera_rays, log10_radiance
from storage.metrics import object_psnr_log_db, psnr_linear_db, psnr_log_db
from storage.records.scene import Scene
from storage.seeds import rng_for
from tests.for_each import for_each
from tests.train.toy import toy_sample, toy_scene
from train.data.scenes import training_scene
from train.evaluation.error_colours import ERROR_WHITE, error_picture
from train.evaluation.judge import hit_masks
from train.evaluation.rivals import median_picture
from train.evaluation.scores import ViewScore, lead, score_view, share_better, summarise
from train.evaluation.sheet import (
    NOISE_WHITE,
    SheetView,
    drawn_sheet,
    noise_picture,
    write_picture,
)


def hits_one_by_one(scene: Scene, view: int, resolution: int) -> np.ndarray:
    """Moeller and Trumbore 1997, one ray and one triangle at a time."""
    origin, rays = camera_rays(scene.c2w[view], float(scene.fov_deg[view]), resolution)
    mask = np.zeros((resolution, resolution), bool)
    for corners in scene.vertex_positions[scene.faces[~scene.triangle_emits]].astype(np.float64):
        edge1, edge2 = corners[1] - corners[0], corners[2] - corners[0]
        for row, column in np.ndindex(mask.shape):
            ray = rays[row, column]
            p = np.cross(ray, edge2)
            determinant = edge1 @ p
            if abs(determinant) < 1e-15:
                continue
            s = (origin - corners[0]) / determinant
            q = np.cross(s, edge1)
            u, v, depth = s @ p, ray @ q, edge2 @ q
            mask[row, column] |= u >= 0 and v >= 0 and u + v <= 1 and depth > 0
    return mask


@for_each("index", [0, 1])
def test_hits_are_those_of_a_ray_tracer(index: int) -> None:
    scene = toy_scene(index, boxes=1)
    masks = hit_masks(scene, 12)
    for view in range(scene.num_views):
        np.testing.assert_array_equal(masks[view], hits_one_by_one(scene, view, 12))
    assert 0 < masks.mean() < 1


def test_geometry_behind_the_camera_and_emitters_are_not_hit() -> None:
    scene = toy_scene(0)
    behind = scene.c2w.copy()
    behind[:, :3, [0, 2]] *= -1  # turned about: the scene is behind the camera now
    assert not hit_masks(scene.with_cameras(behind, scene.fov_deg), 16).any()
    emitter = scene.vertex_positions[scene.faces[scene.triangle_emits]][0].mean(axis=0)
    looking_up = np.eye(4, dtype=np.float32)
    looking_up[:3, :3] = np.diag([1.0, -1.0, -1.0])
    looking_up[:3, 3] = emitter - [0, 0, 0.05]
    at_light = scene.with_cameras(looking_up[None], np.array([20.0], np.float32))
    assert not hit_masks(at_light, 8).any()


def view_score(log_l1: float) -> ViewScore:
    return ViewScore(log_l1=log_l1, psnr_log_db=0, psnr_linear_db=0, object_psnr_log_db=0)


def test_a_lead_is_sure_where_scenes_agree_on_it() -> None:
    """Views of one scene are one draw: many of them make no lead surer."""
    rival = [view_score(0.06)] * 12
    agreed = lead([view_score(x) for x in (0.05, 0.052, 0.051) * 4], rival, [3] * 4)
    assert agreed.log_l1 == pytest.approx(0.009) and agreed.is_sure
    one_scene_alone, rival = [view_score(0.02)] * 6 + [view_score(0.0599)] * 18, rival * 2
    doubtful = lead(one_scene_alone, rival, [6] * 4)
    # by hand: 0.04 of one scene and 0.0001 of three; its spread is 0.01995, over two for four
    assert doubtful.log_l1 == pytest.approx(0.010075)
    assert doubtful.error == pytest.approx(0.009975) and not doubtful.is_sure
    assert lead(one_scene_alone, rival, [1] * 24).is_sure, "as so many scenes it would be"
    single = lead([view_score(0.01)] * 2, rival[:2], [2])
    assert single.error is None and not single.is_sure
    assert not lead([view_score(0.07)] * 24, rival, [6] * 4).is_sure


def test_scores_are_those_of_storage() -> None:
    rng = rng_for(0, "scores")
    a, b = rng.uniform(0, 3, (2, 9, 9, 3))
    hits = rng.random((9, 9)) < 0.5
    score = score_view(a, b, hits)
    assert score.psnr_log_db == psnr_log_db(a, b)
    assert score.psnr_linear_db == psnr_linear_db(a, b)
    assert score.object_psnr_log_db == object_psnr_log_db(a, b, hits)
    assert score.log_l1 == pytest.approx(np.abs(log10_radiance(a) - log10_radiance(b)).mean())


def test_a_summary_shows_the_bad_ones() -> None:
    def view(value: float) -> ViewScore:
        return ViewScore(
            log_l1=value, psnr_log_db=value, psnr_linear_db=value, object_psnr_log_db=value
        )

    views = [view(float(value)) for value in range(101)]
    summary = summarise(views)
    assert summary["log_l1"] == 50.0
    assert summary["psnr_log_db_median"] == 50.0
    assert summary["object_psnr_log_db_p5"] == pytest.approx(5.0)
    assert share_better(views, views) == 0
    assert share_better(views, [view(25.5)] * 101) == pytest.approx(26 / 101)


def test_no_fixed_picture_has_less_l1_error_than_the_median() -> None:
    scenes = [training_scene(toy_sample(index), 8) for index in range(7)]
    pictures = [scene.target_VRR3.numpy() for scene in scenes]
    targets = np.concatenate(pictures)

    def error(radiance_rgb: np.ndarray) -> float:
        return float(np.abs(log10_radiance(radiance_rgb) - targets).mean())

    median = median_picture(pictures)
    rng = rng_for(0, "rivals")
    middle = 10 ** np.sort(targets, axis=0)[len(targets) // 2] - 1
    rivals = [np.zeros_like(median), middle, 10 ** targets.mean(axis=0) - 1, *(10**targets - 1)]
    rivals += [np.maximum(median + rng.normal(0, 0.01, median.shape), 0) for _ in range(20)]
    # of an even number of views the upper middle is as good: only rounding parts the two
    assert all(error(median) <= error(rival) + 1e-9 for rival in rivals)


def test_the_error_picture_is_black_without_error_and_white_at_its_limit() -> None:
    target = np.full((2, 2, 3), 0.5)
    assert error_picture(target, target).max() == 0
    wrong = (1.5 * 10**ERROR_WHITE) - 1
    assert error_picture(np.full((2, 2, 3), wrong), target).min() == 255


def test_the_sheet_shows_every_view(tmp_path: Path) -> None:
    target = np.full((8, 8, 3), 0.2)
    views = [
        SheetView(
            name=f"view {row}", scores="", target_rgb=target, predicted_rgb=target * row, noise=0.01
        )
        for row in range(3)
    ]
    for name in ("a.png", "b.png"):
        write_picture(tmp_path / name, drawn_sheet(views, ("one line", "and another")))
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    with Image.open(tmp_path / "a.png") as sheet:
        pixels = np.asarray(sheet.convert("RGB"))
    assert pixels.shape[1] > 1000
    assert (pixels == 0).all(axis=-1).any(), "the black prediction of the first view"


def test_the_noise_picture_is_black_at_the_noise_and_white_at_its_limit() -> None:
    target = np.full((2, 2, 3), 0.5)

    def view(error: float) -> SheetView:
        predicted = 1.5 * 10**error - 1
        return SheetView(
            name="", scores="", target_rgb=target, predicted_rgb=target * 0 + predicted, noise=0.01
        )

    assert noise_picture(view(0.0099)).max() == 0
    assert 0 < noise_picture(view(0.02)).mean() < 255
    assert noise_picture(view(0.0101 * NOISE_WHITE)).min() == 255
