"""What one picture costs: samples, denoiser, noise floor, guide pictures, length of paths."""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any

from infra.bench.effort import Effort
from infra.bench.experiment import Column, Experiment, Point, TurnFigures
from infra.bench.sides.shots import Shot, fixed_samples, shots
from infra.bench.subjects.named_scenes import sampled_names
from infra.bench.workshop import Subject, Workshop
from pipeline.builds.training import pretrain_256, smoke
from pipeline.renders.settings import RenderSettings
from storage.metrics import psnr_log_db

TARGETS_DB = (34.0, 38.0, 40.0, 42.0, 46.0, 50.0)
_OTHER_TARGETS_DB = {
    "linear": ("noise_floor_linear_db", (32.0, 36.0, 40.0)),
    "objects": ("noise_floor_objects_db", (40.0, 46.0)),
}
"""Targets of the other two metrics, each alone in place of psnr_log_db."""

DEPTHS = (2, 3, 4, 6, 8, 10, 16)
DEEPEST = 32
"""Edges of the paths that shorter ones are compared with; hardly any path is longer."""
CORE_S = Column(name="core-seconds a view", figure="core_s", over="mean")
DB = Column(name="psnr_log_db, dB", figure="db")
WORST = Column(name="worst dB", figure="db", over="least")
_FURTHER = (
    WORST,
    Column(name="stated floor dB", figure="floor_db"),
    Column(name="samples", figure="spp", over="mean"),
)
_REFERENCE = (
    "a converged reference of other samples (up to 16,384, 54 dB or more where that was enough); "
    "median over the scenes"
)


def scenes(effort: Effort) -> tuple[str, ...]:
    """Return the turns of experiments on pictures: scenes whose references are published."""
    return sampled_names(effort.scenes)


def to_reference(subject: Subject, shot: Shot) -> dict[str, float]:
    """Return the figures of one picture beside the scene's reference."""
    return {
        "core_s": shot.core_s,
        "db": psnr_log_db(shot.view.radiance_rgb, subject.reference_rgb),
        "floor_db": shot.view.noise_floor_db,
        "spp": float(shot.view.spp),
        "kb": shot.packed_bytes / 1000,
    }


def measure(workshop: Workshop, points: Sequence[Point], turn: str) -> TurnFigures:
    """Render one scene under the settings of every point, with equal random numbers."""
    subject = workshop.subject(turn)
    found = workshop.call(shots, subject.scene, {point.name: point.settings for point in points})
    for name, shot in found.items():
        yield name, to_reference(subject, shot)


def _measure_depth(workshop: Workshop, points: Sequence[Point], turn: str) -> TurnFigures:
    """Compare with the same samples of paths of DEEPEST edges, so that noise is common to both."""
    variants = {point.name: point.settings for point in points}
    variants["all"] = dataclasses.replace(points[0].settings, max_depth=DEEPEST)
    taken = workshop.call(shots, workshop.subject(turn).scene, variants)
    whole = taken["all"].view.radiance_rgb
    for point in points:
        picture = taken[point.name].view.radiance_rgb
        yield (
            point.name,
            {
                "core_s": taken[point.name].core_s,
                "db": psnr_log_db(picture, whole),
                "lost": 100 * float(1 - picture.mean() / whole.mean()),
            },
        )


def _fixed(effort: Effort, **changes: Any) -> RenderSettings:
    return dataclasses.replace(fixed_samples(effort.resolution, effort.fixed_spp), **changes)


def _adaptive(effort: Effort, base: RenderSettings, **changes: Any) -> RenderSettings:
    changes = {"max_spp": effort.max_spp, **changes}
    return dataclasses.replace(base, resolution=effort.resolution, min_mean_radiance=0.0, **changes)


