"""The one file of `trilight bench card`: measured part by part, written, and read again."""

import datetime
import json
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from infra.bench.card.effort import CARD, PROCESSOR, CardEffort
from infra.bench.card.predicted import with_prediction
from infra.bench.card.private import without_traces
from infra.bench.card.probe import card_facts, copy_rates, product_rates
from infra.bench.card.supply import reading, rendered_scenes
from infra.bench.card.ten_steps import steps_of_run
from infra.bench.card.twin import pictures_beside_twins
from infra.bench.machine import machine
from infra.doctor import examine
from storage.atomic import write_atomically
from storage.errors import TrilightError
from train.runs import RUNS

SCHEMA, VERSION = "trilight-card", 1
MOST_BYTES = 1 << 20
"""Size of a file that is written or read."""

Doing = Callable[[str], None]
"""Is told what is measured next."""


def measured_card(
    device: torch.device,
    effort: CardEffort,
    *,
    data: str | None = None,
    runs: Sequence[str] = (),
    doing: Doing = lambda name: None,
    keep: Callable[[Mapping[str, Any]], None] = lambda record: None,
) -> dict[str, Any]:
    """Return all that is measured, as JSON values without names of this machine.

    A part that cannot be measured has `failed`, with why, and the others are there.

    Args:
        device: the card, or the processor in its place.
        effort: how much.
        data: dataset for the loader; by default copies of the scenes that are rendered here.
        runs: names of runs; by default all of ours.
        doing: is told what comes next.
        keep: is given all that there is after every part, for whoever is interrupted.
    """
    found: dict[str, Any] = {"schema": SCHEMA, "version": VERSION, "effort": effort.name}
    found["date"] = datetime.datetime.now(datetime.UTC).date().isoformat()
    found["machine"] = machine()
    began = time.monotonic()
    for name, measure in _parts(device, effort, doing):
        doing(name)
        found[name] = _tried(measure)
        keep(_cleaned(found))
    rates = found["products"] if "failed" not in found["products"] else {}
    found["runs"] = []
    for run in runs or [name for name in RUNS if RUNS.is_ours(name)]:
        doing(f"steps of {run}")
        found["runs"].append(with_prediction(steps_of_run(run, effort, device), effort, rates))
        found["seconds"] = time.monotonic() - began
        keep(_cleaned(found))
    found |= _fed(effort, data, doing)
    found["seconds"] = time.monotonic() - began
    return _cleaned(found)


def _cleaned(found: Mapping[str, Any]) -> dict[str, Any]:
    cleaned: dict[str, Any] = without_traces(_rounded(found))
    return cleaned


def _parts(
    device: torch.device, effort: CardEffort, doing: Doing
) -> Iterator[tuple[str, Callable[[], Any]]]:
    yield "doctor", lambda: [asdict(one) for one in examine(lambda name: doing(f"doctor: {name}"))]
    yield "card", lambda: card_facts(device)
    yield "products", lambda: product_rates(device, effort)
    yield "copies", lambda: copy_rates(device, effort)
    yield "pictures", lambda: pictures_beside_twins(device)


def _tried(measure: Callable[[], Any]) -> Any:
    try:
        return measure()
    except Exception as error:  # nobody measures a card twice for one part that fails
        return {"failed": f"{type(error).__name__}: {str(error)[:500]}"}


def _fed(effort: CardEffort, data: str | None, doing: Doing) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="trilight-card-") as place:
        doing("views an hour")
        rendered = _tried(lambda: rendered_scenes(effort, Path(place)))
        if isinstance(rendered, tuple):
            rendered, copies = rendered
            data = data or str(copies)
        if data is None:
            return {"rendering": rendered, "reading": {"failed": "nothing to read"}}
        source = data
        doing("samples a second")
        return {"rendering": rendered, "reading": _tried(lambda: reading(source, effort))}


def _rounded(value: Any) -> Any:
    """Return a JSON value with four digits of every number that is none of a count."""
    if isinstance(value, float):
        return float(f"{value:.4g}")
    if isinstance(value, Mapping):
        return {key: _rounded(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(entry) for entry in value]
    return value


def chosen_effort(device: torch.device) -> CardEffort:
    """Return what is measured of a device."""
    return CARD if device.type == "cuda" else PROCESSOR


def write_report(record: Mapping[str, Any], path: Path) -> None:
    """Write the file.

    Raises:
        TrilightError: it cannot be written, or is larger than what is read again.
    """
    data = json.dumps(record, indent=1, sort_keys=True, allow_nan=False).encode() + b"\n"
    if len(data) > MOST_BYTES:
        raise TrilightError(
            f"bench card: the record has {len(data)} bytes; expected at most {MOST_BYTES}. Please "
            "report this."
        )
    write_atomically(path, data)


def read_report(path: Path) -> dict[str, Any]:
    """Return the record of a file that somebody sent.

    Raises:
        TrilightError: it is no such file, or of another version.
    """
    try:
        data = path.read_bytes() if path.stat().st_size <= MOST_BYTES else b""
    except OSError as error:
        raise TrilightError(f"{path}: {error.strerror}; expected a file of bench card.") from error
    try:
        found = json.loads(data)
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict) or found.get("schema") != SCHEMA:
        raise TrilightError(
            f"{path}: it says schema {_told(found, 'schema')}; expected one that `trilight bench "
            f"card` wrote, {SCHEMA!r}."
        )
    if found.get("version") != VERSION:
        raise TrilightError(
            f"{path}: version {_told(found, 'version')}; expected {VERSION}. Read it with the "
            "Trilight that wrote it."
        )
    return found


def _told(found: Any, name: str) -> str:
    return repr(found.get(name))[:40] if isinstance(found, dict) else "nothing"
