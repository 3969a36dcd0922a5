"""Reads RenderFormer's scene JSON (version 1.0) as a `SceneDescription`; writes it from a `Scene`.

Optional fields and their defaults follow the published reader. Unlike it, this reader reports and
ignores unknown fields. It knows the fields of the published example scenes only: no templates
(whose values would have to be halved), no textures, no environment.

A written file names one OBJ file per mesh, in world space and not normalized. An object of the file
has one material, so an object of a scene becomes one object for each of its materials. `CARRIED`
lists the members that the format holds. `DescribedFiles.lost` lists what of these a reader cannot
restore: objects of several materials; shading normals other than flat ones and those that readers
compute (smooth across edges of up to 30 degrees).
"""

import json
import re
from collections import Counter
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.description import (
    ColorGroups,
    DescribedCamera,
    DescribedMaterial,
    DescribedObject,
    DescribedTransform,
    SceneDescription,
)
from pipeline.exchange.from_description import SHELL_FOLDER, SMOOTH_ANGLE_DEG
from pipeline.exchange.json_fields import Fields
from pipeline.foreign.numbers import Malformed
from pipeline.scenes.posing import without_slivers
from pipeline.scenes.shading import face_normals, smooth_shaded
from storage.conventions import HALF_FLOAT_MAX
from storage.errors import TrilightError
from storage.records.material import DIFFUSE, EMISSION, PUBLISHED_COLUMNS, ROUGHNESS, SPECULAR
from storage.records.scene import ARRAY_FIELDS, Scene

MAX_BYTES = 4 << 20
"""Maximum size of a file; an object takes about 1 KiB."""

MAX_OBJECTS = 8192
"""Maximum number of objects in a file; a triangle with a separate color counts as an object."""

MAX_CAMERAS = 1000
"""Maximum number of cameras in a file."""

_VERSION = "1.0"
_MAX_LENGTH = 1e6
"""Maximum coordinate or factor; beyond it float32 positions are off by centimeters."""
_MAX_ANGLE_DEG = 1e6
_MAX_EMISSION = 1e9
_MAX_SEED = 2**32 - 1
_MAX_REMESH_FACES = 1_000_000
_COLOUR_GROUPS = ("per-triangle", "per-shading-group")


def read_description(data: bytes, name: str) -> SceneDescription:
    """Parse a scene file.

    Args:
        data: the bytes of the file.
        name: name of the file, for messages.

    Raises:
        TrilightError: the file exceeds MAX_BYTES or is not JSON; a JSON object repeats a name; or a
            field is missing, of the wrong type, not finite or out of range. The message names file,
            field (with the object's name), value and expected value.
    """
    if len(data) > MAX_BYTES:
        raise TrilightError(f"{name}: {len(data)} bytes; expected at most {MAX_BYTES}.")
    unknown: list[str] = []
    fields = Fields(_parse_json(data, name), file=name, where="", unknown=unknown)
    scene_name = fields.text("scene_name")
    version = fields.text("version")
    if version != _VERSION:
        raise TrilightError(f"{name}: version is {version!r}; expected {_VERSION!r}.")
    objects = fields.group("objects")
    cameras = fields.groups("cameras", MAX_CAMERAS)
    names = list(objects.keys())
    if not 1 <= len(names) <= MAX_OBJECTS:
        raise TrilightError(f"{name}: {len(names)} objects; expected 1 to {MAX_OBJECTS}.")
    described = tuple(_object(key, objects.group(key)) for key in names)
    described_cameras = tuple(_camera(camera) for camera in cameras)
    fields.end()
    return SceneDescription(
        file=name,
        scene_name=scene_name,
        objects=described,
        cameras=described_cameras,
        unknown_fields=tuple(unknown),
    )


def read_cameras(data: bytes, name: str) -> tuple[DescribedCamera, ...]:
    """Return the cameras of a scene file, or of a JSON file that has nothing but `cameras`.

    Raises:
        TrilightError: as `read_description`, for the cameras alone.
    """
    if len(data) > MAX_BYTES:
        raise TrilightError(f"{name}: {len(data)} bytes; expected at most {MAX_BYTES}.")
    fields = Fields(_parse_json(data, name), file=name, where="", unknown=[])
    return tuple(_camera(camera) for camera in fields.groups("cameras", MAX_CAMERAS))


