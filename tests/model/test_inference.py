"""Pictures by a network: three lines, any number of lights, and one clear line for each mistake.

Light of groups adds up to the scene's. Demodulated pictures: what reflects nothing is black.
"""

import dataclasses
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from safetensors.torch import save
from torch import Tensor
from torch.nn.functional import interpolate

from model import inference
from model.config import SIZES, ModelConfig
from model.hits.tracing import with_traced
from model.inference import LightGroup, NeuralRenderer, light_groups
from model.open import find_network
from model.renderformer import RenderFormer, radiance
from model.scene_tensors import scene_tensors
from model.view_decoder import BilinearUpsample, Fusion, compose_radiance
from model.weights import CONFIG_KEY, RANGE_KEY, TrainedRange, encode_config, encode_weights
from storage.conventions import look_at_c2w
from storage.errors import TrilightError
from storage.raycast import first_hits
from storage.records.material import DIFFUSE, EMISSION, SPECULAR
from storage.records.scene import Scene
from tests.for_each import for_each
from tests.model.hits.kit import corner
from tests.model.kit import RESOLUTION, awake, random_scene, render, tiny_config
from tests.pipeline.renders.scene_kit import Part, box, flat, join, light, material, quad
from tests.scenes_by_hand import tiny_scene

FLOOR = quad(
    [[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]], material(diffuse=0.5)
)
CUBE = box([0, 0, 0.2], 0.4, material(diffuse=0.3))


TRIANGLE = 0.05 * np.array([[-1.0, 1, 0], [1, -1, 0], [1, 1, 0]])


def lamp(centre: tuple[float, float, float], radiance: float = 300.0) -> Part:
    return light(TRIANGLE + np.array(centre), radiance)


def row_of_lamps(count: int) -> list[Part]:
    return [lamp((0.2 * at, 0, 2), 100 + at) for at in range(count)]


def many_lights(count: int) -> Scene:
    return join([FLOOR, *row_of_lamps(count)])


def network(config: ModelConfig | None = None, bias: float = 0.3) -> RenderFormer:
    """Return a network, by default a small one, whose radiance stays below a hundred."""
    model = awake(config or tiny_config(), torch.float32)
    last = model.decoder.head.last
    assert last.bias is not None
    with torch.no_grad():
        last.weight *= 0.1
        last.bias.fill_(bias)
    return model


def test_three_lines_are_enough_and_equal_networks_have_equal_digests(tmp_path: Path) -> None:
    (tmp_path / "model.safetensors").write_bytes(encode_weights(network()))
    renderer = NeuralRenderer.load(tmp_path / "model.safetensors", device="cpu")
    picture = renderer.render(tiny_scene(), resolution=16)
    assert (picture.shape, picture.dtype) == ((2, 16, 16, 3), np.float32)
    assert 0 <= picture.min() < picture.max()
    assert len(np.unique(picture)) > 100
    other = network()
    assert NeuralRenderer(other).digest == renderer.digest
    with torch.no_grad():
        other.encoder.registers_NW[0, 0] += 1
    assert NeuralRenderer(other).digest != renderer.digest


def test_few_lights_are_the_networks_own_picture() -> None:
    """The same numbers in the same order; one view at a time may sum in another (1e-5 relative)."""
    seen = many_lights(8).with_cameras(tiny_scene().c2w, tiny_scene().fov_deg)
    for model, scene in ((network(), seen), (awake(KINDS["4 pixels"], torch.float32), corner())):
        whole = radiance(render(model, scene_tensors(scene), resolution=16)[0].double()).numpy()
        shown = NeuralRenderer(model).render(scene, 16)
        np.testing.assert_allclose(shown, np.maximum(whole, 0), rtol=1e-5, atol=1e-6)


def _light_of(model: RenderFormer, scene: Scene, device: torch.device) -> Tensor:
    """Stand for the first stage of an exactly linear network: the light of each channel."""
    tensors = scene_tensors(scene)
    a, b, c = tensors.triangles_T33.double().unbind(dim=1)
    area_T = torch.linalg.cross(b - a, c - a).norm(dim=-1) / 2
    emission_T3 = torch.pow(10.0, tensors.material_TM[:, EMISSION].double()) - 1
    return (area_T[:, None] * emission_T3).sum(dim=0)


