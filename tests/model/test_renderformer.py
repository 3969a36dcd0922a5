"""Laws of the whole network, in float64 on tiny sizes, for every family.

Tolerance 1e-11: pictures of size 1 after some twenty layers of float64 sums; a broken law changes
them by 1e-3 and more, as the two guards show.
"""

import dataclasses

import pytest
import torch
from torch import Tensor, nn
from torch.func import functional_call

from model.layers import CrossAttention, merge_heads, split_heads
from model.positions import Rotation, camera_rotation, rotate, token_positions, world_rotation
from model.renderformer import RenderFormer, radiance
from model.scene_tensors import SceneTensors, batch_scenes, map_tensors
from storage.errors import TrilightError
from tests.for_each import for_each
from tests.model.attention_reference import attend_reference
from tests.model.kit import (
    FAMILIES,
    RESOLUTION,
    awake,
    one_view,
    random_pose,
    random_scene,
    render,
    tiny_config,
)

TIGHT = 1e-11


def model_for(family: str) -> RenderFormer:
    return awake(tiny_config(family))


def close(got: Tensor, expected: Tensor) -> None:
    torch.testing.assert_close(got, expected, rtol=0, atol=TIGHT)


@for_each("family", FAMILIES)
def test_company_and_padding_do_not_change_a_picture(family: str) -> None:
    model = model_for(family)
    short, long = random_scene(5, seed=1), random_scene(19, seed=2)
    together = render(model, short, long)
    assert together.shape == (2, 2, RESOLUTION, RESOLUTION, 3)
    close(together[0], render(model, short)[0])
    close(together[1], render(model, long)[0])


@for_each("family", FAMILIES)
def test_finite_garbage_in_the_padding_changes_nothing(family: str) -> None:
    model = model_for(family)
    batch = batch_scenes([random_scene(3, seed=1), random_scene(6, seed=2)])
    triangles, normals = batch.triangles_BT33.clone(), batch.normals_BT33.clone()
    triangles[0, 3:], normals[0, 3:] = 1e3, 7.0
    dirty = dataclasses.replace(batch, triangles_BT33=triangles, normals_BT33=normals)
    with torch.no_grad():
        close(model(dirty, RESOLUTION), model(batch, RESOLUTION))


@for_each("family", FAMILIES)
def test_the_order_of_triangles_does_not_matter(family: str) -> None:
    scene = random_scene(11)
    order = torch.randperm(11, generator=torch.Generator().manual_seed(5))
    shuffled = dataclasses.replace(
        scene,
        triangles_T33=scene.triangles_T33[order],
        normals_T33=scene.normals_T33[order],
        material_TM=scene.material_TM[order],
    )
    model = model_for(family)
    close(render(model, shuffled), render(model, scene))


@for_each("family", FAMILIES)
@for_each("distance", [1.0, 100.0])
def test_translating_the_world_changes_neither_context_nor_picture(
    family: str, distance: float
) -> None:
    model = model_for(family)
    scene = random_scene(9)
    moved = translated(scene, torch.tensor([distance, -2 * distance, 0.5], dtype=torch.float64))
    with torch.no_grad():
        context, context_moved = (
            model.encoder(batch, model.encode(batch).places)
            for batch in (batch_scenes([scene]), batch_scenes([moved]))
        )
    # Angles grow with the distance, and so does what float64 loses of them.
    torch.testing.assert_close(context_moved, context, rtol=0, atol=TIGHT * distance)
    torch.testing.assert_close(
        render(model, moved), render(model, scene), rtol=0, atol=TIGHT * distance
    )


def translated(scene: SceneTensors, offset: Tensor) -> SceneTensors:
    poses = scene.c2w_V44.clone()
    poses[:, :3, 3] += offset
    return dataclasses.replace(scene, triangles_T33=scene.triangles_T33 + offset, c2w_V44=poses)


def test_float32_stays_near_float64() -> None:
    scene = random_scene(9)
    precise = render(awake(tiny_config(), torch.float64), scene)
    single = map_tensors(scene, Tensor.float)
    rounded = render(awake(tiny_config(), torch.float32), single).double()
    # float32 through twenty layers; positions of size 3 at frequency 5 cost another digit
    torch.testing.assert_close(rounded, precise, rtol=0, atol=2e-5)


def test_gradients_are_those_of_finite_differences() -> None:
    model = awake(tiny_config(width=36, hidden_width=8, encoder_layers=1, decoder_layers=1))
    batch = batch_scenes([random_scene(2, num_views=1, seed=1), random_scene(3, 1, seed=2)])
    names = ["encoder.registers_NW", "encoder.tokens.material.weight", "decoder.head.norm.weight"]
    weights = dict(model.named_parameters())

    def picture(triangles: Tensor, normals: Tensor, c2w: Tensor, *changed: Tensor) -> Tensor:
        scene = dataclasses.replace(
            batch, triangles_BT33=triangles, normals_BT33=normals, c2w_BV44=c2w
        )
        replaced = dict(zip(names, changed, strict=True))
        return functional_call(model, replaced, (scene, 8))[..., ::5, ::5, :]

    inputs = [batch.triangles_BT33, batch.normals_BT33, batch.c2w_BV44]
    inputs += [weights[name].detach().clone() for name in names]
    # along drawn directions: one slope for each input, and not one for each of its numbers
    values = [value.requires_grad_() for value in inputs]
    assert torch.autograd.gradcheck(picture, values, fast_mode=True)


