"""Files of somebody who means harm: they lead out, multiply, contradict themselves, and claim.

Every function of cases yields a name, what writes the file, and what has to come of it: `any`, or
`read`, `refused` or `ended`, with words of what is said behind a colon.
"""

import io
import json
import operator
import os
import socket
import struct
import tarfile
import zipfile
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pipeline.exchange.renderformer_h5 import write_renderformer_h5
from pipeline.exchange.renderformer_json import write_renderformer_json
from storage.records.sample import encode_sample
from storage.records.scene_file import encode_scene
from tests.scenes_by_hand import tiny_sample, tiny_scene

HEAD = "#usda 1.0\n"
SEEN = """
def SphereLight "lamp" {
    float inputs:radius = 0.2
    float inputs:intensity = 5
    double3 xformOp:translate = (0, 0, 3)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
def Mesh "floor" (prepend apiSchemas = ["MaterialBindingAPI"]) {
    rel material:binding = </m>
    point3f[] points = [(-1, -1, 0), (1, -1, 0), (0, 1, 0)]
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
    texCoord2f[] primvars:st = [(0, 0), (1, 0), (0, 1)] (interpolation = "vertex")
}
"""
"""What makes a scene, so that nothing but the harm is a reason to refuse."""
UNDIVIDED = 'uniform token subdivisionScheme = "none"'

LEAK = """
def Mesh "LEAK" {
    point3f[] points = [(777, 0, 0), (778, 0, 0), (777, 1, 0)]
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
}
"""
SECRET = f'{HEAD}def "B" {{{LEAK}}}\ndef "A" {{\ndef "LEAK" {{{LEAK}}}\n}}\n'
"""A file outside of the folder."""

MATERIAL = """
def Material "m" {
    token outputs:surface.connect = </m/p.outputs:surface>
    def Shader "p" {
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor.connect = </m/t.outputs:rgb>
        token outputs:surface
    }
    def Shader "t" {
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @FILE@
        token inputs:sourceColorSpace = "raw"
        float2 inputs:st.connect = </m/r.outputs:result>
        float3 outputs:rgb
    }
    def Shader "r" {
        uniform token info:id = "UsdPrimvarReader_float2"
        string inputs:varname = "st"
        float2 outputs:result
    }
}
"""

Make = Callable[[Path], object]


def text(body: str, seen: str = SEEN, head: str = HEAD) -> Make:
    """Return what writes a stage that may name OUT and PICTURE, the files outside."""

    def make(folder: Path) -> None:
        outside = folder.parent / "outside"
        named = body.replace("PICTURE", str(outside / "secret.png"))
        whole = head + seen + named
        (folder / "s.usda").write_text(whole.replace("OUT", str(outside / "secret.usda")))

    return make


def with_file(name: str, content: str, body: str) -> Make:
    def make(folder: Path) -> None:
        text(content, seen="")(folder)
        (folder / "s.usda").rename(folder / name)
        text(body)(folder)

    return make


def textured(
    spoil: Callable[[Path], object], named: str = "./t.png", head: str = HEAD, seen: str = SEEN
) -> Make:
    def make(folder: Path) -> None:
        spoil(folder / "t.png")
        text(MATERIAL.replace("FILE", named), seen, head)(folder)

    return make


def _png(path: Path, size: tuple[int, int] = (4, 4)) -> None:
    Image.fromarray(np.zeros((*size, 3), np.uint8)).save(path, "PNG")


def _socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as bound:
        bound.bind(str(path))


