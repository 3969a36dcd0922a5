"""Writes one mesh in the dialects of OBJ, PLY, STL and OFF, by the formats' texts alone."""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Rng = Any
"""A `random.Random`, as hypothesis gives it."""


@dataclass(frozen=True)
class Polygons:
    """Simple polygons of any shape, each with its own vertices and color."""

    rings: list[NDArray[np.float64]]
    """[N, 3] each."""
    colors: list[tuple[int, int, int]]
    """8-bit sRGB, all different."""

    @property
    def points(self) -> NDArray[np.float64]:
        return np.concatenate(self.rings)

    @property
    def faces(self) -> list[list[int]]:
        ends = np.cumsum([len(ring) for ring in self.rings])
        return [
            list(range(end - len(ring), end)) for end, ring in zip(ends, self.rings, strict=True)
        ]

    @property
    def areas(self) -> list[float]:
        """Area of each polygon, by its vector sum."""
        return [
            float(np.linalg.norm(np.cross(ring, np.roll(ring, -1, 0)).sum(axis=0)) / 2)
            for ring in self.rings
        ]


def draw_polygons(rng: Rng, most: int = 9) -> Polygons:
    """Return star-shaped polygons, most of them not convex, in planes of any direction."""
    rings = []
    for _ in range(rng.randint(1, 6)):
        count = rng.randint(3, most)
        turn = 2 * np.pi * (np.arange(count) + [rng.uniform(-0.3, 0.3) for _ in range(count)])
        radius = np.array([rng.uniform(0.3, 2) for _ in range(count)])
        flat = np.column_stack([np.cos(turn / count), np.sin(turn / count)]) * radius[:, None]
        tilt, spin = rng.uniform(0, 3), rng.uniform(0, 6)
        along = np.array([np.cos(spin), np.sin(spin), 0])
        up = np.array([-np.sin(spin), np.cos(spin), 0]) * np.cos(tilt) + [0, 0, np.sin(tilt)]
        rings.append(flat @ np.stack([along, up]) + [rng.uniform(-9, 9) for _ in range(3)])
    single = [ring.astype(np.float32).astype(np.float64) for ring in rings]
    return Polygons(single, [(10 * row, 40, 200 - 10 * row) for row in range(len(rings))])


def _words(values: NDArray | list[float]) -> list[str]:
    return [repr(float(value)) for value in values]


def _ended(rng: Rng, lines: list[str]) -> str:
    return rng.choice(["\n", "\r\n", "\r"]).join([*lines, ""])


def write_obj(mesh: Polygons, rng: Rng) -> bytes:
    """Return an OBJ whose materials are called by the rows of its colors."""
    space, colored = rng.choice([" ", "\t", "  "]), rng.random() < 0.5
    form = rng.choice(["{v}", "{v}/{v}", "{v}//{n}", "{v}/{v}/{n}", "{v}/"])
    interleaved, wide = rng.random() < 0.5, rng.choice(["", "", "weight", "alpha"])
    lines, faces = ["# ends with \\", "mtllib m.mtl", "vn 0 0 1"], list[str]()
    for row, (ring, face) in enumerate(zip(mesh.rings, mesh.faces, strict=True)):
        for point in ring:
            more = [repr(code / 255) for code in mesh.colors[row]] if colored else []
            more = ["1.0", *more] if wide == "weight" else more
            more += ["1.0"] if wide == "alpha" and colored else []
            lines.append(space.join(["v", *_words(point), *more]))
            lines.append(space.join(["vt", *_words(point[:2])]))
        total = sum(len(other) for other in mesh.rings[: row + 1])
        before = total if interleaved else len(mesh.points)
        signed = [i - before if rng.random() < 0.5 else i + 1 for i in face]
        normal = rng.choice([1, -1])
        corners = [form.format(v=v, n=normal) for v in signed]
        told = [f"usemtl{space}größe {row}", f"g{space}a b", f"s{space}off"]
        corners[1] += f"{space}\\\n" if rng.random() < 0.3 else ""
        told.append(space * rng.randint(0, 2) + space.join(["f", *corners]))
        (lines if interleaved else faces).extend(told)
    lines = [line + (" # x" if rng.random() < 0.2 and line[0] == "v" else "") for line in lines]
    text = _ended(rng, ["", "", *lines, *faces]).replace("\\\n", "\\" + rng.choice(["\n", "\r\n"]))
    return text.encode(rng.choice(["utf-8", "utf-8-sig", "latin-1", "utf-16"]))


_NAMES = {
    "f": ["float", "float32"], "d": ["double", "float64"], "i": ["int", "int32"],
    "I": ["uint", "uint32"], "B": ["uchar", "uint8"], "H": ["ushort", "uint16"],
}  # fmt: skip


