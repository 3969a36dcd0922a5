"""Paths of a dataset folder, and the locks by which several workers share it.

The shards and the files beside them are the dataset. `.staging` holds unfinished work; it may be
deleted at any time, and is then made again.

No folder holds more than 5,000 entries: of files that are numbered, the first 4,096 stand in their
folder, and each following 4,096 in one of its `part-0001`, `part-0002`, ... The place of a file
follows from its number alone, so nothing moves when a dataset grows. A dataset in a bucket has a
folder of this machine before it.
"""

import contextlib
import os
import re
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from storage.atomic import remove_leftovers
from storage.cache import cache_folder
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.file_locks import hold_lock, is_locked, open_lock, take_lock
from storage.remote.store import WRITABLE, LocalStore, RemoteStore, Store
from storage.remote.url import RemoteUrl, parse_url, printable, safe_url

_LEFT_S = 3600.0
"""Age at which a temporary file counts as left by a kill. Not all file systems carry locks between
machines, so a worker that seems alone may not be; no file takes an hour to write."""

FILES_PER_FOLDER = 4096
"""Numbered files of one folder; with their sub-folders and what else lies there, below 5,000."""

_PART = re.compile(r"part-(\d{4,6})")


def numbered_path(number: int, name: str) -> str:
    """Return the relative path of the file `name`, which is the `number`-th of its folder."""
    part = number // FILES_PER_FOLDER
    return f"part-{part:04d}/{name}" if part else name


def shard_names_in(root: Path, suffix: str = "") -> Iterator[str]:
    """Yield the names of the shards of which a folder or its parts has a file.

    Args:
        root: the folder.
        suffix: what such files have after the name of their shard.
    """
    with contextlib.suppress(FileNotFoundError):
        matches = (_PART.fullmatch(name) for name in os.listdir(root))
        for part in (0, *sorted(int(match[1]) for match in matches if match)):
            yield from shard_names_in_part(root, part, suffix)


def shard_names_in_part(root: Path, part: int, suffix: str = "") -> Iterator[str]:
    """Yield as `shard_names_in`, of one part alone."""
    place = place_of_part(part)
    with contextlib.suppress(FileNotFoundError), os.scandir(root / place) as entries:
        for entry in entries:
            if entry.name.endswith(f".tar{suffix}"):
                yield f"{place}{entry.name.removesuffix(suffix)}"


