"""Builds scenes of files in child processes, from one folder and nothing outside it.

All files of a scene are in that folder: a path that leads out of it, by dots or by a link, is
refused. The digest of every file is compared with the locked one, so that no scene is built from
changed bytes. Scene k is the k-th `*.json` of the folder by name. An unusable file keeps its
number: that scene is rejected, and a row of failures.jsonl states the reason.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pipeline.assets.settings import AssetSettings
from pipeline.exchange.from_description import (
    AlbedoOverOne,
    CameraFile,
    Cameras,
    LoadedMesh,
    build_cameras,
    centre_and_reach,
    scaled_albedo_notes,
    scene_from_description,
)
from pipeline.exchange.renderformer_json import MAX_BYTES, read_record, read_renderformer_json
from pipeline.exchange.textured_triangles import LoadedScene
from pipeline.foreign.material_files import find_in_any_case
from storage.digests import sha256_hex
from storage.errors import EnvironmentFailure, Rejected, TrilightError
from storage.records.safe_read import name_unreadable, open_plain
from storage.records.scene import Scene

TEMPLATE = "renderformer-json"
"""Value of `template` in the provenance of such scenes."""


@dataclass(frozen=True, kw_only=True)
class SceneFiles:
    """Scene files of one folder, from which a render child builds any scene."""

    root: Path  # the folder, with links resolved; nothing outside it is read
    names: tuple[str, ...]
    """Names of all scene files, sorted; the position is the scene index, usable or not."""
    unusable: Mapping[str, str]
    """Reason why no scene can be made of a file, by the name of each such file."""
    num_cameras: Mapping[str, int] = field(default_factory=dict)  # by the name of each usable file
    albedo_over_one: AlbedoOverOne = "scale"  # treatment of albedos over 1
    notes: tuple[str, ...] = ()
    """Sentences for the user: on unknown fields, and on the scenes once they are built."""
    sha256: Mapping[str, str] = field(default_factory=dict)
    """Digest of every locked file by its path below `root`; empty before they are locked."""
    licence: str = ""  # licence of every object

    def views(self, num_views: int | None) -> int:
        """Return the number of views of each scene: `num_views`, or the fewest cameras of a file.

        Cameras come from the files alone; none is added.

        Raises:
            TrilightError: a file has fewer cameras than `num_views`.
        """
        file, fewest = min(self.num_cameras.items(), key=lambda item: item[1])
        if num_views is None:
            return fewest
        if not 1 <= num_views <= fewest:
            raise TrilightError(
                f"--views is {num_views}; expected 1 to {fewest}, the number of cameras in {file}: "
                "choose fewer views, or add cameras to the file."
            )
        return num_views

    def unused_camera_notes(self, num_views: int) -> tuple[str, ...]:
        """Return a sentence for each file with more cameras than are used."""
        return tuple(
            f"{name}: {count - num_views} of {count} cameras not used, from cameras[{num_views}] on"
            for name, count in self.num_cameras.items()
            if count > num_views
        )

    def scene(self, scene_index: int, assets: AssetSettings, num_views: int, seed: int) -> Scene:
        """Build the scene of the file `names[scene_index]`; only child processes call this.

        `num_views` cameras are taken; the provenance records the dataset's `seed`.

        Raises:
            Rejected: "unusable_scene_file", for a file of which no scene can be made.
            TrilightError: a file differs from the one that was locked.
        """
        name = self.names[scene_index]
        if (why := self.unusable.get(name)) is not None:
            raise Rejected("unusable_scene_file", why)
        loaded, digests = build_scene(
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
        return loaded.scene


def read_scene_cameras(root: Path, name: str) -> Cameras:
    """Read the poses [C, 4, 4] and angles [C] in degrees of a scene file or a list of cameras.

    Raises:
        TrilightError: the file or a camera in it is unusable; the message names it.
    """
    file = read_record(CameraFile, _read_scene_file(root, name), name)
    return build_cameras(file.cameras, name)


def build_scene(
    root: Path,
    name: str,
    settings: AssetSettings,
    *,
    licence: str,
    num_views: int | None = None,
    scene_index: int = 0,
    seed: int = 0,
    albedo_over_one: AlbedoOverOne = "scale",
) -> tuple[LoadedScene, Mapping[str, str]]:
    """Build the scene of one file; only child processes call this, since it reads meshes.

    `num_views` cameras are taken, or all; index and seed stand in the provenance only. Notes name
    what was ignored in any file, and objects that became darker. The scene comes with the sha256 of
    each of its files by path below `root`, a folder whose links are resolved.

    Raises:
        TrilightError: the file or a mesh is unusable; the message names it.
    """
    data = _read_scene_file(root, name)
    description = read_renderformer_json(data, name)
    objects = description.objects.values()
    num_views = len(description.cameras) if num_views is None else num_views
    digests = {name: sha256_hex(data)}
    notes = [f"unknown field {field}" for field in description.unknown_fields]
    meshes: dict[tuple[str, int | None], LoadedMesh] = {}
    for described in objects:
        key = (described.mesh_path, described.remesh_faces)
        if key not in meshes:
            where = f"{name}: objects.{described.name}.mesh_path"
            path = _below(root, described.mesh_path, where)
            uid = path.relative_to(root).as_posix()
            display_name = f"{where} is {described.mesh_path}"
            meshes[key] = load_mesh_file(
                path, uid, display_name, settings, licence, described.remesh_faces
            )
            digests[uid] = meshes[key].sha256
            notes += (f"{uid}: {text}" for text in meshes[key].unread)
    scene = scene_from_description(
        description,
        [meshes[described.mesh_path, described.remesh_faces] for described in objects],
        num_views=num_views,
        albedo_over_one=albedo_over_one,
        provenance={
            "template": TEMPLATE,
            "scene_index": scene_index,
            "attempt": 0,
            "seed": seed,
            "camera_attempts": [0] * num_views,
            "scene_file": {
                "name": description.file,
                "sha256": digests[name],
                "scene_name": description.scene_name,
                "cameras": list(range(num_views)),
            },
        },
    )
    return LoadedScene(scene=scene, notes=(*notes, *scaled_albedo_notes(scene))), digests


def load_mesh_file(
    path: Path,
    uid: str,
    display_name: str,
    settings: AssetSettings,
    licence: str,
    remesh_faces: int | None = None,
) -> LoadedMesh:
    """Read the mesh of a scene; only child processes call this.

    A scene file states where each vertex lies: unlike objects for random scenes, its meshes are not
    centered, welded, repaired or flipped. The mesh gets the identifier `uid`; messages call it
    `display_name`. `remesh_faces` is the maximum number of triangles after remeshing; None keeps
    the mesh.

    Raises:
        TrilightError: the file is not a usable mesh, or cannot be read.
    """
    from pipeline.assets.cleaning.clean import check_raw
    from pipeline.foreign.source_file import load_mesh, read_source

    try:
        source = read_source(path, settings.read_limits)
        raw = load_mesh(source)
        check_raw(raw, settings, is_single=source.is_single)
        if not np.isfinite(raw.positions).all():
            raise Rejected("nonfinite_vertices", "a vertex without a triangle is not finite")
        mesh = raw
        if remesh_faces is not None:
            # mesh libraries: in children only
            from pipeline.assets.decimation.decimate import remesh

            mesh = remesh(raw, remesh_faces)
    except Rejected as rejection:
        raise TrilightError(f"{display_name}: {rejection}; expected a usable mesh.") from rejection
    except OSError as error:
        raise TrilightError(f"{display_name}: cannot be read ({error.strerror}).") from error
    centre, reach = centre_and_reach(raw.positions)
    return LoadedMesh(
        uid=uid,
        licence=licence,
        positions=mesh.positions,
        faces=mesh.faces,
        centre=centre,
        reach=reach,
        unread=source.unread,
        sha256=source.sha256,
    )


def _read_scene_file(root: Path, name: str) -> bytes:
    """Return the bytes of a scene file, as many as its reader accepts and one more."""
    with name_unreadable(name), open_plain(_below(root, name, name)) as stream:
        return stream.read(MAX_BYTES + 1)


def _below(root: Path, relative: str, where: str) -> Path:
    """Resolve a path, links followed; raises TrilightError where it leads out of `root`."""
    try:
        path = (root / relative).resolve()
        if not path.exists():  # perhaps a path of Windows: backslashes, other letter case
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


MAX_SCENES = 100_000
"""Maximum number of scene files in a folder."""


def find_scene_files(folder: str, albedo_over_one: AlbedoOverOne = "scale") -> SceneFiles:
    """Read every `*.json` of a local folder, without its subfolders.

    Raises:
        TrilightError: the folder is missing, or has no scene files, too many, or no usable one.
    """
    root = Path(folder)
    if not root.is_dir():
        raise TrilightError(f"--scenes-from {folder}: no such folder; expected one of *.json.")
    root = root.resolve()
    names = sorted(path.name for path in root.glob("*.json"))
    if not 1 <= len(names) <= MAX_SCENES:
        raise TrilightError(
            f"--scenes-from {folder}: {len(names)} files *.json; expected 1 to {MAX_SCENES}."
        )
    for name in names:
        if not name.isprintable():
            raise TrilightError(
                f"--scenes-from {folder}: rename {name!r}; expected printable text."
            )
    num_cameras = {}
    notes: list[str] = []
    unusable = {}
    for name in names:
        try:
            description = read_renderformer_json(_read_scene_file(root, name), name)
            num_cameras[name] = len(description.cameras)
            notes += (f"{name}: unknown field {field}" for field in description.unknown_fields)
        except EnvironmentFailure:
            raise
        except TrilightError as mistake:
            unusable[name] = str(mistake)
    require_usable(names, unusable)
    return SceneFiles(
        root=root,
        names=tuple(names),
        unusable=unusable,
        num_cameras=num_cameras,
        albedo_over_one=albedo_over_one,
        notes=tuple(notes),
    )


def require_usable(names: Sequence[str], unusable: Mapping[str, str]) -> None:
    """Raise TrilightError where no file is usable; the message gives the first reason."""
    if len(unusable) == len(names):
        raise TrilightError(
            f"--scenes-from: none of the {len(names)} scene files is usable; the first: "
            f"{unusable[names[0]]}"
        )
