"""Reference page of settings: every setting with its meaning, range and default."""

import dataclasses
import inspect
import re
from collections.abc import Iterator
from typing import Any

from infra.render.options import RenderOptions
from infra.serving.train_model import TrainOptions
from pipeline.flows.forms import DatasetInRuns
from pipeline.generation.price import CorePrice
from pipeline.generation.revisit_options import RevisitOptions
from pipeline.presets.settings import DatasetSettings
from storage.markdown import table
from storage.records.material import PUBLISHED_COLUMNS, laid_out
from storage.records.scene import Scene
from storage.settings.fields import (
    default_text,
    describe_fields,
    group_of,
    parts_of,
)
from train.evaluation.options import EvaluationOptions, LeaderboardOptions
from train.settings import TrainSettings, WatchSettings

ROOTS: dict[str, tuple[type, ...]] = {
    "Scene": (Scene,),
    "Generate": (DatasetInRuns, DatasetSettings),
    "Revisit": (RevisitOptions,),
    "Render": (RenderOptions,),
    "Plan": (CorePrice,),
    "Train": (TrainOptions, TrainSettings, WatchSettings),
    "Evaluate": (EvaluationOptions,),
    "Leaderboard": (LeaderboardOptions,),
}
"""Settings classes by command; `reachable` finds the classes within them."""

_HEAD = """# Settings

Made from the descriptions at the fields (`storage/settings/described.py`), which
are also what is checked and what the command line and Prefect's forms show: a value outside is
refused in one line that names the field. Tests go to both ends of every range and one step outside
(`tests/extremes/test_ranges.py`), and run what both ends make where that is cheap. Laws between
fields, such as `min_spp` of at most `max_spp`, are not here: the complaint about one says what it
expects. Every setting of a preset can be changed with `--set NAME=VALUE`, by its dotted
name, such as `--set scenes.lights.count=[2,4]`, `--set scenes.families.0.weight=2` or `--set
model=large`. Settings of a run that say *free* are how it is executed: the weights do not depend on
them, or by rounding alone. All others are what the run means, and change by `--change`, which the
run records ([Carry on a run](../how-to/carry-on-a-run.md)).
"""


def settings_page() -> str:
    """Return every setting with its meaning, range and default."""
    parts = [_HEAD]
    for command, roots in ROOTS.items():
        parts.append(f"## {command}\n")
        for settings in reachable(*roots):
            if rows := list(_rows(settings)):
                first = _first_sentence(inspect.getdoc(settings) or "")
                parts.append(f"### `{settings.__name__}`\n\n{first}\n")
                head = ("field", "meaning", "expected", "default", "when a run goes on")
                parts.append(table(head[: len(rows[0])], rows) + "\n")
    return "\n".join(parts)


def reachable(*roots: type) -> list[type]:
    """Return dataclasses and those in their fields, each once, outer ones first."""
    kinds: dict[type, None] = {}
    for root in roots:
        kinds[root] = None
        for field in describe_fields(root):
            kinds |= dict.fromkeys(reachable(*filter(group_of, parts_of(field.hint))))
    return list(kinds)


def _rows(kind: type) -> Iterator[tuple[str, ...]]:
    if kind is Scene:  # its fields are arrays, and no settings
        for field in describe_fields(Scene):
            ranges = {"": field.within}
            if field.name == "materials":
                columns = laid_out(PUBLISHED_COLUMNS)
                ranges = {f", {column.name}": column.within for column, _ in columns}
            for part, within in ranges.items():
                if within is not None:
                    yield f"`{field.name}`{part}", _first_sentence(field.sentence), str(within), ""
        return
    fields = describe_fields(kind) if hasattr(kind, "__pydantic_fields__") else ()
    is_marked = any(field.is_execution for field in fields)
    for field in fields:
        named = [name for kind in parts_of(field.hint) for name in getattr(kind, "PRESETS", ())]
        presets = f", or one of {', '.join(named)}" if named else ""
        yield (
            f"`{field.name}`",
            _first_sentence(field.sentence).replace("|", "\\|"),
            (field.expected + presets).replace("|", "\\|"),
            _default_text(field.default),
            *(["free" if field.is_execution else ""] if is_marked else []),
        )


def _default_text(default: Any) -> str:
    if default is dataclasses.MISSING or dataclasses.is_dataclass(default):
        return ""
    if default is None or default in ((), {}):
        return "none"
    if isinstance(default, bool):
        return str(default).lower()
    return default_text(default, quote="`")


def _first_sentence(doc: str) -> str:
    """Return a text up to its first full stop before a space, as one line."""
    match = re.match(r".*?(?<! al)\.(?=\s|$)", " ".join(doc.split()))
    return match[0] if match else doc
