"""The page of a run is whole, needs nothing from outside, and shows what the folder holds."""

from pathlib import Path

import pytest

from infra.run_page.page import write_run_page
from storage.errors import TrilightError
from tests.infra.run_page.run_by_hand import write_run
from tests.pipeline.documents.pages_read import HARM, read
from train.folder import RunFolder


def test_the_page_shows_all_of_a_run_and_loads_nothing(tmp_path: Path) -> None:
    write_run(tmp_path / "run")
    page = read(write_run_page(tmp_path / "run").read_bytes())
    text = " ".join(page.text)
    for shown in (
        "Run tiny",
        "12 of 12, unfinished",
        "median picture 0.2",
        "decoder.head, step 2: 0.1",
        "spike at step 3",
        "000000001",
        "began",
        "views_per_scene: 2",
        "data_digest",
        "process 1 0.2",
        "backward 67%",
    ):
        assert shown in text, shown
    assert {"curves", "pictures", "layers", "spikes", "notes", "settings"} <= page.ids
    inside = [link for link in page.links if link.startswith(("#", "data:image/png;base64,"))]
    assert set(page.links) - set(inside) == {"metrics.jsonl", "notes.jsonl", "settings.json"}
    assert len(set(inside)) == 8, "six sections, the pictures of a step, the targets"
    assert "script" not in page.tags


def test_words_from_outside_never_become_markup(tmp_path: Path) -> None:
    write_run(tmp_path / "run", key=HARM, note=HARM)
    page = read(write_run_page(tmp_path / "run").read_bytes())
    assert "script" not in page.tags and "onerror" not in page.names
    assert sum(HARM in text for text in page.text) == 2


def test_a_run_that_has_only_begun_has_a_page(tmp_path: Path) -> None:
    write_run(tmp_path / "run")
    folder = RunFolder(tmp_path / "run")
    folder.metrics.write_text("")
    folder.notes.unlink()
    for path in folder.pictures.iterdir():
        path.unlink()
    text = " ".join(read(write_run_page(folder.root).read_bytes()).text)
    assert "0 of 12, unfinished" in text and "they come with the first validation" in text


def test_other_folders_and_damage_are_named(tmp_path: Path) -> None:
    with pytest.raises(TrilightError, match="no run here; expected a folder that `trilight train`"):
        write_run_page(tmp_path)
    write_run(tmp_path / "run")
    for damaged in ("{\n", "[]\n", '{"step": 1, "layers": [1]}\n', '{"step": 1, "spike": 3}\n'):
        (tmp_path / "run/metrics.jsonl").write_text(damaged)
        with pytest.raises(TrilightError, match="is not readable .* Restore it from a copy"):
            write_run_page(tmp_path / "run")
