"""One step of a run on the card that is not there: as train.loop does it, and seen by a Tracer."""

import dataclasses
import math
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import nn

from infra.bench.roofline.cuda_kernels import cuda_kernels
from infra.bench.roofline.trace import Traced, Tracer
from infra.fake_card.card import CARD, fake_card
from model.hits.traced import INPUTS
from model.hits.traced import Traced as TracedViews
from model.hits.view_inputs import NUM_CHANNELS
from model.renderformer import RenderFormer
from model.scene_tensors import SceneTensors, batch_scenes
from storage.records.material import material_width
from train.data.buckets import TrainingBatch
from train.loop.compiled import compiled_parts
from train.loop.crew import Crew
from train.loop.state import new_state
from train.loop.step import Stepper
from train.loss.lpips import BLOCKS, Lpips
from train.loss.objective import Objective
from train.settings import TrainSettings

UNSTATED_TRIANGLES = 1024
"""Triangles of a scene of a run that sets no limit."""

PADDING = 0.06
"""The shortest scene of a pass is shorter than the longest by this share, so half of it is padding:
what buckets of `pretrain` have (docs/log)."""


def traced_step(settings: TrainSettings, scenes: int) -> Traced:
    """Return the second step of a run, of one pass of so many scenes: all memories are there."""
    settings = dataclasses.replace(settings, compile="no")  # it is estimated, see fusion
    with fake_card(), cuda_kernels():
        state = new_state(settings, CARD)
        lpips = _lpips() if settings.loss.perceptual == "lpips" else None
        objective = Objective(settings.loss, lpips).to(CARD)
        stepper = Stepper(state, settings, objective, Crew(device=CARD))
        tracer = Tracer()
        for name, module, call in parts_of(state.model, objective):
            setattr(module, call, _as_part(tracer, name, getattr(module, call)))
        with tracer.counting():
            for _ in range(2):
                tracer.begin_again()
                batch = _batch(settings, scenes)
                taken = stepper.take([batch], settings.learning_rate)
                state.step += 1
            traced, tracer.traced = tracer.traced, Traced()
            stepper.read([taken])
    return dataclasses.replace(traced, window_waits=tracer.traced.waits)


def parts_of(model: RenderFormer, objective: Objective) -> Iterator[tuple[str, nn.Module, str]]:
    """Yield the parts by which time is counted: name, module, and the method that is one visit."""
    if model.encoder is not None:
        yield "tokens", model.encoder, "forward"
    yield "loss", objective, "forward"
    yield from compiled_parts(model, objective)


def _as_part(tracer: Tracer, name: str, call: Callable[..., Any]) -> Callable[..., Any]:
    def called(*args: Any, **kwargs: Any) -> Any:
        with tracer.part(name):
            return call(*args, **kwargs)

    return called


def _lpips() -> Lpips:
    """Return LPIPS of the published sizes."""
    vgg16, linear, channels = {}, {}, 3
    for block, (numbers, width) in enumerate(zip(BLOCKS, (64, 128, 256, 512, 512), strict=True)):
        for number in numbers:
            vgg16[f"features.{number}.weight"] = torch.empty(width, channels, 3, 3)
            vgg16[f"features.{number}.bias"] = torch.empty(width)
            channels = width
        linear[f"lin{block}.model.1.weight"] = torch.empty(1, width, 1, 1)
    return Lpips(vgg16, linear)


def _batch(settings: TrainSettings, scenes: int) -> TrainingBatch:
    longest = settings.most_triangles or UNSTATED_TRIANGLES
    shorter = [PADDING * index / max(scenes - 1, 1) for index in range(scenes)]
    views, px = settings.views_per_scene, settings.resolution
    return TrainingBatch(
        scenes=batch_scenes([_scene(settings, round(longest * (1 - each))) for each in shorter]),
        target_BVRR3=torch.empty(scenes, views, px, px, 3),
        noise_BV=torch.empty(scenes, views),
    )


def _scene(settings: TrainSettings, triangles: int) -> SceneTensors:
    views, px, model = settings.views_per_scene, settings.resolution, settings.model
    traced = None
    if model.view_stage == "hits":
        anchors = math.gcd(model.hit_anchors, px) ** 2
        traced = TracedViews(
            sides_T12=torch.empty(triangles, 12),
            unit_3=torch.empty(3),
            pixels_VRRC=torch.empty(views, px, px, NUM_CHANNELS),
            anchor_VA=torch.empty(views, anchors, dtype=torch.int64),
            gathered_VA3=torch.empty(views, anchors, 3),
            given_VI=torch.empty(views, len(INPUTS)),
        )
    return SceneTensors(
        triangles_T33=torch.empty(triangles, 3, 3),
        normals_T33=torch.empty(triangles, 3, 3),
        material_TM=torch.empty(triangles, material_width(model.material_columns)),
        c2w_V44=torch.empty(views, 4, 4),
        fov_deg_V=torch.empty(views),
        columns=model.material_columns,
        traced=traced,
    )
