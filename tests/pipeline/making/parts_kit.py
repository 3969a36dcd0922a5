"""Datasets whose objects are frozen in parts, of objects and scenes that cost nothing."""

from pathlib import Path

import pytest

from pipeline.making import asked_objects, object_parts, pipeline
from pipeline.making.dataset_order import DatasetOrder
from pipeline.objects.listing import Listing
from pipeline.objects.sources import ListedObjects
from tests.pipeline.making.test_object_parts import Mesher, _records
from tests.pipeline.making.tiny_scenes_kit import tiny_order, without_rendering

PARTS = 2


def parts_by_hand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """Replace objects and pictures; the list fills with both in the order in which they are made.

    There are 60 objects in a folder.
    """
    order: list[object] = []
    accept, share = pipeline.accept_objects, pipeline.share_mesh_work
    without_rendering(monkeypatch, order.append)
    monkeypatch.setattr(pipeline, "accept_objects", accept)
    monkeypatch.setattr(pipeline, "share_mesh_work", share)
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path / "cache"))
    mesher = Mesher()
    monkeypatch.setattr(object_parts, "MeshWork", lambda settings, workers: mesher)
    records = _records(tmp_path / "objects", 60)
    listed = ListedObjects(
        source="by hand",
        listing=Listing(records=records, failures=[]),
        allowed=records,
        refused=[],
    )
    monkeypatch.setattr(asked_objects, "list_objects", lambda *asked, **more: listed)
    prepare = mesher.prepare

    def noted(records, done):  # type: ignore[no-untyped-def]
        order.extend(record.uid for record in records)
        return prepare(records, done)

    monkeypatch.setattr(mesher, "prepare", noted)
    return order


def parts_order(out: str, scenes: int) -> DatasetOrder:
    """Return an order whose first cycle of splits has six shards of four scenes."""
    changes: dict[str, float] = {"scenes.num_views": 2, "splits.object_parts": PARTS}
    changes["splits.shards_per_cycle"] = 6
    return tiny_order(out=out, objects="builtin:", scenes=scenes, changes=changes)
