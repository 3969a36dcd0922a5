"""The licence check of objects: an allow-list, so that an unknown licence is refused."""

import re
from collections.abc import Sequence

from pipeline.objects.listing import failure
from storage.errors import TrilightError
from storage.records.objects import Failure, ObjectRecord
from storage.remote.url import printable

USER_PROVIDED = "LicenseRef-user-provided"
"""Licence of files that a user names without a catalogue; their use is assumed to be allowed."""

UNKNOWN = "LicenseRef-unknown"
"""Licence of objects whose source states no licence."""

DEFAULT_ALLOWED: tuple[str, ...] = (
    "CC0-1.0",
    "CC-PDDC",
    "PDDL-1.0",
    "Unlicense",
    "CC-BY-2.0",
    "CC-BY-2.5",
    "CC-BY-3.0",
    "CC-BY-4.0",
    "CC-BY-SA-3.0",
    "CC-BY-SA-4.0",
    "ODC-By-1.0",
    "MIT",
    "MIT-0",
    "BSD-2-Clause",
    "BSD-3-Clause",
    "Apache-2.0",
    USER_PROVIDED,
)
"""SPDX identifiers that permit derived and commercial use; attribution and share-alike stay with
the object. Unknown, non-commercial (NC) and no-derivatives (ND) licences are absent."""

BY_USER = "stated by the user (--licence)"
"""The licence source recorded for `--licence`."""

_IDENTIFIER = re.compile(r"[A-Za-z0-9.+-]{1,64}")
_COMPOUND = re.compile(r"(?i)\s(?:AND|OR|WITH)\s")
_EXPECTED = (
    "expected an SPDX identifier such as CC-BY-4.0, or LicenseRef-NAME: at most 64 letters, "
    "digits, dots, + and -"
)


def stated_licence(licence: str | None) -> dict[str, str]:
    """Return the fields of an `ObjectRecord` for the licence of files without a statement.

    `licence` is the user's; without one, it is assumed.

    Raises:
        TrilightError: `licence` does not have the form of an identifier.
    """
    if licence is None:
        return {"licence": USER_PROVIDED, "licence_source": "assumed: the user's own files"}
    if not _IDENTIFIER.fullmatch(licence):
        raise TrilightError(f"--licence is {printable(licence)!r}; {_EXPECTED}.")
    return {"licence": licence, "licence_source": BY_USER}


def require_unstated(licence: str | None, source: str) -> None:
    """Raise TrilightError for a user's licence of a source that states its licences."""
    if licence is not None:
        raise TrilightError(
            f"--licence is {printable(licence)!r}, but {source} states the licence of every "
            "object; expected it only for files without a statement. Leave it out; a catalogue "
            "has the column licence for it."
        )


def check_allowed(allowed: Sequence[str]) -> None:
    """Raise TrilightError for an entry of the allow-list that no licence can equal.

    Compound expressions such as `MIT OR Apache-2.0` are not parsed.
    """
    for name in allowed:
        if not _allowable(name):
            raise TrilightError(f"--allow-licence has {printable(name)!r}; {_EXPECTED}.")


def refuse_licences(
    records: Sequence[ObjectRecord], allowed: Sequence[str]
) -> tuple[list[ObjectRecord], list[Failure]]:
    """Return the records with an allowed licence, in order, and a failure for each other one.

    The comparison ignores case, as SPDX demands. Compound expressions such as `MIT OR Apache-2.0`
    are not parsed: they are allowed where the list holds the same expression.
    """
    names = {name.casefold() for name in allowed}
    allowed_records = [record for record in records if record.licence.casefold() in names]
    refused = [
        failure(record.uid, "licence_refused", _refusal(record.licence))
        for record in records
        if record.licence.casefold() not in names
    ]
    return allowed_records, refused


def _refusal(licence: str) -> str:
    if _allowable(licence):
        return (
            f"licence {licence} is not on the allow-list; if you may use the object, add "
            f"--allow-licence '{licence}'"
        )
    return f"licence {licence!r} is no identifier; {_EXPECTED}, in the catalogue"


def _allowable(name: str) -> bool:
    return bool(_IDENTIFIER.fullmatch(name) or _COMPOUND.search(name))
