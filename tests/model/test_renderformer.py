"""Laws of the whole network, in float64 on tiny sizes, for every family; then of its parts.

Tolerance 1e-11: pictures of size 1 after some twenty layers of float64 sums; a broken law changes
them by 1e-3 and more, as the guard shows. Attention, whole and in windows, is its slow twin; rays
are the conventions', and angles, frequencies and encoded normals those of known numbers.
"""

import dataclasses
import math
from functools import partial

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.func import functional_call

from model.attention import attend, attend_in_windows, cut_windows
from model.layers import CrossAttention, SelfAttention, merge_heads, split_heads
from model.positions import (
    Rotation,
    TriangleRotary,
    camera_rotation,
    encode_normals,
    encoded_normal_width,
    rotate,
    to_camera,
    token_positions,
    world_rotation,
)
from model.renderformer import RenderFormer, radiance
from model.scene_tensors import batch_scenes
from model.view_decoder import bundle_rays, ray_directions, unbundle
from storage.conventions import camera_rays
from storage.errors import TrilightError
from tests.for_each import for_each
from tests.model.kit import (
    FAMILIES,
    RESOLUTION,
    attend_reference,
    awake,
    random_pose,
    random_scene,
    render,
    tiny_config,
    value_and_gradients,
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
    batch = batch_scenes([short, long])
    triangles, normals = batch.triangles_BT33.clone(), batch.normals_BT33.clone()
    triangles[0, 5:], normals[0, 5:] = 1e3, 7.0
    garbage = dataclasses.replace(batch, triangles_BT33=triangles, normals_BT33=normals)
    with torch.no_grad():
        close(model(garbage, RESOLUTION), together)


@for_each("family", FAMILIES)
def test_the_order_of_triangles_does_not_matter_and_rotation_and_order_of_vertices_do(
    family: str,
) -> None:
    """Guards: a network without positions would pass every other law."""
    scene = random_scene(11)
    order = torch.randperm(11, generator=torch.Generator().manual_seed(5))
    shuffled = dataclasses.replace(
        scene,
        triangles_T33=scene.triangles_T33[order],
        normals_T33=scene.normals_T33[order],
        material_TM=scene.material_TM[order],
    )
    model = model_for(family)
    before = render(model, scene)
    close(render(model, shuffled), before)
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
    assert (render(model, turned) - before).abs().max() > 1e-4
    assert (render(model, relabelled) - before).abs().max() > 1e-4


@for_each("family", FAMILIES)
@for_each("distance", [1.0, 100.0])
def test_translating_the_world_changes_neither_context_nor_picture(
    family: str, distance: float
) -> None:
    model = model_for(family)
    scene = random_scene(9)
    offset = torch.tensor([distance, -2 * distance, 0.5], dtype=torch.float64)
    poses = scene.c2w_V44.clone()
    poses[:, :3, 3] += offset
    triangles = scene.triangles_T33 + offset
    moved = dataclasses.replace(scene, triangles_T33=triangles, c2w_V44=poses)
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
    message = f"resolution is {resolution}; expected a positive multiple of {multiple}"
    with pytest.raises(TrilightError, match=message):
        render(model_for(family), random_scene(2), resolution=resolution)


@for_each("family", FAMILIES)
def test_one_encoding_serves_every_camera_in_any_order(family: str) -> None:
    """Views one by one, together, and through what is kept of a scene, which knows no camera."""
    model = model_for(family)
    scene = random_scene(7, num_views=3)
    batch = batch_scenes([scene])
    together = render(model, scene)[0]
    with torch.no_grad():
        encoded = model.encode(batch)
        for index in (2, 0, 1, 0):
            alone = dataclasses.replace(
                scene, c2w_V44=scene.c2w_V44[[index]], fov_deg_V=scene.fov_deg_V[[index]]
            )
            got = model.decode(encoded, batch_scenes([alone]), RESOLUTION)
            close(got[0], render(model, alone)[0])
            close(got[0, 0], together[index])


def test_cached_cross_attention_is_the_uncached_one() -> None:
    """Against the published order: project, norm, split, rotate for this view, attend."""
    layer = CrossAttention(48, 2).double()
    generator = torch.Generator().manual_seed(0)
    context = torch.randn(2, 9, 48, generator=generator, dtype=torch.float64)
    bundles = torch.randn(2, 3, 5, 48, generator=generator, dtype=torch.float64)
    angles = torch.randn(2, 3, 9, 12, generator=generator, dtype=torch.float64)
    is_key = torch.arange(9) < torch.tensor([[9], [4]])
    with torch.no_grad():
        for norm in (layer.context_norm, layer.q_norm, layer.k_norm):
            norm.weight.copy_(torch.rand(48, generator=generator) + 0.5)
        got = layer(bundles, layer.keys_values(context), (angles.cos(), angles.sin()), is_key)
        normed = layer.context_norm(context)
        v = split_heads(layer.v(normed), 2)
        for index in range(3):
            q = split_heads(layer.q_norm(layer.q(bundles[:, index])), 2)
            k = split_heads(layer.k_norm(layer.k(normed)), 2)
            k = rotate(k, angles[:, index].cos(), angles[:, index].sin())
            close(got[:, index], layer.out(merge_heads(attend_reference(q, k, v, is_key))))


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


SHAPES = [(1, 1, 1, 1, 2), (2, 2, 5, 7, 6), (3, 1, 17, 33, 8), (1, 4, 64, 130, 16)]
"""(B, H, Q, N, D): one token, odd sizes, and more keys than a kernel's block."""

MASKS = ["none", "all", "first only", "random", "ragged"]


def make_mask(kind: str, scenes: int, keys: int) -> Tensor | None:
    generator = torch.Generator().manual_seed(3)
    mask = torch.ones(scenes, keys, dtype=torch.bool)
    if kind == "none":
        return None
    if kind == "first only":
        mask[:, 1:] = False
    if kind == "random":
        mask = torch.rand(scenes, keys, generator=generator) < 0.5
        mask[:, -1] = True
    if kind == "ragged":
        mask = torch.arange(keys) < torch.arange(1, scenes + 1)[:, None] * keys / scenes
        mask[:, 0] = True
    return mask


@for_each("kind", MASKS)
@for_each("shape", SHAPES)
@for_each(
    ("dtype", "tolerance"),
    # Sums of up to 130 products: rounding of the dtype (1e-16, 6e-8) times their number.
    [(torch.float64, 1e-13), (torch.float32, 1e-5)],
)
def test_fast_attention_equals_its_slow_twin(
    shape: tuple[int, ...], kind: str, dtype: torch.dtype, tolerance: float
) -> None:
    scenes, heads, queries, keys, width = shape
    generator = torch.Generator().manual_seed(1)
    sizes = [(scenes, heads, length, width) for length in (queries, keys, keys, queries)]
    q, k, v, upstream = (torch.randn(s, generator=generator, dtype=dtype) for s in sizes)
    mask = make_mask(kind, scenes, keys)
    results = (
        value_and_gradients(function, (q, k, v), upstream, mask)
        for function in (attend, attend_reference)
    )
    for fast, slow in zip(*results, strict=True):
        torch.testing.assert_close(fast, slow, rtol=0, atol=tolerance)


CPU = torch.device("cpu")


def rolled_and_masked(q: Tensor, k: Tensor, v: Tensor, width: int, shifted: bool) -> Tensor:
    """Return Swin attention as Liu et al. 2021, section 3.2, describe it, window by window."""
    side = round(q.shape[2] ** 0.5)
    shift = width // 2 if shifted else 0
    grids = [x.unflatten(2, (side, side)).roll((-shift, -shift), dims=(2, 3)) for x in (q, k, v)]
    # regions that a roll brings together but that do not touch in the picture
    line = torch.zeros(side, dtype=torch.long)
    if shift:
        line[side - width : side - shift] = 1
        line[side - shift :] = 2
    region = 3 * line[:, None] + line
    result = torch.zeros_like(grids[0])
    for row in range(0, side, width):
        for column in range(0, side, width):
            rows, columns = slice(row, row + width), slice(column, column + width)
            q1, k1, v1 = (grid[:, :, rows, columns].flatten(2, 3) for grid in grids)
            label = region[rows, columns].flatten()
            for member in label.unique():
                inside = label == member
                q2, k2, v2 = (x[:, :, inside] for x in (q1, k1, v1))
                window = result[:, :, rows, columns].flatten(2, 3)
                window[:, :, inside] = attend_reference(q2, k2, v2, None)
                result[:, :, rows, columns] = window.unflatten(2, (width, width))
    return result.roll((shift, shift), dims=(2, 3)).flatten(2, 3)


@for_each("shifted", [False, True])
@for_each(("side", "width"), [(8, 8), (16, 8), (24, 8), (4, 2), (2, 2)])
def test_windows_are_those_of_the_roll(side: int, width: int, shifted: bool) -> None:
    generator = torch.Generator().manual_seed(side)
    shape = (2, 3, side**2, 4)
    q, k, v = (torch.randn(shape, generator=generator, dtype=torch.float64) for _ in range(3))
    upstream = torch.randn(shape, generator=generator, dtype=torch.float64)

    def ours(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        windows = cut_windows(side, width, shifted=shifted, device=CPU)
        q, k, v = (x[:, :, windows.order_Q] for x in (q, k, v))
        return attend_in_windows(q, k, v, windows)[:, :, windows.back_Q]

    theirs = partial(rolled_and_masked, width=width, shifted=shifted)
    results = (value_and_gradients(each, (q, k, v), upstream) for each in (ours, theirs))
    for got, expected in zip(*results, strict=True):
        # float64 softmax over at most 64 keys
        torch.testing.assert_close(got, expected, rtol=0, atol=1e-13)


def test_a_shifted_cut_has_whole_windows_strips_and_corners_and_asks_no_device() -> None:
    """On the meta device there is nobody to ask; what inference cut, training may use."""
    with torch.inference_mode():
        meta = cut_windows(24, 8, shifted=True, device=torch.device("meta"))
        windows = cut_windows(24, 8, shifted=True, device=CPU)
    assert meta.groups == windows.groups and not windows.back_Q.is_inference()
    assert windows is cut_windows(24, 8, shifted=True, device=CPU), "it is made once"
    assert windows.groups == ((4, 64), (8, 32), (4, 16))
    assert cut_windows(24, 8, shifted=False, device=CPU).groups == ((9, 64),)
    assert torch.equal(windows.order_Q[windows.back_Q], torch.arange(24**2))


@for_each(("shifted", "width"), [(False, 4), (True, 2)])
def test_a_bundle_reaches_its_own_window_only(shifted: bool, width: int) -> None:
    layer = SelfAttention(8, 2).double()
    windows = cut_windows(8, 4, shifted=shifted, device=CPU)
    x = torch.randn(1, 64, 8, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    moved = x.clone()
    moved[0, 0] += 1
    with torch.no_grad():
        change = (layer(moved, windows=windows) - layer(x, windows=windows)).abs().amax(dim=-1)
    expected = torch.zeros(8, 8, dtype=torch.bool)
    expected[:width, :width] = True
    assert torch.equal(change.unflatten(1, (8, 8))[0] > 0, expected)


@for_each("resolution", [8, 24, 256])
@for_each("fov_deg", [1.0, 30.0, 45.0, 60.0, 170.0])
def test_rays_agree_with_the_conventions(resolution: int, fov_deg: float) -> None:
    _, expected = camera_rays(np.eye(4), fov_deg, resolution)
    fov = torch.tensor(fov_deg, dtype=torch.float64)
    got = ray_directions(fov, resolution).movedim(0, -1).numpy()
    # the same formula in float64 on both sides
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-14)
    rounded = ray_directions(fov.float(), resolution).movedim(0, -1).numpy()
    # float32 tangent and square root: a millionth of a radian is a thousandth of a pixel at most
    np.testing.assert_allclose(rounded, expected, rtol=0, atol=1e-6)


def test_a_bundle_holds_its_patch_channel_major_and_unbundling_inverts_it() -> None:
    resolution, patch = 24, 8
    picture = torch.arange(3 * resolution**2).reshape(1, 3, resolution, resolution)
    bundles = bundle_rays(picture, patch)
    assert bundles.shape == (1, 9, 192)
    for row in range(3):
        for column in range(3):
            rows, columns = slice(8 * row, 8 * row + 8), slice(8 * column, 8 * column + 8)
            assert torch.equal(bundles[0, 3 * row + column], picture[0, :, rows, columns].flatten())
    assert torch.equal(unbundle(bundles, patch), picture)


def test_angles_are_coordinate_times_log_spaced_frequency_coordinate_major() -> None:
    rotary = TriangleRotary(num_freqs=2, max_freq=5.0, head_width=40)
    cos, sin = rotary(torch.arange(1.0, 10.0).reshape(1, 1, 3, 3))
    angles = [coordinate * frequency for coordinate in range(1, 10) for frequency in (1.0, 5.0)]
    expected = torch.tensor([*angles, 0, 0])
    # float32 sine of angles up to 45 radians
    torch.testing.assert_close(cos[0, 0], expected.cos(), rtol=0, atol=1e-5)
    torch.testing.assert_close(sin[0, 0], expected.sin(), rtol=0, atol=1e-5)
    for num_freqs, max_freq, freqs in (
        (1, 5.0, [1.0]),
        (3, 5.0, [1.0, 5.0**0.5, 5.0]),
        # both published sets, as the documents print them
        (6, 5.0, [1, 1.38, 1.90, 2.63, 3.62, 5.0]),
        (6, 11.0, [1, 1.62, 2.61, 4.22, 6.81, 11.0]),
    ):
        rotary = TriangleRotary(num_freqs=num_freqs, max_freq=max_freq, head_width=128)
        # two printed decimals
        torch.testing.assert_close(rotary.freqs_F, torch.tensor(freqs), rtol=0, atol=6e-3)


def test_rotation_pairs_channel_i_with_channel_i_plus_half() -> None:
    """As one complex number, which is turned counter-clockwise."""
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(2, 3, 5, 8, generator=generator, dtype=torch.float64)
    angle = torch.randn(2, 5, 4, generator=generator, dtype=torch.float64)
    turned = rotate(x, angle.cos(), angle.sin())
    expected = torch.complex(x[..., :4], x[..., 4:]) * torch.exp(1j * angle)[:, None]
    close(turned, torch.cat([expected.real, expected.imag], dim=-1))


def test_normal_encoding_of_known_numbers() -> None:
    normals = torch.linspace(-1, 1, 9, dtype=torch.float64)
    encoded = encode_normals(normals.reshape(1, 1, 3, 3), octaves=3)[0, 0]
    phases = [c * 2**k for c in normals.tolist() for k in range(3)]
    waves = [function(phase) for function in (math.sin, math.cos) for phase in phases]
    assert len(encoded) == encoded_normal_width(3)
    close(encoded, torch.tensor([*normals.tolist(), *waves], dtype=torch.float64))


def test_camera_space_is_the_inverse_pose() -> None:
    scene = random_scene(5, num_views=3)
    inside = to_camera(scene.triangles_T33[None], scene.c2w_V44[None])[0]
    rotation, origin = scene.c2w_V44[:, None, :3, :3], scene.c2w_V44[:, None, None, :3, 3]
    outside = inside @ rotation.transpose(-1, -2) + origin
    close(outside, scene.triangles_T33.expand(3, -1, -1, -1))
