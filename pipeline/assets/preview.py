"""Quick previews of meshes for side-by-side comparison: gray, lit from the camera."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.assets.cleaning.clean import clean, normalize
from pipeline.assets.cleaning.orient import first_faces, orient_outward
from pipeline.assets.quality.measure import level_mesh
from pipeline.assets.settings import AssetSettings
from pipeline.assets.source_materials.source_surface import barycentric
from pipeline.foreign.mesh import TriangleMesh
from pipeline.foreign.source_file import load_mesh, read_source
from storage.conventions import srgb8
from storage.records.asset import Level
from storage.records.lookup import texture_values

_TOWARDS_CAMERA = np.array([0.62, -0.62, 0.48])
_BACKGROUND = 1.0
_LINE_PX = 0.7
_LINED_PX = (3.0, 9.0)
"""Triangle sizes in pixels: no edge lines below the first, where they would only blacken the
picture, and full lines above the second."""
_SUPERSAMPLE = 2
_HALF_WIDTH = 0.72
"""Half of the picture's width, in widths of the unit box."""


def preview_source_and_level(
    path: str, settings: AssetSettings, level: Level, width_px: int
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return gray pictures [W, W] of a cleaned source file and of one of its levels.

    That of a level with colors is [W, W, 3].

    Raises Rejected as `prepare_asset`.
    """
    data = read_source(Path(path), settings.read_limits)
    mesh, _ = orient_outward(clean(normalize(load_mesh(data))))
    simplified = level_mesh(level)
    if level.skin is None:
        return preview(mesh, width_px), preview(simplified, width_px)
    hits = _CameraHits(simplified, width_px * _SUPERSAMPLE)  # in color without edge lines
    uv = np.einsum("nc,ncd->nd", barycentric(hits.corners, hits.points), level.skin.uv[hits.face])
    diffuse, specular = (texture_values(texture, uv) for texture in level.skin.textures[:2])
    colors = (diffuse + specular) * (0.25 + 0.75 * np.abs(hits.facing))[:, None]
    return preview(mesh, width_px), srgb8(hits.picture(colors))


def preview(mesh: TriangleMesh, width_px: int) -> NDArray[np.uint8]:
    """Return a gray picture [W, W] of a mesh in the unit box, +Z up, with its edges drawn.

    Parallel projection from the front right and above; back faces are darker.
    """
    hits = _CameraHits(mesh, width_px * _SUPERSAMPLE)
    grey = np.where(hits.facing >= 0, 0.25 + 0.65 * hits.facing, 0.10 - 0.25 * hits.facing)
    edges = np.roll(hits.corners, -1, axis=1) - hits.corners
    edges /= np.linalg.norm(edges, axis=2, keepdims=True)
    across = np.linalg.norm(np.cross(hits.points[:, None] - hits.corners, edges), axis=2)
    size_px = np.sqrt(hits.double_areas) / hits.pixel
    strength = np.interp(size_px, _LINED_PX, (0.0, 0.55))
    lined = np.where(across.min(axis=1) < _LINE_PX * hits.pixel, (1 - strength) * grey, grey)
    return np.round(255 * hits.picture(lined)).astype(np.uint8)


class _CameraHits:
    """The points of a mesh that the camera's rays hit: faces [N] and what is known there."""

    def __init__(self, mesh: TriangleMesh, width_px: int) -> None:
        back = _TOWARDS_CAMERA / np.linalg.norm(_TOWARDS_CAMERA)
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        offset = _HALF_WIDTH * ((np.arange(width_px) + 0.5) / width_px * 2 - 1)
        rows = -offset[:, None, None] * np.cross(back, right)
        origins = (rows + offset[None, :, None] * right + 2 * back).reshape(-1, 3)
        directions = np.broadcast_to(-back, origins.shape)
        face = first_faces(mesh, origins.astype(np.float32), directions.astype(np.float32))
        self._width_px = width_px
        self._is_hit = face >= 0
        self.pixel = 2 * _HALF_WIDTH / width_px
        self.face = face[self._is_hit]
        self.corners = mesh.corners[self.face]
        normals = mesh.double_area_vectors[self.face]
        self.double_areas = np.linalg.norm(normals, axis=1)
        unit = normals / self.double_areas[:, None]
        ahead = directions[self._is_hit]
        eyes = origins[self._is_hit]
        self.facing = np.einsum("ij,ij->i", unit, -ahead)
        steep = np.where(np.abs(self.facing) > 1e-6, self.facing, 1e-6)
        distance = np.einsum("ij,ij->i", unit, eyes - self.corners[:, 0]) / steep
        self.points = eyes + distance[:, None] * ahead

    def picture(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the picture of values [N, ...] at the hits, of half the width."""
        pixels = np.full((len(self._is_hit), *values.shape[1:]), _BACKGROUND)
        pixels[self._is_hit] = values
        side = self._width_px // _SUPERSAMPLE
        blocks = pixels.reshape(side, _SUPERSAMPLE, side, _SUPERSAMPLE, *values.shape[1:])
        return np.asarray(blocks.mean(axis=(1, 3)))
