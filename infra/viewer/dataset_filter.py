"""Filter of the scenes on a dataset's page, and the command that selects the same scenes."""

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from infra.viewer.dataset_index import SORTED_BY, SceneRow
from storage.errors import TrilightError, expected_one_of

_WHERE = {
    "triangles": "triangles_per_scene",
    "lights": "lights_per_scene",
    "coverage": "min(coverage)",
    "floor": "min(noise_floor_db)",
}
"""Columns with limits, by their quantity in `trilight shards select --where`."""


@dataclass(frozen=True, kw_only=True)
class SceneFilter:
    """Conditions and order of a dataset's page."""

    split: str = ""
    """Split of the scenes; empty for all splits."""
    template: str = ""
    """Layout of the scenes; empty for all layouts."""
    least: Mapping[str, float]
    """Lower limits, inclusive, by column."""
    most: Mapping[str, float]
    """Upper limits, inclusive, by column."""
    sort: str = "key"
    descending: bool = False

    def rows(self, rows: Sequence[SceneRow]) -> list[SceneRow]:
        """Return the rows that meet the conditions, sorted."""
        matching = [row for row in rows if self._matches(row)]
        return sorted(matching, key=SORTED_BY[self.sort], reverse=self.descending)

    def command(self, dataset: Path, out: Path) -> str:
        """Return the command that selects the matching scenes; empty without conditions."""
        words = ["trilight", "shards", "select", str(dataset)]
        conditions = [
            f"{_WHERE[name]} {sign} {value:g}"
            for limits, sign in ((self.least, ">="), (self.most, "<="))
            for name, value in limits.items()
        ]
        options = {"--split": self.split, "--template": self.template}
        options["--where"] = " and ".join(conditions)
        chosen = [word for option, value in options.items() if value for word in (option, value)]
        return shlex.join([*words, *chosen, "--out", str(out)]) if chosen else ""

    def _matches(self, row: SceneRow) -> bool:
        return (
            self.split in ("", row.split)
            and self.template in ("", row.template)
            and all(getattr(row, name) >= value for name, value in self.least.items())
            and all(getattr(row, name) <= value for name, value in self.most.items())
        )


def filter_of(query: Mapping[str, str]) -> SceneFilter:
    """Return the filter of a query.

    Args:
        query: `split`, `template`, `sort`, `descending`, and `COLUMN_min` and `COLUMN_max`.

    Raises:
        TrilightError: a limit is no number, or the sort column is unknown.
    """
    sort = query.get("sort", "key")
    if sort not in SORTED_BY:
        raise TrilightError(f"sort is {sort:.40}; {expected_one_of(sort, list(SORTED_BY))}.")
    ends = {
        end: {
            name: _number(query[f"{name}_{end}"], name)
            for name in _WHERE
            if query.get(f"{name}_{end}")
        }
        for end in ("min", "max")
    }
    return SceneFilter(
        split=query.get("split", ""),
        template=query.get("template", ""),
        least=ends["min"],
        most=ends["max"],
        sort=sort,
        descending=query.get("descending") == "1",
    )


def _number(text: str, name: str) -> float:
    try:
        # rounded as in the command, so that both select the same scenes
        value = float(f"{float(text):g}")
    except ValueError as error:
        raise TrilightError(f"{name}: {text:.20} is no number.") from error
    if not math.isfinite(value):
        raise TrilightError(f"{name}: {text:.20} is no finite number.")
    return value