def leaks() -> Iterator[tuple[str, Make, str]]:
    """Yield what leads out: by every arc, from every place, named in every way."""
    arcs = {
        "reference": 'def "x" (references = @N@</B>) {}',
        "payload": 'def "x" (payload = @N@</B>) {}',
        "prepended": 'def "x" (prepend references = @N@</B>) {}',
        "appended": 'def "x" (append references = @N@</B>) {}',
        "added": 'def "x" (add references = @N@</B>) {}',
        "of an over": 'over "x" (references = @N@</B>) {}',
        "inactive": 'def "x" (active = false\nreferences = @N@</B>) {}',
        "in a variant": 'def "x" (variants = {string v = "a"}\nvariantSets = "v") {\n'
        'variantSet "v" = {\n"a" (references = @N@</B>) {}\n}\n}',
        "of an ancestor": 'def "Y" (references = @N@</A>) {}\ndef "x" (references = </Y/LEAK>) {}',
        "of a class": 'class "_c" (references = @N@</B>) {}\ndef "x" (inherits = </_c>) {}',
        "of a base": 'def "b" (references = @N@</B>) {}\ndef "x" (specializes = </b>) {}',
        "of a prototype": 'def "b" (references = @N@</B>) {}\n'
        'def "x" (instanceable = true\nreferences = </b>) {}',
        "default prim": 'def "x" (references = @N@) {}',
        "with arguments": 'def "x" (references = @N:SDF_FORMAT_ARGS:a=1@</B>) {}',
    }
    outside, fetched = "refused: which is outside of its folder", "refused: nothing is fetched"
    names = {
        "absolute": ("OUT", outside),
        "upwards": ("../outside/secret.usda", outside),
        "by a link": ("./link.usda", outside),
        "by a linked folder": ("./linked/secret.usda", outside),
        "by an expression": ('`"${X}"`', "refused: a variable expression; expected a name"),
        "as a URL": ("file:OUT", fetched),
        "of a server": ("https://x.y/z.usda", fetched),
    }
    head = '#usda 1.0\n(expressionVariables = {string X = "../outside/secret.usda"})\n'
    for arc, body in arcs.items():
        for kind, (name, said) in names.items():
            said = "refused: arguments for its file" if arc == "with arguments" else said
            yield f"{arc} {kind}", text(body.replace("N", name), head=head), said
    for kind, (name, said) in names.items():
        sub = '#usda 1.0\n(expressionVariables = {string X = "../outside/secret.usda"}\n'
        yield f"sublayer {kind}", text("", head=f"{sub}subLayers = [@{name}@])\n"), said
        deep = f'def "A" (references = @{name}@</A>) {{\ndef "LEAK" {{}}\n}}'
        far = with_file("lib.usda", deep, 'def "x" (references = @./lib.usda@</A/LEAK>) {}')
        yield f"of another file's ancestor {kind}", far, said
        picture = name.replace("secret.usda", "secret.png").replace("OUT", "PICTURE")
        variable = head.replace("secret.usda", "secret.png")
        yield f"texture {kind}", textured(_png, picture, variable), "refused"
    clip = 'def "A" (clips = {dictionary default = {asset[] assetPaths = [@OUT@]}}) {}'
    yield "value clips", text(clip), "refused: uses value clips"


def packages() -> Iterator[tuple[str, Make, str]]:
    def package(members: dict[str, str], **options: int) -> Make:
        def make(folder: Path) -> None:
            outside = str(folder.parent / "outside" / "secret.usda")
            with zipfile.ZipFile(folder / "s.usdz", "w") as archive:
                for name, content in members.items():
                    archive.writestr(name, content.replace("OUT", outside), **options)

        return make

    root = f"{HEAD}{SEEN}"
    library = f'{HEAD}def "L" (references = @OUT@</B>) {{}}'
    arcs = {
        "absolute": f'{root}def "x" (references = @OUT@</B>) {{}}',
        "upwards": f'{root}def "x" (references = @../outside/secret.usda@</B>) {{}}',
        "of another layer": f'{root}def "x" (references = @./lib.usda@</L>) {{}}',
        "ancestral": f'{root}def "Y" (references = @OUT@</A>) {{}}\n'
        'def "x" (references = </Y/LEAK>) {}',
        "texture": root + MATERIAL.replace("FILE", "../outside/secret.png"),
    }
    for kind, content in arcs.items():
        # what leads out of an archive is not in it
        ended = "read" if kind in ("upwards", "texture") else "refused"
        yield f"usdz {kind}", package({"s.usda": content, "lib.usda": library}), ended
    packed = package({"s.usda": root * 99}, compress_type=zipfile.ZIP_DEFLATED)
    yield "usdz compressed", packed, "refused"
    yield "usdz with a path out", package({"s.usda": root, "../x.usda": root}), "refused"
    yield "usdz with an absolute path", package({"s.usda": root, "/x.usda": root}), "refused"
    yield "usdz without a layer", package({"readme.txt": "x"}), "refused"
    yield "usdz of nothing", package({}), "refused"
    yield "usdz as it should be", package({"s.usda": root}), "any"