def _samples(effort: Effort) -> list[Point]:
    doublings = range((effort.max_spp // 32).bit_length())
    usual = min(smoke().renders.max_spp, effort.max_spp)
    return [
        Point(
            name=f"{32 << step}, {denoiser}",
            settings=dataclasses.replace(
                fixed_samples(effort.resolution, 32 << step), denoiser=denoiser
            ),
            default=(32 << step, denoiser) == (usual, RenderSettings.denoiser),
        )
        for denoiser in ("off", "fast", "high")
        for step in doublings
    ]


def _floors(effort: Effort) -> list[Point]:
    base = pretrain_256().renders
    most = 2 * effort.max_spp  # else the higher targets all end at the cap
    of_log = [
        Point(
            name=f"{target_db:.0f} dB",
            settings=_adaptive(effort, base, noise_floor_db=target_db, max_spp=most),
            default=target_db == base.noise_floor_db,
        )
        for target_db in TARGETS_DB
    ]
    of_others = [
        Point(
            name=f"{word} {target_db:.0f} dB",
            settings=_adaptive(
                effort, base, noise_floor_db=None, **{setting: target_db}, max_spp=most
            ),
        )
        for word, (setting, targets_db) in _OTHER_TARGETS_DB.items()
        for target_db in targets_db
    ]
    return of_log + of_others


def _first(effort: Effort) -> list[Point]:
    base = smoke().renders
    return [
        Point(
            name=f"{spp}",
            settings=_adaptive(effort, base, min_spp=spp),
            default=spp == base.min_spp,
        )
        for spp in (8, 16, 32, 64, 128)
        if spp <= effort.max_spp
    ]


def _varied(name: str, values: Sequence[int]) -> Any:
    """Return points of fixed samples in which one setting varies."""
    default = getattr(RenderSettings, name)

    def points(effort: Effort) -> list[Point]:
        return [
            Point(
                name=f"{value}", settings=_fixed(effort, **{name: value}), default=value == default
            )
            for value in values
        ]

    return points


_of_views = partial(
    Experiment, cost=CORE_S, error=DB, better="higher", against=_REFERENCE, columns=_FURTHER,
    turns=scenes, measure=measure,
)  # fmt: skip
"""Declares an experiment on views of the scenes whose references are published."""

EXPERIMENTS = (
    _of_views(
        name="samples",
        title="Samples and denoiser",
        about="Views of built-in scenes at fixed numbers of samples, by denoiser.",
        covers=("build.renders.max_spp", "build.renders.denoiser", "render.max_spp"),
        because="Default: `high`. Without a denoiser an equal error takes many times the samples, "
        "and `fast` saves the same fraction of a second at every number of samples, so only few of "
        "them make it worth its loss. In place of a fixed number builds have a cap: what a view "
        "needs is measured, and the cap bounds the hardest (256 in `smoke`, which the table marks "
        "as the default, 4096 in `pretrain-256`).",
        points=_samples,
    ),
    _of_views(
        name="noise-floor",
        title="Noise floor of a view",
        about="Views of built-in scenes that are sampled until a stated floor or a cap: of "
        "psnr_log_db, or alone of psnr_linear_db or of object_psnr_log_db.",
        covers=(
            "build.renders.noise_floor_db",
            "build.renders.noise_floor_linear_db",
            "build.renders.noise_floor_objects_db",
            "build.renders.reject_at_cap",
            "order.noise_floor_db",
            "order.noise_floor_linear_db",
            "order.noise_floor_objects_db",
            "render.noise_floor_db",
            "render.noise_floor_linear_db",
            "render.noise_floor_objects_db",
        ),
        because="Default: 46 dB in the training builds, since an error in a target stays for every "
        "epoch; 38 dB in `smoke`, whose 24 scenes are to take minutes. Hard views end at the cap "
        "and say so: rejecting them (`reject_at_cap`) would change what the set shows. The linear "
        "PSNR is for figures that are compared with published ones: its target is 5 to 10 dB lower "
        "for the same samples.",
        points=_floors,
    ),
    _of_views(
        name="first-samples",
        title="Samples before the floor is measured first",
        about="Views to the floor of `smoke`, by the samples after which it is looked at first.",
        covers=("build.renders.min_spp",),
        because="Default: 64. With fewer both halves may miss the same glints, and small passes "
        "are stratified coarser; more only costs where a view is easy.",
        points=_first,
    ),
    _of_views(
        name="guides",
        title="Samples of the denoiser's guide pictures",
        about="Views at a fixed number of samples, by those of albedo and normals.",
        covers=("build.renders.aux_spp",),
        because="Default: 16, on a regular grid. The filter takes the guides to be without "
        "noise, and they are traced without light, at a fraction of the price of a sample; the "
        "dear pictures of the training builds have 64.",
        points=_varied("aux_spp", (4, 16, 64)),
    ),
    _of_views(
        name="depth",
        title="Length of paths",
        about="Views at a fixed number of samples, with paths that are cut at so many edges.",
        covers=("build.renders.max_depth",),
        against=f"the same samples with paths of {DEEPEST} edges, so that noise is common to both; "
        "median over the scenes",
        columns=(
            Column(name="light lost %", figure="lost", over="mean"),
            Column(name="most light lost %", figure="lost", over="most"),
            WORST,
        ),
        because="Default: 10. Roulette ends most paths long before, so further edges cost little, "
        "and what is cut off is below the noise of the pictures. Fewer edges darken a picture, "
        "which no number of samples brings back.",
        points=_varied("max_depth", DEPTHS),
        measure=_measure_depth,
    ),
    _of_views(
        name="roulette",
        title="Where roulette begins",
        about="Views at a fixed number of samples, by the edge from which paths may end by chance.",
        covers=("build.renders.rr_depth",),
        because="Default: 2. It changes no mean, only noise and time, and ends dark paths soonest.",
        points=_varied("rr_depth", (2, 3, 5, 8)),
    ),
)
