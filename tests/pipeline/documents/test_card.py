"""The numbers of a dataset against those counted by hand, the card and Croissant that state them.

Croissant passes MLCommons' own validator, and a huge dataset is described by a sample.
"""

import contextlib
import dataclasses
import io
import json
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from pipeline.documents import dataset_documents
from pipeline.documents.dataset_documents import (
    _size_category,
    encode_card,
    encode_croissant,
    write_documents,
)
from pipeline.documents.distributions import Distributions, dataset_distributions
from pipeline.documents.pages import render_markdown
from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.statistics import dataset_statistics, described_shards
from storage.errors import TrilightError
from storage.markdown import code, front_matter, plain, text
from storage.records.objects import read_objects_lock, write_objects_lock
from storage.records.profiles import Profile
from storage.records.quantities import QUANTITIES, STATISTICS, summary
from storage.records.sample import PictureErrors, error_text
from tests.for_each import with_folders
from tests.pipeline.documents.dataset_by_hand import (
    edit_manifest,
    five_scenes,
    furnished,
    locked,
    sample,
    write_dataset,
)
from tests.scenes_by_hand import tiny_scene
from tests.textured_by_hand import sky, textured_scene

FLOAT32 = 1e-6
"""Values are kept as float32: relative rounding of 6e-8, a few times over."""


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Distributions:
    return dataset_distributions(five_scenes(tmp_path_factory.mktemp("five")))


def test_scenes_objects_surfaces_and_rejections_are_counted(found: Distributions) -> None:
    assert found.scenes == {("plane", "train"): 3, ("wall", "train"): 1, ("wall", "test"): 1}
    assert found.splits == ["train", "test"]
    assert found.placements == {"a": 4, "b": 1, "c": 1}
    assert found.uses_per_object() == [4, 1, 1, 0]
    assert found.licences == {"CC-BY-4.0": (1, 1, 1), "CC0-1.0": (3, 2, 5)}
    assert found.values["test"]["noise_floor_db"].tolist() == [44, 44]
    assert found.views_at_cap == {"train": 2, "test": 0}
    # The floor's triangles share two vertices; an object's have three each and two colours.
    assert found.as_json()["surfaces"] == {
        "shell": {"all": 5, "smooth": 5, "many_colours": 0, "textured": 0},
        "object": {"all": 6, "smooth": 0, "many_colours": 6, "textured": 0},
    }
    assert list(found.rejections.items()) == [
        (("scenes", "no_room"), {0: 1, 1: 1}),
        (("objects", "no_faces"), {0: 1}),
        (("renders", "black_view"), {0: 1}),
    ]
    floors = {"noise_floor_db": 40.0, "noise_floor_linear_db": None, "noise_floor_objects_db": None}
    assert found.targets == {"max_triangles": 9, **floors, "min_spp": 64, "max_spp": 256}
    read = json.loads(json.dumps(found.as_json(), allow_nan=False, sort_keys=True))
    assert set(read["quantities"]) == set(QUANTITIES)
    assert read["quantities"]["triangles_per_scene"] == {
        "count": 5, "min": 3, "p5": 3.4, "median": 5, "mean": 5.4, "p95": 7, "max": 7,
    }  # fmt: skip
    assert read["object_uses"]["max"] == 4
    assert read["scenes"][0] == {"template": "plane", "split": "train", "count": 3}
    for name, values in VALUES:
        assert np.sort(found.all(name)) == pytest.approx(np.sort(values), rel=FLOAT32), name
    assert {name for name, _ in VALUES} == set(QUANTITIES)


