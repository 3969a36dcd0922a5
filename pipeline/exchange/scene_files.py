"""Scenes of files, each built in a child process from one folder and nothing outside of it.

Everything that a scene is made of lies in that folder: a path that leads out of it, by dots or by a
link, is refused. What a scene is made of is known by its digests, so that none is ever built from
other bytes than the ones that were locked.
"""

import stat
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.assets.settings import AssetSettings
from pipeline.exchange.description import DescribedObject, SceneDescription
from pipeline.exchange.from_description import (
    AlbedoOverOne,
    LoadedMesh,
    build_cameras,
    scene_from_description,
)
from pipeline.exchange.renderformer_json import MAX_BYTES, read_cameras, read_description
from pipeline.foreign.material_files import find_in_any_case
from storage.digests import sha256_hex
from storage.errors import Rejected, TrilightError
from storage.records.scene import Scene

TEMPLATE = "renderformer-json"
"""What stands as the template of such scenes in their provenance."""


@dataclass(frozen=True, kw_only=True)
class SceneFiles:
    """What a render child needs to build any scene of the folder."""

    root: Path  # the folder, without links
    names: tuple[str, ...]  # the scene files; the position is the index of the scene
    sha256: Mapping[str, str]  # digest of every locked file by its path below `root`
    unusable: Mapping[str, str]
    """What is wrong with each file of which no scene can be made, by its name."""
    licence: str  # licence of every object
    albedo_over_one: AlbedoOverOne = "scale"  # what to do where albedos add up to more than 1
    notes: tuple[str, ...] = ()  # what a person should know of the scenes that were built

    def scene(self, scene_index: int, assets: AssetSettings, *, num_views: int, seed: int) -> Scene:
        """Build a scene; only children come here, since it reads meshes.

        Args:
            scene_index: which.
            assets: limits on meshes.
            num_views: cameras to take from its file.
            seed: of the dataset; stands in the provenance, and decides nothing here.

        Raises:
            Rejected: "unusable_scene_file", for a file of which none can be made.
            TrilightError: a file is not the one that was locked.
        """
        name = self.names[scene_index]
        if (why := self.unusable.get(name)) is not None:
            raise Rejected("unusable_scene_file", why)
        scene, digests = build_scene(
            self.root,
            name,
            assets,
            licence=self.licence,
            num_views=num_views,
            scene_index=scene_index,
            seed=seed,
            albedo_over_one=self.albedo_over_one,
        )
        for uid, digest in digests.items():
            if self.sha256.get(uid) != digest:
                raise TrilightError(
                    f"{uid}: has changed while the dataset was being made; restore it and run the "
                    "same command again."
                )
        return scene


def read_scene_description(root: Path, name: str) -> SceneDescription:
    """Return what a scene file in the folder `root` describes; raises TrilightError."""
    return read_description(_read_scene_file(root, name), name)


