"""Options of a picture that a page requests, and the edits of its scene, parsed and checked.

The page holds the edits and sends all of them with every request; the loaded scene stays unchanged,
so that nothing has to be undone.
"""

import dataclasses
import functools
from collections.abc import Mapping
from dataclasses import field
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from storage.digests import canonical_json, sha256_hex
from storage.errors import TrilightError, expected_one_of
from storage.records.material import DIFFUSE, EMISSION, ROUGHNESS, SPECULAR
from storage.records.retextured import chosen_maps
from storage.records.scene import MAX_POSITION_M, Scene
from storage.records.texture import CONSTANT, TEXTURED
from storage.renderer import Camera
from storage.settings.described import checked, from_record
from storage.settings.ranges import Within

MOST_PX = 1024
"""Maximum width in pixels of a requested picture."""

MOST_GAIN = 1000.0
"""Maximum factor by which a lamp may become brighter."""

_COLUMNS = {"diffuse": DIFFUSE, "specular": SPECULAR, "roughness": ROUGHNESS}

Vector = tuple[float, float, float]


@checked()
class LampEdit:
    """Changes to a lamp."""

    move: Annotated[Vector, Within(-MAX_POSITION_M, MAX_POSITION_M, unit="meters")] = (0, 0, 0)
    gain: Annotated[float, Within(0.001, MOST_GAIN)] = 1.0


@checked()
class MaterialEdit:
    """Changes to a material; a stated color or number replaces a texture."""

    diffuse: Annotated[Vector | None, Within(0, 1)] = None
    specular: Annotated[Vector | None, Within(0, 1)] = None
    roughness: Annotated[float | None, Within(0, 1)] = None


@checked()
class SceneEdits:
    """Changes to a scene."""

    lamps: Mapping[int, LampEdit] = field(default_factory=dict)
    """Changes by row of the emitter."""
    materials: Mapping[int, MaterialEdit] = field(default_factory=dict)
    """Changes by row of the material."""


_FAR_M = 10 * MAX_POSITION_M


@checked()
class PictureOptions:
    """Body of a request for a picture."""

    engine: str
    c2w: Annotated[tuple[float, ...], Within(-_FAR_M, _FAR_M)]
    """Pose of the camera, 16 numbers, row by row."""
    fov: Annotated[float, Within(1, 170, unit="degrees")]
    resolution: Annotated[int, Within(16, MOST_PX, unit="pixels")]
    """Width of the picture, a multiple of 8."""
    view: int | None = None
    """Camera of the scene; none for a free one."""
    edits: Mapping[str, Any] = field(default_factory=dict)
    """Changes in the form of SceneEdits."""
    error_db: Annotated[float, Within(10, 60, unit="dB")] = 45.0
    """Stated error as psnr_log_db at which a path tracer stops."""

    @functools.cached_property
    def camera(self) -> Camera:
        """Camera with an orthonormal pose; raises TrilightError where `c2w` is none."""
        return Camera(c2w=_pose(self.c2w), fov_deg=self.fov, view=self.view)

    @property
    def scene_key(self) -> str:
        """Digest of the edits."""
        return short_digest(self.edits)

    @property
    def camera_key(self) -> str:
        """Digest of edits, camera and width, by which pictures of engines are compared."""
        pose = [round(float(value), 6) for value in self.camera.c2w.reshape(-1)]
        return short_digest([self.edits, pose, round(self.fov, 4), self.resolution])


def parse_picture_options(body: Any, engines: Mapping[str, Any], views: int) -> PictureOptions:
    """Return the options in the body of a request.

    Raises:
        TrilightError: an option is missing or invalid.
    """
    options = from_record(PictureOptions, body)
    if options.engine not in engines:
        expected = expected_one_of(options.engine, list(engines))
        raise TrilightError(f"engine {options.engine:.40}: {expected}.")
    if options.resolution % 8:
        raise TrilightError(f"resolution is {options.resolution}; expected a multiple of 8.")
    if options.view is not None and not 0 <= options.view < views:
        raise TrilightError(f"view is {options.view}; expected 0 to {views - 1}, or none.")
    assert options.camera.c2w.size  # a wrong pose is refused here
    return options


def _pose(numbers: tuple[float, ...]) -> NDArray[np.float32]:
    """Return the nearest pose with an orthonormal rotation, since a browser rounds."""
    if len(numbers) != 16:
        raise TrilightError("c2w: expected 16 numbers, row by row.")
    c2w = np.array(numbers).reshape(4, 4)
    rotation = c2w[:3, :3]
    if abs(rotation.T @ rotation - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
        raise TrilightError("c2w: expected the pose of a camera, a rotation without mirroring.")
    u, _, vt = np.linalg.svd(rotation)
    c2w[:3, :3] = u @ vt
    c2w[3] = (0, 0, 0, 1)
    return c2w.astype(np.float32)


def short_digest(value: Any) -> str:
    """Return a digest of JSON values, by which edits and cameras are compared."""
    return sha256_hex(canonical_json(value))[:24]


def apply_edits(scene: Scene, record: Mapping[str, Any]) -> Scene:
    """Return a scene as it was loaded with the edits of a record (SceneEdits).

    Raises:
        TrilightError: an edit is malformed, or breaks a rule of scenes.
    """
    edits = from_record(SceneEdits, record)
    if not edits.lamps and not edits.materials:
        return scene
    positions = scene.vertex_positions.copy()
    rows = scene.materials.copy()
    worn = None if scene.material_textures is None else scene.material_textures.copy()
    for row, lamp in edits.lamps.items():
        _move_lamp(scene, row, lamp, positions, rows)
    for row, material in edits.materials.items():
        if not 0 <= row < len(rows):
            raise TrilightError(f"edits: the scene has no material {row}.")
        for name, value in vars(material).items():
            if value is not None:
                rows[row, _COLUMNS[name]] = value
                if worn is not None:
                    worn[row, TEXTURED.index(name)] = CONSTANT
    worn_scene = dataclasses.replace(scene, material_textures=worn)
    every = (np.arange(scene.num_triangles), np.arange(len(rows)))
    changed = dataclasses.replace(
        scene, vertex_positions=positions, materials=rows, **chosen_maps(worn_scene, *every)
    )
    changed.check()
    return changed


def _move_lamp(
    scene: Scene,
    row: int,
    change: LampEdit,
    positions: NDArray[np.float32],
    rows: NDArray[np.float32],
) -> None:
    if not 0 <= row < len(scene.objects) or scene.objects[row].kind != "emitter":
        raise TrilightError(f"edits: object {row} is no light of the scene.")
    mine = scene.object_index == row
    positions[np.unique(scene.faces[mine])] += np.array(change.move, np.float32)
    for material in np.unique(scene.material_index[mine]):
        rows[material, EMISSION] = scene.materials[material, EMISSION] * change.gain
