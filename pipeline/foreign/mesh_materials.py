"""Materials of single-mesh files: the MTL of an OBJ, the pictures of a PLY, or colors.

An MTL is read with its extension for metal and roughness (Pm, Pr, their maps). A map is read from
the first channel of its picture and multiplied with its number, which is 1 where only the map is
stated. Without those, `Ks` and `Ns` are read as today's exporters write them: Ks is half of white
for an ordinary dielectric, F0 = 0.08 Ks, and Ns is 1000 (1 - roughness)^2. `illum` 0 and 1 mean
that there is no highlight.
"""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from functools import partial

import numpy as np

from pipeline.foreign.material import (
    RGB,
    WHITE,
    Slot,
    SourceMaterial,
    TexturedMesh,
    with_normal_map,
)
from pipeline.foreign.material_files import (
    NORMAL_MAPS,
    READ_MAPS,
    Fields,
    MaterialFiles,
    read_mtl,
    split_map,
)
from pipeline.foreign.mesh import FileMesh
from pipeline.foreign.numbers import Malformed, parse_number
from pipeline.foreign.picture import FilePictures, Picture
from pipeline.foreign.source_file import SourceFile
from storage.errors import Rejected


def read_textured_mesh(
    source: SourceFile, pictures: FilePictures, *, emission: bool, normals: bool = False
) -> TexturedMesh:
    """Return the triangles of an OBJ, OFF, PLY or STL with their materials; colors are sRGB.

    Materials and pictures take precedence over colors, which the notes then name.

    Raises:
        Rejected: no_materials where it has neither, materials_unreadable, or as reading a picture.
    """
    contents = source.contents
    files = source.materials
    names = contents.material_names
    if source.kind == "obj" and (names or contents.color is None):
        materials, unread = _obj_materials(
            names, files, pictures, emission=emission, normals=normals
        )
        source.notes.extend(unread)
    elif (
        names
        and contents.uv is not None
        and (contents.color is None or set(names) <= {*files.data})
    ):
        values = [pictures.decode(name, name, partial(files.require, name)) for name in names]
        bases = [Slot(picture=Picture(values=each, is_srgb=True)) for each in values]
        materials = [SourceMaterial(base=base) for base in bases]
    elif contents.color is not None:
        why = "without texture coordinates" if contents.uv is None else "it is not there"
        source.notes.extend(f"picture {name[:60]!r}: {why}" for name in names)
        return _build_textured_mesh(dataclasses.replace(contents, material=None), [])
    else:
        of_ply = " and no picture with texture coordinates" if source.kind == "ply" else ""
        raise Rejected("no_materials", f"the {source.kind.upper()} has no colors{of_ply}")
    if contents.color is not None:
        source.notes.append("colors, where materials or pictures are read")
    return _build_textured_mesh(dataclasses.replace(contents, color=None), materials)


def _build_textured_mesh(contents: FileMesh, materials: Sequence[SourceMaterial]) -> TexturedMesh:
    count = len(contents.mesh.faces)
    rows = np.full(count, -1) if contents.material is None else contents.material
    uv = np.full((count, 3, 2), np.nan) if contents.uv is None else contents.uv
    return TexturedMesh(
        mesh=contents.mesh,
        material=np.where(rows < 0, len(materials), rows),
        materials=(*materials, SourceMaterial()),
        uv=uv[:, None],
        color=contents.color,
    )


_F0_OF_KS = 0.08
_MOST_NS = 1000.0
_PHYSICAL = {"pm", "pr", "map_pm", "map_pr"}
"""Statements of which one makes a material a metallic-roughness one."""
_READ = {*_PHYSICAL, "kd", "ks", "ns", "ke", "illum", "map_kd", "map_ks", "map_ke"}
_HEIGHTS = {"bump", "map_bump", "disp"}
_LOST = {"norm", *_HEIGHTS, "d", "tr", "map_d"}
"""Statements that `SourceMaterial.lost` names in words."""
_MEANINGLESS = {"ka", "map_ka", "ni", "sharpness", "map_aat"}
"""Statements about ambient light, the inside of what is opaque, and antialiasing."""
_CHANNELS = {"r": 0, "g": 1, "b": 2, "m": 3}
_SILENT_OPTIONS = {"-s", "-o", "-clamp", "-imfchan", "-blendu", "-blendv", "-cc", "-texres"}
_RGB_OF_XYZ = np.array(
    [[3.2404542, -1.5371385, -0.4985314], [-0.969266, 1.8760108, 0.041556],
     [0.0556434, -0.2040259, 1.0572252]]
)  # fmt: skip
"""Matrix from XYZ to linear Rec.709."""


