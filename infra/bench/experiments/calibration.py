"""Experiment `calibration`: how far true errors are from what the halves of a picture say.

The pictures are those of `SceneRenderer` with its tiles, at a target that none reaches, so that one
view gives a row for every number of samples at which it could have stopped.

Every trial is a layout of its own: no two share room, lamps or camera. Sources of objects, kinds of
light and surface, families and uses go round with periods that have no common divisor, so that the
first trials of an unfinished run are balanced too.
"""

import dataclasses
import functools
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from infra.bench.context import BenchContext
from infra.bench.experiment import BenchScale, Column, Experiment, Figures, Point
from infra.bench.workloads.traced_pictures import load_or_render_reference, shrink_reference
from infra.bench_options import BenchOptions
from infra.render.held_out_scenes import first_composed
from infra.render.raw_references import RawReference, first_camera, true_error
from pipeline.isolation import IsolatedChild
from pipeline.objects.generated import BENCHMARK, PREFIX
from pipeline.presets.settings import DatasetSettings
from pipeline.presets.training import smoke
from pipeline.renders.calibrated_error import versions_of_pictures
from pipeline.renders.host_pictures import (
    Half,
    HostPictures,
    keep_converged,
    measure_errors,
    squared_error,
    with_mean_of,
)
from pipeline.renders.noise_floor import BLOCK_PX, Curve, clamped_radiance, secant_slope
from pipeline.renders.renderer import SceneRenderer
from pipeline.renders.settings import Filtered, RenderSettings
from pipeline.renders.tracer import PixelCamera, Tracer
from pipeline.renders.view_pictures import MeasuredLook
from scene_templates.settings import SceneSettings
from storage.conventions import log10_radiance
from storage.dataset.splits import JUDGED_SPLIT
from storage.denoiser import Features, denoise
from storage.digests import canonical_json, sha256_hex
from storage.records.scene import Scene
from storage.seeds import seed_for
from storage.settings.overrides import apply_overrides

CURVES: Mapping[str, Curve] = {"log": log10_radiance, "linear": clamped_radiance}
METRICS = (*CURVES, "object")
MEASURES = ("estimate", "agreement", "move", "surprise", "sure", "block_agreement")
"""Fields of ErrorMeasures beside the share of hits."""

OTHERS = ("se", "least", "most", "raw", "estimate_2", "estimate_8", "sure_1", "sure_2", "fast",
          "jackknife", "oracle")  # fmt: skip
"""Further numbers of the curves. `se`, `least` and `most` are of the estimate in blocks: its
standard error, and the extreme blocks; `fast` is the distance to the picture of the fast filter.
Two are of 64 samples alone, else 0: `jackknife` leaves out one of four passes, and `oracle` is the
mean true error of three other pictures of the view."""

FIGURES = (
    "spp", "hits", "relative", "bound_log", "bound_linear", "bound_object",
    *(f"{metric}_{name}" for metric in METRICS for name in (*MEASURES, "true", "open")),
    *(f"{curve}_{name}" for curve in CURVES for name in OTHERS),
)  # fmt: skip
"""Names of the numbers of a row. Squared errors are in millionths; `open` is the standard deviation
of `true` by the reference's noise. `relative` is the threshold error of Mitsuba's pull request
1731, in thousandths."""

_ONCE_SPP = 64
"""Samples at which passes and pictures are traced once more: those of the first four passes."""
_OTHER_PICTURES = 3


def record_looks(
    scene: Scene, settings: RenderSettings, reference: RawReference, seed: int
) -> list[dict[str, float]]:
    """Return the FIGURES of each look at a scene's first view; runs in a render child.

    Args:
        scene: a scene with one camera at least.
        settings: with a target that no look reaches.
        reference: of the same view and width.
        seed: of the samples.
    """
    looks: list[dict[str, float]] = []
    renderer = _RecordingRenderer(scene, settings, reference, seed, looks)
    view = scene.c2w[0], float(scene.fov_deg[0])
    renderer.render_view(*view, seed)
    second_renderer = SceneRenderer(scene, dataclasses.replace(settings, max_spp=_ONCE_SPP))
    seeds = [seed_for(seed, "other picture", number) for number in range(_OTHER_PICTURES)]
    pictures = [second_renderer.render_view(*view, each).radiance_rgb for each in seeds]
    for name, curve in CURVES.items():
        pixels = np.ones(pictures[0].shape[:2], np.bool_)
        errors = [true_error(each, reference, curve, pixels)[0] for each in pictures]
        (look,) = (look for look in looks if look["spp"] == _ONCE_SPP)
        look[f"{name}_oracle"] = float(f"{1e6 * np.mean(errors):.4g}")
    return looks


