"""Names from outside as text that can be shown, stored and hashed."""


def printable(text: str) -> str:
    r"""Return `text` with everything that is not printable written as an escape.

    File names may hold line breaks, control characters, or bytes that are not UTF-8, which Python
    keeps as lone surrogates that no encoder accepts: a byte 0xff becomes `\xff`, a line feed `\n`.
    """
    return "".join(
        character if character.isprintable() else _escape(character) for character in text
    )


def _escape(character: str) -> str:
    code = ord(character)
    if 0xDC80 <= code <= 0xDCFF:
        return f"\\x{code - 0xDC00:02x}"
    return character.encode("unicode_escape").decode("ascii")
