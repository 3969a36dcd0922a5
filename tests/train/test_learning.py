"""That learning happens: a picture comes of its own scene, unseen scenes beat any stored picture.

And of networks that are told hits, skies and textures: from shards to weights, to the bit after a
stop, and traced alike by any crew. What is slow takes minutes on a busy machine.

And a step of each kind of network on a graphics card that is not there (fake_card): on tensors
without numbers, forward, loss with LPIPS, backward, clipping, Muon, running mean, validation,
evaluation, checkpoint. A module that stayed behind shows here alone. Functions without `test_` run
in a process of their own.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from model.config import SIZES, ModelConfig
from model.hits.traced import INPUTS
from model.inference import NeuralRenderer
from model.open import open_network
from model.renderformer import RenderFormer
from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.training_data import open_training_data
from storage.errors import TrilightError
from storage.metrics import psnr_log_db
from storage.records.retextured import with_textures
from storage.records.scene import Scene
from storage.records.texture import Texture
from tests.for_each import case
from tests.model.kit import hits_config, tiny_config
from tests.sky_maps import smooth
from tests.train.fake_card import CARD, card_process, fake_card
from tests.train.kit import (
    eval_config,
    require_resumed_to_the_bit,
    take,
    take_step,
    tiny_run,
    trained,
)
from tests.train.loss.test_training_loss import small_weights
from tests.train.toy import (
    toy_picture,
    toy_sample,
    toy_scene,
    write_toy_dataset,
)
from train.data.buckets import collate_batch
from train.data.scenes import TrainingScene, training_scene
from train.evaluation.evaluate import judge_views, make_baselines
from train.evaluation.metrics import NETWORK, summarize_views
from train.evaluation.validation import MEDIAN, NEAREST, predict
from train.loop.distributed import DistributedContext
from train.loop.train_state import TrainState, new_state
from train.loss.training_loss import LINEAR_FILE, VGG16_FILE, load_lpips
from train.presets import override_training_preset
from train.settings import AugmentationSettings, TrainSettings, learning_rate

SMALL = dataclasses.replace(
    SIZES["smoke"](), width=64, num_heads=1, hidden_width=192, encoder_layers=2, decoder_layers=2
)


def memorised(scenes: list[TrainingScene], model: ModelConfig, steps: int) -> TrainState:
    settings = tiny_run(
        model=model,
        resolution=scenes[0].target_VRR3.shape[1],
        num_steps=steps,
        warmup_steps=20,
        learning_rate=2e-3,
        final_rate_share=0.01,
        augmentation=AugmentationSettings(),
    )
    state = new_state(settings)
    batches = [collate_batch([scene]) for scene in scenes]
    for number in range(steps):
        take_step(state, batches, learning_rate(number, settings))
    return state


def score(state: TrainState, scene: TrainingScene, target: TrainingScene) -> float:
    """Return the psnr_log_db of one scene's picture against another's."""
    wanted = 10 ** target.target_VRR3[0].double().numpy() - 1
    return psnr_log_db(predict(state.eval_model, scene.tensors, len(wanted))[0], wanted)


@pytest.mark.slow("training")
def test_a_picture_comes_from_its_own_scene() -> None:
    """Four scenes under the same camera: only the tokens tell them apart."""
    first = toy_scene(0)
    scenes = []
    for index in range(4):
        seen = toy_scene(index).with_cameras(first.c2w[:1], first.fov_deg[:1])
        sample = dataclasses.replace(
            toy_sample(0, views=1), scene=seen, radiance_rgb=toy_picture(seen, 0, 16)[None]
        )
        scenes.append(training_scene(sample, 16))
    state = memorised(scenes, SMALL, steps=400)
    for index, scene in enumerate(scenes):
        other = scenes[(index + 1) % len(scenes)]
        # the tokens of another scene, judged against this one's picture
        assert score(state, scene, scene) > score(state, other, scene) + 3


@pytest.mark.slow("training")
def test_unseen_scenes_look_better_than_any_stored_picture(tmp_path: Path) -> None:
    """Than the median one, and than the closest of all training views, which knows the answer."""
    dataset = write_toy_dataset(
        tmp_path / "data", train=64, validation=8, per_shard=64, resolution=16
    )
    folder = dataset.folder
    settings = tiny_run(
        model=SMALL,
        num_steps=600,
        warmup_steps=30,
        scenes_per_step=8,
        learning_rate=3e-3,
        log_every=50,
        validate_every=300,
        checkpoint_every=600,
    )
    trained(settings, [str(folder.root)], tmp_path / "out")
    shards = open_training_data([str(folder.root)]).split("train")
    network, baselines = open_network(tmp_path / "out"), make_baselines(shards, 16)
    views = judge_views(eval_config(dataset, network, baselines=baselines), lambda: None)
    means = {
        name: summarize_views(views, name)["log_l1"]["mean"] for name in (NETWORK, MEDIAN, NEAREST)
    }
    # measured: 0.0292 against 0.0395 and 0.0313
    assert means[NETWORK] < 0.9 * means[MEDIAN]
    assert means[NETWORK] < means[NEAREST]


HITS_AUGMENTATION = AugmentationSettings(
    rotation="uniform", mirror=True, channels=True, vertex_order=True, withheld_inputs=0.3
)


HITS_RUN = tiny_run(model=hits_config(), run="tiny-hits", augmentation=HITS_AUGMENTATION)


def test_views_are_traced_after_the_symmetries_and_lack_inputs_by_chance(dataset: Dataset) -> None:
    """Whatever the thread and the rank."""
    scenes = take(dataset, HITS_RUN, 1, first=3)[0]
    alone = {scene.key: scene.tensors.traced for scene in scenes}
    for rank in range(3):
        part = {"workers": 3, "rank": rank, "world_size": 3}
        ((other,),) = take(dataset, HITS_RUN, 1, first=3, **part)
        a, b = alone.pop(other.key), other.tensors.traced
        assert a is not None and b is not None
        for name, value in vars(a).items():
            assert torch.equal(value, getattr(b, name)), name
    given = torch.cat([s.tensors.traced.given_VI for s in scenes if s.tensors.traced])
    assert given.shape == (6, len(INPUTS))
    assert 0 < given.mean() < 1
    for scene in scenes:
        traced = scene.tensors.traced
        assert traced is not None
        # each pixel that is lit in the picture, mirrored as it is, is one that meets something
        lit = scene.target_VRR3.amax(dim=-1) > 0.01
        assert (traced.pixels_VRRC[..., 0] > 0)[lit].float().mean() > 0.95


def _scene_of_maps(index: int) -> Scene:
    """Return a toy scene: two in three below a sky, two in three with a texture."""
    scene = toy_scene(index)
    if index % 3 != 1:
        scene = dataclasses.replace(scene, environment=smooth(8))
    if index % 3:
        rng = np.random.default_rng(index)
        texture = Texture(texels=rng.integers(0, 90, (8, 8, 3), np.uint8))
        rows = np.full((len(scene.materials), 3), -1, np.int32)
        rows[scene.material_index[~scene.triangle_emits][0], 0] = 0
        uv = scene.vertex_positions[scene.faces.ravel(), :2].astype(np.float32)
        scene = with_textures(scene, uv, (texture,), rows)
    return scene


def test_a_run_that_is_told_hits_below_skies_resumes_to_the_bit_and_one_that_is_not_is_refused(
    tmp_path: Path,
) -> None:
    """With steps in which no scene has a sky, or a texture; refused before the first step."""
    few: dict[str, Any] = {"train": 6, "validation": 2, "per_shard": 3}
    with_maps = write_toy_dataset(tmp_path / "data", **few, scene_of=_scene_of_maps)
    run = dataclasses.replace(
        HITS_RUN,
        model=hits_config(sky_rays=2),
        run="tiny-maps",
        augmentation=dataclasses.replace(HITS_AUGMENTATION, light_scale=2.0),
        num_steps=4,
        checkpoint_every=2,
    )
    require_resumed_to_the_bit(run, with_maps, tmp_path / "out")
    run = dataclasses.replace(run, model=tiny_config())
    with pytest.raises(TrilightError, match=r"does not know its light.*model.sky_rays=16"):
        trained(run, with_maps, tmp_path / "run")
    assert not list((tmp_path / "run").glob("checkpoints/*"))


@pytest.mark.slow("gpu")  # a process and a library of its own
def test_each_view_stage_takes_its_step_on_a_card_where_a_run_goes_on(tmp_path: Path) -> None:
    """And a second one begins; LPIPS by files like the published ones, with few channels."""
    data = str(tmp_path / "data")
    write_toy_dataset(tmp_path / "data", train=2, validation=2, resolution=RESOLUTION)
    lpips = str(tmp_path)
    for name, weights in zip((VGG16_FILE, LINEAR_FILE), small_weights(), strict=True):
        torch.save(weights, tmp_path / name)
    with card_process(tmp_path) as card:
        for run, size in (("pretrain", "smoke"), ("hits", "hits-smoke")):
            with case(run):
                card.submit(train_and_judge, run, size, data, lpips, tmp_path / run).result()
        card.submit(resume, data, lpips, tmp_path).result()


RESOLUTION = 64
"""One window of the large network's."""


