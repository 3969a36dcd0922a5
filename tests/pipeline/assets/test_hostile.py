"""Nothing but the file itself is opened; odd names are names."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.assets.settings import AssetSettings
from tests.conftest import ROOT
from tests.pipeline.assets.meshes_by_hand import gltf_tree, knot, prepare, sphere, write_obj

WATCH = """
import json, sys
from pathlib import Path
from pipeline.assets.settings import AssetSettings
from tests.pipeline.assets.meshes_by_hand import prepare
import pipeline.assets.decimation.pymeshlab_filters
opened = []
def note(event, args):
    if event == "open":
        opened.append(str(args[0]))
    if event.startswith(("socket.", "subprocess.", "os.exec", "os.system")):
        opened.append(event)
sys.addaudithook(note)
prepare(Path(sys.argv[1]))
print(json.dumps(opened))
"""


def opened_for(path: Path) -> list[str]:
    """Files and sockets that a fresh process opens while it prepares `path`, by audit hook."""
    result = subprocess.run(
        [sys.executable, "-c", WATCH, str(path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    opened: list[str] = json.loads(result.stdout.splitlines()[-1])
    return opened


def test_an_obj_opens_no_material(tmp_path: Path) -> None:
    (tmp_path / "secret.mtl").write_text("newmtl a\nmap_Kd ../../../../../etc/hostname\n")
    folder = tmp_path / "objects"
    folder.mkdir()
    path = write_obj(folder / "a.obj", knot())
    text = "mtllib ../secret.mtl\nmtllib /etc/hostname\nusemtl a\n" + path.read_text()
    path.write_text(text)
    assert opened_for(path) == [str(path)]


def test_a_gltf_opens_its_buffers_and_no_picture(tmp_path: Path) -> None:
    tree, buffer = gltf_tree(sphere())
    tree["buffers"][0]["uri"] = "a.bin"
    tree["images"] = [{"uri": "../../etc/hostname"}, {"uri": "http://127.0.0.1:1/a.png"}]
    tree["textures"] = [{"source": 0}, {"source": 1}]
    tree["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    tree["meshes"][0]["primitives"][0]["material"] = 0
    (tmp_path / "a.bin").write_bytes(buffer)
    path = tmp_path / "a.gltf"
    path.write_text(json.dumps(tree))
    assert opened_for(path) == [str(path), str(tmp_path / "a.bin")]


@pytest.mark.parametrize("name", [b"line\nbreak.obj", b"not-utf8-\xff\xfe.obj", b"'; --.obj"])
def test_odd_names_are_names(tmp_path: Path, name: bytes) -> None:
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + name))
    write_obj(path, sphere())
    assert prepare(path).levels


def test_the_second_method_serves_where_the_first_died(tmp_path: Path) -> None:
    path = write_obj(tmp_path / "knot.obj", knot())
    asset = prepare(path, AssetSettings(), "meshoptimizer_sloppy")
    assert {level.record.method for level in asset.levels} == {"meshoptimizer_sloppy"}
    for level in asset.levels:
        assert len(level.faces) <= level.record.budget
        assert level.record.quality.error_p99 <= AssetSettings().gate.max_error_p99