def _obj_materials(
    names: Sequence[str],
    files: MaterialFiles,
    pictures: FilePictures,
    *,
    emission: bool,
    normals: bool,
) -> tuple[list[SourceMaterial], list[str]]:
    """Return the materials of these names, and sentences on statements that are not read."""
    if not names or not files.libraries:
        # records hold these words, and digests hold records
        why = "names no file of its materials (mtllib)" if names else "names no materials"
        raise Rejected("no_materials", f"the OBJ {why}")
    known: dict[str, Fields] = {}
    for library in files.libraries:
        if library in files.data:
            known = {**read_mtl(files.data[library]), **known}
    absent = [name for name in files.libraries if name not in files.data]
    if not known.keys() & set(names):
        if absent:
            files.require(absent[0])
        raise Rejected("materials_unreadable", f"no library has the material {names[0]!r:.80}")
    reader = _Reader(files, pictures)
    chosen = [known.get(name, {}) for name in names]
    try:
        materials = [reader.material(fields) for fields in chosen]
        if emission:
            materials = list(map(reader.add_emission, materials, chosen))
        if normals:
            materials = list(map(reader.add_normal_map, materials, chosen))
    except Malformed as error:
        raise Rejected("materials_unreadable", f"the MTL is malformed ({error!s:.200})") from error
    unread = [f"library {name[:60]!r}: it is not there" for name in absent]
    unread += [
        f"material {name[:60]!r}: no library has it; its faces have MTL's defaults"
        for name in names
        if name not in known
    ]
    read = _READ | NORMAL_MAPS if normals else _READ
    unread += [text for fields in chosen for text in _list_unread(fields, read)]
    return materials, list(dict.fromkeys(unread))


@dataclass(frozen=True, eq=False)
class _Reader:
    """Converts the materials of one MTL."""

    files: MaterialFiles
    pictures: FilePictures

    def material(self, fields: Fields) -> SourceMaterial:
        base = self._slot(fields.get("map_kd"), is_srgb=True)
        base_rgb = WHITE if base is not None and "kd" not in fields else _rgb(fields, "kd", 0.8)
        plain = SourceMaterial(base_rgb=base_rgb, base=base, lost=_list_unsupported(fields))
        if _PHYSICAL & set(fields):
            metallic, roughness = (self._slot(fields.get(name)) for name in ("map_pm", "map_pr"))
            return dataclasses.replace(
                plain,
                metallic=_number(fields, "pm", 0.0 if metallic is None else 1.0),
                metallic_map=metallic,
                roughness=_number(fields, "pr", 0.5 if roughness is None else 1.0),
                roughness_map=roughness,
            )
        shiny = _number(fields, "illum", 2.0) not in (0, 1)
        smooth = np.sqrt(np.clip(_number(fields, "ns", 250.0), 0, _MOST_NS) / _MOST_NS)
        return dataclasses.replace(
            plain,
            roughness=float(1 - smooth),
            f0=_F0_OF_KS,
            specular_rgb=_rgb(fields, "ks", 0.5),
            specular_colour=self._slot(fields.get("map_ks"), is_srgb=True),
            specular_strength=float(shiny),
        )

    def add_emission(self, material: SourceMaterial, fields: Fields) -> SourceMaterial:
        """Return a material with its emission; a map without `Ke` has the factor 1."""
        picture = self._slot(fields.get("map_ke"), is_srgb=True)
        factor = _rgb(fields, "ke", 0.0 if picture is None else 1.0)
        red, green, blue = (max(value, 0.0) for value in factor)
        if picture is not None and not any(factor):  # some exporters write it so
            red, green, blue = WHITE
        return dataclasses.replace(material, emission_rgb=(red, green, blue), emission=picture)

    def add_normal_map(self, material: SourceMaterial, fields: Fields) -> SourceMaterial:
        """Return a material with its normal map, if any; maps of heights are lost by that name."""
        heights = ("height map",) if _HEIGHTS & set(fields) else ()
        text = fields.get("norm", fields.get("map_kn"))
        if text is None:
            return material
        stated = split_map(text)[0].get("-bm", ["1"])
        slot = self._slot(text)
        assert slot is not None
        return with_normal_map(material, slot, parse_number(stated[0], "option -bm"), lost=heights)

    def _slot(self, text: str | None, *, is_srgb: bool = False) -> Slot | None:
        if text is None:
            return None
        options, name = split_map(text)
        values = self.pictures.decode(name, name, lambda: self.files.require(name))
        clamp = options.get("-clamp") == ["on"]
        picture = Picture(
            values=values,
            is_srgb=is_srgb and values.dtype != np.float16,  # floats are linear
            wrap=("clamp", "clamp") if clamp else ("repeat", "repeat"),
        )
        return Slot(
            picture=picture,
            uv_matrix=np.diag(_pair(options, "-s", 1.0)),
            uv_offset=np.array(_pair(options, "-o", 0.0)),
            channel=_CHANNELS.get("".join(options.get("-imfchan", ["r"])), 0),
        )


