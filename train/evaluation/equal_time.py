"""CPU seconds of renderers, and the path tracer with as many of them as a network.

A network is timed on a few scenes of its evaluation, and so are previews of 1, 2, 4, ... samples
per pixel with either filter. The baseline is the preview of the most samples whose further view
takes no longer than the network's; if even one sample takes longer, it is that one.
"""

import contextlib
import dataclasses
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from storage.errors import TrilightError, Unrenderable
from storage.records.sample import Sample
from storage.records.scene import Scene
from storage.renderer import Camera, ReadyScene, Renderer
from train.evaluation.judged_view import (
    NETWORK,
    JudgedView,
    interval_text,
    paired_lead,
    summarize_views,
)


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
    return Price(
        first_s=float(np.median([price.first_s for price in prices])),
        further_s=float(np.median([price.further_s for price in prices])),
    )


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
