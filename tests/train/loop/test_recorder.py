"""What TensorBoard shows is what the log says, also after a resume, and the sheet is there."""

from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.summary.writer import event_file_writer

from storage.dataset.dataset import Dataset
from tests.train.kit import tiny_run, trained
from tests.train.toy import write_toy_dataset
from train.progress import TrainProgress
from train.watching.rows import read_rows


class Stop(BaseException):
    """A power cut."""


class StopAt(TrainProgress):
    def advance(self, *, step: int, loss: float, learning_rate: float, views_per_s: float) -> None:
        if step == 7:
            raise Stop


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_toy_dataset(tmp_path_factory.mktemp("toy"), train=7, validation=2, per_shard=3)


def test_curves_and_sheets_survive_a_resume(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # TensorBoard reads files of one second by the number of their writer: 10 before 9
    monkeypatch.setattr(event_file_writer, "_global_uid", event_file_writer.AtomicCounter(0))
    data = [str(dataset.folder.root)]
    with pytest.raises(Stop):
        trained(tiny_run(), data, tmp_path, progress=StopAt())
    result = trained(tiny_run(), data, tmp_path, resume=True)
    events = EventAccumulator(str(result.folder.tensorboard)).Reload()
    rows = [row for row in read_rows(result.folder.metrics) if "loss" in row]
    shown = {event.step: event.value for event in events.Scalars("train/loss")}
    # TensorBoard keeps float32
    assert shown == pytest.approx({row["step"]: row["loss"] for row in rows}, rel=1e-6)
    assert [event.step for event in events.Scalars("validation/log_l1")] == [4, 8, 12]
    assert {event.step for event in events.Images("validation")} == {4, 8, 12}
    assert result.median_scores is not None
    median = [event.value for event in events.Scalars("validation/median_picture_log_l1")]
    assert median == pytest.approx([result.median_scores["log_l1"]] * 3, rel=1e-6)
