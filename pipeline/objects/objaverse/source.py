"""`objaverse:`: objects of Objaverse 1.0 by uid, by a file of uids, or by LVIS category.

Files stay where the package `objaverse` keeps them, which other programs use too.
"""

import difflib
import functools
import gzip
import json
import os
import re
import zlib
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from pipeline.objects.licences import UNKNOWN, refuse_licences
from pipeline.objects.listing import Listing, failure, fetch_all
from pipeline.objects.local.folder import file_text
from storage.atomic import atomic_writer
from storage.errors import TrilightError
from storage.records.objects import Failure, ObjectRecord
from storage.remote.transfers import TransferFailed, download
from storage.remote.url import RemoteUrl, printable

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


_URL = RemoteUrl(
    what="objects",
    scheme="https",
    root="https://huggingface.co/datasets/allenai/objaverse/resolve/main",
)
_FOLDER = Path("~/.objaverse/hf-objaverse-v1")
_MOST_BYTES = 1 << 34
"""Largest file that is downloaded; the mesh stage has limits of its own."""
_PLACE = re.compile(r"glbs/[\w-]+/[\w-]+\.glb")


def _fetch_file(name: str) -> Path:
    """Return the local path of a file, downloaded whole if missing; raises TransferFailed."""
    path = _FOLDER.expanduser().absolute() / name
    if not path.is_file():
        with atomic_writer(path) as stream:
            download(_URL.child(name), stream, num_bytes=None, max_bytes=_MOST_BYTES)
    return path


def _read(name: str) -> Any:
    """Return the content of a metadata file; an unreadable one is downloaded again once.

    Raises:
        TransferFailed: it cannot be downloaded, or is damaged there too.
    """
    for _ in range(2):
        path = _fetch_file(name)
        try:
            return json.loads(gzip.decompress(path.read_bytes()))
        except (OSError, EOFError, ValueError, zlib.error):
            path.unlink(missing_ok=True)
    raise TransferFailed("download_failed", "is damaged")


def _read_list(name: str) -> Any:
    """Return the content of a metadata file that every run needs."""
    try:
        return _read(name)
    except TransferFailed as error:
        raise TrilightError(
            f"objects objaverse: {name} cannot be downloaded ({error.message}); expected "
            "Objaverse to be reachable. Check the network and try again."
        ) from error


def list_objaverse(source: str, allowed: Sequence[str]) -> Listing:
    """Return the objects that a source names, with the rights from their annotations.

    A category with `:N` gives the first N of its uids, sorted, whose licence is in `allowed`; the
    refused ones before them are listed too. An object's present licence may differ: Objaverse froze
    its annotations.

    Raises:
        TrilightError: the source is malformed, a category is unknown, or the lists cannot be
            downloaded.
    """
    text = source.removeprefix(PREFIX).strip()
    count = None
    if text.startswith(_CATEGORY):
        names, count = _category_names(text.removeprefix(_CATEGORY), source)
        uids = _uids_of_categories(_read_list("lvis-annotations.json.gz"), names)
    else:
        uids = _uids(text, source)
    uids = sorted(set(uids))
    stated = _read_list("object-paths.json.gz")
    paths = {uid: stated[uid] for uid in uids if _PLACE.fullmatch(str(stated.get(uid)))}
    failures = [
        failure(f"objaverse/{uid}", "unknown_uid", "Objaverse 1.0 has no object of this uid")
        for uid in uids
        if uid not in paths
    ]
    records, lost = _records(paths, allowed, count)
    files = {f"objaverse/{uid}": path for uid, path in paths.items()}
    fetch = partial(fetch_all, fetch=lambda record: _fetch_file(files[record.uid]))
    return Listing(records=records, failures=[*failures, *lost], fetch=fetch)


def _records(
    paths: Mapping[str, str], allowed: Sequence[str], count: int | None
) -> tuple[list[ObjectRecord], list[Failure]]:
    """Read annotations, file by file as they are needed, until `count` licences are allowed."""

    @functools.cache
    def read_annotations(group: str) -> dict[str, Any] | TransferFailed:
        try:
            return dict(_read(f"metadata/{group}.json.gz"))
        except TransferFailed as error:
            return error

    records: list[ObjectRecord] = []
    failures: list[Failure] = []
    usable = 0
    for uid, path in paths.items():
        annotations = read_annotations(path.split("/")[1])
        if isinstance(annotations, TransferFailed):
            message = f"annotations: {annotations.message}"
            failures.append(failure(f"objaverse/{uid}", annotations.reason, message))
            continue
        record = _record(uid, annotations.get(uid) or {})
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
        uid=f"objaverse/{uid}",
        path="",
        title=title,
        licence=_LICENCES.get(_text(annotation, "license"), UNKNOWN),
        licence_source=f"Objaverse 1.0 annotations; object {published}",
        attribution=f"{title} by {author}" + (f" ({profile})" if profile else ""),
        source_url=_text(annotation, "viewerUrl"),
    )


def _text(row: dict[str, Any], field: str) -> str:
    value = row.get(field)
    return printable(value).strip() if isinstance(value, str) else ""


def _uids(text: str, source: str) -> list[str]:
    if _UIDS.fullmatch(text):
        return [uid.strip().lower() for uid in text.split(",")]
    path = Path(os.path.expanduser(text))
    if not text or not path.is_file():
        raise TrilightError(f"objects {printable(source)!r} names no file and no uid; {_FORMS}.")
    uids = []
    for number, line in enumerate(file_text(path).splitlines(), start=1):
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
