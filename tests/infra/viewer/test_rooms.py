"""A dataset and a folder of scene files in the page: rows, pictures, pages of scenes."""

import io
import os
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from PIL import Image

from infra.render.path_tracer import RenderChild
from infra.viewer import open_source
from infra.viewer.dataset_handlers import DatasetHandlers, filter_of
from infra.viewer.folder_handlers import THUMBNAIL_PX, FolderHandlers
from infra.viewer.open_source import scene_list
from pipeline.exchange.convert import write_scene
from pipeline.renders.mitsuba_variant import Variant, choose_variant
from pipeline.shards.finished_dataset import FinishedDataset
from pipeline.shards.listing import list_scenes
from pipeline.shards.plans import Selection
from storage.conventions import preview_srgb8
from storage.dataset.dataset import Dataset
from storage.errors import TrilightError
from storage.records.sample import Sample
from tests.for_each import case
from tests.infra.viewer.served_kit import Asker, served
from tests.pipeline.documents.dataset_by_hand import furnished, locked, sample, write_dataset
from tests.scenes_by_hand import tiny_scene

CUBE, BALL = locked("cube"), locked("ball")


def samples() -> dict[str, list[Sample]]:
    scenes = [furnished(["cube"] * (1 + row % 3), ("plane", "wall")[row % 2]) for row in range(8)]
    made = [
        sample(row, scene, noise_floor_db=30.0 + row, coverage=0.1 * row, spp=64 + row)
        for row, scene in enumerate(scenes)
    ]
    return {"train-000000.tar": made[:5], "validation-000001.tar": made[5:]}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    root = tmp_path_factory.mktemp("sets") / "a set"
    return write_dataset(root, samples(), objects=[CUBE, BALL])


@pytest.fixture(scope="module")
def asker(dataset: Dataset) -> Iterator[Asker]:
    child = RenderChild(
        Variant(name="llvm_ad_rgb", libllvm="", note=""), threads=1
    )  # nothing is traced here
    room = DatasetHandlers(dataset, str(dataset.folder.root), child, None)
    room.index.wait()
    with served(room, "dataset.html") as found:
        yield found


FILTERS = [
    {},
    {"split": "train"},
    {"split": "validation", "template": "wall"},
    {"triangles_min": "6", "triangles_max": "8"},
    {"lights_max": "0"},
    {"floor_min": "31.5", "floor_max": "35"},
    {"coverage_min": "0.3", "coverage_max": "0.7"},
]


def test_what_is_shown_is_what_the_printed_command_selects(asker: Asker, dataset: Dataset) -> None:
    for query in FILTERS:
        with case(query):
            found = asker.ask(
                "api/rows?" + "&".join(f"{name}={text}" for name, text in query.items())
            )[1]
            words = shlex.split(found["command"])
            assert bool(words) == bool(query)
            options = dict(zip(words[4::2], words[5::2], strict=True))
            if words:
                assert words[:4] == ["trilight", "shards", "select", str(dataset.folder.root)]
                assert Path(options["--out"]) == dataset.folder.root.with_name("a set-selected")
            selection = Selection(
                split=options.get("--split"),
                template=options.get("--template"),
                where=options.get("--where"),
            )
            whole = FinishedDataset(folder=dataset.folder, manifest=dataset.manifest, objects={})
            chosen = list_scenes(whole, selection)
            assert [row["key"] for row in found["rows"]] == [row["key"] for row in chosen.rows]
            for mine, theirs in zip(found["rows"], chosen.rows, strict=True):
                for name in ("split", "template", "triangles", "lights", "spp"):
                    assert mine[name] == theirs[name]
                assert mine["floor"] == pytest.approx(theirs["floor"], abs=0.06)
                assert mine["coverage"] == pytest.approx(theirs["coverage"], abs=0.0006)


def test_rows_are_sorted_and_come_page_by_page(asker: Asker) -> None:
    falling = asker.ask("api/rows?sort=floor&descending=1")[1]["rows"]
    assert [row["floor"] for row in falling] == sorted(30.0 + row for row in range(8))[::-1]
    rest = asker.ask("api/rows?from=6")[1]
    assert rest["total"] == 8 and len(rest["rows"]) == 2
    for wrong in ("sort=age", "floor_min=x", "floor_min=inf", "coverage_max=nan"):
        assert asker.ask(f"api/rows?{wrong}")[0] == 422, wrong


