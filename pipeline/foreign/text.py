"""Text of untrusted files: lines and words of bytes, located by numpy."""

import codecs
import re
import warnings
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from storage.errors import Rejected

T = TypeVar("T", bound=np.generic)

IS_WORD = np.array([not bytes([code]).isspace() for code in range(256)])
"""Whether each byte belongs to a word, which white space ends."""
_MOST_LISTED = 12


def plain_text(data: bytes) -> bytes:
    """Return a text without byte order mark, with line feeds as line ends."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        data = data.decode("utf-16", "replace").encode()
    else:
        data = data.removeprefix(codecs.BOM_UTF8)
    return data.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in data else data


def decode_name(data: bytes) -> str:
    """Return a name decoded as UTF-8, or else as Latin-1."""
    try:
        return data.decode().strip()
    except UnicodeDecodeError:
        return data.decode("latin-1").strip()


def unquote_name(name: str) -> str:
    """Return a name without the quotation marks around it."""
    return name[1:-1] if len(name) > 2 and name[0] == name[-1] == '"' else name


def join_continued(text: bytes) -> bytes:
    r"""Return a text with lines that end in \ joined to the next; comment lines are not."""
    if b"\\" not in text:
        return text
    text = re.sub(rb"(?m)^[ \t]*#[^\n]*", b"", text)
    return re.sub(rb"\\[ \t]*\n", b" ", text)


def find_words(text: bytes) -> NDArray[np.int64]:
    """Return the position [W] of the first byte of each word."""
    is_word = IS_WORD[np.frombuffer(text, np.uint8)]
    return np.flatnonzero(is_word & ~np.append(False, is_word[:-1]))


def find_lines(text: bytes) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return `find_words`; the index of the first word [L], and the number of words [L], of lines.

    Lines without words are left out.
    """
    words = find_words(text)
    breaks = np.flatnonzero(np.frombuffer(text, np.uint8) == ord("\n"))
    first = np.searchsorted(words, np.append(0, breaks))
    counts = np.diff(np.append(first, len(words)))
    return words, first[counts > 0], counts[counts > 0]


def parse_numbers(text: bytes, count: int, dtype: type[T]) -> NDArray[T]:
    """Return the numbers of a text of exactly `count` words.

    Raises:
        Rejected: load_error where a word is no number of this kind.
    """
    if count == 0:
        return np.zeros(0, dtype)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)
            values = np.fromstring(text, dtype, sep=" ")
    except (ValueError, DeprecationWarning):
        values = np.zeros(0, dtype)
    if len(values) != count:
        kind = int if np.issubdtype(dtype, np.integer) else float
        word = next((word for word in text.split() if not _is_number(word, kind)), b"nothing")
        expected = "a whole number" if kind is int else "a number"
        raise Rejected("load_error", f"{word[:40]!r} stands where {expected} is expected")
    return values


def _is_number(word: bytes, kind: type) -> bool:
    try:
        kind(word)
    except ValueError:
        return False
    return b"_" not in word


def list_some(sentences: dict[str, int]) -> tuple[str, ...]:
    """Return the first sentences of a file, and the number of further ones."""
    listed = [text if count == 1 else f"{count} x {text}" for text, count in sentences.items()]
    more = len(listed) - _MOST_LISTED
    return (*listed[:_MOST_LISTED], *([f"{more} other things"] if more > 0 else []))
