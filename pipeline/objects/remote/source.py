"""Objects of a remote folder: listed, then downloaded to the cache that all datasets share."""

import dataclasses
from functools import partial
from pathlib import Path

from pipeline.objects.licences import StatedLicence, require_unstated, stated_licence
from pipeline.objects.listing import CountDone, Fetched, Listing, fetch_all
from pipeline.objects.local.catalogue import CATALOGUE_NAMES, only_catalogue, read_catalogue
from pipeline.objects.local.folder import list_files
from pipeline.objects.remote.files import RemoteFiles
from pipeline.objects.remote.folder import RemoteFolder
from storage.cache import cache_folder
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.records.objects import ObjectRecord
from storage.remote.retries import TransferFailed
from storage.remote.safe_url import printable, safe_url
from storage.remote.url import RemoteUrl

MAX_BYTES = 200_000_000
"""Largest downloaded object with its buffers, in bytes: the limit of the mesh stage."""
THREADS = 8


def list_remote(url: RemoteUrl, licence: str | None) -> Listing:
    """List the objects of a remote folder: its catalogue's rows, or else its object files.

    Only the catalogue is downloaded here. Later downloads go to the cache; a cached object is
    downloaded again only where the server reports a change.

    `licence` is the user's for files without a statement.

    Raises:
        TrilightError: a driver is missing, the folder cannot be read or listed or holds no object,
            its catalogue is wrong, or there are a catalogue and a `licence`.
    """
    folder = RemoteFolder(url)
    root = cache_folder("objects") / sha256_hex(url.display_url.encode())[:32]
    files = RemoteFiles(folder, root, MAX_BYTES)
    catalogue = only_catalogue(folder.has)
    if catalogue is None:
        listing = _list_object_files(folder, files, stated_licence(licence))
    else:
        require_unstated(licence, catalogue)
        listing = Listing(records=_list_catalogue(folder, files, catalogue), failures=[])
    return dataclasses.replace(listing, fetch=partial(_fetch, folder, files))


def _list_catalogue(folder: RemoteFolder, files: RemoteFiles, catalogue: str) -> list[ObjectRecord]:
    try:
        records = read_catalogue(files.fetch(catalogue))
    except TransferFailed as error:
        raise TrilightError(
            f"objects {folder.url.display_url!r}: {catalogue} cannot be read ({error.message}); "
            "expected it to be fetched. Try again, or check your access to it."
        ) from error
    return [
        dataclasses.replace(
            record, source_url=record.source_url or _display_url(folder, _name_below(files, record))
        )
        for record in records
    ]


def _list_object_files(folder: RemoteFolder, files: RemoteFiles, licence: StatedLicence) -> Listing:
    names = folder.names()
    for catalogue in set(CATALOGUE_NAMES) & set(names):
        # without the catalogue, the run could use objects that it forbids
        raise TrilightError(
            f"objects {folder.url.display_url!r}: {catalogue} is listed but cannot be fetched; "
            "expected a readable catalogue. Check your access to it."
        )
    return list_files(
        names,
        licence,
        lambda name: {"path": str(files.path(name)), "source_url": _display_url(folder, name)},
    )


def _fetch(
    folder: RemoteFolder, files: RemoteFiles, records: list[ObjectRecord], downloaded: CountDone
) -> Fetched:
    def fetch(record: ObjectRecord) -> ObjectRecord:
        name = _name_below(files, record)
        try:
            return dataclasses.replace(record, path=str(files.fetch_object(name)))
        except TransferFailed as error:
            message = f"{_display_url(folder, name)}: {error.message}"
            raise TransferFailed(error.reason, message) from error

    return fetch_all(records, fetch, downloaded, threads=THREADS, stop=files.stop)


def _name_below(files: RemoteFiles, record: ObjectRecord) -> str:
    return Path(record.path).relative_to(files.files).as_posix()


def _display_url(folder: RemoteFolder, name: str) -> str:
    address = folder.address(name)
    return printable(
        safe_url(address if folder.url.is_http else f"{folder.url.scheme}://{address}")
    )
