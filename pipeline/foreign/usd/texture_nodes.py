"""`TextureNode`: the file, color space and texture coordinates of a UsdUVTexture."""

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Usd, UsdShade, Vt

from pipeline.foreign.numbers import Malformed, read_number, read_numbers
from pipeline.foreign.picture import Wrap
from pipeline.foreign.usd.stage import OpenedStage, file_and_member
from storage.errors import TrilightError

_MOST_NODES = 8
"""Maximum number of transforms in a row."""

_WRAPS = get_args(Wrap)


@dataclass(frozen=True, kw_only=True, eq=False)
class TextureNode:
    """The inputs of a texture, before its picture is opened."""

    named: str
    """Path of the file in the shader; empty where it states none."""
    resolved: str | None
    """Resolved path below the folder of the stage; None for a missing file."""
    color_space: str
    """`sRGB`, `raw`, or anything else for `auto`."""
    wrap: tuple[Wrap, Wrap]
    """Wrap modes along s and t; `useMetadata` and unknown ones are `repeat`."""
    scale: NDArray[np.float32]
    """[4] factors of the picture's RGBA values."""
    bias: NDArray[np.float32]
    """[4] offsets added after `scale`."""
    primvar: str
    """Name of the mesh's primvar of texture coordinates; `st` where none is stated."""
    uv_matrix: NDArray[np.float64]
    """[2, 2] factors of those, as column vectors: scales and rotations."""
    uv_offset: NDArray[np.float64]
    """[2] offset that is added after the matrix."""
    output: str
    """Name of the connected output: rgb, r, g, b or a."""
    fallback: NDArray[np.float64] | None
    """[4] RGBA value used without a picture; None where none is stated."""


def read_texture_node(shader: Any, output: str, opened: OpenedStage) -> TextureNode:
    """Return the inputs of a UsdUVTexture shader.

    Args:
        shader: the node.
        output: name of the connected output.
        opened: the file, which resolves paths and receives notes.

    Raises:
        TrilightError: its picture is outside of the folder, or on the network, or Malformed.
    """
    time = opened.time
    sources = find_sources(shader, "file")
    named, resolved = resolve_file(sources[0] if sources else None, opened)
    if "<UDIM>" in named:
        opened.lost.append(f"{shader.GetPath()}: {named!r:.100} has UDIM tiles, which are not read")
    for name in ("scale", "bias", "fallback"):
        if any(is_output(source) for source in find_sources(shader, name)):
            opened.lost.append(f"{shader.GetPath()}.{name}: a network that is not read")
    fallback = read_input(shader, "fallback", time, None)
    return TextureNode(
        named=named,
        resolved=resolved,
        color_space=str(read_input(shader, "sourceColorSpace", time, "auto")),
        wrap=(_wrap(shader, "wrapS", time), _wrap(shader, "wrapT", time)),
        scale=np.array(_vector(shader, "scale", time, (1, 1, 1, 1)), np.float32),
        bias=np.array(_vector(shader, "bias", time, (0, 0, 0, 0)), np.float32),
        **_read_coordinates(shader, time, opened.lost),
        output=output if output in ("r", "g", "b", "a") else "rgb",
        fallback=None if fallback is None else np.array(fallback, np.float64),
    )


def resolve_file(attribute: Any, opened: OpenedStage) -> tuple[str, str | None]:
    """Return the path that an attribute states, or an empty one; and the resolved path, if any.

    Raises:
        TrilightError: the file is outside of the folder, or on the network.
    """
    asset = attribute.Get(opened.time) if attribute else None
    if asset is None or not asset.path:
        return "", None
    specs = attribute.GetPropertyStack(opened.time)
    return asset.path, opened.resolve(specs[0].layer if specs else opened.root, asset.path)


