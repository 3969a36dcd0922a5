"""Shards: byte-reproducible WebDataset tar files, and a reader that does not trust them.

Written members are sorted and have no clock and no owner. The reader walks the headers itself, 512
bytes at a time: anything that is not a plain file is refused before it is read, and no number in a
header decides how much memory is taken.

Textures and environment maps are no members of a sample: each stands once, between two samples,
before the first one that uses it (storage.records.packed_maps). Readers
return the members of a sample together with those of its maps; writers take the same form.
"""

import io
import itertools
import os
import re
import tarfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import BinaryIO

from storage.atomic import atomic_writer
from storage.errors import ShardMissing, TrilightError, prefix_errors
from storage.records.packed_maps import MAP_NAME, map_member
from storage.records.safe_read import open_plain
from storage.records.sample import Sample, StoredSample, decode_sample, stored_sample


def write_shard(path: Path, samples: Iterable[tuple[str, Mapping[str, bytes]]]) -> None:
    """Write samples, (key, members by suffix) in order of keys, as one WebDataset tar file.

    Equal samples give equal bytes. The file appears under its name only when it is complete, and
    never in the place of another: the first writer of a shard wins.

    Raises:
        TrilightError: the disk is full or the folder cannot be written.
    """
    with atomic_writer(path, replace=False) as stream:
        write_tar(stream, samples)


def write_tar(stream: BinaryIO, samples: Iterable[tuple[str, Mapping[str, bytes]]]) -> None:
    """Write samples to an open file by webdataset's writer, with fixed metadata."""
    from webdataset.writer import TarWriter  # late: it loads torch where that is installed

    written = set[str]()
    with TarWriter(stream, _OWNER, _OWNER, _MODE, encoder=False, mtime=0) as writer:
        for key, members in samples:
            for name in sorted(set(filter(MAP_NAME.fullmatch, members)) - written):
                header = _map_header(name, len(members[name]))
                writer.tarstream.addfile(header, io.BytesIO(members[name]))
                written.add(name)
            writer.write({"__key__": key, **members})  # without maps, since they begin with _


_OWNER = "trilight"
_MODE = 0o444


def _map_header(name: str, num_bytes: int) -> tarfile.TarInfo:
    """Return the header of a map, with the metadata that all members have."""
    info = tarfile.TarInfo(name)
    info.size = num_bytes
    info.mode = _MODE
    info.uname = info.gname = _OWNER
    return info


MAX_MEMBER_BYTES = 1 << 30
"""A 512 x 512 picture takes about 1 MiB; a gigabyte is a mistake or an attack."""

MEMBER_NAME = re.compile(r"([0-9A-Za-z_\-]+)\.([0-9A-Za-z_.\-]+)")
"""Key and suffix of a member; neither can leave a folder."""

_OCTAL = re.compile(rb" *([0-7]+)[ \0]*")
"""How headers write numbers, but for those that need more digits, which are binary."""
_BINARY = 0x80


@dataclass(frozen=True, slots=True)
class Member:
    """One file in a shard."""

    key: str  # key of its sample; empty for a map
    suffix: str  # what it is in the sample, or the name of a map
    offset: int  # offset of its first byte in the shard
    num_bytes: int  # its size

    @property
    def name(self) -> str:
        """Its name in the file."""
        return f"{self.key}.{self.suffix}" if self.key else self.suffix


