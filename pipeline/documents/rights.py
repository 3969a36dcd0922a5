"""Licences of a dataset's objects as Hugging Face names them, and `attribution.csv`.

That file has the authors, licences and changes of all objects, textures and maps.
"""

import csv
import io
import re
from collections.abc import Collection, Iterable, Mapping
from types import MappingProxyType
from typing import Any

from storage.dataset.manifest import derivation_of
from storage.markdown import inert
from storage.records.asset import AssetRow
from storage.records.objects import OBJECT, SKY, TEXTURE, LockedObject

_HUB_LICENCES = frozenset(
    "0bsd apache-2.0 bsd-2-clause bsd-3-clause cc-by-2.0 cc-by-2.5 cc-by-3.0 cc-by-4.0 "
    "cc-by-nc-2.0 cc-by-nc-3.0 cc-by-nc-4.0 cc-by-nc-nd-3.0 cc-by-nc-nd-4.0 cc-by-nc-sa-2.0 "
    "cc-by-nc-sa-3.0 cc-by-nc-sa-4.0 cc-by-nd-4.0 cc-by-sa-3.0 cc-by-sa-4.0 cc0-1.0 "
    "cdla-permissive-1.0 cdla-permissive-2.0 cdla-sharing-1.0 isc mit mpl-2.0 unlicense".split()
)
"""SPDX identifiers that Hugging Face knows in lower case."""
_HUB_SPELLING: Mapping[str, str] = {
    "odbl-1.0": "odbl",
    "odc-by-1.0": "odc-by",
    "pddl-1.0": "pddl",
    **{f"{name}-{kind}": name for name in ("gpl-2.0", "gpl-3.0", "lgpl-2.1", "lgpl-3.0", "agpl-3.0")
       for kind in ("only", "or-later")},
}  # fmt: skip
"""Identifiers that Hugging Face spells differently."""


_COLUMNS = ("uid", "title", "licence", "licence_source", "attribution", "source_url", "changes")
_REMESHED = "cleaned, remeshed and given new materials"
_OF_KIND = {
    TEXTURE: "resampled, and laid on other surfaces",
    SKY: "resampled, turned, and scaled in strength",
}
"""Changes to textures and maps, by kind."""
_AS_IN_FILE = "rendered as its scene file says"
"""Changes to the meshes of scene files."""


def hub_licence(licences: Collection[str], *, link: str) -> dict[str, str]:
    """Return the licence fields of the front matter of a Hugging Face card.

    Args:
        licences: licences of the objects; without objects the result is empty.
        link: file with details, unless there is only one licence and Hugging Face knows it.
    """
    if not licences:
        return {}
    if len(licences) > 1:
        return {"license": "other", "license_name": "mixed-object-licences", "license_link": link}
    name = next(iter(licences)).casefold()
    if name in _HUB_LICENCES or name in _HUB_SPELLING:
        return {"license": _HUB_SPELLING.get(name, name)}
    slug = re.sub(r"[^a-z0-9.-]+", "-", name).strip("-")
    return {"license": "other", "license_name": slug or "unnamed", "license_link": link}


def encode_attribution(
    objects: Iterable[LockedObject | AssetRow],
    settings: Mapping[str, Any] = MappingProxyType({}),
) -> bytes:
    """Return the file: one row per object, sorted by uid, with the changes made to it.

    Args:
        settings: settings of the dataset, which decide the changes.
    """
    changes = " or ".join(sorted(_changes(settings)))
    stream = io.StringIO(newline="")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for entry in sorted(objects, key=lambda row: row.uid):
        rights = (entry.licence, entry.licence_source, entry.attribution, entry.source_url)
        done = _OF_KIND.get(getattr(entry, "kind", OBJECT), changes)
        writer.writerow([inert(cell) for cell in (entry.uid, entry.title, *rights, done)])
    # a lone surrogate, which JSON from outside may hold, has no UTF-8
    return stream.getvalue().encode(errors="replace")


def _changes(settings: Mapping[str, Any]) -> set[str]:
    if derivation := derivation_of(settings):
        return set().union(*(_changes(source["settings"]) for source in derivation.sources))
    from_files = settings.get("splits", {}).get("listed_scenes") is not None
    return {_AS_IN_FILE if from_files else _REMESHED}
