"""A large JSON object, entry by entry: never more in memory than one value and a piece of text.

Values stay text: `storage.typed_json` reads each by its type.
"""

import codecs
import json
import re
from collections.abc import Iterator
from typing import BinaryIO

PIECE_BYTES = 1 << 20
_MOST_WAITING = 1 << 23
"""Maximum characters of one value."""
_SPACE = re.compile(r"[ \t\n\r]*")
_AFTER = tuple(", ]}:\t\n\r")
_DECODER = json.JSONDecoder()


def entries(stream: BinaryIO, listed: str) -> Iterator[tuple[str, str]]:
    """Yield name and text of the entries of an object.

    Args:
        stream: the object.
        listed: name of an array, of which each item comes apart.

    Raises:
        ValueError: the stream holds no JSON object, something after it, or too long a value.
        RecursionError: a value is nested too deeply.
    """
    text = _Text(stream)
    text.expect("{")
    while not text.took("}"):
        if text.next_mark() != '"':
            raise ValueError(f"{text.next_mark()!r} where a name is expected")
        name: str = json.loads(text.value())
        text.expect(":")
        if name == listed:
            text.expect("[")
            while not text.took("]"):
                yield name, text.value()
                text.comma_before("]")
        else:
            yield name, text.value()
        text.comma_before("}")
    if text.next_mark():
        raise ValueError(f"{text.next_mark()!r} after the end")


class _Text:
    """What has come of the stream and is not yet used up."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._decode = codecs.getincrementaldecoder("utf-8")().decode
        self._text = ""
        self._at = 0

    def next_mark(self) -> str:
        """Return the next character that is no space; nothing at the end."""
        while True:
            found = _SPACE.match(self._text, self._at)
            self._at = found.end() if found else self._at
            if self._at < len(self._text) or not self._more():
                return self._text[self._at : self._at + 1]

    def took(self, mark: str) -> bool:
        """Step over a mark, if it is the next one."""
        found = self.next_mark() == mark
        self._at += found
        return found

    def expect(self, mark: str) -> None:
        """Step over a mark; raises ValueError where another one stands."""
        if not self.took(mark):
            raise ValueError(f"{self.next_mark()!r} where {mark!r} is expected")

    def comma_before(self, end: str) -> None:
        """Step over the comma between two entries; before the end there must be none."""
        if self.next_mark() != end:
            self.expect(",")
            if self.next_mark() == end:
                raise ValueError(f"a comma before {end!r}")

    def value(self) -> str:
        """Return the text of the next value, when all of it has come."""
        self.next_mark()
        while True:
            try:
                _, end = _DECODER.raw_decode(self._text, self._at)
            except ValueError:
                if not self._more():
                    raise
                continue
            if self._text[end : end + 1] in _AFTER or not self._more():  # a number might go on
                text, self._at = self._text[self._at : end], end
                return text

    def _more(self) -> bool:
        """Read on, as much again as is waiting, so that a long value is not tried too often."""
        waiting = self._text[self._at :]
        if len(waiting) > _MOST_WAITING:
            raise ValueError(f"a value of more than {_MOST_WAITING} characters")
        piece = self._stream.read(max(PIECE_BYTES, len(waiting)))
        self._text, self._at = waiting + self._decode(piece, final=not piece), 0
        return bool(piece)
