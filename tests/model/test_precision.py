"""What is rounded, recomputed or packed gives what it gave, as near as is said."""

import copy
import dataclasses

import numpy as np
import pytest
import torch
from torch import Tensor

from model import encoded_scene, rounding
from model.packing import pack_lengths, pack_tokens
from model.precision import rounded_parts, set_precision, tf32
from model.scene_tensors import SceneBatch, batch_scenes, map_tensors, scene_tensors, tensors_of
from storage.errors import TrilightError
from storage.records.environment import Environment
from storage.records.material import EMISSION, material_width
from storage.records.scene import ARRAY_FIELDS
from tests.for_each import for_each
from tests.model.kit import (
    FAMILIES,
    RESOLUTION,
    awake,
    picture_and_gradients,
    random_scene,
    render,
    tiny_config,
)
from tests.train.toy import toy_scene


def batch_of(*lengths: int, dtype: torch.dtype = torch.float64) -> SceneBatch:
    """Return a batch of scenes of so many triangles, each a scene of its own."""
    return batch_scenes([random_scene(n, seed=row, dtype=dtype) for row, n in enumerate(lengths)])


@for_each("family", FAMILIES)
def test_bfloat16_rounds_the_layers_and_keeps_what_makes_tokens(family: str) -> None:
    model = set_precision(awake(tiny_config(family), torch.float32), "bfloat16")
    rounded = {id(weight) for part in rounded_parts(model) for weight in part.parameters()}
    for name, weight in model.named_parameters():
        assert weight.dtype == (torch.bfloat16 if id(weight) in rounded else torch.float32), name
    exact = {name for name, weight in model.named_parameters() if id(weight) not in rounded}
    tokens = {"encoder.tokens.material.weight", "decoder.rays.weight", "encoder.registers_NW"}
    assert exact > tokens | {"decoder.head.last.weight"}
    assert "decoder.layers.0.ffn.up.weight" not in exact
    assert model.encoder.rotary.freqs_F.dtype == torch.float32


@for_each("family", FAMILIES)
def test_pictures_are_float32_and_near(family: str) -> None:
    exact = awake(tiny_config(family), torch.float32)
    scene = random_scene(9, dtype=torch.float32)
    expected = render(exact, scene)
    assert torch.equal(render(set_precision(exact, "float32"), scene), expected)
    got = render(set_precision(copy.deepcopy(exact), "bfloat16"), scene)
    assert got.dtype == torch.float32
    # 8 bits through some ten layers; pictures of size 1, and not equal at all
    error = (got - expected).square().mean().sqrt() / expected.std()
    assert 1e-5 < error < 5e-2


def test_positions_are_never_rounded() -> None:
    """A scene 100 m out: bfloat16 would know its positions to half a metre."""
    model = set_precision(awake(tiny_config(), torch.float32), "bfloat16")
    near = random_scene(6)
    far = copy.deepcopy(near)
    far.triangles_T33.add_(100.0)
    far.c2w_V44[:, :3, 3].add_(100.0)
    pictures = [render(model, map_tensors(scene, torch.Tensor.float)) for scene in (near, far)]
    # the angles move by 100 x 5 / 2^24; what they turn is rounded to 8 bits, so some ulps of that
    assert (pictures[0] - pictures[1]).abs().max() < 0.1 * pictures[0].std()


@for_each(
    ("name", "message"),
    [
        ("tf32", "precision tf32: the network is on cpu"),
        ("float16", "precision float16: the network is on cpu"),
        ("float8", "float8.*expected one of float32, bfloat16"),
    ],
)
def test_what_a_cpu_has_no_path_for_is_refused(name: str, message: str) -> None:
    with pytest.raises(TrilightError, match=message):
        set_precision(awake(tiny_config(), torch.float32), name)


def test_tf32_is_set_for_a_while_only() -> None:
    before = torch.backends.cuda.matmul.fp32_precision
    for allowed, expected in ((True, "tf32"), (False, "ieee")):
        with tf32(allowed):
            assert torch.backends.cuda.matmul.fp32_precision == expected
        assert torch.backends.cuda.matmul.fp32_precision == before


@for_each("family", FAMILIES)
def test_recomputed_gradients_are_the_same_bit_by_bit(family: str) -> None:
    model, batch = awake(tiny_config(family)), batch_of(3, 5)
    model.recompute_activations(False)
    kept = picture_and_gradients(model, batch)
    model.recompute_activations(True)
    again = picture_and_gradients(model, batch)
    assert kept.keys() == again.keys() == {"picture", *dict(model.named_parameters())}
    for name, value in kept.items():
        assert torch.equal(value, again[name]), name


def test_less_is_kept_for_the_way_back() -> None:
    model, batch, kept = awake(tiny_config()), batch_of(40), [0, 0]
    for wanted in (False, True):
        model.recompute_activations(wanted)

        def keep(tensor: Tensor, wanted: bool = wanted) -> Tensor:
            kept[wanted] += tensor.numel()
            return tensor

        with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            model(batch, RESOLUTION)
    assert kept[1] < 0.5 * kept[0]


