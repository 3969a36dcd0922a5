"""Reads RenderFormer's scene JSON (version 1.0) as a `SceneDescription`; writes it from a `Scene`.

Optional fields and their defaults follow the published reader. Unlike it, this reader reports and
ignores unknown fields. It knows the fields of the published example scenes only: no templates
(whose values would have to be halved), no textures, no environment.

A written file names one OBJ file per mesh, in world space and not normalized. An object of the file
has one material, so an object of a scene becomes one object for each of its materials. Of what the
format holds (pipeline.exchange.formats), the writer lists what a reader cannot restore:
objects of several materials; shading normals other than flat ones and those that readers compute
(smooth across edges of up to 30 degrees).
"""

import dataclasses
import json
import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.from_description import (
    SHELL_FOLDER,
    CameraFile,
    DescribedCamera,
    DescribedObject,
    SceneDescription,
    shade,
)
from pipeline.exchange.textured_triangles import (
    group_triangles,
    is_smooth,
    mesh_of_triangles,
    require_at_most,
    unique_name,
)
from pipeline.foreign.numbers import Malformed
from pipeline.scenes.shading_normals import ShadedMesh, has_area
from storage.atomic import write_atomically
from storage.conventions import HALF_FLOAT_MAX
from storage.errors import TrilightError
from storage.records.material import DIFFUSE, EMISSION, ROUGHNESS, SPECULAR
from storage.records.scene import Scene
from storage.settings.fields import describe_fields, group_of
from storage.typed_json import read_json

Record = TypeVar("Record", bound=CameraFile)

MAX_BYTES = 4 << 20
"""Maximum size of a file; an object takes about 1 KiB."""

MAX_OBJECTS = 8192
"""Maximum number of objects in a file; a triangle with a separate color counts as an object."""

MAX_CAMERAS = 1000
"""Maximum number of cameras in a file."""

_OURS = ("name", "file", "unknown_fields")
"""Fields of records that no object of a file has."""

_MAX_SHOWN = 120
"""Maximum number of characters of a value in a message."""


def read_renderformer_json(data: bytes, name: str) -> SceneDescription:
    """Parse the bytes of a scene file; as `read_record`."""
    return read_record(SceneDescription, data, name)


def read_record(kind: type[Record], data: bytes, name: str) -> Record:
    """Parse the bytes of a scene file, or of another file with `cameras`; messages call it `name`.

    The record names the fields that no record has, so that a misspelt option is reported.

    Raises:
        TrilightError: the file exceeds MAX_BYTES or is not JSON; a JSON object repeats a name; or a
            field is missing, of the wrong type, not finite or out of range. The message names file,
            field (with the object's name), value and expected value.
    """
    if len(data) > MAX_BYTES:
        raise TrilightError(f"{name}: {len(data)} bytes; expected at most {MAX_BYTES}.")
    try:
        tree = json.loads(
            data.decode("utf-8-sig"),
            object_pairs_hook=_refuse_repeats,
            parse_constant=_refuse_constant,
        )
        unknown: list[str] = []
        known = _take_known(kind, tree, "", unknown)
        text = json.dumps(known)
    except RecursionError as error:
        raise TrilightError(f"{name}: nested too deeply; expected a scene.") from error
    except Malformed as error:
        raise TrilightError(f"{name}: not readable as JSON ({error}).") from error
    except json.JSONDecodeError as error:
        where = f"line {error.lineno}, column {error.colno}"
        raise TrilightError(f"{name}: not readable as JSON from {where} on.") from error
    except ValueError as error:
        raise TrilightError(f"{name}: not readable as JSON in UTF-8.") from error
    if not isinstance(known, dict):
        raise TrilightError(f"{name}: the file is {_to_text(known)}; expected a JSON object.")
    for what, most in (("objects", MAX_OBJECTS), ("cameras", MAX_CAMERAS)):
        entries = known.get(what)
        if isinstance(entries, list | dict) and not 1 <= len(entries) <= most:
            raise TrilightError(f"{name}: {len(entries)} {what}; expected 1 to {most}.")
        for key in entries if isinstance(entries, dict) else ():
            if not (1 <= len(key) <= 200 and key.isprintable()):
                raise TrilightError(
                    f"{name}: {_to_text(f'{what}.{key}')} is {_to_text(key)}; expected a printable "
                    "name of 1 to 200 letters."
                )
    record = read_json(text, kind, name)
    # A name that is not UTF-8 has no place in JSON.
    return dataclasses.replace(record, file=name, unknown_fields=tuple(unknown))


def _take_known(kind: Any, value: Any, where: str, unknown: list[str]) -> Any:
    """Return the known fields of a record and of those in it; the name of an object is its key."""
    if isinstance(value, list) and kind == tuple[DescribedCamera, ...]:
        return [
            _take_known(DescribedCamera, entry, f"{where}[{at}]", unknown)
            for at, entry in enumerate(value)
        ]
    if isinstance(value, dict) and kind == Mapping[str, DescribedObject]:
        entries = {}
        for key, entry in value.items():
            known = _take_known(DescribedObject, entry, f"{where}.{key}", unknown)
            entries[key] = {**known, "name": key} if isinstance(known, dict) else known
        return entries
    if not group_of(kind) or not isinstance(value, dict):
        return value
    hints = {each.name: each.hint for each in describe_fields(kind) if each.name not in _OURS}
    paths = {key: f"{where}.{key}" if where else key for key in value}
    unknown += [_to_text(paths[key]) for key in value if key not in hints]
    return {
        key: _take_known(hints[key], inner, paths[key], unknown)
        for key, inner in value.items()
        if key in hints
    }


