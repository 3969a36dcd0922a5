"""Laws of digests of open files."""

import io

from storage.digests import sha256_hex, sha256_of_stream


def test_a_stream_is_hashed_from_where_it_stands() -> None:
    stream = io.BytesIO(b"header and rest")
    stream.seek(7)
    assert sha256_of_stream(stream) == sha256_hex(b"and rest")
    assert stream.read() == b""
