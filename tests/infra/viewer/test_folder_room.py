"""A folder of scene files in the page: listed by name, read one by one, each a page of its own."""

import io
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from infra.viewer import scene_list as list_module
from infra.viewer.folder_room import THUMBNAIL_PX, FolderRoom
from infra.viewer.scene_list import scene_list
from pipeline.exchange.convert import write_scene
from pipeline.making.progressive_tracer import ProgressiveTracer
from pipeline.renders.variant import choose_variant
from storage.conventions import preview_srgb8
from storage.errors import TrilightError
from tests.infra.viewer.served_kit import Asker, served
from tests.scenes_by_hand import tiny_scene

NAMES = ["a & <b>.h5", "notes.json", "rooms/tiny.safetensors"]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of two scenes, a file that is none, and much that is not listed."""
    root = tmp_path_factory.mktemp("scenes")
    for name in ("rooms", ".hidden", "meshes"):
        (root / name).mkdir()
    scene = tiny_scene()
    write_scene(root / NAMES[2], scene)
    pictures = np.full((scene.num_views, 16, 16, 3), 0.25, np.float32)
    write_scene(root / NAMES[0], scene, pictures)
    (root / NAMES[1]).write_text('{"title": "no scene"}')
    for name in (".hidden/x.glb", ".x.glb", "meshes/x.obj", "readme.txt", "shard.tar"):
        (root / name).touch()
    return root


@pytest.fixture(scope="module")
def asker(root: Path) -> Iterator[Asker]:
    tracer = ProgressiveTracer(variant=choose_variant(), threads=1)
    with served(FolderRoom(scene_list(root), tracer, None), "folder.html") as found:
        yield found


def test_the_list_is_of_files_that_may_be_scenes(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "loop").symlink_to(root, target_is_directory=True)
    with pytest.raises(TrilightError, match="holds no scene; expected .*json"):
        scene_list(tmp_path)
    os.symlink(root / NAMES[1], tmp_path / "linked.json")
    assert scene_list(tmp_path).names == ("linked.json",)
    monkeypatch.setattr(list_module, "MOST_FILES", 2)
    cut = scene_list(root)
    assert cut.names == tuple(NAMES[:2]) and cut.is_cut


def test_each_file_tells_what_it_holds_and_shows_it(asker: Asker) -> None:
    facts = asker.ask("api/folder")[1]
    assert facts["files"] == NAMES and not facts["is_cut"]
    assert facts["forms"] == [".h5", ".json", ".safetensors"]
    about = asker.ask("api/about/2")[1]
    assert (about["triangles"], about["lights"], about["views"]) == (3, 1, 2)
    stored = np.asarray(Image.open(io.BytesIO(asker.ask("api/thumbnail/0")[1])))
    wanted = preview_srgb8(np.full((1, 1, 3), 0.25, np.float32))
    assert (stored == wanted).all(), "the picture that the file holds"
    traced = Image.open(io.BytesIO(asker.ask("api/thumbnail/2")[1]))
    assert traced.size == (THUMBNAIL_PX, THUMBNAIL_PX) and np.unique(np.asarray(traced)).size > 10
    status, said, _ = asker.ask("api/about/1")
    assert status == 422 and said["error"].startswith("notes.json: ")
    for wrong in ("3", "-1", "x", "../0", "%D9%A3", "0/1"):
        assert asker.ask(f"api/about/{wrong}")[0] == 404, wrong


def test_a_scene_opens_as_a_page_of_its_own(asker: Asker) -> None:
    assert b'id="stage"' in asker.ask("scene/0/")[1]
    facts = asker.ask("scene/0/api/scene")[1]
    assert facts["name"] == NAMES[0] and facts["target_px"] == 16
    assert {f"samples-{spp}" for spp in (1, 4, 16, 64)} < {
        each["name"] for each in facts["engines"]
    }
    assert "target" not in {each["name"] for each in asker.ask("scene/2/api/scene")[1]["engines"]}
    assert asker.ask("scene/1/api/scene")[0] == 422
    for wrong in ("scene/3/api/scene", "scene/a/api/scene", "scene/../0/", "scene/"):
        assert asker.ask(wrong)[0] == 404, wrong
