"""A dataset's order with the settings of another dataset or of a file in it."""

import dataclasses
from typing import Any, TypeVar

from infra.cli.changes import Shared, all_changes, dataset_record
from pipeline.builds.named import named_build
from pipeline.making.dataset_order import DatasetOrder
from pipeline.renders.settings import asked_floors

Order = TypeVar("Order", bound=DatasetOrder)
_LICENCES = "allowed_licences"


def with_shared(order: Order, shared: Shared) -> Order:
    """Return an order whose changes are all that differs from its build.

    Raises:
        TrilightError: settings that cannot be read, or that the build refuses, those that the order
            states included.
    """
    stated = {**_options(order), **order.changes}
    changes = all_changes(named_build(order.build), shared, dataset_record(shared), stated)
    if not shared.is_given:
        return order
    if _LICENCES in changes:  # licences are allowed beside others, wherever those are from
        changes[_LICENCES] = sorted({*changes[_LICENCES], *order.allow_licences})
    return dataclasses.replace(order, changes=changes)


def _options(order: DatasetOrder) -> dict[str, Any]:
    """Return the settings that an order's own options state: they count more than a file's."""
    stated = {"seed": order.seed, "renders.resolution": order.resolution}
    floors = asked_floors(
        order.noise_floor_db, order.noise_floor_linear_db, order.noise_floor_objects_db
    )
    found: dict[str, Any] = {name: value for name, value in stated.items() if value is not None}
    return found | {f"renders.{name}": db for name, db in floors.items()}
