"""URLs of files and folders on servers: which are admitted, and the fsspec driver of each.

URLs and messages may be shown and stored once they hold no names, passwords, tokens or queries.
"""

import base64
import dataclasses
import functools
import importlib
import logging
import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, quote, unquote

from storage.errors import TrilightError

PACKAGES = {
    "http": "aiohttp",
    "https": "aiohttp",
    "s3": "s3fs",
    "gs": "gcsfs",
    "hf": "huggingface_hub",
}
"""Schemes that are read, and the package that reads each."""

_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+.\-]*)://(.*)", re.DOTALL)
_BRACKETED_HOST = re.compile(r"\[[0-9A-Fa-f:.]*\]")
_ADMITTED = "expected a path, or a URL of http, https, s3, gs, hf or file"
_CONNECT_S = 20.0
_SILENCE_S = 60.0
_ANSWER_S = 300.0
"""For all of an answer that is no file, such as a listing, however slowly its bytes trickle."""

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


@dataclass(frozen=True, kw_only=True)
class RemoteUrl:
    """A folder or file on a server."""

    what: str = field(compare=False)
    """Name of the resource in messages, such as `objects`."""
    scheme: str
    root: str
    """Path as the driver takes it: no secrets, query or final slash."""
    query: tuple[tuple[str, str], ...] = field(default=(), repr=False)
    """Sent with every request, since it may hold the key; http and https only."""
    user: str = field(default="", repr=False)
    password: str = field(default="", repr=False)
    """Sent with every request; http and https only."""

    @property
    def is_http(self) -> bool:
        """True: the scheme is http or https; file names in such URLs are quoted."""
        return self.scheme in ("http", "https")

    @property
    def display_url(self) -> str:
        """The URL without secrets, for messages and for the names of cached files."""
        return printable(self.root if self.is_http else f"{self.scheme}://{self.root}")

    def child(self, name: str) -> "RemoteUrl":
        """Return a file below this folder by its name, which must be a safe one."""
        # bytes that are not UTF-8 are lone surrogates in `name`
        inner = quote(name, errors="surrogateescape") if self.is_http else name
        return dataclasses.replace(self, root=f"{self.root}/{inner}")


def parse_url(source: str, *, what: str) -> RemoteUrl | Path:
    """Return where something is: on this machine, or on a server.

    Args:
        source: a path, or a URL.
        what: begins every message, such as `objects`.

    It raises TrilightError for a URL that is chained (`::`), runs a program (`pipe:`), has a scheme
    that is not admitted, names no host or bucket, or holds a password where none is read.
    """
    url_text = printable(safe_text(source))
    if source.startswith("pipe:"):
        raise TrilightError(f"{what} is a pipe: command; {_ADMITTED}. Programs are not run.")
    if "://" in source and "::" in _BRACKETED_HOST.sub("", source):
        raise TrilightError(f"{what} {url_text!r} is chained with '::'; {_ADMITTED}, on its own.")
    match = _SCHEME.match(source)
    if match is None:
        return parse_local_path(source)
    scheme = match[1].lower()
    rest = match[2]
    if scheme == "file":
        host, slash, path = rest.partition("/")
        if host not in ("", "localhost") or not slash:
            raise TrilightError(
                f"{what} {url_text!r}; expected file:///FOLDER, with three slashes."
            )
        return Path("/" + unquote(path))
    if scheme not in PACKAGES:
        raise TrilightError(
            f"{what} {url_text!r} has the scheme {printable(scheme)!r}; {_ADMITTED}."
        )
    _, at, host = rest.partition("/")[0].rpartition("@")
    if not host:
        raise TrilightError(f"{what} {url_text!r} names no host or bucket; {_ADMITTED}.")
    if scheme in ("http", "https"):
        return _http(scheme, rest, what)
    if at:
        raise TrilightError(
            f"{what} {url_text!r} came with a user or password; expected none in URLs of {scheme}. "
            f"Give them in the way of {PACKAGES[scheme]}, such as by its environment variables."
        )
    return RemoteUrl(what=what, scheme=scheme, root=rest.strip("/"))


def parse_local_path(text: str) -> Path:
    """Return a path as people type it: `~` is the home directory, `./~` a folder of that name.

    The text of the result means the same path again.
    """
    path = Path(os.path.expanduser(text))
    return path.absolute() if str(path).startswith("~") else path


def open_driver(url: RemoteUrl) -> Any:
    """Return the fsspec file system that reads a folder; it keeps no listings.

    Raises:
        TrilightError: its package is not installed; names the package.
    """
    package = PACKAGES[url.scheme]
    try:
        importlib.import_module(package)
        import fsspec
    except ImportError as error:
        raise TrilightError(
            f"{url.what} {url.display_url!r}: {url.scheme}:// needs the package {package}; "
            f"expected it to be installed. Run pip install {package}."
        ) from error
    # Drivers log whole requests, with their secrets, on the way to an error that we report anyway.
    logging.getLogger(package).setLevel(logging.CRITICAL)
    options = _http_options(url) if url.is_http else {}
    return fsspec.filesystem(
        url.scheme, skip_instance_cache=True, use_listings_cache=False, **options
    )


def shared_driver(url: RemoteUrl) -> Any:
    """Return the driver that all files of a host or bucket share, so that connections last."""
    place, slash, rest = url.root.partition("://")
    host = place + slash + rest.partition("/")[0] if url.is_http else place.partition("/")[0]
    return _driver_of(dataclasses.replace(url, root=host), os.getpid())


@functools.lru_cache(maxsize=16)
def _driver_of(access: RemoteUrl, process: int) -> Any:
    """A driver made before a fork cannot be used after it, hence `process`."""
    return open_driver(access)


def transfer_timeout(total_s: float | None = None) -> Any:
    """Return the limits of a request; storage.remote.transfers bounds one for a file as a whole."""
    import aiohttp

    return aiohttp.ClientTimeout(
        total=total_s, connect=_CONNECT_S, sock_connect=_CONNECT_S, sock_read=_SILENCE_S
    )


def _http_options(url: RemoteUrl) -> dict[str, Any]:
    # Sizes are compared with what the server announced, so nothing may be packed on the way.
    headers = {"Accept-Encoding": "identity"}
    if url.user or url.password:
        # As a header it is taken off where a server sends us to another one; the session's own
        # `auth` would go along.
        access = base64.b64encode(f"{url.user}:{url.password}".encode()).decode()
        headers["Authorization"] = f"Basic {access}"
    client = {"timeout": transfer_timeout(_ANSWER_S), "headers": headers, "trust_env": True}
    options: dict[str, Any] = {"client_kwargs": client, "simple_links": False}
    if url.query:
        options["params"] = list(url.query)
    return options


def _http(scheme: str, rest: str, what: str) -> RemoteUrl:
    rest = rest.partition("#")[0]
    rest, _, query = rest.partition("?")
    authority, slash, path = rest.partition("/")
    access, _, host = authority.rpartition("@")
    user, _, password = access.partition(":")
    return RemoteUrl(
        what=what,
        scheme=scheme,
        # A percent sign stays, since the path may be quoted already.
        root=f"{scheme}://{host}{slash}{quote(path, safe='/%:@!$&()*+,;=~')}".rstrip("/"),
        query=tuple(parse_qsl(query, keep_blank_values=True)),
        user=unquote(user),
        password=unquote(password),
    )


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
