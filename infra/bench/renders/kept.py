"""What a long benchmark has measured so far, so that an interruption costs one scene."""

import json
from collections.abc import Callable, Mapping
from typing import Any

from storage.atomic import write_atomically
from storage.cache import cache_folder


class Kept:
    """The finished items of a run, in the user's cache until the run has ended."""

    def __init__(self, name: str, plan: Mapping[str, Any], *, resume: bool) -> None:
        """Begin, or go on where `resume` is asked for and a run of the same plan was interrupted.

        Args:
            name: of the benchmark.
            plan: all that the items depend on, JSON values: machine, versions, settings.
            resume: whether finished items of an interrupted run count.
        """
        self._path = cache_folder("bench") / f"{name}.json"
        self._plan = json.loads(json.dumps(plan))
        self._items: dict[str, Any] = self._of_before() if resume else {}
        self.num_resumed = len(self._items)
        """Items that were measured before this run."""

    def item(self, key: str, measure: Callable[[], Any]) -> Any:
        """Return the JSON value of an item, measured unless it is kept already."""
        if key not in self._items:
            self._items[key] = measure()
            record = {"plan": self._plan, "items": self._items}
            write_atomically(self._path, json.dumps(record).encode())
        return self._items[key]

    def forget(self) -> None:
        """Drop the items of a run that has ended."""
        self._path.unlink(missing_ok=True)

    def _of_before(self) -> dict[str, Any]:
        try:
            record = json.loads(self._path.read_bytes())
        except (OSError, ValueError):
            return {}
        return dict(record["items"]) if record["plan"] == self._plan else {}
