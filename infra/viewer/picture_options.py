"""Options of a picture that a page requests, parsed and checked."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from storage.digests import canonical_json, sha256_hex
from storage.errors import TrilightError, expected_one_of
from storage.records.scene import MAX_POSITION_M
from storage.renderer import Camera

MOST_PX = 1024
"""Maximum width in pixels of a requested picture."""

_POSE_LENGTH = 16


@dataclass(frozen=True, kw_only=True, eq=False)
class PictureOptions:
    """Options of one picture."""

    engine: str
    """Name of the renderer that makes the picture."""
    camera: Camera
    resolution: int
    """Width of the picture in pixels, a multiple of 8."""
    edits: Mapping[str, Any]
    """Edits of the scene in the form of infra.viewer.edits."""
    error_db: float
    """Stated error as psnr_log_db at which a path tracer stops."""

    @property
    def scene_key(self) -> str:
        """Digest of the edits."""
        return _digest(self.edits)

    @property
    def camera_key(self) -> str:
        """Digest of edits, camera and width, by which pictures of engines are compared."""
        pose = [round(float(value), 6) for value in self.camera.c2w.reshape(-1)]
        return _digest([self.edits, pose, round(self.camera.fov_deg, 4), self.resolution])


def parse_picture_options(body: Any, engines: Mapping[str, Any], views: int) -> PictureOptions:
    """Return the options in the body of a request.

    Args:
        body: JSON value of the request.
        engines: renderers of the page by name.
        views: number of cameras of the scene.

    Raises:
        TrilightError: an option is missing or invalid.
    """
    if not isinstance(body, Mapping):
        raise TrilightError("the request is no JSON object.")
    engine = str(body.get("engine"))
    if engine not in engines:
        raise TrilightError(f"engine {engine:.40}: {expected_one_of(engine, list(engines))}.")
    width = body.get("resolution")
    view = body.get("view")
    if not (isinstance(width, int) and 16 <= width <= MOST_PX and width % 8 == 0):
        raise TrilightError(
            f"resolution is {width!r:.20}; expected a multiple of 8 from 16 to {MOST_PX}."
        )
    if view is not None and not (isinstance(view, int) and 0 <= view < views):
        raise TrilightError(f"view is {view!r:.20}; expected 0 to {views - 1}, or none.")
    return PictureOptions(
        engine=engine,
        camera=_camera(body, view),
        resolution=int(width),
        edits=parse_edits(body),
        error_db=_number(body.get("error_db", 45), "error_db", 10, 60),
    )


def parse_edits(body: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the edits in the body of a request; raises TrilightError if they are no object."""
    edits = body.get("edits")
    if edits is not None and not isinstance(edits, Mapping):
        raise TrilightError(f"edits: {edits!r:.20} is no JSON object; expected one, or null.")
    return edits or {}


def _camera(body: Mapping[str, Any], view: int | None) -> Camera:
    pose = body.get("c2w")
    if not isinstance(pose, list) or len(pose) != _POSE_LENGTH:
        raise TrilightError("c2w: expected 16 numbers, row by row.")
    far = 10 * MAX_POSITION_M
    numbers = np.array([_number(value, "c2w", -far, far) for value in pose])
    c2w = numbers.reshape(4, 4)
    rotation = c2w[:3, :3]
    if abs(rotation.T @ rotation - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
        raise TrilightError("c2w: expected the pose of a camera, a rotation without mirroring.")
    # a browser rounds, and scenes need an orthonormal rotation: the nearest one, by the SVD
    u, _, vt = np.linalg.svd(rotation)
    c2w[:3, :3] = u @ vt
    c2w[3] = (0, 0, 0, 1)
    fov_deg = _number(body.get("fov"), "fov", 1, 170)
    return Camera(c2w=c2w.astype(np.float32), fov_deg=fov_deg, view=view)


def _number(value: Any, name: str, low: float, high: float) -> float:
    real = isinstance(value, int | float) and not isinstance(value, bool)
    if not real or not math.isfinite(value) or not low <= value <= high:
        raise TrilightError(f"{name} is {value!r:.20}; expected a number from {low:g} to {high:g}.")
    return float(value)


def _digest(value: Any) -> str:
    return sha256_hex(canonical_json(value))[:24]