def _list_unsupported(fields: Fields) -> tuple[str, ...]:
    unsupported = {
        "emission": _is_over(fields.get("ke", "0"), 0) or "map_ke" in fields,
        "normal map": bool({"norm", *_HEIGHTS} & set(fields)),
        "transparency": not _is_over(fields.get("d", "1"), 1 - 1e-9)
        or _is_over(fields.get("tr", "0"), 0)
        or "map_d" in fields,
    }
    return tuple(word for word, is_there in unsupported.items() if is_there)


def _is_over(text: str, bound: float) -> bool:
    """Return whether any number of a statement exceeds a bound; words that are none are ignored."""
    try:
        return any(value > bound for value in _numbers(text.removeprefix("-halo"), ""))
    except ValueError:
        return bound > 0


def _list_unread(fields: Fields, read: Set[str]) -> Iterator[str]:
    """Yield names of statements of a material that no code reads."""
    for key, value in fields.items():
        if key not in read | _LOST | _MEANINGLESS:
            yield f"statement {key[:24]!r}"
        elif key in READ_MAPS:
            options = split_map(value)[0]
            unknown = [name for name in options if name not in _SILENT_OPTIONS]
            if options.get("-imfchan", ["r"])[0] not in _CHANNELS:
                unknown.append("-imfchan")
            yield from (f"option {name[:24]!r} of {key}" for name in unknown)
        elif value.startswith("spectral"):
            yield f"spectral curve of {key}"
        elif key in ("kd", "ks") and _is_over(value.removeprefix("xyz"), 1.001):
            yield f"{key} above 1"


def _rgb(fields: Fields, name: str, default: float) -> RGB:
    text = fields.get(name, str(default))
    if text.startswith("spectral"):  # a file of a curve, which `_list_unread` names
        text = str(default)
    is_xyz = text.startswith("xyz")
    values = _numbers(text.removeprefix("xyz"), name)
    if len(values) == 1:
        values = values * 3
    if len(values) != 3:
        raise Malformed(f"{name} is {fields.get(name)!r:.60}; expected three numbers")
    if is_xyz:
        values = np.maximum(_RGB_OF_XYZ @ values, 0).tolist()
    return values[0], values[1], values[2]


def _number(fields: Fields, name: str, default: float) -> float:
    return _numbers(fields.get(name, str(default)), name)[0]


def _numbers(text: str, field: str) -> list[float]:
    values = [parse_number(word, field) for word in text.partition("#")[0].split()]
    if not values:
        raise Malformed(f"{field} is empty; expected numbers")
    return values


def _pair(options: Mapping[str, list[str]], name: str, default: float) -> list[float]:
    numbers = [parse_number(value, f"option {name}") for value in options.get(name, ())[:2]]
    return numbers + [default] * (2 - len(numbers))
