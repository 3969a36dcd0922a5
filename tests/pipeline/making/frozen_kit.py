"""Datasets with frozen objects that no mesh stage has made: assets by hand in a store."""

import dataclasses
import functools
import hashlib
from collections.abc import Sequence
from pathlib import Path

from pipeline.assets.stage import PreparedAsset
from pipeline.builds.named import named_build
from pipeline.builds.settings import BuildSettings
from pipeline.making.asked_objects import AskedObjects
from pipeline.making.begin_publication import begin
from pipeline.making.freeze_objects import AcceptedObjects, freeze_objects
from pipeline.making.object_batches import prepared_object
from pipeline.making.prepare_isolated import asset_store
from pipeline.making.publication import Publication
from storage.dataset.layout import DatasetFolder
from storage.digests import sha256_hex
from storage.records.asset import encode_asset
from storage.records.objects import ObjectRecord
from tests.pipeline.making.test_publication import ENVIRONMENT
from tests.pipeline.scenes.small_pool import small_pool

LICENCES = ("CC0-1.0", "CC-BY-SA-4.0", "CC-BY-4.0", "CC-BY-SA-3.0")
SOURCE = "objects-by-hand"


def build() -> BuildSettings:
    """Return a small build."""
    return named_build("smoke", resolution=16)


_pool = functools.cache(small_pool)


def prepared(number: int) -> PreparedAsset:
    """Put an object of its own geometry into the store; return it as the mesh stage would."""
    asset, uid = _pool()[number % 5].asset, f"object {number:05d}"
    name = hashlib.sha256(uid.encode()).hexdigest()
    data = encode_asset(dataclasses.replace(asset, geometry_sha256=name, source_sha256=name))
    path = asset_store().asset_path(name[:32])
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    record = ObjectRecord(
        uid=uid,
        title=f"\N{GREEK SMALL LETTER ALPHA} {number}",
        licence=LICENCES[number % len(LICENCES)],
        licence_source="tests",
        attribution="",
        source_url="",
        path="",
    )
    return PreparedAsset(
        record=record, path=path, asset_sha256=sha256_hex(data), geometry_sha256=name
    )


def begun(root: Path) -> Publication:
    """Begin a dataset of four scenes."""
    return begin(DatasetFolder(root), build(), ENVIRONMENT, 4, accept_environment=False)


def asked(
    publication: Publication, source: str = SOURCE, licence: str | None = None
) -> AskedObjects:
    """Return what is asked for of objects."""
    return AskedObjects(
        source=source, licence=licence, settings=build(), publication=publication, workers=1
    )


def frozen(publication: Publication, objects: Sequence[PreparedAsset]) -> AcceptedObjects:
    """Freeze objects, as after the mesh stage."""
    return freeze_objects(asked(publication), [*map(prepared_object, objects)], [], len(objects))
