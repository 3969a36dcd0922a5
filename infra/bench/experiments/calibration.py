"""Experiment `calibration`: how far true errors are from what the halves of a picture say.

The pictures are those of `SceneRenderer` with its tiles, at a target that none reaches, so that one
view gives a row for every number of samples at which it could have stopped.

Every trial is a layout of its own: no two share room, lamps or camera. Sources of objects, kinds of
light and surface, families and uses go round with periods that have no common divisor, so that the
first trials of an unfinished run are balanced too.
"""

import dataclasses
from functools import partial
from pathlib import Path

import numpy as np

from infra.bench.context import BenchContext
from infra.bench.experiment import BenchScale, Column, Experiment, Figures, Point
from infra.bench.workloads.traced_pictures import (
    CURVES,
    load_or_render_reference,
    shrink_reference,
)
from infra.bench_options import BenchOptions
from infra.render.raw_references import RawReference, true_error
from pipeline.generation.scene_worker import SceneWorker
from pipeline.isolation import IsolatedChild
from pipeline.objects.generated import BENCHMARK, PREFIX
from pipeline.presets.training import smoke
from pipeline.renders.calibrated_error import MEASURES, METRICS, versions_of_pictures
from pipeline.renders.pictures import ViewPictures
from pipeline.renders.renderer import SceneRenderer
from pipeline.renders.settings import Filtered, RenderSettings
from pipeline.renders.view_pictures import MeasuredLook
from scene_templates.settings import SceneSettings
from storage.dataset.splits import JUDGED_SPLIT
from storage.digests import canonical_json, sha256_hex
from storage.records.scene import Scene
from storage.settings.overrides import apply_overrides

_MEASURED = (*MEASURES, "block_agreement")
"""Fields of ErrorMeasures beside the share of hits."""

FIGURES = (
    "spp", "hits", "bound_log", "bound_linear", "bound_object",
    *(f"{metric}_{name}" for metric in METRICS for name in (*_MEASURED, "true", "open")),
)  # fmt: skip
"""Names of the numbers of a row. Squared errors are in millionths; `open` is the standard deviation
of `true` by the reference's noise."""


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

    class RecordingPictures(ViewPictures):
        """Pictures in numpy that append the figures of each look to the list."""

        def look(self, quality: Filtered) -> MeasuredLook:
            look = super().look(quality)
            (picture,) = self.finish()
            measured = self._measures(self._numbers([picture]))
            row = {
                "spp": float(self._samples.spp),
                "hits": float(self.hits.mean()),
                "bound_log": look.floor.noise_floor_db,
                "bound_linear": look.floor.noise_floor_linear_db,
                "bound_object": look.floor.object_noise_floor_db,
            }
            everywhere = np.ones_like(self.hits)
            for metric, curve in CURVES.items():
                pixels = self.hits if metric == "object" and self.hits.any() else everywhere
                true, open_error = true_error(picture, reference, curve, pixels)
                errors = {name: getattr(measured[metric], name) for name in _MEASURED}
                errors |= {"true": true, "open": open_error}
                row |= {f"{metric}_{name}": 1e6 * value for name, value in errors.items()}
                row[f"{metric}_block_agreement"] /= 1e6  # a share
            looks.append({name: float(f"{row[name]:.4g}") for name in FIGURES})
            return look

    renderer = SceneRenderer(scene, settings)
    renderer._arithmetic = RecordingPictures
    renderer.render_view(scene.c2w[0], float(scene.fov_deg[0]), seed)
    return looks


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
    settings = apply_overrides(smoke(), {"splits.one_split": True})
    child = context.get_or_make(
        ("objects", source), lambda: context.render_child(settings, source, threads=1)
    )
    scene = _scene(child, index, KINDS[index % len(KINDS)])
    widest = 256 if has_wide(index) else 128
    reference_spp = _REFERENCE_TIMES * context.scale.reference_spp
    reference = load_or_render_reference(child, scene, widest, reference_spp)
    figures = dict[tuple[int, int], Figures]()
    for px in (px for px in LOOKS if px <= widest):
        renders = unreachable(smoke().renders, px, max(LOOKS[px]))
        looks = child.call(record_looks, scene, renders, shrink_reference(reference, px), index)
        figures |= {(px, spp): look for spp, look in zip(LOOKS[px], looks, strict=True)}
    return figures


def _scene(child: IsolatedChild, index: int, kind: str) -> Scene:
    shares = {"textured": {"textures.share": 0.5}, "sky": {"skies.share": 1.0}}
    settings: SceneSettings = apply_overrides(
        dataclasses.replace(smoke().scenes, num_views=1, families_in_turn=True),
        shares.get(kind, {}),
    )
    return child.call_method(SceneWorker.compose_first, settings, index, SEED, JUDGED_SPLIT)


EXPERIMENT = Experiment(
    name="calibration",
    title="How far true errors are from what the halves of a picture say",
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
