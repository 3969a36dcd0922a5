"""A material column that is declared outside of the product goes through all of it."""

import dataclasses
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from infra.render.path_tracer import PathTracer, RenderChild
from model.inference import NeuralRenderer
from model.open import open_network, save_published
from model.scene_tensors import batch_scenes, scene_tensors
from pipeline.generation.inspect_scene import _facts
from pipeline.renders.mitsuba_variant import choose_variant
from pipeline.renders.preview import PreviewSettings
from scene_templates.families import DEFAULT_FAMILIES
from scene_templates.settings import SceneSettings
from storage.dataset.dataset import Dataset
from storage.errors import TrilightError
from storage.records.material import EMISSION, PUBLISHED_COLUMNS
from storage.records.scene import Scene
from tests.columns_kit import COAT, TINT, WITH_COAT, declared
from tests.for_each import for_each
from tests.infra.child_here import use_children_here
from tests.model.kit import awake, tiny_config
from tests.pipeline.scenes.small_pool import first_scene, small_pool
from tests.scenes_by_hand import FLOOR, tiny_scene
from tests.train.kit import TINY_MODEL, take, tiny_run, trained
from tests.train.toy import toy_sample, write_toy_dataset
from train.data.augment import permute_channels, scale_light
from train.data.scenes import training_scene
from train.loop.train_state import new_state
from train.settings import TrainSettings

SETTINGS = SceneSettings(families=DEFAULT_FAMILIES, num_views=2, max_triangles=600)

FOUR = tiny_run(num_steps=4, shuffle_shards=1)


def coated_run() -> TrainSettings:
    return dataclasses.replace(
        FOUR, model=dataclasses.replace(TINY_MODEL, material_columns=WITH_COAT)
    )


def composed(index: int) -> Scene:
    return first_scene(SETTINGS, small_pool(), seed=0, scene_index=index)


@pytest.fixture(scope="module", autouse=True)
def coat() -> Iterator[None]:
    with declared(COAT):
        yield


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("coated")
    return write_toy_dataset(
        folder, train=4, validation=1, per_shard=2, resolution=16, scene_of=composed
    )


