"""The network that is told hits: what it passes on, what it reads, what it can do without.

And views whose rays a card traces: their code on the CPU's tensors, and the kernel beside Embree.
"""

import ctypes
import dataclasses
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from model.hits import decoder
from model.hits.decoder import _around
from model.hits.device_arrays import DeviceArray, DevicePlace
from model.hits.device_rays import SOURCE, DeviceTriangles, build_tree
from model.hits.traced import INPUTS
from model.hits.tracing import traced_views, with_traced
from model.hits.view_inputs import Channel
from model.inference import NeuralRenderer
from model.open import WEIGHTS_NAME, open_network
from model.renderformer import RenderFormer, radiance
from model.scene_tensors import SceneBatch, SceneTensors, batch_scenes, map_tensors, scene_tensors
from model.weights import encode_weights
from scene_templates.rotations import uniform_rotation
from storage.errors import TrilightError
from storage.raycast import RayHits, Triangles
from storage.records.material import EMISSION
from storage.records.scene import Scene
from tests.for_each import for_each
from tests.model.hits.kit import FLOOR, WALL, corner, lit_scene, textured, traced
from tests.model.kit import awake, hits_config, picture_and_gradients, render
from tests.pipeline.renders.scene_kit import join, material, quad, sphere
from tests.sky_maps import constant, one_sun, smooth

PX = 32


def network(**changes: Any) -> RenderFormer:
    """Return a network none of whose parts is zero: it stands for a trained one."""
    return awake(hits_config(**changes), torch.float32)


def tensors(scene: Scene) -> SceneTensors:
    return with_traced(scene_tensors(scene), PX, hits_config(), 0)


def in_double(batch: SceneBatch) -> SceneBatch:
    return map_tensors(batch, lambda each: each.double() if each.is_floating_point() else each)


def test_anchors_around_a_part_are_those_beside_it() -> None:
    numbers = torch.arange(16.0).reshape(1, 16, 1)
    around = _around(numbers, 4)[0, ..., 0]
    assert around[5].tolist() == [0, 1, 2, 4, 5, 6, 8, 9, 10]
    assert around[0].tolist() == [0, 0, 1, 0, 0, 1, 4, 4, 5], "at the rim the nearest stand again"


def test_gradients_are_those_of_differences() -> None:
    """In double precision, for some weights of every part."""
    model = network().double()
    scenes = in_double(batch_scenes([tensors(corner())]))

    def value() -> Tensor:
        total: Tensor = model(scenes, PX).square().sum()
        return total

    model.zero_grad()
    value().backward()
    for weight in (model.decoder.head.last.weight, model.decoder.told.weight,
                   model.encoder.tokens.light.weight, model.decoder.head.nearness):  # fmt: skip
        flat, grad = weight.data.view(-1), weight.grad.view(-1)
        at = int(grad.abs().argmax())
        step = 1e-5
        flat[at] += step
        with torch.no_grad():
            above = value()
        flat[at] -= 2 * step
        with torch.no_grad():
            below = value()
        flat[at] += step
        # central differences: the error falls with the square of the step
        assert float((above - below) / (2 * step)) == pytest.approx(float(grad[at]), rel=1e-4)


