"""Options of a picture that a page requests, and the edits of its scene, parsed and checked.

The page holds the edits and sends all of them with every request; the loaded scene stays unchanged,
so that nothing has to be undone.
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.digests import canonical_json, sha256_hex
from storage.errors import TrilightError, expected_one_of
from storage.records.material import DIFFUSE, EMISSION, ROUGHNESS, SPECULAR
from storage.records.retextured import chosen_maps
from storage.records.scene import MAX_POSITION_M, Scene
from storage.records.texture import CONSTANT, TEXTURED
from storage.renderer import Camera

MOST_PX = 1024
"""Maximum width in pixels of a requested picture."""

_POSE_LENGTH = 16
MOST_GAIN = 1000.0
"""Maximum factor by which a lamp may become brighter."""

_COLUMNS = {"diffuse": DIFFUSE, "specular": SPECULAR}


@dataclass(frozen=True, kw_only=True, eq=False)
class PictureOptions:
    """Options of one picture."""

    engine: str
    camera: Camera
    resolution: int
    """Width of the picture in pixels, a multiple of 8."""
    edits: Mapping[str, Any]
    """Edits of the scene in the form of infra.viewer.picture_options."""
    error_db: float
    """Stated error as psnr_log_db at which a path tracer stops."""

    @property
    def scene_key(self) -> str:
        """Digest of the edits."""
        return short_digest(self.edits)

    @property
    def camera_key(self) -> str:
        """Digest of edits, camera and width, by which pictures of engines are compared."""
        pose = [round(float(value), 6) for value in self.camera.c2w.reshape(-1)]
        return short_digest([self.edits, pose, round(self.camera.fov_deg, 4), self.resolution])


def parse_picture_options(body: Any, engines: Mapping[str, Any], views: int) -> PictureOptions:
    """Return the options in the body of a request.

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


def short_digest(value: Any) -> str:
    """Return a digest of JSON values, by which edits and cameras are compared."""
    return sha256_hex(canonical_json(value))[:24]


def apply_edits(scene: Scene, edits: Mapping[str, Any]) -> Scene:
    """Return the scene with edits.

    Args:
        scene: scene as it was loaded.
        edits: `lamps`: by row of the emitter, `move` [3] in meters and `gain`; `materials`: by row,
            `diffuse` and `specular` [3] and `roughness`. Values that are left out stay. A stated
            color or number replaces a texture.

    Raises:
        TrilightError: an edit is malformed, or breaks a rule of scenes.
    """
    lamps = _group(edits, "lamps")
    materials = _group(edits, "materials")
    if not lamps and not materials:
        return scene
    positions = scene.vertex_positions.copy()
    rows = scene.materials.copy()
    worn = None if scene.material_textures is None else scene.material_textures.copy()
    for row, change in lamps.items():
        _move_lamp(scene, row, change, positions, rows)
    for row, change in materials.items():
        _change_material(scene, row, change, rows, worn)
    worn_scene = dataclasses.replace(scene, material_textures=worn)
    every = (np.arange(scene.num_triangles), np.arange(len(rows)))
    changed = dataclasses.replace(
        scene, vertex_positions=positions, materials=rows, **chosen_maps(worn_scene, *every)
    )
    changed.check()
    return changed


def _group(edits: Mapping[str, Any], name: str) -> dict[int, Mapping[str, Any]]:
    changes = edits.get(name, {})
    try:
        group = {int(row): dict(change) for row, change in changes.items()}
    except (AttributeError, TypeError, ValueError) as error:
        raise TrilightError(f"edits: {name} is no table of changes by row.") from error
    return dict(group)


def _move_lamp(
    scene: Scene,
    row: int,
    change: Mapping[str, Any],
    positions: NDArray[np.float32],
    rows: NDArray[np.float32],
) -> None:
    if not 0 <= row < len(scene.objects) or scene.objects[row].kind != "emitter":
        raise TrilightError(f"edits: object {row} is no light of the scene.")
    mine = scene.object_index == row
    move = _numbers(change.get("move", (0, 0, 0)), "move", 3, -MAX_POSITION_M, MAX_POSITION_M)
    positions[np.unique(scene.faces[mine])] += move.astype(np.float32)
    gain = float(_numbers([change.get("gain", 1)], "gain", 1, 0.001, MOST_GAIN)[0])
    for material in np.unique(scene.material_index[mine]):
        rows[material, EMISSION] = scene.materials[material, EMISSION] * gain


def _change_material(
    scene: Scene,
    row: int,
    change: Mapping[str, Any],
    rows: NDArray[np.float32],
    worn: NDArray[np.int32] | None,
) -> None:
    if not 0 <= row < len(rows):
        raise TrilightError(f"edits: the scene has no material {row}.")
    for name, part in _COLUMNS.items():
        if name in change:
            rows[row, part] = _numbers(change[name], name, 3, 0, 1)
    if "roughness" in change:
        rows[row, ROUGHNESS] = _numbers([change["roughness"]], "roughness", 1, 0, 1)[0]
    if worn is not None:
        worn[row, [at for at, name in enumerate(TEXTURED) if name in change]] = CONSTANT


def _numbers(values: Any, name: str, count: int, low: float, high: float) -> NDArray[np.float64]:
    try:
        numbers = [float(value) for value in values]
    except (TypeError, ValueError) as error:
        raise TrilightError(f"edits: {name} is no list of numbers.") from error
    if len(numbers) != count or not all(math.isfinite(v) and low <= v <= high for v in numbers):
        raise TrilightError(
            f"edits: {name} is {numbers}; expected {count} from {low:g} to {high:g}."
        )
    return np.array(numbers)