def chain(length: int) -> str:
    """Return prims of which each refers to the next one."""
    return "".join(f'def "L{i}" (references = </L{i + 1}>) {{}}\n' for i in range(length))


def paired_arcs(levels: int) -> str:
    """Return two prims a level, each of which refers to both of the next level."""
    pair = "(references = [</A{0}>, </B{0}>]) {{}}\n"
    arcs = [pair.format(level) for level in range(1, levels + 1)]
    return "".join(f'def "{name}{i}" {arc}' for i, arc in enumerate(arcs) for name in "AB")


def bombs() -> Iterator[tuple[str, Make, str]]:
    doubled = "".join(
        f'def "L{i}" {{\ndef "a" (ARC = </L{i + 1}>) {{}}\ndef "b" (ARC = </L{i + 1}>) {{}}\n}}\n'
        for i in range(40)
    )
    too_many = "refused: composes more than 2000 prims"
    for arc in ("references", "payload", "inherits", "specializes"):
        yield f"2^40 prims by {arc}", text(doubled.replace("ARC", arc)), too_many
    tenfold = "".join(f'def "c{j}" (references = </L{{0}}>) {{{{}}}}\n' for j in range(10))
    tens = "".join(f'def "L{i}" {{\n{tenfold.format(i + 1)}}}\n' for i in range(12))
    heir = 'def "A" (references = @./lib.usda@</A>) {}\nclass "_c" (references = </L0>) {}\n'
    of_class = with_file("lib.usda", 'class "_c" {}\ndef "A" (inherits = </_c>) {}', heir + tens)
    yield "10^12 prims by a class that its heir brings", of_class, too_many
    inner = "".join(
        f'def "L{i}" (references = </L{i + 1}>) {{\ndef "in" {{\n'
        f'def "a" (references = </L{i + 1}/in>) {{}}\n'
        f'def "b" (references = </L{i + 1}/in>) {{}}\n}}\n}}\n'
        for i in range(40)
    )
    yield "2^40 prims by ancestors", text(inner), "refused"
    instanced = doubled.replace("ARC", "instanceable = true\nreferences") + 'def Mesh "L40" {}'
    yield "2^40 instances", text(instanced), "refused"
    slow = "refused: processor seconds to compose and more follow"
    yield "a chain of 2100", text(chain(2100)), slow
    yield "2^30 sites in one prim", text(paired_arcs(30)), "refused"
    for deep in (200, 100_000):
        nested = text('def "a" {\n' * deep + "}\n" * deep)
        # USD's parser calls itself at every level, and crashes: that costs the child
        said = "refused: nested more than 150 deep" if deep < 1000 else "ended"
        yield f"{deep} prims deep", nested, said
    many, places = "0, " * 2001, "(0, 0, 0), " * 2001
    instancer = (
        'def PointInstancer "i" {\nrel prototypes = </floor>\n'
        f"int[] protoIndices = [{many}]\npoint3f[] positions = [{places}]\n}}"
    )
    yield "2001 instances", text(instancer), "refused"
    own = 'def PointInstancer "i" {\nrel prototypes = </i>\nint[] protoIndices = [0]\n'
    yield "an instancer of itself", text(own + "point3f[] positions = [(0, 0, 0)]\n}"), "refused"
    for end in ("1e18", "inf", "nan"):
        head = f"#usda 1.0\n(startTimeCode = 0\nendTimeCode = {end})\n"
        still, moving = "intensity = 5", "intensity.timeSamples = {0: 1, 1: 2}"
        yield f"time codes to {end}", text("", SEEN.replace(still, moving), head), "refused"


def circles() -> Iterator[tuple[str, Make, str]]:
    pairs = {
        "itself": 'def "x" (references = </x>) {}',
        "its file": 'def "x" (references = @./s.usda@</x>) {}',
        "each other": 'def "x" (references = </y>) {}\ndef "y" (references = </x>) {}',
        "its parent": 'def "x" {\ndef "y" (inherits = </x>) {}\n}',
    }
    for kind, body in pairs.items():
        yield f"circle: {kind}", text(body), "refused: refers to itself in a circle"
    yield "sublayer of itself", text("", head="#usda 1.0\n(subLayers = [@./s.usda@])\n"), "refused"


