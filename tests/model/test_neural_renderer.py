"""Pictures by a network: three lines, any number of lights, and one clear line for each mistake."""

import dataclasses
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from model import neural_renderer
from model.config import smoke
from model.neural_renderer import NeuralRenderer
from model.renderformer import RenderFormer, radiance
from model.scene_tensors import batch_scenes, scene_tensors
from model.weights import RANGE_KEY, TrainedRange, encode_weights, trained_range
from storage.conventions import look_at_c2w
from storage.errors import TrilightError
from storage.records.environment import Environment
from storage.records.material import EMISSION
from storage.records.scene import Scene
from tests.for_each import for_each
from tests.model.kit import awake, tiny_config
from tests.pipeline.renders.scene_kit import flat, join, light, material, quad
from tests.scenes_by_hand import tiny_scene

TRIANGLE = 0.05 * np.array([[-1.0, 1, 0], [1, -1, 0], [1, 1, 0]])
ABOVE = np.array([0.0, 0, 2])


def network() -> RenderFormer:
    """Return a small network whose radiance stays below a hundred."""
    model = awake(tiny_config(), torch.float32)
    last = model.decoder.head.last
    assert last.bias is not None
    with torch.no_grad():
        last.weight *= 0.1
        last.bias.fill_(0.3)
    return model


def many_lights(count: int) -> Scene:
    floor = quad([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], material(diffuse=0.5))
    lamps = [light(TRIANGLE + ABOVE + 0.2 * at * np.eye(3)[0], 100.0 + at) for at in range(count)]
    return join([floor, *lamps])


def test_three_lines_are_enough(tmp_path: Path) -> None:
    (tmp_path / "model.safetensors").write_bytes(encode_weights(network()))
    renderer = NeuralRenderer.load(tmp_path / "model.safetensors", device="cpu")
    picture = renderer.render(tiny_scene(), resolution=16)
    assert (picture.shape, picture.dtype) == ((2, 16, 16, 3), np.float32)
    assert 0 <= picture.min() < picture.max()
    assert len(np.unique(picture)) > 100


def test_few_lights_are_the_networks_own_picture() -> None:
    """The same numbers in the same order; one view at a time may sum in another (1e-5 relative)."""
    model, scene = network(), many_lights(8)
    scene = scene.with_cameras(tiny_scene().c2w, tiny_scene().fov_deg)
    with torch.no_grad():
        whole = radiance(model(batch_scenes([scene_tensors(scene)]), 16)[0].double()).numpy()
    picture = NeuralRenderer(model).render(scene, 16)
    np.testing.assert_allclose(picture, np.maximum(whole, 0), rtol=1e-5, atol=1e-6)


def test_other_cameras_see_the_same_prepared_scene() -> None:
    """Float32 sums of equal shape: equal bits."""
    scene, renderer = tiny_scene(), NeuralRenderer(network())
    prepared = renderer.prepare(scene)
    turned = scene.with_cameras(scene.c2w[::-1].copy(), scene.fov_deg[::-1].copy())
    np.testing.assert_array_equal(renderer.render(turned, 16), renderer.render(scene, 16)[::-1])
    np.testing.assert_array_equal(
        renderer.view(prepared, scene.c2w[1], float(scene.fov_deg[1]), 16),
        renderer.render(scene, 16)[1],
    )


def _light_of(model: RenderFormer, scene: Scene, device: torch.device) -> Tensor:
    """Stand for the first stage of an exactly linear network: the light of each channel."""
    tensors = scene_tensors(scene)
    a, b, c = tensors.triangles_T33.double().unbind(dim=1)
    area_T = torch.linalg.cross(b - a, c - a).norm(dim=-1) / 2
    emission_T3 = torch.pow(10.0, tensors.material_TM[:, EMISSION].double()) - 1
    return (area_T[:, None] * emission_T3).sum(dim=0)


def _flat_picture(_: RenderFormer, light_3: Tensor, *camera: Any) -> Tensor:
    """Stand for its second stage: every pixel shows that light."""
    return torch.log10(1 + light_3).expand(camera[-1], camera[-1], 3)


