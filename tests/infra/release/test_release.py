"""`make release`: a network, a page and sums beside a dataset of built-in objects."""

import hashlib
from pathlib import Path

import numpy as np
import pytest

from infra.release.__main__ import _sum_and_say, _write_network
from infra.release.page import write_page
from infra.release.pictures import NETWORK, RIVALS, Beside, chosen_scenes
from infra.release.push import planned_upload
from model.open import open_network
from pipeline.documents.sums import SUMS
from storage.errors import TrilightError
from tests.command_line import trilight
from tests.conftest import ROOT
from tests.pipeline.documents.dataset_by_hand import (
    five_scenes,
    furnished,
    sample,
    write_dataset,
)
from tests.pipeline.documents.pages_read import read


def beside(key: str, network_db: float) -> Beside:
    rng = np.random.default_rng(int(key))
    target, network, sample = (rng.random((8, 8, 3), np.float32) for _ in range(3))
    return Beside(
        key=key,
        caption="test, plane, 12 triangles",
        target_rgb=target,
        floor_db=41.26,
        pictures_rgb={NETWORK: network, "1 sample, filtered": sample},
        psnr_db={NETWORK: network_db, "1 sample, filtered": 30.0},
    )


def test_the_previews_are_those_that_the_page_on_publishing_promises() -> None:
    *first, last = RIVALS
    words = f"by {', '.join(map(str, first))} and {last} samples with a denoiser"
    assert words in (ROOT / "docs/how-to/publish.md").read_text()


def test_the_page_shows_everybody_and_opens_from_disk(tmp_path: Path) -> None:
    page = write_page(
        tmp_path, [beside("000000001", 31.0), beside("000000002", 28.0)], about=[("dataset", "x")]
    )
    tags = read(page.read_bytes())
    pictures = [link for link in tags.links if link.endswith(".png")]
    assert len(pictures) == 2 * 4 and all((tmp_path / name).is_file() for name in pictures)
    text = " ".join(" ".join(tags.text).split())
    assert "network 29.5 28.0 1 sample, filtered 30.0 30.0 1 of 2" in text
    assert "traced, noise floor 41.3 dB" in text
    assert not {"script", "link"} & set(tags.tags)
    assert planned_upload(tmp_path, "ada/page").kind == "space"
    write_page(tmp_path, [beside("000000002", 28.0)], about=[])
    left = {path.name[:9] for path in (tmp_path / "pictures").iterdir()}
    assert left == {"000000002"}, "an earlier page's pictures would be uploaded too"


def test_scenes_are_those_that_nobody_learned_from(tmp_path: Path) -> None:
    dataset = five_scenes(tmp_path / "five")
    assert {entry.split for entry in chosen_scenes(dataset, 24)} == {"test"}
    shards = {"train-000000.tar": [sample(key, furnished(["a"])) for key in range(4)]}
    only_train = write_dataset(tmp_path / "train", shards)
    assert [entry.split for entry in chosen_scenes(only_train, 3)] == ["train"] * 3
    for none, count in ((write_dataset(tmp_path / "none", {}), 24), (dataset, 0), (dataset, -1)):
        with pytest.raises(TrilightError, match=f"pictures is {count}, .* at least one scene"):
            chosen_scenes(none, count)


def test_a_network_that_is_released_opens(tmp_path: Path) -> None:
    _write_network(tmp_path)
    assert open_network(str(tmp_path)).config.view_stage == "hits"
    assert (tmp_path / "README.md").read_text().startswith("---\n")
    assert planned_upload(tmp_path, "ada/network").kind == "model"


@pytest.mark.usefixtures("bare_reports")
def test_sums_are_of_what_is_uploaded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dataset = five_scenes(tmp_path / "dataset")
    _write_network(tmp_path / "network")
    write_page(tmp_path / "gallery", [beside("000000001", 31.0)], about=[])
    _sum_and_say(tmp_path)
    assert "trilight push" in capsys.readouterr().out
    root = dataset.folder.root
    lines = (root / SUMS).read_text().splitlines()
    assert {line.split("  ")[1] for line in lines} >= {"manifest.json", "train-000000.tar"}
    assert not (root / "report.html").exists()
    assert trilight(["inspect", str(root), "--scenes", "1"]).exit_code == 0
    lines = (root / SUMS).read_text().splitlines()
    assert "report.html" in {line.split("  ")[1] for line in lines}, "sums went stale"
    for line in lines:
        digest, _, name = line.partition("  ")
        assert hashlib.sha256((root / name).read_bytes()).hexdigest() == digest, name
    (tmp_path / "network" / "README.md").write_text("a card by hand")
    with pytest.raises(TrilightError, match=r"SHA256SUMS: README.md is not as it says"):
        planned_upload(tmp_path / "network", "ada/network")
