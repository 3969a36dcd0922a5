"""What is stored, and how exactly: codecs of pictures, precision of the arrays of scenes."""

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from infra.bench.renders.fixed_samples import fixed_samples
from infra.bench.shard_pictures import codecs, picture_side
from infra.bench.trade.curves import Curve, Knob, Point
from infra.bench.trade.rendered import shots
from infra.bench.trade.workshop import Workshop
from storage.dataset_settings import StorageSettings
from storage.material import DIFFUSE, SPECULAR
from storage.metrics import psnr_log_db
from storage.profiles import LAW_DB, pack_arrays
from storage.scene import ARRAY_FIELDS, Scene

CODECS = (
    "raw half floats",
    "ZSTD",
    "PIZ",
    "HTJ2K256",
    "LJ2K",
    "DWAB 20",
    "DWAB 45",
    "DWAB 100",
    "DWAB 200",
    "profile lossless",
    "profile compact",
)


def measure_codec(shop: Workshop) -> Curve:
    """Measure bytes, times and error of packed pictures."""
    every, samples = codecs(), shop.samples
    found = shop.in_turns(
        "trade-codecs", {name: picture_side(every[name], samples) for name in CODECS}
    )
    default = f"profile {StorageSettings.profile}"
    points = [
        Point(
            setting=name,
            cost=figures["bytes"] / 1000,
            error=figures["below_floor_p5_db"],
            default=name == default,
            further={
                "pack ms": figures["encode_ms"],
                "unpack ms": figures["decode_ms"],
                f"views at {LAW_DB:.0f} dB or more %": 100 * figures["lawful"],
            },
        )
        for name, figures in found.items()
    ]
    px = samples[0].radiance_rgb.shape[1]
    views = sum(len(sample.views) for sample in samples)
    return Curve(points=tuple(points), measured_on=f"{views} views of `smoke`, {px} x {px}")


def _half(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return values.astype(np.float16).astype(np.float32)


def _half_positions(scene: Scene) -> Scene:
    return dataclasses.replace(scene, vertex_positions=_half(scene.vertex_positions))


def _half_rest(scene: Scene) -> Scene:
    """Round normals and materials; lengths and sums that the laws fix are made right again."""
    normals = _half(scene.vertex_normals)
    normals /= np.sqrt(np.sum(np.square(normals), axis=1, keepdims=True))
    materials = _half(scene.materials)
    materials[:, SPECULAR] = np.minimum(materials[:, SPECULAR], 1 - materials[:, DIFFUSE])
    return dataclasses.replace(scene, vertex_normals=normals, materials=materials)


PRECISIONS: dict[str, tuple[Callable[[Scene], Scene], tuple[str, ...]]] = {
    "float32": (lambda scene: scene, ()),
    "float16 normals and materials": (_half_rest, ("vertex_normals", "materials")),
    "float16 positions too": (
        lambda scene: _half_positions(_half_rest(scene)),
        ("vertex_normals", "materials", "vertex_positions"),
    ),
}
"""How a scene is rounded, and which of its arrays are then stored in half."""


def _kilobytes(scene: Scene, in_half: tuple[str, ...]) -> float:
    from safetensors.numpy import save

    arrays = {name: np.ascontiguousarray(getattr(scene, name)) for name in ARRAY_FIELDS}
    arrays |= {name: arrays[name].astype(np.float16) for name in in_half}
    (packed,) = pack_arrays(save(arrays), "compact").values()
    return len(packed) / 1000


def measure_arrays(shop: Workshop) -> Curve:
    """Measure what rounding the arrays of a scene saves, and what its picture loses."""
    settings = {"view": fixed_samples(shop.effort.resolution, shop.effort.fixed_spp)}
    sizes: dict[str, list[float]] = {name: [] for name in PRECISIONS}
    errors: dict[str, list[float]] = {name: [] for name in PRECISIONS}
    for subject in shop.subjects:
        exact: NDArray[np.float32] | None = None
        for name, (rounded, in_half) in PRECISIONS.items():
            scene = rounded(subject.scene)
            picture = shop.call(shots, scene, settings)["view"].view.radiance_rgb
            exact = picture if exact is None else exact
            sizes[name].append(_kilobytes(scene, in_half))
            errors[name].append(psnr_log_db(picture, exact))
    points = [
        Point(
            setting=name,
            cost=float(np.mean(sizes[name])),
            error=float(np.median(errors[name])),
            default=not in_half,
            further={"worst dB": min(errors[name])},
        )
        for name, (_, in_half) in PRECISIONS.items()
    ]
    words = f"{shop.scenes_in_words}, {shop.effort.fixed_spp} samples"
    return Curve(points=tuple(points), measured_on=words)


KNOBS = (
    Knob(
        name="codec",
        title="Codec of pictures",
        covers=("build.storage.profile",),
        cost="kB a view",
        error="dB below the view's own noise floor, 5th percentile of the views",
        better="higher",
        also_cost=("pack ms", "unpack ms"),
        against="the picture before it is packed, beside its measured noise",
        because="`compact`: for each view the coarsest level of DWAB that adds at most a tenth of "
        "the noise that is there (10 dB below it), tested on what decodes. Sets to be judged by "
        "stay `lossless`. HTJ2K is smaller without loss, but few programs read it yet.",
        measure=measure_codec,
    ),
    Knob(
        name="arrays",
        title="Precision of the arrays of a scene",
        covers=(),
        cost="kB a scene, deflated",
        error="psnr_log_db, dB",
        better="higher",
        against="the path traced picture of the float32 scene, same random numbers; median over "
        "the scenes (100 dB is the same picture)",
        because="float32, without a setting: the arrays are the smaller part of a sample, and "
        "what rounding changes in a picture is no noise that views average out but one wrong "
        "shape in all of them.",
        measure=measure_arrays,
    ),
)
