"""glTF trees that would load wrongly or reach outside are refused, each by its own name."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pipeline.assets.settings import AssetSettings
from tests.assets.meshes_by_hand import gltf_tree, reason_of, sphere, write_glb

BALL = sphere(rings=5, columns=8)


def _broken_tree(change: Callable[[dict[str, Any]], None]) -> tuple[dict[str, Any], bytes]:
    tree, buffer = gltf_tree(BALL)
    change(tree)
    return tree, buffer


TREES: dict[str, tuple[str, Callable[[dict[str, Any]], None]]] = {
    "own child": ("scene_cycle", lambda t: t["nodes"][0].update(children=[0])),
    "cycle": (
        "scene_cycle",
        lambda t: t.update(nodes=[{"mesh": 0, "children": [1]}, {"children": [0]}]),
    ),
    "two parents": (
        "scene_cycle",
        lambda t: t.update(nodes=[{"children": [i + 1, i + 1]} for i in range(24)] + [{"mesh": 0}]),
    ),
    "instances": (
        "too_many_instances",
        lambda t: t.update(nodes=[{"children": list(range(1, 20_001))}] + [{"mesh": 0}] * 20_000),
    ),
    "draco": (
        "unsupported_extension",
        lambda t: t.update(extensionsRequired=["KHR_draco_mesh_compression"]),
    ),
    "no buffer view": ("unsupported_accessor", lambda t: t["accessors"][0].pop("bufferView")),
    "sparse": ("unsupported_accessor", lambda t: t["accessors"][0].update(sparse={"count": 1})),
    "quantised": ("unsupported_accessor", lambda t: t["accessors"][0].update(componentType=5122)),
    "fan": ("unsupported_primitive", lambda t: t["meshes"][0]["primitives"][0].update(mode=6)),
    "lines": ("no_faces", lambda t: t["meshes"][0]["primitives"][0].update(mode=1)),
    "accessor bomb": ("too_many_faces", lambda t: t["accessors"][1].update(count=2**40)),
    "accessor too long": ("load_error", lambda t: t["accessors"][1].update(count=3000)),
    "indices": ("index_range", lambda t: t["accessors"][0].update(count=20)),
    "no such node": ("load_error", lambda t: t["scenes"][0].update(nodes=[5])),
    "no such mesh": ("load_error", lambda t: t["nodes"][0].update(mesh=5)),
    "nan in a transform": (
        "nonfinite_vertices",
        lambda t: t["nodes"][0].update(translation=[float("nan"), 0, 0]),
    ),
    "scaled to nothing": ("extent_range", lambda t: t["nodes"][0].update(scale=[0, 0, 0])),
}


@pytest.mark.parametrize("name", TREES)
def test_bad_trees(tmp_path: Path, name: str) -> None:
    reason, change = TREES[name]
    tree, buffer = _broken_tree(change)
    assert reason_of(write_glb(tmp_path / "a.glb", tree, buffer)) == reason


def test_instances_count_as_faces(tmp_path: Path) -> None:
    tree, buffer = gltf_tree(BALL)
    tree["nodes"] = [{"children": list(range(1, 101))}] + [{"mesh": 0}] * 100
    path = write_glb(tmp_path / "a.glb", tree, buffer)
    assert reason_of(path, AssetSettings(max_source_faces=7999)) == "too_many_faces"


@pytest.mark.parametrize(
    "uri",
    [
        "../secret.bin",
        "a/../../secret.bin",
        "%2e%2e/secret.bin",
        "/etc/hostname",
        "file:///etc/hostname",
        "http://127.0.0.1:1/a.bin",
        "//host/a.bin",
        "link.bin",
    ],
)
def test_buffers_do_not_lead_out(tmp_path: Path, uri: str) -> None:
    (tmp_path / "secret.bin").write_bytes(bytes(10_000))
    folder = tmp_path / "objects"
    folder.mkdir()
    (folder / "link.bin").symlink_to(tmp_path / "secret.bin")
    tree, _ = gltf_tree(BALL)
    tree["buffers"][0]["uri"] = uri
    path = folder / "a.gltf"
    path.write_text(json.dumps(tree))
    assert reason_of(path) == "external_uri"


def test_a_missing_buffer_is_a_missing_file(tmp_path: Path) -> None:
    tree, _ = gltf_tree(BALL)
    tree["buffers"][0]["uri"] = "gone.bin"
    path = tmp_path / "a.gltf"
    path.write_text(json.dumps(tree))
    assert reason_of(path) == "missing_file"
