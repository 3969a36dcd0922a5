"""Who may ask the server: this machine's user, who has the address, and no page of another origin.

The address holds a password, as the first part of every path. A browser sends the name of the host
that it believes to talk to, and the origin of the page that asks: both must be ours, so that a page
whose name was pointed here, or that guesses the port, gets nothing.
"""

import hmac
import secrets
from collections.abc import Iterable
from dataclasses import dataclass
from http import HTTPStatus

HOST = "127.0.0.1"
"""Where the server listens: this machine alone."""

_ONCE = ("host", "origin", "sec-fetch-site", "sec-fetch-dest", "content-length")
"""Headers that decide about a request: of two, another program might believe the other one."""

MAX_PATH = 4096
"""Most characters of a path with its query."""

MAX_BODY_BYTES = 1 << 18
"""Largest request."""

SAFE_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}
"""Of every answer. None names another origin that might read it."""


def new_word() -> str:
    """Return a password for an address."""
    return secrets.token_urlsafe(24)


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """Why a request gets nothing."""

    status: HTTPStatus
    sentence: str
    """For a person."""


def refusal(
    method: str, path: str, pairs: Iterable[tuple[str, str]], *, port: int, word: str
) -> Refusal | None:
    """Return why a request is refused, or None where it may pass.

    Args:
        method: GET or POST.
        path: as it was sent, with its query.
        pairs: headers of the request, names in any case.
        port: at which the server listens.
        word: password of the address.
    """
    here = f"{HOST}:{port}"
    pairs = [(name.lower(), value) for name, value in pairs]
    headers = dict(pairs)
    if len(path) > MAX_PATH:
        return Refusal(status=HTTPStatus.REQUEST_URI_TOO_LONG, sentence="The address is too long.")
    if any([name for name, _ in pairs].count(name) > 1 for name in _ONCE):
        return Refusal(status=HTTPStatus.BAD_REQUEST, sentence="A header is there twice.")
    if headers.get("host") != here:
        return _forbidden(f"Only http://{here} is answered, and no other name of this machine.")
    origin = headers.get("origin")
    site = headers.get("sec-fetch-site", "none")
    # a link with the whole address may stand anywhere: who follows it leaves the other page
    followed = method == "GET" and headers.get("sec-fetch-dest") == "document"
    near = site in ("none", "same-origin") or followed
    if origin not in (None, f"http://{here}") or not near:
        return _forbidden("Pages of other origins are not answered.")
    if method == "POST" and origin is None:
        return _forbidden("The request does not say from which page it comes.")
    given = path.split("?")[0].removeprefix("/").split("/")[0]
    if not hmac.compare_digest(given.encode(), word.encode()):
        return _forbidden("Open the whole address that `trilight view` printed.")
    if method == "POST":
        return _too_large(headers.get("content-length", ""))
    return None


def _too_large(length: str) -> Refusal | None:
    if not (length.isascii() and length.isdecimal()):
        return Refusal(status=HTTPStatus.LENGTH_REQUIRED, sentence="The request has no length.")
    if len(length) > 9 or int(length) > MAX_BODY_BYTES:
        return Refusal(
            status=HTTPStatus.REQUEST_ENTITY_TOO_LARGE, sentence="The request is too large."
        )
    return None


def _forbidden(sentence: str) -> Refusal:
    return Refusal(status=HTTPStatus.FORBIDDEN, sentence=sentence)
