"""`trilight plan`: what a dataset will take, from a few scenes that are measured here."""

import dataclasses
import itertools
from typing import Annotated

from infra.cli.changes import Shared
from infra.cli.console import (
    duration,
    first_words,
    next_step,
    note,
    print_json,
    print_rows,
    progress_bars,
)
from infra.cli.dataset_changes import with_shared
from infra.cli.leaving import temporary_folder
from infra.cli.options import Shown, command
from pipeline.making.dataset_order import DatasetOrder, generate_words
from pipeline.making.machine import cores_owned
from pipeline.making.price import CorePrice
from storage.dataset.layout import dataset_folder
from storage.errors import TrilightError
from storage.settings.described import checked
from storage.settings.ranges import Within


@checked()
class Prognosis:
    """The measurement, and the machines to predict for."""

    samples: Annotated[int, Within(4, 10_000, unit="scenes")] = 12
    """Number of scenes to measure."""
    cores: Annotated[int, Within(1, 10**7, unit="cores")] = 64
    """Total number of cores of all machines."""


@command("build")
def plan(
    order: DatasetOrder,
    shared: Shared,
    prognosis: Prognosis,
    core: CorePrice,
    shown: Shown,
) -> None:
    if (order.scenes_from, order.revisits, order.shards) != (None,) * 3:
        raise TrilightError(
            "plan: --scenes-from, --revisits or --shards was given; expected none of them, since a "
            "whole dataset of new scenes is predicted."
        )
    order = with_shared(order, shared)
    build = order.build
    samples = prognosis.samples
    cores = prognosis.cores
    first_words(f"Measuring {samples} scenes of {build}", silent=shown.json)
    from infra.planning import measure_scenes, predict  # slow: every stage

    with progress_bars() as bars, temporary_folder("trilight-plan-") as place:
        task = bars.add_task("scenes", total=samples, note="", visible=not shown.json)
        measured = measure_scenes(order, samples, place, lambda: bars.advance(task))
    found = predict(measured, order, cores=cores, usd_per_core_hour=core.price)
    if shown.json:
        print_json(dataclasses.asdict(found))
        return
    own = cores_owned()
    print_rows(
        f"{build}, {found.num_scenes} scenes, predicted from {samples} (90 % intervals)",
        [
            ("core-hours", found.core_hours.shown("{:,.2f}".format)),
            (f"on {cores} cores", found.hours.shown(_hours)),
            (f"on the {own} cores here", found.core_hours.shown(lambda hours: _hours(hours / own))),
            ("USD", found.usd.shown("{:,.2f}".format)),
            ("GB", found.gigabytes.shown("{:,.2f}".format)),
            ("shards", f"{found.num_shards} of up to {found.scenes_per_shard} scenes"),
            ("a shard", found.shard_hours.shown("{:,.2f} core-hours".format)),
            ("Prefect's task runs", f"{found.num_tasks}, {found.task_minutes:.1f} minutes each"),
            ("Prefect's database", f"{found.database_mb:.1f} MB"),
            ("manifest.json", f"{found.manifest_mb:.1f} MB"),
        ],
    )
    for text in found.notes:
        note(text)
    next_step((*generate_words(order), "--out", _free(order.place)))


def _hours(hours: float) -> str:
    return duration(3600 * hours)


def _free(place: str) -> str:
    """Return a place where no dataset is begun yet: this one, or with a number."""
    numbered = (place if number < 2 else f"{place}-{number}" for number in itertools.count(1))
    return next(name for name in numbered if not dataset_folder(name).manifest.exists())
