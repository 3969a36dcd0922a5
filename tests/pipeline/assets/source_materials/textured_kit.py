"""Quads with pictures, as glTF and OBJ files written by hand."""

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from pipeline.assets.settings import AssetSettings, OwnMaterialSettings
from pipeline.foreign.mesh import TriangleMesh
from storage.records.asset import Asset
from storage.records.lookup import texture_values
from tests.pipeline.assets.meshes_by_hand import gltf_tree, prepare, write_glb
from tests.pipeline.foreign.gltf.gltf_writer import GltfWriter

RED, GREEN, BLUE, WHITE = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)
CORNERS = np.array([[BLUE, WHITE], [RED, GREEN]], np.uint8)
"""[2, 2, 3] the top row first: red at the lower left, green at the lower right."""
QUARTERS = {(-0.25, -0.25): RED, (0.25, -0.25): GREEN, (-0.25, 0.25): BLUE, (0.25, 0.25): WHITE}
"""Colour by place: to the right and up, on a square of width 1."""

SQUARE = TriangleMesh(
    positions=np.array([[-0.5, 0, -0.5], [0.5, 0, -0.5], [0.5, 0, 0.5], [-0.5, 0, 0.5]]),
    faces=np.array([[0, 1, 2], [0, 2, 3]]),
)
"""It stands upright and looks to the front, -y: x goes to the right and z up."""
UV_UP = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float64)
"""[4, 2] of its corners, v up."""

F = 0.04 + 0.96 / 21
"""Specular albedo of an ordinary dielectric: the mean of Schlick's term for F0 = 0.04."""
STORED = 0.006
"""Half a step of 8 bits in sRGB near white."""
SLOPE = 0.04
"""Colours of two texels change by 2 over the width, and texels are inset by a quarter of a cell of
a sixteenth of it; a wrong corner is off by 0.9."""

OWN = OwnMaterialSettings(keep=True, texels=16)
KEEP = AssetSettings(own_materials=OWN)
REFUSE = AssetSettings(own_materials=OwnMaterialSettings(keep=True, texels=16, if_lost="reject"))


def picture_bytes(values: NDArray, kind: str = "PNG", mode: str | None = None) -> bytes:
    """Return a picture [H, W, C] or [H, W], the top row first, as a file."""
    file = io.BytesIO()
    image = Image.fromarray(values)
    (image if mode is None else image.convert(mode)).save(file, kind)
    return file.getvalue()


def textured_tree(
    picture: bytes | str, uv_up: ArrayLike | None = UV_UP, mesh: TriangleMesh = SQUARE
) -> tuple[dict[str, Any], bytes]:
    """Return a glTF of a mesh with a picture, embedded or by its URI."""
    tree, buffer = gltf_tree(mesh)
    file = GltfWriter(tree=tree, data=bytearray(buffer))
    primitive = tree["meshes"][0]["primitives"][0]
    primitive["material"] = 0
    tree["materials"] = [
        {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicFactor": 0}}
    ]
    tree["textures"] = [{"source": 0}]
    if uv_up is not None:
        uv = np.asarray(uv_up, np.float64) * [1, -1] + [0, 1]  # glTF has v down
        primitive["attributes"]["TEXCOORD_0"] = file.accessor(uv, "f4")
    tree["images"] = [{"uri": picture}]
    if isinstance(picture, bytes):
        tree["images"] = [{"bufferView": file.view(picture), "mimeType": "image/png"}]
    tree["buffers"][0]["byteLength"] = len(file.data)
    return tree, bytes(file.data)


def textured_glb(
    path: Path, picture: bytes | str, uv_up: ArrayLike | None = UV_UP, mesh: TriangleMesh = SQUARE
) -> Path:
    return write_glb(path, *textured_tree(picture, uv_up, mesh))


def textured_gltf(path: Path, picture: bytes | str) -> Path:
    """Write a .gltf with its buffer beside it."""
    tree, buffer = textured_tree(picture)
    path.with_suffix(".bin").write_bytes(buffer)
    tree["buffers"][0]["uri"] = path.with_suffix(".bin").name
    path.write_text(json.dumps(tree))
    return path


def textured_obj(path: Path, picture: bytes, mtl: str = "map_Kd its picture.png\n") -> Path:
    """Write an OBJ, its MTL and the picture of that, in a folder of their own."""
    path.parent.mkdir(exist_ok=True)
    (path.parent / "its picture.png").write_bytes(picture)
    (path.parent / "a.mtl").write_text(f"newmtl it is\n{mtl}")
    rows = [f"v {x} {y} {z}\n" for x, y, z in SQUARE.positions]
    rows += [f"vt {u} {v}\n" for u, v in UV_UP]
    rows += ["usemtl it is\n", "f 1/1 2/2 3/3\n", "f 1/1 3/3 4/4\n"]
    path.write_text("mtllib a.mtl\n" + "".join(rows))
    return path


def seen_at(asset: Asset, right: float, up: float, column: int = 0) -> NDArray[np.float64]:
    """Return what the finest level of an upright square shows at a place."""
    level = asset.levels[0]
    assert level.skin is not None, asset.materials
    for corners, uv in zip(level.positions[level.faces], level.skin.uv, strict=True):
        flat = np.vstack([corners[:, [0, 2]].T, np.ones(3)])
        weights = np.linalg.solve(flat.astype(np.float64), [right, up, 1.0])
        if (weights >= -1e-9).all():
            return texture_values(level.skin.textures[column], weights @ uv)
    raise AssertionError(f"no triangle at {right}, {up}")


def shown(colour: ArrayLike) -> NDArray[np.float64]:
    """Return the diffuse part of a dielectric of a colour that is 0 or 255."""
    return np.asarray(colour) / 255 * (1 - F)


def assert_corners(
    asset: Asset,
    place: Callable[[float, float], tuple[float, float]] = lambda right, up: (right, up),
) -> None:
    """Assert that a square shows its picture upright and not mirrored, or each corner elsewhere."""
    for corner, colour in QUARTERS.items():
        seen = seen_at(asset, *place(*corner))
        assert np.abs(seen - shown(colour)).max() < SLOPE, corner


def lost(path: Path, settings: AssetSettings = KEEP) -> str:
    """Return why an object is accepted without its materials; its mesh is whole."""
    asset = prepare(path, settings)
    assert asset.materials is not None and all(level.skin is None for level in asset.levels)
    assert asset.materials.message.isprintable()
    return asset.materials.reason
