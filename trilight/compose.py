"""Scenes from Python: meshes with materials, a floor, lamps and cameras.

The builder collects the content of a RenderFormer scene file, and the reader of such files
(pipeline.exchange.from_description) turns it into a scene.
"""

import dataclasses
import os
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.exchange.from_description import (
    SHELL_FOLDER,
    DescribedCamera,
    DescribedMaterial,
    DescribedObject,
    DescribedTransform,
    LoadedMesh,
    SceneDescription,
    Vector,
    centre_and_reach,
    scene_from_description,
)
from pipeline.exchange.reader import SceneReader
from pipeline.objects.generated import builtin_mesh
from pipeline.objects.licences import USER_PROVIDED
from scene_templates.rooms import PATCH_FACES, SIDES, PatchPlacement, patch
from storage.conventions import look_at_c2w
from storage.errors import TrilightError
from storage.records.scene import Scene
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
    centre, reach = centre_and_reach(points)
    return LoadedMesh(
        uid=uid,
        licence=licence,
        positions=points,
        faces=rows.astype(np.int64),
        centre=centre,
        reach=reach,
    )


_CC0 = "CC0-1.0"
_TEMPLATE = "python"
_TRIANGLE = np.array([[0.0, 1.0, 0.0], [-(0.75**0.5), -0.5, 0.0], [0.75**0.5, -0.5, 0.0]]) / 3**0.5
"""Corners of an equilateral triangle of edge 1 around the origin."""


_STAYS = DescribedTransform(
    translation=(0.0, 0.0, 0.0),
    rotation=(0.0, 0.0, 0.0),
    scale=(1.0, 1.0, 1.0),
    normalize=False,
)


_Mesh = LoadedMesh | tuple[Path, str]
"""A mesh, or the file and the licence of a mesh that `SceneBuilder.scene` reads."""


