"""A network judged on every view of a split, beside baselines that ignore the scene."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import SkipValidation

from model.config import ModelConfig
from model.hits.traced import INPUTS, with_others_tokens
from model.hits.tracing import with_traced
from model.light_groups import light_groups
from model.neural_renderer import NeuralRenderer
from model.renderformer import RenderFormer
from model.scene_tensors import SceneTensors
from model.weights import MAX_LIGHTS
from storage.conventions import radiance_from_log10
from storage.dataset.shard_set import ShardSet
from storage.errors import TrilightError
from storage.metrics import psnr_log_db
from storage.records.sample import Sample
from storage.records.scene import Scene
from storage.seeds import rng_for
from storage.settings.described import checked
from train.data.scenes import TrainingScene, training_scene
from train.data.unusable import Unusable, first_samples
from train.evaluation.judge import JudgedScene, judged_scene, predict
from train.evaluation.judged_view import GROUPED, NETWORK, JudgedView, facts_of
from train.evaluation.metrics import noise_floors, picture_scores
from train.evaluation.order import SceneCount, Width
from train.evaluation.rivals import Rivals
from train.evaluation.same_time import CAPTION, TRACER, TracedBeside
from train.evaluation.sheet import SheetView
from train.loss.lpips import Lpips

RIVAL_SCENES = 256
"""Training scenes that rivals are taken from."""

SHEET_VIEWS = 8
"""Views on a sheet."""


@checked("evaluate")
class Contest:
    """Who is judged, on what, and by what."""

    network: SkipValidation[RenderFormer]
    """On the device where it is to run."""
    shards: SkipValidation[ShardSet]
    """The split."""
    resolution: Width
    """Pixels across, a divisor of the data's."""
    rivals: SkipValidation[Rivals | None]
    """None where no training data is at hand."""
    lpips: SkipValidation[Lpips | None]
    """Likewise. None where its weights are not at hand: LPIPS is then n/a."""
    most_scenes: SceneCount
    """Maximum number of scenes that are judged, from the start of the split."""
    traced: SkipValidation[TracedBeside | None] = None
    """Who traces pictures in the network's own time, if somebody does."""

    def samples(self) -> Iterator[Sample]:
        """Yield the samples; one that is damaged ends it, since it would be another set."""
        return first_samples(self.shards, self.most_scenes, Unusable(0))


def make_rivals(shards: ShardSet, resolution: int) -> Rivals:
    """Return the rivals that the first scenes of a training split make."""
    samples = first_samples(shards, RIVAL_SCENES, Unusable(0))
    return Rivals(training_scene(sample, resolution) for sample in samples)


def stored_resolution(shards: ShardSet) -> int:
    """Return the pixels across of the first sample."""
    (sample,) = first_samples(shards, 1, Unusable(0))
    return int(sample.radiance_rgb.shape[1])


def judged_views(contest: Contest, scene_done: Callable[[], None]) -> list[JudgedView]:
    """Return a row for every view, in the order of the shards.

    Raises:
        TrilightError: damaged data, a resolution that the data or the network do not have, or no
            scene at all.
    """
    rows: list[JudgedView] = []
    before: SceneTensors | None = None
    for sample in contest.samples():
        judged = judged_scene(sample, contest.resolution)
        if contest.network.config.view_stage == "hits":
            judged = with_traced_views(judged, contest.network.config, contest.resolution)
        contestants = {NETWORK: predict(contest.network, judged.scene)}
        contestants |= withheld_pictures(contest.network, judged.scene)
        grouped = grouped_pictures(contest.network, sample.scene, contest.resolution)
        if grouped is not None:
            contestants[GROUPED] = grouped
        found = [
            _judged(contest, sample, judged, view, contestants)
            for view in range(len(judged.target_VRR3))
        ]
        if before is not None and contest.network.config.scene_tokens:
            found = _with_swapped(found, contest.network, judged, before)
        rows += found
        before = judged.scene.tensors
        scene_done()
    if not rows:
        raise TrilightError("evaluate: the split holds no scene; expected at least one.")
    return rows


def _judged(
    contest: Contest,
    sample: Sample,
    judged: JudgedScene,
    view: int,
    contestants: Mapping[str, NDArray[np.float64]],
) -> JudgedView:
    target, hits = judged.target_VRR3[view], judged.hits_VRR[view]
    pictures = {name: pictures_VRR3[view] for name, pictures_VRR3 in contestants.items()}
    if contest.rivals is not None:
        pictures |= contest.rivals.pictures(target)
    if contest.traced is not None:
        traced = contest.traced.judged(sample, view)
        pictures |= {} if traced is None else {TRACER: traced}
    return JudgedView(
        **facts_of(sample),
        view=view,
        floors=noise_floors(
            sample.views[view],
            target,
            hits,
            contest.lpips,
            rng_for(0, f"noise of {sample.key}", view),
        ),
        scores={
            name: picture_scores(shown, target, hits, contest.lpips)
            for name, shown in pictures.items()
        },
    )


def _with_swapped(
    rows: Sequence[JudgedView], network: RenderFormer, judged: JudgedScene, other: SceneTensors
) -> list[JudgedView]:
    pictures_VRR3 = swapped_pictures(network, judged.scene, other)
    return [
        dataclasses.replace(row, swapped_psnr_log_db=psnr_log_db(picture, target))
        for row, picture, target in zip(rows, pictures_VRR3, judged.target_VRR3, strict=True)
    ]


