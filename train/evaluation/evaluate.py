"""Evaluation of a network on every view of a split, with baselines that ignore the scene.

The path tracer is judged with as many CPU seconds as the network. The network is timed on a few
scenes of its evaluation, and so are previews of 1, 2, 4, ... samples per pixel with either filter.
The baseline is the preview of the most samples whose further view takes no longer than the
network's; if even one sample takes longer, it is that one.
"""

import contextlib
import dataclasses
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import SkipValidation

from model.hits.traced import INPUTS
from model.hits.tracing import with_traced
from model.inference import NeuralRenderer, light_groups
from model.renderformer import RenderFormer
from model.scene_tensors import SceneTensors
from model.weights import MAX_LIGHTS
from storage.conventions import radiance_from_log10
from storage.dataset.shard_set import ShardSet
from storage.errors import TrilightError, Unrenderable
from storage.metrics import psnr_log_db
from storage.records.sample import Sample
from storage.records.scene import Scene
from storage.renderer import Camera, ReadyScene, Renderer
from storage.settings.described import checked
from train.data.bad_samples import first_samples
from train.data.scenes import TrainingScene, training_scene
from train.evaluation.metrics import (
    GROUPED,
    NETWORK,
    JudgedView,
    interval_text,
    noise_floors,
    paired_lead,
    picture_scores,
    scene_facts,
    summarize_views,
)
from train.evaluation.options import SceneCount, Width
from train.evaluation.sheet import SheetView
from train.evaluation.validation import Baselines, ValidationScene, predict, validation_scene
from train.loss.training_loss import Lpips

BASELINE_SCENES = 256
"""Number of training scenes for the baselines."""

SHEET_VIEWS = 8
"""Maximum number of views on a sheet."""


@checked("evaluate")
class EvalConfig:
    """Network, data, baselines and metrics of an evaluation."""

    network: SkipValidation[RenderFormer]
    """Network to evaluate, on the device where it runs."""
    shards: SkipValidation[ShardSet]
    """Shards of the split to evaluate on."""
    resolution: Width
    """Width of the pictures in pixels, a divisor of the data's."""
    baselines: SkipValidation[Baselines | None]
    """Baselines from training data; None without such data."""
    lpips: SkipValidation[Lpips | None]
    """The LPIPS network; None without its weights: LPIPS is then n/a."""
    most_scenes: SceneCount
    """Maximum number of scenes, from the start of the split."""
    tracer: SkipValidation[Renderer | None] = None
    """Path tracer at equal time; None leaves it out."""
    tracer_views: int = 0
    """Maximum number of views for the path tracer."""

    @property
    def num_scenes(self) -> int:
        """Number of scenes to evaluate; opens only shards that are evaluated anyway."""
        count = 0
        for number in range(len(self.shards.names)):
            if count < self.most_scenes:
                count += self.shards.num_samples(number)
        return min(count, self.most_scenes)

    def samples(self) -> Iterator[Sample]:
        """Yield the samples; a damaged one raises, since the scores would be of another set."""
        return first_samples(self.shards, self.most_scenes)


def make_baselines(shards: ShardSet, resolution: int) -> Baselines:
    """Return the baselines from the first scenes of a training split."""
    samples = first_samples(shards, BASELINE_SCENES)
    return Baselines(training_scene(sample, resolution) for sample in samples)


def stored_resolution(shards: ShardSet) -> int:
    """Return the width in pixels of the first sample's pictures."""
    (sample,) = first_samples(shards, 1)
    return int(sample.radiance_rgb.shape[1])


def judge_views(config: EvalConfig, scene_done: Callable[[], None]) -> list[JudgedView]:
    """Score every view, in the order of the shards.

    Raises:
        TrilightError: damaged data, a resolution that data or network do not support, or no scene.
    """
    rows: list[JudgedView] = []
    before: SceneTensors | None = None
    device = next(config.network.parameters()).device
    every, first = spread_views(config.tracer_views, config.num_scenes)
    for number, sample in enumerate(config.samples()):
        scene = validation_scene(sample, config.resolution)
        tensors = with_traced(  # once for all predictions
            scene.scene.tensors, config.resolution, config.network.config, device=device
        )
        contestants = {NETWORK: predict(config.network, tensors, config.resolution)}
        contestants |= withheld_pictures(config.network, tensors, config.resolution)
        contestants |= grouped_pictures(config.network, sample.scene, config.resolution)
        swapped_VRR3 = _swapped_pictures(config, tensors, before)
        views = range(len(scene.target_VRR3))
        traced = _traced_pictures(config, sample, views[:first] if number % every == 0 else ())
        for view in views:
            pictures = {name: pictures_VRR3[view] for name, pictures_VRR3 in contestants.items()}
            if config.baselines is not None:
                pictures |= config.baselines.pictures(scene.target_VRR3[view])
            if view in traced:
                pictures[TRACER] = traced[view]
            rows.append(judge_view(sample, scene, view, pictures, config.lpips))
            if swapped_VRR3 is not None:
                score = psnr_log_db(swapped_VRR3[view], scene.target_VRR3[view])
                rows[-1] = dataclasses.replace(rows[-1], swapped_psnr_log_db=score)
        before = tensors
        scene_done()
    if not rows:
        raise TrilightError("evaluate: the split holds no scene; expected at least one.")
    return rows


