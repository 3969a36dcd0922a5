"""A scene is encoded once: what is kept of it serves every camera, and equals doing all again.

Tolerance 1e-11 as in test_renderformer: float64 sums through some twenty layers.
"""

import dataclasses
from typing import Any

import torch
from torch import Tensor

from model.layers import CrossAttention, merge_heads, split_heads
from model.positions import Rotation, camera_rotation, rotate, token_places, world_rotation
from model.scene_tensors import Cameras, batch_scenes
from tests.for_each import for_each
from tests.model.attention_reference import attend_reference
from tests.model.kit import FAMILIES, RESOLUTION, awake, random_scene, render, tiny_config

TIGHT = 1e-11


def close(got: Tensor, expected: Tensor) -> None:
    torch.testing.assert_close(got, expected, rtol=0, atol=TIGHT)


def view(cameras: Cameras, index: int) -> Cameras:
    return Cameras(c2w_BV44=cameras.c2w_BV44[:, [index]], fov_deg_BV=cameras.fov_deg_BV[:, [index]])


@for_each("family", FAMILIES)
def test_one_encoding_serves_every_camera_in_any_order(family: str) -> None:
    model = awake(tiny_config(family))
    scene = random_scene(7, num_views=3)
    batch = batch_scenes([scene])
    with torch.no_grad():
        encoded = model.encode(batch)
        for index in (2, 0, 1, 0):
            alone = dataclasses.replace(
                scene, c2w_V44=scene.c2w_V44[[index]], fov_deg_V=scene.fov_deg_V[[index]]
            )
            got = model.decode(encoded, view(batch.cameras, index), RESOLUTION)
            close(got[0], render(model, alone)[0])


def test_encoding_looks_at_no_camera() -> None:
    model = awake(tiny_config())
    batch = batch_scenes([random_scene(5)])
    blind = dataclasses.replace(
        batch, c2w_BV44=batch.c2w_BV44 * torch.nan, fov_deg_BV=batch.fov_deg_BV * torch.nan
    )
    with torch.no_grad():
        for seen, unseen in zip(
            model.encode(batch).keys_values, model.encode(blind).keys_values, strict=True
        ):
            assert torch.equal(seen[0], unseen[0]) and torch.equal(seen[1], unseen[1])


def test_cached_cross_attention_is_the_uncached_one() -> None:
    """Against the published order: project, norm, split, rotate for this view, attend."""
    layer = CrossAttention(48, 2).double()
    generator = torch.Generator().manual_seed(0)
    context = torch.randn(2, 9, 48, generator=generator, dtype=torch.float64)
    bundles = torch.randn(2, 3, 5, 48, generator=generator, dtype=torch.float64)
    angles = torch.randn(2, 3, 9, 12, generator=generator, dtype=torch.float64)
    is_key = torch.arange(9) < torch.tensor([[9], [4]])
    with torch.no_grad():
        got = layer(bundles, layer.keys_values(context), (angles.cos(), angles.sin()), is_key)
        for index in range(3):
            rotation = (angles[:, index].cos(), angles[:, index].sin())
            close(got[:, index], uncached(layer, bundles[:, index], context, rotation, is_key))


def uncached(
    layer: CrossAttention, x: Tensor, context: Tensor, rotation: Rotation, is_key: Tensor
) -> Tensor:
    normed = layer.context_norm(context)
    q = split_heads(layer.q_norm(layer.q(x)), layer.num_heads)
    k = rotate(split_heads(layer.k_norm(layer.k(normed)), layer.num_heads), *rotation)
    v = split_heads(layer.v(normed), layer.num_heads)
    return layer.out(merge_heads(attend_reference(q, k, v, is_key)))


def test_what_is_kept_of_a_scene_depends_on_no_view() -> None:
    """Keys must be kept before their rotation: two cameras would otherwise disagree."""
    model = awake(tiny_config())
    batch = batch_scenes([random_scene(5)])
    with torch.no_grad():
        encoded = model.encode(batch)
        context = model.encoder(batch, model.encode(batch).places)
        for index, (k, v) in enumerate(encoded.keys_values):
            layer: Any = model.decoder.layers[index]
            normed = layer.cross.context_norm(context)
            close(merge_heads(k), layer.cross.k_norm(layer.cross.k(normed)))
            close(merge_heads(v), layer.cross.v(normed))


@for_each("eps", [0.0, 1e-5])
def test_registers_stand_where_the_published_divisor_puts_them(eps: float) -> None:
    """In the world and again in the camera: sum / (T + eps) in each frame, by hand."""
    triangles = torch.randn(
        1, 2, 3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    padded = torch.cat([triangles, torch.full_like(triangles, 1e3)], dim=1)
    mask = torch.tensor([[True, True, False, False]])
    c2w = torch.eye(4, dtype=torch.float64)[None, None].clone()
    c2w[..., :3, 3] = torch.tensor([3.0, -2.0, 5.0])
    places = token_places(padded, mask, num_registers=2, eps=eps)
    expected_world = triangles.mean(dim=2).sum(dim=1) / (2 + eps)
    expected_camera = (triangles.mean(dim=2) - c2w[0, 0, :3, 3]).sum(dim=1) / (2 + eps)
    seen: list[Tensor] = []

    def keep(positions: Tensor) -> Rotation:
        seen.append(positions)
        return positions, positions

    world_rotation(keep, places)  # type: ignore[arg-type]
    camera_rotation(keep, places, c2w)  # type: ignore[arg-type]
    for positions, expected in zip(seen, (expected_world, expected_camera), strict=True):
        registers = positions.reshape(-1, 3, 3)[:2]
        # float64 means of six vertices of size 5; eps moves them by 5e-6 of that
        torch.testing.assert_close(registers, expected.expand(2, 3, 3), rtol=0, atol=1e-14)
