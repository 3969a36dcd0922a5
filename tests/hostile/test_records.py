"""What records hold of failures: sentences of ours, equal in every run and on every machine."""

import ast
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.exchange.renderformer_json import read_renderformer_json
from pipeline.isolation.call_failures import ChildFailed
from pipeline.objects.maps.prepared import prepare_map
from storage.errors import Rejected, TrilightError
from storage.records.objects import SKY, TEXTURE
from tests.conftest import ROOT
from tests.for_each import case
from tests.pipeline.assets.meshes_by_hand import WRITERS, cube, prepare, write_glb
from tests.pipeline.assets.source_materials import textured_kit as kit
from tests.pipeline.assets.source_materials.textured_kit import textured_usd
from tests.pipeline.exchange.test_renderformer_json import changed

WHOLE = kit.picture_bytes(kit.CORNERS)
PICTURES = [
    *(
        b"",
        b"<html>",
        b"\xabKTX 20\xbb\r\n\x1a\n" + bytes(99),
        b"\x76\x2f\x31\x01",
        b"#?RADIANCE\n",
    ),
    *(WHOLE[:40], WHOLE[:20] + b"\xff" * 9 + WHOLE[29:], kit.picture_bytes(kit.CORNERS, "GIF")),
    *(kit.picture_bytes(kit.CORNERS, kind)[:-30] for kind in ("JPEG", "TIFF", "BMP", "WEBP")),
]
VALUES: list[Any] = [None, "x", float("nan"), 1e999, -1, 10**30, [], {"a": 1}, True]
USD = ["", "#usda 1.0\n(", '#usda 1.0\ndef Mesh "m" {', '#usda 1.0\ndef Mesh "m" { int x = 1.5.2 }',
       '#usda 1.0\ndef "a" (references = </b>) {}', '#usda 1.0\ndef "a" (references = </a/b>) {}',
       '#usda 1.0\ndef Mesh "m" { point3f[] points = [(nan, 0, 0)] }']  # fmt: skip
OWN = {"Rejected", "TrilightError", "ChildFailed", "Malformed", "OutsideFile", "UndeclaredColumn",
       "EnvironmentFailure", "TooLong", "NotAsDeclared"}  # fmt: skip


def _leaves(tree: Any, place: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    for key in tree if isinstance(tree, dict) else range(len(tree)):
        yield (*place, key)
        if isinstance(tree[key], dict | list):
            yield from _leaves(tree[key], (*place, key))


def _objects(folder: Path, rng: np.random.Generator) -> Iterator[Path]:
    for number, picture in enumerate(PICTURES):
        yield kit.textured_glb(folder / f"p{number}.glb", picture)
        yield kit.textured_obj(folder / f"o{number}" / "a.obj", picture)
        yield textured_usd(folder / f"u{number}" / "a.usda", picture)
    tree, buffer = kit.textured_tree(WHOLE)
    for number, place in enumerate(_leaves(tree)):
        bad = json.loads(json.dumps(tree))
        row = bad
        for key in place[:-1]:
            row = row[key]
        row[place[-1]] = VALUES[number % len(VALUES)]
        yield write_glb(folder / f"t{number}.glb", bad, buffer)
    for suffix, write in WRITERS.items():
        data = write(folder / f"whole{suffix}", cube()).read_bytes()
        for number in range(12):
            at = int(rng.integers(len(data)))
            path = folder / f"{number}{suffix}"
            path.write_bytes(data[:at] + rng.bytes(int(rng.integers(9))) + data[at + 3 :])
            yield path
    (folder / "a.gltf").write_bytes(b'{"asset": }')
    yield folder / "a.gltf"
    for number, statement in enumerate(("Kd red", "Pm", "Ks 1 2", "Ns 1e999", "map_Kd ../a.png")):
        yield kit.textured_obj(folder / f"m{number}" / "a.obj", WHOLE, f"{statement}\n")
    for number, text in enumerate(USD):
        (folder / f"{number}.usda").write_text(text)
        yield folder / f"{number}.usda"


def _refusals(folder: Path) -> Iterator[tuple[str, Exception]]:
    for path in _objects(folder, np.random.default_rng(0)):
        try:
            prepare(path, kit.REFUSE)
        except Rejected as refusal:
            yield path.name, refusal
    for number, picture in enumerate(PICTURES):
        (folder / "map").write_bytes(picture)
        for kind, part in ((TEXTURE, "base"), (SKY, "map")):
            with pytest.raises(Rejected) as caught:
                prepare_map(kind, {part: folder / "map"}, 8)
            yield f"{kind} {number}", caught.value
    text = changed()
    for at in range(0, len(text), 31):
        try:
            read_renderformer_json(text[:at] + b"\xff{1e999" + text[at + 2 :], "a.json")
        except TrilightError as refusal:
            yield f"scene {at}", refusal


def test_no_refusal_cites_a_library_an_address_or_this_machine(tmp_path: Path) -> None:
    runs: list[list[tuple[str, str]]] = []
    for name in ("one", "two"):
        folder = tmp_path / name
        folder.mkdir()
        runs.append([])
        for item, refusal in _refusals(folder):
            said = refusal.message if isinstance(refusal, Rejected) else str(refusal)
            runs[-1].append((item, said))
            with case((item, said)):
                assert not any(text in said for text in ("0x", str(folder), str(ROOT), "/lib/"))
                foreign = refusal.__cause__
                while foreign is not None:
                    text = " ".join(str(foreign).split())[:30]
                    is_own = isinstance(foreign, Rejected | TrilightError)
                    assert is_own or len(text) < 12 or text not in said
                    foreign = foreign.__cause__
    assert runs[0] == runs[1] and len(runs[0]) > 150
    failed = ChildFailed("exception", 'File "/a/b.py", line 3, in f | x | OSError: <a at 0x7f>')
    assert failed.sentence == "an unforeseen error (OSError); the log has it"


def test_no_handler_cites_what_a_library_raised() -> None:
    folders = ("foreign", "exchange", "objects/maps", "assets", "generation", "scenes")
    paths = [path for folder in folders for path in (ROOT / "pipeline" / folder).rglob("*.py")]
    cited = []
    for path in paths:
        for handler in ast.walk(ast.parse(path.read_text())):
            if isinstance(handler, ast.ExceptHandler) and handler.name and handler.type:
                kinds = {each.id for each in ast.walk(handler.type) if isinstance(each, ast.Name)}
                texts = [each for each in ast.walk(handler) if isinstance(each, ast.FormattedValue)]
                names = [text.value for text in texts if isinstance(text.value, ast.Name)]
                if not kinds <= OWN and any(name.id == handler.name for name in names):
                    cited.append(f"{path.relative_to(ROOT)}:{handler.lineno}")
    assert len(paths) > 100 and cited == []
