"""`objaverse:`: objects of Objaverse 1.0 by uid, by a file of uids, or by LVIS category."""

import dataclasses
import difflib
import os
import re
import threading
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from pipeline.objects.licences import UNKNOWN, refuse_licences
from pipeline.objects.listing import CountDone, Fetched, Listing, failure, fetch_all
from pipeline.objects.objaverse.package import ObjaversePackage
from storage.errors import TrilightError
from storage.records.objects import Failure, ObjectRecord
from storage.remote.retries import TransferFailed
from storage.remote.safe_url import printable

PREFIX = "objaverse:"
_CATEGORY = "category/"
_LICENCES = {
    "by": "CC-BY-4.0",
    "by-sa": "CC-BY-SA-4.0",
    "by-nc": "CC-BY-NC-4.0",
    "by-nd": "CC-BY-ND-4.0",
    "by-nc-sa": "CC-BY-NC-SA-4.0",
    "by-nc-nd": "CC-BY-NC-ND-4.0",
    "cc0": "CC0-1.0",
}
_UID = re.compile(r"[0-9a-f]{32}")
_UIDS = re.compile(r"\s*[0-9A-Fa-f]{32}(\s*,\s*[0-9A-Fa-f]{32})*\s*")
_DATE = re.compile(r"\d{4}-\d\d-\d\d")
_FORMS = (
    f"expected {PREFIX}UID[,UID...], {PREFIX}FILE with one uid per line, or "
    f"{PREFIX}{_CATEGORY}NAME[,NAME...][:N]"
)


def list_objaverse(source: str, allowed: Sequence[str]) -> Listing:
    """Return the objects that a source names, with the rights from their annotations.

    A category with `:N` gives the first N of its uids, sorted, whose licence is in `allowed`; the
    refused ones before them are listed too. An object's present licence may differ: Objaverse froze
    its annotations.

    Raises:
        TrilightError: the source is malformed, a category is unknown, the package is missing, or
            its lists cannot be downloaded.
    """
    text = source.removeprefix(PREFIX).strip()
    if text.startswith(_CATEGORY):
        names, count = _category_names(text.removeprefix(_CATEGORY), source)
        package = ObjaversePackage()
        uids = _uids_of_categories(package.categories(), names)
    else:
        uids = _uids(text, source)
        count = None
        package = ObjaversePackage()
    uids = sorted(set(uids))
    known = [uid for uid in uids if uid in package]
    failures = [
        failure(_name(uid), "unknown_uid", "Objaverse 1.0 has no object of this uid")
        for uid in uids
        if uid not in package
    ]
    records, lost = _records(package, known, allowed, count)
    return Listing(records=records, failures=[*failures, *lost], fetch=partial(_fetch, package))


def _records(
    package: ObjaversePackage, uids: list[str], allowed: Sequence[str], count: int | None
) -> tuple[list[ObjectRecord], list[Failure]]:
    """Read annotations, file by file as they are needed, until `count` licences are allowed."""
    group_of = {uid: group for group in package.groups(uids) for uid in group}
    known: dict[str, dict[str, Any]] = {}
    broken: dict[str, TransferFailed] = {}
    records: list[ObjectRecord] = []
    failures: list[Failure] = []
    usable = 0
    for uid in uids:
        if uid not in known and uid not in broken:
            group = group_of[uid]
            try:
                annotations = package.annotations(group)
                known |= {member: annotations.get(member) or {} for member in group}
            except TransferFailed as error:
                broken |= dict.fromkeys(group, error)
        if uid in broken:
            message = f"annotations: {broken[uid].message}"
            failures.append(failure(_name(uid), broken[uid].reason, message))
            continue
        record = _record(uid, known[uid])
        records.append(record)
        usable += len(refuse_licences([record], allowed)[0])
        if usable == count:
            break
    return records, failures


def _record(uid: str, annotation: dict[str, Any]) -> ObjectRecord:
    """Return the record of an object; its path is known after the download."""
    user = annotation.get("user")
    user = user if isinstance(user, dict) else {}
    title = _text(annotation, "name") or uid
    author = _text(user, "displayName") or _text(user, "username") or "an unknown author"
    profile = _text(user, "profileUrl")
    date = _DATE.match(_text(annotation, "publishedAt"))
    published = f"published {date[0]}" if date else "of unknown date"
    return ObjectRecord(
        uid=_name(uid),
        path="",
        title=title,
        licence=_LICENCES.get(_text(annotation, "license"), UNKNOWN),
        licence_source=f"Objaverse 1.0 annotations; object {published}",
        attribution=f"{title} by {author}" + (f" ({profile})" if profile else ""),
        source_url=_text(annotation, "viewerUrl"),
    )


def _fetch(
    package: ObjaversePackage, records: list[ObjectRecord], downloaded: CountDone
) -> Fetched:
    def fetch(record: ObjectRecord) -> ObjectRecord:
        path = package.fetch(record.uid.removeprefix(_name("")))
        return dataclasses.replace(record, path=str(path))

    return fetch_all(records, fetch, downloaded, threads=1, stop=threading.Event())


def _name(uid: str) -> str:
    return f"objaverse/{uid}"


def _text(row: dict[str, Any], field: str) -> str:
    value = row.get(field)
    return printable(value).strip() if isinstance(value, str) else ""


def _uids(text: str, source: str) -> list[str]:
    if _UIDS.fullmatch(text):
        return [uid.strip().lower() for uid in text.split(",")]
    path = Path(os.path.expanduser(text))
    if not text or not path.is_file():
        raise TrilightError(f"objects {printable(source)!r} names no file and no uid; {_FORMS}.")
    try:
        lines = path.read_bytes().decode("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise TrilightError(
            f"{printable(path.name)}: cannot be read; expected UTF-8 text with one uid per line."
        ) from error
    uids = []
    for number, line in enumerate(lines, start=1):
        uid = line.partition("#")[0].strip().lower()
        if uid and not _UID.fullmatch(uid):
            raise TrilightError(
                f"{printable(path.name)}:{number}: got {printable(uid)[:80]!r}; expected a uid of "
                "32 hexadecimal digits, or a comment after #."
            )
        uids += [uid] if uid else []
    if not uids:
        raise TrilightError(f"{printable(path.name)}: holds no uid; expected one per line.")
    return uids


def _category_names(text: str, source: str) -> tuple[list[str], int | None]:
    """Split `NAME[,NAME...][:N]`."""
    listed, colon, digits = text.partition(":")
    names = [name.strip() for name in listed.split(",")]
    number = int(digits) if digits.isascii() and digits.isdigit() and len(digits) <= 9 else 0
    if not all(names) or (colon and number < 1):
        raise TrilightError(
            f"objects {printable(source)!r} is malformed; {_FORMS} with N of at least 1."
        )
    return names, number if colon else None


def _uids_of_categories(categories: dict[str, list[str]], names: list[str]) -> list[str]:
    uids: list[str] = []
    for name in names:
        if name not in categories:
            close = difflib.get_close_matches(name, categories, n=5, cutoff=0.5)
            meant = f"Did you mean {', '.join(close)}?" if close else "See the LVIS categories."
            raise TrilightError(
                f"objects {PREFIX}{_CATEGORY}{printable(name)}: there is no such category; "
                f"expected one of {len(categories)} LVIS categories. {printable(meant)}"
            )
        uids += categories[name]
    return uids
