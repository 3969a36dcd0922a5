"""Quality of a level's textures: color error, missing texels, torn seams."""

import igl
import numpy as np
from numpy.typing import NDArray

from pipeline.assets.quality.measure import sample_surface
from pipeline.assets.quality.triangles import round_digits, unit_normals
from pipeline.assets.source_materials.bake import DIFFUSE, BakedTextures
from pipeline.assets.source_materials.nearest import SurfaceLookup, barycentric
from pipeline.assets.source_materials.source_surface import SourceSurface
from pipeline.foreign.mesh import TriangleMesh
from storage.records.lookup import texture_values
from storage.records.skin import SkinQuality
from storage.seeds import rng_for

_NUM_POINTS = 4096
"""Points on the source at which the color error is measured."""
_ALONG = (0.2, 0.5, 0.8)
"""Positions along an edge, as fractions, at which its two sides are compared."""
_TORN_TEXELS = 2.0
"""Gap in texels from which a seam counts as torn."""


def skin_quality(
    level: TriangleMesh,
    baked: BakedTextures,
    source: SourceSurface,
    nearest: SurfaceLookup,
    reach: float,
) -> SkinQuality:
    """Return the measures of a baked level; arguments as those of `bake`."""
    error = _color_errors(level, baked, source)
    return SkinQuality(
        colour_error=round_digits(error.mean()),
        colour_error_p95=round_digits(np.percentile(error, 95)),
        missed_cells=round_digits(baked.missed),
        torn_seams=round_digits(_torn_seams(level, nearest, source, reach, 1 / baked.density)),
        texels_per_length=round_digits(baked.density),
    )


def _color_errors(
    level: TriangleMesh, baked: BakedTextures, source: SourceSurface
) -> NDArray[np.float64]:
    """Return the mean color difference [N] at points spread evenly over the source."""
    uniform = rng_for(0, "own-materials").random((_NUM_POINTS, 3))
    points = sample_surface(source.mesh, uniform)
    weights = barycentric(source.mesh.corners[points.faces], points.positions)
    source_rgb = source.columns(points.faces, weights, 1 / baked.density)[:, DIFFUSE]
    _, faces, nearest = igl.point_mesh_squared_distance(
        points.positions, level.positions, level.faces
    )
    faces = np.asarray(faces, np.int64).ravel()
    uv = np.einsum("nc,ncd->nd", barycentric(level.corners[faces], nearest), baked.uv[faces])
    level_rgb = texture_values(baked.textures[0], uv)
    return np.abs(level_rgb - source_rgb).mean(axis=1)


def _torn_seams(
    level: TriangleMesh,
    nearest: SurfaceLookup,
    source: SourceSurface,
    reach: float,
    texel: float,
) -> float:
    """Return the fraction of inner edge length whose two sides show distant source points."""
    directed = np.stack([level.faces, np.roll(level.faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    ends = np.sort(directed, axis=1)
    edges, edge, count = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    edge = edge.ravel()
    order = np.argsort(edge, kind="stable")
    sides = order[count[edge[order]] == 2].reshape(-1, 2) // 3
    if not len(sides):
        return 0.0
    inner = level.positions[edges[count == 2]]
    normal = unit_normals(level)
    along = np.array(_ALONG)[:, None, None]
    points = ((1 - along) * inner[:, 0] + along * inner[:, 1]).reshape(-1, 3)
    side_positions = []
    for side in sides.T:
        locations = nearest.find(points, np.tile(normal[side], (len(_ALONG), 1)), reach)
        corners = source.mesh.corners[locations.faces]
        side_positions.append(np.einsum("nc,ncd->nd", locations.weights, corners))
    gap = np.linalg.norm(side_positions[0] - side_positions[1], axis=1).reshape(len(_ALONG), -1)
    length = np.linalg.norm(inner[:, 1] - inner[:, 0], axis=1)
    torn = (gap > _TORN_TEXELS * texel).mean(axis=0)
    return float((torn * length).sum() / length.sum())
