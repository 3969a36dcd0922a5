"""`trilight verify` of what is not finished, and of what is: its exit status and its next step."""

import json
from pathlib import Path

from storage.dataset.asked import write_asked
from tests.command_line import trilight
from tests.pipeline.making.test_publication import begin_tiny, make_tiny_shard

WIDE = {"COLUMNS": "200"}


def test_an_unfinished_set_is_not_verified(tmp_path: Path) -> None:
    publication = begin_tiny(tmp_path / "my set", 12)
    place = str(tmp_path / "my set")
    empty = trilight(["verify", place], env=WIDE)
    assert empty.exit_code == 1
    assert "Unfinished" in empty.output
    assert "Verified" not in empty.output
    make_tiny_shard(publication, 0)
    write_asked(publication.folder, ["generate", "smoke", "--seed", "7"])
    begun = trilight(["verify", place, "--fast"], env=WIDE)
    assert begun.exit_code == 1
    assert "1 of 3" in begun.output
    assert f"Next: trilight generate smoke --seed 7 --out '{place}'" in begun.output
    told = json.loads(trilight(["verify", place, "--fast", "--json"]).output)
    assert (told["finished"], told["shards"], told["shards_planned"]) == (False, 1, 3)


def test_words_that_do_not_print_are_not_repeated(tmp_path: Path) -> None:
    """Whoever hands out a dataset may have written them."""
    publication = begin_tiny(tmp_path, 12)
    for words in (["train", "smoke"], ["generate", "smoke\x1b[2J"], ["generate", "a\nb"]):
        write_asked(publication.folder, words)
        shown = trilight(["verify", str(tmp_path)], env=WIDE).output
        assert "Next:" not in shown
        assert "run the trilight generate command that began it" in shown
