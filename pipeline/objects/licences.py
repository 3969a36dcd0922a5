"""Which objects may enter a dataset by their licence: an allow-list, so that silence refuses."""

from collections.abc import Sequence

from storage.records import Failure, ObjectRecord

USER_PROVIDED = "LicenseRef-user-provided"
"""Of files that a user names without a catalogue: theirs to use, as far as we can know."""

UNKNOWN = "LicenseRef-unknown"
"""Of catalogue rows that state no licence."""

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


def refuse_licences(
    records: Sequence[ObjectRecord], allowed: Sequence[str]
) -> tuple[list[ObjectRecord], list[Failure]]:
    """Return the records with an allowed licence, in order, and a failure for each other one.

    Identifiers are compared without regard to case, as SPDX asks. Compound expressions such as
    `MIT OR Apache-2.0` are not taken apart: they are allowed when listed as they stand.
    """
    names = {name.casefold() for name in allowed}
    kept = [record for record in records if record.licence.casefold() in names]
    refused = [
        Failure(
            stage="objects",
            item=record.uid,
            reason="licence_refused",
            message=f"licence {record.licence} is not on the allow-list; if you may use the "
            f"object, add --allow-licence '{record.licence}'",
        )
        for record in records
        if record.licence.casefold() not in names
    ]
    return kept, refused
