"""The licences of a dataset's objects, and the union of their duties."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from pipeline.documents.pages import render_markdown
from storage.licences import DUTIES, duties_of, licence_url, union_of_duties
from storage.records.objects import LockedObject

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


@dataclass(frozen=True, kw_only=True)
class Rights:
    """The licences of a dataset's objects."""

    objects_by_licence: Mapping[str, int]
    """Number of objects, textures and maps by licence, sorted by its name."""

    @property
    def licences(self) -> list[str]:
        return list(self.objects_by_licence)

    @property
    def duties(self) -> tuple[str, ...]:
        """Union of the licences' duties, as keys of storage.licences.DUTIES."""
        return union_of_duties(self.licences)

    @property
    def unknown(self) -> list[str]:
        """Licences whose duties are unknown."""
        return [name for name in self.licences if duties_of(name) is None]


def rights_of(objects: Iterable[LockedObject]) -> Rights:
    """Count the licences of objects."""
    counts = Counter(entry.licence for entry in objects)
    return Rights(objects_by_licence=dict(sorted(counts.items())))


def hub_licence(rights: Rights, *, link: str) -> dict[str, str]:
    """Return the licence fields of the front matter of a Hugging Face card.

    Args:
        rights: rights to the objects; without objects the result is empty.
        link: file with details, unless there is only one licence and Hugging Face knows it.
    """
    if not rights.licences:
        return {}
    if len(rights.licences) > 1:
        return {"license": "other", "license_name": "mixed-object-licences", "license_link": link}
    name = rights.licences[0].casefold()
    if name in _HUB_LICENCES or name in _HUB_SPELLING:
        return {"license": _HUB_SPELLING.get(name, name)}
    slug = re.sub(r"[^a-z0-9.-]+", "-", name).strip("-")
    return {"license": "other", "license_name": slug or "unnamed", "license_link": link}


def licence_facts(rights: Rights) -> dict[str, object]:
    """Return what `licences.jinja` shows."""
    return {
        "rights": rights,
        "licence_url": licence_url,
        "duties_of": duties_of,
        "duty_texts": DUTIES,
    }


def encode_licences(rights: Rights) -> bytes:
    """Return the file LICENSE.md."""
    return render_markdown("license.jinja", **licence_facts(rights))
