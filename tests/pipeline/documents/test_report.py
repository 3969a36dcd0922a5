"""`report.html`, its gallery and figures: harmless, complete, the same whenever it is written."""

import io
import re
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from pipeline.documents.distributions import dataset_distributions
from pipeline.documents.figures import (
    Panel,
    draw_bars,
    draw_histogram,
    draw_panels,
    short_label,
)
from pipeline.documents.report import write_gallery, write_report
from pipeline.documents.scene_page import encode_scene_page, shown_maps
from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.layout import DatasetFolder
from storage.records.objects import Failure
from storage.records.scene import SceneObject
from storage.records.texture import MapSource, Texture
from tests.pipeline.documents.dataset_by_hand import (
    HARM,
    NO_LINKS,
    RIGHTS,
    Tags,
    edit_manifest,
    files_of,
    five_scenes,
    furnished,
    locked,
    pixels_of,
    read,
    sample,
    text_of,
    write_dataset,
)
from tests.pipeline.documents.test_card import card_of
from tests.scenes_by_hand import tiny_scene
from tests.textured_by_hand import sky, textured_scene

ACTIVE = {"script", "iframe", "link", "object", "embed", "form", "base"}


def report_of(dataset: Dataset) -> Path:
    return write_report(dataset, dataset_distributions(dataset), out=dataset.folder)


