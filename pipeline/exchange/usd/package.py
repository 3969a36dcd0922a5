"""`.usdz`: a zip archive whose members are stored plainly, each beginning at a multiple of 64."""

import io
import zipfile

ALIGNMENT = 64
LAYER_NAME = "scene.usdc"

_HEADER_BYTES = 30
_PADDING_ID = 0x1986
"""Of the extra field that moves a member's bytes to where they must begin; readers skip it."""


def packaged(layer: bytes) -> bytes:
    """Return the `.usdz` of one `.usdc` layer; no clock and no host is in it."""
    entry = zipfile.ZipInfo(LAYER_NAME, date_time=(1980, 1, 1, 0, 0, 0))
    begin = _HEADER_BYTES + len(LAYER_NAME)
    padding = -(begin + 4) % ALIGNMENT
    entry.extra = _PADDING_ID.to_bytes(2, "little") + padding.to_bytes(2, "little") + bytes(padding)
    entry.external_attr = 0o644 << 16
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(entry, layer)
    return stream.getvalue()
