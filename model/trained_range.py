"""What a network was trained on, as far as its checkpoint says: for warnings, not refusals."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass

from storage.errors import TrilightError

RANGE_KEY = "trilight_trained_range"
"""Metadata entry of a weights file."""

MAX_LIGHTS = 8
"""Emitting triangles of a training scene, at most: in the published data as in ours."""


@dataclass(frozen=True, kw_only=True)
class TrainedRange:
    """The largest scenes and the pictures of the training data; None where nobody said."""

    max_triangles: int | None = None
    """Of a whole scene."""
    resolution: int | None = None
    """Pixels across the pictures."""

    def as_metadata(self) -> dict[str, str]:
        """Return the entries for the metadata of a safetensors file."""
        return {RANGE_KEY: json.dumps(asdict(self), sort_keys=True)}


PUBLISHED_RANGE = TrainedRange(max_triangles=4096, resolution=512)
"""Of the published checkpoints: their second stage (Zeng et al. 2025)."""


def trained_range(metadata: Mapping[str, str]) -> TrainedRange | None:
    """Return what the metadata of a file says, or None where it says nothing.

    Raises:
        TrilightError: the entry is not readable.
    """
    if RANGE_KEY not in metadata:
        return None
    try:
        fields = json.loads(metadata[RANGE_KEY])
        known = {name: fields.get(name) for name in ("max_triangles", "resolution")}
        return TrainedRange(
            **{name: None if value is None else int(value) for name, value in known.items()}
        )
    except (AttributeError, TypeError, ValueError) as error:
        raise TrilightError(f"{RANGE_KEY}: not readable ({error}).") from error