def _read_coordinates(shader: Any, time: Any, lost: list[str]) -> dict[str, Any]:
    """Return the fields of `TextureNode` on the texture coordinates of a shader."""
    sources = find_sources(shader, "st")
    moves: list[tuple[NDArray[np.float64], tuple[float, ...]]] = []
    primvar = "st"
    for _ in range(_MOST_NODES):
        if not sources or not is_output(sources[0]):
            break
        node = UsdShade.Shader(sources[0].GetPrim())
        if node.GetIdAttr().Get() == "UsdTransform2d":
            moves.append(_read_transform(node, time))
            sources = find_sources(node, "in")
            continue
        primvar = str(read_input(node, "varname", time, primvar))
        if node.GetIdAttr().Get() != "UsdPrimvarReader_float2":
            lost.append(f"{node.GetPath()}: not read; texture coordinates {primvar!r:.60} taken")
        break
    matrix = np.eye(2)
    offset = np.zeros(2)
    for move, translation in reversed(moves):
        matrix = move @ matrix
        offset = move @ offset + translation
    if not (np.isfinite(matrix).all() and np.isfinite(offset).all()):
        raise Malformed(f"{shader.GetPath()}: coordinates are moved by what is no number")
    return {"primvar": primvar, "uv_matrix": matrix, "uv_offset": offset}


def _read_transform(node: Any, time: Any) -> tuple[NDArray[np.float64], tuple[float, ...]]:
    """Return matrix and translation of a UsdTransform2d: it scales, rotates, then translates."""
    angle = np.radians(
        read_number(read_input(node, "rotation", time, 0), f"{node.GetPath()}.rotation")
    )
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    matrix: NDArray[np.float64] = rotation * _vector(node, "scale", time, (1, 1))
    return matrix, _vector(node, "translation", time, (0, 0))


def asset_bytes(resolved: str, max_bytes: int) -> bytes | None:
    """Return the bytes of a plain file, or of a member of an archive; None for a missing one.

    Raises:
        TrilightError: there are more than `max_bytes`.
    """
    name = Path(resolved).name
    outer, member = file_and_member(resolved)
    try:
        if member:  # packed ones too, which USD's own resolver refuses
            with zipfile.ZipFile(outer) as archive:
                info = archive.getinfo(member)
                _require_size(info.file_size, max_bytes, name)
                return archive.read(info)
        _require_size(outer.stat().st_size, max_bytes, name)
        return outer.read_bytes()
    except (OSError, KeyError, zipfile.BadZipFile):
        return None


def _require_size(size: int, max_bytes: int, name: str) -> None:
    if size > max_bytes:
        raise TrilightError(f"{name}: {size} bytes; expected at most {max_bytes}.")


def find_sources(shader: Any, name: str) -> Any:
    """Return the attributes that produce the value of a shader's input, its material's included."""
    stated = shader.GetInput(name)
    return UsdShade.Utils.GetValueProducingAttributes(stated) if stated else []


def is_output(attribute: Any) -> bool:
    """Return whether an attribute is the output of another node."""
    return bool(UsdShade.Output.IsOutput(attribute))


def read_input(shader: Any, name: str, time: Any, default: Any) -> Any:
    """Return an input of a shader or of its material; the default where none is stated."""
    sources = find_sources(shader, name)
    value = sources[0].Get(time) if sources else None
    return default if value is None else value


def _wrap(shader: Any, name: str, time: Any) -> Wrap:
    mode = str(read_input(shader, name, time, "repeat"))
    return cast(Wrap, mode) if mode in _WRAPS else "repeat"


def _vector(shader: Any, name: str, time: Any, default: tuple[float, ...]) -> tuple[float, ...]:
    stated = read_input(shader, name, time, default)
    return read_numbers(stated, len(default), f"{shader.GetPath()}.{name}")


def convert_to_rec709(attribute: Any, stated: NDArray) -> NDArray:
    """Return the colors [..., 3 or 4] of an attribute, converted from the color space of USD.

    Colors without a space, and those declared as data, stay as they are.
    """
    is_color = attribute.GetTypeName().scalarType.role == "Color" and stated.shape[-1:] != ()
    space = Usd.ColorSpaceAPI.ComputeColorSpace(attribute, None) if is_color else None
    ours = Gf.ColorSpace(Gf.ColorSpaceNames.LinearRec709)
    if space is None or space.IsData() or space.GetName() in ("", ours.GetName()):
        return stated
    rows = np.ascontiguousarray(stated[..., :3], np.float32)
    span = Vt.FloatArray.FromNumpy(rows.reshape(-1))
    space.ConvertRGBSpan(ours, span)
    return np.concatenate([np.array(span).reshape(rows.shape), stated[..., 3:]], axis=-1)
