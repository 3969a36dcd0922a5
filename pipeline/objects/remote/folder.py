"""A folder on a server: its file names, and metadata of each file. Nothing is written here."""

import html
from functools import partial
from typing import Any
from urllib.parse import quote, unquote

from storage.errors import TrilightError
from storage.remote.retries import TransferFailed, is_absent, with_tries
from storage.remote.url import RemoteUrl, shared_driver

_MAX_FOLDERS = 10_000
_MAX_DEPTH = 32
"""Maximum depth of folders: a server may answer every address with the same page."""


class RemoteFolder:
    """Files of a remote folder by name: the unquoted path below it, with / between parts."""

    def __init__(self, url: RemoteUrl) -> None:
        """Open the driver; raises TrilightError where its package is missing."""
        self.url = url
        self.driver = shared_driver(url)
        self.driver.invalidate_cache()  # one driver keeps listings although that is turned off
        self._addresses: dict[str, str] = {}
        self._facts: dict[str, dict[str, Any]] = {}

    def address(self, name: str) -> str:
        """Return the driver's address of a file."""
        if name in self._addresses:
            return self._addresses[name]
        # Bytes that are not UTF-8 are lone surrogates in `name`.
        inner = quote(name, errors="surrogateescape") if self.url.is_http else name
        return f"{self.url.root}/{inner}"

    def facts(self, name: str) -> dict[str, Any]:
        """Return the server's metadata of a file; raises the driver's errors."""
        if name in self._facts:
            return self._facts[name]
        return dict(self.driver.info(self.address(name)))

    def has(self, name: str) -> bool:
        """Return True where a file exists; False also where the server denies access.

        Raises:
            TrilightError: the server gives no answer.
        """

        def ask() -> bool:
            try:
                return self.driver.info(self.address(name))["type"] == "file"
            except Exception as error:  # drivers raise exceptions of any type
                if is_absent(error):
                    return False
                raise

        try:
            return with_tries(ask)
        except TransferFailed as error:
            raise TrilightError(
                f"objects {self.url.display_url!r}: cannot be read ({error.message}); expected a "
                "folder that can be reached. Check the URL and your access to it."
            ) from error

    def names(self) -> list[str]:
        """Return the names of all files, at any depth.

        Raises:
            TrilightError: the folder cannot be listed, or has no end.
        """
        try:
            return self._names_by_links() if self.url.is_http else self._names_by_find()
        except TransferFailed as error:
            hint = " Public buckets need FSSPEC_S3_ANON=true." if self.url.scheme == "s3" else ""
            raise TrilightError(
                f"objects {self.url.display_url!r}: cannot be listed ({error.message}); expected a "
                "folder with a page that lists its files, or with objects.jsonl or objects.csv. "
                f"Check the URL and your access to it.{hint}"
            ) from error

    def _names_by_find(self) -> list[str]:
        start = f"{self.url.root}/"
        listing = with_tries(lambda: self.driver.find(self.url.root, detail=True))
        for address, facts in listing.items():
            name = address.removeprefix(start)
            if address.startswith(start) and name:
                self._addresses[name] = address
                self._facts[name] = facts
        return sorted(self._addresses)

    def _names_by_links(self) -> list[str]:
        """Follow the links of the server's listings, only those below the folder."""
        names: dict[str, str] = {}
        folders = {f"{self.url.root}/"}
        waiting = list(folders)
        deepest = self.url.root.count("/") + _MAX_DEPTH
        while waiting:
            folder = waiting.pop()
            for link in with_tries(partial(self.driver.ls, folder, detail=False)):
                address = html.unescape(link).replace("/./", "/")
                inner = _below(address, self.url.root)
                if inner is None or address in folders:
                    continue
                if address.endswith("/"):
                    folders.add(address)
                    waiting.append(address)
                else:
                    names[inner] = address
            if len(folders) > _MAX_FOLDERS or folder.count("/") > deepest:
                raise TrilightError(
                    f"objects {self.url.display_url!r}: the listing has no end; expected at most "
                    f"{_MAX_FOLDERS} folders, {_MAX_DEPTH} deep. Give it objects.jsonl."
                )
        self._addresses = names
        return sorted(names)


def _below(address: str, root: str) -> str | None:
    """Return the file name of a link, or None where it leads elsewhere or sorts the page."""
    if not address.startswith(f"{root}/") or "?" in address or "#" in address:
        return None
    inner = unquote(address[len(root) + 1 :], errors="surrogateescape")
    hidden_or_upward = any(part.startswith(".") for part in inner.split("/"))
    return None if hidden_or_upward or not inner else inner
