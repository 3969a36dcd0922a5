"""Notes outlive kills and resumes."""

from pathlib import Path

from train.watching.notes import add_note, read_notes


def test_notes_are_read_back_in_order_also_after_a_line_that_a_kill_cut(tmp_path: Path) -> None:
    path = tmp_path / "notes.jsonl"
    assert read_notes(path) == []
    add_note(path, 0, "began")
    whole = path.read_text()
    path.write_text(whole + whole[:20])
    add_note(path, 3, "lost with the line that was cut")
    add_note(path, 4, "went on", processes=2)
    assert [(note["step"], note["text"]) for note in read_notes(path)] == [
        (0, "began"),
        (4, "went on"),
    ]