def write_ply(mesh: Polygons, rng: Rng) -> bytes:
    """Return a PLY with colors of its vertices or faces."""
    form = rng.choice(["ascii", "binary_little_endian", "binary_big_endian"])
    order = "<" if form == "binary_little_endian" else ">"
    kind, code = rng.choice("fd"), rng.choice("BHf")
    scale = {"B": 1, "H": 257, "f": 1 / 255}[code]
    names = rng.choice([("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue")])
    of_faces, count_kind, index_kind = rng.random() < 0.5, rng.choice("BHi"), rng.choice("iI")
    colors = [
        [(code, name, value * scale) for name, value in zip(names, rgb, strict=True)]
        for rgb in mesh.colors
    ]
    owner = [row for row, ring in enumerate(mesh.rings) for _ in ring]
    vertices = []
    for point, row in zip(mesh.points, owner, strict=True):
        named = [(kind, name, value) for name, value in zip("xyz", point, strict=True)]
        vertices.append([("B", "quality", 7), *named, *([] if of_faces else colors[row])])
    shuffled = rng.sample(range(len(vertices[0])), len(vertices[0]))
    vertices = [[entry[i] for i in shuffled] for entry in vertices]
    faces: list[list[Any]] = [
        [("B", "flags", 1), (f"{count_kind}{index_kind}", "vertex_indices", face)]
        + (colors[row] if of_faces else [])
        for row, face in enumerate(mesh.faces)
    ]
    elements: list[tuple[str, list[list[Any]]]] = [
        ("vertex", vertices),
        ("face", faces),
        ("edge", [[("i", "a", 0)], [("i", "a", 1)]]),
    ]
    rng.shuffle(elements)
    head = ["ply", f"format {form} 1.0", "comment end_header property", "obj_info 1"]
    body, text = b"", []
    for name, rows in elements:
        head.append(f"element {name} {len(rows)}")
        for types, label, _ in rows[0]:
            said = [rng.choice(_NAMES[one]) for one in types]
            head.append(f"property {'list ' if len(said) == 2 else ''}{' '.join(said)} {label}")
        for entry in rows:
            for types, _, value in entry:
                values = value if isinstance(value, list) else [value]
                if len(types) == 2:
                    body += struct.pack(order + types[0], len(values))
                    text.append(str(len(values)))
                exact = values if types[-1] in "fd" else [round(one) for one in values]
                body += struct.pack(f"{order}{len(values)}{types[-1]}", *exact)
                text += map(repr, [float(v) for v in exact] if types[-1] in "fd" else exact)
            text.append("\n")
    header = rng.choice(["\n", "\r\n"]).join([*head, "end_header", ""]).encode()
    return header + (" ".join(text).encode() if form == "ascii" else body)


def write_stl(mesh: Polygons, rng: Rng) -> bytes:
    """Return an STL of triangles, as text or binary."""
    if rng.random() < 0.3:
        facets = [struct.pack("<12fH", 0, 0, 0, *ring.ravel(), 0) for ring in mesh.rings]
        return b"solid".ljust(80) + struct.pack("<I", len(facets)) + b"".join(facets)
    space = rng.choice([" ", "\n", "\t\t", " \r\n "])
    case = rng.choice([str.upper, str.lower, str.title])
    text = "solid facet endsolid vertex outer loop\n"
    for row, ring in enumerate(mesh.rings):
        words = ["facet", "normal", "nan", "0", "-1e0", "outer", "loop"]
        words += [word for point in ring for word in ("vertex", *_words(point))]
        text += space.join(map(case, [*words, "endloop", "endfacet"])) + rng.choice([" ", "\n"])
        if row == 0:
            text += "endsolid facet\nsolid endfacet loop\n"
    return (text + rng.choice(["endsolid", "endsolid facet normal\n"])).encode()


def write_off(mesh: Polygons, rng: Rng) -> bytes:
    """Return an OFF with colors of its vertices or faces."""
    kind = rng.choice(["", "C", "N", "CN", "ST", "4", "STC"])
    lines, floats = [], rng.random() < 0.5
    owner = [row for row, ring in enumerate(mesh.rings) for _ in ring]

    def color(row: int) -> list[str]:
        return [repr(code / 255) if floats else str(code) for code in mesh.colors[row]]

    for point, row in zip(mesh.points, owner, strict=True):
        words = [*_words(point * (2 if "4" in kind else 1)), *(["2.0"] if "4" in kind else [])]
        words += ["0", "0", "1"] if "N" in kind else []
        words += [*color(row), "1" if floats else "255"] if "C" in kind else []
        lines.append(" ".join([*words, *(["0.5", "0.5"] if "ST" in kind else [])]))
    for row, face in enumerate(mesh.faces):
        more = [] if "C" in kind else color(row)
        lines.append(" ".join([str(len(face)), *map(str, face), *more]))
    counts = f"{len(mesh.points)} {len(mesh.rings)} 0"
    begin = rng.choice([f"{kind}OFF{counts}", f"{kind}OFF {counts}", f"{kind}OFF # x\n\n{counts}"])
    told = [line + (" # 9" if rng.random() < 0.2 else "") for line in lines]
    return _ended(rng, [*begin.split("\n"), "# 1 2 3", *told]).encode()


WRITERS: dict[str, Callable[[Polygons, Rng], bytes]] = {
    "obj": write_obj, "ply": write_ply, "stl": write_stl, "off": write_off,
}  # fmt: skip
