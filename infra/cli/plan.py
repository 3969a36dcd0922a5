"""`trilight plan`: predicts the cost of a dataset from a few scenes measured on this machine."""

import dataclasses
import itertools
from typing import TYPE_CHECKING, Annotated

from infra.cli.console import (
    duration,
    first_words,
    next_step,
    note,
    print_result,
    progress_bars,
)
from infra.cli.options import command
from infra.cli.overrides import BaseSettings, with_base_settings
from infra.cli.process_exit import temporary_folder
from pipeline.generation.generate_options import CorePrice, GenerateOptions, generate_words
from storage.dataset.layout import dataset_folder
from storage.errors import TrilightError
from storage.machine import available_cores
from storage.settings.described import checked
from storage.settings.ranges import Within

if TYPE_CHECKING:
    from infra.planning import Prediction


@checked()
class PlanOptions:
    """Measurement and machines."""

    samples: Annotated[int, Within(4, 10_000, unit="scenes")] = 12
    """Number of scenes to measure."""
    cores: Annotated[int, Within(1, 10**7, unit="cores")] = 64
    """Total number of cores of all machines."""


@command("build")
def plan(
    options: GenerateOptions,
    base: BaseSettings,
    plan_options: PlanOptions,
    core: CorePrice,
) -> None:
    if (options.scenes_from, options.revisits, options.shards) != (None,) * 3:
        raise TrilightError(
            "plan: --scenes-from, --revisits or --range was given; expected none of them, since a "
            "whole dataset of new scenes is predicted."
        )
    options = with_base_settings(options, base)
    build = options.build
    samples = plan_options.samples
    cores = plan_options.cores
    first_words(f"Measuring {samples} scenes of {build}")
    from infra.planning import measure_scenes, predict_cost  # slow: every stage

    with progress_bars() as bars, temporary_folder("trilight-plan-") as place:
        task = bars.add_task("scenes", total=samples, note="")
        measured = measure_scenes(options, samples, place, lambda: bars.advance(task))
    prediction = predict_cost(measured, options, cores=cores, usd_per_core_hour=core.price)
    title = f"{build}, {prediction.num_scenes} scenes, predicted from {samples} (90 % intervals)"
    record = dataclasses.asdict(prediction)
    print_result(title, _rows(prediction, cores), record)
    for text in prediction.notes:
        note(text)
    next_step((*generate_words(options), "--out", _free(options.place)))


def _rows(prediction: "Prediction", cores: int) -> list[tuple[str, str]]:
    local_cores = available_cores()
    here_text = prediction.core_hours.to_text(lambda hours: _hours(hours / local_cores))
    tasks = f"{prediction.num_tasks}, {prediction.task_minutes:.1f} minutes each"
    return [
        ("core-hours", prediction.core_hours.to_text("{:,.2f}".format)),
        (f"on {cores} cores", prediction.hours.to_text(_hours)),
        (f"on the {local_cores} cores here", here_text),
        ("USD", prediction.usd.to_text("{:,.2f}".format)),
        ("GB", prediction.gigabytes.to_text("{:,.2f}".format)),
        ("shards", f"{prediction.num_shards} of up to {prediction.scenes_per_shard} scenes"),
        ("a shard", prediction.shard_hours.to_text("{:,.2f} core-hours".format)),
        ("Prefect's task runs", tasks),
        ("Prefect's database", f"{prediction.database_mb:.1f} MB"),
        ("manifest.json", f"{prediction.manifest_mb:.1f} MB"),
    ]


def _hours(hours: float) -> str:
    return duration(3600 * hours)


def _free(place: str) -> str:
    """Return a folder or URL without a dataset: this one, or with a number added."""
    numbered = (place if number < 2 else f"{place}-{number}" for number in itertools.count(1))
    return next(name for name in numbered if not dataset_folder(name).manifest.exists())