@for_each("recompute", [False, True])
@for_each("family", ["linear", "dpt"])
def test_rounding_together_changes_no_bit(
    family: str, recompute: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = awake(tiny_config(family), dtype=torch.float32)
    model.recompute_activations(recompute)
    batch = batch_of(3, 5, dtype=torch.float32)
    rounded: list[int] = []
    together = rounding._copy_as

    def counted(tensors: tuple[Tensor, ...], to: torch.dtype) -> tuple[Tensor, ...]:
        rounded.append(len(tensors))
        return together(tensors, to)

    @torch.autocast("cpu", torch.bfloat16)
    def results() -> dict[str, Tensor]:
        return picture_and_gradients(model, batch)

    monkeypatch.setattr(rounding, "_copy_as", counted)
    found = results()
    layers = len(model.encoder.layers) + len(model.decoder.layers) + (family == "dpt")
    assert len(rounded) == 2 * layers, "once forth and once back for each layer, and the head"
    monkeypatch.setattr(rounding, "_round_weights", lambda *_: {})
    alone = results()
    assert found.keys() == alone.keys()
    for name, value in found.items():
        assert torch.equal(value, alone[name]), name


def test_without_autocast_nothing_is_rounded() -> None:
    layer = torch.nn.Linear(3, 3)
    assert rounding.rounded_weights(layer, torch.device("cpu")) == {}
    assert rounding.rounded_weights(layer, torch.device("meta")) == {}


def test_every_triangle_carries_its_own_vertices_normals_and_material() -> None:
    scene = toy_scene(0)
    tensors = scene_tensors(scene)
    assert tensors.num_triangles == scene.num_triangles
    assert tensors.num_views == scene.num_views
    for row in range(scene.num_triangles):
        corners = scene.faces[row]
        material = scene.materials[scene.material_index[row]]
        np.testing.assert_array_equal(tensors.triangles_T33[row], scene.vertex_positions[corners])
        np.testing.assert_array_equal(tensors.normals_T33[row], scene.vertex_normals[corners])
        np.testing.assert_array_equal(tensors.material_TM[row, :7], material[:7])
        emission = 10.0 ** tensors.material_TM[row, 7:].double().numpy() - 1
        # emission of 20 through a float32 logarithm
        np.testing.assert_allclose(emission, material[EMISSION], atol=1e-4)
    assert tensors.material_TM.shape[1] == material_width()
    assert all(value.dtype == torch.float32 for value in tensors_of(tensors).values())


def test_the_scene_stays_as_it_was_and_shares_no_memory() -> None:
    scene = toy_scene(1)
    before = {name: getattr(scene, name).copy() for name in ARRAY_FIELDS}
    tensors = scene_tensors(scene)
    for value in tensors_of(tensors).values():
        value.fill_(-1)
    for name, array in before.items():
        np.testing.assert_array_equal(getattr(scene, name), array, err_msg=name)


def test_batches_are_padded_with_zeros_to_the_longest_and_no_further() -> None:
    scenes = [random_scene(3, seed=1), random_scene(7, seed=2), random_scene(5, seed=3)]
    batch = batch_scenes(scenes)
    assert batch.num_triangles == (3, 7, 5)
    assert batch.triangles_BT33.shape[1] == 7
    assert batch.is_triangle_BT is not None
    assert batch.is_triangle_BT.sum(1).tolist() == [3, 7, 5]
    for row, scene in enumerate(scenes):
        length = scene.num_triangles
        for name in ("triangles", "normals", "material"):
            suffix = "M" if name == "material" else "33"
            padded = getattr(batch, f"{name}_BT{suffix}")[row]
            assert torch.equal(padded[:length], getattr(scene, f"{name}_T{suffix}"))
            assert torch.all(padded[length:] == 0)
    equal = batch_of(4, 4)
    assert equal.is_triangle_BT is None and equal.num_triangles is None, "no mask is needed"


def test_a_black_sky_is_none() -> None:
    for height, radiance, is_there in ((2, 1.0, True), (2, 0.0, False), (1, 0.0, False)):
        texels = np.full((height, 2 * height, 3), radiance, np.float32)
        scene = dataclasses.replace(toy_scene(0), environment=Environment(radiance_rgb=texels))
        batch = batch_scenes([scene_tensors(scene)])
        assert (batch.skies is not None) == is_there


LENGTHS = (5, 9, 1)


@for_each("family", FAMILIES)
def test_a_packed_batch_is_the_padded_one(family: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a card the kernel is torch's; here its slow twin, sequence after sequence."""
    model, batch = awake(tiny_config(family)), batch_of(*LENGTHS)
    padded = picture_and_gradients(model, batch)
    monkeypatch.setattr(encoded_scene, "supports_packed", lambda *_: True)
    monkeypatch.setattr("model.attention.scaled_dot_product_attention", _forbid_masks)
    for name, found in picture_and_gradients(model, batch).items():
        wanted = padded[name]
        assert (found - wanted).abs().max() <= 1e-11 * wanted.abs().max().clamp(min=1), name


def _forbid_masks(q: Tensor, k: Tensor, v: Tensor, attn_mask: Tensor | None) -> Tensor:
    assert attn_mask is None, "nothing that is padded is attended with a mask"
    return torch.nn.functional.scaled_dot_product_attention(q, k, v)


def test_packing_keeps_what_exists_and_gradients_go_back_there() -> None:
    packing = pack_lengths(LENGTHS, 9, torch.device("cpu"))
    x = torch.arange(27.0).reshape(3, 9, 1).requires_grad_()
    exists = torch.arange(9) < torch.tensor(LENGTHS)[:, None]
    there = pack_tokens(x, packing)
    assert torch.equal(there.detach(), x.detach()[exists])
    starts_S1, longest = packing.sequences
    assert starts_S1.tolist() == [0, 5, 14, 15] and longest >= 9
    assert packing.of_views(2).starts_S1.tolist() == [0, 5, 14, 15, 20, 29, 30]
    (there * there.detach()).sum().backward()
    assert x.grad is not None
    assert torch.equal(x.grad[..., 0], x.detach()[..., 0] * exists)
