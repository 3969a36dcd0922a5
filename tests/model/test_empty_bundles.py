"""Laws of skipping: nothing that sees geometry is skipped, and nothing else is lost than stated."""

import dataclasses

import pytest
import torch
from torch import Tensor

from model.empty_bundles import bundles_that_see, fill_absent
from model.positions import to_camera, token_places
from model.scene_tensors import Cameras, SceneTensors, batch_scenes
from storage.errors import TrilightError
from tests.for_each import for_each
from tests.model.kit import awake, random_scene, tiny_config

RESOLUTION, PATCH = 64, 8


def visible(scene: SceneTensors) -> Tensor:
    places = token_places(scene.triangles_T33[None], None, num_registers=2, eps=0.0)
    cameras = Cameras(c2w_BV44=scene.c2w_V44[None], fov_deg_BV=scene.fov_deg_V[None])
    return bundles_that_see(places, cameras, RESOLUTION, PATCH)[0]


def bundles_of_points(scene: SceneTensors) -> Tensor:
    """Return which bundles [V, Q] a dense cloud of surface points falls into."""
    generator = torch.Generator().manual_seed(1)
    weights = torch.rand(4000, 3, generator=generator, dtype=torch.float64)
    weights = weights / weights.sum(dim=-1, keepdim=True)
    inside = to_camera(scene.triangles_T33[None], scene.c2w_V44[None])[0]
    hit = torch.zeros(scene.num_views, (RESOLUTION // PATCH) ** 2, dtype=torch.bool)
    for view in range(scene.num_views):
        points = (weights @ inside[view]).flatten(0, 1)
        points = points[points[:, 2] < -1e-3]
        half = torch.tan(torch.deg2rad(scene.fov_deg_V[view]) / 2)
        plane = torch.stack([points[:, 0], -points[:, 1]], dim=1) / -points[:, 2:] / half
        cell = ((plane + 1) / 2 * (RESOLUTION // PATCH)).floor().long()
        cell = cell[((cell >= 0) & (cell < RESOLUTION // PATCH)).all(dim=1)]
        hit[view, cell[:, 1] * (RESOLUTION // PATCH) + cell[:, 0]] = True
    return hit


@for_each("seed", range(6))
def test_no_bundle_that_sees_geometry_is_skipped(seed: int) -> None:
    """Random cameras among the triangles: some of those are behind, some pierce the near plane."""
    scene = random_scene(3, num_views=4, seed=seed)
    hit = bundles_of_points(scene)
    assert not (hit & ~visible(scene)).any()


def one_small_triangle() -> SceneTensors:
    """In the middle of the picture, 4 m before a camera at the origin."""
    scene = random_scene(1, num_views=1)
    corners = torch.tensor([[0.05, 0.05, -4], [0.2, 0.05, -4], [0.05, 0.2, -4]])
    return dataclasses.replace(
        scene,
        triangles_T33=corners.double()[None],
        c2w_V44=torch.eye(4, dtype=torch.float64)[None],
        fov_deg_V=torch.tensor([40.0], dtype=torch.float64),
    )


def test_a_small_triangle_keeps_its_bundle_and_the_neighbours() -> None:
    seen = visible(one_small_triangle())[0].unflatten(0, (8, 8))
    expected = torch.zeros(8, 8, dtype=torch.bool)
    expected[2:5, 3:6] = True  # right of the middle and above it: row 3, column 4, and around
    assert torch.equal(seen, expected)


@for_each("depth_m", [0.01, 0.5, 500.0])
def test_what_is_kept_depends_on_direction_and_not_on_distance(depth_m: float) -> None:
    scene = one_small_triangle()
    moved = dataclasses.replace(scene, triangles_T33=scene.triangles_T33 * (depth_m / 4))
    assert torch.equal(visible(moved), visible(scene))


def test_a_triangle_that_pierces_the_near_plane_keeps_its_side_alone() -> None:
    """Two corners behind the camera, one before it, all of it far to the right."""
    scene = one_small_triangle()
    corners = torch.tensor([[1.0, 0, 4], [1.0, 0.1, 4], [0.5, 0.05, -4]]).double()
    seen = visible(dataclasses.replace(scene, triangles_T33=corners[None]))[0].unflatten(0, (8, 8))
    # it leaves the picture on the right at half its height: from the tip's column on
    assert seen[3, 5:].all()
    assert not seen[:, :4].any()


def test_a_triangle_behind_the_camera_keeps_nothing() -> None:
    scene = one_small_triangle()
    behind = dataclasses.replace(scene, triangles_T33=-scene.triangles_T33)
    assert not visible(behind).any()


@for_each("family", ["linear", "dpt"])
def test_skipping_nothing_changes_nothing(family: str) -> None:
    model = awake(tiny_config(family))
    wall = torch.tensor([[[-90.0, -90, -3], [90, -90, -3], [0, 90, -3]]], dtype=torch.float64)
    batch = batch_scenes([dataclasses.replace(one_small_triangle(), triangles_T33=wall)])
    with torch.no_grad():
        encoded = model.encode(batch)
        whole = model.decode(encoded, batch.cameras, RESOLUTION)
        skipped = model.decode(encoded, batch.cameras, RESOLUTION, skip_empty_bundles=True)
    # the same float64 sums in the same order but for the batch
    torch.testing.assert_close(skipped, whole, rtol=0, atol=1e-11)


@for_each("family", ["linear", "dpt"])
def test_what_is_skipped_is_black_and_the_rest_stays_near(family: str) -> None:
    model = awake(tiny_config(family))
    near, far = one_small_triangle(), random_scene(5, num_views=1)
    batch = batch_scenes([near, far])  # padded: each scene must be freed of its company
    with torch.no_grad():
        encoded = model.encode(batch)
        whole = model.decode(encoded, batch.cameras, RESOLUTION)
        skipped = model.decode(encoded, batch.cameras, RESOLUTION, skip_empty_bundles=True)
    seen = visible(near)[0].unflatten(0, (8, 8))
    pixels = seen.repeat_interleave(8, 0).repeat_interleave(8, 1)
    assert torch.all(skipped[0, 0][~pixels] == 0)
    assert torch.all(skipped[0, 0][pixels] != 0)
    assert not torch.equal(skipped[0, 0][pixels], whole[0, 0][pixels]), "the rest does change"


def test_a_view_of_nothing_is_black() -> None:
    model = awake(tiny_config("dpt"))
    scene = one_small_triangle()
    batch = batch_scenes([dataclasses.replace(scene, triangles_T33=-scene.triangles_T33)])
    with torch.no_grad():
        skipped = model.decode(
            model.encode(batch), batch.cameras, RESOLUTION, skip_empty_bundles=True
        )
    assert torch.all(skipped == 0)


def test_windows_are_not_skipped() -> None:
    model = awake(tiny_config("swin"))
    batch = batch_scenes([one_small_triangle()])
    with pytest.raises(TrilightError, match="attends in windows"):
        model.decode(model.encode(batch), batch.cameras, RESOLUTION, skip_empty_bundles=True)


def test_absent_tokens_are_the_mean_of_the_present() -> None:
    tokens = torch.tensor([[[1.0, 2.0], [3.0, 6.0]]])
    filled = fill_absent(tokens, torch.tensor([False, True, False, True]))
    assert filled.tolist() == [[[2, 4], [1, 2], [2, 4], [3, 6]]]
