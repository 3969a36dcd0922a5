"""Shards are byte-reproducible tar files: sorted members, no clock, no owner, atomic appearance."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import BinaryIO

from storage.atomic import atomic_writer


def write_shard(path: Path, samples: Iterable[tuple[str, Mapping[str, bytes]]]) -> None:
    """Write samples, given as (key, members by suffix) in order of keys, as one tar file.

    Equal samples give equal bytes. The file appears under its name only when it is complete, and
    never in the place of another: the first writer of a shard wins.

    Raises:
        TrilightError: the disk is full or the folder cannot be written.
    """
    with atomic_writer(path, replace=False) as stream:
        write_tar(stream, samples)


def write_tar(stream: BinaryIO, samples: Iterable[tuple[str, Mapping[str, bytes]]]) -> None:
    """Write samples to an open file with WebDataset's own writer, and with fixed metadata."""
    from webdataset.writer import TarWriter  # not at the top: it is slow to import

    with TarWriter(stream, encoder=False, mtime=0, user="trilight", group="trilight") as writer:
        for key, members in samples:
            writer.write({"__key__": key, **members})