def odd_files() -> Iterator[tuple[str, Make, str]]:
    kinds: dict[str, Callable[[Path], object]] = {
        "fifo": os.mkfifo,
        "socket": _socket,
        "folder": lambda path: path.mkdir(),
        "device": lambda path: path.symlink_to("/dev/zero"),
        "link to itself": lambda path: path.symlink_to(path.name),
    }
    for kind, make_odd in kinds.items():
        said = "refused" if kind in ("device", "link to itself") else "refused: is no plain file"

        def layer(folder: Path, make_odd: Callable[[Path], object] = make_odd) -> None:
            make_odd(folder / "odd.usda")
            text('def "x" (references = @./odd.usda@</A>) {}')(folder)

        yield f"layer is a {kind}", layer, said
        yield f"texture is a {kind}", textured(make_odd), said
    header = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"
    for kind, data in (("empty", b""), ("cut", header), ("noise", bytes(range(256)) * 9)):
        yield f"texture is {kind}", textured(partial(Path.write_bytes, data=data)), "read"
    yield "texture of too many pixels", textured(lambda p: _png(p, (1100, 1100))), "any"
    yield "a layer that is missing", text('def "x" (references = @./no.usda@</A>) {}'), "read"
    other = with_file("x.png", "", 'def "x" (references = @./x.png@</A>) {}')
    yield "a layer of another kind", other, "read"


def contradictions() -> Iterator[tuple[str, Make, str]]:
    points, counts, indices, coordinates = SEEN.splitlines()[9:13]
    moved = "    double3 xformOp:translate = (0, 0, 3)"
    values = {
        "points NaN": (points, "point3f[] points = [(nan, 0, 0), (1, 0, 0), (0, 1, 0)]"),
        "points 1e38": (points, "point3f[] points = [(1e38, 0, 0), (1, 0, 0), (0, 1, 0)]"),
        "points of text": (points, 'string points = "x"'),
        "no points": (points, ""),
        "indices beyond": (indices, "int[] faceVertexIndices = [0, 1, 2147483647]"),
        "indices negative": (indices, "int[] faceVertexIndices = [0, 1, -1]"),
        "counts negative": (counts, "int[] faceVertexCounts = [-3]"),
        "counts huge": (counts, "int[] faceVertexCounts = [2147483647]"),
        "place NaN": (moved, "double3 xformOp:translate = (nan, 0, 0)"),
        "place 1e300": (moved, "double3 xformOp:translate = (1e300, 0, 0)"),
        "intensity NaN": ("inputs:intensity = 5", "inputs:intensity = nan"),
        "intensity infinite": ("inputs:intensity = 5", "inputs:intensity = inf"),
        "intensity negative": ("inputs:intensity = 5", "inputs:intensity = -1"),
        "intensity 1e38": ("inputs:intensity = 5", "inputs:intensity = 1e38"),
        "radius 1e38": ("inputs:radius = 0.2", "inputs:radius = 1e38"),
        "radius NaN": ("inputs:radius = 0.2", "inputs:radius = nan"),
        # A layer may call an attribute of a schema by any type; so may one that a person wrote.
        "points of doubles": (points, "double[] points = [1, 2]"),
        "counts of tokens": (counts, 'token[] faceVertexCounts = ["a"]'),
        "indices of floats": (indices, "float[] faceVertexIndices = [nan]"),
        "normals of text": (points, f'{points}\n{UNDIVIDED}\nstring[] normals = ["a"]'),
        "intensities": ("float inputs:intensity = 5", "float[] inputs:intensity = [1, 2]"),
        "exposure 1e9": (moved, f"{moved}\nfloat inputs:exposure = 1e9"),
    }
    words = {
        "points NaN": "refused: points are not finite",
        "indices beyond": "refused: go from 0 to 2147483647; expected 0 to 2",
        "counts negative": "refused: add up to -3; expected 3",
    }
    for kind, (old, new) in values.items():
        assert old in SEEN
        changed = text("", seen=SEEN.replace(old, new))
        yield f"mesh or light with {kind}", changed, words.get(kind, "any")
    many = 'def PointInstancer "i" {\nrel prototypes = </floor>\npoint3f[] positions = [(0, 0, 0)]'
    yield "instances of text", text(f'{many}\nstring[] protoIndices = ["a"]\n}}'), "any"
    yield "more instances than places", text(f"{many}\nint[] protoIndices = [0, 0]\n}}"), "any"
    yield "a lens NaN", text('def Camera "c" {\nfloat focalLength = nan\n}'), "any"
    of_number = SEEN.replace(coordinates, "int primvars:st = 3")
    yield "coordinates of a number", textured(_png, seen=of_number), "any"
    rough = MATERIAL.replace("  color3f", '  string inputs:roughness = "smooth"\n    color3f')
    yield "roughness of text", text(rough.replace("FILE", "./no.png")), "any"
    for kind, body in {"no prim": "", "half a prim": 'def "x" {', "zeros": "\0" * 99}.items():
        head = "" if kind == "zeros" else HEAD
        said = "refused" if kind == "no prim" else "refused: not readable as USD"
        yield f"text: {kind}", text(body, seen="", head=head), said