def read_scene_cameras(root: Path, name: str) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the poses [C, 4, 4] and angles [C] of a scene file or a list of cameras.

    Raises:
        TrilightError: the file or a camera in it is unusable, named.
    """
    cameras = read_cameras(_read_scene_file(root, name), name)
    try:
        return build_cameras(cameras)
    except TrilightError as error:
        raise TrilightError(f"{name}: {error}") from error


def build_scene(
    root: Path,
    name: str,
    settings: AssetSettings,
    *,
    licence: str,
    num_views: int | None,
    scene_index: int,
    seed: int,
    albedo_over_one: AlbedoOverOne = "scale",
    notes: list[str] | None = None,
) -> tuple[Scene, Mapping[str, str]]:
    """Build the scene of one file; only children come here, since it reads meshes.

    Args:
        root: the folder, without links.
        name: of the scene file in it.
        settings: limits on meshes.
        licence: of the objects.
        num_views: cameras to take from the file, or None for all.
        scene_index: which scene of the dataset this is; stands in its provenance.
        seed: of the dataset; stands in the provenance, and decides nothing here.
        albedo_over_one: what to do where albedos add up to more than 1.
        notes: receives what of the meshes no code has read.

    Returns:
        The scene, and the sha256 of every file that it was made of by path below `root`.

    Raises:
        TrilightError: anything in the file or its meshes is unusable, named.
    """
    data = _read_scene_file(root, name)
    description = read_description(data, name)
    num_views = len(description.cameras) if num_views is None else num_views
    digests = {name: sha256_hex(data)}
    meshes: dict[tuple[str, int | None], LoadedMesh] = {}
    for described in description.objects:
        key = (described.mesh_path, described.remesh_faces)
        if key not in meshes:
            meshes[key], digest = _load_mesh(root, described, name, settings, licence)
            digests[meshes[key].uid] = digest
            if notes is not None:
                notes += (f"{meshes[key].uid}: {text}" for text in meshes[key].unread)
    scene = scene_from_description(
        description,
        [meshes[described.mesh_path, described.remesh_faces] for described in description.objects],
        num_views=num_views,
        albedo_over_one=albedo_over_one,
        provenance={
            "template": TEMPLATE,
            "scene_index": scene_index,
            "attempt": 0,
            "seed": seed,
            "camera_attempts": [0] * num_views,
            "scene_file": {
                "name": name,
                "sha256": digests[name],
                "scene_name": description.scene_name,
                "cameras": list(range(num_views)),
            },
        },
    )
    return scene, digests


def _load_mesh(
    root: Path, described: DescribedObject, name: str, settings: AssetSettings, licence: str
) -> tuple[LoadedMesh, str]:
    """Return the mesh of an object, and the digest of its file."""
    where = f"{name}: objects.{described.name}.mesh_path"
    path = _below(root, described.mesh_path, where)
    uid = path.relative_to(root).as_posix()
    display_name = f"{where} is {described.mesh_path}"
    return load_mesh_file(path, uid, display_name, settings, licence, described.remesh_faces)


def load_mesh_file(
    path: Path,
    uid: str,
    display_name: str,
    settings: AssetSettings,
    licence: str,
    remesh_faces: int | None = None,
) -> tuple[LoadedMesh, str]:
    """Read the mesh of a scene; only children come here.

    Args:
        path: the file.
        uid: what the scene calls it.
        shown: what the user named, for messages.
        settings: limits on meshes.
        licence: of the object.
        remesh_faces: most triangles of a remeshed mesh, or None for the mesh as it is.

    Returns:
        The mesh, and the sha256 of its file.

    Raises:
        TrilightError: the file is no usable mesh, or cannot be read.
    """
    from pipeline.assets.scene_mesh import load_scene_mesh  # mesh libraries: in children only

    try:
        loaded = load_scene_mesh(path, settings, remesh_faces)
    except Rejected as rejection:
        raise TrilightError(f"{display_name}: {rejection}; expected a usable mesh.") from rejection
    except OSError as error:
        raise TrilightError(f"{display_name}: cannot be read ({error.strerror}).") from error
    mesh = LoadedMesh(
        uid=uid,
        licence=licence,
        positions=loaded.mesh.positions,
        faces=loaded.mesh.faces,
        centre=loaded.centre,
        reach=loaded.reach,
        unread=loaded.unread,
    )
    return mesh, loaded.sha256


def _read_scene_file(root: Path, name: str) -> bytes:
    path = _below(root, name, name)
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode) or status.st_size > MAX_BYTES:
            raise TrilightError(f"{name}: expected a regular file of at most {MAX_BYTES} bytes.")
        return path.read_bytes()
    except OSError as error:
        raise TrilightError(f"{name}: cannot be read ({error.strerror}).") from error


def _below(root: Path, relative: str, where: str) -> Path:
    """Return the file that a path means, links followed, if it is below `root`."""
    try:
        path = (root / relative).resolve()
        if not path.exists():  # as a program on Windows writes it
            path = find_in_any_case(root, relative.replace("\\", "/"), root)
    except (OSError, RuntimeError) as error:  # links in a circle
        raise TrilightError(
            f"{where} is {relative}, which cannot be followed: links in a circle."
        ) from error
    if not path.is_relative_to(root) or path == root:
        raise TrilightError(
            f"{where} is {relative}, which leads out of the folder of the scenes; expected a file "
            "below it: copy it there."
        )
    return path
