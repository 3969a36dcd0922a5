"""Result of a finished run, and its files."""

import dataclasses
from dataclasses import dataclass

from model.renderformer import count_parameters
from model.weights import TrainedRange, encode_weights
from storage.atomic import write_atomically
from storage.dataset.training_data import TrainingData
from train.evaluation.metrics import Lead
from train.evaluation.sheet import draw_validation_sheet, write_picture
from train.evaluation.validation import Judge
from train.folder import RunFolder, pretty_json
from train.loop.train_state import TrainState
from train.monitoring.rows import read_rows
from train.resume import Event
from train.settings import TrainSettings

LOSS_SHARE = 20
"""Divisor of the log's rows: the start and end losses average the first and last twentieth."""


@dataclass(frozen=True, kw_only=True)
class TrainResult:
    """Result of a finished run."""

    folder: RunFolder
    """Folder that holds all files of the run."""
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
    """The network on the validation split (evaluation.validation); None where the data has none."""
    median_scores: dict[str, float] | None
    """The median picture of the training views on the same split."""
    lead: Lead | None
    """Advantage of the network over the median picture."""
    unusable: tuple[str, ...]
    """Error messages of the damaged data that this call left out."""
    history: tuple[Event, ...]
    """Origin, decisions and execution changes of the run, oldest first."""
    seconds: float
    """Wall time of this call, from opening the data to writing the sheet."""

    @property
    def beats_median(self) -> bool | None:
        """True if the network beats the median picture by more than two standard errors."""
        return None if self.lead is None else self.lead.is_sure


def finish_run(
    state: TrainState,
    settings: TrainSettings,
    folder: RunFolder,
    data: TrainingData,
    judge: Judge | None,
    seconds: float,
) -> TrainResult:
    """Evaluate the finished network, and write its weights, sheet and summary."""
    trained = TrainedRange(max_triangles=data.max_triangles, resolution=settings.resolution)
    write_atomically(folder.weights, encode_weights(state.eval_model, trained))
    losses = [row["loss"] for row in read_rows(folder.metrics) if row.get("loss") is not None]
    count = max(len(losses) // LOSS_SHARE, 1)
    validation = None
    if judge is not None:
        validation = judge.judge(state.eval_model)
        write_picture(folder.sheet, draw_validation_sheet(settings, judge, validation, state.step))
    result = TrainResult(
        folder=folder,
        num_parameters=count_parameters(state.model),
        num_steps=state.step,
        skipped_steps=state.skipped_steps,
        loss_at_start=sum(losses[:count]) / count,
        loss_at_end=sum(losses[-count:]) / count,
        scores=validation.scores if validation else None,
        median_scores=judge.median_scores if judge else None,
        lead=validation.lead if validation else None,
        unusable=tuple(state.bad_samples.messages),
        history=state.history,
        seconds=seconds,
    )
    record = dataclasses.asdict(result) | {"beats_median": result.beats_median}
    del record["folder"]
    write_atomically(folder.summary, pretty_json(record))
    return result
