"""The user's frozen textures and maps of a split, as scenes draw from them."""

from collections.abc import Iterable
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.objects.maps.prepared import decode_prepared
from scene_templates.user_maps import OwnMaps, UserMap, UserTexture
from storage.records.objects import SKY, TEXTURE, LockedObject
from storage.records.texture import MapSource


def user_maps(rows: Iterable[tuple[LockedObject, Path]], split: str) -> OwnMaps:
    """Return the maps that scenes of a split may use, sorted by uid; no file is read yet.

    Args:
        rows: rows of a lock with the prepared files; objects among them are left out.
        split: train, validation or test.
    """
    of_split = sorted(
        ((locked, path) for locked, path in rows if locked.split == split),
        key=lambda pair: pair[0].uid,
    )
    return OwnMaps(
        textures=[
            UserMap(uid=locked.uid, source=_source(locked), load=partial(_texture, path))
            for locked, path in of_split
            if locked.kind == TEXTURE
        ],
        skies=[
            UserMap(uid=locked.uid, source=_source(locked), load=partial(_radiance, path))
            for locked, path in of_split
            if locked.kind == SKY
        ],
    )


def _source(locked: LockedObject) -> MapSource:
    return MapSource(
        name=locked.title,
        licence=locked.licence,
        attribution=locked.attribution,
        source_url=locked.source_url,
    )


def _texture(path: Path) -> UserTexture:
    arrays = decode_prepared(path.read_bytes(), path.name).arrays
    return UserTexture(
        diffuse_rgb=arrays["diffuse"],
        specular_rgb=arrays["specular"],
        roughness=arrays.get("roughness"),
    )


def _radiance(path: Path) -> NDArray[np.float32]:
    return decode_prepared(path.read_bytes(), path.name).arrays["radiance"]
