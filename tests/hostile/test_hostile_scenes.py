"""Every hostile scene file ends in seconds: in a line, or as a scene with nothing of the outside.

The files are read as `trilight convert` reads them, in a child with limits. Those of the child are
smaller here than for users, so that what is left at a limit is left in a second. What records hold
of failures are sentences of ours, equal in every run and on every machine. Pipes, devices and
folders under the names of our files are a sentence, at once.
"""

import ast
import json
import os
import signal
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from infra.judging import _read_picture
from model.weights import read_metadata, read_tensors
from pipeline.assets.prepare import prepare_asset
from pipeline.assets.settings import AssetSettings, OwnMaterialSettings
from pipeline.exchange.reader import load_source, scene_source, source_keys
from pipeline.exchange.renderformer_h5 import write_renderformer_h5
from pipeline.exchange.renderformer_json import read_renderformer_json
from pipeline.foreign.source_file import load_mesh, read_source
from pipeline.isolation import ChildFailed, ChildLimits, IsolatedChild
from pipeline.objects.local.folder import file_text
from pipeline.objects.maps.prepared import prepare_map
from storage.dataset.manifest import index_shard, read_head, read_manifest
from storage.errors import Rejected, TrilightError
from storage.records.objects import SKY, TEXTURE, read_failures, read_objects_lock
from storage.records.scene_file import read_scene_file
from tests.conftest import ROOT
from tests.for_each import case, with_folders
from tests.hostile import cases
from tests.pipeline.assets.meshes_by_hand import WRITERS, cube, prepare, write_glb
from tests.pipeline.assets.source_materials import textured_kit as kit
from tests.pipeline.assets.source_materials.textured_kit import textured_usd
from tests.pipeline.exchange.test_renderformer_json import changed
from tests.scenes_by_hand import tiny_scene
from train.folder import read_rows
from train.loop.checkpoints import read_checkpoint

LIMITS = ChildLimits(memory_bytes=8 << 30, wall_s=300, cpu_s=30, calls_per_child=1000)
CASES: dict[str, Callable[[], Iterator[tuple[str, cases.Make, str]]]] = {
    "usd": cases.usd_cases,
    "json": cases.json_cases,
    "safetensors": cases.safetensors_cases,
    "h5": cases.h5_cases,
    "tar": cases.tar_cases,
}
FILES = ("s.usda", "s.usdz", "s.json", "s.safetensors", "s.h5", "s.tar")


@dataclass(frozen=True)
class Outcome:
    """What came of a file; sent by the child."""

    said: str
    """All that a user would read."""
    farthest: float
    """Coordinate of the scene; that of the file outside is 777."""
    names: str
    """Of its objects."""


def smaller_limits() -> None:
    """Prepare a child."""
    from pipeline.exchange import gltf
    from pipeline.exchange.usd import foreign_scene, write_materials
    from pipeline.foreign.usd import placed, stage

    stage.MAX_PRIMS, stage.MAX_COMPOSITION_S = 2000, 0.3
    placed.MAX_PLACED = 2000
    gltf.MAX_PIXELS = foreign_scene.MAX_PIXELS = write_materials.MAX_PIXELS = 1 << 20


def outcome(path: str) -> Outcome:
    """Read the first scene of a file; only children come here."""
    source = scene_source(path, many=True)
    if source.path.suffix == ".tar":
        source = scene_source(f"{path}::{cases.KEY}")
    else:
        source_keys(source)
    found = load_source(source)
    found.scene.check()
    return Outcome(
        said=json.dumps(found.notes),
        farthest=float(np.abs(found.scene.vertex_positions).max()),
        names=" ".join(entry.name for entry in found.scene.objects),
    )


@pytest.fixture(scope="module")
def child() -> Iterator[IsolatedChild]:
    child = IsolatedChild(limits=LIMITS, factory=smaller_limits)
    yield child
    child.close()


@cache
def _secret_h5() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write_renderformer_h5(Path(folder) / "secret.h5", tiny_scene())
        return (Path(folder) / "secret.h5").read_bytes()


def lay_out(folder: Path) -> Path:
    """Make the folder of the file, and another beside it that nothing may read."""
    outside, inner = folder / "outside", folder / "inner"
    outside.mkdir()
    inner.mkdir()
    (outside / "secret.usda").write_text(cases.SECRET)
    (outside / "secret.obj").write_text(cases.LEAK_OBJ)
    Image.fromarray(np.full((4, 4, 3), 77, np.uint8)).save(outside / "secret.png")
    (outside / "secret.h5").write_bytes(_secret_h5())
    for suffix in ("usda", "obj"):
        (inner / f"link.{suffix}").symlink_to(outside / f"secret.{suffix}")
    (inner / "linked").symlink_to(outside)
    return inner


