"""OpenEXR files that speak of more pixels than a picture has are refused before they take memory.

A process of their own reads them and says how much its memory grew at most.
"""

import io
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from storage.errors import TrilightError
from storage.records.exr import decode_exr, encode_channels, encode_exr
from storage.records.lights import MAX_LIGHTS, decode_lights_exr, encode_lights_exr
from tests.conftest import ROOT

_SIZE = 2048
"""A plane of half floats takes 8 MiB, and in a file of zeros 9 kB."""

_MOST_GROWTH_MB = 24
"""Reading the headers alone took 1 MB here; three planes would take 24 and their copy 48."""

_CHILD = """
import resource, sys
from pathlib import Path
from storage.errors import TrilightError
from storage.records.exr import decode_exr
from storage.records.lights import decode_lights_exr
for path, read_as in zip(sys.argv[1::2], sys.argv[2::2]):
    data = Path(path).read_bytes()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        decode_lights_exr(data, (2, 2048, 2048)) if read_as == "lights" else decode_exr(data)
    except TrilightError as error:
        print(error)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    print(grown // 1024)
"""


def _planes(names: list[str]) -> dict[str, np.ndarray]:
    return dict.fromkeys(names, np.zeros((_SIZE, _SIZE), np.float16))


def _halves(*names: str) -> bytes:
    return encode_channels(_planes(list(names)))


def _second_part() -> bytes:
    small = {"RGB": np.zeros((8, 8, 3), np.float16)}
    shown = (np.array([0, 0], np.int32), np.array([_SIZE - 1, _SIZE - 1], np.int32))
    parts = [
        OpenEXR.Part({"displayWindow": shown}, small, "a"),
        OpenEXR.Part({"displayWindow": shown}, _planes(["R", "G", "B"]), "b"),
    ]
    stream = io.BytesIO()
    OpenEXR.File(parts, num_threads=0).write(stream)
    return stream.getvalue()


def _deep_pixels() -> bytes:
    """Return a file of 64 pixels, each of which holds 100,000 values of each channel."""
    deep = np.full((8, 8), None, object)
    for pixel in np.ndindex(8, 8):
        deep[pixel] = np.zeros(100_000, np.float16)
    stream = io.BytesIO()
    header = {"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION}
    OpenEXR.File(header, dict.fromkeys("RGB", deep), num_threads=0).write(stream)
    return stream.getvalue()


MANY = [f"c{i}" for i in range(16)]
HOSTILE: list[tuple[Callable[[], bytes], str, str]] = [
    (lambda: _halves(*"RGB", *MANY[3:]), "picture", "expected B, G, R."),
    (lambda: _halves(*MANY), "picture", "channels are c0, c1, c10, c11, c12, c13 and 10 more"),
    (lambda: _halves(*MANY), "lights", "expected light0.B"),
    (_second_part, "picture", "the file has 2 parts; expected one"),
    (_deep_pixels, "picture", "deepscanline; expected lines or tiles"),
]


def test_what_is_not_expected_takes_no_memory(tmp_path: Path) -> None:
    """Not even the most that a process ever took: so one process may read all of them."""
    words: list[str] = []
    for number, (made, read_as, _) in enumerate(HOSTILE):
        path = tmp_path / f"{number}.exr"
        path.write_bytes(made())
        words += [str(path), read_as]
    child = subprocess.run(
        [sys.executable, "-c", _CHILD, *words], cwd=ROOT, capture_output=True, text=True, check=True
    )
    lines = child.stdout.splitlines()
    assert len(lines) == 2 * len(HOSTILE)
    for (_, _, said), message, grown_mb in zip(HOSTILE, lines[::2], lines[1::2], strict=True):
        assert said in message
        assert int(grown_mb) < _MOST_GROWTH_MB, message


def _with_window(data: bytes, height: int, width: int) -> bytes:
    """Return a file whose header speaks of so many pixels; those of the file stay as they are."""
    key = b"dataWindow\0box2i\0"
    at = data.index(key) + len(key) + 4
    return data[:at] + struct.pack("<4i", 0, 0, width - 1, height - 1) + data[at + 16 :]


def test_bytes_are_bounded_by_what_is_expected() -> None:
    lights = encode_lights_exr(np.zeros((MAX_LIGHTS, 8, 8, 3), np.float32))
    with pytest.raises(
        TrilightError, match=r"192 channels of \[4096, 4096\] pixels may take 128849"
    ):
        decode_lights_exr(_with_window(lights, 4096, 4096), (MAX_LIGHTS, 4096, 4096))
    # What the renderer writes at most is not refused for its size, but for its missing pixels.
    with pytest.raises(TrilightError, match="not a readable OpenEXR file|a channel is no"):
        decode_lights_exr(_with_window(lights, 2048, 2048), (MAX_LIGHTS, 2048, 2048))
    with pytest.raises(TrilightError, match=r"^lights: \[1000001, 1000001\] pixels"):
        decode_lights_exr(_with_window(lights, 1_000_001, 1_000_001), (MAX_LIGHTS, 8, 8))
    picture = encode_exr(np.zeros((16, 16, 3), np.float32))
    with pytest.raises(TrilightError, match="data window spans|not a readable"):
        decode_exr(_with_window(picture, 1_000_001, 1_000_001))
