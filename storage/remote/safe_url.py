"""URLs and messages as they may be shown and stored: no names, passwords, tokens, queries."""

import re

_PARTS = re.compile(r"([A-Za-z][A-Za-z0-9+.\-]*)://([^/?#\\]*)([^?#]*)")
_URL_IN_TEXT = re.compile(r"[A-Za-z][A-Za-z0-9+.\-]*://[^\s<>]+")
_SECRET_FIELD = re.compile(
    r"(?i)([\w-]*(?:token|secret|passw|signature|credential|api_?key|access_?key)[\w-]*['\"]?"
    r"\s*[=:]\s*)(?:bearer\s+|basic\s+)?[^\s,;&]+"
)
_SECRET_WORD = re.compile(
    r"(?i)\b(?:(bearer|basic)\s+[\w.~+/=-]{6,}|hf_\w{16,}|(?:AKIA|ASIA)\w{12,})"
)
_SECRET_QUERY = re.compile(
    r"(?i)[?&#;][\w.-]*(?:token|secret|passw|sig|credential|key|auth|session)[\w.-]*="
)
HIDDEN = "..."
"""Stands for what was taken out."""


def safe_url(url: str) -> str:
    """Return `url` without user, password, query and fragment; other text comes back as it is.

    Where the host cannot be told from a password, as in `http://me:pass/word@host`, everything
    after the scheme is hidden. A secret within the path itself cannot be seen, and stays.
    """
    parts = _PARTS.match(url)
    if parts is None:
        return url
    scheme, authority, path = parts.groups()
    host = authority.rpartition("@")[2]
    _, colon, port = host.rpartition("]")[2].partition(":")
    if colon and port and not port.isdecimal():
        return f"{scheme}://{HIDDEN}"
    return f"{scheme}://{host}{path}"


def public_text(text: str) -> str:
    """Return text that a catalogue states, with nothing in its URLs that opens a place.

    Unlike `safe_text`, for what is published and followed: a query stays, since it may name the
    page (`?id=7`), unless one of its fields is called like a secret.
    """
    return _URL_IN_TEXT.sub(lambda match: _public_url(match[0]), text)


def _public_url(url: str) -> str:
    parts = _PARTS.match(url)
    safe = safe_url(url)
    rest = url[parts.end() :] if parts else ""
    return safe if safe.endswith(f"://{HIDDEN}") or _SECRET_QUERY.search(rest) else safe + rest


def safe_text(text: str) -> str:
    """Return a message with its URLs made safe and with what looks like a credential hidden.

    Meant for the errors of libraries, which like to quote the whole request.
    """
    text = _URL_IN_TEXT.sub(lambda match: safe_url(match[0]), text)
    text = _SECRET_FIELD.sub(lambda match: f"{match[1]}{HIDDEN}", text)
    return _SECRET_WORD.sub(HIDDEN, text)


def printable(text: str) -> str:
    r"""Return `text` with everything that is not printable written as an escape.

    File names may hold line breaks, control characters, or bytes that are not UTF-8, which Python
    keeps as lone surrogates that no encoder accepts: a byte 0xff becomes `\xff`, a line feed `\n`.
    """
    return "".join(
        character if character.isprintable() else _escape(character) for character in text
    )


def escape_lines(text: str) -> str:
    """Return text of several lines as `printable` does, with its line feeds."""
    return "\n".join(map(printable, text.split("\n")))


def _escape(character: str) -> str:
    code = ord(character)
    if 0xDC80 <= code <= 0xDCFF:
        return f"\\x{code - 0xDC00:02x}"
    return character.encode("unicode_escape").decode("ascii")
