"""Writer of notes.jsonl, the dated notes of a run; unlike the log it is never truncated."""

import json
import time
from pathlib import Path

from storage.atomic import append_line


def add_note(path: Path, step: int, text: str) -> None:
    """Append a sentence without its full stop.

    Args:
        path: path of notes.jsonl.
        step: number of steps that were done by then.
        text: the sentence.

    Raises:
        TrilightError: the folder is full or cannot be written.
    """
    line = json.dumps({"step": step, "at_unix_s": round(time.time()), "text": text})
    append_line(path, line)
