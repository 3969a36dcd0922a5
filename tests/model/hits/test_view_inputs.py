"""What is traced of a view: laws that hold for every scene, its textures, and the extremes."""

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from model.hits.traced import Traced, denoise_traced
from model.hits.tracing import lit_scenes, traced_views, with_traced
from model.hits.view_inputs import NUM_CHANNELS, Channel
from model.inference import NeuralRenderer
from model.renderformer import radiance
from model.scene_tensors import batch_scenes, scene_tensors
from storage.conventions import pixel_places
from storage.denoiser import Features, denoise
from storage.metrics import pepper
from storage.raycast import first_hits
from storage.records.material import EMISSION
from storage.records.scene import Scene
from tests.for_each import for_each
from tests.model.hits.kit import FLOOR, LAMP, corner, direct, textured, traced
from tests.model.kit import awake, hits_config, render
from tests.pipeline.renders.scene_kit import box, join, light, material, quad, sphere
from tests.scenes_by_hand import moved

LIGHTS = slice(Channel.OPEN_DIFFUSE.start, Channel.MIRRORED.stop)


def _relit(scene: Scene, factor: float | np.ndarray) -> Scene:
    materials = scene.materials.copy()
    materials[:, EMISSION] *= factor
    return dataclasses.replace(scene, materials=materials.astype(np.float32))


def test_light_scales_with_the_lamps() -> None:
    """By powers of two, which round nothing: equal to the last bit."""
    once, twice = traced(corner()), traced(_relit(corner(), 4.0))
    assert np.array_equal(4 * once.pixels[..., LIGHTS], twice.pixels[..., LIGHTS])
    assert np.array_equal(4 * once.gathered, twice.gathered)
    for other in (slice(0, LIGHTS.start), slice(LIGHTS.stop, NUM_CHANNELS)):
        assert np.array_equal(once.pixels[..., other], twice.pixels[..., other])