def usd_cases() -> Iterator[tuple[str, Make, str]]:
    for group in (leaks, packages, bombs, circles, odd_files, contradictions):
        yield from group()


def _sparse(path: Path) -> None:
    """Make a file of 8 TB that takes no room."""
    path.touch()
    os.truncate(path, 8 << 40)


def _bytes(name: str, data: bytes) -> Make:
    return lambda folder: (folder / name).write_bytes(data)


def _safetensors(change: Callable[[bytes], bytes]) -> Make:
    return lambda folder: (folder / "s.safetensors").write_bytes(change(encode_scene(tiny_scene())))


def _header(change: Callable[[dict[str, Any]], Any]) -> Make:
    def changed(data: bytes) -> bytes:
        length = int.from_bytes(data[:8], "little")
        header = json.loads(data[8 : 8 + length])
        change(header)
        text = json.dumps(header).encode()
        return struct.pack("<Q", len(text)) + text + data[8 + length :]

    return _safetensors(changed)


def _claim(field: str, value: Any) -> Make:
    return _header(lambda header: header["faces"].update({field: value}))


def _cut(part: float) -> Make:
    return _safetensors(lambda data: data[: int(len(data) * part)])


def safetensors_cases() -> Iterator[tuple[str, Make, str]]:
    """Yield name, what writes `s.safetensors`; values and metadata are those of test_scene.py."""
    for shape in ([2**62, 3], [-1, 3], [10**9, 3], "x", None, [3.5, 3], [[1], 3]):
        yield f"shape {shape}", _claim("shape", shape), "refused"
    for offsets in ([0, 2**60], [-5, 9], [9, 0], "x", [0]):
        yield f"offsets {offsets}", _claim("data_offsets", offsets), "refused"
    yield "no metadata", _header(lambda header: header.pop("__metadata__")), "refused"
    for kind, data in {
        "empty": b"", "8 bytes": b"\xff" * 8, "a header of 2^63": struct.pack("<Q", 2**63) + b"{}",
        "noise": bytes(range(256)) * 9, "a deep header": struct.pack("<Q", 10**6) + b"[" * 10**6,
    }.items():  # fmt: skip
        yield f"safetensors is {kind}", _bytes("s.safetensors", data), "refused"
    for part in (0.1, 0.5, 0.99):
        yield f"cut at {part}", _cut(part), "refused"
    yield "bytes too many", _safetensors(lambda d: d + b"x"), "refused"
    yield "safetensors is a fifo", lambda f: os.mkfifo(f / "s.safetensors"), "refused"
    yield "safetensors of 8 TB", lambda f: _sparse(f / "s.safetensors"), "refused"


def h5_cases() -> Iterator[tuple[str, Make, str]]:
    """Yield name, what writes `s.h5`, and what comes of it; test_renderformer_h5.py has more."""
    yield "HDF5 is noise", _bytes("s.h5", bytes(range(256)) * 99), "refused"
    for seed in range(8):

        def flipped(folder: Path, seed: int = seed) -> None:
            write_renderformer_h5(folder / "s.h5", tiny_scene())
            data = np.frombuffer((folder / "s.h5").read_bytes(), np.uint8).copy()
            rng = np.random.default_rng(seed)
            data[rng.integers(0, len(data), 20)] = rng.integers(0, 256, 20)
            (folder / "s.h5").write_bytes(data[: len(data) - seed * 500].tobytes())

        yield f"HDF5 damaged {seed}", flipped, "any"
    yield "HDF5 is a fifo", lambda folder: os.mkfifo(folder / "s.h5"), "refused"


LEAK_OBJ = "v 777 0 0\nv 778 0 0\nv 777 1 0\nf 1 2 3\n"