def judge_view(
    sample: Sample,
    judged: ValidationScene,
    view: int,
    pictures: Mapping[str, NDArray],
    lpips: Lpips | None,
) -> JudgedView:
    """Return the row of a view from its pictures [R, R, 3] by method, linear radiance."""
    target = judged.target_VRR3[view]
    hits = judged.hits_VRR[view]
    return JudgedView(
        **scene_facts(sample),
        view=view,
        floors=noise_floors(sample, view, target, hits, lpips),
        scores={
            name: picture_scores(picture, target, hits, lpips) for name, picture in pictures.items()
        },
    )


def _traced_pictures(
    config: EvalConfig, sample: Sample, views: Sequence[int]
) -> dict[int, NDArray[np.float32]]:
    """Return the path tracer's pictures of some views; none if it cannot trace the scene."""
    if config.tracer is None or not views:
        return {}
    scene = sample.scene
    try:
        loaded = config.tracer.load(scene, sample.key)
        return {view: loaded.render(Camera.of_scene(scene, view)).radiance_rgb for view in views}
    except Unrenderable:
        return {}


def _swapped_pictures(
    config: EvalConfig, cameras: SceneTensors, other: SceneTensors | None
) -> NDArray[np.float64] | None:
    """Return predictions that are given another scene's triangles; None without such a scene.

    This tests whether the network uses the scene: one that has only learned an average picture is
    no worse with other triangles. A network of hits keeps its own hits; only the scene's tokens are
    replaced.
    """
    if other is None or not config.network.config.scene_tokens:
        return None
    seen = dataclasses.replace(  # its albedo, which other cameras have seen, is traced again
        other, c2w_V44=cameras.c2w_V44, fov_deg_V=cameras.fov_deg_V, albedo_VRR6=None
    )
    if cameras.traced is not None and other.traced is not None:
        # in the unit of these views, so that the other scene is neither brighter nor darker
        ratio_12 = (cameras.traced.unit_3 / other.traced.unit_3).repeat(4)
        traced = dataclasses.replace(cameras.traced, sides_T12=other.traced.sides_T12 * ratio_12)
        seen = dataclasses.replace(seen, traced=traced)
    return predict(config.network, seen, config.resolution)


def sheet_views(config: EvalConfig, chosen: Sequence[JudgedView]) -> list[SheetView]:
    """Render some views again for a sheet, in the order of their rows."""
    sheet_of_view: dict[tuple[str, int], SheetView] = {}
    for sample in config.samples():
        if rows := [row for row in chosen if row.key == sample.key]:
            scene = training_scene(sample, config.resolution)
            pictures = predict(config.network, scene.tensors, config.resolution)
            traced = _traced_pictures(config, sample, [row.view for row in rows])
            black = np.zeros_like(pictures[0])
            for row in rows:
                extra = {} if config.tracer is None else {CAPTION: traced.get(row.view, black)}
                view = _sheet_view(row, scene, pictures[row.view], extra)
                sheet_of_view[row.key, row.view] = view
    return [sheet_of_view[row.key, row.view] for row in chosen]


def rows_of_sheets(rows: Sequence[JudgedView]) -> dict[str, list[JudgedView]]:
    """Return the rows of each sheet, by psnr_log_db: the worst ones, and those around the median.

    If any scene is outside the usual range, also the worst row of each axis, sorted by axis.
    """
    ranked = sorted(rows, key=lambda row: row.scores[NETWORK]["psnr_log_db"] or 0.0)
    start = max((len(ranked) - SHEET_VIEWS) // 2, 0)
    worst: dict[str, JudgedView] = {}
    for row in ranked:
        if row.excursion is not None:
            worst.setdefault(row.excursion[0], row)
    sheets = {"worst": ranked[:SHEET_VIEWS], "median": ranked[start : start + SHEET_VIEWS]}
    return sheets | (
        {"worst of each axis": [worst[axis] for axis in sorted(worst)]} if worst else {}
    )


def _sheet_view(
    row: JudgedView, scene: TrainingScene, picture: NDArray, extra_rgb: Mapping[str, NDArray]
) -> SheetView:
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
        extra_rgb=extra_rgb,
    )


