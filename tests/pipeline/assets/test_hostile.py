"""Nothing but the file itself is opened; odd names are names."""

import json
import os
import subprocess
import sys
from pathlib import Path

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
for path in sys.argv[1:]:
    opened.clear()
    prepare(Path(path))
    print(json.dumps(opened))
"""


def opened_for(*paths: Path) -> list[list[str]]:
    """Files and sockets that a fresh process opens while it prepares each, by audit hook."""
    result = subprocess.run(
        [sys.executable, "-c", WATCH, *map(str, paths)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    return [json.loads(line) for line in result.stdout.splitlines()[-len(paths) :]]


def test_an_obj_opens_no_material_and_a_gltf_its_buffers_and_no_picture(tmp_path: Path) -> None:
    material, tree = obj_with_material(tmp_path), gltf_with_pictures(tmp_path)
    assert opened_for(material, tree) == [[str(material)], [str(tree), str(tmp_path / "a.bin")]]


def obj_with_material(tmp_path: Path) -> Path:
    (tmp_path / "secret.mtl").write_text("newmtl a\nmap_Kd ../../../../../etc/hostname\n")
    folder = tmp_path / "objects"
    folder.mkdir()
    path = write_obj(folder / "a.obj", knot(segments=80))
    text = "mtllib ../secret.mtl\nmtllib /etc/hostname\nusemtl a\n" + path.read_text()
    path.write_text(text)
    return path


def gltf_with_pictures(tmp_path: Path) -> Path:
    tree, buffer = gltf_tree(sphere())
    tree["buffers"][0]["uri"] = "a.bin"
    tree["images"] = [{"uri": "../../etc/hostname"}, {"uri": "http://127.0.0.1:1/a.png"}]
    tree["textures"] = [{"source": 0}, {"source": 1}]
    tree["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    tree["meshes"][0]["primitives"][0]["material"] = 0
    (tmp_path / "a.bin").write_bytes(buffer)
    path = tmp_path / "a.gltf"
    path.write_text(json.dumps(tree))
    return path


def test_odd_names_are_names(tmp_path: Path) -> None:
    for name in (b"line\nbreak.obj", b"not-utf8-\xff\xfe.obj", b"'; --.obj"):
        path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + name))
        write_obj(path, sphere(rings=5, columns=8))
        assert prepare(path).levels, name


def test_the_second_method_serves_where_the_first_died(tmp_path: Path) -> None:
    path = write_obj(tmp_path / "knot.obj", knot())
    asset = prepare(path, AssetSettings(), "meshoptimizer_sloppy")
    assert {level.record.method for level in asset.levels} == {"meshoptimizer_sloppy"}
    for level in asset.levels:
        assert len(level.faces) <= level.record.budget
        assert level.record.quality.error_p99 <= AssetSettings().gate.max_error_p99
