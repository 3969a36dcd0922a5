"""SHA256SUMS: of what is published, renewed with the documents, and never of a damaged shard."""

import subprocess
from pathlib import Path

import pytest

from pipeline.documents.dataset_documents import write_documents
from pipeline.documents.sums import SUMS, published_files, renew_sums, stale_sums, write_sums
from storage.errors import TrilightError
from tests.pipeline.documents.dataset_by_hand import five_scenes

SHARD = "train-000000.tar"


def checked(folder: Path) -> list[str]:
    """Return the files that coreutils find to be others than the sums say."""
    done = subprocess.run(
        ["sha256sum", "--quiet", "-c", SUMS],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    return sorted(line.partition(": ")[0] for line in done.stdout.splitlines())


@pytest.mark.usefixtures("bare_reports")
def test_documents_that_are_written_again_have_their_sums(tmp_path: Path) -> None:
    dataset = five_scenes(tmp_path / "set")
    root = dataset.folder.root
    dataset.folder.report.write_text("an older report")
    write_sums(root)
    write_documents(dataset)
    assert checked(root) == [] == stale_sums(root)
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
