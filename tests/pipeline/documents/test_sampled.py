"""A huge dataset is described by a sample of its scenes, and every document says so."""

import json
from pathlib import Path

import mlcroissant
import pytest

from pipeline.documents import croissant
from pipeline.documents.dataset_documents import write_documents
from pipeline.documents.distributions import dataset_distributions
from storage.dataset import sampled
from storage.dataset.dataset import Dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.sampled import described_shards
from storage.dataset.statistics import dataset_statistics
from tests.pipeline.documents.dataset_by_hand import sample, write_dataset
from tests.scenes_by_hand import tiny_scene


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    """Return 11 shards of one scene each, one of them for testing."""
    shards = {f"train-{row:06d}.tar": [sample(row, tiny_scene())] for row in range(10)}
    return write_dataset(
        tmp_path / "set", {**shards, "test-000010.tar": [sample(10, tiny_scene())]}
    )


def test_shards_are_spread_over_each_split(dataset: Dataset) -> None:
    assert described_shards(dataset, 11) == list(dataset.manifest.shards)
    names = [shard.name for shard in described_shards(dataset, 4)]
    assert names == ["test-000010.tar", *(f"train-{row:06d}.tar" for row in (0, 3, 6, 9))]


@pytest.mark.usefixtures("bare_reports")
def test_documents_of_a_sample_say_so(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = dataset_statistics(dataset)
    assert whole.scene_digest and "what follows is" not in dict(whole.lines())
    monkeypatch.setattr(sampled, "MOST_SCENES", 4)
    monkeypatch.setattr(croissant, "MOST_LISTED", 3)
    out = DatasetFolder(tmp_path / "documents")
    out.root.mkdir()
    statistics = write_documents(dataset, out)
    said = "of a sample of 5 of 11 scenes"
    lines = dict(statistics.lines())
    assert lines["what follows is"] == said and "scene digest" not in lines
    assert lines["scenes"] == "11 (1 test, 10 train)" and statistics.num_views == 10
    assert f"Views, errors and contents are those {said}." in out.card.read_text()
    assert said in out.report.read_text()
    assert dataset_distributions(dataset).sample == said
    record = json.loads(out.croissant.read_bytes())
    assert "train-000000.tar" not in json.dumps(record)  # 250,000 of them would take 200 MB
    assert not mlcroissant.Dataset(jsonld=str(out.croissant)).metadata.issues.errors
