"""Materials of an OBJ: its MTL, with the extension for metal and roughness (Pm, Pr, their maps).

A map stands in the first channel of its picture, times the number, which is 1 where only the map is
there.
Without those, `Ks` and `Ns` are taken as today's exporters write them: Ks is half of white for an
ordinary dielectric, F0 = 0.08 Ks, and Ns is 1000 (1 - roughness)^2. `illum` 0 and 1 mean that there
is no highlight.
"""

import dataclasses
import re
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.material import RGB, WHITE, Slot, SourceMaterial
from pipeline.foreign.material_files import MaterialFiles, libraries_of, map_words
from pipeline.foreign.picture import Picture
from storage.errors import Rejected

_F0_OF_KS = 0.08
_MOST_NS = 1000.0
_USEMTL = re.compile(rb"^[ \t]*usemtl[ \t]+([^\r\n]+)", re.MULTILINE)
_LIBRARY = "trilight.mtl"
_PHYSICAL = {"pm", "pr", "map_pm", "map_pr"}
"""What makes a material one of metal and roughness."""

Fields = dict[str, str]
Decode = Callable[[bytes, str], NDArray]


def obj_materials(
    data: bytes, files: MaterialFiles, decode: Decode, *, emission: bool = False
) -> dict[str, SourceMaterial]:
    """Return the materials that the faces of an OBJ use, by name; what they emit only if asked.

    Raises:
        Rejected: no_materials where it has none, materials_unreadable, or as reading a picture.
    """
    used = _used(data)
    libraries = libraries_of(data)
    if not used or not libraries:
        raise Rejected("no_materials", "the OBJ names no materials")
    known = {name: entry for library in libraries for name, entry in _entries(files.of(library))}
    missing = [name for name in used if name not in known]
    if missing:
        raise Rejected("materials_unreadable", f"no library has the material {missing[0]!r:.80}")
    reader = _Reader(files, decode)
    try:
        found = {name: reader.material(known[name]) for name in used}
        if emission:
            found = {name: reader.emitting(found[name], known[name]) for name in used}
        return found
    except ValueError as error:
        raise Rejected("materials_unreadable", f"the MTL is malformed ({error!s:.120})") from error


def bare_obj(data: bytes) -> tuple[bytes, dict[str, bytes]]:
    """Return the OBJ with a library that holds the names of its materials and nothing else."""
    names = "".join(f"newmtl {name}\n" for name in _used(data))
    return f"mtllib {_LIBRARY}\n".encode() + data, {_LIBRARY: names.encode()}


def _used(data: bytes) -> list[str]:
    names = (name.decode("utf-8", "replace").strip() for name in _USEMTL.findall(data))
    return list(dict.fromkeys(names))


def _entries(data: bytes) -> Iterator[tuple[str, Fields]]:
    fields: Fields = {}
    for line in data.decode("utf-8", "replace").splitlines():
        key, _, value = line.strip().partition(" ")
        if key.lower() == "newmtl":
            fields = {}
            yield value.strip(), fields
        elif key and not key.startswith("#"):
            fields[key.lower()] = value.strip()


class _Reader:
    """Makes materials of one MTL, each picture once."""

    def __init__(self, files: MaterialFiles, decode: Decode) -> None:
        self._files, self._decode = files, decode
        self._values: dict[str, NDArray] = {}

    def material(self, fields: Fields) -> SourceMaterial:
        lost = _lost(fields)
        base = self._slot(fields.get("map_kd"), is_srgb=True)
        base_rgb = WHITE if base is not None and "kd" not in fields else _rgb(fields, "kd", 0.8)
        if _PHYSICAL & set(fields):
            metallic, roughness = (self._slot(fields.get(name)) for name in ("map_pm", "map_pr"))
            return SourceMaterial(
                base_rgb=base_rgb,
                base=base,
                metallic=_number(fields, "pm", 0.0 if metallic is None else 1.0),
                metallic_map=metallic,
                roughness=_number(fields, "pr", 0.5 if roughness is None else 1.0),
                roughness_map=roughness,
                lost=lost,
            )
        shiny = fields.get("illum", "2") not in ("0", "1")
        smooth = np.sqrt(np.clip(_number(fields, "ns", 250.0), 0, _MOST_NS) / _MOST_NS)
        return SourceMaterial(
            base_rgb=base_rgb,
            base=base,
            roughness=float(1 - smooth),
            f0=_F0_OF_KS,
            specular_rgb=_rgb(fields, "ks", 0.5),
            specular_colour=self._slot(fields.get("map_ks"), is_srgb=True),
            specular_strength=float(shiny),
            lost=lost,
        )

    def emitting(self, found: SourceMaterial, fields: Fields) -> SourceMaterial:
        """Return a material with what it emits; a map alone is as it is."""
        picture = self._slot(fields.get("map_ke"), is_srgb=True)
        factor = _rgb(fields, "ke", 0.0 if picture is None else 1.0)
        red, green, blue = (max(value, 0.0) for value in factor)
        if picture is not None and not any(factor):  # as exporters write it that know maps alone
            red, green, blue = WHITE
        return dataclasses.replace(found, emission_rgb=(red, green, blue), emission=picture)

    def _slot(self, text: str | None, *, is_srgb: bool = False) -> Slot | None:
        if text is None:
            return None
        options, name = map_words(text)
        if name not in self._values:
            self._values[name] = self._decode(self._files.of(name), name)
        clamp = options.get("-clamp") == ["on"]
        picture = Picture(
            values=self._values[name],
            is_srgb=is_srgb and self._values[name].dtype != np.float16,  # floats are linear
            wrap=("clamp", "clamp") if clamp else ("repeat", "repeat"),
        )
        return Slot(
            picture=picture,
            turn=np.diag(_pair(options.get("-s"), 1.0)),
            shift=np.array(_pair(options.get("-o"), 0.0)),
        )


def _lost(fields: Fields) -> tuple[str, ...]:
    found = {
        "emission": any(_numbers(fields.get("ke", "0"))) or "map_ke" in fields,
        "normal map": bool({"norm", "bump", "map_bump", "disp"} & set(fields)),
        "transparency": _number(fields, "d", 1.0) < 1
        or _number(fields, "tr", 0.0) > 0
        or "map_d" in fields,
    }
    return tuple(word for word, is_there in found.items() if is_there)


def _rgb(fields: Fields, name: str, default: float) -> RGB:
    values = _numbers(fields.get(name, str(default)))
    if len(values) == 1:
        values = values * 3
    if len(values) != 3:
        raise ValueError(f"{name} is {fields.get(name)!r:.60}; expected three numbers")
    return values[0], values[1], values[2]


def _number(fields: Fields, name: str, default: float) -> float:
    return _numbers(fields.get(name, str(default)))[0]


def _numbers(text: str) -> list[float]:
    values = [float(word) for word in text.split()]
    if not values or not np.isfinite(values).all():
        raise ValueError(f"{text!r:.60}; expected finite numbers")
    return values


def _pair(values: Sequence[str] | None, default: float) -> list[float]:
    found = [float(value) for value in values or ()][:2]
    return found + [default] * (2 - len(found))
