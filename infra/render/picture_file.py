"""EXR file of a picture; by the header an equal picture is kept instead of rendered again."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.atomic import write_atomically
from storage.digests import canonical_json, sha256_hex
from storage.errors import TrilightError
from storage.records.exr import decode_picture, encode_picture, read_header
from storage.records.lights import rounded_to_half
from storage.records.safe_read import read_plain
from storage.renderer import Camera, Fact, Facts, Image, Renderer

Radiance = NDArray[np.float32]
"""[R, R, 3] linear radiance."""

_PREFIX = "trilight."
_REQUEST = "request_sha256"


@dataclass(frozen=True, kw_only=True)
class PictureFile:
    """Picture on disk, without its pixels, since a video may have thousands."""

    path: Path
    facts: Facts
    was_kept: bool
    """True where an equal file existed already."""
    is_black: bool
    seconds: float | None
    """Wall-clock seconds of rendering, those of loading the scene included for its first picture;
    None where the file was kept."""


def header_of(
    renderer: Renderer, source: str, scene_sha256: str, camera: Camera
) -> Mapping[str, Fact]:
    """Return the header of a picture, without times and folders: everything that decides it.

    Args:
        source: name of the scene's file, without its folders.
        scene_sha256: digest of the scene by storage.records.scene_file.scene_digest.
    """
    pose: dict[str, Any] = {"c2w": camera.c2w.tolist(), "fov_deg": camera.fov_deg}
    values = {
        "engine": renderer.name,
        "source": source,
        "scene_sha256": scene_sha256,
        "camera": pose if camera.view is None else {**pose, "view": camera.view},
        **renderer.identity,
    }
    plain = {
        name: value if isinstance(value, Fact) else canonical_json(value).decode()
        for name, value in values.items()
    }
    return {**plain, _REQUEST: sha256_hex(canonical_json(values))}


def load_matching_picture(
    path: Path, header: Mapping[str, Fact]
) -> tuple[PictureFile, Radiance] | None:
    """Return the picture in a file if its header matches; else, or if it is unreadable, None."""
    try:
        data = read_plain(path)
        stored = read_header(data)
        if stored.get(_PREFIX + _REQUEST) != header[_REQUEST]:
            return None
        names = {channel.name.rpartition(".")[0] for channel in stored["channels"]}
        radiance_rgb = decode_picture(data, names - {""})
    except (OSError, RuntimeError, ValueError, TrilightError):
        return None
    described = {_PREFIX + name for name in header}
    facts = {
        name.removeprefix(_PREFIX): value
        for name, value in stored.items()
        if name.startswith(_PREFIX) and name not in described
    }
    return _picture_file(path, facts, radiance_rgb, None), radiance_rgb


def write_picture(
    path: Path, header: Mapping[str, Fact], image: Image, facts: Facts, seconds: float
) -> tuple[PictureFile, Radiance]:
    """Write a picture with its facts, and return it as the file holds it.

    Equal headers and pictures give equal bytes.

    Raises:
        TrilightError: a value is not finite, or the file cannot be written.
    """
    named = {_PREFIX + name: value for name, value in (dict(header) | dict(facts)).items()}
    write_atomically(path, encode_picture(image.radiance_rgb, image.layers_rgb, named))
    radiance_rgb = rounded_to_half(image.radiance_rgb)
    return _picture_file(path, facts, radiance_rgb, seconds), radiance_rgb


def _picture_file(
    path: Path, facts: Facts, radiance_rgb: Radiance, seconds: float | None
) -> PictureFile:
    return PictureFile(
        path=path,
        facts=dict(facts),
        was_kept=seconds is None,
        is_black=not radiance_rgb.any(),
        seconds=seconds,
    )