VALUES: list[tuple[str, Sequence[float]]] = [
    ("objects_per_scene", [1, 2, 0, 2, 1]),
    ("triangles_per_scene", [5, 7, 3, 7, 5]),
    ("triangles_per_object", [2] * 6),
    # five floors, six objects whose triangles are half red and half green
    ("diffuse", [0.5] * 5 + [(0.6 + 0.4) / 2] * 6),
    ("specular", [0.2] * 5 + [0.1] * 6),
    ("albedo_sum", [0.7] * 5 + [(0.7 + 0.5) / 2] * 6),
    ("roughness", [0.5] * 5 + [0.3] * 6),
    ("textures_per_scene", [0] * 5),
    ("texture_width", []),
    ("skies_per_scene", [0] * 5),
    ("sky_radiance", []),
    ("sky_peak", []),
    ("sky_half_light_deg", []),
    ("lights_per_scene", [1] * 5),
    ("total_emission", [100] * 5),
    # the middle of the light is (0, -1/30, 2), and half of 0.2 x 0.2 its area
    ("light_distance", [(4 + 1 / 900) ** 0.5] * 5),
    ("light_size", [0.02**0.5] * 5),
    ("camera_distance", [5**0.5] * 10),
    ("elevation_deg", [np.degrees(np.arctan(0.5))] * 10),
    ("azimuth_deg", [0, 90] * 5),
    ("fov_deg", [45, 40] * 5),
    ("noise_floor_db", [38, 38, 42, 42, 41.5, 41.5, 41.5, 41.5, 44, 44]),
    ("noise_floor_linear_db", [33.25] * 10),
    ("object_noise_floor_db", [40.5] * 10),
    ("expected_error_db", []),
    ("coverage", [0.25] * 8 + [0.5] * 2),
    ("spp", [256, 256] + [128] * 8),
    ("camera_attempt", [0] * 4 + [0, 0, 2, 2] + [0] * 2),
]


def test_textures_and_skies(tmp_path: Path) -> None:
    """Two scenes of one look, one with a sky alone, and a plain one."""
    half = sky(radiance_rgb=np.full((2, 4, 3), 0.5, np.float32))
    scenes = [textured_scene(), textured_scene(), tiny_scene(environment=half), tiny_scene()]
    shards = {"train-000000.tar": [sample(key, scene) for key, scene in enumerate(scenes)]}
    maps = dataset_distributions(write_dataset(tmp_path, shards))
    assert maps.all("textures_per_scene").tolist() == [2, 2, 0, 0]
    assert maps.all("texture_width").tolist() == [6, 2, 6, 2]
    assert maps.all("skies_per_scene").tolist() == [0, 0, 1, 0]
    assert maps.all("sky_radiance") == pytest.approx([0.5])
    assert maps.all("sky_half_light_deg") == pytest.approx([180], abs=0.01)
    assert maps.maps == {
        ("texture", "colours 0"): 2,
        ("texture", "roughness"): 2,
        ("sky", "sky 0"): 1,
    }
    assert maps.surfaces["shell", "textured"] == 2
    assert {"kind": "sky", "family": "sky 0", "scenes": 1} in maps.as_json()["maps"]


def test_a_view_has_reached_its_targets_when_it_has_reached_all(found: Distributions) -> None:
    def reached(**targets: float) -> list[bool]:
        asked = dataclasses.replace(found, targets={**found.targets, **targets})
        each = asked.reaches_targets("train")
        assert each is not None
        return [bool(view) for view in each]

    assert reached() == [False] * 2 + [True] * 6  # the first scene states 38 dB
    assert reached(noise_floor_linear_db=33.0) == reached()
    assert reached(noise_floor_linear_db=33.5) == [False] * 8
    assert reached(noise_floor_objects_db=41.0) == [False] * 8
    nothing = dataclasses.replace(found, targets=dict.fromkeys(found.targets))
    assert nothing.reaches_targets("train") is None


def test_each_shard_is_reported_and_there_may_be_none(tmp_path: Path) -> None:
    names: list[str] = []
    dataset_distributions(five_scenes(tmp_path / "five"), shard_done=names.append)
    assert names == ["test-000005.tar", "train-000000.tar", "train-000001.tar"]
    found = dataset_distributions(write_dataset(tmp_path / "none", {}))
    assert (found.splits, found.licences, found.rejections) == ([], {}, {})
    assert found.as_json()["quantities"]["spp"] == {"count": 0}


def test_bad_samples_and_failures_are_one_clear_line(tmp_path: Path) -> None:
    plain, scene = sample(7, furnished([])), furnished(["a"])
    bad = [
        sample(7, furnished([]).with_provenance({"template": 3})),
        sample(7, furnished([]), noise_floor_db="quiet"),
        sample(7, dataclasses.replace(scene, faces=scene.faces + np.uint32(50))),
        dataclasses.replace(plain, views=plain.views[:1], radiance_rgb=plain.radiance_rgb[:1]),
    ]
    for folder, made in with_folders(tmp_path, bad):
        dataset = write_dataset(folder, {"train-000000.tar": [made]})
        with pytest.raises(TrilightError, match="sample 000000007: .*trilight verify"):
            dataset_distributions(dataset)
    five_scenes(tmp_path).folder.failures.write_bytes(b'{"stage": "objects"}\n')
    with pytest.raises(TrilightError, match="failures"):
        dataset_distributions(open_dataset(str(tmp_path)))


