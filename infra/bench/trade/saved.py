"""What was measured so far: the newest curve of every knob among the results in docs/bench."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from infra.bench.trade.curves import Curve, Point


@dataclass(frozen=True, kw_only=True)
class SavedCurve:
    """One curve with where it comes from."""

    curve: Curve
    """Its points."""
    file: str
    """Name of the JSON file."""
    date: str
    """When it was measured."""
    processor: str
    """On what."""

    @property
    def quick(self) -> bool:
        """Whether it comes from `--quick`."""
        return _is_quick(self.file.removesuffix(".json")[:-11])


def saved_curves(folder: Path) -> dict[str, SavedCurve]:
    """Return the curves by knob: the latest day's, of one day the careful before the quick one.

    Of a day's results of one kind, those of single knobs (`--knob`) replace the whole run's: they
    are there because somebody measured again.
    """
    found: dict[str, SavedCurve] = {}
    for path in sorted(folder.glob("trade*.json"), key=_rank):
        record = json.loads(path.read_bytes())
        for name, curve in record["curves"].items():
            found[name] = SavedCurve(
                curve=curve_of(curve),
                file=path.name,
                date=record["date"],
                processor=record["machine"]["processor"],
            )
    return found


def _rank(path: Path) -> tuple[str, bool, bool, str]:
    """Return the order of results, the ones to believe last."""
    stem, date = path.stem[:-11], path.stem[-10:]
    return date, not _is_quick(stem), stem.removesuffix("-quick") != "trade", stem


def _is_quick(stem: str) -> bool:
    """Return whether the name of a result, without its date, is that of a quick run."""
    return stem.endswith("-quick")


def curve_of(record: Mapping[str, Any]) -> Curve:
    """Return a curve as it was before it became JSON."""
    return Curve(
        points=tuple(Point(**point) for point in record["points"]),
        measured_on=record["measured_on"],
        details=tuple(record["details"]),
    )