def sheet_views(contest: Contest, chosen: Sequence[JudgedView]) -> list[SheetView]:
    """Return pictures of some rows, in their order; the scenes are read and computed again."""
    rows_of: dict[str, list[JudgedView]] = {}
    for row in chosen:
        rows_of.setdefault(row.key, []).append(row)
    found: dict[tuple[str, int], SheetView] = {}
    for sample in contest.samples():
        if rows := rows_of.get(sample.key):
            scene = training_scene(sample, contest.resolution)
            pictures = predict(contest.network, scene)
            for row in rows:
                shown = _sheet_view(row, scene, pictures[row.view])
                if contest.traced is not None:
                    traced = contest.traced.shown(sample, row.view)
                    black = np.zeros_like(shown.target_rgb)
                    beside = {CAPTION: black if traced is None else traced}
                    shown = dataclasses.replace(shown, beside_rgb=beside)
                found[row.key, row.view] = shown
    return [found[row.key, row.view] for row in chosen]


def worst_and_median(rows: Sequence[JudgedView]) -> dict[str, list[JudgedView]]:
    """Return the rows of the lowest psnr_log_db and those around the middle, worse ones first."""
    ranked = sorted(rows, key=lambda row: row.scores[NETWORK]["psnr_log_db"] or 0.0)
    start = max((len(ranked) - SHEET_VIEWS) // 2, 0)
    return {"worst": ranked[:SHEET_VIEWS], "median": ranked[start : start + SHEET_VIEWS]}


def worst_of_each_excursion(rows: Sequence[JudgedView]) -> list[JudgedView]:
    """Return the worst row of each axis that leaves the usual range, by the name of the axis."""
    worst: dict[str, JudgedView] = {}
    for row in sorted(rows, key=lambda row: row.scores[NETWORK]["psnr_log_db"] or 0.0):
        if row.excursion is not None:
            worst.setdefault(row.excursion[0], row)
    return [worst[axis] for axis in sorted(worst)]


def _sheet_view(row: JudgedView, scene: TrainingScene, picture: NDArray[np.float64]) -> SheetView:
    scores = row.scores[NETWORK]
    excursion = "" if row.excursion is None else f", {row.excursion[0]} {row.excursion[1]:g}"
    return SheetView(
        name=f"scene {row.key}, view {row.view}: {row.template}, {row.num_triangles} triangles, "
        f"lights: {row.num_lights}{excursion}",
        scores=f"{scores['psnr_log_db']:.1f} dB log (noise {row.floors['psnr_log_db']:.1f}), "
        f"{scores['psnr_linear_db']:.1f} dB linear, SSIM {scores['ssim']:.3f}",
        target_rgb=radiance_from_log10(scene.target_VRR3[row.view].double().numpy()),
        predicted_rgb=picture,
        noise=float(scene.noise_V[row.view]),
    )


def grouped_pictures(
    network: RenderFormer, scene: Scene, resolution: int
) -> NDArray[np.float64] | None:
    """Return what `trilight render` shows of a scene, its groups of lights added up.

    Returns:
        Linear radiance [V, R, R, 3] of at least 0, or None where one pass takes every light.
    """
    by_hits = network.config.view_stage == "hits"
    if by_hits or len(light_groups(scene, MAX_LIGHTS)) == 1:
        return None
    renderer = NeuralRenderer(network)
    prepared = renderer.prepare(scene)
    pictures = [
        renderer.view(prepared, c2w, float(fov_deg), resolution)
        for c2w, fov_deg in zip(scene.c2w, scene.fov_deg, strict=True)
    ]
    return np.stack(pictures).astype(np.float64)


def with_traced_views(judged: JudgedScene, config: ModelConfig, resolution: int) -> JudgedScene:
    """Return a scene with what is traced of it, once for all that a network of hits is asked."""
    tensors = with_traced(judged.scene.tensors, resolution, config)
    return dataclasses.replace(judged, scene=dataclasses.replace(judged.scene, tensors=tensors))


def withheld_pictures(
    network: RenderFormer, scene: TrainingScene
) -> dict[str, NDArray[np.float64]]:
    """Return what a network of hits makes without each of its inputs, by the contestant's name.

    Of a traced scene; of any other, nothing is returned.
    """
    traced = scene.tensors.traced
    if traced is None:
        return {}
    found = {}
    for index, name in enumerate(INPUTS):
        if name == "tokens" and not network.config.scene_tokens:
            continue
        kept_VI = torch.ones_like(traced.given_VI)
        kept_VI[:, index] = 0
        tensors = dataclasses.replace(scene.tensors, traced=traced.without(kept_VI))
        found[f"{NETWORK} without {name}"] = predict(
            network, dataclasses.replace(scene, tensors=tensors)
        )
    return found


def swapped_pictures(
    network: RenderFormer, scene: TrainingScene, other: SceneTensors
) -> NDArray[np.float64]:
    """Return what a network makes with another scene's triangles [V, R, R, 3], linear radiance.

    Does the network look at the scene at all? One that has only learned what pictures look like on
    average is no worse with the triangles of another scene. A network of hits keeps its own hits:
    the other scene's tokens alone are put in place of its own.
    """
    cameras = scene.tensors
    seen = dataclasses.replace(other, c2w_V44=cameras.c2w_V44, fov_deg_V=cameras.fov_deg_V)
    if cameras.traced is not None:
        seen = dataclasses.replace(seen, traced=with_others_tokens(cameras.traced, other.traced))
    return predict(network, dataclasses.replace(scene, tensors=seen))