def grouped_pictures(
    network: RenderFormer, scene: Scene, resolution: int
) -> dict[str, NDArray[np.float64]]:
    """Render a scene as `trilight render` does, as the sum over groups of lights.

    Returns:
        Linear radiance [V, R, R, 3] of at least 0 of GROUPED; empty if one pass takes every light.
    """
    if network.config.view_stage == "hits" or len(light_groups(scene, MAX_LIGHTS)) == 1:
        return {}
    with warnings.catch_warnings(action="ignore"):  # that there are groups is known
        return {GROUPED: NeuralRenderer(network).render(scene, resolution).astype(np.float64)}


def withheld_pictures(
    network: RenderFormer, scene: SceneTensors, resolution: int
) -> dict[str, NDArray[np.float64]]:
    """Predict a traced scene without each of the inputs, by the method's name.

    Scenes without traced inputs return an empty dict.
    """
    traced = scene.traced
    if traced is None:
        return {}
    pictures = {}
    for index, name in enumerate(INPUTS):
        if name == "tokens" and not network.config.scene_tokens:
            continue
        kept_VI = torch.ones_like(traced.given_VI)
        kept_VI[:, index] = 0
        without = dataclasses.replace(scene, traced=traced.without(kept_VI))
        pictures[f"{NETWORK} without {name}"] = predict(network, without, resolution)
    return pictures