def test_small_pictures_are_those_of_the_dataset(asker: Asker) -> None:
    status, png, _ = asker.ask("api/thumbnail/000000006/1?px=16")
    assert status == 200
    wanted = preview_srgb8(samples()["validation-000001.tar"][1].radiance_rgb[1])
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(png))), wanted)
    for wrong, status in (
        ("000000006/9", 404), ("000000006/x", 404), ("000000099/0", 422), ("../0", 422),
        ("000000006/0?px=9999", 422), ("000000006/0?px=-1", 422), ("000000006", 404),
    ):  # fmt: skip
        assert asker.ask(f"api/thumbnail/{wrong}")[0] == status, wrong


def test_a_scene_opens_as_a_page_of_its_own_with_its_target(asker: Asker) -> None:
    assert b'id="stage"' in asker.ask("scene/000000003/")[1]
    facts = asker.ask("scene/000000003/api/scene")[1]
    assert facts["target_px"] == 16 and "target" in [each["name"] for each in facts["engines"]]
    assert asker.ask("scene/000000003/static/scene.js")[0] == 200
    for wrong in ("scene/000000099/api/scene", "scene/x/../../", "scene/", "scene/a/b/api/scene"):
        assert asker.ask(wrong)[0] in (404, 422), wrong


def test_a_damaged_shard_costs_itself_alone(tmp_path: Path) -> None:
    broken = write_dataset(tmp_path / "broken", samples(), objects=[CUBE, BALL])
    shard = broken.folder.root / "train-000000.tar"
    shard.write_bytes(shard.read_bytes()[:5000])
    room = DatasetHandlers(broken, "broken", cast(Any, ClosedChild()), None)
    room.index.wait()
    assert {row.split for row in room.index.rows} >= {"validation"}
    assert len(room.index.problems) == 1 and "train-000000.tar" in room.index.problems[0]
    room.close()


class ClosedChild:
    """Traces nothing."""

    def close(self) -> None:
        pass


def test_a_limit_is_compared_as_the_command_says_it() -> None:
    assert filter_of({"floor_min": "33.1234567"}).least == {"floor": 33.1235}
    with pytest.raises(TrilightError, match="sort is size"):
        filter_of({"sort": "size"})


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
def folder_asker(root: Path) -> Iterator[Asker]:
    child = RenderChild(choose_variant(), threads=1)
    with served(FolderHandlers(scene_list(root), child, None), "folder.html") as found:
        yield found


def test_the_list_is_of_files_that_may_be_scenes(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "loop").symlink_to(root, target_is_directory=True)
    with pytest.raises(TrilightError, match="holds no scene; expected .*json"):
        scene_list(tmp_path)
    os.symlink(root / NAMES[1], tmp_path / "linked.json")
    assert scene_list(tmp_path).names == ("linked.json",)
    monkeypatch.setattr(open_source, "MOST_FILES", 2)
    cut = scene_list(root)
    assert cut.names == tuple(NAMES[:2]) and cut.is_cut


def test_each_file_tells_what_it_holds_and_shows_it(folder_asker: Asker) -> None:
    facts = folder_asker.ask("api/folder")[1]
    assert facts["files"] == NAMES and not facts["is_cut"]
    assert facts["forms"] == [".h5", ".json", ".safetensors"]
    about = folder_asker.ask("api/about/2")[1]
    assert (about["triangles"], about["lights"], about["views"]) == (3, 1, 2)
    stored = np.asarray(Image.open(io.BytesIO(folder_asker.ask("api/thumbnail/0")[1])))
    wanted = preview_srgb8(np.full((1, 1, 3), 0.25, np.float32))
    assert (stored == wanted).all(), "the picture that the file holds"
    traced = Image.open(io.BytesIO(folder_asker.ask("api/thumbnail/2")[1]))
    assert traced.size == (THUMBNAIL_PX, THUMBNAIL_PX) and np.unique(np.asarray(traced)).size > 10
    status, said, _ = folder_asker.ask("api/about/1")
    assert status == 422 and "notes.json: " in said["error"]
    for wrong in ("3", "-1", "x", "../0", "%D9%A3", "0/1"):
        assert folder_asker.ask(f"api/about/{wrong}")[0] == 404, wrong


def test_a_scene_opens_as_a_page_of_its_own(folder_asker: Asker) -> None:
    assert b'id="stage"' in folder_asker.ask("scene/0/")[1]
    facts = folder_asker.ask("scene/0/api/scene")[1]
    assert facts["name"] == NAMES[0] and facts["target_px"] == 16
    assert {f"samples-{spp}" for spp in (1, 4, 16, 64)} < {
        each["name"] for each in facts["engines"]
    }
    assert "target" not in {
        each["name"] for each in folder_asker.ask("scene/2/api/scene")[1]["engines"]
    }
    assert folder_asker.ask("scene/1/api/scene")[0] == 422
    for wrong in ("scene/3/api/scene", "scene/a/api/scene", "scene/../0/", "scene/"):
        assert folder_asker.ask(wrong)[0] == 404, wrong
