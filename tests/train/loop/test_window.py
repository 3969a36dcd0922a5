"""Work of training: the formula against torch's counter, what batching wastes, and a peak."""

import dataclasses

import numpy as np
import pytest
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from model.config import ModelConfig
from model.costs import Workload, training_flops
from model.renderformer import RenderFormer
from storage.seeds import rng_for
from tests.for_each import for_each
from tests.train.kit import TINY_MODEL
from tests.train.toy import toy_sample
from train.data.buckets import MOST_WASTE, TrainingBatch, bucket_scenes, make_batch
from train.data.scenes import TrainingScene, training_scene
from train.loop.window import device_peak

RESOLUTION = 16
DEEPER = dataclasses.replace(TINY_MODEL, encoder_layers=2, decoder_layers=2)


def counted(config: ModelConfig, scenes: list[TrainingScene]) -> int:
    """Count a real forward and backward pass; the plain attention is the one that counts all."""
    return counted_batch(config, make_batch(scenes))


def counted_batch(config: ModelConfig, batch: TrainingBatch) -> int:
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        RenderFormer(config)(batch.scenes, RESOLUTION).sum().backward()
    return int(counter.get_total_flops())


def flops(num_triangles: int) -> int:
    workload = Workload(triangles=num_triangles, views=2, resolution=RESOLUTION)
    return training_flops(DEEPER, workload)


@for_each("boxes", [1, 5])
def test_the_formula_says_what_any_scene_needs(boxes: int) -> None:
    scene = with_triangles(training_scene(toy_sample(0), RESOLUTION), 12 * boxes)
    # a first layer needs no gradient of its inputs, which our factor of 3 counts: below 10 %
    assert flops(12 * boxes) == pytest.approx(counted(DEEPER, [scene]), rel=0.1)


def with_triangles(scene: TrainingScene, count: int) -> TrainingScene:
    old = scene.tensors
    rows = torch.arange(count) % old.num_triangles
    tensors = dataclasses.replace(
        old,
        triangles_T33=old.triangles_T33[rows],
        normals_T33=old.normals_T33[rows],
        material_TM=old.material_TM[rows],
    )
    return dataclasses.replace(scene, tensors=tensors)


def test_batching_wastes_less_than_it_may() -> None:
    """Counted by torch, against the sum of single scenes, over lengths as they are drawn."""
    one = training_scene(toy_sample(0), RESOLUTION)
    lengths = rng_for(0, "lengths").integers(10, 300, 7)
    scenes = [with_triangles(one, int(length)) for length in lengths]
    batches = bucket_scenes(scenes, flops, 16)
    together = sum(counted_batch(DEEPER, batch) for batch in batches)
    alone = sum(counted(DEEPER, [scene]) for scene in scenes)
    assert 1 < together / alone < 1 + MOST_WASTE
    assert len(batches) < len(scenes)
    assert np.ptp(lengths) > 200


def test_a_device_has_a_peak() -> None:
    assert 1e8 < device_peak(torch.device("cpu"), torch.float32) < 1e15
