"""Wrapper of the `objaverse` package: one call at a time, with timeouts, silent.

The package keeps its files in its own folder (`~/.objaverse`), which other programs use too. It
downloads metadata without a temporary name, so that a broken transfer leaves a broken file; waits
for a dead server forever; prints; and reads its list of all objects again for each object.
"""

import contextlib
import importlib
import re
import socket
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from storage.errors import TrilightError
from storage.file_locks import hold_lock
from storage.remote.retries import TransferFailed, with_tries

Result = TypeVar("Result")

_SILENCE_S = 60.0
_PLACE = re.compile(r"glbs/[\w-]+/[\w-]+\.glb")
_PATHS = "object-paths.json.gz"
_CATEGORIES = "lvis-annotations.json.gz"


class ObjaversePackage:
    """The used part of the package; not safe for several threads."""

    def __init__(self) -> None:
        """Import the package.

        Raises:
            TrilightError: the package is missing, or the list of all objects cannot be downloaded.
        """
        try:
            self._package: ModuleType = importlib.import_module("objaverse")
        except ImportError as error:
            raise TrilightError(
                "objects objaverse: needs the package objaverse; expected it to be installed. Run "
                "make setup-all."
            ) from error
        self._paths: dict[str, str] = self._listing(_PATHS, self._package._load_object_paths)

    def __contains__(self, uid: str) -> bool:
        """Return True where Objaverse lists an object under a path of the usual form."""
        return bool(_PLACE.fullmatch(str(self._paths.get(uid))))

    def categories(self) -> dict[str, list[str]]:
        """Return the uids of every LVIS category; raises TrilightError as `__init__`."""
        return self._listing(_CATEGORIES, self._package.load_lvis_annotations)

    def groups(self, uids: Sequence[str]) -> list[list[str]]:
        """Return known uids by the metadata file that describes them, each once."""
        groups: dict[str, list[str]] = {}
        for uid in dict.fromkeys(uids):
            groups.setdefault(self._paths[uid].split("/")[1], []).append(uid)
        return [groups[name] for name in sorted(groups)]

    def annotations(self, group: list[str]) -> dict[str, dict[str, Any]]:
        """Return the annotations of one group by uid; some may be missing.

        Raises:
            TransferFailed: the file that describes them cannot be downloaded.
        """
        name = f"metadata/{self._paths[group[0]].split('/')[1]}.json.gz"
        return self._metadata(name, lambda: self._package.load_annotations(group))

    def fetch(self, uid: str) -> Path:
        """Download a known object, unless it is on this machine already.

        Raises:
            TransferFailed: the object cannot be downloaded.
        """

        def load() -> Path:
            with self._guard_package():
                # One process: with more, the package forks a pool that cannot be ended.
                return Path(self._package.load_objects([uid], download_processes=1)[uid])

        return with_tries(load).absolute()

    def _listing(self, name: str, load: Callable[[], Result]) -> Result:
        try:
            return self._metadata(name, load)
        except TransferFailed as error:
            raise TrilightError(
                f"objects objaverse: {name} cannot be downloaded ({error.message}); expected "
                "Objaverse to be reachable. Check the network and try again."
            ) from error

    def _metadata(self, name: str, load: Callable[[], Result]) -> Result:
        """Load a metadata file; an unreadable one is deleted and downloaded again."""

        def attempt() -> Result:
            try:
                with self._guard_package():
                    return load()
            except TrilightError:
                raise
            except Exception:
                (self._root / name).unlink(missing_ok=True)
                raise

        return with_tries(attempt)

    @property
    def _root(self) -> Path:
        return Path(self._package._VERSIONED_PATH)

    @contextlib.contextmanager
    def _guard_package(self) -> Iterator[None]:
        """Lock the package's folder, silence its output and set a timeout while it works.

        Only names of the package are replaced, not `sys.stdout`, so that Trilight's progress bar
        continues. The timeout holds for all sockets that open meanwhile.
        """
        before = socket.getdefaulttimeout()
        replaced: dict[str, Any] = {"print": _print_nothing, "tqdm": _iterate}
        if hasattr(self, "_paths"):
            replaced["_load_object_paths"] = lambda: self._paths
        missing = object()
        originals = {name: self._package.__dict__.get(name, missing) for name in replaced}
        with hold_lock(self._root / ".trilight.lock", wait=True):
            socket.setdefaulttimeout(_SILENCE_S)
            self._package.__dict__.update(replaced)
            try:
                yield
            finally:
                socket.setdefaulttimeout(before)
                for name, value in originals.items():
                    if value is missing:
                        del self._package.__dict__[name]
                    else:
                        self._package.__dict__[name] = value


def _print_nothing(*values: object, **options: object) -> None:
    """Replace `print` of the package."""


def _iterate(items: Result, *values: object, **options: object) -> Result:
    """Replace the progress bar of the package."""
    return items
