"""RenderFormer scene files of somebody who means harm."""

import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from pipeline.exchange.renderformer_json import describe_scene
from tests.scenes_by_hand import tiny_scene

Make = Callable[[Path], object]
LEAK_OBJ = "v 777 0 0\nv 778 0 0\nv 777 1 0\nf 1 2 3\n"


def _base(folder: Path) -> dict[str, Any]:
    files = describe_scene(tiny_scene(), "s")
    for path, data in files.meshes.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(data)
    return dict(json.loads(files.json))


def _changed(*where: Any, value: Any) -> Make:
    """Return what writes the scene with one field changed; ANY is the first name of a group."""

    def make(folder: Path) -> None:
        scene = _base(folder)
        at: Any = scene
        for key in where[:-1]:
            at = at[next(iter(at)) if key == "ANY" else key]
        at[where[-1]] = value
        (folder / "s.json").write_text(json.dumps(scene).replace('"BIG"', "1e400"))

    return make


def _raw(data: bytes) -> Make:
    return lambda folder: (folder / "s.json").write_bytes(data)


def _sparse(path: Path) -> None:
    path.touch()
    os.truncate(path, 8 << 40)


def _mesh(spoil: Callable[[Path], object]) -> Make:
    def make(folder: Path) -> None:
        spoil(folder / "odd.obj")
        _changed("objects", "ANY", "mesh_path", value="odd.obj")(folder)

    return make


def cases() -> Iterator[tuple[str, Make, str]]:
    """Yield name, what writes `s.json`, and what has to come of it."""
    mesh = ("objects", "ANY", "mesh_path")
    values: tuple[Any, ...] = (
        "../outside/secret.obj", "/etc/passwd", "linked/secret.obj", "link.obj", "", ".", "..",
        "objects", "no.obj", "x\0y", "a" * 5000, "https://x.y/z.obj", "file:///etc/passwd",
        "~/x.obj", "s.json", "objects/../../outside/secret.obj", 3, None, [], {},
    )  # fmt: skip
    for value in values:
        yield f"mesh {str(value)[:30]!r}", _changed(*mesh, value=value), "refused"
    kinds: dict[str, Callable[[Path], object]] = {
        "fifo": os.mkfifo,
        "device": lambda path: path.symlink_to("/dev/zero"),
        "folder": lambda path: path.mkdir(),
        "empty": lambda path: path.touch(),
        "noise": lambda path: path.write_bytes(bytes(range(256)) * 99),
        "NaN": lambda path: path.write_text("v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
        "beyond": lambda path: path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99\n"),
        "8 TB": _sparse,
    }
    for kind, spoil in kinds.items():
        yield f"mesh is {kind}", _mesh(spoil), "refused"
    transform = ("objects", "ANY", "transform")
    for field in ("translation", "rotation", "scale"):
        for value in ([1e30] * 3, ["BIG"] * 3, [1, 2], "x", None, [[1, 2, 3]] * 3, [True] * 3):
            shown = str(value)[:20]
            yield f"{field} {shown}", _changed(*transform, field, value=value), "refused"
    material = ("objects", "ANY", "material")
    for field, values in {
        "diffuse": (2, -1), "specular": (2, -1), "emissive": (1e10, -1),
    }.items():  # fmt: skip
        for number in values:
            yield f"{field} {number}", _changed(*material, field, value=[number] * 3), "refused"
    yield "diffuse and specular", _changed(*material, "specular", value=[0.9] * 3), "any"
    yield "emission 1e9", _changed(*material, "emissive", value=[1e9] * 3), "any"
    for fov in (0, 180, -1, 1e30, "x", None):
        yield f"angle {fov}", _changed("cameras", 0, "fov", value=fov), "refused"
    same = _changed("cameras", 0, "position", value=[0, 0, 0])
    yield "a camera that looks at itself", same, "any"
    yield "no cameras", _changed("cameras", value=[]), "any"
    yield "100000 cameras", _changed("cameras", value=[{}] * 100_000), "refused"
    yield "no objects", _changed("objects", value={}), "refused"
    yield (
        "100000 objects",
        _changed("objects", value={str(i): 0 for i in range(100_000)}),
        "refused",
    )
    yield "another version", _changed("version", value="9"), "refused"
    yield "a field that is not known", _changed("script", value="rm -rf"), "read"
    remesh = _changed("objects", "ANY", "remesh_target_face_num", value=10**9)
    yield "remeshed to 10^9 faces", remesh, "refused"
    for kind, data in {
        "empty": b"", "a list": b"[]", "a number": b"1", "noise": bytes(range(256)),
        "deep": b"[" * 10**6, "deep objects": b'{"a":' * 10**5, "cut": b'{"scene_name": "x"',
        "a name twice": b'{"version": "1.0", "version": "1.0"}', "digits": b"9" * 10**6,
        "half a letter": b'{"scene_name": "\xc3"}', "UTF-16": '{"a": 1}'.encode("utf-16"),
    }.items():  # fmt: skip
        yield f"JSON is {kind}", _raw(data), "refused"
    yield "JSON is a fifo", lambda folder: os.mkfifo(folder / "s.json"), "refused"
    yield "JSON is endless", lambda f: (f / "s.json").symlink_to("/dev/zero"), "refused"
    yield "JSON of 8 TB", lambda folder: _sparse(folder / "s.json"), "refused"