class SceneBuilder:
    """Collects the contents of a scene; `scene` builds it. The other methods return the builder."""

    def __init__(self, name: str = "scene") -> None:
        """Begin an empty scene; messages and its provenance hold `name`."""
        self._name = name
        self._objects: dict[str, DescribedObject] = {}
        self._meshes: list[_Mesh] = []
        self._cameras: list[DescribedCamera] = []

    def add_mesh(
        self,
        mesh: str | os.PathLike[str] | tuple[ArrayLike, ArrayLike],
        material: Material | None = None,
        *,
        name: str | None = None,
        at: Vector = (0.0, 0.0, 0.0),
        size: float | None = None,
        rotation_deg: Vector = (0.0, 0.0, 0.0),
        licence: str = USER_PROVIDED,
    ) -> Self:
        """Add an object.

        Args:
            mesh: a file `.glb .gltf .obj .ply .stl .off`, which `scene` reads; or vertices [V, 3]
                and triangles [F, 3] of their rows, counter-clockwise seen from outside.
            material: material of the whole object; gray by default.
            name: unique in the scene; after the file, or `objectN`, by default.
            at: position of the mesh's origin, meters; with `size` of the mean of its vertices.
            size: diameter in meters of the sphere around that mean that holds the mesh; by default
                the mesh keeps the units of its file.
            rotation_deg: angles about the world's X, then Y, then Z.
            licence: SPDX identifier, or `LicenseRef-...`.

        Raises:
            TrilightError: no such file, arrays that are no mesh, invalid numbers, or a used name.
        """
        if isinstance(mesh, tuple):
            name = name or f"object{len(self._objects)}"
            loaded: _Mesh = mesh_of_arrays(*mesh, uid=name, licence=licence)
        else:
            path = Path(mesh)
            if not path.is_file():
                raise TrilightError(f"{path}: no such file; expected a mesh.")
            name = name or self._unique_name(path.stem)
            loaded = (path, licence)
        if size is not None and not 0 < size < np.inf:
            raise TrilightError(f"{name}: size is {size}; expected meters above 0.")
        if size is not None and isinstance(loaded, LoadedMesh) and loaded.reach == 0:
            raise TrilightError(f"{name}: all vertices are one point; expected a mesh.")
        scale = 1.0 if size is None else float(size)
        transform = DescribedTransform(
            translation=vector(f"{name}: at", at),
            rotation=vector(f"{name}: rotation_deg", rotation_deg),
            scale=(scale, scale, scale),
            normalize=size is not None,
        )
        return self._add(name, loaded, transform, material or Material())

    def add_builtin(
        self,
        family: str,
        material: Material | None = None,
        *,
        number: int = 0,
        name: str | None = None,
        at: Vector = (0.0, 0.0, 0.0),
        size: float = 0.6,
        rotation_deg: Vector = (0.0, 0.0, 0.0),
    ) -> Self:
        """Add a procedural object, such as the third `rock` or `torus_knot` of `builtin:`.

        Args:
            family: name of a family in pipeline.objects.generated.
            number: index within the family, from 0.
            material, name, at, size, rotation_deg: as `add_mesh`.

        Raises:
            TrilightError: there is no such family, or as `add_mesh`.
        """
        return self.add_mesh(
            builtin_mesh(family, number),
            material,
            name=name or self._unique_name(family),
            at=at,
            size=size,
            rotation_deg=rotation_deg,
            licence=_CC0,
        )

    def add_floor(
        self, material: Material | None = None, *, size: float = 2.0, height: float = -0.5
    ) -> Self:
        """Add a level square of 128 triangles, as in the rooms of Trilight's datasets.

        Args:
            material: material of the floor; gray by default.
            size: side in meters; the square is centered at x = y = 0.
            height: z of the floor in meters; the floor of the nominal room is at -0.5.
        """
        placement = PatchPlacement(
            rotation_deg=(0, 0, 0),
            reach=1,
            scale=(size, size, 1),
            translation=(0, 0, 1 + 2 * height),
        )
        name = self._unique_name("floor")
        square = (patch(SIDES["floor"], placement), PATCH_FACES)
        mesh = mesh_of_arrays(*square, uid=f"{SHELL_FOLDER}{name}", licence=_CC0)
        flat = dataclasses.replace(material or Material(), smooth=False)
        return self._add(name, mesh, _STAYS, flat)

    def add_lamp(
        self,
        *,
        at: Vector,
        radiance: float | Vector = 2000.0,
        size: float = 0.15,
        towards: Vector = (0.0, 0.0, 0.0),
    ) -> Self:
        """Add an emitter: an equilateral triangle that emits from both sides, hidden from cameras.

        Args:
            at: center of the triangle, meters.
            radiance: linear red, green, blue, or one number for white.
            size: edge length in meters; the power grows with its square.
            towards: point that the triangle faces.

        Raises:
            TrilightError: invalid numbers.
        """
        name = self._unique_name("lamp")
        middle = vector(f"{name}: at", at)
        target = vector(f"{name}: towards", towards)
        if middle == target or not 0 < size < np.inf:
            raise TrilightError(
                f"{name}: size is {size} and towards is {target} from {middle}; expected meters "
                "above 0, and another point."
            )
        up = (0.0, 0.0, 1.0) if middle[:2] != target[:2] else (0.0, 1.0, 0.0)
        pose = look_at_c2w(eye=middle, target=target, up=up)
        corners = size * _TRIANGLE @ pose[:3, :3].T + np.array(middle)
        rgb = (radiance, radiance, radiance) if isinstance(radiance, float | int) else radiance
        shining = Material(diffuse=(0.0, 0.0, 0.0), roughness=1.0, emission=rgb)
        mesh = mesh_of_arrays(corners, [[0, 2, 1]], uid=name, licence=_CC0)
        return self._add(name, mesh, _STAYS, shining)

    def add_camera(
        self,
        *,
        at: Vector,
        look_at: Vector = (0.0, 0.0, 0.0),
        fov_deg: float = 40.0,
        up: Vector = (0.0, 0.0, 1.0),
    ) -> Self:
        """Add a camera.

        Args:
            at: position of the camera, meters.
            look_at: point in the center of the picture.
            fov_deg: full angle of view, equal in width and height.
            up: roughly upwards in the picture; not along the view.
        """
        row = len(self._cameras)
        camera = DescribedCamera(
            position=vector(f"camera {row}: at", at),
            look_at=vector(f"camera {row}: look_at", look_at),
            up=vector(f"camera {row}: up", up),
            fov=float(fov_deg),
        )
        self._cameras.append(camera)
        return self

    def scene(self) -> Scene:
        """Build the scene, which passes `Scene.check`. A child process reads the mesh files.

        Raises:
            TrilightError: an unusable file, albedos beyond 1, or no lamp, camera or surface.
        """
        if not self._objects:
            raise TrilightError(
                f"{self._name}: holds no object; expected at least one. Call add_mesh, add_builtin "
                "or add_floor."
            )
        description = SceneDescription(
            file=self._name,
            scene_name=self._name,
            version="1.0",
            objects=self._objects,
            cameras=tuple(self._cameras),
        )
        with SceneReader() as reader:  # starts a child process only for mesh files
            meshes = [
                reader.mesh(*mesh) if isinstance(mesh, tuple) else mesh for mesh in self._meshes
            ]
        return scene_from_description(
            description,
            meshes,
            num_views=len(self._cameras),
            provenance={"template": _TEMPLATE, "name": self._name},
            albedo_over_one="refuse",
        )

    def _add(
        self,
        name: str,
        mesh: _Mesh,
        transform: DescribedTransform,
        material: Material,
    ) -> Self:
        if name in self._objects:
            raise TrilightError(
                f"{self._name}: objects holds the name {name!r} twice; expected unique names."
            )
        self._objects[name] = DescribedObject(
            name=name,
            mesh_path=str(mesh[0]) if isinstance(mesh, tuple) else mesh.uid,
            transform=transform,
            material=DescribedMaterial(
                diffuse=vector("diffuse", material.diffuse),
                specular=vector("specular", material.specular),
                roughness=material.roughness,
                emissive=vector("emission", material.emission),
                smooth_shading=material.smooth,
            ),
        )
        self._meshes.append(mesh)
        return self

    def _unique_name(self, name: str) -> str:
        """Return a name that no object has yet: `name`, `name1` or `name2`, and so on."""
        tries = (f"{name}{number or ''}" for number in range(len(self._objects) + 1))
        return next(text for text in tries if text not in self._objects)
