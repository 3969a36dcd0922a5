"""Experiment `calibration`: how far true errors are from what the halves of a picture say.

Every trial is a layout of its own: no two share room, lamps or camera. Sources of objects, kinds of
light and surface, families and uses go round with periods that have no common divisor, so that the
first trials of an unfinished run are balanced too.
"""

import dataclasses
from functools import partial
from pathlib import Path

from infra.bench.context import BenchContext
from infra.bench.experiment import BenchScale, Column, Experiment, Figures, Point
from infra.bench.workloads.judged_pictures import load_or_render_reference, shrink_reference
from infra.bench.workloads.recorded_looks import FIGURES, record_looks, unreachable
from infra.bench_options import BenchOptions
from infra.render.held_out_scenes import first_composed
from infra.render.raw_references import first_camera
from pipeline.isolation import IsolatedChild
from pipeline.objects.generated import BENCHMARK, PREFIX
from pipeline.presets.settings import DatasetSettings
from pipeline.presets.training import smoke
from pipeline.renders.calibrated_error import versions_of_pictures
from scene_templates.settings import SceneSettings
from storage.dataset.splits import JUDGED_SPLIT
from storage.digests import canonical_json, sha256_hex
from storage.records.scene import Scene
from storage.settings.overrides import apply_overrides

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
    cost=Column(name="samples", figure="spp"),
    columns=(
        Column(name="true, median millionths", figure="log_true"),
        Column(name="reference's uncertainty, median millionths", figure="log_open"),
        Column(name="bound, median dB", figure="bound_log"),
    ),
    because="Squared errors are of log10(1 + radiance). The page of stated errors is made of the "
    "rows.",
    points=_points,
    trials=_trials,
    figures=FIGURES,
    versions=_versions,
)
