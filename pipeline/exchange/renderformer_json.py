"""Reads RenderFormer's scene JSON (version 1.0): text to a checked `SceneDescription`.

Which fields may be missing, and what then holds, follows the published reader. Unlike it, fields
that mean nothing to us are named and left out. Only the fields of the published example scenes are
known: no templates, whose values would have to be halved, no textures, no environment.
"""

import json
from collections import Counter
from typing import Any, cast

from pipeline.exchange.description import (
    ColourGroups,
    DescribedCamera,
    DescribedMaterial,
    DescribedObject,
    DescribedTransform,
    SceneDescription,
)
from pipeline.exchange.json_fields import Fields
from storage.errors import TrilightError

MAX_BYTES = 4 << 20
"""Largest accepted file; an object takes about 1 KiB."""

MAX_OBJECTS = 8192
"""Of one file: where every triangle has a colour of its own, each is an object there."""

MAX_CAMERAS = 1000
"""Of one file."""

_VERSION = "1.0"
_MAX_LENGTH = 1e6
"""Greatest coordinate or factor: beyond it float32 positions are off by centimetres."""
_MAX_ANGLE_DEG = 1e6
_MAX_EMISSION = 1e9
_MAX_SEED = 2**32 - 1
_MAX_REMESH_FACES = 1_000_000
_COLOUR_GROUPS = ("per-triangle", "per-shading-group")


def read_description(data: bytes, name: str) -> SceneDescription:
    """Return what a scene file describes.

    Args:
        data: the bytes of the file.
        name: of the file, for messages.

    Raises:
        TrilightError: larger than MAX_BYTES, not JSON, a name twice in one JSON object, or a field
            that is missing, of the wrong type, not finite or out of range; the message names file,
            field (with the object's name), value got and value expected.
    """
    if len(data) > MAX_BYTES:
        raise TrilightError(f"{name}: {len(data)} bytes; expected at most {MAX_BYTES}.")
    unknown: list[str] = []
    fields = Fields(_parsed(data, name), file=name, where="", unknown=unknown)
    scene_name, version = fields.text("scene_name"), fields.text("version")
    if version != _VERSION:
        raise TrilightError(f"{name}: version is {version!r}; expected {_VERSION!r}.")
    objects, cameras = fields.group("objects"), fields.groups("cameras", MAX_CAMERAS)
    names = list(objects.keys())
    if not 1 <= len(names) <= MAX_OBJECTS:
        raise TrilightError(f"{name}: {len(names)} objects; expected 1 to {MAX_OBJECTS}.")
    described = tuple(_object(key, objects.group(key)) for key in names)
    seen = tuple(_camera(camera) for camera in cameras)
    fields.end()
    return SceneDescription(
        file=name,
        scene_name=scene_name,
        objects=described,
        cameras=seen,
        unknown_fields=tuple(unknown),
    )


def read_cameras(data: bytes, name: str) -> tuple[DescribedCamera, ...]:
    """Return the cameras of a scene file, or of a JSON file that has nothing but `cameras`.

    Raises:
        TrilightError: as `read_description`, for what of it is read.
    """
    if len(data) > MAX_BYTES:
        raise TrilightError(f"{name}: {len(data)} bytes; expected at most {MAX_BYTES}.")
    fields = Fields(_parsed(data, name), file=name, where="", unknown=[])
    return tuple(_camera(camera) for camera in fields.groups("cameras", MAX_CAMERAS))


def _parsed(data: bytes, name: str) -> Any:
    try:
        return json.loads(
            data.decode("utf-8-sig"),
            object_pairs_hook=_without_repeats,
            parse_constant=_refused_constant,
        )
    except RecursionError as error:
        raise TrilightError(f"{name}: nested too deeply for a scene; expected JSON.") from error
    except ValueError as error:
        raise TrilightError(f"{name}: not readable as JSON ({error}).") from error


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        (repeated, _), *_ = Counter(key for key, _ in pairs).most_common(1)
        raise ValueError(f"the name {repeated!r:.60} stands twice in one object")
    return found


def _refused_constant(text: str) -> float:
    raise ValueError(f"{text} is no JSON number")


def _object(name: str, fields: Fields) -> DescribedObject:
    described = DescribedObject(
        name=name,
        mesh_path=fields.text("mesh_path"),
        transform=_transform(fields.group("transform")),
        material=_material(fields.group("material")),
        remesh=fields.flag("remesh", default=False),
        remesh_target_face_num=fields.whole("remesh_target_face_num", 4, _MAX_REMESH_FACES, 2048),
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
        random_diffuse_type=cast(ColourGroups, groups),
        rand_tri_diffuse_seed=fields.optional_whole("rand_tri_diffuse_seed", 0, _MAX_SEED),
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
