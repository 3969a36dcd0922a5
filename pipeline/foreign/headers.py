"""Checks of the first bytes of a file: archives, and counts that its size cannot hold."""

from storage.errors import Rejected

_ARCHIVES = {
    b"PK\x03\x04": "zip",
    b"PK\x05\x06": "zip",
    b"\x1f\x8b": "gzip",
    b"BZh": "bzip2",
    b"\xfd7zXZ\x00": "xz",
    b"7z\xbc\xaf\x27\x1c": "7z",
    b"Rar!": "rar",
    b"\x28\xb5\x2f\xfd": "zstandard",
}

_STL_HEADER_BYTES = 84
_STL_FACE_BYTES = 50
_MAX_HEADER_BYTES = 1 << 16


def check_header(data: bytes, suffix: str, max_faces: int) -> None:
    """Raise Rejected where the start of a file contradicts its name, its size or our limits."""
    for magic, name in _ARCHIVES.items():
        if data.startswith(magic):
            raise Rejected("archive_refused", f"the file is a {name} archive; unpack it first")
    if data[257:262] == b"ustar":
        raise Rejected("archive_refused", "the file is a tar archive; unpack it first")
    if suffix == ".stl":
        _check_stl(data, max_faces)
    elif suffix == ".ply":
        _check_ply(data, max_faces)


def _check_stl(data: bytes, max_faces: int) -> None:
    count = int.from_bytes(data[80:_STL_HEADER_BYTES], "little")
    if len(data) == _STL_HEADER_BYTES + _STL_FACE_BYTES * count and count > max_faces:
        raise Rejected("too_many_faces", f"{count} faces; expected <= {max_faces}")


def _check_ply(data: bytes, max_faces: int) -> None:
    """Refuse a header that counts more elements than the file has bytes: each takes one or more."""
    header = data[:_MAX_HEADER_BYTES].partition(b"end_header")[0]
    total = 0
    for line in header.splitlines():
        words = line.split()
        if len(words) < 3 or words[0] != b"element":
            continue
        if not words[2].isdigit() or len(words[2]) > 18:
            raise Rejected("header_size_mismatch", f"the PLY header counts {words[2][:24]!r}")
        count = int(words[2])
        total += count
        if words[1] == b"face" and max_faces < count <= len(data):
            raise Rejected("too_many_faces", f"{count} faces; expected <= {max_faces}")
    if total > len(data):
        raise Rejected(
            "header_size_mismatch",
            f"the PLY header counts {total} elements, which {len(data)} bytes do not hold",
        )
