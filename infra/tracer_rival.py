"""Equal-time baseline: the path tracer with as many CPU seconds as a network.

A network is timed on a few scenes of its evaluation, and so are previews of 1, 2, 4, ... samples
per pixel with either filter. The baseline is the preview of the most samples whose further view
takes no longer than the network's; if even one sample takes longer, it is that one.
"""

import copy
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from infra.timed_views import Show, timed_views
from model.neural_renderer import NeuralRenderer
from model.renderformer import RenderFormer
from pipeline.isolation import ChildFailed, ChildLimits, IsolatedChild, with_retries
from pipeline.renders.preview import MOST_SPP, PreviewRenderer, PreviewSettings
from pipeline.renders.renderer import run_to_end, set_threads
from pipeline.renders.variant import Variant, activate, choose_variant
from storage.errors import Rejected, TrilightError
from storage.records.sample import Sample
from storage.records.scene import Scene
from train.evaluation.same_time import SameTimeResult, TracerTimes

TIMED_SCENES = 4
"""Number of scenes on which both are timed."""

TIMED_S = 60.0
"""CPU seconds of the network after which no further scene is timed."""

_LIMITS = ChildLimits(memory_bytes=16 << 30, wall_s=3600, calls_per_child=10_000)

_SEED = 0
"""Seed of the samples: the default of `trilight render`."""

LADDER = tuple(1 << step for step in range(MOST_SPP.bit_length()))
"""Candidate numbers of samples per pixel."""

Level = tuple[int, Literal["fast", "high"]]
"""Samples per pixel, and the filter."""

LEAST: Level = (1, "fast")
"""Cheapest level."""


@dataclass(frozen=True, kw_only=True)
class Price:
    """CPU seconds of one thread."""

    first_s: float
    """CPU seconds of the first view of a scene, loading included."""
    further_s: float
    """CPU seconds of a further view."""


DEARER = Price(first_s=math.inf, further_s=math.inf)
"""Price of a level that was not tried, since fewer samples took too long."""