class _RecordingRenderer(SceneRenderer):
    """Renderer whose pictures note what they measure at every look."""

    def __init__(
        self,
        scene: Scene,
        settings: RenderSettings,
        reference: RawReference,
        seed: int,
        looks: list[dict[str, float]],
    ) -> None:
        super().__init__(scene, settings)
        camera = first_camera(scene, settings.resolution)
        passes = functools.partial(_four_passes, self.tracer, camera, seed)
        self._arithmetic = functools.partial(_RecordingPictures, reference, passes, looks)
        self._arithmetic.mean_radiance = HostPictures.mean_radiance


class _RecordingPictures(HostPictures):
    """Pictures in numpy that append the figures of each look to a list."""

    def __init__(
        self, reference: RawReference, passes: Any, looks: list[dict[str, float]], *rest: Any
    ) -> None:
        super().__init__(*rest)
        self._reference = reference
        self._passes = passes
        self._recorded = looks

    def look(self, quality: Filtered) -> MeasuredLook:
        """Measure, and record what was measured."""
        look = super().look(quality)
        (picture,) = self.finish()
        raw = self._means.mean()
        fast = self._denoise(raw, "fast")
        error = self._means.standard_error()
        if error is not None:
            fast = with_mean_of(keep_converged(fast, raw, error)[0], raw[0])[None]
        a, b = self._halves
        row = {
            "spp": float(self._samples.spp),
            "hits": float(self.hits.mean()),
            "relative": 1e3 * _relative_error(a, b),
            "bound_log": look.floor.log_db,
            "bound_linear": look.floor.linear_db,
            "bound_object": look.floor.object_log_db,
        }
        everywhere = np.ones_like(self.hits)
        for metric in METRICS:
            curve = CURVES.get(metric, log10_radiance)
            objects = metric == "object"
            measures = measure_errors(a, b, picture, curve, self.hits, objects=objects)
            pixels = self.hits if objects and self.hits.any() else everywhere
            true, open_error = true_error(picture, self._reference, curve, pixels)
            errors = {name: getattr(measures, name) for name in MEASURES}
            errors |= {"true": true, "open": open_error}
            row |= {f"{metric}_{name}": 1e6 * value for name, value in errors.items()}
            row[f"{metric}_block_agreement"] /= 1e6  # a share
        passes = self._passes() if self._samples.spp == _ONCE_SPP else None
        for name, curve in CURVES.items():
            values = dict(_other_figures(a, b, picture, fast[0], curve))
            values["jackknife"] = _jackknife(passes, self._features, curve) if passes else 0.0
            values["oracle"] = 0.0
            row |= {f"{name}_{key}": 1e6 * value for key, value in values.items()}
        self._recorded.append({name: float(f"{row[name]:.4g}") for name in FIGURES})
        return look


def _relative_error(a: Half, b: Half) -> float:
    """Return the mean over the pixels of |X - A| / sqrt(|X|), absolute values summed over channels.

    It is the error estimate of Dammertz et al. ("A hierarchical automatic stopping condition for
    Monte Carlo global illumination", 2010), by which Mitsuba's pull request 1731 and Cycles stop.
    """
    mean = 0.5 * (a.raw_rgb.astype(np.float64) + b.raw_rgb)
    difference = np.abs(mean - a.raw_rgb).sum(axis=-1)
    return float((difference / np.sqrt(np.maximum(mean.sum(axis=-1), 1e-4))).mean())


