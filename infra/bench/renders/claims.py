"""Errors and costs of each side over the set, and how many times cheaper one is than another."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from infra.bench.renders.equal_error import Bound, Priced, at_error


@dataclass(frozen=True, kw_only=True)
class Shot:
    """One picture that was timed and judged."""

    scene: str
    """Of the named set; its first view."""
    side: str
    """Such as `trilight 46 dB` or `mitsuba 256`."""
    spp: int
    """Samples per pixel."""
    core_s: float
    """Core-seconds of the picture, kernels warm and scene loaded."""
    load_s: float
    """Seconds before: core-seconds of loading the scene; for Cycles the clock, Blender's scene and
    a picture of one sample included."""
    log_db: float
    """True error: psnr_log_db to the reference."""
    linear_db: float
    """psnr_linear_db to the same."""
    noise_floor_db: float | None
    """What the picture states of itself; None for others than ours."""


@dataclass(frozen=True, kw_only=True)
class Summary:
    """One side over all scenes."""

    side: str
    """As in `Shot`."""
    num_views: int
    """Pictures."""
    mean_core_s: float
    """Core-seconds a view: what the whole set takes, shared out."""
    median_core_s: float
    """Of the median view."""
    mean_spp: float
    """Samples per pixel, on average; ratios with others interpolate in it."""
    median_db: float
    """Of the true error, psnr_log_db."""
    p5_db: float
    """5th percentile."""
    worst_db: float
    """Of the worst view."""
    median_linear_db: float
    """Of the true error, psnr_linear_db."""
    worst_linear_db: float
    """Of the worst view."""
    median_floor_db: float | None
    """What the pictures state, where they do."""
    over_stated: float | None
    """Share of views whose true error is more than 1 dB worse than the stated floor."""


@dataclass(frozen=True, kw_only=True)
class Claim:
    """How many times the core-seconds of one side another one takes."""

    ours: str
    """The side that the ratio divides by."""
    theirs: str
    """What it is compared with, in words."""
    bound: Bound
    """`more than` where no level of theirs is as good, `at most` where all are better."""
    ratio: float
    """Mean core-seconds a view of theirs by those of ours."""
    their_spp: float
    """Samples per pixel of theirs at which the errors are equal."""


def summarised(shots: Sequence[Shot], side: str) -> Summary:
    """Return one side over the scenes of its shots."""
    mine = [shot for shot in shots if shot.side == side]
    log_db = np.array([shot.log_db for shot in mine])
    linear_db = np.array([shot.linear_db for shot in mine])
    floors = [shot.noise_floor_db for shot in mine if shot.noise_floor_db is not None]
    return Summary(
        side=side,
        num_views=len(mine),
        mean_core_s=float(np.mean([shot.core_s for shot in mine])),
        median_core_s=float(np.median([shot.core_s for shot in mine])),
        mean_spp=float(np.mean([shot.spp for shot in mine])),
        median_db=float(np.median(log_db)),
        p5_db=float(np.percentile(log_db, 5)),
        worst_db=float(log_db.min()),
        median_linear_db=float(np.median(linear_db)),
        worst_linear_db=float(linear_db.min()),
        median_floor_db=float(np.median(floors)) if floors else None,
        over_stated=float(np.mean(np.array(floors) - log_db > 1.0)) if floors else None,
    )


def at_equal_worst_error(ours: Summary, levels: Sequence[Summary], name: str) -> Claim:
    """Return what `name` takes at the fixed number of samples whose worst view is as good as ours.

    Between measured levels the number is interpolated (infra.bench.renders.equal_error).

    Args:
        ours: one of our targets.
        levels: theirs, from few samples to many.
        name: what they are called.
    """
    priced = [Priced(spp=one.mean_spp, core_s=one.mean_core_s, db=one.worst_db) for one in levels]
    found = at_error(priced, ours.worst_db)
    return _claim(ours, name, found.bound, found.core_s, found.spp)


def at_error_not_worse(targets: Sequence[Summary], theirs: Summary) -> Claim | None:
    """Return what theirs takes by the cheapest of our targets that is as good.

    As good means that neither the median nor the worst true error is lower; None where none is.
    """
    as_good = [
        one
        for one in targets
        if one.median_db >= theirs.median_db and one.worst_db >= theirs.worst_db
    ]
    if not as_good:
        return None
    cheapest = min(as_good, key=lambda one: one.mean_core_s)
    return _claim(cheapest, theirs.side, "exactly", theirs.mean_core_s, theirs.mean_spp)


def _claim(
    ours: Summary,
    theirs: str,
    bound: Bound,
    core_s: float,
    spp: float,
) -> Claim:
    return Claim(
        ours=ours.side, theirs=theirs, bound=bound, ratio=core_s / ours.mean_core_s, their_spp=spp
    )
