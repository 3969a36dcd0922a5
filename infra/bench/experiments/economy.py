"""What the scenes of a dataset cost part by part, and what was left out, from its own records.

Figures are counted from the samples and this machine's asset store, in which the sources' triangles
are looked up: make the set here.
"""

import math
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from infra.bench.experiment import Column, Experiment, Point, TurnFigures
from infra.bench.workshop import Workshop
from pipeline.exchange.renderformer_h5 import CELLS, CHANNELS, write_renderformer_h5
from storage.cache import cache_folder
from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.shard import contents_of
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.records.asset import Asset, decode_asset
from storage.records.profiles import LAW_DB
from storage.records.sample import SceneRecord

_HDF5_SCENES = 24
"""Written in the published form: half a second each."""


@dataclass(frozen=True, kw_only=True)
class SceneCosts:
    """One scene with its views."""

    triangles: int
    """Triangles in the scene."""
    source_faces: int
    """Triangles of its objects' sources."""
    object_faces: int
    """Triangles of the same objects in the scene."""
    object_errors: tuple[float, ...]
    """Two-way distance of each object to its source, 99th percentile, share of the diagonal."""
    spp: tuple[int, ...]
    """Samples per pixel of each view."""
    at_cap: tuple[bool, ...]
    """Whether sampling of a view ended at the cap before its target was reached."""
    floors_db: tuple[float, ...]
    """Noise floor of each view."""
    array_bytes: int
    """Bytes of the stored arrays."""
    record_bytes: int
    """Bytes of its JSON."""
    picture_bytes: int
    """Bytes of all stored pictures."""
    stored_pictures: int
    """Picture files of all views together."""


def scene_costs(dataset: Dataset) -> Iterator[SceneCosts]:
    """Yield what each scene of a dataset takes.

    Raises:
        TrilightError: objects of the set are not in this machine's asset store.
    """
    known = _prepared_assets()
    objects = dataset.objects_lock()
    unknown = [locked.uid for locked in objects if locked.asset_sha256 not in known]
    if unknown:
        raise TrilightError(
            f"{dataset.shown}: the asset store of this machine does not know {len(unknown)} of its "
            f"{len(objects)} objects, such as {unknown[0]}; expected a set that was made here. "
            "Generate it with the same TRILIGHT_CACHE."
        )
    assets = {locked.uid: known[locked.asset_sha256] for locked in objects}
    for shard in dataset.manifest.shards:
        with dataset.files.open(shard, checked=False) as stream:
            index = contents_of(stream, shard.name).samples
        for record in dataset.read_scenes(shard):
            members = index[record.key].items()
            sizes = {suffix: member.num_bytes for suffix, member in members}
            yield _costs(record, sizes, assets)


def _costs(
    record: SceneRecord, sizes: Mapping[str, int], assets: Mapping[str, Asset]
) -> SceneCosts:
    scene = record.scene
    counts = np.bincount(scene.object_index, minlength=len(scene.objects))
    known = [row for row, entry in enumerate(scene.objects) if entry.uid]
    of_rows = [assets[scene.objects[row].uid] for row in known]
    pictures = [size for suffix, size in sizes.items() if suffix.endswith(".exr")]
    return SceneCosts(
        triangles=scene.num_triangles,
        source_faces=sum(asset.source.num_faces for asset in of_rows),
        object_faces=int(counts[known].sum()),
        object_errors=tuple(
            _error_within(asset, int(counts[row]))
            for asset, row in zip(of_rows, known, strict=True)
        ),
        spp=tuple(view.spp for view in record.views),
        at_cap=tuple(view.at_cap for view in record.views),
        floors_db=tuple(view.noise_floor_db for view in record.views),
        array_bytes=sum(size for suffix, size in sizes.items() if suffix.startswith("scene.")),
        record_bytes=sizes["json"],
        picture_bytes=sum(pictures),
        stored_pictures=len(pictures),
    )


def _error_within(asset: Asset, num_triangles: int) -> float:
    """Return the error of the level that a scene holds, known by its number of triangles."""
    level = asset.finest_within(num_triangles)
    if level is None:
        raise TrilightError(
            f"an object of {num_triangles} triangles is coarser than every level of its asset; "
            "expected one of them. Make the set anew with the same TRILIGHT_CACHE."
        )
    return level.record.quality.error_p99


def _prepared_assets() -> dict[str, Asset]:
    """Return what this machine has prepared, by the digests of the assets."""
    paths = cache_folder("assets").glob("*/*.safetensors")
    return {sha256_hex(data): decode_asset(data) for data in (path.read_bytes() for path in paths)}


def hdf5_bytes(dataset: Dataset) -> float:
    """Return the bytes a scene in the published HDF5 with half-float textures, without pictures."""
    sizes: list[int] = []
    with tempfile.TemporaryDirectory() as folder:
        for shard in dataset.manifest.shards:
            for record in dataset.read_scenes(shard):
                if len(sizes) == _HDF5_SCENES:
                    break
                path = Path(folder, f"{record.key}.h5")
                write_renderformer_h5(path, record.scene, texture_type="float16")
                sizes.append(path.stat().st_size)
    return float(np.mean(sizes))


