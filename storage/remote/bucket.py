"""Uploads to a bucket (s3://, gs://): files appear whole or not at all, and once if asked.

A bucket shows a file when all of it has come, however large it is, so a kill leaves nothing half
written; parts of an upload that was cut off are invisible, and a rule of the bucket may delete them
(AbortIncompleteMultipartUpload). "Only once" is a condition that the server itself checks.
"""

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from storage.errors import EnvironmentFailure, TrilightError
from storage.remote.tries import TransferFailed, is_missing, is_taken, may_pass, with_tries
from storage.remote.url import RemoteUrl, shared_driver

WRITABLE = ("s3", "gs")
"""Schemes of servers that can be told to write a file only where there is none."""
_PART_BYTES = 32 << 20
_PARTS_AT_ONCE = 4
"""Part size and concurrency together bound the memory of an upload."""
_PROBE = ".staging/once"
"""Test file that shows whether the server creates a file only once; it may stay."""


class Bucket:
    """A folder in a bucket that is written to."""

    def __init__(self, url: RemoteUrl) -> None:
        self.url = url

    def names(self, below: str = "") -> set[str]:
        """Return the names of all files below the folder, or a folder in it, relative to it.

        A thousand names are a request.

        Raises:
            TrilightError: the bucket does not exist or may not be listed, or the server gives no
                answer (an EnvironmentFailure where that may pass).
        """
        return self._list_paths(below, lambda driver, place: driver.find(place))

    def names_in(self, folder: str = "") -> set[str]:
        """Return the names of the files in one folder alone, relative to the bucket's folder."""

        def list_files(driver: Any, place: str) -> list[str]:
            with contextlib.suppress(FileNotFoundError):
                rows = driver.ls(place, detail=True)
                return [row["name"] for row in rows if row["type"] == "file"]
            return []

        return self._list_paths(folder, list_files)

    def _list_paths(self, folder: str, find: Callable[[Any, str], list[str]]) -> set[str]:
        root = self.url.root
        place = f"{root}/{folder}".rstrip("/")

        def find_paths() -> list[str]:
            driver = shared_driver(self.url)
            driver.invalidate_cache()
            return list(find(driver, place))

        paths = self._retry(find_paths, "listed")
        return {path.removeprefix(f"{root}/") for path in paths if path.startswith(f"{root}/")}

    def read_start(self, name: str, num_bytes: int) -> bytes | None:
        """Return the first bytes of a file, or None where there is none; raises as `names`."""
        target = self.url.child(name).root

        def read() -> bytes | None:
            try:
                content: bytes = shared_driver(self.url).cat_file(target, start=0, end=num_bytes)
            except FileNotFoundError:
                return None
            return content

        start: bytes | None = self._retry(read, "read")
        return start

    def write(self, name: str, content: Path | bytes) -> None:
        """Write a file, or replace it.

        Args:
            name: relative to the folder.
            content: a file of this machine, or bytes.

        Raises:
            TrilightError: as `names`, or the folder may not be written.
        """
        self._retry(lambda: self._upload(name, content, mode="overwrite"), "written")

    def create(self, name: str, content: Path | bytes) -> bool:
        """Write a file unless it exists, and return whether it was written; otherwise as `write`.

        Where the answer to a successful write is lost, another worker counts as its writer.
        """

        def create_file() -> bool:
            try:
                self._upload(name, content, mode="create")
            except Exception as error:  # drivers raise what they like
                if not is_taken(error):
                    raise
                return False
            return True

        return self._retry(create_file, "written")

    def require_create(self) -> None:
        """Raise TrilightError where the server writes a file again that it was to create once."""
        if self.create(_PROBE, b"\n") and self.create(_PROBE, b"\n"):
            raise TrilightError(
                f"{self.url.what} {self.url.display_url!r}: the server does not know conditional "
                "writes "
                "(If-None-Match, or ifGenerationMatch), so two workers could replace each other's "
                "files; expected one that refuses to create a file twice. Use another server, or "
                "a folder."
            )

    def _upload(self, name: str, content: Path | bytes, *, mode: str) -> None:
        driver = shared_driver(self.url)
        target = self.url.child(name).root
        if isinstance(content, bytes):
            driver.pipe_file(target, content, mode=mode)
            return
        driver.put_file(
            str(content),
            target,
            mode=mode,
            chunksize=_PART_BYTES,
            max_concurrency=_PARTS_AT_ONCE,
        )

    def _retry(self, function: Callable[[], Any], what: str) -> Any:
        try:
            return with_tries(function)
        except TransferFailed as error:
            cause = error.__cause__
            lasting = cause is None or is_missing(cause) or not may_pass(cause)
            kind = TrilightError if lasting else EnvironmentFailure
            raise kind(
                f"{self.url.what} {self.url.display_url!r}: cannot be {what} ({error.message}); "
                "expected "
                "a bucket that exists, and access that lets you list, read and write there. What "
                "was finished is safe: fix it and run the same command again."
            ) from error
