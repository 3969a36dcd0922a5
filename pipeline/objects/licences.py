"""Which objects may enter a dataset by their licence: an allow-list, so that silence refuses."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

from pipeline.objects.listing import failure
from storage.errors import TrilightError
from storage.records.objects import Failure, ObjectRecord
from storage.remote.safe_url import printable

USER_PROVIDED = "LicenseRef-user-provided"
"""Licence of files that a user names without a catalogue; we assume that they may use them."""

UNKNOWN = "LicenseRef-unknown"
"""Licence of objects whose source states none."""

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
"""SPDX identifiers that permit derived and commercial use; attribution and share-alike are kept
with the object. Not here: unknown, non-commercial (NC) and no-derivatives (ND) licences."""

BY_USER = "stated by the user (--licence)"
"""The licence source recorded for `--licence`."""

_IDENTIFIER = re.compile(r"[A-Za-z0-9.+-]{1,64}")
_COMPOUND = re.compile(r"(?i)\s(?:AND|OR|WITH)\s")
_EXPECTED = (
    "expected an SPDX identifier such as CC-BY-4.0, or LicenseRef-NAME: at most 64 letters, "
    "digits, dots, + and -"
)


@dataclass(frozen=True, kw_only=True)
class StatedLicence:
    """The licence of files that come without a statement of their own."""

    licence: str
    """SPDX identifier, or `LicenseRef-...`."""
    licence_source: str
    """Where the licence is stated."""


def stated_licence(licence: str | None) -> StatedLicence:
    """Return what holds for files without a statement: what the user says, or an assumption.

    Raises:
        TrilightError: `licence` does not have the form of an identifier.
    """
    if licence is None:
        return StatedLicence(licence=USER_PROVIDED, licence_source="assumed: the user's own files")
    if not _IDENTIFIER.fullmatch(licence):
        raise TrilightError(f"--licence is {printable(licence)!r}; {_EXPECTED}.")
    return StatedLicence(licence=licence, licence_source=BY_USER)


def require_unstated(licence: str | None, source: str) -> None:
    """Raise TrilightError where a user states a licence for a source that states its own."""
    if licence is not None:
        raise TrilightError(
            f"--licence is {printable(licence)!r}, but {source} states the licence of every "
            "object; expected it only for files without a statement. Leave it out; a catalogue "
            "has the column licence for it."
        )


def check_allowed(allowed: Sequence[str]) -> None:
    """Raise TrilightError for an entry of the allow-list that no licence can ever equal.

    Compound expressions such as `MIT OR Apache-2.0` are not looked into.
    """
    for name in allowed:
        if not _allowable(name):
            raise TrilightError(f"--allow-licence has {printable(name)!r}; {_EXPECTED}.")


def refuse_licences(
    records: Sequence[ObjectRecord], allowed: Sequence[str]
) -> tuple[list[ObjectRecord], list[Failure]]:
    """Return the records with an allowed licence, in order, and a failure for each other one.

    Identifiers are compared without regard to case, as SPDX asks. Compound expressions such as
    `MIT OR Apache-2.0` are not taken apart: they are allowed when listed as they stand.
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