def _parse_json(data: bytes, name: str) -> Any:
    try:
        return json.loads(
            data.decode("utf-8-sig"),
            object_pairs_hook=_refuse_repeats,
            parse_constant=_refuse_constant,
        )
    except RecursionError as error:
        raise TrilightError(f"{name}: nested too deeply for a scene; expected JSON.") from error
    except Malformed as error:
        raise TrilightError(f"{name}: not readable as JSON ({error}).") from error
    except json.JSONDecodeError as error:
        where = f"line {error.lineno}, column {error.colno}"
        raise TrilightError(f"{name}: not readable as JSON from {where} on.") from error
    except ValueError as error:
        raise TrilightError(f"{name}: not readable as JSON in UTF-8.") from error


def _refuse_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    members = dict(pairs)
    if len(members) < len(pairs):
        (repeated, _), *_ = Counter(key for key, _ in pairs).most_common(1)
        raise Malformed(f"the name {repeated!r:.60} stands twice in one object")
    return members


def _refuse_constant(text: str) -> float:
    raise Malformed(f"{text} is no JSON number")


def _object(name: str, fields: Fields) -> DescribedObject:
    described = DescribedObject(
        name=name,
        mesh_path=fields.text("mesh_path"),
        transform=_transform(fields.group("transform")),
        material=_material(fields.group("material")),
        remesh=fields.flag("remesh", default=False),
        remesh_target_face_num=fields.integer("remesh_target_face_num", 4, _MAX_REMESH_FACES, 2048),
    )
    fields.end()
    return described


def _transform(fields: Fields) -> DescribedTransform:
    transform = DescribedTransform(
        translation=fields.vector("translation", -_MAX_LENGTH, _MAX_LENGTH),
        rotation_deg=fields.vector("rotation", -_MAX_ANGLE_DEG, _MAX_ANGLE_DEG),
        scale=fields.vector("scale", -_MAX_LENGTH, _MAX_LENGTH),
        normalize=fields.flag("normalize", default=True),
    )
    fields.end()
    return transform


def _material(fields: Fields) -> DescribedMaterial:
    groups = fields.choice("random_diffuse_type", _COLOUR_GROUPS, "per-shading-group")
    material = DescribedMaterial(
        diffuse=fields.vector("diffuse", 0, 1),
        specular=fields.vector("specular", 0, 1),
        roughness=fields.number("roughness", 0, 1),
        emissive=fields.vector("emissive", 0, _MAX_EMISSION),
        smooth_shading=fields.flag("smooth_shading"),
        random_diffuse_max=fields.number("random_diffuse_max", 0, 1, default=1.0),
        random_diffuse_type=cast(ColorGroups, groups),
        rand_tri_diffuse_seed=fields.optional_integer("rand_tri_diffuse_seed", 0, _MAX_SEED),
    )
    fields.end()
    return material


def _camera(fields: Fields) -> DescribedCamera:
    camera = DescribedCamera(
        position=fields.vector("position", -_MAX_LENGTH, _MAX_LENGTH),
        look_at=fields.vector("look_at", -_MAX_LENGTH, _MAX_LENGTH),
        up=fields.vector("up", -_MAX_LENGTH, _MAX_LENGTH),
        fov_deg=fields.number("fov", 0.001, 179),
    )
    fields.end()
    return camera


CARRIED = frozenset(
    {*ARRAY_FIELDS, "objects.name", "objects.kind"} - {"materials"}
    | {f"materials.{name}" for name in PUBLISHED_COLUMNS}
)
"""Members of a scene that the file holds (pipeline.exchange.formats)."""

