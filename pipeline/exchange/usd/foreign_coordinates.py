"""Which texture coordinates a UsdUVTexture reads, and their values at the corners of a mesh."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.usd.foreign_meshes import MeshToShade, per_corner

_MOST_NODES = 8
"""Maximum number of transforms in a row."""


@dataclass(frozen=True, kw_only=True)
class Move:
    """A UsdTransform2d: scaled, turned counter-clockwise, and shifted, in this order."""

    scale: tuple[float, float]
    rotation_deg: float
    translation: tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class UvChart:
    """What a texture reads."""

    primvar: str
    """Name of the coordinates of the mesh."""
    moves: tuple[Move, ...]
    """What moves them, the first one first."""


def chart_of(shader: Any, time: Any) -> UvChart:
    """Return the coordinates of a texture's shader; `st` where it states none."""
    from pxr import UsdShade

    st, moves = shader.GetInput("st"), list[Move]()
    for _ in range(_MOST_NODES):
        source = st.GetConnectedSources()[0] if st and st.HasConnectedSource() else []
        if not source:
            break
        node = UsdShade.Shader(source[0].source.GetPrim())
        if node.GetIdAttr().Get() == "UsdTransform2d":
            moves.append(
                Move(
                    scale=_pair(value_of(node, "scale", time, (1, 1))),
                    rotation_deg=float(value_of(node, "rotation", time, 0)),
                    translation=_pair(value_of(node, "translation", time, (0, 0))),
                )
            )
            st = node.GetInput("in")
            continue
        name = node.GetInput("varname")
        stated = UsdShade.Utils.GetValueProducingAttributes(name) if name else []
        if stated:
            return UvChart(primvar=str(stated[0].Get(time)), moves=tuple(reversed(moves)))
        break
    return UvChart(primvar="st", moves=tuple(reversed(moves)))


def coordinates(chart: UvChart, surface: MeshToShade, time: Any) -> NDArray[np.float64] | None:
    """Return coordinates [T, 3, 2] of a mesh; None where it has none, or not for every corner."""
    from pxr import UsdGeom

    primvar = UsdGeom.PrimvarsAPI(surface.prim).FindPrimvarWithInheritance(chart.primvar)
    if not primvar or not primvar.HasValue():
        return None
    values = np.array(primvar.ComputeFlattened(time), np.float64)
    if values.ndim != 2 or values.shape[1] < 2:
        return None
    interpolation = str(primvar.GetInterpolation())
    uv = per_corner(values[:, :2], interpolation, surface.indices, surface.soup)
    if uv is None or not np.isfinite(uv).all():
        return None
    for move in chart.moves:
        turn = np.radians(move.rotation_deg)
        u, v = np.moveaxis(uv * move.scale, -1, 0)
        across, up = np.cos(turn) * u - np.sin(turn) * v, np.sin(turn) * u + np.cos(turn) * v
        uv = np.stack([across, up], axis=-1) + move.translation
    return np.asarray(uv, np.float64)


def value_of(shader: Any, name: str, time: Any, default: Any) -> Any:
    """Return an input of a shader, or the default where it is not stated."""
    attribute = shader.GetInput(name)
    value = attribute.Get(time) if attribute else None
    return default if value is None else value


def _pair(value: Any) -> tuple[float, float]:
    one, two = value
    return float(one), float(two)
