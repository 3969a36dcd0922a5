"""Contestants of a leaderboard: traced light, networks, the path tracer, and the nearest picture.

Each renders all views of a sample at a width, and has a digest of everything that decides them.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import metadata
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from infra.render.methods import (
    KINDS,
    Method,
    kind_of,
    network_method,
    sampled_method,
    samples_name,
    warm_up_denoiser,
)
from infra.timed_views import Show, timed_views
from pipeline.isolation import IsolatedChild, with_retries
from pipeline.renders.settings import Filtered
from pipeline.renders.variant import Variant
from storage.digests import canonical_json, sha256_hex
from storage.records.sample import Sample
from storage.records.scene import Scene

if TYPE_CHECKING:
    from model.neural_renderer import NeuralRenderer
    from train.evaluation.baselines import Baselines

TRACED_LIGHT = KINDS[1]
TRACER = KINDS[2]
BASELINE = "picture of another scene"
ELSEWHERE = "pictures made elsewhere"
"""Kinds of contestants, in addition to those of infra.render.methods."""

_REPEATS = 1
"""Measured repetitions after the warm-up; one, because the result is the median over scenes."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ShownViews:
    """All views of a scene by one contestant."""

    radiance_VRR3: NDArray[np.floating]
    """[V, R, R, 3] linear radiance of at least 0."""
    first_s: float | None = None
    """CPU seconds of the first view, loading included; None if it was not timed."""
    further_s: float | None = None
    """CPU seconds of a further view; None if it was not timed."""


class Contestant(Protocol):
    """Method that a leaderboard compares with others, one row of its table."""

    name: str
    """Name of the row, unique on a leaderboard."""
    kind: str
    """Kind of method, which decides the chart's color."""
    is_timed: bool
    """True if CPU seconds are measured."""
    notes: Sequence[str]
    """Notes on the method for the reader."""

    def why_not(self, width: int) -> str:
        """Return why pictures of a width are unsupported; empty if they are supported."""

    def digest(self, key: str, view: int) -> str:
        """Return the digest of everything that decides the picture of a view."""

    def shown(self, sample: Sample, width: int, *, timed: bool) -> ShownViews:
        """Return the pictures of a sample.

        Raises:
            Rejected, ChildFailed: the scene cannot be rendered.
        """


def shown_by(method: Method, scene: Scene, *, timed: bool) -> ShownViews:
    """Return all views of a scene by a method, with CPU seconds of this process after a warm-up."""
    if not timed:
        return ShownViews(radiance_VRR3=_all_views(method, scene))

    def load() -> Show:
        view = method(scene)
        return lambda: view(scene.c2w[0], float(scene.fov_deg[0]))

    first = timed_views(load, repeats=_REPEATS)
    pictures = first.radiance_rgb[None] if scene.num_views == 1 else _all_views(method, scene)
    return ShownViews(radiance_VRR3=pictures, first_s=first.first_s, further_s=first.further_s)


def _all_views(method: Method, scene: Scene) -> NDArray[np.float32]:
    view = method(scene)
    return np.stack([view(c2w, float(f)) for c2w, f in zip(scene.c2w, scene.fov_deg, strict=True)])


def _digest_of(**facts: Any) -> str:
    return sha256_hex(canonical_json({**facts, "trilight": metadata.version("trilight")}))


class MethodContestant:
    """Method that runs in this process: traced light without a network, or a network."""

    is_timed = True

    def __init__(
        self,
        name: str,
        method_of: Callable[[int], Method],
        *,
        weights: str = "",
        notes: Sequence[str],
    ) -> None:
        """Store a function from width to method; `weights` is the digest of the network."""
        self.name = name
        self.kind = kind_of(name)
        self.notes = notes
        self._method_of = functools.lru_cache(method_of)
        self._own = _digest_of(name="" if weights else name, weights=weights)

    def why_not(self, width: int) -> str:
        return ""

    def digest(self, key: str, view: int) -> str:
        return self._own

    def shown(self, sample: Sample, width: int, *, timed: bool) -> ShownViews:
        import torch

        torch.set_num_threads(1)  # core-seconds of waiting threads are not the network's
        return shown_by(self._method_of(width), sample.scene, timed=timed)


class NetworkContestant(MethodContestant):
    """Network, at the widths that it supports."""

    def __init__(self, name: str, renderer: "NeuralRenderer", notes: Sequence[str]) -> None:
        super().__init__(
            name,
            lambda width: network_method(renderer, width),
            weights=renderer.digest,
            notes=notes,
        )
        self._renderer = renderer
        self.most_triangles = renderer.trained.max_triangles

    def why_not(self, width: int) -> str:
        from storage.errors import TrilightError

        try:
            self._renderer.require_resolution(width)
        except TrilightError as error:
            return str(error).rstrip(".")
        return ""


class SampledContestant:
    """Few samples per pixel with one denoise, in a child that traces on one thread."""

    kind = TRACER
    is_timed = True
    notes: Sequence[str] = ()

    def __init__(
        self, level: tuple[int, Filtered], variant: Variant, child: Callable[[], IsolatedChild]
    ) -> None:
        """Store samples per pixel, filter, and a function that starts the child when needed."""
        self.name = samples_name(level)
        self._level = level
        self._child = child
        libraries = {name: metadata.version(name) for name in ("mitsuba", "pyoidn")}
        self._own = _digest_of(level=list(level), variant=variant.name, libraries=libraries)

    def why_not(self, width: int) -> str:
        return ""

    def digest(self, key: str, view: int) -> str:
        return self._own

    def shown(self, sample: Sample, width: int, *, timed: bool) -> ShownViews:
        ask = (shown_by_samples, sample.scene, width, self._level, timed)
        return with_retries(lambda: self._child().call(*ask))


def shown_by_samples(
    scene: Scene, width: int, level: tuple[int, Filtered], timed: bool
) -> ShownViews:
    """Return all views of a scene by few samples per pixel; runs in the child."""
    if timed:
        warm_up_denoiser(width)
    return shown_by(sampled_method(width, *level), scene, timed=timed)


class NearestContestant:
    """Picture of another scene that is nearest to the target: the bound of any lookup.

    The lookup uses the target itself, so that no method that looks up a picture by the scene can be
    better.
    """

    kind = BASELINE
    is_timed = False

    def __init__(
        self,
        name: str,
        rivals_of: Callable[[int], "Baselines"],
        *,
        pool: str,
        not_itself: bool,
        notes: Sequence[str],
    ) -> None:
        """Store the pictures of the lookup.

        Args:
            name: name of the row.
            rivals_of: function from width to the pictures of the lookup.
            pool: digest of the dataset of these pictures.
            not_itself: whether the evaluated scenes are among them.
            notes: notes for the reader.
        """
        self.name = name
        self.notes = notes
        self._not_itself = not_itself
        self._rivals_of = functools.lru_cache(rivals_of)
        self._own = _digest_of(pool=pool)

    def why_not(self, width: int) -> str:
        return ""

    def digest(self, key: str, view: int) -> str:
        return self._own

    def shown(self, sample: Sample, width: int, *, timed: bool) -> ShownViews:
        from train.data.resolution import block_mean

        rivals = self._rivals_of(width)
        targets = block_mean(sample.radiance_rgb, width)
        itself = sample.key if self._not_itself else ""
        nearest = [rivals.nearest(target, not_of=itself) for target in targets]
        return ShownViews(radiance_VRR3=np.stack(nearest))