def _other_figures(
    a: Half,
    b: Half,
    picture_rgb: NDArray[np.float32],
    fast_rgb: NDArray[np.float32],
    curve: Curve,
) -> Iterator[tuple[str, float]]:
    """Yield the OTHERS of a curve, as squared errors; without the jackknife."""
    raw_a, raw_b, den_a, den_b, picture = (
        each.astype(np.float64)
        for each in (a.raw_rgb, b.raw_rgb, a.denoised_rgb, b.denoised_rgb, picture_rgb)
    )
    blocks = _means_of_blocks(squared_error(a, b, curve)[..., None], BLOCK_PX)
    yield "se", float(blocks.std(ddof=1) / np.sqrt(blocks.size))
    yield "least", float(blocks.min())
    yield "most", float(blocks.max())
    yield "raw", float(0.25 * np.square(curve(raw_a) - curve(raw_b)).mean())
    raw = 0.5 * (raw_a + raw_b)
    slope = secant_slope(curve, 0.5 * (den_a + den_b), raw)
    of_halves = [
        slope * each for each in (den_a - raw_b, den_b - raw_a, raw_a - raw_b, den_a - den_b)
    ]
    for size in (2, 8):
        first, second, noise, difference = (_means_of_blocks(each, size) for each in of_halves)
        error = (first**2 + second**2 - noise**2) / 2 - difference**2 / 4
        yield f"estimate_{size}", float(error.mean())
    slope = secant_slope(curve, picture, raw)
    of_picture = [slope * each for each in (picture - raw, 0.5 * (raw_a - raw_b), den_a - den_b)]
    for size in (1, 2):
        residual, probe, difference = (_means_of_blocks(each, size) for each in of_picture)
        yield f"sure_{size}", float((residual**2 + probe * difference - probe**2).mean())
    yield "fast", float(np.square(curve(picture) - curve(fast_rgb.astype(np.float64))).mean())


