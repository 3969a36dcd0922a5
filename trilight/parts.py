"""Components of a scene from Python: materials, and meshes from arrays."""

from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.exchange.from_description import DescribedMaterial, LoadedMesh, Vector
from storage.errors import TrilightError
from storage.settings.described import checked
from storage.settings.ranges import FLOAT32_MAX, Within


@checked("material")
class Material:
    """Reflection and emission of a surface: Lambert and GGX, as in storage.conventions."""

    diffuse: Annotated[tuple[float, ...], Within(0, 1)] = (0.5, 0.5, 0.5)
    """Diffuse albedo, linear red, green, blue; with `specular` at most 1 in each."""
    specular: Annotated[tuple[float, ...], Within(0, 1)] = (0.0, 0.0, 0.0)
    """Specular albedo, linear red, green, blue."""
    roughness: Annotated[float, Within(0, 1)] = 0.5
    """Roughness; its square is the GGX width."""
    emission: Annotated[tuple[float, ...], Within(0, FLOAT32_MAX)] = (0.0, 0.0, 0.0)
    """Radiance of both sides; each triangle of an emitting mesh is a separate emitter."""
    smooth: bool = True
    """Interpolate normals across edges of up to 30 degrees; otherwise flat."""

    def __post_init__(self) -> None:
        for name in ("diffuse", "specular", "emission"):
            vector(f"material: {name}", getattr(self, name))


def described_material(material: Material) -> DescribedMaterial:
    """Return a material in the form of a scene file."""
    return DescribedMaterial(
        diffuse=vector("diffuse", material.diffuse),
        specular=vector("specular", material.specular),
        roughness=material.roughness,
        emissive=vector("emission", material.emission),
        smooth_shading=material.smooth,
        random_diffuse_max=1.0,
        random_diffuse_type="per-triangle",
        rand_tri_diffuse_seed=None,
    )


def vector(name: str, values: ArrayLike) -> Vector:
    """Return three finite numbers; raises TrilightError with `name` for other values."""
    array = np.asarray(values, np.float64)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise TrilightError(f"{name} is {values!r}; expected three finite numbers.")
    x, y, z = array.tolist()
    return x, y, z


def mesh_of_arrays(positions: ArrayLike, faces: ArrayLike, *, uid: str, licence: str) -> LoadedMesh:
    """Return vertices [V, 3] and triangles [F, 3] as a mesh.

    Raises:
        TrilightError: the arrays are not a mesh; the message names `uid`.
    """
    points: NDArray[np.float64] = np.asarray(positions, np.float64)
    rows = np.asarray(faces)
    if points.ndim != 2 or points.shape[1:] != (3,) or not np.isfinite(points).all():
        raise TrilightError(
            f"{uid}: vertices have shape {points.shape}; expected [V, 3] finite meters."
        )
    is_integer = np.issubdtype(rows.dtype, np.integer)
    if rows.ndim != 2 or rows.shape[1:] != (3,) or len(rows) == 0 or not is_integer:
        raise TrilightError(
            f"{uid}: triangles have shape {rows.shape} and dtype {rows.dtype}; expected [F, 3] "
            "whole numbers."
        )
    if rows.min() < 0 or rows.max() >= len(points):
        raise TrilightError(
            f"{uid}: triangles name vertices {rows.min()} to {rows.max()}; expected 0 to "
            f"{len(points) - 1}."
        )
    centre = points.mean(axis=0)
    reach = float(np.sqrt(np.sum(np.square(points - centre), axis=1).max()))
    return LoadedMesh(
        uid=uid,
        licence=licence,
        positions=points,
        faces=rows.astype(np.int64),
        centre=centre,
        reach=reach,
    )
