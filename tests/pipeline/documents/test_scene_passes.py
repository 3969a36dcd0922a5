"""Passes on the pages of scenes: colours that say the value, and commands that run."""

import base64
import dataclasses
import html
import io
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from pipeline.documents.distributions import dataset_distributions
from pipeline.documents.report import write_report
from pipeline.documents.scene_page import Neighbours, encode_scene_page
from pipeline.documents.scene_passes import depth_grays, finite_range, id_colors
from storage.conventions import look_at_c2w
from storage.dataset.dataset import open_dataset
from storage.dataset.manifest import write_manifest
from storage.records.passes.pictures import decode_passes_exr, view_passes
from storage.records.sample import Sample
from storage.records.scene import Scene
from tests.command_line import trilight
from tests.pipeline.documents.dataset_by_hand import SETTINGS, furnished, sample, write_dataset
from tests.scenes_by_hand import tiny_scene

WORDS = ("depth", "shading normal", "object ids", "diffuse albedo", "roughness")
SIZE = 96


def page_of(shown: Sample) -> str:
    links = Neighbours(report="../report.html", before=None, after=None)
    return encode_scene_page(shown, "train", (), links).decode()


def figures(page: str) -> dict[str, tuple[NDArray[np.uint8], str]]:
    """Return the pictures of a page with their captions, by what stands for them."""
    picture = r'<img alt="([^"]+?)" src="data:image/png;base64,([^"]+?)"></label>'
    form = rf"<figure><label><input [^>]+>\n{picture}<figcaption>(.+?)</"
    return {
        alt: (np.asarray(Image.open(io.BytesIO(base64.b64decode(data)))), caption)
        for alt, data, caption in re.findall(form, page)
    }


def commands(page: str) -> list[str]:
    return [
        html.unescape(text) for text in re.findall("<code[^>]*>(trilight passes .+?)</code>", page)
    ]


def looking_away() -> Scene:
    """Return the tiny scene, whose second camera has its back to it."""
    away = look_at_c2w(eye=[3, 0, 1], target=[4, 0, 2], up=[0, 0, 1])
    scene = tiny_scene()
    return tiny_scene(c2w=np.stack([scene.c2w[0], away]).astype(np.float32))


def test_colours_and_captions_say_the_value() -> None:
    scene = furnished(["a"])
    shown = figures(page_of(sample(0, scene)))
    names = ["depth_axis_m", "shading_normal", "object", "material_diffuse", "material_roughness"]
    for view in range(scene.num_views):
        depth_m, normal, ids, _, roughness = view_passes(
            scene, names, view=view, resolution=SIZE
        ).values()
        greys, normals, colours, albedo, rough = (
            shown[f"view {view}, {word}"][0].astype(int) for word in WORDS
        )
        met = ids >= 0
        assert 0 < met.sum() < met.size
        for picture in (greys, normals, colours, albedo, rough):
            assert not picture[~met].any()
            assert picture[met].reshape(met.sum(), -1).any(axis=1).all()
        assert greys[met][np.argmin(depth_m[met])] == 255
        assert (np.diff(greys[met][np.argsort(depth_m[met])]) <= 0).all()
        assert np.abs(normals[met] / 127.5 - 1 - normal[met]).max() <= 0.5 / 127.5
        assert np.array_equal(colours, id_colors(ids))
        assert {tuple(colour) for colour in albedo[ids == 2]} <= {(203, 0, 0), (124, 170, 0)}
        assert np.array_equal(rough[met], np.round(40 + 215 * roughness[met]))
    depth_m = view_passes(scene, ["depth_axis_m"], view=1, resolution=SIZE)["depth_axis_m"]
    near, far = (choose(depth_m[np.isfinite(depth_m)]) for choose in (np.min, np.max))
    assert f": {near:.2f} to {far:.2f} m, near is bright" in shown["view 1, depth"][1]
    assert ": 2 seen" in shown["view 1, object ids"][1]
    assert ": 0.00 to 0.60 (no unit)" in shown["view 1, diffuse albedo"][1]
    assert ": 0.30 to 0.50 (no unit)" in shown["view 1, roughness"][1]