def _means_of_blocks(values: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    across = len(values) // size
    means: NDArray[np.float64] = values.reshape(across, size, across, size, -1).mean(axis=(1, 3))
    return means


def _four_passes(tracer: Tracer, camera: PixelCamera, seed: int) -> list[NDArray[np.float32]]:
    """Return the first two passes of 16 of both halves, as DualBuffer seeds them."""
    return [
        tracer.radiance(camera, seed=seed_for(seed, "pass", number, half), spp=16)
        for number in range(2)
        for half in range(2)
    ]


def _jackknife(passes: list[NDArray[np.float32]], features: Features, curve: Curve) -> float:
    """Return the variance of a denoised picture by those that leave out one pass each."""
    total = np.sum(passes, axis=0, dtype=np.float64)
    count = len(passes)
    left_out = [((total - each) / (count - 1)).astype(np.float32) for each in passes]
    curved = np.stack(
        [curve(denoise(each, features, "fast").astype(np.float64)) for each in left_out]
    )
    spread = np.square(curved - curved.mean(axis=0)).sum(axis=0).mean()
    return float(spread * (count - 1) / count)


def unreachable(settings: RenderSettings, resolution: int, max_spp: int) -> RenderSettings:
    """Return settings that sample to the cap, with a look at every doubling from 32 samples on."""
    return dataclasses.replace(
        settings,
        resolution=resolution,
        noise_floor_db=99.0,
        min_spp=32,
        min_spp_px=128,
        max_spp=max_spp,
        light_paths="view",
        arithmetic="numpy",
        stated_error="bound",
        picture_within_db=None,
    )


SEED = 20_261_129
"""Seed of the layouts; no dataset preset and no other experiment uses it."""

LOOKS = {64: (64, 128, 256), 128: (32, 64, 128, 256), 256: (32, 64, 128, 256)}
"""Samples per pixel of each look, by width in pixels."""

KINDS = ("plain", "textured", "plain", "sky", "plain")
USES = ("fit", "judge", "calibrate", "judge")
_REFERENCE_TIMES = 4
"""Samples of a reference over those of the scale, whatever its width."""
_WIDE = (0, 3, 6, 9)
_WIDE_PERIOD = 11
"""Of so many layouts, these have pictures of 256 pixels too."""


def has_wide(index: int) -> bool:
    """Return whether a layout has pictures of 256 pixels."""
    return index % _WIDE_PERIOD in _WIDE


def use_of(index: int) -> str:
    """Return what the rows of a layout are for; families take turns in each use."""
    return USES[(index + index // 8) % len(USES)]


def _sources(options: BenchOptions) -> list[str]:
    sources = [PREFIX, BENCHMARK]
    return [*sources, *([options.objects] if options.objects not in sources else [])]


def _points(scale: BenchScale, options: BenchOptions) -> list[Point]:
    return [
        Point(name=f"{px} px, {spp} samples", measure=partial(_measure, px, spp), kind=f"{px} px")
        for px, looks in LOOKS.items()
        for spp in looks
    ]


def _trials(scale: BenchScale, options: BenchOptions) -> list[str]:
    """Return the layouts: number, source, family, kind and use."""
    sources = [Path(source).name for source in _sources(options)]
    families = smoke().scenes.families
    return [
        ", ".join(
            (
                f"layout {index}",
                sources[index % len(sources)],
                families[index % len(families)].name,
                KINDS[index % len(KINDS)],
                use_of(index),
            )
        )
        for index in range(scale.layouts)
    ]


def _versions(options: BenchOptions) -> dict[str, str]:
    """Return the versions that pictures depend on, and the objects of each source."""
    objects = {
        Path(source).name: _folder_digest(Path(source))
        for source in _sources(options)
        if Path(source).is_dir()
    }
    return {**versions_of_pictures(), **objects}


def _folder_digest(folder: Path) -> str:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return sha256_hex(
        canonical_json(
            [[str(path.relative_to(folder)), sha256_hex(path.read_bytes())] for path in files]
        )
    )


def _measure(px: int, spp: int, context: BenchContext, trial: str) -> Figures:
    looks = context.get_or_make(trial, lambda: _record(context, trial))
    return looks.get((px, spp), {})


def _record(context: BenchContext, trial: str) -> dict[tuple[int, int], Figures]:
    """Return the figures of all looks of a layout by width and samples."""
    index = int(trial.split(",")[0].split()[1])
    sources = _sources(context.options)
    source = sources[index % len(sources)]
    child = context.get_or_make(
        ("objects", source), lambda: context.render_child(_one_split(), source, threads=1)
    )
    scene = _scene(child, index, KINDS[index % len(KINDS)])
    widest = 256 if has_wide(index) else 128
    reference_spp = _REFERENCE_TIMES * context.scale.reference_spp
    reference = load_or_render_reference(child, scene, first_camera(scene, widest), reference_spp)
    figures = dict[tuple[int, int], Figures]()
    for px in (px for px in LOOKS if px <= widest):
        settings = unreachable(smoke().renders, px, max(LOOKS[px]))
        looks = child.call(record_looks, scene, settings, shrink_reference(reference, px), index)
        figures |= {(px, spp): look for spp, look in zip(LOOKS[px], looks, strict=True)}
    return figures


def _one_split() -> DatasetSettings:
    return apply_overrides(smoke(), {"splits.one_split": True})


def _scene(child: IsolatedChild, index: int, kind: str) -> Scene:
    shares = {"textured": {"textures.share": 0.5}, "sky": {"skies.share": 1.0}}
    settings: SceneSettings = apply_overrides(
        dataclasses.replace(smoke().scenes, num_views=1, families_in_turn=True),
        shares.get(kind, {}),
    )
    return first_composed(child, settings, index, seed=SEED, split=JUDGED_SPLIT)


EXPERIMENT = Experiment(
    name="calibration",
    title="How far true errors are from what the halves of a picture say",
    about="Pictures of layouts of their own at three widths, with what their halves say at every "
    "look and their true error, held against raw samples in two halves.",
    cost=Column("samples", "spp"),
    columns=(
        Column("true, median millionths", "log_true"),
        Column("reference's uncertainty, median millionths", "log_open"),
        Column("bound, median dB", "bound_log"),
    ),
    because="Squared errors are of log10(1 + radiance). The page of stated errors is made of the "
    "rows.",
    points=_points,
    trials=_trials,
    figures=FIGURES,
    versions=_versions,
)
