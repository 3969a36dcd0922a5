"""What each scene of a dataset takes, counted from its samples and from the asset store."""

import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from model.config import base
from model.empty_bundles import bundles_that_see
from model.positions import token_places
from model.scene_tensors import batch_scenes, scene_tensors
from pipeline.exchange.renderformer_h5 import write_renderformer_h5
from storage.cache import cache_folder
from storage.dataset.dataset import Dataset
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.records.asset import Asset, decode_asset
from storage.records.sample import SceneRecord
from storage.records.scene import Scene

_HDF5_SCENES = 24
"""Written in the published form: half a second each."""


@dataclass(frozen=True, kw_only=True)
class SceneCosts:
    """One scene with its views."""

    triangles: int
    """In the scene."""
    source_faces: int
    """Of its objects' sources."""
    object_faces: int
    """Of the same objects in the scene."""
    object_errors: tuple[float, ...]
    """By object: two-way distance to its source, 99th percentile, as a share of the diagonal."""
    spp: tuple[int, ...]
    """By view."""
    at_cap: tuple[bool, ...]
    """By view: whether sampling ended at the cap before the target was reached."""
    floors_db: tuple[float, ...]
    """By view."""
    array_bytes: int
    """Of the stored member."""
    record_bytes: int
    """Of its JSON."""
    picture_bytes: int
    """Of all stored pictures."""
    stored_pictures: int
    """Picture files of all views together."""
    empty_share: float
    """Ray bundles that can see nothing."""


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
    resolution = int(dataset.manifest.settings["renders"]["resolution"])
    for shard in dataset.manifest.shards:
        index = shard.index
        for record in dataset.read_scenes(shard):
            sizes = {suffix: size for suffix, (_, size) in index[record.key].items()}
            yield _costs(record, sizes, assets, resolution)


def _costs(
    record: SceneRecord, sizes: Mapping[str, int], assets: Mapping[str, Asset], resolution: int
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
        empty_share=_empty_share(scene, resolution),
    )


def _empty_share(scene: Scene, resolution: int) -> float:
    batch = batch_scenes([scene_tensors(scene)])
    places = token_places(batch.triangles_BT33, batch.is_triangle_BT, num_registers=0, eps=0)
    with torch.no_grad():
        sees = bundles_that_see(places, batch.cameras, resolution, base().patch_px)
    return 1 - float(sees.double().mean())


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