@for_each(("count", "most"), [(64, 8), (64, 1), (9, 8), (20, 3)])
def test_groups_give_what_a_linear_network_gives_at_once(
    monkeypatch: pytest.MonkeyPatch, count: int, most: int
) -> None:
    """Emission goes through log10 in float32: 1e-6 relative."""
    monkeypatch.setattr(neural_renderer, "_encode", _light_of)
    monkeypatch.setattr(neural_renderer, "_decode", _flat_picture)
    scene, renderer = many_lights(count), NeuralRenderer(network())

    def picture(lights_per_pass: int) -> NDArray[np.float32]:
        prepared = renderer.prepare(scene, lights_per_pass=lights_per_pass)
        assert len(prepared.groups) == -(-count // lights_per_pass)
        return renderer.view(prepared, scene.c2w[0], 40.0, 8)

    at_once = picture(count)
    assert at_once.min() > 0.1
    np.testing.assert_allclose(picture(most), at_once, rtol=1e-6)


def test_extremes_give_finite_pictures() -> None:
    model = awake(smoke(), torch.float32)
    with torch.no_grad():
        model.decoder.head.last.weight *= 0.1
    renderer = NeuralRenderer(model)
    one = join([flat(TRIANGLE * 10, material(diffuse=0.5)), light(TRIANGLE + ABOVE, 1e4)])
    for scene in (one, many_lights(64), tiny_scene()):
        for fov_deg in (1.0, 170.0):
            picture = renderer.view(renderer.prepare(scene), scene.c2w[0], fov_deg, 8)
            assert np.isfinite(picture).all()
    far = look_at_c2w(eye=[1e4, 0, 1], target=[0, 0, 0], up=[0, 0, 1])
    assert np.isfinite(renderer.view(renderer.prepare(one), far, 40.0, 8)).all()


def test_more_triangles_than_trained_are_rendered_with_a_warning(tmp_path: Path) -> None:
    path, scene = tmp_path / "model.safetensors", tiny_scene()
    for most, told in ((2, 1), (3, 0), (None, 0)):
        known = None if most is None else TrainedRange(max_triangles=most)
        path.write_bytes(encode_weights(network(), known))
        renderer = NeuralRenderer.load(tmp_path, device="cpu")  # a folder will do
        with warnings.catch_warnings(record=True) as heard:
            warnings.simplefilter("always")
            assert renderer.render(scene, 8).shape == (2, 8, 8, 3)
        texts = [str(each.message) for each in heard]
        assert len(texts) == told
        assert all("3 triangles, and the network was trained on at most 2" in t for t in texts)


def test_what_it_was_trained_on_goes_round_through_metadata() -> None:
    for known in (TrainedRange(max_triangles=1536), TrainedRange(resolution=64), TrainedRange()):
        assert trained_range(known.as_metadata()) == known
    assert trained_range({}) is None
    lies = ("", "[]", '{"max_triangles": "many"}', '{"resolution": Infinity}', "[" * 100_000)
    for text in lies:
        with pytest.raises(TrilightError, match="trilight_trained_range: not readable"):
            trained_range({RANGE_KEY: text})


@for_each("resolution", [0, -8, 12])
def test_a_resolution_between_bundles_is_one_line(resolution: int) -> None:
    renderer = NeuralRenderer(network())
    expected = f"resolution is {resolution}; expected a positive multiple of 8"
    with pytest.raises(TrilightError, match=expected):
        renderer.render(tiny_scene(), resolution)
    with pytest.raises(TrilightError, match=expected):
        renderer.view(renderer.prepare(tiny_scene()), tiny_scene().c2w[0], 40.0, resolution)


def test_equal_networks_have_equal_digests() -> None:
    assert NeuralRenderer(network()).digest == NeuralRenderer(network()).digest
    other = network()
    with torch.no_grad():
        other.encoder.registers_NW[0, 0] += 1
    assert NeuralRenderer(other).digest != NeuralRenderer(network()).digest


def test_what_memory_cannot_hold_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    renderer = NeuralRenderer(network())
    monkeypatch.setattr(neural_renderer, "_free_bytes", lambda device: 1000)
    with pytest.raises(TrilightError, match="3 triangles need more than 0.0 GB of memory"):
        renderer.prepare(tiny_scene())
    monkeypatch.setattr(neural_renderer, "_free_bytes", lambda device: None)
    renderer.prepare(tiny_scene())


def test_pictures_are_as_wide_as_those_that_it_was_trained_on() -> None:
    known = NeuralRenderer(network(), TrainedRange(max_triangles=None, resolution=16))
    assert known.render(tiny_scene()).shape == (2, 16, 16, 3)
    with pytest.raises(TrilightError, match="resolution is None, and the network does not say"):
        NeuralRenderer(network()).render(tiny_scene())


def test_a_sky_that_is_left_out_is_said() -> None:
    renderer = NeuralRenderer(network())
    scene = tiny_scene()
    environment = Environment(radiance_rgb=np.ones((2, 4, 3), np.float32))
    below_sky = renderer.prepare(dataclasses.replace(scene, environment=environment))
    assert any("has an environment" in note for note in below_sky.notes)
    assert not any("environment" in note for note in renderer.prepare(scene).notes)