def test_summary_leaves_out_what_is_not_finite() -> None:
    assert summary([1, np.nan, 3, np.inf]) == {
        "count": 2, "min": 1, "p5": 1.1, "median": 2, "mean": 2, "p95": 2.9, "max": 3,
    }  # fmt: skip
    assert set(summary([1])) == set(STATISTICS)
    assert summary([]) == {"count": 0}


DOCUMENTS = (
    "README.md", "LICENSE.md", "croissant.json", "attribution.csv", "contact_sheet.png",
    "report.html",
)  # fmt: skip


def card_of(dataset: Dataset) -> tuple[dict[str, Any], str]:
    """Return the card's front matter and its body."""
    found = dataset_distributions(dataset)
    card = encode_card(dataset.folder, dataset.manifest, found)
    _, front, body = card.decode().split("---\n", 2)
    return yaml.safe_load(front), body


@pytest.mark.usefixtures("bare_reports")
def test_the_front_matter_says_what_hubs_ask_and_equal_datasets_have_equal_documents(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither place, clock nor language is in them; of the report's figures see test_report."""
    dataset, second = five_scenes(tmp_path), five_scenes(tmp_path / "other" / "b")
    write_documents(dataset, dataset.folder)
    os.utime(second.folder.manifest, (0, 0))
    monkeypatch.setenv("LC_ALL", "de_DE.UTF-8")
    write_documents(second, second.folder)
    for name in DOCUMENTS:
        assert (tmp_path / name).read_bytes() == (second.folder.root / name).read_bytes()
    front, body = card_of(dataset)
    assert dataset.folder.card.read_text().endswith(f"---\n{body}")
    assert front["license"] == "other"
    assert front["license_name"] == "mixed-object-licences"
    assert (tmp_path / front["license_link"]).exists()
    assert front["size_categories"] == ["n<1K"]
    (config,) = front["configs"]
    files = {entry["split"]: entry["path"] for entry in config["data_files"]}
    assert files == {"train": ["train-*.tar"], "test": ["test-*.tar"]}
    for split, patterns in files.items():
        found = {path.name for pattern in patterns for path in tmp_path.glob(pattern)}
        assert found == {path.name for path in tmp_path.glob("*.tar") if split in path.name}
    counts = (0, 999, 1000, 9_999, 10_000, 123_456, 5_000_000, 10**7)
    assert [_size_category(count) for count in counts] == [
        "n<1K", "n<1K", "1K<n<10K", "1K<n<10K", "10K<n<100K", "100K<n<1M", "1M<n<10M", "n>10M",
    ]  # fmt: skip


def test_one_licence_is_stated_as_the_hub_spells_it(tmp_path: Path) -> None:
    spellings = {
        "CC0-1.0": "cc0-1.0",
        "CC-BY-SA-4.0": "cc-by-sa-4.0",
        "ODC-By-1.0": "odc-by",
        "GPL-3.0-only": "gpl-3.0",
        "LicenseRef-user-provided": "other",
        "MIT OR (my own: one)": "other",
    }
    dataset = five_scenes(tmp_path)
    lock = dataset.folder.objects_lock
    for licence, spelling in spellings.items():
        write_objects_lock(lock, [locked("a", licence), locked("b", licence)])
        front, body = card_of(dataset)
        assert front["license"] == spelling
        assert ("license_link" in front) == (spelling == "other")
        assert re.fullmatch(r"[a-z0-9.-]+", front.get("license_name", "none"))
        assert ("not known here" in body) == (spelling == "other")
    write_objects_lock(lock, [locked("a", "mine"), locked("b", "yours")])
    assert "duties of `mine`, `yours` are" in card_of(dataset)[1]


def test_the_body_counts_by_split_and_licence(tmp_path: Path) -> None:
    """By hand: 8 training views, two of them at 38 dB and the cap; the target is 40 dB."""
    dataset = five_scenes(tmp_path)
    _, body = card_of(dataset)
    assert "| train | 4 | 8 | 2 | 41.5 (33.2, 40.5) | 38.0 (33.2, 40.5) | 75% | 25% |" in body
    assert "| test | 1 | 2 | 1 | 44.0 (33.2, 40.5) | 44.0 (33.2, 40.5) | 100% | 0% |" in body
    assert "| asks for |" in body and "| attribution, changes | 1 |" in body
    assert "| nothing | 3 |" in body
    assert "- **attribution**:" in body and "share-alike" not in body
    assert "4, of which 3 stand in scenes" in body
    assert dataset.digest in body
    licences = dataset_distributions(dataset).licences
    assert "attribution, changes" in render_markdown("license.jinja", licences=licences).decode()


def test_expected_errors_stand_beside_the_promised_ones(tmp_path: Path) -> None:
    """In card, statistics and captions; without them neither says a word of them."""
    expected = PictureErrors(
        noise_floor_db=43.25, noise_floor_linear_db=35.0, object_noise_floor_db=42.0
    )
    stated = sample(0, tiny_scene())
    views = tuple(dataclasses.replace(view, expected=expected) for view in stated.views)
    both = {"stated": dataclasses.replace(stated, views=views), "bounds": stated}
    said = {}
    for name, one in both.items():
        dataset = write_dataset(tmp_path / name, {"train-000000.tar": [one]})
        read = dataset.read_samples(dataset.manifest.shards[0], [one.key])
        (again,) = read
        assert again.views == one.views
        rows = dict(dataset_statistics(dataset).lines())
        assert ("expected error" in rows) == (name == "stated")
        said[name] = card_of(dataset)[1] + error_text(again.views[0])
    assert "| 41.5 (33.2, 40.5), probably 43.2 | 41.5 (33.2, 40.5) |" in said["stated"]
    assert said["stated"].endswith("41.5 dB, probably 43.2")
    assert "calibrated on other scenes" in said["stated"]
    assert "probably" not in said["bounds"]


@pytest.mark.parametrize("profiles", [["lossless"] * 2, ["compact"] * 2, ["lossless", "compact"]])
def test_the_example_of_the_card_runs_as_it_stands(tmp_path: Path, profiles: list[Profile]) -> None:
    """Whichever way the arrays are packed; a merged dataset may hold both."""
    shards = {f"train-00000{row}.tar": [sample(row, furnished(["a"]))] for row in range(2)}
    _, body = card_of(write_dataset(tmp_path, shards, profiles=profiles))
    (example,) = re.findall(r"```python\n(.*?)```", body, re.DOTALL)
    assert len(example.strip().splitlines()) <= 10
    shown = "\n    print(sample['json']['schema_version'])\n"
    printed = io.StringIO()
    with contextlib.chdir(tmp_path), contextlib.redirect_stdout(printed):
        exec(example.rstrip() + shown, {})
    lines = [(f"{row:09d} (16, 16, 3) (5, 3) (2, 4, 4)", "3") for row in range(2)]
    assert printed.getvalue().split("\n")[:-1] == [line for each in lines for line in each]


HOSTILE = (
    "x\n---\nlicense: mit\n---\n# mine",
    '"; - evil: [1',
    "<script>alert(1)</script> & <img src=x onerror=y>",
    "| a | b |\n![i](https://example.org/?leak)",
    "`code` [link](javascript:alert(1)) *bold*",
    "\u2028\u0085\x00\x1b[31m \ud800 é高",
)


def test_text_from_outside_stays_text_in_its_line_its_code_span_its_yaml_and_its_json(
    tmp_path: Path,
) -> None:
    for escape in (text, code):
        assert "\n" not in escape("a\nb\r\nc\u2028d")
    assert code("a`b|c") == "`a'b\\|c`"
    values = {
        "a": "yes: no # [", "b": ["1", "null"], "c": [{"d": "x", "e": ["y", "'"]}, {"d": "1e3"}],
        "f": [], "g": 3,
    }  # fmt: skip
    assert yaml.safe_load(front_matter(values).strip("-")) == values
    dataset = five_scenes(tmp_path)
    for licence in ('"}, {', "x\n\ud800", "LicenseRef-a"):
        document = json.loads(encode_croissant(dataset.manifest, [licence]))
        assert document["license"] == [licence]
    lock, settings = dataset.folder.objects_lock, dataset.manifest.settings
    objects = read_objects_lock(lock)
    for value in HOSTILE:
        write_objects_lock(lock, [*objects, locked("z", value, title=value)])
        value = value.encode(errors="replace").decode()
        hostile = {**settings, "source": value, "seed": [value]}
        edit_manifest(dataset, build=value, settings=hostile, environment={"processor": value})
        front, body = card_of(open_dataset(str(tmp_path)))
        assert front["pretty_name"] == plain(f"Trilight dataset {value}")
        assert front["license"] == "other"
        (row,) = [line for line in body.splitlines() if "not known here | 1 |" in line]
        assert len(re.findall(r"(?<!\\)\|", row)) == 4
        outside_code = re.sub(r"`[^`]*`", "", body)
        assert "<script" not in outside_code and "<img" not in outside_code
        assert not re.search(r"(?<!\\)\]\((javascript|https://example\.org)", outside_code)
        assert "\x1b" not in body and "\n# mine" not in body


def test_the_validator_has_no_error_and_every_shard_and_scene_is_found(tmp_path: Path) -> None:
    mlcroissant = pytest.importorskip("mlcroissant", reason="run make setup-all")
    dataset = five_scenes(tmp_path)
    manifest, path = dataset.manifest, dataset.folder.croissant
    path.write_bytes(encode_croissant(manifest, dataset_distributions(dataset).licences))
    read = mlcroissant.Dataset(jsonld=str(path))
    issues = read.metadata.ctx.issues
    assert not issues.errors
    missed = {message.split('"')[1].rsplit("/", 1)[-1] for message in map(str, issues.warnings)}
    assert missed == {"citeAs", "datePublished"}
    assert read.metadata.ctx.conforms_to.value == "http://mlcommons.org/croissant/1.1"
    assert sorted(read.metadata.license) == [
        "https://spdx.org/licenses/CC-BY-4.0.html",
        "https://spdx.org/licenses/CC0-1.0.html",
    ]
    files = {entry.id: entry.sha256 for entry in read.metadata.file_objects}
    assert files == {shard.name: shard.sha256 for shard in manifest.shards}
    scenes = {row["scenes/key"].decode(): row["scenes/json"] for row in read.records("scenes")}
    assert sorted(scenes) == sorted(key for shard in manifest.shards for key in dataset.keys(shard))
    assert json.loads(scenes["000000020"])["provenance"]["template"] == "wall"
    assert [row["splits/name"] for row in read.records("splits")] == ["train", "test"]
    # A dataset without shards is valid too.
    path.write_bytes(encode_croissant(dataclasses.replace(manifest, shards=()), []))
    assert not mlcroissant.Dataset(jsonld=str(path)).metadata.ctx.issues.errors


@pytest.mark.usefixtures("bare_reports")
def test_described_shards_are_spread_over_each_split_and_documents_of_a_sample_say_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Eleven shards of one scene each, one of them for testing."""
    shards = {f"train-{row:06d}.tar": [sample(row, tiny_scene())] for row in range(10)}
    shards["test-000010.tar"] = [sample(10, tiny_scene())]
    eleven = write_dataset(tmp_path / "set", shards)
    monkeypatch.setattr("storage.dataset.statistics.MOST_SCENES", 11)
    assert described_shards(eleven) == list(eleven.manifest.shards)
    whole = dataset_statistics(eleven)
    assert whole.scene_digest and "what follows is" not in dict(whole.lines())
    monkeypatch.setattr("storage.dataset.statistics.MOST_SCENES", 4)
    names = [shard.name for shard in described_shards(eleven)]
    assert names == ["test-000010.tar", *(f"train-{row:06d}.tar" for row in (0, 3, 6, 9))]
    monkeypatch.setattr(dataset_documents, "MOST_LISTED", 3)
    out = DatasetFolder(tmp_path / "documents")
    out.root.mkdir()
    statistics = write_documents(eleven, out)
    said = "of a sample of 5 of 11 scenes"
    lines = dict(statistics.lines())
    assert lines["what follows is"] == said and "scene digest" not in lines
    assert lines["scenes"] == "11 (1 test, 10 train)" and statistics.num_views == 10
    assert f"Views, errors and contents are those {said}." in out.card.read_text()
    assert said in out.report.read_text()
    assert dataset_distributions(eleven).sample == said
    mlcroissant = pytest.importorskip("mlcroissant", reason="run make setup-all")
    record = json.loads(out.croissant.read_bytes())
    assert "train-000000.tar" not in json.dumps(record)  # 250,000 of them would take 200 MB
    assert not mlcroissant.Dataset(jsonld=str(out.croissant)).metadata.issues.errors
