"""Codecs of pictures: bytes, time to pack and unpack, and error against the noise floor."""

import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from storage.metrics import psnr_log_db
from storage.records.exr import ExrCodec, decode_exr, encode_exr
from storage.records.profiles import LAW_DB, PROFILES, pack_picture
from storage.records.sample import Sample

Picture = NDArray[np.float32]

EXACT = ("NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "ZSTD", "HTJ2K32", "HTJ2K256")
LOSSY = ("B44", "B44A", "LJ2K")
LEVELS = {"DWAA": (20, 45, 100, 200), "DWAB": (5, 10, 20, 45, 100, 200, 400)}
"""What OpenEXR 3.5.3's Python module offers; of the levels only DWA's can be set through it."""


@dataclass(frozen=True, kw_only=True)
class PictureCodec:
    """One way to pack a picture."""

    encode: Callable[[Picture, float], bytes]
    """From the picture and its noise floor in dB."""
    decode: Callable[[bytes, tuple[int, ...]], Picture]
    """From the bytes and the shape."""


def codecs() -> Mapping[str, PictureCodec]:
    """Return every codec by the name that tables show."""
    plain = {
        "raw half floats": PictureCodec(encode=lambda p, _: _half(p), decode=_from_half),
        "raw half floats, deflate": PictureCodec(
            encode=lambda p, _: zlib.compress(_half(p), 6),
            decode=lambda data, shape: _from_half(zlib.decompress(data), shape),
        ),
    }
    chosen = {name: ExrCodec(compression=name) for name in (*EXACT, *LOSSY)}
    for name, levels in LEVELS.items():
        chosen |= {
            f"{name} {level}": ExrCodec(compression=name, dwa_level=level) for level in levels
        }
    profiles = {
        f"profile {name}": PictureCodec(
            encode=lambda p, floor_db, name=name: pack_picture(p, floor_db, name),  # type: ignore[misc]
            decode=lambda data, _: decode_exr(data),
        )
        for name in PROFILES
    }
    return plain | {name: _exr(codec) for name, codec in chosen.items()} | profiles


def _exr(codec: ExrCodec) -> PictureCodec:
    return PictureCodec(
        encode=lambda p, _: encode_exr(p, codec), decode=lambda data, _: decode_exr(data)
    )


def _half(picture: Picture) -> bytes:
    return picture.astype(np.float16).tobytes()


def _from_half(data: bytes, shape: tuple[int, ...]) -> Picture:
    return np.frombuffer(data, np.float16).reshape(shape).astype(np.float32)


def picture_figures(codec: PictureCodec, samples: Sequence[Sample]) -> Mapping[str, float]:
    """Pack and unpack every view of the samples, in one thread."""
    views = [
        (picture, record.noise_floor_db)
        for sample in samples
        for picture, record in zip(sample.radiance_rgb, sample.views, strict=True)
    ]
    started = time.process_time()
    packed = [codec.encode(picture, floor_db) for picture, floor_db in views]
    encoded = time.process_time()
    stored = [
        codec.decode(data, picture.shape) for data, (picture, _) in zip(packed, views, strict=True)
    ]
    decoded = time.process_time()
    return {
        "bytes": float(np.mean([len(data) for data in packed])),
        "encode_ms": 1000 * (encoded - started) / len(views),
        "decode_ms": 1000 * (decoded - encoded) / len(views),
        **_errors(views, stored),
    }


def _errors(
    views: Sequence[tuple[Picture, float]], stored: Sequence[Picture]
) -> Mapping[str, float]:
    """Return how far the error is below the noise floor, over the views."""
    below = [
        psnr_log_db(picture, back) - floor_db
        for (picture, floor_db), back in zip(views, stored, strict=True)
    ]
    return {
        "below_floor_p5_db": float(np.percentile(below, 5)),
        "lawful": float(np.mean([value >= LAW_DB for value in below])),
    }