@dataclass(frozen=True, kw_only=True)
class Price:
    """CPU seconds of a renderer."""

    first_s: float
    """CPU seconds of the first view of a scene, loading included."""
    further_s: float
    """CPU seconds of a further view."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TimedScene:
    """Scene that a renderer has loaded, with what that and its pictures take."""

    loaded: ReadyScene
    radiance_rgb: NDArray[np.float32]
    """[R, R, 3] linear radiance of the first view."""
    price: Price
    """Medians over the measured rounds."""


def time_scene(renderer: Renderer, scene: Scene, name: str, rounds: int = 1) -> TimedScene:
    """Load a scene and render its first view twice, in rounds after one that warms everything up.

    Args:
        renderer: a renderer that states its CPU seconds.
        name: name of the scene in messages.

    Raises:
        Unrenderable, TrilightError: as `Renderer.load` and `ReadyScene.render`.
    """
    camera = Camera.of_scene(scene, 0)
    prices = []
    for _ in range(1 + rounds):
        loaded = renderer.load(scene, name)
        first = loaded.render(camera)
        further = loaded.render(camera)
        first_s = (loaded.cpu_seconds or 0.0) + (first.cpu_seconds or 0.0)
        prices.append(Price(first_s=first_s, further_s=further.cpu_seconds or 0.0))
    return TimedScene(
        loaded=loaded, radiance_rgb=further.radiance_rgb, price=median_price(prices[1:])
    )


def median_price(prices: Sequence[Price]) -> Price:
    """Return the medians of prices."""
    first_s, further_s = np.median([dataclasses.astuple(price) for price in prices], axis=0)
    return Price(first_s=float(first_s), further_s=float(further_s))


TRACER = "path tracer, same time"
"""Name of the path tracer among the evaluated methods."""

CAPTION = "path tracer"
"""Short name of the path tracer on sheets."""

TIMED_SCENES = 4
"""Number of scenes on which both are timed."""

TIMED_S = 60.0
"""CPU seconds of the network after which no further scene is timed."""

Filter = Literal["fast", "high"]
"""Filter of the denoiser."""

Level = tuple[int, Filter]
"""Samples per pixel, and the filter."""


def spread_views(most_views: int, num_scenes: int) -> tuple[int, int]:
    """Return which views the path tracer is judged on: one scene in so many, its first so many."""
    return max(1, -(-num_scenes // max(most_views, 1))), max(1, most_views // max(num_scenes, 1))


def spread_text(every: int, first: int, num_views: int) -> str:
    """Return `spread_views` as text, of scenes with up to `num_views` views."""
    views = f"the first {first} views" if first > 1 else "the first view"
    if num_views <= first:
        views = "all views"
    return f"{views} of {'each scene' if every == 1 else f'one scene in {every}'}"


def time_both(
    network: Renderer,
    previews: Mapping[Level, Renderer],
    samples: Sequence[Sample],
    *,
    missing: str = "",
    note: str = "",
) -> dict[str, Any]:
    """Time both on some scenes, and choose the samples that fit.

    The network is timed first, then the path tracer, then the network once more.

    Returns:
        Median CPU seconds of the network, `network_first_s` and `network_further_s`; the number of
        timed `scenes`; `preview`, the samples, denoiser, price and note of the path tracer, or None
        where nothing is traced; and `missing`, the reason for that.

    Args:
        network: the network on one thread of the processor.
        previews: path tracers on one thread by level, from the least to the best; empty to trace
            nothing.
        samples: scenes, at least one.
        missing: reason why there are no previews.
        note: remark about the machine's path tracer.

    Raises:
        TrilightError: the network cannot render such pictures.
    """
    timed: list[Sample] = []
    ours: list[Price] = []
    began = time.process_time()
    for sample in samples:
        if not timed or time.process_time() - began < TIMED_S:
            timed.append(sample)
            ours.append(time_scene(network, sample.scene, sample.key).price)
    theirs: Mapping[Level, Price] = {}
    try:
        theirs = _preview_prices(previews, timed, median_price(ours).further_s)
        if previews and not theirs:
            missing = "the scenes that were timed cannot be traced"
    except TrilightError as error:
        missing = str(error).rstrip(".")
    ours += [time_scene(network, sample.scene, sample.key).price for sample in timed]
    middle = median_price(ours)
    preview = None
    if theirs:
        fitting = [level for level in theirs if theirs[level].further_s <= middle.further_s]
        level = [next(iter(theirs)), *fitting][-1]
        chosen = {"samples": level[0], "denoiser": level[1], "note": note}
        preview = chosen | dataclasses.asdict(theirs[level])
    return {
        "network_first_s": middle.first_s,
        "network_further_s": middle.further_s,
        "scenes": len(timed),
        "preview": preview,
        "missing": missing,
    }


def _preview_prices(
    previews: Mapping[Level, Renderer], samples: Sequence[Sample], most_s: float
) -> Mapping[Level, Price]:
    """Return median prices over the scenes that can be traced; empty if none can.

    The first samples whose fast filter takes more than `most_s` CPU seconds are the last ones.
    """
    prices: dict[Level, Price] = {}
    for level, preview in previews.items():
        measured = []
        for sample in samples:
            with contextlib.suppress(Unrenderable):
                measured.append(time_scene(preview, sample.scene, sample.key).price)
        if not measured:
            break
        prices[level] = median_price(measured)
        if level[1] == "fast" and prices[level].further_s > most_s:
            break
    return prices


def equal_time(views: Sequence[JudgedView], times: Mapping[str, Any], which: str) -> dict[str, Any]:
    """Compare network and path tracer over the views that have both, as JSON values.

    Args:
        times: result of `time_both`.
        which: description of the views that the tracer was scored on.
    """
    both = [view for view in views if TRACER in view.scores]
    figures = {**times, "which": which, "views": len(both)}
    if times["preview"] is None:
        return figures
    if not both:
        return figures | {"missing": "none of the judged views could be traced"}
    lead = paired_lead(both, NETWORK, TRACER)
    return figures | {
        "network": summarize_views(both, NETWORK),
        "tracer": summarize_views(both, TRACER),
        "lead_db": {"mean": lead.mean, "low": lead.low, "high": lead.high},
        "share_better": lead.share_better,
    }


def sentences(figures: Mapping[str, Any]) -> list[str]:
    """Return the comparison as sentences."""
    network_sentence = (
        f"A further view takes the network {figures['network_further_s']:.3g} CPU seconds, the "
        f"first of a scene {figures['network_first_s']:.3g} (medians of {figures['scenes']} "
        "scenes, one thread of a processor)."
    )
    if figures["missing"]:
        return [
            network_sentence,
            f"The path tracer in that time is not shown: {figures['missing']}.",
        ]
    preview = figures["preview"]
    lead = figures["lead_db"]
    interval = interval_text(lead["low"], lead["high"])
    interval = f"{interval}, 95 % by scene" if interval else "no interval, of one scene"
    longer = preview["further_s"] > figures["network_further_s"]
    lines = [
        network_sentence,
        f"The path tracer takes {preview['further_s']:.3g} ({preview['first_s']:.3g}) with "
        f"{preview['samples']} sample{'s' if preview['samples'] > 1 else ''} a pixel and its "
        f"{preview['denoiser']} filter"
        f"{': longer than the network, and it has nothing cheaper' if longer else ''}.",
        f"Over {figures['views']} views ({figures['which']}) the network has "
        f"{figures['network']['psnr_log_db']['median']:.2f} dB and the path tracer "
        f"{figures['tracer']['psnr_log_db']['median']:.2f} dB, medians of psnr_log_db; view by "
        f"view the network less the path tracer is {lead['mean']:+.2f} dB ({interval}), "
        f"and the network is better in {figures['share_better']:.0%}.",
        "The targets went through the same denoiser, which favors the path tracer a little.",
    ]
    return [*lines, *([f"{preview['note']}."] if preview["note"] else [])]