@for_each("family", ["linear", "swin"])  # which has all parameters of dpt
def test_every_parameter_reaches_the_picture(family: str) -> None:
    model = model_for(family)
    scene = random_scene(6, num_views=1)
    before = render(model, scene)
    for name, weight in model.named_parameters():
        kept = weight.detach().clone()
        noise = torch.randn(weight.shape, generator=torch.Generator().manual_seed(1))
        with torch.no_grad():
            weight.add_(0.1 * noise)
        # 1e-9 is far above float64's rounding and far below the effect of a tenth
        assert (render(model, scene) - before).abs().max() > 1e-9, name
        with torch.no_grad():
            weight.copy_(kept)


def test_a_fresh_network_is_black_and_learns_from_every_picture() -> None:
    model = RenderFormer(tiny_config()).double()
    model.initialize(torch.Generator().manual_seed(0))
    output = model(batch_scenes([random_scene(4)]), RESOLUTION)
    assert torch.all(output == 0)
    (output - 0.1).abs().mean().backward()
    bias = model.decoder.head.last.bias
    assert bias is not None and bias.grad is not None
    # 192 values share a mean of slope 1 / 3 each channel: not a thousandth of it, as behind the ELU
    assert bias.grad.abs().sum() > 0.9


def test_norms_have_the_published_epsilons() -> None:
    """By attribute: the picture cannot tell 1e-6 from 1e-5 (1e-7 of it)."""
    tokens = {f"encoder.tokens.{name}_norm" for name in ("material", "normal")}
    tokens.add("decoder.rays_norm")
    modules = dict(model_for("linear").named_modules())
    norms = {name: each.eps for name, each in modules.items() if isinstance(each, nn.RMSNorm)}
    assert tokens < set(norms)
    for name, eps in norms.items():
        assert eps == (1.1920929e-07 if name in tokens else 1e-6), name


def test_radiance_undoes_the_logarithm_and_bounds_the_dark() -> None:
    log10 = torch.tensor([0.0, 0.5, 3.0], dtype=torch.float64)
    expected = torch.tensor([0.0, 10**0.5 - 1, 999.0], dtype=torch.float64)
    torch.testing.assert_close(radiance(log10), expected)
    darkest = radiance(torch.tensor([-50.0], dtype=torch.float64)).item()
    assert -2.31e-3 < darkest < -2.29e-3  # 10^-0.001 - 1


@for_each(
    ("family", "resolution", "multiple"),
    [*(("linear", px, 8) for px in (0, 4, 12, -8)), *(("swin", px, 16) for px in (0, 8, 24))],
)
def test_a_resolution_that_bundles_or_windows_do_not_fill_is_refused(
    family: str, resolution: int, multiple: int
) -> None:
    message = f"resolution {resolution}: expected a multiple of {multiple}"
    with pytest.raises(TrilightError, match=message):
        render(model_for(family), random_scene(2), resolution=resolution)


@for_each("family", FAMILIES)
def test_rotation_and_vertex_order_do_change_the_picture(family: str) -> None:
    """Guards: a network without positions would pass every law above."""
    model = model_for(family)
    scene = random_scene(6)
    rotation = random_pose(torch.Generator().manual_seed(9))[:3, :3]
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation
    turned = dataclasses.replace(
        scene,
        triangles_T33=scene.triangles_T33 @ rotation.T,
        normals_T33=scene.normals_T33 @ rotation.T,
        c2w_V44=pose @ scene.c2w_V44,
    )
    relabelled = dataclasses.replace(
        scene,
        triangles_T33=scene.triangles_T33.roll(1, dims=1),
        normals_T33=scene.normals_T33.roll(1, dims=1),
    )
    before = render(model, scene)
    assert (render(model, turned) - before).abs().max() > 1e-4
    assert (render(model, relabelled) - before).abs().max() > 1e-4


@for_each("family", FAMILIES)
def test_one_encoding_serves_every_camera_in_any_order(family: str) -> None:
    """Views one by one, together, and through what is kept of a scene."""
    model = model_for(family)
    scene = random_scene(7, num_views=3)
    batch = batch_scenes([scene])
    together = render(model, scene)[0]
    with torch.no_grad():
        encoded = model.encode(batch)
        for index in (2, 0, 1, 0):
            alone = one_view(scene, index)
            got = model.decode(encoded, batch_scenes([alone]).cameras, RESOLUTION)
            close(got[0], render(model, alone)[0])
            close(got[0, 0], together[index])


def test_encoding_looks_at_no_camera() -> None:
    """Keys must be kept before their rotation: two cameras would otherwise disagree."""
    model = awake(tiny_config())
    batch = batch_scenes([random_scene(5)])
    blind = dataclasses.replace(
        batch, c2w_BV44=batch.c2w_BV44 * torch.nan, fov_deg_BV=batch.fov_deg_BV * torch.nan
    )
    with torch.no_grad():
        kept = [model.encode(each).keys_values for each in (batch, blind)]
    for seen, unseen in zip(*kept, strict=True):
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
    places = token_positions(padded, mask, num_registers=2, eps=eps)
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
