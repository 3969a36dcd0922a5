"""The result of a finished run, and how it is written."""

import dataclasses
import json
from dataclasses import dataclass

from model.renderformer import count_parameters
from model.weights import TrainedRange, encode_weights
from storage.atomic import write_atomically
from storage.dataset.training_data import TrainingData
from train.evaluation.judge import Judge
from train.evaluation.scores import Lead
from train.evaluation.sheet import drawn_validation_sheet, write_picture
from train.folder import RunFolder
from train.going_on import Event
from train.loop.state import TrainState
from train.settings import TrainSettings
from train.watching.rows import read_rows

LOSS_SHARE = 20
"""The loss at start and end is the mean over the first and last 1 / LOSS_SHARE of the log."""


@dataclass(frozen=True, kw_only=True)
class TrainResult:
    """What a finished run has to show."""

    folder: RunFolder
    """Where everything is."""
    num_parameters: int
    """Numbers in the network's weights."""
    num_steps: int
    """Steps done, including skipped ones."""
    skipped_steps: int
    """Steps that were not finite and changed nothing."""
    loss_at_start: float
    """Mean training loss over the first twentieth of the run."""
    loss_at_end: float
    """The same over the last twentieth."""
    scores: dict[str, float] | None
    """The network on the validation split (evaluation.judge); None where the data has none."""
    median_scores: dict[str, float] | None
    """The median picture of the training views on the same split."""
    lead: Lead | None
    """Advantage of the network over the median picture."""
    unusable: tuple[str, ...]
    """What was wrong with data that was left out in this call."""
    history: tuple[Event, ...]
    """What it began with, what was decided about it, and how it was executed otherwise."""
    seconds: float
    """Wall time of this call, from opening the data to writing the sheet."""

    @property
    def beats_median(self) -> bool | None:
        """Whether the network is better than the median picture by more than chance explains."""
        return None if self.lead is None else self.lead.is_sure


def finished(
    state: TrainState,
    settings: TrainSettings,
    folder: RunFolder,
    data: TrainingData,
    judge: Judge | None,
    seconds_before: float,
) -> TrainResult:
    """Judge the finished network, write weights, sheet and summary, and return the result."""
    trained = TrainedRange(max_triangles=data.max_triangles, resolution=settings.resolution)
    write_atomically(folder.weights, encode_weights(state.shown, trained))
    loss_at_start, loss_at_end = _losses(folder)
    judgement = None
    if judge is not None:
        judgement = judge.judge(state.shown)
        write_picture(folder.sheet, drawn_validation_sheet(settings, judge, judgement, state.step))
    result = TrainResult(
        folder=folder,
        num_parameters=count_parameters(state.model),
        num_steps=state.step,
        skipped_steps=state.skipped_steps,
        loss_at_start=loss_at_start,
        loss_at_end=loss_at_end,
        scores=judgement.scores if judgement else None,
        median_scores=judge.median_scores if judge else None,
        lead=judgement.lead if judgement else None,
        unusable=tuple(state.unusable.messages),
        history=state.history,
        seconds=seconds_before,
    )
    record = dataclasses.asdict(result) | {"beats_median": result.beats_median}
    del record["folder"]
    write_atomically(folder.summary, pretty_json(record))
    return result


def pretty_json(record: object) -> bytes:
    """Return JSON for people: indented, sorted, with a newline at its end."""
    return json.dumps(record, indent=1, sort_keys=True).encode() + b"\n"


def _losses(folder: RunFolder) -> tuple[float, float]:
    """Return the mean training loss of the first and of the last rows of the log."""
    rows = [row["loss"] for row in read_rows(folder.metrics) if row.get("loss") is not None]
    count = max(len(rows) // LOSS_SHARE, 1)
    return sum(rows[:count]) / count, sum(rows[-count:]) / count