def scan_members(stream: BinaryIO, name: str) -> Iterator[Member]:
    """Yield the members of an open shard in the order of the file, reading headers only.

    The position of the stream may be moved between two members. It raises TrilightError where the
    file is no complete tar, or holds a link, a folder, a path, an extended header, or a member that
    is larger than MAX_MEMBER_BYTES.
    """
    end = stream.seek(0, 2)
    position = 0
    while True:
        stream.seek(position)
        block = stream.read(tarfile.BLOCKSIZE)
        if not any(block):  # a tar ends in two empty blocks; a file that is cut has none
            if block + stream.read(tarfile.BLOCKSIZE) == bytes(2 * tarfile.BLOCKSIZE):
                return
            raise TrilightError(f"{name}: the end of the shard is missing; it is cut short.")
        member = _parse_header(name, block, position + tarfile.BLOCKSIZE)
        position = member.offset + -(-member.num_bytes // tarfile.BLOCKSIZE) * tarfile.BLOCKSIZE
        if position > end:
            raise TrilightError(f"{name}: member {member.name} is cut short.")
        yield member


def scan_samples(
    stream: BinaryIO, name: str, maps: dict[str, Member] | None = None
) -> Iterator[tuple[str, dict[str, Member]]]:
    """Yield (key, members by suffix) of each sample of an open shard, reading headers only.

    Members of one sample must stand together, as WebDataset demands.

    Args:
        stream: the shard.
        name: of the shard, for messages.
        maps: takes up the maps by their names: those before a sample are there when it is yielded,
            and all of them in the end.

    Raises:
        TrilightError: as `scan_members`, or a member, a map or a key occurs twice.
    """
    maps = {} if maps is None else maps
    seen = set[str]()
    for key, group in itertools.groupby(scan_members(stream, name), attrgetter("key")):
        if key in seen:
            raise TrilightError(f"{name}: sample {key} occurs twice.")
        members: dict[str, Member] = {} if key else maps
        for member in group:
            if member.suffix in members:
                raise TrilightError(f"{name}: member {member.name} occurs twice.")
            members[member.suffix] = member
        if key:
            seen.add(key)
            yield key, members


class ShardReader(AbstractContextManager["ShardReader"]):
    """An open shard, which gives any of its samples, in any order and to several threads."""

    def __init__(self, stream: BinaryIO, name: str) -> None:
        """Read the headers; raises TrilightError as `scan_samples`, and closes the file then.

        Args:
            stream: the shard, a file of this machine.
            name: of the shard, for messages.
        """
        self.name = name
        self.maps: dict[str, Member] = {}
        """Textures and environment maps by the names of their members."""
        self._stream = stream
        try:
            samples = dict(scan_samples(stream, name, self.maps))
        except BaseException:
            stream.close()
            raise
        self.samples: Mapping[str, Mapping[str, Member]] = samples
        """Members by suffix of each sample by key, in the order of the file."""
        self.keys = list(samples)
        """The keys of its samples, in the order of the file."""

    def sample(self, row: int) -> Sample:
        """Return a sample that passes `Sample.check`.

        Raises:
            TrilightError: it is not whole, not readable or breaks a law; names shard and sample.
        """
        with prefix_errors(self.name):
            sample = decode_sample(self.keys[row], self.members(self.keys[row]))
            sample.check()
            return sample

    def stored_sample(self, row: int) -> StoredSample:
        """Return a sample whose pictures are unpacked when they are asked for.

        Raises:
            TrilightError: its scene is not readable or breaks a law; names shard and sample.
        """
        with prefix_errors(self.name):
            return stored_sample(self.keys[row], self.members(self.keys[row]))

    def members(
        self, key: str, accepts: Callable[[str], bool] = lambda suffix: True
    ) -> dict[str, bytes]:
        """Return members of a sample by suffix, and the maps that its record names.

        A map that does not stand before the sample is left out: its decoder says that.

        Args:
            key: of the sample.
            accepts: says of a suffix whether it is read; without the record, no map is.

        Raises:
            TrilightError: there is no such sample, or the shard has become shorter.
        """
        if key not in self.samples:
            held = f"{self.keys[0]} to {self.keys[-1]}" if self.keys else "none"
            raise TrilightError(
                f"{self.name}: no sample {key}; expected one of its {len(self.keys)}: {held}."
            )
        stored = self.samples[key]
        members = {name: self.read(member) for name, member in stored.items() if accepts(name)}
        digests = re.findall("[0-9a-f]{64}", members.get("json", b"").decode(errors="replace"))
        maps = {name: self.maps[name] for name in map(map_member, digests) if name in self.maps}
        start = min(member.offset for member in stored.values())
        before = {name: self.read(map_) for name, map_ in maps.items() if map_.offset < start}
        return members | before

    def read(self, member: Member) -> bytes:
        """Return the bytes of a member; raises TrilightError where the shard became shorter."""
        data = os.pread(self._stream.fileno(), member.num_bytes, member.offset)
        if len(data) != member.num_bytes:
            raise TrilightError(f"{self.name}: became shorter while it was read. Copy it again.")
        return data

    def __iter__(self) -> Iterator[tuple[str, dict[str, bytes]]]:
        """Yield the key and the members of each sample."""
        return ((key, self.members(key)) for key in self.samples)

    def close(self) -> None:
        """Let go of the file; a cache may then remove it."""
        self._stream.close()

    def __exit__(self, *error: object) -> None:
        self.close()


def open_shard(path: Path) -> ShardReader:
    """Open a shard; raises ShardMissing, or TrilightError where it is no readable shard."""
    try:
        return ShardReader(open_plain(path), path.name)
    except OSError as error:
        kind = ShardMissing if isinstance(error, FileNotFoundError) else TrilightError
        raise kind(f"{path.name}: not a readable shard ({error.strerror}).") from error


def _parse_header(name: str, block: bytes, offset: int) -> Member:
    """Return the member that a header describes; `tarfile` would take six times as long."""
    block = block.ljust(tarfile.BLOCKSIZE, b"\xff")  # one that is cut has no right sum
    num_bytes = _number(block[124:136])
    stated = _number(block[148:156])
    if num_bytes is None or stated != sum(block) - sum(block[148:156]) + 8 * ord(" "):
        raise TrilightError(f"{name}: not a readable shard (a header at byte {offset - 512}).")
    fields = (field.partition(b"\0")[0] for field in (block[345:500], block[:100]))
    text = b"/".join(filter(None, fields))
    member_name = text.decode("utf-8", "replace")
    match = MEMBER_NAME.fullmatch(member_name)
    is_map = MAP_NAME.fullmatch(member_name) is not None
    is_plain = block[156:157] in (tarfile.REGTYPE, tarfile.AREGTYPE)
    if not is_plain or (match is None and not is_map):
        raise TrilightError(
            f"{name}: member {member_name!r} is refused; expected a plain file named KEY.SUFFIX."
        )
    if num_bytes > MAX_MEMBER_BYTES:
        raise TrilightError(
            f"{name}: member {member_name} claims {num_bytes} bytes; expected at most "
            f"{MAX_MEMBER_BYTES}."
        )
    key, suffix = ("", member_name) if match is None else match.groups()
    return Member(key, suffix, offset, num_bytes)


def _number(field: bytes) -> int | None:
    if field[0] == _BINARY:
        return int.from_bytes(field[1:], "big")
    match = _OCTAL.fullmatch(field)
    return int(match[1], 8) if match else None
