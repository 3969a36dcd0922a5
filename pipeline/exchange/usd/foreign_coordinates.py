"""The values of the texture coordinates that a UsdUVTexture reads, at the corners of a mesh."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.usd.foreign_meshes import MeshToShade
from pipeline.foreign.usd.texture_nodes import UvChart, chart_corners


def coordinates(chart: UvChart, surface: MeshToShade, time: Any) -> NDArray[np.float64] | None:
    """Return coordinates [T, 3, 2] of a mesh; None where it has none, or not for every corner."""
    soup = surface.soup
    uv = chart_corners(chart, surface.prim, surface.indices, soup.corners, soup.polygons, time)
    if uv is None or not np.isfinite(uv).all():
        return None
    for move in chart.moves:
        uv = np.einsum("ij,tcj->tci", move.turn, uv) + move.translation
    return uv
