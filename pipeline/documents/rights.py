"""The licences of a dataset's objects, and the union of their duties."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from storage.licences import DUTIES, duties_of, licence_url, union_of_duties
from storage.markdown import code, table
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


def rights_markdown(rights: Rights) -> str:
    """Return the licences with their counts and duties, and the union of these."""
    rows = [
        (_licence_link(name), _duties(name), count)
        for name, count in rights.objects_by_licence.items()
    ]
    parts = [table(("licence", "asks for", "objects"), rows, numbers=1)]
    if rights.duties:
        parts.append("Users of the whole dataset have to keep all of these:")
        parts.append("\n".join(f"- **{duty}**: {DUTIES[duty]}" for duty in rights.duties))
    elif rights.licences and not rights.unknown:
        parts.append("None of them asks for anything.")
    if rights.unknown:
        names = ", ".join(code(name) for name in rights.unknown)
        parts.append(
            f"The duties of {names} are **not known here**: ask the maker of the dataset before "
            "you use or share it."
        )
    if "share-alike" in rights.duties:
        parts.append("No scene holds objects under two different share-alike licences.")
    parts.append("`attribution.csv` names the author of each object, and what was changed.")
    return "\n\n".join(parts)


def encode_licences(rights: Rights) -> bytes:
    """Return the file LICENSE.md."""
    head = (
        "# Licences of this dataset\n\nIts scenes are made of 3D objects, and perhaps of textures "
        "and environment maps, each under the licence of its author. This is a summary; the "
        "licences themselves decide."
    )
    return f"{head}\n\n{rights_markdown(rights)}\n".encode(errors="replace")


def _licence_link(licence: str) -> str:
    url = licence_url(licence)
    return f"[{code(licence)}]({url})" if url else code(licence)


def _duties(licence: str) -> str:
    duties = duties_of(licence)
    if duties is None:
        return "not known here"
    return ", ".join(duties) or "nothing"
