"""The materials and textures of a scene that Trilight wrote, from the prims of a layer."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.pictures import MAX_BYTES
from pipeline.exchange.usd import names
from pipeline.exchange.usd.authoring import as_expected
from pipeline.exchange.usd.exact_layer import (
    children_of,
    drop_absent,
    numbered,
    require,
    require_plain,
)
from pipeline.exchange.usd.texture_files import decoded_texture
from pipeline.exchange.usd.write_materials import material_tables
from pipeline.exchange.usd.write_textures import COAT_ROUGHNESS, SHADERS, Used, material_links
from pipeline.foreign.usd.stage import OpenedUsd
from pipeline.foreign.usd.texture_nodes import asset_bytes
from storage.records.material import PUBLISHED_COLUMNS, declared_column, default_rows, laid_out
from storage.records.texture import CONSTANT, TEXTURED, MapSource, Texture

_ADDED = {"inputs:ior", COAT_ROUGHNESS, "outputs:r", *map(names.texture_attribute, TEXTURED)}
"""Properties that files of an older Trilight have not; its roughness textures have `outputs:r`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class WrittenMaterials:
    """What the prims of all materials say."""

    rows: NDArray[np.float32]
    """[M, 10 or more] as `Scene.materials`."""
    textures: tuple[Texture, ...]
    """As `Scene.textures`."""
    material_textures: NDArray[np.int32] | None
    """[M, 3] as `Scene.material_textures`."""


def materials_as_written(folder: Any, opened: OpenedUsd | None) -> WrittenMaterials:
    """Return the materials below a prim.

    Args:
        folder: the prim.
        opened: the way to the files of textures; without it, textured materials are not read.

    Raises:
        UndeclaredColumn: a material has a column that is not declared here.
        Changed, LookupError, TypeError, ValueError: not as export writes them.
    """
    prims = numbered(folder, names.material_name)
    rows = default_rows(len(prims))
    columns = _columns(prims[0])
    index = np.full((len(prims), len(TEXTURED)), CONSTANT, np.int32)
    textures: dict[int, Texture] = {}
    for row, prim in enumerate(prims):
        for column, part in laid_out():
            if column.name in columns:
                rows[row, part] = prim.attributes[names.column_attribute(column.name)].default
        used = _used(prim, textures, opened)
        for name, (texture, _) in used.items():
            index[row, TEXTURED.index(name)] = texture
        _require_prims(prim, rows[row], columns, used)
    return WrittenMaterials(
        rows=rows,
        textures=tuple(textures[row] for row in range(len(textures))),
        material_textures=index if textures else None,
    )


def _require_prims(
    prim: Any, values: NDArray[np.float32], columns: tuple[str, ...], used: Used
) -> None:
    """Require that a material's prims are what export writes for such a row, and no more."""
    tables, links = material_tables(values, columns, used), material_links(list(used))
    children_of(prim, {place.removeprefix("/") for place in tables if place})
    own = prim.path.StripAllVariantSelections()
    for place in tables:
        part = prim.nameChildren[place.removeprefix("/")] if place else prim
        table = drop_absent(part, tables[place], _ADDED)
        linked = drop_absent(part, links[place], _ADDED)
        require(as_expected(part, table))
        require_plain(part, {*table, *linked})
        for attribute in part.attributes:
            source = linked.get(attribute.name, ("", None))[1]
            found = [str(path) for path in attribute.connectionPathList.explicitItems]
            require(found == ([] if source is None else [f"{own}/{source}"]))


def _used(prim: Any, textures: dict[int, Texture], opened: OpenedUsd | None) -> Used:
    """Return the textures of a material, and add those that are new to `textures`."""
    used = {}
    for name, shader in SHADERS.items():
        if shader not in prim.nameChildren:
            continue
        require(opened is not None)
        assert opened is not None
        attributes = prim.nameChildren[shader].attributes
        row = attributes[names.TEXTURE_ROW].default
        if row not in textures:
            textures[row] = _texture(attributes, prim.layer, opened)
        used[name] = (row, textures[row])
    return used


def _texture(attributes: Any, layer: Any, opened: OpenedUsd) -> Texture:
    named = attributes["inputs:file"].default.path
    found = opened.inside(layer, named)
    data = None if found is None else asset_bytes(found, MAX_BYTES)
    if data is None:
        raise LookupError(named)
    texts = {field: attributes[name].default for field, name in names.MAP_TEXTS.items()}
    return decoded_texture(
        data,
        is_exr=named.endswith(".exr"),
        is_srgb=attributes["inputs:sourceColorSpace"].default == "sRGB",
        source=MapSource(**texts),
    )


def _columns(prim: Any) -> tuple[str, ...]:
    """Return the columns that a material has; raises UndeclaredColumn."""
    found = (names.added_column(attribute.name) for attribute in prim.attributes)
    added = [name for name in found if name is not None]
    return (*PUBLISHED_COLUMNS, *(declared_column(name).name for name in added))
