"""Guard of the page server: refuses requests without the address's token or from other origins.

The address holds a secret token, as the first component of every path. A browser sends the host
name of its request and the origin of the requesting page. Both must be those of this server, so
that DNS rebinding and a guessed port fail.
"""

import hmac
import secrets
from collections.abc import Iterable
from dataclasses import dataclass
from http import HTTPStatus

HOST = "127.0.0.1"
"""Address of the server, which only this machine reaches."""

_ONCE = ("host", "origin", "sec-fetch-site", "sec-fetch-dest", "content-length")
"""Headers that may stand only once, since another program might read the other one of two."""

MAX_PATH = 4096
"""Maximum number of characters of a path with its query."""

MAX_BODY_BYTES = 1 << 18
"""Maximum size of a request's body in bytes."""

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
"""Headers of every response; none lets another origin read it."""


def new_token() -> str:
    """Return a new secret token for an address."""
    return secrets.token_urlsafe(24)


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """Status and reason of a refused request."""

    status: HTTPStatus
    sentence: str
    """Reason as a sentence that the page shows."""


def refusal(
    method: str, path: str, pairs: Iterable[tuple[str, str]], *, port: int, token: str
) -> Refusal | None:
    """Return why a request is refused, or None where it is allowed.

    Args:
        method: GET or POST.
        path: path as it was sent, with its query.
        pairs: headers of the request, names in any case.
        port: port of the server.
        token: secret token of the address.
    """
    server_address = f"{HOST}:{port}"
    pairs = [(name.lower(), value) for name, value in pairs]
    headers = dict(pairs)
    if len(path) > MAX_PATH:
        return Refusal(status=HTTPStatus.REQUEST_URI_TOO_LONG, sentence="The address is too long.")
    if any([name for name, _ in pairs].count(name) > 1 for name in _ONCE):
        return Refusal(status=HTTPStatus.BAD_REQUEST, sentence="A header is there twice.")
    if headers.get("host") != server_address:
        return _forbidden(
            f"Only http://{server_address} is answered, and no other name of this machine."
        )
    origin = headers.get("origin")
    site = headers.get("sec-fetch-site", "none")
    # a followed link with the whole address is allowed: the browser leaves the other page
    followed = method == "GET" and headers.get("sec-fetch-dest") == "document"
    near = site in ("none", "same-origin") or followed
    if origin not in (None, f"http://{server_address}") or not near:
        return _forbidden("Pages of other origins are not answered.")
    if method == "POST" and origin is None:
        return _forbidden("The request does not say from which page it comes.")
    sent_token = path.split("?")[0].removeprefix("/").split("/")[0]
    if not hmac.compare_digest(sent_token.encode(), token.encode()):
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
