"""Reports the contents of one scene and renders a turntable of it, in children with limits."""

import contextlib
import dataclasses
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.reader import LIMITS, SceneReader, SceneSource
from pipeline.isolation import ChildFailed, IsolatedChild, call_with_retries
from pipeline.renders.mitsuba_variant import Variant, activate, choose_variant
from pipeline.renders.settings import RenderSettings
from storage.atomic import write_atomically
from storage.conventions import look_at_c2w, preview_srgb8
from storage.errors import Rejected, TrilightError
from storage.records.lights import num_lights
from storage.records.material import EMISSION, PUBLISHED_COLUMNS, columns_in_use
from storage.records.scene import Scene
from storage.records.scene_file import scene_digest

VIEWS = 8
ROWS = 2
"""Rows of pictures in a turntable."""

_RESOLUTION = 192
_SPP = 64
_FOV_DEG = 40.0
_ELEVATION_DEG = 25.0
_ROOM_AROUND = 1.03
"""Factor on the least camera distance from which the whole scene is within the picture."""


def inspect_scene(
    source: SceneSource, turntable: Path | None
) -> tuple[Mapping[str, Any], Sequence[str]]:
    """Inspect a scene, and write its turntable if a path is given.

    Returns:
        Facts for the user as JSON values, by name, such as triangles and extent_m; and notes on
        what the reader could not convert, and why no GPU rendered.

    Raises:
        TrilightError: the source is unusable, or the sheet cannot be rendered or written.
    """
    if turntable is not None and turntable.suffix.lower() != ".png":
        raise TrilightError(f"--turntable is {turntable}; expected the name of a file X.png.")
    try:
        with SceneReader() as reader:
            loaded = reader.load(source)
        notes = list(loaded.notes)
        if turntable is not None:
            from pipeline.documents.png import encode_png

            variant = choose_variant("auto")
            memory_bytes = variant.address_space(LIMITS.memory_bytes)
            limits = dataclasses.replace(LIMITS, memory_bytes=memory_bytes)
            with contextlib.closing(IsolatedChild(limits=limits)) as renderer:
                sheet = call_with_retries(renderer, _turntable, loaded.scene, variant)
            write_atomically(turntable, encode_png(sheet))
            if variant.note:
                notes.append(f"{variant.note}; see trilight doctor")
    except ChildFailed as failure:
        raise TrilightError(f"{source.name}: cannot be inspected ({failure}).") from failure
    except Rejected as rejection:
        raise TrilightError(f"{source.name}: cannot be rendered ({rejection}).") from rejection
    return _facts(loaded.scene), notes


def _facts(scene: Scene) -> dict[str, Any]:
    low = scene.vertex_positions.min(axis=0)
    high = scene.vertex_positions.max(axis=0)
    kinds = Counter(entry.kind for entry in scene.objects)
    licences = Counter(scene.licences)
    added = columns_in_use(scene.materials, PUBLISHED_COLUMNS)
    maps: dict[str, str] = {}
    if scene.textures:
        sizes = (
            f"{each.source.name or each.sha256[:8]} {each.texels.shape[1]} x {each.texels.shape[0]}"
            for each in scene.textures[:8]
        )
        maps["textures"] = f"{len(scene.textures)}: {', '.join(sizes)}"
    if (sky := scene.environment) is not None:
        height, width, _ = sky.radiance_rgb.shape
        maps["environment"] = (
            f"{sky.source.name or sky.sha256[:8]} {width} x {height}, greatest radiance "
            f"{float(sky.radiance_rgb.max()):.4g}, {'seen' if sky.is_seen else 'hidden'}"
        )
    return {
        "triangles": scene.num_triangles,
        "vertices": len(scene.vertex_positions),
        "objects": ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items())),
        "materials": len(scene.materials),
        **({"added_columns": ", ".join(added)} if added else {}),
        **maps,
        "lights": num_lights(scene),
        "cameras": ", ".join(f"{angle:.1f} deg" for angle in scene.fov_deg[:8]),
        "views": scene.num_views,
        "extent_m": " x ".join(f"{size:.3g}" for size in (high - low)),
        "greatest_radiance": float(scene.materials[:, EMISSION].max()),
        "licences": ", ".join(f"{count} {name}" for name, count in sorted(licences.items())),
        "made_by": str(scene.provenance.get("template", "unknown")),
        "scene_digest": scene_digest(scene),
    }


