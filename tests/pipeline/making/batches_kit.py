"""Objects that cost nothing: files by hand, and what stands for the mesh stage."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.assets.stage import PreparedAsset
from pipeline.making import object_batches
from storage.records.objects import Failure, ObjectRecord
from tests.pipeline.making.frozen_kit import prepared


class Mesher:
    """Stands for the mesh stage: counts what it prepares, and fails where a test says so."""

    def __init__(self) -> None:
        self.made: Counter[str] = Counter()
        self.reasons: dict[str, str] = {}
        self.before_each: Callable[[str], None] = lambda uid: None

    def prepare(
        self, records: list[ObjectRecord], done: Callable[[], None]
    ) -> tuple[list[PreparedAsset], list[Failure]]:
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
                assets.append(PreparedAsset(**made))
            done()
        return assets, failures

    def __enter__(self) -> "Mesher":
        return self

    def __exit__(self, *error: object) -> None:
        """Hold nothing."""


def use_mesher(monkeypatch: pytest.MonkeyPatch, *, batch: int) -> Mesher:
    """Replace the mesh stage, with batches of so many objects and short pauses."""
    mesher = Mesher()
    monkeypatch.setattr(object_batches, "_NUM_OBJECTS", batch)
    monkeypatch.setattr(object_batches, "_PAUSES_S", (0.001, 0.05))
    monkeypatch.setattr(object_batches, "MeshWork", lambda settings, workers: mesher)
    return mesher


def object_records(folder: Path, count: int = 30, suffix: str = ".ply") -> list[ObjectRecord]:
    """Return records of objects, whose files are written where they are missing."""
    folder.mkdir(parents=True, exist_ok=True)
    records = []
    for number in range(count):
        path = folder / f"object {number:05d}{suffix}"
        if not path.exists():
            path.write_text(str(number))
        records.append(
            ObjectRecord(
                uid=path.stem, title="", licence="MIT", licence_source="tests",
                attribution="", source_url="", path=str(path),
            )
        )  # fmt: skip
    return records