@pytest.fixture(scope="module")
def run(data: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "coated"
    trained(coated_run(), [str(data.folder.root)], out)
    return out


def test_composed_scenes_differ_in_the_column_alone() -> None:
    scene = composed(0)
    reflects = (scene.materials[:, EMISSION] == 0).all(axis=1)
    drawn = scene.materials[:, -1]
    assert len(np.unique(drawn[reflects])) == reflects.sum() > 1
    assert ((drawn[reflects] >= 0.1) & (drawn[reflects] <= 0.9)).all()
    assert (drawn[~reflects] == 0).all()
    with declared(dataclasses.replace(COAT, draw=None)):
        plain = composed(0)
    assert (plain.materials[:, -1] == 0).all()
    assert np.array_equal(plain.materials[:, :-1], scene.materials[:, :-1])
    assert np.array_equal(plain.vertex_positions, scene.vertex_positions)
    assert np.array_equal(plain.c2w, scene.c2w)


@for_each("number", [2.0, float("nan")])
def test_a_draw_outside_of_the_range_is_named(number: float) -> None:
    wrong = dataclasses.replace(COAT, draw=lambda rng, count: np.full((count, 1), number))
    with declared(wrong), pytest.raises(TrilightError, match="'coat': its draw returned"):
        composed(0)


def test_the_stream_shows_what_was_composed(data: Dataset) -> None:
    (batch,) = take(data, dataclasses.replace(coated_run(), scenes_per_step=4), 1)
    assert {scene.key for scene in batch} == {f"{index:09d}" for index in range(4)}
    for shown in batch:
        scene = composed(int(shown.key))
        assert shown.tensors.columns == WITH_COAT
        coats = shown.tensors.material_TM[:, -1].numpy()
        assert np.array_equal(coats, scene.materials[scene.material_index, -1])


def test_symmetries_permute_and_scale_an_added_colour_and_leave_a_scalar() -> None:
    with declared(COAT, TINT):
        sample = toy_sample(0)
        rng = np.random.default_rng(0)
        sample.scene.materials[:, -4:] = rng.random((len(sample.scene.materials), 4))
        scene = training_scene(sample, 16)
        before = scene.tensors.material_TM[:, -4:]
        turned = permute_channels(scene, np.array([2, 0, 1])).tensors.material_TM[:, -4:]
        assert torch.equal(turned[:, 0], before[:, 0])
        assert torch.equal(turned[:, 1:], before[:, [3, 1, 2]])
        scaled = scale_light(scene, 2.0).tensors.material_TM[:, -4:]
        assert torch.equal(scaled[:, 0], before[:, 0])
        assert torch.equal(scaled[:, 1:], 2 * before[:, 1:])


def test_a_network_learns_from_it_and_is_opened_again(run: Path) -> None:
    checkpoint = run / "checkpoints" / "step-000000004.safetensors"
    pictures = []
    for place in (run, checkpoint):
        network = open_network(place)
        assert network.config.material_columns == WITH_COAT
        with torch.no_grad():
            pictures.append(network(batch_scenes([scene_tensors(composed(0))]), 16))
    assert torch.equal(*pictures)
    start = new_state(coated_run()).model.encoder.tokens.material.weight
    learnt = open_network(run).encoder.tokens.material.weight
    assert learnt.shape == start.shape == (36, 11)
    assert not torch.equal(learnt[:, -1], start[:, -1]), "no gradient reached the column"
    renderer = NeuralRenderer.load(run / "model.safetensors")
    plain, coated = tiny_scene(), tiny_scene()
    coated.materials[FLOOR, -1] = 0.9
    assert not np.array_equal(renderer.render(plain, 16), renderer.render(coated, 16))
    assert not renderer.prepare(coated).notes
    with declared():
        for place in (run, checkpoint):
            with pytest.raises(TrilightError, match="'coat'.*has to be declared first"):
                open_network(place)


def test_the_published_form_refuses_it(tmp_path: Path) -> None:
    config = dataclasses.replace(tiny_config("dpt"), material_columns=WITH_COAT)
    with pytest.raises(TrilightError, match="material_columns .*coat"):
        save_published(awake(config), tmp_path)


def test_the_shipped_network_gives_the_same_bytes_and_says_what_it_does_not_read() -> None:
    renderer = NeuralRenderer(open_network("builtin:"))
    assert open_network("builtin:").config.material_columns == PUBLISHED_COLUMNS
    coated = tiny_scene()
    coated.materials[FLOOR, -1] = 0.9
    with pytest.warns(UserWarning, match="does not read coat"):
        shown = renderer.render(coated, 16)
    with declared(), warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.array_equal(renderer.render(tiny_scene(), 16), shown)


def test_the_path_tracer_says_what_it_does_not_read_and_inspect_what_is_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    use_children_here(monkeypatch)
    child = RenderChild(choose_variant(), threads=1)
    tracer = PathTracer(child, PreviewSettings(resolution=8, spp=1, denoiser="off"))
    scene = tiny_scene()
    assert tracer.load(scene, "floor").notes == ()
    scene.materials[FLOOR, -1] = 0.9
    assert tracer.load(scene, "floor").notes == ("the path tracer does not read coat",)
    assert _facts(scene).get("added_columns") == "coat"
    scene.materials[FLOOR, -1] = 0.0
    assert _facts(scene).get("added_columns") is None


def test_a_network_of_four_columns_trains_on_the_same_data(data: Dataset, tmp_path: Path) -> None:
    trained(FOUR, [str(data.folder.root)], tmp_path / "four")
    shape = open_network(tmp_path / "four").encoder.tokens.material.weight.shape
    assert shape == (36, 10)
