"""What a closed loop keeps on disk: a folder for each round, whose files say how far it is.

    order.json                 what was asked for; another order is refused
    rounds/01/drawn.json       what the round draws, written before anything is made
    rounds/01/dataset/         its scenes, an ordinary dataset
    rounds/01/lessons.json     what it taught, written when the round is done
    run/                       the training, an ordinary run that goes on in every round

Every file appears at once (storage.atomic), so that a kill at any moment costs what was under way.
"""

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from infra.improve.order import PLACES, ImproveOrder
from infra.improve.weights import Lesson
from storage.atomic import write_atomically
from storage.errors import TrilightError
from storage.settings.described import settings_record


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """What a round draws."""

    scenes: int
    """Training scenes that are asked for; a dataset holds whole shards."""
    seed: int
    """Of its dataset."""
    weights: Mapping[str, float]
    """Share of each stratum; they sum to one."""


@dataclass(frozen=True, kw_only=True)
class Lessons:
    """What a round taught."""

    digest: str
    """Of its dataset."""
    scenes: int
    """Its training scenes."""
    making_core_s: float
    """Core-seconds of making all its scenes, as its logs say; of wall time and cores."""
    training_core_s: float
    """Core-seconds of the training process; of the last one, where it was killed and went on."""
    strata: Mapping[str, Lesson]
    """By stratum; those without a held-out scene are left out."""
    losses: Mapping[str, float]
    """Mean log L1 of each held-out scene after the round, by key."""


class Rounds:
    """The folder of a closed loop."""

    def __init__(self, order: ImproveOrder) -> None:
        self.order = order

    def begin(self) -> None:
        """Write the order down, or compare it with the one that is there.

        Raises:
            TrilightError: another order was begun in the folder.
        """
        path, record = self.order.root / "order.json", settings_record(self.order)
        if not path.is_file():
            _write(path, {"order": record})
            return
        there = _read(path).get("order", {})
        # as JSON reads them: a form makes 10.0 of what a command line calls 10
        wrong = [
            f"{name} is {value!r}, but was begun with {there.get(name)!r}"
            for name, value in json.loads(json.dumps(record)).items()
            if name not in PLACES and there.get(name) != value
        ]
        if wrong:
            raise TrilightError(
                f"{self.order.out}: holds another loop: {'; '.join(wrong)}. Go on as it was "
                "begun, or choose another --out."
            )

    def dataset(self, number: int) -> Path:
        """Return the folder of a round's dataset."""
        return self._folder(number) / "dataset"

    def drawn(self, number: int) -> Drawn | None:
        """Return what a round draws, where that was decided."""
        return _found(self._folder(number) / "drawn.json", Drawn)

    def lessons(self, number: int) -> Lessons | None:
        """Return what a round taught, where it is done."""
        found = _found(self._folder(number) / "lessons.json", Lessons)
        if found is None:
            return None
        strata: Mapping[str, Any] = found.strata
        read = {name: Lesson(**lesson) for name, lesson in strata.items()}
        return dataclasses.replace(found, strata=read)

    def decide(self, number: int, drawn: Drawn) -> None:
        """Write down what a round draws."""
        _write(self._folder(number) / "drawn.json", dataclasses.asdict(drawn))

    def learn(self, number: int, lessons: Lessons) -> None:
        """Write down what a round taught: it is done."""
        _write(self._folder(number) / "lessons.json", dataclasses.asdict(lessons))

    def history(self, number: int) -> list[Drawn]:
        """Return what all rounds before one drew."""
        found = [self.drawn(earlier) for earlier in range(1, number)]
        return [drawn for drawn in found if drawn is not None]

    def _folder(self, number: int) -> Path:
        return self.order.root / "rounds" / f"{number:02d}"


State = TypeVar("State", Drawn, Lessons)


def _found(path: Path, kind: type[State]) -> State | None:
    if not path.is_file():
        return None
    try:
        return kind(**_read(path))
    except TypeError as error:
        raise TrilightError(
            f"{path.name}: {error}; expected a file of `trilight improve`. Delete the round's "
            "folder to make it anew."
        ) from error


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise TrilightError(
            f"{path.name}: {error}; expected JSON. Delete the round's folder to make it anew."
        ) from error


def _write(path: Path, record: Mapping[str, Any]) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TrilightError(
            f"improve: {path.parent} cannot be made ({error.strerror}); expected a folder that may "
            "be written. Choose another --out."
        ) from error
    write_atomically(path, (json.dumps(record, indent=2, sort_keys=True) + "\n").encode())
