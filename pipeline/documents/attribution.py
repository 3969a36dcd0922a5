"""`attribution.csv`: authors, licences and changes of all objects, textures and maps."""

import csv
import io
from collections.abc import Iterable, Mapping
from typing import Any

from storage.dataset.derived import derivation_of
from storage.markdown import inert
from storage.records.asset import AssetRow
from storage.records.objects import OBJECT, SKY, TEXTURE, LockedObject

_COLUMNS = ("uid", "title", "licence", "licence_source", "attribution", "source_url", "changes")
_REMESHED = "cleaned, remeshed and given new materials"
_OF_KIND = {
    TEXTURE: "resampled, and laid on other surfaces",
    SKY: "resampled, turned, and scaled in strength",
}
"""Changes to textures and maps, by kind."""
AS_IN_FILE = "rendered as its scene file says"
"""Changes to the meshes of scene files."""


def encode_attribution(
    objects: Iterable[LockedObject | AssetRow], *, changes: str = _REMESHED
) -> bytes:
    """Return the file: one row per object, sorted by uid, with the changes made to it."""
    stream = io.StringIO(newline="")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for entry in sorted(objects, key=lambda row: row.uid):
        rights = (entry.licence, entry.licence_source, entry.attribution, entry.source_url)
        done = _OF_KIND.get(getattr(entry, "kind", OBJECT), changes)
        writer.writerow([inert(cell) for cell in (entry.uid, entry.title, *rights, done)])
    # a lone surrogate, which JSON from outside may hold, has no UTF-8
    return stream.getvalue().encode(errors="replace")


def attribution_of(objects: Iterable[LockedObject], settings: Mapping[str, Any]) -> bytes:
    """Return the file of a dataset; its settings decide the changes made to objects."""
    return encode_attribution(objects, changes=" or ".join(sorted(_changes(settings))))


def _changes(settings: Mapping[str, Any]) -> set[str]:
    if derivation := derivation_of(settings):
        return set().union(*(_changes(source["settings"]) for source in derivation.sources))
    from_files = settings.get("splits", {}).get("listed_scenes") is not None
    return {AS_IN_FILE if from_files else _REMESHED}
