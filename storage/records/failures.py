"""`failures.jsonl`: every object, scene and view that was rejected, with its reason."""

import dataclasses
import json
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from storage.atomic import write_atomically
from storage.digests import canonical_json
from storage.errors import TrilightError
from storage.records.objects import Failure


def encode_failures(failures: Iterable[Failure]) -> bytes:
    """Return one line per failure, each once, sorted by stage, item and attempt."""
    rows = sorted(set(failures), key=lambda row: (row.stage, row.item, row.attempt, row.reason))
    return b"".join(canonical_json(dataclasses.asdict(row)) + b"\n" for row in rows)


def decode_failures(data: bytes) -> list[Failure]:
    """Return the failures of a file that `encode_failures` made.

    Raises:
        TrilightError: a line is not a failure.
    """
    try:
        return [Failure(**json.loads(line)) for line in data.splitlines()]
    except (TypeError, ValueError) as error:
        raise TrilightError(f"failures.jsonl: a line is not a failure ({error}).") from error


def read_failures(path: Path) -> list[Failure]:
    """Return the failures of a file; none where there is no file."""
    return decode_failures(path.read_bytes()) if path.exists() else []


def write_failures(path: Path, failures: Iterable[Failure]) -> None:
    """Write the failures atomically."""
    write_atomically(path, encode_failures(failures))


def count_by_reason(failures: Iterable[Failure]) -> list[tuple[str, str, int]]:
    """Return (stage, reason, how many), the most frequent first."""
    counts = Counter((failure.stage, failure.reason) for failure in failures)
    return [(stage, reason, count) for (stage, reason), count in counts.most_common()]
