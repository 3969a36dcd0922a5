"""Nothing is stored that nobody reads: whatever a sample holds changes what a consumer makes of it.

Consumers are the training, the report's numbers, the page of a scene, and who asks for passes.
Conversions copy a scene whole and therefore do not count.
"""

import dataclasses
import gzip
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from safetensors.numpy import load, save

from pipeline.documents.scene_page import encode_scene_page
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.records.exr import decode_exr, encode_channels, encode_exr
from storage.records.lights import decode_parts_exr, encode_parts_exr
from storage.records.packed_maps import MAP_NAME
from storage.records.passes import passes_exr
from storage.records.sample import PictureErrors, Sample, decode_sample, decode_scene, encode_sample
from storage.records.scene_facts import scene_values
from storage.records.texture import MapSource
from tests.scenes_by_hand import tiny_sample
from tests.textured_by_hand import bumpy_scene, sky
from train.data.scenes import TrainingScene, training_scene

Members = dict[str, bytes]
Change = Callable[[Members], None]

ARRAYS, RECORD = "scene.safetensors", "json"
_PIXELS = 16
_PARTS = ("direct", "indirect")


def _sample() -> Sample:
    """Return a sample in which every kind of member exists, and every name and right is stated.

    It is textured, below a sky, with its lights, their parts and a pass apart.
    """
    rights = MapSource(name="n", licence="CC-BY-4.0", attribution="a", source_url="https://x.org")
    scene = bumpy_scene(environment=sky(source=rights))
    textures = tuple(dataclasses.replace(texture, source=rights) for texture in scene.textures)
    scene = dataclasses.replace(scene, textures=textures)
    sample = tiny_sample(resolution=_PIXELS)
    packed = [passes_exr(scene, ["object"], view=view, resolution=_PIXELS) for view in range(2)]
    black = np.zeros_like(sample.radiance_rgb)
    lights = np.stack([sample.radiance_rgb, black], axis=1)  # the sky is one more
    floor = PictureErrors(
        noise_floor_db=40.0, noise_floor_linear_db=30.0, object_noise_floor_db=39.0
    )
    views = [dataclasses.replace(view, parts=dict.fromkeys(_PARTS, floor)) for view in sample.views]
    return dataclasses.replace(
        sample,
        scene=scene,
        lights_rgb=lights,
        parts_rgb=dict(zip(_PARTS, (lights, np.zeros_like(lights)), strict=True)),
        passes_exr=tuple(packed),
        views=tuple(views),
    )


MEMBERS = encode_sample(_sample())


def _consumed(members: Members) -> str:
    """Return a digest of all that consumers make of a sample, or what they refuse it with."""
    try:
        sample = decode_sample("000000000", members)
        # networks refuse light of an environment
        lit = dataclasses.replace(sample.scene, environment=None)
        learned = dataclasses.replace(sample, scene=lit)
        scene = training_scene(learned, _PIXELS, lights_apart=True)
        values = {
            name: array.tolist()
            for name, array in scene_values(decode_scene(sample.key, members)).items()
        }
    except TrilightError as error:
        return str(error)
    links = {"report": "", "before": None, "after": None}
    page = encode_scene_page(sample, "train", [], links)
    names = ["object", "uv", "material_diffuse"]
    seen = [sample.view_passes(names, view=view) for view in range(2)]
    passes = [each[name].tobytes() for each in seen for name in names]
    return sha256_hex(b"".join([*_tensors(scene), *passes, json.dumps(values).encode(), page]))


def _tensors(scene: TrainingScene) -> Iterator[bytes]:
    for part in (scene, scene.tensors):
        for field in dataclasses.fields(part):
            value = getattr(part, field.name)
            if hasattr(value, "numpy"):
                yield value.numpy().tobytes()


def _leaves(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path of every number and word of a record; of lists, the first entry stands."""
    if isinstance(value, Mapping):
        for name, entry in value.items():
            yield from _leaves(entry, (*path, name))
    elif isinstance(value, list):
        yield from _leaves(value[0], (*path, 0))
    else:
        yield path


def _other(value: Any) -> Any:
    """Return another value of the same kind; of the words with a meaning, another one."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, str):
        return {"shell": "object", "emitter": "object"}.get(value, f"{value}x")
    return value + 1


def _change_record(path: tuple[Any, ...], members: Members) -> None:
    record = json.loads(members[RECORD])
    place = record
    for step in path[:-1]:
        place = place[step]
    place[path[-1]] = _other(place[path[-1]])
    members[RECORD] = json.dumps(record).encode()


def _other_map(name: str, members: Members) -> None:
    """Put a map of the same form and other content in the place of one."""
    data = bytearray(gzip.decompress(members[name]))
    data[-1] ^= 1
    members[name] = gzip.compress(data)


def _change_array(name: str, members: Members) -> None:
    arrays = dict(load(members[ARRAYS]))
    changed = arrays[name].copy()
    # the middle, since the last row of a camera's pose is constant; by little, so that an
    # index still points somewhere
    place = tuple(size // 2 for size in changed.shape)
    if name.endswith("_textures"):  # of the floor: lamps are hidden, and their look with them
        place = (0,) * changed.ndim
    changed[place] = changed[place] - 1 if changed[place] else 1
    members[ARRAYS] = save({**arrays, name: changed})


def _brighter_picture(members: Members) -> None:
    members["1.exr"] = encode_exr(decode_exr(members["1.exr"]) * np.float32(2))


def _brighter_parts(what: str, names: Sequence[str], members: Members) -> None:
    parts = decode_parts_exr(members[f"1.{what}.exr"], names, (_PIXELS, _PIXELS), 2)
    brighter = {name: 2 * part for name, part in parts.items()}
    members[f"1.{what}.exr"] = encode_parts_exr(brighter)


def _other_objects(members: Members) -> None:
    members["1.passes.exr"] = encode_channels(
        {name: np.ones((_PIXELS, _PIXELS), np.float32) for name in ("A", "object.V")}
    )


def _changes() -> dict[str, Change]:
    changes: dict[str, Change] = {
        f"{RECORD} {'.'.join(map(str, path))}": partial(_change_record, path)
        for path in _leaves(json.loads(MEMBERS[RECORD]))
    }
    for name in sorted(load(MEMBERS[ARRAYS])):
        changes[f"{ARRAYS} {name}"] = partial(_change_array, name)
    changes |= {name: partial(_other_map, name) for name in filter(MAP_NAME.fullmatch, MEMBERS)}
    return changes | {
        "1.exr": _brighter_picture,
        "1.lights.exr": partial(_brighter_parts, "lights", ("",)),
        "1.parts.exr": partial(_brighter_parts, "parts", _PARTS),
        "1.passes.exr": _other_objects,
    }


CHANGES = _changes()


def test_a_consumer_reads_every_member() -> None:
    before = _consumed(dict(MEMBERS))
    assert len(before) == 64, "a digest, and no refusal"
    for stored, change in CHANGES.items():
        changed = dict(MEMBERS)
        change(changed)
        assert _consumed(changed) != before, stored


def test_every_member_is_changed_above() -> None:
    """Members that come with more views are of the same kinds."""
    of_the_second_view = {suffix.replace("0.", "1.", 1) for suffix in MEMBERS}
    assert of_the_second_view == {stored.partition(" ")[0] for stored in CHANGES}
    assert len(list(filter(MAP_NAME.fullmatch, CHANGES))) == 4


def test_what_nobody_reads_would_be_found() -> None:
    members = dict(MEMBERS)
    before = _consumed(members)
    members["extra.json"] = b"{}"
    assert _consumed(members) == before