def _to_text(value: Any) -> str:
    """Return a value as short text for a message, on one line without control characters."""
    text = value if isinstance(value, str) and value.isprintable() else repr(value)
    return text if len(text) <= _MAX_SHOWN else f"{text[: _MAX_SHOWN - 3]}..."


def _refuse_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    members = dict(pairs)
    if len(members) < len(pairs):
        (repeated, _), *_ = Counter(key for key, _ in pairs).most_common(1)
        raise Malformed(f"the name {repeated!r:.60} stands twice in one object")
    return members


def _refuse_constant(text: str) -> float:
    raise Malformed(f"{text} is no JSON number")


_FLAT = 1e-5
"""Largest difference between a flat face's float32 normal and its geometric normal."""
_CLOSE = 1e-2
"""Maximum difference between a normal and the one that a reader computes: 0.6 degrees."""
_NAME_LETTERS = 48
"""Maximum length of object names; the published converter uses them as file names (255 bytes)."""
_NO_FILE_LETTERS = '/\\:*?"<>|'
"""Characters that some operating system forbids in file names."""


def write_renderformer_json(path: Path, scene: Scene) -> tuple[str, ...]:
    """Write a scene as the files that the published tools read: the scene file and its meshes.

    The stem of the scene file is the name of the folders of meshes next to it.

    Returns:
        Sentences about members in the file that readers cannot restore.

    Raises:
        TrilightError: the scene breaks a law (`Scene.check`); more objects or cameras than a file
            may have, a number out of range, or no emitter with an area; or a file cannot be
            written.
    """
    scene.check()
    lost: list[str] = []
    meshes: dict[str, bytes] = {}
    objects: dict[str, Any] = {}
    taken: dict[str, int] = {}
    for row, material, triangles in group_triangles(scene):
        mesh = mesh_of_triangles(scene, triangles)
        if not has_area(mesh.positions, mesh.faces).any():
            continue  # readers refuse a mesh without an area
        # it becomes the name of a file, whose case some systems ignore
        name = unique_name(_name(scene, row, material), taken, str.casefold)
        mesh_path = _mesh_path(scene, row, material, path.stem)
        meshes[mesh_path] = _encode_obj(mesh)
        smooth = is_smooth(mesh, _FLAT)
        objects[name] = _object_entry(mesh_path, scene.materials[material], smooth)
        if smooth and not _is_reproduced(mesh):
            lost.append(f"{name}: shading normals, which readers compute again")
    if not any(max(entry["material"]["emissive"]) > 0 for entry in objects.values()):
        raise TrilightError("scene: no emitter has an area; a scene file needs at least one.")
    data = json.dumps(
        {
            "scene_name": _printable(path.stem),
            "version": "1.0",
            "objects": objects,
            "cameras": list(map(camera_entry, scene.c2w, scene.fov_deg)),
        }
    ).encode()
    require_at_most({"objects of one material": (len(objects), MAX_OBJECTS)})
    read_renderformer_json(data, path.name)  # raises for anything that readers would refuse
    for mesh_path, obj in meshes.items():
        write_atomically(path.parent / mesh_path, obj)
    write_atomically(path, data)  # last, so that the files that it names exist
    return (*_losses(scene), *lost)


def _name(scene: Scene, row: int, material: int) -> str:
    materials = scene.material_index[scene.object_index == row]
    name = _printable(scene.objects[row].name).lstrip(".") or f"object{row}"
    return name if (materials == material).all() else f"{name}.material{material}"


def _printable(text: str) -> str:
    legal = (c if c.isprintable() and c not in _NO_FILE_LETTERS else "_" for c in text)
    return "".join(legal)[:_NAME_LETTERS]


def _mesh_path(scene: Scene, row: int, material: int, stem: str) -> str:
    plain = re.sub(r"[^0-9A-Za-z_\-]", "_", scene.objects[row].name)[:40]
    folder = SHELL_FOLDER if scene.objects[row].kind == "shell" else "objects/"
    safe_stem = re.sub(r"[^0-9A-Za-z_.\-]", "_", stem)[:60].strip(".") or "scene"
    return f"{folder}{safe_stem}/{row}_{plain}_{material}.obj"


def _encode_obj(mesh: ShadedMesh) -> bytes:
    """Return a mesh as an OBJ file whose numbers round-trip to the same float32."""
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.positions.tolist()]
    lines += [f"vn {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.normals.tolist()]
    triangles = mesh.faces.astype(np.int64) + 1
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


def _is_reproduced(mesh: ShadedMesh) -> bool:
    """Return whether the smoothing of a reader computes the same normals."""
    if not has_area(mesh.positions, mesh.faces).all():
        return False
    made = shade(mesh.positions, mesh.faces, is_smooth=True)
    return bool((np.abs(made.normals[made.faces] - mesh.normals[mesh.faces]) <= _CLOSE).all())


def _losses(scene: Scene) -> list[str]:
    losses: list[str] = []
    parts = np.bincount([row for row, _, _ in group_triangles(scene)])
    num_objects = int((parts > 1).sum())
    num_parts = int(parts[parts > 1].sum())
    if num_objects:
        losses.append(
            f"the grouping of {num_parts} objects that were {num_objects}, of several materials"
        )
    solid = int(has_area(scene.vertex_positions, scene.faces).sum())
    if solid < scene.num_triangles:
        losses.append(
            f"{scene.num_triangles - solid} triangles without an area, which readers drop"
        )
    if (scene.materials[:, EMISSION] > HALF_FLOAT_MAX).any():
        losses.append(f"emission over {HALF_FLOAT_MAX:.0f}, which the published converter cuts off")
    return losses
