"""Objects that no mesh stage has made: files and assets by hand, and what stands for the stage."""

import contextlib
import dataclasses
import functools
import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from pipeline.assets.stage import PreparedObject
from pipeline.generation import object_batches
from pipeline.generation.dataset_writer import DatasetWriter
from pipeline.generation.freeze_objects import AcceptedMaps, ObjectLock
from pipeline.generation.prepare_isolated import asset_store
from pipeline.generation.scene_origins import AcceptedObjects
from storage.digests import sha256_hex
from storage.records.asset import encode_asset
from storage.records.objects import Failure, ObjectRecord
from tests.pipeline.generation.test_dataset_writer import _build
from tests.pipeline.scenes.small_pool import small_pool

LICENCES = ("CC0-1.0", "CC-BY-SA-4.0", "CC-BY-4.0", "CC-BY-SA-3.0")
SOURCE = "objects-by-hand"
BUILD = _build()
_pool = functools.cache(small_pool)


def _record(uid: str, **stated: str) -> ObjectRecord:
    plain = {"title": "", "licence": "MIT", "attribution": "", "source_url": "", "path": ""}
    return ObjectRecord(uid=uid, licence_source="tests", **plain | stated)


def prepared(number: int) -> PreparedObject:
    """Put an object of its own geometry into the store; return it as the mesh stage would."""
    asset, uid = _pool()[number % 5].asset, f"object {number:05d}"
    name = hashlib.sha256(uid.encode()).hexdigest()
    data = encode_asset(dataclasses.replace(asset, geometry_sha256=name, source_sha256=name))
    path = asset_store().asset_path(name[:32])
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    title = f"\N{GREEK SMALL LETTER ALPHA} {number}"
    record = _record(uid, title=title, licence=LICENCES[number % len(LICENCES)])
    return PreparedObject(
        record=record,
        asset_name=name[:32],
        asset_sha256=sha256_hex(data),
        geometry_sha256=name,
        least_triangles=min(len(level.faces) for level in asset.levels),
    )


def asked(writer: DatasetWriter, source: str = SOURCE, licence: str | None = None) -> ObjectLock:
    """Return what is asked for of objects."""
    return ObjectLock(source=source, licence=licence, settings=BUILD, writer=writer)


def frozen(writer: DatasetWriter, objects: Sequence[PreparedObject]) -> AcceptedObjects:
    """Freeze objects, as after the mesh stage."""
    return asked(writer).freeze_prepared([*objects], [], len(objects), AcceptedMaps())


class Mesher:
    """Stands for the mesh stage: counts what it prepares, and fails where a test says so."""

    def __init__(self) -> None:
        self.made: Counter[str] = Counter()
        self.reasons: dict[str, str] = {}
        self.before_each: Callable[[str], None] = lambda uid: None

    def prepare(
        self, records: list[ObjectRecord], done: Callable[[], None]
    ) -> tuple[list[PreparedObject], list[Failure]]:
        assets, failures = [], []
        for record in records:
            self.before_each(record.uid)
            self.made[record.uid] += 1
            if reason := self.reasons.get(record.uid):
                failures.append(
                    Failure(stage="assets", item=record.uid, reason=reason, message="x")
                )
            else:
                made = vars(prepared(int(record.uid[7:]))) | {"record": record}
                assets.append(PreparedObject(**made))
            done()
        return assets, failures


def use_mesher(monkeypatch: pytest.MonkeyPatch, *, batch: int) -> Mesher:
    """Replace the mesh stage, with batches of so many objects and short pauses."""
    mesher = Mesher()
    monkeypatch.setattr(object_batches, "_NUM_OBJECTS", batch)
    monkeypatch.setattr(object_batches, "_PAUSES_S", (0.001, 0.05))
    stage = contextlib.nullcontext(mesher.prepare)
    monkeypatch.setattr(object_batches, "mesh_stage", lambda settings, workers: stage)
    return mesher


def object_records(folder: Path, count: int = 30, suffix: str = ".ply") -> list[ObjectRecord]:
    """Return records of objects, whose files are written where they are missing."""
    folder.mkdir(parents=True, exist_ok=True)
    records = []
    for number in range(count):
        path = folder / f"object {number:05d}{suffix}"
        if not path.exists():
            path.write_text(str(number))
        records.append(_record(path.stem, path=str(path)))
    return records
