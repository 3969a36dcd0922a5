"""Laws of projected positions: where tokens land, what it depends on, and what stays as it was."""

import dataclasses

import numpy as np
import torch
from torch import Tensor

from model.config import ModelConfig
from model.positions import to_camera, token_places
from model.projected import BEYOND, landed
from model.renderformer import RenderFormer
from model.scene_tensors import Cameras, SceneTensors, batch_scenes
from storage.conventions import camera_rays
from tests.for_each import for_each
from tests.model.kit import RESOLUTION, awake, random_pose, random_scene, render, tiny_config

TIGHT = 1e-11
"""Pictures of size 1 after some twenty layers of float64 sums."""

PROJECTED = tiny_config(projected_freqs=1)
KINDS = {
    "linear": PROJECTED,
    "4 pixels": dataclasses.replace(PROJECTED, patch_px=4),
    "4 pixels, windows": dataclasses.replace(PROJECTED, patch_px=4, window_bundles=2),
    "dpt": dataclasses.replace(tiny_config("dpt"), projected_freqs=1),
}


def landing(scene: SceneTensors, per_side: int) -> Tensor:
    inside = to_camera(scene.triangles_T33[None], scene.c2w_V44[None])
    return landed(inside, scene.fov_deg_V[None], per_side)[0]


def test_a_point_lands_in_the_pixel_whose_ray_meets_it() -> None:
    scene = random_scene(1, num_views=2)
    c2w, fov_deg = scene.c2w_V44.numpy(), scene.fov_deg_V.numpy()
    for view in range(2):
        origin, directions = camera_rays(c2w[view], float(fov_deg[view]), 8)
        for row, column in ((0, 0), (7, 2), (3, 5)):
            met = torch.from_numpy(np.asarray(origin) + 2.5 * directions[row, column])
            point = dataclasses.replace(scene, triangles_T33=met.double().expand(1, 3, 3))
            got = landing(point, 8)[view, 0]
            # rays of float32, and 8 bundles of one pixel each
            expected = torch.tensor([column + 0.5, row + 0.5], dtype=torch.float64)
            torch.testing.assert_close(got, expected, rtol=0, atol=1e-5)


def test_a_triangle_lands_at_the_mean_of_its_corners_and_none_far_outside() -> None:
    pose = torch.eye(4, dtype=torch.float64)[None]
    fov = torch.tensor([90.0], dtype=torch.float64)
    triangles = torch.tensor(
        [
            [[0.0, 0.0, -1.0], [0.5, 0.0, -1.0], [0.0, 0.5, -2.0]],
            [[-1e6, -1e6, -1.0], [1e6, -1e6, -1.0], [0.0, 1e6, -1.0]],
        ],
        dtype=torch.float64,
    )
    scene = dataclasses.replace(
        random_scene(2, 1), triangles_T33=triangles, c2w_V44=pose, fov_deg_V=fov
    )
    low, high = -BEYOND, 8 + BEYOND
    expected = torch.tensor([[(4 + 6 + 4) / 3, (4 + 4 + 3) / 3], [4.0, (2 * high + low) / 3]])
    torch.testing.assert_close(landing(scene, 8)[0], expected.double())


@for_each("side", [-1.0, 1.0])
def test_what_passes_the_camera_leaves_by_its_own_side_without_a_jump(side: float) -> None:
    """Just before, at and far behind the camera's plane it lands at one place beyond the border."""
    depths = torch.tensor([1e-2, 1e-3, 0.0, -1e-3, -1.0, -1e6], dtype=torch.float64)
    points = torch.stack([side + 0 * depths, 0 * depths, -depths], dim=-1)
    inside = points[None, None, :, None, :].expand(1, 1, -1, 3, 3)
    got = landed(inside, torch.tensor([[60.0]], dtype=torch.float64), 8)[0, 0]
    assert torch.equal(got[:, 0], torch.full((6,), 4 + side * (4 + BEYOND)).double())
    assert torch.equal(got[:, 1], torch.full((6,), 4.0).double())


def test_landing_is_that_of_the_scene_moved_with_its_cameras() -> None:
    scene = random_scene(9)
    motion = random_pose(torch.Generator().manual_seed(3))
    moved = dataclasses.replace(
        scene,
        triangles_T33=scene.triangles_T33 @ motion[:3, :3].T + motion[:3, 3],
        c2w_V44=motion @ scene.c2w_V44,
    )
    # quotients by depths of down to 1e-3 m, in float64
    torch.testing.assert_close(landing(moved, 8), landing(scene, 8), rtol=0, atol=1e-9)


def test_wider_pictures_shift_nothing_in_units_of_the_picture() -> None:
    """But for what lands beyond the border, which is held within so many bundles of it."""
    scene = random_scene(50)
    corners = dataclasses.replace(scene, triangles_T33=scene.triangles_T33[:, :1].expand(-1, 3, -1))
    coarse, fine = landing(corners, 8), landing(corners, 16)
    inside = ((coarse > -BEYOND / 2) & (coarse < 8 + BEYOND / 2)).all(dim=-1)
    assert inside.sum() > 5
    torch.testing.assert_close(fine[inside], 2 * coarse[inside], rtol=0, atol=1e-12)