_FLAT = 1e-5
"""Largest difference between a flat face's float32 normal and its geometric normal."""
_CLOSE = 1e-2
"""Maximum difference between a normal and the one that a reader computes: 0.6 degrees."""
_NAME_LETTERS = 48
"""Maximum length of object names; the published converter uses them as file names (255 bytes)."""
_NO_FILE_LETTERS = '/\\:*?"<>|'
"""Characters that some operating system forbids in file names."""


@dataclass(frozen=True, kw_only=True)
class DescribedFiles:
    """The scene file and mesh files of one scene."""

    json: bytes  # the scene file
    meshes: dict[str, bytes]  # OBJ files by path relative to the scene file
    lost: tuple[str, ...]  # sentences about members in CARRIED that readers cannot restore


def describe_scene(scene: Scene, stem: str) -> DescribedFiles:
    """Return a scene as the files that the published tools read.

    Args:
        scene: passes `Scene.check`.
        stem: stem of the scene file and name of its mesh folders.

    Raises:
        TrilightError: more objects or cameras than a file may have, a number out of range, or no
            emitter with an area.
    """
    scene.check()
    lost: list[str] = []
    meshes: dict[str, bytes] = {}
    objects: dict[str, Any] = {}
    taken: set[str] = set()
    for row, material, faces in _group_triangles(scene):
        if len(without_slivers(scene.vertex_positions, scene.faces[faces])) == 0:
            continue  # readers refuse a mesh without an area
        name = _unique(_name(scene, row, material), taken)
        normals = scene.vertex_normals[scene.faces[faces]]
        path = _mesh_path(scene, row, material, stem)
        meshes[path] = _obj(scene, faces)
        smooth = _is_smooth(scene, faces, normals)
        objects[name] = _object_entry(path, scene.materials[material], smooth)
        if smooth and not _is_reproduced(scene, faces, normals):
            lost.append(f"{name}: shading normals, which readers compute again")
    if not any(max(entry["material"]["emissive"]) > 0 for entry in objects.values()):
        raise TrilightError("scene: no emitter has an area; a scene file needs at least one.")
    data = json.dumps(
        {
            "scene_name": _printable(stem),
            "version": "1.0",
            "objects": objects,
            "cameras": list(map(camera_entry, scene.c2w, scene.fov_deg)),
        }
    ).encode()
    _require_size(scene, data, len(objects))
    read_description(data, f"{stem}.json")  # raises for anything that readers would refuse
    return DescribedFiles(json=data, meshes=meshes, lost=(*_losses(scene), *lost))


def _group_triangles(scene: Scene) -> list[tuple[int, int, NDArray[np.intp]]]:
    """Return (object, material, triangles), sorted by object and then by material."""
    keys = scene.object_index.astype(np.int64) * len(scene.materials) + scene.material_index
    order = np.argsort(keys, kind="stable")
    distinct, starts = np.unique(keys[order], return_index=True)
    return [
        (*divmod(int(key), len(scene.materials)), faces)
        for key, faces in zip(distinct, np.split(order, starts[1:]), strict=True)
    ]


def _name(scene: Scene, row: int, material: int) -> str:
    materials = scene.material_index[scene.object_index == row]
    name = _printable(scene.objects[row].name).lstrip(".") or f"object{row}"
    return name if (materials == material).all() else f"{name}.material{material}"


def _printable(text: str) -> str:
    legal = (c if c.isprintable() and c not in _NO_FILE_LETTERS else "_" for c in text)
    return "".join(legal)[:_NAME_LETTERS]


def _unique(name: str, taken: set[str]) -> str:
    """Return an unused name, ignoring case, since it becomes the name of a file."""
    candidate = name
    count = 1
    while candidate.casefold() in taken:
        count += 1
        candidate = f"{name}.{count}"
    taken.add(candidate.casefold())
    return candidate


def _mesh_path(scene: Scene, row: int, material: int, stem: str) -> str:
    plain = re.sub(r"[^0-9A-Za-z_\-]", "_", scene.objects[row].name)[:40]
    folder = SHELL_FOLDER if scene.objects[row].kind == "shell" else "objects/"
    safe_stem = re.sub(r"[^0-9A-Za-z_.\-]", "_", stem)[:60].strip(".") or "scene"
    return f"{folder}{safe_stem}/{row}_{plain}_{material}.obj"


