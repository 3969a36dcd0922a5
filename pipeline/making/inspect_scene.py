"""What one scene holds, and a sheet of it from all sides; in a child process with limits."""

import dataclasses
import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.open_scene import SceneSource, load_source
from pipeline.exchange.reader import file_child, reach_of, unconfined_child
from pipeline.isolation import ChildFailed, call_with_retries
from pipeline.renders.settings import RenderSettings
from pipeline.renders.variant import Variant, activate, choose_variant
from storage.atomic import write_atomically
from storage.conventions import look_at_c2w, preview_srgb8
from storage.errors import Rejected, TrilightError
from storage.records.lights import num_lights
from storage.records.material import EMISSION, PUBLISHED_COLUMNS, unread_columns
from storage.records.scene import Scene
from storage.records.scene_file import scene_digest

VIEWS, ROWS = 8, 2
"""Pictures of a turntable, and the rows in which they stand."""

_RESOLUTION, _SPP = 192, 64
_FOV_DEG, _ELEVATION_DEG = 40.0, 25.0
_ROOM_AROUND = 1.03
"""Of the least distance from which everything is within the picture."""


@dataclass(frozen=True, kw_only=True)
class InspectedScene:
    """What there is to say of a scene."""

    facts: Mapping[str, Any]
    """JSON values by name."""
    notes: tuple[str, ...]
    """What of the file could not be carried over."""


def inspect_scene(source: SceneSource, turntable: Path | None) -> InspectedScene:
    """Return what a scene holds, and write its turntable where one is asked for.

    Raises:
        TrilightError: the source is unusable, or the sheet cannot be rendered or written.
    """
    if turntable is not None and turntable.suffix.lower() != ".png":
        raise TrilightError(f"--turntable is {turntable}; expected the name of a file X.png.")
    child, renderer = file_child(reach_of(source)), unconfined_child()
    try:
        found = call_with_retries(child, _facts, source)
        if turntable is not None:
            from pipeline.documents.png import encode_png

            scene = call_with_retries(child, load_source, source).scene
            sheet = call_with_retries(renderer, _turntable, scene, choose_variant())
            write_atomically(turntable, encode_png(sheet))
    except ChildFailed as failure:
        raise TrilightError(f"{source.name}: cannot be inspected ({failure}).") from failure
    except Rejected as rejection:
        raise TrilightError(f"{source.name}: cannot be rendered ({rejection}).") from rejection
    finally:
        child.close()
        renderer.close()
    return found


def _facts(source: SceneSource) -> InspectedScene:
    loaded = load_source(source)
    scene = loaded.scene
    low, high = scene.vertex_positions.min(axis=0), scene.vertex_positions.max(axis=0)
    kinds = Counter(entry.kind for entry in scene.objects)
    licences = Counter(scene.licences)
    added = unread_columns(scene.materials, PUBLISHED_COLUMNS)
    facts = {
        "triangles": scene.num_triangles,
        "vertices": len(scene.vertex_positions),
        "objects": ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items())),
        "materials": len(scene.materials),
        **({"added_columns": ", ".join(added)} if added else {}),
        **_maps(scene),
        "lights": num_lights(scene),
        "cameras": ", ".join(f"{angle:.1f} deg" for angle in scene.fov_deg[:8]),
        "views": scene.num_views,
        "extent_m": " x ".join(f"{size:.3g}" for size in (high - low)),
        "greatest_radiance": float(scene.materials[:, EMISSION].max()),
        "licences": ", ".join(f"{count} {name}" for name, count in sorted(licences.items())),
        "made_by": str(scene.provenance.get("template", "unknown")),
        "scene_digest": scene_digest(scene),
    }
    return InspectedScene(facts=facts, notes=loaded.notes)


def _maps(scene: Scene) -> dict[str, Any]:
    """Return what there is to say of textures and environment, where there are any."""
    found: dict[str, Any] = {}
    if scene.textures:
        sizes = (
            f"{each.source.name or each.sha256[:8]} {each.texels.shape[1]} x {each.texels.shape[0]}"
            for each in scene.textures[:8]
        )
        found["textures"] = f"{len(scene.textures)}: {', '.join(sizes)}"
    if (sky := scene.environment) is not None:
        height, width, _ = sky.radiance_rgb.shape
        found["environment"] = (
            f"{sky.source.name or sky.sha256[:8]} {width} x {height}, greatest radiance "
            f"{float(sky.radiance_rgb.max()):.4g}, {'seen' if sky.is_seen else 'hidden'}"
        )
    return found


def _turntable(scene: Scene, variant: Variant) -> NDArray[np.uint8]:
    """Return a sheet [H, W, 3] of the scene from all sides, lit by its own lights.

    Walls that stand before what they hold are left out of a picture, and with them their light.
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
    rows = [
        np.concatenate(pictures[at * VIEWS // ROWS : (at + 1) * VIEWS // ROWS], axis=1)
        for at in range(ROWS)
    ]
    return np.concatenate(rows, axis=0)


def seen_into(scene: Scene, pose: NDArray[np.float32]) -> Scene:
    """Return a scene without the triangles of its shell that hide what stands in it.

    Their planes part the camera of the pose [4, 4] from the middle of what stands there.
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
    """Return poses [4, 4] around what reflects, so that each sees all of it."""
    points = scene.vertex_positions[np.unique(scene.faces[~scene.triangle_emits])]
    if not len(points):
        points = scene.vertex_positions
    middle = (points.min(axis=0) + points.max(axis=0)).astype(np.float64) / 2
    tangent = math.tan(math.radians(_FOV_DEG) / 2)
    poses = []
    for turn in 2 * np.pi * np.arange(VIEWS) / VIEWS:
        up = math.sin(math.radians(_ELEVATION_DEG))
        flat = math.cos(math.radians(_ELEVATION_DEG))
        away = np.array([flat * math.sin(turn), -flat * math.cos(turn), up])
        turned = look_at_c2w(eye=middle + away, target=middle, up=[0, 0, 1])
        # in the camera's axes about the middle: what lies nearer has to lie nearer the axis
        local = np.einsum("pi,ij->pj", points - middle, turned[:3, :3])
        needed = np.abs(local[:, :2]).max(axis=1) / tangent + local[:, 2]
        distance = max(_ROOM_AROUND * float(needed.max()), 1e-3)
        pose = look_at_c2w(eye=middle + distance * away, target=middle, up=[0, 0, 1])
        poses.append(pose.astype(np.float32))
    return poses
