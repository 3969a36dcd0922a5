"""EXR file of a picture; by the header an equal picture is kept instead of rendered again."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from infra.render.cameras import ShotCamera
from infra.render.engines import Fact, Facts, Rendered
from storage.atomic import write_atomically
from storage.digests import canonical_json, sha256_hex
from storage.errors import TrilightError
from storage.records.exr import read_header
from storage.records.layers import decode_picture, encode_picture
from storage.records.lights import rounded_to_half
from storage.records.safe_read import read_plain

Radiance = NDArray[np.float32]
"""[R, R, 3] linear radiance."""

_PREFIX = "trilight."
_REQUEST = "request_sha256"


@dataclass(frozen=True, kw_only=True, eq=False)
class PictureKey:
    """Everything that decides a picture."""

    engine: str
    """Name of the engine, as in `--engine`."""
    identity: Mapping[str, Any]
    """Everything but scene and camera that decides the picture, as JSON values."""
    source: str
    """Name of the scene's file, without its folders."""
    scene_sha256: str
    """Digest of the scene by storage.records.scene_file.scene_digest."""
    camera: ShotCamera
    view: int | None
    """Row of the camera in the scene; None for a camera from elsewhere."""

    @property
    def header(self) -> dict[str, Fact]:
        """Header of the file, without times and folders."""
        camera: dict[str, Any] = {"c2w": self.camera.c2w.tolist(), "fov_deg": self.camera.fov_deg}
        values = {
            "engine": self.engine,
            "source": self.source,
            "scene_sha256": self.scene_sha256,
            "camera": camera if self.view is None else {**camera, "view": self.view},
            **self.identity,
        }
        plain = {
            name: value if isinstance(value, Fact) else canonical_json(value).decode()
            for name, value in values.items()
        }
        return {**plain, _REQUEST: sha256_hex(canonical_json(values))}


@dataclass(frozen=True, kw_only=True)
class PictureFile:
    """Picture on disk, without its pixels, since a video may have thousands."""

    path: Path
    """Path of the EXR file."""
    facts: Facts
    was_kept: bool
    """True where an equal file existed already."""
    is_black: bool
    """True where all pixels are 0."""
    seconds: float | None = None
    """Wall-clock seconds of rendering, those of loading the scene included for its first picture;
    None where the file was kept."""


def load_matching_picture(path: Path, key: PictureKey) -> tuple[PictureFile, Radiance] | None:
    """Return the picture in a file if its key matches; else, or if it is unreadable, None."""
    try:
        data = read_plain(path)
        header = read_header(data)
        if header.get(_PREFIX + _REQUEST) != key.header[_REQUEST]:
            return None
        names = {channel.name.rpartition(".")[0] for channel in header["channels"]}
        radiance_rgb = decode_picture(data, names - {""})
    except (OSError, RuntimeError, ValueError, TrilightError):
        return None
    described = {_PREFIX + name for name in key.header}
    facts = {
        name.removeprefix(_PREFIX): value
        for name, value in header.items()
        if name.startswith(_PREFIX) and name not in described
    }
    return _picture_file(path, facts, radiance_rgb, was_kept=True), radiance_rgb


def write_picture(path: Path, key: PictureKey, rendered: Rendered) -> tuple[PictureFile, Radiance]:
    """Write a picture, and return it as the file holds it.

    Equal keys and pictures give equal bytes.

    Raises:
        TrilightError: a value is not finite, or the file cannot be written.
    """
    header = {_PREFIX + name: value for name, value in (key.header | dict(rendered.facts)).items()}
    picture = encode_picture(rendered.radiance_rgb, rendered.layers_rgb, header)
    write_atomically(path, picture)
    radiance_rgb = rounded_to_half(rendered.radiance_rgb)
    return _picture_file(path, rendered.facts, radiance_rgb, was_kept=False), radiance_rgb


def _picture_file(
    path: Path, facts: Facts, radiance_rgb: Radiance, *, was_kept: bool
) -> PictureFile:
    return PictureFile(
        path=path, facts=dict(facts), was_kept=was_kept, is_black=not radiance_rgb.any()
    )
