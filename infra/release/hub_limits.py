"""Limits of a repository of the Hugging Face hub, from its documents.

Source: https://huggingface.co/docs/hub/storage-limits, "Repository limitations" (2026-11).
"""

from collections import Counter
from pathlib import Path

from pipeline.documents.sums import published_files
from storage.errors import TrilightError

MOST_FILES = 100_000
"""Maximum number of files of a repository."""
MOST_ENTRIES = 10_000
"""Maximum number of entries of a folder."""
MOST_FILE_BYTES = 20_000_000_000
"""Maximum size of a file."""


def require_within_limits(folder: Path) -> tuple[int, int]:
    """Return the numbers of files and bytes of a folder's upload.

    Raises:
        TrilightError: the folder is empty, or exceeds the hub's limits.
    """
    files = list(published_files(folder))
    sizes = {path: path.stat().st_size for path in files}
    entries = Counter(path.parent for path in files).most_common(1)
    largest = max(sizes, key=lambda path: sizes[path], default=None)
    for got, limit, what in (
        (len(files), MOST_FILES, "files"),
        (entries[0][1] if entries else 0, MOST_ENTRIES, "entries in one folder"),
        (sizes[largest] if largest else 0, MOST_FILE_BYTES, f"bytes in one file, {largest}"),
    ):
        if got > limit:
            raise TrilightError(
                f"{folder}: {got} {what}; the hub advises at most {limit}. Make larger or smaller "
                "shards: trilight shards reshard."
            )
    if not files:
        raise TrilightError(f"{folder}: holds no file; expected a finished dataset or a network.")
    return len(files), sum(sizes.values())
