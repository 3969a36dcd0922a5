"""Prefect flow `train-model`: a training run as a process, or as several by torchrun.

It is in `infra`, which may import both `pipeline` and `train`: the form has every setting of
`train.settings`, and wrong settings are refused before the training process exists, without torch.
"""

import contextlib
from collections.abc import Mapping
from typing import Any, Literal

from prefect import flow
from prefect.concurrency.sync import concurrency
from prefect.logging import get_run_logger

from infra.train_options import TrainOptions
from pipeline.flows.forms import (
    PublicUrl,
    options_of_form,
    overrides_form,
    parameters_of,
    run_name,
)
from pipeline.flows.prefect_server import GPU_LIMIT, run_to_end
from pipeline.renders.mitsuba_variant import visible_gpus
from storage.aliases import PRESET_ALIASES
from storage.errors import TrilightError
from train.presets import TRAINING_PRESETS, training_preset
from train.settings import TrainSettings

TrainingPresetName = Literal[(*PRESET_ALIASES, *TRAINING_PRESETS)]  # type: ignore[valid-type]
"""Names of the training presets, a list of choices in the form."""
RunChanges = overrides_form(TrainSettings, training_preset("smoke"))
"""Form of every setting; an empty one keeps the preset's value."""


TRAIN_FORMS: Mapping[str, Any] = {
    "run": TrainingPresetName,
    "data": list[PublicUrl],
    "begin_with": PublicUrl | None,
    "branch": PublicUrl | None,
    "lpips": PublicUrl | None,
    "changes": RunChanges | None,
}
"""Types of parameters that are narrower in the form than on the command line."""


def train_options(parameters: Mapping[str, Any]) -> TrainOptions:
    """Return the training options of the flow's parameters.

    Raises:
        TrilightError: a value that no schema can refuse, such as one that contradicts another
            setting; the message names it.
    """
    options = options_of_form(parameters, TrainOptions)
    options.settings()
    return options


@flow(name="train-model", flow_run_name=run_name, persist_result=False)
@parameters_of(TrainOptions, **TRAIN_FORMS)
def train_model(**parameters: Any) -> None:
    """Train a model on a dataset, in processes of its own; a run that is cancelled is saved.

    Prefect waits for half a minute then; `resume` goes on from there.
    """
    options = train_options(parameters)
    log = get_run_logger()
    cards = len(visible_gpus())
    limit = (
        concurrency(GPU_LIMIT, occupy=min(options.processes, cards), strict=False)
        if cards
        else contextlib.nullcontext()
    )
    with limit:
        status, last = run_to_end(options.command(), lambda line: log.info("%s", line))
    if status:
        raise TrilightError(f"train {options.run} ended with status {status}: {last}")
