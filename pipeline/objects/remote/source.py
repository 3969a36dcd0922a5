"""Objects of a remote folder: listed, then fetched to the cache that all datasets share."""

import dataclasses
from functools import partial
from pathlib import Path

from pipeline.objects.licences import StatedLicence, require_unstated, stated_licence
from pipeline.objects.listing import (
    CountDone,
    Fetched,
    Listing,
    assign_uids,
    failure,
    fetch_all,
    is_object_file,
)
from pipeline.objects.local.catalogue import CATALOGUE_NAMES, only_catalogue, read_catalogue
from pipeline.objects.local.folder import file_record
from pipeline.objects.remote.files import RemoteFiles
from pipeline.objects.remote.folder import RemoteFolder
from pipeline.objects.selection import drop_copies, drop_outputs, say_unread
from storage.cache import cache_folder
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.records.objects import Failure, ObjectRecord
from storage.remote.safe_url import printable, safe_url
from storage.remote.tries import TransferFailed
from storage.remote.url import RemoteUrl

MAX_BYTES = 200_000_000
"""Largest object that is fetched, with its buffers: what the mesh stage reads at most."""
THREADS = 8


def list_remote(url: RemoteUrl, licence: str | None) -> Listing:
    """Return the objects of a remote folder: those of its catalogue, or else its object files.

    Only the catalogue is fetched here. The objects go to the cache when they are fetched, where
    they are found again: one that is there is fetched anew only when the server says that it
    changed.

    Args:
        url: the folder.
        licence: of files without a statement, as the user states it.

    Raises:
        TrilightError: a driver is missing, the folder cannot be read or listed or holds no object,
            its catalogue is wrong, or has a licence stated from outside.
    """
    folder = RemoteFolder(url)
    place = cache_folder("objects") / sha256_hex(url.display_url.encode())[:32]
    files = RemoteFiles(folder, place, MAX_BYTES)
    catalogue = only_catalogue(folder.has)
    failures: list[Failure] = []
    if catalogue is not None:
        require_unstated(licence, catalogue)
        records = _catalogued(folder, files, catalogue)
    else:
        records, failures = _uncatalogued(folder, files, stated_licence(licence))
    return Listing(records=records, failures=failures, fetch=partial(_fetch, folder, files))


def _catalogued(folder: RemoteFolder, files: RemoteFiles, catalogue: str) -> list[ObjectRecord]:
    try:
        records = read_catalogue(files.fetch(catalogue))
    except TransferFailed as error:
        raise TrilightError(
            f"objects {folder.url.display_url!r}: {catalogue} cannot be read ({error.message}); "
            "expected "
            "it to be fetched. Try again, or check your access to it."
        ) from error
    return [
        dataclasses.replace(
            record, source_url=record.source_url or _shown(folder, _name(files, record))
        )
        for record in records
    ]


def _uncatalogued(
    folder: RemoteFolder, files: RemoteFiles, licence: StatedLicence
) -> tuple[list[ObjectRecord], list[Failure]]:
    names = folder.names()
    for catalogue in set(CATALOGUE_NAMES) & set(names):
        # it would rule, so that going on without it could use what it forbids
        raise TrilightError(
            f"objects {folder.url.display_url!r}: {catalogue} is listed but cannot be fetched; "
            "expected "
            "a readable catalogue. Check your access to it."
        )
    names = drop_outputs(names)
    objects = [name for name in names if is_object_file(name)]
    say_unread(names, objects)
    uids, failures = assign_uids(drop_copies(objects))
    records = []
    for name, uid in uids.items():
        try:
            path = str(files.path(name))
        except TransferFailed as error:
            failures.append(failure(uid, error.reason, error.message))
            continue
        records.append(file_record(uid, path, licence, source_url=_shown(folder, name)))
    return records, failures


def _fetch(
    folder: RemoteFolder, files: RemoteFiles, records: list[ObjectRecord], downloaded: CountDone
) -> Fetched:
    def fetch(record: ObjectRecord) -> ObjectRecord:
        name = _name(files, record)
        try:
            return dataclasses.replace(record, path=str(files.fetch_object(name)))
        except TransferFailed as error:
            message = f"{_shown(folder, name)}: {error.message}"
            raise TransferFailed(error.reason, message) from error

    return fetch_all(records, fetch, downloaded, threads=THREADS, stop=files.stop)


def _name(files: RemoteFiles, record: ObjectRecord) -> str:
    return Path(record.path).relative_to(files.files).as_posix()


def _shown(folder: RemoteFolder, name: str) -> str:
    address = folder.address(name)
    return printable(
        safe_url(address if folder.url.is_http else f"{folder.url.scheme}://{address}")
    )
