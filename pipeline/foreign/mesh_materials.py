"""Materials of single-mesh files: the MTL of an OBJ, the pictures of a PLY, or colors."""

import dataclasses

from pipeline.foreign.material import Slot, SourceMaterial
from pipeline.foreign.obj_materials import obj_materials
from pipeline.foreign.picture import Decode, Picture
from pipeline.foreign.source_file import SourceFile
from pipeline.foreign.textured_mesh import TexturedMesh, build_textured_mesh
from storage.errors import Rejected


def read_textured_mesh(source: SourceFile, decode: Decode, *, emission: bool) -> TexturedMesh:
    """Return the triangles of an OBJ, OFF, PLY or STL with their materials; colors are sRGB.

    Materials and pictures take precedence over colors, which the notes then name.

    Raises:
        Rejected: no_materials where it has neither, materials_unreadable, or as reading a picture.
    """
    contents = source.contents
    files = source.materials
    names = contents.material_names
    if source.kind == "obj" and (names or contents.color is None):
        materials, unread = obj_materials(names, files, decode, emission=emission)
        source.notes.extend(unread)
    elif (
        names
        and contents.uv is not None
        and (contents.color is None or set(names) <= {*files.data})
    ):
        pictures = [
            Picture(values=decode(files.require(name), name), is_srgb=True) for name in names
        ]
        materials = [SourceMaterial(base=Slot(picture=picture)) for picture in pictures]
    elif contents.color is not None:
        why = "without texture coordinates" if contents.uv is None else "it is not there"
        source.notes.extend(f"picture {name[:60]!r}: {why}" for name in names)
        return build_textured_mesh(
            dataclasses.replace(contents, material=None), [], SourceMaterial()
        )
    else:
        of_ply = " and no picture with texture coordinates" if source.kind == "ply" else ""
        raise Rejected("no_materials", f"the {source.kind.upper()} has no colors{of_ply}")
    if contents.color is not None:
        source.notes.append("colors, where materials or pictures are read")
    return build_textured_mesh(
        dataclasses.replace(contents, color=None), materials, SourceMaterial()
    )
