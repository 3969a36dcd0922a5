"""Reading tar shards without trusting them: plain members, sane names, whole samples."""

import re
import tarfile
from collections.abc import Collection, Iterator
from pathlib import Path

from storage.errors import TrilightError

MAX_MEMBER_BYTES = 1 << 30
"""A 512 x 512 picture takes about 1 MiB; a gigabyte is a mistake or an attack."""

MEMBER_NAME = re.compile(r"([0-9A-Za-z_\-]+)\.([0-9A-Za-z_.\-]+)")
"""Key and suffix of a member; neither can leave a folder."""


def iterate_members(path: Path) -> Iterator[tuple[str, str, int, bytes]]:
    """Yield (key, suffix, offset, bytes) of each member of a shard, in the order of the file.

    Raises:
        TrilightError: the file is no complete tar, or holds a link, a folder, a path, or a member
            that is larger than MAX_MEMBER_BYTES. Nothing is extracted to disk.
    """
    try:
        with tarfile.open(path, mode="r:") as archive:
            for member in archive:
                key, suffix = _checked_name(path, member)
                stream = archive.extractfile(member)
                data = stream.read() if stream else b""
                if len(data) != member.size:
                    raise TrilightError(f"{path.name}: member {member.name} is cut short.")
                yield key, suffix, member.offset_data, data
            _require_end(path, archive)
    except (tarfile.TarError, OSError) as error:
        raise TrilightError(f"{path.name}: not a readable shard ({error}).") from error


def iterate_samples(path: Path) -> Iterator[tuple[str, dict[str, bytes]]]:
    """Yield (key, members by suffix) of each sample of a shard.

    Members of one sample must stand together, as WebDataset demands.

    Raises:
        TrilightError: as `iterate_members`, or a member or a key occurs twice.
    """
    seen: set[str] = set()
    current: str | None = None
    members: dict[str, bytes] = {}
    for key, suffix, _, data in iterate_members(path):
        if key != current:
            if current is not None:
                yield current, members
            if key in seen:
                raise TrilightError(f"{path.name}: sample {key} occurs twice.")
            seen.add(key)
            current, members = key, {}
        if suffix in members:
            raise TrilightError(f"{path.name}: member {key}.{suffix} occurs twice.")
        members[suffix] = data
    if current is not None:
        yield current, members


def read_members(path: Path, key: str, suffixes: Collection[str]) -> dict[str, bytes]:
    """Return some members of one sample of a shard by suffix, reading no other.

    Raises:
        TrilightError: as `iterate_members`, there is no such sample, or a member occurs twice.
    """
    members: dict[str, bytes] = {}
    keys: list[str] = []
    try:
        with tarfile.open(path, mode="r:") as archive:
            for member in archive:
                found, suffix = _checked_name(path, member)
                if found not in keys[-1:]:
                    keys.append(found)
                if found != key or suffix not in suffixes:
                    continue
                if suffix in members:
                    raise TrilightError(f"{path.name}: member {key}.{suffix} occurs twice.")
                stream = archive.extractfile(member)
                members[suffix] = stream.read() if stream else b""
    except (tarfile.TarError, OSError) as error:
        raise TrilightError(f"{path.name}: not a readable shard ({error}).") from error
    if key not in keys:
        held = f"{keys[0]} to {keys[-1]}" if keys else "none"
        raise TrilightError(
            f"{path.name}: no sample {key}; expected one of its {len(keys)}: {held}."
        )
    return members


def _checked_name(path: Path, member: tarfile.TarInfo) -> tuple[str, str]:
    match = MEMBER_NAME.fullmatch(member.name)
    if not member.isreg() or match is None:
        raise TrilightError(
            f"{path.name}: member {member.name!r} is refused; expected a plain file named "
            "KEY.SUFFIX."
        )
    if member.size > MAX_MEMBER_BYTES:
        raise TrilightError(
            f"{path.name}: member {member.name} claims {member.size} bytes; expected at most "
            f"{MAX_MEMBER_BYTES}."
        )
    return match[1], match[2]


def _require_end(path: Path, archive: tarfile.TarFile) -> None:
    """A tar ends in two empty blocks; a file cut between two members has none."""
    with path.open("rb") as stream:
        stream.seek(archive.offset)
        if stream.read(2 * tarfile.BLOCKSIZE) != bytes(2 * tarfile.BLOCKSIZE):
            raise TrilightError(f"{path.name}: the end of the shard is missing; it is cut short.")
