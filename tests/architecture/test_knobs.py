"""Each experiment is about settings that exist."""

import dataclasses
import inspect
import typing
from collections.abc import Iterator
from typing import Any

from infra.bench.catalogue import every_experiment
from infra.cli.render import render
from pipeline.builds.settings import BuildSettings
from pipeline.making.dataset_order import DatasetOrder
from train.settings import TrainSettings


def _groups(hint: Any) -> list[type]:
    """Return the dataclasses that a type holds: itself, of a union, or in a tuple."""
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return [hint]
    return [group for part in typing.get_args(hint) for group in _groups(part)]


def _fields(settings: type, prefix: str, seen: set[type]) -> Iterator[str]:
    """Yield dotted names; a class that occurs several times is walked where it comes first."""
    hints = typing.get_type_hints(settings)
    for field in dataclasses.fields(settings):
        name, groups = f"{prefix}.{field.name}", _groups(hints[field.name])
        for group in groups:
            if group not in seen:
                seen.add(group)
                yield from _fields(group, name, seen)
        if not groups:
            yield name


def _every_setting() -> set[str]:
    names = {f"render.{name}" for name in inspect.signature(render).parameters}
    for settings, prefix in ((BuildSettings, "build"), (DatasetOrder, "order")):
        names |= set(_fields(settings, prefix, set()))
    return names | set(_fields(TrainSettings, "train", set()))


def test_the_walk_reaches_all_groups() -> None:
    found = _every_setting()
    for name in (
        "build.renders.max_spp",
        "build.assets.gate.area_ratio",
        "build.scenes.families.shell.tilt_deg",
        "build.scenes.families.shell.floor.spin_deg",
        "build.scenes.excursions.axis",
        "order.workers",
        "train.model.width",
        "train.augmentation.mirror",
        "train.precision",
        "render.tone_map",
    ):
        assert name in found


def test_what_an_experiment_is_about_exists() -> None:
    assert {name for one in every_experiment() for name in one.covers} - _every_setting() == set()
