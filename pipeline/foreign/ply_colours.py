"""Colours of a PLY, of its vertices or of its faces, as base colours of an ordinary dielectric."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.material import SourceMaterial
from pipeline.foreign.parts import TexturedParts, dumped, load_parts
from storage.conventions import linear_from_srgb8
from storage.errors import Rejected


def ply_parts(data: bytes) -> TexturedParts:
    """Return the triangles of a PLY with their colours, which are sRGB-encoded.

    A picture that it names is not read.

    Raises:
        Rejected: no_materials where it has no colours, materials_unreadable.
    """
    parts = load_parts(data, "ply", {}, {}, SourceMaterial())
    colour = np.concatenate([_colours(each.visual, each.faces) for each in dumped(data, "ply", {})])
    return dataclasses.replace(parts, colour=colour)


def _colours(visual: object, faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return linear colours [F, 3, 3] of corners."""
    kind = getattr(visual, "kind", None)
    if kind == "vertex":
        codes = np.asarray(visual.vertex_colors)[faces]  # type: ignore[attr-defined]
    elif kind == "face":
        codes = np.repeat(np.asarray(visual.face_colors)[:, None], 3, axis=1)  # type: ignore[attr-defined]
    else:
        raise Rejected("no_materials", "the PLY has no colours")
    return linear_from_srgb8()[codes[..., :3].astype(np.uint8)].astype(np.float64)
