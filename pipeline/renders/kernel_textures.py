"""The textures of a scene in a kernel, by the lookup of storage.records.lookup in single precision.

All texels of a scene lie in one array of linear values, colours before numbers: a kernel serves any
number of textures of any size. Texture coordinates are interpolated between the corners of a
triangle, and bilinearly looked up there; both repeat.

A colour takes 16 bytes in a kernel and a number 4: 6 to 12 MB for the usual scene, and 2.9 GB for
the largest one that storage admits (MAX_MAPS_BYTES of 8-bit colours), twice while it is loaded. In
8 bits, decoded in the kernel, they would take a quarter; a pass took 5 to 8 % longer (study S28).
"""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pipeline.renders.device_memory import own_floats, own_integers
from storage.records.scene import Scene
from storage.records.texture import CONSTANT, TEXTURED, Texture

_COLOUR = 4
"""Floats of a color texel, padded so that a lane loads it as an aligned group."""

_NUMBER = 1
"""Floats of a texel of numbers."""

_BLOCK = 1 << 16
"""Texels that are decoded at a time."""


class KernelTextures:
    """Textures of triangles. Not a dataclass: Dr.Jit would take its arrays for loop variables."""

    def __init__(self, scene: Scene, order: NDArray[np.intp]) -> None:
        """Take the textures of the triangles `order` of a scene that has some, in that order."""
        assert scene.uv is not None and scene.material_textures is not None
        corners = scene.uv.reshape(-1, 3, 2)[order].astype(np.float64)
        # Whole turns change no lookup; without them float32 keeps its digits for the rest.
        corners -= np.floor(corners.min(axis=1, keepdims=True))
        self._corners = own_floats(np.pad(corners.reshape(-1, 6), ((0, 0), (0, 2))))
        self._material = own_integers(scene.material_index[order])
        colours = [each for each in scene.textures if each.channels == 3]
        numbers = [each for each in scene.textures if each.channels == 1]
        self._colours = _texels(colours, _COLOUR)
        self._numbers = _texels(numbers, _NUMBER)
        places = _places(colours) | _places(numbers)
        rows = np.zeros((len(scene.materials), len(TEXTURED), 4), np.int64)
        textured = scene.material_textures != CONSTANT
        rows[textured] = [
            places[scene.textures[row].sha256] for row in scene.material_textures[textured]
        ]
        self._rows = own_integers(rows)

    def values(
        self, triangle: Any, barycentric: Any, columns: tuple[Any, Any, Any], active: Any
    ) -> tuple[Any, Any, Any]:
        """Return diffuse and specular albedo (Color3f) and roughness (Float) of a place.

        Args:
            triangle: UInt32.
            barycentric: Point2f, the weights of the 2nd and 3rd corner.
            columns: what they are where no texture stands for them.
            active: Bool.
        """
        near = dr.gather(mi.Vector4f, self._corners, triangle * 2, active)
        far = dr.gather(mi.Vector4f, self._corners, triangle * 2 + 1, active)
        weight = 1 - barycentric.x - barycentric.y
        u = weight * near.x + barycentric.x * near.z + barycentric.y * far.x
        v = weight * near.y + barycentric.x * near.w + barycentric.y * far.y
        material = dr.gather(mi.UInt32, self._material, triangle, active)
        kinds = (mi.Color3f, mi.Color3f, mi.Float)
        values = []
        for place, (kind, constant) in enumerate(zip(kinds, columns, strict=True)):
            row = material * len(TEXTURED) + place
            texture = dr.gather(mi.Vector4u, self._rows, row, active)
            textured = active & (texture.w > 0)
            value = self._bilinear(kind, texture, u - dr.floor(u), v - dr.floor(v), textured)
            values.append(dr.select(textured, value, constant))
        return values[0], values[1], values[2]

    def _bilinear(self, kind: Any, texture: Any, u: Any, v: Any, active: Any) -> Any:
        """Return the value at u and v in [0, 1] of a texture (Vector4u: first, width, height)."""
        near, far, along = _neighbours(u, texture.y)
        low, high, across = _neighbours(v, texture.z)

        def row(line: Any) -> Any:
            first = texture.x + line * texture.y
            return dr.lerp(
                self._texel(kind, first + near, active),
                self._texel(kind, first + far, active),
                along,
            )

        return dr.lerp(row(low), row(high), across)

    def _texel(self, kind: Any, index: Any, active: Any) -> Any:
        if kind is mi.Float:
            return dr.gather(mi.Float, self._numbers, index, active)
        texel: Any = dr.gather(mi.Vector4f, self._colours, index, active)
        return mi.Color3f(texel.xyz)


def _neighbours(place: Any, count: Any) -> tuple[Any, Any, Any]:
    """Return the texels (UInt32) around a place in [0, 1], and the share (Float) of the second."""
    scaled = place * mi.Float(count) - 0.5
    below = dr.floor(scaled)
    first = dr.select(below < 0, count - 1, mi.UInt32(dr.maximum(below, 0)))
    second = dr.select(first + 1 < count, first + 1, 0)
    return first, second, scaled - below


def _places(textures: list[Texture]) -> dict[str, tuple[int, int, int, int]]:
    """Return where each texture begins, in texels, its width and height, and 1: it is there."""
    places = {}
    first = 0
    for texture in textures:
        height, width = texture.texels.shape[:2]
        places[texture.sha256] = (first, width, height, 1)
        first += height * width
    return places


def _texels(textures: list[Texture], floats: int) -> Any:
    """Return the linear values of all texels, row by row, `floats` of each; 0 beyond its own."""
    count = sum(each.texels.shape[0] * each.texels.shape[1] for each in textures)
    values = np.zeros((max(1, count), floats), np.float32)
    first = 0
    for texture in textures:
        flat = texture.texels.reshape(-1, texture.channels)
        for start in range(0, len(flat), _BLOCK):
            linear = texture.linear(flat[start : start + _BLOCK])
            begin = first + start
            values[begin : begin + len(linear), : texture.channels] = linear
        first += len(flat)
    return own_floats(values)
