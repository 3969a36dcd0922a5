"""Writers of PNG, TIFF and JSON files for the exports."""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.documents.png import encode_png
from storage.atomic import write_atomically
from storage.conventions import preview_srgb8
from storage.records.sample import Sample


def write_png(path: Path, sample: Sample, view: int) -> None:
    """Write the picture of a view as 8-bit sRGB; radiance above 1 is clipped."""
    write_atomically(path, encode_png(preview_srgb8(sample.radiance_rgb[view])))


def write_tiff(path: Path, values: NDArray[np.float32] | NDArray[np.int32]) -> None:
    """Write one value for each pixel [R, R] as a lossless 32-bit TIFF."""
    stream = io.BytesIO()
    Image.fromarray(values).save(stream, "TIFF")
    write_atomically(path, stream.getvalue())


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file and keep the order of its keys."""
    write_atomically(path, (json.dumps(value, allow_nan=False) + "\n").encode())
