"""One row per object of an asset folder: what `trilight assets` says of it, to people and programs.

The rows of the accepted objects are a catalogue (`objects.jsonl`), so that the folder is itself a
source of objects.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any

from storage.records.asset import LevelQuality, SourceFacts


@dataclass(frozen=True, kw_only=True)
class AssetRow:
    """An accepted object."""

    uid: str
    """As in ObjectRecord."""
    path: str
    """Its mesh, below the folder."""
    title: str
    """For people."""
    licence: str
    """SPDX identifier, or `LicenseRef-...`."""
    licence_source: str
    """Where the licence is stated."""
    attribution: str
    """Whom to name."""
    source_url: str
    """Where the object came from."""
    num_faces: int
    """Triangles of the mesh."""
    method: str
    """How it was made; `source` where nothing had to be left out."""
    quality: LevelQuality
    """How it compares with the source."""
    source: SourceFacts
    """What the file held."""

    def as_json(self) -> dict[str, Any]:
        """Return the row as JSON values, with the two judgements that readers ask for."""
        row = dataclasses.asdict(self)
        row["repaired"] = self.source.repaired
        row["source"]["watertight"] = self.source.watertight
        return row
