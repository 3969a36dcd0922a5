"""Notes on packed shards until the manifest lists them, so that none has to be read again."""

import contextlib
import json
from pathlib import Path

from storage.atomic import write_atomically
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import ShardEntry, index_shard, shard_of_row, shard_row


def note_shard(folder: DatasetFolder, shard: ShardEntry) -> None:
    """Write down what the manifest will say of a shard; safe to repeat."""
    write_atomically(note_of(folder, shard.name), json.dumps(shard_row(shard)).encode())


def note_of(folder: DatasetFolder, name: str) -> Path:
    """Return the file of the note on a shard."""
    return folder.staged_entries / f"{name}.json"


def noted_shard(folder: DatasetFolder, name: str) -> ShardEntry:
    """Return the entry of a shard that is there: its note, or else by reading the shard.

    A note that is older than the shard, or of another size, was of a shard before it. Of a shard
    in a bucket the note alone is here.

    Raises:
        TrilightError: the file is not a whole shard.
    """
    path, shard = note_of(folder, name), folder.shard(name)
    # a kill before the note leaves none; then, and where it is no note, the shard itself is read
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        entry = shard_of_row(json.loads(path.read_bytes()))
        if folder.is_sent(name):
            return entry
        facts = shard.stat()
        if entry.num_bytes == facts.st_size and path.stat().st_mtime_ns >= facts.st_mtime_ns:
            return entry
    return index_shard(shard)


def forget_note(folder: DatasetFolder, name: str) -> None:
    """Delete the note of a shard that the manifest lists."""
    note_of(folder, name).unlink(missing_ok=True)
