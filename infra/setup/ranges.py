"""Writes docs/ranges.md: every numeric field that a person may set, and what it may be."""

import dataclasses
import inspect
import re
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

from infra.rendering.session import Asked
from infra.serving.train_model import TrainOrder
from pipeline.documents.markdown import table
from pipeline.flows.price import CorePrice
from pipeline.flows.served.orders import DatasetInRuns
from pipeline.flows.served.schema import field_docs
from pipeline.flows.settings import BuildSettings
from storage.ranges import Declared, declared_ranges, shown_number
from storage.scene import Scene
from train.evaluation.evaluate import Contest
from train.settings import TrainSettings

FILE = Path(__file__).parents[2] / "docs/ranges.md"

ROOTS: dict[str, tuple[type, ...]] = {
    "Scene": (Scene,),
    "Generate": (DatasetInRuns, BuildSettings),
    "Render": (Asked,),
    "Plan": (CorePrice,),
    "Train": (TrainOrder, TrainSettings),
    "Evaluate": (Contest,),
}
"""What each command is told; the settings within settings are found from here."""

_HEAD = """# Ranges

Made by `make ranges` from the declarations at the fields, which are also what is checked
(`storage/ranges.py`): a value outside is refused in one line that names the field. Tests go to both
ends of every range and one step outside (`tests/extremes/test_ranges.py`), and run what both ends
make where that is cheap. Laws between fields, such as `min_spp` of at most `max_spp`, are not here:
the complaint about one says what it expects.
"""


def main() -> None:
    """Write the file."""
    FILE.write_text(ranges_page())


def ranges_page() -> str:
    """Return docs/ranges.md."""
    parts = [_HEAD]
    for command, roots in ROOTS.items():
        parts.append(f"## {command}\n")
        for settings in reachable(*roots):
            if rows := list(_rows(settings)):
                first = _first_sentence(inspect.getdoc(settings) or "")
                parts.append(f"### `{settings.__name__}`\n\n{first}\n")
                parts.append(table(("field", "meaning", "range", "unit", "default"), rows) + "\n")
    return "\n".join(parts)


def reachable(*roots: type) -> list[type]:
    """Return dataclasses and those that their fields hold, each once, outer ones first."""
    found: dict[type, None] = {}
    for root in roots:
        found[root] = None
        hints = typing.get_type_hints(root)
        for field in dataclasses.fields(root):
            for kind in _kinds(hints[field.name]):
                if dataclasses.is_dataclass(kind):
                    found |= dict.fromkeys(reachable(kind))
    return list(found)


def _kinds(hint: Any) -> Iterator[type]:
    """Yield the classes that a type is made of."""
    if isinstance(hint, type) and not get_args(hint):
        yield hint
    for part in get_args(hint):
        yield from _kinds(part)


def _rows(settings: type) -> Iterator[tuple[str, ...]]:
    docs = field_docs(settings)
    assert dataclasses.is_dataclass(settings)
    defaults = {field.name: field.default for field in dataclasses.fields(settings)}
    for declared in declared_ranges(settings):
        part = "" if declared.part is None else f", {declared.part.name}"
        yield (
            f"`{declared.name}`{part}",
            _first_sentence(docs[declared.name]).replace("|", "\\|"),
            _range(declared),
            declared.within.unit,
            _shown(defaults[declared.name]),
        )


def _range(declared: Declared) -> str:
    bounds = str(dataclasses.replace(declared.within, unit=""))
    whole = "whole, " if declared.kind is int else ""
    return f"{whole}{bounds}" + (", or none" if declared.optional else "")


def _shown(default: Any) -> str:
    if default is dataclasses.MISSING:
        return ""
    if default is None:
        return "none"
    if isinstance(default, tuple):
        return ", ".join(shown_number(part) for part in default) or "none"
    return shown_number(default)


def _first_sentence(doc: str) -> str:
    """Return a text up to its first full stop before a space, in one line."""
    found = re.match(r".*?(?<! al)\.(?=\s|$)", " ".join(doc.split()))
    return found[0] if found else doc


if __name__ == "__main__":
    main()
