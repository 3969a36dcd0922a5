"""What one picture costs: samples, denoiser, noise floor, first measurement, guide pictures."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from infra.bench.renders.fixed_samples import fixed_samples
from infra.bench.trade.curves import Curve, Knob, Point
from infra.bench.trade.rendered import Shot, shots
from infra.bench.trade.workshop import Subject, Workshop
from pipeline.flows.training_builds import pretrain_256, smoke
from pipeline.renders.settings import RenderSettings
from storage.metrics import psnr_log_db

TARGETS_DB = (34.0, 38.0, 40.0, 42.0, 46.0, 50.0)
_REFERENCE = (
    "a converged reference of other samples (up to 16,384, 54 dB or more where that was enough); "
    "median over the scenes"
)
Judge = Callable[[Subject, Shot], float]


def to_reference(subject: Subject, shot: Shot) -> float:
    """Return psnr_log_db of a picture to the scene's reference."""
    return psnr_log_db(shot.view.radiance_rgb, subject.reference_rgb)


def points(
    shop: Workshop, variants: Mapping[str, RenderSettings], default: str
) -> tuple[Point, ...]:
    """Return a point for each setting over all scenes: mean cost, median true error."""
    found = [(subject, shop.call(shots, subject.scene, variants)) for subject in shop.subjects]
    return tuple(
        _point(name, [(subject, of_scene[name]) for subject, of_scene in found], name == default)
        for name in variants
    )


def _point(name: str, taken: Sequence[tuple[Subject, Shot]], default: bool) -> Point:
    errors = [to_reference(subject, shot) for subject, shot in taken]
    floors = [shot.view.noise_floor_db for _, shot in taken]
    return Point(
        setting=name,
        cost=float(np.mean([shot.core_s for _, shot in taken])),
        error=float(np.median(errors)),
        default=default,
        further={
            "worst dB": min(errors),
            "stated floor dB": float(np.median(floors)),
            "samples": float(np.mean([shot.view.spp for _, shot in taken])),
        },
    )


def _doublings(least: int, most: int) -> list[int]:
    return [least << step for step in range((most // least).bit_length())]


def measure_samples(shop: Workshop) -> Curve:
    """Measure fixed numbers of samples, by denoiser."""
    effort = shop.effort
    variants = {
        f"{spp}, {denoiser}": dataclasses.replace(
            fixed_samples(effort.resolution, spp), denoiser=denoiser
        )
        for denoiser in ("off", "fast", "high")
        for spp in _doublings(32, effort.max_spp)
    }
    spp = min(smoke().renders.max_spp, effort.max_spp)
    default = f"{spp}, {RenderSettings.denoiser}"
    return Curve(points=points(shop, variants, default), measured_on=shop.scenes_in_words)


def measure_noise_floor(shop: Workshop) -> Curve:
    """Measure targets at which sampling stops."""
    effort, base = shop.effort, pretrain_256().renders
    most = 2 * effort.max_spp  # else the higher targets all end at the cap
    variants = {
        f"{target_db:.0f} dB": dataclasses.replace(
            base,
            resolution=effort.resolution,
            noise_floor_db=target_db,
            max_spp=most,
            min_mean_radiance=0.0,
        )
        for target_db in TARGETS_DB
    }
    words = f"{shop.scenes_in_words}, at most {most} samples"
    default = f"{base.noise_floor_db:.0f} dB"
    return Curve(points=points(shop, variants, default), measured_on=words)


def measure_first_samples(shop: Workshop) -> Curve:
    """Measure the samples after which the floor is looked at first."""
    effort, base = shop.effort, smoke().renders
    variants = {
        f"{spp}": dataclasses.replace(
            base,
            resolution=effort.resolution,
            min_spp=spp,
            max_spp=effort.max_spp,
            min_mean_radiance=0.0,
        )
        for spp in (8, 16, 32, 64, 128)
        if spp <= effort.max_spp
    }
    words = f"{shop.scenes_in_words}, target {base.noise_floor_db:.0f} dB"
    return Curve(points=points(shop, variants, f"{base.min_spp}"), measured_on=words)


def measure_guides(shop: Workshop) -> Curve:
    """Measure the samples of the pictures that guide the denoiser."""
    base = fixed_samples(shop.effort.resolution, shop.effort.fixed_spp)
    variants = {f"{spp}": dataclasses.replace(base, aux_spp=spp) for spp in (4, 16, 64)}
    words = f"{shop.scenes_in_words}, {shop.effort.fixed_spp} samples"
    return Curve(points=points(shop, variants, f"{base.aux_spp}"), measured_on=words)


_CORE_S = "core-seconds a view"
_DB = "psnr_log_db, dB"

KNOBS = (
    Knob(
        name="samples",
        title="Samples and denoiser",
        covers=("build.renders.max_spp", "build.renders.denoiser", "render.max_spp"),
        cost=_CORE_S,
        error=_DB,
        better="higher",
        against=_REFERENCE,
        because="`high`: without a denoiser an equal error takes many times the samples, and "
        "`fast` saves the same fraction of a second at every number of samples, so only few of "
        "them make it worth its loss. In place of a fixed number builds have a cap: what a view "
        "needs is measured, and the cap bounds the hardest (256 in `smoke`, which the table marks "
        "as the default, 4096 in `pretrain-256`).",
        measure=measure_samples,
    ),
    Knob(
        name="noise-floor",
        title="Noise floor of a view",
        covers=(
            "build.renders.noise_floor_db",
            "build.renders.reject_at_cap",
            "order.noise_floor_db",
            "render.noise_floor_db",
        ),
        cost=_CORE_S,
        error=_DB,
        better="higher",
        against=_REFERENCE,
        because="46 dB in the training builds, since an error in a target stays for every epoch; "
        "40 dB in `smoke`, whose 24 scenes are to take minutes. Hard views end at the cap and say "
        "so: rejecting them (`reject_at_cap`) would change what the set shows.",
        measure=measure_noise_floor,
    ),
    Knob(
        name="first-samples",
        title="Samples before the floor is measured first",
        covers=("build.renders.min_spp",),
        cost=_CORE_S,
        error=_DB,
        better="higher",
        against=_REFERENCE,
        because="32: with fewer the two halves may agree by luck, and small passes are stratified "
        "coarser, so that they save nothing; more only costs where a view is easy.",
        measure=measure_first_samples,
    ),
    Knob(
        name="guides",
        title="Samples of the denoiser's guide pictures",
        covers=("build.renders.aux_spp",),
        cost=_CORE_S,
        error=_DB,
        better="higher",
        against=_REFERENCE,
        because="64: the filter takes the guides to be without noise, and they are traced without "
        "light, at a fraction of the price of a sample.",
        measure=measure_guides,
    ),
)
