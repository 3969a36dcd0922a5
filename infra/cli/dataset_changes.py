"""Applies the settings of another dataset or of a settings file to the options of a dataset."""

import dataclasses
from typing import Any, TypeVar

from infra.cli.changes import BaseSettings, all_changes, dataset_record
from pipeline.builds.named import named_build
from pipeline.generation.dataset_order import DatasetOrder

Order = TypeVar("Order", bound=DatasetOrder)
_LICENCES = "allowed_licences"


def with_base_settings(order: Order, base: BaseSettings) -> Order:
    """Return options whose `changes` hold all differences from the preset.

    Raises:
        TrilightError: settings cannot be read, or the preset refuses a value, also one that the
            options state.
    """
    stated = {**_options(order), **order.changes}
    changes = all_changes(named_build(order.build), base, dataset_record(base), stated)
    if not base.is_given:
        return order
    if _LICENCES in changes:  # the option adds licences to those of any source of settings
        changes[_LICENCES] = sorted({*changes[_LICENCES], *order.allow_licences})
    return dataclasses.replace(order, changes=changes)


def _options(order: DatasetOrder) -> dict[str, Any]:
    """Return the settings that single options state; they override those of a file."""
    stated = {"seed": order.seed, "renders.resolution": order.resolution}
    options: dict[str, Any] = {name: value for name, value in stated.items() if value is not None}
    return options | {f"renders.{name}": db for name, db in order.noise_targets.overrides.items()}
