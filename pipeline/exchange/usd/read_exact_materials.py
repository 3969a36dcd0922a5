"""Reads the materials and textures of a scene that Trilight wrote, from the prims of a layer."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.pictures import MAX_BYTES
from pipeline.exchange.usd import names
from pipeline.exchange.usd.exact_layer import list_by_row, require
from pipeline.exchange.usd.texture_files import decode_texture
from pipeline.exchange.usd.write_textures import SHADERS
from pipeline.foreign.usd.stage import OpenedStage
from pipeline.foreign.usd.texture_nodes import asset_bytes
from storage.records.material import PUBLISHED_COLUMNS, declared_column, default_rows, laid_out
from storage.records.texture import CONSTANT, TEXTURED, MapSource, Texture


@dataclass(frozen=True, kw_only=True, eq=False)
class ExactMaterials:
    """Material arrays of a scene, as the prims of all materials hold them."""

    rows: NDArray[np.float32]
    """[M, 10 or more] rows of `Scene.materials`."""
    textures: tuple[Texture, ...]
    """Distinct textures, the value of `Scene.textures`."""
    material_textures: NDArray[np.int32] | None
    """[M, 3] the value of `Scene.material_textures`; None without textures."""


def read_exact_materials(folder: Any, opened: OpenedStage | None) -> ExactMaterials:
    """Read the materials below a prim.

    Args:
        folder: the prim.
        opened: the open file, which resolves texture files; None refuses textured materials.

    Raises:
        UndeclaredColumn: a material has a column that is not declared here.
        Changed, LookupError, TypeError, ValueError: the materials are not as export writes them.
    """
    prims = list_by_row(folder, names.material_name)
    rows = default_rows(len(prims))
    columns = _list_columns(prims[0])
    index = np.full((len(prims), len(TEXTURED)), CONSTANT, np.int32)
    textures: dict[int, Texture] = {}
    for row, prim in enumerate(prims):
        for column, part in laid_out():
            if column.name in columns:
                rows[row, part] = prim.attributes[names.column_attribute(column.name)].default
        used = _read_textures(prim, textures, opened)
        for name, texture in used.items():
            index[row, TEXTURED.index(name)] = texture
    return ExactMaterials(
        rows=rows,
        textures=tuple(textures[row] for row in range(len(textures))),
        material_textures=index if textures else None,
    )


def _read_textures(
    prim: Any, textures: dict[int, Texture], opened: OpenedStage | None
) -> dict[str, int]:
    """Return the texture rows of a material's columns, and add new ones to `textures`."""
    used = {}
    for name, shader in SHADERS.items():
        if shader not in prim.nameChildren:
            continue
        require(opened is not None)
        assert opened is not None
        attributes = prim.nameChildren[shader].attributes
        row = attributes[names.TEXTURE_ROW].default
        if row not in textures:
            textures[row] = _read_texture(attributes, prim.layer, opened)
        used[name] = row
    return used


def _read_texture(attributes: Any, layer: Any, opened: OpenedStage) -> Texture:
    named = attributes["inputs:file"].default.path
    resolved = opened.resolve(layer, named)
    data = None if resolved is None else asset_bytes(resolved, MAX_BYTES)
    if data is None:
        raise LookupError(named)
    texts = {field: attributes[name].default for field, name in names.MAP_TEXTS.items()}
    return decode_texture(
        data,
        is_exr=named.endswith(".exr"),
        is_srgb=attributes["inputs:sourceColorSpace"].default == "sRGB",
        source=MapSource(**texts),
    )


def _list_columns(prim: Any) -> tuple[str, ...]:
    """Return the column names of a material; raises UndeclaredColumn."""
    added_or_none = (names.added_column(attribute.name) for attribute in prim.attributes)
    added = [name for name in added_or_none if name is not None]
    return (*PUBLISHED_COLUMNS, *(declared_column(name).name for name in added))
