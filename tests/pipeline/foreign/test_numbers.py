"""No number of a stranger's file that is not finite gets anywhere, in any format."""

import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.assets.source_materials.skin import _parts
from pipeline.exchange.renderformer_json import read_description
from pipeline.foreign.light_pictures import read_linear_picture
from pipeline.foreign.numbers import FINITE
from pipeline.foreign.picture import Decoder
from pipeline.foreign.source_file import read_source
from storage.errors import Rejected, TrilightError
from tests.for_each import case
from tests.pipeline.assets.meshes_by_hand import write_glb
from tests.pipeline.assets.source_materials import textured_kit as kit
from tests.pipeline.assets.source_materials.usd_kit import SHADER, TEXTURE, set_inputs, textured_usd
from tests.pipeline.exchange.test_renderformer_json import MATERIAL, TRANSFORM, changed

NUMBERS = (math.nan, math.inf, -math.inf, 1e39, -1e39, 0.0, 0.25, 1e3, -7.0)
PICTURE = kit.picture_bytes(kit.CORNERS)


def look_at_parts(path: Path) -> str:
    """Read all of a file and return what is not read; what became of its numbers is finite."""
    source = read_source(path, kit.KEEP.read_limits)
    for material in _parts(source, Decoder(1 << 20), emission=True).materials:
        colors = (*material.base_rgb, *material.specular_rgb, *material.emission_rgb)
        numbers = (material.metallic, material.roughness, material.f0, material.specular_strength)
        moves = [[*slot.uv_matrix.flat, *slot.uv_offset] for slot in material.slots]
        assert np.isfinite([*colors, *numbers, *itertools.chain(*moves)]).all()
    return "; ".join(source.unread)


def gltf(folder: Path, where: str, name: str, value: Any) -> str:
    tree, buffer = kit.textured_tree(PICTURE)
    row = tree["materials"][0]
    if where == "emissive_strength":
        row["emissiveFactor"] = [1, 1, 1]
    if where in ("metal", "uv"):
        row = row["pbrMetallicRoughness"]
    if where == "uv":
        extensions = row["baseColorTexture"].setdefault("extensions", {})
        row = extensions.setdefault("KHR_texture_transform", {})
    elif where not in ("metal", ""):
        row = row.setdefault("extensions", {}).setdefault(f"KHR_materials_{where}", {})
    row[name] = value
    return look_at_parts(write_glb(folder / "a.glb", tree, buffer))


def obj(folder: Path, where: str, name: str, value: Any) -> str:
    line = f"map_Kd {name} {value} its picture.png" if where == "option" else f"{name} {value}"
    return look_at_parts(kit.textured_obj(folder / "o" / "a.obj", PICTURE, f"{line}\n"))


def usd(folder: Path, where: str, name: str, value: Any) -> str:
    def change(stage: Any) -> None:
        set_inputs(stage, where, {name: tuple(value) if isinstance(value, list) else value})

    path, connect = folder / "u" / "a.usda", {"emissiveColor": "rgb"}
    return look_at_parts(textured_usd(path, PICTURE, change, connect=connect))


def scene(folder: Path, where: str, name: str, value: Any) -> str:
    fields = MATERIAL if where == "material" else TRANSFORM
    read_description(changed(*fields, **{name: value}), f"{name}.json")
    return ""


def radiance(folder: Path, where: str, name: str, value: Any) -> str:
    head = f"#?RADIANCE\n{name}={value}\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 1\n"
    picture = read_linear_picture(head.encode() + bytes([128] * 4), 1)
    assert picture is not None and np.isfinite(picture.values).all()
    return ""


FIELDS = [
    *((gltf, "metal", "baseColorFactor", 4), (gltf, "metal", "metallicFactor", 1)),
    *((gltf, "metal", "roughnessFactor", 1), (gltf, "ior", "ior", 1)),
    *((gltf, "specular", "specularFactor", 1), (gltf, "specular", "specularColorFactor", 3)),
    *((gltf, "", "emissiveFactor", 3), (gltf, "emissive_strength", "emissiveStrength", 1)),
    *((gltf, "uv", "rotation", 1), (gltf, "uv", "scale", 2), (gltf, "uv", "offset", 2)),
    *((obj, "", name, 1) for name in ("Kd", "Ks", "Ns", "Ke", "Pm", "Pr", "illum")),
    *((obj, "option", name, 1) for name in ("-s", "-o")),
    *((usd, SHADER, name, 1) for name in ("roughness", "metallic", "ior")),
    *((usd, SHADER, "diffuseColor", 3), (usd, TEXTURE, "scale", 4), (usd, TEXTURE, "bias", 4)),
    *((scene, "material", "roughness", 1), (scene, "material", "emissive", 3)),
    *((scene, "transform", "scale", 3), (radiance, "", "EXPOSURE", 1)),
]


def test_a_number_that_is_not_finite_is_named_by_its_field(tmp_path: Path) -> None:
    for (read, where, name, count), number in itertools.product(FIELDS, NUMBERS):
        with case((read.__name__, where, name, number)):
            try:
                said = read(tmp_path, where, name, number if count == 1 else [number] * count)
            except (Rejected, TrilightError) as refusal:
                said = str(refusal)
            if not FINITE.holds(number):
                assert name.lower() in said.lower() or "no JSON number" in said
