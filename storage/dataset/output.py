"""Where a dataset is made: in a folder, or in a bucket with a folder of this machine before it."""

from pathlib import Path

from storage.cache import cache_folder
from storage.dataset.layout import DatasetFolder
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.remote.bucket import WRITABLE
from storage.remote.safe_url import printable, safe_url
from storage.remote.url import parse_url

_ADMITTED = f"expected a folder, or a URL of {' or '.join(WRITABLE)}"


def dataset_folder(out: str) -> DatasetFolder:
    """Return the folder of a dataset that is to be made.

    For a bucket that is a folder of the cache, the same one whenever the same URL is named, with
    the scenes that are not in a shard yet and a copy of what stands beside the shards.

    Args:
        out: a folder, or a URL of WRITABLE.

    Raises:
        TrilightError: the URL is refused (storage.remote.url), is none that can be written to only
            once, or has a query.
    """
    if "://" not in out and not out.startswith("pipe:"):
        return DatasetFolder(Path(out))
    place = parse_url(out, what="out")
    if isinstance(place, Path):
        return DatasetFolder(place)
    shown = printable(safe_url(out))
    if place.scheme not in WRITABLE:
        raise TrilightError(f"out {shown!r} has the scheme {place.scheme!r}; {_ADMITTED}.")
    if "?" in place.root or "#" in place.root:
        raise TrilightError(f"out {shown!r} has a query or fragment; {_ADMITTED}, without one.")
    name = sha256_hex(place.shown.encode())[:16]
    return DatasetFolder(cache_folder("outputs") / name, place.shown)
