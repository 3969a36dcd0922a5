"""A dataset's order with the settings of another dataset or of a file in it."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from infra.cli.changes import Shared, all_changes, dataset_record
from pipeline.flows.builds import named_build
from pipeline.flows.order import DatasetOrder


def with_shared(order: DatasetOrder, shared: Shared) -> DatasetOrder:
    """Return an order whose changes are all that differs from its build, checked.

    Raises:
        TrilightError: settings that cannot be read, or that the build refuses.
    """
    build = named_build(order.build)
    liked = dataset_record(shared)
    stated = {**_options(order, liked), **order.changes} if shared.is_given else order.changes
    return dataclasses.replace(order, changes=all_changes(build, shared, liked, stated))


def _options(order: DatasetOrder, liked: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that an order's own options state: they count more than a file's."""
    licences = {*liked.get("allowed_licences", ()), *order.allow_licences}
    stated = {
        "seed": order.seed,
        "renders.resolution": order.resolution,
        "renders.noise_floor_db": order.noise_floor_db,
        "allowed_licences": sorted(licences) if order.allow_licences else None,
    }
    return {name: value for name, value in stated.items() if value is not None}
