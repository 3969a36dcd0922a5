"""Laws of heads and of demodulated pictures: what reflects nothing is black."""

import dataclasses

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from model.config import ModelConfig
from model.demodulated import compose_radiance, with_albedo
from model.image_head import BilinearUpsample, DptHead, Fusion
from model.neural_renderer import NeuralRenderer
from model.renderformer import RenderFormer, radiance
from model.scene_tensors import SceneTensors, batch_scenes, scene_tensors
from storage.records.first_hits import first_hits
from storage.records.material import DIFFUSE, SPECULAR
from storage.records.scene import Scene
from tests.for_each import for_each
from tests.model.hits.kit import corner
from tests.model.kit import RESOLUTION, awake, random_scene, render, tiny_config

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


def test_one_ray_a_pixel_sees_the_albedo_that_the_pixel_sees_first() -> None:
    scene = corner()
    seen = with_albedo(scene_tensors(scene), 32, 1).albedo_VRR6
    assert seen is not None
    found = first_hits(scene, view=0, resolution=32)
    materials = np.append(scene.materials[scene.material_index], np.zeros((1, 10)), axis=0)
    expected = materials[np.where(found.met, found.triangle, -1)]
    expected = np.concatenate([expected[..., DIFFUSE], expected[..., SPECULAR]], axis=-1)
    differs = (np.abs(seen[0].numpy() - expected) > 1e-6).any(axis=-1)
    # rays of single precision pass some edges on the other side
    assert differs.mean() < 0.005 and found.met.any() and not found.met.all()


def test_rays_of_a_pixel_are_averaged() -> None:
    """Four rays of a pixel are those of four pixels of a picture twice as wide."""
    tensors = scene_tensors(corner())
    coarse, fine = with_albedo(tensors, 16, 2).albedo_VRR6, with_albedo(tensors, 32, 1).albedo_VRR6
    assert coarse is not None and fine is not None
    mean = fine.unflatten(2, (16, 2)).unflatten(1, (16, 2)).mean(dim=(2, 4))
    # rays through one place, rounded otherwise, may pass an edge on the other side
    assert ((coarse - mean).abs() > 1e-5).any(dim=-1).double().mean() < 0.01


@for_each("config", KINDS.values())
def test_what_reflects_nothing_and_the_background_are_black(config: ModelConfig) -> None:
    model, scene = awake(config, torch.float32), corner()
    assert (picture(model, with_albedos(scene, 0, 0)) == 0).all()
    shown = picture(model, scene)
    tensors = with_albedo(scene_tensors(scene), RESOLUTION, config.hit_rays)
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

    def brought(scene: SceneTensors) -> SceneTensors:
        return with_albedo(scene, RESOLUTION, config.hit_rays)

    asked, given = render(model, *scenes), render(model, *map(brought, scenes))
    assert torch.equal(asked, given)
    for index, scene in enumerate(scenes):
        # float64 sums in another order
        torch.testing.assert_close(render(model, scene)[0], asked[index], rtol=0, atol=1e-11)


def test_every_weight_learns() -> None:
    model = awake(KINDS["4 pixels"], torch.float32)
    model(batch_scenes([scene_tensors(corner())]), RESOLUTION).mean().backward()
    for name, weight in model.named_parameters():
        assert weight.grad is not None and weight.grad.abs().max() > 0, name


def test_it_begins_with_equal_light_everywhere() -> None:
    model = RenderFormer(DEMODULATED)
    model.initialize(torch.Generator().manual_seed(0))
    shown, half = picture(model, corner()), picture(model, with_albedos(corner(), 0.5, 0.5))
    assert shown.max() > 0.1
    # float32 through a logarithm and back
    torch.testing.assert_close(radiance(half), 0.5 * radiance(shown), rtol=1e-4, atol=1e-6)


def test_a_renderer_shows_what_the_network_computes() -> None:
    scene = corner()
    model = awake(KINDS["4 pixels"], torch.float32)
    shown = NeuralRenderer(model).render(scene, RESOLUTION)[0]
    expected = radiance(picture(model, scene).double()).numpy()
    np.testing.assert_allclose(shown, expected, rtol=1e-5, atol=1e-6)  # rounded to float32


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
    fusion = Fusion(6, deepest=deepest).double()
    generator = torch.Generator().manual_seed(0)
    grid = torch.randn(2, 6, 3, 3, generator=generator, dtype=torch.float64)
    coarse = None if deepest else torch.randn(2, 6, 3, 3, generator=generator, dtype=torch.float64)

    def published_order(grid: Tensor) -> Tensor:
        if fusion.skip is not None and coarse is not None:
            grid = coarse + fusion.skip(grid)
        refined = fusion.refine(grid)
        enlarged = interpolate(refined, size=(7, 7), mode="bilinear", align_corners=True)
        return fusion.project(enlarged)

    with torch.no_grad():
        # float64 sums of six channels
        torch.testing.assert_close(
            fusion(coarse, grid, (7, 7)), published_order(grid), rtol=0, atol=1e-14
        )


def test_the_dpt_lets_a_bundle_reach_its_neighbours_and_the_linear_head_does_not() -> None:
    for head, reaches in (("linear", False), ("dpt", True)):
        config = tiny_config(head)
        built = awake(config).decoder.head
        assert isinstance(built, DptHead) == reaches
        tokens = [torch.zeros(1, 9, config.width, dtype=torch.float64) for _ in built.taps]
        changed = [tap.clone() for tap in tokens]
        for tap in changed:
            tap[0, 0] += torch.linspace(-1, 1, config.width, dtype=torch.float64)
        with torch.no_grad():
            difference = (built(changed) - built(tokens)).abs()[0].amax(dim=0)
        assert difference[:8, :8].max() > 0
        assert bool(difference[8:16, 8:16].max() > 0) == reaches