def pages(report: Path) -> dict[Path, Tags]:
    files = [report, *sorted((report.parent / "report").glob("*"))]
    return {path: read(path.read_bytes()) for path in files}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Five scenes with their report."""
    dataset = five_scenes(tmp_path_factory.mktemp("five"))
    report_of(dataset)
    return dataset


@pytest.fixture(scope="module")
def five(dataset: Dataset) -> dict[str, Tags]:
    """The pages of five scenes, by file name without suffix."""
    return {path.stem: tags for path, tags in pages(dataset.folder.report).items()}


def test_text_from_outside_stays_text(tmp_path: Path) -> None:
    """Every text from outside is markup."""
    shell = SceneObject(name=HARM, kind="shell")
    scene = furnished([HARM], HARM, **RIGHTS)
    scene = scene.with_provenance({**scene.provenance, HARM: [HARM]})
    object.__setattr__(scene, "objects", (shell, *scene.objects[1:]))
    failures = [
        Failure(stage="scenes", item="000000000", reason=HARM, message=HARM),
        Failure(stage=HARM, item=HARM, reason="$\\frac{$ \x07\n ł 高", message=HARM),
    ]
    objects = [locked(HARM, HARM, title=HARM, attribution=HARM, source_url=HARM)]
    shards = {"train-000000.tar": [sample(0, scene)]}
    hostile = write_dataset(tmp_path, shards, objects=objects, failures=failures)
    shown = pages(report_of(hostile))
    assert len(shown) == 2
    for path, tags in shown.items():
        own = ["script"] * (path.name == "report.html")
        assert [tag for tag in tags.tags if tag in ACTIVE] == own
        assert not any(name.startswith("on") for name in tags.names)
        assert not any("javascript" in link for link in tags.links)
        assert not re.search(rb"@import|url\(", path.read_bytes())
        assert "".join(tags.text).count(HARM) >= 4
    # the address is shown on the page of the scene, and is no link
    assert "javascript:alert(3)" in text_of(shown[tmp_path / "report" / "000000000.html"])


def test_links_lead_somewhere_in_the_order_of_the_gallery(
    dataset: Dataset, five: dict[str, Tags]
) -> None:
    shown = pages(dataset.folder.report)
    followed = 0
    for path, tags in shown.items():
        for link in tags.links:
            parts = urlsplit(link)
            if parts.scheme == "data":
                assert link.startswith("data:image/png;base64,")
                continue
            assert not parts.scheme, link
            target = (path.parent / parts.path).resolve() if parts.path else path
            assert target in shown, link
            assert not parts.fragment or parts.fragment in shown[target].ids, link
            followed += 1
    # five cards, five ways back, four neighbours each way, eleven places of the report
    assert followed == 5 + 5 + 4 + 4 + 11
    cards = [link for link in five["report"].links if link.startswith("report/")]
    order = ["000000000", "000000001", "000000002", "000000003", "000000020"]
    assert cards == [f"report/{key}.html" for key in order]
    neighbours = [link for link in five["000000002"].links if link.endswith(".html")]
    assert neighbours == ["000000001.html", "000000003.html"]


def test_the_numbers_of_a_dataset_and_of_a_scene_are_on_their_pages(five: dict[str, Tags]) -> None:
    text = text_of(five["report"])
    assert "scenes 5 (4 train, 1 test)" in text
    assert "views 10, 2 of each scene" in text
    assert "objects 4, 3 of them in scenes" in text
    assert "plane 3 0 3 wall 1 1 2 all 4 1 5" in text
    assert "triangles of a scene 5 3 3 5 5.4 7 7" in text
    assert "objects 6 0.0% 100.0%" in text  # smooth, many colours
    assert "floors and walls 5 100.0% 0.0%" in text
    assert "train 8 41.5 38.0 75.0% 25.0%" in text
    assert "test 2 44.0 44.0 100.0% 0.0%" in text
    assert "scenes no_room 2 1 1 0 0" in text
    assert "CC-BY-4.0 1 1 1 CC0-1.0 3 2 5" in text
    assert "2 cameras stand in for rejected ones" in text
    tags = five["000000001"]
    text = text_of(tags)
    assert "train, template wall, 7 triangles" in text
    assert "0 2.000, 0.000, 1.000 2.236 26.6 0.0 45.0 128 42.00 33.25 40.50 0.25 no 0 7" in text
    assert "0 a object a CC0-1.0 flat 2 1 b object b CC0-1.0 flat 2" in text
    assert "light 0.000, -0.033, 2.000 2.000 100.0, 100.0, 100.0 0.02000" in text
    assert text.count("no_room") == 2  # both rejected attempts at it
    assert tags.tags.count("figure") == 2 + 2 * 5  # pictures, and passes of both views
    assert tags.tags.count("i") == 4 + 1 + 2 + 2  # colours of ids, then of materials
    assert "no_room" not in text_of(five["000000000"])
    # linear 0.6 is 0.7977 in sRGB, 203 of 255
    assert "background: #cb0000" in five["000000000"].styles


def test_the_report_says_which_objects_keep_their_materials(tmp_path: Path) -> None:
    dataset = five_scenes(tmp_path)
    report = report_of(dataset)
    assert "a A train drawn 4" in text_of(read(report.read_bytes()))
    scenes = {"materials": {"source": "object"}}
    root = edit_manifest(dataset, settings={**dataset.manifest.settings, "scenes": scenes})
    (root / "logs").mkdir(exist_ok=True)
    (root / "logs" / "drawn_materials.json").write_text('{"b": ["no_materials"]}')
    text = text_of(read(report_of(open_dataset(str(root))).read_bytes()))
    assert "a A train own 4" in text
    assert "b B train drawn: no_materials 1" in text


@pytest.mark.usefixtures("bare_reports")
def test_one_scene_or_none_at_all_and_only_source_addresses_lead_elsewhere(tmp_path: Path) -> None:
    address = 'https://example.org/a?b=1&c="x"'
    scene = furnished(["a"], source_url=address, attribution="somebody")
    dataset = write_dataset(tmp_path, {"validation-000002.tar": [sample(9, scene)]})
    shown = pages(report_of(dataset))
    page = shown[tmp_path / "report" / "000000009.html"]
    assert page.links[0] == "../report.html#gallery" and "before" not in text_of(page)
    assert "1 of 1 scenes" in text_of(shown[tmp_path / "report.html"])
    assert [link for link in page.links if urlsplit(link).scheme not in ("", "data")] == [address]
    assert not [link for link in shown[tmp_path / "report.html"].links if "//" in link[:12]]
    assert "somebody" in text_of(page)
    shown = pages(report_of(write_dataset(tmp_path / "none", {})))
    assert "scenes 0 (none)" in text_of(shown[tmp_path / "none" / "report.html"])


@pytest.mark.usefixtures("bare_reports")
def test_the_gallery_is_bounded_and_old_pages_go(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = five_scenes(tmp_path)
    write_gallery(dataset, (), dataset.folder)
    mine = tmp_path / "report" / "notes.html"
    mine.write_text("kept")
    monkeypatch.setattr("pipeline.documents.report.MOST_SHOWN", 2)
    report = report_of(dataset)
    # one scene of each split
    names = sorted(path.name for path in (tmp_path / "report").iterdir())
    assert names == ["000000000.html", "000000020.html", "notes.html"]
    assert "2 of 5 scenes" in text_of(read(report.read_bytes()))


def test_writing_elsewhere_gives_the_same_bytes_and_leaves_the_dataset_alone(
    tmp_path: Path, dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = dataset.folder.root
    before = files_of(root)
    found = dataset_distributions(dataset)
    monkeypatch.setenv("LC_ALL", "de_DE.UTF-8")
    report = write_report(dataset, found, out=DatasetFolder(tmp_path))
    assert report == tmp_path / "report.html"
    written = {path.relative_to(tmp_path): path.read_bytes() for path in pages(report)}
    assert written == {
        path.relative_to(root): path.read_bytes() for path in pages(root / "report.html")
    }
    assert not any(str(root).encode() in data for data in written.values())
    assert files_of(root) == before


def test_the_report_and_the_card_count_maps_and_scenes_show_them(
    tmp_path: Path, dataset: Dataset, five: dict[str, Tags]
) -> None:
    """A textured scene below a seen sky, a textured one, and a plain one."""
    dusk = sky(radiance_rgb=np.full((4, 8, 3), 0.25, np.float32), is_seen=True)
    scenes = [textured_scene(environment=dusk), textured_scene(), tiny_scene()]
    shards = {"train-000000.tar": [sample(key, scene) for key, scene in enumerate(scenes)]}
    mapped = write_dataset(tmp_path, shards)
    report_of(mapped)
    page = read(mapped.folder.report.read_bytes())
    text = text_of(page)
    assert "scenes textured 2 66.7% scenes below a sky 1 33.3%" in text
    assert "objects textured 0 floors and walls textured 2 66.7%" in text
    assert "texture colours 0 2 texture roughness 2" in text and "sky sky 0 1" in text
    assert "mean radiance of a sky 1 0.250 0.250 0.250 0.250 0.250 0.250" in text
    assert "#textures-and-skies" in page.links and "Nothing was rejected." in text
    card = card_of(mapped)[1]
    assert "2 of 3 scenes, 4 maps of 2 families, 2 to 6 texels wide" in card
    assert "1 of 3 scenes, 1 families, mean radiance 0.25; half of the light" in card
    text = text_of(read((mapped.folder.report_pages / "000000000.html").read_bytes()))
    assert "colours 0 (diffuse) roughness sky 0 (environment, seen)" in text
    assert "sky 0 (environment, seen): mean radiance 0.25, brightest texel 1 times that" in text
    plain = text_of(read((mapped.folder.report_pages / "000000002.html").read_bytes()))
    assert "Textures and environment" not in plain
    bare = card_of(dataset)[1]
    assert "textures" not in bare and "skies" not in bare
    assert "#textures-and-skies" not in five["report"].links


def test_a_texture_is_shown_as_it_lies() -> None:
    """Its row 0 is at the bottom; names are text. A sun and all else of a sky are seen."""
    texels = np.zeros((2, 2, 3), np.uint8)
    texels[0, 1] = [200, 100, 50]
    texture = Texture(texels=texels, is_srgb=True, source=MapSource(name=HARM))
    number = Texture(texels=np.full((1, 1, 1), 128, np.uint8))
    scene = textured_scene(0, texture, number, environment=sky())
    pictures = [pixels_of(shown.source) for *_, shown in shown_maps(scene)]
    assert pictures[0].tolist() == [[[0] * 3] * 2, [[0] * 3, [200, 100, 50]]]
    assert pictures[2].shape == (112, 224, 3) and pictures[2].max() == 255
    page = read(encode_scene_page(sample(0, scene.with_provenance({})), "train", (), NO_LINKS))
    assert "".join(page.text).count(HARM) == 2


VALUES: dict[str, list[float]] = {
    "none": [],
    "one": [3.5],
    "equal": [2.5] * 9,
    "whole": [1, 2, 2, 5],
    "wide": [1e-9, 1e30],
    "not finite": [np.nan, np.inf, 1.0],
    "all not finite": [np.nan],
    "many": list(np.linspace(0, 1, 1000)),
}


def test_any_values_can_be_drawn() -> None:
    marks = {"a": 3.0, "c": np.nan}
    kinds: tuple[dict[str, Any], ...] = ({"is_rose": True}, {"is_log": True}, {"marks": marks})
    panels = [
        Panel(values=values, label=name, unit="y", **more)
        for more in kinds
        for name, values in VALUES.items()
    ]
    drawn = Image.open(io.BytesIO(draw_panels(panels)))
    assert drawn.size[0] > 800
    assert len(drawn.getcolors(1 << 24) or []) > 20


def test_bars_hold_every_value_and_names_from_outside_are_labels() -> None:
    """Heights of the bars add up to the values, and whole numbers have a bar each."""

    def heights(values: list[float]) -> list[float]:
        axes = Figure().add_subplot()
        draw_histogram(axes, Panel(values=values, label="x"))
        return [patch.get_height() for patch in axes.patches]  # type: ignore[attr-defined]

    assert heights([1, 2, 2, 5]) == [1, 2, 0, 0, 1]
    assert sum(heights(VALUES["many"])) == 1000
    assert short_label("a\n b\x07\u202e") == "a b"
    assert len(short_label("x" * 99)) == 26
    names = ["$\\frac{$", "高 \ud800", "", "x" * 99]
    drawn = draw_bars(names, {name: [1, 2, 3, 4] for name in names}, label="n")
    assert Image.open(io.BytesIO(drawn)).size[0] > 800
    # The reader's settings do not matter.
    panel = Panel(values=[1.5, 2.5], label="x")
    plain = draw_panels([panel])
    with matplotlib.rc_context({"font.size": 30, "axes.facecolor": "black"}):
        assert draw_panels([panel]) == plain
        assert matplotlib.rcParams["font.size"] == 30