def _flat_picture(_: RenderFormer, light_3: Tensor, cameras: Any, resolution: int) -> Tensor:
    """Stand for its second stage: every pixel shows that light."""
    return torch.log10(1 + light_3).expand(1, 1, resolution, resolution, 3)


@for_each(("count", "most"), [(64, 8), (64, 1), (9, 8), (20, 3)])
def test_groups_give_what_a_linear_network_gives_at_once(
    monkeypatch: pytest.MonkeyPatch, count: int, most: int
) -> None:
    """Emission goes through log10 in float32: 1e-6 relative."""
    monkeypatch.setattr(inference, "_encode", _light_of)
    monkeypatch.setattr(RenderFormer, "decode", _flat_picture)
    scene, renderer = many_lights(count), NeuralRenderer(network())

    def picture(lights_per_pass: int) -> NDArray[np.float32]:
        prepared = renderer.prepare(scene, lights_per_pass=lights_per_pass)
        assert len(prepared.groups) == -(-count // lights_per_pass)
        return renderer.view(prepared, scene.c2w[0], 40.0, 8)

    at_once = picture(count)
    assert at_once.min() > 0.1
    np.testing.assert_allclose(picture(most), at_once, rtol=1e-6)


def test_extremes_give_finite_pictures() -> None:
    model = awake(SIZES["smoke"](), torch.float32)
    with torch.no_grad():
        model.decoder.head.last.weight *= 0.1
    renderer = NeuralRenderer(model)
    one = join([flat(TRIANGLE * 10, material(diffuse=0.5)), lamp((0, 0, 2), 1e4)])
    for scene in (one, many_lights(64), tiny_scene()):
        for fov_deg in (1.0, 170.0):
            picture = renderer.view(renderer.prepare(scene), scene.c2w[0], fov_deg, 8)
            assert np.isfinite(picture).all()
    far = look_at_c2w(eye=[1e4, 0, 1], target=[0, 0, 0], up=[0, 0, 1])
    assert np.isfinite(renderer.view(renderer.prepare(one), far, 40.0, 8)).all()


def test_more_triangles_than_trained_are_rendered_with_a_warning(tmp_path: Path) -> None:
    """What it was trained on goes round through metadata."""
    model, path, scene = network(), tmp_path / "model.safetensors", tiny_scene()
    enough, unsaid = TrainedRange(max_triangles=3), TrainedRange(resolution=8)
    for known, told in ((TrainedRange(max_triangles=2), 1), (enough, 0), (unsaid, 0), (None, 0)):
        path.write_bytes(encode_weights(model, known))
        renderer = NeuralRenderer.load(tmp_path, device="cpu")  # a folder will do
        assert renderer.trained == find_network(path).trained == (known or TrainedRange())
        with warnings.catch_warnings(record=True) as heard:
            warnings.simplefilter("always")
            assert renderer.render(scene, 8).shape == (2, 8, 8, 3)
        texts = [str(each.message) for each in heard]
        assert len(texts) == told
        assert all("3 triangles, and the network was trained on at most 2" in t for t in texts)
    lies = ("", "[]", '{"max_triangles": "many"}', '{"resolution": Infinity}', "[" * 100_000)
    for text in lies:
        metadata = {CONFIG_KEY: encode_config(model.config), RANGE_KEY: text}
        path.write_bytes(save(model.state_dict(), metadata=metadata))
        with pytest.raises(TrilightError, match="^trilight_trained_range"):
            find_network(path)


def test_a_resolution_between_bundles_or_beyond_memory_is_one_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """By default it is that of the training."""
    renderer, scene = NeuralRenderer(network()), tiny_scene()
    prepared = renderer.prepare(scene)
    for resolution in (0, -8, 12):
        expected = f"resolution is {resolution}; expected a positive multiple of 8"
        with pytest.raises(TrilightError, match=expected):
            renderer.render(scene, resolution)
        with pytest.raises(TrilightError, match=expected):
            renderer.view(prepared, scene.c2w[0], 40.0, resolution)
    known = NeuralRenderer(network(), TrainedRange(max_triangles=None, resolution=16))
    assert known.render(scene).shape == (2, 16, 16, 3)
    with pytest.raises(TrilightError, match="resolution is None, and the network does not say"):
        renderer.render(scene)
    # as control groups leave it, whatever the machine has
    monkeypatch.setattr(inference, "free_memory", lambda: 1000)
    with pytest.raises(TrilightError, match="3 triangles need more than 0.0 GB of memory"):
        renderer.prepare(scene)
    monkeypatch.setattr(inference, "free_memory", lambda: None)
    renderer.prepare(scene)


def emission_of(scene: Scene) -> dict[bytes, NDArray[np.float32]]:
    """Return the radiance of each emitting triangle by its corners."""
    corners = scene.vertex_positions[scene.faces[scene.triangle_emits]]
    radiance = scene.materials[scene.material_index[scene.triangle_emits], EMISSION]
    return {place.tobytes(): value for place, value in zip(corners, radiance, strict=True)}


def counts(groups: list[LightGroup]) -> list[int]:
    return [int(scene.triangle_emits.sum()) for scene, _ in groups]


@given(count=st.integers(9, 64), most=st.integers(1, 8))
def test_the_light_of_the_groups_is_that_of_the_scene(count: int, most: int) -> None:
    scene = many_lights(count)
    groups = light_groups(scene, most)
    assert max(counts(groups)) <= most
    assert len(groups) == -(-count // most)
    found = [
        (place, fraction * radiance)
        for alone, fraction in groups
        for place, radiance in emission_of(alone).items()
    ]
    whole = emission_of(scene)
    assert [place for place, _ in found] == list(whole)
    # the division by a share and the product with it round to float32 twice
    for place, emitted in found:
        np.testing.assert_allclose(emitted, whole[place], rtol=3e-7)
    assert sum(fraction for _, fraction in groups) == pytest.approx(1, abs=1e-12)  # float64 sums


def test_a_group_is_as_bright_as_the_scene_and_otherwise_the_same() -> None:
    for count in (1, 8):
        few = join([FLOOR, CUBE, *row_of_lamps(count)])
        ((alone, fraction),) = light_groups(few, 8)
        assert alone is few and fraction == 1, "within limits it is rendered as it is"
    scene = join([FLOOR, CUBE, *row_of_lamps(20)])
    reflects = ~scene.triangle_emits
    for alone, _ in light_groups(scene, 8):
        alone.check()
        np.testing.assert_array_equal(alone.faces[~alone.triangle_emits], scene.faces[reflects])
        assert alone.c2w is scene.c2w
        # equal lamps: the sums of their radiance are as their light
        total = sum(float(value.sum()) for value in emission_of(alone).values())
        expected = sum(float(value.sum()) for value in emission_of(scene).values())
        assert total == pytest.approx(expected, rel=1e-5)  # of some hundred float32 numbers
    assert scene.materials[:, EMISSION].max() < 200  # the scene itself stays as it was


def without_area(scene: Scene, *lamps: int) -> Scene:
    """Return a scene whose emitting triangles of these numbers are points."""
    positions = scene.vertex_positions.copy()
    for face in scene.faces[scene.triangle_emits][list(lamps)]:
        positions[face] = positions[face[0]]
    return dataclasses.replace(scene, vertex_positions=positions)


def test_triangles_that_touch_are_one_lamp_apart_from_those_within_objects() -> None:
    """And lamps without area give no light."""
    bulb = box([0, 0, 2], 0.1, material(emission=50.0), kind="emitter")
    scene = join([FLOOR, *row_of_lamps(3), bulb])
    assert counts(light_groups(scene, 8)) == [3, 12]
    apart = [flat(bulb.triangles[at : at + 1], bulb.material, "emitter") for at in range(12)]
    assert counts(light_groups(join([FLOOR, *row_of_lamps(3), *apart]), 8)) == [3, 12]
    within = lamp((0.05, 0, 0.2))
    assert counts(light_groups(join([FLOOR, CUBE, lamp((0, 0, 2)), within]), 8)) == [1, 1]
    assert counts(light_groups(join([FLOOR, CUBE, within]), 8)) == [1]
    # a shell is around every light of a room, and says nothing
    assert counts(light_groups(join([FLOOR, lamp((0, 0, 0)), lamp((0, 0, 2))]), 8)) == [2]
    scene = join([FLOOR, *row_of_lamps(3)])
    assert counts(light_groups(without_area(scene, 1), 1)) == [1, 1]
    ((_, fraction),) = light_groups(without_area(scene, 0, 1, 2), 1)
    assert fraction == 1


DEMODULATED = tiny_config(demodulated=True, hit_rays=2)
KINDS = {
    "linear": DEMODULATED,
    "4 pixels": dataclasses.replace(DEMODULATED, patch_px=4),
    "windows": dataclasses.replace(DEMODULATED, window_bundles=2),
    "dpt": dataclasses.replace(tiny_config("dpt"), demodulated=True, hit_rays=1),
}


def picture(model: RenderFormer, scene: Scene, resolution: int = RESOLUTION) -> torch.Tensor:
    return render(model, scene_tensors(scene), resolution=resolution)[0, 0]


def with_albedos(scene: Scene, diffuse: float, specular: float) -> Scene:
    materials = scene.materials.copy()
    materials[:, DIFFUSE] *= diffuse
    materials[:, SPECULAR] *= specular
    return dataclasses.replace(scene, materials=materials)


def test_one_ray_sees_the_albedo_that_its_pixel_sees_first_and_rays_are_averaged() -> None:
    """Four rays of a pixel are those of four pixels of a picture twice as wide."""
    scene, one_ray = corner(), dataclasses.replace(DEMODULATED, hit_rays=1)
    fine = with_traced(scene_tensors(scene), 32, one_ray).albedo_VRR6
    coarse = with_traced(scene_tensors(scene), 16, DEMODULATED).albedo_VRR6
    assert fine is not None and coarse is not None
    found = first_hits(scene, view=0, resolution=32)
    materials = np.append(scene.materials[scene.material_index], np.zeros((1, 10)), axis=0)
    expected = materials[np.where(found.met, found.triangle, -1)]
    expected = np.concatenate([expected[..., DIFFUSE], expected[..., SPECULAR]], axis=-1)
    differs = (np.abs(fine[0].numpy() - expected) > 1e-6).any(axis=-1)
    # rays of single precision pass some edges on the other side
    assert differs.mean() < 0.005 and found.met.any() and not found.met.all()
    mean = fine.unflatten(2, (16, 2)).unflatten(1, (16, 2)).mean(dim=(2, 4))
    # rays through one place, rounded otherwise, may pass an edge on the other side
    assert ((coarse - mean).abs() > 1e-5).any(dim=-1).double().mean() < 0.01


@for_each("config", KINDS.values())
def test_what_reflects_nothing_and_the_background_are_black(config: ModelConfig) -> None:
    model, scene = awake(config, torch.float32), corner()
    assert (picture(model, with_albedos(scene, 0, 0)) == 0).all()
    shown = picture(model, scene)
    tensors = with_traced(scene_tensors(scene), RESOLUTION, config)
    assert tensors.albedo_VRR6 is not None
    is_black = (tensors.albedo_VRR6[0] == 0).all(dim=-1)
    assert (shown[is_black] == 0).all() and 0 < is_black.double().mean() < 1
    assert (shown[~is_black] > 0).all()


def test_pictures_are_in_proportion_to_albedo_and_add_up() -> None:
    generator = torch.Generator().manual_seed(0)
    light = torch.randn(1, 1, 4, 4, 6, generator=generator, dtype=torch.float64)
    albedo = torch.rand(1, 1, 4, 4, 6, generator=generator, dtype=torch.float64)
    diffuse, specular = albedo.clone(), albedo.clone()
    diffuse[..., 3:], specular[..., :3] = 0, 0

    def linear(albedo: torch.Tensor) -> torch.Tensor:
        return radiance(compose_radiance(light, albedo))

    # numbers of size 1 through a logarithm and back, in float64
    torch.testing.assert_close(linear(0.25 * albedo), 0.25 * linear(albedo), rtol=1e-12, atol=0)
    torch.testing.assert_close(
        linear(diffuse) + linear(specular), linear(albedo), rtol=1e-12, atol=0
    )


@for_each("size", [-1e30, -50.0, 50.0, 1e30])
def test_gradients_are_finite_whatever_a_head_says(size: float) -> None:
    light = torch.full((1, 1, 2, 2, 6), size, requires_grad=True)
    albedo = torch.zeros(1, 1, 2, 2, 6)
    albedo[..., 0, :] = 0.5
    shown = compose_radiance(light, albedo)
    shown.sum().backward()
    assert torch.isfinite(shown).all() and (shown >= 0).all()
    assert light.grad is not None and torch.isfinite(light.grad).all()


@for_each("config", KINDS.values())
def test_albedo_that_a_loader_brings_gives_the_picture_that_the_network_asks_for(
    config: ModelConfig,
) -> None:
    model = awake(config)
    scenes = [random_scene(7, seed=1), random_scene(15, seed=2)]

    asked = render(model, *scenes)
    given = (with_traced(scene, RESOLUTION, config) for scene in scenes)
    assert torch.equal(asked, render(model, *given))
    for index, scene in enumerate(scenes):
        # float64 sums in another order
        torch.testing.assert_close(render(model, scene)[0], asked[index], rtol=0, atol=1e-11)


def test_it_begins_with_equal_light_everywhere() -> None:
    model = RenderFormer(DEMODULATED)
    model.initialize(torch.Generator().manual_seed(0))
    shown, half = picture(model, corner()), picture(model, with_albedos(corner(), 0.5, 0.5))
    assert shown.max() > 0.1
    # float32 through a logarithm and back
    torch.testing.assert_close(radiance(half), 0.5 * radiance(shown), rtol=1e-4, atol=1e-6)


@for_each("small", [(1, 1), (1, 4), (3, 5), (16, 16)])
def test_the_way_back_of_an_enlargement_is_that_of_torch(small: tuple[int, int]) -> None:
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(2, 3, *small, generator=generator, dtype=torch.float64).requires_grad_()
    size = (2 * small[0] + 1, 2 * small[1])
    twin = interpolate(x, size=size, mode="bilinear", align_corners=True)
    gradient = torch.randn(twin.shape, generator=generator, dtype=torch.float64)
    assert torch.equal(twin, BilinearUpsample.apply(x, size))
    (expected,) = torch.autograd.grad(twin, x, gradient)
    (found,) = torch.autograd.grad(BilinearUpsample.apply(x, size), x, gradient)
    # float64 sums of tens of numbers around 1
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-13)


@for_each("deepest", [False, True])
def test_projecting_before_upsampling_equals_projecting_after(deepest: bool) -> None:
    """The published order, to float64 sums of six channels."""
    fusion = Fusion(6, deepest=deepest).double()
    generator = torch.Generator().manual_seed(0)
    grid, coarse = torch.randn(2, 2, 6, 3, 3, generator=generator, dtype=torch.float64)
    with torch.no_grad():
        summed = grid if fusion.skip is None else coarse + fusion.skip(grid)
        enlarged = interpolate(fusion.refine(summed), (7, 7), mode="bilinear", align_corners=True)
        published = fusion.project(enlarged)
        found = fusion(None if deepest else coarse, grid, (7, 7))
    torch.testing.assert_close(found, published, rtol=0, atol=1e-14)


def test_the_dpt_lets_a_bundle_reach_its_neighbours_and_the_linear_head_does_not() -> None:
    for head in ("linear", "dpt"):
        config = tiny_config(head)
        built = awake(config).decoder.head
        tokens = torch.zeros(1, 9, config.width, dtype=torch.float64)
        changed = tokens.clone()
        changed[0, 1] += torch.linspace(-1, 1, config.width, dtype=torch.float64)
        with torch.no_grad():
            both = (built([each] * len(built.taps)) for each in (changed, tokens))
            change = (next(both) - next(both)).abs()[0].amax(dim=0)
        by_bundle = change.unflatten(1, (3, 8)).unflatten(0, (3, 8)).amax(dim=(1, 3))
        assert by_bundle.argmax() == 1
        assert bool(by_bundle[0, 0] > 0) == bool(by_bundle[1, 1] > 0) == (head == "dpt")
