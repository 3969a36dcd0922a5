"""Decodes untrusted pictures of scenes; sizes are checked before any allocation."""

import contextlib
from collections.abc import Iterator

from numpy.typing import NDArray

from pipeline.foreign.picture import decode_image, read_linear_picture
from storage.errors import Rejected, TrilightError

MAX_BYTES = 256 << 20
MAX_PIXELS = 64 << 20
"""Maximum size of one picture."""


def decode_values(data: bytes, name: str, lost: list[str]) -> NDArray:
    """Return the values [H, W, 4] of a texture, as `decode_image`; `lost` receives its notes.

    Raises:
        Rejected: the bytes are no picture.
        TrilightError: the picture has more pixels than MAX_PIXELS.
    """
    with _refuse_large(""):
        return decode_image(data, name, MAX_PIXELS, lost, replaces_nan=True)


def decode_pixels(data: bytes, name: str, lost: list[str]) -> NDArray | None:
    """Return a picture [H, W, C], the top row first; None where the bytes are not one.

    OpenEXR and Radiance are linear float32 of 1 to 4 channels; others are as `decode_image`.
    Messages call it `name`; `lost` receives a sentence for each unsupported feature.

    Raises:
        TrilightError: the picture has more pixels than MAX_PIXELS.
    """
    try:
        with _refuse_large(name):
            picture = read_linear_picture(data, MAX_PIXELS)
            if picture is None:
                return decode_image(data, name, MAX_PIXELS, lost, replaces_nan=True)[::-1]
    except Rejected as error:
        lost.append(f"{name!r:.100}: {error.message}")
        return None
    lost += [f"{name!r:.100}: {sentence}" for sentence in picture.unread]
    return picture.values


@contextlib.contextmanager
def _refuse_large(name: str) -> Iterator[None]:
    """Raise TrilightError for a picture of too many pixels."""
    try:
        yield
    except Rejected as error:
        if error.reason not in ("too_many_pixels", "texture_too_large"):
            raise
        stated, is_left, _ = error.message.partition("; at most ")
        text = f"{stated} pixels; expected at most {MAX_PIXELS}" if is_left else error.message
        text = f"{text}." if not name or name in text else f"{name}: {text}."
        raise TrilightError(text) from error
