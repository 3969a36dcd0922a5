"""Which checkpoints a run has, which it goes on from, and which of them stay."""

from collections.abc import Callable
from pathlib import Path

from storage.atomic import remove_leftovers
from storage.errors import TrilightError
from train.loop.checkpoint import Checkpoint, read_checkpoint, save_checkpoint
from train.loop.crew import Crew
from train.loop.state import TrainState
from train.settings import TrainSettings

PREFIX, SUFFIX = "step-", ".safetensors"


def saved_steps(folder: Path) -> list[int]:
    """Return the steps of which there is a checkpoint, oldest first."""
    names = [path.name for path in folder.glob(f"{PREFIX}*{SUFFIX}")]
    digits = [name.removeprefix(PREFIX).removesuffix(SUFFIX) for name in names]
    return sorted(int(text) for text in digits if text.isdecimal())


def checkpoint_path(folder: Path, step: int) -> Path:
    """Return where the checkpoint of a step is."""
    return folder / f"{PREFIX}{step:09d}{SUFFIX}"


def resumed_checkpoint(folder: Path, crew: Crew, noted: Callable[[str], None]) -> Checkpoint:
    """Return the newest checkpoint that is whole.

    Args:
        folder: of the checkpoints.
        crew: the processes that go on together; all must call it.
        noted: is told of those that are not, and which one took their place.

    Raises:
        TrilightError: there is none, none is whole, or a process reads another than this one.
    """
    steps = saved_steps(folder)
    if not steps:
        raise TrilightError(
            f"{folder.parent}: no checkpoint here to resume from; start the run without --resume."
        )
    checkpoint = _newest_whole(folder, steps, noted)
    step = checkpoint.header["step"]
    # bit by bit, since the mean of a large number is rounded, and the verdict must be everybody's
    if any(0 < share < 1 for share in crew.mean([step >> bit & 1 for bit in range(32)])):
        raise TrilightError(
            f"{folder.parent}: the processes do not read the same checkpoint; this one reads that "
            f"of step {step}. Look whether the folder is the same on every machine, and resume "
            "again."
        )
    return checkpoint


def _newest_whole(folder: Path, steps: list[int], noted: Callable[[str], None]) -> Checkpoint:
    damaged = []
    for step in reversed(steps):
        try:
            checkpoint = read_checkpoint(checkpoint_path(folder, step))
        except TrilightError as error:
            damaged.append(str(error))
            continue
        if damaged:
            noted(f"{' '.join(damaged)} The run goes on from that of step {step}")
        return checkpoint
    raise TrilightError(
        f"{folder.parent}: none of its checkpoints can be resumed from. {' '.join(damaged)} "
        "Restore one from a copy, or start the run again in another folder."
    )


def keep_checkpoint(
    folder: Path, state: TrainState, settings: TrainSettings, *, data_digest: str, world_size: int
) -> None:
    """Save the state, whole or not at all, and only then delete what the run does not keep.

    Kept are the newest `checkpoints_kept` and every multiple of `keep_every`. One of a later step
    could not be read when the run went on from an earlier one, and takes nobody's place.

    Raises:
        TrilightError: the folder is full or cannot be written; the older ones are still there.
    """
    path = checkpoint_path(folder, state.step)
    save_checkpoint(path, state, settings, data_digest=data_digest, world_size=world_size)
    remove_leftovers(folder)
    passed = [step for step in saved_steps(folder) if step <= state.step]
    for step in passed[: -settings.checkpoints_kept]:
        if not settings.keep_every or step % settings.keep_every:
            checkpoint_path(folder, step).unlink(missing_ok=True)
