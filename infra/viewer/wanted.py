"""`Wanted`: the picture that a page asks for, checked."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from infra.rendering.cameras import ShotCamera
from storage.digests import canonical_json, sha256_hex
from storage.errors import TrilightError, expected_one_of
from storage.records.scene import MAX_POSITION_M

MOST_PX = 1024
"""Widest picture that a page may ask for."""

_POSE_LENGTH = 16


@dataclass(frozen=True, kw_only=True, eq=False)
class Wanted:
    """One picture."""

    engine: str
    """Name of the way to it."""
    camera: ShotCamera
    view: int | None
    """Row of the scene's own camera that `camera` is, if it is one."""
    resolution: int
    """Width in pixels."""
    edits: Mapping[str, Any]
    """As infra.viewer.edits reads them."""
    error_db: float
    """Error at which a path tracer ends."""

    @property
    def scene_key(self) -> str:
        """Equal for equal changes of the scene."""
        return _digest(self.edits)

    @property
    def place_key(self) -> str:
        """Equal where pictures of different engines can be compared: scene, camera and width."""
        pose = [round(float(value), 6) for value in self.camera.c2w.reshape(-1)]
        return _digest([self.edits, pose, round(self.camera.fov_deg, 4), self.resolution])


def wanted_of(body: Any, engines: Mapping[str, Any], views: int) -> Wanted:
    """Return what the body of a request asks for.

    Args:
        body: JSON of the request.
        engines: known ones, by name.
        views: cameras of the scene.

    Raises:
        TrilightError: it asks for nothing that there is.
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
    return Wanted(
        engine=engine,
        camera=_camera(body),
        view=view,
        resolution=int(width),
        edits=edits_of(body),
        error_db=_number(body.get("error_db", 45), "error_db", 10, 60),
    )


def edits_of(body: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the changes of the scene that a request states; raises TrilightError for no object."""
    edits = body.get("edits")
    if edits is not None and not isinstance(edits, Mapping):
        raise TrilightError(f"edits: {edits!r:.20} is no JSON object; expected one, or null.")
    return edits or {}


def _camera(body: Mapping[str, Any]) -> ShotCamera:
    pose = body.get("c2w")
    if not isinstance(pose, list) or len(pose) != _POSE_LENGTH:
        raise TrilightError("c2w: expected 16 numbers, row by row.")
    far = 10 * MAX_POSITION_M
    numbers = np.array([_number(value, "c2w", -far, far) for value in pose])
    c2w = numbers.reshape(4, 4)
    rotation = c2w[:3, :3]
    if abs(rotation.T @ rotation - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
        raise TrilightError("c2w: expected the pose of a camera, a rotation without mirroring.")
    # a browser rounds; scenes want an orthonormal rotation
    u, _, vt = np.linalg.svd(rotation)
    c2w[:3, :3] = u @ vt
    c2w[3] = (0, 0, 0, 1)
    fov_deg = _number(body.get("fov"), "fov", 1, 170)
    return ShotCamera(c2w=c2w.astype(np.float32), fov_deg=fov_deg)


def _number(value: Any, name: str, low: float, high: float) -> float:
    real = isinstance(value, int | float) and not isinstance(value, bool)
    if not real or not math.isfinite(value) or not low <= value <= high:
        raise TrilightError(f"{name} is {value!r:.20}; expected a number from {low:g} to {high:g}.")
    return float(value)


def _digest(value: Any) -> str:
    return sha256_hex(canonical_json(value))[:24]
