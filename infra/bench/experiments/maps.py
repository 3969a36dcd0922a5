"""What textures and skies cost, and whether the stated floor holds with them."""

import dataclasses
from collections.abc import Callable, Sequence

from infra.bench.effort import Effort
from infra.bench.experiment import Column, Experiment, Over, Point, TurnFigures, percent
from infra.bench.experiments.sampling import CORE_S
from infra.bench.sides.mapped_pictures import MAPS, mapped_views
from infra.bench.sides.sky_picks import SKIES, WAYS, picked_pictures
from infra.bench.workshop import Workshop
from pipeline.builds.training import smoke
from pipeline.renders.settings import USUAL_FLOOR_DB, RenderSettings

_PX = 64
_REFERENCE_SHARE = 2
"""References have more samples than those of `calibration` by this: they have half its width."""

_PICKED_REFERENCE = 8
"""The same for pictures of 48 pixels, which are not denoised."""


def picture_settings(effort: Effort) -> RenderSettings:
    """Return the settings of the pictures: small ones, to the usual floor or a cap."""
    return dataclasses.replace(
        smoke().renders,
        resolution=_PX,
        noise_floor_db=USUAL_FLOOR_DB,
        max_spp=effort.max_spp,
        min_mean_radiance=0.0,
    )


def _points(effort: Effort) -> list[Point]:
    return [Point(name=name, default=name == "plain") for name in MAPS]


def _measure(workshop: Workshop, points: Sequence[Point], turn: str) -> TurnFigures:
    effort, scene = workshop.effort, int(turn.split()[-1])
    spp = _REFERENCE_SHARE * effort.reference_spp
    found = workshop.call(mapped_views, scene, picture_settings(effort), spp)
    yield from found.items()


_FIGURES: tuple[tuple[str, str, Over, Callable[[float], float] | None], ...] = (
    ("over 1 dB worse than stated, %", "over_1", "mean", percent),
    ("over 3 dB, %", "over_3", "mean", percent),
    ("caution, median dB", "caution_db", "median", None),
    ("worst dB", "caution_db", "least", None),
)

_JUDGED = tuple(
    Column(name=f"{metric}: {words}", figure=f"{name}_{figure}", over=over, then=then)
    for name, metric in (("log", "psnr_log_db"), ("linear", "linear"), ("object", "objects"))
    for words, figure, over, then in _FIGURES
)


def _measure_picks(workshop: Workshop, points: Sequence[Point], turn: str) -> TurnFigures:
    found = workshop.call(picked_pictures, turn, _PICKED_REFERENCE * workshop.effort.reference_spp)
    yield from found.items()


EXPERIMENTS = (
    Experiment(
        name="map-costs",
        title="Textures and skies: their price, and their stated floors",
        about=f"The same scenes with the means of their textures, with textures on every surface, "
        f"below a sky, and with both, the sky seen: pictures of {_PX} pixels to {USUAL_FLOOR_DB:g} "
        "dB or a cap, held against raw references in two halves.",
        covers=("build.scenes.textures.share", "build.scenes.skies.share"),
        cost=CORE_S,
        columns=(
            Column(name="a pass of 64 samples, core-ms", figure="pass_ms"),
            Column(name="that over the plain scene's", figure="pass_ratio"),
            Column(name="loading the scene, core-ms", figure="load_ms"),
            Column(name="samples", figure="spp", over="mean"),
            Column(name="at the cap, %", figure="at_cap", over="mean", then=percent),
            *_JUDGED,
            Column(name="what the reference leaves open, median dB", figure="log_open_db"),
            Column(name="brightness, mean %", figure="brightness", over="mean"),
            Column(name="arrays, kB", figure="scene_kb"),
            Column(name="maps, kB", figure="maps_kb"),
            Column(name="picture, kB", figure="picture_kb"),
            Column(name="sky's share of picks", figure="sky_share"),
        ),
        because="Default: none. A wrong floor is one where the true error is more than 1 dB (3 dB) "
        "above the stated one. Sizes are those in shards of the profile `compact`; a map stands in "
        "a shard once.",
        points=_points,
        turns=lambda effort: [f"scene {index}" for index in range(effort.judged_scenes)],
        measure=_measure,
    ),
    Experiment(
        name="sky-picks",
        title="How often a path picks the sky",
        about="A sampled scene below four skies, raw pictures of 16 samples: the sky is picked as "
        "often as the average lamp, by the peaks of its map, or by its whole power.",
        cost=Column(name="core-seconds a picture", figure="core_s", over="mean"),
        error=Column(
            name="error over the least of the three, worst sky", figure="over_least", over="most"
        ),
        against="raw references in two halves; the error is the mean square of log10(1 + radiance)",
        columns=(
            Column(name="error over the least, mean", figure="over_least", over="mean"),
            Column(name="least share of picks", figure="share", over="least"),
            Column(name="greatest share", figure="share", over="most"),
        ),
        because="Default: by its peaks, its mean less its median, and at least as the average "
        "lamp. A smooth map is found by the directions that surfaces draw; a sun is not.",
        points=lambda effort: [Point(name=way, default="ours" in way) for way in WAYS],
        turns=lambda effort: tuple(SKIES),
        measure=_measure_picks,
    ),
)
