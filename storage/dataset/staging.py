"""What the manifest does not list yet: finished scenes that wait for their shard, finished shards.

Each is one file that appears whole. A scene's is a small tar with the members of its sample and, as
`failures`, the attempts that were rejected on the way. A scene that no attempt could save has
failures only. The worker that packs a shard writes a note on it once: the shard's row of the
manifest, and the rejections. The work of one worker does not grow with that of the others.
"""

import contextlib
import dataclasses
import io
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from storage.atomic import write_atomically
from storage.dataset.dataset import Dataset
from storage.dataset.layout import DatasetFolder, numbered_path, shard_names_in
from storage.dataset.manifest import (
    SHARD_NAME,
    Scenes,
    ShardEntry,
    index_shard,
    num_planned,
    number_of_shard,
    shard_row,
)
from storage.dataset.shard import open_shard, write_tar
from storage.digests import canonical_json
from storage.errors import TrilightError
from storage.records.objects import Failure, decode_failures, encode_failures, read_failures
from storage.records.safe_read import read_plain
from storage.records.sample import sample_key
from storage.typed_json import Converted, read_json

_SUFFIX = ".json"
_AT_ONCE = 32
"""Notes that are fetched at the same time."""


@dataclass(frozen=True, kw_only=True)
class ShardNote:
    """Contents of the note on a finished shard."""

    shard: ShardEntry
    failures: Annotated[
        tuple[Failure, ...], Converted(lambda text: tuple(decode_failures(str(text).encode())))
    ]
    """Scenes that were given up, and rejected attempts; in the file, lines as in failures.jsonl."""
    scenes: Scenes | None = None
    """Scenes so far of a shard in a bucket that still grows; None for a full shard."""


def rejections_of_shard(folder: DatasetFolder, name: str) -> Path:
    """Return the file with the rejections of a shard that is packed and not noted yet."""
    return folder.staged_failures / f"{name}.jsonl"


def note_of(folder: DatasetFolder, name: str) -> Path:
    """Return the file of the note on a shard."""
    return folder.staged_entries / f"{name}{_SUFFIX}"


def name_of_note(name: str) -> str:
    """Return the relative name of the note on a shard, in a folder or a bucket."""
    return note_of(DatasetFolder(Path()), name).as_posix()


def note_shard(folder: DatasetFolder, note: ShardNote) -> None:
    """Write the note on a shard that is there; safe to repeat."""
    write_atomically(note_of(folder, note.shard.name), encode_note(note))
    rejections_of_shard(folder, note.shard.name).unlink(missing_ok=True)


def encode_note(note: ShardNote) -> bytes:
    """Return the file of a note."""
    failures = encode_failures(note.failures).decode()
    cut = {} if note.scenes is None else {"scenes": note.scenes}
    return canonical_json({"shard": shard_row(note.shard), "failures": failures, **cut})


def noted_shard(folder: DatasetFolder, name: str) -> ShardNote:
    """Return what is known of a shard that is there: its note, or else by reading the shard.

    A note that is older than the shard, or of another size, was of a shard before it. Of a shard
    in a bucket the note alone is here.

    Raises:
        TrilightError: the file is not a whole shard.
    """
    path = note_of(folder, name)
    shard = folder.shard(name)
    # a kill before the note leaves none; then, and where it is no note, the shard itself is read
    with contextlib.suppress(OSError, TrilightError):
        note = read_json(read_plain(path), ShardNote, str(path))
        if folder.is_sent(name):
            return note
        facts = shard.stat()
        if note.shard.num_bytes == facts.st_size and path.stat().st_mtime_ns >= facts.st_mtime_ns:
            return note
    failures = read_failures(rejections_of_shard(folder, name))
    return ShardNote(shard=index_shard(shard), failures=tuple(failures))


def noted_names(folder: DatasetFolder) -> Iterator[str]:
    """Yield the names of the shards on which there are notes."""
    return shard_names_in(folder.staged_entries, _SUFFIX)


def fetch_notes(
    read: Callable[[str], bytes | None], names: Iterable[str], dataset_name: str
) -> list[ShardNote]:
    """Return notes that are on a server, by the names of their files, many at a time.

    `read` returns a file of the dataset by its relative name, and is called in threads.

    Raises:
        TrilightError: one of them is no note, or as `read`.
    """

    def fetch_note(name: str) -> ShardNote:
        try:
            note = read_json(read(name) or b"", ShardNote, name)
            if not name.endswith(f"/{note.shard.name}{_SUFFIX}"):
                raise TrilightError(note.shard.name)
        except TrilightError as error:
            raise TrilightError(
                f"{dataset_name}/{name}: not a note on its shard ({error}); delete both, and the "
                "shard is made again."
            ) from error
        return note

    with ThreadPoolExecutor(_AT_ONCE) as pool:
        return list(pool.map(fetch_note, names))


def with_unlisted(dataset: Dataset) -> Dataset:
    """Return a dataset with the shards that are finished and not listed, as far as known here."""
    unlisted = _notes(dataset)
    if not unlisted:
        return dataset
    noted = [note.shard for note in unlisted]
    shards = {shard.name: shard for shard in (*dataset.manifest.shards, *noted)}
    every = tuple(sorted(shards.values(), key=number_of_shard))
    failures = [failure for note in unlisted for failure in note.failures]
    manifest = dataclasses.replace(dataset.manifest, shards=every)
    return Dataset(dataset.store, manifest, dataset.num_listed, failures)


def _notes(dataset: Dataset) -> list[ShardNote]:
    manifest = dataset.manifest
    if folder := dataset.local:
        noted = filter(SHARD_NAME.fullmatch, noted_names(folder))
        return [noted_shard(folder, name) for name in noted if folder.shard(name).exists()]
    if len(manifest.shards) >= num_planned(manifest):
        return []
    names = dataset.names_in_bucket()
    listed = {shard.name for shard in manifest.shards}
    notes = map(name_of_note, sorted(filter(SHARD_NAME.fullmatch, names - listed)))
    with contextlib.suppress(TrilightError):  # it may be listed and not read
        noted_files = [name for name in notes if name in names]
        return fetch_notes(dataset.store.get, noted_files, dataset.display_name)
    return []


_FAILURES = "failures"


def stage_members(
    folder: Path, scene_index: int, members: dict[str, bytes], failures: list[Failure]
) -> None:
    """Write what became of a scene into the staging folder of its shard.

    The members of its sample are packed as they will stay; there are none where it was given up.
    """
    stream = io.BytesIO()
    write_tar(
        stream, [(sample_key(scene_index), {**members, _FAILURES: encode_failures(failures)})]
    )
    write_atomically(_path(folder, scene_index), stream.getvalue())


def is_staged(folder: Path, scene_index: int) -> bool:
    """Return whether a scene is finished."""
    return _path(folder, scene_index).exists()


def read_staged_scene(folder: Path, scene_index: int) -> tuple[dict[str, bytes], list[Failure]]:
    """Return the members of a finished scene's sample, none where it was given up, and failures.

    Raises:
        ShardMissing: it is not staged.
    """
    with open_shard(_path(folder, scene_index)) as opened:
        ((_, members),) = opened
    failures = decode_failures(members.pop(_FAILURES))
    return members, failures


def _path(folder: Path, scene_index: int) -> Path:
    return folder / numbered_path(scene_index, f"{sample_key(scene_index)}.tar")
