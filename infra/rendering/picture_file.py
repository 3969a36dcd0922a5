"""One EXR file of a picture that says how it was made, and is kept if it would come out again."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from infra.rendering.cameras import ShotCamera
from infra.rendering.engines import Fact, Facts, Rendered
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
class Request:
    """All that decides a picture."""

    engine: str
    """Name of the engine."""
    identity: Mapping[str, Any]
    """What it depends on beside scene and camera."""
    source: str
    """Name of the scene's file, without its folders."""
    scene_sha256: str
    """Digest of the scene."""
    camera: ShotCamera
    view: int | None
    """Row of the camera among the scene's own; None if the camera is none of these."""

    @property
    def header(self) -> dict[str, Fact]:
        """What a picture says about itself: nothing of the clock, and no folder."""
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
    """A picture on disk: what is remembered of it, and a film may have thousands."""

    path: Path
    """The EXR file."""
    facts: Facts
    """What its engine says of it."""
    was_kept: bool
    """Whether it was there already."""
    is_black: bool
    """Whether it shows nothing at all."""
    seconds: float | None = None
    """Wall-clock seconds that it took, with its scene where it is the first picture of it; None
    where it was kept."""


def kept_picture(path: Path, wanted: Request) -> tuple[PictureFile, Radiance] | None:
    """Return the picture in a file, as `write_picture`, if it is the one that is wanted."""
    try:
        data = read_plain(path)
        header = read_header(data)
        if header.get(_PREFIX + _REQUEST) != wanted.header[_REQUEST]:
            return None
        names = {channel.name.rpartition(".")[0] for channel in header["channels"]}
        radiance_rgb = decode_picture(data, names - {""})
    except (OSError, RuntimeError, ValueError, TrilightError):
        return None
    described = {_PREFIX + name for name in wanted.header}
    facts = {
        name.removeprefix(_PREFIX): value
        for name, value in header.items()
        if name.startswith(_PREFIX) and name not in described
    }
    return _remembered(path, facts, radiance_rgb, was_kept=True), radiance_rgb


def write_picture(path: Path, wanted: Request, rendered: Rendered) -> tuple[PictureFile, Radiance]:
    """Write a picture, and return it as the file holds it.

    Equal requests and pictures give equal bytes.

    Raises:
        TrilightError: a value is not finite, or the file cannot be written.
    """
    header = {
        _PREFIX + name: value for name, value in (wanted.header | dict(rendered.facts)).items()
    }
    picture = encode_picture(rendered.radiance_rgb, rendered.layers_rgb, header)
    write_atomically(path, picture)
    radiance_rgb = rounded_to_half(rendered.radiance_rgb)
    return _remembered(path, rendered.facts, radiance_rgb, was_kept=False), radiance_rgb


def _remembered(path: Path, facts: Facts, radiance_rgb: Radiance, *, was_kept: bool) -> PictureFile:
    return PictureFile(
        path=path, facts=dict(facts), was_kept=was_kept, is_black=not radiance_rgb.any()
    )
