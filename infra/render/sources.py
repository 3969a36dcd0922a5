"""Scenes and cameras of a render: a source may hold many of either."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.exchange.formats import readable_suffixes
from pipeline.exchange.open_scene import SceneSource, scene_source
from pipeline.exchange.reader import SceneReader
from storage.dataset.shard_set import expand_pattern
from storage.errors import TrilightError
from storage.records.scene import Scene
from storage.renderer import Camera


def scene_sources(text: str, reader: SceneReader) -> list[SceneSource]:
    """Return every scene of a source, in order.

    Args:
        text: one file; `scenes/{000..119}.json` for numbered ones; or a folder, whose scene files
            are sorted by the numbers in their names. A shard stands for all of its samples, an
            animated USD stage for all of its frames.

    Raises:
        TrilightError: a file is unusable, or there is no scene.
    """
    if "://" not in text and Path(text).is_dir():
        paths = [
            path for path in Path(text).iterdir() if path.suffix.lower() in readable_suffixes()
        ]
        if not paths:
            raise TrilightError(
                f"{text}: holds no scene file; expected files that end in "
                f"{' '.join(readable_suffixes())}."
            )
        return [scene_source(str(path)) for path in sorted(paths, key=_by_number)]
    names = expand_pattern(text, "scenes") if "{" in text else [text]
    files = [scene_source(name, many=True) for name in names]
    return [scene for source in files for scene in reader.scenes_of(source)]


def _by_number(path: Path) -> list[tuple[int, str]]:
    """Return a key that sorts frame9 before frame10."""
    parts = re.split(r"([0-9]+)", path.name)
    return [(int(part), part) if part.isdecimal() else (-1, part) for part in parts]


def pair_cameras(
    sources: Sequence[SceneSource], cameras: Sequence[Camera | int]
) -> list[tuple[SceneSource, Camera | int]]:
    """Return scene and camera of each picture, in order.

    One scene is combined with all cameras, and one camera with all scenes; equally many scenes and
    cameras are paired. A number is the row of a camera of the scene.

    Raises:
        TrilightError: several scenes and several cameras, but not equally many.
    """
    if len(sources) > 1 and len(cameras) > 1 and len(sources) != len(cameras):
        raise TrilightError(
            f"{len(sources)} scenes and {len(cameras)} cameras; expected one of either, or as many "
            "cameras as scenes."
        )
    count = max(len(sources), len(cameras))
    return [(sources[at % len(sources)], cameras[at % len(cameras)]) for at in range(count)]


def own_camera(scene: Scene, view: int, named: str = "--view") -> Camera:
    """Return a camera of a scene; raises TrilightError, with `named`, if there is no such view."""
    if not 0 <= view < scene.num_views:
        raise TrilightError(
            f"{named} is {view}; expected 0 to {scene.num_views - 1}: the scene has "
            f"{scene.num_views} cameras."
        )
    return Camera.of_scene(scene, view)


def orbit(scene: Scene, start: Camera, count: int, arc_deg: float) -> list[Camera]:
    """Return `count` cameras on a horizontal circle around the point that `start` looks at.

    The circle's center is the point of the camera's axis nearest to the center of all surfaces that
    reflect. The whole circle begins at `start`; a shorter arc has `start` in its middle.
    """
    points = scene.vertex_positions[scene.faces[~scene.triangle_emits]].reshape(-1, 3)
    if not len(points):
        points = scene.vertex_positions
    middle = (points.min(axis=0).astype(np.float64) + points.max(axis=0)) / 2
    pose = start.c2w.astype(np.float64)
    eye = pose[:3, 3]
    forward = -pose[:3, 2]
    target = eye + forward * max(float(np.einsum("i,i->", middle - eye, forward)), 0.0)
    if arc_deg == 360:
        angles_deg = 360 * np.arange(count) / count
    else:
        angles_deg = np.linspace(-arc_deg / 2, arc_deg / 2, count) if count > 1 else np.zeros(1)
    cameras = []
    for angle_rad in np.radians(angles_deg):
        cos = np.cos(angle_rad)
        sin = np.sin(angle_rad)
        rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])  # about the vertical axis
        turned = pose.copy()
        turned[:3, :3] = np.einsum("ij,jk->ik", rotation, pose[:3, :3])
        turned[:3, 3] = np.einsum("ij,j->i", rotation, eye - target) + target
        cameras.append(Camera(c2w=turned.astype(np.float32), fov_deg=start.fov_deg))
    return cameras


def camera_path(text: str, reader: SceneReader, view: int) -> list[Camera]:
    """Return the cameras of a file: all of one scene, or one of each frame of an animated stage.

    Args:
        text: JSON file with a list `cameras` as in RenderFormer's scenes, or any scene.
        view: row of the camera in each frame.

    Raises:
        TrilightError: the file is unusable, or has no such camera.
    """
    source = scene_source(text, many=True)
    frames = reader.scenes_of(source)
    if len(frames) > 1:
        return [own_camera(reader.load(frame).scene, view) for frame in frames]
    c2w, fov_deg = reader.cameras(frames[0])
    return [
        Camera(c2w=pose, fov_deg=float(angle)) for pose, angle in zip(c2w, fov_deg, strict=True)
    ]
