"""What is stored, and how exactly: codecs of pictures, arrays of scenes, whole samples.

A codec is judged by bytes, time to pack and unpack, and error against the noise floor.
"""

import dataclasses
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from infra.bench.effort import Effort
from infra.bench.experiment import (
    Column,
    Experiment,
    Figures,
    Point,
    TurnFigures,
    one_by_one,
    percent,
    repeats,
)
from infra.bench.experiments.sampling import DB, WORST, scenes
from infra.bench.sides.packed_arrays import ARRAYS, COLOURS, SAMPLES, array_figures, sample_figures
from infra.bench.sides.shots import fixed_samples, shots
from infra.bench.workshop import Workshop
from storage.dataset.settings import StorageSettings
from storage.metrics import psnr_log_db
from storage.records.exr import ExrCodec, decode_exr, encode_exr
from storage.records.material import DIFFUSE, SPECULAR
from storage.records.profiles import LAW_DB, PROFILES, pack_arrays, pack_picture
from storage.records.sample import Sample
from storage.records.scene import ARRAY_FIELDS, Scene

Picture = NDArray[np.float32]

EXACT = ("NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "ZSTD", "HTJ2K32", "HTJ2K256")
LOSSY = ("B44", "B44A", "LJ2K")
LEVELS = {"DWAA": (20, 45, 100, 200), "DWAB": (5, 10, 20, 45, 100, 200, 400)}
"""What OpenEXR 3.5.3's Python module offers; of the levels only DWA's can be set through it."""


@dataclass(frozen=True, kw_only=True)
class PictureCodec:
    """One way to pack a picture."""

    encode: Callable[[Picture, float], bytes]
    """Packs a picture, given its noise floor in dB."""
    decode: Callable[[bytes, tuple[int, ...]], Picture]
    """Unpacks a picture of a shape."""


def codecs() -> Mapping[str, PictureCodec]:
    """Return every codec by the name that tables show."""
    plain = {
        "raw half floats": PictureCodec(encode=lambda p, _: _half_bytes(p), decode=_from_half),
        "raw half floats, deflate": PictureCodec(
            encode=lambda p, _: zlib.compress(_half_bytes(p), 6),
            decode=lambda data, shape: _from_half(zlib.decompress(data), shape),
        ),
    }
    chosen = {name: ExrCodec(compression=name) for name in (*EXACT, *LOSSY)}
    for name, levels in LEVELS.items():
        chosen |= {
            f"{name} {level}": ExrCodec(compression=name, dwa_level=level) for level in levels
        }
    profiles = {
        f"profile {name}": PictureCodec(
            encode=lambda p, floor_db, name=name: pack_picture(p, floor_db, name),  # type: ignore[misc]
            decode=lambda data, _: decode_exr(data),
        )
        for name in PROFILES
    }
    return plain | {name: _exr(codec) for name, codec in chosen.items()} | profiles


def _exr(codec: ExrCodec) -> PictureCodec:
    return PictureCodec(
        encode=lambda p, _: encode_exr(p, codec), decode=lambda data, _: decode_exr(data)
    )


def _half_bytes(picture: Picture) -> bytes:
    return picture.astype(np.float16).tobytes()


def _from_half(data: bytes, shape: tuple[int, ...]) -> Picture:
    return np.frombuffer(data, np.float16).reshape(shape).astype(np.float32)


def picture_figures(codec: PictureCodec, samples: Sequence[Sample]) -> Mapping[str, float]:
    """Pack and unpack every view of the samples, in one thread."""
    views = [
        (picture, record.noise_floor_db)
        for sample in samples
        for picture, record in zip(sample.radiance_rgb, sample.views, strict=True)
    ]
    started = time.process_time()
    packed = [codec.encode(picture, floor_db) for picture, floor_db in views]
    encoded = time.process_time()
    stored = [
        codec.decode(data, picture.shape) for data, (picture, _) in zip(packed, views, strict=True)
    ]
    decoded = time.process_time()
    return {
        "bytes": float(np.mean([len(data) for data in packed])),
        "encode_ms": 1000 * (encoded - started) / len(views),
        "decode_ms": 1000 * (decoded - encoded) / len(views),
        **_errors(views, stored),
    }


def _errors(
    views: Sequence[tuple[Picture, float]], stored: Sequence[Picture]
) -> Mapping[str, float]:
    """Return how far the error is below the noise floor, over the views."""
    below = [
        psnr_log_db(picture, back) - floor_db
        for (picture, floor_db), back in zip(views, stored, strict=True)
    ]
    return {
        "below_floor_p5_db": float(np.percentile(below, 5)),
        "lawful": float(np.mean([value >= LAW_DB for value in below])),
    }


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


ROUNDED: dict[str, tuple[Callable[[Scene], Scene], tuple[str, ...]]] = {
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


def _measure_rounding(workshop: Workshop, points: Sequence[Point], turn: str) -> TurnFigures:
    """Render one scene with its arrays rounded, and compare with the picture of the first point."""
    settings = {"view": fixed_samples(workshop.effort.resolution, workshop.effort.fixed_spp)}
    exact: NDArray[np.float32] | None = None
    for point in points:
        rounded, in_half = ROUNDED[point.name]
        scene = rounded(workshop.subject(turn).scene)
        picture = workshop.call(shots, scene, settings)["view"].view.radiance_rgb
        exact = picture if exact is None else exact
        yield point.name, {"kb": _kilobytes(scene, in_half), "db": psnr_log_db(picture, exact)}


def _codec(workshop: Workshop, point: Point, turn: str) -> Figures:
    return picture_figures(codecs()[point.name], workshop.samples)


def _arrays(workshop: Workshop, point: Point, turn: str) -> Figures:
    form, colours = point.settings
    return array_figures(workshop.samples, form, colours, workshop.folder())


def _sample(workshop: Workshop, point: Point, turn: str) -> Figures:
    return sample_figures(workshop.samples, point.name, workshop.folder())


def _forms(effort: Effort) -> list[Point]:
    return [
        Point(
            name=f"{form}, {colours}",
            settings=(form, colours),
            default=(form, colours) == (ARRAYS[3], COLOURS[0]),
        )
        for colours in COLOURS
        for form in ARRAYS
    ]


def _kilo(value: float) -> float:
    return value / 1000


_KB = Column(name="kB", figure="bytes", then=_kilo)
_UNPACK = Column(name="unpack ms", figure="decode_ms")

EXPERIMENTS = (
    Experiment(
        name="codec",
        title="Codec of pictures",
        about="Views of `smoke` packed and unpacked by one thread, in memory.",
        covers=("build.storage.profile",),
        cost=Column(name="kB a view", figure="bytes", then=_kilo),
        error=Column(
            name="dB below the view's own noise floor, 5th percentile of the views",
            figure="below_floor_p5_db",
        ),
        better="higher",
        also_cost=("pack ms", "unpack ms"),
        against="the picture before it is packed, beside its measured noise",
        columns=(
            Column(name="pack ms", figure="encode_ms"),
            _UNPACK,
            Column(
                name=f"views at {LAW_DB:.0f} dB or more %",
                figure="lawful",
                then=percent,
            ),
        ),
        because=(
            "Default: `compact`. For each view it takes the coarsest level of DWAB that adds "
            "at most a tenth of the noise already in the picture (10 dB below it), tested on "
            "the decoded picture. Datasets for evaluation stay `lossless`. HTJ2K is smaller "
            "without loss, but few programs read it yet."
        ),
        points=lambda effort: [
            Point(name=name, default=name == f"profile {StorageSettings.profile}")
            for name in codecs()
        ],
        turns=repeats,
        measure=one_by_one(_codec),
        warm_up=True,
    ),
    Experiment(
        name="arrays",
        title="Precision of the arrays of a scene",
        about="Scenes with rounded arrays, path traced with the same random numbers.",
        cost=Column(name="kB a scene, deflated", figure="kb", over="mean"),
        error=DB,
        better="higher",
        against="the path traced picture of the float32 scene, same random numbers; median over "
        "the scenes (100 dB is the same picture)",
        columns=(WORST,),
        because="Default: float32, without a setting. The arrays are the smaller part of a sample, "
        "and what rounding changes in a picture is no noise that views average out but one wrong "
        "shape in all of them.",
        points=lambda effort: [Point(name=name, default=name == "float32") for name in ROUNDED],
        turns=scenes,
        measure=_measure_rounding,
    ),
    Experiment(
        name="array-forms",
        title="Forms of the arrays of a scene",
        about="Ours, indexed with a palette of materials, beside flat triangles and the published "
        "HDF5, by how many colours a scene has; all exact.",
        cost=_KB,
        columns=(Column(name="in memory, kB", figure="memory_bytes", then=_kilo), _UNPACK),
        points=_forms,
        turns=repeats,
        measure=one_by_one(_arrays),
        warm_up=True,
    ),
    Experiment(
        name="samples-unpacked",
        title="Whole samples, unpacked by one thread",
        about="Arrays and pictures of `smoke`, four views a sample; HDF5 by our exporter.",
        cost=Column(name="unpack ms a sample", figure="decode_ms"),
        columns=(
            Column(name="a second and core", figure="decode_ms", then=lambda ms: 1000 / ms),
            _KB,
            Column(name="in memory, kB", figure="memory_bytes", then=_kilo),
        ),
        points=lambda effort: [
            Point(name=name, default=name == StorageSettings.profile) for name in SAMPLES
        ],
        turns=repeats,
        measure=one_by_one(_sample),
        warm_up=True,
    ),
)