def parts_of(numbers: range) -> range:
    """Return the parts of a folder in which numbered files stand."""
    if not numbers:
        return range(0)
    return range(numbers.start // FILES_PER_FOLDER, numbers[-1] // FILES_PER_FOLDER + 1)


def in_parts(numbers: range) -> Iterator[range]:
    """Yield ranges of numbers, each of those in one part of a folder."""
    for part in parts_of(numbers):
        first = max(numbers.start, part * FILES_PER_FOLDER)
        yield range(first, min(numbers.stop, (part + 1) * FILES_PER_FOLDER))


def place_of_part(part: int) -> str:
    """Return the relative path of a part of a folder, with its slash; empty for the first."""
    return numbered_path(part * FILES_PER_FOLDER, "")


class Below:
    """A path below the folder that an object names as its `root`."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, folder: Any, owner: type) -> Path:
        return Path(folder.root, self._name)


@dataclass(frozen=True)
class DatasetFolder:
    """The paths of one dataset, or of this machine's part of one that is made in a bucket."""

    root: Path
    """The folder that users name; for a bucket, one in the cache (storage.dataset.layout)."""
    bucket: str = ""
    """URL of the bucket that the dataset is made in, where it is; without secrets."""

    manifest = Below("manifest.json")
    objects_lock = Below("objects.lock.jsonl")
    failures = Below("failures.jsonl")
    attribution = Below("attribution.csv")
    card = Below("README.md")
    """The dataset card, which is what hubs and people open first."""
    licences = Below("LICENSE.md")
    croissant = Below("croissant.json")
    contact_sheet = Below("contact_sheet.png")
    template_sheet = Below("templates.png")
    report = Below("report.html")
    report_pages = Below("report")
    """Folder of the report's pages, one per scene that it shows."""
    logs = Below("logs")
    staging = Below(".staging")
    staged_objects = Below(".staging/objects")
    """Built-in objects, written out as files."""
    staged_index = Below(".staging/objects.index")
    """The index of the frozen objects (storage.records.object_index)."""
    staged_batches = Below(".staging/object_batches")
    """Results of the mesh stage by batch, until the objects are frozen."""
    staged_failures = Below(".staging/failures")
    """Rejections of shards that are packed and not yet noted."""
    staged_entries = Below(".staging/entries")
    """Notes on shards that the manifest does not list yet (storage.dataset.staging)."""
    staged_samples = Below(".staging/samples")
    """Finished samples of unfinished shards, in a folder for each shard."""
    staged_sent = Below(".staging/sent")
    """An empty file for each shard that is known to be in the bucket."""
    staged_at_work = Below(".staging/at_work")
    """Notes on how far unfinished scenes are."""
    staged_plan = Below(".staging/plan.json")
    """How many objects the asset stage has to do."""
    staged_downloads = Below(".staging/downloads.json")
    """How many object files are downloaded, and of how many."""
    staged_done = Below(".staging/objects_done")
    """A byte for each object that is prepared or rejected."""
    staged_given_up = Below(".staging/given_up")
    """A line for each scene that was given up and that the manifest does not stand for yet."""
    _lock = Below(".staging/lock")

    @property
    def display_name(self) -> str:
        """The dataset's folder or URL, as messages show it."""
        return self.bucket or str(self.root)

    def store(self) -> Store:
        """Return where the dataset is published: this folder itself, or its bucket."""
        if not self.bucket:
            return LocalStore(self.root)
        url = parse_url(self.bucket, what="out")
        assert isinstance(url, RemoteUrl)
        return RemoteStore(url, self.root)

    def name_of(self, path: Path) -> str:
        """Return the name of a file of the folder, relative to it."""
        return path.relative_to(self.root).as_posix()

    def staged_shard(self, name: str) -> Path:
        """Folder of the finished samples of an unfinished shard."""
        return self.staged_samples / name

    def shard(self, name: str) -> Path:
        """Path of a shard; its name is relative to the folder and may begin with a part of it."""
        return self.root / name

    def has_shard(self, name: str) -> bool:
        """Return whether a shard is finished: it is here, or in the bucket."""
        return self.shard(name).exists() or self.is_sent(name)

    def is_sent(self, name: str) -> bool:
        """Return whether a shard is known to be in the bucket; its bytes need not be here."""
        return bool(self.bucket) and (self.staged_sent / name).exists()

    @property
    def is_at_work(self) -> bool:
        """True while a process of this machine, or one whose locks reach here, works on it."""
        return is_locked(self._lock)

    @contextlib.contextmanager
    def hold_exclusive_lock(self) -> Iterator[None]:
        """Hold the folder's lock exclusively; it ends with the process that holds it.

        Raises:
            TrilightError: the folder cannot be written, or another process is at work in it.
        """
        with hold_lock(self._lock) as ours:
            if not ours:
                raise TrilightError(
                    f"{self.root}: another process is making this dataset. Wait for it, or choose "
                    "another --out."
                )
            yield

    @contextlib.contextmanager
    def hold_shared_lock(self, when_alone: Callable[[], None] = lambda: None) -> Iterator[None]:
        """Hold the lock that the workers of a dataset share.

        A worker that is alone at first removes what killed writers left more than an hour ago,
        unless another one has looked within that hour: to look costs the whole set.

        Args:
            when_alone: called by a worker that is alone at first, before another one can join.

        Raises:
            TrilightError: the folder cannot be written; or as `when_alone`.
        """
        descriptor = open_lock(self._lock)
        try:
            if take_lock(descriptor):
                self._clean()
                when_alone()
            # flock converts a lock by releasing it first, so another worker may hold it exclusively
            # in between and clean too. That is harmless: this worker has not begun its work yet.
            take_lock(descriptor, shared=True, wait=True)
            yield
        finally:
            os.close(descriptor)

    def clear(self) -> None:
        """Delete everything except the locks of workers."""
        lock_paths = {self.staging, self.staging / "lock", self.staging / "turns"}
        for path in {*self.root.iterdir(), *self.staging.iterdir()} - lock_paths:
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink()

    def _clean(self) -> None:
        looked = self.staging / "cleaned"
        with contextlib.suppress(FileNotFoundError):
            if time.time() - looked.stat().st_mtime < _LEFT_S:
                return
        remove_leftovers(self.root, older_than_s=_LEFT_S)
        looked.touch()

    def mutex(self, what: str) -> "contextlib.AbstractContextManager[bool]":
        """Hold the lock of a step that one worker does at a time, such as `manifest`."""
        return hold_lock(self.staging / "turns" / what, wait=True)


_ADMITTED = f"expected a folder, or a URL of {' or '.join(WRITABLE)}"


def dataset_folder(out: str) -> DatasetFolder:
    """Return the folder of a dataset that is to be made.

    For a bucket that is a folder of the cache, the same one whenever the same URL is named, with
    the scenes that are not in a shard yet and a copy of the files next to the shards.

    Args:
        out: a folder, or a URL of WRITABLE.

    Raises:
        TrilightError: the URL is refused (storage.remote.url), is none that can be written to only
            once, or has a query.
    """
    place = parse_url(out, what="out")
    if isinstance(place, Path):
        return DatasetFolder(place)
    url_text = printable(safe_url(out))
    if place.scheme not in WRITABLE:
        raise TrilightError(f"out {url_text!r} has the scheme {place.scheme!r}; {_ADMITTED}.")
    if "?" in place.root or "#" in place.root:
        raise TrilightError(f"out {url_text!r} has a query or fragment; {_ADMITTED}, without one.")
    name = sha256_hex(place.display_url.encode())[:16]
    return DatasetFolder(cache_folder("outputs") / name, place.display_url)
