"""What each scene of a dataset takes, counted from its samples and from the asset store."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import torch

from model.config import base
from model.empty_bundles import bundles_that_see
from model.positions import token_places
from model.scene_tensors import batch_scenes, scene_tensors
from storage.asset import decode_asset
from storage.cache import cache_folder
from storage.dataset import Dataset
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.sample import SceneRecord
from storage.scene import Scene


@dataclass(frozen=True, kw_only=True)
class SceneCosts:
    """One scene with its views."""

    triangles: int
    """In the scene."""
    source_faces: int
    """Of its objects' sources."""
    object_faces: int
    """Of the same objects in the scene."""
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
    empty_share: float
    """Ray bundles that can see nothing."""


def scene_costs(dataset: Dataset) -> Iterator[SceneCosts]:
    """Yield what each scene of a dataset takes.

    Raises:
        TrilightError: objects of the set are not in this machine's asset store.
    """
    faces_of_asset = _source_faces()
    objects = dataset.objects_lock()
    unknown = [locked.uid for locked in objects if locked.asset_sha256 not in faces_of_asset]
    if unknown:
        raise TrilightError(
            f"{dataset.shown}: the asset store of this machine does not know {len(unknown)} of its "
            f"{len(objects)} objects, such as {unknown[0]}; expected a set that was made here. "
            "Generate it with the same TRILIGHT_CACHE."
        )
    faces_of_uid = {locked.uid: faces_of_asset[locked.asset_sha256] for locked in objects}
    resolution = int(dataset.manifest.settings["renders"]["resolution"])
    for shard in dataset.manifest.shards:
        index = shard.index
        for record in dataset.read_scenes(shard):
            sizes = {suffix: size for suffix, (_, size) in index[record.key].items()}
            yield _costs(record, sizes, faces_of_uid, resolution)


def _costs(
    record: SceneRecord, sizes: Mapping[str, int], faces_of_uid: Mapping[str, int], resolution: int
) -> SceneCosts:
    scene = record.scene
    counts = np.bincount(scene.object_index, minlength=len(scene.objects))
    known = [row for row, entry in enumerate(scene.objects) if entry.uid]
    return SceneCosts(
        triangles=scene.num_triangles,
        source_faces=sum(faces_of_uid[scene.objects[row].uid] for row in known),
        object_faces=int(counts[known].sum()),
        spp=tuple(view.spp for view in record.views),
        at_cap=tuple(view.at_cap for view in record.views),
        floors_db=tuple(view.noise_floor_db for view in record.views),
        array_bytes=sum(size for suffix, size in sizes.items() if suffix.startswith("scene.")),
        record_bytes=sizes["json"],
        picture_bytes=sum(size for suffix, size in sizes.items() if suffix.endswith(".exr")),
        empty_share=_empty_share(scene, resolution),
    )


def _empty_share(scene: Scene, resolution: int) -> float:
    batch = batch_scenes([scene_tensors(scene)])
    places = token_places(batch.triangles_BT33, batch.is_triangle_BT, num_registers=0, eps=0)
    with torch.no_grad():
        sees = bundles_that_see(places, batch.cameras, resolution, base().patch_px)
    return 1 - float(sees.double().mean())


def _source_faces() -> dict[str, int]:
    """Return the triangles of each source that this machine has prepared, by its asset's digest."""
    faces = {}
    for path in cache_folder("assets").glob("*/*.safetensors"):
        data = path.read_bytes()
        faces[sha256_hex(data)] = decode_asset(data).source.num_faces
    return faces
