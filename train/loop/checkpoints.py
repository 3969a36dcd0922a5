"""Which checkpoints a run has, and which of them stay."""

from pathlib import Path

from storage.atomic import remove_leftovers
from storage.errors import TrilightError
from train.loop.checkpoint import save_checkpoint
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


def newest_checkpoint(folder: Path) -> Path:
    """Return the newest checkpoint; raises TrilightError where there is none."""
    steps = saved_steps(folder)
    if not steps:
        raise TrilightError(
            f"{folder.parent}: no checkpoint here to resume from; start the run without --resume."
        )
    return checkpoint_path(folder, steps[-1])


def keep_checkpoint(
    folder: Path, state: TrainState, settings: TrainSettings, *, data_digest: str, world_size: int
) -> None:
    """Save the state, whole or not at all, and only then delete what the run does not keep.

    Kept are the newest `checkpoints_kept` and every multiple of `keep_every`.

    Raises:
        TrilightError: the folder is full or cannot be written; the older ones are still there.
    """
    path = checkpoint_path(folder, state.step)
    save_checkpoint(path, state, settings, data_digest=data_digest, world_size=world_size)
    remove_leftovers(folder)
    for step in saved_steps(folder)[: -settings.checkpoints_kept]:
        if not settings.keep_every or step % settings.keep_every:
            checkpoint_path(folder, step).unlink(missing_ok=True)