class TracerRival:
    """Equal-time path tracer of stored scenes, in a child with one thread."""

    def __init__(self, resolution: int, *, most_views: int, num_scenes: int) -> None:
        """Store the limits; a child is started when it is first needed.

        Args:
            resolution: width in pixels.
            most_views: maximum number of views to trace; 0 for none.
            num_scenes: number of evaluated scenes.
        """
        self._resolution = resolution
        self._most_views = most_views
        self._every = max(1, -(-num_scenes // max(most_views, 1)))
        self._views = max(1, most_views // max(num_scenes, 1))
        self._level: Level = LEAST
        self._variant: Variant | None = None
        self._child: IsolatedChild | None = None
        self._number: dict[str, int] = {}
        self._asked_views = 0

    @property
    def which(self) -> str:
        """Text on the views that were traced."""
        views = f"the first {self._views} views" if self._views > 1 else "the first view"
        if self._asked_views <= self._views:
            views = "all views"
        return f"{views} of {'each scene' if self._every == 1 else f'one scene in {self._every}'}"

    def measure(self, network: RenderFormer, samples: Sequence[Sample]) -> SameTimeResult:
        """Time both on some scenes, and choose the samples that fit.

        The network is timed first, then the path tracer, then the network once more.

        Args:
            network: network on any device; it is timed on the processor.
            samples: scenes, at least one.

        Raises:
            TrilightError: the network cannot render such pictures.
        """
        renderer = NeuralRenderer(copy.deepcopy(network).cpu())
        scenes: list[Scene] = []
        ours: list[Price] = []
        began = time.process_time()
        for sample in samples:
            if not scenes or time.process_time() - began < TIMED_S:
                scenes.append(sample.scene)
                ours.append(_network_price(renderer, sample.scene, self._resolution))
        theirs, missing = self._prices(scenes, _middle([each.further_s for each in ours]))
        ours += [_network_price(renderer, scene, self._resolution) for scene in scenes]
        further_s = _middle([each.further_s for each in ours])
        return SameTimeResult(
            network_first_s=_middle([each.first_s for each in ours]),
            network_further_s=further_s,
            scenes=len(scenes),
            preview=self._choose(theirs, further_s) if theirs else None,
            missing=missing,
        )

    def _prices(
        self, scenes: Sequence[Scene], most_s: float
    ) -> tuple[list[Mapping[Level, Price]], str]:
        """Return the prices of each scene that can be traced, or an empty list and the reason."""
        if not self._most_views:
            return [], "no views of it were requested"
        by_scene: list[Mapping[Level, Price]] = []
        for scene in scenes:
            try:
                prices = self._open().call(preview_prices, scene, self._resolution, most_s)
                by_scene.append(dict(prices))
            except (Rejected, ChildFailed):
                continue
            except TrilightError as error:
                return [], str(error).rstrip(".")
        return by_scene, "" if by_scene else "the scenes that were timed cannot be traced"

    def _choose(self, prices: Sequence[Mapping[Level, Price]], most_s: float) -> TracerTimes:
        level = self._level = chosen_level(prices, most_s)
        return TracerTimes(
            samples=level[0],
            denoiser=level[1],
            first_s=_middle([each.get(level, DEARER).first_s for each in prices]),
            further_s=_middle([each.get(level, DEARER).further_s for each in prices]),
            note=self._variant.note if self._variant else "",
        )

    def judged(self, sample: Sample, view: int) -> NDArray[np.float32] | None:
        """Return linear radiance [R, R, 3]; None for a view that is not traced."""
        number = self._number.setdefault(sample.key, len(self._number))
        self._asked_views = max(self._asked_views, view + 1)
        if number % self._every or view >= self._views:
            return None
        return self.shown(sample, view)

    def shown(self, sample: Sample, view: int) -> NDArray[np.float32] | None:
        """Return linear radiance [R, R, 3] of any view; None if it cannot be traced."""
        scene = sample.scene
        child = self._open()
        (spp, denoiser) = self._level
        settings = PreviewSettings(resolution=self._resolution, spp=spp, denoiser=denoiser)
        try:
            return with_retries(lambda: child.call(traced_view, scene, view, settings))
        except (Rejected, ChildFailed):
            return None

    def close(self) -> None:
        """End the child; a later picture starts a new one."""
        if self._child is not None:
            self._child.close()
            self._child = None

    def _open(self) -> IsolatedChild:
        if self._variant is None:
            self._variant = choose_variant()
        if self._child is None:
            self._child = tracing_child(self._variant)
        return self._child


def chosen_level(prices: Sequence[Mapping[Level, Price]], most_s: float) -> Level:
    """Return the most samples whose median further view fits, and of equals the better filter.

    If none fits, return LEAST.

    Args:
        prices: prices of each scene by level; a missing level takes longer than `most_s`.
        most_s: maximum CPU seconds of a further view.
    """
    fits = [
        level
        for level in set().union(*prices)
        if _middle([each.get(level, DEARER).further_s for each in prices]) <= most_s
    ]
    return max(fits, key=lambda level: (level[0], level[1] == "high"), default=LEAST)


def _middle(seconds: Sequence[float]) -> float:
    return float(np.median(seconds))


def tracing_child(variant: Variant) -> IsolatedChild:
    """Return a child that traces on one thread; the caller closes it."""
    limits = replace(_LIMITS, memory_bytes=variant.address_space(_LIMITS.memory_bytes))
    return IsolatedChild(limits=limits, factory=set_up_child, args=(variant,))


def set_up_child(variant: Variant) -> None:
    """Prepare a child that traces on one thread."""
    activate(variant)
    set_threads(1)


def traced_view(scene: Scene, view: int, settings: PreviewSettings) -> NDArray[np.float32]:
    """Return the picture of one of a scene's cameras; runs in the child."""
    return _show(PreviewRenderer(scene, settings), scene, view)


def preview_prices(scene: Scene, resolution: int, most_s: float) -> Sequence[tuple[Level, Price]]:
    """Return the prices of previews of a scene's first view, after a warm-up; runs in the child.

    Samples are doubled until the fast filter takes longer than `most_s` CPU seconds; that level is
    returned, too.
    """
    by_level: dict[Level, Price] = {}
    for spp in LADDER:
        levels: tuple[Level, ...] = ((spp, "fast"), (spp, "high"))
        for level in levels:
            settings = PreviewSettings(resolution=resolution, spp=spp, denoiser=level[1])
            by_level[level] = min((_price_preview(scene, settings) for _ in range(2)), key=_further)
        if by_level[spp, "fast"].further_s > most_s:
            break
    return tuple(by_level.items())


def _further(price: Price) -> float:
    return price.further_s


def _price_preview(scene: Scene, settings: PreviewSettings) -> Price:
    began = time.process_time()
    renderer = PreviewRenderer(scene, settings)
    loaded = time.process_time()
    _show(renderer, scene, 0)
    further_s = time.process_time() - loaded
    return Price(first_s=loaded - began + further_s, further_s=further_s)


def _show(renderer: PreviewRenderer, scene: Scene, view: int) -> NDArray[np.float32]:
    steps = renderer.view_steps(scene.c2w[view], float(scene.fov_deg[view]), _SEED)
    return run_to_end(steps).radiance_rgb


def _network_price(renderer: NeuralRenderer, scene: Scene, resolution: int) -> Price:
    """Return the network's price of a scene's first view, on one thread of the processor."""

    def load() -> Show:
        prepared = renderer.prepare(scene)
        return lambda: renderer.view(prepared, scene.c2w[0], float(scene.fov_deg[0]), resolution)

    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # core-seconds of waiting threads are not the network's
    try:
        times = timed_views(load, repeats=1)
    finally:
        torch.set_num_threads(threads)
    return Price(first_s=times.first_s, further_s=times.further_s)