def read(
    child: IsolatedChild, folder: Path, make: cases.Make, look: Callable[[str], Outcome]
) -> tuple[str, Outcome]:
    """Return `read`, `refused` or `ended`, and what came of the file that is made."""
    inner = lay_out(folder)
    make(inner)
    (path,) = (
        inner / name for name in FILES if (inner / name).is_symlink() or (inner / name).exists()
    )
    ended, found = "read", Outcome(said="", farthest=0.0, names="")
    try:
        found = child.call(look, str(path))
    except (Rejected, TrilightError) as error:
        ended, found = "refused", Outcome(said=str(error), farthest=0.0, names="")
        assert isinstance(error, Rejected) or found.said.startswith((path.name, "sample"))
    except ChildFailed as failure:
        assert failure.reason != "exception", failure.message
        ended, found = "ended", Outcome(said=str(failure), farthest=0.0, names="")
    said = found.said.replace(str(folder / "outside"), "")  # which some of the files name
    assert found.said.isprintable() and str(folder) not in said, (path, found)
    return ended, found


@pytest.mark.parametrize("form", CASES)
def test_every_file_ends_well(tmp_path: Path, child: IsolatedChild, form: str) -> None:
    for folder, (name, make, expected) in with_folders(tmp_path, CASES[form]()):
        kind, found = read(child, folder, make, outcome)
        assert "LEAK" not in found.names and found.farthest != 778.0, name
        wanted, _, words = expected.partition(": ")
        assert kind in (("read", "refused") if wanted == "any" else (wanted,)), (name, found)
        assert words in found.said, (name, found)


SETTINGS = AssetSettings(
    max_instances=1000, own_materials=OwnMaterialSettings(keep=True, texels=8, max_pixels=1 << 16)
)
HARMLESS = ("place NaN", "intensity", "radius", "time codes", "place 1e300")
"""What is wrong with a lamp is nothing to an object."""


def object_outcome(path: str) -> Outcome:
    """Read an object with its materials; only children come here."""
    source = read_source(Path(path), SETTINGS.read_limits)
    farthest = float(np.abs(load_mesh(source).positions).max())
    attempt = prepare_asset(Path(path), SETTINGS, "meshoptimizer")
    materials = attempt.asset.materials
    assert materials is not None
    said = f"{materials.reason} {materials.message} {list(attempt.missed.values())}"
    return Outcome(said=said, farthest=farthest, names="")


@pytest.mark.slow("hostile")
def test_every_object_ends_well(tmp_path: Path, child: IsolatedChild) -> None:
    """The cases are those of scenes; there a missing part is noted, here it refuses the object."""
    for folder, (name, make, wanted) in with_folders(tmp_path, cases.usd_cases()):
        expected = wanted.partition(": ")[0]
        ended, found = read(child, folder, make, object_outcome)
        assert found.farthest < 700, (name, found)
        if name.startswith("texture ") and expected == "refused":
            assert ended == "read" and found.said.startswith("texture_"), (name, found)
        elif expected == "refused" and not any(word in name for word in HARMLESS):
            assert ended == "refused", (name, found)
        assert (ended == "ended") == (expected == "ended"), (name, found)


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
    assert len(paths) > 80 and cited == []


READERS: list[Callable[[Path], object]] = [
    *(lambda path: _read_picture(path, [4]), file_text, index_shard, read_checkpoint),
    *(read_failures, read_head, read_manifest, read_metadata, read_objects_lock, read_rows),
    *(read_scene_file, read_tensors),
]


def test_what_is_no_plain_file_is_refused_at_once(tmp_path: Path) -> None:
    pipe, device, folder = (tmp_path / f"train-00000{row}.safetensors" for row in range(3))
    os.mkfifo(pipe)
    device.symlink_to("/dev/zero")
    folder.mkdir()
    for path in (pipe, device, folder):
        for read in READERS:
            with case((read.__name__, path.name)):
                signal.alarm(10)  # a pipe would be waited for without end
                with pytest.raises((TrilightError, OSError), match="plain file|regular file"):
                    read(path)
                signal.alarm(0)
