"""Duties of each license; no other module states them.

A licence is an SPDX identifier. What is not known here (`LicenseRef-...`, expressions such as
`MIT OR Apache-2.0`) is said to be unknown, never guessed. This is a summary for people who choose
and share data; the licences themselves decide.
"""

import re
from collections.abc import Iterable, Mapping

DUTIES: Mapping[str, str] = {
    "attribution": "name the authors as attribution.csv does",
    "changes": "say that the objects were changed; attribution.csv says how",
    "notice": "pass on the copyright notice and the text of the licence",
    "share-alike": "share what you make of these scenes under the same licence",
    "non-commercial": "do not use them for commercial purposes",
    "no-derivatives": "adaptations may not be shared, and these scenes are adaptations",
}
"""Everything that a licence may ask for, with what it means here, in the order of documents."""

_SHARED_CODE = ("changes", "notice", "share-alike")

_BY_DUTIES: Mapping[tuple[str, ...], str] = {
    (): "0BSD CC-PDDC CC0-1.0 MIT-0 PDDL-1.0 Unlicense",
    ("notice",): ("BSD-2-Clause BSD-3-Clause CDLA-Permissive-1.0 CDLA-Permissive-2.0 ISC MIT"),
    ("changes", "notice"): "Apache-2.0",
    ("attribution", "notice"): "ODC-By-1.0",
    ("attribution", "notice", "share-alike"): "ODbL-1.0",
    ("attribution", *_SHARED_CODE): "CDLA-Sharing-1.0 LAL-1.3",
    _SHARED_CODE: (
        "AGPL-3.0-only AGPL-3.0-or-later GPL-2.0-only GPL-2.0-or-later GPL-3.0-only "
        "GPL-3.0-or-later LGPL-2.1-only LGPL-2.1-or-later LGPL-3.0-only LGPL-3.0-or-later MPL-2.0"
    ),
}
_KNOWN = {name: duties for duties, names in _BY_DUTIES.items() for name in names.split()}
_BY_FOLDED = {name.casefold(): name for name in _KNOWN}

_CREATIVE_COMMONS = re.compile(
    r"CC-(BY|SA|NC|BY-SA|BY-NC|BY-ND|BY-NC-SA|BY-NC-ND)-[1-4]\.[015](-[A-Z]{2,4})?",
    re.IGNORECASE,
)
_ELEMENTS: Mapping[str, tuple[str, ...]] = {
    "BY": ("attribution", "changes"),
    "SA": ("share-alike",),
    "NC": ("non-commercial",),
    "ND": ("no-derivatives",),
}


def duties_of(licence: str) -> tuple[str, ...] | None:
    """Return the keys of DUTIES that a licence asks for, in their order; None where unknown.

    Identifiers are compared without regard to case, as SPDX asks.
    """
    if match := _CREATIVE_COMMONS.fullmatch(licence):
        parts = match[1].upper().split("-")
        duties = {duty for part in parts for duty in _ELEMENTS[part]}
    elif licence.casefold() in _BY_FOLDED:
        duties = set(_KNOWN[_BY_FOLDED[licence.casefold()]])
    else:
        return None
    return tuple(duty for duty in DUTIES if duty in duties)


def union_of_duties(licences: Iterable[str]) -> tuple[str, ...]:
    """Return what several licences ask for together; unknown ones add nothing."""
    duties = {duty for licence in licences for duty in duties_of(licence) or ()}
    return tuple(duty for duty in DUTIES if duty in duties)


def share_alike_camp(licence: str) -> str:
    """Return a name that two licences share only if they are the same share-alike licence.

    Works under two such licences must not meet in one scene: it could be shared under neither.
    Versions and ports count as different. The name is empty for every other licence, unknown ones
    among them: what they ask for is for the user to judge.
    """
    return licence.casefold() if "share-alike" in (duties_of(licence) or ()) else ""


def mixed_share_alike(licences: Iterable[str]) -> list[str]:
    """Return the share-alike licences among those of one scene where they are more than one."""
    by_camp = {share_alike_camp(licence): licence for licence in licences}
    by_camp.pop("", None)
    return sorted(by_camp.values()) if len(by_camp) > 1 else []


def licence_url(licence: str) -> str | None:
    """Return the address of a known licence's text at SPDX; None where it is unknown."""
    if _CREATIVE_COMMONS.fullmatch(licence):
        return f"https://spdx.org/licenses/{licence.upper()}.html"
    name = _BY_FOLDED.get(licence.casefold())
    return f"https://spdx.org/licenses/{name}.html" if name else None