@for_each("config", KINDS.values())
def test_laws_of_the_network_hold_with_projected_positions(config: ModelConfig) -> None:
    model = awake(config)
    short, long = random_scene(5, seed=1), random_scene(19, seed=2)
    together = render(model, short, long)
    for index, alone in enumerate((short, long)):
        torch.testing.assert_close(together[index], render(model, alone)[0], rtol=0, atol=TIGHT)
    shift = torch.tensor([3.0, -20.0, 100.0], dtype=torch.float64)
    poses = long.c2w_V44.clone()
    poses[:, :3, 3] += shift
    moved = dataclasses.replace(long, triangles_T33=long.triangles_T33 + shift, c2w_V44=poses)
    # positions of size 100 have four digits less
    torch.testing.assert_close(render(model, moved)[0], together[1], rtol=0, atol=1e-9)


def test_one_view_stage_gives_one_picture_however_the_world_is_turned() -> None:
    """The scene's own stage knows which way it is turned; what a camera is shown does not."""
    scene = random_scene(9)
    model = awake(PROJECTED)
    motion = random_pose(torch.Generator().manual_seed(4))
    with torch.no_grad():
        encoded = model.encode(batch_scenes([scene]))
        turned = token_places(
            (scene.triangles_T33 @ motion[:3, :3].T + motion[:3, 3])[None],
            None,
            num_registers=PROJECTED.num_registers,
            eps=0.0,
        )
        cameras = batch_scenes([scene]).cameras
        moved = Cameras(c2w_BV44=motion @ cameras.c2w_BV44, fov_deg_BV=cameras.fov_deg_BV)
        expected = model.decode(encoded, cameras, RESOLUTION)
        got = model.decode(dataclasses.replace(encoded, places=turned), moved, RESOLUTION)
    torch.testing.assert_close(got, expected, rtol=0, atol=1e-9)  # as above


def test_products_depend_on_the_way_from_bundle_to_landing() -> None:
    """Tokens that stand and land one bundle to the right are to the next bundle what they were."""
    model = awake(PROJECTED)
    places = model.decoder.projected
    one = torch.ones(1, 1, 1, model.decoder.rotary.half_width, dtype=torch.float64)
    keys = [
        places._beside((one, 0 * one), torch.tensor([[[[column, 2.5]]]]).double())
        for column in (1.25, 2.25)
    ]
    cos, sin = places.of_bundles(4, (one, one))
    row = 2 * 4
    for key, bundle in zip(keys, (row + 1, row + 2), strict=True):
        turn = torch.atan2(sin[bundle], cos[bundle]) - torch.atan2(key[1], key[0])[0, 0, 0]
        expected = torch.zeros_like(turn)
        expected[9] = 0.25 * 0.25  # the lowest frequency, by a quarter of a bundle
        torch.testing.assert_close(turn, expected)


def test_projected_positions_change_the_picture_and_no_other_weight() -> None:
    scene = random_scene(9)
    plain, projected = awake(tiny_config()), awake(PROJECTED)
    assert plain.state_dict().keys() == projected.state_dict().keys()
    assert (render(plain, scene) - render(projected, scene)).abs().max() > 1e-3


@for_each("config", KINDS.values())
def test_gradients_are_finite_around_and_behind_the_camera(config: ModelConfig) -> None:
    scene = random_scene(12, num_views=1, dtype=torch.float32)
    eye = scene.c2w_V44[0, :3, 3]
    triangles = scene.triangles_T33.clone()
    triangles[0] = eye  # a triangle in the camera's own place
    triangles[1] = eye + scene.c2w_V44[0, :3, 2]  # a point behind it
    triangles[2, 0] = eye + 1e4 * scene.c2w_V44[0, :3, 2]
    scene = dataclasses.replace(scene, triangles_T33=triangles)
    model: RenderFormer = awake(config, torch.float32)
    picture = model(batch_scenes([scene]), RESOLUTION)
    picture.square().mean().backward()
    assert torch.isfinite(picture).all()
    for name, weight in model.named_parameters():
        assert weight.grad is not None and torch.isfinite(weight.grad).all(), name


def test_empty_bundles_are_skipped_with_their_own_places() -> None:
    """Where every bundle sees something, skipping none of them is the whole picture."""
    scene = random_scene(6, num_views=1)
    wall = torch.tensor([[-9.0, -9.0, -1.0], [9.0, -9.0, -1.0], [0.0, 18.0, -1.0]]).double()
    wall = wall @ scene.c2w_V44[0, :3, :3].T + scene.c2w_V44[0, :3, 3]
    filled = dataclasses.replace(
        scene, triangles_T33=torch.cat([wall[None], scene.triangles_T33[1:]])
    )
    model = awake(KINDS["4 pixels"])
    speck = dataclasses.replace(
        scene,
        triangles_T33=scene.c2w_V44[0, :3, 3]
        + 3 * (wall.mean(dim=0) - scene.c2w_V44[0, :3, 3])
        + 0.01 * scene.triangles_T33,
    )
    for shown in (filled, speck):
        batch = batch_scenes([shown])
        with torch.no_grad():
            encoded = model.encode(batch)
            whole = model.decode(encoded, batch.cameras, RESOLUTION)
            some = model.decode(encoded, batch.cameras, RESOLUTION, skip_empty_bundles=True)
        if shown is filled:
            torch.testing.assert_close(some, whole, rtol=0, atol=TIGHT)
    black = (some == 0).all(dim=-1).double().mean()
    assert 0 < black < 1 and torch.isfinite(some).all()


@for_each(("window", "width"), [(0, 12), (2, 24)])
def test_pictures_of_four_pixel_bundles_are_multiples_of_them(window: int, width: int) -> None:
    config = dataclasses.replace(PROJECTED, patch_px=4, window_bundles=window)
    assert config.picture_px == 4 * max(1, window)
    assert render(awake(config), random_scene(4), resolution=width).shape[2:] == (width, width, 3)
