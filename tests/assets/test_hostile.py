"""Nothing but the file itself is opened; odd names and topologies cost nothing but themselves."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pipeline.assets.mesh import TriangleMesh
from pipeline.assets.prepare import prepare_asset
from pipeline.assets.settings import AssetSettings
from storage.errors import Rejected
from tests.assets.meshes_by_hand import gltf_tree, knot, record_of, sphere, write_obj
from tests.conftest import ROOT

WATCH = """
import json, sys
from pathlib import Path
from pipeline.assets.prepare import prepare_asset
from pipeline.assets.settings import AssetSettings
from tests.assets.meshes_by_hand import record_of
opened = []
def note(event, args):
    if event == "open":
        opened.append(str(args[0]))
    if event.startswith(("socket.", "subprocess.", "os.exec", "os.system")):
        opened.append(event)
sys.addaudithook(note)
prepare_asset(record_of(Path(sys.argv[1])), AssetSettings())
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
    assert prepare_asset(record_of(path), AssetSettings()).levels


def test_a_random_soup_ends(tmp_path: Path) -> None:
    """Heavily non-manifold: raw, it has killed pymeshlab; cleaned, it is merely far off."""
    rng = np.random.default_rng(0)
    soup = TriangleMesh(positions=rng.random((400, 3)), faces=rng.integers(0, 400, (3000, 3)))
    path = write_obj(tmp_path / "soup.obj", soup)
    with pytest.raises(Rejected, match="error_over_bound"):
        prepare_asset(record_of(path), AssetSettings(budgets=(700,)))


def test_many_faces_on_one_edge_end(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    pages = np.arange(2, 402)
    book = TriangleMesh(
        positions=rng.random((402, 3)),
        faces=np.column_stack([np.zeros(400, np.int64), np.ones(400, np.int64), pages]),
    )
    asset = prepare_asset(record_of(write_obj(tmp_path / "book.obj", book)), AssetSettings())
    methods = {level.record.budget: level.record.method for level in asset.levels}
    assert methods == {1400: "source", 340: "vertex_clustering", 240: "vertex_clustering"}
    sizes = [len(level.faces) for level in asset.levels]
    assert sizes == sorted(set(sizes), reverse=True)


def test_the_second_method_serves_where_the_first_died(tmp_path: Path) -> None:
    path = write_obj(tmp_path / "knot.obj", knot())
    asset = prepare_asset(record_of(path), AssetSettings(), "vertex_clustering")
    assert {level.record.method for level in asset.levels} == {"vertex_clustering"}
    for level in asset.levels:
        assert len(level.faces) <= level.record.budget
        assert level.record.error_p99 <= AssetSettings().max_error_p99