def _obj(scene: Scene, faces: NDArray[np.intp]) -> bytes:
    """Return triangles as an OBJ file whose numbers round-trip to the same float32."""
    rows, corners = np.unique(scene.faces[faces], return_inverse=True)
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in scene.vertex_positions[rows].tolist()]
    lines += [f"vn {x:.9g} {y:.9g} {z:.9g}" for x, y, z in scene.vertex_normals[rows].tolist()]
    triangles = corners.reshape(-1, 3) + 1
    lines += [f"f {a}//{a} {b}//{b} {c}//{c}" for a, b, c in triangles.tolist()]
    return ("\n".join(lines) + "\n").encode()


def _object_entry(path: str, values: NDArray[np.float32], smooth: bool) -> dict[str, Any]:
    return {
        "mesh_path": path,
        "transform": {
            "translation": [0.0, 0.0, 0.0],
            "rotation": [0.0, 0.0, 0.0],
            "scale": [1.0, 1.0, 1.0],
            "normalize": False,
        },
        "material": {
            "diffuse": values[DIFFUSE].tolist(),
            "specular": values[SPECULAR].tolist(),
            "roughness": float(values[ROUGHNESS]),
            "emissive": values[EMISSION].tolist(),
            "smooth_shading": smooth,
            "rand_tri_diffuse_seed": None,
        },
    }


def camera_entry(c2w: NDArray[np.float32], fov_deg: float) -> dict[str, Any]:
    """Return the entry of `cameras` for a pose [4, 4] and a full angle in degrees."""
    pose = c2w.astype(np.float64)
    return {
        "position": pose[:3, 3].tolist(),
        "look_at": (pose[:3, 3] - pose[:3, 2]).tolist(),
        "up": pose[:3, 1].tolist(),
        "fov": float(fov_deg),
    }


def _is_smooth(scene: Scene, faces: NDArray[np.intp], normals: NDArray[np.float32]) -> bool:
    with np.errstate(invalid="ignore", divide="ignore"):
        flat = face_normals(scene.vertex_positions, scene.faces[faces])
    off = np.abs(normals - flat[:, None])
    return bool((off[np.isfinite(off)] > _FLAT).any())


def _is_reproduced(scene: Scene, faces: NDArray[np.intp], normals: NDArray[np.float32]) -> bool:
    """Return whether the smoothing of a reader computes the same normals."""
    rows, corners = np.unique(scene.faces[faces], return_inverse=True)
    positions = scene.vertex_positions[rows]
    triangles = corners.reshape(-1, 3).astype(np.uint32)
    if len(without_slivers(positions, triangles)) < len(triangles):
        return False
    made = smooth_shaded(positions, triangles, SMOOTH_ANGLE_DEG)
    return bool((np.abs(made.normals[made.faces] - normals) <= _CLOSE).all())


def _losses(scene: Scene) -> list[str]:
    losses: list[str] = []
    parts = np.bincount([row for row, _, _ in _group_triangles(scene)])
    num_objects = int((parts > 1).sum())
    num_parts = int(parts[parts > 1].sum())
    if num_objects:
        losses.append(
            f"the grouping of {num_parts} objects that were {num_objects}, of several materials"
        )
    solid = len(without_slivers(scene.vertex_positions, scene.faces))
    if solid < scene.num_triangles:
        losses.append(
            f"{scene.num_triangles - solid} triangles without an area, which readers drop"
        )
    if (scene.materials[:, EMISSION] > HALF_FLOAT_MAX).any():
        losses.append(f"emission over {HALF_FLOAT_MAX:.0f}, which the published converter cuts off")
    return losses


def _require_size(scene: Scene, data: bytes, objects: int) -> None:
    for what, count, most in (
        ("objects of one material", objects, MAX_OBJECTS),
        ("cameras", scene.num_views, MAX_CAMERAS),
        ("bytes", len(data), MAX_BYTES),
    ):
        if count > most:
            raise TrilightError(f"scene: {count} {what}; a scene file holds at most {most}.")
