"""Reading safetensors bytes from outside: the header is bounded before any memory is taken."""

import json

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load

from storage.errors import TrilightError

MAX_HEADER_BYTES = 1 << 20
"""A scene's header takes about 1 KiB."""


def read_safetensors(data: bytes) -> tuple[dict[str, NDArray], dict[str, str]]:
    """Return arrays and metadata of a safetensors file held in memory.

    Raises:
        TrilightError: the bytes are truncated, the header is larger than MAX_HEADER_BYTES, or the
            library refuses them (it checks every offset against the length of `data`).
    """
    length = int.from_bytes(data[:8], "little")
    if len(data) < 8 or length > min(MAX_HEADER_BYTES, len(data) - 8):
        raise TrilightError(
            f"safetensors: the header claims {length} bytes of a file of {len(data)}; expected at "
            f"most {MAX_HEADER_BYTES}. The file is damaged: run `trilight verify` on its dataset."
        )
    try:
        header = json.loads(data[8 : 8 + length])
        arrays = load(data)
    except (SafetensorError, ValueError) as error:
        raise TrilightError(f"safetensors: unreadable ({error}); run `trilight verify`.") from error
    metadata = header.get("__metadata__", {})
    return {name: np.asarray(array) for name, array in arrays.items()}, metadata