def test_the_table_of_objects_has_the_colours_of_the_ids() -> None:
    page = page_of(sample(0, furnished(["a"])))
    squares = re.findall(r'class="id" style="background: #(\w+)"></i> (.+?)</td>', page)
    assert squares == [("800000", "floor"), ("008000", "light"), ("808000", "0 a")]


def test_a_view_of_nothing_is_black() -> None:
    shown = figures(page_of(sample(0, looking_away())))
    for word in WORDS:
        picture, caption = shown[f"view 1, {word}"]
        assert not picture.any() and caption == f"view 1, {word}: nothing is met"
        assert shown[f"view 0, {word}"][0].any()


@pytest.mark.usefixtures("bare_reports")
def test_the_commands_run_as_printed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shards = {"train-000000.tar": [sample(index, furnished(["a"])) for index in (3, 4)]}
    dataset = write_dataset(tmp_path / "data", shards)
    report = write_report(dataset, dataset_distributions(dataset))
    monkeypatch.chdir(report.parent)
    before = {path: path.read_bytes() for path in report.parent.rglob("*") if path.is_file()}

    def written(path: Path) -> list[Path]:
        (command,) = commands(path.read_text())
        name, *words = shlex.split(command)
        assert name == "trilight"
        ended = trilight(words)
        assert ended.exit_code == 0, ended.exception
        return sorted((tmp_path / "passes").iterdir())

    files = written(report.parent / "report" / "000000004.html")
    assert [path.name for path in files] == [f"000000004.{view}.passes.exr" for view in range(2)]
    assert set(decode_passes_exr(files[0].read_bytes(), 16)) == {
        *("depth_axis_m", "shading_normal", "object", "material_diffuse", "material_roughness"),
        "coverage",
    }
    assert len(written(report)) == 4
    after = {path: path.read_bytes() for path in report.parent.rglob("*") if path.is_file()}
    assert after == before


@pytest.mark.usefixtures("bare_reports")
def test_the_report_names_the_stored_passes(tmp_path: Path) -> None:
    dataset = write_dataset(tmp_path, {"train-000000.tar": [sample(0, furnished([]))]})

    def report() -> str:
        found = open_dataset(str(tmp_path))
        return write_report(found, dataset_distributions(found)).read_text()

    assert "<td>passes</td><td>none stored;" in report()
    settings = {**SETTINGS, "storage": {"passes": ["object", "depth_axis_m"]}}
    manifest = dataclasses.replace(dataset.manifest, settings=settings)
    write_manifest(dataset.folder.manifest, manifest)
    assert "<td>passes</td><td>object, depth_axis_m beside each picture</td>" in report()
    assert not commands(report())


def test_near_is_bright_and_every_id_has_its_own_colour() -> None:
    depth_m = np.array([[2.0, 3.0], [4.0, np.inf]])
    assert depth_grays(depth_m).tolist() == [[255, 148], [40, 0]]
    # metres do not matter, only the range
    assert np.array_equal(depth_grays(depth_m * 1000), depth_grays(depth_m))
    assert depth_grays(np.array([[3.0, np.inf]])).tolist() == [[255, 0]]
    assert depth_grays(np.full((2, 2), np.inf)).tolist() == [[0, 0], [0, 0]]
    ids = np.append(np.arange(-1, 2**16), 2**24 - 2)
    assert len(np.unique(id_colors(ids), axis=0)) == len(ids)
    assert not id_colors(-1).any()
    first = [[128, 0, 0], [0, 128, 0], [128, 128, 0], [0, 0, 128]]
    assert id_colors(range(4)).tolist() == first
    assert finite_range(np.array([np.nan, 3, 1, np.inf])) == (1, 3)
    assert finite_range(np.array([np.nan])) is None
