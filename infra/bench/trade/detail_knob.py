"""How coarse objects may be before the picture shows it: path tracing them against the finest."""

import numpy as np

from infra.bench.scene_detail import ERRORS, picture_errors
from infra.bench.trade.curves import Curve, Knob, Point
from infra.bench.trade.workshop import Workshop
from pipeline.flows.training_builds import pretrain_256

FINEST = "finest, other samples"


def measure_detail(shop: Workshop) -> Curve:
    """Measure pictures of coarser objects in the same scenes."""
    effort = shop.effort
    count = max(2, effort.scenes // 2)
    px, spp = effort.picture_px, effort.fixed_spp
    found = [shop.call(picture_errors, index, px, spp) for index in range(count)]
    names = {f"{error:.2%}": f"{100 * error:g} %" for error in ERRORS} | {"finest": FINEST}
    default = f"{100 * pretrain_256().scenes.enough_error:g} %"
    points = []
    for key, setting in names.items():
        values = np.array([scene[key] for scene in found])
        triangles = float(values[:, 0].mean())
        points.append(
            Point(
                setting=setting,
                cost=shop.network_core_s(triangles),
                error=float(np.median(values[:, 1])),
                default=setting == default,
                further={"worst dB": float(values[:, 1].min()), "object triangles": triangles},
            )
        )
    words = f"{count} scenes of `smoke`, one view of {px} x {px}, {spp} samples; the network is"
    return Curve(points=tuple(points), measured_on=f"{words} {effort.network}")


KNOBS = (
    Knob(
        name="detail",
        title="Distance to the source that is near enough",
        covers=("build.scenes.enough_error",),
        cost="core-seconds of the network for the objects and one view",
        error="psnr_log_db, dB",
        better="higher",
        against="the path traced picture of the finest meshes (at most 1400 triangles each), same "
        "places, materials, lights, camera and random numbers; median over the scenes. The last "
        "row is that picture itself with other samples: nothing can be told above it",
        because="0.5 % at 256 pixels, 0.25 % at 512. Facets and outlines move highlights long "
        "before a distance is seen; but every picture of a set is of the very triangles that the "
        "network is given, so this is no error of the labels.",
        measure=measure_detail,
        needs=("torch",),
        yardstick=FINEST,
    ),
)