def test_a_picture_that_moves_by_half_an_anchor_shows_no_seam() -> None:
    """Other anchors know other light: where nine give way to the next nine, nothing jumps."""
    model, resolution, side = network(), 64, 8
    step = resolution // side
    scene = scene_tensors(corner())
    inputs = with_traced(scene, resolution, hits_config()).traced
    assert inputs is not None
    center = slice(resolution // 2, resolution // 2 + 1)
    middle = torch.arange(side) * step + step // 2
    inputs = dataclasses.replace(
        inputs,
        pixels_VRRC=inputs.pixels_VRRC[:, center, center].expand_as(inputs.pixels_VRRC),
        anchor_VA=(middle[:, None] * resolution + middle).reshape(1, -1),
    )
    generator = torch.Generator().manual_seed(0)
    pictures = []
    for _ in range(2):
        known = inputs.unit_3 * torch.rand(1, side * side, 3, generator=generator)
        traced_inputs = dataclasses.replace(inputs, gathered_VA3=known)
        with torch.no_grad():
            shown = model(batch_scenes([dataclasses.replace(scene, traced=traced_inputs)]), 64)
        pictures.append(shown[0, 0])
    half = step // 2
    moved = pictures[0][half:-half, half:-half] - pictures[1][2 * half :, 2 * half :]
    steps = moved.diff(dim=0).abs().mean(dim=(1, 2))
    between = torch.arange(1, len(moved)) % half == 0
    assert steps[between].mean() < 1.2 * steps[~between].mean()


def test_all_views_at_once_are_the_views_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """While learning on a card; pictures and gradients, in double precision.

    What a bias of keys is told is zero but for rounding, hence a least scale for all.
    """
    model, batch = network().double(), in_double(batch_scenes([tensors(corner())] * 2))
    one_by_one = picture_and_gradients(model, batch)
    monkeypatch.setattr(decoder, "_blocks", lambda *_: [slice(None)])
    at_once = picture_and_gradients(model, batch)
    sizes = {name: float(value.abs().max()) for name, value in one_by_one.items()}
    least = 1e-6 * max(size for name, size in sizes.items() if name != "picture")
    assert least > 0 and at_once.keys() == one_by_one.keys()
    for name, size in sizes.items():
        apart = float((at_once[name] - one_by_one[name]).abs().max())
        assert apart <= 1e-12 * max(least, size), name  # thousands of roundings


def test_before_any_training_what_was_traced_is_passed_on() -> None:
    """Every gain is 1 and what is learned is a twentieth of the scene's mean light."""
    model = RenderFormer(hits_config(filter_width=0))
    model.initialize(torch.Generator().manual_seed(0))
    scene = corner()
    inputs = traced(scene, PX, shades_each_ray=True)
    shown = radiance(render(model, tensors(scene))[0, 0]).numpy()
    known = inputs.pixels[..., Channel.SHOWN_DIFFUSE] + inputs.pixels[..., Channel.DIRECT_SPECULAR]
    known = known + inputs.pixels[..., Channel.MIRRORED]
    assert (shown >= known * (1 - 1e-4) - 1e-5).all()
    assert (shown - known).mean() < 0.5 * known.mean()
    assert not shown[inputs.pixels[..., 0] == 0].any(), "nothing is met: black"


@for_each("tokens", [True, False])
def test_the_picture_scales_with_the_lamps(tokens: bool) -> None:
    scene = corner()
    materials = scene.materials.copy()
    materials[:, EMISSION] *= np.array([8.0, 4.0, 2.0], np.float32)
    brighter = dataclasses.replace(scene, materials=materials)
    model = network(scene_tokens=tokens)
    one, other = (radiance(render(model, tensors(each))[0, 0]) for each in (scene, brighter))
    # colours change the odds with which lamps are drawn; one lamp leaves nothing to draw
    torch.testing.assert_close(other, one * torch.tensor([8.0, 4.0, 2.0]), rtol=2e-3, atol=1e-4)


def test_pictures_of_a_batch_are_those_of_the_scenes_alone() -> None:
    small = corner()
    kept = scene_tensors(small)
    fewer = dataclasses.replace(
        kept,
        triangles_T33=kept.triangles_T33[4:],
        normals_T33=kept.normals_T33[4:],
        material_TM=kept.material_TM[4:],
    )
    scenes = [tensors(small), with_traced(fewer, PX, hits_config(), 0)]
    model = network()
    together = render(model, *scenes)
    for index, scene in enumerate(scenes):
        torch.testing.assert_close(together[index], render(model, scene)[0], rtol=1e-3, atol=1e-5)


def test_what_comes_traced_is_what_the_network_traces_itself() -> None:
    scene, model = corner(), network()
    plain = scene_tensors(scene)
    assert torch.equal(render(model, plain), render(model, tensors(scene)))
    renderer = NeuralRenderer(model)
    shown = renderer.render(scene, PX)[0]
    expected = radiance(render(model, plain)[0, 0]).numpy()
    np.testing.assert_allclose(shown, expected, rtol=1e-4, atol=1e-6)
    with pytest.raises(TrilightError, match="multiple of 8"):
        renderer.render(scene, 30)


def test_each_input_is_read_and_can_be_withheld() -> None:
    model, scene = network(), tensors(corner())
    whole = render(model, scene)
    assert scene.traced is not None
    for index, name in enumerate(INPUTS):
        kept = torch.ones(1, len(INPUTS))
        kept[0, index] = 0
        without = dataclasses.replace(scene, traced=scene.traced.without(kept))
        shown = render(model, without)
        assert torch.isfinite(shown).all()
        assert (shown - whole).abs().max() > 1e-4, name


@for_each("tokens", [True, False])
def test_every_weight_has_a_gradient_and_comes_back_from_its_file(
    tokens: bool, tmp_path: Path
) -> None:
    model = network(scene_tokens=tokens)
    assert tokens == any(name.startswith("encoder") for name, _ in model.named_parameters())
    model(batch_scenes([tensors(corner())]), PX).square().sum().backward()
    for name, weight in model.named_parameters():
        assert weight.grad is not None, name
        assert weight.grad.abs().max() > 0, name
    (tmp_path / WEIGHTS_NAME).write_bytes(encode_weights(model))
    again = open_network(tmp_path)
    assert again.config == model.config
    assert any(isinstance(each, nn.RMSNorm) for each in again.decoder.modules()), "for training"
    scene = tensors(corner())
    shown = render(again, scene)
    assert torch.equal(shown, render(model.eval(), scene)) and torch.isfinite(shown).all()


@pytest.mark.skipif(
    os.environ.get("ATEN_CPU_CAPABILITY") == "default",
    reason="torch's attention then packs for AMX, which the processor has, and cannot: pack_vnni2",
)
def test_it_takes_bfloat16_for_what_is_rounded() -> None:
    from model.precision import set_precision

    scene = tensors(corner())
    exact = render(network(), scene)
    rounded = render(set_precision(network(), "bfloat16"), scene)
    assert rounded.dtype == torch.float32
    # 8 bits of mantissa in anchors alone, whose numbers gain at most twice what was traced
    assert (rounded - exact).abs().mean() < 0.03 * exact.abs().mean()


HOST = torch.device("cpu")
TURN = uniform_rotation(np.random.default_rng(3)).astype(np.float32)
needs_card = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")


class _OnHost:
    """Embree for tensors of the HOST."""

    def __init__(self, corners: NDArray, rows: NDArray, place: DevicePlace) -> None:
        self._embree, self._place = Triangles(corners, rows), place

    def intersect(self, origins: DeviceArray, directions: DeviceArray) -> RayHits:
        met = self._embree.intersect(origins.tensor.numpy(), directions.tensor.numpy())
        uv = np.where(met.triangle >= 0, met.uv, np.float32(0))
        return RayHits(triangle=self._place.array(met.triangle), uv=self._place.array(uv))

    def is_free(self, *rays: DeviceArray) -> DeviceArray:
        return self._place.array(self._embree.is_free(*(each.tensor.numpy() for each in rays)))


class _NothingRead(TorchDispatchMode):
    """Refuse what no graph of CUDA can hold: numbers for the host, shapes that they decide."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.overloadpacket.__name__
        indices = args[1] if name in ("index", "index_put", "index_put_") else ()
        by_mask = any(each is not None and each.dtype == torch.bool for each in indices)
        assert not by_mask and name not in ("_local_scalar_dense", "nonzero", "masked_select")
        return func(*args, **(kwargs or {}))


def _below_a_lit_ball() -> Scene:
    """Return a corner with 264 lamps."""
    lamp = material(diffuse=0.0, emission=[9.0, 8.0, 7.0])
    ball = dataclasses.replace(sphere([0.4, 0.2, 2.0], 0.2, lamp, rings=9), kind="emitter")
    parts = [quad(FLOOR, material(diffuse=0.5, specular=0.3, roughness=0.2)), ball]
    return join(parts, eye=(1.0, -3.0, 1.4), target=(0, 0, 0.4), fov_deg=38.0)


BELOW_SKIES = [
    corner(roughness=0.05, sky=smooth(rotation=TURN)),
    corner(roughness=0.05, radiance=0.0, sky=one_sun(1e4, rotation=TURN)),
]


@for_each("scene", [corner(), textured(), _below_a_lit_ball(), *BELOW_SKIES])
def test_a_view_of_tensors_is_numpys(scene: Scene) -> None:
    numpy_form = lit_scene(scene)
    place = DevicePlace(HOST)
    tensor_form = numpy_form.on(place, _OnHost)
    config = hits_config(hit_rays=2, gather_rays=4, sky_rays=3)
    given = torch.tensor(scene.c2w[:1]), torch.tensor(scene.fov_deg[:1]), 32
    expected, got = (traced_views(form, *given, config) for form in (numpy_form, tensor_form))
    held = len(place._held)
    with _NothingRead():  # or it could not be recorded
        traced_views(tensor_form, *given, config)
    assert len(place._held) == held
    for name, tensor in vars(expected).items():
        torch.testing.assert_close(getattr(got, name), tensor, rtol=1e-3, atol=2e-5, msg=name)
    denoising = dataclasses.replace(config, denoise_from_px=32)
    views = [
        traced_views(form, *given, denoising).pixels_VRRC for form in (numpy_form, tensor_form)
    ]
    torch.testing.assert_close(views[1], views[0], rtol=1e-2, atol=1e-3)


def _rays(corners: NDArray, count: int) -> tuple[NDArray, NDArray, NDArray]:
    rng = np.random.default_rng(0)
    shares = rng.dirichlet([1, 1, 1], count)
    starts = np.einsum("nk,nki->ni", shares, corners[rng.integers(0, len(corners), count)])
    starts += rng.normal(size=starts.shape) * 0.3
    directions = rng.normal(size=starts.shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    floats = [each.astype(np.float32) for each in (starts, directions, rng.uniform(0, 2, count))]
    return floats[0], floats[1], floats[2]


def _corners() -> NDArray[np.float32]:
    scene = textured()
    return scene.vertex_positions[scene.faces]


@for_each("count", [0, 1, 5, 545])
def test_the_kernel_meets_what_embree_meets(count: int, tmp_path: Path) -> None:
    """Its text, compiled for this processor: the triangle of each ray, and what is free."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("no g++")
    before = "#include <math.h>\n#define __global__\n#define __device__\n"
    before += "static struct { int x; } blockIdx, blockDim, threadIdx;\n"
    source, library = tmp_path / "kernel.cpp", tmp_path / "kernel.so"
    source.write_text(before + SOURCE + 'extern "C" void at(int ray) { threadIdx.x = ray; }\n')
    command = [compiler, "-O1", "-shared", "-fPIC", str(source), "-o", str(library)]
    subprocess.run(command, check=True)
    compiled = ctypes.CDLL(str(library))
    corners, rows = _corners(), np.arange(count)
    tree = build_tree(corners[rows], rows)
    starts, directions, limits = _rays(corners, 4000)
    triangle, uv = np.zeros(4000, np.int64), np.zeros((2, 4000), np.float32)
    free = np.zeros(4000, np.bool_)
    arrays = (starts, directions, limits, tree.nodes, tree.corners,
              tree.rows, triangle, uv, free)  # fmt: skip
    pointers = [ctypes.c_void_p(each.ctypes.data) for each in arrays]
    for ray in range(4000):
        compiled.at(ray)
        for asks_free in (0, 1):
            compiled.trace(*pointers, 4000, asks_free)
    embree = Triangles(corners, rows)
    met = embree.intersect(starts, directions)
    # where the box stands on the floor, either is right
    assert (triangle == met.triangle).mean() > 0.99
    assert (free == embree.is_free(starts, directions, limits)).mean() > 0.999
    same = (triangle == met.triangle) & (triangle >= 0)
    np.testing.assert_allclose(uv[:, same], met.uv[:, same], atol=1e-3)


@needs_card
def test_a_card_shows_the_processors_picture() -> None:
    scene, card = textured(), torch.device("cuda")
    corners = _corners()
    starts, directions, _ = _rays(corners, 4000)
    rows, place = np.arange(len(corners)), DevicePlace(card)
    met = DeviceTriangles(corners, rows, place).intersect(
        place.array(starts), place.array(directions)
    )
    expected = Triangles(corners, rows).intersect(starts, directions).triangle
    assert (met.triangle.tensor.cpu().numpy() == expected).mean() > 0.99
    slow = NeuralRenderer.load("builtin:hits", device="cpu").render(scene, 64)[0]
    renderer = NeuralRenderer.load("builtin:hits", device="cuda")
    prepared = renderer.prepare(scene)
    for _ in range(3):  # one by one, recorded, repeated
        quick = renderer.view(prepared, scene.c2w[0], float(scene.fov_deg[0]), 64)
        assert np.abs(quick - slow).mean() < 1e-4 * slow.mean()
    tensors, config = scene_tensors(scene), hits_config()
    by_card = with_traced(tensors, 32, config, device=card).traced
    by_processor = with_traced(tensors, 32, config).traced
    assert by_card is not None and by_processor is not None
    torch.testing.assert_close(by_card.pixels_VRRC, by_processor.pixels_VRRC, rtol=1e-3, atol=1e-3)


def test_a_ray_towards_a_triangle_meets_it_and_others_meet_nothing() -> None:
    """From just above the middle of each triangle, down to it and up to the sky."""
    parts = [quad(FLOOR, material()), quad(WALL, material())]
    scene = lit_scene(join(parts, eye=(0, -3, 1), sky=constant(1.0)))
    towards = -scene.plane
    start = scene.corners.mean(axis=0) - np.float32(1e-3) * towards
    points, met = scene.meet(start, towards)
    assert met.all() and points.triangle.tolist() == list(range(scene.num_triangles))
    up = np.zeros_like(start) + np.array([[0], [0], [1]], np.float32)
    _, met = scene.meet(start, up)
    assert not met.any()
