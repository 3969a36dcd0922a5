"""URLs of remote folders: which are admitted, and the driver that reads each."""

import base64
import importlib
import logging
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, quote, unquote

from pipeline.objects.names import printable
from storage.errors import TrilightError
from storage.safe_url import safe_text

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
_ADMITTED = "expected a folder, or a URL of http, https, s3, gs, hf or file"
_CONNECT_S = 20.0
_SILENCE_S = 60.0
_WHOLE_FILE_S = 3600.0
"""However slowly the bytes of one file trickle, it ends then."""


@dataclass(frozen=True, kw_only=True)
class RemoteUrl:
    """A folder on a server."""

    scheme: str
    """A key of PACKAGES."""
    root: str
    """What the driver calls the folder: without secrets, query and final slash."""
    query: tuple[tuple[str, str], ...] = field(default=(), repr=False)
    """Sent with every request, since it may hold the key to the folder; http and https only."""
    user: str = field(default="", repr=False)
    """Sent with every request; http and https only."""
    password: str = field(default="", repr=False)
    """Sent with every request; http and https only."""

    @property
    def is_http(self) -> bool:
        """Names of files in URLs of http are quoted; those of buckets are as they are."""
        return self.scheme in ("http", "https")

    @property
    def shown(self) -> str:
        """The folder for people, and for naming what is kept of it."""
        return printable(self.root if self.is_http else f"{self.scheme}://{self.root}")


def parse_source(source: str) -> RemoteUrl | Path:
    """Return where a source is: a folder of this machine, or one on a server.

    Raises:
        TrilightError: the URL is chained (`::`), runs a program (`pipe:`), has a scheme that is not
            admitted, names no host or bucket, or holds a password where none is read.
    """
    shown = printable(safe_text(source))
    if source.startswith("pipe:"):
        raise TrilightError(f"objects is a pipe: command; {_ADMITTED}. Programs are not run.")
    if "://" in source and "::" in _BRACKETED_HOST.sub("", source):
        raise TrilightError(f"objects {shown!r} is chained with '::'; {_ADMITTED}, on its own.")
    match = _SCHEME.match(source)
    if match is None:
        return Path(source).expanduser()
    scheme, rest = match[1].lower(), match[2]
    if scheme == "file":
        return _local(rest, shown)
    if scheme not in PACKAGES:
        raise TrilightError(f"objects {shown!r} has the scheme {printable(scheme)!r}; {_ADMITTED}.")
    if not rest.partition("/")[0].rpartition("@")[2]:
        raise TrilightError(f"objects {shown!r} names no host or bucket; {_ADMITTED}.")
    return _http(scheme, rest) if scheme in ("http", "https") else _bucket(scheme, rest, shown)


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
            f"objects {url.shown!r}: {url.scheme}:// needs the package {package}; expected it to "
            f"be installed. Run pip install {package}."
        ) from error
    # Drivers log whole requests, with their secrets, on the way to an error that we report anyway.
    logging.getLogger(package).setLevel(logging.CRITICAL)
    options = _http_options(url) if url.is_http else {}
    return fsspec.filesystem(
        url.scheme, skip_instance_cache=True, use_listings_cache=False, **options
    )


def _http_options(url: RemoteUrl) -> dict[str, Any]:
    import aiohttp

    # Sizes are compared with what the server announced, so nothing may be packed on the way.
    headers = {"Accept-Encoding": "identity"}
    if url.user or url.password:
        # As a header it is taken off where a server sends us to another one; the session's own
        # `auth` would go along.
        access = base64.b64encode(f"{url.user}:{url.password}".encode()).decode()
        headers["Authorization"] = f"Basic {access}"
    client = {
        "timeout": aiohttp.ClientTimeout(
            total=_WHOLE_FILE_S,
            connect=_CONNECT_S,
            sock_connect=_CONNECT_S,
            sock_read=_SILENCE_S,
        ),
        "headers": headers,
        "trust_env": True,
    }
    options: dict[str, Any] = {"client_kwargs": client, "simple_links": False}
    if url.query:
        options["params"] = list(url.query)
    return options


def _http(scheme: str, rest: str) -> RemoteUrl:
    rest = rest.partition("#")[0]
    rest, _, query = rest.partition("?")
    authority, slash, path = rest.partition("/")
    access, _, host = authority.rpartition("@")
    user, _, password = access.partition(":")
    return RemoteUrl(
        scheme=scheme,
        # A percent sign stays, since the path may be quoted already.
        root=f"{scheme}://{host}{slash}{quote(path, safe='/%:@!$&()*+,;=~')}".rstrip("/"),
        query=tuple(parse_qsl(query, keep_blank_values=True)),
        user=unquote(user),
        password=unquote(password),
    )


def _bucket(scheme: str, rest: str, shown: str) -> RemoteUrl:
    if "@" in rest.partition("/")[0]:
        raise TrilightError(
            f"objects {shown!r} came with a user or password; expected none in URLs of {scheme}. "
            f"Give them in the way of {PACKAGES[scheme]}, such as by its environment variables."
        )
    return RemoteUrl(scheme=scheme, root=rest.strip("/"))


def _local(rest: str, shown: str) -> Path:
    host, slash, path = rest.partition("/")
    if host not in ("", "localhost") or not slash:
        raise TrilightError(f"objects {shown!r}; expected file:///FOLDER, with three slashes.")
    return Path("/" + unquote(path))