def one_step_of(run: str, size: str) -> TrainSettings:
    """Return a named run at a named size, with one step of two scenes of the toy's."""
    changes = {
        "model": size,
        "resolution": RESOLUTION,
        "num_steps": 1,
        "warmup_steps": 0,
        "scenes_per_step": 2,
        "scenes_per_pass": 2,
        "views_per_scene": 1,
        "log_every": 1,
        "validate_every": 1,
        "checkpoint_every": 1,
        "validation_scenes": 1,
        "from_weights": False,
    }
    return override_training_preset(run, changes)


def train_and_judge(run: str, size: str, data: str, lpips: str, out: Path) -> None:
    """Train by run_training, evaluate and render."""
    settings = one_step_of(run, size)
    with fake_card():
        crew = DistributedContext(device=CARD)
        assert trained(settings, [data], out, lpips=lpips, dist_context=crew).skipped_steps == 0
        network = RenderFormer(settings.model).to(CARD)
        distance = load_lpips(lpips)
        assert distance is not None
        judged = {"resolution": RESOLUTION, "lpips": distance.to(CARD), "most_scenes": 1}
        config = eval_config(open_dataset(data), network, **judged)
        (view, *_) = judge_views(config, lambda: None)
        assert view.scores["network"]["lpips"] is not None
        assert NeuralRenderer(network).render(toy_scene(0), RESOLUTION).shape[1:] == (64, 64, 3)


def resume(data: str, lpips: str, out: Path) -> None:
    """Go on with a run on the card, and begin a second stage with it.

    Muon is torch's own there, whatever the processor beside the card has.
    """
    first = dataclasses.replace(one_step_of("builtin", "smoke"), num_steps=2, warmup_steps=1)
    second = dataclasses.replace(one_step_of("finetune", "smoke"), from_weights=True)
    with pytest.MonkeyPatch.context() as patch, fake_card():
        patch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)
        crew = DistributedContext(device=CARD)
        trained(first, [data], out / "first", dist_context=crew)
        checkpoint = out / "first" / "checkpoints" / "step-000000002.safetensors"
        checkpoint.unlink()
        trained(first, [data], out / "first", resume=True, dist_context=crew)
        begin: dict[str, Any] = {"begin_with": str(checkpoint), "lpips": lpips}
        trained(second, [data], out / "second", **begin, dist_context=crew)
    for name in ("first", "second"):
        record = json.loads((out / name / "settings.json").read_text())
        assert record["muon_precision"] == "bfloat16"
