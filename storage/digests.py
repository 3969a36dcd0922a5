"""Names by content: sha256 of bytes, of files, and of JSON values in one canonical spelling."""

import hashlib
import json
from pathlib import Path
from typing import Any, BinaryIO

_PIECE_BYTES = 1 << 20


def sha256_hex(data: bytes) -> str:
    """Return the sha256 of bytes as 64 hexadecimal digits."""
    return hashlib.sha256(data).hexdigest()


def sha256_of_file(path: Path) -> str:
    """Return the sha256 of a file, read in pieces."""
    with path.open("rb") as stream:
        return sha256_of_stream(stream)


def sha256_of_stream(stream: BinaryIO) -> str:
    """Return the sha256 of an open file from where it stands to its end, read in pieces."""
    digest = hashlib.sha256()  # hashlib.file_digest reads a BytesIO from its first byte
    while piece := stream.read(_PIECE_BYTES):
        digest.update(piece)
    return digest.hexdigest()


def seal_of(data: bytes, sha256: str) -> str:
    """Return the sha256 of sealed bytes, which hold it: of all but its first 64 digits.

    Raises:
        ValueError: the digits are not there.
    """
    start = data.index(sha256.encode())
    view = memoryview(data)
    digest = hashlib.sha256(view[:start])
    digest.update(view[start + len(sha256) :])
    return digest.hexdigest()


def canonical_json(value: Any) -> bytes:
    """Return the one spelling of a JSON value: sorted keys, no spaces, UTF-8, no NaN."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return text.encode()