def test_channels_change_places_together() -> None:
    scene = corner()
    order = np.array([2, 0, 1])
    columns = np.concatenate([order, 3 + order, [6], 7 + order])
    other = dataclasses.replace(scene, materials=scene.materials[:, columns])
    plain, permuted = traced(scene), traced(other)
    for channel in (Channel.DIFFUSE, Channel.SPECULAR, Channel.SHOWN_DIFFUSE, Channel.MIRRORED):
        # a lamp is drawn by the mean of its colours, which is summed in another order
        got, wanted = permuted.pixels[..., channel], plain.pixels[..., channel][..., order]
        np.testing.assert_allclose(got, wanted, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(permuted.gathered, plain.gathered[:, order], rtol=1e-4, atol=1e-6)


def test_a_turned_world_shows_the_same_light() -> None:
    """Rays that graze a rim may fall on its other side by a rounding: one pixel in a hundred."""
    scene = corner()
    rotation = Rotation.from_euler("xyz", [0.4, -1.1, 2.0]).as_matrix()
    there, here = traced(moved(scene, rotation, [0.3, -0.2, 0.5])), traced(scene)
    assert np.mean(np.abs(there.gathered - here.gathered) > 1e-3 * here.gathered.max()) < 0.02
    for channel in (LIGHTS, Channel.DIFFUSE, Channel.DISTANCE):
        apart = np.abs(there.pixels[..., channel] - here.pixels[..., channel]).max(axis=-1)
        scale = here.pixels[..., channel].max()
        assert np.mean(apart > 1e-3 * scale) < 0.01
    turned = here.pixels[..., Channel.NORMAL] @ rotation.T
    apart = np.abs(turned - there.pixels[..., Channel.NORMAL]).max(axis=-1)
    assert np.mean(apart > 1e-3) < 0.01


def test_surfaces_are_those_that_the_passes_know() -> None:
    scene = corner()
    inputs = traced(scene, rays_a_side=1)
    hits = first_hits(scene, resolution=32)
    assert np.array_equal(inputs.pixels[..., 0] > 0, hits.met)
    there = hits.met
    # Embree's own place on a triangle, in single precision, 3 m away
    position = inputs.pixels[..., Channel.POSITION][there]
    np.testing.assert_allclose(position, hits.position[there], atol=2e-5)
    distance = inputs.pixels[..., 4][there]
    np.testing.assert_allclose(distance, hits.depth_m[there], atol=2e-5)
    np.testing.assert_array_equal(
        inputs.pixels[..., Channel.DIFFUSE][there], hits.material[there][:, :3]
    )
    places = pixel_places(position, scene.c2w[0], float(scene.fov_deg[0]), 32)
    rows, columns = np.nonzero(there)
    np.testing.assert_allclose(places, np.stack([columns, rows], axis=1) + 0.5, atol=1e-3)


def test_shadows_only_take_light_away_and_equal_arguments_give_equal_numbers() -> None:
    one, again, other = traced(corner()), traced(corner()), traced(corner(), seed=1)
    assert np.array_equal(one.pixels, again.pixels)
    assert np.array_equal(one.gathered, again.gathered)
    assert not np.array_equal(one.pixels, other.pixels), "another seed, another noise"
    pixels = one.pixels
    for shadowed, open_light in (
        (Channel.DIRECT_DIFFUSE, Channel.OPEN_DIFFUSE),
        (Channel.DIRECT_SPECULAR, Channel.OPEN_SPECULAR),
    ):
        assert (pixels[..., shadowed] <= pixels[..., open_light] * (1 + 1e-5)).all()
    assert (pixels[..., Channel.DIRECT_DIFFUSE] < 0.5 * pixels[..., Channel.OPEN_DIFFUSE]).any()


@pytest.mark.parametrize(
    "resolution", [8, 100, pytest.param(1024, marks=pytest.mark.slow("training"))]
)
def test_any_width_shows_the_same_scene(resolution: int) -> None:
    """Means of a picture and of one with 16 rays a pixel; 64 pixels see a highlight by chance."""
    tolerance = 0.03 if resolution > 8 else 0.2
    few = traced(corner(), resolution, anchors_a_side=np.gcd(8, resolution))
    many = traced(corner(), 64, rays_a_side=4)
    assert few.pixels.shape == (resolution, resolution, NUM_CHANNELS)
    assert direct(few).mean() == pytest.approx(direct(many).mean(), rel=tolerance)


def test_mirrors_show_edges_as_smoothly_as_the_camera() -> None:
    """2 x 2 rays of a pixel meet what one ray of each of 2 x 2 pixels meets, also in a mirror."""
    scene = corner(roughness=0.01)
    half, whole = traced(scene, 32), traced(scene, 64, rays_a_side=1)
    seen = slice(Channel.SEEN_ALBEDO.start, Channel.SEEN_NEARNESS.stop)
    wanted = whole.pixels[..., seen].reshape(32, 2, 32, 2, -1).mean(axis=(1, 3))
    is_mirror = half.pixels[..., Channel.ROUGHNESS][..., 0] == np.float32(0.01)
    assert is_mirror.sum() > 50
    # lobes are narrow, and not points: a ray in hundreds meets the other side of an edge
    apart = np.abs(half.pixels[..., seen] - wanted).max(axis=-1)[is_mirror]
    assert np.mean(apart > 0.01) < 0.1


def test_one_point_of_a_pixel_and_each_ray_bring_the_same_light() -> None:
    for roughness in (0.01, 0.4):
        forms = [traced(corner(roughness=roughness), 64, shades_each_ray=each) for each in (0, 1)]
        for channel in (Channel.SHOWN_DIFFUSE, Channel.DIRECT_SPECULAR, Channel.MIRRORED):
            one, each = (form.pixels[..., channel].mean() for form in forms)
            assert one == pytest.approx(each, rel=0.05), (roughness, channel)


def test_edges_near_those_of_256_rays_as_rays_grow() -> None:
    """Evenly spread rays miss an edge by their distance: twice as many a side, less than half.

    0.6 instead of 0.5, since an edge along the rays' rows sees no more of them for a while.
    """

    def shown(rays_a_side: int) -> np.ndarray:
        pixels = traced(corner(), 48, rays_a_side=rays_a_side, gather_rays=0).pixels
        return pixels[..., Channel.COVERAGE] * pixels[..., Channel.DIFFUSE]

    truth = shown(16)
    missed = [float(np.abs(shown(rays) - truth).mean()) for rays in (1, 2, 4)]
    assert missed[1] < 0.6 * missed[0]
    assert missed[2] < 0.6 * missed[1]
    assert missed[1] < 0.004  # measured 0.0023: 38.8 dB, 2 x 2 rays of 256


def _small_lamp(column: int, row: int, height: float) -> np.ndarray:
    return 0.1 * np.array(LAMP) + np.array([0.3 * column - 1.5, 0.3 * row - 1.5, height])


EXTREMES = {
    "black metal": [quad(FLOOR, material(roughness=0.01)), light(LAMP, 50.0)],
    "mirror": [quad(FLOOR, material(specular=1.0, roughness=0.0)), light(LAMP, 50.0)],
    "rough mirror": [quad(FLOOR, material(specular=1.0, roughness=0.01)), light(LAMP, 50.0)],
    "a dim lamp": [quad(FLOOR, material(diffuse=0.5, specular=0.5)), light(LAMP, 1e-20)],
    "lamp in an object": [
        quad(FLOOR, material(diffuse=0.5)),
        sphere([0, 0, 0.6], 0.5, material(specular=0.9, roughness=0.05)),
        light(_small_lamp(5, 5, 0.35), 5e4),
    ],
    "lamp on the floor": [quad(FLOOR, material(diffuse=0.5, specular=0.4, roughness=0.1)),
                          light(np.eye(3)[[2, 0, 1]] * [0.5, 0.5, 0], 10.0)],
    "bright": [quad(FLOOR, material(diffuse=1.0)), light(LAMP, 1e6)],
    "a hundred lamps": [
        quad(FLOOR, material(diffuse=0.5, specular=0.3, roughness=0.2)),
        *(light(_small_lamp(k % 10, k // 10, 1.0), 3.0) for k in range(100)),
    ],
    "nothing": [box([0, 50, 0], 0.1, material(diffuse=0.5)), light(LAMP, 5.0)],
}  # fmt: skip


@for_each("name", EXTREMES)
def test_extremes_are_finite_and_not_negative(name: str) -> None:
    """Seen from above, and by a camera that grazes the floor."""
    for eye, target, fov_deg in (((1, -3, 1.4), (0, 0, 0.2), 40), ((0, -1.9, 1e-4), (0, 2, 0), 60)):
        inputs = traced(join(EXTREMES[name], eye=eye, target=target, fov_deg=fov_deg), 16)
        for values in (inputs.pixels, inputs.gathered):
            assert np.isfinite(values).all()
        assert (inputs.pixels[..., LIGHTS] >= 0).all()
        assert (inputs.gathered >= 0).all()


def test_no_light_at_all_is_black() -> None:
    """A scene has an emitter, but a group of its lights may have none (model.inference)."""
    scene = corner()
    positions = scene.vertex_positions.copy()
    positions[-3:] = positions[-1]
    without_area = dataclasses.replace(scene, vertex_positions=positions)
    for dark in (_relit(scene, 0.0), without_area):
        inputs = traced(dark)
        assert np.isfinite(inputs.pixels).all()
        assert not inputs.pixels[..., LIGHTS].any()
        assert not inputs.gathered.any()


def test_a_pixel_has_the_material_at_its_hit() -> None:
    scene = textured()
    hits = first_hits(scene, resolution=32)
    pixels = traced(scene, rays_a_side=1).pixels
    met = hits.met
    same = met & (pixels[..., 0] > 0)
    assert same.sum() > 0.99 * met.sum()
    # Places of hits are float32 here and float64 there: 1e-6 m is 1e-5 of a texel.
    apart = np.abs(pixels[..., Channel.DIFFUSE] - hits.material[..., 0:3]).max(axis=-1)[same]
    assert np.mean(apart > 1e-4) < 0.005
    apart = np.abs(pixels[..., Channel.ROUGHNESS][..., 0] - hits.material[..., 6])[same]
    assert np.mean(apart > 1e-4) < 0.005
    assert hits.material[same][:, 0].std() > 0.1


def test_every_ray_of_a_textured_pixel_counts() -> None:
    """The albedo of a pixel is the mean over its rays, not that of one of them."""
    scene = textured(roughness=False)
    fine = first_hits(scene, resolution=64).material[..., 0:3]
    means = np.asarray(fine).reshape(32, 2, 32, 2, 3).mean(axis=(1, 3))
    found = traced(scene).pixels
    whole = np.isfinite(means).all(axis=-1) & (found[..., 0] == 1)
    apart = np.abs(found[..., Channel.DIFFUSE] - means).max(axis=-1)[whole]
    assert np.median(apart) < 1e-4 and np.mean(apart > 0.02) < 0.05  # rims: other rays meet


WIDE_PX = 64
UNIT = torch.tensor([0.5, 1.0, 2.0])
DENOISED = (Channel.SHOWN_DIFFUSE, Channel.DIRECT_SPECULAR, Channel.MIRRORED)


def _traced(**changes: int) -> Tensor:
    return torch.from_numpy(traced(corner(), WIDE_PX, **changes).pixels[None])


def _denoise(pixels_VRRC: Tensor, unit_3: Tensor) -> Tensor:
    empty = torch.zeros(0)
    views = Traced(empty, unit_3, pixels_VRRC, empty, empty, empty)
    return denoise_traced(views, hits_config(denoise_from_px=WIDE_PX)).pixels_VRRC


def _light(pixels: Tensor) -> Tensor:
    return sum((pixels[0, ..., channel] for channel in DENOISED), torch.zeros(WIDE_PX, WIDE_PX, 3))


def test_noise_goes_and_light_and_surfaces_stay() -> None:
    noisy = _traced()
    clean = _denoise(noisy, UNIT)
    truth = torch.stack([_traced(seed=seed) for seed in range(1, 17)]).mean(dim=0)
    assert pepper(_light(clean), _light(truth)) < 0.5 * pepper(_light(noisy), _light(truth))
    torch.testing.assert_close(_light(clean).mean(), _light(noisy).mean(), rtol=0.05, atol=0)
    kept = torch.ones(noisy.shape[-1], dtype=torch.bool)
    for channel in DENOISED:
        kept[channel] = False
    assert torch.equal(clean[..., kept], noisy[..., kept])
    coverage = noisy[0, ..., Channel.COVERAGE]
    guides = [noisy[0, ..., channel] for channel in (Channel.DIFFUSE, Channel.SPECULAR)]
    features = Features(
        albedo=(coverage * (guides[0] + guides[1])).numpy(),
        normal=(coverage * noisy[0, ..., Channel.NORMAL]).numpy(),
    )
    filtered = denoise((_light(noisy) / UNIT).numpy(), features, "fast")
    np.testing.assert_array_equal(_light(clean), UNIT.numpy() * filtered)
    nothing = noisy[0, ..., 0] == 0
    assert nothing.any() and not _light(clean)[nothing].any(), "nothing is met: black"


def test_it_scales_with_the_lamps_and_is_the_same_in_every_thread() -> None:
    noisy = _traced()
    brighter = noisy.clone()
    scale = torch.tensor([8.0, 4.0, 2.0])
    for channel in DENOISED:
        brighter[..., channel] *= scale
    with ThreadPoolExecutor(2) as pool:
        one, other = pool.map(_denoise, (noisy, brighter), (UNIT, UNIT * scale))
    assert torch.equal(_light(other), _light(one) * scale)


def test_wide_pictures_are_denoised_wherever_their_light_is_traced() -> None:
    scene, config = corner(), hits_config(denoise_from_px=WIDE_PX)
    tensors = scene_tensors(scene)
    below = [with_traced(tensors, WIDE_PX // 2, which).traced for which in (hits_config(), config)]
    assert below[0] is not None and below[1] is not None
    assert torch.equal(below[0].pixels_VRRC, below[1].pixels_VRRC)
    cameras = tensors.c2w_V44[:1], tensors.fov_deg_V[:1]
    (lit,) = lit_scenes(batch_scenes([tensors]))
    noisy = traced_views(lit, *cameras, WIDE_PX, config)
    given = with_traced(tensors, WIDE_PX, config)
    wide = given.traced
    assert wide is not None
    assert torch.equal(wide.pixels_VRRC, _denoise(noisy.pixels_VRRC, noisy.unit_3))
    model = awake(config, torch.float32)
    trained = radiance(render(model, given, resolution=WIDE_PX)[0, 0])
    shown = NeuralRenderer(model).render(scene, WIDE_PX)[0]
    np.testing.assert_allclose(shown, trained.numpy(), rtol=1e-4, atol=1e-6)
