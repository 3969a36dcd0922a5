"""notes.jsonl: what happened to a run and when; unlike the log it is never cut back."""

import json
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from storage.atomic import write_error


def add_note(path: Path, step: int, text: str, **facts: Any) -> None:
    """Append a sentence without its full stop.

    Args:
        path: the file.
        step: steps that were done by then.
        text: what happened.
        facts: more, by name; JSON values.

    Raises:
        TrilightError: the folder is full or cannot be written.
    """
    line = json.dumps({"step": step, "at_unix_s": round(time.time()), "text": text, **facts})
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a") as stream:
            stream.write(line + "\n")
    except OSError as error:
        raise write_error(path, error) from error


def read_notes(path: Path) -> list[Mapping[str, Any]]:
    """Return all whole notes, oldest first; a missing file has none."""
    if not path.exists():
        return []
    notes = []
    for line in path.read_text().splitlines():
        with suppress(
            ValueError
        ):  # a kill cut it short, and the next note went on in the same line
            notes.append(json.loads(line))
    return notes