def _changed(*where: Any, value: Any) -> Make:
    """Return what writes the scene with one field changed; ANY is the first name of a group."""

    def make(folder: Path) -> None:
        write_renderformer_json(folder / "s.json", tiny_scene())
        at = scene = json.loads((folder / "s.json").read_bytes())
        for key in where[:-1]:
            at = at[next(iter(at)) if key == "ANY" else key]
        at[where[-1]] = value
        (folder / "s.json").write_text(json.dumps(scene))

    return make


def _mesh(spoil: Callable[[Path], object]) -> Make:
    def make(folder: Path) -> None:
        spoil(folder / "odd.obj")
        _changed("objects", "ANY", "mesh_path", value="odd.obj")(folder)

    return make


def json_cases() -> Iterator[tuple[str, Make, str]]:
    """Yield name, what writes `s.json`, what comes of it; test_renderformer_json.py has more."""
    mesh = ("objects", "ANY", "mesh_path")
    outside: tuple[Any, ...] = (
        "../outside/secret.obj", "/etc/passwd", "linked/secret.obj", "link.obj", "", ".", "..",
        "objects/../../outside/secret.obj",
    )  # fmt: skip
    others: tuple[Any, ...] = (
        "objects", "no.obj", "x\0y", "a" * 5000, "https://x.y/z.obj", "file:///etc/passwd",
        "~/x.obj", "s.json", 3, None, [], {},
    )  # fmt: skip
    for value in (*outside, *others):
        said = "refused: mesh_path is {value}, which leads out" if value in outside else "refused"
        yield f"mesh {str(value)[:30]!r}", _changed(*mesh, value=value), said.format(value=value)
    kinds: dict[str, Callable[[Path], object]] = {
        "fifo": os.mkfifo,
        "device": lambda path: path.symlink_to("/dev/zero"),
        "folder": lambda path: path.mkdir(),
        "empty": lambda path: path.touch(),
        "noise": lambda path: path.write_bytes(bytes(range(256)) * 99),
        "NaN": lambda path: path.write_text("v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
        "beyond": lambda path: path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99\n"),
        "8 TB": _sparse,
    }
    for kind, spoil in kinds.items():
        said = "refused: is not a regular file" if kind in ("fifo", "folder") else "refused"
        yield f"mesh is {kind}", _mesh(spoil), said
    over = _changed("objects", "ANY", "material", "specular", value=[0.9] * 3)
    yield "diffuse and specular", over, "any"
    bright = _changed("objects", "ANY", "material", "emissive", value=[1e9] * 3)
    yield "emission 1e9", bright, "any"
    same = _changed("cameras", 0, "position", value=[0, 0, 0])
    yield "a camera that looks at itself", same, "any"
    yield "no cameras", _changed("cameras", value=[]), "any"
    yield "a field that is not known", _changed("script", value="rm -rf"), "read"
    remesh = _changed("objects", "ANY", "remesh_target_face_num", value=10**9)
    yield "remeshed to 10^9 faces", remesh, "refused"
    for kind, data in {"noise": bytes(range(256)), "cut": b'{"scene_name": "x"'}.items():
        yield f"JSON is {kind}", _bytes("s.json", data), "refused"
    fifo = "refused: cannot be read (not a plain file)"
    yield "JSON is a fifo", lambda folder: os.mkfifo(folder / "s.json"), fifo
    yield "JSON is endless", lambda f: (f / "s.json").symlink_to("/dev/zero"), "refused"
    yield "JSON of 8 TB", lambda folder: _sparse(folder / "s.json"), "refused"


KEY = "000000003"


def _members() -> dict[str, bytes]:
    return {f"{KEY}.{suffix}": data for suffix, data in encode_sample(tiny_sample(KEY)).items()}


def tar_of(members: Iterable[tuple[str, bytes]]) -> bytes:
    """Return a shard of these members, of which several may have one name."""
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w", format=tarfile.USTAR_FORMAT) as archive:
        for name, data in members:
            entry = tarfile.TarInfo(name)
            entry.size = len(data)
            archive.addfile(entry, io.BytesIO(data))
    return stream.getvalue()


def _tar(change: Callable[[bytes], bytes]) -> Make:
    return lambda folder: (folder / "s.tar").write_bytes(change(tar_of(_members().items())))


def _sample(**changes: bytes | None) -> Make:
    """Return what writes the sample with members changed, or without those that are None."""

    def make(folder: Path) -> None:
        members = _members()
        for suffix, data in changes.items():
            name = f"{KEY}.{suffix.replace('_', '.')}"
            if data is None:
                members.pop(name)
            else:
                members[name] = data
        (folder / "s.tar").write_bytes(tar_of(members.items()))

    return make


def _with_entry(**fields: Any) -> Make:
    """Return what writes a shard with one member of another kind in front."""

    def make(folder: Path) -> None:
        stream = io.BytesIO()
        with tarfile.open(fileobj=stream, mode="w", format=fields.pop("format", 0)) as archive:
            entry = tarfile.TarInfo(fields.pop("name", f"{KEY}.x"))
            for name, value in fields.items():
                setattr(entry, name, value)
            archive.addfile(entry)
        head = stream.getvalue()[:512]
        (folder / "s.tar").write_bytes(head + tar_of(_members().items()))

    return make


def _field(start: int, end: int, text: bytes) -> Make:
    """Return what writes the shard with bytes of its first header changed, its sum made right."""

    def change(data: bytes) -> bytes:
        block = bytearray(data[:512])
        block[start:end] = text.ljust(end - start, b"\0")
        block[148:156] = b" " * 8
        block[148:156] = f"{sum(block):06o}\0 ".encode()
        return bytes(block) + data[512:]

    return _tar(change)


def tar_cases() -> Iterator[tuple[str, Make, str]]:
    """Yield name, what writes `s.tar`, and what has to come of its first sample."""
    for kind in "SYMTYPE LNKTYPE DIRTYPE FIFOTYPE CHRTYPE BLKTYPE CONTTYPE GNUTYPE_SPARSE".split():
        entry = {"type": getattr(tarfile, kind), "linkname": "/etc/passwd"}
        yield f"a member of type {kind}", _with_entry(**entry), "refused"
    for name in ("/etc/x", "../x", "a/../../x", "x", ".x", "a b.c", "ä.x", "a" * 99):
        yield f"a member named {name[:20]!r}", _with_entry(name=name), "refused"
    yield "a long name by pax", _with_entry(name="a" * 300, format=tarfile.PAX_FORMAT), "refused"
    yield "a long name by GNU", _with_entry(name="a" * 300, format=tarfile.GNU_FORMAT), "refused"
    for kind, size in {
        "2^33": b"77777777777", "negative": b"-0000000001", "binary": b"\x80" + b"\xff" * 11,
        "binary negative": b"\xff" * 12, "text": b"many", "nothing": b"",
    }.items():  # fmt: skip
        yield f"size of {kind}", _field(124, 136, size), "refused"
    yield "a wrong sum", _tar(lambda d: d[:148] + b"0000000\0" + d[156:]), "refused"
    for part in (0, 100, 512, 5000):
        yield f"cut at {part}", _tar(operator.itemgetter(slice(part))), "refused"
    yield "no end", _tar(lambda d: d.rstrip(b"\0")), "refused"
    yield "all twice", _tar(lambda d: d.rstrip(b"\0").ljust(-(-len(d) // 512) * 512) + d), "refused"
    yield "noise", _tar(lambda d: bytes(range(256)) * 99), "refused"
    yield "empty", _tar(lambda d: bytes(1024)), "refused"
    for kind, data in {
        "deep": b'{"schema_version": 3, "x": ' + b"[" * 10**6, "a list": b"[]", "empty": b"",
        "noise": bytes(range(256)), "of another version": b'{"schema_version": 99}',
        "short": b'{"schema_version": 3}',
        "odd": b'{"schema_version": 3, "views": [1], "objects": {}, "provenance": 0}',
    }.items():  # fmt: skip
        yield f"record is {kind}", _sample(json=data), "refused"
    yield "no record", _sample(json=None), "refused"
    yield "no arrays", _sample(scene_safetensors=None), "refused"
    yield "arrays are noise", _sample(scene_safetensors=bytes(range(256)) * 9), "refused"
    packed = _sample(scene_safetensors=None, scene_safetensors_gz=b"\x1f\x8b\x08" + bytes(99))
    yield "packed arrays are noise", packed, "refused"
    yield "shard is a fifo", lambda folder: os.mkfifo(folder / "s.tar"), "refused"