def _turntable(scene: Scene, variant: Variant) -> NDArray[np.uint8]:
    """Return a sheet [H, W, 3] of the scene from all sides, lit by its own lights.

    Walls between the camera and the objects are left out of a picture, and with them their light.
    """
    from pipeline.renders.renderer import SceneRenderer

    activate(variant)
    settings = RenderSettings(
        resolution=_RESOLUTION,
        noise_floor_db=99.0,
        min_spp=_SPP,
        max_spp=_SPP,
        min_mean_radiance=0.0,
    )
    pictures = []
    for pose in turntable_poses(scene):
        renderer = SceneRenderer(seen_into(scene, pose), settings)
        pictures.append(preview_srgb8(renderer.render_view(pose, _FOV_DEG, 0).radiance_rgb))
    each = VIEWS // ROWS
    rows = [pictures[first : first + each] for first in range(0, VIEWS, each)]
    return np.concatenate([np.concatenate(row, axis=1) for row in rows], axis=0)


def seen_into(scene: Scene, pose: NDArray[np.float32]) -> Scene:
    """Return a scene without the triangles of its shell that hide its objects.

    The planes of these triangles lie between the camera of the pose [4, 4] and the middle of the
    objects.
    """
    shells = np.array([entry.kind == "shell" for entry in scene.objects])[scene.object_index]
    inside = scene.vertex_positions[scene.faces[~shells & ~scene.triangle_emits]].reshape(-1, 3)
    if not shells.any() or not len(inside):
        return scene
    middle = (inside.min(axis=0) + inside.max(axis=0)).astype(np.float64) / 2
    corners = scene.vertex_positions[scene.faces].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    before, within = (
        np.einsum("ti,ti->t", normals, point - corners[:, 0])
        for point in (pose[:3, 3].astype(np.float64), middle)
    )
    keep = ~(shells & (before * within < 0))
    uv = None if scene.uv is None else scene.uv.reshape(-1, 3, 2)[keep].reshape(-1, 2)
    return dataclasses.replace(
        scene,
        faces=scene.faces[keep],
        material_index=scene.material_index[keep],
        object_index=scene.object_index[keep],
        uv=uv,
    )


def turntable_poses(scene: Scene) -> list[NDArray[np.float32]]:
    """Return camera poses [4, 4] around all reflecting surfaces; each sees all of them."""
    points = scene.vertex_positions[np.unique(scene.faces[~scene.triangle_emits])]
    if not len(points):
        points = scene.vertex_positions
    middle = (points.min(axis=0) + points.max(axis=0)).astype(np.float64) / 2
    tangent = math.tan(math.radians(_FOV_DEG) / 2)
    poses = []
    for azimuth in 2 * np.pi * np.arange(VIEWS) / VIEWS:
        up = math.sin(math.radians(_ELEVATION_DEG))
        flat = math.cos(math.radians(_ELEVATION_DEG))
        direction = np.array([flat * math.sin(azimuth), -flat * math.cos(azimuth), up])
        facing = look_at_c2w(eye=middle + direction, target=middle, up=[0, 0, 1])
        # in the camera's axes about the middle: a nearer point has to lie nearer to the axis
        local = np.einsum("pi,ij->pj", points - middle, facing[:3, :3])
        distances = np.abs(local[:, :2]).max(axis=1) / tangent + local[:, 2]
        distance = max(_ROOM_AROUND * float(distances.max()), 1e-3)
        pose = look_at_c2w(eye=middle + distance * direction, target=middle, up=[0, 0, 1])
        poses.append(pose.astype(np.float32))
    return poses
