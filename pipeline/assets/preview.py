"""Quick previews of meshes for side-by-side comparison: gray, lit from the camera."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.assets.cleaning.clean import clean, normalize
from pipeline.assets.cleaning.orient import orient_outward
from pipeline.assets.outside_rays import first_faces
from pipeline.assets.quality.measure import level_mesh
from pipeline.assets.settings import AssetSettings
from pipeline.assets.source_materials.nearest import barycentric
from pipeline.foreign.load_mesh import load_mesh
from pipeline.foreign.mesh import TriangleMesh
from pipeline.foreign.source_file import read_source
from storage.conventions import srgb8
from storage.records.asset import Level, LevelSkin
from storage.records.lookup import texture_values

_TOWARDS_CAMERA = np.array([0.62, -0.62, 0.48])
_BACKGROUND = 1.0
_LINE_PX = 0.7
_LINED_PX = (3.0, 9.0)
"""Triangle sizes in pixels: no edge lines below the first, where they would only blacken the
picture, and full lines above the second."""
_SUPERSAMPLE = 2


def preview_source_and_level(
    path: str, settings: AssetSettings, level: Level, width_px: int
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return gray pictures [W, W] of a cleaned source file and of one of its levels.

    Raises Rejected as `prepare_asset`.
    """
    data = read_source(Path(path), settings.read_limits)
    mesh, _ = orient_outward(clean(normalize(load_mesh(data))))
    return preview(mesh, width_px), preview_level(level, width_px)


def preview_level(level: Level, width_px: int) -> NDArray[np.uint8]:
    """Return a picture of a level: gray [W, W], or [W, W, 3] where the level has colors."""
    mesh = level_mesh(level)
    grey = preview(mesh, width_px)
    return grey if level.skin is None else _preview_colors(mesh, level.skin, width_px)


def _preview_colors(mesh: TriangleMesh, skin: LevelSkin, width_px: int) -> NDArray[np.uint8]:
    """Return a picture [W, W, 3] of a mesh with its textures, without edge lines."""
    wide = width_px * _SUPERSAMPLE
    origins, directions, _ = _camera_rays(wide)
    face = first_faces(mesh, origins.astype(np.float32), directions.astype(np.float32))
    hit = face >= 0
    color = np.full((len(face), 3), _BACKGROUND)
    corners = mesh.corners[face[hit]]
    normals = mesh.double_area_vectors[face[hit]]
    facing = np.einsum("ij,ij->i", normals, -directions[hit])
    facing /= np.linalg.norm(normals, axis=1)
    offset = np.einsum("ij,ij->i", normals, origins[hit] - corners[:, 0])
    steep = np.einsum("ij,ij->i", normals, -directions[hit])
    distance = offset / np.where(np.abs(steep) > 1e-12, steep, 1e-12)
    points = origins[hit] + distance[:, None] * directions[hit]
    uv = np.einsum("nc,ncd->nd", barycentric(corners, points), skin.uv[face[hit]])
    diffuse, specular = (texture_values(texture, uv) for texture in skin.textures[:2])
    color[hit] = (diffuse + specular) * (0.25 + 0.75 * np.abs(facing))[:, None]
    blocks = color.reshape(width_px, _SUPERSAMPLE, width_px, _SUPERSAMPLE, 3).mean(axis=(1, 3))
    return srgb8(blocks)


def preview(mesh: TriangleMesh, width_px: int) -> NDArray[np.uint8]:
    """Return a gray picture [W, W] of a mesh in the unit box, +Z up, with its edges drawn.

    Parallel projection from the front right and above; back faces are darker.
    """
    wide = width_px * _SUPERSAMPLE
    origins, directions, pixel = _camera_rays(wide)
    face = first_faces(mesh, origins.astype(np.float32), directions.astype(np.float32))
    shade = np.full(len(face), _BACKGROUND)
    hit = face >= 0
    shade[hit] = _shade(mesh, face[hit], origins[hit], directions[hit], pixel)
    blocks = shade.reshape(width_px, _SUPERSAMPLE, width_px, _SUPERSAMPLE).mean(axis=(1, 3))
    return np.round(255 * blocks).astype(np.uint8)


def _camera_rays(width_px: int) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return origins and directions [W x W, 3] from the top left, and the width of a pixel."""
    back = _TOWARDS_CAMERA / np.linalg.norm(_TOWARDS_CAMERA)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    up = np.cross(back, right)
    half = 0.72
    offset = half * ((np.arange(width_px) + 0.5) / width_px * 2 - 1)
    origins = -offset[:, None, None] * up + offset[None, :, None] * right + 2 * back
    origins = origins.reshape(-1, 3)
    return origins, np.broadcast_to(-back, origins.shape), 2 * half / width_px


def _shade(
    mesh: TriangleMesh,
    face: NDArray[np.int64],
    origins: NDArray[np.float64],
    directions: NDArray[np.float64],
    pixel: float,
) -> NDArray[np.float64]:
    """Return the gray value of each hit: brighter towards the camera, dark along the edges."""
    normal = mesh.double_area_vectors[face]
    unit = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    corner = mesh.corners[face]
    facing = np.einsum("ij,ij->i", unit, -directions)
    steep = np.where(np.abs(facing) > 1e-6, facing, 1e-6)
    distance = np.einsum("ij,ij->i", unit, origins - corner[:, 0]) / steep
    point = origins + distance[:, None] * directions
    grey = np.where(facing >= 0, 0.25 + 0.65 * facing, 0.10 - 0.25 * facing)
    nearest = np.full(len(face), np.inf)
    for k in range(3):
        edge = corner[:, (k + 1) % 3] - corner[:, k]
        edge /= np.linalg.norm(edge, axis=1, keepdims=True)
        nearest = np.minimum(nearest, np.linalg.norm(np.cross(point - corner[:, k], edge), axis=1))
    size_px = np.sqrt(np.linalg.norm(normal, axis=1)) / pixel
    strength = np.interp(size_px, _LINED_PX, (0.0, 0.55))
    return np.where(nearest < _LINE_PX * pixel, (1 - strength) * grey, grey)