PASSES = {"colour": 3, "diffuse": 3, "glossy": 3, "normal": 3, "albedo": 3, "depth": 1}
"""Channels by pass: what the published pipeline writes for every view, of which its exporter for
training reads the colour alone."""
HALF_BYTES = 2
OBJECTS, FLOPS = "triangles of the objects", "G FLOPs of all views (Base), padded as published"
LEAST_FLOPS, LEAST_KB = "G FLOPs of the smallest scene, not the largest", "kB of its arrays"
SAMPLES, ARRAYS = "samples of a pixel, not the cap", "kB of arrays and record, not published HDF5"
TEXTURES, PICTURES = "MB of materials, not textures", "kB of pictures, not raw half floats"
WHOLE, STORED = "kB of a whole sample", "passes of a view that are stored, of those published"
ALL_FLOPS, ALL_KB = "in all: G FLOPs, not with the objects' sources", "in all: kB, six raw passes"
PARTS = (OBJECTS, FLOPS, LEAST_FLOPS, LEAST_KB, STORED, SAMPLES, ARRAYS, TEXTURES, PICTURES, WHOLE,
         ALL_FLOPS, ALL_KB)  # fmt: skip


def _measure(workshop: Workshop, points: Sequence[Point], turn: str) -> TurnFigures:
    dataset = open_dataset(workshop.asked.data or "")
    found = list(scene_costs(dataset))
    if not found:
        raise TrilightError(f"{dataset.shown}: no scene; expected a finished dataset.")
    manifest = dataset.manifest
    workshop.note(f"{len(found)} scenes of `{manifest.build}`, {manifest.num_views} views each")
    for note in _errors(found, manifest.settings):
        workshop.note(note)
    parts = {**_geometry(found, manifest.settings), **_bytes(dataset, found)}
    for point in points:
        everything, kept = parts[point.name]
        yield point.name, {"kept": kept, "everything": everything, "times": everything / kept}


def _geometry(found: Sequence[SceneCosts], settings: Any) -> dict[str, tuple[float, float]]:
    """Return what each part would take and takes: triangles, FLOPs, samples."""
    from infra.bench.sides.networks import PUBLISHED_LENGTH, base_flops

    px, views = int(settings["renders"]["resolution"]), len(found[0].spp)

    def flops(triangles: Iterable[int]) -> float:
        return float(np.mean([base_flops(count, views, px) for count in triangles])) / 1e9

    least = min(found, key=lambda one: one.triangles)
    most = max(found, key=lambda one: one.triangles)
    counted = flops(one.triangles for one in found)
    padded = PUBLISHED_LENGTH.get(px, max(PUBLISHED_LENGTH.values()))
    sources = flops(one.triangles - one.object_faces + one.source_faces for one in found)
    return {
        OBJECTS: (_mean(found, "source_faces"), _mean(found, "object_faces")),
        FLOPS: (flops([padded]), counted),
        LEAST_FLOPS: (flops([most.triangles]), flops([least.triangles])),
        LEAST_KB: (most.array_bytes / 1e3, least.array_bytes / 1e3),
        SAMPLES: (
            float(settings["renders"]["max_spp"]),
            float(np.mean([spp for one in found for spp in one.spp])),
        ),
        ALL_FLOPS: (sources, counted),
    }


def _bytes(dataset: Dataset, found: Sequence[SceneCosts]) -> dict[str, tuple[float, float]]:
    """Return what each part would take and takes on disk and in memory."""
    px, views = int(dataset.manifest.settings["renders"]["resolution"]), len(found[0].spp)
    published = hdf5_bytes(dataset) / 1e3
    arrays = (_mean(found, "array_bytes") + _mean(found, "record_bytes")) / 1e3
    pictures = _mean(found, "picture_bytes") / 1e3
    raw = {passes: views * px * px * passes * HALF_BYTES / 1e3 for passes in (3, 16)}
    textures = _mean(found, "triangles") * CHANNELS * CELLS**2 * HALF_BYTES / 1e6
    return {
        STORED: (float(len(PASSES)), _mean(found, "stored_pictures") / views),
        ARRAYS: (published, arrays),
        TEXTURES: (textures, arrays / 1e3),
        PICTURES: (raw[PASSES["colour"]], pictures),
        WHOLE: (published + raw[PASSES["colour"]], arrays + pictures),
        ALL_KB: (published + raw[sum(PASSES.values())], arrays + pictures),
    }


def _mean(found: Sequence[SceneCosts], name: str) -> float:
    return float(np.mean([getattr(one, name) for one in found]))


def _errors(found: Sequence[SceneCosts], settings: Any) -> Iterable[str]:
    """Yield what the savings add in error, in words."""
    floors = np.array([floor for one in found for floor in one.floors_db])
    lossless = settings["storage"]["profile"] == "lossless"
    lost = 0.0 if lossless else 10 * math.log10(1 + 10 ** (-LAW_DB / 10))
    middle, low = np.median(floors), np.percentile(floors, 5)
    at_cap = np.mean([capped for one in found for capped in one.at_cap])
    errors = 100 * np.array([error for one in found for error in one.object_errors])
    yield f"{100 * at_cap:.0f} % of the views end at the cap"
    yield (
        f"stated per view: median {middle:.1f} dB as rendered, {middle - lost:.1f} or more as "
        f"stored; 5th percentile {low:.1f} and {low - lost:.1f}"
    )
    yield (
        f"p99 distance of the objects to their sources: median {np.median(errors):.2f} %, 95th "
        f"percentile {np.percentile(errors, 95):.2f} %, largest {errors.max():.2f} %"
    )


EXPERIMENTS = (
    Experiment(
        name="economy",
        title="What a set left out",
        about=(
            "Means per scene of one finished dataset (`--data SET`), from its manifest, "
            "samples and the asset store: what each part takes, and what it would take with "
            "nothing left out."
        ),
        cost=Column(name="what is kept", figure="kept"),
        columns=(
            Column(name="with everything", figure="everything"),
            Column(name="saving, times", figure="times"),
        ),
        points=lambda effort: [Point(name=name) for name in PARTS],
        turns=lambda effort: ["the set"],
        measure=_measure,
        needs=("torch", "data"),
    ),
)
