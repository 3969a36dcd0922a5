"""The passes that are not made, and all parts of a set together with the error that they add."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from infra.bench.economy_counts import SceneCosts
from infra.bench.economy_line import Line, base_flops
from storage.profiles import LAW_DB

PASSES: Mapping[str, int] = {
    "colour": 3, "diffuse": 3, "glossy": 3, "normal": 3, "albedo": 3, "depth": 1,
}  # fmt: skip
"""Channels by pass: what the published pipeline writes for every view, of which its exporter for
training reads the colour alone."""
HALF_BYTES = 2


def passes(found: Sequence[SceneCosts], renders: Mapping[str, Any]) -> Line:
    """Return the line of the pictures of a view that are rendered and stored.

    Args:
        found: scenes of the set.
        renders: settings of its pictures, as in the manifest.
    """
    views = sum(len(one.spp) for one in found)
    stored = sum(one.stored_pictures for one in found) / views
    guides = f"albedo and normal at {renders['aux_spp']} samples for the denoiser, not stored"
    rendered = "colour" if renders["denoiser"] == "off" else f"colour; {guides}"
    return Line(
        part="passes of a view, stored",
        everything=f"{len(PASSES)}, as published: {', '.join(PASSES)}",
        kept=f"{stored:g}; rendered: {rendered}",
        factor=len(PASSES) / stored,
        error="none: neither network nor loss reads another one; geometry and materials are exact "
        "in the arrays",
    )


def in_all(
    found: Sequence[SceneCosts], settings: Mapping[str, Any], *, published_bytes: float
) -> list[Line]:
    """Return samples, FLOPs and bytes of a scene with all savings together, and their error.

    Args:
        found: scenes of the set.
        settings: of the build, as in the manifest.
        published_bytes: of a scene's arrays in the published HDF5.
    """
    px, most = int(settings["renders"]["resolution"]), int(settings["renders"]["max_spp"])
    views = len(found[0].spp)
    paths = views * px * px / 1e6
    spent = float(np.mean([spp for one in found for spp in one.spp]))
    sources = _mean_flops([one.triangles - one.object_faces + one.source_faces for one in found],
                          views, px)  # fmt: skip
    counted = _mean_flops([one.triangles for one in found], views, px)
    raw = views * px * px * sum(PASSES.values()) * HALF_BYTES
    kept = float(np.mean([one.array_bytes + one.record_bytes + one.picture_bytes for one in found]))
    errors = 100 * np.array([error for one in found for error in one.object_errors])
    return [
        Line(
            part="**in all**: samples of all pixels",
            everything=f"{paths * most:.1f} M",
            kept=f"{paths * spent:.1f} M",
            factor=most / spent,
            error=_picture_error(found, str(settings["storage"]["profile"])),
        ),
        Line(
            part="**in all**: FLOPs of all views (Base)",
            everything=f"{sources / 1e9:.0f} G with the objects' sources",
            kept=f"{counted / 1e9:.0f} G",
            factor=sources / counted,
            error=f"p99 distance of the objects to their sources: median {np.median(errors):.2f} "
            f"%, 95th percentile {np.percentile(errors, 95):.2f} %, largest {errors.max():.2f} %",
        ),
        Line(
            part="**in all**: bytes",
            everything=f"{(published_bytes + raw) / 1e3:.0f} kB: the published HDF5, six passes as "
            "raw half floats",
            kept=f"{kept / 1e3:.0f} kB",
            factor=(published_bytes + raw) / kept,
            error="in pictures only, and counted in the line of the samples",
        ),
    ]


def _mean_flops(triangles: Sequence[int], views: int, px: int) -> float:
    return float(np.mean([base_flops(count, views, px) for count in triangles]))


def _picture_error(found: Sequence[SceneCosts], profile: str) -> str:
    floors = np.array([floor for one in found for floor in one.floors_db])
    lost = 0.0 if profile == "lossless" else 10 * math.log10(1 + 10 ** (-LAW_DB / 10))
    middle, low = np.median(floors), np.percentile(floors, 5)
    return (
        f"stated per view: median {middle:.1f} dB as rendered, {middle - lost:.1f} or more as "
        f"stored; 5th percentile {low:.1f} and {low - lost:.1f}"
    )
