"""The card of a dataset: what hubs read, what people read, and nothing that runs or leaks."""

import contextlib
import io
import os
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from pipeline.documents.card import _size_category, encode_card
from pipeline.documents.dataset_documents import write_documents
from pipeline.documents.distributions import dataset_distributions
from pipeline.documents.markdown import code, front_matter, plain, text
from pipeline.documents.rights import encode_licences, rights_of
from storage.dataset.dataset import Dataset, open_dataset
from storage.records.objects import read_objects_lock, write_objects_lock
from storage.records.profiles import Profile
from tests.pipeline.documents.dataset_by_hand import (
    edit_manifest,
    five_scenes,
    furnished,
    locked,
    sample,
)
from tests.pipeline.making.derive_kit import finished

DOCUMENTS = (
    "README.md", "LICENSE.md", "croissant.json", "attribution.csv", "contact_sheet.png",
    "report.html",
)  # fmt: skip


def card_of(dataset: Dataset) -> tuple[dict[str, Any], str]:
    """Return the card's front matter and its body."""
    found = dataset_distributions(dataset)
    card = encode_card(dataset.folder, dataset.manifest, found, rights_of(found.objects))
    _, front, body = card.decode().split("---\n", 2)
    return yaml.safe_load(front), body


@pytest.mark.usefixtures("bare_reports")
def test_the_front_matter_says_what_hubs_ask(tmp_path: Path) -> None:
    dataset = five_scenes(tmp_path)
    write_documents(dataset)
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
    for licence, spelling in spellings.items():
        objects = [locked("a", licence), locked("b", licence)]
        write_objects_lock(dataset.folder.objects_lock, objects)
        front, body = card_of(dataset)
        assert front["license"] == spelling
        assert ("license_link" in front) == (spelling == "other")
        assert re.fullmatch(r"[a-z0-9.-]+", front.get("license_name", "none"))
        assert ("not known here" in body) == (spelling == "other")


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
    rights = rights_of(read_objects_lock(dataset.folder.objects_lock))
    assert "attribution, changes" in encode_licences(rights).decode()


@pytest.mark.parametrize("profiles", [["lossless"] * 2, ["compact"] * 2, ["lossless", "compact"]])
def test_the_example_of_the_card_runs_as_it_stands(tmp_path: Path, profiles: list[Profile]) -> None:
    """Whichever way the arrays are packed; a merged dataset may hold both."""
    finished(tmp_path, {
        f"train-00000{row}.tar": [sample(row, furnished(["a"]))]
        for row in range(2)
    }, profiles=profiles)  # fmt: skip
    _, body = card_of(open_dataset(str(tmp_path)))
    (example,) = re.findall(r"```python\n(.*?)```", body, re.DOTALL)
    assert len(example.strip().splitlines()) <= 7
    shown = "\n    print(arrays['faces'].shape, picture.shape, sample['json']['schema_version'])\n"
    printed = io.StringIO()
    with contextlib.chdir(tmp_path), contextlib.redirect_stdout(printed):
        exec(example.rstrip() + shown, {})
    assert printed.getvalue().splitlines() == ["(5, 3) (16, 16, 3) 3"] * 2


@pytest.mark.usefixtures("bare_reports")
def test_equal_datasets_have_equal_documents(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither place, clock nor language is in them; of the report's figures see test_report."""
    first, second = five_scenes(tmp_path / "a"), five_scenes(tmp_path / "other" / "b")
    write_documents(first)
    os.utime(second.folder.manifest, (0, 0))
    monkeypatch.setenv("LC_ALL", "de_DE.UTF-8")
    write_documents(second)
    for name in DOCUMENTS:
        assert (first.folder.root / name).read_bytes() == (second.folder.root / name).read_bytes()


HOSTILE = (
    "x\n---\nlicense: mit\n---\n# mine",
    '"; - evil: [1',
    "<script>alert(1)</script> & <img src=x onerror=y>",
    "| a | b |\n![i](https://example.org/?leak)",
    "`code` [link](javascript:alert(1)) *bold*",
    "\u2028\u0085\x00\x1b[31m \ud800 é高",
)


def test_text_from_outside_stays_text(tmp_path: Path) -> None:
    dataset = five_scenes(tmp_path)
    lock, settings = dataset.folder.objects_lock, dataset.manifest.settings
    objects = read_objects_lock(lock)
    for value in HOSTILE:
        write_objects_lock(lock, [*objects, locked("z", value, title=value)])
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


def test_one_line_stays_one_line_and_a_code_span_ends_where_it_should() -> None:
    for escape in (text, code):
        assert "\n" not in escape("a\nb\r\nc\u2028d")
    assert code("a`b|c") == "`a'b\\|c`"


def test_yaml_comes_back_as_it_was() -> None:
    values = {
        "a": "yes: no # [", "b": ["1", "null"], "c": [{"d": "x", "e": ["y", "'"]}, {"d": "1e3"}],
        "f": [], "g": 3,
    }  # fmt: skip
    assert yaml.safe_load(front_matter(values).strip("-")) == values


def test_sizes_are_named_as_the_hub_names_them() -> None:
    counts = (0, 999, 1000, 9_999, 10_000, 123_456, 5_000_000, 10**7)
    assert [_size_category(count) for count in counts] == [
        "n<1K", "n<1K", "1K<n<10K", "1K<n<10K", "10K<n<100K", "100K<n<1M", "1M<n<10M", "n>10M",
    ]  # fmt: skip
